//! What a reading is: a number, a moment, a flag, a name, a text, or missing with a reason.

mod moment;

pub use moment::Moment;

use std::fmt;

/// An exact decimal number: `units` × 10^-`decimals`. `21.50` is 2150 with 2 decimals, and keeps
/// its last zero: the digits are those that the register's scale gives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Decimal {
    pub units: i128,
    pub decimals: u8,
}

impl Decimal {
    pub const ZERO: Decimal = Decimal { units: 0, decimals: 0 };
    pub const ONE: Decimal = Decimal { units: 1, decimals: 0 };
    /// More digits behind the dot than this are refused when parsing.
    pub const DECIMALS_MAX: u8 = 18;

    pub const fn integer(units: i128) -> Decimal {
        Decimal { units, decimals: 0 }
    }

    /// Reads `21.5`, `-0.3`, `20`, `1e-05`, `+7`. `None` for anything else, for more than 30 digits
    /// and for more than [`Decimal::DECIMALS_MAX`] decimals.
    pub fn parse(text: &str) -> Option<Decimal> {
        let (mantissa, exponent) = match text.find(['e', 'E']) {
            Some(at) => (&text[..at], text[at + 1..].parse::<i32>().ok()?),
            None => (text, 0),
        };
        let (negative, digits) = match mantissa.as_bytes().first()? {
            b'-' => (true, &mantissa[1..]),
            b'+' => (false, &mantissa[1..]),
            _ => (false, mantissa),
        };
        let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
        let all_digits = |part: &str| part.bytes().all(|byte| byte.is_ascii_digit());
        if whole.len() + fraction.len() == 0 || !all_digits(whole) || !all_digits(fraction) {
            return None;
        }
        if whole.len() + fraction.len() > 30 || !(-40..=30).contains(&exponent) {
            return None;
        }
        let mut units: i128 = format!("{whole}{fraction}").parse().ok()?;
        let mut decimals = fraction.len() as i32 - exponent;
        while decimals < 0 {
            units = units.checked_mul(10)?;
            decimals += 1;
        }
        while decimals > i32::from(Decimal::DECIMALS_MAX) && units % 10 == 0 {
            units /= 10;
            decimals -= 1;
        }
        if decimals > i32::from(Decimal::DECIMALS_MAX) {
            return None;
        }
        Some(Decimal { units: if negative { -units } else { units }, decimals: decimals as u8 })
    }

    /// The same number with exactly `decimals` digits behind the dot; `None` if that would lose
    /// a digit or overflow.
    pub fn with_decimals(self, decimals: u8) -> Option<Decimal> {
        let units = if decimals >= self.decimals {
            self.units.checked_mul(power_of_ten(decimals - self.decimals)?)?
        } else {
            let divisor = power_of_ten(self.decimals - decimals)?;
            if self.units % divisor != 0 {
                return None;
            }
            self.units / divisor
        };
        Some(Decimal { units, decimals })
    }

    /// The same number without trailing zeros behind the dot.
    pub fn normalized(mut self) -> Decimal {
        while self.decimals > 0 && self.units % 10 == 0 {
            self.units /= 10;
            self.decimals -= 1;
        }
        self
    }

    pub fn checked_mul(self, other: Decimal) -> Option<Decimal> {
        Some(Decimal {
            units: self.units.checked_mul(other.units)?,
            decimals: self.decimals.checked_add(other.decimals)?,
        })
    }

    pub fn checked_add(self, other: Decimal) -> Option<Decimal> {
        let decimals = self.decimals.max(other.decimals);
        let (a, b) = (self.with_decimals(decimals)?, other.with_decimals(decimals)?);
        Some(Decimal { units: a.units.checked_add(b.units)?, decimals })
    }

    pub fn negated(self) -> Decimal {
        Decimal { units: -self.units, ..self }
    }

    pub fn absolute(self) -> Decimal {
        if self.units < 0 { self.negated() } else { self }
    }

    /// The decimal by which a float is told, without the digits that are beyond what a decimal holds; `None` for one
    /// that is too large.
    pub fn nearest(number: f64) -> Option<Decimal> {
        let decimals = usize::from(Decimal::DECIMALS_MAX);
        let told = number.to_string();
        Decimal::parse(&told).or_else(|| Decimal::parse(&format!("{number:.decimals$}")))
    }

    /// `self ÷ divisor` as a whole number, only if nothing is left over.
    pub fn divided_exactly_by(self, divisor: Decimal) -> Option<i128> {
        let decimals = self.decimals.max(divisor.decimals);
        let (a, b) = (self.with_decimals(decimals)?, divisor.with_decimals(decimals)?);
        if b.units == 0 || a.units % b.units != 0 { None } else { Some(a.units / b.units) }
    }

    /// Compares by amount: 1.0 equals 1.
    pub fn compare(self, other: Decimal) -> std::cmp::Ordering {
        let decimals = self.decimals.max(other.decimals);
        match (self.with_decimals(decimals), other.with_decimals(decimals)) {
            (Some(a), Some(b)) => a.units.cmp(&b.units),
            _ => self.to_f64().total_cmp(&other.to_f64()),
        }
    }

    pub fn to_f64(self) -> f64 {
        // Through text: the nearest double, not a rounded quotient of two.
        self.to_string().parse().unwrap_or(f64::NAN)
    }
}

fn power_of_ten(exponent: u8) -> Option<i128> {
    10i128.checked_pow(u32::from(exponent))
}

impl fmt::Display for Decimal {
    /// Digits, a dot, no exponent: `-0.050`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sign = if self.units < 0 { "-" } else { "" };
        let digits = self.units.unsigned_abs().to_string();
        let decimals = usize::from(self.decimals);
        if decimals == 0 {
            return write!(f, "{sign}{digits}");
        }
        let padded = format!("{digits:0>width$}", width = decimals + 1);
        let (whole, fraction) = padded.split_at(padded.len() - decimals);
        write!(f, "{sign}{whole}.{fraction}")
    }
}

/// What is known of a point.
#[derive(Clone, Debug, PartialEq)]
pub enum Reading {
    /// From integer registers: exact.
    Number(Decimal),
    /// From floating-point registers; always finite.
    Float(f64),
    /// When something was or will be.
    Moment(Moment),
    Flag(bool),
    /// A named value: `automatic`, `°C`.
    Name(String),
    Text(String),
    /// An array of numbers, some of which may be missing.
    List(Vec<Reading>),
    Missing(Missing),
}

/// Why there is no value. Published as `None`; the reason goes to the device's info.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Missing {
    /// Not read since the start, or since the last write.
    NotYetRead,
    /// The device does not answer.
    Offline,
    /// The named point decides how to read this one, and is itself not known yet.
    WaitingFor(String),
    /// In the present mode the device has no such reading.
    NotInThisMode,
    /// The register held one of the profile's `invalid` words.
    Invalid(String),
    /// The register held a number that the profile does not name.
    UnknownValue(i128),
    /// A floating-point register held no number.
    NotANumber,
    /// This number would be longer than a state in Home Assistant can be, told without an exponent.
    TooManyDigits(String),
    /// The text register held no text.
    NotText,
    /// It held a text without a letter. Told as such it would be no value on MQTT: an empty message deletes what
    /// the broker keeps, and Home Assistant passes over it.
    EmptyText,
    /// A thing's points say what is none of its states.
    NoState,
    /// The register that counts seconds held 0, or more than there is a date for.
    NotAMoment,
    /// The device answered the read with this exception.
    Exception(u8),
    /// The device leaves the read without an answer, while it answers others; what came instead.
    Unanswered(String),
}

/// The specification's words for an exception code.
pub const fn exception_name(code: u8) -> &'static str {
    match code {
        1 => "illegal function",
        2 => "illegal data address",
        3 => "illegal data value",
        4 => "device failure",
        5 => "acknowledge",
        6 => "device busy",
        // Of the first specification; some devices still say it.
        7 => "negative acknowledge",
        8 => "memory parity error",
        10 => "gateway path unavailable",
        11 => "gateway target failed to respond",
        _ => "unknown exception",
    }
}

impl Missing {
    /// A word for programs.
    pub const fn name(&self) -> &'static str {
        match self {
            Missing::NotYetRead => "not_yet_read",
            Missing::Offline => "offline",
            Missing::WaitingFor(_) => "waiting",
            Missing::NotInThisMode => "not_in_this_mode",
            Missing::Invalid(_) => "invalid",
            Missing::UnknownValue(_) => "unknown_value",
            Missing::NotANumber => "not_a_number",
            Missing::TooManyDigits(_) => "too_many_digits",
            Missing::NotText => "not_text",
            Missing::EmptyText => "empty_text",
            Missing::NoState => "no_state",
            Missing::NotAMoment => "not_a_moment",
            Missing::Exception(_) => "exception",
            Missing::Unanswered(_) => "unanswered",
        }
    }
}

impl fmt::Display for Missing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Missing::NotYetRead => write!(f, "not yet read"),
            Missing::Offline => write!(f, "the device is offline"),
            Missing::WaitingFor(point) => write!(f, "waiting for {point}"),
            Missing::NotInThisMode => write!(f, "no reading in this mode"),
            Missing::Invalid(reason) => write!(f, "{reason}"),
            Missing::UnknownValue(raw) => write!(f, "unknown value {raw}"),
            Missing::NotANumber => write!(f, "not a number"),
            Missing::TooManyDigits(number) => write!(f, "{number} has too many digits to be told"),
            Missing::NotText => write!(f, "not a text"),
            Missing::EmptyText => write!(f, "an empty text"),
            Missing::NoState => write!(f, "what its points say is none of its states"),
            Missing::NotAMoment => write!(f, "no date and time"),
            Missing::Exception(code) => write!(f, "exception {code} ({})", exception_name(*code)),
            Missing::Unanswered(error) => write!(f, "{error}, again and again"),
        }
    }
}

impl Reading {
    /// As a JSON value: numbers with their digits, `"ON"` and `"OFF"`, moments, names and texts, `null` where
    /// there is none.
    pub fn to_json(&self) -> String {
        match self {
            Reading::Number(_) | Reading::Float(_) => self.to_string(),
            Reading::Moment(_) | Reading::Flag(_) | Reading::Name(_) | Reading::Text(_) => {
                serde_json::Value::from(self.to_string()).to_string()
            }
            Reading::List(readings) => {
                let items: Vec<String> = readings.iter().map(Reading::to_json).collect();
                format!("[{}]", items.join(","))
            }
            Reading::Missing(_) => "null".into(),
        }
    }
}

impl fmt::Display for Reading {
    /// The text published on MQTT: `21.5`, `2026-11-27T05:24:00+00:00`, `ON`, `automatic`, `[0.1,null]`, `None`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Reading::Number(number) => write!(f, "{number}"),
            Reading::Float(number) => write!(f, "{number}"),
            Reading::Moment(moment) => write!(f, "{moment}"),
            Reading::Flag(true) => write!(f, "ON"),
            Reading::Flag(false) => write!(f, "OFF"),
            Reading::Name(name) => write!(f, "{name}"),
            Reading::Text(text) => write!(f, "{text}"),
            Reading::List(readings) => {
                write!(f, "[")?;
                for (at, reading) in readings.iter().enumerate() {
                    let comma = if at == 0 { "" } else { "," };
                    match reading {
                        Reading::Missing(_) => write!(f, "{comma}null")?,
                        reading => write!(f, "{comma}{reading}")?,
                    }
                }
                write!(f, "]")
            }
            Reading::Missing(_) => write!(f, "None"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decimals_are_read_and_told_with_the_digits_they_have() {
        for (text, told) in [
            ("21.5", "21.5"),
            ("21.50", "21.50"),
            ("-0.05", "-0.05"),
            ("20", "20"),
            ("21.0", "21.0"),
            ("1e-05", "0.00001"),
            ("2.5E3", "2500"),
            ("+7", "7"),
            ("0", "0"),
        ] {
            assert_eq!(Decimal::parse(text).expect(text).to_string(), told, "{text}");
        }
        for text in ["", "-", ".", "1,5", "nan", "inf", "0x10", "1e", "1e99", "--1", "1 ", "٣"] {
            assert_eq!(Decimal::parse(text), None, "{text}");
        }
    }

    #[test]
    fn a_reading_is_json_with_its_digits() {
        let number = |text| Reading::Number(Decimal::parse(text).expect("a decimal"));
        let moment = Moment::new(Decimal::integer(1_795_757_040)).expect("a moment");
        let list = Reading::List(vec![number("0.10"), Reading::Missing(Missing::NotANumber)]);
        for (reading, expected) in [
            (number("21.50"), "21.50"),
            (number("-0.05"), "-0.05"),
            (number("18446744073709551615"), "18446744073709551615"),
            (Reading::Float(0.00001), "0.00001"),
            (Reading::Float(20.0), "20"),
            (Reading::Moment(moment), "\"2026-11-27T05:24:00+00:00\""),
            (Reading::Flag(true), "\"ON\""),
            (Reading::Name("50 % \"A\"".into()), "\"50 % \\\"A\\\"\""),
            (Reading::Text("21".into()), "\"21\""),
            (list, "[0.10,null]"),
            (Reading::Missing(Missing::Offline), "null"),
        ] {
            assert_eq!(reading.to_json(), expected);
            assert!(serde_json::from_str::<serde_json::Value>(expected).is_ok(), "{expected}");
        }
    }

    #[test]
    fn a_decimal_is_divided_only_without_a_rest() {
        let step = Decimal::parse("0.01").expect("a decimal");
        assert_eq!(Decimal::parse("30").expect("a decimal").divided_exactly_by(step), Some(3000));
        assert_eq!(Decimal::parse("0.005").expect("a decimal").divided_exactly_by(step), None);
        assert_eq!(Decimal::ONE.divided_exactly_by(Decimal::ZERO), None);
    }
}
