//! Writes one episode's MCAP file, see [`crate::episode`]. Allocates; ordinary threads only.

/// Why an episode cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {}

/// What is known at an episode's start.
#[derive(Debug, Clone, PartialEq)]
pub struct Start {}

/// One row of `/sample`.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {}

/// How an episode ended.
#[derive(Debug, Clone, PartialEq)]
pub struct End {}

/// An episode being written.
pub struct EpisodeWriter {}
