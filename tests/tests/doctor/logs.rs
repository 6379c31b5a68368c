//! What the programs say where systemd's journal reads it, and where it does not.

use std::io::{BufRead as _, BufReader};
use std::process::{Command, Stdio};

use tests::{CellUnderTest, program};

/// The lines of a worker whose camera is missing, until it waits for it; `journal` is whether `JOURNAL_STREAM` names its standard error.
fn said(journal: bool) -> Vec<String> {
    let mut cell = CellUnderTest::prepare(|c| {
        c["camera"]["source"] = "device".into();
        c["camera"].as_table_mut().expect("a table").insert("path".into(), "/dev/no-such-camera".into());
    });
    let (reader, writer) = std::io::pipe().expect("a pipe");
    let stream = rustix::fs::fstat(&writer).expect("it is open");
    let inode = if journal { stream.st_ino } else { stream.st_ino + 1 };
    let mut command = Command::new(program("feature-worker"));
    command.env("JOURNAL_STREAM", format!("{}:{inode}", stream.st_dev));
    cell.spawn_with("feature-worker", command, writer.into());
    let mut lines = Vec::new();
    for line in BufReader::new(reader).lines() {
        lines.push(line.expect("text"));
        if lines.iter().any(|l| l.contains("it is waited for")) && lines.len() > 1 {
            break;
        }
    }
    cell.stop("feature-worker");
    lines
}

/// Protects `journalctl -p warning`: in the journal each line has the priority of what it says, and no time of its own. Anywhere else, also where a
/// service's variable was inherited, people read the time and no marks.
#[test]
fn lines_carry_their_priority_in_the_journal_alone() {
    let lines = said(true);
    let find = |words: &str| lines.iter().find(|l| l.contains(words)).unwrap_or_else(|| panic!("{words}: {lines:?}"));
    assert!(find("waiting for frames").starts_with("<6>feature-worker: "), "{lines:?}");
    assert!(find("it is waited for").starts_with("<4>feature-worker: "), "{lines:?}");
    assert!(lines.iter().all(|l| l.starts_with('<')), "{lines:?}");

    let lines = said(false);
    assert!(lines.iter().all(|l| l.as_bytes().get(10) == Some(&b'T') && l.contains("Z feature-worker: ")), "{lines:?}");

    let (mut reader, writer) = std::io::pipe().expect("a pipe");
    let stream = rustix::fs::fstat(&writer).expect("it is open");
    let mut command = Command::new(program("feature-worker"));
    command.args(["run", "--config", "/no/such/cell.toml"]).env("JOURNAL_STREAM", format!("{}:{}", stream.st_dev, stream.st_ino));
    let status = command.stdout(Stdio::null()).stderr(writer).status().expect("it runs");
    drop(command);
    let mut error = String::new();
    std::io::Read::read_to_string(&mut reader, &mut error).expect("text");
    assert!(status.code() == Some(2) && error.starts_with("<3>error: ") && error.lines().count() == 1, "{error}");
}
