//! The simulated cell: container physics, rendered camera, UR5 controller, kitchen scale. Only it knows the truth.
#![forbid(unsafe_code)]

pub mod camera;
pub mod cell;
pub mod demo;
pub mod evaluate;
pub mod evaluate_camera;
pub mod jitter;
pub mod motion;
pub mod operator;
pub mod own_cell;
pub mod physics;
pub mod pour_plot;
pub mod reproduce;
pub mod ur;
pub mod ur_command;
