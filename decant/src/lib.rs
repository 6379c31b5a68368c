//! The operator's one program.
//!
//! | module | what it holds |
//! |---|---|
//! | [`cli`] | the command line |
//! | [`doctor`] | a look at everything that a pour needs |
//! | [`metrics`] | the cell for Prometheus |
//! | [`programs`] | which program has which command |
//!
//! Everything runs in ordinary processes, short ones but for `metrics`, allocates, and fails with one line.
#![forbid(unsafe_code)]

pub mod cli;
pub mod doctor;
pub mod metrics;
pub mod programs;
