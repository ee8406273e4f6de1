//! Wakes a thread that waits for bytes.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rustix::event::{EventfdFlags, eventfd};

/// An eventfd; copies ring the same bell.
#[derive(Clone, Debug)]
pub struct Bell {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    descriptor: OwnedFd,
    /// Whether it rings: who does not wait but spins sees it here.
    rings: AtomicBool,
}

impl Bell {
    pub fn new() -> std::io::Result<Bell> {
        let descriptor = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?;
        Ok(Bell { shared: Arc::new(Shared { descriptor, rings: AtomicBool::new(false) }) })
    }

    /// Wakes whoever waits for it, or will.
    pub fn ring(&self) {
        if !self.shared.rings.swap(true, Ordering::SeqCst) {
            // It fails only when it rings already.
            let _ = rustix::io::write(&self.shared.descriptor, &1u64.to_ne_bytes());
        }
    }

    /// Whether it rings.
    pub fn rings(&self) -> bool {
        self.shared.rings.load(Ordering::SeqCst)
    }

    /// Stops the ringing; what it rang for is looked for afterwards.
    pub fn silence(&self) {
        // In this order: who rings in between is either seen afterwards, or wakes once more.
        let _ = rustix::io::read(&self.shared.descriptor, &mut [0; 8]);
        self.shared.rings.store(false, Ordering::SeqCst);
    }
}

impl AsFd for Bell {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.shared.descriptor.as_fd()
    }
}

#[cfg(test)]
mod tests {
    use rustix::event::{PollFd, PollFlags, Timespec, poll};

    use super::*;

    fn wakes(bell: &Bell) -> bool {
        let mut descriptors = [PollFd::new(bell, PollFlags::IN)];
        poll(&mut descriptors, Some(&Timespec { tv_sec: 0, tv_nsec: 0 })).expect("it can be waited for") > 0
    }

    #[test]
    fn a_bell_rings_until_it_is_silenced_and_rings_again() {
        let bell = Bell::new().expect("a bell");
        assert_eq!((bell.rings(), wakes(&bell)), (false, false));
        for _ in 0..2 {
            bell.clone().ring();
            bell.ring();
            assert_eq!((bell.rings(), wakes(&bell)), (true, true));
            bell.silence();
            assert_eq!((bell.rings(), wakes(&bell)), (false, false));
        }
    }
}
