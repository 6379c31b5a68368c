//! `feature-worker bench`: measures the time of each stage of the extraction, beside the same pipeline written with Python's OpenCV.
//!
//! The frames are drawn or read from `--input`. Both programs measure the same bytes in the same run, one after the other, on one
//! thread. The command allocates. It prints times and never judges them. Without Python's OpenCV that part is left out, and the command
//! says so.

use std::path::PathBuf;

use opencv::core::Mat;
use serde::Serialize;
use shared::config::{CameraConfig, Config, ImageConfig, LiquidMethod};
use shared::exit::{self, Failure, OrExit as _};

use crate::drawing::to_bgr;
use crate::source::for_each_frame;

mod drawn;
mod measure;
mod python;

use drawn::Ground;
use measure::StageTimes;

/// The most frames that are read from `--input`: four times as many as are drawn without it. All of them are held in memory, so that
/// reading is not measured.
const INPUT_FRAMES: usize = 4 * drawn::PICTURES;

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
    /// Take what is there of an --input of which something is missing.
    #[arg(long)]
    partial: bool,
    /// The configuration that belongs to --input.
    #[arg(long, env = shared::config::VARIABLE)]
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

/// One line of the table.
#[derive(Debug, Serialize)]
struct BenchRow {
    name: String,
    #[serde(flatten)]
    times: StageTimes,
    python_p50: Option<f64>,
    times_as_fast: Option<f64>,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let words = |e: opencv::Error| e.message;
    opencv::core::set_num_threads(1).map_err(words).or_exit(exit::FAILED)?;
    let mut rows = Vec::new();
    if let (Some(input), Some(file)) = (&args.input, &args.config) {
        let config = Config::read(file).or_exit(exit::BAD_INPUT)?;
        let mut frames = Vec::new();
        let contents = for_each_frame(std::slice::from_ref(input), config.camera.fps, args.partial, |frame| {
            if frames.len() < INPUT_FRAMES {
                frames.push(to_bgr(&frame).map_err(words)?);
            }
            Ok(())
        });
        let contents = contents.or_exit(exit::BAD_INPUT)?;
        contents.missing.iter().for_each(|line| eprintln!("bench: {line}"));
        rows.push(row("input".into(), &config.camera, &config.image, &frames, args).or_exit(exit::FAILED)?);
    } else {
        for (scale, size) in [(1.0, "640x480"), (2.0, "1280x720")] {
            for (method, ground, name) in [
                (LiquidMethod::Colour, Ground::Board, "colour"),
                (LiquidMethod::Clear, Ground::Card, "clear, card"),
                (LiquidMethod::Clear, Ground::Board, "clear, board"),
            ] {
                let (camera, image) = drawn::config(scale, method);
                let frames = drawn::pictures(&camera, &image, ground).map_err(words).or_exit(exit::FAILED)?;
                rows.push(row(format!("{size} {name}"), &camera, &image, &frames, args).or_exit(exit::FAILED)?);
            }
        }
    }
    if args.json {
        println!("{}", serde_json::json!({ "unit": "us", "frames": args.frames, "lines": rows }));
    } else {
        print_table(&rows, args.frames);
    }
    Ok(())
}

/// Measures one kind of frames, here and in Python.
fn row(name: String, camera: &CameraConfig, image: &ImageConfig, frames: &[Mat], args: &Args) -> Result<BenchRow, String> {
    let times = measure::measure(camera, image, frames, args.frames)?;
    // Python has the method for coloured liquids only.
    let python_p50 = if args.no_python || image.method == LiquidMethod::Clear {
        None
    } else {
        let measured = python::median_us(&args.venv, camera, image, frames, args.frames);
        measured.inspect_err(|e| eprintln!("bench: Python is left out: {e}")).ok()
    };
    Ok(BenchRow { name, times, python_p50, times_as_fast: python_p50.map(|us| us / times.total.p50) })
}

fn print_table(rows: &[BenchRow], frames: usize) {
    println!("us a frame on one thread, {frames} frames each");
    println!(
        "{:<22}{:>8}{:>8}{:>9}{:>7}{:>12}{:>8}{:>9}{:>12}{:>8}",
        "", "rays", "checks", "segment", "line", "total p50", "p99", "max", "Python p50", "ratio"
    );
    let optional = |v: Option<f64>, digits: usize| v.map_or("-".to_string(), |v| format!("{v:.digits$}"));
    for BenchRow { name, times, python_p50, times_as_fast } in rows {
        println!(
            "{name:<22}{:>8.0}{:>8.0}{:>9.0}{:>7.0}{:>12.0}{:>8.0}{:>9.0}{:>12}{:>8}",
            times.rays.p50,
            times.checks.p50,
            times.segment.p50,
            times.line.p50,
            times.total.p50,
            times.total.p99,
            times.total.max,
            optional(*python_p50, 0),
            optional(*times_as_fast, 1)
        );
    }
}
