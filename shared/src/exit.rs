//! Exit codes and the one-line error of every program. They are used at the end of commands, in ordinary threads, and allocate. Nothing
//! here fails.

use std::fmt::Display;
use std::io::Write as _;
use std::panic::PanicHookInfo;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration;

use crate::level::Level;

/// The work failed on the way, for example because a file could not be written or a check found faults.
pub const FAILED: u8 = 1;
/// Wrong command line, configuration or input file; nothing was changed.
pub const BAD_INPUT: u8 = 2;
/// Another part of the cell (controller, worker, robot, camera, simulator) cannot be reached.
pub const UNREACHABLE: u8 = 3;
/// The pour or recording ended before it was done.
pub const ENDED_EARLY: u8 = 4;
/// The controller refused the request in its present state, or the cell has a program of this kind already.
pub const REFUSED: u8 = 5;
/// Interrupted by Ctrl-C or SIGTERM.
pub const INTERRUPTED: u8 = 130;

/// How often [`end_within`] looks at its flag. Chosen by hand; no measurement is recorded.
const BEAT: Duration = Duration::from_millis(100);
/// Stack of its thread, bytes; it may be locked in memory. Chosen by hand: its deepest call is a write.
const STACK: usize = 128 * 1024;

/// The exit codes, as `--help` shows them.
pub const HELP: &str = "Exit codes: 0 done, 1 failed, 2 bad command line, configuration or input file, 3 another part of the cell \
cannot be reached, 4 the pour ended early, 5 refused, 130 interrupted.";

/// Why a command ends without success: its exit code and its one line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Failure {
    /// One of this module's exit codes.
    pub code: u8,
    /// One line: what failed, where, and what to do.
    pub what: String,
}

/// The failure with exit code `code` and the line `what`.
pub fn failure(code: u8, what: impl Display) -> Failure {
    Failure { code, what: what.to_string() }
}

/// Turns an operation's error into the command's failure: `Config::read(file).or_exit(BAD_INPUT)?`.
pub trait OrExit<T> {
    /// The value, or a failure with the error's line and the exit code `code`.
    fn or_exit(self, code: u8) -> Result<T, Failure>;
}

impl<T, E: Display> OrExit<T> for Result<T, E> {
    fn or_exit(self, code: u8) -> Result<T, Failure> {
        self.map_err(|e| failure(code, e))
    }
}

/// Ends the process with `line` and [`FAILED`] if it still runs `within` after `stop` was set, as when a disk or a device holds one of its threads.
/// Without a thread for it, nothing does.
pub fn end_within(stop: &Arc<AtomicBool>, within: Duration, line: &'static str) {
    let stop = Arc::clone(stop);
    let watch = move || {
        while !stop.load(Relaxed) {
            std::thread::sleep(BEAT);
        }
        std::thread::sleep(within);
        crate::os::tell(Level::Error, line);
        std::process::exit(FAILED.into());
    };
    let _ = std::thread::Builder::new().name("end".into()).stack_size(STACK).spawn(watch);
}

/// Makes a panic in any thread of the process `name` one line that matters, in place of what Rust prints. What a command cannot print, because
/// the disk that its output goes to is full or nobody reads it any more, is no defect: it ends the process with one line and [`FAILED`].
pub fn explain_panics(name: &'static str) {
    std::panic::set_hook(Box::new(move |panic| {
        if let Some((stream, why)) = unprinted(panic) {
            crate::os::tell(Level::Error, &format!("error: {stream} cannot be written: {why}; what was to be said is not all there"));
            std::process::exit(FAILED.into());
        }
        crate::os::tell(Level::Error, &format!("{name}: this is a defect, please report it: {}", one_line(panic)));
    }));
}

/// Which of the two standard streams could not be written, and why, if that is what the panic is about: `println!` knows no other way to say it.
fn unprinted(panic: &PanicHookInfo) -> Option<(&'static str, String)> {
    let message = panic.payload().downcast_ref::<String>()?;
    let (stream, why) = message.strip_prefix("failed printing to std")?.split_once(": ")?;
    Some((if stream == "err" { "standard error" } else { "standard output" }, why.into()))
}

/// A panic's place and message in one line: Rust puts them on lines of their own, and the message may have several.
pub fn one_line(panic: &PanicHookInfo) -> String {
    panic.to_string().lines().collect::<Vec<_>>().join(" ")
}

/// Ends a resident process: as [`end`], but a terminal that takes nothing does not keep the process alive.
pub fn end_resident(result: Result<(), Failure>) -> ExitCode {
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure { code, what }) => {
            crate::os::tell(Level::Error, &format!("error: {what}"));
            ExitCode::from(code)
        }
    }
}

/// Ends a command: prints its failure, if there is one, and gives the process's exit code.
pub fn end(result: Result<(), Failure>) -> ExitCode {
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure { code, what }) => {
            // The exit code says it too, so that a standard error that cannot be written changes nothing.
            let _ = writeln!(std::io::stderr(), "{}", Level::Error.marked(&format!("error: {what}")));
            ExitCode::from(code)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Set in the process that is to panic.
    const PANICS: &str = "DECANT_TEST_PANICS";

    /// Protects the journal, where each line is an entry of its own, from a panic in pieces: whatever its message, it is one line with name and place.
    #[test]
    #[allow(clippy::panic)]
    fn a_panic_is_one_line() {
        if std::env::var_os(PANICS).is_some() {
            explain_panics("worker");
            panic!("first\nsecond");
        }
        // The hook is the whole process's, so this test panics in another one.
        let mut other = std::process::Command::new(std::env::current_exe().unwrap());
        let ended = other.args(["--exact", "exit::tests::a_panic_is_one_line", "--nocapture"]).env(PANICS, "1").output().unwrap();
        let said = String::from_utf8(ended.stderr).unwrap();
        assert!(!ended.status.success() && said.lines().count() == 1, "{said}");
        assert!(said.starts_with("worker: this is a defect, please report it: panicked at ") && said.contains("exit.rs:"), "{said}");
        assert!(said.ends_with("first second\n"), "{said}");
    }
}
