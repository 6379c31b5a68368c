//! What was seen of one pour: kept pictures to learn from, and all frames once more to measure.
//!
//! Runs on the command's thread and allocates: at most [`KEEP_PICTURES`] pictures and [`KEEP_MOST`] bytes of them, and of a live camera each
//! frame as JPEG. Files are read a second time instead.

use std::path::PathBuf;

use opencv::core::{self, Mat, Vector};
use opencv::imgcodecs;
use opencv::prelude::*;
use shared::config::CameraConfig;
use shared::messages::PixelFormat;

use crate::drawing::to_bgr;
use crate::source::{Frame, for_each_frame};
use crate::vision::{Extractor, Image, Measurement, PictureTime, Poses};

/// The most pictures that are kept for learning and for the drawn picture. Chosen by hand: about 140 MB at 640 x 480 px.
const KEEP_PICTURES: usize = 150;
/// The most that these pictures take, bytes. Chosen by hand: 150 at 1280 x 720 px, and 21 at 3840 x 2160 px.
const KEEP_MOST: usize = 1 << 29;
/// Quality of the frames of a live camera that are kept, 0 to 100. Chosen by hand: no difference in V_e was seen.
const FILM_QUALITY: i32 = 97;
/// The most that is kept of a live camera, with those pictures, bytes. Chosen by hand: some five minutes at 640 x 480 px.
pub(super) const FILM_MOST: usize = 1 << 30;

/// Where all frames come from once more.
enum Film {
    /// From these files, of which something may be missing.
    Files(Vec<PathBuf>, bool),
    /// From memory, each as JPEG with its number and time, and how many bytes they may take.
    Kept { frames: Vec<(Vec<u8>, PictureTime)>, bytes: usize, most: usize },
}

/// What was seen of one pour.
pub(super) struct Pour {
    /// Evenly spread pictures in BGR.
    pub pictures: Vec<Mat>,
    /// Number of all pictures.
    pub count: u64,
    /// Whether one of them has no colour by its format, as all of a camera without colour.
    pub is_grey: bool,
    /// Of this many pictures, one is kept.
    stride: u64,
    /// How many bytes the kept pictures may take.
    keep_most: usize,
    film: Film,
}

impl Pour {
    /// A pour that a live camera shows. At most `most` bytes of it are kept, such as [`FILM_MOST`].
    pub fn live(most: usize) -> Self {
        Self::of(Film::Kept { frames: Vec::new(), bytes: 0, most })
    }

    fn of(film: Film) -> Self {
        Self { pictures: Vec::new(), count: 0, is_grey: false, stride: 1, keep_most: KEEP_MOST, film }
    }

    /// The pour in files. With `partial`, something may be missing. Returns also what is missing, a line each.
    pub fn read(input: &[PathBuf], rate_hz: f64, partial: bool) -> Result<(Self, Vec<String>), String> {
        let mut pour = Self::of(Film::Files(input.to_vec(), partial));
        let contents = for_each_frame(input, rate_hz, partial, |frame| pour.add(&frame))?;
        Ok((pour, contents.missing))
    }

    /// Adds a frame.
    pub fn add(&mut self, frame: &Frame) -> Result<(), String> {
        let words = |e: opencv::Error| e.message;
        let bgr = to_bgr(frame).map_err(words)?;
        if let Some(first) = self.pictures.first()
            && first.size().map_err(words)? != bgr.size().map_err(words)?
        {
            return Err(format!("frame {} has another size than those before; all must come from one camera", self.count + 1));
        }
        if let Film::Kept { frames, bytes, .. } = &mut self.film {
            let mut jpeg = Vector::<u8>::new();
            let quality = Vector::from_slice(&[imgcodecs::IMWRITE_JPEG_QUALITY, FILM_QUALITY]);
            imgcodecs::imencode(".jpg", &bgr, &mut jpeg, &quality).map_err(words)?;
            *bytes += jpeg.len();
            frames.push((jpeg.to_vec(), time(frame)));
        }
        if self.count.is_multiple_of(self.stride) {
            self.pictures.push(bgr);
        }
        if self.pictures.len() > KEEP_PICTURES || self.picture_bytes() > self.keep_most {
            // Every second picture is dropped, and from now on half as many are kept.
            let mut index = 0;
            self.pictures.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.stride *= 2;
        }
        self.count += 1;
        self.is_grey |= frame.header.format == PixelFormat::Mono8 as u32;
        Ok(())
    }

    /// How many bytes the kept pictures take.
    fn picture_bytes(&self) -> usize {
        let each = self.pictures.first().map_or(0, |first| first.total() * first.elem_size().unwrap_or(0));
        self.pictures.len() * each
    }

    /// Whether no more can be kept.
    pub fn is_full(&self) -> bool {
        matches!(self.film, Film::Kept { bytes, most, .. } if bytes + self.picture_bytes() > most)
    }

    /// The poses among the kept pictures, those pictures, and their mean.
    pub fn poses(&self) -> Result<(Poses, Vec<&Mat>, Mat), opencv::Error> {
        let poses = Poses::choose(&self.pictures)?;
        let chosen = poses.chosen.iter().map(|i| &self.pictures[*i]).collect();
        let mean = poses.mean(&self.pictures)?;
        Ok((poses, chosen, mean))
    }

    /// Measures all frames in their order, and gives each measurement to `take`, with its picture in BGR.
    pub fn measure(
        &self,
        camera: &CameraConfig,
        mut extractor: Extractor,
        mut take: impl FnMut(Measurement, &Mat) -> opencv::Result<()>,
    ) -> Result<(), String> {
        let mut each = |picture: &Mat, time: PictureTime| {
            let pixels = picture.data_bytes().map_err(|e| e.message)?;
            let (width_px, height_px) = (picture.cols() as u32, picture.rows() as u32);
            let image = Image { width_px, height_px, format: PixelFormat::Bgr8, pixels };
            take(extractor.measure_at(image, time).map_err(|e| e.to_string())?, picture).map_err(|e| e.message)
        };
        match &self.film {
            Film::Files(input, partial) => {
                for_each_frame(input, camera.fps, *partial, |frame| each(&to_bgr(&frame).map_err(|e| e.message)?, time(&frame))).map(|_| ())
            }
            Film::Kept { frames, .. } => frames.iter().try_for_each(|(jpeg, time)| {
                each(&imgcodecs::imdecode(&Vector::<u8>::from_slice(jpeg), imgcodecs::IMREAD_COLOR).map_err(|e| e.message)?, *time)
            }),
        }
    }
}

/// Number and time of a frame.
fn time(frame: &Frame) -> PictureTime {
    PictureTime { sequence: frame.header.sequence, captured_at_ns: frame.header.captured_at_ns }
}

/// Whether two pictures are the same to the byte.
pub(super) fn same(a: &Mat, b: &Mat) -> bool {
    core::norm2(a, b, core::NORM_INF, &core::no_array()).is_ok_and(|difference| difference == 0.0)
}

#[cfg(test)]
mod tests {
    use shared::messages::FrameHeader;

    use super::*;

    /// Protects the memory of whoever calibrates with a large picture or for long: the kept pictures take no more than they may, spread over the whole
    /// pour, and of a live camera they count with its frames.
    #[test]
    fn kept_pictures_are_bounded_in_bytes() {
        let header = FrameHeader { width_px: 64, height_px: 48, format: PixelFormat::Bgr8 as u32, ..Default::default() };
        let each = 64 * 48 * 3;
        let kept = |mut pour: Pour, frames: u8| {
            for level in 0..frames {
                pour.add(&Frame { header, pixels: &vec![level; each] }).unwrap();
            }
            let levels: Vec<u8> = pour.pictures.iter().map(|p| p.data_bytes().unwrap()[0]).collect();
            (levels, pour.is_full())
        };
        let files = |keep_most| Pour { keep_most, ..Pour::of(Film::Files(Vec::new(), false)) };
        assert_eq!(kept(files(10 * each), 40).0, (0..40).step_by(4).collect::<Vec<u8>>());
        assert_eq!(kept(files(usize::MAX), 150).0.len(), 150);
        assert_eq!(kept(files(usize::MAX), 151).0.len(), 76);
        let live = || Pour::live(20 * each);
        assert!(!kept(live(), 10).1 && kept(live(), 21).1);
    }
}
