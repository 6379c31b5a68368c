//! `feature-worker bench`: time of each stage of the extraction, beside the same pipeline written with Python's OpenCV.
//!
//! Frames are drawn here (a turning chess board, a stream, noise) or read from `--input`; both programs measure the same bytes in
//! the same run, one after the other, on one thread. Python and its OpenCV go into a virtual environment under `--venv`; without
//! network or Python that part is left out and said so. Allocates. Times are printed, never judged.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use opencv::core::{self, CV_8UC3, Mat, Point, Point2f, Scalar, Size, Vector};
use opencv::imgproc;
use opencv::prelude::*;
use serde::Serialize;
use shared::config::{CameraConfig, CameraSource, Config, ImageConfig, LiquidMethod};
use shared::exit::{self, Failure, OrExit as _};
use shared::messages::PixelFormat;

use crate::extract::{Extractor, Image};
use crate::inspect::{for_each_frame, to_bgr};

/// Different frames; they are measured again and again.
const PICTURES: usize = 40;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  feature-worker bench\n  feature-worker bench --frames 5000 --no-python --json\n  feature-worker bench --config \
config/cell.toml --input pour.mp4"
)]
pub struct Args {
    /// Measurements of each kind.
    #[arg(long, default_value_t = 2000)]
    frames: usize,
    /// Measure these pictures or this video (with --config) instead of drawn frames.
    #[arg(long, requires = "config")]
    input: Option<PathBuf>,
    /// The configuration that belongs to --input.
    #[arg(long)]
    config: Option<PathBuf>,
    /// Leave Python out.
    #[arg(long)]
    no_python: bool,
    /// Where Python's virtual environment is made and kept.
    #[arg(long, default_value = "out/bench-venv")]
    venv: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Percentiles in us.
#[derive(Debug, Clone, Copy, Serialize)]
struct Times {
    p50: f64,
    p99: f64,
    max: f64,
}

fn times(mut ns: Vec<u64>) -> Times {
    ns.sort_unstable();
    let at = |share: f64| ns.get((ns.len().saturating_sub(1) as f64 * share) as usize).map_or(0.0, |v| *v as f64 / 1e3);
    Times { p50: at(0.5), p99: at(0.99), max: at(1.0) }
}

/// One line of the table.
#[derive(Debug, Serialize)]
struct Line {
    name: String,
    rays: Times,
    checks: Times,
    segment: Times,
    line: Times,
    total: Times,
    python_p50: Option<f64>,
    times_as_fast: Option<f64>,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    bench(args).or_exit(exit::FAILED)
}

fn drawn_config(scale: f32, method: LiquidMethod) -> (CameraConfig, ImageConfig) {
    let px = |v: f32| (v * scale).round() as u32;
    let height = if scale > 1.0 { 720 } else { 480 };
    let camera =
        CameraConfig { source: CameraSource::SharedMemory, path: String::new(), width_px: px(640.0), height_px: height, fps: 30.0 };
    let axis = |a: [f32; 4]| a.map(|v| v * scale);
    let image = ImageConfig {
        method,
        region_px: [px(190.0), px(16.0), px(420.0), px(256.0)],
        x_axis_px: axis([215.0, 250.0, 600.0, 250.0]),
        y_axis_px: axis([215.0, 350.0, 215.0, 250.0]),
        colour_hsv: [98, 90, 25, 124, 255, 255],
        area_min_px2: 30.0,
    };
    (camera, image)
}

/// A turning chess board, a blue stream of changing size over the lip, noise.
fn draw_frames(camera: &CameraConfig, image: &ImageConfig) -> Result<Vec<Mat>, opencv::Error> {
    let (width, height) = (camera.width_px as i32, camera.height_px as i32);
    let mut board = Mat::new_rows_cols_with_default(2 * height, 2 * width, CV_8UC3, Scalar::all(200.0))?;
    for row in 0..40 {
        for column in (row % 2..40).step_by(2) {
            let square = core::Rect::new(column * 60, row * 60, 60, 60);
            imgproc::rectangle(&mut board, square, Scalar::all(50.0), imgproc::FILLED, imgproc::LINE_8, 0)?;
        }
    }
    let [x, y] = [image.x_axis_px[0], image.x_axis_px[1]];
    let scale = camera.width_px as f32 / 640.0;
    core::set_rng_seed(1)?;
    let mut frames = Vec::new();
    for i in 0..PICTURES {
        let turn = imgproc::get_rotation_matrix_2d(Point2f::new(width as f32, height as f32), f64::from(i as u32), 1.0)?;
        let mut frame = Mat::default();
        imgproc::warp_affine(&board, &mut frame, &turn, Size::new(width, height), imgproc::INTER_LINEAR, 0, Scalar::default())?;
        let size = scale * (20.0 + 2.5 * i as f32);
        let corners = [(-0.1, 2.0), (-0.1, 0.2), (-3.0, -0.6), (-3.0, -0.9), (0.0, -0.9), (0.6, -0.5), (1.2, 0.0), (2.0, 2.0)];
        let stream: Vector<Point> = corners.iter().map(|(dx, dy)| Point::new((x + dx * size) as i32, (y + dy * size) as i32)).collect();
        imgproc::fill_poly(&mut frame, &stream, Scalar::new(150.0, 62.0, 20.0, 0.0), imgproc::LINE_AA, 0, Point::default())?;
        let mut noise = Mat::new_rows_cols_with_default(height, width, CV_8UC3, Scalar::all(0.0))?;
        core::randn(&mut noise, &Scalar::all(8.0), &Scalar::all(3.0))?;
        let mut noisy = Mat::default();
        core::add(&frame, &noise, &mut noisy, &core::no_array(), -1)?;
        frames.push(noisy);
    }
    Ok(frames)
}

fn bench(args: &Args) -> Result<(), String> {
    let words = |e: opencv::Error| e.message;
    opencv::core::set_num_threads(1).map_err(words)?;
    let mut lines = Vec::new();
    if let (Some(input), Some(file)) = (&args.input, &args.config) {
        let config = Config::read(file).map_err(|e| e.to_string())?;
        let mut frames = Vec::new();
        for_each_frame(std::slice::from_ref(input), &config.camera, |frame| {
            if frames.len() < 4 * PICTURES {
                frames.push(to_bgr(&frame).map_err(|e| e.message)?);
            }
            Ok(())
        })?;
        lines.push(measure("input", &config.camera, &config.image, &frames, args)?);
    } else {
        for (scale, size) in [(1.0, "640x480"), (2.0, "1280x720")] {
            for (method, name) in [(LiquidMethod::Colour, "colour"), (LiquidMethod::Clear, "clear")] {
                let (camera, image) = drawn_config(scale, method);
                let frames = draw_frames(&camera, &image).map_err(words)?;
                lines.push(measure(&format!("{size} {name}"), &camera, &image, &frames, args)?);
            }
        }
    }
    if args.json {
        println!("{}", serde_json::json!({ "unit": "us", "frames": args.frames, "lines": lines }));
        return Ok(());
    }
    println!("us a frame on one thread, {} frames each", args.frames);
    println!(
        "{:<18}{:>8}{:>8}{:>9}{:>7}{:>12}{:>8}{:>9}{:>12}{:>8}",
        "", "rays", "checks", "segment", "line", "total p50", "p99", "max", "Python p50", "ratio"
    );
    for l in &lines {
        let optional = |v: Option<f64>, digits: usize| v.map_or("-".to_string(), |v| format!("{v:.digits$}"));
        println!(
            "{:<18}{:>8.0}{:>8.0}{:>9.0}{:>7.0}{:>12.0}{:>8.0}{:>9.0}{:>12}{:>8}",
            l.name,
            l.rays.p50,
            l.checks.p50,
            l.segment.p50,
            l.line.p50,
            l.total.p50,
            l.total.p99,
            l.total.max,
            optional(l.python_p50, 0),
            optional(l.times_as_fast, 1)
        );
    }
    Ok(())
}

fn measure(name: &str, camera: &CameraConfig, image: &ImageConfig, frames: &[Mat], args: &Args) -> Result<Line, String> {
    let mut extractor = Extractor::new(camera, image).map_err(|e| e.to_string())?;
    let mut ns: [Vec<u64>; 5] = std::array::from_fn(|_| Vec::with_capacity(args.frames));
    for i in 0..args.frames + frames.len() {
        let Some(frame) = frames.get(i % frames.len().max(1)) else { return Err("no frames to measure".into()) };
        let pixels = frame.data_bytes().map_err(|e| e.message)?;
        let image = Image { width_px: camera.width_px, height_px: camera.height_px, format: PixelFormat::Bgr8, pixels };
        let start = Instant::now();
        extractor.measure(image).map_err(|e| e.to_string())?;
        let total = start.elapsed().as_nanos() as u64;
        // The first round fills caches and buffers.
        if i >= frames.len() {
            let s = extractor.stages();
            for (list, value) in ns.iter_mut().zip([s.rays_ns, s.checks_ns, s.segment_ns, s.line_ns, total]) {
                list.push(value);
            }
        }
    }
    let [rays, checks, segment, line, total] = ns.map(times);
    let python_p50 = if args.no_python || image.method == LiquidMethod::Clear {
        None
    } else {
        match python(camera, image, frames, args) {
            Ok(us) => Some(us),
            Err(e) => {
                eprintln!("bench: Python is left out: {e}");
                None
            }
        }
    };
    let times_as_fast = python_p50.map(|us| us / total.p50);
    Ok(Line { name: name.into(), rays, checks, segment, line, total, python_p50, times_as_fast })
}

/// Median time of the same pipeline in Python, us.
fn python(camera: &CameraConfig, image: &ImageConfig, frames: &[Mat], args: &Args) -> Result<f64, String> {
    let interpreter = environment(&args.venv)?;
    let directory = args.venv.join("bench");
    let io = |e: std::io::Error| format!("{}: {e}", directory.display());
    std::fs::create_dir_all(&directory).map_err(io)?;
    std::fs::write(directory.join("bench.py"), include_str!("bench/bench.py")).map_err(io)?;
    let mut raw = std::fs::File::create(directory.join("frames.bgr")).map_err(io)?;
    for frame in frames {
        raw.write_all(frame.data_bytes().map_err(|e| e.message)?).map_err(io)?;
    }
    let task = serde_json::json!({ "width": camera.width_px, "height": camera.height_px, "frames": args.frames, "region": image.region_px,
        "x_axis": image.x_axis_px, "y_axis": image.y_axis_px, "hsv": image.colour_hsv });
    std::fs::write(directory.join("task.json"), task.to_string()).map_err(io)?;
    let output = Command::new(interpreter).arg(directory.join("bench.py")).arg(&directory).output().map_err(io)?;
    let text = String::from_utf8_lossy(&output.stdout);
    text.trim()
        .parse()
        .map_err(|_| format!("bench.py: {}", String::from_utf8_lossy(&output.stderr).lines().last().unwrap_or("no answer").trim()))
}

/// The virtual environment's interpreter with OpenCV in it; makes it when it is not there.
fn environment(venv: &Path) -> Result<PathBuf, String> {
    let interpreter = venv.join("bin/python");
    let works = |i: &Path| Command::new(i).args(["-c", "import cv2, numpy"]).output().is_ok_and(|o| o.status.success());
    if works(&interpreter) {
        return Ok(interpreter);
    }
    eprintln!("bench: installing Python's OpenCV into {}", venv.display());
    let steps: [(&str, Vec<&str>); 2] =
        [("python3", vec!["-m", "venv"]), ("", vec!["-m", "pip", "install", "--quiet", "numpy", "opencv-python-headless<5"])];
    for (program, arguments) in steps {
        let mut command = if program.is_empty() { Command::new(&interpreter) } else { Command::new(program) };
        command.args(&arguments);
        if !program.is_empty() {
            command.arg(venv);
        }
        let output = command.output().map_err(|e| format!("{program}: {e}"))?;
        if !output.status.success() {
            return Err(String::from_utf8_lossy(&output.stderr).lines().last().unwrap_or("failed").trim().to_string());
        }
    }
    if works(&interpreter) { Ok(interpreter) } else { Err("OpenCV cannot be imported".into()) }
}
