//! Whether the pixels of a JPEG are whole: its Huffman codes are walked through and must add up to the blocks of a picture of its size.
//!
//! OpenCV's decoder makes a picture of what is damaged too, and says nothing, and so does zune-jpeg 0.5 in its strict mode for most of what the tests
//! below damage. No rule about single bytes would tell it: with tables that are
//! made for the picture, an even ground may be a long run of zero bytes. Walked are the sequential and the progressive Huffman codes of ITU-T T.81, with
//! its standard tables where a picture has none; arithmetic and lossless codes, which OpenCV hardly reads, are judged by their end alone. Damage that keeps the number of codes, as in the low bits of a
//! coefficient, cannot be told. For commands that read files and for the worker when it plays pictures, on their own thread; allocates eight
//! bytes a block. Any bytes are survived: what does not fit is [`DAMAGED`].

use super::jpeg_codes::{Bits, CUT, DAMAGED, Stop, Table, Tables, marker};

/// The most blocks of a component that are walked through: those of the largest picture that is read, 4096 x 4096 px, and as many again for filling up.
const BLOCKS_MAX: usize = 1 << 19;
/// The most components of a picture (ITU-T T.81, B.2.3, for a scan); cameras have 1 or 3, and printers 4.
const COMPONENTS_MOST: usize = 4;
/// The most blocks that are walked through in all scans together. Chosen by hand: a picture has about ten scans, and this is 16 times the largest picture of all its
/// components.
const WALKED_MOST: usize = 16 * COMPONENTS_MOST * BLOCKS_MAX;

/// A component: brightness, or a colour.
struct Component {
    id: u8,
    /// Blocks of it in one unit of several components, across and down.
    across: usize,
    down: usize,
    /// Blocks that it has by itself, across and down.
    own: [usize; 2],
    /// Blocks in a row, those that fill the last unit up too.
    row: usize,
    /// Which coefficients of each block are not zero so far, a bit each; only of a progressive picture.
    set: Vec<u64>,
    seen: bool,
}

/// What a frame header says.
struct Picture {
    progressive: bool,
    /// Units of all components together, across and down.
    units: [usize; 2],
    components: Vec<Component>,
}

impl Picture {
    fn of(marker: u8, header: &[u8]) -> Result<Self, Stop> {
        let [8, h1, h0, w1, w0, count, parts @ ..] = header else { return Err(Stop::Unjudged) };
        let size = [usize::from(*w1) << 8 | usize::from(*w0), usize::from(*h1) << 8 | usize::from(*h0)];
        if usize::from(*count) > COMPONENTS_MOST {
            return Err(Stop::Fault(DAMAGED));
        }
        let parts: Vec<&[u8]> = parts.chunks_exact(3).take(usize::from(*count)).collect();
        let samples = |part: &[u8]| [usize::from(part[1] >> 4), usize::from(part[1] & 15)];
        let largest = parts.iter().fold([0, 0], |most: [usize; 2], part| [0, 1].map(|i| most[i].max(samples(part)[i])));
        if size.contains(&0)
            || parts.len() != usize::from(*count)
            || parts.iter().any(|part| samples(part).contains(&0))
            || parts.is_empty()
        {
            return Err(Stop::Unjudged);
        }
        let units = [0, 1].map(|i| size[i].div_ceil(8 * largest[i]));
        let progressive = marker == 0xc2;
        let component = |part: &&[u8]| {
            let [across, down] = samples(part);
            let own = [0, 1].map(|i| (size[i] * samples(part)[i]).div_ceil(largest[i]).div_ceil(8));
            let (row, rows) = (units[0] * across, units[1] * down);
            let set = if progressive && row * rows <= BLOCKS_MAX { vec![0; row * rows] } else { Vec::new() };
            (row * rows <= BLOCKS_MAX).then_some(Component { id: part[0], across, down, own, row, set, seen: false })
        };
        let components = parts.iter().map(component).collect::<Option<Vec<_>>>().ok_or(Stop::Unjudged)?;
        Ok(Self { progressive, units, components })
    }
}

/// What is known behind the headers so far.
struct Walk {
    picture: Option<Picture>,
    tables: Tables,
    /// Units from one restart to the next; 0 if there is none.
    interval: usize,
    /// Blocks of all scans so far.
    walked: usize,
}

/// What one scan tells.
struct Scan<'a> {
    /// First and last coefficient.
    band: [u8; 2],
    refines: bool,
    progressive: bool,
    /// Blocks that end before the band does, still to come.
    ended: u32,
    bits: Bits<'a>,
}

impl Scan<'_> {
    /// Walks through one block. `set` is what is known of it if the picture is progressive.
    fn block(&mut self, means: Option<&Table>, others: Option<&Table>, set: &mut u64) -> Result<(), Stop> {
        let mut first = self.band[0];
        if first == 0 {
            if self.refines {
                return self.bits.bit().map(drop);
            }
            let length = self.bits.value(means.ok_or(Stop::Fault(DAMAGED))?)?;
            self.bits.bits(length.min(16))?;
            first = 1;
        }
        if self.progressive && self.band[1] == 0 {
            return Ok(());
        }
        let table = others.ok_or(Stop::Fault(DAMAGED))?;
        if self.refines { self.refine(first, table, set) } else { self.coefficients(first, table, set) }
    }

    /// Coefficients from `first` on, whose values come for the first time.
    fn coefficients(&mut self, first: u8, table: &Table, set: &mut u64) -> Result<(), Stop> {
        if self.ended > 0 {
            self.ended -= 1;
            return Ok(());
        }
        let mut at = first;
        while at <= self.band[1] {
            let value = self.bits.value(table)?;
            let (zeros, length) = (value >> 4, value & 15);
            if length == 0 && zeros < 15 {
                // In a sequential picture the end of a block is that of one block.
                self.ended = if self.progressive { (1 << zeros) + self.bits.bits(zeros)? - 1 } else { 0 };
                return Ok(());
            }
            at += zeros;
            if at > self.band[1] {
                return Err(Stop::Fault(DAMAGED));
            }
            self.bits.bits(length)?;
            *set |= u64::from(length > 0) << at;
            at += 1;
        }
        Ok(())
    }

    /// Coefficients from `first` on, which become more exact: each that is not zero has a bit, and others become so.
    fn refine(&mut self, first: u8, table: &Table, set: &mut u64) -> Result<(), Stop> {
        let last = self.band[1];
        let mut at = first;
        while self.ended == 0 && at <= last {
            let value = self.bits.value(table)?;
            let (mut zeros, length) = (value >> 4, value & 15);
            match length {
                0 if zeros < 15 => {
                    self.ended = (1 << zeros) + self.bits.bits(zeros)?;
                    break;
                }
                0 => {}
                1 => {
                    self.bits.bit()?;
                }
                _ => return Err(Stop::Fault(DAMAGED)),
            }
            while at <= last {
                if *set >> at & 1 == 1 {
                    self.bits.bit()?;
                } else if zeros == 0 {
                    break;
                } else {
                    zeros -= 1;
                }
                at += 1;
            }
            if at > last && length > 0 {
                return Err(Stop::Fault(DAMAGED));
            }
            *set |= u64::from(length) << at.min(63);
            at += 1;
        }
        if self.ended > 0 {
            self.bits.bits((at..=last).filter(|at| *set >> at & 1 == 1).count() as u8)?;
            self.ended -= 1;
        }
        Ok(())
    }
}

impl Walk {
    /// Walks through the scan whose header has these contents and whose pixels begin at `at`. Returns where the next marker is.
    fn scan(&mut self, header: &[u8], bytes: &[u8], at: usize) -> Result<usize, Stop> {
        let picture = self.picture.as_mut().ok_or(Stop::Fault(DAMAGED))?;
        let count = usize::from(*header.first().ok_or(Stop::Fault(DAMAGED))?);
        let (Some(parts), Some([first, last, exactness])) = (header.get(1..1 + 2 * count), header.get(1 + 2 * count..4 + 2 * count)) else {
            return Err(Stop::Fault(DAMAGED));
        };
        let band = if picture.progressive { [*first, *last] } else { [0, 63] };
        if band[1] > 63
            || band[0] > band[1]
            || !(1..=COMPONENTS_MOST).contains(&count)
            || (picture.progressive && band[0] == 0 && band[1] > 0)
        {
            return Err(Stop::Fault(DAMAGED));
        }
        let refines = picture.progressive && exactness >> 4 > 0;
        let mut scan = Scan { band, refines, progressive: picture.progressive, ended: 0, bits: Bits::new(bytes, at) };
        let places: Vec<(usize, [usize; 2])> = parts
            .chunks_exact(2)
            .map(|part| {
                let place = picture.components.iter().position(|component| component.id == part[0]);
                place.map(|place| (place, [usize::from(part[1] >> 4), usize::from(part[1] & 15)]))
            })
            .collect::<Option<_>>()
            .ok_or(Stop::Fault(DAMAGED))?;
        // One component alone has its own blocks one by one, and several have units of some blocks of each.
        let alone = count == 1;
        let units = if alone { picture.components[places[0].0].own } else { picture.units };
        let blocks = |place: usize| if alone { 1 } else { picture.components[place].across * picture.components[place].down };
        self.walked += units[0] * units[1] * places.iter().map(|(place, _)| blocks(*place)).sum::<usize>();
        if self.walked > WALKED_MOST {
            return Err(Stop::Fault(DAMAGED));
        }
        for unit in 0..units[0] * units[1] {
            if self.interval > 0 && unit > 0 && unit % self.interval == 0 {
                scan.ended = 0;
                scan.bits.restart(unit / self.interval - 1)?;
            }
            let (x, y) = (unit % units[0], unit / units[0]);
            for (place, [means, others]) in &places {
                let component = &mut picture.components[*place];
                component.seen = true;
                let (across, down) = if alone { (1, 1) } else { (component.across, component.down) };
                let tables = (self.tables.at(0, *means), self.tables.at(1, *others));
                for block in 0..across * down {
                    let place = (y * down + block / across) * component.row + x * across + block % across;
                    let mut none = 0;
                    scan.block(tables.0, tables.1, component.set.get_mut(place).unwrap_or(&mut none))?;
                }
            }
        }
        // Some encoders write a restart behind the last interval too.
        if let Some(before) = (units[0] * units[1] - 1).checked_div(self.interval) {
            let _ = scan.bits.restart(before);
        }
        Ok(scan.bits.at)
    }
}

/// The EXIF data in a JPEG's header, if there are any; the error says how its pixels are not whole.
pub(super) fn judge(bytes: &[u8]) -> Result<Option<&[u8]>, &'static str> {
    let mut exif = None;
    let (mut walk, mut at) = (Walk { picture: None, tables: Tables::standard(), interval: 0, walked: 0 }, 2);
    loop {
        let (number, behind) = marker(bytes, at)?;
        at = behind;
        match number {
            0x01 => continue,
            // No restart is due here.
            0xd0..=0xd7 => return Err(DAMAGED),
            0xd9 => {
                let all = walk.picture.is_some_and(|picture| picture.components.iter().all(|component| component.seen));
                return if all { Ok(exif) } else { Err(DAMAGED) };
            }
            _ => {}
        }
        let Some([high, low]) = bytes.get(at..at + 2) else { return Err(CUT) };
        let end = at + usize::from(*high) * 256 + usize::from(*low);
        let Some(contents) = bytes.get(at + 2..end) else { return Err(if end < at + 2 { DAMAGED } else { CUT }) };
        let done = match number {
            0xc0..=0xc2 if walk.picture.is_some() => Err(Stop::Fault(DAMAGED)),
            0xc0..=0xc2 => Picture::of(number, contents).map(|picture| walk.picture = Some(picture)),
            0xc4 => walk.tables.take(contents),
            0xdd => {
                walk.interval = contents.iter().take(2).fold(0, |value, byte| value << 8 | usize::from(*byte));
                Ok(())
            }
            0xda => walk.scan(contents, bytes, end).map(|next| at = next),
            0xc3 | 0xc5..=0xc7 | 0xc9..=0xcb | 0xcd..=0xcf => Err(Stop::Unjudged),
            0xe1 => {
                exif = exif.or(contents.strip_prefix(b"Exif\0\0"));
                Ok(())
            }
            0xc8 | 0xcc | 0xd8 | 0xdb..=0xe0 | 0xe2..=0xef | 0xfe => Ok(()),
            _ => Err(Stop::Fault(DAMAGED)),
        };
        match done {
            Ok(()) if number == 0xda => {}
            Ok(()) => at = end,
            Err(Stop::Fault(fault)) => return Err(fault),
            // In pixels 0xff is never followed by the end marker's byte by chance.
            Err(Stop::Unjudged) => return if bytes[end..].windows(2).any(|w| w == [0xff, 0xd9]) { Ok(exif) } else { Err(CUT) },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use opencv::core::{self, Mat, Vector};
    use opencv::prelude::*;
    use opencv::{imgcodecs, imgproc};
    use rand::{Rng as _, RngExt as _};

    /// Pictures of all kinds that OpenCV's encoder writes: in colour and grey, sequential and progressive, with tables of their own, with restarts, and of sizes
    /// that fill no whole block.
    fn encoded() -> Vec<(String, Vec<u8>)> {
        let mut all = Vec::new();
        for (width, height) in [(160, 120), (201, 77), (7, 5)] {
            let mut picture = Mat::new_rows_cols_with_default(height, width, core::CV_8UC3, core::Scalar::all(120.0)).expect("made");
            core::set_rng_seed(width).expect("set");
            core::randn(&mut picture, &core::Scalar::all(120.0), &core::Scalar::new(30.0, 60.0, 90.0, 0.0)).expect("drawn");
            let mut soft = Mat::default();
            imgproc::gaussian_blur_def(&picture, &mut soft, core::Size::new(0, 0), 2.0).expect("blurred");
            imgproc::rectangle_def(&mut soft, core::Rect::new(2, 2, width / 2, height / 2), core::Scalar::all(250.0)).expect("drawn");
            let mut grey = Mat::default();
            imgproc::cvt_color_def(&soft, &mut grey, imgproc::COLOR_BGR2GRAY).expect("grey");
            for (picture, colours) in [(&soft, "colour"), (&grey, "grey")] {
                for (progressive, optimised, restarts) in [(0, 0, 0), (0, 1, 0), (1, 0, 0), (1, 1, 0), (0, 0, 3), (1, 0, 5), (0, 1, 1)] {
                    let flags = Vector::from_slice(&[
                        imgcodecs::IMWRITE_JPEG_QUALITY,
                        85,
                        imgcodecs::IMWRITE_JPEG_PROGRESSIVE,
                        progressive,
                        imgcodecs::IMWRITE_JPEG_OPTIMIZE,
                        optimised,
                        imgcodecs::IMWRITE_JPEG_RST_INTERVAL,
                        restarts,
                    ]);
                    let mut bytes = Vector::new();
                    imgcodecs::imencode(".jpg", picture, &mut bytes, &flags).expect("encoded");
                    all.push((format!("{width} x {height} {colours} {progressive} {optimised} {restarts}"), bytes.to_vec()));
                }
            }
        }
        all
    }

    /// Where the first scan's pixels begin.
    fn pixels(bytes: &[u8]) -> usize {
        let header = bytes.windows(2).position(|w| w == [0xff, 0xda]).expect("a scan");
        header + 2 + usize::from(bytes[header + 2]) * 256 + usize::from(bytes[header + 3])
    }

    /// Protects whole pictures from a refusal, and measurements from damaged ones: each kind of JPEG adds up, and none of which a part was overwritten,
    /// taken out, or doubled does.
    #[test]
    fn whole_pictures_add_up_and_damaged_ones_do_not() {
        for (name, whole) in encoded() {
            assert!(judge(&whole).is_ok(), "{name}: {:?}", judge(&whole));
            assert_eq!(judge(&whole[..whole.len() - 2]), Err(CUT), "{name}");
            let (begin, end) = (pixels(&whole), whole.len() - 2);
            if end - begin < 600 {
                continue;
            }
            let middle = begin + (end - begin) / 2;
            for (byte, length) in [(0, 256), (0xff, 40), (0x55, 256)] {
                let mut damaged = whole.clone();
                damaged[middle..middle + length].fill(byte);
                assert!(judge(&damaged).is_err(), "{name}: {length} times {byte}");
            }
            let gone = [&whole[..middle], &whole[middle + 200..]].concat();
            let twice = [&whole[..middle + 200], &whole[middle..]].concat();
            assert!(judge(&gone).is_err() && judge(&twice).is_err(), "{name}");
        }
    }

    /// Where the markers with one of these numbers begin.
    fn markers(bytes: &[u8], wanted: std::ops::RangeInclusive<u8>) -> Vec<usize> {
        (0..bytes.len() - 1).filter(|at| bytes[*at] == 0xff && wanted.contains(&bytes[at + 1])).collect()
    }

    /// Protects the pictures of common webcams, which leave some bytes before a restart, the end or a header and are decoded well. A restart that is not the next in turn,
    /// and one that is not due, are damage all the same.
    #[test]
    fn stray_bytes_before_a_marker_are_no_damage() {
        let stray = [&[0x5a; 9][..], &[0; 9], &[0xff, 0, 0x12, 0xff, 0, 0xff, 0, 0xff, 0]];
        for (name, whole) in encoded() {
            let restarts: Vec<usize> = markers(&whole[pixels(&whole)..], 0xd0..=0xd7).iter().map(|at| at + pixels(&whole)).collect();
            let headers = [markers(&whole, 0xda..=0xda)[0], whole.len() - 2];
            for at in headers.into_iter().chain(restarts.iter().take(9).copied()) {
                for (bytes, count) in stray.iter().flat_map(|bytes| (1..=9).map(move |count| (bytes, count))) {
                    // A lone 0xff is filling.
                    let with = [&whole[..at], &bytes[..count], &whole[at..]].concat();
                    assert!(judge(&with).is_ok(), "{name}: {count} of {bytes:?} at {at}: {:?}", judge(&with));
                }
                let many = [&whole[..at], &[0x5a; 60], &whole[at..]].concat();
                assert_eq!(judge(&many), Err(DAMAGED), "{name} at {at}");
            }
            for at in restarts.into_iter().take(9) {
                let mut other = whole.clone();
                other[at + 1] ^= 1;
                let twice = [&whole[..at], &whole[at..at + 2], &whole[at..]].concat();
                assert_eq!((judge(&other), judge(&twice)), (Err(DAMAGED), Err(DAMAGED)), "{name} at {at}");
            }
            let undue = [&whole[..whole.len() - 2], &[0xff, 0xd7, 0xff, 0xd3], &whole[whole.len() - 2..]].concat();
            assert_eq!(judge(&undue), Err(DAMAGED), "{name}");
        }
    }

    /// Protects frames of MJPEG, which have no Huffman tables: whole ones are taken, and damaged ones refused, as those with the tables are. One whose codes
    /// are those of a table that nobody said is damaged.
    #[test]
    fn a_picture_without_tables_has_the_standard_ones() {
        for (name, whole) in encoded().into_iter().filter(|(name, _)| name.contains(" 0 0 ")) {
            let mut bare = whole;
            while let Some(at) = markers(&bare, 0xc4..=0xc4).first().copied() {
                bare.drain(at..at + 2 + usize::from(bare[at + 3]) + 256 * usize::from(bare[at + 2]));
            }
            assert!(judge(&bare).is_ok(), "{name}: {:?}", judge(&bare));
            let read = imgcodecs::imdecode(&Vector::from_slice(&bare), imgcodecs::IMREAD_COLOR).expect("read");
            assert!(!read.empty(), "{name}: OpenCV reads it too");
            let mut elsewhere = bare.clone();
            // The first component's tables.
            let scan = markers(&bare, 0xda..=0xda)[0];
            elsewhere[scan + 6] = 0x22;
            assert_eq!(judge(&elsewhere), Err(DAMAGED), "{name}");
            let (begin, end) = (pixels(&bare), bare.len() - 2);
            if end - begin > 600 {
                bare[begin + (end - begin) / 2..][..256].fill(0x55);
                assert_eq!(judge(&bare), Err(DAMAGED), "{name}");
            }
        }
    }

    /// Protects the commands from files that take hours or gigabytes: a second frame, more components than a picture has, and more blocks in all scans together than
    /// encoders write are damage.
    #[test]
    fn more_than_any_picture_has_is_refused() {
        let header = |number: u8, contents: &[u8]| [&[0xff, number, 0, contents.len() as u8 + 2][..], contents].concat();
        let frame = |side_px: u16, parts: u8| {
            let [high, low] = side_px.to_be_bytes();
            let parts_of = (1..=parts).flat_map(|id| [id, 0x11, 0]).collect::<Vec<_>>();
            header(0xc2, &[&[8, high, low, high, low, parts][..], &parts_of].concat())
        };
        let scan = |parts: u8, band: [u8; 2]| {
            let parts_of = (1..=parts).flat_map(|id| [id, 0]).collect::<Vec<_>>();
            header(0xda, &[&[parts][..], &parts_of, &[band[0], band[1], 0]].concat())
        };
        let picture = |parts: &[Vec<u8>]| [&[0xff, 0xd8][..], &parts.concat(), &[0xff, 0xd9]].concat();
        // The first code of the standard table of means, 00, is a mean of no length: 8 x 8 px of up to 4 components are a byte.
        for parts in [1, 3, 4] {
            assert!(judge(&picture(&[frame(8, parts), scan(parts, [0, 0]), vec![0]])).is_ok(), "{parts}");
        }
        assert_eq!(judge(&picture(&[frame(8, 5), scan(4, [0, 0]), vec![0]])), Err(DAMAGED), "five components");
        assert_eq!(judge(&picture(&[frame(8, 1), scan(1, [0, 0]), vec![0], frame(8, 1)])), Err(DAMAGED), "two frames");
        assert_eq!(
            judge(&picture(&[frame(8, 1), [scan(1, [0, 0]), vec![0]].concat(), header(0xda, &[5, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 0, 0, 0])])),
            Err(DAMAGED)
        );
        // A table with one code: 16384 blocks that end, and as many more as 14 bits say. 4096 x 4096 px have 16 times as many.
        let ends = header(0xc4, &[&[0x10, 1][..], &[0; 15], &[0xe0]].concat());
        let pass = [scan(1, [1, 63]), vec![0; 16 * 15 / 8]].concat();
        let scans = |count: usize| picture(&[frame(4096, 1), scan(1, [0, 0]), vec![0; (1 << 18) / 4], ends.clone(), pass.repeat(count)]);
        assert_eq!((judge(&scans(100)).is_ok(), judge(&scans(200))), (true, Err(DAMAGED)));
    }

    /// Protects the commands from files that others made: whatever is in them, the walk ends, and never in a panic.
    #[test]
    fn any_bytes_are_survived() {
        let mut random = rand_pcg::Pcg32::new(1, 1);
        for (_, whole) in encoded() {
            for _ in 0..100 {
                let mut bytes = whole.clone();
                for _ in 0..random.random_range(1..6) {
                    let at = random.random_range(0..bytes.len());
                    bytes[at] = [0, 1, 0xff, 0x7f, random.next_u32() as u8][random.random_range(0..5)];
                }
                bytes.truncate(random.random_range(2..=bytes.len()));
                let _ = judge(&bytes);
            }
        }
    }
}
