//! Whether the pictures of a video come at one rate, by the times from one to the next.
//!
//! Pure; called once for a file, on the thread that reads it. Sorts what it is given in memory of its own, and nothing fails.

/// Periods between two pictures from which on one is missing where all periods are the same. Half way to the second.
pub(super) const GAP_PERIODS: f64 = 1.5;
/// Steps that differ by no more are the same, ms. Chosen by hand: many files have times in whole ms, and a telephone whose rate varies scatters by more.
const SAME_MS: f64 = 1.25;
/// Share of steps that are the same from which on a file has one rate. Chosen by hand: more gaps than every fifth step are a rate that varies.
const MOST: f64 = 0.8;
/// Long steps in a row, all the same, that are a slower rate and no gaps. Chosen by hand: a telephone in dim light goes on so for seconds, and damage
/// leaves gaps one by one.
const SLOWER: u64 = 4;

/// The rhythm of a file.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rhythm {
    /// The usual time from one picture to the next, ms.
    pub usual_ms: f64,
    /// Whether it is always the same, so that a step which is longer is a gap.
    pub fixed: bool,
    /// Number of steps, and of those that are longer than [`GAP_PERIODS`] usual ones.
    pub steps: u64,
    pub long: u64,
}

impl Rhythm {
    /// The rhythm of `steps`, in their order: how many there are one after the other, and how long each is, ms. `None` if there is none that is longer than 0.
    pub(super) fn of(steps: &[(u64, f64)]) -> Option<Self> {
        let mut sorted: Vec<(u64, f64)> = steps.iter().copied().filter(|(count, ms)| *count > 0 && *ms > 0.0 && ms.is_finite()).collect();
        sorted.sort_by(|a, b| a.1.total_cmp(&b.1));
        // The steps that are the same as each, in a window that moves along the sorted ones: of the most common one, their number and the sum of their times.
        let (mut from, mut to, mut number, mut sum_ms) = (0, 0, 0, 0.0);
        let mut most = (0, 0.0);
        for (_, at) in &sorted {
            while let Some((count, ms)) = sorted.get(to).filter(|(_, ms)| *ms <= at + SAME_MS) {
                (to, number, sum_ms) = (to + 1, number + count, sum_ms + *count as f64 * ms);
            }
            while sorted[from].1 < at - SAME_MS {
                let (count, ms) = sorted[from];
                (from, number, sum_ms) = (from + 1, number - count, sum_ms - count as f64 * ms);
            }
            if number > most.0 {
                most = (number, sum_ms);
            }
        }
        let usual_ms = (most.0 > 0).then(|| most.1 / most.0 as f64)?;
        let number: u64 = sorted.iter().map(|(count, _)| count).sum();
        let (mut long, mut run, mut slower, mut last_ms) = (0, 0, false, 0.0);
        for (count, ms) in steps {
            let is_long = *ms > GAP_PERIODS * usual_ms;
            long += if is_long { *count } else { 0 };
            run = if !is_long {
                0
            } else if (ms - last_ms).abs() <= SAME_MS {
                run + count
            } else {
                *count
            };
            (slower, last_ms) = (slower || run >= SLOWER, *ms);
        }
        Some(Self { usual_ms, fixed: !slower && most.0 as f64 >= MOST * number as f64, steps: number, long })
    }

    /// The time from picture to picture where it is always the same, ms.
    pub(super) fn period_ms(&self) -> Option<f64> {
        self.fixed.then_some(self.usual_ms)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects gaps from being taken for a rate that varies, and telephones, whose rate does vary, from a refusal.
    #[test]
    fn one_rate_is_told_from_one_that_varies() {
        let fixed = |steps: &[(u64, f64)]| Rhythm::of(steps).and_then(|rhythm| rhythm.period_ms().map(|ms| (ms * 10.0).round() / 10.0));
        let whole_ms: Vec<(u64, f64)> = (0..90u32).map(|i| (1, f64::from((i + 1) * 100 / 3 - i * 100 / 3))).collect();
        assert_eq!(fixed(&whole_ms), Some(33.3));
        // Holes of one, two and three pictures, also in the first step, and as an index of an MP4 has them.
        assert_eq!(fixed(&[&[(1, 66.7)][..], &whole_ms[..40], &[(1, 100.0), (1, 133.3)], &whole_ms[..40]].concat()), Some(33.3));
        assert_eq!(fixed(&[(700, 40.0), (1, 80.0), (300, 40.0)]), Some(40.0));
        // A telephone that scatters, one that is slower for a while, and a rate that changes for good.
        let scatters: Vec<(u64, f64)> =
            (0..90u32).map(|i| (1, 33.3 + 4.0 * f64::from(i * 7 % 11) / 11.0 + if i % 20 == 7 { 33.3 } else { 0.0 })).collect();
        assert_eq!((fixed(&scatters), Rhythm::of(&scatters).map(|rhythm| rhythm.long)), (None, Some(5)));
        assert_eq!(fixed(&[(900, 33.3), (30, 66.7), (300, 33.3)]), None);
        assert_eq!(fixed(&[(10, 66.7), (14, 200.0)]), None);
        assert_eq!((Rhythm::of(&[]), Rhythm::of(&[(3, 0.0), (1, f64::NAN)])), (None, None));
    }
}
