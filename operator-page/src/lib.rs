//! The operator's page: fill, pour, stop, weigh and learn, from a browser beside the robot. A client of the cell like any other.
//!
//! | module | what it holds |
//! |---|---|
//! | [`cli`] | the command line |
//! | [`run`] | the command: threads, ports, token |
//! | [`routes`] | which request gets which answer |
//! | [`site`] | what the threads share, and the state that is sent to browsers |
//! | [`orders`] | pour, record, resume, weigh |
//! | [`stop`] | Stop, on a way of its own |
//! | [`say`] | who may start something |
//! | [`words`] | what the cell is doing |
//! | [`cell`] | what is known of the cell, and the link's parent |
//! | [`link`] | the process that touches shared memory |
//! | [`wire`] | what crosses the pipe between them |
//! | [`shelf`] | the weight files |
//! | [`jobs`], [`programs`] | the house's other programs in the background |
//! | [`calibration`] | `feature-worker calibrate` in the page |
//! | [`history`] | the recorded episodes |
//! | [`ends`] | why they ended |
//! | [`addresses`] | this machine's addresses |
//! | [`lock`] | how locks are taken |
#![forbid(unsafe_code)]

pub mod addresses;
pub mod calibration;
pub mod cell;
pub mod cli;
pub mod ends;
pub mod history;
pub mod jobs;
pub mod link;
pub mod lock;
pub mod orders;
pub mod programs;
pub mod routes;
pub mod run;
pub mod say;
pub mod shelf;
pub mod site;
pub mod stop;
pub mod wire;
pub mod words;
