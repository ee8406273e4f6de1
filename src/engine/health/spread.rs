//! How a time is spread: a histogram of fixed size, since the start and lately.
//!
//! What is counted since the start is what a scraper wants; a person wants to know how it is now, and
//! after a week nothing moves a percentile of everything any more. So there are two windows beside the
//! whole, of which the younger fills while the older still counts.

use crate::engine::time::{Duration, Time};

/// The upper bounds of a decade's buckets, in units of its beginning.
const OF_DECADE: [u64; 6] = [10, 15, 20, 30, 50, 70];
/// From 10 µs to 7 s.
const DECADES: usize = 6;
const BOUNDS: usize = OF_DECADE.len() * DECADES;
/// One for what is above all bounds.
const BUCKETS: usize = BOUNDS + 1;
/// Of the bounds of a decade, those that a scraper is told: 1, 2 and 5.
const TOLD: [usize; 3] = [0, 2, 4];
/// The buckets that a scraper is told, the one above all bounds included.
pub const TOLD_BUCKETS: usize = TOLD.len() * DECADES + 1;

/// The upper bound of each bucket, in microseconds.
const UPPER: [u64; BOUNDS] = {
    let mut bounds = [0; BOUNDS];
    let mut bucket = 0;
    while bucket < BOUNDS {
        bounds[bucket] = OF_DECADE[bucket % OF_DECADE.len()] * 10u64.pow((bucket / OF_DECADE.len()) as u32);
        bucket += 1;
    }
    bounds
};

/// Many times of one kind.
#[derive(Clone, Debug)]
pub struct Spread {
    sum: Duration,
    window: Duration,
    /// The number of the younger window, counted from the start, and when it ends.
    number: u64,
    ends_at: Time,
    young: Extremes,
    old: Extremes,
    buckets: [Bucket; BUCKETS],
}

/// How many times were within its bounds. They lie together: with a thousand devices none of this is near when the
/// next reply comes, and each piece of it has to be fetched.
#[derive(Clone, Copy, Debug, Default)]
struct Bucket {
    ever: u32,
    young: u16,
    old: u16,
}

/// Of a window, in microseconds.
#[derive(Clone, Copy, Debug)]
struct Extremes {
    least: u32,
    most: u32,
}

impl Extremes {
    const NONE: Extremes = Extremes { least: u32::MAX, most: 0 };
}

/// What is told of a [`Spread`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SpreadReport {
    /// Since the start, by [`SpreadReport::bounds`]; the last one is what lies above them.
    pub counts: [u32; TOLD_BUCKETS],
    pub sum: Duration,
    /// `None`: there was none lately.
    pub lately: Option<Percentiles>,
}

/// So many of a hundred took no longer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Percentiles {
    pub p50: Duration,
    pub p95: Duration,
    pub p99: Duration,
}

impl Spread {
    /// `window`: what is told of as lately is between this and twice as long ago.
    pub fn new(window: Duration) -> Spread {
        let ends_at = Time::default() + window;
        let (young, old) = (Extremes::NONE, Extremes::NONE);
        let buckets = [Bucket::default(); BUCKETS];
        Spread { sum: Duration::ZERO, window, number: 0, ends_at, young, old, buckets }
    }

    pub fn add(&mut self, now: Time, time: Duration) {
        self.turn_to(now);
        let micros = time.as_micros() as u64;
        self.sum += time;
        let bucket = UPPER.partition_point(|bound| *bound < micros);
        if self.buckets[bucket].young == u16::MAX {
            // The shares stay as they are; a bucket that is full while others fill would not tell its own.
            self.buckets.iter_mut().for_each(|bucket| bucket.young /= 2);
        }
        let bucket = &mut self.buckets[bucket];
        bucket.ever = bucket.ever.saturating_add(1);
        bucket.young += 1;
        let micros = micros.min(u64::from(u32::MAX)) as u32;
        self.young.least = self.young.least.min(micros);
        self.young.most = self.young.most.max(micros);
    }

    pub fn report(&self, now: Time) -> SpreadReport {
        let mut current = self.clone();
        current.turn_to(now);
        let mut counts = [0; TOLD_BUCKETS];
        let mut told = 0;
        for (number, bucket) in self.buckets.iter().enumerate() {
            counts[told] += bucket.ever;
            if number < BOUNDS && TOLD.contains(&(number % OF_DECADE.len())) {
                told += 1;
            }
        }
        SpreadReport { counts, sum: self.sum, lately: current.percentiles() }
    }

    /// Lets windows pass that are over.
    fn turn_to(&mut self, now: Time) {
        if now < self.ends_at {
            return;
        }
        let window = (self.window.as_micros() as u64).max(1);
        let number = now.0 / window;
        let is_next = number == self.number + 1;
        for bucket in &mut self.buckets {
            bucket.old = if is_next { bucket.young } else { 0 };
            bucket.young = 0;
        }
        self.old = if is_next { self.young } else { Extremes::NONE };
        self.young = Extremes::NONE;
        (self.number, self.ends_at) = (number, Time((number + 1) * window));
    }

    fn percentiles(&self) -> Option<Percentiles> {
        let count_of = |bucket: usize| {
            let Bucket { young, old, .. } = self.buckets[bucket];
            u32::from(young) + u32::from(old)
        };
        let count: u32 = (0..BUCKETS).map(count_of).sum();
        if count == 0 {
            return None;
        }
        let least = f64::from(self.young.least.min(self.old.least));
        let most = f64::from(self.young.most.max(self.old.most));
        let percentile = |share: f64| {
            let rank = share * f64::from(count);
            let mut below = 0.0;
            for bucket in 0..BUCKETS {
                let inside = f64::from(count_of(bucket));
                if inside > 0.0 && below + inside >= rank {
                    let from = if bucket == 0 { 0.0 } else { UPPER[bucket - 1] as f64 };
                    let to = if bucket < BOUNDS { UPPER[bucket] as f64 } else { most };
                    // No time lies outside of those that were seen, whatever the bounds are.
                    let (from, to) = (from.clamp(least, most), to.clamp(least, most));
                    return Duration::from_micros(
                        (from + (to - from) * (rank - below) / inside).round() as u64
                    );
                }
                below += inside;
            }
            Duration::from_micros(most as u64)
        };
        Some(Percentiles { p50: percentile(0.5), p95: percentile(0.95), p99: percentile(0.99) })
    }
}

impl SpreadReport {
    /// The upper bounds of all but the last count.
    pub fn bounds() -> impl Iterator<Item = Duration> {
        let is_told = |bucket: &usize| TOLD.contains(&(bucket % OF_DECADE.len()));
        (0..BOUNDS).filter(is_told).map(|bucket| Duration::from_micros(UPPER[bucket]))
    }
}

/// What is polled is asked often enough to know how it was in the last ten minutes or twenty.
const OF_REQUESTS: Duration = Duration::from_secs(10 * 60);
/// Commands are rare.
const OF_COMMANDS: Duration = Duration::from_secs(24 * 60 * 60);

/// The times of one bus, or of one device. What has never happened takes no memory, but for what happens with every
/// request: that lies beside whatever else of the device is needed then.
#[derive(Clone, Debug, Default)]
pub struct Timing {
    turnaround: Option<Spread>,
    gap_wait: Option<Spread>,
    lateness: Option<Box<Spread>>,
    command_wait: Option<Box<Spread>>,
}

impl Timing {
    /// A device took so long from the request's last character to the first one of its answer.
    pub fn turned_around(&mut self, now: Time, time: Duration) {
        add_always(&mut self.turnaround, now, time);
    }

    /// A request waited so long for the line to be silent.
    pub fn waited_for_gap(&mut self, now: Time, time: Duration) {
        add_always(&mut self.gap_wait, now, time);
    }

    /// A request began so long after it could have.
    pub fn began_late(&mut self, now: Time, time: Duration) {
        add_seldom(&mut self.lateness, OF_REQUESTS, now, time);
    }

    /// A command waited so long until it was on the wire.
    pub fn command_waited(&mut self, now: Time, time: Duration) {
        add_seldom(&mut self.command_wait, OF_COMMANDS, now, time);
    }

    pub fn report(&self, now: Time) -> TimingReport {
        let report = |spread: Option<&Spread>| spread.map(|spread| spread.report(now));
        TimingReport {
            turnaround: report(self.turnaround.as_ref()),
            gap_wait: report(self.gap_wait.as_ref()),
            lateness: report(self.lateness.as_deref()),
            command_wait: report(self.command_wait.as_deref()),
        }
    }
}

fn add_always(spread: &mut Option<Spread>, now: Time, time: Duration) {
    spread.get_or_insert_with(|| Spread::new(OF_REQUESTS)).add(now, time);
}

fn add_seldom(spread: &mut Option<Box<Spread>>, window: Duration, now: Time, time: Duration) {
    spread.get_or_insert_with(|| Box::new(Spread::new(window))).add(now, time);
}

/// What is told of a [`Timing`]; `None`: it has never happened.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TimingReport {
    pub turnaround: Option<SpreadReport>,
    pub gap_wait: Option<SpreadReport>,
    pub lateness: Option<SpreadReport>,
    pub command_wait: Option<SpreadReport>,
}

impl TimingReport {
    /// Each with its name, in JSON and in metrics.
    pub fn list(&self) -> [(&'static str, &Option<SpreadReport>); 4] {
        [
            ("turnaround", &self.turnaround),
            ("gap_wait", &self.gap_wait),
            ("lateness", &self.lateness),
            ("command_wait", &self.command_wait),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MINUTE: u64 = 60_000;

    fn millis(millis: f64) -> Duration {
        Duration::from_secs_f64(millis / 1000.0)
    }

    fn percentiles(spread: &Spread, minute: u64) -> Option<[f64; 3]> {
        let lately = spread.report(Time::from_millis(minute * MINUTE)).lately?;
        Some([lately.p50, lately.p95, lately.p99].map(|time| time.as_micros() as f64 / 1000.0))
    }

    #[test]
    fn percentiles_are_as_near_as_the_buckets_and_never_outside_of_what_was_seen() {
        let mut same = Spread::new(OF_REQUESTS);
        (0..100).for_each(|_| same.add(Time(0), millis(7.1)));
        assert_eq!(percentiles(&same, 0), Some([7.1, 7.1, 7.1]));

        let mut even = Spread::new(OF_REQUESTS);
        (1..=1000).for_each(|time| even.add(Time(0), millis(f64::from(time) / 10.0)));
        let found = percentiles(&even, 0).expect("there were some");
        for (found, expected) in found.into_iter().zip([50.0, 95.0, 99.0]) {
            assert!((found / expected - 1.0).abs() < 0.03, "{found} for {expected}");
        }
        for odd in [0.0, 0.001, 60_000.0, 1e9] {
            let mut spread = Spread::new(OF_REQUESTS);
            spread.add(Time(0), millis(odd));
            let found = percentiles(&spread, 0).expect("there was one")[1];
            assert!(found == odd || odd > 4_294_967.0, "{found} for {odd}");
        }
    }

    /// A connection may have a thousand answers a second, and a window more than a small number can count.
    #[test]
    fn of_very_many_the_shares_are_told_all_the_same() {
        let mut spread = Spread::new(OF_REQUESTS);
        for count in 0..1_500_000 {
            spread.add(Time(0), millis(if count % 25 == 0 { 40.0 } else { 1.0 }));
        }
        let [half, most, nearly_all] = percentiles(&spread, 0).expect("there were some");
        assert!(half <= 1.0 && most <= 1.0 && nearly_all > 30.0, "{half} {most} {nearly_all}");
    }

    #[test]
    fn what_was_long_ago_moves_no_percentile_but_stays_counted() {
        let mut spread = Spread::new(OF_REQUESTS);
        assert_eq!(percentiles(&spread, 0), None);
        (0..1000).for_each(|_| spread.add(Time(0), millis(5.0)));
        assert_eq!(percentiles(&spread, 19).map(|found| found[0]), Some(5.0));
        assert_eq!(percentiles(&spread, 20), None);
        (0..10).for_each(|_| spread.add(Time::from_millis(25 * MINUTE), millis(50.0)));
        assert_eq!(percentiles(&spread, 26), Some([50.0, 50.0, 50.0]));
        let report = spread.report(Time::from_millis(26 * MINUTE));
        assert_eq!(report.counts.iter().sum::<u32>(), 1010);
        assert_eq!(report.sum, millis(5500.0));
    }

    #[test]
    fn a_scraper_is_told_1_2_and_5_of_each_decade() {
        let bounds: Vec<u128> = SpreadReport::bounds().map(|bound| bound.as_micros()).collect();
        assert_eq!(bounds[..5], [10, 20, 50, 100, 200]);
        assert_eq!(bounds.len() + 1, TOLD_BUCKETS);
        let mut spread = Spread::new(OF_REQUESTS);
        for time in [0.01, 0.011, 0.015, 0.02, 0.021, 0.07, 6000.0, 8000.0] {
            spread.add(Time(0), millis(time));
        }
        let counts = spread.report(Time(0)).counts;
        assert_eq!((counts[0], counts[1], counts[2], counts[3]), (1, 3, 1, 1));
        assert_eq!(counts[TOLD_BUCKETS - 1], 2, "above 5 s");
        assert_eq!(counts.iter().sum::<u32>(), 8);
    }

    #[test]
    fn a_device_that_is_only_polled_takes_less_memory_than_one_point_may() {
        assert!(std::mem::size_of::<Spread>() * 2 < 800, "{}", std::mem::size_of::<Spread>());
    }
}
