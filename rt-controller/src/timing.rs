//! Histograms that the loop always keeps of itself.
//!
//! The loop records with two relaxed atomic operations, without allocation or lock; any thread may read. Nothing here fails.

use std::sync::atomic::{AtomicU64, Ordering};

/// Number of bins for each power of two, which makes a bin at most 1/16 of its value wide.
const SUB: u64 = 16;
/// Number of bins, enough for every u64: 16 values below 16, and 16 bins for each of the 60 powers of two from 16 on.
const BINS: usize = (61 * SUB) as usize;

/// Log-linear histogram of nanoseconds: relative bin width at most 6.25 %, exact below 16 ns, exact maximum.
#[derive(Debug)]
pub struct Histogram {
    bins: [AtomicU64; BINS],
    max_ns: AtomicU64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { bins: [const { AtomicU64::new(0) }; BINS], max_ns: AtomicU64::new(0) }
    }
}

/// The bin of a value.
fn bin(value_ns: u64) -> usize {
    if value_ns < SUB {
        return value_ns as usize;
    }
    let shift = u64::from(value_ns.ilog2()) - 4;
    ((shift + 1) * SUB + (value_ns >> shift) - SUB) as usize
}

/// The first value above the bin, ns.
fn upper_edge_ns(bin: usize) -> u64 {
    let bin = bin as u64;
    if bin < SUB {
        return bin + 1;
    }
    let shift = bin / SUB - 1;
    (bin % SUB + SUB + 1).saturating_mul(1 << shift)
}

impl Histogram {
    /// Counts one value.
    pub fn record(&self, value_ns: u64) {
        self.bins[bin(value_ns)].fetch_add(1, Ordering::Relaxed);
        self.max_ns.fetch_max(value_ns, Ordering::Relaxed);
    }

    /// A snapshot for people, in microseconds, under the name `name`. Allocates.
    pub fn snapshot(&self, name: &str) -> shared::control::Histogram {
        let counts: Vec<(usize, u64)> = self.bins.iter().map(|b| b.load(Ordering::Relaxed)).enumerate().filter(|(_, n)| *n > 0).collect();
        let n: u64 = counts.iter().map(|(_, n)| n).sum();
        let max_ns = self.max_ns.load(Ordering::Relaxed);
        let us = |ns: u64| ns as f64 / 1e3;
        let percentile = |share: f64| {
            let rank = (share * n as f64).ceil() as u64;
            let mut seen = 0;
            let found = counts.iter().find(|(_, c)| {
                seen += c;
                seen >= rank
            });
            found.map_or(0.0, |(b, _)| us(upper_edge_ns(*b).min(max_ns)))
        };
        shared::control::Histogram {
            name: name.into(),
            n,
            p50_us: percentile(0.5),
            p99_us: percentile(0.99),
            p999_us: percentile(0.999),
            max_us: us(max_ns),
            bins: counts.iter().map(|(b, c)| (us(upper_edge_ns(*b)), *c)).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects every published percentile: a value lies in its bin, and the bin is narrow.
    #[test]
    fn bins_hold_their_values() {
        for shift in 0..60 {
            for offset in [0u64, 1, 3] {
                let value = (1u64 << shift) + offset * ((1u64 << shift) / 7);
                let (low, high) = (bin(value).checked_sub(1).map_or(0, upper_edge_ns), upper_edge_ns(bin(value)));
                assert!(low <= value && value < high, "{value} not in {low}..{high}");
                assert!(value < 16 || (high - low) as f64 <= value as f64 / 15.9);
            }
        }
        assert!(bin(u64::MAX) < BINS);
    }

    /// Protects the reader from wrong ranks.
    #[test]
    fn percentiles_are_those_of_the_values() {
        let histogram = Histogram::default();
        for value in 1..=1000u64 {
            histogram.record(value * 1000);
        }
        let snapshot = histogram.snapshot("x");
        assert_eq!(snapshot.n, 1000);
        assert!((snapshot.p50_us / 500.0 - 1.0).abs() < 0.07, "{}", snapshot.p50_us);
        assert!((snapshot.p99_us / 990.0 - 1.0).abs() < 0.07);
        assert_eq!(snapshot.max_us, 1000.0);
    }
}
