//! How a silent device is asked: seldom and cheaply, and yet soon enough after its return.

use crate::engine::time::Duration;

/// So many requests in a row without an answer, and a device counts as offline.
pub(super) const FAILURES_UNTIL_OFFLINE: u32 = 3;
/// The longest pause between two attempts: with the attempt itself, what a device's return may take to
/// be noticed is 15 seconds.
const PAUSE_LONGEST: Duration = Duration::from_secs(14);
/// A silent device may take this part of the bus, as far as [`PAUSE_LONGEST`] lets it.
const SHARE: u32 = 33;
/// What an attempt costs beside the wait: its frame and the silence around it, at 19200 baud.
const FRAME: Duration = Duration::from_millis(7);
/// The shortest wait for the answer to a probe.
const PROBE_SHORTEST: Duration = Duration::from_millis(50);
/// So many times its slowest answer, and a device that is there has answered.
const PROBE_FACTOR: u32 = 3;
/// One slow answer among many shall not make every later probe slow: with each answer the slowest loses
/// this part.
const FADING: u32 = 64;
/// From so many failures on, and then each time that they have doubled, a probe waits as long as any
/// request: a device may come back slower than it went, but such waits must not add up.
const FULL_PROBE_FROM: u32 = 8;
/// Pauses differ by so many hundredths, so that two silent devices do not keep step.
const JITTER_PERCENT: u32 = 6;

/// What is known of a device's way to answer.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Patience {
    /// Requests without an answer since the last answer.
    failures: u32,
    /// From sending a request to its answer's first byte; old ones fade.
    slowest_answer: Option<Duration>,
}

impl Patience {
    pub(super) fn failures(&self) -> u32 {
        self.failures
    }

    pub(super) fn answered(&mut self, latency: Option<Duration>) {
        self.failures = 0;
        let faded = self.slowest_answer.map(|slowest| slowest * (FADING - 1) / FADING);
        self.slowest_answer = faded.max(latency);
    }

    pub(super) fn unanswered(&mut self) {
        self.failures += 1;
    }

    /// A new link: old silence says nothing about it.
    pub(super) fn start_anew(&mut self) {
        self.failures = 0;
    }

    /// Whether the next request only asks whether the device is there again. Nobody waits for a late
    /// answer to it.
    pub(super) fn is_probing(&self) -> bool {
        self.failures >= FAILURES_UNTIL_OFFLINE
    }

    /// How long to wait for the next answer. `full` is what the bus and the profile ask for; a probe
    /// of a device that is offline waits less, but never less than the profile's own `demanded`.
    pub(super) fn timeout(&self, full: Duration, demanded: Option<Duration>) -> Duration {
        let Some(slowest) = self.slowest_answer else { return full };
        let is_full = self.failures >= FULL_PROBE_FROM && self.failures.is_power_of_two();
        if !self.is_probing() || is_full {
            return full;
        }
        (slowest * PROBE_FACTOR).max(PROBE_SHORTEST).max(demanded.unwrap_or_default()).min(full)
    }

    /// How long to leave the device alone after a request that waited for `timeout` in vain: 0.25 s,
    /// 0.5 s, 1 s, and so on up to what keeps it within its share of the bus. `unit` makes the pauses of
    /// several silent devices differ.
    pub(super) fn pause(&self, timeout: Duration, unit: u8) -> Duration {
        let backoff = Duration::from_millis(125 << self.failures.min(8));
        let longest = ((timeout + FRAME) * SHARE).min(PAUSE_LONGEST);
        let jitter = (self.failures.wrapping_mul(7) + u32::from(unit) * 5) % (JITTER_PERCENT + 1);
        backoff.min(longest) * (100 - jitter) / 100
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
            (8, Some(9), None, 500),
            (9, Some(9), None, 50),
            (1024, Some(9), None, 500),
            (4, None, None, 500),
        ] {
            let timeout = silent(failures, slowest).timeout(FULL, demanded.map(Duration::from_millis));
            assert_eq!(timeout, Duration::from_millis(expected), "{failures} {slowest:?} {demanded:?}");
        }
    }

    #[test]
    fn a_silent_device_keeps_within_its_share_and_its_return_is_noticed_in_time() {
        for (known, return_within) in [(Some(9), 2_000), (Some(150), 15_000), (None, 15_000)] {
            let (mut asked, mut passed, mut longest) = (Duration::ZERO, Duration::ZERO, Duration::ZERO);
            let mut patience = silent(20, known);
            for _ in 0..1000 {
                let timeout = patience.timeout(FULL, None);
                patience.unanswered();
                let pause = patience.pause(timeout, 7);
                asked += timeout + FRAME;
                passed += timeout + FRAME + pause;
                if timeout < FULL || known.is_none() {
                    longest = longest.max(timeout + FRAME + pause);
                }
            }
            let share = asked.as_secs_f64() / passed.as_secs_f64();
            assert!(share < if known == Some(9) { 0.032 } else { 0.037 }, "{known:?}: {share}");
            assert!(longest <= Duration::from_millis(return_within), "{known:?}: {longest:?}");
        }
    }

    #[test]
    fn one_slow_answer_is_forgotten_after_many_quick_ones() {
        let mut patience = silent(0, Some(400));
        (0..300).for_each(|_| patience.answered(Some(Duration::from_millis(12))));
        (0..3).for_each(|_| patience.unanswered());
        assert_eq!(patience.timeout(FULL, None), Duration::from_millis(50));
    }

    #[test]
    fn pauses_double_and_differ_from_device_to_device() {
        let pauses = |unit: u8| -> Vec<u128> {
            (1..=4).map(|failures| silent(failures, None).pause(FULL, unit).as_millis()).collect()
        };
        assert_eq!(pauses(0), [250, 500, 1000, 2000].map(|pause: u128| pause).to_vec());
        assert_ne!(pauses(1), pauses(2));
    }
}
