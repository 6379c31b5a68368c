//! What the cell is doing, in words, and what to do when it may not move.
//!
//! Pure functions of what is known; they allocate and do not fail.

use shared::control::{RobotLink, volume_words};
use shared::messages::Phase;

use crate::cell::Live;

/// What a person sees first.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Words {
    /// What the cell is doing.
    pub doing: String,
    /// What to do about it; empty if nothing needs to be done.
    pub remedy: String,
    /// A short word for what it is: `ready`, `moving`, `waiting`, `lost`.
    pub kind: &'static str,
    /// Whether the robot waits until somebody takes it back.
    pub may_resume: bool,
}

fn words(kind: &'static str, doing: impl Into<String>, remedy: impl Into<String>) -> Words {
    Words { doing: doing.into(), remedy: remedy.into(), kind, may_resume: false }
}

/// What the cell is doing.
pub fn of(live: &Live) -> Words {
    let Some(phase) = live.phase() else {
        let remedy =
            if live.no_status.is_empty() { "Is `rt-controller run` running with the same --config, as the same user?" } else { "" };
        return words("lost", "The controller does not answer", if remedy.is_empty() { sentence(&live.no_status) } else { remedy.into() });
    };
    let Some(point) = live.points.back() else { return words("lost", "The controller does not answer", "") };
    let hindrance = live.status.as_ref().map_or_else(|| live.no_status.clone(), |s| s.hindrance.clone());
    let poured = volume_words(point.poured_ml, point.poured_sd_ml);
    // A curve has no goal, and nobody counts what it pours.
    let counted = if point.goal_ml.is_finite() { format!(": {poured} ml poured") } else { String::new() };
    match phase {
        Phase::Pouring => words("moving", format!("Pouring {} ml: {poured} poured", point.goal_ml), ""),
        Phase::Recording => words("moving", format!("Recording a curve: at {:.0} degrees", point.alpha_deg), ""),
        Phase::Returning => words("moving", format!("Coming upright{counted}"), ""),
        Phase::Settling => words(
            "moving",
            if counted.is_empty() {
                "Upright, waiting for the last drops".into()
            } else {
                format!("Upright, counting the last drops{counted}")
            },
            "",
        ),
        Phase::Idle if live.status.as_ref().is_some_and(|s| s.hindrance.is_empty()) => words("ready", "Ready to pour", ""),
        Phase::Idle if live.status.as_ref().is_some_and(|s| s.may_record) => {
            words("waiting", "Ready to record, but not to pour", sentence(&hindrance))
        }
        Phase::Idle => words("waiting", "Not ready", sentence(&hindrance)),
        Phase::NoRobot => {
            let waits = live.status.as_ref().is_some_and(|s| s.robot == RobotLink::WaitsForOperator);
            let remedy = if hindrance.is_empty() { "Waiting for the robot.".into() } else { sentence(&hindrance) };
            Words { may_resume: waits, ..words("waiting", "The robot may not move", remedy) }
        }
    }
}

/// A line as a sentence.
fn sentence(line: &str) -> String {
    let mut letters = line.chars();
    let first: String = letters.next().map(|c| c.to_uppercase().collect()).unwrap_or_default();
    let end = if line.ends_with(['.', '?', '!']) || line.is_empty() { "" } else { "." };
    format!("{first}{}{end}", letters.as_str())
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;
    use crate::wire::Point;

    fn live(phase: Phase, age_s: u64) -> Live {
        let point = Point {
            tick: 1,
            at_ns: 1,
            phase: phase as u32,
            episode: 3,
            alpha_deg: 40.0,
            alpha_measured_deg: 39.0,
            area_px2: 900.0,
            d_ml: 46.0,
            goal_ml: 110.0,
            poured_ml: 64.0,
            poured_sd_ml: 1.8,
            doubt: 0,
        };
        let at = Instant::now().checked_sub(std::time::Duration::from_secs(age_s));
        let mut live = Live::default();
        live.points.push_back(point);
        (live.points_at, live.no_status) = (at, "no answer".into());
        live
    }

    /// Protects whoever looks from across the room: what is poured is said with its deviation, and an old tick is not taken for the present.
    #[test]
    fn the_first_line_says_what_is_going_on() {
        assert_eq!(of(&live(Phase::Pouring, 0)).doing, "Pouring 110 ml: 64.0 +- 1.8 poured");
        let mut small = live(Phase::Pouring, 0);
        small.points[0].goal_ml = 12.5;
        assert_eq!(of(&small).doing, "Pouring 12.5 ml: 64.0 +- 1.8 poured", "a goal is not rounded");
        let mut curve = live(Phase::Returning, 0);
        (curve.points[0].goal_ml, curve.points[0].poured_ml) = (f32::NAN, 0.0);
        assert_eq!(of(&curve).doing, "Coming upright", "what a curve pours is not counted, and not said to be nothing");
        curve.points[0].phase = Phase::Settling as u32;
        assert_eq!(of(&curve).doing, "Upright, waiting for the last drops");
        let old = of(&live(Phase::Pouring, 5));
        assert_eq!((old.kind, old.remedy.as_str()), ("lost", "No answer."));
        assert_eq!(of(&Live::default()).kind, "lost");
    }
}
