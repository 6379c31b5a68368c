//! The subcommands of `rt-controller`. Each has a file with its arguments, its help, and what it does.
//!
//! `run` is the resident process; the others are processes that ask it, or work on files. All of them may allocate, and each failure is one
//! line.

pub mod abort;
pub mod pour;
pub mod record;
pub mod replay;
pub mod resume;
pub mod run;
pub mod status;
pub mod step;
