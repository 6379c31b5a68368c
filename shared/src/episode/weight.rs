//! Which numbers can be the weight `w_E` of an episode. It is pure and does not allocate; a wrong number is a [`WeightError`].

/// Why a number cannot be the weight of an episode. The text follows the number and a colon.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum WeightError {
    /// It is negative, infinite or not a number.
    #[error("give the scale's reading in g, a finite number of at least 0")]
    NotAReading,
    /// It is 0.
    #[error("nothing was poured, so nothing can be learned from it; leave the episode out")]
    NothingPoured,
}

/// The weight, if a scale can show it: finite and at least 0 g.
pub fn check_reading(weight_g: f64) -> Result<f64, WeightError> {
    if weight_g.is_finite() && weight_g >= 0.0 { Ok(weight_g) } else { Err(WeightError::NotAReading) }
}

/// The weight, if something can be learned from it: finite and above 0 g.
pub fn check_poured(weight_g: f64) -> Result<f64, WeightError> {
    if check_reading(weight_g)? > 0.0 { Ok(weight_g) } else { Err(WeightError::NothingPoured) }
}
