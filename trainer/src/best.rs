//! Method `best`: flow model, law search in it, distilled into the network. Not REINFORCE: a model fitted offline, and policy
//! search in that model.
//!
//! Offline, pure, allocates; the same episodes, options and seed give the same weights on any number of threads.

use shared::actions::Selection;
use shared::limits::Limits;
use shared::mlp::{InputScale, Mlp};
use shared::weights::{Estimator, Method, Origin, Weights};

use crate::calibrate;
use crate::data::{self, TrainingEpisode};
use crate::distill;
use crate::fit::{self, Fit};
use crate::law::{self, Law, Search, Worlds};
use crate::train::{Estimate, Options, Progress, Trained, actions_table};

/// The size of the search that is used, chosen so that a training takes seconds.
/// Also used for the PD that the policy is compared with.
pub const SEARCH: Search = Search { population: 16, pours: 32, iterations: 6, elites: 4 };
const DISTIL: distill::Size = distill::Size { rounds: 3, pours: 96, steps: 500, batch: 256 };

/// Fit, calibration and estimator of `episodes`, the part that `refine` and evaluation share.
pub fn estimator(episodes: &[TrainingEpisode], estimate: Estimate, limits: &Limits) -> (Fit, Estimator) {
    let mut fit = fit::fit(episodes);
    let estimator = match estimate {
        Estimate::Sum => {
            fit.calibration = calibrate::fit(episodes, None);
            Estimator::Sum
        }
        Estimate::Fused => {
            let rate_hz = episodes.first().map_or(30.0, |e| e.rate_hz);
            Estimator::Fused { model: fit.model, back: shared::estimate::flow::Return::new(limits, rate_hz) }
        }
    };
    (fit, estimator)
}

/// Trains on usable episodes.
pub fn train(episodes: &[TrainingEpisode], options: &Options, progress: &dyn Progress) -> Trained {
    progress.stage("fitting the flow model", 1);
    let (fit, estimator) = estimator(episodes, options.estimate, &options.limits);
    let rate_hz = episodes.first().map_or(30.0, |e| e.rate_hz);
    let worlds = Worlds::new(&fit, options.limits, rate_hz, options.estimate == Estimate::Fused);
    progress.stage("searching the control law", SEARCH.iterations as u64);
    let (law, search_curve): (Law, Vec<f64>) = law::search(&worlds, Law::start(worlds.fused), SEARCH, options.seed, |k, cost| {
        progress.at(k as u64 + 1, &format!("cost {cost:.3}"))
    });
    let scale = InputScale::default();
    let table = actions_table(options.actions);
    progress.stage("teaching the network", (DISTIL.steps * (DISTIL.rounds + 1)) as u64);
    let (net, loss) = distill::distil(&worlds, &law, &table, options.actions, &scale, DISTIL, options.seed, |k, loss| {
        progress.at(k as u64, &format!("loss {loss:.3}"));
    });
    let weights = Weights {
        network: net.to_mlp().unwrap_or(Mlp::ZERO),
        actions_deg: table,
        selection: Selection::Argmax,
        scale,
        calibration: fit.calibration,
        estimator,
        rate_hz: rate_hz as f32,
        origin: Origin {
            method: Method::Best,
            actions: options.actions,
            episodes: episodes.len() as u32,
            data_sha256: data::hash(episodes),
        },
        seed: options.seed,
    };
    Trained { weights, fit: Some(fit), law: Some(law), search_curve, loss }
}
