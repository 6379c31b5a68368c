//! How this crate takes a lock: whoever panicked while holding it has left nothing half done that matters here.
//!
//! Any thread may use it. It allocates nothing, waits for the lock, and does not fail.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Takes the lock.
pub fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
