//! When the reply under way is likely to come, learnt from those before it: whoever waits for it can be awake
//! then.

use std::collections::BTreeMap;

use crate::engine::time::{Duration, Time};

/// A reply is expected where its last ones took the same time but for this.
const STEADY_WITHIN: Duration = Duration::from_micros(100);
/// So many of them, one behind the other.
const STEADY_FROM: u32 = 3;
/// Questions that are remembered; before one more, all are forgotten.
const REMEMBERED: usize = 256;

/// Unit, function, address, and count or value.
type Question = [u8; 6];

/// Stands for every question where the reply to one takes as long as that to another.
pub const ANY: Question = [0; 6];

/// What is known of the replies on one line.
#[derive(Debug, Default)]
pub struct Expectation {
    usual: BTreeMap<Question, Usual>,
    asked: Option<(Question, Time)>,
}

/// How long the last reply took, and how many took as long in a row.
#[derive(Clone, Copy, Debug)]
struct Usual {
    took: Duration,
    times: u32,
}

impl Expectation {
    /// This frame was sent.
    pub fn asked(&mut self, frame: &[u8], now: Time) {
        self.asked = frame.first_chunk().map(|question| (*question, now));
    }

    /// Its reply was whole.
    pub fn answered(&mut self, now: Time) {
        let Some((question, asked_at)) = self.asked.take() else { return };
        let took = now - asked_at;
        if self.usual.len() >= REMEMBERED && !self.usual.contains_key(&question) {
            self.usual.clear();
        }
        let usual = self.usual.entry(question).or_insert(Usual { took, times: 0 });
        let is_steady = usual.took.abs_diff(took) <= STEADY_WITHIN;
        *usual = Usual { took, times: if is_steady { usual.times.saturating_add(1) } else { 1 } };
    }

    /// When the reply under way will come if it takes its usual time; `None` where nothing is under way, or
    /// the time is not the same each time.
    pub fn at(&self) -> Option<Time> {
        let (question, asked_at) = self.asked?;
        let usual = self.usual.get(&question).filter(|usual| usual.times >= STEADY_FROM)?;
        Some(asked_at + usual.took)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const READ: [u8; 8] = [1, 3, 0, 0, 0, 20, 69, 197];

    /// What is expected after replies that took these times, when the next is asked for at 10 s.
    fn expected(took: &[u64]) -> Option<u64> {
        let mut expectation = Expectation::default();
        for took in took {
            expectation.asked(&READ, Time(1000));
            expectation.answered(Time(1000 + took));
        }
        assert_eq!(expectation.at(), None, "nothing is under way");
        expectation.asked(&READ, Time(10_000_000));
        expectation.at().map(|at| at.0 - 10_000_000)
    }

    #[test]
    fn a_reply_is_expected_where_three_in_a_row_took_the_same_time() {
        assert_eq!(expected(&[]), None);
        assert_eq!(expected(&[35_000, 35_000]), None);
        assert_eq!(expected(&[35_000, 35_060, 35_020]), Some(35_020));
        assert_eq!(expected(&[9_000, 35_000, 35_060, 35_020]), Some(35_020));
        assert_eq!(expected(&[35_000, 35_060, 35_020, 36_000]), None);
        assert_eq!(expected(&[35_000, 35_080, 35_160, 36_000, 35_160]), None);
    }

    #[test]
    fn questions_are_told_apart_and_one_without_a_reply_teaches_nothing() {
        let mut expectation = Expectation::default();
        let other = [2, 3, 0, 0, 0, 20, 69, 246];
        for took in [5000, 5000, 5000] {
            expectation.asked(&READ, Time(0));
            expectation.answered(Time(took));
            expectation.asked(&READ, Time(0));
            expectation.asked(&other, Time(0));
            assert_eq!(expectation.at(), None);
        }
        expectation.asked(&READ, Time(0));
        assert_eq!(expectation.at(), Some(Time(5000)));
    }

    #[test]
    fn no_more_is_remembered_than_there_is_room_for() {
        let mut expectation = Expectation::default();
        for value in 0..10_000_u16 {
            let [high, low] = value.to_be_bytes();
            expectation.asked(&[1, 6, 0, 0, high, low], Time(0));
            expectation.answered(Time(1));
            assert!(expectation.usual.len() <= REMEMBERED);
        }
    }
}
