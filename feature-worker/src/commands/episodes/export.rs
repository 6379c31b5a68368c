//! `feature-worker episodes export`: episodes for other programs. Allocates; nothing that exists is overwritten.

use std::fs;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use indicatif::{ProgressBar, ProgressStyle};
use opencv::core::{Mat, MatTraitConst, Size, Vector};
use opencv::imgcodecs;
use opencv::videoio::{VideoWriter, VideoWriterTrait, VideoWriterTraitConst};
use serde_json::json;
use shared::episode::{Episode, EpisodeError, EpisodeImage, EpisodeImages, TableError, write_table};
use shared::exit::{self, Failure, failure};

use super::lerobot;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Episodes (.mcap) or directories of them; without any, the directory of [recording] in the configuration.
    paths: Vec<PathBuf>,
    /// What to write.
    #[arg(long = "as", value_enum)]
    format: ExportFormat,
    /// The directory for it; made if missing.
    #[arg(long, value_name = "DIR")]
    to: PathBuf,
    /// The cell's configuration.
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum ExportFormat {
    Csv,
    Images,
    Video,
    Lerobot,
}

/// Why an export failed; what was written before stays.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// An episode cannot be read.
    #[error(transparent)]
    Episode(#[from] EpisodeError),
    /// A table cannot be written.
    #[error(transparent)]
    Table(#[from] TableError),
    /// A file or directory cannot be written.
    #[error("{path}: {what}")]
    Write {
        /// The file or directory.
        path: String,
        /// What went wrong.
        what: String,
    },
    /// There is nothing to export.
    #[error("{0}")]
    Nothing(String),
}

pub(crate) fn write_error(path: &Path, what: impl std::fmt::Display) -> ExportError {
    ExportError::Write { path: path.display().to_string(), what: what.to_string() }
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let files = super::files(&args.paths, &args.config)?;
    let input = |e: &ExportError| matches!(e, ExportError::Episode(_) | ExportError::Nothing(_));
    let code = |e: &ExportError| if input(e) { exit::BAD_INPUT } else { exit::FAILED };
    let written = export(args, &files).map_err(|e| failure(code(&e), e))?;
    if args.json {
        println!("{:#}", json!({ "written": written.iter().map(|p| p.display().to_string()).collect::<Vec<_>>() }));
    } else {
        for path in written {
            println!("{}", path.display());
        }
    }
    Ok(())
}

fn export(args: &Args, files: &[PathBuf]) -> Result<Vec<PathBuf>, ExportError> {
    if files.is_empty() {
        return Err(ExportError::Nothing("no episodes to export; name .mcap files or a directory of them".into()));
    }
    fs::create_dir_all(&args.to).map_err(|e| write_error(&args.to, e))?;
    let episodes = files.iter().map(|f| Episode::read(f)).collect::<Result<Vec<_>, _>>()?;
    if args.format == ExportFormat::Csv {
        let pair = [args.to.join("features.csv"), args.to.join("scale.csv")];
        write_table(&episodes, &pair[0], &pair[1])?;
        return Ok(pair.into());
    }
    let frames: usize = episodes.iter().map(|e| e.rows.len()).sum();
    let bar = progress(frames as u64);
    if args.format == ExportFormat::Lerobot {
        lerobot::write(files, &episodes, &args.to, &bar)?;
        bar.finish_and_clear();
        return Ok(vec![args.to.clone()]);
    }
    let mut written = Vec::new();
    for (file, episode) in files.iter().zip(&episodes) {
        let stem = file.file_stem().unwrap_or(file.as_os_str());
        let target = args.to.join(stem);
        written.push(match args.format {
            ExportFormat::Csv | ExportFormat::Lerobot => continue,
            ExportFormat::Images => images(file, &target, &bar)?,
            ExportFormat::Video => {
                let target = target.with_extension("mp4");
                if target.exists() {
                    return Err(write_error(&target, "is there already; name another directory"));
                }
                let fps = rate_hz(episode);
                let mut video = Video::new(&target, fps);
                frames_with_images(file, episode, |image| {
                    bar.inc(1);
                    video.push(image)
                })?;
                video.finish()?;
                target
            }
        });
    }
    bar.finish_and_clear();
    Ok(written)
}

pub(crate) fn progress(total: u64) -> ProgressBar {
    let bar = ProgressBar::new(total);
    if let Ok(style) = ProgressStyle::with_template("{wide_bar} {pos}/{len} images, {eta} left") {
        bar.set_style(style);
    }
    bar
}

fn images(file: &Path, target: &Path, bar: &ProgressBar) -> Result<PathBuf, ExportError> {
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

/// Frames a second; the lost ones count, because they are shown too.
pub(crate) fn rate_hz(episode: &Episode) -> f64 {
    let rate_hz = (episode.rows.len().saturating_sub(1)) as f64 / episode.seconds();
    if rate_hz.is_finite() { rate_hz.clamp(1.0, 240.0) } else { 30.0 }
}

/// Calls `take` once for each frame of the episode with its image, or with the one before where there is none; frames before
/// the first image get the first image.
pub(crate) fn frames_with_images(
    file: &Path,
    episode: &Episode,
    mut take: impl FnMut(&EpisodeImage) -> Result<(), ExportError>,
) -> Result<(), ExportError> {
    let mut images = EpisodeImages::open(file)?.peekable();
    let mut shown: Option<EpisodeImage> = None;
    for frame in &episode.rows {
        let due = |next: Option<&Result<EpisodeImage, EpisodeError>>| match next {
            Some(Ok(image)) => image.captured_at_ns <= frame.captured_at_ns,
            Some(Err(_)) => true,
            None => false,
        };
        while due(images.peek()) || (shown.is_none() && images.peek().is_some()) {
            if let Some(image) = images.next() {
                shown = Some(image?);
            }
        }
        match &shown {
            Some(image) => take(image)?,
            None => return Err(ExportError::Nothing(format!("{}: has no images", file.display()))),
        }
    }
    Ok(())
}

/// A video file being written; its size is that of the first image.
pub(crate) struct Video {
    path: PathBuf,
    fps: f64,
    writer: Option<(VideoWriter, Size)>,
}

impl Video {
    pub(crate) fn new(path: &Path, fps: f64) -> Self {
        Self { path: path.into(), fps, writer: None }
    }

    pub(crate) fn push(&mut self, image: &EpisodeImage) -> Result<(), ExportError> {
        let fail = |e: opencv::Error| write_error(&self.path, e.message);
        let bytes: Vector<u8> = Vector::from_slice(&image.data);
        let picture: Mat = imgcodecs::imdecode(&bytes, imgcodecs::IMREAD_COLOR).map_err(fail)?;
        let size = picture.size().map_err(fail)?;
        if self.writer.is_none() {
            // H.264 plays everywhere; MPEG-4 where OpenCV's FFmpeg was built without it.
            for code in ["avc1", "mp4v"] {
                let c: Vec<char> = code.chars().collect();
                let fourcc = VideoWriter::fourcc(c[0], c[1], c[2], c[3]).map_err(fail)?;
                let writer = VideoWriter::new_def(&self.path, fourcc, self.fps, size).map_err(fail)?;
                if writer.is_opened().map_err(fail)? {
                    self.writer = Some((writer, size));
                    break;
                }
            }
        }
        match &mut self.writer {
            Some((writer, first)) if *first == size => writer.write(&picture).map_err(fail),
            Some((_, first)) => Err(write_error(
                &self.path,
                format!("an image of {} x {} among {} x {}", size.width, size.height, first.width, first.height),
            )),
            None => Err(write_error(&self.path, "OpenCV cannot write MP4 here; install FFmpeg's libraries")),
        }
    }

    pub(crate) fn finish(mut self) -> Result<(), ExportError> {
        match &mut self.writer {
            Some((writer, _)) => writer.release().map_err(|e| write_error(&self.path, e.message)),
            None => Ok(()),
        }
    }
}
