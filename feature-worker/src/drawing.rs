//! Pictures for the eye: frames in BGR with what was measured drawn on them, captions, JPEG.
//!
//! Used by `view`, `calibrate`, `inspect` and the experiments, never by the worker. Everything here allocates; the only failures are
//! OpenCV's, and those of the disk where a picture is saved.

use std::path::Path;

use opencv::core::{CV_8UC3, Mat, Point, Rect, Scalar, Vec2b, Vec3b, Vector};
use opencv::prelude::*;
use opencv::{imgcodecs, imgproc};
use shared::messages::{Doubt, PixelFormat};
use shared::whole_file;

use crate::source::Frame;
use crate::vision::{Extractor, Measurement};

/// Binary digits after the point in OpenCV's coordinates. Chosen by hand: sixteenths of a pixel.
const SHIFT: i32 = 4;
/// Height of a line of caption, px. Chosen by hand to fit the font.
const CAPTION_PX: i32 = 20;
/// Quality of JPEG pictures, 0 to 100. Chosen by hand; no measurement is recorded.
const JPEG_QUALITY: i32 = 80;

/// A copy of a frame in BGR, whatever the frame's format is.
pub fn to_bgr(frame: &Frame) -> Result<Mat, opencv::Error> {
    let (rows, columns) = (frame.header.height_px as i32, frame.header.width_px as i32);
    let mut bgr = Mat::default();
    match PixelFormat::from_code(frame.header.format) {
        Some(PixelFormat::Mono8) => {
            imgproc::cvt_color_def(&Mat::new_rows_cols_with_bytes::<u8>(rows, columns, frame.pixels)?, &mut bgr, imgproc::COLOR_GRAY2BGR)?;
        }
        Some(PixelFormat::Yuyv) => {
            let yuyv = Mat::new_rows_cols_with_bytes::<Vec2b>(rows, columns, frame.pixels)?;
            imgproc::cvt_color_def(&yuyv, &mut bgr, imgproc::COLOR_YUV2BGR_YUYV)?;
        }
        _ => Mat::new_rows_cols_with_bytes::<Vec3b>(rows, columns, frame.pixels)?.copy_to(&mut bgr)?,
    }
    Ok(bgr)
}

/// A picture as JPEG; no bytes if the picture is empty.
pub fn jpeg(picture: &Mat) -> Vec<u8> {
    let mut bytes = Vector::new();
    let quality = Vector::from_slice(&[imgcodecs::IMWRITE_JPEG_QUALITY, JPEG_QUALITY]);
    let ok = !picture.empty() && imgcodecs::imencode(".jpg", picture, &mut bytes, &quality).unwrap_or(false);
    if ok { bytes.to_vec() } else { Vec::new() }
}

fn colour(blue: u8, green: u8, red: u8) -> Scalar {
    Scalar::new(blue.into(), green.into(), red.into(), 0.0)
}

/// A place in px as OpenCV takes it with [`SHIFT`].
fn point([x, y]: [f32; 2]) -> Point {
    let fixed = |v: f32| (v * (1 << SHIFT) as f32).round() as i32;
    Point::new(fixed(x), fixed(y))
}

/// Draws what `extractor` has just measured into the BGR picture `image`: the region (grey), the axes (red and green, as in Fig. 4), the
/// outline of the liquid (white), edge points and line (yellow), the triangle and its numbers.
pub fn draw(image: &mut Mat, extractor: &Extractor, measured: &Measurement) -> Result<(), opencv::Error> {
    let (plain, smooth) = (imgproc::LINE_8, imgproc::LINE_AA);
    let region = extractor.region();
    imgproc::rectangle(image, region, colour(160, 160, 160), 1, plain, 0)?;
    let axes = extractor.axes();
    let reach = (region.width + region.height) as f32 * 0.4;
    for (axis, shade) in [(axes.x, colour(40, 40, 255)), (axes.y, colour(40, 220, 40))] {
        let end = |d: f32| point([axes.lip_px[0] + d * axis[0], axes.lip_px[1] + d * axis[1]]);
        imgproc::line(image, end(0.0), end(reach), shade, 1, smooth, SHIFT)?;
    }
    let outline: Vector<Point> = extractor.outline_px().map(point).collect();
    if !outline.is_empty() {
        imgproc::polylines(image, &outline, false, colour(255, 255, 255), 1, smooth, SHIFT)?;
    }
    let yellow = colour(0, 255, 255);
    for p in extractor.edge_points_px() {
        imgproc::circle(image, point(p), 24, yellow, imgproc::FILLED, smooth, SHIFT)?;
    }
    if measured.area_px2 > 0.0 {
        let [x0, y0, x1, y1, x2, y2] = measured.triangle_px;
        imgproc::line(image, point([x1, y1]), point([x2, y2]), yellow, 2, smooth, SHIFT)?;
        for corner in [[x1, y1], [x2, y2]] {
            imgproc::line(image, point([x0, y0]), point(corner), yellow, 1, smooth, SHIFT)?;
        }
    }
    let doubt = if measured.doubt == Doubt::None { String::new() } else { format!("  {}", measured.doubt.words()) };
    let text = format!("V_e {:.0} px^2  confidence {:.2}{doubt}", measured.area_px2, measured.confidence);
    caption(image, &text, 0)
}

/// Writes one line of text over a dark bar at the picture's foot, `line` lines above the lowest.
pub fn caption(image: &mut Mat, text: &str, line: i32) -> Result<(), opencv::Error> {
    let (width, height) = (image.cols(), image.rows());
    let top = height - CAPTION_PX * (line + 1);
    imgproc::rectangle(image, Rect::new(0, top, width, CAPTION_PX), colour(20, 20, 20), imgproc::FILLED, imgproc::LINE_8, 0)?;
    let font = imgproc::FONT_HERSHEY_SIMPLEX;
    imgproc::put_text(image, text, Point::new(6, top + 14), font, 0.45, colour(235, 235, 235), 1, imgproc::LINE_AA, false)
}

/// The picture at most `width_max` px wide.
pub fn shrunk(picture: &Mat, width_max: i32) -> Result<Mat, opencv::Error> {
    if picture.cols() <= width_max {
        return Ok(picture.clone());
    }
    let size = opencv::core::Size::new(width_max, picture.rows() * width_max / picture.cols());
    let mut small = Mat::default();
    imgproc::resize(picture, &mut small, size, 0.0, 0.0, imgproc::INTER_AREA)?;
    Ok(small)
}

/// Writes the picture to the file at `path` in one step, in the format that the name's ending says. OpenCV's own writing does not tell of a full disk.
pub fn save(picture: &Mat, path: &Path) -> Result<(), String> {
    let bytes = encode(picture, path)?;
    whole_file::replace_soon(path, bytes.as_slice(), begins(&bytes)).map_err(|e| e.to_string())
}

/// Whether [`save`] may put a picture at `path`, so that it is known before long work. Its directory may be missing if it can be made.
pub fn may_save(path: &Path) -> Result<(), String> {
    let one = Mat::new_rows_cols_with_default(1, 1, CV_8UC3, Scalar::default()).map_err(|e| e.message)?;
    let bytes = encode(&one, path)?;
    let above = path.ancestors().skip(1).find(|directory| directory.exists()).unwrap_or(Path::new("."));
    let is_missing = path.parent().is_some_and(|parent| parent != above && !parent.as_os_str().is_empty());
    let looked = if is_missing { whole_file::may_make_in(above) } else { whole_file::check(path, begins(&bytes)) };
    looked.map_err(|e| e.to_string())
}

/// The picture as a file in the format that the ending of `path` says.
fn encode(picture: &Mat, path: &Path) -> Result<Vector<u8>, String> {
    let ending = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    let mut bytes = Vector::new();
    // An unknown ending is an error of OpenCV's as well, and so it is looked at before.
    if !imgcodecs::have_image_writer(format!("x.{ending}")).unwrap_or(false) {
        return Err(format!("'{ending}' is no ending of a picture that can be written, such as png or jpg"));
    }
    let made = imgcodecs::imencode(&format!(".{ending}"), picture, &mut bytes, &Vector::new()).map_err(|e| e.message)?;
    if made { Ok(bytes) } else { Err(format!("the picture cannot be made a {ending}")) }
}

/// How a file begins that a picture may replace: as the picture does, which is of the same format.
fn begins(bytes: &Vector<u8>) -> &[u8] {
    bytes.as_slice().get(..2).unwrap_or_default()
}

/// Lets OpenCV work in the calling thread alone. The error is one line.
pub fn one_thread() -> Result<(), String> {
    opencv::core::set_num_threads(1).map_err(|e| e.message)
}
