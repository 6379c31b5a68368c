//! Recorded episodes: what is wrong with them, and how they are exported for other programs.
//!
//! Used by `feature-worker episodes`, on files alone; no cell needs to run. Allocates. An export never overwrites anything.

pub mod export;
mod lerobot;
pub mod output;
pub mod summary;
mod video;
