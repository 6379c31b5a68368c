//! How white a filter's innovations are, which tells whether its model is right.
//!
//! It is pure and runs in the controller's loop: its size is fixed, and it does not allocate, panic or fail.

use super::filter::Innovation;

/// Correlation of the innovations up to which an explanation is fully trusted, and from which on it is not trusted at all, in a pour. On rigs
/// 100 to 107 and 200 to 207, it was -0.03 to 0.02 where the walls were straight, 0.1 to 0.3 where they were rough, and 0.56 to 0.79 where
/// the surface swung.
const TRUSTED_CORRELATION: (f64, f64) = (0.15, 0.35);
/// The sum of the innovations' squares below which their correlation says little. Chosen by hand: some twenty frames.
const CORRELATED_SQUARES: f64 = 20.0;
/// An innovation counts for no more than this in the correlation, standard deviations. Chosen by hand; no measurement is recorded.
const CORRELATED_SDS: f64 = 6.0;

/// How white the innovations are: where a model is right, each is independent of the one before it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Whiteness {
    /// Sum of the products of neighbours.
    pub products: f64,
    /// Sum of squares.
    pub squares: f64,
    newest: f64,
}

impl Whiteness {
    pub(super) fn add(&mut self, innovation: Option<Innovation>) {
        let Some(Innovation { sds, .. }) = innovation else { return };
        let sds = sds.clamp(-CORRELATED_SDS, CORRELATED_SDS);
        self.products += sds * self.newest;
        self.squares += sds * sds;
        self.newest = sds;
    }

    /// How far a model with these innovations is to be trusted, 0 to 1.
    pub(super) fn trust(&self) -> f64 {
        let (whole, none) = TRUSTED_CORRELATION;
        let correlation = self.products / (self.squares + CORRELATED_SQUARES);
        ((none - correlation) / (none - whole)).clamp(0.0, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the estimate from a model that is wrong: innovations that keep their sign take its trust, and those that change it do not.
    #[test]
    fn innovations_that_keep_their_sign_are_not_trusted() {
        let trust = |sign: fn(u32) -> f64| {
            let mut whiteness = Whiteness::default();
            (0..100).for_each(|k| whiteness.add(Some(Innovation { foreseen_ml: 1.0, sds: sign(k) })));
            whiteness.trust()
        };
        assert_eq!(trust(|k| if k % 20 < 10 { 1.0 } else { -1.0 }), 0.0);
        assert_eq!(trust(|k| if k % 4 < 2 { 1.0 } else { -1.0 }), 1.0);
        assert_eq!(Whiteness::default().trust(), 1.0);
    }
}
