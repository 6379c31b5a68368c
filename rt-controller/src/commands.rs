//! The subcommands of `rt-controller`, a file each: its arguments, its help, and what it does.
//!
//! `run` is the resident process; the others are short processes that ask it, or work on files.

pub mod abort;
pub mod pour;
pub mod record;
pub mod replay;
pub mod run;
pub mod status;
pub mod step;
