//! The dashboard, the operator port's faults and the cutting of uploads into programs: any bytes.
#![no_main]
#![allow(dead_code, unused_imports)]

mod ur;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let mut assembler = ur::client_interface::ProgramAssembler::default();
    let whole = assembler.feed(bytes).len() + usize::from(assembler.finish().is_some());
    assert!(whole <= bytes.len());
    let series = ur::Series::ESeries;
    let mut machine = ur::machine::Machine::new(series, series.default_version(), [0.0; 6]);
    for line in String::from_utf8_lossy(bytes).lines() {
        let _ = ur::dashboard::answer(line, &mut machine);
        if let Ok(fault) = line.parse::<ur::Fault>() {
            assert_eq!(fault.to_string().parse::<ur::Fault>().as_ref(), Ok(&fault));
        }
        machine.step();
    }
});
