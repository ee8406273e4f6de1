//! How fast messages are told.
//!
//! The broker's acknowledgement would be the natural pace, but it says only that the broker has a message.
//! What is lost is lost behind it: a mosquitto queues a thousand messages for each reader and drops what is
//! beyond, without a word to anybody, and a Home Assistant takes some hundred a second. When a gateway with
//! many points came back, what was dropped could be that it is online. So a fixed pace that such a reader
//! keeps up with, with a burst that fits in its queue many times.
//!
//! Outcomes and responses answer messages that came through the same broker just before, as fast as they came.
//! Held to that pace a flood of commands would have to wait for minutes, and values behind it; so there may
//! be more of them, a burst of which still fits.

use crate::engine::time::{Duration, Time};

/// So many messages are told in so long, at the most.
pub(super) const AT_ONCE: usize = 100;
pub(super) const PERIOD: Duration = Duration::from_millis(200);

/// An answer is worth this part of another message.
pub(super) const ANSWERS_FOR_ONE: usize = 8;

#[derive(Clone, Debug, Default)]
pub(super) struct Pace {
    /// When the present period began, and how many messages were told in it, counted as answers.
    period_began: Time,
    told: usize,
}

impl Pace {
    /// Whether one more message may be told now.
    pub(super) fn allows(&mut self, now: Time) -> bool {
        if now >= self.period_began + PERIOD {
            (self.period_began, self.told) = (now, 0);
        }
        self.told < AT_ONCE * ANSWERS_FOR_ONE
    }

    pub(super) fn told(&mut self, is_answer: bool) {
        self.told += weight(is_answer);
    }

    /// What was told last was not told after all.
    pub(super) fn take_back(&mut self, is_answer: bool) {
        self.told = self.told.saturating_sub(weight(is_answer));
    }

    /// Until when no more may be told, if too many have been.
    pub(super) fn held_until(&self) -> Option<Time> {
        (self.told >= AT_ONCE * ANSWERS_FOR_ONE).then(|| self.period_began + PERIOD)
    }
}

const fn weight(is_answer: bool) -> usize {
    if is_answer { 1 } else { ANSWERS_FOR_ONE }
}
