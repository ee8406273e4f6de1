//! How long the thread of all connections sleeps before the first of many replies, so as to be awake when it comes.
//!
//! A core that sleeps then hears it late, and every other reply behind it as well. To be awake costs time of a
//! processor, and most of the time one reply follows another anyway. So it is done only behind a long sleep.

use crate::edge::punctual::Punctual;
use crate::engine::time::{Duration, Time};

/// So long before its usual time, and so long behind it, a reply is waited for without sleeping.
const AWAKE_BEFORE: Duration = Duration::from_micros(20);
const AWAKE_BEHIND: Duration = Duration::from_micros(10);
/// Shorter sleeps are many, and a core is soon awake again behind them.
const SLEEP_MIN: Duration = Duration::from_micros(200);

/// A stretch of time in which a reply is waited for without sleeping.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Awake {
    pub from: Time,
    pub until: Time,
}

impl Awake {
    /// `expected`: when replies under way will most likely come. `wake_at`: when there is something else to do.
    /// `None`: no reply is expected, or not after a sleep that is long enough.
    pub fn for_the_next(
        expected: impl Iterator<Item = Time>,
        wake_at: Option<Time>,
        punctual: &Punctual,
        now: Time,
    ) -> Option<Awake> {
        // One that is overdue may be lost.
        let next = expected.filter(|at| now < *at + AWAKE_BEHIND).min()?;
        let (from, until) = (next.before(AWAKE_BEFORE), next + AWAKE_BEHIND);
        if from < now + SLEEP_MIN || wake_at.is_some_and(|at| until >= at) {
            return None;
        }
        let from = punctual.doze_until(from);
        (from >= now + SLEEP_MIN).then_some(Awake { from, until })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// When a thread is awake that sleeps from 10 ms on, and wakes up 30 µs late.
    fn awake(expected: &[u64], wake_at: Option<u64>) -> Option<(u64, u64)> {
        let mut punctual = Punctual::default();
        (0..10).for_each(|_| punctual.slept(Time(0), Time(1000), Time(1030)));
        let expected = expected.iter().map(|at| Time(*at));
        let awake = Awake::for_the_next(expected, wake_at.map(Time), &punctual, Time(10_000))?;
        Some((awake.from.0, awake.until.0))
    }

    #[test]
    fn it_ends_before_the_first_reply_by_what_a_wake_up_needs() {
        assert_eq!(awake(&[], None), None);
        assert_eq!(awake(&[11_500, 11_000, 12_000], None), Some((10_950, 11_010)));
    }

    #[test]
    fn a_reply_that_is_overdue_is_not_waited_for() {
        assert_eq!(awake(&[9_000, 11_000], None), Some((10_950, 11_010)));
        assert_eq!(awake(&[9_990], None), None);
    }

    #[test]
    fn behind_a_short_sleep_nothing_is_gained() {
        assert_eq!(awake(&[10_249], None), None);
        assert_eq!(awake(&[10_250], None), Some((10_200, 10_260)));
        // The one that comes first decides.
        assert_eq!(awake(&[9_995, 11_000], None), None);
    }

    #[test]
    fn what_else_is_to_be_done_is_done_in_time() {
        assert_eq!(awake(&[11_000], Some(11_010)), None);
        assert_eq!(awake(&[11_000], Some(11_011)), Some((10_950, 11_010)));
    }
}
