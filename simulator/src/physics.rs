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

pub mod container;
pub mod paper;
pub mod rig;

/// Frames a second of both simulators.
pub const RATE_HZ: f64 = 30.0;
/// Tilt range, degrees.
pub const ALPHA_MAX_DEG: f64 = 110.0;
