//! What was to be seen in the tick in which a pour or recording was ended, so that it may not be told as an end without a fault.
//!
//! Pure; allocates nothing; cannot fail. It looks at what the loop was given, and not at what the loop made of it.

use rt_controller::core::{Order, Settings};
use rt_controller::journal::Tick;
use shared::messages::{Doubt, Phase};

/// What is kept from tick to tick.
#[derive(Debug, Clone, Copy, Default)]
pub struct Evidence {
    /// When the newest usable picture was taken, ns.
    usable_ns: u64,
    /// When the tick before began, ns; 0 before the first.
    before_ns: u64,
    /// The start of the worker that measured when the run began, ns.
    epoch_ns: u64,
    /// What ended the newest run, if it was to be seen.
    pub demands: Option<&'static str>,
}

impl Evidence {
    /// Takes a tick that led from one phase to another, and the start of the worker whose measurement counted last, ns.
    pub fn tick(&mut self, tick: &Tick, (before, now): (Phase, Phase), epoch_ns: u64, settings: &Settings) {
        let runs = |phase| matches!(phase, Phase::Pouring | Phase::Recording);
        let of_this_clock = || tick.features.iter().filter(|f| f.captured_at_ns <= tick.now_ns);
        let usable = of_this_clock().filter(|f| Doubt::from_code(f.doubt).usable(f.area_px2));
        self.usable_ns = usable.map(|f| f.captured_at_ns).fold(self.usable_ns, u64::max);
        if runs(now) && !runs(before) {
            (self.epoch_ns, self.demands) = (epoch_ns, None);
        } else if runs(before) && !runs(now) {
            let slept = self.before_ns != 0 && tick.now_ns - self.before_ns > settings.patience_ns;
            let looks = [
                (now == Phase::NoRobot, "the robot was lost"),
                (tick.order == Some(Order::Abort), "it was aborted"),
                (slept, "the controller was stopped too long"),
                (epoch_ns != self.epoch_ns, "another worker measured"),
                (tick.now_ns.saturating_sub(self.usable_ns) > settings.stale_ns, "no measurement was fresh"),
            ];
            self.demands = looks.into_iter().find_map(|(is_so, words)| is_so.then_some(words));
        }
        self.before_ns = tick.now_ns;
    }
}
