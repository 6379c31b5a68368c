//! Which numbers can be the weight `w_E` of an episode. It is pure, for ordinary threads, and does not allocate; a wrong number is a [`WeightError`].

/// Why a number cannot be the weight of an episode. The text follows the number and a colon.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum WeightError {
    /// It is negative, beyond any kitchen scale, or not a number.
    #[error("give the scale's reading in g, from 0 to 50000")]
    NotAReading,
    /// It is 0.
    #[error("nothing was poured, so nothing can be learned from it; leave the episode out")]
    NothingPoured,
}

/// Largest reading of a scale that is believed, g. Chosen by hand: ten times what a robot of this kind carries.
const READING_MAX_G: f64 = 50_000.0;

/// The weight, if a scale can show it: 0 g to 50 kg.
pub fn check_reading(weight_g: f64) -> Result<f64, WeightError> {
    // A scale that shows -0 shows nothing.
    if (0.0..=READING_MAX_G).contains(&weight_g) { Ok(weight_g.abs()) } else { Err(WeightError::NotAReading) }
}

/// The weight that a file has: finite and at least 0 g. One that no scale shows can still be read, so that it can be corrected.
pub fn check_kept(weight_g: f64) -> Result<f64, WeightError> {
    if weight_g.is_finite() && weight_g >= 0.0 { Ok(weight_g) } else { Err(WeightError::NotAReading) }
}

/// The weight, if something can be learned from it: above 0 g.
pub fn check_poured(weight_g: f64) -> Result<f64, WeightError> {
    if check_reading(weight_g)? > 0.0 { Ok(weight_g) } else { Err(WeightError::NothingPoured) }
}
