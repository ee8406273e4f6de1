//! The watchdog of register 66, which all METZ CONNECT devices with outputs have (pages 8, 13, 24, 44, 46, 61).

use crate::engine::time::{Duration, Time};

/// Expires when no message has come for the time that register 66 says.
pub struct Watchdog {
    /// Register 66, in units of 10 ms; 0 is off. EEPROM.
    pub time: u16,
    last_message: Time,
    expired: bool,
}

/// The watchdog's register.
pub const WATCHDOG: u16 = 66;
const UNIT: Duration = Duration::from_millis(10);

impl Watchdog {
    pub fn new(now: Time) -> Watchdog {
        Watchdog { time: 0, last_message: now, expired: false }
    }

    /// A message for this device has come, or it has started.
    pub fn feed(&mut self, now: Time) {
        self.last_message = now;
        self.expired = false;
    }

    /// How long no message has come.
    pub fn silence(&self, now: Time) -> Duration {
        now.since(self.last_message)
    }

    /// When it expires if no message comes; `None` when it is off or has expired.
    pub fn expires_at(&self) -> Option<Time> {
        (self.time > 0 && !self.expired).then(|| self.last_message + UNIT * self.time.into())
    }

    /// Whether it has expired, and no message has come since.
    pub fn has_expired(&self) -> bool {
        self.expired
    }

    /// True once each time it expires.
    pub fn expires(&mut self, now: Time) -> bool {
        let is_over = self.time > 0 && self.silence(now) >= UNIT * self.time.into();
        let expires = is_over && !self.expired;
        self.expired |= is_over;
        expires
    }
}
