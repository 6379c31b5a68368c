//! Squares of the picture beside the rays: the ground on the far side of the container's left wall, and the inside of the glass just below
//! the lip.
//!
//! What the background brings to the lip comes from beside the container, so its colours are known before they come. And where the
//! liquid in the glass is seen in its own colours, what is foreign at the lip is not that liquid.
//!
//! Called on the extraction thread. The pictures are kept, so nothing is allocated after the first frame but OpenCV's matrix headers. The
//! only failures are OpenCV's.

use opencv::boxed_ref::BoxedRef;
use opencv::core::{self, CV_16SC2, CV_32FC1, Mat, Scalar, Vec3b};
use opencv::imgproc;
use opencv::prelude::*;
use shared::config::{CameraConfig, ImageConfig, LiquidMethod};

use super::geometry::Axes;
use super::ground_colours::{GroundColours, Mean};
use super::hues::ranges;
use super::pace::Pace;

/// Width of the picture for which distances were chosen, px.
const PICTURE_PX: f32 = 640.0;
/// Samples of a side of a square. Chosen by hand, for speed.
const SQUARE_SAMPLES: i32 = 16;
/// Where the square beside the container lies in a picture 640 px wide: from and to, px along the x-axis and along the y-axis. What the
/// background brings to the lip comes from there, or along the rays.
const BESIDE_PX: [[f32; 2]; 2] = [[-34.0, -7.0], [-48.0, 10.0]];
/// Where the larger square beside the container lies, in the same way. Chosen by hand: a jet of liquid falls across its lower half at a small tilt and
/// across its upper half at a large one, so that none fills both.
const BESIDE_WIDE_PX: [[f32; 2]; 2] = [[-36.0, -7.0], [-48.0, 60.0]];
/// Where the square in the glass lies, in the same way: while something flows, the liquid stands there. Chosen by hand: beyond the wall's
/// own light, and within the region that calibration writes.
const GLASS_PX: [[f32; 2]; 2] = [[6.0, 18.0], [-46.0, -14.0]];
/// Of this many samples of the square beside the container, the ground is learned from one a frame. Chosen by hand.
const TEACH_EVERY: usize = 4;
/// And only when nothing foreign came to the lip for so many pictures more: a jet of liquid crosses the square before its stream is seen. Chosen by
/// hand: a stream that begins is seen in 4 pictures, and the ground does not come to the lip much faster.
const TEACH_AFTER: u32 = 4;
/// Samples of a square.
const SAMPLES: usize = (SQUARE_SAMPLES * SQUARE_SAMPLES) as usize;
/// Side of the square of samples that are smoothed together, as along the rays. Chosen by hand.
const SMOOTH: i32 = 5;
/// The liquid stands in the glass when this share of its square has the liquid's colours. Chosen by hand.
const TOLD_SHARE: f32 = 0.6;
/// The square in the glass shows what is in the glass only if it was seen without the liquid: in no more than this share of it, for
/// [`EMPTY_PICTURES`]. Chosen by hand: a jug in the liquid's colour never is.
const EMPTY_SHARE: f32 = 0.2;
/// So many pictures in which the glass was looked at. Chosen by hand.
const EMPTY_PICTURES: u32 = 5;
/// Of this many pictures without a stream, the glass is looked at in one. Chosen by hand, for speed.
const EMPTY_EVERY: usize = 4;

/// Samples a square of the region.
pub(super) struct Square {
    /// The two maps of the square; empty if it is not within the region.
    maps: [Mat; 2],
    /// The square in BGR.
    pixels: Mat,
    /// The same, smoothed.
    smooth: Mat,
    /// The last smoothed squares, of quiet pictures in a row, as a ring, and how many there were.
    kept: Vec<Vec3b>,
    /// How many squares the ring holds.
    ring: usize,
    quiet: usize,
}

impl Square {
    fn new(place: &Place, at_px: [[f32; 2]; 2]) -> opencv::Result<Self> {
        let ring = TEACH_AFTER as usize;
        let kept = vec![Vec3b::default(); ring * SAMPLES];
        Ok(Self { maps: place.maps(at_px)?, pixels: Mat::default(), smooth: Mat::default(), kept, ring, quiet: 0 })
    }

    /// Beside the container.
    pub(super) fn beside(place: &Place) -> opencv::Result<Self> {
        Self::new(place, BESIDE_PX)
    }

    /// A larger square beside the container.
    pub(super) fn beside_wide(place: &Place) -> opencv::Result<Self> {
        Self::new(place, BESIDE_WIDE_PX)
    }

    /// Takes the next picture's square.
    pub(super) fn take(&mut self, region: &impl core::ToInputArray) -> opencv::Result<()> {
        let [map_a, map_b] = &self.maps;
        if map_a.empty() {
            return Ok(());
        }
        imgproc::remap(region, &mut self.pixels, map_a, map_b, imgproc::INTER_NEAREST, core::BORDER_REPLICATE, Scalar::default())
    }

    /// The smoothed colours of the square that was taken; none if it is not within the region.
    pub(super) fn colours(&mut self) -> opencv::Result<&[Vec3b]> {
        if self.pixels.empty() {
            return Ok(&[]);
        }
        let size = core::Size::new(SMOOTH, SMOOTH);
        imgproc::blur(&self.pixels, &mut self.smooth, size, core::Point::new(-1, -1), core::BORDER_REPLICATE)?;
        self.smooth.data_typed()
    }

    /// Says that nothing foreign is at the lip in the picture that was taken. Learns the ground's colours from the square of an earlier such picture:
    /// what comes to the lip from there is known before.
    pub(super) fn teach(&mut self, ground: &mut GroundColours, frame: usize) -> opencv::Result<()> {
        if self.colours()?.len() != SAMPLES {
            return Ok(());
        }
        let kept = &mut self.kept[self.quiet % self.ring * SAMPLES..][..SAMPLES];
        if self.quiet >= self.ring {
            kept.iter().skip(frame % TEACH_EVERY).step_by(TEACH_EVERY).for_each(|colour| ground.learn(colour.0, false));
        }
        kept.copy_from_slice(self.smooth.data_typed()?);
        self.quiet = self.quiet.wrapping_add(1);
        Ok(())
    }

    /// Says how fast pictures follow each other. Allocates when they come faster than before.
    pub(super) fn set_pace(&mut self, pace: Pace) {
        let ring = pace.pictures(TEACH_AFTER) as usize;
        if ring != self.ring {
            self.kept.resize(ring * SAMPLES, Vec3b::default());
            (self.ring, self.quiet) = (ring, 0);
        }
    }

    /// Says that something may be at the lip: what the square showed just before it may be a jet of it.
    pub(super) fn forget_kept(&mut self) {
        self.quiet = 0;
    }
}

/// The inside of the glass just below the lip.
pub struct InGlass {
    square: Square,
    hsv: Mat,
    ranges: Vec<(Scalar, Scalar)>,
    /// Pictures in which the square was seen without the liquid.
    empty_pictures: u32,
    turn: usize,
}

impl InGlass {
    /// For the liquid's ranges.
    pub(super) fn new(place: &Place, ranges: &[(Scalar, Scalar)]) -> opencv::Result<Self> {
        let square = Square::new(place, GLASS_PX)?;
        Ok(Self { square, hsv: Mat::default(), ranges: ranges.to_vec(), empty_pictures: 0, turn: 0 })
    }

    /// For whole pictures of `camera` and the coloured liquid of `image`.
    pub fn of_pictures(camera: &CameraConfig, image: &ImageConfig) -> opencv::Result<Self> {
        let all = ImageConfig { region_px: [0, 0, camera.width_px, camera.height_px], ..image.clone() };
        Self::new(&Place::new(Axes::new(image), &all, camera.width_px), &ranges(image.colour_hsv.map(f64::from)))
    }

    /// The share of the square in a picture that has the liquid's colours, 0 to 1; none if the picture ends before the square.
    pub fn share(&mut self, picture: &Mat) -> opencv::Result<Option<f32>> {
        self.square.take(picture)?;
        Ok(self.look()?.0)
    }

    /// Takes the next picture's square.
    pub(super) fn take(&mut self, region: &BoxedRef<Mat>) -> opencv::Result<()> {
        self.square.take(region)
    }

    /// Says that no stream is seen in the picture that was taken.
    pub(super) fn see_dry(&mut self) -> opencv::Result<()> {
        self.turn += 1;
        if self.empty_pictures < EMPTY_PICTURES && self.turn.is_multiple_of(EMPTY_EVERY) {
            let (share, _) = self.look()?;
            self.empty_pictures += u32::from(share.is_some_and(|share| share <= EMPTY_SHARE));
        }
        Ok(())
    }

    /// Whether the glass is seen not to hold the liquid just below the lip.
    pub(super) fn is_empty(&mut self) -> opencv::Result<bool> {
        Ok(self.look()?.0.is_some_and(|share| share <= EMPTY_SHARE))
    }

    /// The mean levels of blue, green and red of the liquid in the glass, if it stands there in its own colours.
    pub(super) fn liquid(&mut self) -> opencv::Result<Option<[f32; 3]>> {
        if self.empty_pictures < EMPTY_PICTURES {
            return Ok(None);
        }
        let (share, mean) = self.look()?;
        Ok(share.filter(|share| *share >= TOLD_SHARE).map(|_| mean))
    }

    /// Which share of the square has the liquid's colours, and their mean; no share if the square is not within the region.
    fn look(&mut self) -> opencv::Result<(Option<f32>, [f32; 3])> {
        if self.square.colours()?.is_empty() {
            return Ok((None, [0.0; 3]));
        }
        imgproc::cvt_color_def(&self.square.smooth, &mut self.hsv, imgproc::COLOR_BGR2HSV)?;
        let (hsv, colours): (&[Vec3b], &[Vec3b]) = (self.hsv.data_typed()?, self.square.smooth.data_typed()?);
        let mut inside = Mean::default();
        for (hsv, colour) in hsv.iter().zip(colours) {
            let within = |(low, high): &(Scalar, Scalar)| (0..3).all(|k| (low[k]..=high[k]).contains(&f64::from(hsv[k])));
            if self.ranges.iter().any(within) {
                inside.add(colour.0);
            }
        }
        Ok((Some(inside.count as f32 / hsv.len() as f32), inside.levels()))
    }
}

/// Where squares lie: the axes relative to a region, the region's width and height, px, and how many px stand for one of a picture 640 px wide.
pub(super) struct Place {
    axes: Axes,
    region_px: [f32; 2],
    scale: f32,
}

impl Place {
    /// For a region of pictures `width_px` wide; `axes` are relative to it.
    pub(super) fn new(axes: Axes, image: &ImageConfig, width_px: u32) -> Self {
        let region_px = [image.region_px[2], image.region_px[3]].map(|v| v as f32);
        Self { axes, region_px, scale: width_px as f32 / PICTURE_PX }
    }

    /// Where a square's sample lies, px in the region: the `j`-th along the x-axis and the `i`-th along the y-axis.
    fn sample(&self, at_px: [[f32; 2]; 2], i: i32, j: i32) -> [f32; 2] {
        let share = |k: i32| (k as f32 + 0.5) / SQUARE_SAMPLES as f32;
        let at = |[from, to]: [f32; 2], k: i32| self.scale * (from + share(k) * (to - from));
        let (u, w) = (at(at_px[0], j), at(at_px[1], i));
        [0, 1].map(|k| self.axes.lip_px[k] + u * self.axes.x[k] + w * self.axes.y[k])
    }

    /// The samples in a square's corners, px in the region.
    fn corners(&self, at_px: [[f32; 2]; 2]) -> [[f32; 2]; 4] {
        let last = SQUARE_SAMPLES - 1;
        [(0, 0), (0, last), (last, 0), (last, last)].map(|(i, j)| self.sample(at_px, i, j))
    }

    /// The fixed-point maps from a square to the region, as `cv::convertMaps` makes them; empty if the region does not hold it.
    fn maps(&self, at_px: [[f32; 2]; 2]) -> opencv::Result<[Mat; 2]> {
        let (mut map_a, mut map_b) = (Mat::default(), Mat::default());
        let mut map_x = Mat::new_rows_cols_with_default(SQUARE_SAMPLES, SQUARE_SAMPLES, CV_32FC1, Scalar::all(0.0))?;
        let mut map_y = map_x.try_clone()?;
        for i in 0..SQUARE_SAMPLES {
            for j in 0..SQUARE_SAMPLES {
                let [x, y] = self.sample(at_px, i, j);
                (*map_x.at_2d_mut::<f32>(i, j)?, *map_y.at_2d_mut::<f32>(i, j)?) = (x, y);
            }
        }
        let inside = |p: [f32; 2]| (0..2).all(|k| p[k] >= 0.0 && p[k] <= self.region_px[k] - 1.0);
        if self.corners(at_px).into_iter().all(inside) {
            imgproc::convert_maps(&map_x, &map_y, &mut map_a, &mut map_b, CV_16SC2, true)?;
        }
        Ok([map_a, map_b])
    }
}

/// What a region is wanting of what tells new ground from a coloured liquid: the ground beside the container, and the glass below the lip.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RoomBeside {
    /// Nothing.
    Enough,
    /// It has to be this one, px: x, y, width, height.
    Wanted([u32; 4]),
    /// The picture itself ends before it.
    BeyondPicture,
}

/// What the region of `image` is wanting for a coloured liquid. The squares of clear water are not asked for.
pub fn room_beside(camera: &CameraConfig, image: &ImageConfig) -> RoomBeside {
    if image.method != LiquidMethod::Colour {
        return RoomBeside::Enough;
    }
    let place = Place::new(Axes::new(image), image, camera.width_px);
    let [left, top, width, height] = image.region_px;
    let (mut low, mut high) = ([left, top], [left + width, top + height]);
    for corner in [BESIDE_PX, BESIDE_WIDE_PX, GLASS_PX].iter().flat_map(|at_px| place.corners(*at_px)) {
        for k in 0..2 {
            let most = [camera.width_px, camera.height_px][k] as f32 - 1.0;
            if !(0.0..=most).contains(&corner[k]) {
                return RoomBeside::BeyondPicture;
            }
            low[k] = low[k].min(corner[k].floor() as u32);
            high[k] = high[k].max(corner[k].ceil() as u32 + 1);
        }
    }
    let wanted = [low[0], low[1], high[0] - low[0], high[1] - low[1]];
    if wanted == image.region_px { RoomBeside::Enough } else { RoomBeside::Wanted(wanted) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the rules beside the lip: a region that lacks a square is said with the one that holds all, turned and in larger pictures too, and that
    /// one lacks none.
    #[test]
    fn a_region_without_room_is_said() -> opencv::Result<()> {
        for (scale, turn_deg) in [(1.0f32, 0.0f32), (1.0, 8.0), (2.0, -8.0)] {
            let camera = CameraConfig { width_px: (640.0 * scale) as u32, height_px: (480.0 * scale) as u32, ..CameraConfig::default() };
            let (lip, (sin, cos)) = ([215.0 * scale, 250.0 * scale], turn_deg.to_radians().sin_cos());
            let small = ImageConfig {
                region_px: [190.0, 16.0, 420.0, 256.0].map(|v| (v * scale) as u32),
                x_axis_px: [lip[0], lip[1], lip[0] + 100.0 * cos, lip[1] + 100.0 * sin],
                y_axis_px: [lip[0] - 100.0 * sin, lip[1] + 100.0 * cos, lip[0], lip[1]],
                method: LiquidMethod::Colour,
                colour_hsv: [98, 90, 25, 124, 255, 255],
                area_min_px2: 30.0,
            };
            let RoomBeside::Wanted(region_px) = room_beside(&camera, &small) else {
                panic!("{scale} {turn_deg}: the small region is taken")
            };
            let enough = ImageConfig { region_px, ..small.clone() };
            assert_eq!(room_beside(&camera, &enough), RoomBeside::Enough, "{region_px:?}");
            for (image, held) in [(&small, false), (&enough, true)] {
                let [x, y] = [0, 1].map(|k| lip[k] - image.region_px[k] as f32);
                let place = Place::new(Axes { lip_px: [x, y], ..Axes::new(image) }, image, camera.width_px);
                for at_px in [BESIDE_PX, BESIDE_WIDE_PX, GLASS_PX] {
                    assert_eq!(!place.maps(at_px)?[0].empty(), held, "{scale} {turn_deg}: {:?} {at_px:?}", image.region_px);
                }
            }
            let at_border =
                ImageConfig { x_axis_px: small.x_axis_px.map(|v| v * 0.1), y_axis_px: small.y_axis_px.map(|v| v * 0.1), ..small };
            assert_eq!(room_beside(&camera, &at_border), RoomBeside::BeyondPicture);
            let clear = ImageConfig { method: LiquidMethod::Clear, ..at_border };
            assert_eq!(room_beside(&camera, &clear), RoomBeside::Enough);
        }
        Ok(())
    }
}
