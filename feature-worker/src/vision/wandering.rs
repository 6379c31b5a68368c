//! Whether the camera's colours or its brightness wander, as with a white balance or an exposure that hunts: then a coloured liquid may look
//! like the ground, and no picture by itself shows it. It is told from picture to picture by how the ground far from the lip changes, ray by
//! ray: light changes all rays by the same factors, and what moves behind does not.
//!
//! Called on the extraction thread. Nothing is allocated after the start and nothing fails.

use shared::messages::Doubt;

use super::geometry::RAYS;
use super::picture::median;

/// A ray agrees when each of its colours changed by the common factor up to this share. Chosen by hand: noise alone makes 1 to 3 %.
const AGREES: f32 = 0.04;
/// The change of the light is told when this share of the rays agrees. Chosen by hand.
const RAYS_AGREE: f32 = 0.7;
/// And when so many rays show the ground. Chosen by hand.
const RAYS_LEAST: usize = RAYS / 3;
/// A ray with a brighter or darker part tells nothing: it may be cut off, grey levels. Chosen by hand.
const TOLD_LEVELS: [f32; 2] = [3.0, 225.0];
/// Pictures over which the light's way is looked at. Chosen by hand: two seconds, a period of a white balance that hunts.
const PICTURES: usize = 60;
/// Colours wander when the share of one of them in the light changes by this factor. Tuned on seeds 1 to 4 of `evaluate-camera --faults`: gains
/// of red and blue that wander by 10 % change it by 1.14 to 1.22, and liquids are still told then; by 20 %, by 1.31 to 1.5.
const COLOURS: f32 = 1.25;
/// Brightness wanders when it changes by this factor. Tuned as [`COLOURS`] was: an exposure that hunts by 1.6 changes it by 2.6.
const BRIGHTNESS: f32 = 4.0;
/// For so many pictures it counts, because it is told only while the background is at rest or even. Chosen by hand: ten seconds.
const COUNTS_FOR: u32 = 300;

/// Watches the light on the ground.
pub(super) struct Wandering {
    /// Mean levels of each ray's ground in the last picture with the number of samples, 0 where there was none.
    before: [([f32; 3], u32); RAYS],
    /// Logarithms of the light's blue, green and red against the first picture's, as far as its changes were told.
    light: [f32; 3],
    /// The last of these, as a ring.
    way: [[f32; 3]; PICTURES],
    told: usize,
    colours_for: u32,
    brightness_for: u32,
    ratios: [Vec<f32>; 3],
    scratch: Vec<f32>,
}

impl Wandering {
    /// Nothing was seen yet.
    pub(super) fn new() -> Self {
        Self {
            before: [([0.0; 3], 0); RAYS],
            light: [0.0; 3],
            way: [[0.0; 3]; PICTURES],
            told: 0,
            colours_for: 0,
            brightness_for: 0,
            ratios: std::array::from_fn(|_| Vec::with_capacity(RAYS)),
            scratch: Vec::with_capacity(RAYS),
        }
    }

    /// Takes the next picture: the mean levels of blue, green and red of the ground on each ray, and of how many samples.
    pub(super) fn look(&mut self, now: &[([f32; 3], u32); RAYS]) {
        self.colours_for = self.colours_for.saturating_sub(1);
        self.brightness_for = self.brightness_for.saturating_sub(1);
        let change = self.change(now);
        if change.is_none() {
            // The light's way has a gap that nothing bridges: of a light that rises and falls, only the rise may have been told. A new way
            // begins in this picture, against which the next one is compared.
            self.way[0] = self.light;
            self.told = 1;
        }
        if let Some(change) = change {
            (0..3).for_each(|k| self.light[k] += change[k]);
            self.way[self.told % PICTURES] = self.light;
            self.told = if self.told + 1 == 2 * PICTURES { PICTURES } else { self.told + 1 };
            let seen = &self.way[..self.told.min(PICTURES)];
            let range = |of: &dyn Fn(&[f32; 3]) -> f32| {
                let (low, high) = seen.iter().map(of).fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(v), h.max(v)));
                (high - low).exp()
            };
            let mean = |l: &[f32; 3]| (l.iter().map(|v| v.exp()).sum::<f32>() / 3.0).max(1e-6).ln();
            if (0..3).any(|k| range(&|l| l[k] - mean(l)) > COLOURS) {
                self.colours_for = COUNTS_FOR;
            }
            if range(&mean) > BRIGHTNESS {
                self.brightness_for = COUNTS_FOR;
            }
        }
        self.before = *now;
    }

    /// What wanders, if something does.
    pub(super) fn doubt(&self) -> Option<Doubt> {
        if self.colours_for > 0 { Some(Doubt::ColoursChanged) } else { (self.brightness_for > 0).then_some(Doubt::LightFlickers) }
    }

    /// The logarithms by which the light's blue, green and red changed since the last picture, if that is told.
    fn change(&mut self, now: &[([f32; 3], u32); RAYS]) -> Option<[f32; 3]> {
        self.ratios.iter_mut().for_each(Vec::clear);
        for ((now, count), (before, count_before)) in now.iter().zip(&self.before) {
            // Another number of samples are other places.
            if *count > 0 && count == count_before && now.iter().chain(before).all(|v| (TOLD_LEVELS[0]..=TOLD_LEVELS[1]).contains(v)) {
                (0..3).for_each(|k| self.ratios[k].push((now[k] / before[k]).ln()));
            }
        }
        let rays = self.ratios[0].len();
        if rays < RAYS_LEAST {
            return None;
        }
        let change: [f32; 3] = std::array::from_fn(|k| {
            self.scratch.clear();
            self.scratch.extend_from_slice(&self.ratios[k]);
            median(&mut self.scratch)
        });
        let agree = (0..rays).filter(|i| (0..3).all(|k| (self.ratios[k][*i] - change[k]).abs() <= AGREES)).count();
        (agree as f32 >= RAYS_AGREE * rays as f32).then_some(change)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The doubt after two seconds of a ground whose levels are multiplied by what `gains` says of each picture; on each ray something of its own
    /// passes, which is brighter or darker by the share `moves`.
    fn doubt(gains: impl Fn(f32) -> [f32; 3], moves: f32) -> Option<Doubt> {
        let mut wandering = Wandering::new();
        for picture in 0..60 {
            let gains = gains(picture as f32 / 30.0);
            let rays: [([f32; 3], u32); RAYS] = std::array::from_fn(|i| {
                let level = (60.0 + i as f32) * (1.0 + moves * (0.9 * picture as f32 + i as f32).sin());
                (gains.map(|gain| level * gain), 6)
            });
            wandering.look(&rays);
        }
        wandering.doubt()
    }

    /// Protects pours from a liquid that becomes the ground's colour: a white balance and an exposure that hunt far are named; an ordinary
    /// one, a lamp's drift, and a background that moves are not.
    #[test]
    fn light_that_wanders_is_named() {
        let wave = |share: f32| move |t: f32| [1.0 + share * (3.1 * t).sin(), 1.0, 1.0 + share * (3.1 * t + 1.0).cos()];
        assert_eq!(doubt(wave(0.2), 0.0), Some(Doubt::ColoursChanged));
        assert_eq!(doubt(wave(0.05), 0.0), None);
        assert_eq!(doubt(|t| [2.5f32.powf((4.2 * t).sin()); 3], 0.0), Some(Doubt::LightFlickers));
        assert_eq!(doubt(|t| [1.6f32.powf((4.2 * t).sin()); 3], 0.0), None);
        assert_eq!(doubt(wave(0.2), 0.3), None, "the background moves, so the light is not told");
    }

    /// Protects dry frames under an exposure that hunts a little while the background moves now and then: rises that are told and falls that
    /// are not do not add up to a far way.
    #[test]
    fn a_way_with_gaps_does_not_add_up() {
        let mut wandering = Wandering::new();
        for picture in 0..240 {
            let phase = 4.2 * picture as f32 / 30.0;
            let (gain, moves) = (1.6f32.powf(phase.sin()), if phase.cos() < 0.0 { 0.3 } else { 0.0 });
            let rays: [([f32; 3], u32); RAYS] = std::array::from_fn(|i| {
                let level = (60.0 + i as f32) * (1.0 + moves * (0.9 * picture as f32 + i as f32).sin());
                ([level * gain; 3], 6)
            });
            wandering.look(&rays);
        }
        assert_eq!(wandering.doubt(), None);
    }

    /// Protects pours from a step of the white balance in the first picture that tells the light again after others that did not, or in one
    /// that comes between them: it is named.
    #[test]
    fn a_step_right_after_a_gap_is_named() {
        let doubt = |steps_at: usize, is_gap: &dyn Fn(usize) -> bool| {
            let mut wandering = Wandering::new();
            for picture in 0..40usize {
                let (red, moves) = (if picture < steps_at { 1.0 } else { 1.5 }, if is_gap(picture) { 0.3 } else { 0.0 });
                let rays: [([f32; 3], u32); RAYS] = std::array::from_fn(|i| {
                    let level = (60.0 + i as f32) * (1.0 + moves * (0.9 * picture as f32 + i as f32).sin());
                    ([level, level, level * red], 6)
                });
                wandering.look(&rays);
            }
            wandering.doubt()
        };
        // Picture 21 is the first that is compared with one in which nothing moved.
        assert_eq!(doubt(21, &|picture| (10..20).contains(&picture)), Some(Doubt::ColoursChanged));
        assert_eq!(doubt(21, &|picture| picture % 3 == 1), Some(Doubt::ColoursChanged));
        assert_eq!(doubt(1, &|_| false), Some(Doubt::ColoursChanged), "right after the first picture");
    }
}
