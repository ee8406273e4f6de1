//! The file `manual.tsv`: what a device's manual says of each register, as somebody read it who had not
//! seen the profile. Tab-separated, `#` begins a comment, the first line is [`HEADER`], `-` stands where
//! the manual says nothing.
//!
//! * `place` is `coil 0`, `holding 16.0..7`, `input 42..43`. With `each` behind it the row stands for
//!   several: `holding 2..5 each` for each register, `input 0..11 each 3` for values of three registers,
//!   `holding 1.0..3 each` for each bit, `holding 36..39.8..15 each` for that field of each register.
//! * `type` is a profile's word for it (`u16`, `f32`, `text 8`), `bits` for a field of several, `i16×128` for
//!   an array, `press` for an order whose word is `min` and `max`; or `by:holding 16.0..7` where that place
//!   decides, and then scale, unit, min and max are its. `by:holding 16.0..7 +1` lies one register further
//!   (`+1bit`: one bit) with each repetition. `scale` and `unit` may be `by` a place too.
//! * `scale` is what one step is in the unit. `min`, `max` and `default` are the register's own numbers: what
//!   may be written, and where nothing may, what can be read.
//! * `access` is `r`, `w`, `rw`, or `out` for what the profile leaves out.
//! * `values` are `0=off 1=on`, in the manual's words; only the numbers are compared.

use std::str::FromStr;

use busker::engine::address::{Address, Bits, Span, Table};
use busker::engine::value::Decimal;

pub const HEADER: &str = "place\ttype\tscale\tunit\taccess\tmin\tmax\tdefault\teeprom\tvalues\tpage";

/// One value of a device: a line of the file, or one of those that a line with `each` stands for.
#[derive(Clone, Debug)]
pub struct Row {
    pub line: usize,
    pub place: Address,
    pub kind: Said,
    pub scale: Said,
    pub unit: Said,
    pub access: Access,
    /// The register's own numbers: the smallest and largest that may be written, or that can be read
    /// where nothing may be written. Of a button both are its word.
    pub min: Option<Decimal>,
    pub max: Option<Decimal>,
    pub default: Option<i128>,
    pub is_persistent: bool,
    /// The named numbers, in order.
    pub values: Vec<i128>,
}

/// What stands in a column that may name another place instead.
#[derive(Clone, Debug, PartialEq)]
pub enum Said {
    /// `-`
    Nothing,
    Text(String),
    By(Address),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    Read,
    Write,
    ReadWrite,
    /// The manual has it, busker does not.
    Out,
}

/// All rows of a file, or the first line that is none.
pub fn rows(file: &str) -> Result<Vec<Row>, String> {
    let mut lines = file
        .lines()
        .enumerate()
        .map(|(index, line)| (index + 1, line))
        .filter(|(_, line)| !line.starts_with('#') && !line.is_empty());
    if lines.next().map(|(_, line)| line) != Some(HEADER) {
        return Err(format!("the first line is not\n{HEADER}"));
    }
    let mut rows = Vec::new();
    for (number, line) in lines {
        rows.extend(rows_of(number, line).map_err(|fault| format!("line {number}: {fault}"))?);
    }
    Ok(rows)
}

fn rows_of(line: usize, text: &str) -> Result<Vec<Row>, String> {
    let columns: Vec<&str> = text.split('\t').map(str::trim).collect();
    let [place, kind, scale, unit, access, min, max, default, eeprom, values, page] = columns[..] else {
        return Err(format!("{} columns instead of 11", columns.len()));
    };
    if page.is_empty() || page == "-" {
        return Err("no page".into());
    }
    let mut rows = Vec::new();
    for (nth, place) in (0..).zip(places(place)?) {
        rows.push(Row {
            line,
            place,
            kind: said(kind.strip_prefix("array ").unwrap_or(kind), nth)?,
            scale: said(scale, nth)?,
            unit: said(unit, nth)?,
            access: match access {
                "r" => Access::Read,
                "w" => Access::Write,
                "rw" => Access::ReadWrite,
                "out" => Access::Out,
                other => return Err(format!("`{other}` is no access")),
            },
            min: unless_dash(min, Decimal::parse)?,
            max: unless_dash(max, Decimal::parse)?,
            default: unless_dash(default, |text| text.parse().ok())?,
            is_persistent: match eeprom {
                "yes" => true,
                "no" | "-" => false,
                other => return Err(format!("`{other}` is neither yes nor no")),
            },
            values: if values == "-" { Vec::new() } else { keys(values)? },
        });
    }
    Ok(rows)
}

fn unless_dash<T>(text: &str, parse: impl Fn(&str) -> Option<T>) -> Result<Option<T>, String> {
    match text {
        "-" => Ok(None),
        text => parse(text).map(Some).ok_or_else(|| format!("`{text}` is no number")),
    }
}

fn said(text: &str, nth: u16) -> Result<Said, String> {
    if text == "-" {
        return Ok(Said::Nothing);
    }
    let Some(place) = text.strip_prefix("by:") else { return Ok(Said::Text(text.into())) };
    let (place, step) = place.split_once(" +").unwrap_or((place, "0"));
    let first = one_place(place)?;
    let (step, is_bits) = step.strip_suffix("bit").map_or((step, false), |step| (step, true));
    let far = nth * number::<u16>(step)?;
    let moved = match (is_bits, first.bits) {
        (false, _) => {
            let (table, count) = (first.span.table(), first.span.count() as u16);
            let span = Span::with_count(table, first.span.first() + far, count);
            span.map(|span| Address { span, bits: first.bits })
        }
        (true, Some(bits)) => Bits::new(bits.low() + far as u8, bits.high() + far as u8)
            .map(|bits| Address { span: first.span, bits: Some(bits) }),
        (true, None) => None,
    };
    moved.map(Said::By).ok_or_else(|| format!("`{text}` leaves its register"))
}

/// `0=OFF 1=on for a while`: only the numbers count.
fn keys(text: &str) -> Result<Vec<i128>, String> {
    let mut keys = Vec::new();
    for word in text.split_whitespace() {
        if let Some((key, _)) = word.split_once('=') {
            keys.push(number(key)?);
        } else if keys.is_empty() {
            return Err(format!("`{text}` does not begin with a number and `=`"));
        }
    }
    keys.sort_unstable();
    keys.dedup();
    Ok(keys)
}

fn one_place(text: &str) -> Result<Address, String> {
    match places(text)?[..] {
        [place] => Ok(place),
        _ => Err(format!("`{text}` is more than one place")),
    }
}

fn places(text: &str) -> Result<Vec<Address>, String> {
    let none = || format!("`{text}` is no place");
    let (text, each) = match text.split_once(" each") {
        Some((text, "")) => (text, Some(1)),
        Some((text, count)) => (text, Some(number(count.trim())?)),
        None => (text, None),
    };
    let (table, numbers) = text.split_once(' ').ok_or_else(none)?;
    let table = Table::from_name(table).ok_or_else(none)?;
    let (registers, bits) = registers_and_bits(numbers);
    let (first, last) = ends::<u16>(registers)?;
    let bits = bits.map(ends::<u8>).transpose()?;
    let field = |(low, high)| Bits::new(low, high).ok_or_else(none);
    let at = |first, count| Span::with_count(table, first, count).ok_or_else(none);
    match (each, bits) {
        (None, None) => {
            Ok(vec![Address { span: Span::new(table, first, last).ok_or_else(none)?, bits: None }])
        }
        (None, Some(bits)) if first == last => {
            Ok(vec![Address { span: at(first, 1)?, bits: Some(field(bits)?) }])
        }
        (None, Some(_)) => Err(none()),
        (Some(count), None)
            if count > 0 && (u32::from(last) + 1 - u32::from(first)) % u32::from(count) == 0 =>
        {
            let firsts = (first..=last).step_by(count.into());
            firsts.map(|first| Ok(Address { span: at(first, count)?, bits: None })).collect()
        }
        (Some(1), Some((low, high))) if first == last => {
            let span = at(first, 1)?;
            (low..=high).map(|bit| Ok(Address { span, bits: Some(field((bit, bit))?) })).collect()
        }
        (Some(1), Some(bits)) => {
            let field = field(bits)?;
            (first..=last).map(|first| Ok(Address { span: at(first, 1)?, bits: Some(field) })).collect()
        }
        (Some(_), _) => Err(none()),
    }
}

/// `36..39.8..15` is `36..39` and `8..15`; `16.0..7` is `16` and `0..7`.
fn registers_and_bits(text: &str) -> (&str, Option<&str>) {
    let is_single = |at: usize| !text[..at].ends_with('.') && !text[at + 1..].starts_with('.');
    match text.match_indices('.').map(|(at, _)| at).find(|at| is_single(*at)) {
        Some(at) => (&text[..at], Some(&text[at + 1..])),
        None => (text, None),
    }
}

fn ends<T: FromStr + Copy>(text: &str) -> Result<(T, T), String> {
    let (first, last) = text.split_once("..").unwrap_or((text, text));
    Ok((number(first)?, number(last)?))
}

fn number<T: FromStr>(text: &str) -> Result<T, String> {
    text.parse().map_err(|_| format!("`{text}` is no number"))
}

#[test]
fn places_are_read_with_all_that_they_stand_for() {
    let check = |text: &str, expected: &[&str]| {
        let found: Vec<String> = places(text).expect(text).iter().map(Address::to_string).collect();
        assert_eq!(found, expected, "{text}");
    };
    check("coil 0", &["coil 0"]);
    check("input 42..43", &["input 42..43"]);
    check("holding 16.0..7", &["holding 16.0..7"]);
    check("holding 1.3", &["holding 1.3"]);
    check("holding 2..4 each", &["holding 2", "holding 3", "holding 4"]);
    check("holding 10..13 each 2", &["holding 10..11", "holding 12..13"]);
    check("holding 1.2..3 each", &["holding 1.2", "holding 1.3"]);
    check("holding 36..37.8..15 each", &["holding 36.8..15", "holding 37.8..15"]);
    for text in
        ["holding", "register 1", "holding 5..4", "holding 1..2.3", "holding 0..4 each 2", "input 1.16"]
    {
        assert!(places(text).is_err(), "{text}");
    }
}
