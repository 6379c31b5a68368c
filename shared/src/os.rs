//! What is asked of the operating system: the clock, signals, real-time scheduling, locked memory, and the count of allocations.
//!
//! This is the only file of the project with `unsafe`. Any thread may call it. Nothing here allocates, except [`stop_at_signals`],
//! [`explain_bus_errors`] and texts. Where the system refuses something, the caller gets a line for the operator and goes on without it.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::os::fd::{AsFd, AsRawFd};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI32, AtomicPtr, Ordering::SeqCst};

use crate::level::Level;

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

/// Pins the calling thread to `core` and, if `priority` > 0, schedules it SCHED_FIFO with that priority (1 to 99).
///
/// Gives one line for each thing that was not permitted; the thread carries on without it.
pub fn become_realtime(core: usize, priority: u8) -> Vec<String> {
    let mut missing = Vec::new();
    if !core_affinity::set_for_current(core_affinity::CoreId { id: core }) {
        missing.push(format!("could not pin to core {core} (does it exist?): running on any core"));
    }
    missing.extend(prioritise(priority).err());
    missing
}

/// Schedules the calling thread SCHED_FIFO with `priority` (1-99); 0 leaves it as it is. The error is one line for the operator.
pub fn prioritise(priority: u8) -> Result<(), String> {
    if priority == 0 {
        return Ok(());
    }
    let param = libc::sched_param { sched_priority: i32::from(priority) };
    // SAFETY: pid 0 is the calling thread and `param` is a valid, initialised structure that the call only reads.
    if unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const param) } == 0 {
        return Ok(());
    }
    Err(format!(
        "SCHED_FIFO {priority} is not permitted ({}): set LimitRTPRIO or CAP_SYS_NICE; running with ordinary scheduling",
        std::io::Error::last_os_error()
    ))
}

/// Locks all present and future pages of the process in memory; gives the reason if that is not permitted. Call it before other threads
/// allocate, because each of them would get an arena of 64 MiB to be locked.
pub fn lock_memory() -> Result<(), String> {
    use rustix::mm::{MlockAllFlags, mlockall};
    // SAFETY: sets one number in the allocator, under the allocator's own lock.
    #[cfg(target_env = "gnu")]
    unsafe {
        libc::mallopt(libc::M_ARENA_MAX, 1)
    };
    mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE)
        .map_err(|e| format!("mlockall is not permitted ({e}): set LimitMEMLOCK=infinity or CAP_IPC_LOCK; page faults may delay the loop"))
}

/// Keeps the processor out of sleep states from which it wakes up slowly, as long as the returned file is kept; gives the reason if that
/// is not permitted. `None` where the kernel has no such file, as in most virtual machines.
pub fn stay_awake() -> Result<Option<std::fs::File>, String> {
    use std::io::Write;
    let path = "/dev/cpu_dma_latency";
    let held = std::fs::OpenOptions::new().write(true).open(path).and_then(|mut file| file.write_all(&0i32.to_ne_bytes()).map(|()| file));
    match held {
        Ok(file) => Ok(Some(file)),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(e) => Err(format!("{path}: {e}: the processor may wake up late from deep sleep; run as root or permit it by a udev rule")),
    }
}

/// Lets the process end quietly when nobody reads its output any more, as in `rt-controller status | head`. For commands that only print.
pub fn end_when_nobody_reads() {
    // SAFETY: the default action of a signal is not a function of this program, so no code of ours runs in a signal handler.
    unsafe { libc::signal(libc::SIGPIPE, libc::SIG_DFL) };
}

/// Sets a variable of the process's environment, for a library that reads it. It is an error once the process has a second thread.
pub fn set_variable(name: &str, value: &str) -> Result<(), String> {
    let threads = std::fs::read_dir("/proc/self/task").map_or(usize::MAX, Iterator::count);
    if threads != 1 {
        return Err(format!("{name} cannot be set: the process has {threads} threads already"));
    }
    // SAFETY: this is the only thread, as was just counted, so that no other one reads the environment meanwhile.
    unsafe { std::env::set_var(name, value) };
    Ok(())
}

/// A flag that becomes true when the process is asked to end by Ctrl-C or SIGTERM. These signals then no longer end it by themselves.
pub fn stop_at_signals() -> std::io::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&stop))?;
    }
    Ok(stop)
}

/// From now on Ctrl-C and SIGTERM end the process at once with this exit code, also after [`stop_at_signals`].
pub fn end_at_signals(code: u8) -> std::io::Result<()> {
    let always = Arc::new(AtomicBool::new(true));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register_conditional_shutdown(signal, code.into(), Arc::clone(&always))?;
    }
    Ok(())
}

/// Writes one line to standard error if that is possible within half a second, and leaves it out otherwise. For the end of a process that
/// must end, whatever became of its terminal.
pub fn tell(level: Level, line: &str) {
    let stderr = std::io::stderr();
    if may_be_written(500) {
        let _ = rustix::io::write(&stderr, format!("{}\n", level.marked(line)).as_bytes());
    }
}

/// Whether standard error takes a line within `wait_ms`. Nothing in it allocates, so that a signal's handler may call it.
fn may_be_written(wait_ms: i32) -> bool {
    let mut waits = libc::pollfd { fd: libc::STDERR_FILENO, events: libc::POLLOUT, revents: 0 };
    // SAFETY: `waits` is one valid structure, which the call reads and fills.
    unsafe { libc::poll(&raw mut waits, 1, wait_ms) == 1 }
}

/// User number of the process at the other end of a Unix socket. A process in another PID namespace has one too.
pub fn peer_uid(socket: &impl AsFd) -> Option<u32> {
    peer(socket).map(|[uid, _]| uid)
}

/// User number and process number of the process at the other end of a Unix socket, of a server the one that listens. The process number is 0 where this
/// process's PID namespace has none for it.
pub fn peer(socket: &impl AsFd) -> Option<[u32; 2]> {
    let mut credentials = libc::ucred { pid: 0, uid: 0, gid: 0 };
    let mut length = size_of::<libc::ucred>() as libc::socklen_t;
    let fd = socket.as_fd().as_raw_fd();
    // SAFETY: `credentials` is plain data, valid for writes of `length` bytes, and the call writes no more.
    let done = unsafe { libc::getsockopt(fd, libc::SOL_SOCKET, libc::SO_PEERCRED, (&raw mut credentials).cast(), &raw mut length) };
    (done == 0).then_some([credentials.uid, credentials.pid.max(0) as u32])
}

/// What is done when shared memory vanishes under the process.
struct BusErrors {
    line: String,
    code: i32,
    stop: Arc<AtomicBool>,
}

/// What [`explain_bus_errors`] was told; null before. It is never freed, because a signal may come at any time.
static BUS_ERRORS: AtomicPtr<BusErrors> = AtomicPtr::new(std::ptr::null_mut());
/// Number of the thread that must not be held up, see [`cannot_be_held_up`]; 0 if there is none.
static URGENT_THREAD: AtomicI32 = AtomicI32::new(0);

/// Says `line` and ends with the exit code `code` when the system takes a page of shared memory away (SIGBUS), as it does when `/dev/shm` is
/// full or somebody shortens a file there. Without this the process would die without a word.
///
/// A process whose loop must first do something else sets [`cannot_be_held_up`] there: if another thread is struck, that thread stops for
/// good, `stop` becomes true, and it is the process's task to end.
pub fn explain_bus_errors(line: &str, code: u8, stop: Arc<AtomicBool>) {
    let told = Box::new(BusErrors { line: format!("{}\n", Level::Error.marked(line)), code: code.into(), stop });
    BUS_ERRORS.store(Box::into_raw(told), SeqCst);
    let handler = on_bus_error as extern "C" fn(libc::c_int);
    // SAFETY: the handler only makes system calls that may be made in one, and reads memory that is never freed.
    unsafe { libc::signal(libc::SIGBUS, handler as libc::sighandler_t) };
}

/// Marks the calling thread as the one that [`explain_bus_errors`] does not stop: if it is struck itself, the process ends at once.
pub fn cannot_be_held_up() {
    URGENT_THREAD.store(rustix::thread::gettid().as_raw_nonzero().get(), SeqCst);
}

extern "C" fn on_bus_error(_: libc::c_int) {
    // SAFETY: the pointer is null or leads to a structure that is never freed or changed.
    let Some(told) = (unsafe { BUS_ERRORS.load(SeqCst).as_ref() }) else { return };
    if may_be_written(0) {
        // SAFETY: the line is valid for reads of its length.
        unsafe { libc::write(libc::STDERR_FILENO, told.line.as_ptr().cast(), told.line.len()) };
    }
    let urgent = URGENT_THREAD.load(SeqCst);
    // SAFETY: this call has no arguments and cannot fail.
    if urgent != 0 && urgent != unsafe { libc::gettid() } {
        told.stop.store(true, SeqCst);
        loop {
            // SAFETY: this call has no arguments; it waits for a signal.
            unsafe { libc::pause() };
        }
    }
    // SAFETY: ends the process without running anything of it.
    unsafe { libc::_exit(told.code) };
}

/// Number of page faults of the calling thread so far: minor ones, and major ones. Both are 0 if the system does not tell.
pub fn page_faults() -> (u64, u64) {
    // SAFETY: `rusage` is plain data for which all zeroes is a valid value.
    let mut usage: libc::rusage = unsafe { std::mem::zeroed() };
    // SAFETY: `usage` is valid for writes for the duration of the call, which only fills it.
    if unsafe { libc::getrusage(libc::RUSAGE_THREAD, &raw mut usage) } != 0 {
        return (0, 0);
    }
    (usage.ru_minflt as u64, usage.ru_majflt as u64)
}

/// Bytes of a cache line. Source: all x86-64 processors; a hint more or less does no harm elsewhere.
const CACHE_LINE: usize = 64;

/// Asks the processor to bring one of `parts` equal parts of `value` into its caches, and does not wait for it. It changes no result and
/// can only save time. A processor drops what is too much at once, so call it for part 0, 1, ... with some work between. On other
/// processors than x86-64 it does nothing.
pub fn prefetch<T>(value: &T, part: usize, parts: usize) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let start = std::ptr::from_ref(value).cast::<i8>();
        let size = size_of::<T>().div_ceil(parts.max(1));
        let first = part.saturating_mul(size);
        for offset in (first..first.saturating_add(size).min(size_of::<T>())).step_by(CACHE_LINE) {
            // SAFETY: a prefetch is a hint that neither reads into a register nor faults, and the address lies inside `value`.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(start.wrapping_add(offset)) };
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (value, part, parts, CACHE_LINE);
}

thread_local! {
    /// Number of allocations and frees of this thread.
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

/// Number of heap allocations and frees of the calling thread since it started; always 0 unless the binary installs [`CountingAllocator`].
pub fn allocations() -> u64 {
    ALLOCATIONS.try_with(Cell::get).unwrap_or(0)
}

/// The system's allocator, which also counts the calls of each thread ([`allocations`]). With it the loop shows that it makes none.
pub struct CountingAllocator;

/// Counts a call of the calling thread.
fn count() {
    // A thread that is being torn down has no counter any more, and nobody reads it.
    let _ = ALLOCATIONS.try_with(|c| c.set(c.get() + 1));
}

// SAFETY: every call is passed on unchanged to `System`, which keeps the contract; the counter is a plain thread-local cell
// without a destructor, so counting neither allocates nor unwinds.
unsafe impl GlobalAlloc for CountingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller keeps `alloc`'s contract.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, ptr: *mut u8, layout: Layout) {
        count();
        // SAFETY: the caller keeps `dealloc`'s contract; `ptr` came from `System`.
        unsafe { System.dealloc(ptr, layout) }
    }

    unsafe fn realloc(&self, ptr: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        count();
        // SAFETY: the caller keeps `realloc`'s contract; `ptr` came from `System`.
        unsafe { System.realloc(ptr, layout, new_size) }
    }
}
