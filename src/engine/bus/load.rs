//! The share of time in which the wire is busy.

use crate::engine::time::{Duration, Time};

/// The share of time in which the wire is busy: two buckets of a minute.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Load {
    minute: u64,
    busy: Duration,
    busy_before: Option<Duration>,
}

impl Load {
    const MINUTE: u64 = 60_000_000;

    pub(super) fn add(&mut self, from: Time, until: Time) {
        let minute = until.0 / Load::MINUTE;
        if minute != self.minute {
            self.busy_before = Some(if minute == self.minute + 1 { self.busy } else { Duration::ZERO });
            (self.minute, self.busy) = (minute, Duration::ZERO);
        }
        self.busy += until - from;
    }

    /// 0 to 1, over the last whole minute; before there is one, since the start.
    pub(super) fn share(&self, now: Time) -> f64 {
        let (busy, time) = match (self.busy_before, now.0 / Load::MINUTE) {
            (_, minute) if minute > self.minute + 1 => (Duration::ZERO, Duration::from_secs(60)),
            (_, minute) if minute == self.minute + 1 => (self.busy, Duration::from_secs(60)),
            (Some(before), _) => (before, Duration::from_secs(60)),
            (None, _) => (self.busy, now - Time::default()),
        };
        if time.is_zero() { 0.0 } else { (busy.as_secs_f64() / time.as_secs_f64()).min(1.0) }
    }
}
