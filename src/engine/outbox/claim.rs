//! What others tell of this gateway's own state, `offline` for example while it is online: another gateway's
//! last will, or somebody's mistake. It is put right at once, but not for ever: who writes there again and again
//! does so on purpose, and two gateways would never come to an end.

use std::collections::VecDeque;

use super::Outbox;
use crate::engine::time::{Duration, Time};
use crate::engine::topics::OFFLINE;

/// So often the state is put right in so long; after that when its time has come.
pub(super) const CORRECTIONS: usize = 5;
pub(super) const WITHIN: Duration = Duration::from_secs(60);

#[derive(Clone, Debug, Default)]
pub(super) struct Claim {
    /// The last times that it was put right.
    corrected: VecDeque<Time>,
    /// It is to be put right then.
    due: Option<Time>,
    /// Whether others denied it again and again when something was heard of it last.
    was_denied: bool,
}

impl Claim {
    /// Others say something else. Whether that is put right at once.
    fn denied(&mut self, now: Time) -> bool {
        if self.due.is_some() {
            return false;
        }
        match self.corrected.front() {
            Some(first) if self.is_full() && now < *first + WITHIN => {
                self.due = Some(*first + WITHIN);
                false
            }
            _ => {
                self.corrected(now);
                true
            }
        }
    }

    fn corrected(&mut self, now: Time) {
        if self.is_full() {
            self.corrected.pop_front();
        }
        self.corrected.push_back(now);
        self.due = None;
    }

    fn is_full(&self) -> bool {
        self.corrected.len() >= CORRECTIONS
    }

    pub(super) fn due(&self) -> Option<Time> {
        self.due
    }
}

impl Outbox {
    /// Somebody has told the gateway's state, itself perhaps. What is not so is put right, unless this gateway has said
    /// goodbye: then that is its last word. Not to be told what the broker kept from before this connection, since the
    /// state follows then anyway. Whether a quarrel about it has begun by that: people should know, once.
    pub(super) fn heard_state(&mut self, payload: &str, now: Time) -> bool {
        let topic = self.topics.bridge_state();
        if let Some(entry) = self.retained.get(&*topic) {
            if entry.payload == OFFLINE {
                return false;
            }
            if *entry.payload == *payload {
                self.claim.due = None;
                self.has_arrived(&topic, payload.len(), now);
            } else if !entry.queued && self.claim.denied(now) {
                self.tell_state_again();
            }
        }
        let is_denied = self.is_denied(now);
        let was_denied = std::mem::replace(&mut self.claim.was_denied, is_denied);
        is_denied && !was_denied
    }

    /// Whether others tell something else of this gateway's state again and again.
    pub fn is_denied(&self, now: Time) -> bool {
        let claim = &self.claim;
        claim.is_full() && claim.corrected.front().is_some_and(|first| now < *first + WITHIN)
    }

    /// The time of [`Claim::due`] may have come.
    pub(super) fn wake_claim(&mut self, now: Time) {
        if self.claim.due.is_some_and(|due| due <= now) {
            self.claim.corrected(now);
            self.tell_state_again();
        }
    }

    fn tell_state_again(&mut self) {
        let topic = self.topics.bridge_state();
        self.tell_again(&topic);
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{check_sent, outbox, take_all};
    use super::*;

    const STATE: &str = "busker/bridge/state online";

    fn at(millis: u64) -> Time {
        Time::from_millis(100_000 + millis)
    }

    #[test]
    fn what_others_say_of_our_state_is_put_right_and_what_we_say_is_not() {
        let mut outbox = outbox();
        outbox.heard_state("offline", at(0));
        check_sent(&mut outbox, &[]);
        outbox.connected();
        // The state follows anyway.
        outbox.heard_state("offline", at(0));
        check_sent(&mut outbox, &[STATE]);
        for payload in ["offline", "", "maybe"] {
            outbox.heard_state(payload, at(1));
            outbox.heard_state(payload, at(1));
            check_sent(&mut outbox, &[STATE]);
            outbox.heard_state("online", at(2));
            check_sent(&mut outbox, &[]);
        }
    }

    #[test]
    fn the_last_word_is_the_goodbye() {
        let mut outbox = outbox();
        outbox.connected();
        outbox.goodbye();
        check_sent(&mut outbox, &["busker/bridge/state offline"]);
        outbox.heard_state("online", at(1));
        check_sent(&mut outbox, &[]);
        // Another connection begins with another word.
        outbox.connected();
        check_sent(&mut outbox, &[STATE]);
        outbox.heard_state("offline", at(2));
        check_sent(&mut outbox, &[STATE]);
    }

    #[test]
    fn a_quarrel_about_our_state_is_bounded_and_noticed() {
        let mut outbox = outbox();
        outbox.connected();
        take_all(&mut outbox);
        let (mut told, mut quarrels) = (0, 0);
        for second in 0..600 {
            let now = at(second * 1000);
            outbox.wake(now);
            quarrels += usize::from(outbox.heard_state("offline", now));
            told += take_all(&mut outbox).len();
            quarrels += usize::from(outbox.heard_state("online", now));
            assert_eq!(outbox.is_denied(now), told >= CORRECTIONS, "after {second} s");
        }
        assert!((50..=CORRECTIONS * 11).contains(&told), "{told} times in ten minutes");
        assert_eq!(quarrels, 1, "it is one all the time");
        // The last word is ours, also when the other one has had one just after ours.
        outbox.heard_state("offline", at(599_500));
        let due = outbox.wake_at().expect("it is put right later");
        outbox.wake(due);
        check_sent(&mut outbox, &[STATE]);
        assert!(!outbox.is_denied(due + WITHIN));
        assert_eq!(outbox.wake_at(), None);
        // The next quarrel is another.
        let later = due + WITHIN + WITHIN;
        let mut begins = || {
            let begins = outbox.heard_state("offline", later);
            take_all(&mut outbox);
            begins
        };
        assert_eq!((0..20).filter(|_| begins()).count(), 1);
    }
}
