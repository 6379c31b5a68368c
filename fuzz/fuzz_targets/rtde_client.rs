//! The RTDE client: any bytes, cut in two ways, give the same packets, and no packet's contents make a reader panic.
#![no_main]

use libfuzzer_sys::fuzz_target;
use rt_controller::link::TiltJoint;
use rt_controller::link::wire::{Inbox, Malformed, read_anything};
use shared::config::Joint;

/// The types and payloads of all packets, and how the stream ended.
fn frames(bytes: &[u8], cut: usize) -> (Vec<(u8, Vec<u8>)>, Option<Malformed>) {
    let tilt = TiltJoint { joint: Joint::Wrist3, start_deg: 0.0, direction: 1.0 };
    let (mut inbox, mut frames) = (Inbox::new(), Vec::new());
    for mut piece in bytes.chunks(cut) {
        while !piece.is_empty() {
            let n = inbox.space().len().min(piece.len());
            assert!(n > 0, "there is always space");
            inbox.space()[..n].copy_from_slice(&piece[..n]);
            inbox.filled(n);
            piece = &piece[n..];
            loop {
                match inbox.next_packet() {
                    Ok(Some(frame)) => {
                        read_anything(frame, &tilt);
                        frames.push((frame.kind, frame.payload.to_vec()));
                    }
                    Ok(None) => break,
                    Err(malformed) => return (frames, Some(malformed)),
                }
            }
        }
    }
    (frames, None)
}

fuzz_target!(|input: (u8, Vec<u8>)| {
    let (cut, bytes) = input;
    assert_eq!(frames(&bytes, usize::from(cut).max(1)), frames(&bytes, bytes.len().max(1)));
});
