//! Whether pictures are missing again and again. Before a pattern clear water is told by how pictures follow each other, so a camera that
//! loses every third one does not show it, and the reason is said in every picture.
//!
//! Pure; called on the extraction thread. Nothing is allocated and nothing fails.

use shared::messages::Doubt;

/// So many pictures are remembered. Chosen by hand: two seconds.
const REMEMBERED: u32 = 60;
/// So many of them may be lost. Chosen by hand: one broken picture is no reason to end a pour.
const LOST_MOST: u32 = 1;

/// Remembers which of the last pictures could not be looked at.
pub(super) struct Disturbed {
    /// One bit for each picture, the last one first.
    lost: u64,
    /// Why the last of them could not be looked at.
    doubt: Doubt,
}

impl Disturbed {
    /// No picture was lost yet.
    pub(super) fn new() -> Self {
        Self { lost: 0, doubt: Doubt::None }
    }

    /// A picture could not be looked at, for this reason.
    pub(super) fn lose(&mut self, doubt: Doubt) {
        (self.lost, self.doubt) = (self.lost << 1 | 1, doubt);
    }

    /// A picture was looked at.
    pub(super) fn look(&mut self) {
        self.lost <<= 1;
    }

    /// The reason for which pictures are missing, if too many are.
    pub(super) fn doubt(&self) -> Option<Doubt> {
        let remembered = self.lost & ((1 << REMEMBERED) - 1);
        (remembered.count_ones() > LOST_MOST).then_some(self.doubt)
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
        disturbed.look();
        assert_eq!(disturbed.doubt(), None);
        disturbed.lose(Doubt::Frozen);
        assert_eq!(disturbed.doubt(), Some(Doubt::Frozen));
        (0..57).for_each(|_| disturbed.look());
        assert_eq!(disturbed.doubt(), Some(Doubt::Frozen));
        (0..60).for_each(|_| disturbed.look());
        assert_eq!(disturbed.doubt(), None);
    }
}
