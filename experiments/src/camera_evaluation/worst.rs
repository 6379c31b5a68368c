//! The worst frames, kept for a person to look at: what was seen and the truth are drawn on them. Any thread; allocates.

use std::path::Path;

use feature_worker::drawing;
use opencv::core::{Mat, Point, Scalar, Vec3b, Vector};
use opencv::prelude::*;
use opencv::{imgcodecs, imgproc};
use simulator::camera::Scene;

use super::cases::Case;
use super::measure::MeasuredFrame;
use crate::camera_setup::CameraError;

/// Worst frames that are kept: as many as a person looks through.
const KEPT: usize = 20;

/// A frame that is kept.
struct Kept {
    badness: f64,
    name: String,
    picture: Mat,
}

/// The worst frames so far, the worst one first.
#[derive(Default)]
pub struct Worst(Vec<Kept>);

impl Worst {
    /// Keeps a frame if it is among the worst.
    ///
    /// # Errors
    /// OpenCV's, when its picture cannot be drawn.
    pub fn add(&mut self, method: &str, case: &Case, frame: &MeasuredFrame, scene: &Scene) -> Result<(), CameraError> {
        let badness = frame.comparison().badness();
        let least = if self.0.len() < KEPT { 0.0 } else { self.0.last().map_or(0.0, |w| w.badness) };
        if badness > least {
            let name = format!("{method}-{}-{:02}", case.seed, frame.number);
            self.0.push(Kept { badness, name, picture: explain(case, frame, scene)? });
            self.0.sort_by(|a, b| b.badness.total_cmp(&a.badness));
            self.0.truncate(KEPT);
        }
        Ok(())
    }

    /// Writes the frames to `directory` as PNG files, in place of those that are there.
    ///
    /// # Errors
    /// One line, when a file cannot be removed or written.
    pub fn save(&self, directory: &Path) -> Result<(), CameraError> {
        let fail = |e: std::io::Error| format!("{}: {e}; give another --out", directory.display());
        std::fs::create_dir_all(directory).map_err(fail)?;
        for entry in std::fs::read_dir(directory).map_err(fail)? {
            let path = entry.map_err(fail)?.path();
            if path.extension().is_some_and(|e| e == "png") {
                std::fs::remove_file(path).map_err(fail)?;
            }
        }
        for (rank, kept) in self.0.iter().enumerate() {
            let path = directory.join(format!("{:02}-{}.png", rank + 1, kept.name));
            imgcodecs::imwrite(&path, &kept.picture, &Vector::new())?;
        }
        Ok(())
    }
}

/// The frame with what was seen (yellow, white) and the truth (magenta) drawn on it, and its conditions below.
fn explain(case: &Case, frame: &MeasuredFrame, scene: &Scene) -> Result<Mat, CameraError> {
    let (rows, columns, truth) = (case.view.height_px as i32, case.view.width_px as i32, frame.truth);
    let mut picture = Mat::new_rows_cols_with_bytes::<Vec3b>(rows, columns, frame.pixels)?.try_clone()?;
    drawing::draw(&mut picture, frame.extractor, frame.measured)?;
    // In sixteenths of a pixel.
    let at = |k: usize| Point::new((truth.triangle_px[k][0] * 16.0) as i32, (truth.triangle_px[k][1] * 16.0) as i32);
    if truth.area_px2 > 0.0 {
        imgproc::line(&mut picture, at(1), at(2), Scalar::new(255.0, 0.0, 255.0, 0.0), 1, imgproc::LINE_AA, 4)?;
    }
    let text = format!("truth {:.0} px^2, alpha {:.0}, {:.1} ml/s", truth.area_px2, scene.alpha_deg, scene.flow_ml_s);
    drawing::caption(&mut picture, &text, 1)?;
    drawing::caption(&mut picture, &case.labels.join(", "), 2)?;
    Ok(picture)
}
