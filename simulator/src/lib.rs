//! The simulated cell: container physics, rendered camera, UR5 controller, kitchen scale. Only it knows the truth.
//!
//! Of our crates it depends on `shared` alone. So Cargo itself ensures that the renderer shares no code and no constant with the
//! vision that is judged by its pictures, nor the simulated robot with the controller that is tried on it.
#![forbid(unsafe_code)]

pub mod camera;
pub mod cell;
pub mod commands;
pub mod physics;
pub mod ur;
