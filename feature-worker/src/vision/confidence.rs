//! What confidence means: the share of measurements like this one whose area is within 20 % of the truth.
//!
//! The extraction's own figure only orders measurements. The tables here turn it into that share. They were read off the tables of
//! reliability that `evaluate-camera` prints, on the seeds for tuning.
//!
//! Pure, for any thread; nothing fails.

/// What a measurement rests on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Basis {
    /// A liquid's colour.
    Colour,
    /// The evidence of clear water before an even ground.
    EvenGround,
    /// The evidence of clear water before a pattern, with this share of the line on ground that was seen dry: without it, the line slips.
    Pattern(f32),
}

/// From the figure of a measured stream to its confidence, in front of each [`Basis`]. Tuned on seed 5001.
const BY_COLOUR: [(f32, f32); 6] = [(0.0, 0.0), (0.3, 0.45), (0.5, 0.6), (0.6, 0.9), (0.7, 0.98), (1.0, 1.0)];
/// The same for clear water before an even ground. Tuned on seed 102.
const BY_EVEN_GROUND: [(f32, f32); 6] = [(0.0, 0.0), (0.35, 0.2), (0.5, 0.7), (0.65, 0.95), (0.85, 0.97), (1.0, 0.99)];
/// From the share of a line on known ground to its confidence, before a pattern: a line that slipped to another edge has a strong contrast too, so
/// that tells nothing. Tuned on seeds 101, 103 and 60264 of `evaluate-camera --faults`: before some chess boards it is right no more often than
/// this, and before other grounds more often.
const BY_PATTERN: [(f32, f32); 4] = [(0.0, 0.35), (0.05, 0.4), (0.6, 0.45), (1.0, 0.55)];
/// Confidence that nothing flows where a line was seen and refuted. Tuned on seed 102.
const REFUTED: f32 = 0.87;

/// The confidence of a measured stream with the figure `raw`.
pub(crate) fn of_stream(basis: Basis, raw: f32) -> f32 {
    let (table, raw): (&[(f32, f32)], f32) = match basis {
        Basis::Colour => (&BY_COLOUR, raw),
        Basis::EvenGround => (&BY_EVEN_GROUND, raw),
        Basis::Pattern(known) => (&BY_PATTERN, known),
    };
    let raw = raw.clamp(0.0, 1.0);
    let next = table.iter().position(|(at, _)| *at >= raw).unwrap_or(table.len() - 1).max(1);
    let ((from, low), (to, high)) = (table[next - 1], table[next]);
    low + (high - low) * (raw - from) / (to - from)
}

/// The confidence that nothing flows where nothing was seen, with the figure `raw`.
pub(crate) fn of_nothing(raw: f32) -> f32 {
    REFUTED + (1.0 - REFUTED) * (4.0 * raw).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects those who weigh frames by confidence: it lies between 0 and 1, whatever the figure is.
    #[test]
    fn confidence_is_a_share() {
        for basis in [Basis::Colour, Basis::EvenGround, Basis::Pattern(-1.0), Basis::Pattern(2.0)] {
            for raw in [-1.0, 0.0, 0.123, 0.3, 0.65, 0.999, 1.0, 7.0] {
                assert!((0.0..=1.0).contains(&of_stream(basis, raw)) && (0.0..=1.0).contains(&of_nothing(raw)), "{basis:?} {raw}");
            }
        }
        assert!([Basis::Colour, Basis::EvenGround].iter().all(|basis| of_stream(*basis, 0.2) < of_stream(*basis, 0.7)));
        assert!(of_stream(Basis::Pattern(0.0), 0.9) < of_stream(Basis::Pattern(0.5), 0.9));
    }
}
