//! One relay's automatic part: thresholds, on-delay, run-on, hold, negation, cycle (chapter 6.1).
//!
//! The manual lists the parts and says of their order only that thresholds, times, negations and
//! cycles come before the relay. Here the hold stands behind the times, so that a reset acts at once.

use crate::engine::time::{Duration, Time};

/// What the registers say of one relay.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rules {
    /// Registers 51 to 58.
    pub on_delay: Duration,
    /// Registers 61 to 68.
    pub run_on: Duration,
    /// Register 40: stays on until it is reset.
    pub hold: bool,
    /// Register 69.
    pub negate: bool,
    /// Registers 71 to 78; zero is no cycle. Half of a cycle the relay is on, the first half.
    pub cycle: Duration,
}

/// The relay's automatic state. Between two calls of [`Relay::demand`] nothing changes but time.
#[derive(Clone, Copy, Debug)]
pub struct Relay {
    /// Whether a measured value or register 19 wants the relay on.
    demanded: bool,
    demand_changed: Time,
    /// What the times made of the demand before this one, at the moment of the change.
    was_on: bool,
    /// Switched on under register 40 and not yet reset.
    held: bool,
    /// Since when it would be on if there were no cycle.
    on_since: Option<Time>,
    advanced_to: Time,
}

impl Relay {
    pub fn new(now: Time) -> Relay {
        Relay {
            demanded: false,
            demand_changed: now,
            was_on: false,
            held: false,
            on_since: None,
            advanced_to: now,
        }
    }

    pub fn is_demanded(&self) -> bool {
        self.demanded
    }

    /// A measured value has passed a threshold, or a bit of register 19 has changed.
    pub fn demand(&mut self, now: Time, on: bool, rules: Rules) {
        self.advance(now, rules);
        if on != self.demanded {
            self.was_on = self.is_timed_on(now, rules);
            self.demanded = on;
            self.demand_changed = now;
        }
        self.advance(now, rules);
    }

    /// Registers 41 to 49.
    pub fn reset(&mut self, now: Time, rules: Rules) {
        self.advance(now, rules);
        self.held = false;
        self.advance(now, rules);
    }

    pub fn advance(&mut self, now: Time, rules: Rules) {
        // What happened in between counts from its own moment, however seldom this is called.
        let delay = if self.demanded { rules.on_delay } else { rules.run_on };
        let switched_at = self.demand_changed + delay;
        if self.demanded != self.was_on && self.advanced_to < switched_at && switched_at < now {
            self.settle(switched_at, rules);
        }
        self.settle(now, rules);
        self.advanced_to = now;
    }

    pub fn is_on(&self, now: Time, rules: Rules) -> bool {
        let Some(since) = self.on_since else { return false };
        if rules.cycle.is_zero() {
            return true;
        }
        let cycle = rules.cycle.as_micros();
        now.since(since).as_micros() % cycle < cycle / 2
    }

    fn settle(&mut self, at: Time, rules: Rules) {
        let timed_on = self.is_timed_on(at, rules);
        self.held = rules.hold && (self.held || timed_on);
        if (timed_on || self.held) == rules.negate {
            self.on_since = None;
        } else if self.on_since.is_none() {
            self.on_since = Some(at);
        }
    }

    fn is_timed_on(&self, at: Time, rules: Rules) -> bool {
        let elapsed = at.since(self.demand_changed);
        if self.demanded {
            self.was_on || elapsed >= rules.on_delay
        } else {
            self.was_on && elapsed < rules.run_on
        }
    }
}
