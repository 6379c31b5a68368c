//! The command line of each subcommand of `feature-worker`: its arguments, its help and what it prints.

pub mod bench;
pub mod calibrate;
pub mod camera;
mod configuration;
pub mod episodes;
pub mod inspect;
pub mod run;
pub mod view;
