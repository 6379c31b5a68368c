//! The bytes that were logged from the client library ur_rtde 1.6.5, and the answers that a CB3 3.15.8 gave.

use std::io::Write;

use simulator::ur::Series;

use crate::client::{RtdeClient, double, hex, int};
use crate::{RECEIVE, start, until};

// Protects the wire format. The bytes that were logged from ur_rtde 1.6.5 get the answers that a CB3 3.15.8 gave.
#[test]
fn ur_rtde_receive_interface_byte_for_byte() {
    let (_handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::new(address);
    client.stream.write_all(&hex("0005560002 000376 000376")).unwrap();
    assert_eq!(client.packet().unwrap().unwrap(), hex("00045601"));
    for _ in 0..2 {
        assert_eq!(client.packet().unwrap().unwrap(), hex("00137600000003 0000000f 00000008 00019f63"));
    }
    let mut setup = hex("044e4f405f400000000000");
    setup.extend(RECEIVE.as_bytes());
    assert_eq!(setup.len(), 1102, "the request as logged");
    client.stream.write_all(&setup).unwrap();
    let answer = client.packet().unwrap().unwrap();
    assert_eq!((answer[2], answer[3]), (b'O', 1));
    assert!(answer[4..].starts_with(b"DOUBLE,VECTOR6D,"), "no comma after the last type, none before the first");
    assert_eq!(answer.iter().filter(|b| **b == b',').count(), 56);
    client.stream.write_all(&hex("000353")).unwrap();
    assert_eq!(client.packet().unwrap().unwrap(), hex("00045301"));
    let first = client.packet().unwrap().unwrap();
    assert_eq!((first.len(), &first[2..4]), (1132, &b"U\x01"[..]), "1132 bytes a packet, as logged");
    let second = client.packet().unwrap().unwrap();
    assert!((double(&second, 4) - double(&first, 4) - 0.008).abs() < 1e-9, "timestamps of neighbours are a cycle apart");
}

/// The fields of 22 of ur_rtde's 23 input recipes: how many ints, how many doubles, and whether one more int follows the doubles.
/// Then the sizes of the I packet, of its answer and of the U packet in bytes.
const CONTROL: [(usize, usize, bool, usize, usize, usize); 22] = [
    (1, 8, true, 237, 71, 76),
    (1, 11, false, 289, 86, 96),
    (8, 18, false, 611, 177, 180),
    (1, 0, false, 24, 9, 8),
    (1, 9, false, 240, 72, 80),
    (1, 6, false, 168, 51, 56),
    (1, 4, false, 120, 37, 40),
    (1, 1, false, 48, 16, 16),
    (2, 0, false, 45, 15, 12),
    (1, 14, false, 364, 107, 120),
    (1, 0, false, 24, 9, 8),
    (1, 12, false, 314, 93, 104),
    (1, 8, false, 216, 65, 72),
    (1, 14, false, 364, 107, 120),
    (2, 0, false, 45, 15, 12),
    (1, 13, false, 339, 100, 112),
    (7, 6, false, 294, 87, 80),
    (2, 7, false, 213, 64, 68),
    (1, 1, true, 69, 22, 20),
    (1, 10, false, 264, 79, 88),
    (1, 6, true, 189, 57, 60),
    (1, 18, false, 464, 135, 152),
];

// Protects the control interface. Its 23 input recipes get their ids in order although they share variables, all sizes are as
// logged, and the logged packets for servoJ, watchdog and clear arrive in the registers.
#[test]
fn ur_rtde_control_interface_byte_for_byte() {
    let (_handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::new(address);
    client.ask(b'V', &[0, 2]);
    let mut names: Vec<String> = ["timestamp", "robot_status_bits", "safety_status_bits", "runtime_state"].map(str::to_owned).to_vec();
    names.extend((0..3).map(|i| format!("output_int_register_{i}")));
    names.extend((0..6).map(|i| format!("output_double_register_{i}")));
    client.outputs(125.0, &format!("{},", names.join(",")));
    for (i, (ints, doubles, last_int, setup_bytes, answer_bytes, _)) in CONTROL.into_iter().enumerate() {
        let mut names: Vec<String> = (0..ints).map(|n| format!("input_int_register_{n}")).collect();
        names.extend((0..doubles).map(|n| format!("input_double_register_{n}")));
        names.extend(last_int.then(|| "input_int_register_1".to_owned()));
        let list = format!("{},", names.join(","));
        assert_eq!(list.len() + 3, setup_bytes, "recipe {}", i + 1);
        let answer = client.ask(b'I', list.as_bytes());
        assert_eq!((answer.len(), usize::from(answer[3])), (answer_bytes, i + 1));
    }
    assert_eq!(client.inputs("input_int_register_0,external_force_torque,"), "23:INT32,VECTOR6D");
    assert_eq!(client.ask(b'S', &[]), hex("00045301"));
    assert_eq!(client.answer(b'U').len(), 84, "84 bytes a packet, as logged");
    // A client may read inputs back.
    let mut reader = RtdeClient::started(
        address,
        "input_int_register_0,input_double_register_0,input_double_register_1,input_double_register_5,input_double_register_8,\
         input_double_register_9,input_double_register_10",
    );
    let servoj = "0060 55 02 0000000b 0000000000000000 bff921ff2e48e8a7 3ff921ff2e48e8a7 bff921ff2e48e8a7 bff921ff2e48e8a7 \
                  3f81111111111111 0000000000000000 0000000000000000 3fa1111111111111 3fb999999999999a 4072c00000000000";
    client.stream.write_all(&hex(servoj)).unwrap();
    let wanted = hex("0000000b 0000000000000000 bff921ff2e48e8a7 3f81111111111111 3fa1111111111111 3fb999999999999a 4072c00000000000");
    until("servoJ's registers", || reader.data() == wanted);
    client.stream.write_all(&hex("0010550800000023 4024000000000000")).unwrap();
    until("setWatchdog's registers", || reader.data()[..12] == hex("00000023 4024000000000000"));
    client.stream.write_all(&hex("0008550400000000")).unwrap();
    until("the command cleared", || int(&reader.data(), 0) == 0);
}
