//! The worker: takes frame after frame, measures V_e, publishes it and hands the frame to the recorder.
//!
//! Threads: the extraction thread is the calling one, pinned and prioritised as `[worker]` says. It takes a frame, measures, publishes,
//! then offers the frame to the recorder and, if the frame comes from a device or a file, to programs that watch. Neither offer ever
//! blocks, and the thread does no file or terminal input or output after the start. The status thread and the recorder's thread are
//! their own. A driver that stops or restarts is waited for; a lost device ends the worker with its reason.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};

use crossbeam::queue::ArrayQueue;
use iceoryx2::port::publisher::{Publisher, PublisherCreateError};
use shared::config::{CameraConfig, CameraSource, Config, ImageConfig};
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::framing::Framing;
use shared::ipc::Cell;
use shared::level::Level;
use shared::messages::{Doubt, Feature, FrameHeader, LAYOUT_VERSION, PixelFormat};
use shared::os;
use shared::speaker::Speaker;

use crate::recorder::{Recorder, RecorderError};
use crate::source::{Frame, FrameStream, SILENT_NS, Source, SourceError, StreamEvent, WAIT};
use crate::vision::{Extractor, Image, Measurement, PictureTime, RoomBeside, room_beside};

mod republisher;
mod status;

use republisher::FrameRepublisher;
pub use status::Lines;
use status::Status;

/// How long a `view` that holds the camera may take to let go of it, ns. Chosen by hand: a view looks for a worker with each frame.
const LET_GO_NS: u64 = 3_000_000_000;

/// Pause before a camera that is not there is looked for again. Chosen by hand; a signal ends the wait after it.
const MISSING: std::time::Duration = std::time::Duration::from_millis(500);
/// How long the worker may take to end once it was asked to. Chosen by hand: a disk that works takes the rest of an episode much sooner.
const GRACE: std::time::Duration = std::time::Duration::from_secs(8);

/// Pictures after the start in which the ground behind clear water is judged. Chosen by hand: half a second.
const GROUND_PICTURES: u32 = 15;
/// What is said of a ground before which clear water cannot be relied upon.
const UNEVEN_GROUND: &str = "the ground behind the lip has a pattern, and clear water is measured badly before it; put an even card or wall \
                             there, or colour the water (docs/VISION.md, Clear water)";

type Ipc = iceoryx2::service::ipc::Service;

/// Runs until a signal, the end of the video or a failure. `lines` says what is told meanwhile.
pub fn run(config: &Config, lines: Lines) -> Result<(), Failure> {
    let stop = os::stop_at_signals().or_exit(exit::FAILED)?;
    exit::explain_panics("feature-worker");
    exit::end_within(&stop, GRACE, "feature-worker: the disk or the camera does not answer: ended without it");
    // OpenCV's own threads would run on the controller's core and wait for each other.
    opencv::core::set_num_threads(1).or_exit(exit::BAD_INPUT)?;
    let extractor = Extractor::new(&config.camera, &config.image).or_exit(exit::BAD_INPUT)?;
    let lost = "feature-worker: shared memory vanished: /dev/shm is full, or a file there was cut. The worker ends";
    os::explain_bus_errors(lost, exit::FAILED, Arc::clone(&stop));
    let speaker = Arc::new(Speaker::start("feature-worker"));
    if let Some(lacks) = lacks_room(&config.camera, &config.image) {
        speaker.say(Level::Warning, &lacks);
    }
    let result = measure_until_stopped(config, extractor, &stop, &speaker, lines);
    speaker.finish();
    result
}

/// What the region is wanting beside the lip, with what to do.
pub(crate) fn lacks_room(camera: &CameraConfig, image: &ImageConfig) -> Option<String> {
    let region = image.region_px;
    match room_beside(camera, image) {
        RoomBeside::Enough => None,
        RoomBeside::Wanted(wanted) => Some(format!(
            "image.region_px = {region:?} does not hold the ground beside the lip and the glass below it, so more pictures than need be are \
             doubted (colours changed); write region_px = {wanted:?}"
        )),
        RoomBeside::BeyondPicture => Some(
            "the picture ends close beside the lip or below it, so more pictures than need be are doubted (colours changed); move the camera \
             until 40 px beside the lip and 50 px of the glass below it are seen (of a picture 640 px wide)"
                .into(),
        ),
    }
}

/// Opens everything and measures, until `stop` is set or the camera ends.
fn measure_until_stopped(
    config: &Config,
    extractor: Extractor,
    stop: &Arc<AtomicBool>,
    speaker: &Arc<Speaker>,
    lines: Lines,
) -> Result<(), Failure> {
    let cell = Cell::join(&config.cell)?;
    cell.check_space(shared_memory_bytes(config))?;
    let name = &config.cell.name;
    let publisher = cell.features()?.publisher_builder().create().map_err(|e| match e {
        PublisherCreateError::ExceedsMaxSupportedPublishers => {
            failure(exit::REFUSED, format!("another feature worker of cell '{name}' is running: stop it first"))
        }
        e => failure(
            exit::UNREACHABLE,
            format!("cell '{name}': service 'feature': {e:?}; end all programs of the cell and start them again"),
        ),
    })?;
    cell.reserve()?;
    // The republisher comes before the camera is opened: a view that holds the camera sees it and lets go.
    let republisher = match config.camera.source {
        CameraSource::SharedMemory => None,
        _ => Some(FrameRepublisher::new(&cell, config)?),
    };
    // Threads inherit the core and the priority, so the other threads start first.
    let its = Arc::clone(speaker);
    let recorder = Recorder::start(config, move |level, text| its.say(level, text)).map_err(|e| match e {
        RecorderError::Ipc(e) => e.into(),
        e => failure(exit::FAILED, e),
    })?;
    let latest = Arc::new(ArrayQueue::new(1));
    let looks = Arc::new(AtomicU64::new(0));
    let printer =
        status::start_printer(&latest, &looks, stop, speaker, lines).map_err(|e| failure(exit::FAILED, format!("status thread: {e}")))?;
    let opened = open_source(config, &cell, (stop, &looks), speaker);
    let Ok(Some(source)) = opened else {
        stop.store(true, Relaxed);
        recorder.stop();
        let _ = printer.join();
        return opened.map(|_| ());
    };
    for missing in os::become_realtime(config.worker.core, config.worker.priority) {
        speaker.say(Level::Warning, &missing);
    }
    let mut worker = Worker {
        extractor,
        publisher,
        recorder,
        republisher,
        framing: Framing::new(&config.camera, &config.image),
        epoch_ns: os::now_ns(),
        newest: Newest::default(),
        status: Status { doubt: Doubt::None.words(), ..Status::default() },
        latest: &latest,
        looks: &looks,
        speaker,
        judged: 0,
        uneven: 0,
    };
    let result = worker.work(FrameStream::new(source, stop));
    stop.store(true, Relaxed);
    worker.recorder.stop();
    let _ = printer.join();
    result
}

/// Space in `/dev/shm` that the worker's ports take, bytes: a little for features and reports, and 17 frames if it publishes a device's.
fn shared_memory_bytes(config: &Config) -> u64 {
    let frame = u64::from(config.camera.width_px) * u64::from(config.camera.height_px) * PixelFormat::Bgr8.bytes_per_pixel() as u64;
    let frames = if config.camera.source == CameraSource::SharedMemory { 0 } else { 18 };
    (2 << 20) + frames * frame
}

/// Opens the camera. It waits a while for a view that holds it, and for a device that is not there until it is, with one line. `None` if `stop` was set
/// meanwhile. `looks` grows, so that systemd sees that the worker waits and does not hang.
fn open_source(
    config: &Config,
    cell: &Cell,
    (stop, looks): (&AtomicBool, &AtomicU64),
    speaker: &Speaker,
) -> Result<Option<Source>, Failure> {
    let begin_ns = os::now_ns();
    let mut said = false;
    loop {
        match Source::open(&config.camera, cell) {
            Ok(source) => return Ok(Some(source)),
            Err(_) if stop.load(Relaxed) => return Ok(None),
            Err(SourceError::Busy { .. }) if os::now_ns() < begin_ns + LET_GO_NS => std::thread::sleep(WAIT),
            Err(e @ SourceError::Missing(_)) if config.camera.source == CameraSource::Device => {
                if !said {
                    speaker.say(Level::Warning, &format!("{e}; it is waited for"));
                }
                said = true;
                looks.fetch_add(1, Relaxed);
                std::thread::sleep(MISSING);
            }
            Err(e) => return Err(failure(e.exit_code(), e)),
        }
    }
}

/// What the extraction thread works with.
struct Worker<'a> {
    extractor: Extractor,
    publisher: Publisher<Ipc, Feature, ()>,
    recorder: Recorder,
    republisher: Option<FrameRepublisher>,
    /// How the lip lies in its pictures, which each measurement says.
    framing: Framing,
    /// When the present run of frame numbers began, CLOCK_MONOTONIC ns.
    epoch_ns: u64,
    newest: Newest,
    status: Status,
    /// The queue of one from which the status thread prints.
    latest: &'a ArrayQueue<Status>,
    /// Number of looks for a frame, for systemd's watchdog.
    looks: &'a AtomicU64,
    speaker: &'a Speaker,
    /// Pictures in which the ground behind clear water was judged, and those of them in which it had a pattern.
    judged: u32,
    uneven: u32,
}

/// The newest frame that was measured; zeros before the first.
#[derive(Debug, Clone, Copy, Default)]
struct Newest {
    sequence: u64,
    captured_at_ns: u64,
    received_at_ns: u64,
}

impl Worker<'_> {
    fn work(&mut self, mut frames: FrameStream<Source>) -> Result<(), Failure> {
        loop {
            self.looks.fetch_add(1, Relaxed);
            match frames.wait().map_err(|e| failure(e.exit_code(), e))? {
                StreamEvent::Frame(frame) => self.take(&frame)?,
                StreamEvent::Nothing => {}
                StreamEvent::FellSilent => {
                    self.status.silent = true;
                    self.latest.force_push(self.status);
                }
                StreamEvent::End => return Ok(()),
            }
        }
    }

    /// Measures one frame and publishes its feature, unless the frame is a repetition.
    fn take(&mut self, frame: &Frame) -> Result<(), Failure> {
        let received_at_ns = os::now_ns();
        let header = frame.header;
        if !self.is_new(&header, received_at_ns) {
            self.status.repeated += 1;
            // A driver that sends one frame again and again shows nothing, as one that sends none.
            if !self.status.silent && received_at_ns > self.newest.received_at_ns + SILENT_NS {
                self.status.silent = true;
                self.latest.force_push(self.status);
            }
            return Ok(());
        }
        let measured = self.measure(frame)?;
        let feature = Feature {
            version: LAYOUT_VERSION,
            doubt: measured.doubt as u32,
            sequence: header.sequence,
            worker_epoch_ns: self.epoch_ns,
            captured_at_ns: header.captured_at_ns,
            received_at_ns,
            published_at_ns: os::now_ns(),
            area_px2: measured.area_px2,
            confidence: measured.confidence,
            triangle_px: measured.triangle_px,
            framing: self.framing,
        };
        let sent = self.publisher.send_copy(feature);
        sent.map_err(|e| failure(exit::FAILED, format!("service 'feature': {e:?}; is /dev/shm full?")))?;
        self.recorder.offer(&header, frame.pixels, &feature);
        if let Some(republisher) = &self.republisher {
            republisher.offer(frame);
        }
        self.status = Status {
            frames: self.status.frames + 1,
            doubtful: self.status.doubtful + u64::from(measured.doubt != Doubt::None),
            sequence: header.sequence,
            area_px2: measured.area_px2,
            confidence: measured.confidence,
            doubt: measured.doubt.words(),
            took_us: (feature.published_at_ns - received_at_ns) as f32 / 1e3,
            latency_ms: feature.published_at_ns.saturating_sub(header.captured_at_ns) as f32 / 1e6,
            silent: false,
            ..self.status
        };
        self.latest.force_push(self.status);
        self.judge_ground();
        Ok(())
    }

    /// Says once, at the start, if the ground is none before which clear water can be measured.
    fn judge_ground(&mut self) {
        let Some(even) = self.extractor.ground_is_even().filter(|_| self.judged < GROUND_PICTURES) else { return };
        (self.judged, self.uneven) = (self.judged + 1, self.uneven + u32::from(!even));
        if self.judged == GROUND_PICTURES && 2 * self.uneven > GROUND_PICTURES {
            self.speaker.say(Level::Warning, UNEVEN_GROUND);
        }
    }

    /// Whether a frame is younger than all before it. Counts the frames that are missing between the last one and this one.
    fn is_new(&mut self, header: &FrameHeader, received_at_ns: u64) -> bool {
        let newest = self.newest;
        if header.sequence <= newest.sequence {
            if header.captured_at_ns <= newest.captured_at_ns {
                // The frame came twice or out of order, and the controller has counted its time already.
                return false;
            }
            // A driver that was restarted starts at 1 again, with younger frames. To the controller, which counts frames by their
            // numbers, this is a new camera.
            self.epoch_ns = received_at_ns;
        }
        if newest.sequence > 0 && header.sequence > newest.sequence + 1 {
            self.status.lost += header.sequence - newest.sequence - 1;
        }
        self.newest = Newest { sequence: header.sequence, captured_at_ns: header.captured_at_ns, received_at_ns };
        true
    }

    fn measure(&mut self, frame: &Frame) -> Result<Measurement, Failure> {
        let header = frame.header;
        match PixelFormat::from_code(header.format) {
            Some(format) if header.version == LAYOUT_VERSION => {
                let image = Image { width_px: header.width_px, height_px: header.height_px, format, pixels: frame.pixels };
                let time = PictureTime { sequence: header.sequence, captured_at_ns: header.captured_at_ns };
                self.extractor.measure_at(image, time).or_exit(exit::BAD_INPUT)
            }
            _ => Ok(Measurement { area_px2: 0.0, confidence: 0.0, doubt: Doubt::WrongFormat, triangle_px: [0.0; 6] }),
        }
    }
}
