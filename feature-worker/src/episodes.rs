//! Recorded episodes: what is wrong with them, how they are exported for other programs, and how they are sorted and deleted.
//!
//! Used by `feature-worker episodes`, on files alone; no cell needs to run. Allocates. An export never overwrites anything.

pub mod export;
pub mod folder;
mod lerobot;
pub mod output;
pub mod summary;
pub mod upkeep;
mod video;
