//! The word that a browser needs which is not this user's on this machine. It is made once, and lies in a file that only the user may read.
//!
//! It runs at a program's start, allocates, and reads and writes the file. Every failure is one line that names the file.

use std::fs::{File, Metadata};
use std::io::{ErrorKind, Read as _};
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use sha2::{Digest as _, Sha256};
use shared::disk_space::error_words;
use shared::regular_file;
use shared::runtime_dir::own_uid;
use shared::whole_file;

/// Random bytes of a token: 128 bits cannot be guessed over a network.
const BYTES: u64 = 16;
/// Longest token file that is read, bytes. Chosen by hand: 32 digits and a line's end, and room for what a person writes instead.
const FILE_MAX: u64 = 256;
/// Least length of a token that a person wrote, characters. Chosen by hand: shorter ones can be guessed.
const LEAST: usize = 16;

/// The token in `file`, which is made if it is not there or has nothing in it. The second value tells whether it was made now.
pub fn read_or_make(file: &Path) -> Result<(String, bool), String> {
    let fail = |e: std::io::Error| format!("{}: {}", file.display(), error_words(&e));
    let there = match regular_file::open(file) {
        Ok((open, meta)) => Some(read(file, open, &meta)?),
        Err(e) if e.kind() == ErrorKind::NotFound => None,
        Err(e) => return Err(fail(e)),
    };
    if let Some(token) = there.as_ref().filter(|token| !token.is_empty()) {
        return Ok((token.clone(), false));
    }
    let mut bytes = Vec::new();
    File::open("/dev/urandom").and_then(|f| f.take(BYTES).read_to_end(&mut bytes)).map_err(fail)?;
    let token: String = bytes.iter().map(|b| format!("{b:02x}")).collect();
    let line = format!("{token}\n");
    if there.is_some() {
        whole_file::replace(file, line.as_bytes(), b"").map_err(fail)?;
    } else {
        if let Some(parent) = file.parent() {
            std::fs::create_dir_all(parent).map_err(fail)?;
        }
        whole_file::create_secret(file, line.as_bytes()).map_err(fail)?;
    }
    Ok((token, true))
}

/// The token in `open`, the file that `meta` describes; empty if there is nothing in it, as after a power failure that came before the disk had it.
fn read(file: &Path, open: File, meta: &Metadata) -> Result<String, String> {
    if ![0, own_uid()].contains(&meta.uid()) {
        return Err(format!("{}: belongs to user {}, who knows it: delete it, so that a new one is made", file.display(), meta.uid()));
    }
    if meta.mode() & 0o077 != 0 {
        return Err(format!("{}: others may read it; run `chmod 600` on it, or delete it, so that a new one is made", file.display()));
    }
    let mut text = String::new();
    open.take(FILE_MAX).read_to_string(&mut text).map_err(|e| format!("{}: {}", file.display(), error_words(&e)))?;
    // Some file systems leave zeros where nothing was written yet.
    let token = text.trim_matches(|c: char| c.is_whitespace() || c == '\0').to_string();
    if !token.is_empty() && (token.len() < LEAST || !token.bytes().all(|b| b.is_ascii_alphanumeric())) {
        return Err(format!("{}: a token is {LEAST} letters and digits or more; delete it, so that a new one is made", file.display()));
    }
    Ok(token)
}

/// Whether two words are the same. Their hashes are compared, so the time that it takes says nothing about them.
pub fn same(a: &str, b: &str) -> bool {
    Sha256::digest(a.as_bytes()) == Sha256::digest(b.as_bytes())
}

#[cfg(test)]
mod tests {
    use std::fs::Permissions;
    use std::os::unix::fs::{PermissionsExt as _, chown};

    use super::*;

    /// Protects a cell on a network: the token is made once, is long, stays, and is refused when others may read it or it is short.
    #[test]
    fn a_token_is_made_once_and_kept_from_others() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("there/token");
        let (token, made) = read_or_make(&file).unwrap();
        assert!(made && token.len() == 32, "{token}");
        assert_eq!(read_or_make(&file), Ok((token.clone(), false)));
        assert!(same(&token, &token) && !same(&token, "x"));
        std::fs::set_permissions(&file, Permissions::from_mode(0o644)).unwrap();
        assert!(read_or_make(&file).unwrap_err().contains("chmod 600"));
        std::fs::set_permissions(&file, Permissions::from_mode(0o600)).unwrap();
        std::fs::write(&file, "short").unwrap();
        assert!(read_or_make(&file).unwrap_err().contains("letters and digits"));
    }

    /// Protects the operator's page after a power failure: a token's file in which nothing is, because the disk never had it, is made anew, whole and for its
    /// owner alone; so a cell needs nobody to delete it. One that another user has made is known to that user, and is refused.
    #[test]
    fn a_token_that_was_lost_is_made_anew() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("token");
        for nothing in [&b""[..], b"\n", &[0; 33]] {
            std::fs::write(&file, nothing).unwrap();
            std::fs::set_permissions(&file, Permissions::from_mode(0o600)).unwrap();
            let (token, made) = read_or_make(&file).unwrap();
            assert!(made && token.len() == 32, "{token}");
            assert_eq!(std::fs::read_to_string(&file).unwrap(), format!("{token}\n"));
            assert_eq!(file.metadata().unwrap().mode() & 0o777, 0o600);
            assert_eq!(read_or_make(&file), Ok((token, false)));
        }
        assert_eq!(dir.path().read_dir().unwrap().count(), 1, "nothing is left beside it");
        if own_uid() == 0 {
            chown(&file, Some(65534), None).unwrap();
            assert!(read_or_make(&file).unwrap_err().contains("belongs to user 65534"));
        } else {
            println!("not run: it takes root to make a file of another user");
        }
    }
}
