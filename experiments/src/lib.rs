//! Experiments on the simulated cell. This crate knows both the truth, from the simulator, and what the programs under test make of it.
//!
//! | file | what it holds |
//! |---|---|
//! | [`commands`] | the command line |
//! | [`mod@bench`] | pours on a simulated rig at full speed |
//! | [`pour_evaluation`] | pours of many rigs against their goals |
//! | [`camera_setup`], [`camera_evaluation`] | the feature extraction against rendered truth |
//! | [`paper_section_4`] | the paper's own simulation and training |
//! | [`own_cell`] | a cell of real processes, for the next two |
//! | [`demo`] | the main job from the first recording to a poured volume |
//! | [`jitter`] | latency and jitter of the real processes on this machine |
//! | [`motion`] | what the robot makes of targets |
//! | [`plots`] | pictures of a pour and of a motion |
#![forbid(unsafe_code)]

pub mod bench;
pub mod camera_evaluation;
pub mod camera_setup;
pub mod commands;
pub mod demo;
pub mod jitter;
pub mod motion;
pub mod own_cell;
pub mod own_folder;
pub mod paper_section_4;
pub mod plots;
pub mod pour_evaluation;
