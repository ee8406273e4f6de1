//! What was taken back at the broker, for as long as it may still stand there: what was handed over just before
//! a connection was lost has perhaps not arrived. It is taken back again then, and worth remembering until that
//! has gone well.

use std::collections::BTreeSet;

use super::{Outbox, Tree};
use crate::engine::time::{Duration, Time};

/// What was handed over so long ago, on a connection that still stands, has most likely arrived.
pub(super) const ARRIVES_WITHIN: Duration = Duration::from_secs(10);

#[derive(Clone, Debug, Default)]
pub(super) struct TakenBack {
    topics: BTreeSet<String>,
    /// When the last of them was handed over.
    handed_over_at: Time,
}

impl TakenBack {
    pub(super) fn add(&mut self, topic: &str) {
        self.topics.insert(topic.to_string());
    }

    pub(super) fn handed_over(&mut self, topic: &str, now: Time) {
        if self.topics.contains(topic) {
            self.handed_over_at = now;
        }
    }
}

impl Outbox {
    /// What is worth remembering of where something stands at the broker: `told_on`, where the devices tell
    /// something now, with what may not have been taken back yet; and then other base topics.
    pub fn trees(&self, told_on: BTreeSet<String>) -> Vec<Tree> {
        let mut present = Tree { base_topic: self.topics.base().into(), topics: told_on };
        present.topics.extend(self.left_behind.iter().chain(&self.taken_back.topics).cloned());
        std::iter::once(present).chain(self.former_trees()).collect()
    }

    /// Whether [`Outbox::trees`] are fewer than before, since what was taken back has arrived, or is somebody
    /// else's now. Told once; to be asked now and then.
    pub fn settle(&mut self, now: Time) -> bool {
        if !self.is_empty() {
            return false;
        }
        self.departed.settle(now);
        if now < self.taken_back.handed_over_at + ARRIVES_WITHIN {
            return false;
        }
        let has_arrived = !std::mem::take(&mut self.taken_back.topics).is_empty();
        std::mem::take(&mut self.is_left_to_others) || has_arrived
    }

    /// There is no connection any more on which it would have arrived.
    pub(super) fn doubt_what_was_taken_back(&mut self) {
        self.left_behind.append(&mut self.taken_back.topics);
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{LATER, check_sent, outbox, retained, take_all};
    use super::*;

    const GONE: &str = "busker/boiler/old";

    /// An outbox that has told two values on a connection, and has one of them no more. What was left by an
    /// earlier run, `busker/boiler/older`, is gone as well.
    fn with_one_gone() -> Outbox {
        let mut outbox = outbox();
        retained(&mut outbox, "busker/boiler/flow", "21.5");
        retained(&mut outbox, GONE, "7");
        outbox.connected();
        take_all(&mut outbox);
        let before = ["busker/boiler/flow", GONE, "busker/boiler/older"].map(String::from);
        outbox.reconfigure([], &before.into(), &told_on());
        outbox
    }

    fn told_on() -> BTreeSet<String> {
        ["busker/boiler/flow".to_string()].into()
    }

    #[track_caller]
    fn check_remembered(outbox: &Outbox, expected: &[&str]) {
        let trees = outbox.trees(told_on());
        assert_eq!(trees.len(), 1);
        assert_eq!(trees[0].base_topic, "busker");
        assert!(trees[0].topics.iter().eq(expected), "{:?}", trees[0].topics);
    }

    const ALL: [&str; 3] = ["busker/boiler/flow", GONE, "busker/boiler/older"];
    const REMOVALS: [&str; 2] = ["busker/boiler/old ", "busker/boiler/older "];

    /// The same, handed over at [`LATER`].
    fn handed_over() -> Outbox {
        let mut outbox = with_one_gone();
        assert!(!outbox.settle(LATER + ARRIVES_WITHIN), "nothing is handed over");
        check_remembered(&outbox, &ALL);
        check_sent(&mut outbox, &REMOVALS);
        outbox
    }

    #[test]
    fn what_was_taken_back_is_remembered_until_it_has_arrived() {
        let mut outbox = handed_over();
        assert!(!outbox.settle(LATER + (ARRIVES_WITHIN - Duration::from_micros(1))));
        check_remembered(&outbox, &ALL);
        // Something else waits just now.
        retained(&mut outbox, "busker/boiler/flow", "22");
        assert!(!outbox.settle(LATER + ARRIVES_WITHIN));
        check_sent(&mut outbox, &["busker/boiler/flow 22"]);
        assert!(outbox.settle(LATER + ARRIVES_WITHIN));
        check_remembered(&outbox, &ALL[..1]);
        assert!(!outbox.settle(LATER + ARRIVES_WITHIN * 2), "it is told once");
        outbox.connected();
        check_sent(&mut outbox, &["busker/boiler/flow 22", "busker/bridge/state online"]);
    }

    #[test]
    fn what_was_taken_back_on_a_connection_that_is_lost_is_taken_back_on_the_next_one() {
        let mut outbox = handed_over();
        outbox.disconnected();
        assert!(!outbox.settle(LATER + ARRIVES_WITHIN * 10), "there is no connection");
        check_remembered(&outbox, &ALL);
        outbox.connected();
        // Meanwhile one of them is there again.
        retained(&mut outbox, "busker/boiler/older", "8");
        let expected =
            ["busker/boiler/flow 21.5", "busker/bridge/state online", "busker/boiler/older 8", REMOVALS[0]];
        check_sent(&mut outbox, &expected);
        assert!(outbox.settle(LATER + ARRIVES_WITHIN));
        check_remembered(&outbox, &ALL[..1]);
    }

    #[test]
    fn what_is_still_to_be_taken_back_when_the_connection_is_lost_is_taken_back_once() {
        let mut outbox = with_one_gone();
        outbox.disconnected();
        outbox.connected();
        let expected = ["busker/boiler/flow 21.5", "busker/bridge/state online", REMOVALS[0], REMOVALS[1]];
        check_sent(&mut outbox, &expected);
    }

    #[test]
    fn while_nothing_was_taken_back_nothing_is_to_be_stored() {
        let mut outbox = outbox();
        retained(&mut outbox, "busker/boiler/flow", "21.5");
        outbox.connected();
        take_all(&mut outbox);
        assert!(!outbox.settle(LATER + ARRIVES_WITHIN * 2));
    }
}
