//! The fixed-rate controller process: V_e in, servo targets out.
//!
//! | module | what it holds | thread |
//! |---|---|---|
//! | [`core`] | the decisions, as a pure step | the loop's, and that of evaluations |
//! | [`control_loop`] | the 30 Hz loop | real-time |
//! | [`pacing`] | when the next tick is due | the loop's |
//! | [`timing`] | the loop's histograms | all |
//! | [`exchange`] | the queues between the loop and the other threads | all |
//! | [`link`] | RTDE client and the program on the robot | connects in an ordinary thread, then the loop's |
//! | [`robot_thread`] | connects the robot and hands it over to the loop | ordinary, a thread of its own |
//! | [`service`] | clients and telemetry | ordinary, the main thread |
//! | [`disk`] | journal, weight file, episodes' numbers | ordinary, a thread of its own |
//! | [`stop`] | the way to stop a motion that depends on nothing else, and its end | ordinary, a thread of its own |
//! | [`stop_client`] | the clients' side of it | their own process |
//! | [`claim`] | one controller in a cell, no file in two cells | ordinary |
//! | [`journal`] | every tick's inputs, and their replay | ordinary |
//! | [`journal_files`] | where journals lie, and what is left as it is there | ordinary |
//! | [`foreseen`] | what can be said of a pour before it starts | their own process |
//! | [`client`] | the clients' side of the service | their own process |
//! | [`cli`] | the command line | their own process |
//! | [`commands`] | the subcommands | their own process |
//!
//! What the loop runs does not allocate; the other threads may. Whatever fails in one of them ends the pour upright, or is one line on standard error.
#![forbid(unsafe_code)]

pub mod claim;
pub mod cli;
pub mod client;
pub mod commands;
pub mod control_loop;
pub mod core;
pub mod disk;
pub mod disk_note;
pub mod exchange;
pub mod foreseen;
pub mod journal;
pub mod journal_files;
pub mod link;
pub mod pacing;
pub mod robot_thread;
pub mod service;
pub mod stop;
pub mod stop_client;
pub mod timing;
