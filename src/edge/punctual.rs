//! How late this thread wakes up, learnt while it runs: so that what must happen at a moment happens then.
//!
//! A core that sleeps needs some 50 µs to wake up, and the silence before a frame is 2 ms in a transaction
//! of 37, or 1.75 in one of 7. A sleep therefore ends a little before its moment, and the rest is spun.

use crate::engine::time::{Duration, Time};

/// Waits that are remembered.
const REMEMBERED: usize = 32;
/// What nine of ten wake-ups need, and so much more, is spun.
const RESERVE: Duration = Duration::from_micros(20);
/// On a machine that is busy with other things a thread may wake up very late; spinning would not help.
const SPIN_MAX: Duration = Duration::from_micros(200);
/// More than this is never taken for the time that a wake-up needs at least: where all of them were later,
/// the thread had to wait for others, and need not have waited this time.
const LEAST_MAX: u64 = 60;
/// A shorter sleep says nothing: the core has hardly begun to sleep.
const SLEEP_MIN: Duration = Duration::from_micros(200);

/// A bus that rested so lately has time to spare, and none is spun for it: that would cost more than all
/// else it does.
const RESTED_LATELY: Duration = Duration::from_secs(1);

/// Whether a bus has time to spare, so that nobody would gain by being punctual.
#[derive(Clone, Copy, Debug, Default)]
pub struct Leisure {
    /// When the bus last had nothing to do.
    rested_at: Option<Time>,
}

impl Leisure {
    /// The bus had nothing to do until `now`.
    pub fn rested(&mut self, now: Time) {
        self.rested_at = Some(now);
    }

    pub fn is_calm(&self, at: Time) -> bool {
        self.rested_at.is_some_and(|rested_at| at.since(rested_at) < RESTED_LATELY)
    }
}

/// The lags of one thread's latest wake-ups, in microseconds.
#[derive(Clone, Copy, Debug, Default)]
pub struct Punctual {
    lags: [u64; REMEMBERED],
    seen: usize,
    /// Of all wake-ups so far.
    least: Option<u64>,
}

impl Punctual {
    /// A sleep from `since` that was to end at `until` has ended at `now`, because of nothing else.
    pub fn slept(&mut self, since: Time, until: Time, now: Time) {
        if until - since >= SLEEP_MIN {
            let lag = (now - until).as_micros() as u64;
            self.lags[self.seen % REMEMBERED] = lag;
            self.seen += 1;
            self.least = Some(self.least.map_or(lag, |least| least.min(lag)));
        }
    }

    /// When to end a sleep so as to be awake at `at`; the rest is to be spun.
    pub fn sleep_until(&self, at: Time) -> Time {
        let Some(usual) = self.usual(9) else { return at };
        at.before((usual + RESERVE).min(SPIN_MAX))
    }

    /// The same for who can do without: in half of all cases it comes too late, and spins so much less.
    pub fn doze_until(&self, at: Time) -> Time {
        at.before(self.usual(5).unwrap_or_default().min(SPIN_MAX))
    }

    /// What so many of ten wake-ups need at most.
    fn usual(&self, of_ten: usize) -> Option<Duration> {
        let mut lags = self.lags;
        let known = &mut lags[..self.seen.min(REMEMBERED)];
        known.sort_unstable();
        known.get(known.len() * of_ten / 10).map(|lag| Duration::from_micros(*lag))
    }

    /// What woke this thread at `now` from a sleep since `since` happened by then at the latest: no
    /// wake-up has ever been quicker.
    pub fn woken_by(&self, since: Time, now: Time) -> Time {
        let least = self.least.unwrap_or_default().min(LEAST_MAX);
        now.before(Duration::from_micros(least)).max(since)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(lags: &[u64]) -> Punctual {
        let mut punctual = Punctual::default();
        for lag in lags {
            punctual.slept(Time(0), Time(1000), Time(1000 + lag));
        }
        punctual
    }

    #[test]
    fn a_sleep_ends_early_by_what_most_wake_ups_need() {
        assert_eq!(Punctual::default().sleep_until(Time(5000)), Time(5000));
        assert_eq!(after(&[50; 10]).sleep_until(Time(5000)), Time(4930));
        assert_eq!(after(&[60, 50, 50, 50, 50, 50, 50, 50, 50, 50]).sleep_until(Time(5000)), Time(4920));
        assert_eq!(after(&[9000; 10]).sleep_until(Time(5000)), Time(4800));
        assert_eq!(after(&[50; 10]).sleep_until(Time(10)), Time(0));
    }

    #[test]
    fn only_the_latest_wake_ups_count_and_short_sleeps_do_not() {
        let mut punctual = after(&[9000; 40]);
        (0..REMEMBERED).for_each(|_| punctual.slept(Time(0), Time(1000), Time(1040)));
        assert_eq!(punctual.sleep_until(Time(5000)), Time(4940));
        punctual.slept(Time(0), Time(100), Time(101));
    }

    #[test]
    fn who_dozes_is_awake_in_half_of_all_cases() {
        assert_eq!(Punctual::default().doze_until(Time(5000)), Time(5000));
        assert_eq!(after(&[90, 10, 30, 20, 80]).doze_until(Time(5000)), Time(4970));
        assert_eq!(after(&[9000; 10]).doze_until(Time(5000)), Time(4800));
    }

    #[test]
    fn a_bus_that_rested_lately_has_time_to_spare() {
        let mut leisure = Leisure::default();
        assert!(!leisure.is_calm(Time(5000)));
        leisure.rested(Time(1_000_000));
        assert!(leisure.is_calm(Time(1_900_000)));
        assert!(!leisure.is_calm(Time(2_000_000)));
    }

    #[test]
    fn what_woke_the_thread_came_before_but_not_before_the_sleep() {
        assert_eq!(after(&[]).woken_by(Time(0), Time(5000)), Time(5000));
        assert_eq!(after(&[70, 50, 90]).woken_by(Time(0), Time(5000)), Time(4950));
        assert_eq!(after(&[70, 50, 90]).woken_by(Time(4980), Time(5000)), Time(4980));
    }

    #[test]
    fn nobody_is_thought_to_wake_slowly_who_had_to_wait_for_others() {
        assert_eq!(after(&[2000; 40]).woken_by(Time(0), Time(5000)), Time(4940));
        let mut punctual = after(&[30]);
        (0..100).for_each(|_| punctual.slept(Time(0), Time(1000), Time(1050)));
        assert_eq!(punctual.woken_by(Time(0), Time(5000)), Time(4970));
    }
}
