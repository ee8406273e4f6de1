//! Wishes to words: checked, brought to what the register can hold, or refused with a reason that a person can
//! act on.

use super::{Resolved, read, to_unit};
use crate::engine::device::{Decimals, Form, Kind, Names, OutOfRange, Point, Write, WriteRule};
use crate::engine::value::{Decimal, Reading};

/// A command as it is carried out.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Obeyed {
    /// As those of [`encode`].
    pub words: Vec<u16>,
    /// What was made of the wish, where that is not it itself.
    pub note: Option<String>,
}

/// The words for a command, as [`encode`], with what is made of values between two steps, and of those out of
/// range where the point says that they are limited.
pub fn obey(point: &Point, write: &Write, resolved: &Resolved<'_>, text: &str) -> Result<Obeyed, String> {
    let end = match write.out_of_range {
        OutOfRange::Clamp => nearest_end(resolved, &write.rule, text),
        OutOfRange::Refuse => None,
    };
    let words = encode(point, &write.rule, resolved, end.as_deref().unwrap_or(text))
        .map_err(|fault| with_range(fault, resolved, &write.rule))?;
    let taken = read(resolved, &words);
    let note = match (end, &taken) {
        (Some(_), taken) => Some(format!("`{text}` is out of range, and {taken} the nearest value in it")),
        (None, Reading::Number(taken)) => {
            let wanted =
                wished_number(text).ok().filter(|wanted| !is_noise(resolved.step(), *wanted, *taken));
            wanted.map(|_| format!("`{text}` is rounded to {taken}"))
        }
        (None, Reading::Float(taken)) => {
            // A float is as exact as a float is: only a step of the profile moves it.
            let wanted = wished_number(text).ok();
            let stepped = wanted.and_then(|wanted| Some((wanted, stepped(resolved, &write.rule, wanted)??)));
            let step = limits(resolved, &write.rule).and_then(|limits| limits.step);
            let moved = stepped.filter(|(wanted, stepped)| !is_noise(step, *wanted, *stepped));
            moved.map(|_| format!("`{text}` is rounded to {taken}"))
        }
        _ => None,
    };
    Ok(Obeyed { words, note })
}

/// The end of the range that a number is beyond.
fn nearest_end(resolved: &Resolved<'_>, rule: &WriteRule, text: &str) -> Option<String> {
    let is_name = resolved.form.names.list().iter().any(|(_, name)| name == text.trim());
    let (limits, wanted) = (limits(resolved, rule)?, wished_number(text).ok().filter(|_| !is_name)?);
    if wanted.compare(limits.min).is_lt() {
        return Some(limits.min.to_string());
    }
    wanted.compare(limits.max).is_gt().then(|| limits.max.to_string())
}

/// The number that a wish is. Calculations with floats leave more digits than a [`Decimal`] keeps, as in
/// `5.551115123125783e-17`: what is behind the last of them makes no difference to a whole number, and what is
/// too large for them is beyond every limit.
fn wished_number(text: &str) -> Result<Decimal, String> {
    let typed = text.trim();
    if let Some(number) = Decimal::parse(typed) {
        return Ok(number);
    }
    if typed.is_empty() {
        return Err(format!("an empty text {NO_NUMBER}"));
    }
    // `inf` and `nan` are floats, and no numbers.
    let is_number = typed.bytes().all(|byte| byte.is_ascii_digit() || b"+-.eE".contains(&byte));
    let number = typed.parse::<f64>().ok().filter(|_| is_number);
    let number = number.ok_or_else(|| format!("`{text}` {NO_NUMBER}"))?;
    let decimals = if number.abs() < 1e10 { usize::from(Decimal::DECIMALS_MAX) } else { 0 };
    let nearest = Decimal::parse(&format!("{:.decimals$}", number.clamp(-TOO_LARGE, TOO_LARGE)));
    nearest.map(Decimal::normalized).ok_or_else(|| format!("`{text}` {NO_NUMBER}"))
}

const NO_NUMBER: &str = "is not a number";

/// No wish is larger: what is beyond it counts as this.
const TOO_LARGE: f64 = 1e29;

/// Whether the two differ only by what a calculation with floats leaves: 21.400000000000002 is 21.4.
fn is_noise(step: Option<Decimal>, wanted: Decimal, taken: Decimal) -> bool {
    let step = step.unwrap_or(Decimal::ONE).to_f64().abs();
    (wanted.to_f64() - taken.to_f64()).abs() <= step * 1e-6
}

/// Between which values a number may be written, in the unit shown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    pub min: Decimal,
    pub max: Decimal,
    /// The finest step that makes a difference; `None` for floats without one.
    pub step: Option<Decimal>,
}

/// The limits of a writable number as they are now; `None` for what is no number, or a float
/// without any.
pub fn limits(resolved: &Resolved<'_>, rule: &WriteRule) -> Option<Limits> {
    let form = resolved.form;
    let resolution = resolved.step();
    match rule {
        WriteRule::Range { min, max, step } => {
            // Where a register gives the decimals, the profile's range is the register's own.
            let shift = if matches!(form.decimals, Some(Decimals::By(_))) { resolved.shift } else { 0 };
            let shifted = |number: Decimal| Decimal { decimals: number.decimals + shift, ..number };
            Some(Limits { min: shifted(*min), max: shifted(*max), step: step.map(shifted).or(resolution) })
        }
        WriteRule::Any if matches!(form.names, Names::All(_)) || form.kind == Kind::Bool => None,
        WriteRule::Any => {
            let capacity = form.kind.integer_range().and_then(|(low, high)| {
                let (a, b) = (to_unit(resolved, low)?, to_unit(resolved, high)?);
                Some(if a.compare(b).is_le() { (a, b) } else { (b, a) })
            });
            let (min, max) = measuring_range(resolved).or(capacity)?;
            Some(Limits { min, max, step: resolution })
        }
        WriteRule::Names(_) | WriteRule::Press { .. } => None,
    }
}

/// The manual's range in the unit that is shown now: profiles give temperatures in °C.
fn measuring_range(resolved: &Resolved<'_>) -> Option<(Decimal, Decimal)> {
    let (mut min, mut max) = resolved.form.range?;
    if resolved.form.difference {
        max = max.checked_add(min.negated())?;
        min = max.negated();
    }
    if resolved.unit.as_deref() == Some("°F") {
        let factor = Decimal { units: 18, decimals: 1 };
        let zero = Decimal::integer(if resolved.form.difference { 0 } else { 32 });
        min = min.checked_mul(factor)?.checked_add(zero)?.normalized();
        max = max.checked_mul(factor)?.checked_add(zero)?.normalized();
    }
    Some((min, max))
}

/// The words that make `text` true for a point, for its whole span: a field of bits as one word not
/// yet shifted, a value shorter than its span filled up with zeros. `Err` is the rule that the wish
/// breaks, in words for a person.
pub fn encode(
    point: &Point,
    rule: &WriteRule,
    resolved: &Resolved<'_>,
    text: &str,
) -> Result<Vec<u16>, String> {
    let form = resolved.form;
    // Whoever types a value, or makes it of a template, leaves blanks; only in a text they mean something.
    let text = if matches!(form.kind, Kind::Text { .. }) { text } else { text.trim() };
    if let WriteRule::Press { word, .. } = rule {
        return if text == WriteRule::PRESS {
            Ok(vec![*word])
        } else {
            Err(format!("`{text}` is not what presses a button; expected `{}`", WriteRule::PRESS))
        };
    }
    if form.since.is_some() {
        return Err("a moment cannot be written".to_string());
    }
    let mut words = if form.kind.is_text() {
        encode_text(form, text)?
    } else if form.kind == Kind::Bool {
        match text {
            "ON" => vec![1],
            "OFF" => vec![0],
            "" => return Err("an empty text is no value; expected `ON` or `OFF`".into()),
            _ => return Err(format!("`{text}` is neither `ON` nor `OFF`")),
        }
    } else if let Some(raw) = named_value(form, rule, text)? {
        encode_integer(form, raw)
    } else if form.kind.is_float() {
        encode_float(resolved, rule, text)?
    } else {
        encode_integer(form, checked_number(point, resolved, rule, text)?)
    };
    let registers = if point.at.span.table().is_bits() { 1 } else { point.at.span.count() as usize };
    words.resize(registers.max(words.len()), 0);
    Ok(words)
}

/// The raw value of a name, if `text` is one that may be written; an error if only names may be.
fn named_value(form: &Form, rule: &WriteRule, text: &str) -> Result<Option<i128>, String> {
    let named = form.names.list().iter().find(|(_, name)| name == text);
    let allowed = |name: &str| match rule {
        WriteRule::Names(names) => names.iter().any(|allowed| allowed == name),
        _ => true,
    };
    match named {
        Some((raw, name)) if allowed(name) => Ok(Some(*raw)),
        _ if matches!(form.names, Names::All(_)) || matches!(rule, WriteRule::Names(_)) => {
            let names: Vec<String> = form
                .names
                .list()
                .iter()
                .filter(|(_, name)| allowed(name))
                .map(|(_, name)| format!("`{name}`"))
                .collect();
            Err(format!("`{text}` is none of {}", names.join(", ")))
        }
        _ => Ok(None),
    }
}

fn checked_number(
    point: &Point,
    resolved: &Resolved<'_>,
    rule: &WriteRule,
    text: &str,
) -> Result<i128, String> {
    let form = resolved.form;
    let wanted = wished_number(text)?;
    check_limits(resolved, rule, wanted, text)?;
    let overflow = || format!("`{text}` is too large");
    let stepped = stepped(resolved, rule, wanted).ok_or_else(overflow)?.unwrap_or(wanted);
    let above_offset = stepped.checked_add(form.offset.negated()).ok_or_else(overflow)?;
    let resolution = Decimal { units: form.scale.units, decimals: form.scale.decimals + resolved.shift };
    let raw = rounded_quotient(above_offset, resolution).ok_or_else(overflow)?;
    let raw = inside(resolved, rule, raw);
    let (mut low, mut high) = form.kind.integer_range().ok_or_else(overflow)?;
    let field_bits = match point.at.bits {
        Some(bits) => Some(u32::from(bits.width())),
        None if point.at.span.table().is_bits() => Some(point.at.span.count()),
        None => None,
    };
    if let Some(width) = field_bits {
        (low, high) = (low.max(0), high.min((1i128 << width) - 1));
    }
    if raw < low || raw > high {
        return Err(format!("`{text}` does not fit the register, which holds {low} to {high}"));
    }
    Ok(raw)
}

/// The nearest of the profile's steps, or `Some(None)` where it gives none; `None` for what is too large.
fn stepped(resolved: &Resolved<'_>, rule: &WriteRule, wanted: Decimal) -> Option<Option<Decimal>> {
    let limits = limits(resolved, rule);
    match (rule, limits, limits.and_then(|limits| limits.step)) {
        (WriteRule::Range { step: Some(_), .. }, Some(limits), Some(step)) => {
            nearest_step(wanted, step, limits).map(Some)
        }
        _ => Some(None),
    }
}

/// Steps are counted from the smallest value, as Home Assistant counts them, and none is beyond the largest.
fn nearest_step(wanted: Decimal, step: Decimal, limits: Limits) -> Option<Decimal> {
    let at = |steps: i128| Decimal::integer(steps).checked_mul(step)?.checked_add(limits.min);
    let steps = rounded_quotient(wanted.checked_add(limits.min.negated())?, step)?;
    let nearest = at(steps)?;
    if nearest.compare(limits.max).is_gt() { at(steps - 1) } else { Some(nearest) }
}

/// What is rounded beyond a limit that the register cannot hold exactly is the value before it.
fn inside(resolved: &Resolved<'_>, rule: &WriteRule, raw: i128) -> i128 {
    let (Some(limits), Some(value)) = (limits(resolved, rule), to_unit(resolved, raw)) else { return raw };
    let inwards = if value.compare(limits.max).is_gt() {
        -1
    } else if value.compare(limits.min).is_lt() {
        1
    } else {
        0
    };
    raw + inwards * resolved.form.scale.units.signum()
}

/// What would be right, where only what is wrong is said.
fn with_range(fault: String, resolved: &Resolved<'_>, rule: &WriteRule) -> String {
    if !fault.ends_with(NO_NUMBER) {
        return fault;
    }
    match limits(resolved, rule) {
        Some(Limits { min, max, .. }) => format!("{fault}; expected one from {min} to {max}"),
        None => format!("{fault}; expected one like `21.5`"),
    }
}

fn check_limits(
    resolved: &Resolved<'_>,
    rule: &WriteRule,
    wanted: Decimal,
    text: &str,
) -> Result<(), String> {
    let Some(limits) = limits(resolved, rule) else { return Ok(()) };
    if wanted.compare(limits.min).is_lt() || wanted.compare(limits.max).is_gt() {
        return Err(format!("`{text}` is outside {} to {}", limits.min, limits.max));
    }
    Ok(())
}

/// `number ÷ divisor`, rounded to the nearest whole, halves away from zero.
fn rounded_quotient(number: Decimal, divisor: Decimal) -> Option<i128> {
    let decimals = number.decimals.max(divisor.decimals);
    let (a, b) = (number.with_decimals(decimals)?.units, divisor.with_decimals(decimals)?.units);
    if b == 0 {
        return None;
    }
    let (quotient, rest) = (a / b, a % b);
    let away = if (a < 0) == (b < 0) { 1 } else { -1 };
    Some(if rest.unsigned_abs() * 2 >= b.unsigned_abs() { quotient + away } else { quotient })
}

fn encode_float(resolved: &Resolved<'_>, rule: &WriteRule, text: &str) -> Result<Vec<u16>, String> {
    let form = resolved.form;
    let number = wished_number(text)?;
    check_limits(resolved, rule, number, text)?;
    let wanted: f64 = match stepped(resolved, rule, number) {
        Some(Some(stepped)) => stepped.to_f64(),
        // A float holds what has too many digits for a decimal.
        _ => text.trim().parse().map_err(|_| format!("`{text}` {NO_NUMBER}"))?,
    };
    if let Some(limits) = limits(resolved, rule) {
        if wanted < limits.min.to_f64() || wanted > limits.max.to_f64() {
            return Err(format!("`{text}` is outside {} to {}", limits.min, limits.max));
        }
    }
    let register = (wanted - form.offset.to_f64()) / form.scale.to_f64();
    let finite =
        |fits: bool| if fits { Ok(()) } else { Err(format!("`{text}` is too large for the register")) };
    let bytes = if form.kind == Kind::F32 {
        finite((register as f32).is_finite())?;
        (register as f32).to_be_bytes().to_vec()
    } else {
        finite(register.is_finite())?;
        register.to_be_bytes().to_vec()
    };
    let words = bytes.chunks(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect();
    Ok(form.order.turn(words))
}

fn encode_integer(form: &Form, raw: i128) -> Vec<u16> {
    let bits = match form.kind {
        Kind::Bcd16 | Kind::Bcd32 => u64::from_str_radix(&raw.to_string(), 16).unwrap_or(0),
        _ => raw as u64,
    };
    let count = form.kind.registers();
    let words = (0..count).rev().map(|index| (bits >> (16 * index)) as u16).collect();
    form.order.turn(words)
}

fn encode_text(form: &Form, text: &str) -> Result<Vec<u16>, String> {
    match form.kind {
        Kind::LetterNumber => {
            let letter = text.bytes().next().filter(u8::is_ascii_alphabetic);
            let number = text.get(1..).and_then(|digits| digits.parse::<u8>().ok());
            match (letter, number) {
                (Some(letter), Some(number)) => {
                    Ok(form.order.turn(vec![u16::from_be_bytes([letter, number])]))
                }
                _ => Err(format!("`{text}` is not a letter and a number from 0 to 255, as in `R017`")),
            }
        }
        Kind::Text { registers } => {
            let room = usize::from(registers) * 2;
            if text.len() > room {
                return Err(format!("`{text}` has {} bytes; expected at most {room}", text.len()));
            }
            if text.contains(char::is_control) {
                return Err(format!("{text:?} has control characters; expected a text without"));
            }
            // What stands for bytes that are no UTF-8 is not what was wished for.
            if text.contains(char::REPLACEMENT_CHARACTER) {
                return Err(format!("`{text}` is not UTF-8; expected a text in it"));
            }
            let mut bytes = text.as_bytes().to_vec();
            bytes.resize(room, 0);
            let swap = form.order.swaps_bytes();
            let word = |pair: &[u8]| u16::from_be_bytes([pair[0], pair[1]]);
            Ok(bytes.chunks(2).map(|pair| if swap { word(pair).swap_bytes() } else { word(pair) }).collect())
        }
        _ => Err("a date cannot be written".to_string()),
    }
}
