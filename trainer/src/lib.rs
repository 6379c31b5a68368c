//! The offline trainer: weighed episodes in, one weight file out. It knows nothing of the simulator.
#![forbid(unsafe_code)]

pub mod best;
pub mod calibrate;
pub mod check;
pub mod consistency;
pub mod data;
pub mod distill;
pub mod eq8;
pub mod fit;
pub mod inspect;
pub mod law;
pub mod net;
pub mod refine;
pub mod report;
pub mod train;
