//! `feature-worker run`: measures V_e in every frame, publishes it and hands the frame to the recorder.
//!
//! Threads: the extraction thread (this one; pinned and prioritised as `[worker]` says) takes a frame, measures, publishes,
//! then offers the frame to the recorder and, if it comes from a device or file, to who looks on; neither ever blocks. The status
//! thread prints once a second what the extraction thread left in a queue of one. The recorder's thread is its own. The extraction
//! thread does no file or terminal I/O after the start. A driver that stops or restarts is waited for; a lost device ends the process
//! with its reason.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration;

use crossbeam::queue::ArrayQueue;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::service::port_factory::PortFactory as _;
use serde::Serialize;
use shared::config::{CameraSource, Config};
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::ipc::{Cell, FrameNotifier, FrameTopic};
use shared::messages::{Doubt, Feature, FrameHeader, LAYOUT_VERSION, PixelFormat};
use shared::os;

use crate::extract::{Extractor, Image, Measurement};
use crate::recorder::Recorder;
use crate::source::{Frame, Next, Source, SourceError};

/// How long a wait for a frame lasts before signals and silence are looked at.
const WAIT: Duration = Duration::from_millis(100);
/// A camera without a frame for this long is reported as silent, ns.
const SILENT_NS: u64 = 1_000_000_000;
/// How long a view that holds the camera may take to let go of it, ns.
const LET_GO_NS: u64 = 3_000_000_000;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  feature-worker run --config config/cell.toml\n  feature-worker run --config config/sim.toml --json\n\n\
Runs until Ctrl-C or SIGTERM (exit 0), or until its video or image sequence is over."
)]
pub struct Args {
    /// The cell's configuration.
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Print the status as one JSON object a line, to standard output.
    #[arg(long)]
    json: bool,
}

/// What the status thread prints.
#[derive(Debug, Clone, Copy, Default, Serialize)]
struct Status {
    /// Frames measured since the start.
    frames: u64,
    /// Frames that the camera counted but that never came.
    lost: u64,
    /// Frames that came twice or late and were left out.
    repeated: u64,
    /// Frames with a doubt.
    doubtful: u64,
    /// Sequence number of the newest.
    sequence: u64,
    area_px2: f32,
    confidence: f32,
    doubt: &'static str,
    /// From taking the newest frame to publishing its feature.
    took_us: f32,
    /// From the middle of its exposure to publishing its feature.
    latency_ms: f32,
    /// No frame for a second.
    silent: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    work(&config, args.json)
}

fn work(config: &Config, json: bool) -> Result<(), Failure> {
    let stop = os::stop_at_signals().or_exit(exit::FAILED)?;
    // OpenCV's own threads would run on the controller's core and wait for each other.
    opencv::core::set_num_threads(1).or_exit(exit::BAD_INPUT)?;
    let mut extractor = Extractor::new(&config.camera, &config.image).or_exit(exit::BAD_INPUT)?;
    let cell = Cell::join(&config.cell.name).or_exit(exit::UNREACHABLE)?;
    let topic = cell.features().or_exit(exit::UNREACHABLE)?;
    let publisher = topic.publisher_builder().create().map_err(|e| {
        failure(
            exit::UNREACHABLE,
            format!("cell '{}': service 'feature': {e:?}; is another feature worker running? Stop it first", config.cell.name),
        )
    })?;
    // Before the camera is opened: by this a view that holds it sees the worker, and lets go.
    let onlookers = match config.camera.source {
        CameraSource::SharedMemory => None,
        _ => Some(Onlookers::new(&cell, config)?),
    };
    let begin_ns = os::now_ns();
    let mut source = loop {
        match Source::open(&config.camera, &cell) {
            Ok(source) => break source,
            Err(SourceError::Busy(_)) if os::now_ns() < begin_ns + LET_GO_NS && !stop.load(Relaxed) => std::thread::sleep(WAIT),
            Err(e) if onlookers.is_none() => return Err(failure(exit::UNREACHABLE, e)),
            Err(e) => return Err(failure(exit::BAD_INPUT, e)),
        }
    };
    // Threads inherit the core and the priority, so the others start first.
    let recorder = Recorder::start(config).or_exit(exit::FAILED)?;
    let latest = Arc::new(ArrayQueue::new(1));
    let printer = {
        let (latest, stop) = (Arc::clone(&latest), Arc::clone(&stop));
        std::thread::Builder::new().name("status".into()).spawn(move || print_status(&latest, &stop, json))
    }
    .map_err(|e| failure(exit::FAILED, format!("status thread: {e}")))?;
    for missing in os::become_realtime(config.worker.core, config.worker.priority) {
        eprintln!("feature-worker: {missing}");
    }

    let mut epoch_ns = os::now_ns();
    let mut status = Status { doubt: Doubt::None.words(), ..Status::default() };
    let mut newest = (0, 0); // sequence, captured_at_ns
    let mut last_frame_ns = epoch_ns;
    let result = loop {
        if stop.load(Relaxed) {
            break Ok(());
        }
        let frame = match source.next(WAIT) {
            Ok(Next::Frame(frame)) => frame,
            Ok(Next::Nothing) => {
                if !status.silent && os::now_ns() > last_frame_ns + SILENT_NS {
                    status.silent = true;
                    latest.force_push(status);
                }
                continue;
            }
            Ok(Next::End) => break Ok(()),
            // The signal also cut short the wait for a device, which then looks lost.
            Err(_) if stop.load(Relaxed) => break Ok(()),
            Err(e) => break Err(failure(exit::UNREACHABLE, e)),
        };
        let received_at_ns = os::now_ns();
        last_frame_ns = received_at_ns;
        let header = frame.header;
        if header.sequence <= newest.0 && header.captured_at_ns <= newest.1 {
            // Twice or out of order: the controller has counted this time already. (A driver that was restarted also starts
            // at 1 again, but its frames are younger.)
            status.repeated += 1;
            continue;
        }
        if header.sequence <= newest.0 {
            // To the controller, who counts frames by their numbers, this is a new camera.
            epoch_ns = received_at_ns;
        }
        if newest.0 > 0 && header.sequence > newest.0 + 1 {
            status.lost += header.sequence - newest.0 - 1;
        }
        newest = (header.sequence, header.captured_at_ns);
        let measured = match PixelFormat::from_code(header.format) {
            Some(format) if header.version == LAYOUT_VERSION => {
                let image = Image { width_px: header.width_px, height_px: header.height_px, format, pixels: frame.pixels };
                extractor.measure(image)
            }
            _ => Ok(Measurement { area_px2: 0.0, confidence: 0.0, doubt: Doubt::WrongFormat, triangle_px: [0.0; 6] }),
        };
        let measured = match measured {
            Ok(measured) => measured,
            Err(e) => break Err(failure(exit::BAD_INPUT, e)),
        };
        let feature = Feature {
            version: LAYOUT_VERSION,
            doubt: measured.doubt as u32,
            sequence: header.sequence,
            worker_epoch_ns: epoch_ns,
            captured_at_ns: header.captured_at_ns,
            received_at_ns,
            published_at_ns: os::now_ns(),
            area_px2: measured.area_px2,
            confidence: measured.confidence,
            triangle_px: measured.triangle_px,
        };
        if let Err(e) = publisher.send_copy(feature) {
            break Err(failure(exit::FAILED, format!("service 'feature': {e:?}; is /dev/shm full?")));
        }
        recorder.offer(&header, frame.pixels, &feature);
        if let Some(onlookers) = &onlookers {
            onlookers.offer(&frame);
        }
        status = Status {
            frames: status.frames + 1,
            doubtful: status.doubtful + u64::from(measured.doubt != Doubt::None),
            sequence: header.sequence,
            area_px2: measured.area_px2,
            confidence: measured.confidence,
            doubt: measured.doubt.words(),
            took_us: (feature.published_at_ns - received_at_ns) as f32 / 1e3,
            latency_ms: feature.published_at_ns.saturating_sub(header.captured_at_ns) as f32 / 1e6,
            silent: false,
            ..status
        };
        latest.force_push(status);
    };
    stop.store(true, Relaxed);
    recorder.stop();
    let _ = printer.join();
    result
}

/// Publishes the frames of a device or file for who looks on (`view`, `calibrate`), who could not open a device beside the worker.
struct Onlookers {
    publisher: Publisher<iceoryx2::service::ipc::Service, [u8], FrameHeader>,
    notifier: FrameNotifier,
    topic: FrameTopic,
}

impl Onlookers {
    fn new(cell: &Cell, config: &Config) -> Result<Self, Failure> {
        let topic = cell.frames().or_exit(exit::UNREACHABLE)?;
        let bytes = config.camera.width_px as usize * config.camera.height_px as usize * PixelFormat::Bgr8.bytes_per_pixel();
        let publisher = topic.publisher_builder().initial_max_slice_len(bytes).create().map_err(|e| {
            failure(
                exit::UNREACHABLE,
                format!("cell '{}': service 'frame': {e:?}; is a camera driver running? Stop it first", config.cell.name),
            )
        })?;
        Ok(Self { publisher, notifier: cell.frame_notifier().or_exit(exit::UNREACHABLE)?, topic })
    }

    /// Publishes a frame if somebody subscribes: one copy, into shared memory that was made at the start. Never waits: who is slow
    /// loses the oldest. Allocates only when somebody comes or goes.
    fn offer(&self, frame: &Frame) {
        if self.topic.dynamic_config().number_of_subscribers() == 0 {
            return;
        }
        // A frame larger than configured has no room, and whatever goes wrong here is no reason to end a pour.
        let Ok(mut sample) = self.publisher.loan_slice_uninit(frame.pixels.len()) else { return };
        *sample.user_header_mut() = FrameHeader { published_at_ns: os::now_ns(), ..frame.header };
        let _ = sample.write_from_slice(frame.pixels).send();
        let _ = self.notifier.notify();
    }
}

/// Thread "status": one line a second while frames come, one when they stop.
fn print_status(latest: &ArrayQueue<Status>, stop: &AtomicBool, json: bool) {
    let mut before = 0;
    let mut from_ns = os::now_ns();
    eprintln!("feature-worker: waiting for frames");
    while !stop.load(Relaxed) {
        std::thread::sleep(Duration::from_millis(100));
        let now_ns = os::now_ns();
        if now_ns < from_ns + 1_000_000_000 {
            continue;
        }
        let Some(status) = latest.pop() else { continue };
        if json {
            match serde_json::to_string(&status) {
                Ok(line) => println!("{line}"),
                Err(e) => eprintln!("feature-worker: status: {e}"),
            }
        } else if status.silent {
            eprintln!("feature-worker: no frames for a second; waiting for the camera driver");
        } else {
            let fps = (status.frames - before) as f64 * 1e9 / (now_ns - from_ns) as f64;
            eprintln!(
                "feature-worker: frame {} ({fps:.0}/s), V_e {:.0} px^2, confidence {:.2}, doubt: {}, {:.2} ms + {:.1} ms old, lost {}, \
                 repeated {}, doubtful {}",
                status.sequence,
                status.area_px2,
                status.confidence,
                status.doubt,
                status.took_us / 1e3,
                status.latency_ms,
                status.lost,
                status.repeated,
                status.doubtful
            );
        }
        (before, from_ns) = (status.frames, now_ns);
    }
}
