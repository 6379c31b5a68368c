//! The vision process: camera frames in, V_e (section 3.3.1 of the paper) and episodes out.
//!
//! | module | what it does |
//! |---|---|
//! | [`source`] | opens a camera, a file or shared memory and gives one frame after the other |
//! | [`vision`] | finds V_e in one image; learns the axes and the colour |
//! | [`drawing`] | draws on pictures what was measured |
//! | [`worker`] | measures V_e in every frame, publishes it and hands the frame to the recorder |
//! | [`recorder`] | writes episodes while the controller runs them |
//! | [`episodes`] | says what is wrong with recorded episodes and exports them |
//! | [`commands`] | the command line of each subcommand |
#![forbid(unsafe_code)]

pub mod cli;
pub mod commands;
pub mod drawing;
pub mod episodes;
pub mod recorder;
pub mod source;
pub mod vision;
pub mod worker;
