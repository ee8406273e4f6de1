//! The log of the running gateway, on standard error.

use std::io::{IsTerminal, stderr};

use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt;

/// Starts it. `BUSKER_LOG` says what is told: `info` (the default), `debug`, `busker=debug,info`.
pub fn start() {
    let filter =
        EnvFilter::try_from_env("BUSKER_LOG").unwrap_or_else(|_| EnvFilter::new("info,rumqttc=error"));
    let lines = fmt()
        .with_env_filter(filter)
        .with_target(false)
        .with_ansi(stderr().is_terminal())
        .with_writer(stderr);
    // The journal stamps each line itself. A log that runs already is as good.
    let _ = if std::env::var_os("JOURNAL_STREAM").is_some() {
        lines.without_time().try_init()
    } else {
        lines.try_init()
    };
}
