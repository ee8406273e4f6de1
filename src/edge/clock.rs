//! The program's one clock: everything else is told the time.

use std::time::{Instant, SystemTime};

use crate::engine::time::{Date, Duration, Time};

/// Microseconds since the program started; copies share the same start.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    start: Instant,
}

impl Clock {
    #[expect(clippy::disallowed_methods, reason = "this is the place that asks")]
    pub fn start() -> Clock {
        Clock { start: Instant::now() }
    }

    pub fn now(self) -> Time {
        Time(self.start.elapsed().as_micros() as u64)
    }

    /// The date, for texts; nothing may be decided by it, since it can jump.
    pub fn today(self) -> Date {
        Date(self.since_1970().as_secs())
    }

    /// The time since 1970, to be told and nothing else: it can jump.
    #[expect(clippy::disallowed_methods, reason = "this is the place that asks")]
    pub fn since_1970(self) -> Duration {
        SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default()
    }

    /// When `time` was, as people tell it, if nobody has set the clock since.
    pub fn since_1970_at(self, time: Time) -> Duration {
        self.since_1970().saturating_sub(self.now() - time)
    }

    /// How long from now until `time`; zero when it has passed.
    pub fn until(self, time: Time) -> Duration {
        time - self.now()
    }
}
