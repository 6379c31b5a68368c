//! The command line of each subcommand of `feature-worker`: its arguments, its help and what it prints.

pub mod bench;
pub mod episodes;
pub mod run;
