//! Another vessel or another camera than the episodes showed: what is said then is honest, as nobody knows which of the two it is.
//!
//! Tests only: any thread, may allocate, fails by panicking.

use super::*;

/// Protects a pour after the camera was moved, or out of another vessel, from a false certainty: a gain that was off by a quarter left 32 ml more than were
/// said, to be right within 12. A camera and a vessel as they were learned cost no doubt.
#[test]
fn what_looks_like_another_vessel_is_in_doubt() {
    for gain in [0.75, 0.8, 1.2, 1.3] {
        let (truth, _, fused) = pour_into(new(&model(1.0)), gain);
        let (said, sd) = (fused.poured_ml(), fused.poured_sd_ml());
        assert!(fused.impossible().is_some() || (truth - said).abs() < 2.0 * sd, "gain {gain}: {truth} left, {said} +- {sd} said");
    }
    for gain in [0.97, 1.0, 1.03] {
        let (truth, _, fused) = pour_into(new(&model(1.0)), gain);
        assert!(fused.poured_sd_ml() < 0.05 * truth, "gain {gain}: {truth} +- {}", fused.poured_sd_ml());
    }
}
