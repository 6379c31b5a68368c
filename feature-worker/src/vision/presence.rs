//! When a stream that is not seen any more is gone: a stream of hundreds of px^2 does not end from one picture to the next, so it is not
//! seen until there is evidence of dry ground where it was.
//!
//! Counts of pictures are those at 30 Hz; at another rate they stand for the same times. Called on the extraction thread. Nothing is allocated and nothing fails.

use super::liquid::Unsure;
use super::pace::Pace;

/// A smaller stream may end between two pictures, px^2 of a picture 640 px wide. Tuned on seeds 1, 5001 to 5003 and 101 to 104 of
/// `evaluate-camera`, see docs/VISION.md.
const LASTING_PX2: f32 = 100.0;
/// Width of the picture for which that holds, px.
const WIDTH_PX: f32 = 640.0;
/// The ground is dry when this share of the stream's former place was seen to be ground. Tuned as [`LASTING_PX2`] was.
const DRY_SHARE: f32 = 0.6;
/// So many pictures in a row have to show dry ground for each doubling of the last area above [`LASTING_PX2`]: a stream that ends gets
/// small first, and one whose colours are those of the ground for a few pictures does not. Tuned on seeds 1 and 101 of
/// `evaluate-camera --faults`.
const PICTURES_PER_DOUBLING: f32 = 1.5;
/// But no more than so many: 0.3 s at 30 Hz. Chosen by hand, so that a pour does not end late.
const PICTURES_MOST: u32 = 9;
/// After something foreign at the lip, so many pictures in a row have to show none. Tuned as [`PICTURES_PER_DOUBLING`] was.
const FOREIGN_PICTURES: u32 = 5;
/// So many where no stream was seen for [`LATELY_PICTURES`]: nothing that flows has changed its colours then, and what passes the lip is an edge of ground
/// that was never seen. With 5 a thin rod that passes ended a pour: one picture and five more are the 0.2 s of `controller.stale_feature_ms`.
const FOREIGN_DRY_PICTURES: u32 = 2;
/// A stream that was seen within so many pictures may be there still, in other colours: one second. Chosen by hand: longer than a bottle gurgles.
const LATELY_PICTURES: u32 = 30;

/// A smaller stream than the last one, after pictures without any, is what is left of it once it was seen in so many pictures in a row. Chosen by hand: a
/// false line inside a stream that has left the region lasts for one or two.
const RETURN_PICTURES: u32 = 5;

/// After so many pictures without a stream, what is seen in its place is the ground. Chosen by hand: three seconds, after which a pour
/// that sees nothing has long ended.
const HELD_PICTURES: u32 = 90;

/// Where the light is not what it was, by this factor, colours are no evidence. Chosen by hand: a container that turns changes the mean
/// level by less in a second.
const LIGHT_CHANGE: f32 = 1.25;
/// Where a colour's share of the light is not what it was, by this factor, colours are no evidence either. Chosen by hand.
const COLOUR_CHANGE: f32 = 1.1;
/// After this many pictures in other light, that is the light. Chosen by hand: the end of a pour must not be late.
const LIGHT_PICTURES: u32 = 6;

/// Remembers the stream until its end was seen.
pub(crate) struct Presence {
    lasting_px2: f32,
    /// The pictures that are needed, in units of the usual ones.
    patience: f32,
    pace: Pace,
    /// Legs of the stream that may still be there, px from the lip.
    legs_px: Option<[f32; 2]>,
    /// Pictures in a row that showed dry ground in its place.
    dry_pictures: u32,
    /// So many of them are needed.
    needed: u32,
    /// Pictures in a row without a stream, and with one.
    unseen: u32,
    seen: u32,
    /// Pictures that still have to show nothing foreign at the lip.
    foreign: u32,
    /// Mean levels of blue, green and red in the last picture with a stream.
    bgr: [f32; 3],
    /// Pictures in a row in other light.
    other_light: u32,
    /// Pictures that still have to look dry after one in which it was not told, see [`Unsure::LastsOnceDry`]; none until the ground was told dry, since the
    /// start or the last pause.
    unsure: Option<u32>,
    /// Pictures in which it was not told, less those that looked dry since.
    untold: u32,
}

impl Presence {
    /// For pictures of this width, px. There is no stream yet.
    pub(crate) fn new(width_px: u32, patience: f32) -> Self {
        let scale = width_px as f32 / WIDTH_PX;
        Self {
            lasting_px2: LASTING_PX2 * scale * scale,
            patience,
            pace: Pace::CHOSEN,
            legs_px: None,
            dry_pictures: 0,
            needed: 1,
            unseen: u32::MAX,
            seen: 0,
            foreign: 0,
            bgr: [0.0; 3],
            other_light: 0,
            unsure: None,
            untold: 0,
        }
    }

    /// Says how fast pictures follow each other.
    pub(crate) fn set_pace(&mut self, pace: Pace) {
        self.pace = pace;
    }

    /// Says that a pause of unknown length lies before the next picture. A stream that was seen may be there still, and dry ground may be so no more.
    pub(crate) fn interrupt(&mut self) {
        (self.dry_pictures, self.unsure, self.untold) = (0, None, 0);
    }

    /// A stream was measured in a picture with these mean levels of blue, green and red.
    pub(crate) fn saw(&mut self, area_px2: f32, legs_px: [f32; 2], bgr: [f32; 3]) {
        (self.bgr, self.other_light) = (bgr, 0);
        (self.dry_pictures, self.foreign, self.unsure, self.untold) = (0, 0, self.unsure.map(|_| 0), 0);
        let shrinks = self.legs_px.is_some_and(|before| before[0] * before[1] > legs_px[0] * legs_px[1]);
        if shrinks && self.seen < self.pace.pictures(RETURN_PICTURES) {
            return;
        }
        self.legs_px = (area_px2 >= self.lasting_px2).then_some(legs_px);
        let doublings = (area_px2 / self.lasting_px2).max(1.0).log2();
        let most = self.pace.parts(self.patience * PICTURES_MOST as f32) as u32;
        self.needed = (self.pace.parts(self.patience * PICTURES_PER_DOUBLING * doublings) as u32).clamp(1, most.max(1));
    }

    /// A stream was seen of which no more than a part was measured, as [`Self::saw`] says: it is no smaller than what was there before.
    pub(crate) fn saw_part(&mut self, area_px2: f32, legs_px: [f32; 2], bgr: [f32; 3]) {
        if self.legs_px.is_none_or(|before| before[0] * before[1] < legs_px[0] * legs_px[1]) {
            self.saw(area_px2, legs_px, bgr);
        }
        self.saw_unsure(Unsure::Lasts);
    }

    /// There may be a stream that was not measured. Where something foreign lies at the lip, or the liquid's colours are not told, this lasts: then the
    /// next pictures have to show none.
    pub(crate) fn saw_unsure(&mut self, unsure: Unsure) {
        self.dry_pictures = 0;
        self.untold = (self.untold + 1).min(self.pace.pictures(LATELY_PICTURES));
        let needed = self.pace.pictures(if self.flowed_lately() { FOREIGN_PICTURES } else { FOREIGN_DRY_PICTURES });
        match unsure {
            Unsure::Passes => {}
            // An edge of ground that passes is not told in a few pictures, and a stream in many.
            Unsure::LastsOnceDry => {
                let needed = needed.max(self.untold.min(self.pace.pictures(FOREIGN_PICTURES)));
                self.unsure = self.unsure.map(|pictures| pictures.max(needed));
            }
            Unsure::Lasts => self.foreign = self.foreign.max(needed),
        }
    }

    /// Whether a stream was seen within the last second.
    pub(crate) fn flowed_lately(&self) -> bool {
        self.unseen <= self.pace.pictures(LATELY_PICTURES)
    }

    /// Legs of a stream that was seen, and not yet its end, px from the lip. None after some seconds without a stream, when what is seen is the ground.
    pub(crate) fn holds(&mut self, seen: bool) -> Option<[f32; 2]> {
        (self.seen, self.unseen) = if seen { (self.seen.saturating_add(1), 0) } else { (0, self.unseen.saturating_add(1)) };
        if self.unseen > self.pace.pictures(HELD_PICTURES) {
            self.legs_px = None;
        }
        self.legs_px
    }

    /// No stream was seen in a picture with these mean levels, without other doubts. Returns whether there is none; `dry_share` tells which
    /// share of a triangle with these legs was seen to be ground.
    pub(crate) fn is_gone(&mut self, bgr: [f32; 3], dry_share: impl FnOnce([f32; 2]) -> f32) -> bool {
        let doubted = self.foreign > 0 || self.unsure.is_some_and(|pictures| pictures > 0);
        self.foreign = self.foreign.saturating_sub(1);
        self.untold = self.untold.saturating_sub(1);
        self.unsure = self.unsure.map(|pictures| pictures.saturating_sub(1));
        let Some(legs_px) = self.legs_px else {
            if !doubted {
                self.unsure.get_or_insert(0);
            }
            return !doubted;
        };
        self.other_light = if is_other_light(self.bgr, bgr) { self.other_light + 1 } else { 0 };
        let told = self.other_light == 0 || self.other_light > self.pace.pictures(LIGHT_PICTURES);
        self.dry_pictures = if told && dry_share(legs_px) >= DRY_SHARE { self.dry_pictures + 1 } else { 0 };
        if self.dry_pictures >= self.needed {
            self.legs_px = None;
        }
        self.legs_px.is_none() && !doubted
    }
}

/// Whether one picture's mean levels of blue, green and red are those of another light than another's.
fn is_other_light(before: [f32; 3], now: [f32; 3]) -> bool {
    let changes: [f32; 3] = std::array::from_fn(|k| now[k].max(1.0) / before[k].max(1.0));
    let all = changes.iter().sum::<f32>() / 3.0;
    let off = |change: f32, most: f32| change.max(1.0 / change) > most;
    off(all, LIGHT_CHANGE) || changes.iter().any(|change| off(change / all, COLOUR_CHANGE))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects pours of a stream that has left the region: a false line inside it, in a picture or two, is not all that is left of it, so its end is none of
    /// the stream's. A stream that really came back smaller is known after some pictures.
    #[test]
    fn a_false_line_in_a_large_stream_is_not_its_end() {
        let (large, small, light) = ([200.0, 150.0], [60.0, 50.0], [90.0; 3]);
        // Evidence of dry ground, where only the small one was.
        let dry = |legs_px: [f32; 2]| f32::from(u8::from(legs_px[0] < 100.0));
        for (pictures, gone) in [(1, false), (2, false), (RETURN_PICTURES + 1, true)] {
            let mut presence = Presence::new(640, 1.0);
            let see = |presence: &mut Presence, area_px2: f32, legs_px: [f32; 2]| {
                presence.saw(area_px2, legs_px, light);
                presence.holds(true);
            };
            (0..20).for_each(|_| see(&mut presence, 15_000.0, large));
            for _ in 0..10 {
                assert!(!presence.is_gone(light, dry));
                presence.holds(false);
            }
            (0..pictures).for_each(|_| see(&mut presence, 1_500.0, small));
            let seen_to_end = (0..2 * PICTURES_MOST).any(|_| {
                presence.holds(false);
                presence.is_gone(light, dry)
            });
            assert_eq!(seen_to_end, gone, "{pictures}");
        }
    }

    /// Protects pours of clear water before a pattern that was not told for long: the longer, the more pictures have to look dry in a row. An edge of ground that
    /// passes asks for two.
    #[test]
    fn what_was_not_told_for_long_is_not_dry_at_once() {
        let light = [90.0; 3];
        for (untold, needed) in [(1, 2), (3, 3), (20, 5)] {
            let mut presence = Presence::new(640, 1.0);
            assert!(presence.is_gone(light, |_| 1.0), "told dry");
            (0..untold).for_each(|_| presence.saw_unsure(Unsure::LastsOnceDry));
            let doubted = (0..20).take_while(|_| !presence.is_gone(light, |_| 1.0)).count();
            assert_eq!(doubted, needed, "after {untold}");
        }
    }
}
