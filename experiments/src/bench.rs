//! A bench: pours on a simulated rig at full speed, whose truth is known.
//!
//! | file | what it holds |
//! |---|---|
//! | [`simulators`] | the simulators that a pour can run on, and one pour of any of them, frame by frame |
//! | [`through_camera`] | a pour whose V_e is measured in rendered pictures |
//! | [`eye_fault`] | what a camera may show instead of the stream |
//! | [`episodes`] | what a person would record on a bench: curves of eq. (1), weighed |
//! | [`pour`] | one pour in closed loop, by the controller's own core or by a baseline |
//! | [`baselines`] | what the learned network is compared with |

pub mod baselines;
pub mod episodes;
pub mod eye_fault;
pub mod pour;
pub mod simulators;
pub mod through_camera;
