//! The recorder's thread: follows the controller's telemetry and writes each episode into its file.
//!
//! When an episode's number appears in the telemetry it opens a file and takes the few frames from just before. When the number is gone
//! and the last frame of the episode has come, it closes the file. An episode that was under way when the recorder started is not
//! recorded, because its beginning is missing. Allocates and writes files; a file that cannot be written is given up, reported and said.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use shared::config::Config;
use shared::disk_space::{LEAST_FREE, room};
use shared::episode::{EpisodeEnd, EpisodeKind, EpisodeStart, EpisodeTrack, EpisodeWriter, FrameRow, GAP, WriteError, is_gap};
use shared::gaussian_curve::Curve;
use shared::ipc::{Cell, IpcError};
use shared::level::Level;
use shared::messages::{Feature, RecorderReport, RecorderState, Telemetry};
use shared::os::now_ns;
use shared::plural::counted;

use super::encoder::Encoder;
use super::handover::{Handover, KEPT_FRAMES, OfferedFrame};
use crate::episodes::folder::{Budget, DAY, Folder, MEGABYTE};

/// Frames from up to this long before an episode's first tick belong to its file, ns. Chosen by hand: they show that nothing flows yet.
const BEFORE_NS: u64 = 200_000_000;
/// How long a frame of the episode's end may be under way, ns. Chosen by hand; no measurement is recorded.
const AFTER_NS: u64 = 500_000_000;
/// Without telemetry for this long the controller counts as gone, ns. Chosen by hand; no measurement is recorded.
const SILENCE_NS: u64 = 2_000_000_000;
/// How often the thread looks for work. Chosen by hand: much shorter than a frame of a 30 Hz camera.
const PAUSE: Duration = Duration::from_millis(5);

type Ipc = iceoryx2::service::ipc::Service;
/// What the operator is told.
type Say = Box<dyn Fn(Level, &str) + Send>;

/// The recorder's thread, with its ports and the episode under way.
pub struct RecorderThread {
    config: Config,
    directory: PathBuf,
    handover: Arc<Handover>,
    telemetry: Subscriber<Ipc, Telemetry, ()>,
    reports: Publisher<Ipc, RecorderReport, ()>,
    track: EpisodeTrack,
    /// The newest frames that belong to no episode yet, the oldest first.
    kept: VecDeque<OfferedFrame>,
    encoder: Encoder,
    /// Episode of the newest tick; `None` before the first.
    newest_episode: Option<u64>,
    /// Number and time of the newest tick, ns; 0 before the first.
    newest_tick: (u64, u64),
    /// Ticks of the next episode, while frames of the one before are still under way, each with whether the angles before it are not known.
    pending: VecDeque<(Telemetry, bool)>,
    current: Option<OpenEpisode>,
    say: Say,
    /// When it was said that the episodes are over their budget, CLOCK_MONOTONIC ns; `None` while they are not.
    over_budget_ns: Option<u64>,
    // Declared last, because the ports need it until they are dropped.
    _cell: Cell,
}

/// The episode under way and its file.
struct OpenEpisode {
    writer: EpisodeWriter,
    episode: u64,
    started_at_ns: u64,
    /// Set once a tick has come that no longer belongs to the episode.
    ended: Option<EpisodeOver>,
    /// Whether the angles of a part of it are not known, or its beginning or end.
    has_gap: bool,
    /// When the newest tick was received, CLOCK_MONOTONIC ns.
    heard_at_ns: u64,
    last_sequence: u64,
    last_captured_at_ns: u64,
    /// Frames whose alpha is not known yet.
    waiting: VecDeque<WaitingFrame>,
    images: u64,
    dropped: u64,
    disordered: u64,
}

/// The end of an episode, whose last frames may still be under way.
#[derive(Clone, Copy)]
struct EpisodeOver {
    /// Time of the first tick after the episode, CLOCK_MONOTONIC ns.
    at_ns: u64,
    /// When that tick was received, CLOCK_MONOTONIC ns.
    seen_at_ns: u64,
    /// A frame from after the end has come, so all frames from before it have come too.
    frames_passed: bool,
}

/// A frame that waits for the tick after it, which decides its alpha.
struct WaitingFrame {
    feature: Feature,
    image: Option<Vec<u8>>,
}

impl RecorderThread {
    /// Joins the cell.
    pub fn new(config: Config, directory: PathBuf, handover: Arc<Handover>, say: Say) -> Result<Self, IpcError> {
        let cell = Cell::join(&config.cell)?;
        let fail = |service: &str, what: String| IpcError::Service { service: service.into(), what };
        let telemetry = cell.telemetry()?.subscriber_builder().create().map_err(|e| fail("telemetry", format!("{e:?}")))?;
        let reports = cell.recorder()?.publisher_builder().create().map_err(|e| fail("recorder", format!("{e:?}")))?;
        cell.reserve()?;
        let encoder = Encoder::new(&config);
        Ok(Self {
            config,
            directory,
            handover,
            telemetry,
            reports,
            track: EpisodeTrack::new(),
            kept: VecDeque::with_capacity(KEPT_FRAMES + 1),
            encoder,
            newest_episode: None,
            newest_tick: (0, 0),
            pending: VecDeque::new(),
            current: None,
            say,
            over_budget_ns: None,
            _cell: cell,
        })
    }

    /// Records until the handover is stopped.
    pub fn run(&mut self) {
        loop {
            let stop = self.handover.is_stopped();
            // The telemetry comes first, so that a file is open before the frames of its episode are looked at.
            while let Ok(Some(tick)) = self.telemetry.receive() {
                let tick = *tick;
                self.take_tick(&tick);
            }
            // The number of frames is bounded, so that a slow disk cannot keep the thread from the telemetry.
            for _ in 0..KEPT_FRAMES {
                match self.handover.take() {
                    Some(frame) => self.take_frame(frame),
                    None => break,
                }
            }
            self.write_waiting(false);
            self.close_if_over();
            self.take_due_ticks();
            if stop {
                break;
            }
            if self.handover.is_empty() {
                std::thread::sleep(PAUSE);
            }
        }
        while let Some(frame) = self.handover.take() {
            self.take_frame(frame);
        }
        while let Some(current) = &self.current {
            let complete = current.ended.is_some();
            self.close(complete, if complete { "over" } else { "the feature worker was stopped" });
            self.take_due_ticks();
        }
    }

    /// Enters a tick into the track of alpha and puts it into the queue.
    fn take_tick(&mut self, tick: &Telemetry) {
        self.track.push(tick.at_ns, tick.alpha_deg, tick.robot_at_ns, tick.alpha_measured_deg);
        let (newest, newest_ns) = self.newest_tick;
        let after_gap = newest != 0 && is_gap((newest, newest_ns), (tick.tick, tick.at_ns));
        if tick.tick <= newest {
            self.pending.clear();
            self.close(false, "the controller was restarted");
            self.newest_episode = None;
        }
        self.newest_tick = (tick.tick, tick.at_ns);
        self.pending.push_back((*tick, after_gap));
        self.take_due_ticks();
    }

    /// Opens and ends episodes as the ticks say, and writes the ticks. Those of the next episode wait until the last frames of the one
    /// before have come.
    fn take_due_ticks(&mut self) {
        while let Some((tick, after_gap)) = self.pending.front().copied() {
            if let Some(current) = &mut self.current {
                current.heard_at_ns = now_ns();
                current.has_gap |= after_gap && current.ended.is_none();
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
                if let Some(current) = &mut self.current {
                    current.has_gap |= after_gap;
                }
            }
            let write = |c: &mut OpenEpisode| if tick.episode == c.episode { c.writer.telemetry(&tick) } else { Ok(()) };
            self.try_write(write);
        }
    }

    /// Opens the file of the episode that begins with `tick`, and gives it the frames that were kept.
    fn open(&mut self, tick: &Telemetry) {
        if let Some(what) = self.no_room() {
            return self.report(RecorderState::Failed, tick.episode, 0, 0, &what);
        }
        let kind = if tick.goal_ml.is_nan() {
            EpisodeKind::Recording(Curve { lambda_deg: tick.lambda_deg, gamma_per_s2: tick.gamma_per_s2, beta_s: tick.beta_s })
        } else {
            EpisodeKind::Pour { goal_ml: tick.goal_ml }
        };
        let start = EpisodeStart {
            episode: tick.episode,
            kind,
            started_at_ns: tick.at_ns,
            // The tick is a little older than now, and both clocks are to tell of one moment.
            wall_clock: SystemTime::now() - Duration::from_nanos(now_ns().saturating_sub(tick.at_ns)),
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
                    has_gap: false,
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
                    self.take_frame(frame);
                }
            }
            Err(e) => self.report(RecorderState::Failed, tick.episode, 0, 0, &e.to_string()),
        }
    }

    /// Why no episode is begun on the disk as it is; `None` if one is.
    fn no_room(&self) -> Option<String> {
        let room = room(&self.directory)?;
        let directory = self.directory.display();
        if room.lacks_files() {
            return Some(format!(
                "{directory}: the disk holds as many files as it may, whatever their size: nothing is recorded. Delete what is not needed (`episodes prune`)"
            ));
        }
        (room.bytes < LEAST_FREE).then(|| {
            format!(
                "{directory}: only {} MB are free, and below {} MB no episode is begun: nothing is recorded. Delete what is not needed (`episodes prune`)",
                room.bytes / MEGABYTE,
                LEAST_FREE / MEGABYTE
            )
        })
    }

    /// Puts a frame into the episode under way if it belongs there, and keeps it otherwise.
    fn take_frame(&mut self, frame: OfferedFrame) {
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

    /// Keeps a frame for an episode that may begin, and forgets the oldest one.
    fn keep(&mut self, frame: OfferedFrame) {
        self.kept.push_back(frame);
        if self.kept.len() > KEPT_FRAMES
            && let Some(oldest) = self.kept.pop_front()
        {
            self.handover.give_back(oldest.pixels);
        }
    }

    /// Writes the frames whose alpha is known, or, with `all`, every one that waits.
    fn write_waiting(&mut self, all: bool) {
        let Self { current: Some(current), track, encoder, .. } = self else { return };
        let mut result = Ok(());
        while let Some(first) = current.waiting.front() {
            let at_ns = first.feature.captured_at_ns;
            if !all && !track.covers(at_ns) {
                break;
            }
            // When the frame came, the end of the episode may not have been known yet.
            if current.ended.is_none_or(|e| at_ns < e.at_ns) {
                let row = FrameRow {
                    feature: &first.feature,
                    alpha_commanded_deg: track.commanded_deg(at_ns),
                    alpha_measured_deg: track.measured_deg(at_ns),
                    image: first.image.as_deref().map(|data| (encoder.name(), data)),
                };
                result = current.writer.frame(&row);
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
        self.try_write(|_| result);
    }

    /// Writes into the file under way. Gives the file up when that fails; what is in it stays.
    fn try_write(&mut self, write: impl FnOnce(&mut OpenEpisode) -> Result<(), WriteError>) {
        let Some(mut current) = self.current.take() else { return };
        match write(&mut current) {
            Ok(()) => self.current = Some(current),
            Err(e) => {
                self.report(RecorderState::Failed, current.episode, current.images, current.dropped, &e.to_string());
                self.look_at_budget();
            }
        }
    }

    /// Closes the file when the last frame has come or can no longer come, or when the controller is gone.
    fn close_if_over(&mut self) {
        let Some(current) = &self.current else { return };
        let now = now_ns();
        match current.ended {
            Some(ended) if ended.frames_passed || now.saturating_sub(ended.seen_at_ns) > AFTER_NS => self.close(true, "over"),
            None if now.saturating_sub(current.heard_at_ns) > SILENCE_NS => self.close(false, "the controller fell silent"),
            _ => {}
        }
    }

    /// Closes the file under way, if there is one, and reports it.
    fn close(&mut self, complete: bool, reason: &str) {
        self.write_waiting(true);
        let Some(current) = self.current.take() else { return };
        let (complete, reason) = if complete && current.has_gap { (false, GAP) } else { (complete, reason) };
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
        self.look_at_budget();
    }

    /// Says that the episodes are over their budget, when they come to be and once a day while they are.
    fn look_at_budget(&mut self) {
        let budget = Budget::of(&self.config.recording);
        let folder = if budget.is_none() { Folder::default() } else { Folder::look(&self.directory) };
        let now = now_ns();
        if budget.holds(folder.episodes, folder.bytes) {
            self.over_budget_ns = None;
        } else if self.over_budget_ns.is_none_or(|said| now - said > DAY.as_nanos() as u64) {
            self.over_budget_ns = Some(now);
            let what = format!(
                "{}: {}, {} MB together; the budget is {}: nothing is deleted by itself, `episodes prune` does it",
                self.directory.display(),
                counted(folder.episodes, "episode"),
                folder.bytes / MEGABYTE,
                budget.words()
            );
            (self.say)(Level::Warning, &what);
        }
    }

    /// Reports the file of an episode on the service `recorder`.
    fn report_path(&self, state: RecorderState, episode: u64, images: u64, dropped: u64, path: &Path) {
        self.report(state, episode, images, dropped, &path.display().to_string());
    }

    /// Reports what became of an episode on the service `recorder`.
    fn report(&self, state: RecorderState, episode: u64, images: u64, dropped: u64, text: &str) {
        if state == RecorderState::Failed {
            (self.say)(Level::Warning, &format!("recorder: {text}"));
        }
        // A report that cannot be sent is no fault: the file is what counts, and often no process listens.
        let _ = self.reports.send_copy(RecorderReport::new(state, episode, images, dropped, text));
    }
}
