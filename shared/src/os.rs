//! The operating system's part: the clock, and what a real-time process asks of the kernel.
//!
//! Called from any thread; nothing here allocates except [`pin_and_prioritise`]'s error text. On failure the caller gets
//! a line for the operator and goes on without the privilege.

/// Now, CLOCK_MONOTONIC in nanoseconds.
pub fn now_ns() -> u64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    t.tv_sec as u64 * 1_000_000_000 + t.tv_nsec as u64
}

/// Sleeps until the CLOCK_MONOTONIC time `deadline_ns`; returns at once if it has passed. Signals do not cut it short.
pub fn sleep_until_ns(deadline_ns: u64) {
    let request = rustix::time::Timespec { tv_sec: (deadline_ns / 1_000_000_000) as i64, tv_nsec: (deadline_ns % 1_000_000_000) as i64 };
    while let Err(rustix::io::Errno::INTR) = rustix::thread::clock_nanosleep_absolute(rustix::thread::ClockId::Monotonic, &request) {}
}
