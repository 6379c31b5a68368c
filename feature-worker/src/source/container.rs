//! What a video's container says beside its pictures: how they are turned, when the last one ends, and whether the file is whole.
//!
//! OpenCV tells the first in a way that differs between its versions, and the others not at all. Read are MP4 and QuickTime boxes
//! (ISO/IEC 14496-12), the RIFF chunks of AVI, and the elements of Matroska and WebM (RFC 8794); of other files nothing is said.
//! For commands that read files, on their own thread; allocates at most [`INDEX_MOST`] bytes and eight for each of [`PICTURES_MOST`] pictures. Damaged files are no errors here: what
//! cannot be read is left out, and numbers from the file are used in checked arithmetic only.

use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::Path;

use opencv::core::{self, Mat};
use shared::regular_file;

use super::rhythm::Rhythm;

/// The largest index of an MP4 file that is read, bytes. Chosen by hand: an hour at 60 frames a second has about 3 MB.
const INDEX_MOST: u64 = 1 << 26;
/// The most pictures of an index whose times are read. Chosen by hand: 19 hours at 60 frames a second.
const PICTURES_MOST: usize = 1 << 22;
/// Part of a matrix's larger numbers below which the others count as zero. Chosen by hand: matrices of cameras are exact.
const NO_SHEAR: f64 = 0.01;

/// Matroska's element that holds all others but the header (RFC 9559).
const SEGMENT: u32 = 0x1853_8067;
/// Matroska's element that holds the blocks of some seconds (RFC 9559).
const CLUSTER: u32 = 0x1f43_b675;
/// Matroska's element that says how long the file is (RFC 9559).
const INFO: u32 = 0x1549_a966;
/// Matroska's element that says what tracks there are (RFC 9559).
const TRACKS: u32 = 0x1654_ae6b;
/// The largest of these two that is read, bytes. Chosen by hand: they have some hundred.
const ABOUT_MOST: u64 = 1 << 20;
/// Part of a cluster that is read for its time, bytes. Chosen by hand: it takes ten, and a checksum before it six.
const CLUSTER_HEAD: u64 = 32;
/// The longest head of an element of Matroska, bytes: 4 of its number and 8 of its length (RFC 8794).
const ELEMENT_HEAD: u64 = 12;

/// How the pictures must be turned to be upright.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Turn {
    /// Flipped left to right, before the turn.
    mirrored: bool,
    /// Quarter turns clockwise, 0 to 3.
    quarters: u8,
}

impl Turn {
    /// The pictures are upright.
    pub(super) const NONE: Self = Self { mirrored: false, quarters: 0 };

    /// The turn of an MP4 track's matrix, whose a, b, c and d map (x, y) to (a x + c y, b x + d y); `None` if it is no quarter turn.
    fn of_matrix([a, b, c, d]: [f64; 4]) -> Option<Self> {
        let (straight, across) = (a.abs().min(d.abs()), b.abs().min(c.abs()));
        let most = a.abs().max(b.abs()).max(c.abs()).max(d.abs());
        let clean = |large: f64, small: [f64; 2]| large > 0.5 * most && small.iter().all(|v| v.abs() < NO_SHEAR * most);
        let turn = |mirrored, quarters| Some(Self { mirrored, quarters });
        if clean(straight, [b, c]) {
            match (a > 0.0, d > 0.0) {
                (true, true) => turn(false, 0),
                (false, false) => turn(false, 2),
                (false, true) => turn(true, 0),
                (true, false) => turn(true, 2),
            }
        } else if clean(across, [a, d]) {
            match (b > 0.0, c > 0.0) {
                (true, false) => turn(false, 1),
                (false, true) => turn(false, 3),
                // Mirrored, then turned: (x, y) goes to (-x, y), and a clockwise turn takes that to (-y, -x).
                (false, false) => turn(true, 1),
                (true, true) => turn(true, 3),
            }
        } else {
            None
        }
    }

    /// A turn by whole quarters, in degrees clockwise.
    pub(super) fn of_degrees(degrees: f64) -> Option<Self> {
        let quarters = degrees / 90.0;
        (quarters.fract() == 0.0).then(|| Self { mirrored: false, quarters: quarters.rem_euclid(4.0) as u8 })
    }

    /// The turn that EXIF's orientation asks for; `None` if it is none of its eight numbers.
    pub(super) fn of_exif(orientation: u64) -> Option<Self> {
        let (mirrored, quarters) = match orientation {
            1 => (false, 0),
            2 => (true, 0),
            3 => (false, 2),
            4 => (true, 2),
            5 => (true, 3),
            6 => (false, 1),
            7 => (true, 1),
            8 => (false, 3),
            _ => return None,
        };
        Some(Self { mirrored, quarters })
    }

    /// `picture` upright; `spare` is a buffer that is used again.
    pub(super) fn apply(self, picture: &mut Mat, spare: &mut Mat) -> opencv::Result<()> {
        if self.mirrored {
            core::flip(picture, spare, 1)?;
            std::mem::swap(picture, spare);
        }
        let code = match self.quarters {
            1 => core::ROTATE_90_CLOCKWISE,
            2 => core::ROTATE_180,
            3 => core::ROTATE_90_COUNTERCLOCKWISE,
            _ => return Ok(()),
        };
        core::rotate(picture, spare, code)?;
        std::mem::swap(picture, spare);
        Ok(())
    }
}

/// What a container says.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Container {
    /// How the pictures are turned: `None` if this container does not say, `Some(None)` if it says an odd angle.
    pub turn: Option<Option<Turn>>,
    /// When the last picture ends, s from the first one.
    pub end_s: Option<f64>,
    /// How the pictures follow each other, if the file says it of each.
    pub rhythm: Option<Rhythm>,
    /// When each picture is shown, in their order, ms from the first one; empty if no index of the whole file says it.
    pub index_ms: Vec<f64>,
    /// Whether the time from one to the next is always the same, and OpenCV tells it as the rate.
    pub fixed_rate: bool,
    /// Whether this is a stream without a container, which has no times; what OpenCV tells of its rate is made up.
    pub raw: bool,
    /// Whether OpenCV's number of frames is written in the file, and is not an estimate from its duration.
    pub counts_frames: bool,
    /// Bytes that the file has too few, judged by the sizes in it.
    pub missing_bytes: Option<u64>,
    /// Whether the file does not say how long it is, as of a recorder that writes into a pipe: its end may be missing all the same.
    pub open_end: bool,
}

impl Container {
    const UNKNOWN: Self = Self {
        turn: None,
        end_s: None,
        rhythm: None,
        index_ms: Vec::new(),
        fixed_rate: false,
        raw: false,
        counts_frames: false,
        missing_bytes: None,
        open_end: false,
    };

    /// What the file at `path` says.
    pub(super) fn read(path: &Path) -> std::io::Result<Self> {
        let (mut file, meta) = regular_file::open(path)?;
        let size = meta.len();
        let mut head = Vec::new();
        (&mut file).take(12).read_to_end(&mut head)?;
        let kind = |at: usize| head.get(at..at + 4).unwrap_or_default();
        match (kind(0), kind(4), kind(8)) {
            (b"RIFF", _, b"AVI ") => avi(&mut file, size),
            ([0x1a, 0x45, 0xdf, 0xa3], ..) => matroska(&mut file, size),
            (_, b"ftyp" | b"moov" | b"mdat" | b"wide" | b"free" | b"skip", _) => mp4(&mut file, size),
            // MJPEG one after the other or with the borders of a mail, and the start codes of MPEG and H.26x but for MPEG's own container.
            ([0xff, 0xd8, 0xff, _] | [b'-', b'-', ..] | [0, 0, 0, 1], ..) => Ok(Self { raw: true, open_end: true, ..Self::UNKNOWN }),
            ([0, 0, 1, code], ..) => Ok(Self { raw: *code != 0xba, open_end: true, ..Self::UNKNOWN }),
            _ => Ok(Self { open_end: true, ..Self::UNKNOWN }),
        }
    }
}

/// How many bytes a file of `size` lacks of what ends at `end`.
fn missing(end: Option<u64>, size: u64) -> Option<u64> {
    end.map_or(Some(u64::MAX), |end| end.checked_sub(size)).filter(|m| *m > 0)
}

fn avi(file: &mut File, size: u64) -> std::io::Result<Container> {
    let mut known = Container { counts_frames: true, fixed_rate: true, turn: Some(Some(Turn::NONE)), ..Container::UNKNOWN };
    let mut at = 0u64;
    let mut head = [0; 8];
    // A file of more than a gigabyte has several such chunks, one after the other.
    while at.saturating_add(8) <= size && known.missing_bytes.is_none() {
        file.seek(SeekFrom::Start(at))?;
        file.read_exact(&mut head)?;
        if &head[..4] != b"RIFF" {
            break;
        }
        let body = u64::from(u32::from_le_bytes([head[4], head[5], head[6], head[7]]));
        // A recorder that was killed leaves no size.
        known.missing_bytes = if body == 0 { Some(1) } else { missing(at.checked_add(8 + body), size) };
        at = at.saturating_add(8 + body + body % 2);
    }
    Ok(known)
}

/// A number of Matroska's variable length, `None` for "unknown", and its own length in bytes; `None` if `bytes` do not hold one.
fn variable(bytes: &[u8]) -> Option<(Option<u64>, usize)> {
    let first = *bytes.first()?;
    let length = first.leading_zeros() as usize + 1;
    let rest = bytes.get(1..length).filter(|_| length <= 8)?;
    let value = rest.iter().fold(u64::from(first) & (0xff >> length), |v, b| v << 8 | u64::from(*b));
    Some(((value != (1 << (7 * length)) - 1).then_some(value), length))
}

/// Number, length of the head, and length of the contents of the element of Matroska that begins with `bytes`; the last is `None` for
/// "unknown". `None` if this is no element, or its head is cut.
fn element_head(bytes: &[u8]) -> Option<(u32, u64, Option<u64>)> {
    let length = bytes.first()?.leading_zeros() as usize + 1;
    let number = bytes.get(..length).filter(|_| length <= 4)?.iter().fold(0, |v, b| v << 8 | u32::from(*b));
    let (contents, more) = variable(&bytes[length..])?;
    Some((number, (length + more) as u64, contents))
}

/// The elements in `bytes`: number and contents. One that is cut ends them.
fn elements(mut bytes: &[u8]) -> impl Iterator<Item = (u32, &[u8])> {
    std::iter::from_fn(move || {
        let (number, head, contents) = element_head(bytes)?;
        let (head, contents) = (head as usize, usize::try_from(contents?).ok()?);
        let inside = bytes.get(head..head.checked_add(contents)?)?;
        bytes = &bytes[head + contents..];
        Some((number, inside))
    })
}

/// The contents of the first element with this number.
fn element(bytes: &[u8], wanted: u32) -> Option<&[u8]> {
    elements(bytes).find(|(number, _)| *number == wanted).map(|(_, contents)| contents)
}

/// A whole number of Matroska.
fn whole(bytes: &[u8]) -> Option<u64> {
    (bytes.len() <= 8).then(|| bytes.iter().fold(0, |value, byte| value << 8 | u64::from(*byte)))
}

/// When the file ends, by its element [`INFO`], in units of so many s.
fn matroska_end(info: &[u8]) -> Option<(f64, f64)> {
    // TimestampScale, ns, and Duration, in units of it.
    let scale_ns = element(info, 0x2a_d7b1).map_or(Some(1_000_000), whole)?;
    let duration = match *element(info, 0x4489)? {
        [a, b, c, d] => f64::from(f32::from_be_bytes([a, b, c, d])),
        [a, b, c, d, e, f, g, h] => f64::from_be_bytes([a, b, c, d, e, f, g, h]),
        _ => return None,
    };
    Some((duration, scale_ns as f64 / 1e9)).filter(|(duration, _)| duration.is_finite() && *duration > 0.0)
}

/// When the cluster whose contents begin at `at` starts, in the file's units: its first element says it, or stands behind a checksum.
fn cluster_start(file: &mut File, at: u64) -> std::io::Result<Option<u64>> {
    let mut head = Vec::new();
    file.seek(SeekFrom::Start(at))?;
    file.take(CLUSTER_HEAD).read_to_end(&mut head)?;
    Ok(element(&head, 0xe7).and_then(whole))
}

/// Whether there is one track of pictures, and no other that could be longer.
fn is_alone(tracks: &[u8]) -> bool {
    // TrackEntry, and TrackType (1 is video).
    let mut all = elements(tracks).filter(|(number, _)| *number == 0xae).map(|(_, track)| track);
    all.next().is_some_and(|track| element(track, 0x83).and_then(whole) == Some(1)) && all.next().is_none()
}

fn matroska(file: &mut File, size: u64) -> std::io::Result<Container> {
    let mut known = Container::UNKNOWN;
    let (mut about_end, mut alone, mut whole_segment, mut start) = (None, false, false, None);
    let mut at = 0u64;
    while at < size && known.missing_bytes.is_none() {
        file.seek(SeekFrom::Start(at))?;
        let mut head = Vec::new();
        file.take(ELEMENT_HEAD).read_to_end(&mut head)?;
        let Some((number, length, contents)) = element_head(&head) else {
            // At the file's end the head itself is cut.
            known.missing_bytes = ((head.len() as u64) < ELEMENT_HEAD).then_some(1);
            break;
        };
        let end = contents.and_then(|contents| (at + length).checked_add(contents));
        match (number, contents) {
            // Who writes into a pipe cannot come back to write a length, so what is inside is walked through.
            (SEGMENT | CLUSTER, None) => {
                known.open_end |= number == SEGMENT;
                at += length;
            }
            // The file is as long as it says; its first elements say more.
            (SEGMENT, Some(_)) if missing(end, size).is_none() => {
                whole_segment = true;
                at += length;
            }
            (CLUSTER, Some(_)) if whole_segment => {
                start = cluster_start(file, at + length)?;
                break;
            }
            (_, None) => break,
            (_, Some(contents)) => {
                if matches!(number, INFO | TRACKS) && contents <= ABOUT_MOST {
                    let mut about = Vec::new();
                    file.seek(SeekFrom::Start(at + length))?;
                    file.take(contents).read_to_end(&mut about)?;
                    if number == INFO {
                        about_end = matroska_end(&about);
                    } else {
                        alone = is_alone(&about);
                    }
                }
                known.missing_bytes = missing(end, size);
                at = end.unwrap_or(size);
            }
        }
    }
    // A track of sound may last longer than the pictures. A recording that was cut out of another one does not begin at 0.
    known.end_s = about_end.zip(start).filter(|_| alone).map(|((end, scale_s), start)| (end - start as f64) * scale_s);
    Ok(known)
}

fn mp4(file: &mut File, size: u64) -> std::io::Result<Container> {
    let mut known = Container { counts_frames: true, ..Container::UNKNOWN };
    let mut at = 0u64;
    while at.saturating_add(8) <= size {
        file.seek(SeekFrom::Start(at))?;
        let mut head = Vec::new();
        file.take(16).read_to_end(&mut head)?;
        let Some((kind, header, length)) = box_head(&head) else { break };
        let end = match length {
            Some(length) => at.checked_add(length),
            None => Some(size),
        };
        known.missing_bytes = missing(end, size);
        let Some(end) = end.filter(|end| known.missing_bytes.is_none() && *end > at) else { break };
        if &kind == b"moov" && end - at <= INDEX_MOST {
            let mut moov = Vec::new();
            file.seek(SeekFrom::Start(at + header))?;
            file.take(end - at - header).read_to_end(&mut moov)?;
            known = Container { missing_bytes: None, ..movie(&moov) };
        }
        at = end;
    }
    Ok(known)
}

/// Kind, length of the header, and length in all of the box that begins with `bytes`; the length is `None` up to the file's end. `None` if
/// this is no box.
fn box_head(bytes: &[u8]) -> Option<([u8; 4], u64, Option<u64>)> {
    let kind: [u8; 4] = bytes.get(4..8)?.try_into().ok()?;
    if !kind.iter().all(|c| c.is_ascii_graphic() || *c == b' ' || *c == 0xa9) {
        return None;
    }
    match u32_at(bytes, 0)? {
        0 => Some((kind, 8, None)),
        1 => Some((kind, 16, Some(u64_at(bytes, 8)?.max(16)))),
        length => Some((kind, 8, (length >= 8).then_some(u64::from(length)))).filter(|_| length >= 8),
    }
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_be_bytes(bytes.get(at..at.checked_add(4)?)?.try_into().ok()?))
}

fn u64_at(bytes: &[u8], at: usize) -> Option<u64> {
    Some(u64::from(u32_at(bytes, at)?) << 32 | u64::from(u32_at(bytes, at + 4)?))
}

/// The boxes in `bytes`: kind and contents.
fn boxes(mut bytes: &[u8]) -> impl Iterator<Item = ([u8; 4], &[u8])> {
    std::iter::from_fn(move || {
        let (kind, header, length) = box_head(bytes)?;
        let length = length.map_or(bytes.len(), |l| usize::try_from(l).unwrap_or(usize::MAX).min(bytes.len()));
        let contents = bytes.get(header as usize..length)?;
        bytes = &bytes[length..];
        Some((kind, contents))
    })
}

/// The contents of the box at the end of `path`, each in the one before.
fn inside<'a>(bytes: &'a [u8], path: &[&[u8; 4]]) -> Option<&'a [u8]> {
    path.iter().try_fold(bytes, |bytes, kind| boxes(bytes).find(|(k, _)| k == *kind).map(|(_, contents)| contents))
}

/// A header box's time scale (units a second) and duration, of which the second is `None` where it is not known.
fn scale_and_duration(header: &[u8]) -> Option<(f64, Option<u64>)> {
    let (scale, duration) = match header.first()? {
        0 => (u32_at(header, 12)?, u32_at(header, 16).filter(|d| *d != u32::MAX).map(u64::from)),
        _ => (u32_at(header, 20)?, u64_at(header, 24).filter(|d| *d != u64::MAX)),
    };
    (scale > 0).then_some((f64::from(scale), duration.filter(|d| *d > 0)))
}

/// What the index of an MP4 file says of its first video track.
fn movie(moov: &[u8]) -> Container {
    let mut known = Container { counts_frames: true, ..Container::UNKNOWN };
    let is_video = |trak: &&[u8]| inside(trak, &[b"mdia", b"hdlr"]).is_some_and(|h| h.get(8..12) == Some(b"vide"));
    let Some(track) = boxes(moov).filter(|(kind, _)| kind == b"trak").map(|(_, trak)| trak).find(is_video) else { return known };
    if let Some(header) = inside(track, &[b"tkhd"]) {
        let wide = header.first().is_some_and(|v| *v > 0);
        let matrix = if wide { 52 } else { 40 };
        let number = |i: usize| u32_at(header, matrix + 4 * i).map(|v| f64::from(v as i32));
        if let (Some(a), Some(b), Some(c), Some(d)) = (number(0), number(1), number(3), number(4)) {
            known.turn = Some(Turn::of_matrix([a, b, c, d]));
        }
        let scale = inside(moov, &[b"mvhd"]).and_then(scale_and_duration).map(|(scale, _)| scale);
        let duration =
            if wide { u64_at(header, 28).filter(|d| *d != u64::MAX) } else { u32_at(header, 20).filter(|d| *d != u32::MAX).map(u64::from) };
        known.end_s = scale.zip(duration.filter(|d| *d > 0)).map(|(scale, duration)| duration as f64 / scale);
    }
    (known.rhythm, known.index_ms) = (rhythm(track), index_ms(track).unwrap_or_default());
    // In a file of fragments the index holds no pictures, and the length stands elsewhere, if anywhere.
    if let Some(fragments) = inside(moov, &[b"mvex"]) {
        let alone = boxes(moov).filter(|(kind, _)| kind == b"trak").count() == 1;
        let scale = inside(moov, &[b"mvhd"]).and_then(scale_and_duration).map(|(scale, _)| scale);
        let duration = inside(fragments, &[b"mehd"]).and_then(|header| match header.first()? {
            0 => u32_at(header, 4).map(u64::from),
            _ => u64_at(header, 4),
        });
        let told_s = scale.zip(duration.filter(|d| *d > 0 && alone)).map(|(scale, duration)| duration as f64 / scale);
        // The track's own duration may be that of the first fragment alone.
        known = Container { counts_frames: false, end_s: told_s, open_end: told_s.is_none(), index_ms: Vec::new(), ..known };
    }
    known
}

/// The rhythm of a track by its index: so many pictures, and how long each is shown.
fn rhythm(track: &[u8]) -> Option<Rhythm> {
    let (scale, _) = inside(track, &[b"mdia", b"mdhd"]).and_then(scale_and_duration)?;
    let times = inside(track, &[b"mdia", b"minf", b"stbl", b"stts"])?;
    let entry = |i: usize| Some((u64::from(u32_at(times, 8 + 8 * i)?), 1e3 * f64::from(u32_at(times, 12 + 8 * i)?) / scale));
    let mut steps: Vec<(u64, f64)> = (0..u32_at(times, 4)? as usize).map_while(entry).collect();
    // No picture follows the last one.
    if let Some((count, _)) = steps.last_mut() {
        *count = count.saturating_sub(1);
    }
    Rhythm::of(&steps)
}

/// When a track's pictures are shown, by its index; `None` also where its edit list has more than one part.
fn index_ms(track: &[u8]) -> Option<Vec<f64>> {
    let (scale, _) = inside(track, &[b"mdia", b"mdhd"]).and_then(scale_and_duration)?;
    let tables = inside(track, &[b"mdia", b"minf", b"stbl"])?;
    let each = |kind| {
        let runs = inside(tables, &[kind]).unwrap_or_default();
        let run = move |i: usize| Some((u32_at(runs, 8 + 8 * i)?, u32_at(runs, 12 + 8 * i)?));
        (0..u32_at(runs, 4).unwrap_or(0) as usize).map_while(run).flat_map(|(count, value)| std::iter::repeat_n(value, count as usize))
    };
    // Each is decoded so long after the one before, and shown so much later.
    let later = each(b"ctts").map(|units| i64::from(units as i32)).chain(std::iter::repeat(0));
    let decoded = each(b"stts").take(PICTURES_MOST + 1).scan(0, |at, step| Some(std::mem::replace(at, *at + i64::from(step))));
    let mut shown: Vec<i64> = decoded.zip(later).map(|(at, later)| at + later).collect();
    shown.sort_unstable();
    let edits = inside(track, &[b"edts", b"elst"]).unwrap_or_default();
    let long = |i: usize| Some(u64_at(edits, 16 + 20 * i)? as i64);
    let edit = |i: usize| if edits[0] > 0 { long(i) } else { Some(i64::from(u32_at(edits, 12 + 12 * i)? as i32)) };
    // A negative one is a pause before the first picture.
    let mut begins = (0..u32_at(edits, 4).unwrap_or(0) as usize).map_while(edit).filter(|at| *at >= 0);
    let begin = begins.next().unwrap_or(i64::MIN);
    let shown = shown.get(shown.partition_point(|at| *at < begin)..).filter(|_| begins.next().is_none() && shown.len() <= PICTURES_MOST)?;
    Some(shown.iter().map(|at| (at - shown[0]) as f64 * 1e3 / scale).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng as _, RngExt as _};

    /// Protects the commands from files that others made: whatever the sizes in them say, reading ends, and never in a panic.
    #[test]
    fn any_bytes_are_survived() {
        let file = tempfile::NamedTempFile::new().expect("a file");
        let mut random = rand_pcg::Pcg32::new(1, 1);
        let boxed = |kind: &[u8], inner: &[u8]| [&(inner.len() as u32 + 8).to_be_bytes(), kind, inner].concat();
        let mut track = boxed(b"tkhd", &[0; 84]);
        let run = |kind: &[u8], count: u8, value: u8| boxed(kind, &[0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, count, 0, 0, 0, value]);
        // The first is decoded first, shown third, and cut out with the first that is shown.
        let times = [run(b"stts", 5, 5), run(b"ctts", 1, 11)].concat();
        track.extend(boxed(b"edts", &boxed(b"elst", &[0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 9, 0, 0, 0, 6, 0, 1, 0, 0])));
        let media =
            [boxed(b"mdhd", &[7; 24]), boxed(b"hdlr", b"\0\0\0\0\0\0\0\0vide\0\0\0\0"), boxed(b"minf", &boxed(b"stbl", &times))].concat();
        track.extend(boxed(b"mdia", &media));
        let movie = boxed(b"moov", &[boxed(b"mvhd", &[1; 100]), boxed(b"trak", &track)].concat());
        let mp4 = [boxed(b"ftyp", b"isom\0\0\0\0"), movie, boxed(b"mdat", &[0; 64])].concat();
        let avi = [&b"RIFF"[..], &200u32.to_le_bytes(), b"AVI ", &[0; 200]].concat();
        let mkv = [&[0x1a, 0x45, 0xdf, 0xa3, 0x84, 1, 2, 3, 4, 0x18, 0x53, 0x80, 0x67, 0x10, 0, 1, 0][..], &[0; 200]].concat();
        let live = [&mkv[..13], &[0xff, 0x1f, 0x43, 0xb6, 0x75, 0xff, 0xa3, 0x85, 1, 2, 3, 4, 5], &[0xec, 0x81, 7].repeat(50)].concat();
        let whole = read_in(&mp4, file.path());
        let shown_ms = [0.0, 1.0, 5.0, 10.0].map(|units| units * 1e3 / f64::from(0x0707_0707)).to_vec();
        assert_eq!((whole.rhythm.is_some(), whole.index_ms), (true, shown_ms));
        for seed in [mp4, avi, mkv, live] {
            for _ in 0..3000 {
                let mut bytes = seed.clone();
                for _ in 0..random.random_range(1..5) {
                    let at = random.random_range(0..bytes.len());
                    bytes[at] = [0, 1, 0xff, 0x7f, random.next_u32() as u8][random.random_range(0..5)];
                }
                bytes.truncate(random.random_range(0..=bytes.len()));
                read_in(&bytes, file.path());
            }
        }
    }

    fn read_in(bytes: &[u8], file: &Path) -> Container {
        std::fs::write(file, bytes).expect("written");
        Container::read(file).expect("read")
    }
}
