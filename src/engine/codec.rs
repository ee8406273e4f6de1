//! Words to readings, and wishes to words.
//!
//! Reading: words → field of bits → raw number → `invalid`, names → scale, decimals, offset.
//! Writing (`writing`) runs the same way back.
//!
//! What another register decides (case, unit, decimals) comes in as `known`: the raw fields of the
//! device's points, where they have been read and still hold.

mod writing;

pub use writing::{Limits, Obeyed, encode, limits, obey};

use crate::engine::address::Address;
use crate::engine::device::{
    Case, Condition, Decimals, Device, Encoding, Form, Kind, Names, PointIndex, Unit,
};
use crate::engine::value::{Decimal, Missing, Moment, Reading};

/// One point's interpretation as it is now, with everything decided that other registers decide.
#[derive(Clone, Debug, PartialEq)]
pub struct Resolved<'d> {
    pub form: &'d Form,
    /// Digits behind the dot; `None` for floats that come as they are, and for all that is no number.
    pub decimals: Option<u8>,
    /// How many of those digits are a division by a power of ten.
    shift: u8,
    pub unit: Option<String>,
    /// The active case's name, for a point with cases.
    pub case: Option<&'d str>,
}

impl Resolved<'_> {
    /// What one more in the register is in the unit; `None` for what is no integer.
    pub fn step(&self) -> Option<Decimal> {
        let Form { kind, scale, .. } = self.form;
        kind.integer_range()?;
        Some(Decimal { units: scale.units.abs(), decimals: scale.decimals + self.shift })
    }

    /// As many digits behind the dot as it takes to see one step of the register: 4 for steps of
    /// 0.0003125 V, of which the exact value has 7.
    pub fn display_precision(&self) -> Option<u8> {
        let Some(step) = self.step() else { return self.decimals };
        let visible = |decimals: &u8| Decimal { units: 1, decimals: *decimals }.compare(step).is_le();
        self.decimals.map(|exact| (0..exact).find(visible).unwrap_or(exact))
    }
}

/// What `point` means at present. Missing says which point it waits for, or that there is no reading.
pub fn resolve<'d>(
    device: &'d Device,
    point: PointIndex,
    known: &[Option<i128>],
) -> Result<Resolved<'d>, Missing> {
    if !lives(device, &device.points[point].when, known)? {
        return Err(Missing::NotInThisMode);
    }
    match &device.points[point].encoding {
        Encoding::Plain(form) => resolve_form(device, form, None, known),
        Encoding::Cases { by, cases } => {
            let case = active_case(device, *by, cases, known)?;
            let form = case.form.as_ref().ok_or(Missing::NotInThisMode)?;
            resolve_form(device, form, Some(&case.name), known)
        }
    }
}

/// Whether all of `conditions` hold. Missing says which point it waits for.
pub fn lives(device: &Device, conditions: &[Condition], known: &[Option<i128>]) -> Result<bool, Missing> {
    for condition in conditions {
        if !condition.holds(known_value(device, condition.point, known)?) {
            return Ok(false);
        }
    }
    Ok(true)
}

fn active_case<'d>(
    device: &Device,
    by: PointIndex,
    cases: &'d [Case],
    known: &[Option<i128>],
) -> Result<&'d Case, Missing> {
    let key = known_value(device, by, known)?;
    cases.iter().find(|case| case.key == key).ok_or_else(|| {
        Missing::Invalid(format!("{} holds {key}, which has no meaning", device.points[by].name))
    })
}

fn known_value(device: &Device, point: PointIndex, known: &[Option<i128>]) -> Result<i128, Missing> {
    known.get(point).copied().flatten().ok_or_else(|| Missing::WaitingFor(device.points[point].name.clone()))
}

fn resolve_form<'d>(
    device: &'d Device,
    form: &'d Form,
    case: Option<&'d str>,
    known: &[Option<i128>],
) -> Result<Resolved<'d>, Missing> {
    let shift = match form.decimals {
        None => 0,
        Some(Decimals::Fixed(decimals)) => decimals,
        Some(Decimals::By(point)) => {
            let held = known_value(device, point, known)?;
            u8::try_from(held).ok().filter(|decimals| *decimals <= Decimal::DECIMALS_MAX).ok_or_else(
                || Missing::Invalid(format!("{} holds {held} decimals", device.points[point].name)),
            )?
        }
    };
    let unit = match &form.unit {
        Unit::None => None,
        Unit::Fixed(unit) => Some(unit.clone()),
        Unit::By(point) => {
            let held = known_value(device, *point, known)?;
            let names = device.points[*point].plain().map_or(&[][..], |form| form.names.list());
            let unit = name_of(names, held).ok_or_else(|| {
                Missing::Invalid(format!("{} holds {held}, which is no unit", device.points[*point].name))
            })?;
            Some(unit.to_string())
        }
    };
    let decimals = match form.kind {
        Kind::F32 | Kind::F64 => form.decimals.map(|_| shift),
        _ if !form.is_number() => None,
        _ => Some((form.scale.decimals + shift).max(form.offset.decimals)),
    };
    Ok(Resolved { form, decimals, shift, unit, case })
}

fn name_of(names: &[(i128, String)], raw: i128) -> Option<&str> {
    names.iter().find(|(value, _)| *value == raw).map(|(_, name)| name.as_str())
}

/// A register field before any meaning: what `values`, `invalid` and `known` speak of.
#[derive(Clone, Debug, PartialEq)]
pub enum Raw {
    Integer(i128),
    Float(f64),
    Text(String),
    /// The words are no number (NaN, infinity, a letter where a decimal digit belongs) or no text.
    Nonsense,
}

/// The words of one value, cut out of a read that began at `first`: registers as they are, a field of
/// bits shifted down into one word, coils packed with the first one lowest. `None` if the read does
/// not cover the address.
pub fn words_at(address: Address, first: u16, words: &[u16]) -> Option<Vec<u16>> {
    let start = usize::from(address.span.first().checked_sub(first)?);
    let end = start + address.span.count() as usize;
    let part = words.get(start..end)?;
    if address.span.table().is_bits() {
        return Some(vec![part.iter().rev().fold(0, |field, bit| field << 1 | (bit & 1))]);
    }
    match address.bits {
        Some(bits) => Some(vec![bits.extract(part[0])]),
        None => Some(part.to_vec()),
    }
}

/// Whether two answers to one read that began at `first` hold the same at this place.
pub fn are_equal_at(address: Address, first: u16, before: &[u16], words: &[u16]) -> bool {
    let Some(start) = address.span.first().checked_sub(first).map(usize::from) else { return false };
    let place = start..start + address.span.count() as usize;
    let pair = before.get(place.clone()).zip(words.get(place));
    pair.is_some_and(|(before, now)| before == now)
}

/// The raw field that `words` hold in this form.
pub fn raw(form: &Form, words: &[u16]) -> Raw {
    let count = usize::from(form.kind.registers());
    let Some(words) = words.get(..count) else { return Raw::Nonsense };
    if form.kind.is_text() {
        return raw_text(form, words);
    }
    let words = form.order.turn(words.to_vec());
    let unsigned = words.into_iter().fold(0u64, |value, word| value << 16 | u64::from(word));
    match form.kind {
        Kind::I16 => Raw::Integer(i128::from(unsigned as u16 as i16)),
        Kind::I32 => Raw::Integer(i128::from(unsigned as u32 as i32)),
        Kind::I64 => Raw::Integer(i128::from(unsigned as i64)),
        Kind::F32 => {
            let value = f32::from_bits(unsigned as u32);
            // The shortest decimal that names this f32: 21.1, not 21.100000381.
            if value.is_finite() {
                value.to_string().parse().map_or(Raw::Nonsense, Raw::Float)
            } else {
                Raw::Nonsense
            }
        }
        Kind::F64 => {
            let value = f64::from_bits(unsigned);
            if value.is_finite() { Raw::Float(value) } else { Raw::Nonsense }
        }
        Kind::Bcd16 | Kind::Bcd32 => {
            format!("{unsigned:x}").parse::<i128>().map_or(Raw::Nonsense, Raw::Integer)
        }
        _ => Raw::Integer(i128::from(unsigned)),
    }
}

fn raw_text(form: &Form, words: &[u16]) -> Raw {
    let swaps_bytes = form.order.swaps_bytes();
    let bytes: Vec<u8> = words
        .iter()
        .flat_map(|word| if swaps_bytes { word.to_le_bytes() } else { word.to_be_bytes() })
        .collect();
    let text = match form.kind {
        Kind::LetterNumber => match bytes[0] {
            letter if letter.is_ascii_alphabetic() => Some(format!("{}{:03}", char::from(letter), bytes[1])),
            _ => None,
        },
        Kind::DayMonthYear => day_month_year(words[0]),
        _ => {
            let end = bytes.iter().rposition(|byte| !matches!(byte, 0 | b' ')).map_or(0, |last| last + 1);
            String::from_utf8(bytes[..end].to_vec()).ok().filter(|text| !text.contains(char::is_control))
        }
    };
    text.map_or(Raw::Nonsense, Raw::Text)
}

/// `01018` is 01.01.2018 (FuehlerSysteme, Rreg 79). The one digit of the year is of the 2010s, as in
/// the manual's example.
fn day_month_year(word: u16) -> Option<String> {
    let (day, month, year) = (word / 1000, word / 10 % 100, word % 10);
    ((1..=31).contains(&day) && (1..=12).contains(&month)).then(|| format!("{day:02}.{month:02}.201{year}"))
}

/// What the words (from [`words_at`]) say.
pub fn read(resolved: &Resolved<'_>, words: &[u16]) -> Reading {
    let Form { kind, elements, .. } = *resolved.form;
    if elements > 1 {
        let each = words.chunks_exact(usize::from(kind.registers()));
        return Reading::List(each.take(elements.into()).map(|words| read_one(resolved, words)).collect());
    }
    read_one(resolved, words)
}

fn read_one(resolved: &Resolved<'_>, words: &[u16]) -> Reading {
    let form = resolved.form;
    let raw = raw(form, words);
    if let Some(reason) = invalid_reason(form, words, &raw) {
        return Reading::Missing(Missing::Invalid(reason));
    }
    match raw {
        Raw::Nonsense if form.kind.is_text() => Reading::Missing(Missing::NotText),
        Raw::Nonsense => Reading::Missing(Missing::NotANumber),
        Raw::Text(text) if text.is_empty() => Reading::Missing(Missing::EmptyText),
        Raw::Text(text) => Reading::Text(text),
        Raw::Float(number) => read_float(resolved, number),
        Raw::Integer(raw) => read_integer(resolved, raw),
    }
}

fn invalid_reason(form: &Form, words: &[u16], raw: &Raw) -> Option<String> {
    if form.invalid.is_empty() {
        return None;
    }
    // A profile may name the word as the manual prints it (0x8000) or as it is decoded (-32768).
    let count = usize::from(form.kind.registers()).min(words.len());
    let words = form.order.turn(words[..count].to_vec());
    let pattern = words.into_iter().fold(0i128, |value, word| value << 16 | i128::from(word));
    let decoded = if let Raw::Integer(raw) = raw { *raw } else { pattern };
    form.invalid
        .iter()
        .find(|(word, _)| *word == pattern || *word == decoded)
        .map(|(_, reason)| reason.clone())
}

/// A register value without a name stands for the one that means all others, if there is one.
pub fn meant(form: &Form, raw: i128) -> i128 {
    match form.others {
        Some(others) if name_of(form.names.list(), raw).is_none() => others,
        _ => raw,
    }
}

fn read_integer(resolved: &Resolved<'_>, raw: i128) -> Reading {
    let form = resolved.form;
    let raw = meant(form, raw);
    match (&form.names, name_of(form.names.list(), raw)) {
        (_, Some(name)) if form.kind != Kind::Bool => return Reading::Name(name.to_string()),
        (Names::All(_), None) => return Reading::Missing(Missing::UnknownValue(raw)),
        _ => {}
    }
    if form.kind == Kind::Bool {
        return match raw {
            0 => Reading::Flag(false),
            1 => Reading::Flag(true),
            other => Reading::Missing(Missing::UnknownValue(other)),
        };
    }
    let number = to_unit(resolved, raw);
    if let Some(since) = form.since {
        // A clock that nobody has set counts from nothing, or has not begun to.
        let seconds = number
            .filter(|_| raw != 0)
            .and_then(|number| number.checked_add(Decimal::integer(since.0.into())));
        let moment = seconds.and_then(Moment::new);
        return moment.map_or(Reading::Missing(Missing::NotAMoment), Reading::Moment);
    }
    number.map_or(Reading::Missing(Missing::TooManyDigits(raw.to_string())), Reading::Number)
}

/// A raw number in the point's unit, with all the digits that scale, decimals and offset give.
pub fn to_unit(resolved: &Resolved<'_>, raw: i128) -> Option<Decimal> {
    let form = resolved.form;
    let units = raw.checked_mul(form.scale.units)?;
    Decimal { units, decimals: form.scale.decimals.checked_add(resolved.shift)? }.checked_add(form.offset)
}

fn read_float(resolved: &Resolved<'_>, raw: f64) -> Reading {
    let form = resolved.form;
    let mut value = raw;
    if form.scale != Decimal::ONE || form.offset != Decimal::ZERO {
        value = raw * form.scale.to_f64() + form.offset.to_f64();
        // No more digits than the register had: 0.1 × 3 is 0.3.
        let digits = if form.kind == Kind::F32 { 6 } else { 14 };
        value = format!("{value:.digits$e}").parse().unwrap_or(value);
    }
    if !is_told(value) {
        // Beyond every number is what only the scale has made so.
        let told = if value.is_finite() { value } else { raw };
        return Reading::Missing(Missing::TooManyDigits(format!("{told:e}")));
    }
    let Some(decimals) = resolved.decimals else {
        // Minus zero is told as zero.
        return Reading::Float(value + 0.0);
    };
    let text = format!("{value:.*}", usize::from(decimals));
    match Decimal::parse(&text) {
        // With all the digits that were asked for: 2.50.
        Some(number) => Reading::Number(number),
        // Too large for a decimal, so that it has no digits behind the dot anyway.
        None => Reading::Float(text.parse().unwrap_or(value) + 0.0),
    }
}

/// Whether the number can be told without an exponent in the 255 characters that a state in Home Assistant may have.
/// What is beyond comes of words in the wrong order.
fn is_told(number: f64) -> bool {
    number == 0.0 || (1e-230..1e250).contains(&number.abs())
}

#[cfg(test)]
#[path = "codec_tests.rs"]
mod tests;
