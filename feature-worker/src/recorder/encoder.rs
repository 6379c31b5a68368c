//! Compresses pictures as `[recording]` says. It is used by the recorder's thread alone, and allocates. Where a picture cannot be
//! compressed it returns nothing, and the recorder counts the image as dropped.

use opencv::core::{Mat, MatTraitConst, Vector, VectorToVec};
use opencv::{imgcodecs, imgproc};
use shared::config::{Config, ImageFormat};
use shared::messages::{FrameHeader, PixelFormat};

/// OpenCV's level of PNG compression. The fastest one: camera noise hardly shrinks further, and the frames come at 30 Hz.
const PNG_COMPRESSION: i32 = 1;

/// A compressor with its buffers.
pub struct Encoder {
    extension: &'static str,
    name: &'static str,
    parameters: Vector<i32>,
    bgr: Mat,
    out: Vector<u8>,
}

impl Encoder {
    /// A compressor for the image format of `[recording]`.
    pub fn new(config: &Config) -> Self {
        let (extension, name, parameters) = match config.recording.image_format {
            ImageFormat::Jpeg => (".jpg", "jpeg", vec![imgcodecs::IMWRITE_JPEG_QUALITY, i32::from(config.recording.jpeg_quality)]),
            ImageFormat::Png => (".png", "png", vec![imgcodecs::IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION]),
        };
        Self { extension, name, parameters: parameters.into(), bgr: Mat::default(), out: Vector::new() }
    }

    /// The format's name in an episode: `jpeg` or `png`.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// The compressed picture; `None` if the pixels do not fit the header or cannot be compressed.
    pub fn encode(&mut self, header: &FrameHeader, pixels: &[u8]) -> Option<Vec<u8>> {
        let format = PixelFormat::from_code(header.format)?;
        let rows = i32::try_from(header.height_px).ok()?;
        let expected = (header.width_px as usize).checked_mul(header.height_px as usize)?.checked_mul(format.bytes_per_pixel())?;
        if expected == 0 || pixels.len() != expected {
            return None;
        }
        let flat = Mat::from_slice(pixels).ok()?;
        let picture = flat.reshape(i32::try_from(format.bytes_per_pixel()).ok()?, rows).ok()?;
        let done = if format == PixelFormat::Yuyv {
            imgproc::cvt_color_def(&picture, &mut self.bgr, imgproc::COLOR_YUV2BGR_YUYV)
                .and_then(|()| imgcodecs::imencode(self.extension, &self.bgr, &mut self.out, &self.parameters))
        } else {
            imgcodecs::imencode(self.extension, &picture, &mut self.out, &self.parameters)
        };
        done.ok()?.then(|| self.out.to_vec())
    }
}
