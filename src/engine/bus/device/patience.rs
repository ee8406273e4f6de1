//! How a silent device is asked: seldom and cheaply, and yet soon enough after its return.

use crate::engine::time::Duration;

/// So many requests in a row without an answer, and a device counts as offline.
pub(super) const FAILURES_UNTIL_OFFLINE: u32 = 3;
/// The longest pause between two attempts: what a device's return may take to be noticed.
const PAUSE_LONGEST: Duration = Duration::from_secs(12);
/// A silent device may take this part of the bus, as far as [`PAUSE_LONGEST`] lets it.
const SHARE: u32 = 33;
/// The shortest wait for the answer to a probe.
const PROBE_SHORTEST: Duration = Duration::from_millis(50);
/// So many times its slowest answer, and a device that is there has answered.
const PROBE_FACTOR: u32 = 3;
/// Of so many probes one waits as long as any request: a device may come back slower than it went.
const FULL_PROBE_EVERY: u32 = 5;

/// What is known of a device's way to answer.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Patience {
    /// Requests without an answer since the last answer.
    failures: u32,
    /// From sending a request to its answer's first byte.
    slowest_answer: Option<Duration>,
}

impl Patience {
    pub(super) fn failures(&self) -> u32 {
        self.failures
    }

    pub(super) fn answered(&mut self, latency: Option<Duration>) {
        self.failures = 0;
        self.slowest_answer = self.slowest_answer.max(latency);
    }

    pub(super) fn unanswered(&mut self) {
        self.failures += 1;
    }

    /// A new link: old silence says nothing about it.
    pub(super) fn start_anew(&mut self) {
        self.failures = 0;
    }

    /// How long to wait for the next answer. `full` is what the bus and the profile ask for; a probe
    /// of a device that is offline waits less, but never less than the profile's own `demanded`.
    pub(super) fn timeout(&self, full: Duration, demanded: Option<Duration>) -> Duration {
        let Some(slowest) = self.slowest_answer else { return full };
        if self.failures < FAILURES_UNTIL_OFFLINE || self.failures % FULL_PROBE_EVERY == 0 {
            return full;
        }
        (slowest * PROBE_FACTOR).max(PROBE_SHORTEST).max(demanded.unwrap_or_default()).min(full)
    }

    /// How long to leave the device alone after a request that waited for `timeout` in vain: 0.25 s,
    /// 0.5 s, 1 s, and so on up to what keeps it within its share of the bus. Waiting for the late
    /// reply that must not meet the next request costs as much again as the timeout.
    pub(super) fn pause(&self, timeout: Duration) -> Duration {
        let backoff = Duration::from_millis(125 << self.failures.min(8));
        backoff.min(timeout * 2 * SHARE).min(PAUSE_LONGEST)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FULL: Duration = Duration::from_millis(500);

    fn silent(failures: u32, slowest: Option<u64>) -> Patience {
        let mut patience = Patience::default();
        patience.answered(slowest.map(Duration::from_millis));
        (0..failures).for_each(|_| patience.unanswered());
        patience
    }

    #[test]
    fn a_probe_waits_no_longer_than_the_device_ever_took() {
        for (failures, slowest, demanded, expected) in [
            (0, Some(9), None, 500),
            (2, Some(9), None, 500),
            (3, Some(9), None, 50),
            (4, Some(40), None, 120),
            (4, Some(400), None, 500),
            (4, Some(9), Some(300), 300),
            (5, Some(9), None, 500),
            (4, None, None, 500),
        ] {
            let timeout = silent(failures, slowest).timeout(FULL, demanded.map(Duration::from_millis));
            assert_eq!(timeout, Duration::from_millis(expected), "{failures} {slowest:?} {demanded:?}");
        }
    }

    #[test]
    fn a_silent_device_keeps_within_its_share_and_its_return_is_noticed_in_time() {
        let probe = Duration::from_millis(50);
        assert_eq!(silent(20, Some(9)).pause(probe), Duration::from_millis(3300));
        assert_eq!(silent(20, None).pause(FULL), PAUSE_LONGEST);
        let pauses: Vec<u128> =
            (1..=4).map(|failures| silent(failures, None).pause(FULL).as_millis()).collect();
        assert_eq!(pauses, [250, 500, 1000, 2000]);
    }
}
