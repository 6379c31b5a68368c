//! Reads an episode and prints what is in it.
//!
//! You learn from it how to open an episode that `feature-worker run` recorded, what one of its rows holds (time, alpha, V_e), how a lost
//! frame looks, where the weight is, and when an episode may be trained on. Run it with an episode of your own, or without one: it then
//! writes a small episode into a temporary directory first, which also shows how an [`EpisodeWriter`] is used.
//!
//! ```text
//! cargo run -p shared --example read_episode -- out/episodes/episode-0001.mcap
//! ```

use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use shared::config::Config;
use shared::episode::{Episode, EpisodeEnd, EpisodeKind, EpisodeStart, EpisodeWriter, FrameRow, set_weight};
use shared::gaussian_curve::Curve;
use shared::messages::{Feature, LAYOUT_VERSION, Phase, Telemetry};

/// Time from one frame to the next, ns: a camera of 30 Hz.
const FRAME_NS: u64 = 33_333_333;

fn main() -> Result<(), Box<dyn Error>> {
    let own = tempfile::tempdir()?;
    let file = match std::env::args_os().nth(1) {
        Some(file) => PathBuf::from(file),
        None => write_small_episode(own.path())?,
    };
    print!("{}", describe(&file)?);
    Ok(())
}

/// What is in an episode, as lines of text.
pub fn describe(file: &Path) -> Result<String, Box<dyn Error>> {
    // A damaged file is an error here. A file whose recorder was killed is read as far as it goes, and is not complete.
    let episode = Episode::read(file)?;
    let mut text = match episode.kind {
        EpisodeKind::Recording(curve) => format!("a recording of eq. (1) up to {} degrees\n", curve.lambda_deg),
        EpisodeKind::Pour { goal_ml } => format!("a pour of {goal_ml} ml\n"),
        EpisodeKind::Table => "rows of a table\n".into(),
    };
    text += "    t_s  alpha_deg    V_e_px2\n";
    for row in &episode.rows {
        // V_e is NaN where there is nothing to learn from: the frame was lost, or its measurement must not be used.
        let area = if row.lost { "lost".into() } else { format!("{:.1}", row.area_px2) };
        text += &format!("{:7.3}  {:9.2}  {area:>9}\n", row.t_s, row.alpha_commanded_deg);
    }
    // Training needs no more than the rows and the weight: all the frames together must explain the weight.
    let sum: f32 = episode.rows.iter().map(|r| r.area_px2).filter(|a| !a.is_nan()).sum();
    text += &match episode.weight_g {
        Some(weight_g) => format!("{} rows, sum of V_e {sum:.1} px^2, weight {weight_g} g\n", episode.rows.len()),
        None => format!("{} rows, sum of V_e {sum:.1} px^2, not weighed yet\n", episode.rows.len()),
    };
    let sound = episode.complete && episode.weight_g.is_some() && episode.stream_faults().next().is_none();
    text += if sound { "it can be trained on\n" } else { "it cannot be trained on\n" };
    Ok(text)
}

/// Writes an episode of twelve frames, as the recorder does, and weighs it. The frame numbered 6 is lost.
pub fn write_small_episode(directory: &Path) -> Result<PathBuf, Box<dyn Error>> {
    let config = Config::read(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../config/sim.toml")))?;
    let curve = Curve { lambda_deg: 60.0, gamma_per_s2: 200.0, beta_s: 0.2 };
    let start = EpisodeStart {
        episode: 1,
        kind: EpisodeKind::Recording(curve),
        started_at_ns: FRAME_NS,
        wall_clock: SystemTime::now(),
        config: &config,
        weights: "",
    };
    let mut writer = EpisodeWriter::create(directory, &start)?;
    for sequence in 1..=12 {
        let at_ns = sequence * FRAME_NS;
        let alpha_deg = curve.alpha_deg((sequence - 1) as f32 / 30.0);
        let phase = Phase::Recording as u32;
        let tick = Telemetry { version: LAYOUT_VERSION, phase, tick: sequence, at_ns, episode: 1, alpha_deg, ..Default::default() };
        writer.telemetry(&tick)?;
        if sequence != 6 {
            let area_px2 = 10.0 * (alpha_deg - 30.0).max(0.0);
            let feature = Feature { version: LAYOUT_VERSION, sequence, captured_at_ns: at_ns, area_px2, ..Default::default() };
            // The robot measures nothing here, and there is no image: an episode is whole without them.
            writer.frame(&FrameRow { feature: &feature, alpha_commanded_deg: alpha_deg, alpha_measured_deg: f32::NAN, image: None })?;
        }
    }
    let file = writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 })?;
    set_weight(&file, 12.5)?;
    Ok(file)
}
