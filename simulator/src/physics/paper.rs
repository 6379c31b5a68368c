//! Simulator a: the paper's own simple simulation (section 4), in which the outflow depends linearly on the angle and on what remains.
//!
//! Pure, on any thread. It does not allocate and cannot fail. In each frame: v = min(V, max(0, 0.10 (alpha - (100 - 0.16 V)))), V -= v,
//! area = 400 v. There is no noise, no lag and no delay.

/// One pour on simulator a.
#[derive(Debug, Clone)]
pub struct PaperPour {
    volume_ml: f64,
    poured_ml: f64,
}

impl PaperPour {
    /// An upright container with `volume_ml`.
    pub fn new(volume_ml: f64) -> Self {
        Self { volume_ml, poured_ml: 0.0 }
    }

    /// The tilt at which the present volume starts to flow, degrees.
    pub fn spill_angle_deg(&self) -> f64 {
        100.0 - 0.16 * self.volume_ml
    }

    /// Lets one frame pass at `alpha_deg`. Returns the area that the camera reports, px^2.
    pub fn frame(&mut self, alpha_deg: f64) -> f32 {
        let v = (0.10 * (alpha_deg - self.spill_angle_deg())).max(0.0).min(self.volume_ml);
        self.volume_ml -= v;
        self.poured_ml += v;
        (400.0 * v) as f32
    }

    /// The volume poured so far, ml.
    pub fn poured_ml(&self) -> f64 {
        self.poured_ml
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the definition: the outflow is linear in angle and remaining volume, 400 px^2 stand for 1 ml, and no more leaves than there
    /// is.
    #[test]
    fn flow_is_linear_in_angle_and_remaining_volume() {
        let mut pour = PaperPour::new(300.0);
        assert_eq!(pour.frame(52.0), 0.0);
        assert!((pour.frame(57.0) - 400.0 * 0.5).abs() < 1e-3);
        assert!((pour.poured_ml() - 0.5).abs() < 1e-12);
        for _ in 0..10_000 {
            pour.frame(110.0);
        }
        assert!((pour.poured_ml() - 300.0).abs() < 1e-6);
    }
}
