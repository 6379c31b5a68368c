//! Single pictures and numbered sequences of pictures.
//!
//! For commands that read files and for the worker when it plays a sequence; on their own thread. Allocates. All pictures go through
//! [`decode`], so a picture is read alike alone, in a sequence and in an episode: turned by its EXIF orientation, without its alpha, other depths
//! as 8 bits a channel. A picture that is cut off or damaged, and a file of several pictures, are errors.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use opencv::core::{CV_8U, Mat, Vector};
use opencv::imgcodecs;
use opencv::prelude::*;
use shared::plural::counted;
use shared::regular_file;

use super::about_picture::{About, about};
use super::frame::SourceError;

/// Endings of the names of picture files.
const ENDINGS: [&str; 11] = ["png", "jpg", "jpeg", "bmp", "tif", "tiff", "pbm", "pgm", "pnm", "ppm", "webp"];
/// The most numbers that an error lists. Chosen by hand: the line stays readable.
const LIST_MOST: usize = 5;

/// Largest file of a picture that is read, bytes. Chosen by hand: the largest picture that a camera may have takes 50 MB without compression.
const FILE_MAX: u64 = 256 << 20;

/// The most pixels of a picture that is read: those of the largest one that `[camera]` allows, 4096 x 4096.
const PIXELS_MAX: usize = 1 << 24;

/// Whether `path` is a single picture by its name.
pub(super) fn is_picture(path: &Path) -> bool {
    let ending = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_lowercase();
    ENDINGS.contains(&ending.as_str())
}

/// Whether `path` is one picture, and no pattern of a sequence.
pub(super) fn is_single(path: &Path) -> bool {
    Pattern::of(path).is_none() && is_picture(path)
}

/// The picture in `bytes` as 8-bit grey or BGR; the error says what is wrong with it.
pub(super) fn decode(bytes: &[u8], picture: &mut Mat) -> Result<(), String> {
    check_size(bytes)?;
    let About { bytes, turn, white } = about(bytes)?;
    // We turn pictures ourselves, because OpenCV does it for some formats only.
    let flags = imgcodecs::IMREAD_ANYCOLOR | imgcodecs::IMREAD_IGNORE_ORIENTATION;
    let flags = if white.is_some() { flags | imgcodecs::IMREAD_ANYDEPTH } else { flags };
    // OpenCV says no more about what it cannot read than an empty picture does.
    let mut read = imgcodecs::imdecode(&Vector::from_slice(&bytes), flags).unwrap_or_default();
    if read.empty() {
        return Err("cannot be read as a picture".into());
    }
    match white {
        Some(white) => read.convert_to(picture, CV_8U, 255.0 / white, 0.0),
        None => {
            std::mem::swap(picture, &mut read);
            Ok(())
        }
    }
    .and_then(|()| turn.apply(picture, &mut read))
    .map_err(|e| e.message)
}

/// Refuses a picture with more pixels than any camera has, by its header: a small file may unpack to gigabytes. What its header does not tell, OpenCV
/// will find.
pub(crate) fn check_size(bytes: &[u8]) -> Result<(), String> {
    match imagesize::blob_size(bytes) {
        Ok(size) if size.width.saturating_mul(size.height) > PIXELS_MAX => {
            Err(format!("{} x {} px are too many: no camera has more than {PIXELS_MAX}", size.width, size.height))
        }
        _ => Ok(()),
    }
}

/// The picture in the file at `path`.
pub(super) fn read(path: &Path, picture: &mut Mat) -> Result<(), String> {
    decode(&regular_file::read(path, FILE_MAX).map_err(|e| unreadable(&e))?, picture)
}

/// Why a file cannot be read, in words.
pub(super) fn unreadable(e: &std::io::Error) -> String {
    match e.kind() {
        std::io::ErrorKind::NotFound => "no such file; a sequence of pictures has a name such as frame_%04d.png".to_string(),
        _ => e.to_string(),
    }
}

/// A file name with a number in it, such as `frame_%04d.png`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Pattern {
    directory: PathBuf,
    before: String,
    /// Least number of digits; fewer are filled up with zeros.
    digits: usize,
    after: String,
}

impl Pattern {
    /// The pattern that `path` is; `None` for the name of a file, which may hold a `%` too.
    pub(super) fn of(path: &Path) -> Option<Self> {
        if path.exists() {
            return None;
        }
        let name = path.file_name()?.to_str()?;
        let starts = name.match_indices('%').map(|(at, _)| at).collect::<Vec<_>>();
        starts.iter().rev().find_map(|at| {
            let rest = &name[at + 1..];
            let (width, after) = rest.split_at(rest.find(|c: char| !c.is_ascii_digit())?);
            let after = after.strip_prefix('d')?;
            let digits = if width.is_empty() { 1 } else { width.strip_prefix('0')?.parse().ok().filter(|d| (1..=18).contains(d))? };
            Some(Self { directory: path.parent()?.into(), before: name[..*at].into(), digits, after: after.into() })
        })
    }

    /// The number in a file's name, if the name follows the pattern.
    fn number(&self, name: &str) -> Option<u64> {
        let digits = name.strip_prefix(self.before.as_str())?.strip_suffix(self.after.as_str())?;
        let legal = digits.bytes().all(|c| c.is_ascii_digit())
            && (digits.len() == self.digits || (digits.len() > self.digits && !digits.starts_with('0')));
        legal.then(|| digits.parse().ok()).flatten()
    }

    /// All files of the pattern, by number.
    fn files(&self) -> BTreeMap<u64, PathBuf> {
        let directory = if self.directory.as_os_str().is_empty() { Path::new(".") } else { &self.directory };
        let entries = std::fs::read_dir(directory).into_iter().flatten().flatten();
        entries.filter_map(|e| Some((self.number(e.file_name().to_str()?)?, e.path()))).collect()
    }
}

/// A numbered sequence of pictures, or one picture.
pub(super) struct Sequence {
    path: String,
    files: std::collections::btree_map::IntoIter<u64, PathBuf>,
    first: u64,
    picture: Mat,
    partial: bool,
    /// Pictures that were left out because they cannot be read.
    left_out: Vec<u64>,
    /// Numbers between the first and the last that no file has.
    absent: u64,
}

impl Sequence {
    /// The sequence of `pattern`. Without `partial` a number that is missing between the first and the last is an error.
    pub(super) fn open(path: &Path, pattern: &Pattern, partial: bool) -> Result<Self, SourceError> {
        let path = path.display().to_string();
        let files = pattern.files();
        let (Some(first), Some(last)) = (files.keys().next().copied(), files.keys().next_back().copied()) else {
            let what = "no file of this name with a number; give a pattern such as frames/frame_%04d.png".into();
            return Err(SourceError::File { path, what });
        };
        let absent = (last - first + 1).saturating_sub(files.len() as u64);
        if absent > 0 && !partial {
            let mut expected = first;
            let mut gaps = Vec::new();
            for number in files.keys() {
                if *number > expected {
                    gaps.push(if *number == expected + 1 { expected.to_string() } else { format!("{expected} to {}", number - 1) });
                }
                expected = number + 1;
            }
            let more = if gaps.len() > LIST_MOST { format!(" and {}", counted(gaps.len() - LIST_MOST, "more gap")) } else { String::new() };
            gaps.truncate(LIST_MOST);
            let what = format!("of the numbers {first} to {last}, {absent} missing: {}{more}", gaps.join(", "));
            return Err(SourceError::Incomplete { path, what });
        }
        Ok(Self { path, files: files.into_iter(), first, picture: Mat::default(), partial, left_out: Vec::new(), absent })
    }

    /// The sequence of one picture.
    pub(super) fn single(path: &Path, partial: bool) -> Self {
        let files = BTreeMap::from([(0, path.to_path_buf())]);
        let path = path.display().to_string();
        Self { path, files: files.into_iter(), first: 0, picture: Mat::default(), partial, left_out: Vec::new(), absent: 0 }
    }

    /// The next picture and its number, counted from 0; `None` after the last.
    pub(super) fn next(&mut self) -> Result<Option<(&Mat, u64)>, SourceError> {
        for (number, file) in self.files.by_ref() {
            match read(&file, &mut self.picture) {
                Ok(()) => return Ok(Some((&self.picture, number - self.first))),
                Err(_) if self.partial => self.left_out.push(number),
                Err(what) => {
                    let path = file.display().to_string();
                    // Only what may be left out is called incomplete.
                    let alone = self.path == path;
                    return Err(if alone { SourceError::File { path, what } } else { SourceError::Incomplete { path, what } });
                }
            }
        }
        Ok(None)
    }

    /// What is missing, if something is.
    pub(super) fn remark(&self) -> Option<String> {
        let left_out: Vec<String> = self.left_out.iter().take(LIST_MOST).map(u64::to_string).collect();
        match (self.absent, self.left_out.len()) {
            (0, 0) => None,
            (absent, 0) => Some(format!("{}: {} missing between the first and the last", self.path, counted(absent, "picture"))),
            (absent, bad) => {
                let dots = if bad > LIST_MOST { ", ..." } else { "" };
                Some(format!(
                    "{}: {} missing and {bad} cannot be read ({}{dots})",
                    self.path,
                    counted(absent, "picture"),
                    left_out.join(", ")
                ))
            }
        }
    }
}
