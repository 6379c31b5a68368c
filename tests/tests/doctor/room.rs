//! Episodes that are over their budget, and a disk that they fill.

use std::io::Read as _;
use std::process::Stdio;
use std::time::{Duration, Instant};

use tests::{CellUnderTest, Namespaces};

use super::waiting::Ends;
use super::{examine, line};

/// Records a short curve; gives what the command said.
fn record(cell: &CellUnderTest) -> String {
    cell.wait_idle();
    let output = cell.command("rt-controller", &["record", "--json", "--lambda", "5", "--gamma", "2"]);
    String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned()
}

/// Waits until the worker has said `words`.
fn wait_for(cell: &CellUnderTest, words: &str) {
    let until = Instant::now() + Duration::from_secs(10);
    while !cell.log("feature-worker").contains(words) {
        assert!(Instant::now() < until, "{words}: {}", cell.log("feature-worker"));
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// A cell that runs, whose episodes lie on a disk of their own, mounted with `options`; `None`, with a printed line, where that is not permitted.
fn cell_on_a_disk(options: &str, adapt: impl FnOnce(&mut toml::Table)) -> Option<CellUnderTest> {
    let mut cell = CellUnderTest::prepare(adapt);
    let inside = Namespaces::new(None)?;
    let episodes = cell.dir.path().join("episodes");
    std::fs::create_dir(&episodes).expect("ours");
    let mut mount = inside.command("mount");
    assert!(mount.args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(&episodes).status().expect("it runs").success());
    cell.inside = Some(inside);
    cell.spawn_all();
    Some(cell)
}

/// What `script` says where the cell is; `$EPISODES` is the directory.
fn in_episodes(cell: &CellUnderTest, script: &str) -> String {
    let mut sh = cell.inside.as_ref().expect("apart").command("sh");
    let output = sh.args(["-c", script]).current_dir("/").env("EPISODES", cell.dir.path().join("episodes")).output().expect("it runs");
    String::from_utf8_lossy(&output.stdout).trim().to_owned()
}

/// Protects the disk, and whoever believes that an episode was recorded: episodes over their budget are said by the recorder and by the doctor, and
/// none is deleted; a disk that is nearly full takes no more episodes, which the worker, the command and the doctor say.
#[test]
fn the_disk_is_not_filled_in_silence() {
    let Some(cell) = cell_on_a_disk("size=400m", |c| {
        c["recording"].as_table_mut().expect("a table").insert("budget_episodes".into(), 1.into());
    }) else {
        return;
    };
    let count = || in_episodes(&cell, "ls $EPISODES/*.mcap | wc -l");

    let said = record(&cell);
    assert!(said.contains("episode-0001.mcap"), "{said}");
    assert_eq!(line(&examine(&cell).0, "files", "episodes' budget").0, "green");
    assert!(!cell.log("feature-worker").contains("the budget is"), "{}", cell.log("feature-worker"));
    let said = record(&cell);
    assert!(said.contains("episode-0002.mcap"), "{said}");
    wait_for(&cell, "2 episodes, ");
    let (verdict, words) = line(&examine(&cell).0, "files", "episodes' budget");
    assert!(
        verdict == "red" && words.contains("MB together; the budget is 1 episode") && words.contains("decant episodes prune"),
        "{words}"
    );
    assert_eq!(count(), "2", "nothing is deleted by itself");

    in_episodes(&cell, "head -c 360000000 /dev/zero > $EPISODES/other");
    let said = record(&cell);
    assert!(said.contains("nothing is recorded"), "{said}");
    wait_for(&cell, "nothing is recorded");
    let recorder = cell.status().expect("it answers")["recorder"].to_string();
    assert!(recorder.contains("records nothing") && recorder.contains("below 64 MB no episode is begun"), "{recorder}");
    let (verdict, words) = line(&examine(&cell).0, "files", "episodes");
    assert!(verdict == "red" && words.contains("nothing more is recorded"), "{words}");
    assert_eq!(count(), "2");
}

/// Protects whoever believes that an episode was recorded: a disk that takes no more files takes no episode, however many bytes are free, which the worker,
/// the command, `status` and the doctor say.
#[test]
fn a_disk_that_takes_no_more_files_is_told() {
    let Some(cell) = cell_on_a_disk("size=400m,nr_inodes=1000", |_| {}) else { return };
    assert_ne!(line(&examine(&cell).0, "files", "episodes").0, "red");
    in_episodes(&cell, "seq -f $EPISODES/%g 990 | xargs touch");
    let said = record(&cell);
    assert!(said.contains("as many files as it may") && said.contains("nothing is recorded"), "{said}");
    wait_for(&cell, "as many files as it may");
    let (verdict, words) = line(&examine(&cell).0, "files", "episodes");
    assert!(verdict == "red" && words.contains("as many files as it may"), "{words}");
    cell.wait("the same of `status`", Duration::from_secs(10), |s| {
        s["space"].as_str().is_some_and(|s| s.contains("no room for more files"))
    });
    assert_eq!(in_episodes(&cell, "ls $EPISODES/*.mcap | wc -l"), "0");
}

/// Protects who looks for a crash in the journal: one that is deleted while the controller writes it is said, once, and begun anew as soon as nothing is
/// poured.
#[test]
fn a_journal_that_is_deleted_is_begun_anew() {
    let cell = CellUnderTest::start(|_| {});
    let journal = cell.dir.path().join("journal.bin");
    std::fs::remove_file(&journal).expect("it is written");
    let until = Instant::now() + Duration::from_secs(20);
    while !journal.exists() {
        assert!(Instant::now() < until, "{}", cell.log("rt-controller"));
        std::thread::sleep(Duration::from_millis(50));
    }
    let log = cell.log("rt-controller");
    assert_eq!(log.matches("was deleted or moved while it was written").count(), 1, "{log}");
    cell.wait("the journal", Duration::from_secs(10), |s| s["journal"].as_str().is_some_and(|words| words.ends_with(" MB")));
    assert!(journal.metadata().expect("there").len() > 0);
}

/// An empty disk of so many GiB at a directory, `SCRIPT DIRECTORY GIB`, that says no number of its own (`f_fsid` is 0), as those over NFS and FUSE. It is one
/// over FUSE: the numbers are those of the protocol's version 7.31 (linux/fuse.h).
const NAMELESS_DISK: &str = "import ctypes,os,struct,sys
at,blocks=sys.argv[1],int(sys.argv[2])<<18
fd=os.open('/dev/fuse',os.O_RDWR)
options=f'fd={fd},rootmode=40000,user_id=0,group_id=0,allow_other'
if ctypes.CDLL(None).mount(b'none',at.encode(),b'fuse',0,options.encode()): sys.exit('not mounted')
print(1,flush=True)
while True:
    asked=os.read(fd,1<<20)
    kind,number=struct.unpack('<4xIQ',asked[:16])
    error,answer=0,b''
    if kind==26: answer=struct.pack('<4I2H2I2HI28x',7,31,1<<16,0,12,10,1<<16,1,0,0,0)
    elif kind==3: answer=struct.pack('<Q8x6Q12x7I',60,1,0,0,0,0,0,0o40755,2,0,0,0,4096,0)
    elif kind==17: answer=struct.pack('<5Q4I24x',blocks,blocks,blocks,0,0,4096,255,4096,0)
    elif kind in (2,36,42): continue
    else: error=-2 if kind==1 else -38
    os.write(fd,struct.pack('<IiQ',16+len(answer),error,number)+answer)";

/// Protects who asks how much room is left: two disks that give no number of their own are two.
#[test]
fn disks_without_a_number_are_told_apart() {
    let mut cell = CellUnderTest::prepare(|c| {
        let journal = c["controller"]["journal"].as_str().expect("a path").replace("journal.bin", "journals/journal.bin");
        c["controller"].as_table_mut().expect("a table").insert("journal".into(), journal.into());
    });
    let Some(inside) = Namespaces::new(None) else { return };
    let mut disks = Vec::new();
    for (name, gib) in [("journals", "1"), ("episodes", "2")] {
        let directory = cell.dir.path().join(name);
        std::fs::create_dir(&directory).expect("ours");
        let mut disk = inside.command("python3");
        let disk = disk.args(["-c", NAMELESS_DISK]).arg(directory).arg(gib).stdout(Stdio::piped()).stderr(Stdio::null()).spawn();
        let mut disk = Ends(disk.expect("it starts"));
        if disk.0.stdout.as_mut().is_none_or(|out| out.read_exact(&mut [0; 1]).is_err()) {
            println!("not run: no disk can be made over FUSE here");
            return;
        }
        disks.push(disk);
    }
    cell.inside = Some(inside);
    cell.spawn("rt-controller");
    let status = cell.wait("the disks", Duration::from_secs(20), |s| s["space"].as_str().is_some_and(|words| !words.is_empty()));
    let space = status["space"].as_str().expect("text");
    assert!(space.contains("1.1 GB free in ") && space.contains("2.1 GB free in "), "{space}");
    // The controller lets go of the disks before they do.
    assert_eq!(cell.stop("rt-controller"), Some(0), "{}", cell.log("rt-controller"));
}
