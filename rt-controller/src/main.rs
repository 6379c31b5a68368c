//! Command line of `rt-controller`.

fn main() {}
