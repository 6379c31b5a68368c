//! Pictures of one experiment, as SVG files. The plots on a page are those of the trainer's report.

pub mod motion;
pub mod percentiles;
pub mod pour;
