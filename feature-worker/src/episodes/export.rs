//! Writes episodes for other programs: as tables, pictures, videos or a LeRobot data set.
//!
//! Runs on the command's thread and allocates. Nothing that exists is overwritten, and every failure names its file.

use std::fs;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use indicatif::{ProgressBar, ProgressStyle};
use shared::episode::{Episode, EpisodeImages, write_table};
use shared::plural::counted;

use super::lerobot;
use super::output::{ExportError, LeftOut, all_free, disk_error};
use super::video::{Video, for_each_row_with_image, mean_rate_hz};

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
/// cannot be exported, is left out and returned. Shows its progress on the terminal.
pub fn export(files: &[PathBuf], format: ExportFormat, to: &Path) -> Result<Exported, ExportError> {
    let (mut episodes, mut left_out) = (Vec::new(), Vec::new());
    for file in files {
        match Episode::read(file) {
            Ok(episode) => episodes.push((file.clone(), episode)),
            Err(e) => left_out.push(LeftOut { file: file.clone(), why: e.to_string() }),
        }
    }
    if episodes.is_empty() {
        return Err(ExportError::Nothing(match left_out.first() {
            None => "no episodes to export; name .mcap files or a directory of them".into(),
            Some(first) => format!("none of {} can be read; {}", counted(files.len(), "episode"), first.why),
        }));
    }
    fs::create_dir_all(to).map_err(|e| disk_error(to, &e))?;
    if format == ExportFormat::Csv {
        let pair = [to.join("features.csv"), to.join("scale.csv")];
        let episodes: Vec<Episode> = episodes.into_iter().map(|(_, episode)| episode).collect();
        write_table(&episodes, &pair[0], &pair[1])?;
        return Ok(Exported { written: pair.into(), left_out });
    }
    let bar = progress(episodes.iter().map(|(_, e)| e.rows.len() as u64).sum());
    let mut written = Vec::new();
    if format == ExportFormat::Lerobot {
        left_out.append(&mut lerobot::write(&episodes, to, &bar)?);
        written.push(to.to_path_buf());
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
    Ok(Exported { written, left_out })
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
        for image in EpisodeImages::open(file)? {
            let image = image?;
            let extension = if image.format == "png" { "png" } else { "jpg" };
            let path = target.join(format!("frame-{:08}.{extension}", image.sequence));
            fs::write(&path, &image.data).map_err(|e| disk_error(&path, &e))?;
            bar.inc(1);
        }
        Ok(target.to_path_buf())
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
