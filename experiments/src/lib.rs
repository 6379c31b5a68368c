//! Experiments on the simulated cell. This crate knows both the truth, from the simulator, and what the programs under test make of it.
#![forbid(unsafe_code)]

pub mod bench;
pub mod commands;
pub mod own_cell;
pub mod plots;
