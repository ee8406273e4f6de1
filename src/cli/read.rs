//! `busker read`: registers of one device in every interpretation, or one of its points.

use serde_json::{Value, json};

use super::by_hand::{Asked, ByHand, span};
use super::{Failure, output};
use crate::engine::address::Span;
use crate::engine::codec::{self, Raw};
use crate::engine::device::{Form, Kind, Order};
use crate::engine::value::Reading;

/// Read registers of one device by hand
///
/// Shows every register in every interpretation: hexadecimal, with and without sign, as bits, as
/// text, and each pair of registers as 32-bit numbers in the four orders of bytes. With --config and
/// --device, or with --profile, a point's name is understood as well.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  busker read --serial /dev/ttyUSB0 --baud 19200 --parity even --unit 18 'coil 0..3'
  busker read --tcp 192.168.1.20:502 --unit 1 'input 0..9' --json
  busker read --config busker.yaml --device heating_relays relay_1")]
pub struct Args {
    #[command(flatten)]
    device: ByHand,
    /// What to read: `holding 0..3`, `input 8`, `coil 0..7`, `discrete 2`, or a point's name
    #[arg(value_name = "WHAT")]
    what: String,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: Args) -> Result<(), Failure> {
    let span = span(&args.what).transpose()?;
    let mut device = args.device.open()?;
    let Some(span) = span else { return read_point(&mut device, &args) };
    refuse_forbidden(&device, span)?;
    let words = device.read(span)?;
    if args.json {
        return output::print_json(&as_json(device.unit(), span, &words));
    }
    output::print(&as_text(span, &words))
}

/// A read of some registers stops outputs or ends the device's answers; the profile says which.
fn refuse_forbidden(device: &Asked, span: Span) -> Result<(), Failure> {
    let forbidden = device.device().into_iter().flat_map(|device| &device.wire.forbidden);
    match forbidden.into_iter().find(|forbidden| forbidden.span.overlaps(span)) {
        Some(forbidden) => Err(Failure::wrong(format!(
            "`{span}` holds the forbidden `{}`: {}",
            forbidden.span, forbidden.reason
        ))),
        None => Ok(()),
    }
}

fn read_point(asked: &mut Asked, args: &Args) -> Result<(), Failure> {
    let (device, index) = asked.point(&args.what)?;
    let point = &device.points[index];
    let mut known = vec![None; device.points.len()];
    asked.learn(&device, index, &mut known)?;
    let words = asked.read(point.at.span)?;
    let field = codec::words_at(point.at, point.at.span.first(), &words).unwrap_or_default();
    let resolved = codec::resolve(&device, index, &known);
    let reading = match &resolved {
        Ok(resolved) => codec::read(resolved, &field),
        Err(missing) => Reading::Missing(missing.clone()),
    };
    let reason = match &reading {
        Reading::Missing(missing) => Some(missing.to_string()),
        _ => None,
    };
    let unit = resolved.ok().and_then(|resolved| resolved.unit);
    let hex = hexadecimal(&words);
    if args.json {
        return output::print_json(&json!({
            "device": device.profile, "point": point.name, "value": reading.to_string(), "unit": unit,
            "reason": reason, "at": point.at.to_string(), "words": hex,
        }));
    }
    let mut table = output::Table::new();
    let behind = reason.map(|reason| format!("({reason})")).or(unit).unwrap_or_default();
    table.row([&point.name, &reading.to_string(), &behind, &point.at.to_string(), &hex.join(" ")]);
    output::print(&table.render())
}

fn hexadecimal(words: &[u16]) -> Vec<String> {
    words.iter().map(|word| format!("{word:04X}")).collect()
}

/// The table of what was read, as [`run`] prints it.
pub fn as_text(span: Span, words: &[u16]) -> String {
    let addresses = span.first()..=span.last();
    let place = |address: u16| Span::single(span.table(), address).to_string();
    let mut table = output::Table::new();
    if span.table().is_bits() {
        for (address, word) in addresses.zip(words) {
            table.row([place(address).as_str(), if *word == 1 { "ON" } else { "OFF" }]);
        }
        return table.render();
    }
    table.row(["register", "hex", "u16", "i16", "bits 15..0", "text"]).right(2).right(3);
    for (address, word) in addresses.zip(words) {
        let (signed, bits) = (*word as i16, bits(*word));
        let row = [place(address), format!("{word:04X}"), word.to_string(), signed.to_string(), bits];
        table.row(row.into_iter().chain([text(*word)])).right(2).right(3);
    }
    let mut pairs = output::Table::new();
    pairs.row(["registers", "", "ABCD", "CDAB", "BADC", "DCBA"]).right(2).right(3).right(4).right(5);
    for (first, pair) in span_pairs(span, words) {
        for (row, kind) in PAIR_KINDS.into_iter().enumerate() {
            let place = if row == 0 { first.to_string() } else { String::new() };
            let numbers = ORDERS.map(|order| told(kind, order, pair).unwrap_or_else(|| "-".into()));
            pairs.row([place, kind.name()].into_iter().chain(numbers)).right(2).right(3).right(4).right(5);
        }
    }
    if words.len() < 2 { table.render() } else { format!("{}\n{}", table.render(), pairs.render()) }
}

const PAIR_KINDS: [Kind; 3] = [Kind::U32, Kind::I32, Kind::F32];
const ORDERS: [Order; 4] = [Order::Abcd, Order::Cdab, Order::Badc, Order::Dcba];

fn as_json(unit: u8, span: Span, words: &[u16]) -> Value {
    let addresses = span.first()..=span.last();
    if span.table().is_bits() {
        let bits: Vec<Value> = addresses
            .zip(words)
            .map(|(address, word)| json!({"address": address, "on": *word == 1}))
            .collect();
        return json!({"unit": unit, "at": span.to_string(), "bits": bits});
    }
    let register = |(address, word): (u16, &u16)| {
        json!({"address": address, "hex": format!("{word:04X}"), "u16": word, "i16": *word as i16,
            "bits": bits(*word), "text": text(*word)})
    };
    let registers: Vec<Value> = addresses.zip(words).map(register).collect();
    let in_orders = |kind: Kind, pair: &[u16]| {
        let number = |order| told(kind, order, pair).and_then(|text| serde_json::from_str(&text).ok());
        let [abcd, cdab, badc, dcba] = ORDERS.map(|order| number(order).unwrap_or(Value::Null));
        json!({"abcd": abcd, "cdab": cdab, "badc": badc, "dcba": dcba})
    };
    let pairs: Vec<Value> = span_pairs(span, words)
        .map(|(at, pair)| {
            json!({"at": at.to_string(), "u32": in_orders(Kind::U32, pair), "i32": in_orders(Kind::I32, pair),
                "f32": in_orders(Kind::F32, pair)})
        })
        .collect();
    json!({"unit": unit, "at": span.to_string(), "registers": registers, "pairs": pairs})
}

/// Each two registers that stand side by side.
fn span_pairs(span: Span, words: &[u16]) -> impl Iterator<Item = (Span, &[u16])> {
    let places =
        (span.first()..=span.last()).filter_map(move |first| Span::with_count(span.table(), first, 2));
    places.zip(words.windows(2))
}

/// A pair in one interpretation; `None` for a float that is no number.
fn told(kind: Kind, order: Order, pair: &[u16]) -> Option<String> {
    let form = Form { order, ..Form::new(kind) };
    match codec::raw(&form, pair) {
        Raw::Integer(number) => Some(number.to_string()),
        // Far from 1, digits would fill the line: 1.5e-39.
        Raw::Float(number) if number != 0.0 && !(1e-4..1e9).contains(&number.abs()) => {
            Some(format!("{number:e}"))
        }
        Raw::Float(number) => Some(number.to_string()),
        Raw::Text(_) | Raw::Nonsense => None,
    }
}

fn bits(word: u16) -> String {
    let digits = format!("{word:016b}");
    [&digits[..4], &digits[4..8], &digits[8..12], &digits[12..]].join(" ")
}

/// The two bytes as characters, a dot for what cannot be shown.
fn text(word: u16) -> String {
    let shown = |byte: u8| if byte.is_ascii_graphic() { char::from(byte) } else { '.' };
    word.to_be_bytes().map(shown).into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::address::Table;

    #[test]
    fn registers_are_shown_in_every_interpretation() {
        let span = Span::with_count(Table::Holding, 4, 2).expect("a span");
        let expected = "\
register   hex     u16    i16  bits 15..0           text
holding 4  42F6  17142  17142  0100 0010 1111 0110  B.
holding 5  E979  59769  -5767  1110 1001 0111 1001  .y

registers                ABCD           CDAB           BADC          DCBA
holding 4..5  u32  1123477881     3917038326     4131551721    2045376066
              i32  1123477881     -377928970     -163415575    2045376066
              f32     123.456  -1.8833671e25  -9.8611155e32  1.5184998e35
";
        assert_eq!(as_text(span, &[0x42F6, 0xE979]), expected);
        assert_eq!(as_text(Span::single(Table::Coil, 7), &[1]), "coil 7  ON\n");
    }

    #[test]
    fn json_holds_the_same_and_null_for_what_is_no_number() {
        let span = Span::with_count(Table::Input, 0, 2).expect("a span");
        let json = as_json(18, span, &[0x7FC0, 0x0000]);
        assert_eq!(json["registers"][0]["u16"], 0x7FC0);
        assert_eq!(json["pairs"][0]["at"], "input 0..1");
        assert_eq!(json["pairs"][0]["f32"]["abcd"], Value::Null);
        assert_eq!(json["pairs"][0]["u32"]["abcd"], 0x7FC0_0000_u32);
        assert_eq!(json["pairs"][0]["i32"]["cdab"], 0x7FC0);
    }
}
