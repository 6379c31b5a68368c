//! Recordings in Matroska files: without a length, cut, with holes, and pieces of longer ones.

use super::{FRAMES, Outcome, find, inspect, refused, report, times, video};

/// Protects who records into a pipe, as live recorders do: a Matroska file that does not say its length is taken with a remark, and one that is
/// cut in the middle of a block is refused, whatever stands before its pictures and whether its clusters say their lengths. A long header hides
/// no length.
#[test]
fn a_recording_without_a_length_is_walked_through() -> Outcome {
    let directory = tempfile::tempdir()?;
    let path = directory.path().join("live.mkv");
    video(&path, ['m', 'p', '4', 'v'], 30.0)?;
    let whole = std::fs::read(&path)?;
    let segment = find(&whole, &[0x18, 0x53, 0x80, 0x67], 0) + 4;
    let cluster = find(&whole, &[0x1f, 0x43, 0xb6, 0x75], 0) + 4;
    let length = |at: usize| whole[at].leading_zeros() as usize + 1;
    let unknown = |bytes: &mut [u8], at: usize| {
        let length = length(at);
        bytes[at..at + length].fill(0xff);
        bytes[at] = 0xff >> (length - 1);
    };
    for clusters_too in [false, true] {
        let mut live = whole.clone();
        unknown(&mut live, segment);
        if clusters_too {
            unknown(&mut live, cluster);
        }
        std::fs::write(&path, &live)?;
        let (all, said) = report(&inspect(directory.path(), &[&path], &[])?)?;
        assert!(all["frames"] == FRAMES && said.contains("live.mkv: the file does not say its length"), "{all} {said}");
        std::fs::write(&path, &live[..live.len() * 2 / 3])?;
        refused(&inspect(directory.path(), &[&path], &[])?, &["live.mkv", "ends after frame", "truncated", "--partial"]);
    }
    // A header of more than a hundred bytes: its length takes two bytes, and nothing (EBML's Void) follows what it said.
    let nothing = [&[0xec, 0x80 + 100][..], &[0; 100]].concat();
    let header = u16::from(whole[4] & 0x7f) + nothing.len() as u16;
    let padded = [&whole[..4], &(0x4000 | header).to_be_bytes(), &whole[5..segment - 4], &nothing, &whole[segment - 4..]].concat();
    assert_eq!(length(4), 1);
    std::fs::write(&path, &padded)?;
    assert_eq!(report(&inspect(directory.path(), &[&path], &[])?)?.0["frames"], FRAMES);
    std::fs::write(&path, &padded[..padded.len() * 2 / 3])?;
    refused(&inspect(directory.path(), &[&path], &[])?, &["live.mkv", "ends after frame", "truncated"]);
    Ok(())
}

/// Where the pictures of a Matroska file lie: of each its element's first byte, and its contents.
pub fn blocks(bytes: &[u8]) -> Vec<(usize, std::ops::Range<usize>)> {
    let mut at = find(bytes, &[0x1f, 0x43, 0xb6, 0x75], 0);
    let mut all = Vec::new();
    while at < bytes.len() {
        let id = bytes[at].leading_zeros() as usize + 1;
        let size = bytes[at + id].leading_zeros() as usize + 1;
        let first = u64::from(bytes[at + id]) & (0xff >> size);
        let length = bytes[at + id + 1..at + id + size].iter().fold(first, |v, b| v << 8 | u64::from(*b)) as usize;
        let begin = at + id + size;
        match bytes[at..at + id] {
            // A cluster is walked into.
            [0x1f, 0x43, 0xb6, 0x75] => at = begin,
            [0xa3] => {
                all.push((at, begin..begin + length));
                at = begin + length;
            }
            _ => at = begin + length,
        }
    }
    all
}

/// Protects who measures a Matroska file that is as long as it says and has holes all the same: one that ends before its own duration is refused, also where
/// it does not begin at 0, and so are pictures that are missing between others, because they cannot be decoded or are gone.
#[test]
fn a_matroska_file_with_holes_is_said() -> Outcome {
    let directory = tempfile::tempdir()?;
    let path = directory.path().join("holes.mkv");
    video(&path, ['m', 'p', '4', 'v'], 30.0)?;
    let whole = std::fs::read(&path)?;
    let pictures = blocks(&whole);
    assert_eq!(pictures.len() as i32, FRAMES);
    // EBML's Void takes an element's place.
    let without = |gone: &[usize]| {
        let mut bytes = whole.clone();
        gone.iter().for_each(|k| bytes[pictures[*k].0] = 0xec);
        bytes
    };
    let mut damaged = whole.clone();
    damaged[pictures[9].1.clone()].fill(0);
    // Without the file's own word of its rate (DefaultDuration) too.
    let mut silent = without(&[9, 10]);
    let word = find(&silent, &[0x23, 0xe3, 0x83, 0x84], 0);
    silent[word..word + 2].copy_from_slice(&[0xec, 0x86]);
    for (bytes, gone) in [(damaged, None), (without(&[9, 10]), Some(2)), (silent, Some(2))] {
        std::fs::write(&path, &bytes)?;
        refused(&inspect(directory.path(), &[&path], &[])?, &["holes.mkv", "frame 10 (at 0.30 s) is missing", "--partial"]);
        let (part, said) = report(&inspect(directory.path(), &[&path], &["--partial"])?)?;
        // Behind a damaged picture, a decoder may give none until it has a whole one.
        let missing = FRAMES as u64 - part["frames"].as_u64().unwrap_or(0);
        assert!(missing > 0 && gone.is_none_or(|gone| gone == missing), "{part}");
        assert!(said.contains(&format!("{missing} of 24 frames are missing")), "{said}");
        let numbers: Vec<u64> = times(directory.path())?.into_iter().map(|(number, _)| number).collect();
        assert!(!numbers.contains(&10) && numbers.last() == Some(&24), "{numbers:?}");
    }
    // All times, and the end, a minute later: as of a piece of a longer recording.
    let later = |mut bytes: Vec<u8>| -> Result<Vec<u8>, Box<dyn std::error::Error>> {
        let duration = find(&bytes, &[0x44, 0x89, 0x88], 0) + 3;
        let end = f64::from_be_bytes(bytes[duration..duration + 8].try_into()?) + 60_000.0;
        bytes[duration..duration + 8].copy_from_slice(&end.to_be_bytes());
        let cluster = find(&bytes, &[0x1f, 0x43, 0xb6, 0x75], 0);
        let time = cluster + find(&bytes[cluster..], &[0xe7], 0);
        assert_eq!(bytes[time + 1], 0x81, "one byte");
        // The blocks of the cluster are relative to it. Its time takes two bytes now, and one before.
        Ok([&bytes[..time], &[0xe7, 0x82, 0xea, 0x60], &bytes[time + 3..]].concat())
    };
    let longer = |bytes: &[u8]| -> Vec<u8> {
        // So the segment and the cluster are longer by a byte.
        let mut bytes = bytes.to_vec();
        for id in [&[0x18, 0x53, 0x80, 0x67], &[0x1f, 0x43, 0xb6, 0x75]] {
            let at = find(&bytes, id, 0) + 4;
            let size = bytes[at].leading_zeros() as usize + 1;
            let last = at + size - 1;
            bytes[last] = bytes[last].checked_add(1).expect("no carry");
        }
        bytes
    };
    std::fs::write(&path, longer(&later(whole.clone())?))?;
    let (all, said) = report(&inspect(directory.path(), &[&path], &[])?)?;
    assert!(all["frames"] == FRAMES && said.is_empty(), "{all} {said}");
    let gone = without(&(12..FRAMES as usize).collect::<Vec<_>>());
    for bytes in [gone.clone(), longer(&later(gone)?)] {
        std::fs::write(&path, &bytes)?;
        refused(&inspect(directory.path(), &[&path], &[])?, &["holes.mkv", "ends after frame 12", "is missing", "--partial"]);
    }
    Ok(())
}
