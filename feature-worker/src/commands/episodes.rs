//! `feature-worker episodes`: lists, shows, checks, weighs and exports episodes, and what else people do with them.
//!
//! An ordinary command-line program that works on files alone; no cell needs to run. Allocates. Only `weigh` and `note` change a file, and
//! they do so in one step (see [`shared::episode::set_weight`]). An export never overwrites anything.

use std::path::{Path, PathBuf};

use clap::Subcommand;
use serde_json::{Value, json};
use shared::episode::{Episode, EpisodeError, EpisodeKind, set_weight};
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::level::plain;
use shared::plural::counted;

use crate::episodes::export::{ExportFormat, Exported, export};
use crate::episodes::output::ExportError;
use crate::episodes::summary::{Remark, about_weight, remarks, summary};

mod keep;
mod which;

use which::{WhichArgs, change_failure, files, print_json};

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
    List(WhichArgs),
    /// Shows one episode: what was run, from where, how many frames, how much flowed.
    #[command(after_help = "Example:\n  feature-worker episodes show out/episodes/episode-0001.mcap")]
    Show(WhichArgs),
    /// Says in words what is wrong with episodes. The exit code is 1 if any of them cannot be trained on.
    #[command(
        after_help = "Examples:\n  feature-worker episodes check\n  feature-worker episodes check out/episodes/episode-0001.mcap --json"
    )]
    Check(WhichArgs),
    /// Writes the scale's reading into an episode.
    #[command(after_help = "Example:\n  feature-worker episodes weigh out/episodes/episode-0001.mcap --weight 104")]
    Weigh(WeighArgs),
    /// Writes episodes as tables, images, videos or a LeRobot data set. A file that cannot be read, or whose pictures or rate do not fit, is
    /// left out and said at the end; the exit code is then 1.
    #[command(after_help = "Examples:\n  feature-worker episodes export out/episodes --as csv --to out/table\n  \
        feature-worker episodes export out/episodes/episode-0001.mcap --as video --to out/video")]
    Export(ExportArgs),
    #[command(flatten)]
    Keep(keep::Command),
}

#[derive(Debug, clap::Args)]
struct WeighArgs {
    /// The episode (.mcap).
    file: PathBuf,
    /// The scale's reading, g.
    #[arg(long, value_name = "G", allow_negative_numbers = true)]
    weight: f64,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, clap::Args)]
struct ExportArgs {
    #[command(flatten)]
    which: WhichArgs,
    /// What to write.
    #[arg(long = "as", value_enum)]
    format: ExportFormat,
    /// The directory to write into. It is made if it is missing.
    #[arg(long, value_name = "DIR")]
    to: PathBuf,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    match &args.command {
        Command::List(which) => list(&files(which)?, which.json),
        Command::Show(which) => show(&files(which)?, which.json),
        Command::Check(which) => check(&files(which)?, which.json),
        Command::Weigh(args) => weigh(args),
        Command::Export(args) => run_export(args),
        Command::Keep(command) => keep::run(command),
    }
}

fn kind_words(kind: EpisodeKind) -> String {
    match kind {
        EpisodeKind::Recording(c) => format!("curve lambda {} deg, gamma {} /s2, beta {} s", c.lambda_deg, c.gamma_per_s2, c.beta_s),
        EpisodeKind::Pour { goal_ml } => format!("pour of {goal_ml} ml"),
        EpisodeKind::Table => "table".into(),
    }
}

fn list(files: &[PathBuf], as_json: bool) -> Result<(), Failure> {
    let read: Vec<Result<Episode, EpisodeError>> = files.iter().map(|f| Episode::read(f)).collect();
    if as_json {
        let line = |(file, result): (&PathBuf, &Result<Episode, EpisodeError>)| match result {
            Ok(episode) => summary(episode),
            Err(e) => json!({ "file": file.display().to_string(), "error": e.to_string() }),
        };
        print_json(&json!({ "episodes": files.iter().zip(&read).map(line).collect::<Vec<_>>() }));
    } else {
        println!("{:<24} {:<20} {:>7} {:>6} {:>8}  {:<10} what", "episode", "started (UTC)", "seconds", "frames", "weight g", "state");
        for (file, result) in files.iter().zip(&read) {
            let name = file.file_name().unwrap_or(file.as_os_str()).to_string_lossy();
            let name = plain(&name);
            match result {
                Ok(e) => println!(
                    "{name:<24} {:<20} {:>7.1} {:>6} {:>8}  {:<10} {}",
                    plain(&e.info.started_at_utc),
                    e.seconds(),
                    e.rows.len(),
                    e.weight_g.map_or("-".into(), |w| w.to_string()),
                    if e.complete { "complete" } else { "INCOMPLETE" },
                    kind_words(e.kind)
                ),
                Err(e) => println!("{name:<24} UNREADABLE: {}", plain(&e.to_string())),
            }
        }
        println!("{}", counted(files.len(), "episode"));
    }
    match read.iter().filter(|r| r.is_err()).count() {
        0 => Ok(()),
        bad => Err(failure(exit::FAILED, format!("{bad} of {} cannot be read", counted(files.len(), "episode")))),
    }
}

fn show(files: &[PathBuf], as_json: bool) -> Result<(), Failure> {
    let [file] = files else {
        return Err(failure(exit::BAD_INPUT, format!("{} found; name one file to show", counted(files.len(), "episode"))));
    };
    let episode = Episode::read(file).or_exit(exit::BAD_INPUT)?;
    let value = summary(&episode);
    if as_json {
        print_json(&value);
        return Ok(());
    }
    println!("{}", plain(&file.display().to_string()));
    println!("  run        {}", kind_words(episode.kind));
    println!("  started    {} in cell '{}'", plain(&episode.info.started_at_utc), plain(&episode.info.cell));
    if !episode.info.note.is_empty() {
        println!("  note       {}", plain(&episode.info.note));
    }
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
    println!("  config     {}", plain(&episode.info.config_sha256));
    println!("  weights    {}", if episode.info.weights.is_empty() { "none".into() } else { plain(&episode.info.weights) });
    for remark in remarks(&episode) {
        println!("  {} {}", if remark.is_wrong { "WRONG     " } else { "note      " }, plain(&remark.text));
    }
    Ok(())
}

/// One file and what is said about it.
struct CheckedFile {
    name: String,
    remarks: Vec<Remark>,
}

impl CheckedFile {
    fn is_wrong(&self) -> bool {
        self.remarks.iter().any(|r| r.is_wrong)
    }

    /// The remarks that are wrong, or those that are not.
    fn texts(&self, wrong: bool) -> Vec<&str> {
        self.remarks.iter().filter(|r| r.is_wrong == wrong).map(|r| r.text.as_str()).collect()
    }
}

/// Reads each file and says what is wrong with it. A file that holds the same measurement as an earlier one is wrong too.
fn checked(files: &[PathBuf]) -> Vec<CheckedFile> {
    let mut all: Vec<CheckedFile> = Vec::new();
    let (mut places, mut episodes) = (Vec::new(), Vec::new());
    for file in files {
        let name = file.display().to_string();
        match Episode::read(file) {
            Ok(episode) => {
                places.push(all.len());
                all.push(CheckedFile { name, remarks: remarks(&episode) });
                episodes.push(episode);
            }
            Err(e) => all.push(CheckedFile { name, remarks: vec![Remark::wrong(e.to_string())] }),
        }
    }
    for (index, first) in Episode::first_of_measurement(&episodes).into_iter().enumerate().filter(|(index, first)| index != first) {
        let text = format!("the same measurement as {}; keep one of them", episodes[first].name);
        all[places[index]].remarks.push(Remark::wrong(text));
    }
    all
}

fn check(files: &[PathBuf], as_json: bool) -> Result<(), Failure> {
    let all = checked(files);
    let wrong = all.iter().filter(|f| f.is_wrong()).count();
    if as_json {
        let line = |f: &CheckedFile| json!({ "file": f.name, "wrong": f.texts(true), "notes": f.texts(false) });
        print_json(&json!({ "episodes": all.iter().map(line).collect::<Vec<_>>(), "usable": all.len() - wrong }));
    } else {
        for file in &all {
            println!("{}: {}", plain(&file.name), if file.is_wrong() { "WRONG" } else { "good" });
            for remark in &file.remarks {
                println!("  {} {}", if remark.is_wrong { "wrong:" } else { "note: " }, plain(&remark.text));
            }
        }
        println!("{} of {} can be trained on", all.len() - wrong, counted(all.len(), "episode"));
    }
    match wrong {
        0 => Ok(()),
        wrong => Err(failure(exit::FAILED, format!("{wrong} of {} cannot be trained on", counted(all.len(), "episode")))),
    }
}

fn weigh(args: &WeighArgs) -> Result<(), Failure> {
    // A negative zero is none on any scale.
    let weight = args.weight + 0.0;
    let before = set_weight(&args.file, weight).map_err(|e| change_failure(&e))?;
    if args.json {
        print_json(&json!({ "file": args.file.display().to_string(), "weight_g": weight, "before_g": before }));
    } else {
        let before = before.map_or("had none before".into(), |b| format!("was {b} g"));
        println!("{}: {weight} g ({before})", plain(&args.file.display().to_string()));
    }
    if let Some(remark) = Episode::read(&args.file).ok().as_ref().and_then(about_weight) {
        eprintln!("{}: {}", if remark.is_wrong { "warning" } else { "note" }, remark.text);
    }
    Ok(())
}

fn run_export(args: &ExportArgs) -> Result<(), Failure> {
    let code = |e: &ExportError| match e {
        ExportError::Episode(_) | ExportError::Unfit { .. } | ExportError::Nothing(_) => exit::BAD_INPUT,
        ExportError::Table(_) | ExportError::Write { .. } => exit::FAILED,
    };
    let shown = |path: &Path| path.display().to_string();
    let Exported { written, left_out } = export(&files(&args.which)?, args.format, &args.to).map_err(|e| failure(code(&e), e))?;
    if args.which.json {
        let left_out: Vec<Value> = left_out.iter().map(|l| json!({ "file": shown(&l.file), "why": l.why })).collect();
        print_json(&json!({ "written": written.iter().map(|p| shown(p)).collect::<Vec<_>>(), "left_out": left_out }));
    } else {
        for path in &written {
            println!("{}", plain(&shown(path)));
        }
        for one in &left_out {
            println!("left out: {}", plain(&one.why));
        }
    }
    match left_out.len() {
        0 => Ok(()),
        n => Err(failure(exit::FAILED, format!("{} left out; the others are exported", counted(n, "episode")))),
    }
}
