//! Values that are written as one word: texts, numbers, durations.

use serde_json::{Value as Json, json};

use crate::engine::time::Duration;
use crate::engine::value::Decimal;

/// A type that is written as one scalar. Implementing it is all that a type needs to be read.
pub trait Scalar: Sized {
    /// What is wanted, with its article: `a whole number`.
    const EXPECTED: &'static str;

    /// The value of `text`, or the whole message: what was found, and what would be right.
    fn parse(text: &str) -> Result<Self, String>;

    /// The scalar's JSON Schema.
    fn schema() -> Json;
}

impl Scalar for String {
    const EXPECTED: &'static str = "a text";

    fn parse(text: &str) -> Result<String, String> {
        if text.trim().is_empty() {
            Err("an empty text; expected at least a letter".into())
        } else {
            Ok(text.into())
        }
    }

    fn schema() -> Json {
        // YAML's own rules make numbers of some texts; here they stay texts.
        json!({"type": ["string", "number", "boolean"]})
    }
}

impl Scalar for bool {
    const EXPECTED: &'static str = "`true` or `false`";

    fn parse(text: &str) -> Result<bool, String> {
        match text {
            "true" => Ok(true),
            "false" => Ok(false),
            _ => Err(format!("`{text}` is neither `true` nor `false`")),
        }
    }

    fn schema() -> Json {
        json!({"type": "boolean"})
    }
}

/// Whole numbers, decimal (`-12`) or hexadecimal (`0x0C`).
macro_rules! integers {
    ($($type:ty),*) => {$(
        impl Scalar for $type {
            const EXPECTED: &'static str = "a whole number";

            fn parse(text: &str) -> Result<$type, String> {
                let number = parse_integer(text)
                    .ok_or_else(|| format!("`{text}` is not a whole number; expected one like `12` or `0x0C`"))?;
                <$type>::try_from(number).map_err(|_| {
                    format!("{text} is out of range; expected {} to {}", <$type>::MIN, <$type>::MAX)
                })
            }

            fn schema() -> Json {
                json!({"type": "integer", "minimum": <$type>::MIN as f64, "maximum": <$type>::MAX as f64})
            }
        }
    )*};
}

integers!(u8, u16, u32, u64, i64);

impl Scalar for i128 {
    const EXPECTED: &'static str = "a whole number";

    fn parse(text: &str) -> Result<i128, String> {
        parse_integer(text)
            .ok_or_else(|| format!("`{text}` is not a whole number; expected one like `12` or `0x0C`"))
    }

    fn schema() -> Json {
        json!({"type": "integer"})
    }
}

fn parse_integer(text: &str) -> Option<i128> {
    match text.strip_prefix("0x") {
        Some(digits) if digits.bytes().all(|digit| digit.is_ascii_hexdigit()) => {
            i128::from_str_radix(digits, 16).ok()
        }
        Some(_) => None,
        None => text.parse().ok(),
    }
}

impl Scalar for Decimal {
    const EXPECTED: &'static str = "a number";

    fn parse(text: &str) -> Result<Decimal, String> {
        Decimal::parse(text)
            .ok_or_else(|| format!("`{text}` is not a number; expected one like `20` or `0.5`"))
    }

    fn schema() -> Json {
        json!({"type": "number"})
    }
}

impl Scalar for Duration {
    const EXPECTED: &'static str = "a duration like `250ms`, `30s` or `10m`";

    fn parse(text: &str) -> Result<Duration, String> {
        let unit_at = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
        let (number, unit) = text.split_at(unit_at);
        let Some(number) = Decimal::parse(number) else {
            return Err(format!("`{text}` is not a duration; expected one like `250ms`, `30s` or `10m`"));
        };
        let micros_each: i128 = match unit.trim() {
            "us" => 1,
            "ms" => 1_000,
            "s" => 1_000_000,
            "m" => 60_000_000,
            "h" => 3_600_000_000,
            "d" => 86_400_000_000,
            "" => {
                return Err(format!(
                    "the duration `{text}` has no unit; expected one like `{text}s` or `{text}ms`"
                ));
            }
            other => {
                return Err(format!(
                    "`{other}` is not a unit of time; expected us, ms, s, m, h or d, as in `30s`"
                ));
            }
        };
        let micros =
            number.checked_mul(Decimal::integer(micros_each)).and_then(|micros| micros.with_decimals(0));
        match micros.map(|micros| u64::try_from(micros.units)) {
            // A hundred years: far beyond any period, and far from overflowing.
            Some(Ok(micros)) if micros <= 3_153_600_000_000_000 => Ok(Duration::from_micros(micros)),
            _ => Err(format!("`{text}` is out of range; expected whole microseconds up to 100 years")),
        }
    }

    fn schema() -> Json {
        json!({"type": "string", "pattern": "^[0-9]+(\\.[0-9]+)? ?(us|ms|s|m|h|d)$"})
    }
}
