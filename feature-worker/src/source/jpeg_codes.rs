//! The Huffman codes of a JPEG: the tables that say them, the bits of a scan, and the markers between.
//!
//! For [`super::jpeg`] alone, on its caller's thread; allocates the values of the tables. Any bytes are survived: what does not fit is [`DAMAGED`].

/// What is said of a picture that ends too early.
pub(super) const CUT: &str = "the picture is cut off";
/// What is said of a picture whose data cannot be right.
pub(super) const DAMAGED: &str = "the picture is damaged: its data do not add up";
/// The most bytes before a marker that are passed over. Chosen by hand: webcams (Logitech's C270, C310 and C910) leave 1 to 9, and hardware fills up to whole
/// words of up to 16 bytes.
const STRAY_MOST: usize = 16;

/// The tables of pictures that have none, as frames of MJPEG: brightness and colour, of means and of other coefficients (ITU-T T.81, K.3, K.5, K.4 and K.6), as a
/// header would have them.
const STANDARD: &[u8] = b"\
    \x00\x00\x01\x05\x01\x01\x01\x01\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x01\x02\x03\x04\x05\x06\x07\x08\x09\x0a\x0b\x10\x00\x02\
    \x01\x03\x03\x02\x04\x03\x05\x05\x04\x04\x00\x00\x01\x7d\x01\x02\x03\x00\x04\x11\x05\x12\x21\x31\x41\x06\x13\x51\x61\x07\x22\x71\
    \x14\x32\x81\x91\xa1\x08\x23\x42\xb1\xc1\x15\x52\xd1\xf0\x24\x33\x62\x72\x82\x09\x0a\x16\x17\x18\x19\x1a\x25\x26\x27\x28\x29\x2a\
    \x34\x35\x36\x37\x38\x39\x3a\x43\x44\x45\x46\x47\x48\x49\x4a\x53\x54\x55\x56\x57\x58\x59\x5a\x63\x64\x65\x66\x67\x68\x69\x6a\x73\
    \x74\x75\x76\x77\x78\x79\x7a\x83\x84\x85\x86\x87\x88\x89\x8a\x92\x93\x94\x95\x96\x97\x98\x99\x9a\xa2\xa3\xa4\xa5\xa6\xa7\xa8\xa9\
    \xaa\xb2\xb3\xb4\xb5\xb6\xb7\xb8\xb9\xba\xc2\xc3\xc4\xc5\xc6\xc7\xc8\xc9\xca\xd2\xd3\xd4\xd5\xd6\xd7\xd8\xd9\xda\xe1\xe2\xe3\xe4\
    \xe5\xe6\xe7\xe8\xe9\xea\xf1\xf2\xf3\xf4\xf5\xf6\xf7\xf8\xf9\xfa\x01\x00\x03\x01\x01\x01\x01\x01\x01\x01\x01\x01\x00\x00\x00\x00\
    \x00\x00\x01\x02\x03\x04\x05\x06\x07\x08\x09\x0a\x0b\x11\x00\x02\x01\x02\x04\x04\x03\x04\x07\x05\x04\x04\x00\x01\x02\x77\x00\x01\
    \x02\x03\x11\x04\x05\x21\x31\x06\x12\x41\x51\x07\x61\x71\x13\x22\x32\x81\x08\x14\x42\x91\xa1\xb1\xc1\x09\x23\x33\x52\xf0\x15\x62\
    \x72\xd1\x0a\x16\x24\x34\xe1\x25\xf1\x17\x18\x19\x1a\x26\x27\x28\x29\x2a\x35\x36\x37\x38\x39\x3a\x43\x44\x45\x46\x47\x48\x49\x4a\
    \x53\x54\x55\x56\x57\x58\x59\x5a\x63\x64\x65\x66\x67\x68\x69\x6a\x73\x74\x75\x76\x77\x78\x79\x7a\x82\x83\x84\x85\x86\x87\x88\x89\
    \x8a\x92\x93\x94\x95\x96\x97\x98\x99\x9a\xa2\xa3\xa4\xa5\xa6\xa7\xa8\xa9\xaa\xb2\xb3\xb4\xb5\xb6\xb7\xb8\xb9\xba\xc2\xc3\xc4\xc5\
    \xc6\xc7\xc8\xc9\xca\xd2\xd3\xd4\xd5\xd6\xd7\xd8\xd9\xda\xe2\xe3\xe4\xe5\xe6\xe7\xe8\xe9\xea\xf2\xf3\xf4\xf5\xf6\xf7\xf8\xf9\xfa";

/// Why a walk ends before the picture does.
pub(super) enum Stop {
    /// With this fault.
    Fault(&'static str),
    /// The codes are of a kind that is not walked through.
    Unjudged,
}

/// The codes of a Huffman table.
pub(super) struct Table {
    /// Number of codes of each length, from 1 bit on.
    counts: [u8; 16],
    values: Vec<u8>,
}

/// Tables of means and of the other coefficients.
pub(super) struct Tables([[Option<Table>; 4]; 2]);

impl Tables {
    /// Those that hold until a header says others.
    pub(super) fn standard() -> Self {
        let mut tables = Self(Default::default());
        let _ = tables.take(STANDARD);
        tables
    }

    /// The table of this class at this place.
    pub(super) fn at(&self, class: usize, place: usize) -> Option<&Table> {
        self.0[class].get(place)?.as_ref()
    }

    /// Takes those of a header with these contents.
    pub(super) fn take(&mut self, mut contents: &[u8]) -> Result<(), Stop> {
        while let Some((head, rest)) = contents.split_first() {
            let (class, place) = (usize::from(head >> 4), usize::from(head & 15));
            let counts: [u8; 16] = rest.get(..16).and_then(|counts| counts.try_into().ok()).ok_or(Stop::Fault(DAMAGED))?;
            let length = counts.iter().map(|count| usize::from(*count)).sum::<usize>();
            let values = rest.get(16..16 + length).ok_or(Stop::Fault(DAMAGED))?.to_vec();
            let slot = self.0.get_mut(class).and_then(|tables| tables.get_mut(place)).ok_or(Stop::Fault(DAMAGED))?;
            *slot = Some(Table { counts, values });
            contents = &rest[16 + length..];
        }
        Ok(())
    }
}

/// The bits of a scan, from byte `at` on, up to the next marker.
pub(super) struct Bits<'a> {
    bytes: &'a [u8],
    pub at: usize,
    held: u8,
    left: u32,
}

impl<'a> Bits<'a> {
    pub(super) fn new(bytes: &'a [u8], at: usize) -> Self {
        Self { bytes, at, held: 0, left: 0 }
    }

    pub(super) fn bit(&mut self) -> Result<u32, Stop> {
        if self.left == 0 {
            let byte = *self.bytes.get(self.at).ok_or(Stop::Fault(CUT))?;
            // In pixels a byte 0xff has a zero behind it; with anything else it is a marker, and the codes have ended too early.
            let escaped = byte == 0xff;
            if escaped && self.bytes.get(self.at + 1) != Some(&0) {
                return Err(Stop::Fault(if self.at + 1 < self.bytes.len() { DAMAGED } else { CUT }));
            }
            self.at += 1 + usize::from(escaped);
            (self.held, self.left) = (byte, 8);
        }
        self.left -= 1;
        Ok(u32::from(self.held >> self.left) & 1)
    }

    pub(super) fn bits(&mut self, count: u8) -> Result<u32, Stop> {
        (0..count).try_fold(0, |value, _| Ok(value << 1 | self.bit()?))
    }

    /// The next value by `table`.
    pub(super) fn value(&mut self, table: &Table) -> Result<u8, Stop> {
        let (mut code, mut first, mut before) = (0, 0, 0);
        for count in table.counts.map(u32::from) {
            code = code << 1 | self.bit()?;
            if code < first + count {
                return table.values.get((before + code - first) as usize).copied().ok_or(Stop::Fault(DAMAGED));
            }
            before += count;
            first = (first + count) << 1;
        }
        Err(Stop::Fault(DAMAGED))
    }

    /// Goes on behind the marker of the restart that is due after `before` others, if it is the next marker.
    pub(super) fn restart(&mut self, before: usize) -> Result<(), Stop> {
        let (number, behind) = marker(self.bytes, self.at).map_err(Stop::Fault)?;
        // They count from 0 to 7, and again.
        if usize::from(number) != 0xd0 + before % 8 {
            return Err(Stop::Fault(DAMAGED));
        }
        (self.at, self.left) = (behind, 0);
        Ok(())
    }
}

/// The next marker's number from byte `from` on, and where what follows it begins. A few stray bytes before it are passed over, as libjpeg does.
pub(super) fn marker(bytes: &[u8], from: usize) -> Result<(u8, usize), &'static str> {
    let mut at = from;
    while at <= from + STRAY_MOST {
        // Bytes 0xff before a marker are filling, and with a zero behind them they are none.
        let fill = bytes.get(at..).unwrap_or_default().iter().take_while(|byte| **byte == 0xff).count();
        match bytes.get(at + fill) {
            None => return Err(CUT),
            Some(number) if fill > 0 && *number > 0 => return Ok((*number, at + fill + 1)),
            Some(_) => at += fill + 1,
        }
    }
    Err(DAMAGED)
}
