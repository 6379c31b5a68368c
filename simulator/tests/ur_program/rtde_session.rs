//! An RTDE session without its socket, where the cycles in which packets are due can be chosen.

use simulator::ur::Series;
use simulator::ur::rtde::{InputOwners, RtdeSession, SessionContext};

use crate::machine;

// Protects the rule for frequencies: 30 Hz are every fourth cycle of a CB3 (31.25 Hz) and every sixteenth of an e-Series. A packet
// whose cycle was missed is sent late and once, and the next one on time.
#[test]
fn the_divider_is_rounded_down() {
    for (series, frequency, divider) in
        [(Series::Cb3, 30.0f64, 4), (Series::ESeries, 30.0, 16), (Series::Cb3, 125.0, 1), (Series::Cb3, 500.0, 1)]
    {
        let mut machine = machine(series);
        let mut owners = InputOwners::default();
        let mut session = RtdeSession::new(1);
        let setup = [&[0, 20, b'O'][..], &frequency.to_be_bytes(), b"timestamp"].concat();
        for request in [&[0, 5, b'V', 0, 2][..], &setup, &[0, 3, b'S']] {
            let mut context = SessionContext { machine: &mut machine, owners: &mut owners, hidden: &[], refuse_version_2: false };
            session.feed(request, &mut context, &mut Vec::new()).unwrap();
        }
        let mut sent = Vec::new();
        for cycle in 1..=10 * divider {
            machine.step();
            // The controller is short of time in one cycle in which a packet is due.
            if cycle != 5 * divider + 1 && session.output(&machine).is_some() {
                sent.push(cycle);
            }
        }
        let on_time: Vec<usize> = (0..10).map(|i| i * divider + 1).collect();
        if divider == 1 {
            assert_eq!(sent.len(), 9);
        } else {
            assert_eq!(sent.iter().filter(|c| !on_time.contains(c)).collect::<Vec<_>>(), [&(5 * divider + 2)], "{series:?} {frequency}");
            assert_eq!(sent.len(), 10);
        }
    }
}
