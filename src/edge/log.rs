//! Writes the engine's lines into the log.

use crate::engine::health::Severity;

pub fn say(severity: Severity, text: &str) {
    match severity {
        Severity::Info => tracing::info!("{text}"),
        Severity::Warning => tracing::warn!("{text}"),
    }
}

pub fn say_all(lines: impl IntoIterator<Item = (Severity, String)>) {
    lines.into_iter().for_each(|(severity, text)| say(severity, &text));
}
