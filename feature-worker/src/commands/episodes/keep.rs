//! `feature-worker episodes note`, `recover`, `delete`, `prune`, `split` and `merge`: what people do with episodes beside reading them.
//!
//! An ordinary command-line program that works on files alone; no cell needs to run. Allocates. What would be deleted is said first, and is
//! deleted only with `--yes`. An episode itself is never split: its weight belongs to all of it.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use shared::config::Config;
use shared::episode::{each_once, find_episodes, recover, set_note};
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::level::plain;
use shared::plural::counted;
use shared::whole_file;

use super::which::{WhichArgs, change_failure, files, places, print_json};
use crate::episodes::folder::{Budget, Folder, MEGABYTE};
use crate::episodes::output::{ExportError, LeftOut};
use crate::episodes::upkeep::{self, Copied, Found};

/// The commands.
#[derive(Debug, clap::Subcommand)]
pub(super) enum Command {
    /// Writes a note into an episode, in place of any that was there.
    #[command(after_help = "Example:\n  feature-worker episodes note out/episodes/episode-0001.mcap --text 'the cup stood askew'")]
    Note(NoteArgs),
    /// Makes a whole file of one that was cut, because its recorder was killed or the power failed. The old file stays.
    #[command(after_help = "Example:\n  feature-worker episodes recover out/episodes/episode-0001.mcap --to out/episodes/recovered.mcap")]
    Recover(RecoverArgs),
    /// Deletes episodes. Without --yes it only says what it would delete. Never another file, never one that is being written.
    #[command(after_help = "Example:\n  feature-worker episodes delete out/episodes/episode-0001.mcap --yes")]
    Delete(DeleteArgs),
    /// Deletes episodes until the rest is within the budget of `[recording]`. Without --yes it only says what it would delete. First go those
    /// whose end is missing, then those that were never weighed, the oldest first; the newest of all stays. Files that are kept because they
    /// cannot be read or are being written count too. What a program that was killed has left in the directories goes as well, a day later. The exit
    /// code is 1 if the rest is still over the budget, or one cannot be deleted.
    #[command(after_help = "Examples:\n  feature-worker episodes prune\n  feature-worker episodes prune --budget-mb 20000 --yes")]
    Prune(PruneArgs),
    /// Copies episodes into directories by shares, for example to train and to judge. Each episode goes into one, the same with the same seed.
    #[command(after_help = "Example:\n  feature-worker episodes split out/episodes --to out/parts --share train=0.8 --share check=0.2")]
    Split(SplitArgs),
    /// Copies the episodes of several directories into one, with new numbers. The same measurement twice is copied once, with its weight. What
    /// cannot be read or is being written is left out; the exit code is then 1, as with split.
    #[command(after_help = "Example:\n  feature-worker episodes merge monday tuesday --to week")]
    Merge(MergeArgs),
}

#[derive(Debug, clap::Args)]
pub(super) struct NoteArgs {
    /// The episode (.mcap).
    file: PathBuf,
    /// The note; an empty text takes it away.
    #[arg(long)]
    text: String,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, clap::Args)]
pub(super) struct RecoverArgs {
    /// The file that was cut (.mcap).
    file: PathBuf,
    /// The new file; without it, the old name with `-recovered` at its end.
    #[arg(long, value_name = "FILE")]
    to: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, clap::Args)]
pub(super) struct DeleteArgs {
    /// Episodes (.mcap).
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Delete them.
    #[arg(long)]
    yes: bool,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, clap::Args)]
pub(super) struct PruneArgs {
    #[command(flatten)]
    which: WhichArgs,
    /// Megabytes that may stay, in place of `recording.budget_mb`; 0 for no bound.
    #[arg(long, value_name = "MB")]
    budget_mb: Option<u64>,
    /// Number of episodes that may stay, in place of `recording.budget_episodes`; 0 for no bound.
    #[arg(long, value_name = "N")]
    budget_episodes: Option<usize>,
    /// Delete weighed episodes too, after all others.
    #[arg(long)]
    weighed: bool,
    /// Delete them.
    #[arg(long)]
    yes: bool,
}

#[derive(Debug, clap::Args)]
pub(super) struct SplitArgs {
    #[command(flatten)]
    which: WhichArgs,
    /// The directory for the parts.
    #[arg(long, value_name = "DIR")]
    to: PathBuf,
    /// A part's name and its share of the episodes; several, together at most 1.
    #[arg(long = "share", value_name = "NAME=SHARE", value_parser = share, required = true)]
    shares: Vec<(String, f64)>,
    /// Another seed draws other parts.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

#[derive(Debug, clap::Args)]
pub(super) struct MergeArgs {
    /// Episodes (.mcap) or directories of them.
    #[arg(required = true)]
    paths: Vec<PathBuf>,
    /// The directory for the copies.
    #[arg(long, value_name = "DIR")]
    to: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Reads `NAME=SHARE`.
fn share(text: &str) -> Result<(String, f64), String> {
    let (name, share) = text.split_once('=').ok_or("write NAME=SHARE, such as train=0.8")?;
    let plain = !name.is_empty() && name.chars().all(|c| c.is_alphanumeric() || c == '-' || c == '_');
    match share.parse::<f64>() {
        _ if !plain => Err(format!("'{name}' is not a plain name")),
        Ok(share) if share > 0.0 && share <= 1.0 => Ok((name.into(), share)),
        _ => Err(format!("'{share}' is not a share above 0 and at most 1")),
    }
}

/// Runs a command.
pub(super) fn run(command: &Command) -> Result<(), Failure> {
    match command {
        Command::Note(args) => note(args),
        Command::Recover(args) => run_recover(args),
        Command::Delete(args) => delete(args),
        Command::Prune(args) => prune(args),
        Command::Split(args) => split(args),
        Command::Merge(args) => {
            let files = find_episodes(&args.paths).or_exit(exit::BAD_INPUT)?;
            tell_copied(&upkeep::merge(&files, &args.to).map_err(|e| work_failure(&e))?, args.json)
        }
    }
}

fn shown(path: &Path) -> String {
    path.display().to_string()
}

fn work_failure(e: &ExportError) -> Failure {
    failure(if matches!(e, ExportError::Write { .. }) { exit::FAILED } else { exit::BAD_INPUT }, e)
}

fn note(args: &NoteArgs) -> Result<(), Failure> {
    let before = set_note(&args.file, &args.text).map_err(|e| change_failure(&e))?;
    if args.json {
        print_json(&json!({ "file": shown(&args.file), "note": args.text, "before": before }));
    } else {
        let before = if before.is_empty() { "had none before".into() } else { format!("was '{before}'") };
        println!("{}", plain(&format!("{}: '{}' ({before})", shown(&args.file), args.text)));
    }
    Ok(())
}

fn run_recover(args: &RecoverArgs) -> Result<(), Failure> {
    let new = args.to.clone().unwrap_or_else(|| {
        let mut name = args.file.file_stem().unwrap_or_default().to_os_string();
        name.push("-recovered.mcap");
        args.file.with_file_name(name)
    });
    let episode = recover(&args.file, &new).map_err(|e| change_failure(&e))?;
    let (frames, seconds) = (episode.rows.len(), episode.seconds());
    if args.json {
        print_json(&json!({ "file": shown(&new), "frames": frames, "seconds": seconds, "complete": episode.complete }));
    } else {
        let state = episode.lacks().map_or("nothing is missing".into(), |what| format!("{what}, so it cannot be trained on"));
        println!("{}: {} in {seconds:.1} s; {state}", plain(&shown(&new)), counted(frames, "frame"));
    }
    Ok(())
}

/// Looks at `files`: those that may be deleted, and why others may not.
fn look(files: &[PathBuf]) -> (Vec<Found>, Vec<LeftOut>) {
    let (mut found, mut kept) = (Vec::new(), Vec::new());
    for file in files {
        match upkeep::look(file) {
            Ok(one) => found.push(one),
            Err(why) => kept.push(why),
        }
    }
    (found, kept)
}

/// Deletes the episodes of `going` if `yes`. Those that cannot be deleted go to `kept`, with the reason, and the others are deleted all the same.
/// Returns how many could not be.
fn delete_all(going: &mut Vec<&Found>, kept: &mut Vec<LeftOut>, yes: bool) -> usize {
    let before = kept.len();
    if yes {
        going.retain(|one| match upkeep::delete(one) {
            Ok(()) => true,
            Err(e) => {
                kept.push(LeftOut { file: one.path.clone(), why: e.to_string() });
                false
            }
        });
    }
    kept.len() - before
}

/// The same for what programs that were killed have left.
fn delete_left_over(left_over: &mut Vec<PathBuf>, kept: &mut Vec<LeftOut>, yes: bool) -> usize {
    let before = kept.len();
    if yes {
        left_over.retain(|path| match std::fs::remove_file(path) {
            Ok(()) => true,
            Err(e) => {
                kept.push(LeftOut { file: path.clone(), why: format!("{}: {e}", path.display()) });
                false
            }
        });
    }
    kept.len() - before
}

fn as_json(going: &[&Found], left_over: &[PathBuf], kept: &[LeftOut], yes: bool) -> Value {
    let gone = |f: &&Found| json!({ "file": shown(&f.path), "bytes": f.bytes, "weight_g": f.episode.weight_g });
    json!({
        "deleted": yes && (!going.is_empty() || !left_over.is_empty()),
        "episodes": going.iter().map(gone).collect::<Vec<_>>(),
        "left_over": left_over.iter().map(|path| shown(path)).collect::<Vec<_>>(),
        "kept": kept.iter().map(|k| json!({ "file": shown(&k.file), "why": k.why })).collect::<Vec<_>>(),
    })
}

fn tell(going: &[&Found], left_over: &[PathBuf], kept: &[LeftOut], yes: bool) {
    let what = if yes { "deleted" } else { "would delete" };
    for one in going {
        let weight = one.episode.weight_g.map_or("never weighed".into(), |w| format!("{w} g"));
        println!(
            "{what} {} ({:.1} MB, {weight}, {})",
            plain(&shown(&one.path)),
            one.bytes as f64 / MEGABYTE as f64,
            plain(&one.episode.info.started_at_utc)
        );
    }
    for path in left_over {
        println!("{what} {} (left by a program that was killed)", plain(&shown(path)));
    }
    for one in kept {
        println!("kept: {}", plain(&one.why));
    }
    let something = !going.is_empty() || !left_over.is_empty();
    if something && !yes {
        println!("nothing was deleted; say --yes to do it");
    }
}

fn delete(args: &DeleteArgs) -> Result<(), Failure> {
    let files = each_once(args.files.clone());
    let (found, mut kept) = look(&files);
    let mut going: Vec<&Found> = found.iter().collect();
    let undeleted = delete_all(&mut going, &mut kept, args.yes);
    if args.json {
        print_json(&as_json(&going, &[], &kept, args.yes));
    } else {
        tell(&going, &[], &kept, args.yes);
    }
    match kept.len() {
        0 => Ok(()),
        n => {
            let code = if undeleted > 0 { exit::FAILED } else { exit::BAD_INPUT };
            Err(failure(code, format!("not deleted: {n} of {}", files.len())))
        }
    }
}

fn prune(args: &PruneArgs) -> Result<(), Failure> {
    let which = &args.which;
    let configured = match (args.budget_mb, args.budget_episodes) {
        (Some(_), Some(_)) => None,
        // The usual file need not be there for what is said in full: where, and how much.
        (Some(_), _) | (_, Some(_)) if !which.paths.is_empty() && which.is_unconfigured() => None,
        _ => Some(Config::read(&which.config).or_exit(exit::BAD_INPUT)?.recording),
    };
    let budget = Budget {
        bytes: args.budget_mb.or(configured.as_ref().map(|r| r.budget_mb)).unwrap_or(0).saturating_mul(MEGABYTE),
        episodes: args.budget_episodes.or(configured.as_ref().map(|r| r.budget_episodes)).unwrap_or(0),
    };
    let none = budget.is_none();
    let files = files(&args.which)?;
    // A name that is wrong would else hold every budget, night after night.
    for file in &files {
        file.symlink_metadata().map_err(|e| format!("{}: {e}", file.display())).or_exit(exit::BAD_INPUT)?;
    }
    let (found, mut kept) = look(&files);
    let beside = Folder::of(kept.iter().map(|k| k.file.as_path()));
    let mut going: Vec<&Found> = upkeep::to_prune(&found, beside, budget, args.weighed).into_iter().map(|i| &found[i]).collect();
    let undeleted = delete_all(&mut going, &mut kept, args.yes);
    let mut left_over = each_once(places(which)?.iter().flat_map(|place| whole_file::left_over(place)).collect());
    let undeleted = undeleted + delete_left_over(&mut left_over, &mut kept, args.yes);
    let bytes = found.iter().map(|f| f.bytes).sum::<u64>() - going.iter().map(|f| f.bytes).sum::<u64>() + beside.bytes;
    let stay = found.len() - going.len() + beside.episodes;
    let holds = budget.holds(stay, bytes);
    if args.which.json {
        let mut value = as_json(&going, &left_over, &kept, args.yes);
        value["stay"] = json!({ "episodes": stay, "bytes": bytes, "within_budget": holds });
        value["budget"] = json!({ "episodes": budget.episodes, "bytes": budget.bytes });
        print_json(&value);
    } else {
        tell(&going, &left_over, &kept, args.yes);
        let of_them = if beside.episodes > 0 { format!(", {} of them kept for the reasons above", beside.episodes) } else { String::new() };
        println!("{} of {:.1} MB left{of_them}", counted(stay, "episode"), bytes as f64 / MEGABYTE as f64);
        if none {
            println!("there is no budget: set recording.budget_mb or recording.budget_episodes, or say --budget-mb or --budget-episodes");
        }
    }
    if undeleted > 0 {
        return Err(failure(exit::FAILED, format!("{} could not be deleted", counted(undeleted, "file"))));
    }
    if holds {
        return Ok(());
    }
    if upkeep::is_out_of_reach(&found, beside, budget) {
        let what = "the files that are listed as kept break the budget by themselves, so nothing is deleted: move what is no episode elsewhere, or raise the budget";
        return Err(failure(exit::FAILED, what));
    }
    let weighed = if args.weighed { "" } else { "; weighed ones are kept without --weighed" };
    Err(failure(exit::FAILED, format!("what stays is over the budget{weighed}; the newest, and what is listed as kept, always stay")))
}

fn split(args: &SplitArgs) -> Result<(), Failure> {
    let sum: f64 = args.shares.iter().map(|(_, share)| share).sum();
    let mut names: Vec<&String> = args.shares.iter().map(|(name, _)| name).collect();
    names.sort();
    names.dedup();
    if sum > 1.0 + 1e-9 || names.len() < args.shares.len() {
        return Err(failure(exit::BAD_INPUT, format!("the shares add up to {sum}, or a name comes twice; they may take 1 together")));
    }
    tell_copied(&upkeep::split(&files(&args.which)?, &args.to, &args.shares, args.seed).map_err(|e| work_failure(&e))?, args.which.json)
}

/// Says what was copied. A file that cannot be read or is under way makes the exit code 1; one that is there twice does not.
fn tell_copied(copied: &Copied, as_json: bool) -> Result<(), Failure> {
    if as_json {
        let files = copied.files.iter().map(|(from, to)| json!({ "from": shown(from), "to": shown(to) }));
        let left_out = copied.left_out.iter().map(|l| json!({ "file": shown(&l.file), "why": l.why }));
        print_json(&json!({ "copied": files.collect::<Vec<_>>(), "left_out": left_out.collect::<Vec<_>>() }));
    } else {
        for (from, to) in &copied.files {
            println!("{} -> {}", plain(&shown(from)), plain(&shown(to)));
        }
        for one in &copied.left_out {
            println!("left out: {}", plain(&one.why));
        }
    }
    match copied.missing {
        0 => Ok(()),
        n => Err(failure(exit::FAILED, format!("{} left out; {} copied", counted(n, "file"), copied.files.len()))),
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, SystemTime};

    use super::*;

    /// Protects the disk from what killed programs leave, which is as large as an episode: it goes where it is wanted, and what is being written stays.
    #[test]
    fn what_killed_programs_have_left_is_pruned() {
        let dir = tempfile::tempdir().unwrap();
        let [left, written] = ["1", "2"].map(|n| dir.path().join(format!(".decant-12-{n}.new")));
        for (path, hours) in [(&left, 25), (&written, 1)] {
            std::fs::write(path, "a part").unwrap();
            let file = std::fs::File::open(path).unwrap();
            file.set_modified(SystemTime::now() - Duration::from_secs(hours * 3600)).unwrap();
        }
        for yes in [false, true] {
            let which = WhichArgs { paths: vec![dir.path().into()], config: "none.toml".into(), json: false };
            let args = PruneArgs { which, budget_mb: Some(0), budget_episodes: Some(0), weighed: false, yes };
            assert!(prune(&args).is_ok());
            assert_eq!((left.exists(), written.exists()), (!yes, true));
        }
    }
}
