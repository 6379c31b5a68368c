//! The subcommands of `trainer`, one file each.

pub mod check;
pub mod inspect;
pub mod plan;
pub mod refine;
pub mod report;
pub mod train;
