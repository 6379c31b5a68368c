//! What crosses the borders between Decant's processes.
//!
//! | module | what it holds | used in the controller's loop |
//! |---|---|---|
//! | [`messages`] | fixed-layout messages in shared memory | yes |
//! | [`ipc`] | the iceoryx2 services that carry them | receive only |
//! | [`control`] | requests to the controller and its answers | no |
//! | [`robot_address`] | the robot's address, by number or by name | no |
//! | [`runtime_dir`] | where a cell keeps its sockets and other files of a run | no |
//! | [`shared_memory`] | the cell's files in `/dev/shm`: their names, who uses them, space for them | no |
//! | [`config`], [`config_paths`] | the cell's one TOML file, and what its paths mean | no |
//! | [`framing`] | how the lip lies in the pictures, on which an area depends | yes |
//! | [`limits`] | the one place that every target passes | yes |
//! | [`gaussian_curve`] | eq. (1), the movement of an experimental episode | yes |
//! | [`alpha_track`] | alpha over time: which angle belongs to a picture | yes |
//! | [`mlp`] | the 4-32-32-21 network | yes |
//! | [`actions`] | Fig. 5's table of actions | yes |
//! | [`estimator`] | from areas to ml, and to the volume poured so far | yes |
//! | [`agent`] | the weights at work in one pour: an observation in, an action out | yes |
//! | [`weights`] | the weight file (postcard with a CRC) | no |
//! | [`episode`] | `E = (L_E, w_E)` as MCAP files and CSV tables | no |
//! | [`regular_file`] | files of which only so much is read as is expected | no |
//! | [`whole_file`] | files that are written in one step, and never in place of one of another kind | no |
//! | [`disk_space`] | how much room a disk has | no |
//! | [`level`], [`plural`] | the priority of a line, and its numbers in words | no |
//! | [`exit`] | exit codes and one-line errors | no |
//! | [`speaker`] | lines for people, from threads that must not wait for a terminal | no |
//! | [`machine`] | what Linux tells about the machine, and what would make it better | no |
//! | [`supervisor`] | what systemd is told of a process that it started | no |
//! | [`os`] | the operating system: clock, scheduling, locked memory | yes |
//!
//! What the loop uses of a module marked "yes" does not allocate, lock or panic after construction; the module's header names the
//! exceptions that are for other threads. Nothing here panics: what fails is an error of one line for whoever called.

#![deny(unsafe_code)]

pub mod actions;
pub mod agent;
pub mod alpha_track;
pub mod config;
mod config_camera;
mod config_container;
pub mod config_paths;
pub mod control;
pub mod disk_space;
pub mod episode;
pub mod estimator;
pub mod exit;
pub mod framing;
pub mod gaussian_curve;
pub mod ipc;
pub mod level;
pub mod limits;
pub mod machine;
pub mod messages;
pub mod mlp;
#[allow(unsafe_code)]
pub mod os;
pub mod plural;
pub mod regular_file;
pub mod robot_address;
pub mod runtime_dir;
pub mod shared_memory;
pub mod speaker;
pub mod supervisor;
pub mod weights;
pub mod whole_file;
