//! The offline trainer: weighed episodes in, one weight file out. It knows nothing of the simulator.
//!
//! | module | what it holds |
//! |---|---|
//! | [`data`] | the episodes, read and checked |
//! | [`consistency`], [`exchanged`], [`tare`] | weights that do not fit the others, two that were entered for each other, and all that have the cup's |
//! | [`calibration`] | area to ml, from the weights alone |
//! | [`fit`] | the flow model, fitted to the episodes |
//! | [`servo`] | how the joint follows its commands, where it was measured |
//! | [`allowed_actions`], [`network`] | the network's actions, and its training |
//! | [`training`], [`method`] | what a training is told and gives, and the methods |
//! | [`teaching`] | what episodes teach and leave open, and what to record next |
//! | [`report`] | pages of plots and tables |
//! | [`commands`] | the command line |
#![forbid(unsafe_code)]

pub mod allowed_actions;
pub mod calibration;
pub mod cli;
pub mod commands;
pub mod consistency;
pub mod data;
pub mod exchanged;
pub mod fit;
pub mod method;
pub mod network;
pub mod report;
pub mod servo;
pub mod tare;
pub mod teaching;
pub mod training;
