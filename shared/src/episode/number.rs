//! The number of the next episode, from what lies in the episodes' directory: no number is given twice, whatever the wall clock says. And the
//! order of episodes by their numbers.
//!
//! A number counts as used if a file of any kind, in the directory or below it, begins with `episode-` and that number: an episode that was
//! moved into a folder, renamed at its end or cut off. The file `.last-number` remembers what was given and has been moved away since. Its
//! lock keeps two programs from taking the same number.
//!
//! Ordinary threads that may wait for the disk use it; it allocates. Errors are those of the system; the caller names the directory.

use std::cmp::Ordering;
use std::fs::{File, OpenOptions, Permissions};
use std::io::{Error, ErrorKind, Read, Result, Seek, Write};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::Path;
use std::time::{Duration, Instant};

use crate::disk_space::error_words;
use crate::whole_file::give_owner;

/// Longest wait for another program that takes a number. Chosen by hand: it takes milliseconds.
const WAIT: Duration = Duration::from_secs(5);
/// How many folders deep episodes are looked for. Chosen by hand: people move episodes into a folder or two.
const DEPTH: usize = 8;
/// The largest number that a file's name or `.last-number` may say, so that a stray one (`episode-99999999999999.mcap`) cannot use up all numbers.
pub(crate) const LARGEST: u64 = 999_999_999;

/// Takes the next number in `directory`, which is made if it is missing. From then on the number is used.
pub fn take_number(directory: &Path) -> Result<u64> {
    take_number_above(directory, 0)
}

/// The same, and larger than `known`, the largest number that the caller has had: what the directory remembers goes when it is moved away or deleted while
/// a program runs that still knows its episodes.
pub fn take_number_above(directory: &Path, known: u64) -> Result<u64> {
    std::fs::create_dir_all(directory)?;
    let mut file = open(directory, true)?;
    // Who may read it could hold its lock. One that is another user's stays as it is.
    let _ = file.set_permissions(Permissions::from_mode(0o600));
    // Root may take a number for the cell's user, whose file it then is.
    give_owner(&file, &std::fs::metadata(directory)?);
    let number = next(&file, directory, known)?;
    // The number before is written over, and not taken away first: a disk that is full then leaves it.
    let text = format!("{number}\n");
    file.rewind()?;
    file.write_all(text.as_bytes())?;
    file.set_len(text.len() as u64)?;
    file.sync_data()?;
    Ok(number)
}

/// Whether the memory of [`take_number`] in `directory` gives a number, if there is one; nothing is made or changed.
pub fn check_number(directory: &Path) -> Result<()> {
    match open(directory, false) {
        Err(e) if e.kind() == ErrorKind::NotFound => Ok(()),
        file => next(&file?, directory, 0).map(|_| ()),
    }
}

/// The file that remembers the last number.
fn open(directory: &Path, create: bool) -> Result<File> {
    let flags = (rustix::fs::OFlags::NOFOLLOW | rustix::fs::OFlags::NONBLOCK).bits() as i32;
    let path = directory.join(".last-number");
    let open = OpenOptions::new().read(true).write(true).create(create).truncate(false).mode(0o600).custom_flags(flags).open(path);
    let file = open.map_err(|e| Error::new(e.kind(), format!(".last-number: {}", error_words(&e))))?;
    if !file.metadata()?.is_file() {
        return Err(Error::other(".last-number is no file: remove it"));
    }
    Ok(file)
}

/// The number behind the last one, by `file`, by what lies in `directory` and by what is `known`. From then on `file` is locked.
fn next(file: &File, directory: &Path, known: u64) -> Result<u64> {
    lock(file)?;
    let mut text = Vec::new();
    file.take(32).read_to_end(&mut text)?;
    let given: u64 = String::from_utf8_lossy(&text).trim().parse().ok().filter(|n| *n <= LARGEST).unwrap_or(0);
    let number = given.max(highest(directory, DEPTH)?).max(known) + 1;
    if number > LARGEST {
        return Err(Error::other("the numbers of its episodes are used up: look at .last-number and at the files' names"));
    }
    Ok(number)
}

/// The order of episodes' files: by their names, in which the first number counts as one. As text, `episode-10000.mcap` would come before
/// `episode-9999.mcap`.
pub fn by_number(a: &Path, b: &Path) -> Ordering {
    let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    around_number(&name(a)).cmp(&around_number(&name(b))).then_with(|| a.cmp(b))
}

/// What stands in `name` before its first number, the number, as its length and its digits without leading zeros, and what stands behind it.
fn around_number(name: &str) -> (&str, (usize, &str), &str) {
    let (before, rest) = name.split_at(name.find(|c: char| c.is_ascii_digit()).unwrap_or(name.len()));
    let (digits, after) = rest.split_at(rest.find(|c: char| !c.is_ascii_digit()).unwrap_or(rest.len()));
    let number = digits.trim_start_matches('0');
    (before, (number.len(), number), after)
}

/// Takes the file's lock, which goes when the file is closed.
fn lock(file: &File) -> Result<()> {
    let until = Instant::now() + WAIT;
    while file.try_lock().is_err() {
        if Instant::now() > until {
            return Err(Error::other("another program holds .last-number: is it stopped?"));
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    Ok(())
}

/// The highest number of a file in `directory` and the folders in it, `depth` deep; 0 if there is none. Links are not followed.
fn highest(directory: &Path, depth: usize) -> Result<u64> {
    let mut found = 0;
    for entry in std::fs::read_dir(directory)? {
        let entry = entry?;
        found = found.max(number_of(Path::new(&entry.file_name())).unwrap_or(0));
        if depth > 0 && entry.file_type()?.is_dir() {
            // A folder that may not be read holds nothing that could be overwritten here.
            found = found.max(highest(&entry.path(), depth - 1).unwrap_or(0));
        }
    }
    Ok(found)
}

/// The number that an episode's file has by its name; `None` if it has none.
pub fn number_of(file: &Path) -> Option<u64> {
    let name = file.file_name()?.to_string_lossy();
    let digits: String = name.strip_prefix("episode-")?.chars().take_while(char::is_ascii_digit).collect();
    digits.parse().ok().filter(|n| *n <= LARGEST)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects weights on the scale from the wrong episode: a number is never given twice, although files are moved, renamed or deleted.
    #[test]
    fn a_number_is_given_once() {
        let dir = tempfile::tempdir().expect("a directory");
        let take = || take_number(&dir.path().join("new")).expect("writable");
        let put = |name: &str| {
            let path = dir.path().join("new").join(name);
            std::fs::create_dir_all(path.parent().expect("a folder")).expect("writable");
            std::fs::write(path, b"").expect("writable");
        };
        assert_eq!((take(), take()), (1, 2));
        // Whoever may open it may lock it, and no number is taken meanwhile.
        let mode = std::fs::metadata(dir.path().join("new/.last-number")).expect("there").permissions().mode();
        assert_eq!(mode & 0o077, 0, "{mode:o}");
        put("moved aside/monday/episode-0017.mcap");
        assert_eq!(take(), 18);
        put("episode-0020.mcap.part");
        assert_eq!(take(), 21);
        put("episode-0025 (copy).mcap");
        put("episode-x.mcap");
        put("episode-99999999999999.mcap");
        assert_eq!(take(), 26);
        std::fs::remove_dir_all(dir.path().join("new/moved aside")).expect("there");
        std::fs::rename(dir.path().join("new/episode-0025 (copy).mcap"), dir.path().join("away")).expect("there");
        assert_eq!(take(), 27, "what was moved out of the directory is remembered");
        std::fs::remove_file(dir.path().join("new/.last-number")).expect("there");
        assert_eq!(take(), 21, "without its memory, what lies there decides");
        std::fs::write(dir.path().join("new/.last-number"), b"nonsense, and no \xff text").expect("writable");
        put("episode-0030.mcap");
        assert_eq!(take(), 31);
        std::fs::write(dir.path().join("new/.last-number"), u64::MAX.to_string()).expect("writable");
        assert_eq!(take(), 31, "a number that cannot be is none");
        std::fs::write(dir.path().join("new/.last-number"), LARGEST.to_string()).expect("writable");
        assert!(take_number(&dir.path().join("new")).is_err(), "no number is given twice, and none beyond the largest");
        std::fs::remove_dir_all(dir.path().join("new")).expect("there");
        let above = |known| take_number_above(&dir.path().join("new"), known).expect("writable");
        assert_eq!((above(31), above(7)), (32, 33), "what the directory forgot with it, a program that runs still knows");
    }

    /// Protects who trusts a look before a pour: it says what taking a number would say, and makes and changes nothing.
    #[test]
    fn a_look_says_what_taking_would() {
        let dir = tempfile::tempdir().expect("a directory");
        let file = dir.path().join(".last-number");
        check_number(&dir.path().join("new")).expect("it can be made");
        check_number(dir.path()).expect("nothing is there");
        assert!(!file.exists());
        assert_eq!(take_number(dir.path()).expect("writable"), 1);
        check_number(dir.path()).expect("ours");
        assert_eq!(std::fs::read(&file).expect("there"), b"1\n");
        let same = |word: &str| {
            let looked = check_number(dir.path()).expect_err("must be refused").to_string();
            assert!(looked.contains(word), "{looked}");
            assert_eq!(looked, take_number(dir.path()).expect_err("must be refused").to_string());
        };
        std::fs::write(&file, LARGEST.to_string()).expect("writable");
        same("used up");
        std::fs::remove_file(&file).expect("there");
        std::os::unix::fs::symlink("elsewhere", &file).expect("a link");
        same(".last-number: ");
        std::fs::remove_file(&file).expect("there");
        std::fs::create_dir(&file).expect("a directory");
        same(".last-number: ");
    }

    /// Protects who looks for the newest episodes from the order of text, in which the ten thousandth comes before the second.
    #[test]
    fn the_ten_thousandth_comes_last() {
        let order = [
            "a copy.mcap",
            "episode-0002.mcap",
            "episode-9999 (copy).mcap",
            "episode-9999.mcap",
            "episode-10000.mcap",
            "episode-99999999999999999999.mcap",
            "episode-100000000000000000000.mcap",
            "episode-x.mcap",
            "of a friend.mcap",
        ];
        let mut files = order.map(Path::new);
        files.sort();
        assert_ne!(files, order.map(Path::new));
        files.sort_by(|a, b| by_number(a, b));
        assert_eq!(files, order.map(Path::new));
    }

    /// Protects two programs that take numbers at once: each gets its own.
    #[test]
    fn two_programs_never_get_the_same_number() {
        let dir = tempfile::tempdir().expect("a directory");
        let numbers: Vec<u64> = std::thread::scope(|scope| {
            let take = || (0..50).map(|_| take_number(dir.path()).expect("writable")).collect::<Vec<_>>();
            let threads: Vec<_> = (0..4).map(|_| scope.spawn(take)).collect();
            threads.into_iter().flat_map(|t| t.join().expect("no panic")).collect()
        });
        let distinct: std::collections::BTreeSet<u64> = numbers.iter().copied().collect();
        assert_eq!(distinct.len(), 200);
    }
}
