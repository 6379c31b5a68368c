//! The offline trainer: weighed episodes in, one weight file out. It knows nothing of the simulator.
#![forbid(unsafe_code)]

pub mod check;
pub mod inspect;
pub mod refine;
pub mod report;
pub mod train;
