//! The relay on the sensor's own board, or Rreg_50 alone where it has none (page 12; RWreg_50 to 55).

use crate::engine::time::{Duration, Time};

/// RWreg_52 to 55.
#[derive(Clone, Copy, Debug)]
pub struct Rules {
    pub off: i16,
    pub on: i16,
    pub off_delay: Duration,
    pub on_delay: Duration,
}

/// "AUS-Bedingung muss solange erfüllt sein", "EIN-Bedingung muss solange erfüllt sein": unlike the relay
/// board, a condition that is interrupted begins anew.
#[derive(Clone, Copy, Debug, Default)]
pub struct Threshold {
    is_on: bool,
    off_since: Option<Time>,
    on_since: Option<Time>,
}

impl Threshold {
    pub fn is_on(&self) -> bool {
        self.is_on
    }

    /// The value is this from now on. A threshold that is reached counts as passed, as a door has no
    /// more than 0 and 1.
    pub fn observe(&mut self, now: Time, value: i16, rules: Rules) {
        self.off_since = (value <= rules.off).then(|| self.off_since.unwrap_or(now));
        self.on_since = (value >= rules.on).then(|| self.on_since.unwrap_or(now));
        if self.changes_at(rules).is_some_and(|at| at <= now) {
            self.is_on = !self.is_on;
        }
    }

    /// When it switches if the value stays.
    pub fn changes_at(&self, rules: Rules) -> Option<Time> {
        if self.is_on {
            self.off_since.map(|since| since + rules.off_delay)
        } else {
            self.on_since.map(|since| since + rules.on_delay)
        }
    }
}
