//! The fixed-rate controller process: V_e in, servo targets out.
//!
//! | module | what it holds | thread |
//! |---|---|---|
//! | [`core`] | what decides: a pure step | the loop's, and evaluation's |
//! | [`control_loop`] | the 30 Hz loop | real-time |
//! | [`exchange`] | queues between the loop and the rest | all |
//! | [`pacing`] | when the next tick is due | the loop's |
//! | [`timing`] | the loop's histograms | all |
//! | [`journal`] | every tick's inputs, and their replay | ordinary |
//! | [`link`] | RTDE client and the robot's program | connects in an ordinary thread, then the loop's |
//! | [`service`] | clients, telemetry | ordinary |
//! | [`disk`] | journal, weight file | ordinary, a thread of its own |
//! | [`client`] | the clients' side | their own process |
//! | [`run`], [`pour`], [`record`], [`abort`], [`status`], [`step`], [`replay`] | the commands | their own process |
#![forbid(unsafe_code)]

pub mod abort;
pub mod client;
pub mod control_loop;
pub mod core;
pub mod disk;
pub mod exchange;
pub mod journal;
pub mod link;
pub mod pacing;
pub mod pour;
pub mod record;
pub mod replay;
pub mod run;
pub mod service;
pub mod status;
pub mod step;
pub mod timing;
