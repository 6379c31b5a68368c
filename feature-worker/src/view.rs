//! `feature-worker view`: the live stream with region, axes, outline, line, triangle, V_e and its history, in a local web page.
//!
//! A process of its own, so it never slows the worker: it reads the cell's frames as a further subscriber ([`ObserverSource`]: a device or
//! file is opened only while no worker runs), measures them again with the same configuration and keeps the newest picture. When no
//! frames come any more it says so and goes on when they come again.
//! Threads: this one measures; one answers the browser and compresses a picture only when it is asked for. Allocates.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use opencv::core::{Mat, Point, Rect, Scalar, Vector};
use opencv::prelude::*;
use opencv::{imgcodecs, imgproc};
use shared::config::Config;
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::ipc::Cell;
use shared::messages::{Doubt, PixelFormat};
use shared::os;
use tiny_http::{Header, Response, Server};

use crate::extract::{Extractor, Image, Measurement};
use crate::inspect::to_bgr;
use crate::source::{FrameSource as _, NextFrame, ObserverSource};

/// Values of V_e that the page shows.
const HISTORY: usize = 300;
/// Without a frame for this long the page says so, ns.
const SILENT_NS: u64 = 1_000_000_000;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  feature-worker view --config config/sim.toml\n  feature-worker view --config config/cell.toml --port 9000\n\n\
Open the address that it prints in a browser on this machine. Ctrl-C ends it.

Beside `feature-worker run` it shows the worker's frames. Without a worker it opens the camera itself, and leaves it to a worker that \
starts. When the worker ends it waits for the next one."
)]
pub struct Args {
    /// The cell's configuration.
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Port on 127.0.0.1; 0: any free one.
    #[arg(long, default_value_t = 8642)]
    port: u16,
}

/// What the browser may ask for.
#[derive(Default)]
struct Shown {
    picture: Mat,
    /// sequence, V_e, confidence, doubt.
    newest: (u64, f32, f32, &'static str),
    history: std::collections::VecDeque<f32>,
    /// No frame for a second.
    silent: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    show(args, &config)
}

fn lock(shown: &Mutex<Shown>) -> MutexGuard<'_, Shown> {
    shown.lock().unwrap_or_else(PoisonError::into_inner)
}

fn show(args: &Args, config: &Config) -> Result<(), Failure> {
    let stop = os::stop_at_signals().or_exit(exit::FAILED)?;
    opencv::core::set_num_threads(1).or_exit(exit::FAILED)?;
    let mut extractor = Extractor::new(&config.camera, &config.image).or_exit(exit::BAD_INPUT)?;
    let cell = Cell::join(&config.cell.name).or_exit(exit::UNREACHABLE)?;
    let mut source = ObserverSource::open(&config.camera, &cell).or_exit(exit::UNREACHABLE)?;
    let server = Server::http(("127.0.0.1", args.port))
        .map_err(|e| failure(exit::FAILED, format!("port {} on 127.0.0.1: {e}; give another --port", args.port)))?;
    println!("http://{}", server.server_addr());
    let shown = Mutex::new(Shown::default());
    std::thread::scope(|scope| {
        scope.spawn(|| serve(&server, &shown, &stop));
        let mut last_frame_ns = os::now_ns();
        let result = loop {
            if stop.load(Relaxed) {
                break Ok(());
            }
            let frame = match source.next_frame(Duration::from_millis(100)) {
                Ok(NextFrame::Frame(frame)) => frame,
                Ok(NextFrame::Nothing) => {
                    let mut shown = lock(&shown);
                    if !shown.silent && os::now_ns() > last_frame_ns + SILENT_NS {
                        shown.silent = true;
                        eprintln!("feature-worker: no frames for a second; waiting for the worker or the camera driver to go on");
                    }
                    continue;
                }
                Ok(NextFrame::End) => break Ok(()),
                // The signal also cut short the wait for a device, which then looks lost.
                Err(_) if stop.load(Relaxed) => break Ok(()),
                Err(e) => break Err(failure(exit::UNREACHABLE, e)),
            };
            last_frame_ns = os::now_ns();
            let Some(format) = PixelFormat::from_code(frame.header.format) else { continue };
            let (width_px, height_px) = (frame.header.width_px, frame.header.height_px);
            if frame.pixels.len() != width_px as usize * height_px as usize * format.bytes_per_pixel() {
                continue;
            }
            let image = Image { width_px, height_px, format, pixels: frame.pixels };
            let drawn = extractor.measure(image).or_exit(exit::BAD_INPUT).and_then(|measured| {
                let mut picture = to_bgr(&frame).or_exit(exit::FAILED)?;
                draw(&mut picture, &extractor, &measured).or_exit(exit::FAILED)?;
                Ok((picture, measured))
            });
            match drawn {
                Ok((picture, measured)) => {
                    let mut shown = lock(&shown);
                    shown.picture = picture;
                    shown.silent = false;
                    shown.newest = (frame.header.sequence, measured.area_px2, measured.confidence, measured.doubt.words());
                    if shown.history.len() >= HISTORY {
                        shown.history.pop_front();
                    }
                    shown.history.push_back(measured.area_px2);
                }
                Err(e) => break Err(e),
            }
        };
        stop.store(true, Relaxed);
        result
    })
}

/// Thread that answers the browser.
fn serve(server: &Server, shown: &Mutex<Shown>, stop: &AtomicBool) {
    while !stop.load(Relaxed) {
        let Ok(Some(request)) = server.recv_timeout(Duration::from_millis(100)) else { continue };
        let path = request.url().split('?').next().unwrap_or("/").to_string();
        // A browser that went away is no fault of ours.
        let _ = match path.as_str() {
            "/" => request.respond(answer(PAGE.as_bytes().to_vec(), "text/html; charset=utf-8")),
            "/picture.jpg" => {
                let picture = lock(shown).picture.clone();
                request.respond(answer(jpeg(&picture), "image/jpeg"))
            }
            "/state.json" => {
                let shown = lock(shown);
                let (sequence, area_px2, confidence, doubt) = shown.newest;
                let state = serde_json::json!({ "sequence": sequence, "area_px2": area_px2, "confidence": confidence, "doubt": doubt,
                    "silent": shown.silent, "history": shown.history });
                drop(shown);
                request.respond(answer(state.to_string().into_bytes(), "application/json"))
            }
            _ => request.respond(Response::from_data("not here").with_status_code(404)),
        };
    }
}

/// An answer with its content type.
pub fn answer(body: Vec<u8>, kind: &str) -> Response<std::io::Cursor<Vec<u8>>> {
    let response = Response::from_data(body);
    match Header::from_bytes("Content-Type", kind) {
        Ok(header) => response.with_header(header),
        Err(()) => response,
    }
}

/// A picture as JPEG; empty if there is none.
pub fn jpeg(picture: &Mat) -> Vec<u8> {
    let mut bytes = Vector::new();
    let ok = !picture.empty()
        && imgcodecs::imencode(".jpg", picture, &mut bytes, &Vector::from_slice(&[imgcodecs::IMWRITE_JPEG_QUALITY, 80])).unwrap_or(false);
    if ok { bytes.to_vec() } else { Vec::new() }
}

const PAGE: &str = include_str!("view.html");

fn colour(blue: u8, green: u8, red: u8) -> Scalar {
    Scalar::new(blue.into(), green.into(), red.into(), 0.0)
}

fn point([x, y]: [f32; 2]) -> Point {
    // Four binary digits behind the point.
    Point::new((x * 16.0).round() as i32, (y * 16.0).round() as i32)
}

/// Draws what `extractor` has just measured into the BGR picture `image`: region (grey), axes (red and green, as in Fig. 4),
/// outline of the liquid (white), edge points and line (yellow), triangle and numbers.
pub fn draw(image: &mut Mat, extractor: &Extractor, measured: &Measurement) -> Result<(), opencv::Error> {
    let (line, aa) = (imgproc::LINE_8, imgproc::LINE_AA);
    imgproc::rectangle(image, extractor.region(), colour(160, 160, 160), 1, line, 0)?;
    let axes = extractor.axes();
    let region = extractor.region();
    let reach = (region.width + region.height) as f32 * 0.4;
    for (axis, shade) in [(axes.x, colour(40, 40, 255)), (axes.y, colour(40, 220, 40))] {
        let end = |d: f32| point([axes.lip_px[0] + d * axis[0], axes.lip_px[1] + d * axis[1]]);
        imgproc::line(image, end(0.0), end(reach), shade, 1, aa, 4)?;
    }
    let outline: Vector<Point> = extractor.outline_px().map(point).collect();
    if !outline.is_empty() {
        imgproc::polylines(image, &outline, false, colour(255, 255, 255), 1, aa, 4)?;
    }
    let yellow = colour(0, 255, 255);
    for p in extractor.edge_points_px() {
        imgproc::circle(image, point(p), 24, yellow, imgproc::FILLED, aa, 4)?;
    }
    if measured.area_px2 > 0.0 {
        let [x0, y0, x1, y1, x2, y2] = measured.triangle_px;
        imgproc::line(image, point([x1, y1]), point([x2, y2]), yellow, 2, aa, 4)?;
        for corner in [[x1, y1], [x2, y2]] {
            imgproc::line(image, point([x0, y0]), point(corner), yellow, 1, aa, 4)?;
        }
    }
    let doubt = if measured.doubt == Doubt::None { String::new() } else { format!("  {}", measured.doubt.words()) };
    let text = format!("V_e {:.0} px^2  confidence {:.2}{doubt}", measured.area_px2, measured.confidence);
    caption(image, &text, 0)
}

/// One line of text over a dark bar at the picture's foot, `line` lines above the lowest.
pub fn caption(image: &mut Mat, text: &str, line: i32) -> Result<(), opencv::Error> {
    let (width, height) = (image.cols(), image.rows());
    let top = height - 20 * (line + 1);
    imgproc::rectangle(image, Rect::new(0, top, width, 20), colour(20, 20, 20), imgproc::FILLED, imgproc::LINE_8, 0)?;
    let font = imgproc::FONT_HERSHEY_SIMPLEX;
    imgproc::put_text(image, text, Point::new(6, top + 14), font, 0.45, colour(235, 235, 235), 1, imgproc::LINE_AA, false)
}
