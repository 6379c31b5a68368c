//! The errors of one method over many pours. Pure; allocates; cannot fail.

use std::collections::BTreeMap;

use serde::Serialize;

use shared::control::EndReason;

use crate::bench::pour::PourResult;

/// The errors of one method, ml.
#[derive(Debug, Clone, Serialize)]
pub struct Summary {
    /// Name of the method, or of the weight file.
    pub name: String,
    /// Number of pours.
    pub n: usize,
    /// Mean absolute error, ml.
    pub mae_ml: f64,
    /// Half the width of its 95 % interval over rigs and seeds, ml.
    pub mae_ci_ml: f64,
    /// Median absolute error, ml.
    pub median_ml: f64,
    /// 95th percentile of the absolute error, ml.
    pub p95_ml: f64,
    /// Largest absolute error, ml.
    pub max_ml: f64,
    /// Mean error, ml: above 0 too much was poured.
    pub bias_ml: f64,
    /// Share of the pours within 5 ml of the goal.
    pub within_5_ml: f64,
    /// Share of the pours within 5 % of the goal.
    pub within_5_percent: f64,
    /// Number of pours in which nothing was poured.
    pub never_poured: usize,
    /// Number of pours that never came to an end by themselves.
    pub never_stopped: usize,
    /// Number of pours that were ended because of a camera that was right.
    pub falsely_ended: usize,
    /// Share of the pours whose error of measurement is within the standard deviation that the controller gives; NaN if it gives none.
    pub covered: f64,
    /// How many pours ended for each reason, in the order of their names.
    pub endings: BTreeMap<String, usize>,
    /// Of the pours that ended as done: the largest difference of what had left from what was said, ml.
    pub done_off_ml: f64,
    /// Of these, the share whose difference is more than three of the standard deviations that were said.
    pub done_beyond_3_sds: f64,
    /// The most that has left beyond the goal in any pour, ml.
    pub beyond_goal_ml: f64,
    /// Mean absolute error of measurement, ml.
    pub measurement_ml: f64,
    /// The same of the camera's plain sum over the same pours, ml; NaN without one.
    pub sum_ml: f64,
    /// Share of the pours whose plain sum is nearer to the truth than the estimate.
    pub sum_nearer: f64,
    /// Mean absolute error of control, ml.
    pub control_ml: f64,
    /// Mean duration of a pour, s.
    pub seconds: f64,
    /// Mean absolute error of each rig and seed, in order, ml.
    pub groups_ml: Vec<f64>,
}

/// Mean of group means, and half the width of its 95 % interval; that is NaN for fewer than two groups.
pub fn mean_ci(groups: &[f64]) -> (f64, f64) {
    let n = groups.len().max(1) as f64;
    let mean = groups.iter().sum::<f64>() / n;
    if groups.len() < 2 {
        return (mean, f64::NAN);
    }
    let variance = groups.iter().map(|g| (g - mean).powi(2)).sum::<f64>() / (n - 1.0);
    (mean, 1.96 * (variance / n).sqrt())
}

/// How many pours ended for each reason.
fn endings(pours: &[&PourResult]) -> BTreeMap<String, usize> {
    let mut endings = BTreeMap::new();
    for reason in pours.iter().filter_map(|p| p.reason) {
        let name = serde_json::to_value(reason).ok().and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default();
        *endings.entry(name).or_insert(0) += 1;
    }
    endings
}

impl Summary {
    /// The summary of groups (one for each rig and seed) of pours.
    pub fn new(name: &str, groups: &[Vec<PourResult>]) -> Self {
        let pours: Vec<&PourResult> = groups.iter().flatten().collect();
        let n = pours.len().max(1) as f64;
        let mean = |f: &dyn Fn(&PourResult) -> f64| pours.iter().map(|p| f(p)).sum::<f64>() / n;
        let mut errors: Vec<f64> = pours.iter().map(|p| p.error_ml().abs()).collect();
        errors.sort_by(f64::total_cmp);
        let quantile = |q: f64| errors.get(((q * n).ceil() as usize).clamp(1, errors.len().max(1)) - 1).copied().unwrap_or(f64::NAN);
        let done: Vec<&PourResult> = pours.iter().filter(|p| p.reason == Some(EndReason::Done)).copied().collect();
        let groups_ml: Vec<f64> =
            groups.iter().map(|g| g.iter().map(|p| p.error_ml().abs()).sum::<f64>() / g.len().max(1) as f64).collect();
        Self {
            name: name.into(),
            n: pours.len(),
            mae_ml: mean(&|p| p.error_ml().abs()),
            mae_ci_ml: mean_ci(&groups_ml).1,
            median_ml: quantile(0.5),
            p95_ml: quantile(0.95),
            max_ml: errors.last().copied().unwrap_or(f64::NAN),
            bias_ml: mean(&PourResult::error_ml),
            within_5_ml: mean(&|p| f64::from(p.error_ml().abs() <= 5.0)),
            within_5_percent: mean(&|p| f64::from(p.error_ml().abs() <= 0.05 * p.goal_ml)),
            never_poured: pours.iter().filter(|p| p.never_poured()).count(),
            never_stopped: pours.iter().filter(|p| p.never_stopped()).count(),
            falsely_ended: pours.iter().filter(|p| p.falsely_ended).count(),
            covered: {
                let covered: Vec<bool> = pours.iter().filter_map(|p| p.covered()).collect();
                covered.iter().filter(|c| **c).count() as f64 / covered.len() as f64
            },
            endings: endings(&pours),
            done_off_ml: done.iter().map(|p| p.measurement_ml().abs()).fold(0.0, f64::max),
            done_beyond_3_sds: done.iter().filter(|p| p.measurement_ml().abs() > 3.0 * p.believed_sd_ml).count() as f64 / done.len() as f64,
            beyond_goal_ml: pours.iter().map(|p| p.error_ml()).fold(f64::NEG_INFINITY, f64::max),
            measurement_ml: mean(&|p| p.measurement_ml().abs()),
            sum_ml: mean(&|p| p.sum_ml().abs()),
            sum_nearer: mean(&|p| f64::from(p.sum_ml().abs() < p.measurement_ml().abs())),
            control_ml: mean(&|p| p.control_ml().abs()),
            seconds: mean(&|p| p.seconds),
            groups_ml,
        }
    }

    /// Heading of [`Summary::line`].
    pub fn heading() -> String {
        format!(
            "{:<16} {:>6} {:>14} {:>7} {:>7} {:>7} {:>7} {:>7} {:>7} {:>6} {:>6} {:>6} {:>8} {:>8} {:>8} {:>6}",
            "method",
            "n",
            "MAE +- 95 %",
            "median",
            "p95",
            "max",
            "bias",
            "<=5 ml",
            "<=5 %",
            "fails",
            "false",
            "cover",
            "measure",
            "sum",
            "control",
            "s"
        )
    }

    /// How the pours ended, and how far what was said of those that were done is off.
    pub fn endings_line(&self) -> String {
        let endings: Vec<String> = self.endings.iter().map(|(reason, n)| format!("{reason} {n}")).collect();
        format!(
            "  {}: {}; said of the done ones: off by at most {:.1} ml, {:.1} % beyond 3 sd; at most {:.1} ml beyond a goal",
            self.name,
            endings.join(", "),
            self.done_off_ml,
            100.0 * self.done_beyond_3_sds,
            self.beyond_goal_ml
        )
    }

    /// The row of the table.
    pub fn line(&self) -> String {
        format!(
            "{:<16} {:>6} {:>7.2} +- {:>3.2} {:>7.2} {:>7.2} {:>7.2} {:>7.2} {:>6.1}% {:>6.1}% {:>6} {:>6} {:>5.0}% {:>8.2} {:>8.2} {:>8.2} {:>6.1}",
            self.name,
            self.n,
            self.mae_ml,
            self.mae_ci_ml,
            self.median_ml,
            self.p95_ml,
            self.max_ml,
            self.bias_ml,
            100.0 * self.within_5_ml,
            100.0 * self.within_5_percent,
            self.never_poured + self.never_stopped,
            self.falsely_ended,
            100.0 * self.covered,
            self.measurement_ml,
            self.sum_ml,
            self.control_ml,
            self.seconds
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the report's numbers: mean, percentile, bias, failures and interval of known pours.
    #[test]
    fn summaries_count_right() {
        let one = |error: f64, ended: bool| PourResult {
            believed_sd_ml: 4.0,
            reason: Some(if ended { EndReason::Done } else { EndReason::ImpossibleFlow }),
            falsely_ended: !ended,
            init_ml: 300.0,
            goal_ml: 100.0,
            true_ml: 100.0 + error,
            believed_ml: 100.0,
            summed_ml: 101.0,
            seconds: 5.0,
            frames: 150,
            ended,
        };
        let s = Summary::new("x", &[vec![one(1.0, true), one(-3.0, true)], vec![one(6.0, false), one(-100.0, true)]]);
        assert_eq!((s.mae_ml, s.bias_ml, s.max_ml, s.median_ml), (27.5, -24.0, 100.0, 3.0));
        assert_eq!((s.never_poured, s.never_stopped, s.within_5_ml, s.within_5_percent), (1, 1, 0.5, 0.5));
        assert_eq!((s.falsely_ended, s.covered), (1, 0.5));
        assert_eq!((s.endings["done"], s.endings["impossible-flow"]), (3, 1));
        assert_eq!((s.done_off_ml, s.done_beyond_3_sds, s.beyond_goal_ml), (100.0, 1.0 / 3.0, 6.0));
        // The plain sums are off by 0, 4, 5 and 101 ml, the estimates by 1, 3, 6 and 100 ml.
        assert_eq!((s.sum_ml, s.sum_nearer), (27.5, 0.5));
        assert_eq!(s.groups_ml, [2.0, 53.0]);
        assert!((s.mae_ci_ml - 1.96 * 25.5).abs() < 1e-9);
    }
}
