//! The operator's one program.
//!
//! | module | what it holds |
//! |---|---|
//! | [`cli`] | the command line |
//! | [`doctor`] | a look at everything that a pour needs |
//! | [`programs`] | which program has which command |
//!
//! Everything runs in the main thread of a short process, allocates, and fails with one line.
#![forbid(unsafe_code)]

pub mod cli;
pub mod doctor;
pub mod programs;
