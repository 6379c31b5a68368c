//! The images of an episode in the order of its rows, and as an MP4 video.
//!
//! Runs on the command's thread. It allocates, and holds one image at a time. A failure names the file.

use std::path::{Path, PathBuf};

use opencv::core::{Mat, MatTraitConst, Size, Vector};
use opencv::imgcodecs;
use opencv::videoio::{
    CAP_FFMPEG, CAP_PROP_FRAME_COUNT, VideoCapture, VideoCaptureTraitConst, VideoWriter, VideoWriterTrait, VideoWriterTraitConst,
};
use shared::episode::{Episode, EpisodeError, EpisodeImage, EpisodeImages};

use crate::source::check_size;

use super::output::{ExportError, disk_error, unfit, write_error};

/// The rate of an episode that is too short to have one, frames a second: that of the usual camera.
pub const USUAL_RATE_HZ: f64 = 30.0;
/// The slowest and the fastest rate that a video gets, frames a second. Chosen by hand; they bound what a damaged time could give.
const RATE_LIMITS_HZ: [f64; 2] = [1.0, 240.0];
/// Bytes with which it is tried whether the disk takes a file at all. Chosen by hand: more than what some disks keep beside a file's name.
const PROBE: usize = 64 * 1024;
/// Codecs of an MP4 file, the best first: H.264 plays everywhere, and MPEG-4 is there where OpenCV's FFmpeg was built without H.264.
const CODECS: [([char; 4], &str); 2] = [(['a', 'v', 'c', '1'], "h264"), (['m', 'p', '4', 'v'], "mpeg4")];

/// Mean rate of an episode, frames a second. Lost frames count, because they are shown too.
pub fn mean_rate_hz(episode: &Episode) -> f64 {
    let rate_hz = (episode.rows.len().saturating_sub(1)) as f64 / episode.seconds();
    let [slowest, fastest] = RATE_LIMITS_HZ;
    if rate_hz.is_finite() { rate_hz.clamp(slowest, fastest) } else { USUAL_RATE_HZ }
}

/// Calls `take` once for each row of the episode with its image, or with the image before where there is none. Rows before the first
/// image get the first image.
pub fn for_each_row_with_image(
    file: &Path,
    episode: &Episode,
    mut take: impl FnMut(&EpisodeImage) -> Result<(), ExportError>,
) -> Result<(), ExportError> {
    let mut images = EpisodeImages::open(file)?.peekable();
    let mut shown: Option<EpisodeImage> = None;
    for row in &episode.rows {
        let due = |next: Option<&Result<EpisodeImage, EpisodeError>>| match next {
            Some(Ok(image)) => image.captured_at_ns <= row.captured_at_ns,
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
            None => return Err(unfit(file, "the episode has no images")),
        }
    }
    Ok(())
}

/// A video file being written. Its size is that of the first image.
pub struct Video {
    /// The episode.
    file: PathBuf,
    path: PathBuf,
    fps: f64,
    writer: Option<(VideoWriter, Size)>,
    codec: &'static str,
    /// Pictures so far.
    pushed: u64,
}

impl Video {
    /// A video of the episode `file` that will be written to `path` with `fps` frames a second. The file appears with the first image.
    pub fn new(file: &Path, path: &Path, fps: f64) -> Self {
        Self { file: file.into(), path: path.into(), fps, writer: None, codec: "", pushed: 0 }
    }

    /// Adds an image, and returns it as pixels in OpenCV's order blue, green, red.
    pub fn push(&mut self, image: &EpisodeImage) -> Result<Mat, ExportError> {
        let fail = |e: opencv::Error| write_error(&self.path, e.message);
        check_size(&image.data).map_err(|what| unfit(&self.file, format!("picture {}: {what}", image.sequence)))?;
        let bytes: Vector<u8> = Vector::from_slice(&image.data);
        // OpenCV makes an empty picture of most bytes that are none, and an error of some.
        let picture = imgcodecs::imdecode(&bytes, imgcodecs::IMREAD_COLOR).unwrap_or_default();
        if picture.empty() {
            return Err(unfit(&self.file, format!("picture {} cannot be decoded", image.sequence)));
        }
        let size = picture.size().map_err(fail)?;
        if self.writer.is_none() {
            // OpenCV says no more than that it cannot write, so the disk is asked first.
            std::fs::write(&self.path, [0; PROBE]).map_err(|e| disk_error(&self.path, &e))?;
            for ([a, b, c, d], name) in CODECS {
                let fourcc = VideoWriter::fourcc(a, b, c, d).map_err(fail)?;
                let writer = VideoWriter::new_with_backend(&self.path, CAP_FFMPEG, fourcc, self.fps, size, true).map_err(fail)?;
                if writer.is_opened().map_err(fail)? {
                    self.writer = Some((writer, size));
                    self.codec = name;
                    break;
                }
            }
        }
        match &mut self.writer {
            Some((writer, first)) if *first == size => {
                self.pushed += 1;
                writer.write(&picture).map_err(fail)?;
                Ok(picture)
            }
            Some((_, first)) => {
                let (n, Size { width, height }) = (image.sequence, size);
                let what = format!("picture {n} is {width} x {height} px, but those before it are {} x {} px", first.width, first.height);
                Err(unfit(&self.file, what))
            }
            None => Err(write_error(&self.path, "OpenCV cannot write MP4 here; install FFmpeg's libraries")),
        }
    }

    /// Width and height, px; `None` before the first image.
    pub fn size(&self) -> Option<(i32, i32)> {
        self.writer.as_ref().map(|(_, size)| (size.width, size.height))
    }

    /// The codec's name, as FFmpeg writes it; empty before the first image.
    pub fn codec(&self) -> &'static str {
        self.codec
    }

    /// Closes the file.
    pub fn finish(mut self) -> Result<(), ExportError> {
        match &mut self.writer {
            Some((writer, _)) => writer.release().map_err(|e| write_error(&self.path, e.message))?,
            None => return Ok(()),
        }
        self.check()
    }

    /// Looks whether the file is whole: OpenCV says nothing of a disk that was full.
    fn check(&self) -> Result<(), ExportError> {
        let count = || -> opencv::Result<f64> {
            let video = VideoCapture::from_file(&self.path, CAP_FFMPEG)?;
            if video.is_opened()? { video.get(CAP_PROP_FRAME_COUNT) } else { Ok(0.0) }
        };
        let found = count().unwrap_or(0.0);
        if found == self.pushed as f64 {
            return Ok(());
        }
        Err(write_error(&self.path, format!("has {found} of {} pictures: is the disk full?", self.pushed)))
    }
}
