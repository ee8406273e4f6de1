//! How a silent device is asked: seldom and cheaply, and yet soon enough after its return.

use super::super::line::at_random;
use crate::engine::time::{Duration, Time};

/// So many requests in a row without an answer, and a device counts as offline.
pub const FAILURES_UNTIL_OFFLINE: u32 = 3;
/// A device that has not answered is left alone for so long at least: half of the first pause, which is random.
pub const LEFT_ALONE_LEAST: Duration = Duration::from_millis(125);
/// The longest pause between two attempts: with the attempt itself, what a device's return may take to
/// be noticed is 15 seconds.
const PAUSE_LONGEST: Duration = Duration::from_millis(14_200);
/// A pause is so many times as long as what it follows: a silent device makes the others some 2.3 % slower, as
/// far as [`PAUSE_LONGEST`] lets it. Of the 3 % that it may cost, the rest is for what is not foreseen here.
const SHARE: u32 = 44;
/// What an attempt costs beside the wait: its frame and the silence around it, at 19200 baud.
const FRAME: Duration = Duration::from_millis(7);
/// The shortest wait for the answer to a probe.
const PROBE_SHORTEST: Duration = Duration::from_millis(30);
/// So many times its slowest answer, and a device that is there has answered.
const PROBE_FACTOR: u32 = 2;
/// Of a device that has never answered nothing is known. Every other probe gives it the whole time; those
/// between give it so much, in which nearly every device answers: to wait for the whole time each time
/// would cost more than its share, or come too seldom.
const PROBE_OF_UNKNOWN: Duration = Duration::from_millis(100);
/// One slow answer among many shall not make every later probe slow: with each answer the slowest loses
/// this part.
const FADING: u32 = 64;
/// A device that has answered before may come back slower than it went. Its answer to a probe is late then,
/// but it is heard, or spoils what another one says: the next probe waits as long as any request. When that
/// one is in vain, no other such sign counts for so many probes (some 13 seconds), and then for twice as many.
const SIGNS_APART: u32 = 8;
const SIGNS_APART_LONGEST: u32 = 256;
/// And if no sign reaches us: from so many failures on (some two minutes), and then each time that they have
/// doubled, so seldom that it does not count in the device's share.
const FULL_PROBE_FROM: u32 = 64;
/// And at the latest after so many, which may be two hours.
const FULL_PROBE_EACH: u32 = 512;
/// Pauses differ at random, so that two silent devices do not keep step with each other, nor one with something
/// that disturbs the line at regular times. One of a device that is there is shorter or longer by up to a half, to
/// leave whatever spoils a third of the time;
const SPREAD_PRESENT_PERCENT: u32 = 100;
/// one of a device that is offline by up to a tenth, but never by more than this, or its share of the bus and the
/// time of its return would not be kept.
const SPREAD_OFFLINE_PERCENT: u32 = 20;
const SPREAD_OFFLINE_LONGEST: Duration = Duration::from_millis(300);

/// A device that is there and is asked the usual is waited for so many times its slowest answer lately,
const HURRIED_FACTOR: u32 = 4;
/// but so long at least: the specification gives the slowest unit that time to carry out a broadcast (Modbus
/// over serial line V1.02, 2.4.1), and an adapter may hold back bytes for some hundredths of a second.
const HURRIED_SHORTEST: Duration = Duration::from_millis(200);
/// The slowest answer is remembered for so long at least, and twice as long at most.
const SLOWEST_KEPT: Duration = Duration::from_secs(30 * 60);

/// What is known of a device's way to answer.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Patience {
    /// Requests without an answer since the last answer.
    failures: u32,
    /// From sending a request to its answer's first byte; old ones fade.
    slowest_answer: Option<Duration>,
    /// The slowest answer to a read, late ones too: since [`Patience::lately_since`], and in the time before it.
    slowest_lately: [Duration; 2],
    lately_since: Time,
    /// There is a sign that it is back: the next probe waits fully.
    is_expected: bool,
    /// Signs of its return that were none, since it last answered; and from how many failures on the next
    /// one counts.
    false_signs: u32,
    signs_count_from: u32,
}

impl Patience {
    pub(super) fn failures(&self) -> u32 {
        self.failures
    }

    pub(super) fn answered(&mut self, latency: Option<Duration>) {
        self.start_anew();
        let faded = self.slowest_answer.map(|slowest| slowest * (FADING - 1) / FADING);
        self.slowest_answer = faded.max(latency);
    }

    /// A read was answered after this time, be it late.
    pub(super) fn took(&mut self, now: Time, time: Duration) {
        if now - self.lately_since >= SLOWEST_KEPT {
            self.slowest_lately = [Duration::ZERO, self.slowest_lately[0]];
            self.lately_since = now;
        }
        self.slowest_lately[0] = self.slowest_lately[0].max(time);
    }

    /// How long to wait for the answer to something that the device has often been asked of late. Who has just
    /// left something unanswered is waited for fully.
    pub(super) fn hurried_timeout(&self, full: Duration, demanded: Option<Duration>) -> Duration {
        let [lately, before] = self.slowest_lately;
        let short = (lately.max(before) * HURRIED_FACTOR).max(HURRIED_SHORTEST);
        if self.failures == 0 { short.max(demanded.unwrap_or_default()).min(full) } else { full }
    }

    pub(super) fn unanswered(&mut self) {
        self.failures += 1;
        if std::mem::take(&mut self.is_expected) {
            let apart = (SIGNS_APART << self.false_signs.min(8)).min(SIGNS_APART_LONGEST);
            self.signs_count_from = self.failures + apart;
            self.false_signs += 1;
        }
    }

    /// A new link: old silence says nothing about it.
    pub(super) fn start_anew(&mut self) {
        self.failures = 0;
        self.is_expected = false;
        self.false_signs = 0;
        self.signs_count_from = 0;
    }

    /// While it is silent: something was heard that may be its late answer to a probe. Returns whether it is
    /// worth asking at once.
    pub(super) fn shows_sign(&mut self) -> bool {
        self.is_expected |= self.is_probing() && self.failures >= self.signs_count_from;
        self.is_expected
    }

    /// Whether the next request only asks whether the device is there again. Nobody waits for a late
    /// answer to it.
    pub(super) fn is_probing(&self) -> bool {
        self.failures >= FAILURES_UNTIL_OFFLINE
    }

    /// How long to wait for the next answer. `full` is what the bus and the profile ask for; a probe
    /// of a device that is offline waits less, but never less than the profile's own `demanded`.
    pub(super) fn timeout(&self, full: Duration, demanded: Option<Duration>) -> Duration {
        if self.is_probing() && !self.is_expected && !self.is_full_probe() {
            self.short_probe(full, demanded)
        } else {
            full
        }
    }

    fn is_full_probe(&self) -> bool {
        match self.slowest_answer {
            None => self.failures % 2 == 0,
            Some(_) => {
                let has_doubled = self.failures >= FULL_PROBE_FROM && self.failures.is_power_of_two();
                has_doubled || self.failures % FULL_PROBE_EACH == 0
            }
        }
    }

    fn short_probe(&self, full: Duration, demanded: Option<Duration>) -> Duration {
        let short = match self.slowest_answer {
            None => PROBE_OF_UNKNOWN,
            Some(slowest) => (slowest * PROBE_FACTOR).max(PROBE_SHORTEST),
        };
        short.max(demanded.unwrap_or_default()).min(full)
    }

    /// The pause after which what took so much of the bus is within a silent device's share.
    pub(super) fn pause_after(taken: Duration) -> Duration {
        (taken * SHARE).min(PAUSE_LONGEST)
    }

    /// How long to leave the device alone after a request in vain: some 0.25 s, 0.5 s, 1 s, and so on up to
    /// what keeps it within its share of the bus. A probe that waited longer than most is followed by no
    /// longer pause, or the device's return would be noticed late just then.
    pub(super) fn pause(&self, now: Time, full: Duration, demanded: Option<Duration>) -> Duration {
        let short = self.short_probe(full, demanded);
        let usual = if self.slowest_answer.is_some() { short } else { (short + full) / 2 };
        let backoff = LEFT_ALONE_LEAST * (1 << self.failures.min(8));
        let pause = backoff.min(Patience::pause_after(usual + FRAME));
        let spread = match self.is_probing() {
            false => pause * SPREAD_PRESENT_PERCENT / 100,
            true => (pause * SPREAD_OFFLINE_PERCENT / 100).min(SPREAD_OFFLINE_LONGEST),
        };
        pause - spread / 2 + at_random(now, spread)
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
            (3, Some(9), None, 30),
            (4, Some(40), None, 80),
            (4, Some(400), None, 500),
            (4, Some(9), Some(300), 300),
            (8, Some(9), None, 30),
            (64, Some(9), None, 500),
            (65, Some(9), None, 30),
            (1024, Some(9), None, 500),
            (1536, Some(9), None, 500),
            (2, None, None, 500),
            (3, None, None, 100),
            (4, None, None, 500),
            (5, None, Some(300), 300),
        ] {
            let timeout = silent(failures, slowest).timeout(FULL, demanded.map(Duration::from_millis));
            assert_eq!(timeout, Duration::from_millis(expected), "{failures} {slowest:?} {demanded:?}");
        }
    }

    /// What two probes of it cost, beside what the others got meanwhile, in the mean over `probes`; and how
    /// long it was between two of them at most.
    fn cost(known: Option<u64>, from: u32, probes: u32) -> (f64, Duration) {
        let (mut asked, mut left, mut longest) = (Duration::ZERO, Duration::ZERO, Duration::ZERO);
        let mut patience = silent(from, known);
        for _ in 0..probes {
            let took = patience.timeout(FULL, None) + FRAME;
            patience.unanswered();
            let pause = patience.pause(Time::default() + asked + left, FULL, None);
            (asked, left, longest) = (asked + took, left + pause, longest.max(took + pause));
        }
        (asked.as_secs_f64() / left.as_secs_f64(), longest)
    }

    #[test]
    fn a_silent_device_keeps_within_its_share_and_its_return_is_noticed_in_time() {
        // 10: the pauses have grown to their full length.
        for (known, from, probes) in
            [(Some(13), 10, 50), (Some(13), 10, 5000), (None, 10, 2), (None, 10, 100)]
        {
            let (cost, longest) = cost(known, from, probes);
            assert!(cost <= 0.025, "{known:?} {from} {probes}: {cost}");
            let return_within = if known.is_some() { 1_820 } else { 14_250 };
            // A full probe comes late itself, once in minutes.
            let longest = if probes > 50 && known.is_some() { longest - FULL } else { longest };
            assert!(longest <= Duration::from_millis(return_within), "{known:?}: {longest:?}");
        }
        // A slow one may cost more, but is not left alone for longer.
        assert!(cost(Some(150), 10, 100).1 <= Duration::from_secs(15));
    }

    #[test]
    fn a_known_device_is_waited_for_four_times_its_slowest_answer_of_the_last_half_hour() {
        let ms = Duration::from_millis;
        for (slowest, demanded, expected) in
            [(9, None, 200), (60, None, 240), (130, None, 500), (9, Some(300), 300), (9, Some(700), 500)]
        {
            let mut patience = silent(0, Some(9));
            patience.took(Time::default(), ms(slowest));
            assert_eq!(
                patience.hurried_timeout(FULL, demanded.map(ms)),
                ms(expected),
                "{slowest} {demanded:?}"
            );
            // Who has just left something unanswered is waited for fully.
            patience.unanswered();
            assert_eq!(patience.hurried_timeout(FULL, demanded.map(ms)), FULL);
        }
        let mut patience = silent(0, Some(9));
        let expected = |minutes: u64| if minutes < 65 { ms(400) } else { ms(200) };
        patience.took(Time::from_millis(9 * 60_000), ms(100));
        for minutes in [10, 35, 64, 65] {
            patience.took(Time::from_millis(minutes * 60_000), ms(9));
            assert_eq!(patience.hurried_timeout(FULL, None), expected(minutes), "{minutes}");
        }
    }

    #[test]
    fn a_sign_of_its_return_is_worth_a_long_probe_but_not_again_and_again() {
        let full = |patience: &Patience| patience.timeout(FULL, None) == FULL;
        let mut patience = silent(2, Some(9));
        assert!(!patience.shows_sign(), "it is not even offline");
        patience = silent(5, Some(9));
        assert!(!full(&patience) && patience.shows_sign() && full(&patience));
        patience.unanswered();
        // Signs without end, on a line with much noise.
        let mut long_probes = Vec::new();
        for probe in 0..50 {
            patience.shows_sign();
            if full(&patience) {
                long_probes.push(probe);
            }
            patience.unanswered();
        }
        assert_eq!(long_probes, [8, 25]);
        patience.answered(Some(Duration::from_millis(9)));
        (0..4).for_each(|_| patience.unanswered());
        assert!(patience.shows_sign() && full(&patience), "an answer was the best sign");
    }

    #[test]
    fn one_slow_answer_is_forgotten_after_many_quick_ones() {
        let mut patience = silent(0, Some(400));
        (0..300).for_each(|_| patience.answered(Some(Duration::from_millis(12))));
        (0..3).for_each(|_| patience.unanswered());
        assert_eq!(patience.timeout(FULL, None), PROBE_SHORTEST);
    }

    #[test]
    fn pauses_double_and_differ_from_time_to_time() {
        for (failures, doubled, spread) in [(1, 250, 250), (2, 500, 500), (3, 1000, 200), (4, 2000, 300)] {
            let pauses: Vec<u64> = (0..100)
                .map(|time| silent(failures, None).pause(Time(time * 37_411), FULL, None).as_millis() as u64)
                .collect();
            let (shortest, longest) = (pauses.iter().min(), pauses.iter().max());
            assert!(pauses.iter().all(|pause| (doubled - spread / 2..=doubled + spread / 2).contains(pause)));
            assert!(longest.zip(shortest).is_some_and(|(long, short)| long - short > spread * 8 / 10));
        }
    }
}
