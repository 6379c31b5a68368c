//! Percentiles of a measurement. Pure, any thread; allocates; cannot fail.

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
