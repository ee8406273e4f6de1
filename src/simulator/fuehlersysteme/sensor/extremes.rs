//! The least and greatest value of a quantity within the last hours: "gleitende Analyse über den
//! vorgegebenen Zeitraum" (page 12; RWreg_57 to 59, Rreg_55 to 58).

use std::collections::VecDeque;

use crate::engine::time::{Duration, Time};

/// One of the two analyses.
#[derive(Clone, Debug, Default)]
pub struct Extremes {
    current: Option<i16>,
    /// Values that were there until a moment, oldest first: each smaller one is younger than the
    /// greater ones before it would be of use, so those are not kept; and the other way round.
    lows: VecDeque<(Time, i16)>,
    highs: VecDeque<(Time, i16)>,
}

impl Extremes {
    /// The value is this from now on, and was what it was until now.
    pub fn observe(&mut self, now: Time, value: i16, window: Duration) {
        if let Some(before) = self.current.filter(|before| *before != value) {
            push(&mut self.lows, now, before, |kept| kept >= before);
            push(&mut self.highs, now, before, |kept| kept <= before);
        }
        self.current = Some(value);
        for kept in [&mut self.lows, &mut self.highs] {
            while kept.front().is_some_and(|(until, _)| now.since(*until) >= window) {
                kept.pop_front();
            }
        }
    }

    /// 0 where nothing is analysed.
    pub fn low(&self) -> i16 {
        let oldest = self.lows.front().map(|(_, value)| *value);
        oldest.into_iter().chain(self.current).min().unwrap_or(0)
    }

    pub fn high(&self) -> i16 {
        let oldest = self.highs.front().map(|(_, value)| *value);
        oldest.into_iter().chain(self.current).max().unwrap_or(0)
    }
}

fn push(kept: &mut VecDeque<(Time, i16)>, until: Time, value: i16, is_useless: impl Fn(i16) -> bool) {
    while kept.back().is_some_and(|(_, kept)| is_useless(*kept)) {
        kept.pop_back();
    }
    kept.push_back((until, value));
}
