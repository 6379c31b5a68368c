//! What crosses the borders between Decant's processes.
//!
//! | module | what it holds | used in the controller's loop |
//! |---|---|---|
//! | [`messages`] | fixed-layout messages in shared memory | yes |
//! | [`ipc`] | the iceoryx2 services that carry them | receive only |
//! | [`control`] | requests to the controller and its answers | no |
//! | [`config`] | the cell's one TOML file | no |
//! | [`limits`] | the one place that every target passes | yes |
//! | [`policy`] | the 4-32-32-21 network and the action table | yes |
//! | [`estimator`] | area to ml, and the volume poured so far | yes |
//! | [`agent`] | observation pipeline and policy: a frame in, an action out | yes |
//! | [`weights`] | the weight file (postcard with a CRC) | no |
//! | [`episode`] | `E = (L_E, w_E)` as MCAP files and CSV tables | no |
//! | [`exit`] | exit codes and one-line errors | no |
//! | [`os`] | the operating system: clock, scheduling, locked memory | yes |
//!
//! Nothing in a module marked "yes" allocates, locks or panics after construction.

#![deny(unsafe_code)]

pub mod agent;
pub mod config;
pub mod control;
pub mod episode;
pub mod estimator;
pub mod exit;
pub mod ipc;
pub mod limits;
pub mod messages;
#[allow(unsafe_code)]
pub mod os;
pub mod policy;
pub mod weights;
