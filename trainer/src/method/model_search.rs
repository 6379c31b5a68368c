//! Method `best`: a flow model fitted to the episodes, a control law searched in it, and the law distilled into the network.
//!
//! This is not REINFORCE: the model is fitted offline, and the policy is searched in that model.
//!
//! Pure functions of the offline trainer, which allocate and do not fail; the same episodes, options and seed give the same weights on any
//! number of threads.

use shared::actions::Selection;
use shared::estimator::flow::WayBack;
use shared::limits::Limits;
use shared::mlp::{InputScale, Mlp};
use shared::weights::{Estimator, Method, Origin, Weights};

use super::control_law::{self, ControlLaw, SearchSize};
use super::distillation::{self, Distillation};
use super::model_pour::PossiblePours;
use crate::allowed_actions::Actions;
use crate::calibration;
use crate::data::{self, TrainingEpisode};
use crate::fit::{self, Fit};
use crate::training::{Estimate, Options, Progress, Trained};

/// The size of the search. It is so small that a training takes seconds (docs/LEARNING.md, speed). The PD that the policy is compared
/// with is searched in the same way.
pub const SEARCH: SearchSize = SearchSize { population: 16, pours: 32, iterations: 6, elites: 4 };
/// The size of the distillation, chosen for the same reason.
const DISTILLATION: distillation::Size = distillation::Size { rounds: 3, pours: 96, steps: 500, batch: 256 };

/// Fit, calibration and estimator of `episodes`, the part that training and evaluation share.
pub fn estimator(episodes: &[TrainingEpisode], estimate: Estimate, limits: &Limits) -> (Fit, Estimator) {
    let mut fit = fit::fit(episodes);
    let estimator = match estimate {
        Estimate::Sum => {
            fit.calibration = calibration::calibrate(episodes, None);
            Estimator::Sum
        }
        Estimate::Fused => Estimator::Fused { model: fit.fused, back: WayBack::new(limits, data::rate_hz(episodes)) },
    };
    (fit, estimator)
}

/// Trains on usable episodes.
pub fn train(episodes: &[TrainingEpisode], options: &Options, progress: &dyn Progress) -> Trained {
    progress.stage("fitting the flow model", 1);
    let (fit, estimator) = estimator(episodes, options.estimate, &options.limits);
    let rate_hz = data::rate_hz(episodes);
    let pours = PossiblePours::new(&fit, options.limits, rate_hz, options.estimate == Estimate::Fused);
    progress.stage("searching the control law", SEARCH.iterations as u64);
    let (law, search_curve) = control_law::search(&pours, ControlLaw::start(pours.fused), SEARCH, options.seed, |k, cost| {
        progress.at(k as u64 + 1, &format!("cost {cost:.3}"));
    });
    let distillation =
        Distillation { pours: &pours, law: &law, actions: Actions::new(options.actions), scale: InputScale::default(), size: DISTILLATION };
    progress.stage("teaching the network", DISTILLATION.total_steps() as u64);
    let (network, loss) = distillation.run(options.seed, |k, loss| progress.at(k as u64, &format!("loss {loss:.3}")));
    let weights = Weights {
        network: network.to_mlp().unwrap_or(Mlp::ZERO),
        actions_deg: distillation.actions.angles_deg,
        selection: Selection::Argmax,
        scale: distillation.scale,
        calibration: fit.calibration,
        estimator,
        rate_hz: rate_hz as f32,
        origin: Origin {
            method: Method::Best,
            actions: options.actions,
            episodes: episodes.len() as u32,
            data_sha256: data::hash(episodes),
            framing: data::framing(episodes),
        },
        seed: options.seed,
    };
    Trained { weights, fit: Some(fit), law: Some(law), search_curve, loss }
}
