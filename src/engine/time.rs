//! Time as the engine knows it: a number that somebody else brings.

use std::fmt;
use std::ops::{Add, AddAssign, Sub};
pub use std::time::Duration;

/// Microseconds since the program (or the test) began. Monotonic; the edge makes it from the clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Time(pub u64);

impl Time {
    /// The time `millis` milliseconds after the start.
    pub const fn from_millis(millis: u64) -> Time {
        Time(millis * 1000)
    }

    /// How long ago `earlier` was; zero when it lies in the future.
    pub fn since(self, earlier: Time) -> Duration {
        Duration::from_micros(self.0.saturating_sub(earlier.0))
    }

    /// So much earlier; the start where that would be before it.
    pub fn before(self, duration: Duration) -> Time {
        Time(self.0.saturating_sub(duration.as_micros().min(u128::from(u64::MAX)) as u64))
    }
}

impl Add<Duration> for Time {
    type Output = Time;
    fn add(self, duration: Duration) -> Time {
        Time(self.0.saturating_add(duration.as_micros().min(u128::from(u64::MAX)) as u64))
    }
}

impl AddAssign<Duration> for Time {
    fn add_assign(&mut self, duration: Duration) {
        *self = *self + duration;
    }
}

impl Sub<Time> for Time {
    type Output = Duration;
    fn sub(self, earlier: Time) -> Duration {
        self.since(earlier)
    }
}

impl fmt::Display for Time {
    /// Milliseconds with up to three decimals: `37.4 ms`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let millis = self.0 as f64 / 1000.0;
        write!(f, "{millis} ms")
    }
}

/// Seconds since 1970-01-01 00:00 UTC, for texts that people read. The edge makes it from the clock;
/// nothing is decided by it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Date(pub u64);

impl Date {
    /// The beginning of a day, which is there in no calendar where this is `None`.
    pub fn of_day(year: u64, month: u64, day: u64) -> Option<Date> {
        let years: u64 = (1970..year.min(Date::YEARS_END)).map(days_of_year).sum();
        let lengths = days_of_months(year);
        let length = *lengths.get(usize::try_from(month.checked_sub(1)?).ok()?)?;
        let months: u64 = lengths.iter().take(month as usize - 1).sum();
        let is_there = (1970..Date::YEARS_END).contains(&year) && (1..=length).contains(&day);
        is_there.then(|| Date((years + months + day - 1) * 86_400))
    }

    /// The year that no date is in any more: what other programs take has four digits.
    const YEARS_END: u64 = 10_000;
    /// As many seconds have passed when that year begins.
    pub const SECONDS_END: u64 = 253_402_300_800;
}

fn days_of_months(year: u64) -> [u64; 12] {
    let leap = year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
    [31, 28 + u64::from(leap), 31, 30, 31, 30, 31, 31, 30, 31, 30, 31]
}

fn days_of_year(year: u64) -> u64 {
    days_of_months(year).iter().sum()
}

impl Add<Duration> for Date {
    type Output = Date;
    fn add(self, duration: Duration) -> Date {
        Date(self.0.saturating_add(duration.as_secs()))
    }
}

impl fmt::Display for Date {
    /// RFC 3339: `2026-11-26T23:50:21Z`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (days, second) = (self.0 / 86_400, self.0 % 86_400);
        let (mut year, mut day) = (1970, days);
        while day >= days_of_year(year) {
            day -= days_of_year(year);
            year += 1;
        }
        let mut month = 1;
        for length in days_of_months(year) {
            if day < length {
                break;
            }
            day -= length;
            month += 1;
        }
        let (hour, minute, second) = (second / 3600, second / 60 % 60, second % 60);
        write!(f, "{year:04}-{month:02}-{:02}T{hour:02}:{minute:02}:{second:02}Z", day + 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_date_is_told_in_the_calendar() {
        for (seconds, expected) in [
            (0, "1970-01-01T00:00:00Z"),
            (951_782_399, "2000-02-28T23:59:59Z"),
            (951_782_400, "2000-02-29T00:00:00Z"),
            (1_735_689_599, "2024-12-31T23:59:59Z"),
            (4_107_542_400, "2100-03-01T00:00:00Z"),
            (1_795_737_021, "2026-11-26T23:50:21Z"),
        ] {
            assert_eq!(Date(seconds).to_string(), expected);
        }
        assert_eq!(Date(Date::SECONDS_END).to_string(), "10000-01-01T00:00:00Z");
    }

    #[test]
    fn a_day_is_one_of_the_calendar() {
        for (day, expected) in [
            ((1970, 1, 1), Some("1970-01-01T00:00:00Z")),
            ((2000, 2, 29), Some("2000-02-29T00:00:00Z")),
            ((2026, 11, 27), Some("2026-11-27T00:00:00Z")),
            ((9999, 12, 31), Some("9999-12-31T00:00:00Z")),
            ((1969, 12, 31), None),
            ((2100, 2, 29), None),
            ((2026, 0, 1), None),
            ((2026, 13, 1), None),
            ((2026, 4, 31), None),
            ((2026, 4, 0), None),
            ((10_000, 1, 1), None),
        ] {
            let (year, month, date) = day;
            let found = Date::of_day(year, month, date).map(|date| date.to_string());
            assert_eq!(found.as_deref(), expected, "{day:?}");
        }
    }
}
