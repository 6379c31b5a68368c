//! The URScript parser, compiler and interpreter: any text is uploaded and stepped for 50 control cycles.
#![no_main]
#![allow(dead_code, unused_imports)]

mod ur;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|source: &str| {
    let series = if source.len() % 2 == 0 { ur::Series::Cb3 } else { ur::Series::ESeries };
    let mut machine = ur::machine::Machine::new(series, series.default_version(), [0.0; 6]);
    machine.upload(source);
    for _ in 0..50 {
        machine.step();
    }
    assert!(machine.robot.servo.actual_q.iter().all(|q| q.is_finite()));
});
