//! Writes episodes in a thread of its own.
