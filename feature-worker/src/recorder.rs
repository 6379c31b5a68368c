//! Writes episodes (section 3.1) in a thread of its own.
//!
//! The worker's loop hands each frame over with [`Recorder::offer`], which copies the pixels into a buffer that was
//! allocated at the start and never waits: without a free buffer the image is dropped and counted, its V_e is kept.
//! The recorder's thread follows the controller's telemetry. When an episode's number appears it opens a file and takes the
//! few frames from just before; it compresses and writes; when the number is gone and the last frame of the episode has come,
//! it closes the file. It reports on the service `recorder`. A full or slow disk costs that episode's file or some of its
//! images, and nothing else: the next episode tries again. An episode that was under way when the recorder started is not
//! recorded, because its beginning is missing.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc;
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime};

use crossbeam::queue::ArrayQueue;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use opencv::core::{Mat, MatTraitConst, Vector, VectorToVec};
use opencv::{imgcodecs, imgproc};
use shared::alpha_track::AlphaTrack;
use shared::config::{Config, ImageFormat};
use shared::episode::{End, EpisodeWriter, Kind, Sample, Start, WriteError};
use shared::gaussian_curve::Curve;
use shared::ipc::{Cell, IpcError};
use shared::messages::{Feature, FrameHeader, PixelFormat, RecorderReport, RecorderState, Telemetry};
use shared::os::now_ns;

/// Frames kept from before an episode: telemetry and frames arrive with different delays.
const RING_FRAMES: usize = 8;
/// Features without image that may wait besides the images, while the disk is slow.
const SPARE_FEATURES: usize = 1024;
/// Frames from up to this long before an episode's first tick belong to its file, ns.
const BEFORE_NS: u64 = 200_000_000;
/// How long a frame of the episode's end may be under way, ns.
const AFTER_NS: u64 = 500_000_000;
/// Without telemetry for this long the controller is gone, ns.
const SILENCE_NS: u64 = 2_000_000_000;
/// How often the thread looks.
const PAUSE: Duration = Duration::from_millis(5);

/// Why the recorder cannot start.
#[derive(Debug, thiserror::Error)]
pub enum RecorderError {
    /// The directory cannot be made or used.
    #[error("recording.directory = {directory}: {what}; name a directory that can be written")]
    Directory {
        /// The directory.
        directory: String,
        /// The system's words.
        what: String,
    },
    /// Shared memory cannot be used.
    #[error(transparent)]
    Ipc(#[from] IpcError),
    /// No thread could be started.
    #[error("recorder: no thread could be started: {0}")]
    Thread(std::io::Error),
}

/// The recorder, as the worker's loop sees it. Dropping it closes the file under way.
pub struct Recorder {
    handover: Arc<Handover>,
    thread: Option<JoinHandle<()>>,
}

/// What both threads share: neither ever waits for the other.
struct Handover {
    free: ArrayQueue<Vec<u8>>,
    queue: ArrayQueue<Item>,
    dropped: AtomicU64,
    stop: AtomicBool,
}

/// One frame on its way to the recorder.
struct Item {
    header: FrameHeader,
    feature: Feature,
    /// `None`: no buffer was free.
    pixels: Option<Vec<u8>>,
}

impl Recorder {
    /// Starts the recorder's thread. Call it before the calling thread takes a real-time priority or pins itself, because
    /// a thread inherits both.
    pub fn start(config: &Config) -> Result<Self, RecorderError> {
        let directory = &config.recording.directory;
        let fail = |e: std::io::Error| RecorderError::Directory { directory: directory.display().to_string(), what: e.to_string() };
        std::fs::create_dir_all(directory).map_err(fail)?;
        let directory = directory.canonicalize().map_err(fail)?;

        let buffers = config.recording.queue_frames + RING_FRAMES;
        // Room for the largest format, so that a copy never allocates.
        let bytes = config.camera.width_px as usize * config.camera.height_px as usize * PixelFormat::Bgr8.bytes_per_pixel();
        let handover = Arc::new(Handover {
            free: ArrayQueue::new(buffers),
            queue: ArrayQueue::new(buffers + SPARE_FEATURES),
            dropped: AtomicU64::new(0),
            stop: AtomicBool::new(false),
        });
        for _ in 0..buffers {
            let _ = handover.free.push(Vec::with_capacity(bytes));
        }

        let (started, answer) = mpsc::channel();
        let thread = std::thread::Builder::new().name("recorder".into());
        let (its_config, its_handover) = (config.clone(), handover.clone());
        let thread = thread
            .spawn(move || match Worker::new(its_config, directory, its_handover) {
                Ok(mut worker) => {
                    let _ = started.send(Ok(()));
                    worker.run();
                }
                Err(e) => {
                    let _ = started.send(Err(e));
                }
            })
            .map_err(RecorderError::Thread)?;
        let this = Self { handover, thread: Some(thread) };
        match answer.recv() {
            Ok(Ok(())) => Ok(this),
            Ok(Err(e)) => Err(e.into()),
            Err(_) => Err(RecorderError::Thread(std::io::Error::other("it ended at once"))),
        }
    }

    /// Hands a frame with its feature to the recorder: never waits, never allocates. The cost is one copy of the pixels, so
    /// call it after the feature is published.
    pub fn offer(&self, header: &FrameHeader, pixels: &[u8], feature: &Feature) {
        let mut buffer = self.handover.free.pop();
        match &mut buffer {
            Some(copy) if pixels.len() <= copy.capacity() => {
                copy.clear();
                copy.extend_from_slice(pixels);
            }
            // A frame larger than configured: there is no room, and growing would allocate.
            _ => {
                self.handover.give_back(buffer.take());
                self.handover.dropped.fetch_add(1, Ordering::Relaxed);
            }
        }
        if let Err(item) = self.handover.queue.push(Item { header: *header, feature: *feature, pixels: buffer }) {
            if item.pixels.is_some() {
                self.handover.dropped.fetch_add(1, Ordering::Relaxed);
            }
            self.handover.give_back(item.pixels);
        }
    }

    /// Images that found no free buffer since the start, whether or not an episode was running.
    pub fn dropped(&self) -> u64 {
        self.handover.dropped.load(Ordering::Relaxed)
    }

    /// Closes the file under way and ends the thread; the same as dropping it.
    pub fn stop(self) {}
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.handover.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Handover {
    fn give_back(&self, buffer: Option<Vec<u8>>) {
        if let Some(buffer) = buffer {
            // There is room for every buffer, so this cannot fail.
            let _ = self.free.push(buffer);
        }
    }
}

type Ipc = iceoryx2::service::ipc::Service;

/// The recorder's thread.
struct Worker {
    config: Config,
    directory: PathBuf,
    handover: Arc<Handover>,
    telemetry: Subscriber<Ipc, Telemetry, ()>,
    reports: Publisher<Ipc, RecorderReport, ()>,
    track: AlphaTrack<256>,
    ring: VecDeque<Item>,
    encoder: Encoder,
    /// Episode of the newest tick; `None` before the first.
    seen: Option<u64>,
    newest_tick: u64,
    /// Ticks of the next episode, while frames of the one before are still under way.
    pending: VecDeque<Telemetry>,
    current: Option<Current>,
    // Ports are used until here, so the cell is dropped last.
    _cell: Cell,
}

/// The file under way.
struct Current {
    writer: EpisodeWriter,
    episode: u64,
    started_at_ns: u64,
    /// First tick that is not of the episode any more, and when it was seen.
    ended: Option<Ended>,
    heard_at_ns: u64,
    last_sequence: u64,
    last_captured_at_ns: u64,
    waiting: VecDeque<Waiting>,
    images: u64,
    dropped: u64,
    disordered: u64,
}

#[derive(Clone, Copy)]
struct Ended {
    at_ns: u64,
    seen_at_ns: u64,
    /// A frame from after the end has come, so all from before have.
    frames_passed: bool,
}

/// A frame that waits for the tick after it.
struct Waiting {
    feature: Feature,
    image: Option<Vec<u8>>,
}

impl Worker {
    fn new(config: Config, directory: PathBuf, handover: Arc<Handover>) -> Result<Self, IpcError> {
        let cell = Cell::join(&config.cell.name)?;
        let fail = |service: &str, what: String| IpcError::Service { service: service.into(), what };
        let telemetry = cell.telemetry()?.subscriber_builder().create().map_err(|e| fail("telemetry", format!("{e:?}")))?;
        let reports = cell.recorder()?.publisher_builder().create().map_err(|e| fail("recorder", format!("{e:?}")))?;
        let encoder = Encoder::new(&config);
        Ok(Self {
            config,
            directory,
            handover,
            telemetry,
            reports,
            track: AlphaTrack::new(),
            ring: VecDeque::with_capacity(RING_FRAMES + 1),
            encoder,
            seen: None,
            newest_tick: 0,
            pending: VecDeque::new(),
            current: None,
            _cell: cell,
        })
    }

    fn run(&mut self) {
        loop {
            let stop = self.handover.stop.load(Ordering::Acquire);
            // Telemetry first, so that a file is open before the frames of its episode are looked at.
            while let Ok(Some(tick)) = self.telemetry.receive() {
                let tick = *tick;
                self.tick(&tick);
            }
            // Bounded, so that a slow disk cannot keep the thread from the telemetry.
            for _ in 0..RING_FRAMES {
                match self.handover.queue.pop() {
                    Some(item) => self.frame(item),
                    None => break,
                }
            }
            self.settle(false);
            self.close_if_over();
            self.follow();
            if stop {
                break;
            }
            if self.handover.queue.is_empty() {
                std::thread::sleep(PAUSE);
            }
        }
        while let Some(item) = self.handover.queue.pop() {
            self.frame(item);
        }
        while let Some(current) = &self.current {
            let complete = current.ended.is_some();
            self.close(complete, if complete { "over" } else { "the feature worker was stopped" });
            self.follow();
        }
    }

    fn tick(&mut self, tick: &Telemetry) {
        self.track.push(tick.at_ns, tick.alpha_deg, tick.robot_at_ns, tick.alpha_measured_deg);
        if tick.tick <= self.newest_tick {
            self.pending.clear();
            self.close(false, "the controller was restarted");
            self.seen = None;
        }
        self.newest_tick = tick.tick;
        self.pending.push_back(*tick);
        self.follow();
    }

    /// Takes the ticks that are due: those of the next episode wait until the last frames of the one before have come.
    fn follow(&mut self) {
        while let Some(tick) = self.pending.front().copied() {
            if let Some(current) = &mut self.current {
                current.heard_at_ns = now_ns();
                if tick.episode != current.episode && current.ended.is_none() {
                    current.ended = Some(Ended { at_ns: tick.at_ns, seen_at_ns: now_ns(), frames_passed: false });
                }
                if tick.episode != 0 && tick.episode != current.episode {
                    return;
                }
            }
            self.pending.pop_front();
            let is_new = self.seen != Some(tick.episode);
            let joined_late = self.seen.is_none();
            self.seen = Some(tick.episode);
            if tick.episode == 0 {
                continue;
            }
            if is_new {
                if joined_late {
                    let what = format!("episode {} was under way when the recorder started; it is not recorded", tick.episode);
                    self.report(RecorderState::Failed, tick.episode, 0, 0, &what);
                    continue;
                }
                self.open(&tick);
            }
            let write = |c: &mut Current| if tick.episode == c.episode { c.writer.telemetry(&tick) } else { Ok(()) };
            self.writing(write);
        }
    }

    fn open(&mut self, tick: &Telemetry) {
        let kind = if tick.goal_ml.is_nan() {
            Kind::Recording(Curve { lambda_deg: tick.lambda_deg, gamma_per_s2: tick.gamma_per_s2, beta_s: tick.beta_s })
        } else {
            Kind::Pour { goal_ml: tick.goal_ml }
        };
        let start = Start {
            episode: tick.episode,
            kind,
            started_at_ns: tick.at_ns,
            wall_clock: SystemTime::now(),
            config: &self.config,
            weights: &tick.weights(),
        };
        match EpisodeWriter::create(&self.directory, &start) {
            Ok(writer) => {
                let path = writer.path().to_path_buf();
                self.current = Some(Current {
                    writer,
                    episode: tick.episode,
                    started_at_ns: tick.at_ns,
                    ended: None,
                    heard_at_ns: now_ns(),
                    last_sequence: 0,
                    last_captured_at_ns: 0,
                    waiting: VecDeque::new(),
                    images: 0,
                    dropped: 0,
                    disordered: 0,
                });
                self.report_path(RecorderState::Writing, tick.episode, 0, 0, &path);
                for item in std::mem::take(&mut self.ring) {
                    self.frame(item);
                }
            }
            Err(e) => self.report(RecorderState::Failed, tick.episode, 0, 0, &e.to_string()),
        }
    }

    /// A frame goes into the file under way, or into the ring.
    fn frame(&mut self, item: Item) {
        let captured_at_ns = item.feature.captured_at_ns;
        let Some(current) = &mut self.current else { return self.keep(item) };
        if let Some(ended) = &mut current.ended
            && captured_at_ns >= ended.at_ns
        {
            ended.frames_passed = true;
            return self.keep(item);
        }
        if captured_at_ns.saturating_add(BEFORE_NS) < current.started_at_ns {
            return self.handover.give_back(item.pixels);
        }
        if item.feature.sequence <= current.last_sequence || captured_at_ns <= current.last_captured_at_ns {
            current.disordered += 1;
            return self.handover.give_back(item.pixels);
        }
        current.last_sequence = item.feature.sequence;
        current.last_captured_at_ns = captured_at_ns;
        let image = item.pixels.as_ref().and_then(|pixels| self.encoder.encode(&item.header, pixels));
        if image.is_some() {
            current.images += 1;
        } else {
            current.dropped += 1;
        }
        current.waiting.push_back(Waiting { feature: item.feature, image });
        self.handover.give_back(item.pixels);
    }

    fn keep(&mut self, item: Item) {
        self.ring.push_back(item);
        if self.ring.len() > RING_FRAMES
            && let Some(oldest) = self.ring.pop_front()
        {
            self.handover.give_back(oldest.pixels);
        }
    }

    /// Writes the frames whose alpha is known; all of them if `now`.
    fn settle(&mut self, now: bool) {
        let Self { current: Some(current), track, encoder, .. } = self else { return };
        let mut result = Ok(());
        while let Some(first) = current.waiting.front() {
            let at_ns = first.feature.captured_at_ns;
            if !now && !track.covers(at_ns) {
                break;
            }
            // The end was not known yet when the frame came.
            if current.ended.is_none_or(|e| at_ns < e.at_ns) {
                let sample = Sample {
                    feature: &first.feature,
                    alpha_commanded_deg: track.commanded_deg(at_ns),
                    alpha_measured_deg: track.measured_deg(at_ns),
                    image: first.image.as_deref().map(|data| (encoder.name, data)),
                };
                result = current.writer.frame(&sample);
            } else {
                match first.image {
                    Some(_) => current.images -= 1,
                    None => current.dropped -= 1,
                }
            }
            current.waiting.pop_front();
            if result.is_err() {
                break;
            }
        }
        self.writing(|_| result);
    }

    /// Gives the file up when writing fails; what is in it stays.
    fn writing(&mut self, write: impl FnOnce(&mut Current) -> Result<(), WriteError>) {
        let Some(mut current) = self.current.take() else { return };
        match write(&mut current) {
            Ok(()) => self.current = Some(current),
            Err(e) => self.report(RecorderState::Failed, current.episode, current.images, current.dropped, &e.to_string()),
        }
    }

    fn close_if_over(&mut self) {
        let Some(current) = &self.current else { return };
        let now = now_ns();
        match current.ended {
            Some(ended) if ended.frames_passed || now.saturating_sub(ended.seen_at_ns) > AFTER_NS => self.close(true, "over"),
            None if now.saturating_sub(current.heard_at_ns) > SILENCE_NS => self.close(false, "the controller fell silent"),
            _ => {}
        }
    }

    fn close(&mut self, complete: bool, reason: &str) {
        self.settle(true);
        let Some(current) = self.current.take() else { return };
        let end = End { complete, reason, disordered_frames: current.disordered };
        let (episode, images, dropped) = (current.episode, current.images, current.dropped);
        match current.writer.finish(&end) {
            Ok(path) if complete => self.report_path(RecorderState::Complete, episode, images, dropped, &path),
            Ok(path) => {
                let what = format!("{reason}; {} is incomplete", path.display());
                self.report(RecorderState::Failed, episode, images, dropped, &what);
            }
            Err(e) => self.report(RecorderState::Failed, episode, images, dropped, &e.to_string()),
        }
    }

    fn report_path(&self, state: RecorderState, episode: u64, images: u64, dropped: u64, path: &Path) {
        self.report(state, episode, images, dropped, &path.display().to_string());
    }

    fn report(&self, state: RecorderState, episode: u64, images: u64, dropped: u64, text: &str) {
        // Nobody may be listening, and the file is what counts.
        let _ = self.reports.send_copy(RecorderReport::new(state, episode, images, dropped, text));
    }
}

/// Compresses images as `[recording]` says.
struct Encoder {
    extension: &'static str,
    name: &'static str,
    parameters: Vector<i32>,
    bgr: Mat,
    out: Vector<u8>,
}

impl Encoder {
    fn new(config: &Config) -> Self {
        let (extension, name, parameters) = match config.recording.image_format {
            ImageFormat::Jpeg => (".jpg", "jpeg", vec![imgcodecs::IMWRITE_JPEG_QUALITY, i32::from(config.recording.jpeg_quality)]),
            // The fastest level: camera noise hardly shrinks further, and the frames come at 30 Hz.
            ImageFormat::Png => (".png", "png", vec![imgcodecs::IMWRITE_PNG_COMPRESSION, 1]),
        };
        Self { extension, name, parameters: parameters.into(), bgr: Mat::default(), out: Vector::new() }
    }

    /// The compressed image; `None` if the pixels do not fit the header or cannot be compressed.
    fn encode(&mut self, header: &FrameHeader, pixels: &[u8]) -> Option<Vec<u8>> {
        let format = PixelFormat::from_code(header.format)?;
        let rows = i32::try_from(header.height_px).ok()?;
        let expected = (header.width_px as usize).checked_mul(header.height_px as usize)?.checked_mul(format.bytes_per_pixel())?;
        if expected == 0 || pixels.len() != expected {
            return None;
        }
        let flat = Mat::from_slice(pixels).ok()?;
        let image = flat.reshape(i32::try_from(format.bytes_per_pixel()).ok()?, rows).ok()?;
        let done = if format == PixelFormat::Yuyv {
            imgproc::cvt_color_def(&image, &mut self.bgr, imgproc::COLOR_YUV2BGR_YUYV)
                .and_then(|()| imgcodecs::imencode(self.extension, &self.bgr, &mut self.out, &self.parameters))
        } else {
            imgcodecs::imencode(self.extension, &image, &mut self.out, &self.parameters)
        };
        done.ok()?.then(|| self.out.to_vec())
    }
}
