//! The word that a browser needs which is not this user's on this machine. It is made once, and lies in a file that only the user may read.
//!
//! It runs at a program's start, allocates, and reads and writes the file. Every failure is one line that names the file.

use std::fs::{OpenOptions, Permissions};
use std::io::{Read as _, Write as _};
use std::os::unix::fs::{OpenOptionsExt as _, PermissionsExt as _};
use std::path::Path;

use sha2::{Digest as _, Sha256};
use shared::disk_space::error_words;
use shared::regular_file;

/// Random bytes of a token: 128 bits cannot be guessed over a network.
const BYTES: u64 = 16;
/// Longest token file that is read, bytes. Chosen by hand: 32 digits and a line's end, and room for what a person writes instead.
const FILE_MAX: u64 = 256;
/// Least length of a token that a person wrote, characters. Chosen by hand: shorter ones can be guessed.
const LEAST: usize = 16;

/// The token in `file`, which is made if it is not there. The second value tells whether it was made now.
pub fn read_or_make(file: &Path) -> Result<(String, bool), String> {
    let fail = |e: std::io::Error| format!("{}: {}", file.display(), error_words(&e));
    match regular_file::open(file) {
        Ok((open, meta)) => {
            let mode = meta.permissions().mode();
            if mode & 0o077 != 0 {
                return Err(format!(
                    "{}: others may read it; run `chmod 600` on it, or delete it, so that a new one is made",
                    file.display()
                ));
            }
            let mut text = String::new();
            open.take(FILE_MAX).read_to_string(&mut text).map_err(fail)?;
            let token = text.trim().to_string();
            if token.len() < LEAST || !token.bytes().all(|b| b.is_ascii_alphanumeric()) {
                return Err(format!(
                    "{}: a token is {LEAST} letters and digits or more; delete it, so that a new one is made",
                    file.display()
                ));
            }
            Ok((token, false))
        }
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
            let mut bytes = Vec::new();
            std::fs::File::open("/dev/urandom").and_then(|f| f.take(BYTES).read_to_end(&mut bytes)).map_err(fail)?;
            let token: String = bytes.iter().map(|b| format!("{b:02x}")).collect();
            if let Some(parent) = file.parent() {
                std::fs::create_dir_all(parent).map_err(fail)?;
            }
            let mut new = OpenOptions::new().write(true).create_new(true).mode(0o600).open(file).map_err(fail)?;
            let written = new.set_permissions(Permissions::from_mode(0o600)).and_then(|()| writeln!(new, "{token}"));
            written.map_err(|e| {
                // An empty one would keep the next start from making its own.
                let _ = std::fs::remove_file(file);
                fail(e)
            })?;
            Ok((token, true))
        }
        Err(e) => Err(fail(e)),
    }
}

/// Whether two words are the same. Their hashes are compared, so the time that it takes says nothing about them.
pub fn same(a: &str, b: &str) -> bool {
    Sha256::digest(a.as_bytes()) == Sha256::digest(b.as_bytes())
}

#[cfg(test)]
mod tests {
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
}
