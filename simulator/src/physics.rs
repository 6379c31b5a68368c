//! Container physics: the paper's simulation ("a", section 4) and a physical one ("b").
//!
//! Pure: no clock, no devices, every random number from an explicit seed. Used by evaluation at full speed and, through
//! [`container::Container`], by the simulated cell in real time with the robot's actual tilt.
//!
//! | module | what it holds |
//! |---|---|
//! | [`container`] | vessels, what they retain at a tilt, the flow over the lip, the film, step by step |
//! | [`rig`] | a seeded rig of simulator b: container, liquid, servo, camera; one pour of it frame by frame |
//! | [`paper`] | simulator a |
//! | [`seen`] | the same pour through a rendered camera and the feature worker's extraction |
//! | [`episodes`] | what a person would record on either: curves of eq. (1), weighed |

pub mod container;
pub mod episodes;
pub mod paper;
pub mod rig;
pub mod seen;

/// Frames a second of both simulators.
pub const RATE_HZ: f64 = 30.0;
/// Tilt range, degrees.
pub const ALPHA_MAX_DEG: f64 = 110.0;

/// One pour of either simulator, frame by frame.
#[derive(Debug, Clone)]
pub enum World {
    /// Simulator a.
    A(paper::Pour),
    /// Simulator b.
    B(Box<rig::Pour>),
    /// Simulator b through a rendered camera.
    Seen(Box<seen::Seen>),
}

impl World {
    /// One frame with `alpha_deg` commanded; the area that the camera reports at its end, px^2; NaN: not usable.
    pub fn frame(&mut self, alpha_deg: f64) -> f32 {
        match self {
            Self::A(pour) => pour.frame(alpha_deg),
            Self::B(pour) => pour.frame(alpha_deg),
            Self::Seen(seen) => seen.frame(alpha_deg),
        }
    }

    /// What has really left so far, ml. Film that has yet to drip is not in it.
    pub fn poured_ml(&self) -> f64 {
        match self {
            Self::A(pour) => pour.poured_ml(),
            Self::B(pour) => pour.poured_ml(),
            Self::Seen(seen) => seen.pour.poured_ml(),
        }
    }
}
