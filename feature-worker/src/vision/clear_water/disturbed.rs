//! Whether pictures are missing again and again, or the light wanders. Before a pattern clear water is told by how pictures follow each other, so a camera that
//! loses every third one, or whose exposure hunts, does not show it, and the reason is said in every picture.
//!
//! Pure; called on the extraction thread. Nothing is allocated and nothing fails.

use shared::messages::Doubt;

use crate::vision::pace::Pace;

/// So many pictures are remembered. Chosen by hand: two seconds.
const REMEMBERED: u32 = 60;
/// So many of them may be lost. Chosen by hand: one broken picture is no reason to end a pour.
const LOST_MOST: usize = 1;

/// For so many pictures a jump of the light counts. Chosen by hand: jumps are told while the background is at rest, and a tilt takes seconds.
const JUMP_PICTURES: u32 = 100;
/// All jumps together count for no longer than this many pictures. Chosen by hand: 13 seconds.
const JUMPS_MOST: u32 = 400;
/// The light wanders while they count for more pictures than this. Chosen by hand: two jumps that follow each other within two seconds.
const JUMPS_LEAST: u32 = 150;

/// Remembers what was wrong with the last pictures.
pub(super) struct Disturbed {
    /// How many pictures ago the last ones were that could not be looked at, the newest first.
    lost_ago: [u32; LOST_MOST + 1],
    /// Why the last of them could not be looked at.
    doubt: Doubt,
    /// For how many pictures the light's jumps still count.
    jumps: u32,
    pace: Pace,
}

impl Disturbed {
    /// No picture was lost yet.
    pub(super) fn new() -> Self {
        Self { lost_ago: [u32::MAX; LOST_MOST + 1], doubt: Doubt::None, jumps: 0, pace: Pace::CHOSEN }
    }

    /// Says how fast pictures follow each other.
    pub(super) fn set_pace(&mut self, pace: Pace) {
        self.pace = pace;
    }

    /// A picture could not be looked at, for this reason.
    pub(super) fn lose(&mut self, doubt: Doubt) {
        self.pass();
        self.lost_ago.rotate_right(1);
        (self.lost_ago[0], self.doubt) = (0, doubt);
    }

    /// A picture was looked at; `jumps` says whether its light is another one than that of the picture before.
    pub(super) fn look(&mut self, jumps: bool) {
        self.pass();
        self.jumps = self.jumps.saturating_sub(1);
        if jumps {
            self.jumps = (self.jumps + self.pace.pictures(JUMP_PICTURES)).min(self.pace.pictures(JUMPS_MOST));
        }
    }

    /// Why clear water is not told before a pattern now, if there is a reason.
    pub(super) fn doubt(&self) -> Option<Doubt> {
        let loses = self.lost_ago[LOST_MOST] < self.pace.pictures(REMEMBERED);
        let wanders = (self.jumps > self.pace.pictures(JUMPS_LEAST)).then_some(Doubt::LightFlickers);
        loses.then_some(self.doubt).or(wanders)
    }

    /// One more picture has passed.
    fn pass(&mut self) {
        self.lost_ago.iter_mut().for_each(|ago| *ago = ago.saturating_add(1));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects pours from one broken picture, and from a camera that breaks every third: only the latter is a doubt, for two seconds.
    #[test]
    fn one_lost_picture_is_none() {
        let mut disturbed = Disturbed::new();
        disturbed.lose(Doubt::PictureIncomplete);
        disturbed.look(false);
        assert_eq!(disturbed.doubt(), None);
        disturbed.lose(Doubt::Frozen);
        assert_eq!(disturbed.doubt(), Some(Doubt::Frozen));
        (0..57).for_each(|_| disturbed.look(false));
        assert_eq!(disturbed.doubt(), Some(Doubt::Frozen));
        (0..60).for_each(|_| disturbed.look(false));
        assert_eq!(disturbed.doubt(), None);
    }

    /// Protects fast cameras: one that loses a picture every one and a half seconds is as much in doubt as a slow one.
    #[test]
    fn two_seconds_are_two_seconds_for_every_camera() {
        for hz in [30, 120, 240] {
            let mut disturbed = Disturbed::new();
            disturbed.set_pace(Pace::of(hz as f32));
            for _ in 0..2 {
                (0..hz * 3 / 2).for_each(|_| disturbed.look(false));
                disturbed.lose(Doubt::PictureIncomplete);
            }
            assert_eq!(disturbed.doubt(), Some(Doubt::PictureIncomplete), "{hz} Hz");
            (0..hz * 2).for_each(|_| disturbed.look(false));
            assert_eq!(disturbed.doubt(), None, "{hz} Hz");
        }
    }

    /// Protects pours before a pattern from an exposure that hunts, and not from a lamp that is switched on once.
    #[test]
    fn light_that_wanders_is_named() {
        let mut disturbed = Disturbed::new();
        disturbed.look(true);
        assert_eq!(disturbed.doubt(), None);
        (0..30).for_each(|_| disturbed.look(false));
        disturbed.look(true);
        assert_eq!(disturbed.doubt(), Some(Doubt::LightFlickers));
        (0..100).for_each(|_| disturbed.look(false));
        assert_eq!(disturbed.doubt(), None);
    }
}
