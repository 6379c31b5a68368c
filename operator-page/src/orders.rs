//! What a page may order: pour, record, take the robot back, weigh. Motion is ordered through the controller's own requests, and nothing else.
//!
//! The page's answering threads run it; it allocates and may wait seconds for the controller. Every refusal is a line for the operator.

use std::time::{Duration, Instant};

use rt_controller::core::Settings;
use rt_controller::foreseen::{self, Expected, WARNED_SD_ML};
use serde_json::{Value, json};
use shared::control::{Reply, Request, RobotLink};
use shared::episode::set_weight;
use shared::gaussian_curve::Curve;
use shared::messages::Phase;
use shared::weights::{Origin, Weights};

use crate::site::{Site, moves};

/// How long the robot may take to be connected: as `rt-controller resume`.
const CONNECTED: Duration = Duration::from_secs(15);
/// Pause between two looks at the cell. Chosen by hand; no measurement is recorded.
const BEAT: Duration = Duration::from_millis(50);
/// Weighed pours that were off by more than this many expected deviations show that the weights' own deviation is too small. Chosen by hand: by
/// chance it is so in one of twenty pours.
const BEYOND_SD: f64 = 2.0;
/// Least time after which the link's state is one from after a request: it asks twice a second.
const FRESH: Duration = Duration::from_millis(1200);

/// What is known of a pour before it starts.
pub struct Foreseen {
    /// Whether it may be ordered.
    pub possible: bool,
    /// The deviation with which it is expected to end, ml, if the weights tell.
    pub sd_ml: Option<f32>,
    /// The tilt by which it must flow, degrees, if the fill is known.
    pub flows_by_deg: Option<f32>,
    /// What the operator should know, a line each.
    pub lines: Vec<String>,
    /// The weights of which this is said; empty before they are known.
    pub identity: String,
}

impl Foreseen {
    /// As the page takes it.
    pub fn json(&self) -> Value {
        json!({ "possible": self.possible, "sd_ml": self.sd_ml, "flows_by_deg": self.flows_by_deg, "lines": self.lines,
            "identity": self.identity })
    }
}

/// Foresees a pour of `goal_ml`, with `fill_ml` in the vessel if that is known.
pub fn foresee(site: &Site, goal_ml: f32, fill_ml: Option<f64>) -> Foreseen {
    let most = site.config.controller.goal_max_ml;
    let cannot = |line: String| Foreseen { possible: false, sd_ml: None, flows_by_deg: None, lines: vec![line], identity: String::new() };
    if !goal_ml.is_finite() || goal_ml <= 0.0 || goal_ml > most {
        return cannot(format!("The goal must be above 0 and at most {most} ml (controller.goal_max_ml)."));
    }
    let container = site.config.container;
    if fill_ml.is_some_and(|ml| !ml.is_finite() || ml < f64::from(goal_ml)) {
        return cannot("There is less in the vessel than is to be poured: fill it, or give a smaller goal.".into());
    }
    let (phase, status) = {
        let live = site.cell.live();
        (live.phase(), live.status.clone())
    };
    let Some(status) = status.filter(|_| phase.is_some()) else { return cannot("The controller does not answer.".into()) };
    if moves(phase) {
        return cannot("The robot still moves: wait until it stands upright.".into());
    }
    if status.weights.is_empty() {
        return cannot(format!("There are no weights to pour with: record curves, weigh them, and learn. {}", status.weights_refused));
    }
    let mut lines = Vec::new();
    if phase == Some(Phase::NoRobot) {
        if status.robot != RobotLink::WaitsForOperator {
            return cannot(format!("The robot may not move: {}", status.hindrance));
        }
        lines.push(format!("The robot is taken back first. It waited: {}", status.hindrance));
    }
    let weights = Weights::read(&site.config.controller.weights).ok().filter(|w| w.identity() == status.weights);
    let Some(weights) = weights else {
        if fill_ml.is_some() {
            return cannot(
                "The weight file is not the one that the controller has taken, so what is in the vessel cannot be used: leave it out."
                    .into(),
            );
        }
        lines.push("The weight file is not the one that the controller has taken, so it is not said how far off this will be.".into());
        lines.extend(foreseen::unbounded_line(None, container.least_fill_ml).map(str::to_owned));
        return Foreseen { possible: true, sd_ml: None, flows_by_deg: None, lines, identity: status.weights };
    };
    let limits = site.config.limits;
    let expected = foreseen::expected(&weights, &Settings::new(&site.config), goal_ml);
    let sd_ml = expected.sd_ml();
    let flows_by_deg = foreseen::must_flow_by_deg(&weights, fill_ml, container.least_fill_ml, container.holds_ml);
    if fill_ml.is_some() && flows_by_deg.is_none() {
        return cannot("The weights do not say by which tilt this fill flows: say what really is in the vessel, or leave it out.".into());
    }
    if let Some(unseen_ml) = foreseen::unseen_ml(&weights, limits, flows_by_deg) {
        lines.push(match flows_by_deg {
            Some(_) => format!(
                "What is said to be in the vessel need not flow before the largest tilt: if the camera sees no stream at all, up to \
                 {unseen_ml:.0} ml leave before that is noticed."
            ),
            None => format!(
                "It is not known by which tilt it must flow: if the camera sees no stream at all, up to {unseen_ml:.0} ml leave before that is \
                 noticed. Say what is in the vessel."
            ),
        });
    }
    lines.extend(foreseen::unbounded_line(Some(&weights), container.least_fill_ml).map(str::to_owned));
    lines.extend(few(&weights));
    lines.extend(unknown_pictures(&weights.origin));
    lines.extend(sd_ml.and_then(|sd| worse_than_expected(&site.history.errors_ml(&status.weights), sd)));
    lines.extend(expected_line(expected));
    Foreseen { possible: true, sd_ml, flows_by_deg, lines, identity: status.weights }
}

/// What the operator should know of how far off the pour will be; `None` if all is well.
fn expected_line(expected: Expected) -> Option<String> {
    match expected {
        Expected::Within(sd_ml) => (sd_ml > WARNED_SD_ML)
            .then(|| format!("This is far off: weigh what is proposed under Learn first. Expected deviation {sd_ml:.1} ml.")),
        Expected::TooMuch => {
            Some("The vessel, as the weights know it, cannot give this goal from a usual fill: the pour may end early.".into())
        }
        Expected::TooLong => {
            Some("This pour is expected to take longer than it may (controller.max_frames), and then ends short of its goal.".into())
        }
        Expected::Short(ml) => {
            Some(format!("The network is expected to stop {ml:.0} ml short of this goal: learn again, or give another goal."))
        }
        Expected::Unknown => Some("These weights do not say how far off this pour will be.".into()),
    }
}

/// What the operator should know of weights that do not know their pictures.
fn unknown_pictures(origin: &Origin) -> Option<String> {
    origin.pictures_unknown().then(|| {
        "These weights do not say on which pictures they were learned: if the camera stood elsewhere, another volume is poured than is said. Weigh it.".into()
    })
}

/// What the operator should know of weights from few episodes: their deviation cannot be taken at its word.
fn few(weights: &Weights) -> Option<String> {
    foreseen::few_episodes(weights).map(|n| {
        format!(
            "These weights were learned from few weighed episodes ({n}): this pour may be off by far more than they say. Weigh it, and learn again."
        )
    })
}

/// What the weighed pours with the same weights say of the deviation `sd_ml` that is expected of this one.
fn worse_than_expected(errors_ml: &[f64], sd_ml: f32) -> Option<String> {
    let n = errors_ml.len();
    let rms_ml = (errors_ml.iter().map(|e| e * e).sum::<f64>() / n.max(1) as f64).sqrt();
    let worse = n > 0 && rms_ml > BEYOND_SD * f64::from(sd_ml);
    worse.then(|| {
        format!("The weighed pours with these weights ({n}) were off by {rms_ml:.1} ml, more than they expect: learn from them before the next one.")
    })
}

/// Orders a pour, unless somebody has stopped since `stops`, or other weights or lines are foreseen now than the page has `shown`. Gives its
/// number.
pub fn pour(site: &Site, stops: u64, goal_ml: f32, fill_ml: Option<f64>, shown: (&str, &[String])) -> Result<u64, String> {
    let foreseen = foresee(site, goal_ml, fill_ml);
    if !foreseen.possible {
        return Err(foreseen.lines.join(" "));
    }
    as_shown(&foreseen, shown)?;
    if take_back_if_it_waits(site)? {
        // That takes seconds, in which other weights may have come. The line that the robot waited is no longer foreseen.
        as_shown(&Foreseen { lines: foreseen.lines.clone(), ..foresee(site, goal_ml, fill_ml) }, shown)?;
    }
    order(site, stops, Request::Pour { goal_ml, flows_by_deg: foreseen.flows_by_deg })
}

/// Refuses what is foreseen now if a person has confirmed something else.
fn as_shown(foreseen: &Foreseen, (identity, lines): (&str, &[String])) -> Result<(), String> {
    if foreseen.identity == identity && foreseen.lines == lines {
        return Ok(());
    }
    Err("what is foreseen has changed since it was shown, so nothing began: look ahead again".into())
}

/// Orders the curve of eq. (1), unless somebody has stopped since `stops`. Gives its number.
pub fn record(site: &Site, stops: u64, lambda_deg: f32, gamma_per_s2: f32) -> Result<u64, String> {
    let curve = Curve::from_upright(lambda_deg, gamma_per_s2);
    if !curve.beta_s.is_finite() || lambda_deg <= 0.0 || gamma_per_s2 <= 0.0 {
        return Err("The curve's height and width must be above 0: take what is proposed.".into());
    }
    take_back_if_it_waits(site)?;
    order(site, stops, Request::Record(curve))
}

/// Orders a motion. One that was stopped on its way does not begin, and one of which it is not known whether it began is stopped.
fn order(site: &Site, stops: u64, request: Request) -> Result<u64, String> {
    if site.stops() != stops {
        return Err("it was stopped before it began".into());
    }
    let reply = site.cell.ask(request).map_err(|e| {
        // Whether this is obeyed is said by the next Stop; the order itself is dropped when its asker has gone.
        let _ = site.stopper.stop();
        format!("{e} Whether it began is not known, so it was stopped: look at the robot.")
    })?;
    match reply {
        Reply::Started { .. } if site.stops() != stops => {
            site.stopper.stop()?;
            Err("it was stopped as it began".into())
        }
        Reply::Started { episode } => Ok(episode),
        Reply::Refused { reason } => Err(reason),
        _ => Err("the controller is another version of Decant: run the same build on both sides".into()),
    }
}

/// Takes the robot back after a person had it, and waits until it is connected.
pub fn resume(site: &Site) -> Result<(), String> {
    match site.cell.ask(Request::Resume)? {
        Reply::Resuming => {}
        Reply::Refused { reason } => return Err(reason),
        _ => return Err("the controller is another version of Decant: run the same build on both sides".into()),
    }
    let asked = Instant::now();
    loop {
        std::thread::sleep(BEAT);
        let live = site.cell.live();
        let fresh = asked.elapsed() > FRESH;
        let robot = live.status.as_ref().map(|s| s.robot);
        let hindrance = live.status.as_ref().map_or_else(|| live.no_status.clone(), |s| s.hindrance.clone());
        match live.phase() {
            Some(phase) if phase != Phase::NoRobot => return Ok(()),
            _ if fresh && robot == Some(RobotLink::WaitsForOperator) => return Err(hindrance),
            _ if asked.elapsed() > CONNECTED => return Err(hindrance),
            _ => {}
        }
    }
}

/// Takes the robot back if it waits for its operator. Whether it did.
fn take_back_if_it_waits(site: &Site) -> Result<bool, String> {
    let waits = {
        let live = site.cell.live();
        live.phase() == Some(Phase::NoRobot) && live.status.as_ref().is_some_and(|s| s.robot == RobotLink::WaitsForOperator)
    };
    if waits { resume(site).map(|()| true) } else { Ok(false) }
}

/// Writes the scale's reading into an episode of which the page shows the weight `shown_g`. Another weight than that is not replaced.
pub fn weigh(site: &Site, name: &str, grams: f64, shown_g: Option<f64>) -> Result<Value, String> {
    let path = site.history.path(name)?;
    // Two pages that weigh at the same time take turns.
    let _turn = site.history.turn();
    site.history.refresh(name);
    if let Some(has) = site.history.weight_g(name).filter(|has| shown_g != Some(*has)) {
        return Err(format!("{name} has a weight already, {has} g: if yours is to replace it, enter it again"));
    }
    let before = set_weight(&path, grams).map_err(|e| e.to_string())?;
    site.history.refresh(name);
    Ok(json!({ "file": name, "weight_g": grams, "before_g": before }))
}

#[cfg(test)]
mod tests {
    use shared::framing::Framing;
    use shared::weights::Method;

    use super::*;

    /// Protects whoever pours with weights from tables: nothing refuses them in other pictures, so it is said. Weights made by hand saw none.
    #[test]
    fn weights_that_know_no_pictures_say_so() {
        let of = |episodes, framing| Origin { method: Method::Handmade, actions: 21, episodes, data_sha256: [0; 32], framing };
        let known = Framing { size_px: [640, 480], ..Framing::default() };
        assert!(unknown_pictures(&of(5, Framing::default())).is_some());
        assert_eq!([unknown_pictures(&of(5, known)), unknown_pictures(&of(0, Framing::default()))], [None, None]);
    }

    /// Protects whoever believes a small deviation: where the scale has shown more, it is said; where it has not, nothing is.
    #[test]
    fn the_scale_is_believed_before_the_weights() {
        assert!(worse_than_expected(&[-6.1], 1.2).unwrap().contains("6.1 ml"));
        assert!(worse_than_expected(&[-6.0, 5.0, 0.5], 1.2).unwrap().contains("(3)"));
        assert_eq!(worse_than_expected(&[-2.0, 1.0], 1.2), None);
        assert_eq!(worse_than_expected(&[], 0.0), None);
    }

    /// Protects whoever has confirmed a pour that the page had foreseen: if other weights have come meanwhile, or something else is to be known of it,
    /// nothing begins.
    #[test]
    fn what_is_confirmed_is_what_was_shown() {
        let lines = vec!["The robot is taken back first.".to_string()];
        let now = Foreseen { possible: true, sd_ml: None, flows_by_deg: None, lines: lines.clone(), identity: "new".into() };
        assert_eq!(as_shown(&now, ("new", &lines)), Ok(()));
        assert!(as_shown(&now, ("old", &lines)).unwrap_err().contains("look ahead again"));
        assert!(as_shown(&now, ("new", &[])).is_err());
    }
}
