//! Which values a plain device takes, and what it holds before anybody has written one.

use crate::engine::codec::{self, Raw, Resolved};
use crate::engine::device::{Device, Encoding, Form, Kind, Names, WriteRule};
use crate::engine::value::Decimal;

/// What becomes of a field that is written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// This is what the device then holds.
    Taken(Vec<u16>),
    /// Out of range; this is the nearest value in it.
    Limited(Vec<u16>),
    Refused,
}

/// Measures a field by the point's rule; `known` as in [`codec::resolve`].
pub fn judge(
    device: &Device,
    index: usize,
    rule: &WriteRule,
    field: &[u16],
    known: &[Option<i128>],
) -> Verdict {
    let taken = || Verdict::Taken(field.to_vec());
    if let WriteRule::Press { word, self_clearing } = rule {
        return match field {
            [pressed] if pressed == word && *self_clearing => Verdict::Taken(vec![0]),
            [pressed] if pressed == word => taken(),
            _ => Verdict::Refused,
        };
    }
    // What has no meaning now is held and waits for one.
    let Ok(resolved) = codec::resolve(device, index, known) else { return taken() };
    let limited = |text: &str| match codec::encode(&device.points[index], rule, &resolved, text) {
        Ok(field) => Verdict::Limited(field),
        Err(_) => Verdict::Refused,
    };
    let form = resolved.form;
    match codec::raw(form, field) {
        Raw::Nonsense => Verdict::Refused,
        Raw::Text(_) => taken(),
        Raw::Integer(raw) if form.kind == Kind::Bool => {
            if matches!(raw, 0 | 1) {
                taken()
            } else {
                limited("ON")
            }
        }
        Raw::Integer(raw) => match form.names.list().iter().find(|(value, _)| *value == raw) {
            Some((_, name)) if is_allowed(rule, name) => taken(),
            None if is_number(form, rule) => outside(&resolved, rule, codec::to_unit(&resolved, raw))
                .map_or_else(taken, |end| limited(&end)),
            _ => match nearest_name(form, rule, raw) {
                Some(name) => limited(name),
                None => Verdict::Refused,
            },
        },
        Raw::Float(raw) => {
            let value = raw * form.scale.to_f64() + form.offset.to_f64();
            let value = Decimal::parse(&format!("{value:e}"));
            outside(&resolved, rule, value).map_or_else(taken, |end| limited(&end))
        }
    }
}

fn is_allowed(rule: &WriteRule, name: &str) -> bool {
    match rule {
        WriteRule::Names(names) => names.iter().any(|allowed| allowed == name),
        _ => true,
    }
}

fn is_number(form: &Form, rule: &WriteRule) -> bool {
    !matches!(form.names, Names::All(_)) && !matches!(rule, WriteRule::Names(_))
}

/// The end of the range that the value is beyond.
fn outside(resolved: &Resolved<'_>, rule: &WriteRule, value: Option<Decimal>) -> Option<String> {
    let (limits, value) = (codec::limits(resolved, rule)?, value?);
    if value.compare(limits.min).is_lt() {
        Some(limits.min.to_string())
    } else {
        value.compare(limits.max).is_gt().then(|| limits.max.to_string())
    }
}

/// Of the names that may be written, the one whose value is nearest.
fn nearest_name<'f>(form: &'f Form, rule: &WriteRule, raw: i128) -> Option<&'f str> {
    let allowed = form.names.list().iter().filter(|(_, name)| is_allowed(rule, name));
    allowed.min_by_key(|(value, _)| (value - raw).abs()).map(|(_, name)| name.as_str())
}

/// The field that a point has when the device leaves the factory.
pub fn initial(device: &Device, index: usize, known: &[Option<i128>]) -> Vec<u16> {
    let point = &device.points[index];
    let count = if point.at.span.table().is_bits() { 1 } else { point.at.span.count() as usize };
    let form = match (&point.encoding, codec::resolve(device, index, known)) {
        (_, Ok(resolved)) => Some(resolved.form),
        (Encoding::Plain(form), Err(_)) => Some(form),
        (Encoding::Cases { .. }, Err(_)) => None,
    };
    let first_name = form.and_then(|form| match &form.names {
        Names::All(names) if names.iter().all(|(value, _)| *value != 0) => names.first(),
        _ => None,
    });
    let raw = point.default.or(first_name.map(|(value, _)| *value)).unwrap_or(0);
    let mut words = form.map_or_else(|| vec![raw as u16], |form| words_of(form, raw));
    words.resize(count, 0);
    words
}

/// A raw number as the registers hold it.
fn words_of(form: &Form, raw: i128) -> Vec<u16> {
    let bits = match form.kind {
        Kind::F32 => u64::from((raw as f32).to_bits()),
        Kind::F64 => (raw as f64).to_bits(),
        // Decimal digits read as hexadecimal ones.
        Kind::Bcd16 | Kind::Bcd32 => u64::from_str_radix(&raw.to_string(), 16).unwrap_or(0),
        _ => raw as u64,
    };
    let word = |from_low: u16| (bits >> (16 * u32::from(from_low.min(3)))) as u16;
    let registers = form.kind.registers();
    let mut words: Vec<u16> = if form.kind.is_text() && raw == 0 {
        vec![0; registers.into()]
    } else {
        (0..registers.min(4)).rev().map(word).collect()
    };
    if form.order.low_word_first() {
        words.reverse();
    }
    if form.order.swaps_bytes() {
        words.iter_mut().for_each(|word| *word = word.swap_bytes());
    }
    words
}
