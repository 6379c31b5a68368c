//! The demo without its processes: `trainer plan` proposes each curve or pour, it is weighed, a training follows, and three pours are judged.
//!
//! Any thread, at full speed; allocates. The same arguments give the same numbers. A vessel for which nothing can be proposed, and a training
//! that fails, pour nothing.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use shared::agent::Agent;
use trainer::commands::plan::{PERIOD_NS, propose, wish};
use trainer::data::{TrainingEpisode, UsableEpisodes};
use trainer::teaching::plan::Proposal;
use trainer::training::{Options, Silent, Trained};

use super::trial::Trial;
use crate::demo::plan::Plan;

impl Trial {
    /// What the demo's operator does with this rig's vessel; `None` for simulator a, which has none.
    pub(super) fn demo_plan(&self) -> Option<Plan> {
        self.test.rig().map(|(rig, _)| Plan::for_rig(rig))
    }

    /// Weighs what is proposed, so many times, with a training after each weighing.
    pub(super) fn first_hour(&self, options: &Options, weighings: u64) -> Option<(Trained, Vec<TrainingEpisode>)> {
        let Plan { holds_ml, goal_max_ml, .. } = self.demo_plan()?;
        let wish = wish(&self.limits, PERIOD_NS, goal_max_ml);
        let mut random = Pcg64Mcg::seed_from_u64(self.data_seed ^ 0xd_0000_0000);
        let mut usable = UsableEpisodes::default();
        let mut trained: Option<Trained> = None;
        for n in 0..weighings {
            let found = propose(&usable, Some(holds_ml), &wish).ok()?;
            let episode = match (found.candidates.first()?.next, &trained) {
                (Proposal::Pour { fill_ml, goal_ml }, Some(trained)) => {
                    self.weigh_pour(&Agent::new(&trained.weights), n, (fill_ml, goal_ml), &mut random)
                }
                (Proposal::Pour { .. }, None) => return None,
                (Proposal::Curve { fill_ml, lambda_deg, gamma_per_s2 }, _) => {
                    let sigma_s = (0.5 / gamma_per_s2).sqrt();
                    let seed = random.random();
                    self.bench.record_one(&format!("{}", n + 1), fill_ml, lambda_deg, sigma_s, seed, &mut random)
                }
            };
            if episode.fault().is_none() {
                usable.episodes.push(episode);
                trained = Some(trainer::method::train(&usable.episodes, options, &Silent).ok()?);
            }
        }
        trained.map(|trained| (trained, usable.episodes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pour_evaluation::change::Change;
    use trainer::training::{Estimate, MethodName};

    /// Protects the demo's figures without its processes: what is proposed is weighed in the order of the plan, curves first, and the demo's own
    /// pours are judged.
    #[test]
    fn the_first_hour_follows_the_plan() {
        let trial = Trial::new("b", 1, 0, "cylinder", Change::None);
        let (trained, weighed) = trial.first_hour(&trial.options(MethodName::Best, Estimate::Fused, 21), 3).unwrap();
        assert_eq!(weighed.iter().map(|e| e.name.as_str()).collect::<Vec<_>>(), ["1", "2", "pour 3"]);
        let goals_ml: Vec<f64> = trial.demo_plan().unwrap().pours.iter().map(|pour| pour.goal_ml).collect();
        let pours = trial.judge(&trained.weights, 1, true);
        assert_eq!(pours.iter().map(|p| p.goal_ml).collect::<Vec<_>>(), goals_ml);
        assert!(pours.iter().all(|p| p.error_ml().abs() < 15.0), "{pours:?}");
    }
}
