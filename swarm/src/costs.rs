//! What pours came to, and what faults in them cost: how much left after a fault could first be noticed, and how long the way upright took.
//!
//! Pure; allocates; cannot fail. Which fault binds: the earliest that must end the run, whatever came with it; without one, one of those that give the
//! reason with which the run ended must explain what left. What else may leave:
//!
//! - A fault that stops or slows the arm ([`OnWay::Holds`]) ends the bound when it begins, or the whole of it where it stood already. Liquid then leaves
//!   a container that nobody can bring upright. What had left until then is still held to it.
//! - A fault that the way upright waits for ([`OnWay::Delays`]), of the robot, the link or the loop, adds the bound that it has itself. The program then
//!   waits out its patience once more, where the pour may be about to flow again.
//! - A run that its own goal or a fault from before it ended, and no fault that must end it, is not bound: whether that end was right is not asked here.

use serde::Serialize;
use shared::control::EndReason;
use shared::messages::Phase;

use crate::bound::{Moment, most_ml};
use crate::check::NOTICED_S;
use crate::faults::Kind;
use crate::noticing::{OnWay, is_ordinary, lasts, must_end, on_way, reasons};
use crate::what::What;

/// A container nearer to 0 than this is upright, degrees (`robot.start_tolerance_deg` of config/sim.toml).
const UPRIGHT_DEG: f64 = 2.0;

/// What a fault during a pour or recording cost.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Cost {
    /// The fault's kind.
    pub fault: &'static str,
    /// Whether it came in a pour, and not in a recording.
    pub in_pour: bool,
    /// What left from the moment in which it could first be noticed until the container was upright, ml.
    pub excess_ml: f64,
    /// The most that may leave then ([`crate::bound`]), ml; `None` where only the vessel's content bounds it.
    pub bound_ml: Option<f64>,
    /// What left from the fault itself until then, ml.
    pub since_ml: f64,
    /// Time from the fault until the container was upright, s.
    pub upright_s: f64,
}

/// How a pour or recording went.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Poured {
    /// When it ended, s.
    pub at_s: f64,
    /// Time from its start until the last drops were counted, s.
    pub seconds: f64,
    /// Why.
    pub reason: EndReason,
    /// The goal, ml.
    pub goal_ml: Option<f32>,
    /// What the vessel could give at its start, ml: all but what stays in it at the largest tilt.
    pub givable_ml: f64,
    /// What was believed, ml.
    pub believed_ml: f32,
    /// Its standard deviation as far as it is known, ml.
    pub sd_ml: f32,
    /// What left, ml.
    pub true_ml: f64,
    /// The kinds of the faults while it went on or in the 6 s before.
    pub faults: Vec<&'static str>,
}

/// A fault in a pour or recording whose container is not upright again.
#[derive(Debug, Clone)]
struct OpenFault {
    kind: Kind,
    at_s: f64,
    at_ml: f64,
    /// Until when it may last, s.
    until_s: f64,
    /// What had left when it could first be noticed, ml, and the most that may leave from then on.
    noticed: Option<(f64, f64)>,
    /// The container was on its way upright already.
    is_on_way: bool,
    /// It was a pour, and no recording.
    in_pour: bool,
    /// It must end the run.
    ends: bool,
    /// Somebody may set it right before it is noticed.
    lasts: bool,
    reasons: &'static [EndReason],
    on_way: OnWay,
}

impl OpenFault {
    fn excess_ml(&self, poured_ml: f64) -> f64 {
        poured_ml - self.noticed.map_or(poured_ml, |(noticed_ml, _)| noticed_ml)
    }

    fn bound_ml(&self) -> Option<f64> {
        self.noticed.filter(|_| self.kind.is_bounded).map(|(_, bound_ml)| bound_ml)
    }

    /// What is wrong if more has left after it than may, until `poured_ml` had left; `all` are the faults of the run, in order.
    fn beyond(&self, all: &[Self], poured_ml: f64) -> Option<String> {
        let (from_ml, mut most_ml) = self.noticed?;
        let tell = |until_ml: f64, most_ml: f64| {
            let excess_ml = until_ml - from_ml;
            (excess_ml > most_ml).then(|| format!("{excess_ml:.1} ml after {}, where {most_ml:.1} may", self.kind.name))
        };
        if all.iter().any(|f| f.on_way == OnWay::Holds && f.at_s <= self.at_s && f.until_s >= self.at_s) {
            return None;
        }
        for later in all.iter().filter(|f| f.at_s > self.at_s && f.on_way != OnWay::Nothing) {
            if let Some(wrong) = tell(later.at_ml, most_ml) {
                return Some(wrong);
            }
            if later.on_way == OnWay::Holds {
                return None;
            }
            // From its beginning until it could be noticed the arm may stand already.
            most_ml += later.noticed.map_or(0.0, |(noticed_ml, bound_ml)| bound_ml + (noticed_ml - later.at_ml.max(from_ml)).max(0.0));
        }
        tell(poured_ml, most_ml)
    }
}

/// What a run ended with.
#[derive(Debug, Clone, Copy)]
struct End {
    reason: EndReason,
    /// A fault that stood before the run may have ended it.
    stood_before: bool,
}

/// What faults cost, in one cell.
#[derive(Debug, Default)]
pub struct Costs {
    open: Vec<OpenFault>,
    /// How the newest run ended, if it has.
    end: Option<End>,
    /// Until when a fault from before a run may hold the arm or slow it, s: one that began where nothing was open, or in an earlier run.
    held_until_s: f64,
    /// What is known.
    pub known: Vec<Cost>,
}

impl Costs {
    /// A fault begins in this phase with `what`, when so much had left, and may last until `until_s`. The newest run is a pour, or a recording.
    pub fn begins(&mut self, (kind, what): (Kind, &What), phase: Phase, in_pour: bool, (at_s, at_ml, until_s): (f64, f64, f64)) {
        let is_active = matches!(phase, Phase::Pouring | Phase::Recording);
        let is_returning = matches!(phase, Phase::Settling | Phase::Returning);
        if is_active || is_returning {
            // How an earlier run ended says nothing about this one.
            self.end = None;
        } else if self.open.is_empty() && on_way(what) == OnWay::Holds {
            // With a container that is not upright yet it is one of that run, and excuses only what leaves from now on.
            self.held_until_s = self.held_until_s.max(until_s);
        }
        // A robot that is lost is still on its way, as long as the container has not come upright after a fault.
        let is_on_way = is_returning || (!is_active && !self.open.is_empty());
        if is_on_way || is_active {
            let (ends, lasts, reasons, on_way) = (is_active && must_end(what).is_some(), lasts(what), reasons(what), on_way(what));
            let noticed = None;
            self.open.push(OpenFault { kind, at_s, at_ml, until_s, noticed, is_on_way, in_pour, ends, lasts, reasons, on_way });
        }
    }

    /// Somebody ends what lasts; what nobody could notice before need not end a run.
    pub fn cleared(&mut self, at_s: f64) {
        for open in self.open.iter_mut().filter(|open| open.lasts) {
            open.until_s = open.until_s.min(at_s);
            open.ends &= at_s >= open.at_s + NOTICED_S;
        }
    }

    /// A run has ended; a fault that stood before it may be why.
    pub fn ended(&mut self, reason: EndReason, stood_before: bool) {
        self.end = Some(End { reason, stood_before });
    }

    /// Takes note of what had left when a fault could first be noticed, and, when the container is upright again, of what it cost. Gives what
    /// is wrong if more has left than may.
    pub fn settle(&mut self, phase: Phase, now: &Moment<'_>) -> Option<String> {
        let (at_s, alpha_deg, poured_ml) = (now.at_s, now.alpha_deg, now.container.poured_ml());
        for open in &mut self.open {
            if open.noticed.is_none() && at_s >= open.at_s + f64::from(open.kind.noticed_ms) / 1000.0 {
                open.noticed = Some((poured_ml, most_ml(now)));
            }
        }
        let is_over = matches!(phase, Phase::Idle | Phase::NoRobot) && alpha_deg.abs() < UPRIGHT_DEG;
        if self.open.is_empty() || !is_over {
            return None;
        }
        let (open, end) = (std::mem::take(&mut self.open), self.end.take());
        let wrong = self.beyond(&open, end, poured_ml);
        // After the check: for the next run what still holds the arm stood before it.
        let holds = open.iter().filter(|fault| fault.on_way == OnWay::Holds).map(|fault| fault.until_s);
        self.held_until_s = holds.fold(self.held_until_s, f64::max);
        if end.is_some_and(|end| is_ordinary(end.reason) || end.stood_before) {
            return wrong;
        }
        for open in open.into_iter().filter(|open| !open.is_on_way) {
            let (excess_ml, bound_ml) = (open.excess_ml(poured_ml), open.bound_ml());
            let (since_ml, upright_s) = (poured_ml - open.at_ml, at_s - open.at_s);
            self.known.push(Cost { fault: open.kind.name, in_pour: open.in_pour, excess_ml, bound_ml, since_ml, upright_s });
        }
        wrong
    }

    /// What is wrong if more has left in a run with these faults and this end than may.
    fn beyond(&self, open: &[OpenFault], end: Option<End>, poured_ml: f64) -> Option<String> {
        let is_held = |fault: &OpenFault| fault.at_s < self.held_until_s;
        let told = |left: &str| format!("more left after a fault could be noticed than may: {left}");
        if let Some(first) = open.iter().find(|fault| fault.ends) {
            let counts = first.kind.is_bounded && !is_held(first);
            return first.beyond(open, poured_ml).filter(|_| counts).map(|left| told(&left));
        }
        let end = end.filter(|end| !is_ordinary(end.reason) && !end.stood_before)?;
        let named: Vec<_> = open.iter().filter(|fault| fault.reasons.contains(&end.reason)).collect();
        if named.iter().any(|fault| !fault.kind.is_bounded || is_held(fault)) {
            return None;
        }
        let left: Option<Vec<_>> = named.iter().map(|fault| fault.beyond(open, poured_ml)).collect();
        left.filter(|left| !left.is_empty()).map(|left| told(&left.join(", ")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::faults::{KINDS, named};
    use crate::what::EyeFault;
    use simulator::physics::container::{Container, Shape};
    use simulator::ur::Fault;

    /// Step of the liquid, s.
    const STEP_S: f64 = 0.004;
    /// Rate of the pour's tilt from where the vessel flows on, degrees/s: a stream of some 30 ml/s.
    const POURS_DEG_S: f64 = 8.0;

    /// A pour in which faults begin at their times, s, and last for so long; it goes on until `ends_s`, goes upright from there with 60
    /// degrees/s, and stands in `holds`, s. Gives what is wrong.
    fn wrong(faults: &[(f64, &str, What, f64)], ends_s: f64, reason: EndReason, holds: (f64, f64)) -> Option<String> {
        wrong_in(&mut Costs::default(), Phase::Returning, faults, ends_s, reason, holds)
    }

    /// The same with what is known of earlier pours, and with the phase in which the container goes upright.
    fn wrong_in(
        costs: &mut Costs,
        upright: Phase,
        faults: &[(f64, &str, What, f64)],
        ends_s: f64,
        reason: EndReason,
        holds: (f64, f64),
    ) -> Option<String> {
        let mut container = Container::new(Shape::Cylinder { radius_mm: 38.0, height_mm: 115.0 }, 20.0, 1.0, 300.0);
        let mut alpha_deg = container.spill_angle_deg();
        for k in 0..3000 {
            let at_s = f64::from(k) * STEP_S;
            let phase = if at_s < ends_s {
                Phase::Pouring
            } else if alpha_deg > 0.0 {
                upright
            } else {
                Phase::Idle
            };
            if phase == Phase::Pouring {
                alpha_deg += POURS_DEG_S * STEP_S;
            } else if !(holds.0..holds.1).contains(&at_s) {
                alpha_deg = (alpha_deg - 60.0 * STEP_S).max(0.0);
            }
            container.step(STEP_S, alpha_deg);
            for (begins_s, name, what, lasts_s) in faults.iter().filter(|(begins_s, ..)| (begins_s - at_s).abs() < STEP_S / 2.0) {
                let kind = KINDS[named(name).unwrap()];
                costs.begins((kind, what), phase, true, (*begins_s, container.poured_ml(), begins_s + lasts_s));
            }
            if phase == Phase::Idle {
                costs.ended(reason, false);
            }
            let target = (phase == Phase::Pouring).then_some((alpha_deg, POURS_DEG_S));
            let now = Moment { container: &container, alpha_deg, target, lag_s: 0.012, return_deg_s: 60.0, at_s };
            if let Some(wrong) = costs.settle(phase, &now) {
                return Some(wrong);
            }
        }
        None
    }

    const NEVER: (f64, f64) = (0.0, 0.0);

    fn cut(at_s: f64) -> (f64, &'static str, What, f64) {
        (at_s, "link-cut", What::LinkCut, 0.0)
    }

    /// Protects the bound from whatever else happens: a cut link ends a pour within its time, whether a spike, which bounds nothing, came before it, or an
    /// abort, which was obeyed at once, a second later.
    #[test]
    fn the_earliest_fault_that_must_end_a_pour_binds() {
        let spike = (0.2, "eye-spike", What::Eye(EyeFault::Spike(500.0)), 0.0);
        let abort = (2.0, "abort", What::Abort, 0.0);
        assert_eq!(wrong(&[spike.clone(), cut(1.0)], 1.1, EndReason::RobotLost, NEVER), None, "a prompt way upright");
        assert!(wrong(&[spike, cut(1.0)], 2.0, EndReason::RobotLost, NEVER).is_some_and(|wrong| wrong.contains("link-cut")));
        assert!(wrong(&[cut(1.0), abort.clone()], 2.04, EndReason::Aborted, NEVER).is_some_and(|wrong| wrong.contains("link-cut")));
        assert_eq!(wrong(&[abort], 2.04, EndReason::Aborted, NEVER), None);
    }

    /// Protects the bound from what comes on the way upright: only what holds the arm excuses what leaves then, and not what had left before it; what the way
    /// waits for excuses its own bound.
    #[test]
    fn what_holds_the_arm_excuses_what_leaves_from_then_on() {
        let on_way = |at_s, name, what| [cut(1.0), (at_s, name, What::Robot(what), 9.0)];
        let held = on_way(1.16, "safeguard-stop", Fault::SafeguardOpen);
        assert_eq!(wrong(&held, 1.1, EndReason::SafetyStop, (1.16, 5.0)), None);
        let late = on_way(2.0, "safeguard-stop", Fault::SafeguardOpen);
        assert!(wrong(&late, 1.96, EndReason::SafetyStop, (2.0, 5.0)).is_some());
        let lost = on_way(4.0, "safeguard-stop", Fault::SafeguardOpen);
        let lost = wrong_in(&mut Costs::default(), Phase::NoRobot, &lost, 3.96, EndReason::RobotLost, (4.0, 7.0));
        assert!(lost.is_some_and(|wrong| wrong.contains("link-cut")), "what left while the robot was lost is not excused");
        let stalled = on_way(1.16, "stall", Fault::Stall(0.2));
        assert_eq!(wrong(&stalled, 1.1, EndReason::RobotLost, (1.16, 1.4)), None);
        assert!(wrong(&stalled, 1.1, EndReason::RobotLost, (1.16, 4.0)).is_some(), "a stall does not hold the arm for 3 s");
    }

    /// Protects the next pour from what began in the one before: who stands in the robot's way still excuses there.
    #[test]
    fn what_holds_the_arm_excuses_in_the_next_pour_too() {
        let stop = (0.2, "safeguard-stop", What::Robot(Fault::SafeguardOpen), 60.0);
        let mut costs = Costs::default();
        assert!(wrong_in(&mut costs, Phase::Returning, &[cut(1.0)], 2.0, EndReason::RobotLost, NEVER).is_some(), "nothing held before");
        wrong_in(&mut costs, Phase::Returning, &[stop], 0.3, EndReason::SafetyStop, NEVER);
        assert_eq!(wrong_in(&mut costs, Phase::Returning, &[cut(1.0)], 2.0, EndReason::RobotLost, NEVER), None);
    }

    /// Protects from held faults that need not end a pour: one explains an end only if it can be its reason, and a goal that is reached needs none.
    #[test]
    fn a_fault_explains_only_an_end_that_it_can_cause() {
        let late = (0.2, "overrun", What::Overrun(63), 0.063);
        let lost = (0.2, "eye-loss", What::Eye(EyeFault::Loss(4)), 0.13);
        let doubled = (0.3, "eye-duplicate", What::Eye(EyeFault::Duplicate(9)), 0.3);
        assert_eq!(wrong(std::slice::from_ref(&late), 2.0, EndReason::Done, NEVER), None);
        assert!(
            wrong(&[late.clone(), doubled], 2.0, EndReason::ControllerOverrun, NEVER).is_some_and(|wrong| !wrong.contains("duplicate"))
        );
        assert!(wrong(&[late, lost], 2.0, EndReason::ControllerOverrun, NEVER).is_some_and(|wrong| !wrong.contains("eye-loss")));
    }
}
