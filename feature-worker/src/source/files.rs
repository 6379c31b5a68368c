//! Frames of files that people name on the command line: pictures, videos and patterns of image sequences.
//!
//! For commands that end when the files do. Allocates; a file that cannot be read is an error that names it.

use std::path::{Path, PathBuf};
use std::time::Duration;

use opencv::imgcodecs;
use opencv::prelude::*;
use shared::config::{CameraConfig, CameraSource};
use shared::messages::{FrameHeader, PixelFormat};

use super::capture::Capture;
use super::frame::{Frame, FrameSource as _, NextFrame};

/// Whether `path` is a single picture by its name.
fn is_picture(path: &Path) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_lowercase();
    !path.to_string_lossy().contains('%')
        && ["png", "jpg", "jpeg", "bmp", "tif", "tiff", "pgm", "ppm", "webp"].contains(&extension.as_str())
}

/// Calls `each` with every frame of pictures, videos or sequences, numbered from 1 on; their size may be any. Returns how many there were.
/// Ends at the first file that cannot be read, or the first error of `each`, with its text.
pub fn for_each_frame(input: &[PathBuf], camera: &CameraConfig, mut each: impl FnMut(Frame) -> Result<(), String>) -> Result<u64, String> {
    let mut count = 0;
    for path in input {
        if is_picture(path) {
            count += 1;
            each_picture(path, count, &mut each)?;
            continue;
        }
        let camera = CameraConfig {
            source: if path.to_string_lossy().contains('%') { CameraSource::Images } else { CameraSource::Video },
            path: path.display().to_string(),
            ..camera.clone()
        };
        let mut capture = Capture::open(&camera, false).map_err(|e| e.to_string())?;
        while let NextFrame::Frame(mut frame) = capture.next_frame(Duration::ZERO).map_err(|e| e.to_string())? {
            count += 1;
            frame.header.sequence = count;
            each(frame)?;
        }
    }
    Ok(count)
}

fn each_picture(path: &Path, sequence: u64, each: &mut impl FnMut(Frame) -> Result<(), String>) -> Result<(), String> {
    let picture = imgcodecs::imread(path, imgcodecs::IMREAD_ANYCOLOR).map_err(|e| e.message)?;
    if picture.empty() {
        return Err(format!("{}: cannot be read as a picture", path.display()));
    }
    let header = FrameHeader {
        format: if picture.channels() == 1 { PixelFormat::Mono8 } else { PixelFormat::Bgr8 } as u32,
        width_px: picture.cols() as u32,
        height_px: picture.rows() as u32,
        sequence,
        ..Default::default()
    };
    each(Frame { header, pixels: picture.data_bytes().map_err(|e| e.message)? })
}
