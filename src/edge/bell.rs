//! Wakes a thread that waits for bytes.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::Arc;

use rustix::event::{EventfdFlags, eventfd};

/// An eventfd; copies ring the same bell.
#[derive(Clone, Debug)]
pub struct Bell {
    descriptor: Arc<OwnedFd>,
}

impl Bell {
    pub fn new() -> std::io::Result<Bell> {
        let descriptor = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?;
        Ok(Bell { descriptor: Arc::new(descriptor) })
    }

    /// Wakes whoever waits for it, or will.
    pub fn ring(&self) {
        // It fails only when it rings already.
        let _ = rustix::io::write(&*self.descriptor, &1u64.to_ne_bytes());
    }

    /// Stops the ringing; what it rang for is looked for afterwards.
    pub fn silence(&self) {
        let _ = rustix::io::read(&*self.descriptor, &mut [0; 8]);
    }
}

impl AsFd for Bell {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.descriptor.as_fd()
    }
}
