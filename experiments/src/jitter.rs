//! Latency and jitter of the real processes on this machine, beside cyclictest, at rest and under load.
//!
//! | file | what it holds |
//! |---|---|
//! | [`this_machine`] | what is known of the machine, and what would make it better |
//! | [`other_programs`] | cyclictest, the yardstick, and stress-ng, the load |
//! | [`bare_loop`] | the yardstick of a tick's execution |
//! | [`machine_log`] | what the machine did meanwhile |
//! | [`ratios`] | the controller over a yardstick of the same run |
//! | [`against`] | the gate: this run against an earlier one |
//! | [`tick_times`] | what the controller measured of every tick, from its journal |
//! | [`statistics`] | percentiles, and histograms for the page |
//! | [`processes`] | processor time, memory and files of a process |
//! | [`cell_run`] | one run of the cell: at rest, then pouring |
//! | [`condition`] | what was measured at rest, or under load, and how it is told |
//! | [`rounds`] | the cell and its yardsticks in turns |
//! | [`storm`] | everything at once that other programs can do to a cell |
//! | [`soak`] | one long run under load |
//! | [`measured`] | what a measurement becomes: numbers, text, page |

pub mod against;
pub mod bare_loop;
pub mod cell_run;
pub mod condition;
pub mod machine_log;
pub mod measured;
pub mod other_programs;
pub mod processes;
pub mod ratios;
pub mod rounds;
pub mod soak;
pub mod statistics;
pub mod storm;
pub mod this_machine;
pub mod tick_times;

/// Version of `jitter.json`; docs/REALTIME.md has its fields. Another meaning of a field gets another version.
pub const VERSION: u64 = 1;
