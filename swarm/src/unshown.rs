//! What the camera has not shown, or has shown too much of, since a run began: nothing in its pictures tells.
//!
//! Pure; allocates nothing; cannot fail.

/// The power of the area with which a volume goes at most. Chosen by hand: nothing that a drift hid on the seeds up to 23,299 needs more.
const VOLUME_EXPONENT: f64 = 1.2;
/// A camera of which so many frames in a row give no measurement is blind (`controller.stale_feature_ms` of config/sim.toml, at 30 Hz).
const BLIND_FRAMES: u32 = 6;

/// A stream of so much in a frame may be there at once, ml: the estimate takes a larger one for a stream that has begun before (`ABRUPT_ML` of
/// shared/src/estimator/verdict.rs).
const SMALL_ML: f64 = 0.7;

/// What is kept of the run under way.
#[derive(Debug, Clone, Copy)]
pub struct Unshown {
    /// The camera's gain, as a share of that at the start of the cell.
    gain: f64,
    /// Its smallest and largest value since the run began, and 1.
    gains: (f64, f64),
    /// What left in frames that showed too little, and what frames showed that did not leave, ml.
    hidden_ml: (f64, f64),
    /// The largest outflow that a frame of the run has shown, ml.
    largest_ml: f64,
    /// What left in frames that showed nothing, beyond the largest outflow that any frame before had shown, ml; of a stream that had not been shown yet, as long
    /// as it was small.
    surged_ml: f64,
    /// What left in the newest frames without a measurement, ml, and their number.
    gone: (f64, u32),
    /// What left while the camera was blind, ml.
    blind_ml: f64,
}

impl Default for Unshown {
    fn default() -> Self {
        Self { gain: 1.0, gains: (1.0, 1.0), hidden_ml: (0.0, 0.0), largest_ml: 0.0, surged_ml: 0.0, gone: (0.0, 0), blind_ml: 0.0 }
    }
}

impl Unshown {
    /// A run begins.
    pub fn begins(&mut self) {
        *self = Self { gain: self.gain, gains: (self.gain.min(1.0), self.gain.max(1.0)), ..Self::default() };
    }

    /// A frame passed with this gain, in which so much left, ml. It was lost or is doubted: it is known to have shown nothing.
    pub fn frame_without_measurement(&mut self, gain: f64, left_ml: f64) {
        self.takes_gain(gain);
        self.gone = (self.gone.0 + left_ml, self.gone.1 + 1);
        if self.gone.1 >= BLIND_FRAMES {
            self.blind_ml += std::mem::take(&mut self.gone.0);
        }
    }

    /// A frame was measured with this gain, in which so much left, ml, and which showed so much less than that, ml; below 0 it showed more.
    pub fn frame(&mut self, gain: f64, left_ml: f64, hidden_ml: f64) {
        self.takes_gain(gain);
        self.gone = (0.0, 0);
        let shown_ml = left_ml - hidden_ml;
        // A stream that stands still, or is there at once, tells by itself that something was not shown, and whoever looks on doubts it; a small one may
        // begin so.
        let tells = shown_ml > 0.0 || (self.largest_ml <= 0.0 && hidden_ml > SMALL_ML);
        self.surged_ml += if tells { 0.0 } else { (hidden_ml - self.largest_ml).max(0.0) };
        self.largest_ml = self.largest_ml.max(shown_ml);
        self.hidden_ml = (self.hidden_ml.0 + hidden_ml.max(0.0), self.hidden_ml.1 + (-hidden_ml).max(0.0));
    }

    fn takes_gain(&mut self, gain: f64) {
        self.gain = gain;
        self.gains = (self.gains.0.min(gain), self.gains.1.max(gain));
    }

    /// By how much the truth may lie below and above `said_ml`, ml, because of the gain.
    pub fn by_gain_ml(&self, said_ml: f64) -> (f64, f64) {
        let share = |gain: f64| (gain.powf(-VOLUME_EXPONENT) - 1.0).abs();
        (share(self.gains.1) * said_ml.abs(), share(self.gains.0) * said_ml.abs())
    }

    /// By how much the truth may lie above what is said, ml, because frames that showed nothing hid a surge: more than any picture of the run let expect.
    pub fn by_surges_ml(&self) -> f64 {
        self.surged_ml
    }

    /// By how much the truth may lie above what is said to be a lower bound, ml, because the camera was blind.
    pub fn by_blindness_ml(&self) -> f64 {
        self.blind_ml
    }

    /// By how much the truth may lie below and above what is said, ml, because single frames showed something else.
    pub fn by_frames_ml(&self) -> (f64, f64) {
        (self.hidden_ml.1, self.hidden_ml.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the check of what is said: a gain that fell lets the truth be larger only, by its power, and comes back to nothing when the gain does before
    /// the run; a frame excuses what left in it.
    #[test]
    fn what_was_not_shown_is_what_it_excuses() {
        let mut unshown = Unshown::default();
        unshown.begins();
        unshown.frame(0.8, 3.0, 0.0);
        let (below, above) = unshown.by_gain_ml(100.0);
        assert!(below == 0.0 && (above - 30.7).abs() < 0.1, "{below} {above}");
        unshown.frame(1.0, 2.5, 2.5);
        unshown.frame(1.0, 0.0, -1.0);
        assert_eq!((unshown.by_frames_ml(), unshown.by_surges_ml()), ((1.0, 2.5), 0.0), "as much had been shown");
        unshown.frame(1.0, 8.0, 8.0);
        assert_eq!(unshown.by_surges_ml(), 5.0);
        unshown.frame(1.0, 30.0, 26.0);
        assert_eq!(unshown.by_surges_ml(), 5.0, "it showed something, which stood still");
        unshown.begins();
        unshown.frame(1.0, 8.0, 8.0);
        assert_eq!(unshown.by_surges_ml(), 0.0, "the stream is there at once afterwards");
        unshown.frame(1.0, 0.5, 0.5);
        assert_eq!(unshown.by_surges_ml(), 0.5, "a small one may begin so");
        unshown.begins();
        assert_eq!((unshown.by_gain_ml(100.0), unshown.by_frames_ml()), ((0.0, 0.0), (0.0, 0.0)));
        assert_eq!(unshown.by_surges_ml(), 0.0);
    }

    /// Protects the check of a lower bound: what leaves while the camera is blind is excused from the first frame on, a shorter gap is not, and a lost frame
    /// shows no outflow.
    #[test]
    fn a_blind_camera_is_told_from_a_gap() {
        let mut unshown = Unshown::default();
        unshown.begins();
        let gap = |unshown: &mut Unshown, frames: u32| {
            (0..frames).for_each(|_| unshown.frame_without_measurement(1.0, 2.0));
            unshown.frame(1.0, 0.0, 0.0);
        };
        gap(&mut unshown, BLIND_FRAMES - 1);
        assert_eq!(unshown.by_blindness_ml(), 0.0);
        gap(&mut unshown, BLIND_FRAMES + 1);
        assert_eq!(unshown.by_blindness_ml(), 14.0);
        gap(&mut unshown, BLIND_FRAMES - 1);
        assert_eq!((unshown.by_blindness_ml(), unshown.largest_ml), (14.0, 0.0));
    }
}
