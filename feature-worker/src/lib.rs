//! The vision process: camera frames in, V_e (section 3.3.1) and episodes out.
#![forbid(unsafe_code)]

pub mod bench;
pub mod calibrate;
pub mod clear;
pub mod episodes;
pub mod extract;
mod ground;
pub mod inspect;
pub mod recorder;
pub mod source;
pub mod view;
pub mod worker;
