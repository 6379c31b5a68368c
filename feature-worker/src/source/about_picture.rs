//! What the bytes of a picture file say that OpenCV leaves out: whether it is whole, how it is turned, how many pictures it holds, and what its
//! largest value is.
//!
//! Read are JPEG ([`jpeg`]), PNG, WebP, TIFF (also the directories of EXIF in the others) and the family of PNM; of other files nothing is said.
//! For commands that read files and for the worker when it plays pictures, on their own thread; allocates little. Numbers from the file are used in checked
//! arithmetic only, and what cannot be read is left to OpenCV.

use std::borrow::Cow;
use std::collections::BTreeSet;

use crc::{CRC_32_ISO_HDLC, Crc, Table};
use shared::plural::counted;

use super::container::Turn;
use super::jpeg;
use super::jpeg_codes::{CUT, DAMAGED};

/// The checksum of PNG's chunks (its specification, 5.5).
const PNG_CHECKSUM: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CRC_32_ISO_HDLC);
/// TIFF's tag of how a picture is turned, which EXIF has too (TIFF 6.0, Orientation).
const ORIENTATION: u16 = 274;
/// TIFF's tag of what a picture is for (TIFF 6.0, NewSubfileType): bit 0 says that it is smaller, bit 2 that it is a mask.
const PURPOSE: u16 = 254;
/// The most directories of a TIFF that are looked at. Chosen by hand: five minutes of pictures in one file.
const DIRECTORIES_MOST: usize = 10_000;
/// The most entries of a directory: as many as a TIFF can say (TIFF 6.0); BigTIFF could say more.
const ENTRIES_MOST: u64 = 65_535;
/// The largest values that OpenCV itself takes for white (its file `grfmt_pxm.cpp`).
const KNOWN_WHITE: [f64; 2] = [255.0, 65535.0];

/// What there is to decode, and what to do with the picture then.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct About<'a> {
    /// The picture without what its library would remark on.
    pub bytes: Cow<'a, [u8]>,
    /// How it must be turned.
    pub turn: Turn,
    /// The value of white, where it is none that OpenCV knows.
    pub white: Option<f64>,
}

/// What a PNG says: its EXIF data, how many pictures it has, and its bytes without remarks.
type Png<'a> = (Option<&'a [u8]>, u64, Cow<'a, [u8]>);

/// What the picture in `bytes` says; the error says why it cannot be taken.
pub(super) fn about(bytes: &[u8]) -> Result<About<'_>, String> {
    let (mut exif, mut pictures, mut white, mut plain) = (None, 1, None, Cow::from(bytes));
    match bytes {
        [] => return Err("is empty".into()),
        [0xff, 0xd8, ..] => exif = jpeg::judge(bytes)?,
        [0x89, b'P', b'N', b'G', ..] => (exif, pictures, plain) = png(bytes)?,
        [b'R', b'I', b'F', b'F', _, _, _, _, b'W', b'E', b'B', b'P', ..] => (exif, pictures) = webp(bytes)?,
        // OpenCV turns these itself.
        [b'I', b'I', ..] | [b'M', b'M', ..] => pictures = Directories::read(bytes).map_or(1, |directories| directories.pictures()),
        [b'P', b'1'..=b'6', ..] => (pictures, white) = pnm(bytes)?,
        _ => {}
    }
    if pictures > 1 {
        let holds = counted(pictures, "picture");
        return Err(format!(
            "holds {holds}, of which only the first would be read: write each into a file of its own, and give a pattern such as frame_%04d.png"
        ));
    }
    let turned = exif.and_then(|exif| Directories::read(exif)?.value(ORIENTATION));
    Ok(About { bytes: plain, turn: turned.and_then(Turn::of_exif).unwrap_or(Turn::NONE), white })
}

/// The EXIF data of a PNG, how many pictures it has, and its bytes without chunks that pixels do not need: its library writes to the terminal what it thinks of
/// colour profiles and the like.
fn png(bytes: &[u8]) -> Result<Png<'_>, &'static str> {
    let (mut exif, mut pictures, mut at) = (None, 1, 8);
    let mut plain = bytes.get(..at).ok_or(CUT)?.to_vec();
    loop {
        let length = number(bytes, at, 4, false).ok_or(CUT)? as usize;
        let end = at + 8 + length;
        let (Some(kind), Some(contents)) = (bytes.get(at + 4..at + 8), bytes.get(at + 8..end)) else { return Err(CUT) };
        let checksum = number(bytes, end, 4, false).ok_or(CUT)?;
        // A small first letter says that the picture can be read without the chunk.
        let needed = kind[0].is_ascii_uppercase();
        if needed && u64::from(PNG_CHECKSUM.checksum(&bytes[at + 4..end])) != checksum {
            return Err(DAMAGED);
        }
        if needed || kind == b"tRNS" {
            plain.extend_from_slice(&bytes[at..end + 4]);
        }
        match kind {
            b"IEND" => return Ok((exif, pictures, plain.into())),
            b"eXIf" => exif = Some(contents),
            b"acTL" => pictures = number(contents, 0, 4, false).unwrap_or(1),
            _ => {}
        }
        at = end + 4;
    }
}

/// The EXIF data of a WebP, and how many pictures it has.
fn webp(bytes: &[u8]) -> Result<(Option<&[u8]>, u64), &'static str> {
    let (mut exif, mut pictures, mut at) = (None, 0, 12);
    // What stands behind the file's own end is none of it.
    let end = 8 + number(bytes, 4, 4, true).ok_or(CUT)? as usize;
    let bytes = bytes.get(..end).ok_or(CUT)?;
    while let (Some(kind), Some(length)) = (bytes.get(at..at + 4), number(bytes, at + 4, 4, true)) {
        let contents = bytes.get(at + 8..at + 8 + length as usize).ok_or(DAMAGED)?;
        match kind {
            // Some writers put the head of JPEG's before it.
            b"EXIF" => exif = Some(contents.strip_prefix(b"Exif\0\0").unwrap_or(contents)),
            b"ANMF" => pictures += 1,
            _ => {}
        }
        // A chunk of odd length is filled up.
        at += 8 + length as usize + length as usize % 2;
    }
    Ok((exif, pictures))
}

/// How many pictures a PNM file has, and its value of white where OpenCV does not know it.
fn pnm(bytes: &[u8]) -> Result<(u64, Option<f64>), &'static str> {
    let (mut pictures, mut rest, mut white) = (0, bytes, None);
    while let [b'P', kind @ b'1'..=b'6', after @ ..] = rest {
        let (mut header, bits) = (after, kind % 3 == 1);
        let mut next = || {
            // A comment goes on to the end of its line.
            loop {
                header = header.trim_ascii_start();
                let [b'#', comment @ ..] = header else { break };
                header = &comment[comment.iter().position(|byte| *byte == b'\n').unwrap_or(comment.len())..];
            }
            let digits = header.iter().take_while(|byte| byte.is_ascii_digit()).count();
            let value = std::str::from_utf8(&header[..digits]).ok().and_then(|text| text.parse::<u32>().ok());
            header = &header[digits..];
            value
        };
        // What is no header behind a picture is none of ours; of the first, OpenCV says so.
        let (Some(width), Some(height), Some(largest)) = (next(), next(), if bits { Some(1) } else { next() }) else { break };
        pictures += 1;
        let plain = *kind < b'4';
        // OpenCV scales the values of plain files up to 255 itself, and no others.
        let scaled = bits || largest == 0 || KNOWN_WHITE.contains(&f64::from(largest)) || (plain && largest < 256);
        white = if pictures == 1 { (!scaled).then_some(f64::from(largest)) } else { white };
        if plain {
            break;
        }
        let (width, height) = (width as usize, height as usize);
        let row = match kind {
            b'4' => width.div_ceil(8),
            b'5' => width * (1 + usize::from(largest > 255)),
            _ => width * 3 * (1 + usize::from(largest > 255)),
        };
        // One white space ends the header.
        let behind = row.checked_mul(height).and_then(|length| header.get(1..)?.get(length..));
        rest = behind.ok_or(CUT)?.trim_ascii_start();
    }
    Ok((pictures.max(1), white))
}

/// The whole number of so many bytes at `at`.
fn number(bytes: &[u8], at: usize, length: usize, little: bool) -> Option<u64> {
    let of = bytes.get(at..at.checked_add(length)?)?;
    let add = |value, byte: &u8| value << 8 | u64::from(*byte);
    Some(if little { of.iter().rev().fold(0, add) } else { of.iter().fold(0, add) })
}

/// The directories of a TIFF file, or of EXIF data.
struct Directories<'a> {
    bytes: &'a [u8],
    little: bool,
    /// Length of an offset, bytes: 4, or 8 in BigTIFF.
    wide: usize,
    /// Where the first one lies.
    first: u64,
}

impl<'a> Directories<'a> {
    fn read(bytes: &'a [u8]) -> Option<Self> {
        let little = bytes.starts_with(b"II");
        let wide = match number(bytes, 2, 2, little)? {
            42 => 4,
            43 => 8,
            _ => return None,
        };
        Some(Self { bytes, little, wide, first: number(bytes, wide, wide, little)? })
    }

    fn number(&self, at: usize, length: usize) -> Option<u64> {
        number(self.bytes, at, length, self.little)
    }

    /// Where the entries of the directory at `at` begin, how many there are, and the length of one, bytes.
    fn entries(&self, at: u64) -> Option<(usize, usize, usize)> {
        let (at, head) = (usize::try_from(at).ok()?, self.wide * self.wide / 8);
        let count = self.number(at, head).filter(|count| *count <= ENTRIES_MOST)?;
        Some((at.checked_add(head)?, count as usize, 4 + 2 * self.wide))
    }

    /// The value of the tag in the directory at `at`, if it is one whole number.
    fn value_in(&self, at: u64, tag: u16) -> Option<u64> {
        let (begin, count, length) = self.entries(at)?;
        // The entries end with the file, however many it says there are.
        let places = (0..count).map_while(|i| begin.checked_add(i.checked_mul(length)?)).take_while(|at| *at < self.bytes.len());
        let entry = { places }.find(|at| self.number(*at, 2) == Some(u64::from(tag)))?;
        // Of 1, 2, 4 or 8 bytes: BYTE, SHORT, LONG, LONG8.
        let size = match self.number(entry + 2, 2)? {
            1 => 1,
            3 => 2,
            4 => 4,
            16 => 8,
            _ => return None,
        };
        (size <= self.wide && self.number(entry + 4, self.wide)? == 1).then(|| self.number(entry + 4 + self.wide, size))?
    }

    /// The value of the tag in the first directory.
    fn value(&self, tag: u16) -> Option<u64> {
        self.value_in(self.first, tag)
    }

    /// How many pictures there are beside smaller copies and masks; the first always is one.
    fn pictures(&self) -> u64 {
        let (mut seen, mut at, mut pictures) = (BTreeSet::new(), self.first, 0);
        while at > 0 && seen.len() < DIRECTORIES_MOST && seen.insert(at) {
            let Some((begin, count, length)) = self.entries(at) else { break };
            let copy = self.value_in(at, PURPOSE).is_some_and(|purpose| purpose & 0b101 > 0);
            pictures += u64::from(seen.len() == 1 || !copy);
            let next = count.checked_mul(length).and_then(|all| begin.checked_add(all)).and_then(|at| self.number(at, self.wide));
            at = next.unwrap_or(0);
        }
        pictures.max(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng as _, RngExt as _};

    /// Protects whole WebP files, behind which a program left something, from a refusal, and measurements from those that are cut, also between two chunks.
    #[test]
    fn a_webp_ends_where_it_says() {
        let whole = b"RIFF\x16\0\0\0WEBPVP8 \x02\0\0\0\0\0EXIF\0\0\0\0";
        assert_eq!(webp(whole), Ok((Some(&[][..]), 0)));
        for behind in [&b"ANMF\x40\0\0\0 and more"[..], &[0; 3]] {
            assert_eq!(webp(&[whole, behind].concat()), Ok((Some(&[][..]), 0)), "{behind:?}");
        }
        // The last chunk begins at byte 22.
        (12..whole.len()).for_each(|length| assert_eq!(webp(&whole[..length]), Err(CUT), "{length}"));
        let mut longer = *whole;
        longer[26] = 1;
        assert_eq!(webp(&longer), Err(DAMAGED));
    }

    /// Protects the commands from files that take hours: a chain of directories, and the entries of one, have a bound.
    #[test]
    fn a_tiff_without_end_is_left() {
        // Each directory has no entry, and the next one lies behind it.
        let mut chain = b"II*\0\x08\0\0\0".to_vec();
        (0..30_000u32).for_each(|i| chain.extend([&[0, 0][..], &(8 + 6 * (i + 1)).to_le_bytes()].concat()));
        assert_eq!(Directories::read(&chain).map(|all| all.pictures()), Some(DIRECTORIES_MOST as u64));
        for (count, pictures, turn) in [(ENTRIES_MOST, 2, Some(6)), (ENTRIES_MOST + 1, 1, None)] {
            let entry = [&b"\x12\x01\x03\0"[..], &1u64.to_le_bytes(), &[6, 0, 0, 0, 0, 0, 0, 0]].concat();
            let head = [&b"II\x2b\0\x08\0\0\0"[..], &16u64.to_le_bytes(), &count.to_le_bytes()].concat();
            let bytes = [head, entry.repeat(count as usize), (32 + 20 * count).to_le_bytes().to_vec(), vec![0; 16]].concat();
            let all = Directories::read(&bytes).expect("a TIFF");
            assert_eq!((all.pictures(), all.value(ORIENTATION)), (pictures, turn), "{count}");
        }
    }

    /// Protects the commands from files that others made: whatever the numbers in them say, reading ends, and never in a panic.
    #[test]
    fn any_bytes_are_survived() {
        let tiff = b"II*\0\x08\0\0\0\x02\0\xfe\0\x04\0\x01\0\0\0\0\0\0\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\x26\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x01\0\0\0\0\0\0\0";
        let wide = [
            &b"MM\0\x2b\0\x08\0\0"[..],
            &16u64.to_be_bytes(),
            &1u64.to_be_bytes(),
            b"\x01\x12\0\x03",
            &1u64.to_be_bytes(),
            &[0, 6],
            &[0; 14],
        ]
        .concat();
        let webp = [&b"RIFF\x26\0\0\0WEBPEXIF\x10\0\0\0"[..], &tiff[..16], b"ANMF\x02\0\0\0\0\0"].concat();
        let png =
            [&b"\x89PNG\r\n\x1a\n"[..], &16u32.to_be_bytes(), b"eXIf", &tiff[..16], &[0; 4], &[0; 4], b"IEND", &[0xae, 0x42, 0x60, 0x82]]
                .concat();
        let pnm = b"P5 # two\n2 2\n1023\n12345678P5 2 2 255 1234".to_vec();
        let sure = |bytes: &[u8]| Directories::read(bytes).map(|all| (all.value(ORIENTATION), all.pictures()));
        assert_eq!((sure(tiff), sure(&wide)), (Some((Some(6), 2)), Some((Some(6), 1))), "the whole files are read");
        assert!(about(&pnm).is_err_and(|what| what.starts_with("holds 2 pictures")));
        assert!(about(&png).is_ok() && about(&webp).is_ok(), "{:?} {:?}", about(&png), about(&webp));
        let mut random = rand_pcg::Pcg32::new(1, 1);
        for whole in [tiff.to_vec(), wide, webp, png, pnm] {
            for _ in 0..3000 {
                let mut bytes = whole.clone();
                for _ in 0..random.random_range(1..5) {
                    let at = random.random_range(0..bytes.len());
                    bytes[at] = [0, 1, 0xff, 0x7f, random.next_u32() as u8][random.random_range(0..5)];
                }
                bytes.truncate(random.random_range(0..=bytes.len()));
                let _ = about(&bytes);
            }
        }
    }
}
