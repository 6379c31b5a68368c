//! Writes episodes for other programs: as tables, pictures, videos or a LeRobot data set.
//!
//! Runs on the command's thread and allocates. Nothing that exists is overwritten, and every failure names its file.

use std::fs;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use indicatif::{ProgressBar, ProgressStyle};
use shared::episode::{Episode, EpisodeImages, write_table};

use super::lerobot;
use super::output::{ExportError, write_error};
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

/// Writes the episodes of `files` into the directory `to`, which is made if it is missing. Returns the paths that were written. Shows its
/// progress on the terminal.
pub fn export(files: &[PathBuf], format: ExportFormat, to: &Path) -> Result<Vec<PathBuf>, ExportError> {
    if files.is_empty() {
        return Err(ExportError::Nothing("no episodes to export; name .mcap files or a directory of them".into()));
    }
    fs::create_dir_all(to).map_err(|e| write_error(to, e))?;
    let episodes = files.iter().map(|f| Episode::read(f)).collect::<Result<Vec<_>, _>>()?;
    if format == ExportFormat::Csv {
        let pair = [to.join("features.csv"), to.join("scale.csv")];
        write_table(&episodes, &pair[0], &pair[1])?;
        return Ok(pair.into());
    }
    let bar = progress(episodes.iter().map(|e| e.rows.len() as u64).sum());
    let written = match format {
        ExportFormat::Lerobot => {
            lerobot::write(files, &episodes, to, &bar)?;
            vec![to.to_path_buf()]
        }
        _ => {
            let mut written = Vec::new();
            for (file, episode) in files.iter().zip(&episodes) {
                let target = to.join(file.file_stem().unwrap_or(file.as_os_str()));
                written.push(match format {
                    ExportFormat::Video => video(file, episode, &target.with_extension("mp4"), &bar)?,
                    _ => pictures(file, &target, &bar)?,
                });
            }
            written
        }
    };
    bar.finish_and_clear();
    Ok(written)
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
    fs::create_dir(target).map_err(|e| write_error(target, e))?;
    for image in EpisodeImages::open(file)? {
        let image = image?;
        let extension = if image.format == "png" { "png" } else { "jpg" };
        let path = target.join(format!("frame-{:08}.{extension}", image.sequence));
        fs::write(&path, &image.data).map_err(|e| write_error(&path, e))?;
        bar.inc(1);
    }
    Ok(target.to_path_buf())
}

/// Writes the images of one episode as the new video `target`.
fn video(file: &Path, episode: &Episode, target: &Path, bar: &ProgressBar) -> Result<PathBuf, ExportError> {
    if target.exists() {
        return Err(write_error(target, "is there already; name another directory"));
    }
    let mut video = Video::new(target, mean_rate_hz(episode));
    for_each_row_with_image(file, episode, |image| {
        bar.inc(1);
        video.push(image)
    })?;
    video.finish()?;
    Ok(target.to_path_buf())
}
