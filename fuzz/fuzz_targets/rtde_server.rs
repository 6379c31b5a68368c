//! The RTDE server's session: any bytes, cut in two ways, give the same answers.
#![no_main]
#![allow(dead_code, unused_imports)]

mod ur;

use libfuzzer_sys::fuzz_target;
use ur::rtde::{InputOwners, RtdeSession, SessionContext};

fn answers(bytes: &[u8], cut: usize) -> Vec<u8> {
    let series = ur::Series::Cb3;
    let mut machine = ur::machine::Machine::new(series, series.default_version(), [0.0; 6]);
    let mut owners = InputOwners::default();
    let mut session = RtdeSession::new(1);
    let mut answers = Vec::new();
    for piece in bytes.chunks(cut) {
        let mut context = SessionContext { machine: &mut machine, owners: &mut owners, hidden: &[], refuse_version_2: false };
        if session.feed(piece, &mut context, &mut answers).is_err() {
            break;
        }
    }
    machine.step();
    answers.extend(session.output(&machine).unwrap_or_default());
    answers
}

fuzz_target!(|input: (u8, Vec<u8>)| {
    let (cut, bytes) = input;
    assert_eq!(answers(&bytes, usize::from(cut).max(1)), answers(&bytes, bytes.len().max(1)));
});
