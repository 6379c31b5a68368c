//! Which connections are open, which of them answer something, and which one makes room when all places are taken.
//!
//! It runs in the server's runtime and allocates. Nothing fails and nobody waits: a connection on which nothing is answered is the first to
//! go, so that people who only hold connections open cannot keep others away.

use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};

use tokio::sync::Notify;

/// One connection.
pub struct Place {
    /// Number of answers under way.
    busy: AtomicUsize,
    /// Tells the connection to end.
    pub close: Notify,
}

/// As long as it lives, its connection is answering.
pub struct Busy(Arc<Place>);

impl Place {
    /// Marks the connection as one that answers.
    pub fn busy(self: &Arc<Self>) -> Busy {
        self.busy.fetch_add(1, Relaxed);
        Busy(Arc::clone(self))
    }
}

impl Drop for Busy {
    fn drop(&mut self) {
        self.0.busy.fetch_sub(1, Relaxed);
    }
}

/// All connections of a server.
pub struct Connections {
    most: usize,
    open: Mutex<Vec<Arc<Place>>>,
}

impl Connections {
    /// Room for `most` connections.
    pub fn new(most: usize) -> Self {
        Self { most, open: Mutex::new(Vec::new()) }
    }

    /// A place for a new connection. If all are taken, the oldest one that answers nothing ends; `None` if there is none.
    pub fn enter(&self) -> Option<Arc<Place>> {
        let mut open = self.open.lock().unwrap_or_else(PoisonError::into_inner);
        if open.len() >= self.most {
            let idle = open.iter().position(|place| place.busy.load(Relaxed) == 0)?;
            open.remove(idle).close.notify_one();
        }
        let place = Arc::new(Place { busy: AtomicUsize::new(0), close: Notify::new() });
        open.push(Arc::clone(&place));
        Some(place)
    }

    /// Gives a place back.
    pub fn leave(&self, place: &Arc<Place>) {
        self.open.lock().unwrap_or_else(PoisonError::into_inner).retain(|p| !Arc::ptr_eq(p, place));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the operator from people who hold connections open: a new one takes the oldest idle place, and none that answers.
    #[test]
    fn an_idle_connection_makes_room() {
        let all = Connections::new(2);
        let (first, second) = (all.enter().unwrap(), all.enter().unwrap());
        let answering = first.busy();
        let third = all.enter().unwrap();
        assert!(!all.open.lock().unwrap().iter().any(|p| Arc::ptr_eq(p, &second)), "the idle one went");
        let (_a, _b) = (third.busy(), answering);
        assert!(all.enter().is_none(), "none that answers goes");
        all.leave(&first);
        assert!(all.enter().is_some());
    }
}
