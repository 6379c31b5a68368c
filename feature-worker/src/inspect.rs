//! `feature-worker inspect`: what is measured in images or a video, as pictures and a CSV.
//!
//! An ordinary command-line program; allocates. An input that cannot be read or has another size than configured ends it with
//! one line.

use std::path::PathBuf;
use std::time::Duration;

use indicatif::ProgressBar;
use opencv::core::{Mat, Vec3b, Vector};
use opencv::prelude::*;
use opencv::{imgcodecs, imgproc};
use shared::config::{CameraConfig, CameraSource, Config};
use shared::exit::{self, Failure, OrExit as _};
use shared::messages::{Doubt, PixelFormat};

use crate::extract::{Extractor, Image};
use crate::source::{Capture, Frame, FrameSource as _, NextFrame};
use crate::view;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  feature-worker inspect pour.mp4 --config config/cell.toml --out out/inspect\n  feature-worker inspect a.png b.png \
--json\n  feature-worker inspect 'frames/frame_%04d.png' --every 10\n\nWrites features.csv (frame, t_s, area_px2, confidence, doubt, triangle) \
and a picture of every N-th frame with region, axes, outline, edge points, line and triangle drawn on it."
)]
pub struct Args {
    /// Images, one video, or one pattern of an image sequence.
    #[arg(required = true)]
    input: Vec<PathBuf>,
    /// The cell's configuration; its [image] table is what is tried.
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Directory of the pictures and the CSV.
    #[arg(long, default_value = "out/inspect")]
    out: PathBuf,
    /// Write the picture of every N-th frame; 0: none.
    #[arg(long, default_value_t = 1)]
    every: u64,
    /// Print a summary as JSON.
    #[arg(long)]
    json: bool,
}

/// Whether `path` is a single picture by its name.
fn is_picture(path: &std::path::Path) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_lowercase();
    !path.to_string_lossy().contains('%')
        && ["png", "jpg", "jpeg", "bmp", "tif", "tiff", "pgm", "ppm", "webp"].contains(&extension.as_str())
}

/// Calls `each` with every frame of pictures, a video or a sequence; the size may be any. Used by `inspect` and `calibrate`.
pub fn for_each_frame(input: &[PathBuf], camera: &CameraConfig, mut each: impl FnMut(Frame) -> Result<(), String>) -> Result<u64, String> {
    let mut count = 0;
    for path in input {
        let camera = CameraConfig {
            source: if path.to_string_lossy().contains('%') { CameraSource::Images } else { CameraSource::Video },
            path: path.display().to_string(),
            ..camera.clone()
        };
        if is_picture(path) {
            let picture = imgcodecs::imread(path, imgcodecs::IMREAD_ANYCOLOR).map_err(|e| e.message)?;
            if picture.empty() {
                return Err(format!("{}: is no picture that can be read", path.display()));
            }
            count += 1;
            let header = shared::messages::FrameHeader {
                format: if picture.channels() == 1 { PixelFormat::Mono8 } else { PixelFormat::Bgr8 } as u32,
                width_px: picture.cols() as u32,
                height_px: picture.rows() as u32,
                sequence: count,
                ..Default::default()
            };
            each(Frame { header, pixels: picture.data_bytes().map_err(|e| e.message)? })?;
            continue;
        }
        let mut capture = Capture::open(&camera, false).map_err(|e| e.to_string())?;
        while let NextFrame::Frame(mut frame) = capture.next_frame(Duration::ZERO).map_err(|e| e.to_string())? {
            count += 1;
            frame.header.sequence = count;
            each(frame)?;
        }
    }
    Ok(count)
}

/// A BGR copy of a frame, whatever its format.
pub fn to_bgr(frame: &Frame) -> Result<Mat, opencv::Error> {
    let (rows, columns) = (frame.header.height_px as i32, frame.header.width_px as i32);
    let mut bgr = Mat::default();
    match PixelFormat::from_code(frame.header.format) {
        Some(PixelFormat::Mono8) => {
            imgproc::cvt_color_def(&Mat::new_rows_cols_with_bytes::<u8>(rows, columns, frame.pixels)?, &mut bgr, imgproc::COLOR_GRAY2BGR)?;
        }
        Some(PixelFormat::Yuyv) => {
            let yuyv = Mat::new_rows_cols_with_bytes::<opencv::core::Vec2b>(rows, columns, frame.pixels)?;
            imgproc::cvt_color_def(&yuyv, &mut bgr, imgproc::COLOR_YUV2BGR_YUYV)?;
        }
        _ => Mat::new_rows_cols_with_bytes::<Vec3b>(rows, columns, frame.pixels)?.copy_to(&mut bgr)?,
    }
    Ok(bgr)
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    inspect(args, &config).or_exit(exit::BAD_INPUT)
}

fn inspect(args: &Args, config: &Config) -> Result<(), String> {
    let words = |e: &dyn std::fmt::Display| e.to_string();
    let mut extractor = Extractor::new(&config.camera, &config.image).map_err(|e| words(&e))?;
    std::fs::create_dir_all(&args.out).map_err(|e| format!("{}: {e}; give another --out", args.out.display()))?;
    let table = args.out.join("features.csv");
    let mut csv = csv::Writer::from_path(&table).map_err(|e| format!("{}: {e}", table.display()))?;
    csv.write_record(["frame", "t_s", "area_px2", "confidence", "doubt", "x0", "y0", "x1", "y1", "x2", "y2"]).map_err(|e| words(&e))?;
    let bar = ProgressBar::new_spinner().with_message("frames");
    let (mut flowing, mut doubtful, mut sum) = (0u64, 0u64, 0.0f64);
    let frames = for_each_frame(&args.input, &config.camera, |frame| {
        let header = frame.header;
        let format = PixelFormat::from_code(header.format).unwrap_or(PixelFormat::Bgr8);
        let image = Image { width_px: header.width_px, height_px: header.height_px, format, pixels: frame.pixels };
        let measured = extractor.measure(image).map_err(|e| words(&e))?;
        if measured.doubt == Doubt::WrongFormat {
            let (camera, header) = (&config.camera, &header);
            return Err(format!(
                "frame {} is {} x {} px, but [camera] says {} x {}; set width_px and height_px to the input's size and calibrate",
                header.sequence, header.width_px, header.height_px, camera.width_px, camera.height_px
            ));
        }
        flowing += u64::from(measured.area_px2 > 0.0);
        doubtful += u64::from(measured.doubt != Doubt::None);
        sum += f64::from(measured.area_px2);
        let t_s = (header.sequence - 1) as f64 / config.camera.fps;
        let mut row = vec![header.sequence.to_string(), format!("{t_s:.4}"), format!("{:.2}", measured.area_px2)];
        row.extend([format!("{:.3}", measured.confidence), measured.doubt.words().to_string()]);
        row.extend(measured.triangle_px.iter().map(|v| format!("{v:.2}")));
        csv.write_record(&row).map_err(|e| words(&e))?;
        if args.every > 0 && (header.sequence - 1) % args.every == 0 {
            let mut picture = to_bgr(&frame).map_err(|e| words(&e))?;
            view::draw(&mut picture, &extractor, &measured).map_err(|e| words(&e))?;
            let path = args.out.join(format!("frame_{:06}.png", header.sequence));
            imgcodecs::imwrite(&path, &picture, &Vector::new()).map_err(|e| words(&e))?;
        }
        bar.inc(1);
        Ok(())
    })?;
    csv.flush().map_err(|e| format!("{}: {e}", table.display()))?;
    bar.finish_and_clear();
    if args.json {
        let report = serde_json::json!({ "frames": frames, "flowing": flowing, "doubtful": doubtful, "sum_area_px2": sum, "csv": table });
        println!("{report}");
    } else {
        println!("{frames} frames, {flowing} with flow, {doubtful} doubtful, sum of V_e {sum:.0} px^2; see {}", table.display());
    }
    Ok(())
}
