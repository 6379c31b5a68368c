//! The commands of the program `experiments`, one file each.

pub mod bare_loop;
pub mod demo;
pub mod evaluate;
pub mod evaluate_camera;
pub mod jitter;
pub mod motion;
pub mod reproduce;
