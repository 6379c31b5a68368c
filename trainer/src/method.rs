//! The training methods: usable episodes in, weights out.
//!
//! | method | file |
//! |---|---|
//! | `best` | [`model_search`]: [`control_law`] searched in pours of [`model_pour`], then [`distillation`] into the network |
//! | `literal`, `literal-clipped`, `paper`, `cloning` | [`policy_gradient`], eq. (5) to (8) |
//!
//! Pure functions of the offline trainer, which allocate; the only failure is a lack of episodes. The same episodes, options and seed give
//! the same weights on any number of threads.

pub mod control_law;
pub mod distillation;
pub mod model_pour;
pub mod model_search;
pub mod policy_gradient;

use crate::data::{DataError, TrainingEpisode};
use crate::training::{MethodName, Options, Progress, Trained};

/// Trains on usable episodes; an error if there are none.
pub fn train(episodes: &[TrainingEpisode], options: &Options, progress: &dyn Progress) -> Result<Trained, DataError> {
    if episodes.is_empty() {
        return Err(DataError::TooFew { found: 0, method: format!("{:?}", options.method).to_lowercase(), needed: 1 });
    }
    Ok(match options.method {
        MethodName::Best => model_search::train(episodes, options, progress),
        _ => policy_gradient::train(episodes, options, progress),
    })
}
