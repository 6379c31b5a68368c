//! Container physics: the paper's simulation (simulator a, section 4) and a physical one (simulator b).
//!
//! Pure functions and plain data, for any thread: there is no clock and no device, nothing fails, and every random number comes from an
//! explicit seed. The experiments use it at full speed; the simulated
//! cell uses [`container::Container`] in real time with the robot's actual tilt.
//!
//! | file | what it holds |
//! |---|---|
//! | [`container`] | vessels, what they retain at a tilt, and the flow over the lip and the film, step by step |
//! | [`habits`] | what vessels and liquids do beyond a smooth shape and a weir |
//! | [`rig`] | a seeded rig of simulator b: container, liquid, servo, camera; one pour on it, frame by frame |
//! | [`vessel`] | rigs that are not straight, water and prompt, each drawn from a seed |
//! | [`paper`] | simulator a |

pub mod container;
pub mod habits;
pub mod paper;
pub mod rig;
pub mod vessel;

/// Frames a second of both simulators, the same as the paper's camera gives.
pub const RATE_HZ: f64 = 30.0;
/// Largest tilt of both simulators, degrees; `config/sim.toml` allows the robot the same.
pub const ALPHA_MAX_DEG: f64 = 110.0;
