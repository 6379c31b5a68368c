//! `feature-worker view`: the live stream with region, axes, outline, line, triangle, V_e and its history, in a local web page.
//!
//! A process of its own, so that it never slows the worker: it reads the cell's frames as one more subscriber (see [`ObserverSource`]),
//! measures them again with the same configuration, and keeps the newest picture. When no frames come any more it says so, and goes on when
//! they come again.
//!
//! Threads: the calling one measures; another answers the browser, and compresses a picture only when it is asked for. Allocates. A lost
//! camera ends the command with its reason.

use std::collections::VecDeque;
use std::net::IpAddr;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use opencv::core::Mat;
use shared::config::Config;
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::ipc::Cell;
use shared::messages::PixelFormat;
use shared::os;
use web::{Answer, Server, Settings};

use crate::drawing::{draw, jpeg, to_bgr};
use crate::source::{Frame, FrameStream, ObserverSource, StreamEvent};
use crate::vision::{Extractor, Image, PictureTime};

/// Values of V_e that the page shows. Chosen by hand: ten seconds at 30 frames a second.
const HISTORY: usize = 300;
/// How long it may take to end. Chosen by hand: much longer than a frame is waited for.
const GRACE: Duration = Duration::from_secs(5);

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  feature-worker view --config config/sim.toml\n  feature-worker view --config config/cell.toml --port 9000\n\n\
Open the address that it prints in a browser on this machine. Ctrl-C ends it.

Beside `feature-worker run` it shows the worker's frames. Without a worker it opens the camera itself, and hands it over to a worker \
that starts. When the worker ends, it waits for the next one."
)]
pub struct Args {
    /// The cell's configuration.
    #[arg(long, env = shared::config::VARIABLE, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Port on 127.0.0.1. With 0 any free port is taken.
    #[arg(long, default_value_t = 8642)]
    port: u16,
}

/// The newest measurement.
#[derive(Debug, Clone, Copy, Default)]
struct Newest {
    sequence: u64,
    area_px2: f32,
    confidence: f32,
    doubt: &'static str,
}

/// What the browser may ask for.
#[derive(Default)]
struct Shown {
    /// The newest picture, in BGR; empty before the first.
    picture: Mat,
    newest: Newest,
    /// The last values of V_e, px^2.
    history: VecDeque<f32>,
    /// Whether no frame has come for a second.
    silent: bool,
    /// Why the newest frame is not shown; empty if it is.
    unshown: &'static str,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    view(args, &config)
}

fn lock(shown: &Mutex<Shown>) -> MutexGuard<'_, Shown> {
    shown.lock().unwrap_or_else(PoisonError::into_inner)
}

fn view(args: &Args, config: &Config) -> Result<(), Failure> {
    let stop = os::stop_at_signals().or_exit(exit::FAILED)?;
    exit::end_within(&stop, GRACE, "feature-worker view: shared memory or the camera does not answer: ended without it");
    opencv::core::set_num_threads(1).or_exit(exit::FAILED)?;
    let extractor = Extractor::new(&config.camera, &config.image).or_exit(exit::BAD_INPUT)?;
    let cell = Cell::join(&config.cell)?;
    let source = ObserverSource::open(&config.camera, &cell).map_err(|e| failure(e.exit_code(), e))?;
    let server = Server::open(IpAddr::from([127, 0, 0, 1]), args.port, Settings::default())?;
    println!("http://{}", server.address());
    let shown = Mutex::new(Shown::default());
    std::thread::scope(|scope| {
        scope.spawn(|| answer(&server, &shown, &stop));
        let result = watch(FrameStream::new(source, &stop), extractor, &shown);
        stop.store(true, Relaxed);
        result
    })
}

/// Measures every frame for the browser until the frames end.
fn watch(mut frames: FrameStream<ObserverSource>, mut extractor: Extractor, shown: &Mutex<Shown>) -> Result<(), Failure> {
    loop {
        match frames.wait().or_exit(exit::UNREACHABLE)? {
            StreamEvent::Frame(frame) => show(&frame, &mut extractor, shown)?,
            StreamEvent::Nothing => {}
            StreamEvent::FellSilent => {
                lock(shown).silent = true;
                eprintln!("feature-worker: no frames for a second; waiting for the worker or the camera driver to go on");
            }
            StreamEvent::End => return Ok(()),
        }
    }
}

/// Why a frame cannot be shown; its format otherwise.
fn format_of(frame: &Frame) -> Result<PixelFormat, &'static str> {
    let format = PixelFormat::from_code(frame.header.format).ok_or("the frames have a format that is not known")?;
    let bytes = frame.header.width_px as usize * frame.header.height_px as usize * format.bytes_per_pixel();
    if frame.pixels.len() == bytes { Ok(format) } else { Err("the frames have another length than they say") }
}

/// Measures one frame for the browser. Of a frame that cannot be drawn the page says why, so that nobody takes the one before for it.
fn show(frame: &Frame, extractor: &mut Extractor, shown: &Mutex<Shown>) -> Result<(), Failure> {
    let format = match format_of(frame) {
        Ok(format) => format,
        Err(why) => {
            let mut shown = lock(shown);
            (shown.silent, shown.unshown) = (false, why);
            return Ok(());
        }
    };
    let (width_px, height_px) = (frame.header.width_px, frame.header.height_px);
    let time = PictureTime { sequence: frame.header.sequence, captured_at_ns: frame.header.captured_at_ns };
    let image = Image { width_px, height_px, format, pixels: frame.pixels };
    let measured = extractor.measure_at(image, time).or_exit(exit::BAD_INPUT)?;
    let mut picture = to_bgr(frame).or_exit(exit::FAILED)?;
    draw(&mut picture, extractor, &measured).or_exit(exit::FAILED)?;
    let mut shown = lock(shown);
    shown.picture = picture;
    (shown.silent, shown.unshown) = (false, "");
    shown.newest = Newest {
        sequence: frame.header.sequence,
        area_px2: measured.area_px2,
        confidence: measured.confidence,
        doubt: measured.doubt.words(),
    };
    if shown.history.len() >= HISTORY {
        shown.history.pop_front();
    }
    shown.history.push_back(measured.area_px2);
    Ok(())
}

/// Answers the browser until the command ends.
fn answer(server: &Server, shown: &Mutex<Shown>, stop: &AtomicBool) {
    server.serve(stop, |request| match request.path.as_str() {
        "/" => Answer::html(include_str!("view.html")),
        "/view.js" => Answer::bytes("text/javascript", include_str!("view.js")),
        "/view.css" => Answer::bytes("text/css", include_str!("view.css")),
        "/picture.jpg" => {
            let picture = lock(shown).picture.clone();
            Answer::jpeg(jpeg(&picture))
        }
        "/state.json" => {
            let shown = lock(shown);
            let Newest { sequence, area_px2, confidence, doubt } = shown.newest;
            Answer::json(&serde_json::json!({ "sequence": sequence, "area_px2": area_px2, "confidence": confidence, "doubt": doubt,
                "silent": shown.silent, "unshown": shown.unshown, "history": shown.history }))
        }
        _ => Answer::not_here(),
    });
}

#[cfg(test)]
mod tests {
    use shared::messages::FrameHeader;

    use super::*;

    /// Protects who looks at a camera from an old picture that looks live: of frames that cannot be shown the page says why, until one can be.
    #[test]
    fn a_frame_that_is_not_shown_is_said() {
        let config = Config::parse(include_str!("../../../config/sim.toml"), "sim.toml").unwrap();
        let mut extractor = Extractor::new(&config.camera, &config.image).unwrap();
        let shown = Mutex::new(Shown::default());
        let pixels = vec![90; 640 * 480 * 3];
        let mut take = |format, bytes| {
            let header = FrameHeader { width_px: 640, height_px: 480, format, sequence: 7, ..Default::default() };
            show(&Frame { header, pixels: &pixels[..bytes] }, &mut extractor, &shown).unwrap();
            lock(&shown).unshown
        };
        let good = PixelFormat::Bgr8 as u32;
        assert_eq!(take(good, pixels.len()), "");
        assert!(take(99, pixels.len()).contains("not known"));
        assert!(take(good, pixels.len() - 1).contains("another length"));
        assert_eq!(take(good, pixels.len()), "");
    }
}
