//! The little words of a profile: addresses, spans, ranges, steps, types.

use serde_json::{Value as Json, json};

use crate::choices;
use crate::engine::address::{Address, Bits, Span, Table};
use crate::engine::device::{Category, Kind, Order, OutOfRange, Platform, Poll, ThingKind, WriteFunction};
use crate::engine::time::Date;
use crate::engine::value::Decimal;
use crate::engine::yaml::{At, Content, Definitions, Faults, Node, Read, Scalar};

choices! { "a byte order", Order {
    "abcd" => Order::Abcd, "cdab" => Order::Cdab, "badc" => Order::Badc, "dcba" => Order::Dcba,
} }

choices! { "a poll class", Poll {
    "fast" => Poll::Fast, "slow" => Poll::Slow, "once" => Poll::Once, "never" => Poll::Never,
} }

choices! { "a function code that writes", WriteFunction {
    "5" => WriteFunction::SingleCoil,
    "6" => WriteFunction::SingleRegister,
    "15" => WriteFunction::MultipleCoils,
    "16" => WriteFunction::MultipleRegisters,
} }

choices! { "what becomes of a value out of range", OutOfRange {
    "refuse" => OutOfRange::Refuse, "clamp" => OutOfRange::Clamp,
} }

choices! { "a platform of a single point", Platform {
    "sensor" => Platform::Sensor,
    "binary_sensor" => Platform::BinarySensor,
    "switch" => Platform::Switch,
    "number" => Platform::Number,
    "select" => Platform::Select,
    "button" => Platform::Button,
    "text" => Platform::Text,
} }

choices! { "a kind of thing", ThingKind {
    "cover" => ThingKind::Cover,
    "valve" => ThingKind::Valve,
    "climate" => ThingKind::Climate,
    "button" => ThingKind::Button,
} }

choices! { "a category", Category {
    "config" => Category::Config, "diagnostic" => Category::Diagnostic,
} }

/// A departure from the Modbus specification.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quirk {
    ClampsWithException,
    ExceptionFunctionVaries,
}

choices! { "a quirk", Quirk {
    "clamps_with_exception" => Quirk::ClampsWithException,
    "exception_function_varies" => Quirk::ExceptionFunctionVaries,
} }

/// Names become files, topics and Home Assistant's identifiers, which end at 255 characters: that of a device, and
/// those of a group, a point and a flag.
pub const NAME_BYTES_MAX: usize = 48;

/// What has only characters of a name, unless it is too long for one.
pub fn short_name(text: &str) -> Result<String, String> {
    match text.len() {
        0..=NAME_BYTES_MAX => Ok(text.into()),
        long => Err(format!("a name of {long} characters; expected at most {NAME_BYTES_MAX}")),
    }
}

/// A name in snake_case: of a point, a group or a flag.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Name(pub String);

impl Scalar for Name {
    const EXPECTED: &'static str = "a name in snake_case";

    fn parse(text: &str) -> Result<Name, String> {
        if is_name(text) {
            return short_name(text).map(Name);
        }
        Err(format!("`{text}` is not a name; expected a small letter, then small letters, digits and `_`"))
    }

    fn schema() -> Json {
        json!({"type": "string", "pattern": "^[a-z][a-z0-9_]*$", "maxLength": NAME_BYTES_MAX})
    }
}

fn is_name(text: &str) -> bool {
    text.starts_with(|first: char| first.is_ascii_lowercase())
        && text.bytes().all(|byte| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'_')
}

/// The path of a point: `watchdog`, `channel.value`, `channel.status.overheated`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct PointPath(pub String);

impl Scalar for PointPath {
    const EXPECTED: &'static str = "a point's name or path";

    fn parse(text: &str) -> Result<PointPath, String> {
        if text.split('.').all(is_name) {
            return Ok(PointPath(text.into()));
        }
        Err(format!(
            "`{text}` is not a point's path; expected names with dots between, as in `channel.value`"
        ))
    }

    fn schema() -> Json {
        json!({"type": "string", "pattern": "^[a-z][a-z0-9_]*([.][a-z][a-z0-9_]*)*$"})
    }
}

/// Where one value begins. Of registers only the first is given: the type says how many there are.
impl Scalar for Address {
    const EXPECTED: &'static str = "an address like `input 32`, `holding 16.8` or `coil 0`";

    fn parse(text: &str) -> Result<Address, String> {
        let (table, rest) = table_and_rest(text, "as in `input 32`")?;
        if table.is_bits() {
            return Ok(Address { span: span_of(table, rest)?, bits: None });
        }
        let (register, bits) = match rest.split_once('.') {
            Some((_, second)) if second.starts_with('.') => {
                return Err(format!(
                    "`{rest}` are several registers; expected the first one, the type says how many there are"
                ));
            }
            Some((register, bits)) => (register, Some(bits_of(bits)?)),
            None => (rest, None),
        };
        Ok(Address { span: Span::single(table, number_of(register)?), bits })
    }

    fn schema() -> Json {
        json!({"type": "string", "pattern": "^((coil|discrete) [0-9]+([.][.][0-9]+)?|(input|holding) [0-9]+([.][0-9]+([.][.][0-9]+)?)?)$"})
    }
}

impl Scalar for Span {
    const EXPECTED: &'static str = "a span like `holding 300..399` or `coil 0`";

    fn parse(text: &str) -> Result<Span, String> {
        let (table, rest) = table_and_rest(text, "as in `holding 300..399`")?;
        span_of(table, rest)
    }

    fn schema() -> Json {
        json!({"type": "string", "pattern": "^(coil|discrete|input|holding) [0-9]+([.][.][0-9]+)?$"})
    }
}

fn table_and_rest<'t>(text: &'t str, example: &str) -> Result<(Table, &'t str), String> {
    let (word, rest) = text.split_once(' ').unwrap_or((text, ""));
    match (Table::from_name(word), rest.trim()) {
        (None, _) => Err(format!(
            "`{word}` is not a register table; expected coil, discrete, input or holding, {example}"
        )),
        (Some(table), "") => Err(format!("`{table}` has no address behind it; expected one, {example}")),
        (Some(table), rest) => Ok((table, rest)),
    }
}

fn span_of(table: Table, text: &str) -> Result<Span, String> {
    let (first, last) = text.split_once("..").unwrap_or((text, text));
    let (first, last) = (number_of(first)?, number_of(last)?);
    Span::new(table, first, last).ok_or_else(|| {
        format!("`{text}` runs backwards; expected the lower address first, as in `{last}..{first}`")
    })
}

fn number_of(text: &str) -> Result<u16, String> {
    u16::parse(text).map_err(|_| format!("`{text}` is not an address; expected a number from 0 to 65535"))
}

fn bits_of(text: &str) -> Result<Bits, String> {
    let (low, high) = text.split_once("..").unwrap_or((text, text));
    let number = |text: &str| text.parse::<u8>().ok().filter(|bit| *bit <= 15);
    match (number(low), number(high)) {
        (Some(low), Some(high)) => Bits::new(low, high)
            .ok_or_else(|| format!("the bits `{text}` run backwards; expected `{high}..{low}`")),
        _ => Err(format!(
            "`{text}` are no bits of a register; expected 0 (the lowest) to 15, as in `.8` or `.0..7`"
        )),
    }
}

/// `1..8`: the numbers of the repetitions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Repeat {
    pub first: u16,
    pub last: u16,
}

impl Scalar for Repeat {
    const EXPECTED: &'static str = "the numbers of the repetitions, like `1..8`";

    fn parse(text: &str) -> Result<Repeat, String> {
        let numbers =
            text.split_once("..").and_then(|(first, last)| Some((first.parse().ok()?, last.parse().ok()?)));
        match numbers {
            Some((first, last)) if first < last && last - first < 1000 => Ok(Repeat { first, last }),
            _ => Err(format!(
                "`{text}` does not count up; expected the first and the last number, as in `1..8`"
            )),
        }
    }

    fn schema() -> Json {
        json!({"type": "string", "pattern": "^[0-9]+[.][.][0-9]+$"})
    }
}

/// How far one repetition lies behind the one before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// `4`: registers, or bits of a table of bits.
    Addresses(u16),
    /// `1 bit`: bits inside a register.
    Bits(u8),
}

impl Scalar for Step {
    const EXPECTED: &'static str = "a step like `4` or `1 bit`";

    fn parse(text: &str) -> Result<Step, String> {
        let bits = text
            .strip_suffix("bits")
            .or_else(|| text.strip_suffix("bit"))
            .map(|number| number.trim().parse());
        match (bits, text.parse()) {
            (Some(Ok(bits @ 1..=8)), _) => Ok(Step::Bits(bits)),
            (None, Ok(addresses @ 1..)) => Ok(Step::Addresses(addresses)),
            _ => Err(format!("`{text}` is not a step; expected a number of registers like `4`, or `1 bit`")),
        }
    }

    fn schema() -> Json {
        json!({"anyOf": [{"type": "integer", "minimum": 1}, {"type": "string", "pattern": "^[1-8] bits?$"}]})
    }
}

/// A day, as of `since`.
impl Scalar for Date {
    const EXPECTED: &'static str = "a day like `1970-01-01`";

    fn parse(text: &str) -> Result<Date, String> {
        let parts: Vec<Option<u64>> = text
            .split('-')
            .map(|part| part.parse().ok().filter(|_| part.bytes().all(|byte| byte.is_ascii_digit())))
            .collect();
        let day = match parts[..] {
            [Some(year), Some(month), Some(day)] => Date::of_day(year, month, day),
            _ => None,
        };
        day.ok_or_else(|| {
            format!("`{text}` is no day since 1970; expected one like `1970-01-01` or `2000-01-01`")
        })
    }

    fn schema() -> Json {
        json!({"type": "string", "pattern": "^[0-9]{4}-[0-9]{1,2}-[0-9]{1,2}$"})
    }
}

/// `-50..150`, both ends included.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Range {
    pub min: Decimal,
    pub max: Decimal,
}

impl Scalar for Range {
    const EXPECTED: &'static str = "a range like `-50..150`";

    fn parse(text: &str) -> Result<Range, String> {
        let ends =
            text.split_once("..").and_then(|(min, max)| Some((Decimal::parse(min)?, Decimal::parse(max)?)));
        match ends {
            Some((min, max)) if min.compare(max).is_lt() => Ok(Range { min, max }),
            Some(_) => {
                Err(format!("the range `{text}` is empty; expected the lower end first, as in `0..100`"))
            }
            None => Err(format!("`{text}` is not a range; expected one like `0..100` or `-9.5..9.5`")),
        }
    }

    fn schema() -> Json {
        json!({"type": "string", "pattern": "^-?[0-9.]+[.][.]-?[0-9.]+$"})
    }
}

/// What may be written.
#[derive(Clone, Debug)]
pub enum Writable {
    Any,
    Range { range: Range, step: Option<Decimal> },
    Names(Vec<At<String>>),
}

impl Read for Writable {
    fn read(node: &Node, faults: &mut Faults) -> Option<Writable> {
        let expected = "expected `any`, a range like `0..100` or `4..20 step 0.5`, or a list of names";
        let result = match &node.content {
            Content::List(_) => return Vec::read(node, faults).map(Writable::Names),
            Content::Scalar { .. } if !node.is_null() => match node.text() {
                Some("any") => Ok(Writable::Any),
                Some(text) => parse_writable_range(text).map_err(|message| {
                    if text.contains("..") {
                        message
                    } else {
                        format!("`{text}` cannot be written; {expected}")
                    }
                }),
                None => Err(expected.into()),
            },
            _ => Err(format!("{} stands here; {expected}", node.found())),
        };
        result.map_err(|message| faults.add(&node.place, message)).ok()
    }

    fn schema(_: &mut Definitions) -> Json {
        json!({"anyOf": [
            {"const": "any"},
            {"type": "string", "pattern": "^-?[0-9.]+[.][.]-?[0-9.]+( step [0-9.]+)?$"},
            {"type": "array", "items": {"type": "string"}},
        ]})
    }
}

fn parse_writable_range(text: &str) -> Result<Writable, String> {
    let (range, step) = match text.split_once(" step ") {
        Some((range, step)) => (range, Some(step.trim())),
        None => (text, None),
    };
    let step = match step.map(|step| (step, Decimal::parse(step))) {
        None => None,
        Some((_, Some(step))) if step.units > 0 => Some(step),
        Some((step, _)) => {
            return Err(format!("`{step}` is not a step; expected a number above 0, as in `4..20 step 0.5`"));
        }
    };
    Ok(Writable::Range { range: Range::parse(range.trim())?, step })
}

/// `decimals:` is a number or the point that holds it.
#[derive(Clone, Debug, PartialEq)]
pub enum Digits {
    Fixed(u8),
    By(PointPath),
}

impl Scalar for Digits {
    const EXPECTED: &'static str = "a number of decimals, or the point that holds it";

    fn parse(text: &str) -> Result<Digits, String> {
        match text.parse::<u8>() {
            Ok(decimals) if decimals <= 9 => Ok(Digits::Fixed(decimals)),
            Ok(_) => Err(format!("{text} is out of range; expected 0 to 9 decimals")),
            Err(_) => PointPath::parse(text)
                .map(Digits::By)
                .map_err(|_| format!("`{text}` is not {}", Digits::EXPECTED)),
        }
    }

    fn schema() -> Json {
        json!({"anyOf": [{"type": "integer", "minimum": 0, "maximum": 9}, <PointPath as Scalar>::schema()]})
    }
}

impl Scalar for Kind {
    const EXPECTED: &'static str = "a type like `i16`";

    fn parse(text: &str) -> Result<Kind, String> {
        if let Some(registers) = text.strip_prefix("text ") {
            return match registers.trim().parse() {
                Ok(registers @ 1..=125) => Ok(Kind::Text { registers }),
                _ => Err(format!(
                    "`{registers}` is not a number of registers; expected 1 to 125, as in `text 8`"
                )),
            };
        }
        match KINDS.into_iter().find(|kind| kind.name() == text) {
            Some(kind) => Ok(kind),
            None if text == "text" => {
                Err("`text` does not say its length; expected its registers, as in `text 8`".into())
            }
            None => {
                let names: Vec<String> = KINDS.into_iter().map(Kind::name).collect();
                Err(format!("`{text}` is not a type; expected {} or `text 8`", names.join(", ")))
            }
        }
    }

    fn schema() -> Json {
        let names: Vec<String> = KINDS.into_iter().map(Kind::name).collect();
        json!({"anyOf": [{"enum": names}, {"type": "string", "pattern": "^text [0-9]+$"}]})
    }
}

/// The types that have a word of their own.
const KINDS: [Kind; 14] = [
    Kind::U16,
    Kind::I16,
    Kind::U32,
    Kind::I32,
    Kind::U48,
    Kind::U64,
    Kind::I64,
    Kind::F32,
    Kind::F64,
    Kind::Bcd16,
    Kind::Bcd32,
    Kind::LetterNumber,
    Kind::DayMonthYear,
    Kind::Bool,
];

#[cfg(test)]
mod tests {
    use super::*;

    fn check<T: Scalar + std::fmt::Debug>(text: &str, expected: &str) {
        let shown = match T::parse(text) {
            Ok(value) => format!("{value:?}"),
            Err(message) => message,
        };
        assert_eq!(shown, expected, "{text}");
    }

    fn check_address(text: &str, expected: &str) {
        let shown = Address::parse(text).map_or_else(|message| message, |address| address.to_string());
        assert_eq!(shown, expected, "{text}");
    }

    #[test]
    fn addresses_are_read_or_refused_with_an_example() {
        check_address("input 32", "input 32");
        check_address("holding 16.8", "holding 16.8");
        check_address("holding 0x10.0..7", "holding 16.0..7");
        check_address("coil 2..3", "coil 2..3");
        check_address(
            "holdng 1010",
            "`holdng` is not a register table; expected coil, discrete, input or holding, as in `input 32`",
        );
        check_address("input", "`input` has no address behind it; expected one, as in `input 32`");
        check_address("input 70000", "`70000` is not an address; expected a number from 0 to 65535");
        check_address(
            "input 3.16",
            "`16` are no bits of a register; expected 0 (the lowest) to 15, as in `.8` or `.0..7`",
        );
        check_address("input 3.7..0", "the bits `7..0` run backwards; expected `0..7`");
        check_address(
            "input 3..4",
            "`3..4` are several registers; expected the first one, the type says how many there are",
        );
        check_address("coil 5..4", "`5..4` runs backwards; expected the lower address first, as in `4..5`");
    }

    #[test]
    fn ranges_and_steps_are_read_or_refused_with_an_example() {
        check::<Repeat>("1..8", "Repeat { first: 1, last: 8 }");
        check::<Repeat>("8", "`8` does not count up; expected the first and the last number, as in `1..8`");
        check::<Step>("1 bit", "Bits(1)");
        check::<Step>("4", "Addresses(4)");
        check::<Step>("0", "`0` is not a step; expected a number of registers like `4`, or `1 bit`");
        check::<Range>("10..1", "the range `10..1` is empty; expected the lower end first, as in `0..100`");
        check::<Kind>("text 8", "Text { registers: 8 }");
        check::<Digits>("decimals", "By(PointPath(\"decimals\"))");
        check::<Date>("2000-01-01", "Date(946684800)");
        check::<Date>(
            "2000-02-30",
            "`2000-02-30` is no day since 1970; expected one like `1970-01-01` or `2000-01-01`",
        );
        check::<Date>("unix", "`unix` is no day since 1970; expected one like `1970-01-01` or `2000-01-01`");
        check::<Digits>("12", "12 is out of range; expected 0 to 9 decimals");
    }
}
