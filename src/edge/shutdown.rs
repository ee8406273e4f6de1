//! When to end, and what systemd is told meanwhile.

use sd_notify::NotifyState;
use tokio::signal::unix::{Signal, SignalKind, signal};

use crate::engine::time::Duration;

/// The two signals that end the program in good order, and the one for a new configuration.
pub struct Signals {
    terminate: Signal,
    interrupt: Signal,
    hangup: Signal,
}

/// What a signal asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Heard {
    /// The end, by the signal of this name.
    Stop(&'static str),
    /// That the configuration is read again.
    Reload,
}

impl Signals {
    /// From here on the signals do not end the program by themselves. Only within a runtime.
    pub fn listen() -> std::io::Result<Signals> {
        Ok(Signals {
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
            hangup: signal(SignalKind::hangup())?,
        })
    }

    /// Waits for one of them.
    pub async fn wait(&mut self) -> Heard {
        tokio::select! {
            _ = self.terminate.recv() => Heard::Stop("SIGTERM"),
            _ = self.interrupt.recv() => Heard::Stop("SIGINT"),
            _ = self.hangup.recv() => Heard::Reload,
        }
    }
}

/// Tells systemd that the service has started; nothing without systemd.
pub fn tell_ready() {
    tell(NotifyState::Ready);
}

/// Tells systemd that the configuration is being read again; [`tell_ready`] ends that.
pub fn tell_reloading() {
    match NotifyState::monotonic_usec_now() {
        Ok(now) => tell_all(&[NotifyState::Reloading, now]),
        Err(error) => tracing::warn!("systemd cannot be told: {error}"),
    }
}

/// Tells whoever asks systemd for the service's state.
pub fn tell_status(text: &str) {
    tell(NotifyState::Status(text));
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
    tell_all(&[state]);
}

fn tell_all(states: &[NotifyState]) {
    if let Err(error) = sd_notify::notify(states) {
        tracing::warn!("systemd cannot be told: {error}");
    }
}
