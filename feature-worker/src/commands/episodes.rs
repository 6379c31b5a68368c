//! `feature-worker episodes`: lists, shows, checks, weighs and exports episodes.
//!
//! An ordinary command-line program on files alone; needs no running cell. Allocates. Files are changed by `weigh` only,
//! and by that in one step (see [`shared::episode::set_weight`]); nothing is ever overwritten by an export.

use std::path::{Path, PathBuf};

use clap::Subcommand;
use serde_json::{Value, json};
use shared::config::Config;
use shared::episode::{Episode, EpisodeError, EpisodeKind, EpisodeRow, WeighError, find_episodes, set_weight};
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::messages::Doubt;

pub mod export;
mod lerobot;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Lists episodes, one line each.
    #[command(after_help = "Examples:\n  feature-worker episodes list\n  feature-worker episodes list out/episodes --json")]
    List(Which),
    /// Shows one episode: what was run, from where, how many frames, how much flowed.
    #[command(after_help = "Example:\n  feature-worker episodes show out/episodes/episode-0001.mcap")]
    Show(Which),
    /// Says in words what is wrong with episodes; exit code 1 if any cannot be trained on.
    #[command(
        after_help = "Examples:\n  feature-worker episodes check\n  feature-worker episodes check out/episodes/episode-0001.mcap --json"
    )]
    Check(Which),
    /// Writes the scale's reading into an episode.
    #[command(after_help = "Example:\n  feature-worker episodes weigh out/episodes/episode-0001.mcap --weight 104")]
    Weigh(Weigh),
    /// Writes episodes as tables, images, videos or a LeRobot data set.
    #[command(after_help = "Examples:\n  feature-worker episodes export out/episodes --as csv --to out/table\n  \
        feature-worker episodes export out/episodes/episode-0001.mcap --as video --to out/video\n\n\
        csv:     features.csv and scale.csv, as `trainer train` takes them\n\
        images:  a directory of pictures an episode\n\
        video:   an MP4 an episode; a lost image repeats the one before\n\
        lerobot: one data set in the layout of LeRobot v3.0")]
    Export(export::Args),
}

/// Which episodes.
#[derive(Debug, clap::Args)]
pub struct Which {
    /// Episodes (.mcap) or directories of them; without any, the directory of `[recording]` in the configuration.
    pub paths: Vec<PathBuf>,
    /// The cell's configuration.
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    pub config: PathBuf,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

#[derive(Debug, clap::Args)]
struct Weigh {
    /// The episode (.mcap).
    file: PathBuf,
    /// The scale's reading, g.
    #[arg(long, value_name = "G", allow_negative_numbers = true)]
    weight: f64,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    match &args.command {
        Command::List(which) => with_files(which, list),
        Command::Show(which) => with_files(which, show),
        Command::Check(which) => with_files(which, check),
        Command::Weigh(weigh) => run_weigh(weigh),
        Command::Export(args) => export::run(args),
    }
}

/// The files meant.
pub(crate) fn files(paths: &[PathBuf], config: &Path) -> Result<Vec<PathBuf>, Failure> {
    let paths = match paths {
        [] => vec![Config::read(config).or_exit(exit::BAD_INPUT)?.recording.directory],
        given => given.to_vec(),
    };
    find_episodes(&paths).or_exit(exit::BAD_INPUT)
}

fn with_files(which: &Which, command: fn(&[PathBuf], bool) -> Result<(), Failure>) -> Result<(), Failure> {
    command(&files(&which.paths, &which.config)?, which.json)
}

fn kind_words(kind: EpisodeKind) -> String {
    match kind {
        EpisodeKind::Recording(c) => format!("curve lambda {} deg, gamma {} /s2, beta {} s", c.lambda_deg, c.gamma_per_s2, c.beta_s),
        EpisodeKind::Pour { goal_ml } => format!("pour of {goal_ml} ml"),
        EpisodeKind::Table => "table".into(),
    }
}

fn kind_json(kind: EpisodeKind) -> Value {
    match kind {
        EpisodeKind::Recording(c) => {
            json!({ "kind": "recording", "lambda_deg": c.lambda_deg, "gamma_per_s2": c.gamma_per_s2, "beta_s": c.beta_s })
        }
        EpisodeKind::Pour { goal_ml } => json!({ "kind": "pour", "goal_ml": goal_ml }),
        EpisodeKind::Table => json!({ "kind": "table" }),
    }
}

fn usable(frame: &&EpisodeRow) -> bool {
    !frame.area_px2.is_nan()
}

/// Everything about an episode but its frames.
fn summary(episode: &Episode) -> Value {
    let largest = |values: &mut dyn Iterator<Item = f32>| values.filter(|v| v.is_finite()).fold(0.0, f32::max);
    let area: f64 = episode.rows.iter().filter(usable).map(|f| f64::from(f.area_px2)).sum();
    let info = &episode.info;
    json!({
        "file": episode.name,
        "complete": episode.complete,
        "run": kind_json(episode.kind),
        "weight_g": episode.weight_g,
        "seconds": episode.seconds(),
        "frames": episode.rows.len(),
        "flow_frames": episode.rows.iter().filter(|f| f.area_px2 > 0.0).count(),
        "lost_frames": info.lost_frames,
        "doubtful_frames": doubts(episode).into_iter().map(|(doubt, n)| (doubt.words().to_string(), json!(n))).collect::<serde_json::Map<_, _>>(),
        "area_sum_px2": area,
        "area_max_px2": largest(&mut episode.rows.iter().map(|f| f.area_px2)),
        "alpha_max_deg": largest(&mut episode.rows.iter().map(|f| f.alpha_commanded_deg)),
        "images": info.images,
        "dropped_images": info.dropped_images,
        "ticks": info.ticks,
        "lost_ticks": info.lost_ticks,
        "ended": info.ended,
        "started_at_utc": info.started_at_utc,
        "started_at_ns": info.started_at_ns,
        "cell": info.cell,
        "config_sha256": info.config_sha256,
        "weights": info.weights,
        "content_sha256": episode.content_sha256().iter().map(|b| format!("{b:02x}")).collect::<String>(),
    })
}

/// How many frames have each doubt.
fn doubts(episode: &Episode) -> Vec<(Doubt, usize)> {
    let count = |doubt: Doubt| episode.rows.iter().filter(|f| f.doubt == doubt).count();
    Doubt::ALL.into_iter().filter(|d| *d != Doubt::None).map(|d| (d, count(d))).filter(|(_, n)| *n > 0).collect()
}

fn print_json(value: &Value) {
    println!("{value:#}");
}

fn list(files: &[PathBuf], as_json: bool) -> Result<(), Failure> {
    let read: Vec<Result<Episode, EpisodeError>> = files.iter().map(|f| Episode::read(f)).collect();
    if as_json {
        let rows: Vec<Value> = files
            .iter()
            .zip(&read)
            .map(|(file, r)| match r {
                Ok(episode) => summary(episode),
                Err(e) => json!({ "file": file.display().to_string(), "error": e.to_string() }),
            })
            .collect();
        print_json(&json!({ "episodes": rows }));
    } else {
        println!("{:<24} {:<20} {:>7} {:>6} {:>8}  {:<10} what", "episode", "started (UTC)", "seconds", "frames", "weight g", "state");
        for (file, result) in files.iter().zip(&read) {
            let name = file.file_name().unwrap_or(file.as_os_str()).to_string_lossy();
            match result {
                Ok(e) => println!(
                    "{name:<24} {:<20} {:>7.1} {:>6} {:>8}  {:<10} {}",
                    e.info.started_at_utc,
                    e.seconds(),
                    e.rows.len(),
                    e.weight_g.map_or("-".into(), |w| w.to_string()),
                    if e.complete { "complete" } else { "INCOMPLETE" },
                    kind_words(e.kind)
                ),
                Err(e) => println!("{name:<24} UNREADABLE: {e}"),
            }
        }
        println!("{} episodes", files.len());
    }
    match read.iter().filter(|r| r.is_err()).count() {
        0 => Ok(()),
        bad => Err(failure(exit::FAILED, format!("{bad} of {} episodes cannot be read", files.len()))),
    }
}

fn show(files: &[PathBuf], as_json: bool) -> Result<(), Failure> {
    let [file] = files else {
        return Err(failure(exit::BAD_INPUT, format!("{} episodes; name one file to show", files.len())));
    };
    let episode = Episode::read(file).or_exit(exit::BAD_INPUT)?;
    let value = summary(&episode);
    if as_json {
        print_json(&value);
        return Ok(());
    }
    println!("{}", file.display());
    println!("  run        {}", kind_words(episode.kind));
    println!("  started    {} in cell '{}'", episode.info.started_at_utc, episode.info.cell);
    println!("  weight     {}", episode.weight_g.map_or("not weighed yet".into(), |w| format!("{w} g")));
    println!("  state      {}", if episode.complete { "complete" } else { "INCOMPLETE" });
    println!("  frames     {} in {:.1} s, {} with flow", value["frames"], episode.seconds(), value["flow_frames"]);
    println!("  alpha      up to {:.1} deg", value["alpha_max_deg"].as_f64().unwrap_or(0.0));
    println!(
        "  V_e        up to {:.0} px2, in all {:.0} px2",
        value["area_max_px2"].as_f64().unwrap_or(0.0),
        value["area_sum_px2"].as_f64().unwrap_or(0.0)
    );
    println!("  images     {} ({} dropped)", episode.info.images, episode.info.dropped_images);
    println!("  ticks      {} ({} missing)", episode.info.ticks, episode.info.lost_ticks);
    println!("  config     {}", episode.info.config_sha256);
    println!("  weights    {}", if episode.info.weights.is_empty() { "none" } else { &episode.info.weights });
    for (bad, words) in remarks(&episode) {
        println!("  {} {words}", if bad { "WRONG     " } else { "note      " });
    }
    Ok(())
}

/// What is wrong with an episode, in words; true: it cannot be trained on.
fn remarks(episode: &Episode) -> Vec<(bool, String)> {
    let info = &episode.info;
    let mut all = Vec::new();
    let flow = episode.rows.iter().filter(|f| f.area_px2 > 0.0).count();
    if info.ended.is_empty() {
        all.push((true, "the recorder was killed before the end; record it again".to_string()));
    } else if !episode.complete {
        let last_s = episode.rows.last().map_or(0.0, |f| f.t_s);
        all.push((true, format!("incomplete: {}; the last frame is from {last_s:.1} s; record it again", info.ended)));
    }
    match episode.weight_g {
        None => all.push((true, "no weight yet: `feature-worker episodes weigh FILE --weight G`".into())),
        Some(w) if w > 3.0 && flow == 0 => all.push((true, format!("{w} g on the scale, but no frame shows flow: check [image]"))),
        Some(w) if w < 1.0 && flow > 5 => {
            all.push((true, format!("{flow} frames show flow, but the scale says {w} g: check weight and [image]")))
        }
        Some(w) if w < 1.0 => all.push((true, "nothing was poured: there is nothing to learn from it".into())),
        Some(_) => {}
    }
    if info.lost_frames > 0 {
        let longest = episode.rows.chunk_by(|a, b| a.lost == b.lost).filter(|c| c[0].lost).map(<[EpisodeRow]>::len).max().unwrap_or(0);
        all.push((false, format!("{} frames were lost, at most {longest} in a row", info.lost_frames)));
    }
    for (doubt, n) in doubts(episode) {
        let left = if doubt.usable() { "still used" } else { "not used" };
        all.push((false, format!("{n} frames are doubtful: {} ({left})", doubt.words())));
    }
    if info.dropped_images > 0 {
        all.push((false, format!("{} images were dropped; V_e is there for all of them", info.dropped_images)));
    }
    if info.lost_ticks > 0 {
        all.push((false, format!("{} ticks of the controller are missing", info.lost_ticks)));
    }
    let unknown = episode.rows.iter().filter(|f| f.alpha_measured_deg.is_nan()).count();
    if unknown > 0 {
        all.push((false, format!("the robot's measured alpha is unknown in {unknown} frames")));
    }
    all
}

fn check(files: &[PathBuf], as_json: bool) -> Result<(), Failure> {
    let mut rows: Vec<(String, Vec<(bool, String)>)> = Vec::new();
    let mut episodes = Vec::new();
    for file in files {
        let name = file.display().to_string();
        match Episode::read(file) {
            Ok(episode) => {
                rows.push((name, remarks(&episode)));
                episodes.push((rows.len() - 1, episode));
            }
            Err(e) => rows.push((name, vec![(true, e.to_string())])),
        }
    }
    let (places, plain): (Vec<usize>, Vec<Episode>) = episodes.into_iter().unzip();
    for (first, second) in Episode::duplicates(&plain) {
        let words = format!("the same measurement as {}; keep one of them", plain[first].name);
        rows[places[second]].1.push((true, words));
    }
    let wrong = rows.iter().filter(|(_, all)| all.iter().any(|(bad, _)| *bad)).count();
    if as_json {
        let words = |all: &[(bool, String)], bad: bool| all.iter().filter(|r| r.0 == bad).map(|r| r.1.clone()).collect::<Vec<_>>();
        let rows: Vec<Value> =
            rows.iter().map(|(file, all)| json!({ "file": file, "wrong": words(all, true), "notes": words(all, false) })).collect();
        print_json(&json!({ "episodes": rows, "usable": rows.len() - wrong }));
    } else {
        for (file, all) in &rows {
            println!("{file}: {}", if all.iter().any(|(bad, _)| *bad) { "WRONG" } else { "good" });
            for (bad, words) in all {
                println!("  {} {words}", if *bad { "wrong:" } else { "note: " });
            }
        }
        println!("{} of {} episodes can be trained on", rows.len() - wrong, rows.len());
    }
    match wrong {
        0 => Ok(()),
        wrong => Err(failure(exit::FAILED, format!("{wrong} of {} episodes cannot be trained on", rows.len()))),
    }
}

fn run_weigh(args: &Weigh) -> Result<(), Failure> {
    let code = |e: &WeighError| if matches!(e, WeighError::Write { .. }) { exit::FAILED } else { exit::BAD_INPUT };
    let before = set_weight(&args.file, args.weight).map_err(|e| failure(code(&e), e))?;
    if args.json {
        print_json(&json!({ "file": args.file.display().to_string(), "weight_g": args.weight, "before_g": before }));
    } else {
        let before = before.map_or("had none before".into(), |b| format!("was {b} g"));
        println!("{}: {} g ({before})", args.file.display(), args.weight);
    }
    Ok(())
}
