//! Writes small episodes with drawn pictures, for trying what other programs make of a recording.
//!
//! You learn from it how a recorder fills an episode: ticks, frames with their pictures, frames that are lost, doubtful or without a picture.
//! `scripts/check-lerobot` and `scripts/check-mcap` use it. It runs on one thread, allocates, and ends with the first error.
//!
//! ```text
//! cargo run -p feature-worker --example drawn_episodes -- out/drawn 5
//! ```

use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::{Duration, UNIX_EPOCH};

use opencv::core::{Mat, Rect, Scalar, Vector, VectorToVec};
use opencv::{imgcodecs, imgproc};
use shared::config::Config;
use shared::episode::{EpisodeEnd, EpisodeKind, EpisodeStart, EpisodeWriter, FrameRow, set_weight};
use shared::gaussian_curve::Curve;
use shared::messages::{Doubt, Feature, LAYOUT_VERSION, Phase, Telemetry};

/// Time from one frame to the next, ns: a camera of 30 Hz.
const FRAME_NS: u64 = 33_333_333;
/// Frames of an episode: two seconds.
const FRAMES: u64 = 60;
/// Width and height of the pictures, px: small, for speed.
const SIZE_PX: (i32, i32) = (128, 96);

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args_os().skip(1);
    let directory = PathBuf::from(arguments.next().ok_or("name a directory")?);
    let count: u64 = arguments.next().and_then(|n| n.to_str()?.parse().ok()).unwrap_or(1);
    for number in 1..=count {
        println!("{}", write(&directory, number)?.display());
    }
    Ok(())
}

/// Writes and weighs one episode. Every second one is a pour.
fn write(directory: &Path, number: u64) -> Result<PathBuf, Box<dyn Error>> {
    let config = Config::read(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../config/sim.toml")))?;
    let curve = Curve { lambda_deg: 50.0 + number as f32, gamma_per_s2: 4.0, beta_s: 1.0 };
    let goal_ml = if number.is_multiple_of(2) { 50.0 } else { f32::NAN };
    let kind = if goal_ml.is_nan() { EpisodeKind::Recording(curve) } else { EpisodeKind::Pour { goal_ml } };
    let started_at_ns = 1_000_000_000 * number;
    // Each on another day, and each after a start of the machine.
    let wall_clock = UNIX_EPOCH + Duration::from_secs(1_795_000_000 + 86_400 * number);
    let start = EpisodeStart { episode: number, kind, started_at_ns, wall_clock, config: &config, weights: "" };
    let mut writer = EpisodeWriter::create(directory, &start)?;
    for n in 0..FRAMES {
        let at_ns = started_at_ns + n * FRAME_NS;
        let alpha_deg = curve.alpha_deg(n as f32 / 30.0);
        writer.telemetry(&Telemetry {
            version: LAYOUT_VERSION,
            phase: Phase::Pouring as u32,
            tick: n + 1,
            at_ns,
            robot_at_ns: at_ns,
            episode: number,
            alpha_deg,
            alpha_measured_deg: if n < 3 { f32::NAN } else { alpha_deg - 0.1 },
            dalpha_deg: if n % 7 == 0 { f32::NAN } else { 1.0 },
            area_px2: f32::NAN,
            goal_ml,
            poured_ml: n as f32,
            ..Default::default()
        })?;
        if n == 20 || n == 21 {
            continue;
        }
        let area_px2 = 20.0 * (alpha_deg - 35.0).max(0.0);
        let feature = Feature {
            version: LAYOUT_VERSION,
            doubt: if n == 30 { Doubt::TooDark } else { Doubt::None } as u32,
            sequence: n + 1,
            captured_at_ns: at_ns + 5_000_000,
            area_px2,
            confidence: 0.9,
            triangle_px: [60.0, 30.0, 60.0 + area_px2.sqrt(), 30.0, 60.0, 30.0 + area_px2.sqrt()],
            ..Default::default()
        };
        let picture = picture(area_px2)?;
        let image = (n != 40).then_some(("jpeg", picture.as_slice()));
        let alpha_measured_deg = if n < 3 { f32::NAN } else { alpha_deg - 0.1 };
        writer.frame(&FrameRow { feature: &feature, alpha_commanded_deg: alpha_deg, alpha_measured_deg, image })?;
    }
    let file = writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 })?;
    set_weight(&file, 40.0 + number as f64)?;
    Ok(file)
}

/// A grey picture with a red stream as wide as its area asks for.
fn picture(area_px2: f32) -> opencv::Result<Vec<u8>> {
    let (width, height) = SIZE_PX;
    let mut picture = Mat::new_rows_cols_with_default(height, width, opencv::core::CV_8UC3, Scalar::all(190.0))?;
    let stream = Rect::new(60, 30, 1 + (area_px2.sqrt() as i32).min(60), 60);
    imgproc::rectangle(&mut picture, stream, Scalar::new(30.0, 30.0, 200.0, 0.0), imgproc::FILLED, imgproc::LINE_8, 0)?;
    let mut bytes = Vector::<u8>::new();
    imgcodecs::imencode_def(".jpg", &picture, &mut bytes)?;
    Ok(bytes.to_vec())
}
