//! Container physics: the paper's simulation (simulator a, section 4) and a physical one (simulator b).
//!
//! Pure: no clock, no devices, and every random number comes from an explicit seed. The experiments use it at full speed; the simulated
//! cell uses [`container::Container`] in real time with the robot's actual tilt.
//!
//! | file | what it holds |
//! |---|---|
//! | [`container`] | vessels, what they retain at a tilt, the flow over the lip, the film, step by step |
//! | [`rig`] | a seeded rig of simulator b: container, liquid, servo, camera; one pour on it, frame by frame |
//! | [`paper`] | simulator a |

pub mod container;
pub mod paper;
pub mod rig;

/// Frames a second of both simulators, as of the camera in the paper.
pub const RATE_HZ: f64 = 30.0;
/// Largest tilt of both simulators, degrees; `config/sim.toml` allows the robot the same.
pub const ALPHA_MAX_DEG: f64 = 110.0;
