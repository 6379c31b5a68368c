//! Cells that differ in liquid, background, light and more; each condition has a name. Any thread; allocates. The same generator gives the
//! same cells.

use rand::RngExt;
use rand::seq::IndexedRandom;
use rand_pcg::Pcg64Mcg;
use shared::config::ImageConfig;
use simulator::camera::{Background, View};

use crate::camera_setup::{CameraError, image_config, learn_colour};

/// Names and colours (blue, green, red) of the liquids: such as food dyes give, and cola.
const LIQUIDS: [(&str, [u8; 3]); 6] = [
    ("blue", [150, 62, 20]),
    ("red", [40, 36, 180]),
    ("green", [60, 150, 40]),
    ("orange", [24, 130, 240]),
    ("violet", [140, 40, 110]),
    ("cola", [18, 30, 62]),
];
/// Light relative to a good exposure. Chosen by hand, from an evening without lamps to a window behind the operator.
const LIGHTS: [(&str, f64); 3] = [("dim", 0.45), ("normal", 1.0), ("bright", 1.4)];
/// Standard deviation of the pixel noise, grey levels. Chosen by hand, from a good industrial camera to a cheap one at night.
const NOISES: [(&str, f64); 3] = [("low", 1.5), ("middle", 4.0), ("high", 8.0)];
/// Standard deviation of the blur, px. Chosen by hand, from a sharp lens to one that is visibly out of focus.
const BLURS: [(&str, f64); 3] = [("none", 0.0), ("slight", 0.8), ("strong", 1.6)];
/// Opening angle from which on a lip is called wide, degrees: the middle of those that are drawn.
const WIDE_SPOUT_DEG: f64 = 67.0;
/// Share of the short scenes in which nothing flows. Chosen by hand, so that false flow has a figure of its own.
const DRY_SHARE: f64 = 0.25;

/// A cell with the names of its conditions.
pub struct Case {
    /// The camera's view.
    pub view: View,
    /// The feature worker's configuration.
    pub image: ImageConfig,
    /// Its conditions, such as `light dim`.
    pub labels: Vec<String>,
    /// The seed that the renderer is given.
    pub seed: u64,
    /// Whether a short scene of it stays dry.
    pub dry: bool,
}

/// The name of a background.
pub fn name(background: Background) -> String {
    format!("{background:?}").to_lowercase()
}

impl Case {
    /// A cell that `random` draws; with clear water or a coloured liquid whose colour is learned from one pour. A given `background`
    /// takes the place of the drawn one, and changes nothing else.
    ///
    /// # Errors
    /// When the liquid's colour cannot be learned.
    pub fn draw(random: &mut Pcg64Mcg, clear: bool, background: Option<Background>, seed: u64) -> Result<Self, CameraError> {
        let mut pick = |levels: &[(&'static str, f64)]| levels.choose(random).copied().unwrap_or(levels[0]);
        let (light_name, light) = pick(&LIGHTS);
        let (noise_name, noise) = pick(&NOISES);
        let (blur_name, blur_px) = pick(&BLURS);
        let drawn = *Background::ALL.choose(random).unwrap_or(&Background::Chess);
        let background = background.unwrap_or(drawn);
        let (liquid_name, colour) = *LIQUIDS.choose(random).unwrap_or(&LIQUIDS[0]);
        let placed = View::placed(random);
        let view = View {
            liquid_bgr: (!clear).then_some(colour),
            opacity: random.random_range(0.8..0.97),
            background,
            light,
            noise,
            blur_px,
            ..placed
        };
        let mut image = image_config(&view);
        if !clear {
            // The person calibrates under good light, before the same background.
            image.colour_hsv = learn_colour(&View { light: 1.0, noise: 3.0, blur_px: 0.3, ..view.clone() }, &image, seed)?;
        }
        let labels = vec![
            format!("liquid {}", if clear { "clear water" } else { liquid_name }),
            format!("background {}", name(background)),
            format!("light {light_name}"),
            format!("noise {noise_name}"),
            format!("blur {blur_name}"),
            format!("lip {}", if view.spout_deg < WIDE_SPOUT_DEG { "narrow" } else { "wide" }),
        ];
        Ok(Self { view, image, labels, seed, dry: random.random::<f64>() < DRY_SHARE })
    }
}
