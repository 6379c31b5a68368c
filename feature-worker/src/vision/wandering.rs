//! Whether the camera's colours or its brightness wander, as with a white balance or an exposure that hunts: then a coloured liquid may look
//! like the ground, and no picture by itself shows it. It is told from picture to picture by how the ground far from the lip changes, ray by
//! ray: light changes all rays by the same factors, and what moves behind does not.
//!
//! Called on the extraction thread. Nothing is allocated after the start and nothing fails.

use shared::messages::Doubt;

use super::geometry::RAYS;
use super::pace::Pace;
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
const PICTURES: u32 = 60;
/// Colours wander when the share of one of them in the light changes by this factor. Tuned on seeds 1 to 4 of `evaluate-camera --faults`: gains
/// of red and blue that wander by 10 % change it by 1.14 to 1.22, and liquids are still told then; by 20 %, by 1.31 to 1.5.
const COLOURS: f32 = 1.25;
/// Brightness wanders when it changes by this factor. Tuned as [`COLOURS`] was: an exposure that hunts by 1.6 changes it by 2.6.
const BRIGHTNESS: f32 = 4.0;
/// For so many pictures it counts, because it is told only while the background is at rest or even. Chosen by hand: ten seconds.
const COUNTS_FOR: u32 = 300;

/// The light has gone far only if the ground itself shows at least this share of it between the two ends of its way, in the median of the rays.
/// Chosen by hand: on seeds 1 to 3 of `evaluate-camera --faults` it shows 55 % and more; planks that pass, which add up to as much, show 5 %.
const SHOWS: f32 = 0.35;

/// Mean levels of blue, green and red of the ground on each ray of a picture, and of how many samples.
pub(super) type Ground = [([f32; 3], u32); RAYS];

/// Watches the light on the ground.
pub(super) struct Wandering {
    /// Logarithms of the light's blue, green and red against the first picture's, as far as its changes were told.
    light: [f32; 3],
    /// The last of these without a gap, as a ring, and the pictures that they belong to.
    way: Vec<[f32; 3]>,
    pictures: Vec<Ground>,
    /// How many there were; it does not grow beyond twice the ring.
    told: usize,
    pace: Pace,
    colours_for: u32,
    brightness_for: u32,
    ratios: [Vec<f32>; 3],
    scratch: Vec<f32>,
}

/// The logarithm of the mean of levels of which these are the logarithms.
fn mean(logarithms: &[f32; 3]) -> f32 {
    (logarithms.iter().map(|v| v.exp()).sum::<f32>() / 3.0).max(1e-6).ln()
}

impl Wandering {
    /// Nothing was seen yet.
    pub(super) fn new() -> Self {
        Self {
            light: [0.0; 3],
            way: vec![[0.0; 3]; PICTURES as usize],
            pictures: vec![[([0.0; 3], 0); RAYS]; PICTURES as usize],
            told: 0,
            pace: Pace::CHOSEN,
            colours_for: 0,
            brightness_for: 0,
            ratios: std::array::from_fn(|_| Vec::with_capacity(RAYS)),
            scratch: Vec::with_capacity(RAYS),
        }
    }

    /// Says how fast pictures follow each other. Allocates when they come faster than before.
    pub(super) fn set_pace(&mut self, pace: Pace) {
        self.pace = pace;
        let ring = pace.pictures(PICTURES) as usize;
        if ring != self.way.len() {
            self.way.resize(ring, [0.0; 3]);
            self.pictures.resize(ring, [([0.0; 3], 0); RAYS]);
            self.told = 0;
        }
    }

    /// Says that a pause lies before the next picture: the light's way has a gap.
    pub(super) fn interrupt(&mut self) {
        self.begin_anew();
    }

    /// Begins a new way. A light that only ever adds up would be no number in the end.
    fn begin_anew(&mut self) {
        (self.told, self.light) = (0, [0.0; 3]);
    }

    /// Takes the next picture.
    pub(super) fn look(&mut self, now: &Ground) {
        self.colours_for = self.colours_for.saturating_sub(1);
        self.brightness_for = self.brightness_for.saturating_sub(1);
        match self.change(now) {
            Some(change) => (0..3).for_each(|k| self.light[k] += change[k]),
            // The light's way has a gap that nothing bridges: of a light that rises and falls, only the rise may have been told.
            None => self.begin_anew(),
        }
        self.keep(now);
        if (0..3).any(|k| self.is_far(now, COLOURS, |l| l[k] - mean(l))) {
            self.colours_for = self.pace.pictures(COUNTS_FOR);
        }
        if self.is_far(now, BRIGHTNESS, mean) {
            self.brightness_for = self.pace.pictures(COUNTS_FOR);
        }
    }

    /// Goes on with the light's way, or begins one.
    fn keep(&mut self, now: &Ground) {
        let (ring, at) = (self.way.len(), self.told % self.way.len());
        (self.way[at], self.pictures[at]) = (self.light, *now);
        self.told = if self.told + 1 == 2 * ring { ring } else { self.told + 1 };
    }

    /// Whether what `of` makes of the light's logarithms has changed by more than this factor on its way, and the ground shows it. Ground that passes
    /// changes all rays a little from picture to picture, which adds up to a way, and none from its one end to its other: then a new way begins.
    fn is_far(&mut self, now: &Ground, factor: f32, of: impl Fn(&[f32; 3]) -> f32) -> bool {
        let way = || self.way[..self.told.min(self.way.len())].iter().map(&of).enumerate();
        let by_light = |a: &(usize, f32), b: &(usize, f32)| a.1.total_cmp(&b.1);
        let (Some((darkest, low)), Some((brightest, high))) = (way().min_by(by_light), way().max_by(by_light)) else { return false };
        if (high - low).exp() <= factor {
            return false;
        }
        self.scratch.clear();
        for (one, other) in self.pictures[darkest].iter().zip(&self.pictures[brightest]) {
            if one.1 > 0 && other.1 > 0 {
                let logarithms = |levels: [f32; 3]| levels.map(|level| level.max(1.0).ln());
                self.scratch.push(of(&logarithms(other.0)) - of(&logarithms(one.0)));
            }
        }
        let shown = !self.scratch.is_empty() && median(&mut self.scratch) >= SHOWS * (high - low);
        if !shown {
            self.begin_anew();
            self.keep(now);
        }
        shown
    }

    /// What wanders, if something does.
    pub(super) fn doubt(&self) -> Option<Doubt> {
        if self.colours_for > 0 { Some(Doubt::ColoursChanged) } else { (self.brightness_for > 0).then_some(Doubt::LightFlickers) }
    }

    /// The logarithms by which the light's blue, green and red changed since the last picture, if that is told.
    fn change(&mut self, now: &Ground) -> Option<[f32; 3]> {
        let before = &self.pictures[self.told.checked_sub(1)? % self.way.len()];
        self.ratios.iter_mut().for_each(Vec::clear);
        for ((now, count), (before, count_before)) in now.iter().zip(before) {
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
            let rays: Ground = std::array::from_fn(|i| {
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
            let rays: Ground = std::array::from_fn(|i| {
                let level = (60.0 + i as f32) * (1.0 + moves * (0.9 * picture as f32 + i as f32).sin());
                ([level * gain; 3], 6)
            });
            wandering.look(&rays);
        }
        assert_eq!(wandering.doubt(), None);
    }

    /// Protects dry frames before planks that pass while the container turns: on nearly all rays they get a little redder in each picture, and on none do
    /// they in the end.
    #[test]
    fn small_changes_that_lead_nowhere_do_not_add_up() {
        let mut wandering = Wandering::new();
        for picture in 0..240usize {
            let rays: Ground = std::array::from_fn(|i| ([60.0, 60.0, 60.0 * 1.01f32.powi(((picture + 7 * i) % 20) as i32)], 6));
            wandering.look(&rays);
            assert_eq!(wandering.doubt(), None, "picture {picture}");
        }
    }

    /// Protects pours from a step of the white balance in the first picture that tells the light again after others that did not, or in one
    /// that comes between them: it is named.
    #[test]
    fn a_step_right_after_a_gap_is_named() {
        let doubt = |steps_at: usize, is_gap: &dyn Fn(usize) -> bool| {
            let mut wandering = Wandering::new();
            for picture in 0..40usize {
                let (red, moves) = (if picture < steps_at { 1.0 } else { 1.5 }, if is_gap(picture) { 0.3 } else { 0.0 });
                let rays: Ground = std::array::from_fn(|i| {
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
