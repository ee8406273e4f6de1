//! The program's one clock: everything else is told the time.

use std::time::Instant;

use crate::engine::time::{Duration, Time};

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

    /// How long from now until `time`; zero when it has passed.
    pub fn until(self, time: Time) -> Duration {
        time - self.now()
    }
}
