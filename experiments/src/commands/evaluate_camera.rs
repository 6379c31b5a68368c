//! `experiments evaluate-camera`: measures the feature extraction against rendered truth.
//!
//! Each short scene is another cell: container, lip, camera pose, liquid, background, light, noise and blur are drawn from a seed, and its
//! liquid's colour is learned from one rendered pour as `feature-worker calibrate` does. Then a pour, or a dry container that tilts, is
//! rendered and measured. Runs of whole pours follow, and frames that nobody should trust. One thread; allocates freely. A failure is an
//! error of one line.

use std::collections::BTreeMap;
use std::path::PathBuf;

use indicatif::ProgressBar;
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use serde_json::{Value, json};
use shared::exit::{self, OrExit as _};
use simulator::camera::{Background, Scene};
use trainer::report::json_out::JsonOut;

use crate::camera_evaluation::cases::{Case, name};
use crate::camera_evaluation::doubts;
use crate::camera_evaluation::faults::{self, Chosen, FaultFrames, Hardship};
use crate::camera_evaluation::figures::{CameraFigures, Comparison, figures, reliability};
use crate::camera_evaluation::measure::measure;
use crate::camera_evaluation::scenes::{SHORT_FRAMES, short, whole_pours};
use crate::camera_evaluation::worst::Worst;
use crate::camera_setup::CameraError;

/// Pours in a row in a run of whole pours: about half a minute, after which a drift would show.
const POURS: usize = 3;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  experiments evaluate-camera\n  experiments evaluate-camera --frames 9600 --seed 2 --json out/camera.json\n  \
experiments evaluate-camera --frames 48 --runs 16 --method clear\n  experiments evaluate-camera --faults 10\n\n\
Prints the error of V_e for areas above 200 px^2 (median and 95th percentile of its size, bias), false flow on dry frames, missed flow \
(unnoticed: without a doubt) and the share of frames with a doubt, all by condition and over whole pours, and saves the worst 20 frames."
)]
pub struct Args {
    /// Frames of short scenes, half of them with coloured liquid and half with clear water.
    #[arg(long, default_value_t = 4800)]
    frames: usize,
    /// Runs of three whole pours, half of them with clear water, the backgrounds in turn (about 900 frames each).
    #[arg(long, default_value_t = 8)]
    runs: usize,
    /// Seed of everything that is drawn.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Prints all figures as JSON in place of the tables, or writes them to FILE beside them.
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = "-")]
    json: Option<PathBuf>,
    /// Directory of the worst frames.
    #[arg(long, default_value = "out/evaluate-camera")]
    out: PathBuf,
    /// Evaluates only this method: colour or clear.
    #[arg(long)]
    method: Option<String>,
    /// Instead of this, measure so many whole pours of each method through every fault of a camera.
    #[arg(long)]
    faults: Option<u64>,
    /// With --faults: only the faults whose name in the table begins so, such as Banding; `none` is the camera without a fault.
    #[arg(long, requires = "faults")]
    fault: Option<String>,
    /// With --faults: ask for so many times as many dry pictures before a stream counts as gone.
    #[arg(long, requires = "faults", default_value_t = 1.0)]
    patience: f32,
    /// With --faults: in all cells, this is hard too.
    #[arg(long, value_enum, requires = "faults")]
    hardship: Option<Hardship>,
    /// Write what was measured in every frame to this CSV file.
    #[arg(long)]
    frames_csv: Option<PathBuf>,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), exit::Failure> {
    let json = JsonOut::open(args.json.as_deref())?;
    let done = match args.faults {
        Some(pours) => evaluate_faults(args, pours, json.tables()),
        None => evaluate(args, json.tables()),
    };
    json.write(&done.or_exit(exit::FAILED)?)
}

/// Frames by method and condition, their number, and the worst of them.
#[derive(Default)]
struct Measured {
    groups: BTreeMap<String, Vec<Comparison>>,
    frames: usize,
    worst: Worst,
}

fn evaluate(args: &Args, tables: bool) -> Result<Value, CameraError> {
    let short_scenes = args.frames.div_ceil(SHORT_FRAMES).max(2);
    let bar = ProgressBar::new((short_scenes + args.runs) as u64).with_message("scenes");
    let mut all = Measured::default();
    for i in 0..short_scenes + args.runs {
        let method = if i % 2 == 1 { "clear" } else { "colour" };
        if args.method.as_deref().is_none_or(|m| m == method) {
            measure_case(args, method, i, i.checked_sub(short_scenes), &mut all)?;
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    all.worst.save(&args.out)?;

    let figures: BTreeMap<&str, CameraFigures> = all.groups.iter().map(|(name, frames)| (name.as_str(), figures(frames))).collect();
    if let Some(path) = &args.frames_csv {
        faults::write_frames(&all.groups, path)?;
    }
    let doubts = doubts::raised_percent(args.seed)?;
    if tables {
        print(&figures);
        print_reliability(&all.groups);
        println!("\nframes that nobody should trust, and the share for which the doubt was raised:");
        for (name, percent) in &doubts {
            println!("  {name:<24}{percent:>6.1} %");
        }
        println!("\nworst frames: {}", args.out.display());
    }
    Ok(json!({ "frames": all.frames, "seed": args.seed, "conditions": figures, "doubts_raised_percent": doubts }))
}

/// Measures `pours` whole pours of each method through every fault, and prints a line for each if `tables` are wanted.
fn evaluate_faults(args: &Args, pours: u64, tables: bool) -> Result<Value, CameraError> {
    let mut frames = FaultFrames::new();
    let bar = ProgressBar::new(2 * pours).with_message("pours");
    for (clear, method) in [(false, "colour"), (true, "clear")] {
        for i in 0..pours {
            if args.method.as_deref().is_none_or(|m| m == method) {
                faults::measure_cell(
                    clear,
                    i,
                    args.seed,
                    Chosen { only: args.fault.as_deref(), patience: args.patience, hardship: args.hardship },
                    &mut frames,
                )?;
            }
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    if tables {
        faults::print(&frames);
        print_reliability(&faults::by_ground(&frames));
    }
    if let Some(path) = &args.frames_csv {
        faults::write_frames(&frames, path)?;
    }
    let figures: BTreeMap<&str, CameraFigures> = frames.iter().map(|(name, frames)| (name.as_str(), figures(frames))).collect();
    Ok(json!({ "pours": pours, "seed": args.seed, "faults": figures }))
}

/// Measures the `i`-th cell: a short scene, or the `run`-th run of whole pours.
fn measure_case(args: &Args, method: &str, i: usize, run: Option<usize>, all: &mut Measured) -> Result<(), CameraError> {
    let seed = args.seed.wrapping_mul(1_000_003).wrapping_add(i as u64);
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    // Runs take the backgrounds in turn.
    let background = run.map(|run| Background::ALL[run / 2 % Background::ALL.len()]);
    let case = Case::draw(&mut random, method == "clear", background, seed)?;
    let (scenes, labels): (Vec<Scene>, Vec<String>) = match run {
        Some(_) => {
            let labels = vec!["whole pours".into(), format!("whole pours, {}", name(case.view.background))];
            (whole_pours(&mut random, seed, POURS), labels)
        }
        None => (short(&mut random, case.dry), [case.labels.clone(), vec!["all".into()]].concat()),
    };
    all.frames += scenes.len();
    measure(&case.view, &case.image, seed, &scenes, |frame| {
        for label in &labels {
            all.groups.entry(format!("{method}: {label}")).or_default().push(frame.comparison());
        }
        all.worst.add(method, &case, frame, &scenes[frame.number])
    })
}

/// Prints, by condition, how often areas with a confidence are right.
fn print_reliability(groups: &BTreeMap<String, Vec<Comparison>>) {
    println!("\nframes, their mean confidence and the share of areas within 20 % of the truth, by steps of confidence:");
    for (name, frames) in groups {
        for (kind, chosen) in [("stream seen", true), ("nothing seen", false)] {
            let frames: Vec<Comparison> = frames.iter().filter(|f| (f.area_px2 > 0.0) == chosen).copied().collect();
            let steps = reliability(&frames).into_iter().filter(|(n, ..)| *n > 0);
            let words: Vec<String> = steps.map(|(n, confidence, right)| format!("{n}: {confidence:.2} {right:.2}")).collect();
            println!("  {:<44}{}", format!("{name}, {kind}"), words.join("  "));
        }
    }
}

/// Prints the table of the conditions.
fn print(figures: &BTreeMap<&str, CameraFigures>) {
    println!(
        "{:<32}{:>7}{:>9}{:>8}{:>8}{:>8}{:>9}{:>12}{:>8}{:>8}{:>9}{:>10}{:>10}{:>8}",
        "condition",
        "frames",
        "median %",
        "p95 %",
        "bias %",
        "false %",
        "missed %",
        "unnoticed %",
        "doubt %",
        "wrong %",
        "dry d. %",
        "undist. %",
        "settled %",
        "dry s"
    );
    for (name, f) in figures {
        println!(
            "{name:<32}{:>7}{:>9.2}{:>8.2}{:>8.2}{:>8.2}{:>9.2}{:>12.2}{:>8.2}{:>8.2}{:>9.2}{:>10.2}{:>10.2}{:>8.2}  {}",
            f.frames,
            f.median_error_percent,
            f.p95_error_percent,
            f.bias_percent,
            f.false_flow_percent,
            f.missed_flow_percent,
            f.unnoticed_percent,
            f.doubt_percent,
            f.wrong_percent,
            f.dry_doubt_percent,
            f.undisturbed_doubt_percent,
            f.settled_doubt_percent,
            f.dry_after_p95_s,
            f.doubts
        );
    }
}
