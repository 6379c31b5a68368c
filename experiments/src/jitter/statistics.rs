//! Percentiles of a measurement, and its histograms for the page. Pure, any thread; allocates; cannot fail.

use trainer::report::page;
use trainer::report::plot::{PlotSeries, plot};

/// Steps of a histogram; one more holds what is beyond.
const STEPS: usize = 60;

/// Number, p50, p99, p99.9 and maximum of the values; percentiles are ranks, and NaN without values.
pub fn summary(values: &[f64]) -> [f64; 5] {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let at = |share: f64| sorted.get(((sorted.len() as f64 * share).ceil() as usize).saturating_sub(1)).copied().unwrap_or(f64::NAN);
    [sorted.len() as f64, at(0.5), at(0.99), at(0.999), at(1.0)]
}

/// The median; NaN without values.
pub fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_by(f64::total_cmp);
    match sorted.len() {
        0 => f64::NAN,
        n if n % 2 == 1 => sorted[n / 2],
        n => (sorted[n / 2 - 1] + sorted[n / 2]) / 2.0,
    }
}

/// A figure with the histogram of each series of values, up to the largest of their 99.9th percentiles.
pub fn histograms(title: &str, caption: &str, columns: &[(&str, &Vec<f64>)]) -> String {
    let end = columns.iter().map(|(_, v)| summary(v)[3]).filter(|x| x.is_finite()).fold(1e-3, f64::max) * 1.05;
    let width = end / STEPS as f64;
    let series: Vec<PlotSeries> = columns
        .iter()
        .map(|(name, values)| {
            let mut counts = [0.0; STEPS + 1];
            for v in values.iter() {
                counts[((v / width) as usize).min(STEPS)] += 100.0 / values.len() as f64;
            }
            let steps = counts.iter().enumerate().flat_map(|(k, c)| [(k as f64 * width, *c), ((k + 1) as f64 * width, *c)]);
            PlotSeries::line(name, steps.collect())
        })
        .collect();
    page::figure(&plot(title, "% of n", &series, true), caption)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects every figure: ranks, not interpolations.
    #[test]
    fn percentiles_are_ranks() {
        let values: Vec<f64> = (1..=1000).rev().map(f64::from).collect();
        assert_eq!(summary(&values), [1000.0, 500.0, 990.0, 999.0, 1000.0]);
        assert_eq!(median([3.0, 1.0, 2.0].into_iter()), 2.0);
    }
}
