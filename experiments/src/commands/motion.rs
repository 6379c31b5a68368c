//! `experiments motion`: what the robot makes of a recorded pour's targets, with the program that is uploaded and without it.
//!
//! The targets of an episode are sent, at the times at which they were recorded, to two simulated controllers: one runs `pour.script`, the
//! other hands each target to servoj as it is until the next one comes. Ordinary process; allocates; an error is one line.

use std::path::PathBuf;

use rt_controller::link::{LinkOptions, program};
use serde::Serialize;
use shared::config::Config;
use shared::episode::Episode;
use shared::exit::{self, Failure, OrExit as _};
use simulator::ur::variables::Series;

use crate::motion::{self, MotionFigures};
use crate::plots;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  experiments motion out/episodes/episode-0001.mcap\n  \
experiments motion out/episodes/episode-0001.mcap --series e-series --from 1 --to 3 --out out/motion.svg")]
pub struct Args {
    /// The episode: a recorded pour or curve
    episode: PathBuf,
    /// The cell's configuration: joint, limits, servoj parameters
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Controller generation: 125 or 500 cycles a second
    #[arg(long, value_enum, default_value = "cb3")]
    series: SeriesArg,
    /// Show the picture from this time on, s
    #[arg(long, default_value_t = 0.0)]
    from: f64,
    /// Show the picture up to this time, s; with 0, to the end
    #[arg(long, default_value_t = 0.0)]
    to: f64,
    /// File of the picture (SVG)
    #[arg(long, default_value = "out/motion.svg")]
    out: PathBuf,
    /// Print the figures as JSON
    #[arg(long)]
    json: bool,
}

/// Controller generation, as it is written on the command line.
#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum SeriesArg {
    Cb3,
    ESeries,
}

/// What is printed.
#[derive(Debug, Serialize)]
struct Report {
    targets: usize,
    with_program: MotionFigures,
    raw: MotionFigures,
    picture: String,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    let episode = Episode::read(&args.episode).or_exit(exit::BAD_INPUT)?;
    let report = compare(args, &config, &episode).map_err(|e| format!("{}: {e}", args.episode.display())).or_exit(exit::FAILED)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report).or_exit(exit::FAILED)?);
    } else {
        print(&report);
    }
    Ok(())
}

/// Prints the table of both motions.
fn print(report: &Report) {
    println!("{} targets; picture {}", report.targets, report.picture);
    println!("{:44}{:>14}{:>14}", "", "pour.script", "raw servoj");
    type Row = (&'static str, fn(&MotionFigures) -> f64);
    let rows: [Row; 6] = [
        ("command: largest rate, deg/s", |f| f.command_rate_deg_s),
        ("command: largest acceleration, deg/s^2", |f| f.command_acceleration_deg_s2),
        ("joint: largest acceleration, deg/s^2", |f| f.joint_acceleration_deg_s2),
        ("joint: acceleration, r.m.s., deg/s^2", |f| f.joint_acceleration_rms_deg_s2),
        ("joint: jerk, r.m.s., deg/s^3", |f| f.joint_jerk_rms_deg_s3),
        ("joint behind the targets, ms", |f| f.delay_ms),
    ];
    for (name, value) in rows {
        println!("{name:44}{:>14.0}{:>14.0}", value(&report.with_program), value(&report.raw));
    }
}

/// Moves the robot with the program and without it, judges both motions, and draws them.
fn compare(args: &Args, config: &Config, episode: &Episode) -> Result<Report, Box<dyn std::error::Error>> {
    let address = config.robot.address.resolve()?;
    let options = LinkOptions::new(config, address);
    let series = match args.series {
        SeriesArg::Cb3 => Series::Cb3,
        SeriesArg::ESeries => Series::ESeries,
    };
    let targets = motion::targets(episode, options.rate_hz);
    let Some((end_s, _)) = targets.last().copied() else { return Err("the episode holds no targets; choose another one".into()) };
    let cycle_s = 1.0 / series.rate_hz();
    let with_program = motion::follow(&options, series, &program::text(&options, cycle_s, 1)?, &targets)?;
    let raw = motion::follow(&options, series, &motion::raw_program(&options, cycle_s), &targets)?;

    let to_s = if args.to > 0.0 { args.to.min(end_s) } else { end_s };
    if args.from >= to_s {
        return Err(format!("the episode ends after {end_s:.1} s: choose --from and --to within that time").into());
    }
    if let Some(parent) = args.out.parent() {
        std::fs::create_dir_all(parent)?;
    }
    let names = ["pour.script: interpolated on the robot", "raw: each target straight to servoj"];
    plots::motion::draw(&args.out, args.from..to_s, &[(names[0], &with_program), (names[1], &raw)])?;
    let [with_program, raw] = [with_program, raw].map(|cycles| motion::figures(&cycles));
    Ok(Report { targets: targets.len(), with_program, raw, picture: args.out.display().to_string() })
}
