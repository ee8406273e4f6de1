//! A moment as a device counts it: seconds in a register, told as a date and a time.

use std::fmt;

use super::Decimal;
use crate::engine::time::Date;

/// Seconds since 1970-01-01 00:00 UTC, with the digits that the register's scale gives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Moment(Decimal);

impl Moment {
    /// `None` before 1970 and behind the year 9999, which no program that is told it would take.
    pub fn new(seconds: Decimal) -> Option<Moment> {
        let end = Decimal::integer(Date::SECONDS_END.into());
        let is_told = seconds.compare(Decimal::ZERO).is_ge() && seconds.compare(end).is_lt();
        is_told.then_some(Moment(seconds))
    }

    /// Unix time, for programs that calculate.
    pub fn seconds(self) -> Decimal {
        self.0
    }
}

impl fmt::Display for Moment {
    /// ISO 8601, as Home Assistant tells it too: `2026-11-27T05:24:00+00:00`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let digits = self.0.to_string();
        let (whole, fraction) = match digits.split_once('.') {
            Some((whole, fraction)) => (whole, format!(".{fraction}")),
            None => (digits.as_str(), String::new()),
        };
        let date = Date(whole.parse().unwrap_or_default()).to_string();
        write!(f, "{}{fraction}+00:00", date.trim_end_matches('Z'))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_moment_is_told_with_the_digits_of_its_seconds() {
        for (seconds, told) in [
            ("0", "1970-01-01T00:00:00+00:00"),
            ("1795757040", "2026-11-27T05:24:00+00:00"),
            ("1795757040.050", "2026-11-27T05:24:00.050+00:00"),
            ("253402300799", "9999-12-31T23:59:59+00:00"),
        ] {
            let seconds = Decimal::parse(seconds).expect("a decimal");
            assert_eq!(Moment::new(seconds).expect("a moment").to_string(), told);
        }
        for seconds in ["-1", "253402300800"] {
            assert_eq!(Moment::new(Decimal::parse(seconds).expect("a decimal")), None, "{seconds}");
        }
    }
}
