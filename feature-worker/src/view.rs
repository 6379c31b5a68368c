//! Shows the live stream with what is measured, in a local web page.

use std::process::ExitCode;

use opencv::core::{Mat, Point, Rect, Scalar, Vector};
use opencv::imgproc;

use crate::extract::{Extractor, Measurement};
use shared::messages::Doubt;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
pub struct Args {}

/// Runs the command; the exit codes are those of [`shared::exit`].
pub fn run(_args: &Args) -> ExitCode {
    shared::exit::fail(shared::exit::FAILED, "not built yet")
}

fn colour(blue: u8, green: u8, red: u8) -> Scalar {
    Scalar::new(blue.into(), green.into(), red.into(), 0.0)
}

fn point([x, y]: [f32; 2]) -> Point {
    // Four binary digits behind the point.
    Point::new((x * 16.0).round() as i32, (y * 16.0).round() as i32)
}

/// Draws what `extractor` has just measured into the BGR picture `image`: region (grey), axes (red and green, as in Fig. 4),
/// outline of the liquid (white), edge points and line (yellow), triangle and numbers.
pub fn draw(image: &mut Mat, extractor: &Extractor, measured: &Measurement) -> Result<(), opencv::Error> {
    let (line, aa) = (imgproc::LINE_8, imgproc::LINE_AA);
    imgproc::rectangle(image, extractor.region(), colour(160, 160, 160), 1, line, 0)?;
    let axes = extractor.axes();
    let region = extractor.region();
    let reach = (region.width + region.height) as f32 * 0.4;
    for (axis, shade) in [(axes.x, colour(40, 40, 255)), (axes.y, colour(40, 220, 40))] {
        let end = |d: f32| point([axes.lip_px[0] + d * axis[0], axes.lip_px[1] + d * axis[1]]);
        imgproc::line(image, end(0.0), end(reach), shade, 1, aa, 4)?;
    }
    let outline: Vector<Point> = extractor.outline_px().map(point).collect();
    if !outline.is_empty() {
        imgproc::polylines(image, &outline, false, colour(255, 255, 255), 1, aa, 4)?;
    }
    let yellow = colour(0, 255, 255);
    for p in extractor.edge_points_px() {
        imgproc::circle(image, point(p), 24, yellow, imgproc::FILLED, aa, 4)?;
    }
    if measured.area_px2 > 0.0 {
        let [x0, y0, x1, y1, x2, y2] = measured.triangle_px;
        imgproc::line(image, point([x1, y1]), point([x2, y2]), yellow, 2, aa, 4)?;
        for corner in [[x1, y1], [x2, y2]] {
            imgproc::line(image, point([x0, y0]), point(corner), yellow, 1, aa, 4)?;
        }
    }
    let doubt = if measured.doubt == Doubt::None { String::new() } else { format!("  {}", measured.doubt.words()) };
    let text = format!("V_e {:.0} px^2  confidence {:.2}{doubt}", measured.area_px2, measured.confidence);
    caption(image, &text, 0)
}

/// One line of text over a dark bar at the picture's foot, `line` lines above the lowest.
pub fn caption(image: &mut Mat, text: &str, line: i32) -> Result<(), opencv::Error> {
    use opencv::prelude::MatTraitConst;
    let (width, height) = (image.cols(), image.rows());
    let top = height - 20 * (line + 1);
    imgproc::rectangle(image, Rect::new(0, top, width, 20), colour(20, 20, 20), imgproc::FILLED, imgproc::LINE_8, 0)?;
    let font = imgproc::FONT_HERSHEY_SIMPLEX;
    imgproc::put_text(image, text, Point::new(6, top + 14), font, 0.45, colour(235, 235, 235), 1, imgproc::LINE_AA, false)
}
