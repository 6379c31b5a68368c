//! The colours of the ground: what a coloured liquid is not, and what must be seen again before a stream counts as gone.
//!
//! A liquid whose colour leaves its range is seen as ground by the range alone. So the colours that were seen far from the lip, and near
//! it while the worker was new, are counted in a table of their shares of blue and red. Brightness does not enter, because exposures
//! wander; places do not, because the background moves. What is in neither the range nor the table is foreign.
//!
//! Called on the extraction thread; nothing is allocated after the start and nothing fails.

/// Shares of blue and of red that are told apart. Chosen by hand: a step is about what noise and a lamp's tint do.
const SHARES: usize = 32;
/// Colours darker than this sum of their levels are only noise. Chosen by hand.
const DARK_SUM: usize = 30;
/// A colour whose parts reach this is white light and not a colour, grey levels. As in the check of light, a little below 255.
const BLIND_LEVEL: u8 = 250;
/// What one sample adds to its colour.
const SEEN: u16 = 4;
/// What one sample adds to the colours beside its own.
const SEEN_BESIDE: u16 = 1;
/// From a colour's place to those beside it, as the table wraps around.
const BESIDE: [usize; 8] = [
    1,
    SHARES - 1,
    SHARES,
    SHARES + 1,
    SHARES * SHARES - 1,
    SHARES * SHARES - SHARES + 1,
    SHARES * SHARES - SHARES,
    SHARES * SHARES - SHARES - 1,
];
/// A colour with this count is known. Chosen by hand: two samples, or eight of colours beside it.
const KNOWN: u16 = 8;
/// A count does not grow further than this. Chosen by hand, so that what is not seen any more is forgotten within a minute.
const COUNT_MOST: u16 = 4096;
/// A count loses this share when its turn comes. Chosen by hand, see [`COUNT_MOST`].
const FORGETS: u16 = 8;

/// What a colour is to the ground.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Ground {
    /// It is a colour of the ground.
    Known,
    /// It is white light or dark, which the ground was not seen to be, and could be anything.
    Blind,
    /// The ground has no such colour.
    Foreign,
}

/// Where what is too dark to have a colour is counted.
const DARK: usize = SHARES * SHARES;
/// Where white light is counted.
const WHITE: usize = DARK + 1;

/// The colours of the ground that were seen.
pub(crate) struct GroundColours {
    /// A count for each share of blue and share of red, which wraps around; then for dark and white.
    counts: [u16; SHARES * SHARES + 2],
    /// `SHARES / sum` for each sum of three levels, of which 65536 is 1.
    per_sum: [u32; 766],
    /// Which row of the table is forgotten next.
    turn: usize,
}

impl GroundColours {
    /// Nothing was seen yet.
    pub(crate) fn new() -> Self {
        let per_sum = std::array::from_fn(|sum| (SHARES * 65_536 / sum.max(1)) as u32);
        Self { counts: [0; SHARES * SHARES + 2], per_sum, turn: 0 }
    }

    /// Where a colour of blue, green and red is counted.
    #[inline(always)]
    fn place(&self, [blue, green, red]: [u8; 3]) -> usize {
        let sum = usize::from(blue) + usize::from(green) + usize::from(red);
        let share = |level: u8| (((u32::from(level) * self.per_sum[sum]) >> 16) as usize).min(SHARES - 1);
        if sum < DARK_SUM {
            DARK
        } else if blue.min(green).min(red) >= BLIND_LEVEL {
            WHITE
        } else {
            share(blue) * SHARES + share(red)
        }
    }

    /// What a colour is to the ground.
    #[inline(always)]
    pub(crate) fn tell(&self, colour: [u8; 3]) -> Ground {
        let place = self.place(colour);
        match self.counts[place] {
            KNOWN.. => Ground::Known,
            _ if place >= DARK => Ground::Blind,
            _ => Ground::Foreign,
        }
    }

    /// Whether a colour is white light that the ground was not seen to be.
    #[inline(always)]
    pub(crate) fn is_blind(&self, colour: [u8; 3]) -> bool {
        colour.iter().all(|v| *v >= BLIND_LEVEL) && self.counts[WHITE] < KNOWN
    }

    /// Takes a colour for one of the ground. White light close to the lip is a reflection and no ground, so it counts only where `is_far`.
    #[inline(always)]
    pub(crate) fn learn(&mut self, colour: [u8; 3], is_far: bool) {
        let place = self.place(colour);
        if place == WHITE && !is_far {
            return;
        }
        let count = &mut self.counts[place];
        *count = (*count + SEEN).min(COUNT_MOST);
        if place >= DARK {
            return;
        }
        for beside in BESIDE {
            let count = &mut self.counts[(place + beside) % (SHARES * SHARES)];
            *count = (*count + SEEN_BESIDE).min(COUNT_MOST);
        }
    }

    /// Forgets a little. Call it once for each picture.
    pub(crate) fn forget(&mut self) {
        let from = self.turn * SHARES;
        let to = if self.turn + 1 == SHARES { self.counts.len() } else { from + SHARES };
        for count in &mut self.counts[from..to] {
            *count -= *count / FORGETS;
        }
        self.turn = (self.turn + 1) % SHARES;
    }
}
