//! The fixed-rate controller process: V_e in, servo targets out.
#![forbid(unsafe_code)]

pub mod core;
pub mod link;
