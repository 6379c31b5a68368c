//! The statistics that LeRobot wants of each column and of the images. Pure arithmetic, but for the decoding of images; allocates.

use opencv::core::{self, Mat, MatTraitConst, MatTraitConstManual, Vector};
use serde_json::{Value, json};
use shared::episode::EpisodeImage;

use crate::episodes::video::decode;

/// Least, greatest, sum and sum of squares of a number over all rows where it is known.
#[derive(Clone, Copy)]
pub struct Moments {
    min: f64,
    max: f64,
    sum: f64,
    squares: f64,
    count: u64,
}

impl Moments {
    /// The moments of no values.
    const EMPTY: Self = Self { min: f64::INFINITY, max: f64::NEG_INFINITY, sum: 0.0, squares: 0.0, count: 0 };

    /// The moments of `values`; values that are not finite are left out.
    pub fn of(values: &mut dyn Iterator<Item = f64>) -> Self {
        values.filter(|v| v.is_finite()).fold(Self::EMPTY, Self::with)
    }

    /// The same numbers with one more value.
    fn with(self, value: f64) -> Self {
        Self {
            min: self.min.min(value),
            max: self.max.max(value),
            sum: self.sum + value,
            squares: self.squares + value * value,
            count: self.count + 1,
        }
    }

    fn mean(&self) -> f64 {
        if self.count == 0 { 0.0 } else { self.sum / self.count as f64 }
    }

    fn std(&self) -> f64 {
        if self.count == 0 { 0.0 } else { (self.squares / self.count as f64 - self.mean().powi(2)).max(0.0).sqrt() }
    }

    /// One of the numbers; 0 when no value was known.
    fn get(&self, number: fn(&Self) -> f64) -> f64 {
        if self.count == 0 { 0.0 } else { number(self) }
    }

    /// The statistics of a column with one number a row.
    pub fn json(&self) -> Value {
        Self::columns(&[*self])
    }

    /// The statistics of a column with several numbers a row.
    pub fn columns(all: &[Self]) -> Value {
        let each = |number: fn(&Self) -> f64| all.iter().map(|m| m.get(number)).collect::<Vec<_>>();
        json!({
            "min": each(|m| m.min),
            "max": each(|m| m.max),
            "mean": each(Self::mean),
            "std": each(Self::std),
            "count": [all.iter().map(|m| m.count).max().unwrap_or(0)],
        })
    }
}

/// Size and colour statistics of the images: red, green and blue from 0 to 1.
pub struct ImageStatistics {
    /// Width of the last image, px.
    pub width_px: i32,
    /// Height of the last image, px.
    pub height_px: i32,
    channels: [Moments; 3],
}

impl ImageStatistics {
    /// The statistics before the first image.
    pub fn new() -> Self {
        Self { width_px: 0, height_px: 0, channels: [Moments::EMPTY; 3] }
    }

    /// Counts all pixels of an image.
    pub fn add(&mut self, image: &EpisodeImage) -> opencv::Result<()> {
        let picture = decode(image)?;
        (self.width_px, self.height_px) = (picture.cols(), picture.rows());
        let mut planes: Vector<Mat> = Vector::new();
        core::split(&picture, &mut planes)?;
        // OpenCV's order is blue, green, red.
        for (channel, plane) in self.channels.iter_mut().rev().zip(planes) {
            *channel = plane.data_bytes()?.iter().fold(*channel, |m, value| m.with(f64::from(*value) / 255.0));
        }
        Ok(())
    }

    /// The statistics in the shape that LeRobot has for images: each channel is one row of one column.
    pub fn json(&self) -> Value {
        let each = |number: fn(&Moments) -> f64| self.channels.iter().map(|m| [[m.get(number)]]).collect::<Vec<_>>();
        let pixels = self.width_px as u64 * self.height_px as u64;
        json!({
            "min": each(|m| m.min),
            "max": each(|m| m.max),
            "mean": each(Moments::mean),
            "std": each(Moments::std),
            "count": [self.channels[0].count.checked_div(pixels).unwrap_or(0)],
        })
    }
}
