//! Whether the payload that the robot was told can hold a vessel: a robot that carries more or less than it was told may stop protectively, is
//! slower, and gives way in freedrive.
//!
//! It is pure and runs on the connecting thread; the line allocates. Nothing here fails.

use super::RobotState;

/// Mass below which a payload holds no vessel, kg: the lightest glass that was tried with this robot, with its holder, weighs more. Chosen by hand;
/// no measurement is recorded.
const LEAST_KG: f64 = 0.1;
/// Difference from the expected mass that is passed over, kg: about what a vessel loses while it pours. Chosen by hand; no measurement is recorded.
const PASSED_OVER_KG: f64 = 0.3;
/// Distance of the centre of gravity from the flange below which nothing is held beyond it, m. Chosen by hand; no measurement is recorded.
const AT_THE_FLANGE_M: f64 = 0.001;
/// Where the payload is set.
const WHERE: &str = "set mass and centre of gravity of holder and full vessel on the pendant (Installation > General > Payload)";

/// What is doubtful about the robot's payload, where the robot says it: it is not that of a vessel, or not the expected one
/// (`robot.payload_kg`).
pub fn warning(state: &RobotState, expected_kg: Option<f64>) -> Option<String> {
    let kg = state.payload_kg?;
    let problem = match expected_kg {
        Some(expected) if kg.is_nan() || (kg - expected).abs() > PASSED_OVER_KG => {
            format!("is set to {kg:.2} kg, but robot.payload_kg expects {expected:.2} kg")
        }
        None if kg.is_nan() || kg < LEAST_KG => format!("is set to {kg:.2} kg, which cannot hold a vessel"),
        _ => {
            let [x, y, z] = state.payload_cog_m?;
            let distance_m = (x * x + y * y + z * z).sqrt();
            (distance_m < AT_THE_FLANGE_M && kg >= LEAST_KG)
                .then(|| format!("of {kg:.2} kg has its centre of gravity at the flange, where no vessel is"))?
        }
    };
    Some(format!("the robot's payload {problem}: {WHERE}, or it may stop protectively or move more slowly"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn warned(kg: f64, cog_m: [f64; 3], expected_kg: Option<f64>) -> String {
        let state = RobotState { payload_kg: Some(kg), payload_cog_m: Some(cog_m), ..RobotState::default() };
        warning(&state, expected_kg).unwrap_or_default()
    }

    /// Protects the operator from a robot that stops because it was told another load; a load that fits, and one that nobody knows, are passed
    /// over.
    #[test]
    fn a_payload_that_holds_no_vessel_is_named() {
        let held = [0.0, 0.02, 0.1];
        assert!(warned(0.0, [0.0; 3], None).contains("0.00 kg, which cannot hold a vessel"));
        assert!(warned(f64::NAN, held, None).contains("cannot hold"));
        assert!(warned(0.8, [0.0; 3], None).contains("at the flange"));
        assert!(warned(0.8, held, Some(1.6)).contains("0.80 kg, but robot.payload_kg expects 1.60 kg"));
        assert_eq!(warned(0.8, held, None), "");
        assert_eq!(warned(0.8, held, Some(1.0)), "");
        assert_eq!(warned(0.0, [0.0; 3], Some(0.0)), "", "the operator expects nothing at the tool");
        assert_eq!(warning(&RobotState::default(), Some(1.0)), None, "an old robot does not say");
    }
}
