//! Writes episodes for other programs: as tables, pictures, videos or a LeRobot data set.
//!
//! Runs on the command's thread and allocates. Nothing that exists is overwritten, and every failure names its file.

use std::fs;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use indicatif::{ProgressBar, ProgressStyle};
use shared::episode::{Episode, EpisodeImages, oldest_first, write_table};
use shared::plural::counted;

use super::lerobot;
use super::output::{ExportError, LeftOut, all_free, disk_error, unfit};
use super::video::{Video, for_each_row_with_image, mean_rate_hz};

/// The most files that the error of an export names of which nothing was written. Chosen by hand: a person reads the line.
const NAMED: usize = 8;

/// What an export writes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ExportFormat {
    /// The tables features.csv and scale.csv, as `trainer train` takes them.
    Csv,
    /// A directory of pictures for each episode.
    Images,
    /// An MP4 video for each episode; where an image is lost, the one before it is repeated.
    Video,
    /// One data set in the layout of LeRobot v3.0.
    Lerobot,
}

/// What an export wrote.
#[derive(Debug)]
pub struct Exported {
    /// The files or directories.
    pub written: Vec<PathBuf>,
    /// The episodes that could not be exported, in no way a reason to stop for the others.
    pub left_out: Vec<LeftOut>,
}

/// Writes the episodes of `files` into the directory `to`, which is made if it is missing. A file that cannot be read, or has pictures that
/// cannot be exported, is left out and returned, and so is an incomplete one where the format cannot say that it is. An error says why if nothing is
/// left. Shows its progress on the terminal.
pub fn export(files: &[PathBuf], format: ExportFormat, to: &Path) -> Result<Exported, ExportError> {
    let (mut episodes, mut left_out) = (Vec::new(), Vec::new());
    // Neither can say that an end is missing, and whoever learns from it would take it for a whole one.
    let whole = matches!(format, ExportFormat::Csv | ExportFormat::Lerobot);
    for file in files {
        match Episode::read(file) {
            Ok(episode) => match episode.lacks().filter(|_| whole) {
                Some(what) => {
                    let why = unfit(file, format!("it is incomplete ({what}); export it as images or as a video")).to_string();
                    left_out.push(LeftOut { file: file.clone(), why });
                }
                None => episodes.push((file.clone(), episode)),
            },
            Err(e) => left_out.push(LeftOut { file: file.clone(), why: e.to_string() }),
        }
    }
    if episodes.is_empty() {
        return Err(nothing(&left_out));
    }
    let made: Vec<&Path> = to.ancestors().filter(|directory| directory.symlink_metadata().is_err()).collect();
    let exported = fs::create_dir_all(to).map_err(|e| disk_error(to, &e)).and_then(|()| write(episodes, left_out, format, to));
    if exported.is_err() {
        // The innermost one comes first. What holds something stays.
        made.iter().for_each(|empty| drop(fs::remove_dir(empty)));
    }
    exported
}

/// Writes `episodes` into the directory `to`, as [`export`] says.
fn write(episodes: Vec<(PathBuf, Episode)>, mut left_out: Vec<LeftOut>, format: ExportFormat, to: &Path) -> Result<Exported, ExportError> {
    if format == ExportFormat::Csv {
        let pair = [to.join("features.csv"), to.join("scale.csv")];
        // A training takes the last ones for the newest, where something has changed.
        let episodes = oldest_first(episodes.into_iter().map(|(_, episode)| episode).collect());
        write_table(&episodes, &pair[0], &pair[1])?;
        return Ok(Exported { written: pair.into(), left_out });
    }
    let bar = progress(episodes.iter().map(|(_, e)| e.rows.len() as u64).sum());
    let mut written = Vec::new();
    if format == ExportFormat::Lerobot {
        if lerobot::write(&episodes, to, &bar, &mut left_out)? {
            written.push(to.to_path_buf());
        }
    } else {
        let ending = if format == ExportFormat::Video { ".mp4" } else { "" };
        let target = |file: &Path| {
            let mut name = file.file_stem().unwrap_or(file.as_os_str()).to_os_string();
            name.push(ending);
            to.join(name)
        };
        let targets: Vec<PathBuf> = episodes.iter().map(|(file, _)| target(file)).collect();
        all_free(to, targets.iter())?;
        for ((file, episode), target) in episodes.iter().zip(&targets) {
            let one = match format {
                ExportFormat::Video => video(file, episode, target, &bar),
                _ => pictures(file, target, &bar),
            };
            match one {
                Ok(path) => written.push(path),
                Err(e) if e.spares_others() => left_out.push(LeftOut { file: file.clone(), why: e.to_string() }),
                Err(e) => return Err(e),
            }
        }
    }
    bar.finish_and_clear();
    if written.is_empty() { Err(nothing(&left_out)) } else { Ok(Exported { written, left_out }) }
}

/// The error where no episode is exported, with what was left out and why.
fn nothing(left_out: &[LeftOut]) -> ExportError {
    if left_out.is_empty() {
        return ExportError::Nothing("no episodes to export; name .mcap files or a directory of them".into());
    }
    let mut whys: Vec<String> = left_out.iter().take(NAMED).map(|one| one.why.clone()).collect();
    if left_out.len() > NAMED {
        whys.push(format!("and {}", counted(left_out.len() - NAMED, "more file")));
    }
    ExportError::Nothing(format!("no episode can be exported; {}", whys.join("; ")))
}

fn progress(total: u64) -> ProgressBar {
    let bar = ProgressBar::new(total);
    if let Ok(style) = ProgressStyle::with_template("{wide_bar} {pos}/{len} images, {eta} left") {
        bar.set_style(style);
    }
    bar
}

/// Writes the images of one episode into the new directory `target`, as they were recorded.
fn pictures(file: &Path, target: &Path, bar: &ProgressBar) -> Result<PathBuf, ExportError> {
    fs::create_dir(target).map_err(|e| disk_error(target, &e))?;
    let write = || {
        let mut written = 0;
        for image in EpisodeImages::open(file)? {
            let image = image?;
            let extension = if image.format == "png" { "png" } else { "jpg" };
            let path = target.join(format!("frame-{:08}.{extension}", image.sequence));
            fs::write(&path, &image.data).map_err(|e| disk_error(&path, &e))?;
            bar.inc(1);
            written += 1;
        }
        if written == 0 { Err(unfit(file, "the episode has no images")) } else { Ok(target.to_path_buf()) }
    };
    write().inspect_err(|_| {
        // It was not there before, so it is ours, and a part of an episode would look like all of it.
        let _ = fs::remove_dir_all(target);
    })
}

/// Writes the images of one episode as the new video `target`.
fn video(file: &Path, episode: &Episode, target: &Path, bar: &ProgressBar) -> Result<PathBuf, ExportError> {
    let mut video = Video::new(file, target, mean_rate_hz(episode));
    let shown = for_each_row_with_image(file, episode, |image| {
        bar.inc(1);
        video.push(image).map(|_| ())
    });
    if let Err(e) = shown.and_then(|()| video.finish()) {
        // It was not there before, so it is ours, and half a video would look like a whole one.
        let _ = fs::remove_file(target);
        return Err(e);
    }
    Ok(target.to_path_buf())
}
