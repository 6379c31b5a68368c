//! Everything that the page's threads share, and what it looks like from outside: the state that is sent to all browsers more than ten times a
//! second.
//!
//! Ordinary threads; each part has its own lock, held for a moment. Allocates, and does not fail: what is not known is `null` or a line.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed, Ordering::SeqCst};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use shared::config::Config;
use shared::control::{EndReason, Outcome, Status};
use shared::messages::{Doubt, Phase};
use shared::os::now_ns;
use shared::runtime_dir::Place;
use web::Broadcast;

use crate::calibration::Calibration;
use crate::cell::{Cell, Live};
use crate::ends::Ends;
use crate::history::History;
use crate::jobs::Jobs;
use crate::lock::locked;
use crate::say::Say;
use crate::shelf::Shelf;
use crate::stop::Stopper;
use crate::wire::Point;
use crate::words;

/// Time between two states that are sent: more than thirteen a second.
const BEAT: Duration = Duration::from_millis(75);
/// Pause between two looks at the weight files. Chosen by hand: a person waits for it no longer.
const SLOW: Duration = Duration::from_secs(1);
/// Number of the newest ticks in each state: half a second, so that a browser that misses some states misses no tick.
const POINTS: usize = 18;
/// How often a pour that was let go of is stopped until it is obeyed. Chosen by hand; no measurement is recorded.
const STOP_TRIES: usize = 3;
/// What is remembered of the episodes' ends lies beside them, under this name.
const ENDS_FILE: &str = "operator-page-ends.json";
/// Number of the newest results that are sent. Chosen by hand; no measurement is recorded.
const OUTCOMES: usize = 8;

/// What the page's threads share.
pub struct Site {
    /// The configuration, as it was at the start.
    pub config: Config,
    /// Its file.
    pub file: PathBuf,
    /// What is known of the cell.
    pub cell: Arc<Cell>,
    /// Who has the say.
    say: Mutex<Say>,
    /// The pour that is held; 0 if none is.
    held: Mutex<u64>,
    /// Number of times that somebody stopped, took the say, or let go: an order from before does not begin any more.
    stops: AtomicU64,
    /// The weight files.
    pub shelf: Shelf,
    /// What the page shows of them.
    weights: Mutex<Value>,
    /// Work in the background.
    pub jobs: Arc<Jobs>,
    /// The recorded episodes.
    pub history: History,
    /// A calibration under way.
    pub calibration: Arc<Calibration>,
    /// The way to stop.
    pub stopper: Stopper,
    /// All browsers that look.
    pub events: Broadcast,
    /// The second port, where only Stop is answered.
    pub stop_port: u16,
}

impl Site {
    /// The page of a cell, of which nothing is known yet.
    pub fn new(config: Config, file: PathBuf, stop_port: u16) -> Self {
        let shelf = Shelf::new(&config);
        Self {
            cell: Arc::new(Cell::new(file.clone(), Ends::of_file(config.recording.directory.join(ENDS_FILE)))),
            say: Mutex::default(),
            held: Mutex::default(),
            stops: AtomicU64::new(0),
            shelf,
            weights: Mutex::new(Value::Null),
            jobs: Arc::default(),
            calibration: Arc::default(),
            history: History::new(config.recording.directory.clone()),
            stopper: Stopper::new(Place::from(&config.cell), file.clone()),
            events: Broadcast::default(),
            stop_port,
            config,
            file,
        }
    }

    /// Who has the say.
    pub fn say(&self) -> MutexGuard<'_, Say> {
        locked(&self.say)
    }

    /// Number of stops so far; see [`Site::stopped`].
    pub fn stops(&self) -> u64 {
        self.stops.load(SeqCst)
    }

    /// Orders that are still on their way do not begin any more.
    pub fn stopped(&self) {
        self.stops.fetch_add(1, SeqCst);
    }

    /// From now on the pour `episode` is held.
    pub fn hold(&self, episode: u64) {
        *locked(&self.held) = episode;
        self.say().hold(true);
        self.cell.hold(true);
    }

    /// Ends a pour that is held, because this program ends.
    fn end_held(&self) {
        if std::mem::take(&mut *locked(&self.held)) != 0 {
            // The link would say the same; whether it is obeyed, nobody is left to tell.
            let _ = self.stopper.stop();
        }
    }

    /// Ends what would go on without this program: a pour that is held, work in the background.
    pub fn end(&self) {
        self.end_held();
        self.jobs.cancel();
        self.calibration.cancel();
        std::thread::sleep(BEAT * 2);
    }

    /// What does not change while this program runs.
    pub fn about(&self) -> Value {
        let c = &self.config;
        json!({
            "cell": c.cell.name, "version": env!("CARGO_PKG_VERSION"), "config": self.file.display().to_string(),
            "goal_max_ml": c.controller.goal_max_ml, "holds_ml": c.container.holds_ml,
            "region_px": c.image.region_px, "x_axis_px": c.image.x_axis_px, "y_axis_px": c.image.y_axis_px,
            "doubts": Doubt::ALL.map(Doubt::words), "stop_port": self.stop_port,
        })
    }

    /// The last minute of ticks.
    pub fn minute(&self) -> Value {
        Value::Array(self.cell.live().points.iter().map(row).collect())
    }

    /// Sends the state to all browsers, and ends a held pour that is let go of, until `stop` is set.
    pub fn publish(self: &Arc<Self>, stop: &AtomicBool) {
        while !stop.load(Relaxed) {
            let begin = Instant::now();
            self.watch_held();
            if self.events.listeners() > 0 {
                self.events.send(&self.state().to_string());
            }
            std::thread::sleep(BEAT.saturating_sub(begin.elapsed()));
        }
        self.stopped();
        self.end_held();
    }

    /// Looks at the weight files until `stop` is set.
    pub fn look_at_weights(&self, stop: &AtomicBool) {
        while !stop.load(Relaxed) {
            let about = self.shelf.about();
            *locked(&self.weights) = about;
            std::thread::sleep(SLOW);
        }
    }

    fn watch_held(self: &Arc<Self>) {
        let held = *locked(&self.held);
        if held == 0 {
            return;
        }
        let over = self.cell.live().status.as_ref().is_some_and(|s| s.outcomes.iter().any(|o| o.episode == held));
        let let_go = self.say().let_go();
        if over || let_go {
            *locked(&self.held) = 0;
            self.say().hold(false);
            self.cell.hold(false);
        }
        if let_go && !over {
            let this = Arc::clone(self);
            // Without a thread the pour ends a moment later, when the page's own Stop or the loop's rules end it.
            let stop = move || (0..STOP_TRIES).any(|_| this.stopper.stop().is_ok());
            let _ = std::thread::Builder::new().name("let-go".into()).spawn(stop);
        }
    }

    /// What a browser shows now.
    fn state(&self) -> Value {
        let (words, fast) = {
            let live = self.cell.live();
            (words::of(&live), fast(&live))
        };
        let say = self.say();
        let holder = say.holder().map(|h| h.name.clone());
        let held = say.is_held();
        drop(say);
        json!({
            "doing": words.doing, "remedy": words.remedy, "kind": words.kind, "may_resume": words.may_resume,
            "live": fast, "say": holder, "held": held, "weights": *locked(&self.weights), "job": self.jobs.about(),
            "table": self.history.version(),
            "stops": self.stops(), "sent_at_ms": now_ns() / 1_000_000,
        })
    }
}

/// A tick as the page takes it.
fn row(p: &Point) -> Value {
    json!([
        p.tick,
        p.at_ns as f64 / 1e9,
        p.alpha_deg,
        p.alpha_measured_deg,
        p.area_px2,
        p.doubt,
        p.d_ml,
        p.poured_ml,
        p.poured_sd_ml,
        p.phase,
        p.episode,
        p.goal_ml
    ])
}

/// What changes all the time.
fn fast(live: &Live) -> Value {
    let skipped = live.points.len().saturating_sub(POINTS);
    json!({
        "ticks": live.ticks(),
        "points": live.points.iter().skip(skipped).map(row).collect::<Vec<_>>(),
        "picture": live.picture.as_ref().map(|p| p.sequence),
        "no_picture": live.no_picture,
        "status": live.status.as_ref().map(|s| slow(s, live)),
        "no_status": live.no_status,
    })
}

/// The controller's own state, as far as the page shows it.
fn slow(s: &Status, live: &Live) -> Value {
    let lateness = s.timing.first();
    let skipped = s.outcomes.len().saturating_sub(OUTCOMES);
    json!({
        "phase": s.phase, "hindrance": s.hindrance, "robot": s.robot, "robot_warning": s.robot_warning,
        "weights": s.weights, "weights_refused": s.weights_refused, "ticks": s.ticks, "late_ticks": s.late_ticks,
        "skipped_ticks": s.skipped_ticks, "stale_features": s.stale_features, "events_lost": s.events_lost,
        "lateness": lateness.map(|h| json!({ "n": h.n, "p50_us": h.p50_us, "p99_us": h.p99_us, "max_us": h.max_us, "bins": h.bins })),
        "outcomes": s.outcomes.iter().skip(skipped).map(|o| outcome(o, live)).collect::<Vec<_>>(),
    })
}

fn outcome(o: &Outcome, live: &Live) -> Value {
    let recorded = live.files.get(&o.episode);
    let file = recorded.and_then(|r| r.as_ref().ok()).and_then(|path| path.rsplit('/').next());
    json!({
        "episode": o.episode, "done": o.reason == EndReason::Done, "unsure": o.is_unsure(), "reason": o.words(), "goal_ml": o.goal_ml,
        "poured_ml": o.poured_ml, "poured_sd_ml": o.poured_sd_ml, "poured": o.poured_words(), "unseen": o.unseen, "seconds": o.seconds,
        "file": file, "no_file": recorded.and_then(|r| r.as_ref().err()),
    })
}

/// Whether the cell moves.
pub fn moves(phase: Option<Phase>) -> bool {
    matches!(phase, Some(Phase::Pouring | Phase::Recording | Phase::Returning | Phase::Settling))
}
