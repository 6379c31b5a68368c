//! Calibration in the page: `feature-worker calibrate --page` as a child, whose own page answers this one's questions.
//!
//! The child watches one pour, finds corner, axes and colour, takes corrections, and writes the configuration; nothing of that is done here. A
//! thread of its own takes what it says. There is one child at a time: another start ends the one before first, and a child ends with its
//! standard input, so also when this program is killed. Allocates, and what is read is bounded. A child that fails gives its lines.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use serde_json::{Value, json};

use crate::lock::locked;
use crate::programs::program;

/// Longest watch of a camera, s. Chosen by hand: calibrate keeps more than five minutes of it.
const SECONDS_MAX: u64 = 120;
/// Number of lines that are kept of what the child says. Chosen by hand; it says about ten.
const LINES: usize = 40;
/// Longest wait for the child's answer. Chosen by hand: measuring a long pour again takes some seconds.
const ANSWER: Duration = Duration::from_secs(50);
/// Largest answer of the child, bytes: a picture.
const ANSWER_MAX: u64 = 16 << 20;

#[derive(Default)]
struct Newest {
    child: Option<Child>,
    /// Where the child's page is, once it has one.
    address: Option<SocketAddr>,
    lines: Vec<String>,
    /// Whether the last child has ended, and how.
    ended: Option<bool>,
}

impl Newest {
    /// The process number of the child, if there is one.
    fn number(&self) -> Option<u32> {
        self.child.as_ref().map(Child::id)
    }

    /// Ends the child, if there is one, and tells how it ended.
    fn end(&mut self) -> Option<ExitStatus> {
        let mut child = self.child.take()?;
        self.address = None;
        // It may have ended by itself.
        let _ = child.kill();
        child.wait().ok()
    }
}

/// The calibration under way, if there is one.
pub struct Calibration {
    program: PathBuf,
    newest: Mutex<Newest>,
}

impl Default for Calibration {
    fn default() -> Self {
        Self::with(program("feature-worker"))
    }
}

impl Calibration {
    /// Calibrates with this `feature-worker`.
    fn with(program: PathBuf) -> Self {
        Self { program, newest: Mutex::default() }
    }

    fn newest(&self) -> MutexGuard<'_, Newest> {
        locked(&self.newest)
    }

    /// Starts to watch the camera for `seconds`, during which one pour is to be shown. `method` is `colour`, `clear`, or
    /// anything else for the configured one. A picture for people is written to `picture`.
    pub fn start(self: &Arc<Self>, (config, picture): (&Path, &Path), seconds: u64, method: &str) -> Result<(), String> {
        if !(3..=SECONDS_MAX).contains(&seconds) {
            return Err(format!("the camera can be watched for 3 to {SECONDS_MAX} s"));
        }
        let path = &self.program;
        let mut command = Command::new("nice");
        command.args(["-n", "19"]).arg(path).arg("calibrate").arg("--config").arg(config);
        command.arg("--picture").arg(picture);
        command.args(["--seconds", &seconds.to_string(), "--page", "--port", "0", "--end-with-input"]);
        if ["colour", "clear"].contains(&method) {
            command.args(["--method", method]);
        }
        command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        // Until the new child is known, nobody else starts one.
        let mut newest = self.newest();
        newest.end();
        let mut child = command.spawn().map_err(|e| format!("{}: {e}", path.display()))?;
        let said = child.stderr.take();
        let number = child.id();
        *newest = Newest { child: Some(child), ..Newest::default() };
        let this = Arc::clone(self);
        let listen = move || {
            for line in said.into_iter().flat_map(|s| BufReader::new(s.take(ANSWER_MAX)).lines()).map_while(Result::ok) {
                this.take(number, line);
            }
            let mut newest = this.newest();
            if newest.number() != Some(number) {
                return;
            }
            // It has closed its standard error, so it has ended, or says more than is read.
            let status = newest.end();
            newest.ended = Some(status.is_some_and(|s| s.success()));
        };
        std::thread::Builder::new().name("calibration".into()).spawn(listen).map(drop).map_err(|e| {
            newest.end();
            e.to_string()
        })
    }

    fn take(&self, number: u32, line: String) {
        let mut newest = self.newest();
        if newest.number() != Some(number) {
            return;
        }
        if let Some((_, rest)) = line.split_once("open http://") {
            newest.address = rest.split_whitespace().next().and_then(|a| a.parse().ok());
        } else if newest.lines.len() < LINES {
            newest.lines.push(line.trim_start_matches("calibrate: ").trim_start_matches("error: ").into());
        }
    }

    /// Ends the child, if there is one. Nothing is written.
    pub fn cancel(&self) {
        if let Some(child) = self.newest().child.as_mut() {
            // It may have ended by itself.
            let _ = child.kill();
        }
    }

    /// How far it has come: what the child says, and its own state when it has found something.
    pub fn about(&self) -> Value {
        let (address, lines, busy, ended) = {
            let newest = self.newest();
            (newest.address, newest.lines.clone(), newest.child.is_some(), newest.ended)
        };
        let state = address.and_then(|_| self.ask(false, "/state.json", "").ok());
        let state = state.and_then(|bytes| serde_json::from_slice::<Value>(&bytes).ok());
        json!({ "busy": busy, "lines": lines, "found": state, "ended": ended })
    }

    /// The picture with what was found.
    pub fn picture(&self) -> Result<Vec<u8>, String> {
        self.ask(false, "/picture.jpg", "")
    }

    /// Tries a corner that was clicked, or writes the configuration: what the child says of it.
    pub fn order(&self, path: &str, body: &str) -> Result<String, String> {
        self.ask(true, path, body).map(|bytes| String::from_utf8_lossy(&bytes).into_owned())
    }

    /// Asks the child's page, as its own page would.
    fn ask(&self, post: bool, path: &str, body: &str) -> Result<Vec<u8>, String> {
        let address = self.newest().address.ok_or("no calibration is under way: start one")?;
        let ask = || -> std::io::Result<Vec<u8>> {
            let mut stream = TcpStream::connect_timeout(&address, ANSWER)?;
            stream.set_read_timeout(Some(ANSWER))?;
            let method = if post { "POST" } else { "GET" };
            write!(
                stream,
                "{method} {path} HTTP/1.1\r\nHost: {address}\r\nOrigin: http://{address}\r\nContent-Type: application/json\r\n\
                 Connection: close\r\nContent-Length: {}\r\n\r\n{body}",
                body.len()
            )?;
            let mut answer = Vec::new();
            stream.take(ANSWER_MAX).read_to_end(&mut answer)?;
            Ok(answer)
        };
        let answer = ask().map_err(|e| format!("calibrate does not answer ({e}): start it again"))?;
        let head = answer.windows(4).position(|w| w == b"\r\n\r\n").ok_or("calibrate gave no answer: start it again")?;
        if answer.starts_with(b"HTTP/1.1 200") { Ok(answer[head + 4..].to_vec()) } else { Err("calibrate refused: start it again".into()) }
    }
}

impl Drop for Calibration {
    fn drop(&mut self) {
        self.cancel();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the camera and the configuration from calibrations that nobody sees: however many people start one at the same time, one child is
    /// left, and none after a cancel.
    #[test]
    fn one_child_at_a_time() {
        use std::os::unix::fs::PermissionsExt as _;
        let dir = tempfile::tempdir().unwrap();
        let (script, pids) = (dir.path().join("worker"), dir.path().join("pids"));
        std::fs::write(&script, format!("#!/bin/sh\necho $$ >> {}\nexec sleep 30\n", pids.display())).unwrap();
        std::fs::set_permissions(&script, std::fs::Permissions::from_mode(0o700)).unwrap();
        let calibration = Arc::new(Calibration::with(script));
        let alive = || {
            let began = std::fs::read_to_string(&pids).unwrap_or_default();
            began.lines().filter(|pid| Path::new("/proc").join(pid).exists()).count()
        };
        let wait = |what: &str, good: &dyn Fn() -> bool| {
            let until = std::time::Instant::now() + Duration::from_secs(10);
            while !good() {
                assert!(std::time::Instant::now() < until, "{what}: {} children", alive());
                std::thread::sleep(Duration::from_millis(10));
            }
        };
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| calibration.start((dir.path(), dir.path()), 20, "colour").unwrap());
            }
        });
        wait("one is left", &|| alive() == 1);
        // Whoever was started and forgotten would have said so by now.
        std::thread::sleep(Duration::from_millis(300));
        assert_eq!((alive(), &calibration.about()["busy"]), (1, &json!(true)));
        calibration.cancel();
        wait("none is left", &|| alive() == 0 && calibration.about()["busy"] == false);
    }
}
