//! Chooses pictures of one pour in which the scene differs, and weighs pictures so that each pose counts alike.
//!
//! A container stands upright for most of a clip. In a plain mean over all pictures the background of that one pose would then stay as sharp
//! as the container. It is used by calibration only, on the command's thread; it allocates. The only failures are OpenCV's.

use opencv::core::{CV_32F, CV_32FC3, Mat, Scalar, Size};
use opencv::prelude::*;
use opencv::{core, imgproc};

/// Size of the small pictures that are compared, px. Chosen by hand: noise is averaged away, and a background that turns is still seen.
const SMALL: [i32; 2] = [40, 30];
/// The most poses. Chosen by hand: the background of each is then a twentieth of the mean.
const MOST: usize = 24;
/// Mean difference of two small pictures below which they are the same pose, grey levels. Chosen by hand: noise of 8 grey levels gives 0.4,
/// a chess board that turns by a degree about 2.
const LEAST_DIFFERENCE: f64 = 1.0;
/// Grey level to which small pictures are scaled, so that exposure makes no pose. Chosen by hand: the middle.
const LEVEL: f64 = 128.0;

/// The poses among the pictures of a pour.
pub struct Poses {
    /// Index of the picture that stands for each pose, at least one.
    pub chosen: Vec<usize>,
    /// Weight of each picture; those of one pose have the sum 1.
    weights: Vec<f64>,
    /// The pose of each picture.
    pose_of: Vec<usize>,
}

impl Poses {
    /// The poses among `pictures` (BGR, one size, at least one picture).
    pub fn choose(pictures: &[Mat]) -> opencv::Result<Self> {
        let small: Vec<Mat> = pictures.iter().map(small).collect::<opencv::Result<_>>()?;
        let mut chosen = vec![0];
        // Distance of each picture from the nearest pose, and that pose.
        let mut nearest = vec![(f64::INFINITY, 0); small.len()];
        loop {
            let newest = chosen.len() - 1;
            for (picture, nearest) in small.iter().zip(&mut nearest) {
                let sum = core::norm2(picture, &small[chosen[newest]], core::NORM_L1, &core::no_array())?;
                let distance = sum / f64::from(SMALL[0] * SMALL[1]);
                if distance < nearest.0 {
                    *nearest = (distance, newest);
                }
            }
            let furthest = nearest.iter().enumerate().max_by(|(_, a), (_, b)| a.0.total_cmp(&b.0));
            match furthest {
                Some((index, (distance, _))) if *distance > LEAST_DIFFERENCE && chosen.len() < MOST => chosen.push(index),
                _ => break,
            }
        }
        let mut sizes = vec![0usize; chosen.len()];
        nearest.iter().for_each(|(_, pose)| sizes[*pose] += 1);
        let weights = nearest.iter().map(|(_, pose)| 1.0 / sizes[*pose] as f64).collect();
        let pose_of = nearest.iter().map(|(_, pose)| *pose).collect();
        Ok(Self { chosen, weights, pose_of })
    }

    /// Indices of at most `most` pictures of each pose, evenly spread, in their order.
    pub fn balanced(&self, most: usize) -> Vec<usize> {
        let mut taken = Vec::new();
        for pose in 0..self.chosen.len() {
            let all: Vec<usize> = (0..self.pose_of.len()).filter(|i| self.pose_of[*i] == pose).collect();
            let count = all.len().min(most);
            taken.extend((0..count).map(|k| all[k * all.len() / count]));
        }
        taken.sort_unstable();
        taken
    }

    /// The mean of `pictures`, in which each pose counts alike, in 8-bit BGR.
    pub fn mean(&self, pictures: &[Mat]) -> opencv::Result<Mat> {
        let size = pictures.first().map_or(Ok(Size::default()), |p| p.size())?;
        let mut sum = Mat::new_size_with_default(size, CV_32FC3, Scalar::default())?;
        let mut part = Mat::default();
        for (picture, weight) in pictures.iter().zip(&self.weights) {
            picture.convert_to(&mut part, CV_32F, *weight, 0.0)?;
            let mut both = Mat::default();
            core::add(&sum, &part, &mut both, &core::no_array(), -1)?;
            sum = both;
        }
        let mut mean = Mat::default();
        sum.convert_to(&mut mean, core::CV_8U, 1.0 / self.chosen.len() as f64, 0.0)?;
        Ok(mean)
    }
}

/// A small grey picture of a mean level.
fn small(picture: &Mat) -> opencv::Result<Mat> {
    let (mut grey, mut small, mut level) = (Mat::default(), Mat::default(), Mat::default());
    imgproc::cvt_color_def(picture, &mut grey, imgproc::COLOR_BGR2GRAY)?;
    imgproc::resize(&grey, &mut small, Size::new(SMALL[0], SMALL[1]), 0.0, 0.0, imgproc::INTER_AREA)?;
    let mean = core::mean(&small, &core::no_array())?[0].max(1.0);
    small.convert_to(&mut level, CV_32F, LEVEL / mean, 0.0)?;
    Ok(level)
}
