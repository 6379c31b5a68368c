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

/// Where the ground's mean reaches this in a part, most of it is cut off there, grey levels. Chosen by hand: boards differ by a tenth.
const CUT_OFF_MEAN: f32 = 235.0;
/// A part that is cut off may be so many grey levels brighter than it looks, in steps of [`BEYOND_STEP`]. Chosen by hand: half as bright again.
const BEYOND_MOST: u32 = 120;
/// See [`BEYOND_MOST`]. Chosen by hand: less than a step of the shares.
const BEYOND_STEP: usize = 15;
/// Sums of three levels that a table holds: two of them beyond what is cut off.
const SUMS: usize = 3 * 255 + 2 * BEYOND_MOST as usize + 1;

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
    per_sum: [u32; SUMS],
    /// What is added to each level before its share is taken, in [`RAISED_PARTS`].
    raised: u32,
    /// The step of brightness for each sum of three levels in the present picture, times [`CHROMAS`].
    steps: [u32; SUMS],
    /// The sum of three levels for which the steps were made.
    mean_sum: u32,
    /// In which parts most of the ground is cut off.
    cut_off: [bool; 3],
    /// Which row of the table is forgotten next.
    turn: usize,
}

impl GroundColours {
    /// Nothing was seen yet.
    pub(crate) fn new() -> Self {
        let counts = vec![0; CHROMAS * STEPS + 2];
        let mut new = Self { counts, per_sum: [0; SUMS], raised: 0, steps: [0; SUMS], mean_sum: 0, cut_off: [false; 3], turn: 0 };
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

    /// Says the ground's mean levels of blue, green and red in the present picture.
    pub(crate) fn see_mean(&mut self, bgr: [f32; 3]) {
        self.cut_off = bgr.map(|level| level >= CUT_OFF_MEAN);
    }

    /// Whether a colour is one of the ground, but for how bright it is in parts in which most of the ground is cut off: the sensor made of
    /// known ground what has other shares.
    fn is_known_beyond(&self, colour: [u8; 3]) -> bool {
        let cut_off: [bool; 3] = std::array::from_fn(|k| self.cut_off[k] && colour[k] >= BLIND_LEVEL);
        let beyond = |by: u32| self.place_of(std::array::from_fn(|k| u32::from(colour[k]) + if cut_off[k] { by } else { 0 }));
        // White light has no colour at all.
        let tells = cut_off.contains(&true) && cut_off.contains(&false);
        tells && (0..=BEYOND_MOST).step_by(BEYOND_STEP).skip(1).any(|by| self.counts[beyond(by)] >= KNOWN)
    }

    /// Where a colour of blue, green and red is counted.
    #[inline(always)]
    fn place(&self, colour: [u8; 3]) -> usize {
        self.place_of(colour.map(u32::from))
    }

    /// Where these levels of blue, green and red are counted; two of them may be larger than 255 by [`BEYOND_MOST`].
    #[inline(always)]
    fn place_of(&self, [blue, green, red]: [u32; 3]) -> usize {
        let sum = (blue + green + red) as usize;
        // Darker colours than those of `DARK_SUM` do not come here, so nothing overflows.
        let share = |level: u32| {
            let raised = RAISED_PARTS * level + self.raised;
            ((raised * self.per_sum[sum] / (RAISED_PARTS << 16)) as usize).min(SHARES - 1)
        };
        if sum < DARK_SUM {
            DARK
        } else if blue.min(green).min(red) >= u32::from(BLIND_LEVEL) {
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
            _ if self.is_known_beyond(colour) => Ground::Known,
            _ => Ground::Foreign,
        }
    }

    /// Whether a colour is too dark to be one, whatever the ground is.
    #[inline(always)]
    pub(super) fn is_dark(colour: [u8; 3]) -> bool {
        colour.iter().map(|v| usize::from(*v)).sum::<usize>() < DARK_SUM
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

    /// Protects dry pictures when the exposure rises until red is cut off over the whole ground: it stays known, and an orange liquid that is cut off
    /// in the same way stays foreign. Where only some of the ground is cut off, nothing is excused.
    #[test]
    fn ground_that_is_cut_off_is_known() {
        let mut ground = GroundColours::new();
        ground.expose(520);
        for i in 0..900u32 {
            let [blue, green, red] = exposed([110, 175, 235], 0.9 + 0.15 * ((i / 30) % 2) as f32);
            let noise = |level: u8, k: u32| (level + (i / 3u32.pow(k) % 3) as u8).saturating_sub(1);
            ground.learn([noise(blue, 0), noise(green, 1), noise(red, 2)], true);
        }
        ground.expose(639);
        let (wood, orange) = ([148, 236, 255], [45, 220, 255]);
        assert_eq!(ground.tell(wood), Ground::Foreign, "as before the mean is told");
        ground.see_mean([140.0, 225.0, 252.0]);
        assert_eq!([wood, orange].map(|colour| ground.tell(colour)), [Ground::Known, Ground::Foreign]);
        assert_eq!(ground.tell([20, 60, 255]), Ground::Foreign);
        ground.see_mean([120.0, 180.0, 225.0]);
        assert_eq!(ground.tell(wood), Ground::Foreign);
    }
}
