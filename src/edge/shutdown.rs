//! When to end, and what systemd is told meanwhile.

use sd_notify::NotifyState;
use tokio::signal::unix::{Signal, SignalKind, signal};

use crate::engine::time::Duration;

/// The two signals that end the program in good order.
pub struct Signals {
    terminate: Signal,
    interrupt: Signal,
}

impl Signals {
    /// From here on the signals do not end the program by themselves. Only within a runtime.
    pub fn listen() -> std::io::Result<Signals> {
        Ok(Signals {
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
        })
    }

    /// Waits for one of them, and says which.
    pub async fn wait(&mut self) -> &'static str {
        tokio::select! {
            _ = self.terminate.recv() => "SIGTERM",
            _ = self.interrupt.recv() => "SIGINT",
        }
    }
}

/// Tells systemd that the service has started; nothing without systemd.
pub fn tell_ready() {
    tell(NotifyState::Ready);
}

/// Tells systemd that the service is ending.
pub fn tell_stopping() {
    tell(NotifyState::Stopping);
}

/// Tells systemd that all is alive.
pub fn feed_watchdog() {
    tell(NotifyState::Watchdog);
}

/// How often [`feed_watchdog`] is wanted at most; `None` without a watchdog.
pub fn watchdog_interval() -> Option<Duration> {
    sd_notify::watchdog_enabled().map(|limit| limit / 3)
}

fn tell(state: NotifyState) {
    if let Err(error) = sd_notify::notify(&[state]) {
        tracing::warn!("systemd cannot be told: {error}");
    }
}
