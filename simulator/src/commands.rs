//! The commands of the program `simulator`, one file each.

pub mod operator;
pub mod run;
pub mod ur;
