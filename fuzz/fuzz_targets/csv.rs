//! Any bytes to the parser `csv` of tests/src/parsers.rs, which says what must hold.
#![no_main]

#[path = "../../tests/src/parsers.rs"]
#[allow(dead_code)]
mod parsers;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| parsers::csv(bytes));
