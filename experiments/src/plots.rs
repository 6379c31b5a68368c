//! Pictures of one experiment, as SVG files. Plots within a page are drawn by `trainer`'s report.

pub mod pour;
