//! The ranges of hue, saturation and value that are a liquid's, also where the light cuts its brightest part off.
//!
//! Pure; called when an extractor is made, so it may allocate. Nothing fails.

use opencv::core::Scalar;

/// A colour whose brightest part reaches this may be one whose brightest part is cut off, grey levels. Chosen by hand: a little below 255,
/// because samples are smoothed.
const CUT_OFF_LEVEL: f64 = 240.0;
/// A hue this near to that of red, green or blue may move to either side of it, in OpenCV's degrees of 2. Chosen by hand.
const AT_PRIMARY: f64 = 5.0;
/// Hues from a primary colour to the mixed ones beside it, in OpenCV's degrees of 2.
const PRIMARY_TO_MIXED: f64 = 30.0;

/// The ranges of hue, saturation and value that are the liquid: its own, and what its colours become when their brightest part is cut off.
/// The hue then moves away from that part's own, as far as that of the mixed colour beside it.
pub(super) fn ranges([h0, s0, v0, h1, s1, v1]: [f64; 6]) -> Vec<(Scalar, Scalar)> {
    let width = (h1 - h0).rem_euclid(180.0);
    let middle = h0 + 0.5 * width;
    // The hues of red, green and blue are 0, 60 and 120.
    let primary = (middle / 60.0).round() * 60.0;
    let (below, above) = (primary - PRIMARY_TO_MIXED, primary + PRIMARY_TO_MIXED);
    let mut hues = vec![(h0, h0 + width, v0)];
    // A liquid that is not red, green or blue itself moves to one side only.
    if middle >= primary - AT_PRIMARY && above > h0 + width {
        hues.push((middle, above, v0.max(CUT_OFF_LEVEL)));
    }
    if middle <= primary + AT_PRIMARY && below < h0 {
        hues.push((below, middle, v0.max(CUT_OFF_LEVEL)));
    }
    let mut all = Vec::new();
    for (from, to, v) in hues {
        // Hues wrap around at 180.
        for turn in [-180.0, 0.0, 180.0] {
            let (from, to) = ((from + turn).max(0.0), (to + turn).min(179.0));
            if from <= to {
                all.push((Scalar::new(from, s0, v, 0.0), Scalar::new(to, s1, if v > v0 { 255.0 } else { v1 }, 0.0)));
            }
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    fn holds(ranges: &[(Scalar, Scalar)], hsv: [f64; 3]) -> bool {
        ranges.iter().any(|(low, high)| (0..3).all(|k| low[k] <= hsv[k] && hsv[k] <= high[k]))
    }

    /// Protects orange liquids in bright light: where red is cut off the hue moves towards yellow, and only there and only that way.
    #[test]
    fn a_hue_moves_away_from_its_cut_off_colour() {
        let orange = ranges([8.0, 150.0, 60.0, 20.0, 255.0, 255.0]);
        assert!(holds(&orange, [14.0, 200.0, 100.0]));
        assert!(holds(&orange, [28.0, 200.0, 252.0]));
        assert!(!holds(&orange, [28.0, 200.0, 200.0]) && !holds(&orange, [40.0, 200.0, 252.0]) && !holds(&orange, [28.0, 100.0, 252.0]));
        let red = ranges([175.0, 100.0, 50.0, 6.0, 255.0, 255.0]);
        assert!(holds(&red, [178.0, 200.0, 90.0]) && holds(&red, [3.0, 200.0, 90.0]) && !holds(&red, [90.0, 200.0, 90.0]));
        assert!(holds(&red, [160.0, 200.0, 250.0]) && holds(&red, [25.0, 200.0, 250.0]) && !holds(&red, [25.0, 200.0, 90.0]));
    }
}
