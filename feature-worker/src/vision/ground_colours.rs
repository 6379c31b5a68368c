//! The colours of the ground: what a coloured liquid is not, and what must be seen again before a stream counts as gone.
//!
//! A liquid whose colour leaves its range is seen as ground by the range alone. So the colours that were seen far from the lip, and near
//! it while the worker was new, are counted in a table of their shares of blue and red and their brightness. The shares are those of levels
//! that are raised by a share of the present picture's mean, because in dark colours noise alone makes every share; and brightness is that
//! against the present picture's ground. So an exposure that wanders changes neither. Places do not enter, because the background moves.
//! What is in neither the range nor the table is foreign.
//!
//! Called on the extraction thread; nothing is allocated after the start and nothing fails.

/// Shares of blue and of red that are told apart. Chosen by hand: a step is about what noise and a lamp's tint do.
const SHARES: usize = 64;
/// Colours darker than this sum of their levels are only noise. Chosen by hand.
const DARK_SUM: usize = 30;
/// A colour whose parts reach this is white light and not a colour, grey levels. As in the check of light, a little below 255.
const BLIND_LEVEL: u8 = 250;
/// Shares are taken of levels that are raised by this share of the ground's mean sum, whatever it is. Chosen by hand: in dim light, where the
/// mean sum is 100, by some times the noise of a smoothed sample.
const RAISED_SHARE: f64 = 0.1;
/// Levels are raised in such parts of a grey level, so that in dim light too it is the same share.
const RAISED_PARTS: u32 = 16;
/// What one sample adds to its colour.
const SEEN: u16 = 4;
/// What one sample adds to the colours beside its own.
const SEEN_BESIDE: u16 = 1;
/// Shares of blue and red that are told apart.
const CHROMAS: usize = SHARES * SHARES;
/// Steps of brightness that are told apart, each by a factor of the root of 2. Chosen by hand, from a sixth of the ground's to three times.
const STEPS: usize = 8;
/// From a colour's place to those beside it, as the table wraps around.
const BESIDE: [usize; 8] = [1, SHARES - 1, SHARES, SHARES + 1, CHROMAS - 1, CHROMAS - SHARES + 1, CHROMAS - SHARES, CHROMAS - SHARES - 1];
/// A colour with this count is known. Chosen by hand: more samples than a drop in flight has.
const KNOWN: u16 = 48;
/// A count does not grow further than this. Chosen by hand, so that what is not seen any more is forgotten within a minute.
const COUNT_MOST: u16 = 4096;
/// A count loses this share when its turn comes. Chosen by hand, see [`COUNT_MOST`].
const FORGETS: u16 = 4;

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
const DARK: usize = CHROMAS * STEPS;
/// Where white light is counted.
const WHITE: usize = DARK + 1;

/// The colours of the ground that were seen.
pub(crate) struct GroundColours {
    /// A count for each step of brightness, share of blue and share of red; then for dark and white.
    counts: Vec<u16>,
    /// `SHARES / sum` for each sum of three levels, which are `raised`, of which 65536 is 1.
    per_sum: [u32; 766],
    /// What is added to each level before its share is taken, in [`RAISED_PARTS`].
    raised: u32,
    /// The step of brightness for each sum of three levels in the present picture, times [`CHROMAS`].
    steps: [u32; 766],
    /// The sum of three levels for which the steps were made.
    mean_sum: u32,
    /// Which row of the table is forgotten next.
    turn: usize,
}

impl GroundColours {
    /// Nothing was seen yet.
    pub(crate) fn new() -> Self {
        let counts = vec![0; CHROMAS * STEPS + 2];
        let mut new = Self { counts, per_sum: [0; 766], raised: 0, steps: [0; 766], mean_sum: 0, turn: 0 };
        new.expose(384);
        new
    }

    /// Says how bright the ground is in the present picture: the mean sum of the three levels.
    pub(crate) fn expose(&mut self, mean_sum: u32) {
        if mean_sum.abs_diff(self.mean_sum) * 64 <= self.mean_sum {
            return;
        }
        self.mean_sum = mean_sum;
        let raised = RAISED_SHARE * f64::from(mean_sum);
        self.raised = (raised * f64::from(RAISED_PARTS)).round() as u32;
        for (sum, kept) in self.per_sum.iter_mut().enumerate() {
            *kept = ((SHARES * 65_536) as f64 / (sum as f64 + 3.0 * raised).max(1.0)) as u32;
        }
        // The middle of the steps is the mean's own brightness.
        let mut step = 0;
        for (sum, kept) in self.steps.iter_mut().enumerate() {
            let limit = f64::from(mean_sum) * 2.0f64.powf(0.5 * (step as f64 + 1.5 - STEPS as f64 * 0.6));
            step += usize::from(step + 1 < STEPS && sum as f64 >= limit);
            *kept = (step * CHROMAS) as u32;
        }
    }

    /// Where a colour of blue, green and red is counted.
    #[inline(always)]
    fn place(&self, [blue, green, red]: [u8; 3]) -> usize {
        let sum = usize::from(blue) + usize::from(green) + usize::from(red);
        // Darker colours than those of `DARK_SUM` do not come here, so nothing overflows.
        let share = |level: u8| {
            let raised = RAISED_PARTS * u32::from(level) + self.raised;
            ((raised * self.per_sum[sum] / (RAISED_PARTS << 16)) as usize).min(SHARES - 1)
        };
        if sum < DARK_SUM {
            DARK
        } else if blue.min(green).min(red) >= BLIND_LEVEL {
            WHITE
        } else {
            self.steps[sum] as usize + share(blue) * SHARES + share(red)
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

    /// Whether a colour is white light, whatever the ground is.
    #[inline(always)]
    pub(crate) fn is_white(colour: [u8; 3]) -> bool {
        colour.iter().all(|v| *v >= BLIND_LEVEL)
    }

    /// Whether a colour is white light that the ground was not seen to be.
    #[inline(always)]
    pub(crate) fn is_blind(&self, colour: [u8; 3]) -> bool {
        Self::is_white(colour) && self.counts[WHITE] < KNOWN
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
        let (brightness, chroma) = (place / CHROMAS * CHROMAS, place % CHROMAS);
        let darker = brightness.checked_sub(CHROMAS).map(|b| b + chroma);
        let brighter = Some(place + CHROMAS).filter(|p| *p < DARK);
        let around = BESIDE.iter().map(|beside| brightness + (chroma + beside) % CHROMAS);
        for place in around.chain(darker).chain(brighter) {
            let count = &mut self.counts[place];
            *count = (*count + SEEN_BESIDE).min(COUNT_MOST);
        }
    }

    /// Forgets a little. Call it once for each picture that is learned from.
    pub(crate) fn forget(&mut self) {
        let row = SHARES * STEPS;
        let from = self.turn * row;
        let to = if self.turn + 1 == SHARES { self.counts.len() } else { from + row };
        for count in &mut self.counts[from..to] {
            *count -= *count / FORGETS;
        }
        self.turn = (self.turn + 1) % SHARES;
    }
}

/// A mean of colours.
#[derive(Clone, Copy, Default)]
pub(super) struct Mean {
    sums: [u32; 3],
    pub(super) count: u32,
}

impl Mean {
    pub(super) fn add(&mut self, colour: [u8; 3]) {
        (0..3).for_each(|k| self.sums[k] += u32::from(colour[k]));
        self.count += 1;
    }

    pub(super) fn join(&mut self, other: Mean) {
        (0..3).for_each(|k| self.sums[k] += other.sums[k]);
        self.count += other.count;
    }

    /// Its levels of blue, green and red; 0 of none.
    pub(super) fn levels(&self) -> [f32; 3] {
        self.sums.map(|sum| sum as f32 / self.count.max(1) as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A colour in another exposure.
    fn exposed(colour: [u8; 3], gain: f32) -> [u8; 3] {
        colour.map(|level| (f32::from(level) * gain).round() as u8)
    }

    /// Protects dry pictures under an exposure that hunts: ground of any colour stays known, and what is no ground stays foreign.
    #[test]
    fn the_ground_is_known_in_any_exposure() {
        for mean_sum in [90u32, 150, 200, 250, 330] {
            let most = (245 / 2).min(mean_sum as usize);
            let colours: Vec<[u8; 3]> = (0..most)
                .step_by(7)
                .flat_map(|blue| (0..most).step_by(9).flat_map(move |green| (0..most).step_by(8).map(move |red| [blue, green, red])))
                .filter(|levels| (mean_sum as usize / 2..2 * mean_sum as usize).contains(&levels.iter().sum()))
                .map(|levels| levels.map(|level| level as u8))
                .filter(|levels| exposed(*levels, 0.6).iter().map(|v| u32::from(*v)).sum::<u32>() >= 45)
                .collect();
            assert!(colours.len() > 100, "{mean_sum}");
            for known in colours.iter().step_by(11) {
                let mut ground = GroundColours::new();
                ground.expose(mean_sum);
                // With a level of noise, as every sensor has.
                for i in 0..540u32 {
                    let [blue, green, red] = *known;
                    let noise = |level: u8, k: u32| (level + (i / 3u32.pow(k) % 3) as u8).saturating_sub(1);
                    ground.learn([noise(blue, 0), noise(green, 1), noise(red, 2)], true);
                }
                let foreign = colours.iter().find(|other| {
                    let sums = [*known, **other].map(|c| c.iter().map(|v| f32::from(*v)).sum::<f32>());
                    (0..3).any(|k| (f32::from(known[k]) / sums[0] - f32::from(other[k]) / sums[1]).abs() > 0.3)
                });
                for gain in [0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.3, 1.6, 2.0] {
                    ground.expose((mean_sum as f32 * gain).round() as u32);
                    assert_eq!(ground.tell(exposed(*known, gain)), Ground::Known, "{known:?} of {mean_sum} x {gain}");
                    if let Some(other) = foreign {
                        assert_eq!(ground.tell(exposed(*other, gain)), Ground::Foreign, "{other:?} for {known:?} of {mean_sum} x {gain}");
                    }
                }
            }
        }
    }
}
