//! The async runtime for the broker and HTTP: all of it on one thread.
//!
//! It has so little to do that a second thread would cost more by being woken than it would save; and the
//! scheduler for several is larger than the whole of this one.

use std::future::Future;
use std::thread::JoinHandle;

use tokio::runtime::{Builder, EnterGuard, Handle};
use tokio::sync::oneshot;

/// Runs what is spawned on it until it is dropped.
pub struct Runtime {
    handle: Handle,
    thread: Option<(oneshot::Sender<()>, JoinHandle<()>)>,
}

impl Runtime {
    pub fn start() -> std::io::Result<Runtime> {
        let runtime = Builder::new_current_thread().enable_all().build()?;
        let handle = runtime.handle().clone();
        let (stop, stopped) = oneshot::channel::<()>();
        let thread = std::thread::Builder::new().name("edge".into()).spawn(move || {
            // Whether it is told to or forgotten.
            let _ = runtime.block_on(stopped);
            // A thread that is stuck in a bus is not waited for.
            runtime.shutdown_background();
        })?;
        Ok(Runtime { handle, thread: Some((stop, thread)) })
    }

    /// Waits for `future` on the caller's thread, while everything else goes on. Not from within a runtime.
    pub fn block_on<F: Future>(&self, future: F) -> F::Output {
        self.handle.block_on(future)
    }

    /// As long as the guard lives, the caller can spawn.
    pub fn enter(&self) -> EnterGuard<'_> {
        self.handle.enter()
    }
}

impl Drop for Runtime {
    fn drop(&mut self) {
        if let Some((stop, thread)) = self.thread.take() {
            drop(stop);
            if thread.join().is_err() {
                tracing::error!("the thread for the broker and HTTP ended in a panic");
            }
        }
    }
}
