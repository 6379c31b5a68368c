//! The statistics that LeRobot wants of each column and of the images, for each episode and for the whole data set. Pure arithmetic;
//! allocates. Every number is finite: of no values at all, all are 0.

use opencv::core::{self, Mat, MatTraitConstManual, Vector};
use serde_json::{Value, json};

/// The quantiles that LeRobot wants, with their names in its files.
const QUANTILES: [(&str, f64); 5] = [("q01", 0.01), ("q10", 0.1), ("q50", 0.5), ("q90", 0.9), ("q99", 0.99)];
/// Names of all numbers of a [`Summary`] but its count, in the order of [`Summary::numbers`].
pub const NUMBERS: [&str; 9] = ["min", "max", "mean", "std", "q01", "q10", "q50", "q90", "q99"];
/// Levels of a colour.
const LEVELS: usize = 256;

/// What is said about one number over all rows.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Summary {
    /// Least, greatest, mean, standard deviation and the quantiles, named [`NUMBERS`].
    pub numbers: [f64; 9],
    /// How many rows, or images, it is made of.
    pub count: u64,
}

impl Summary {
    /// Of `values`, which are finite. A quantile between two values is interpolated, as numpy does.
    pub fn of(values: impl Iterator<Item = f64>) -> Self {
        let mut values: Vec<f64> = values.collect();
        values.sort_by(f64::total_cmp);
        let [Some(min), Some(max)] = [values.first().copied(), values.last().copied()] else { return Self::default() };
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let std = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
        let quantile = |share: f64| {
            let place = share * (n - 1.0);
            let [below, above] = [place.floor(), place.ceil()].map(|p| values.get(p as usize).copied().unwrap_or(max));
            below + (above - below) * place.fract()
        };
        let [q01, q10, q50, q90, q99] = QUANTILES.map(|(_, share)| quantile(share));
        Self { numbers: [min, max, mean, std, q01, q10, q50, q90, q99], count: values.len() as u64 }
    }

    /// Of the pixels of `images` images, of which `counts` have each level; levels become 0 to 1.
    fn of_levels(counts: &[u64; LEVELS], images: u64) -> Self {
        let total: u64 = counts.iter().sum();
        if total == 0 {
            return Self::default();
        }
        let value = |level: usize| level as f64 / (LEVELS - 1) as f64;
        let weighted =
            |of: &dyn Fn(f64) -> f64| counts.iter().enumerate().map(|(l, n)| *n as f64 * of(value(l))).sum::<f64>() / total as f64;
        let mean = weighted(&|v| v);
        let std = weighted(&|v| (v - mean).powi(2)).sqrt();
        // The first level at or below which so many pixels lie.
        let quantile = |share: f64| {
            let mut below = 0;
            let level = counts.iter().position(|n| {
                below += n;
                below as f64 >= share * total as f64 && below > 0
            });
            value(level.unwrap_or(LEVELS - 1))
        };
        let max = value(counts.iter().rposition(|n| *n > 0).unwrap_or(0));
        let [q01, q10, q50, q90, q99] = QUANTILES.map(|(_, share)| quantile(share));
        Self { numbers: [quantile(0.0), max, mean, std, q01, q10, q50, q90, q99], count: images }
    }

    /// The statistics of a column with `all.len()` numbers a row.
    pub fn json(all: &[Self]) -> Value {
        let mut map = serde_json::Map::new();
        for (i, name) in NUMBERS.into_iter().enumerate() {
            map.insert(name.into(), json!(all.iter().map(|s| s.numbers[i]).collect::<Vec<_>>()));
        }
        map.insert("count".into(), json!([all.first().map_or(0, |s| s.count)]));
        map.into()
    }

    /// The statistics of the images' channels, in the shape that LeRobot has for images: each channel is one row of one column.
    pub fn image_json(all: &[Self]) -> Value {
        let mut map = serde_json::Map::new();
        for (i, name) in NUMBERS.into_iter().enumerate() {
            map.insert(name.into(), json!(all.iter().map(|s| [[s.numbers[i]]]).collect::<Vec<_>>()));
        }
        map.insert("count".into(), json!([all.first().map_or(0, |s| s.count)]));
        map.into()
    }
}

/// How many pixels of some images have each level of red, green and blue.
#[derive(Clone)]
pub struct ImageLevels {
    counts: [[u64; LEVELS]; 3],
    images: u64,
}

impl ImageLevels {
    /// Before the first image.
    pub fn new() -> Self {
        Self { counts: [[0; LEVELS]; 3], images: 0 }
    }

    /// Counts all pixels of a picture, in OpenCV's order blue, green, red.
    pub fn add(&mut self, picture: &Mat) -> opencv::Result<()> {
        let mut planes: Vector<Mat> = Vector::new();
        core::split(picture, &mut planes)?;
        for (counts, plane) in self.counts.iter_mut().rev().zip(planes) {
            for level in plane.data_bytes()? {
                counts[usize::from(*level)] += 1;
            }
        }
        self.images += 1;
        Ok(())
    }

    /// Adds the images of `other`.
    pub fn join(&mut self, other: &Self) {
        for (counts, more) in self.counts.iter_mut().flatten().zip(other.counts.iter().flatten()) {
            *counts += more;
        }
        self.images += other.images;
    }

    /// The statistics of red, green and blue.
    pub fn summaries(&self) -> Vec<Summary> {
        self.counts.iter().map(|counts| Summary::of_levels(counts, self.images)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects training elsewhere: the numbers are those of numpy, for values and for levels.
    #[test]
    fn quantiles_are_numpys() {
        let s = Summary::of((0..=100).rev().map(f64::from));
        assert_eq!(s.count, 101);
        for (got, want) in s.numbers.iter().zip([0.0, 100.0, 50.0, 29.154_759_474_226_5, 1.0, 10.0, 50.0, 90.0, 99.0]) {
            assert!((got - want).abs() < 1e-9, "{got} {want}");
        }
        assert_eq!(Summary::of([3.0, 5.0].into_iter()).numbers[6], 4.0);
        assert_eq!(Summary::of(std::iter::empty()), Summary::default());
        let mut counts = [0; LEVELS];
        (counts[51], counts[255]) = (90, 10);
        let s = Summary::of_levels(&counts, 2);
        for (got, want) in s.numbers.iter().zip([0.2, 1.0, 0.28, 0.24, 0.2, 0.2, 0.2, 0.2, 1.0]) {
            assert!((got - want).abs() < 1e-9, "{got} {want}");
        }
    }
}
