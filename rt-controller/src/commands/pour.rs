//! `rt-controller pour ML`: asks the running controller for a pour, shows its progress, and ends with its result. It is a short,
//! ordinary process, and every failure is one line.

use shared::config::{CellConfig, Config};
use shared::control::{EndReason, Outcome, Reply, Request};
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::os;
use shared::plural::counted;
use shared::weights::Weights;

use super::resume;
use crate::client::{self, Client, ClientError, Common};
use crate::core::{Settings, goal_is_legal};
use crate::foreseen::{self, Expected, WARNED_SD_ML};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  rt-controller pour 75\n  rt-controller pour 120 --json\n  rt-controller pour 120 --fill 300\n\n\
Ctrl-C aborts the pour: the container comes upright.\n\
Exit codes: 0 poured, 3 no controller, 4 ended early (the reason is printed), 5 refused, 130 interrupted.")]
pub struct Args {
    /// Goal volume V_G in ml, each of which is a g on the scale: of a liquid that is not as dense as water, give the weight in g.
    goal_ml: f32,
    /// What is in the vessel at least, ml: a pour in which nothing flows where this would flow ends at once. Without it, [container]
    /// least_fill_ml counts, if it is given.
    #[arg(long)]
    fill: Option<f64>,
    #[command(flatten)]
    common: Common,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.common.config).or_exit(exit::BAD_INPUT)?;
    if args.fill.is_some_and(|ml| !ml.is_finite()) {
        return Err(failure(exit::BAD_INPUT, "--fill: this is no volume: give what is in the vessel at least, in ml"));
    }
    if args.fill.is_some_and(|ml| ml < f64::from(args.goal_ml)) {
        let what = "--fill: there is less in the vessel than is to be poured: fill it, or give a smaller goal";
        return Err(failure(exit::BAD_INPUT, what));
    }
    // What cannot be poured is refused before a robot is taken from somebody for it.
    goal_is_legal(args.goal_ml, &Settings::new(&config)).or_exit(exit::REFUSED)?;
    let mut foreseen = Foreseen::of(&config, args)?;
    if resume::take_back_if_it_waits(&Client::connect_or_end(&config.cell)?)? {
        // That may have taken a while, in which the controller may have taken other weights: what is foreseen is of those that pour.
        foreseen = Foreseen::of(&config, args)?;
    }
    for line in foreseen.lines(args.goal_ml) {
        eprintln!("{line}");
    }
    let request = Request::Pour { goal_ml: args.goal_ml, flows_by_deg: foreseen.flows_by_deg };
    let ended = order(&config.cell, &request)?;
    report(&ended, foreseen.expected.and_then(Expected::sd_ml), args.common.json);
    ended.as_result()
}

/// What is known of a pour before it starts.
struct Foreseen {
    /// How far off it will be; `None` if the controller has other weights than lie in the configured file.
    expected: Option<Expected>,
    /// The tilt by which it must flow, degrees, if the fill is known.
    flows_by_deg: Option<f32>,
    /// What may leave before it is noticed that the camera sees nothing, ml, if no tilt bounds it.
    unseen_ml: Option<f64>,
    /// What there is to say where weights know no vessel, or are not known here.
    unbounded_line: Option<&'static str>,
    /// How many episodes the weights were learned from, if they are few.
    few_episodes: Option<u32>,
    /// What there is to say of the pictures that the weights were trained on.
    pictures_line: Option<&'static str>,
}

impl Foreseen {
    /// Foresees the pour with the weights that the running controller has.
    fn of(config: &Config, args: &Args) -> Result<Self, Failure> {
        let status = Client::connect_or_end(&config.cell)?.status()?;
        let weights = Weights::read(&config.controller.weights).ok().filter(|w| w.identity() == status.weights);
        let foreseen = Self::with(weights.as_ref(), config, args.goal_ml, args.fill);
        if args.fill.is_some() && weights.is_none() {
            let what = "--fill: controller.weights is not the file that the controller has taken, so what is in the vessel cannot be used: leave it out";
            return Err(failure(exit::BAD_INPUT, what));
        }
        if args.fill.is_some() && foreseen.flows_by_deg.is_none() {
            let what = "--fill: the controller's weights do not say by which tilt this fill flows: give what really is in the vessel, or train \
                        with --estimate fused";
            return Err(failure(exit::BAD_INPUT, what));
        }
        Ok(foreseen)
    }

    /// Foresees a pour of `goal_ml` with the controller's weights, if they are known, and `fill_ml` in the vessel, if that is told.
    fn with(weights: Option<&Weights>, config: &Config, goal_ml: f32, fill_ml: Option<f64>) -> Self {
        let container = config.container;
        let flows_by_deg = weights.and_then(|w| foreseen::must_flow_by_deg(w, fill_ml, container.least_fill_ml, container.holds_ml));
        Self {
            expected: weights.map(|w| foreseen::expected(w, &Settings::new(config), goal_ml)),
            flows_by_deg,
            unbounded_line: foreseen::unbounded_line(weights, container.least_fill_ml),
            unseen_ml: weights.and_then(|w| foreseen::unseen_ml(w, config.limits, flows_by_deg)),
            few_episodes: weights.and_then(foreseen::few_episodes),
            pictures_line: weights.and_then(foreseen::pictures_line),
        }
    }

    /// All that is said before the pour.
    fn lines(&self, goal_ml: f32) -> impl Iterator<Item = String> {
        self.line(goal_ml)
            .into_iter()
            .chain(self.unseen_line())
            .chain(self.unbounded_line.map(|line| format!("warning: {line}")))
            .chain(self.few_episodes.map(|n| {
                format!("warning: the weights were learned from few weighed episodes ({n}): this pour may be off by far more than they say; weigh it, and refine")
            }))
            .chain(self.pictures_line.map(str::to_owned))
    }

    /// What a camera that sees no stream at all could cost, where no tilt bounds it.
    fn unseen_line(&self) -> Option<String> {
        self.unseen_ml.map(|ml| match self.flows_by_deg {
            Some(_) => format!(
                "note: what is said to be in the vessel need not flow before the largest tilt, so if the camera sees no stream at all, up to {ml:.0} ml \
                 leave before that is noticed"
            ),
            None => format!(
                "note: nobody said how much is in the vessel, so if the camera sees no stream at all, up to {ml:.0} ml leave before that is \
                 noticed: give --fill, or [container] least_fill_ml"
            ),
        })
    }

    /// What the operator should know before the pour; `None` if all is well.
    fn line(&self, goal_ml: f32) -> Option<String> {
        let note = match self.expected {
            Some(Expected::Within(sd_ml)) => {
                return (sd_ml > WARNED_SD_ML).then(|| {
                    format!("warning: a pour of {goal_ml:.0} ml is expected to be off by {sd_ml:.1} ml (standard deviation); `trainer plan` says what to weigh")
                });
            }
            None => "note: controller.weights is not the file that the controller has taken, so it is not said how far off this will be",
            Some(Expected::TooMuch) => {
                "note: the vessel, as the weights know it, cannot give this goal from a usual fill: the pour may end early"
            }
            Some(Expected::TooLong) => {
                "note: this pour is expected to take more than controller.max_frames, and then ends short of its goal"
            }
            Some(Expected::Short(ml)) => {
                return Some(format!(
                    "warning: the network is expected to stop {ml:.0} ml short of this goal: train again, or give another goal"
                ));
            }
            Some(Expected::Unknown) => "note: the weights do not say how far off this pour will be",
        };
        Some(note.into())
    }
}

/// A pour or recording that has ended.
pub(crate) struct Ended {
    pub(crate) outcome: Outcome,
    /// What the recorder says, if there is one.
    pub(crate) recorded: Option<client::Recorded>,
    /// Whether somebody has pressed Ctrl-C.
    interrupted: bool,
}

impl Ended {
    /// Fails unless the pour or recording ended with `Done`, and nobody interrupted it.
    pub(crate) fn as_result(&self) -> Result<(), Failure> {
        match self.outcome.reason {
            _ if self.interrupted => Err(failure(exit::INTERRUPTED, interrupted_line(&self.outcome))),
            EndReason::Done => Ok(()),
            reason => Err(failure(exit::ENDED_EARLY, format!("ended early: {}", reason.words()))),
        }
    }
}

/// The failure of an order that nobody answers any more. Whether it goes on is not known then, so it is stopped by the way that needs no shared memory.
fn unanswered(client: &Client, e: ClientError) -> Failure {
    let what = match e {
        ClientError::NoAnswer { .. } if client.abort_by_socket() => format!("{e} The robot may move, so it was asked to stop: look at it"),
        ClientError::NoAnswer { .. } => format!("{e} Nobody answers at its stop socket either: look at the robot"),
        e => e.to_string(),
    };
    failure(exit::UNREACHABLE, what)
}

/// Gives an order that moves the container, follows it to its end, and waits for the recorder's report, if there is a recorder.
pub(crate) fn order(cell: &CellConfig, request: &Request) -> Result<Ended, Failure> {
    let client = Client::connect_or_end(cell)?;
    resume::take_back_if_it_waits(&client)?;
    let recorder = client::RecorderReports::open(cell).ok();
    // From here on Ctrl-C must stop what is ordered. If this fails, it ends this command, and the pour goes on.
    let interrupted = os::stop_at_signals().unwrap_or_default();
    let episode = match client.ask(request).map_err(|e| unanswered(&client, e))? {
        Reply::Started { episode } => episode,
        Reply::Refused { reason } => return Err(failure(exit::REFUSED, reason)),
        _ => return Err(failure(exit::UNREACHABLE, client::ClientError::Version)),
    };
    let (outcome, interrupted) = client.follow(episode, &interrupted).map_err(|e| unanswered(&client, e))?;
    Ok(Ended { outcome, recorded: recorder.and_then(|r| r.wait(episode)), interrupted })
}

/// What Ctrl-C has led to. A robot or a camera that was lost on the way upright leaves a pour aborted too, and not all is known then; where all was seen,
/// the container came upright.
fn interrupted_line(outcome: &Outcome) -> String {
    let words = outcome.reason.words();
    match outcome.reason {
        _ if !outcome.unwatched => format!("interrupted: {words}, the container is upright"),
        EndReason::NotUpright => format!("interrupted: {words}"),
        _ => format!("interrupted: {words}; the container or the camera could not be watched to the end: look at the robot"),
    }
}

/// Prints how the pour ended.
fn report(Ended { outcome, recorded, .. }: &Ended, foreseen_sd_ml: Option<f32>, json: bool) {
    if json {
        let file = recorded.as_ref().and_then(|r| r.file.as_ref().ok());
        let unsure = outcome.is_unsure();
        println!("{}", serde_json::json!({ "outcome": outcome, "unsure": unsure, "episode_file": file, "foreseen_sd_ml": foreseen_sd_ml }));
    } else {
        println!(
            "{}: {} ml poured (estimate) for a goal of {:.1} ml in {:.1} s; {} ({} bridged), {} between ticks, {}",
            outcome.words(),
            outcome.poured_words(),
            outcome.goal_ml.unwrap_or(f32::NAN),
            outcome.seconds,
            counted(outcome.frames, "frame"),
            outcome.bridged_frames,
            counted(outcome.tick_gaps, "gap"),
            counted(outcome.stale_features, "stale feature")
        );
        if outcome.unseen && !outcome.unwatched {
            // Of a pour without a stream nothing was counted.
            let why = if outcome.poured_ml > 0.0 {
                "a part of the stream left the region: enlarge [image] region_px"
            } else {
                "no stream was seen, so it is not known that there was none"
            };
            println!("{why}");
        }
        match recorded.as_ref().map(|r| &r.file) {
            Some(Ok(file)) => println!("recorded: {file}\nread the scale, then: feature-worker episodes weigh {file} --weight GRAMS"),
            Some(Err(e)) => println!("not recorded: {e}"),
            None => println!("not recorded: no recorder answered"),
        }
    }
}

#[cfg(test)]
mod tests {
    use shared::limits::Clipped;
    use shared::weights::Estimator;

    use super::*;

    /// Protects whoever asks for more than the vessel can give: that is said, and not that the weights know nothing of how far off a pour will be.
    #[test]
    fn a_goal_that_the_vessel_cannot_give_is_named() {
        let config = Config::read(&std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap();
        let line = |weights: &Weights, goal_ml| Foreseen::with(Some(weights), &config, goal_ml, None).line(goal_ml).unwrap_or_default();
        let fused = foreseen::tests::weights();
        let sum = Weights { estimator: Estimator::Sum, ..fused.clone() };
        assert!(!line(&fused, 30.0).contains("note"), "{}", line(&fused, 30.0));
        assert!(line(&fused, 2000.0).contains("cannot give this goal"), "{}", line(&fused, 2000.0));
        assert!(line(&sum, 2000.0).contains("the weights do not say how far off"), "{}", line(&sum, 2000.0));
        // A pour of nothing leaves no deviation, and the vessel can give it.
        assert!(line(&fused, 0.0).contains("the weights do not say how far off"), "{}", line(&fused, 0.0));
        assert!(Foreseen::with(None, &config, 30.0, None).line(30.0).unwrap().contains("is not the file that the controller has taken"));
    }

    /// Protects a pour from weights of tables that do not say their pictures: nothing can be compared, and that is said; of others it is not.
    #[test]
    fn weights_that_do_not_know_their_pictures_are_named() {
        let config = Config::read(&std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap();
        let mut weights = foreseen::tests::weights();
        let named = |weights: &Weights| {
            let foreseen = Foreseen::with(Some(weights), &config, 30.0, None);
            foreseen.lines(30.0).any(|line| line.starts_with("note: the weights do not say on which pictures they were trained"))
        };
        assert!(!named(&weights), "weights by hand");
        weights.origin.episodes = 5;
        assert!(named(&weights));
        weights.origin.framing = shared::framing::Framing::new(&config.camera, &config.image);
        assert!(!named(&weights));
    }

    /// Protects whoever takes a small deviation at its word: weights from few weighed episodes hardly know their own, and that is said, as on the page.
    #[test]
    fn weights_from_few_episodes_are_named() {
        let config = Config::read(&std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap();
        let mut weights = foreseen::tests::weights();
        for (episodes, few) in [(0, false), (1, true), (4, true), (5, false)] {
            weights.origin.episodes = episodes;
            let said = Foreseen::with(Some(&weights), &config, 30.0, None).lines(30.0).any(|line| line.contains("few weighed episodes"));
            assert_eq!(said, few, "{episodes} episodes");
        }
    }

    /// Protects whoever pressed Ctrl-C at a robot: it is said to be upright only where that is known.
    #[test]
    fn upright_is_said_only_where_it_is_known() {
        let line = |reason: EndReason, unwatched: bool| {
            interrupted_line(&Outcome {
                episode: 1,
                reason,
                // A stream that left the region says nothing of the container.
                unseen: true,
                unwatched,
                goal_ml: Some(50.0),
                poured_ml: 20.0,
                poured_sd_ml: 0.0,
                seconds: 3.0,
                frames: 90,
                bridged_frames: 0,
                stale_features: 0,
                tick_gaps: 0,
                clipped: Clipped::default(),
            })
        };
        for (reason, unwatched, upright) in [
            (EndReason::Aborted, false, true),
            (EndReason::Done, false, true),
            (EndReason::MaxFrames, false, true),
            (EndReason::Aborted, true, false),
            (EndReason::NotUpright, true, false),
        ] {
            let said = line(reason, unwatched);
            assert_eq!((said.contains("is upright"), said.contains("look at the robot")), (upright, !upright), "{said}");
        }
    }
}
