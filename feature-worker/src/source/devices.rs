//! V4L2 devices: which there are, what each can do, who uses it, and why one cannot be opened.
//!
//! Called at the start and by `feature-worker camera`, on their own thread; allocates. What is read of /dev, /sys, /proc and /etc is read below
//! a root, so that a test can give another one. Only [`open`], [`is_taken`] and [`Device::ask`] touch a device, and none disturbs one that streams.

use std::fs::{File, OpenOptions};
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use serde::Serialize;
use v4l2r::ioctl::{self, Capabilities, Capability, FmtDesc, FormatIterator, FrmIvalTypes, FrmSizeTypes, ReqbufsError};
use v4l2r::memory::MemoryType;
use v4l2r::nix::errno::Errno;
use v4l2r::{PixelFormat, QueueType, bindings as v4l2};

use super::frame::SourceError;

/// O_NONBLOCK of Linux on x86-64 and aarch64: opening a device never waits.
const NONBLOCK: i32 = 0o4000;
/// The most sizes, and rates of a size, that are listed. Chosen by hand; it bounds a driver that never ends its list.
const LIST_MOST: u32 = 64;

/// Why a device cannot be used, apart from its pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Trouble {
    /// There is no such file, or the device behind it is gone.
    Missing,
    /// This user may not open it.
    Permission,
    /// Another program uses it.
    Busy,
    /// It is the node of a camera's metadata.
    Metadata,
    /// It is no V4L2 device that gives pictures.
    NotACamera,
    /// Its driver fails.
    Failing,
}

/// The group of a file, by its name in `etc/group` below `root`, else by its number.
fn group_of(root: &Path, path: &Path) -> Option<String> {
    let gid = std::fs::metadata(path).ok()?.gid().to_string();
    let groups = std::fs::read_to_string(root.join("etc/group")).unwrap_or_default();
    let name = groups.lines().find_map(|line| {
        let mut parts = line.split(':');
        let name = parts.next()?;
        (parts.nth(1)? == gid).then(|| name.to_string())
    });
    Some(name.unwrap_or(gid))
}

/// The programs that have `path` open, as `name (pid)`, by `proc` below `root`. Of other users' programs only root sees this.
pub fn users(root: &Path, path: &Path) -> Vec<String> {
    let target = std::fs::canonicalize(path).unwrap_or_else(|_| path.to_path_buf());
    let mut found = Vec::new();
    for entry in std::fs::read_dir(root.join("proc")).into_iter().flatten().flatten() {
        let pid = entry.file_name().to_string_lossy().into_owned();
        if !pid.bytes().all(|c| c.is_ascii_digit()) || pid == std::process::id().to_string() {
            continue;
        }
        let files = std::fs::read_dir(entry.path().join("fd")).into_iter().flatten().flatten();
        if files.filter_map(|f| std::fs::read_link(f.path()).ok()).any(|to| to == target) {
            let name = std::fs::read_to_string(entry.path().join("comm")).unwrap_or_default();
            found.push(format!("{} ({pid})", name.trim()));
        }
    }
    found.sort();
    found
}

/// Whether another program streams from the opened device. The kernel lets many programs open a camera and only one stream from it; who asks for no
/// buffers at all is told that they belong to another one, and disturbs nobody.
pub fn is_taken(device: &File) -> bool {
    let abilities = ioctl::querycap::<Capability>(device).map_or(Capabilities::VIDEO_CAPTURE, |abilities| abilities.device_caps());
    let queue = if abilities.contains(Capabilities::VIDEO_CAPTURE) { QueueType::VideoCapture } else { QueueType::VideoCaptureMplane };
    let asked = ioctl::reqbufs::<()>(device, queue, MemoryType::Mmap, 0);
    matches!(asked, Err(ReqbufsError::IoctlError(Errno::EBUSY)))
}

/// Whether no other program streams from the device that was opened at `path`; the error names those that have it open, by `proc` below `root`.
pub fn free(device: &File, root: &Path, path: &Path) -> Result<(), SourceError> {
    if is_taken(device) { Err(error_of(root, path, Trouble::Busy)) } else { Ok(()) }
}

/// The trouble that a failed opening, or a failed look at the abilities, means.
fn trouble_of(error: &std::io::Error) -> Trouble {
    match (error.kind(), error.raw_os_error()) {
        (std::io::ErrorKind::PermissionDenied, _) => Trouble::Permission,
        (std::io::ErrorKind::ResourceBusy, _) => Trouble::Busy,
        // ENODEV and ENXIO: the file is there and the device is not.
        (std::io::ErrorKind::NotFound, _) | (_, Some(6 | 19)) => Trouble::Missing,
        // EINVAL and ENOTTY: whatever it is, it knows no such question.
        (std::io::ErrorKind::IsADirectory, _) | (_, Some(22 | 25)) => Trouble::NotACamera,
        _ => Trouble::Failing,
    }
}

/// The error for a trouble with `path`, with what to do.
pub(super) fn error_of(root: &Path, path: &Path, trouble: Trouble) -> SourceError {
    let name = path.display().to_string();
    match trouble {
        Trouble::Missing => SourceError::Missing(name),
        Trouble::Permission => SourceError::Permission { group: group_of(root, path).unwrap_or_else(|| "video".into()), path: name },
        Trouble::Busy => SourceError::Busy { users: users(root, path).join(", "), path: name },
        Trouble::Metadata => SourceError::Metadata(name),
        Trouble::NotACamera => SourceError::NotACamera(name),
        Trouble::Failing => SourceError::Failing(name),
    }
}

/// The trouble with a node that has these abilities, if there is one.
fn trouble_with(abilities: Capabilities) -> Option<Trouble> {
    if abilities.intersects(Capabilities::VIDEO_CAPTURE | Capabilities::VIDEO_CAPTURE_MPLANE) {
        None
    } else if abilities.contains(Capabilities::META_CAPTURE) {
        Some(Trouble::Metadata)
    } else {
        Some(Trouble::NotACamera)
    }
}

/// Opens the device at `path` for its controls, beside whoever streams from it. What is no camera is an error that says what it is.
pub fn open(path: &Path) -> Result<File, SourceError> {
    let fail = |trouble| error_of(Path::new("/"), path, trouble);
    let file = OpenOptions::new().read(true).write(true).custom_flags(NONBLOCK).open(path).map_err(|e| fail(trouble_of(&e)))?;
    let abilities: Capability = ioctl::querycap(&file).map_err(|e| fail(trouble_of(&Errno::from(e).into())))?;
    trouble_with(abilities.device_caps()).map_or(Ok(file), |trouble| Err(fail(trouble)))
}

/// What `feature-worker camera` tells of one device.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Device {
    /// Its node, such as `/dev/video0`.
    pub path: PathBuf,
    /// Its lasting names in `/dev/v4l/by-id` and `by-path`.
    pub names: Vec<PathBuf>,
    /// The name that the kernel gives it.
    pub card: String,
    /// Group that may open it.
    pub group: String,
    /// Programs that have it open.
    pub users: Vec<String>,
    /// Why it cannot be used; none if it can.
    pub trouble: Option<Trouble>,
    /// Formats, sizes and rates, a line each.
    pub formats: Vec<String>,
}

/// All V4L2 devices below `root`, in the order of their numbers. Nothing is opened.
pub fn list(root: &Path) -> Vec<Device> {
    let mut devices = Vec::new();
    for entry in std::fs::read_dir(root.join("sys/class/video4linux")).into_iter().flatten().flatten() {
        let node = entry.file_name().to_string_lossy().into_owned();
        let Some(number) = node.strip_prefix("video").and_then(|n| n.parse::<u32>().ok()) else { continue };
        let path = root.join("dev").join(&node);
        let card = std::fs::read_to_string(entry.path().join("name")).unwrap_or_default().trim().to_string();
        let group = group_of(root, &path).unwrap_or_default();
        let users = users(root, &path);
        let trouble = (!path.exists()).then_some(Trouble::Missing);
        devices.push((number, Device { names: names(root, &path), path, card, group, users, trouble, formats: Vec::new() }));
    }
    devices.sort_by_key(|(number, _)| *number);
    devices.into_iter().map(|(_, device)| device).collect()
}

/// The lasting names of a node.
fn names(root: &Path, path: &Path) -> Vec<PathBuf> {
    let target = std::fs::canonicalize(path).ok();
    let links =
        ["by-id", "by-path"].into_iter().flat_map(|by| std::fs::read_dir(root.join("dev/v4l").join(by)).into_iter().flatten().flatten());
    let mut found: Vec<PathBuf> =
        links.map(|link| link.path()).filter(|link| target.is_some() && std::fs::canonicalize(link).ok() == target).collect();
    found.sort();
    found
}

impl Device {
    /// Asks the device itself: whether it can be opened, whether it gives pictures, and in which formats. Returns it opened if it is a
    /// camera.
    pub fn ask(&mut self) -> Option<File> {
        let opened = OpenOptions::new().read(true).write(true).custom_flags(NONBLOCK).open(&self.path);
        let file = opened.map_err(|e| self.trouble = Some(trouble_of(&e))).ok()?;
        self.trouble = match ioctl::querycap::<Capability>(&file) {
            Ok(abilities) => trouble_with(abilities.device_caps()),
            Err(e) => Some(trouble_of(&Errno::from(e).into())),
        };
        if self.trouble.is_some() {
            return None;
        }
        self.formats = formats(&file);
        Some(file)
    }
}

/// Formats, sizes and rates of an opened device.
fn formats(file: &File) -> Vec<String> {
    let mut lines = Vec::new();
    for format in FormatIterator::new(file, QueueType::VideoCapture).take(LIST_MOST as usize) {
        let FmtDesc { pixelformat, description, .. } = format;
        for index in 0..LIST_MOST {
            let Ok(size) = ioctl::enum_frame_sizes::<v4l2::v4l2_frmsizeenum>(file, index, pixelformat) else { break };
            match size.size() {
                Some(FrmSizeTypes::Discrete(size)) => {
                    let rates = rates(file, pixelformat, size.width, size.height);
                    lines.push(format!("{pixelformat} {} x {}: {} ({description})", size.width, size.height, rates.join(", ")));
                }
                Some(FrmSizeTypes::StepWise(range)) => {
                    let v4l2::v4l2_frmsize_stepwise { min_width, max_width, min_height, max_height, .. } = range;
                    lines.push(format!("{pixelformat} {min_width} x {min_height} to {max_width} x {max_height} ({description})"));
                    break;
                }
                None => break,
            }
        }
    }
    lines
}

/// The rates of one size, frames a second.
fn rates(file: &File, format: PixelFormat, width: u32, height: u32) -> Vec<String> {
    let mut rates = Vec::new();
    for index in 0..LIST_MOST {
        let Ok(interval) = ioctl::enum_frame_intervals::<v4l2::v4l2_frmivalenum>(file, index, format, width, height) else { break };
        let rate = |f: &v4l2::v4l2_fract| f64::from(f.denominator) / f64::from(f.numerator.max(1));
        match interval.intervals() {
            Some(FrmIvalTypes::Discrete(interval)) => {
                rates.push(format!("{:.4}", rate(interval)).trim_end_matches('0').trim_end_matches('.').into())
            }
            Some(FrmIvalTypes::StepWise(range)) => {
                rates.push(format!("{:.2} to {:.2}", rate(&range.max), rate(&range.min)));
                break;
            }
            None => break,
        }
    }
    rates
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    /// Protects the listing: lasting names, kernel name, group and users are found below any root, in the order of the numbers; another device's
    /// names and programs are not taken for it.
    #[test]
    fn devices_are_listed_by_name_and_user() {
        let directory = tempfile::tempdir().expect("a directory");
        let root = directory.path();
        for path in ["sys/class/video4linux/video10", "sys/class/video4linux/video2", "dev/v4l/by-id", "etc", "proc/77/fd", "proc/self"] {
            std::fs::create_dir_all(root.join(path)).expect("made");
        }
        let write = |path: &str, text: &str| std::fs::write(root.join(path), text).expect("written");
        write("sys/class/video4linux/video10/name", "Wrist: metadata\n");
        write("sys/class/video4linux/video2/name", "Wrist\n");
        write("dev/video2", "");
        let gid = std::fs::metadata(root.join("dev/video2")).expect("there").gid();
        write("etc/group", &format!("root:x:999999:\ncameras:x:{gid}:anna\n"));
        write("proc/77/comm", "cheese\n");
        let target = std::fs::canonicalize(root.join("dev/video2")).expect("there");
        symlink(&target, root.join("proc/77/fd/5")).expect("linked");
        symlink("../../video2", root.join("dev/v4l/by-id/usb-Wrist-index0")).expect("linked");
        let found = list(root);
        assert_eq!(found.iter().map(|d| d.card.as_str()).collect::<Vec<_>>(), ["Wrist", "Wrist: metadata"]);
        assert_eq!(found[0].names, [root.join("dev/v4l/by-id/usb-Wrist-index0")]);
        assert_eq!((found[0].group.as_str(), found[0].users.as_slice()), ("cameras", &["cheese (77)".to_string()][..]));
        assert_eq!((found[0].trouble, found[1].trouble), (None, Some(Trouble::Missing)));
        assert!(found[1].names.is_empty() && found[1].users.is_empty());
        let busy = error_of(root, &root.join("dev/v4l/by-id/usb-Wrist-index0"), Trouble::Busy);
        assert!(busy.exit_code() == 3 && busy.to_string().contains("cheese (77)"), "{busy}");
        let held = File::open(&target).expect("opened");
        assert!(free(&held, root, &target).is_ok(), "a program that has it open, and does not stream, takes it from nobody");
        let said = error_of(root, &root.join("dev/video2"), Trouble::Permission).to_string();
        assert!(said.contains("group 'cameras'") && said.contains("usermod"), "{said}");
    }

    /// Protects the reasons: a permission, a metadata node, a busy device, a missing one, a driver that fails and a file that is no device are told apart, each with
    /// its exit code.
    #[test]
    fn troubles_are_told_apart() {
        let error = |number: i32| trouble_of(&std::io::Error::from_raw_os_error(number));
        assert_eq!(
            [13, 16, 2, 6, 19, 22, 25].map(error),
            [
                Trouble::Permission,
                Trouble::Busy,
                Trouble::Missing,
                Trouble::Missing,
                Trouble::Missing,
                Trouble::NotACamera,
                Trouble::NotACamera
            ]
        );
        assert_eq!([5, 71, 110].map(error), [Trouble::Failing; 3], "input or output, protocol, and time");
        assert!(matches!(open(Path::new("/")), Err(SourceError::NotACamera(_))));
        let with = |flags| trouble_with(flags);
        assert_eq!(with(Capabilities::VIDEO_CAPTURE | Capabilities::STREAMING), None);
        assert_eq!(with(Capabilities::META_CAPTURE | Capabilities::STREAMING), Some(Trouble::Metadata));
        assert_eq!(with(Capabilities::VIDEO_OUTPUT), Some(Trouble::NotACamera));
        let codes = [Trouble::Missing, Trouble::Busy, Trouble::Failing, Trouble::Permission, Trouble::Metadata, Trouble::NotACamera]
            .map(|t| error_of(Path::new("/nowhere"), Path::new("/nowhere/video0"), t).exit_code());
        assert_eq!(codes, [3, 3, 3, 2, 2, 2]);
        let file = tempfile::NamedTempFile::new().expect("a file");
        assert!(matches!(open(file.path()), Err(SourceError::NotACamera(_))));
        assert!(matches!(open(Path::new("/dev/no-such-camera")), Err(SourceError::Missing(_))));
    }
}
