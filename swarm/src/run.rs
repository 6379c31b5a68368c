//! One seed: the cell is made, the controller lives in it, is killed and started again, until the plan is done.
//!
//! One thread; allocates. A panic of any part is a violation of its own.

use std::cell::RefCell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, AtomicU64};

use rt_controller::control_loop::LoopState;
use rt_controller::core::Settings;
use rt_controller::exchange::Exchange;
use rt_controller::robot_thread::{RobotNote, keep_robot_connected};
use serde::Serialize;
use shared::config::Config;
use shared::control::Outcome;
use simulator::ur::Series;

use crate::check::Violation;
use crate::costs::{Cost, Poured};
use crate::plan::Plan;
use crate::records::{Journal, Row};
use crate::site::Site;
use crate::vessels::VESSELS;
use crate::weight_set::TrainedSet;
use crate::world::{Life, LoopSide, World};

/// What a seed showed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Shown {
    /// The seed.
    pub seed: u64,
    /// The robot's generation.
    pub series: Series,
    /// The vessel's name.
    pub vessel: &'static str,
    /// Time constant of the robot's lag, s.
    pub lag_s: f64,
    /// Virtual time, s.
    pub virtual_s: f64,
    /// What must not have happened.
    pub violations: Vec<Violation>,
    /// How pours and recordings went.
    pub poured: Vec<Poured>,
    /// What faults in pours and recordings cost.
    pub costs: Vec<Cost>,
    /// What happened, in words, if it was wanted.
    #[serde(skip)]
    pub story: Vec<String>,
    /// One row for each tick, if they were wanted.
    #[serde(skip)]
    pub rows: Vec<Row>,
}

/// Runs a plan. `wanted` keeps the story and the rows.
pub fn run(plan: &Plan, trained: &TrainedSet, config: &Config, wanted: bool) -> Shown {
    run_checked(plan, trained, config, config, wanted)
}

/// Runs a plan with a controller that has `config`, while the checks hold it to `checked`. They differ where it is tried whether the checks
/// find a limit that is too weak.
pub fn run_checked(plan: &Plan, trained: &TrainedSet, config: &Config, checked: &Config, wanted: bool) -> Shown {
    let site = RefCell::new(Site::new(plan, trained, checked, wanted));
    let ran = catch_unwind(AssertUnwindSafe(|| {
        while !site.borrow().is_done() {
            live(&site, config);
            wait_for_restart(&site);
        }
    }));
    let site = site.into_inner();
    let mut shown = Shown {
        seed: plan.seed,
        series: plan.series,
        vessel: VESSELS[plan.vessel].name,
        lag_s: plan.lag_s,
        virtual_s: site.now_s(),
        violations: site.checks.violations,
        poured: site.poured,
        costs: site.costs.known,
        story: site.story.unwrap_or_default(),
        rows: site.rows.unwrap_or_default(),
    };
    if let Err(panic) = ran {
        let words = panic.downcast_ref::<String>().cloned().or_else(|| panic.downcast_ref::<&str>().map(|s| (*s).to_owned()));
        shown.violations.insert(0, Violation { invariant: "no-panic", at_s: shown.virtual_s, what: words.unwrap_or_default() });
    }
    shown
}

/// One life of the controller.
fn live(site: &RefCell<Site>, config: &Config) {
    let settings = Settings::new(config);
    let (exchange, side, note) = (Exchange::default(), LoopSide::default(), RobotNote::default());
    let (stop, connections) = (AtomicBool::new(false), AtomicU64::new(0));
    site.borrow_mut().controller_starts();
    let before = site.borrow().checks.outcomes.len();
    let lost_ns = u64::from(config.controller.lost_robot_ms) * 1_000_000;
    let life = Life {
        state: LoopState::new(settings, lost_ns, &side, &exchange),
        side: &side,
        exchange: &exchange,
        note: &note,
        deadline_ns: Some(site.borrow().now_ns + settings.period_ns),
        journal: Journal::new(&settings),
    };
    let world = World { site, life: RefCell::new(life), stop: &stop };
    let say = |_: shared::level::Level, text: &str| site.borrow_mut().say(|| text.to_owned());
    keep_robot_connected(&world, config, &exchange, &note, &connections, &stop, &say);
    let mut site = site.borrow_mut();
    let outcomes: Vec<Outcome> = site.checks.outcomes[before..].iter().map(|(_, outcome)| *outcome).collect();
    let at_s = site.now_s();
    if let Some(difference) = world.life.borrow().journal.difference(&outcomes) {
        site.checks.violated("journal-replays", at_s, difference);
    }
}

/// Lets the cell go on without a controller until it is started again.
fn wait_for_restart(site: &RefCell<Site>) {
    let mut site = site.borrow_mut();
    while let Some(restart_at_ns) = site.restart_at_ns.filter(|_| !site.is_done()) {
        let next_ns = site.next_ns();
        site.set_now(next_ns.min(restart_at_ns));
        if next_ns > restart_at_ns {
            return;
        }
        // Orders find nobody.
        site.step();
    }
}
