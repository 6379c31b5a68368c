//! What the camera is (a view) and what it is shown (a scene).
//!
//! This is plain data, for any thread. It does not allocate, and cannot fail once it is read. The container's frame has its origin at the
//! lip; u runs along the glass's top edge into the mouth, w along its left side out of the mouth, both in mm.

use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};

use crate::physics::container::Container;

/// What stands behind the container.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Background {
    /// The chess board of Fig. 4.
    Chess,
    /// A workbench of wooden boards.
    Wood,
    /// An untidy laboratory with boxes and cables.
    Clutter,
    /// A plain wall.
    Plain,
    /// A dark curtain with folds, as people photograph clear water before.
    Curtain,
}

impl Background {
    /// The backgrounds that cells and evaluations draw from.
    pub const ALL: [Self; 4] = [Self::Chess, Self::Wood, Self::Clutter, Self::Plain];
}

/// One camera in front of one container with one liquid.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct View {
    /// Width of the picture, px.
    pub width_px: u32,
    /// Height of the picture, px.
    pub height_px: u32,
    /// Scale at the lip, px per mm.
    pub px_per_mm: f64,
    /// Place of the lip (where the glass's top edge meets its left side) in the picture, px.
    pub lip_px: [f64; 2],
    /// Turn of the camera about its own axis, degrees clockwise in the picture.
    pub roll_deg: f64,
    /// Opening angle theta of the spout, degrees.
    pub spout_deg: f64,
    /// Share of the discharge coefficient that is lost when the wall lies flat (alpha = 90 degrees).
    pub flat_wall_loss: f64,
    /// Colour of the liquid as blue, green, red; none (in a file, `[]`) for clear water.
    #[serde(deserialize_with = "colour_or_clear")]
    pub liquid_bgr: Option<[u8; 3]>,
    /// Share of the background that a thick layer of coloured liquid hides, 0 to 1.
    pub opacity: f64,
    /// What stands behind the container.
    pub background: Background,
    /// Light relative to a good exposure.
    pub light: f64,
    /// Standard deviation of the exposure's slow drift, as a share of the light.
    pub exposure_drift: f64,
    /// Standard deviation of the pixel noise, grey levels.
    pub noise: f64,
    /// Standard deviation of the blur at the lip, by lens and vibration together, px.
    pub blur_px: f64,
    /// Exposure time, s.
    pub shutter_s: f64,
    /// How far a hand lets what stands behind move in the picture, px (standard deviation): camera and container are held together.
    pub hand_px: f64,
    /// Number of drops of liquid that hang on the container's glass.
    pub glass_drops: u32,
    /// Share of the liquid's surface that is foam, 0 to 1.
    pub foam: f64,
}

impl View {
    /// A camera as people mount it, in front of one of the many shapes of lips: `random` draws scale, place, roll and the lip's shape.
    pub fn placed(random: &mut Pcg64Mcg) -> Self {
        Self {
            px_per_mm: random.random_range(5.5..8.5),
            lip_px: [random.random_range(150.0..240.0), random.random_range(236.0..290.0)],
            roll_deg: random.random_range(-8.0..8.0),
            spout_deg: random.random_range(45.0..90.0),
            flat_wall_loss: random.random_range(0.3..0.6),
            ..Self::default()
        }
    }

    /// The place in the picture (px) of a place in the container's frame (mm).
    pub(super) fn to_image(&self, [u, w]: [f64; 2]) -> [f64; 2] {
        let (sin, cos) = self.roll_deg.to_radians().sin_cos();
        let s = self.px_per_mm;
        [self.lip_px[0] + s * (u * cos + w * sin), self.lip_px[1] + s * (u * sin - w * cos)]
    }
}

impl Default for View {
    fn default() -> Self {
        Self {
            width_px: 640,
            height_px: 480,
            px_per_mm: 7.0,
            lip_px: [215.0, 250.0],
            roll_deg: 0.0,
            spout_deg: 60.0,
            flat_wall_loss: 0.5,
            liquid_bgr: Some([150, 62, 20]),
            opacity: 0.93,
            background: Background::Chess,
            light: 1.0,
            exposure_drift: 0.05,
            noise: 3.0,
            blur_px: 0.0,
            shutter_s: 0.008,
            hand_px: 0.0,
            glass_drops: 0,
            foam: 0.0,
        }
    }
}

/// Reads the liquid's colour. TOML has no word for nothing, so an empty list stands for clear water.
fn colour_or_clear<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<Option<[u8; 3]>, D::Error> {
    let levels = Vec::<u8>::deserialize(deserializer)?;
    match levels.len() {
        0 => Ok(None),
        _ => levels
            .try_into()
            .map(Some)
            .map_err(|_| serde::de::Error::custom("give liquid_bgr as [blue, green, red], or [] for clear water")),
    }
}

/// The physical state at the middle of an exposure.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Scene {
    /// Time, s; it grows from frame to frame.
    pub at_s: f64,
    /// Tilt alpha, degrees from upright.
    pub alpha_deg: f64,
    /// Rate of the tilt, degrees/s.
    pub rate_deg_s: f64,
    /// Outflow over the lip, ml/s.
    pub flow_ml_s: f64,
    /// Height of the liquid's surface over the lip when nothing flows, mm; negative when it is below the lip.
    pub level_mm: f64,
}

impl Scene {
    /// The scene of `container` at this tilt.
    pub fn of(container: &Container, at_s: f64, alpha_deg: f64, rate_deg_s: f64) -> Self {
        let shape = container.shape();
        let excess_ml = container.volume_ml() - shape.retained_ml(alpha_deg);
        let level_mm = 1000.0 * excess_ml / shape.surface_mm2(alpha_deg);
        Self { at_s, alpha_deg, rate_deg_s, flow_ml_s: container.lip().flow_ml_s, level_mm }
    }
}

/// What was really drawn.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Truth {
    /// Area of the triangle between the container's axes and the least-squares line along the stream's outer outline, px^2; 0 without
    /// a stream.
    pub area_px2: f64,
    /// Its corners: the lip, the one on the x-axis, the one on the y-axis; px.
    pub triangle_px: [[f64; 2]; 3],
}

/// Turns a vector from the world (x towards the pour, z up) into the container's frame (u, w), for a container tilted by `angle_rad`.
pub(super) fn to_container([x, z]: [f64; 2], angle_rad: f64) -> [f64; 2] {
    let (sin, cos) = angle_rad.sin_cos();
    [-x * cos + z * sin, x * sin + z * cos]
}
