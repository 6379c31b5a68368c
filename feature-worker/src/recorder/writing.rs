//! The recorder's thread: follows the controller's telemetry and writes each episode into its file.
//!
//! When an episode's number appears in the telemetry it opens a file and takes the few frames from just before. When the number is gone
//! and the last frame of the episode has come, it closes the file. An episode that was under way when the recorder started is not
//! recorded, because its beginning is missing. Allocates and writes files; a file that cannot be written is given up and reported.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use shared::alpha_track::AlphaTrack;
use shared::config::Config;
use shared::episode::{EpisodeEnd, EpisodeKind, EpisodeStart, EpisodeWriter, FrameRow, WriteError};
use shared::gaussian_curve::Curve;
use shared::ipc::{Cell, IpcError};
use shared::messages::{Feature, RecorderReport, RecorderState, Telemetry};
use shared::os::now_ns;

use super::encoder::Encoder;
use super::handover::{Handover, KEPT_FRAMES, OfferedFrame};

/// Frames from up to this long before an episode's first tick belong to its file, ns. Chosen by hand: they show that nothing flows yet.
const BEFORE_NS: u64 = 200_000_000;
/// How long a frame of the episode's end may be under way, ns. Chosen by hand; no measurement is recorded.
const AFTER_NS: u64 = 500_000_000;
/// Without telemetry for this long the controller counts as gone, ns. Chosen by hand; no measurement is recorded.
const SILENCE_NS: u64 = 2_000_000_000;
/// How often the thread looks for work. Chosen by hand: much shorter than a frame of a 30 Hz camera.
const PAUSE: Duration = Duration::from_millis(5);
/// Ticks of the controller of which alpha is remembered: more than 8 s at the camera's rate of 30 Hz.
const TRACK_TICKS: usize = 256;

type Ipc = iceoryx2::service::ipc::Service;

/// The recorder's thread.
pub struct RecorderThread {
    config: Config,
    directory: PathBuf,
    handover: Arc<Handover>,
    telemetry: Subscriber<Ipc, Telemetry, ()>,
    reports: Publisher<Ipc, RecorderReport, ()>,
    track: AlphaTrack<TRACK_TICKS>,
    kept: VecDeque<OfferedFrame>,
    encoder: Encoder,
    /// Episode of the newest tick; `None` before the first.
    newest_episode: Option<u64>,
    newest_tick: u64,
    /// Ticks of the next episode, while frames of the one before are still under way.
    pending: VecDeque<Telemetry>,
    current: Option<OpenEpisode>,
    // Ports are used until here, so the cell is dropped last.
    _cell: Cell,
}

/// The file under way.
struct OpenEpisode {
    writer: EpisodeWriter,
    episode: u64,
    started_at_ns: u64,
    /// First tick that is not of the episode any more, and when it was seen.
    ended: Option<EpisodeOver>,
    heard_at_ns: u64,
    last_sequence: u64,
    last_captured_at_ns: u64,
    waiting: VecDeque<WaitingFrame>,
    images: u64,
    dropped: u64,
    disordered: u64,
}

#[derive(Clone, Copy)]
struct EpisodeOver {
    at_ns: u64,
    seen_at_ns: u64,
    /// A frame from after the end has come, so all from before have.
    frames_passed: bool,
}

/// A frame that waits for the tick after it.
struct WaitingFrame {
    feature: Feature,
    image: Option<Vec<u8>>,
}

impl RecorderThread {
    /// Joins the cell.
    pub fn new(config: Config, directory: PathBuf, handover: Arc<Handover>) -> Result<Self, IpcError> {
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
            kept: VecDeque::with_capacity(KEPT_FRAMES + 1),
            encoder,
            newest_episode: None,
            newest_tick: 0,
            pending: VecDeque::new(),
            current: None,
            _cell: cell,
        })
    }

    /// Records until the handover is stopped.
    pub fn run(&mut self) {
        loop {
            let stop = self.handover.is_stopped();
            // Telemetry first, so that a file is open before the frames of its episode are looked at.
            while let Ok(Some(tick)) = self.telemetry.receive() {
                let tick = *tick;
                self.tick(&tick);
            }
            // Bounded, so that a slow disk cannot keep the thread from the telemetry.
            for _ in 0..KEPT_FRAMES {
                match self.handover.take() {
                    Some(frame) => self.frame(frame),
                    None => break,
                }
            }
            self.settle(false);
            self.close_if_over();
            self.follow();
            if stop {
                break;
            }
            if self.handover.is_empty() {
                std::thread::sleep(PAUSE);
            }
        }
        while let Some(frame) = self.handover.take() {
            self.frame(frame);
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
            self.newest_episode = None;
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
                    current.ended = Some(EpisodeOver { at_ns: tick.at_ns, seen_at_ns: now_ns(), frames_passed: false });
                }
                if tick.episode != 0 && tick.episode != current.episode {
                    return;
                }
            }
            self.pending.pop_front();
            let is_new = self.newest_episode != Some(tick.episode);
            let joined_late = self.newest_episode.is_none();
            self.newest_episode = Some(tick.episode);
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
            let write = |c: &mut OpenEpisode| if tick.episode == c.episode { c.writer.telemetry(&tick) } else { Ok(()) };
            self.writing(write);
        }
    }

    fn open(&mut self, tick: &Telemetry) {
        let kind = if tick.goal_ml.is_nan() {
            EpisodeKind::Recording(Curve { lambda_deg: tick.lambda_deg, gamma_per_s2: tick.gamma_per_s2, beta_s: tick.beta_s })
        } else {
            EpisodeKind::Pour { goal_ml: tick.goal_ml }
        };
        let start = EpisodeStart {
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
                self.current = Some(OpenEpisode {
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
                for frame in std::mem::take(&mut self.kept) {
                    self.frame(frame);
                }
            }
            Err(e) => self.report(RecorderState::Failed, tick.episode, 0, 0, &e.to_string()),
        }
    }

    /// A frame goes into the file under way, or into the ring.
    fn frame(&mut self, frame: OfferedFrame) {
        let captured_at_ns = frame.feature.captured_at_ns;
        let Some(current) = &mut self.current else { return self.keep(frame) };
        if let Some(ended) = &mut current.ended
            && captured_at_ns >= ended.at_ns
        {
            ended.frames_passed = true;
            return self.keep(frame);
        }
        if captured_at_ns.saturating_add(BEFORE_NS) < current.started_at_ns {
            return self.handover.give_back(frame.pixels);
        }
        if frame.feature.sequence <= current.last_sequence || captured_at_ns <= current.last_captured_at_ns {
            current.disordered += 1;
            return self.handover.give_back(frame.pixels);
        }
        current.last_sequence = frame.feature.sequence;
        current.last_captured_at_ns = captured_at_ns;
        let image = frame.pixels.as_ref().and_then(|pixels| self.encoder.encode(&frame.header, pixels));
        if image.is_some() {
            current.images += 1;
        } else {
            current.dropped += 1;
        }
        current.waiting.push_back(WaitingFrame { feature: frame.feature, image });
        self.handover.give_back(frame.pixels);
    }

    fn keep(&mut self, frame: OfferedFrame) {
        self.kept.push_back(frame);
        if self.kept.len() > KEPT_FRAMES
            && let Some(oldest) = self.kept.pop_front()
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
                let sample = FrameRow {
                    feature: &first.feature,
                    alpha_commanded_deg: track.commanded_deg(at_ns),
                    alpha_measured_deg: track.measured_deg(at_ns),
                    image: first.image.as_deref().map(|data| (encoder.name(), data)),
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
    fn writing(&mut self, write: impl FnOnce(&mut OpenEpisode) -> Result<(), WriteError>) {
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
        let end = EpisodeEnd { complete, reason, disordered_frames: current.disordered };
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
