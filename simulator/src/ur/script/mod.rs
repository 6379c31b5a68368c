//! URScript: the part of the language that a streaming program needs, run one control cycle at a time.
//!
//! [`parse`] turns text into a tree, `compile` turns the tree into code for a small stack machine, and [`Interpreter`] runs
//! that code until every thread of it waits for time to pass. What a robot would refuse is refused here: an unknown construct,
//! function, keyword or parameter is an error that names line and cause, and is never ignored. Where UR's manual leaves a rule
//! open, the stricter reading holds: a variable keeps its type, a condition is a bool, and an index is an int.
//!
//! Runs on the controller's thread. Memory is bounded whatever the source: nesting, code, call depth, list sizes, string
//! lengths, threads and instructions per cycle all have limits, and passing one is an error of the program.

mod builtin;
mod compile;
mod expressions;
mod interpreter;
mod lex;
mod parser;
mod statements;
mod syntax;
mod thread;
mod value;

pub use interpreter::{Interpreter, StepOutcome};
pub use statements::{MAX_SOURCE_BYTES, parse};
pub use thread::Effort;

/// A mistake in a program.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("line {line}: {what}")]
pub struct ScriptError {
    /// The line in the uploaded text, from 1.
    pub line: u32,
    /// What is wrong and, where it helps, what to write instead.
    pub what: String,
}

impl ScriptError {
    fn new(line: u32, what: impl Into<String>) -> Self {
        Self { line, what: what.into() }
    }
}
