//! `busker write`: a guarded write to one device: read, written, read back, shown.

use anyhow::anyhow;

use super::by_hand::{Asked, ByHand, span};
use super::read::as_text;
use super::{Failure, output};
use crate::engine::address::{Span, Table};
use crate::engine::command::{ACCEPTED, BUSY_MAX, CommandFlow, OutcomeKind, PAUSE_BUSY, words_of};
use crate::engine::device::Order;
use crate::engine::modbus::{ACKNOWLEDGE, Answer, Call, RequestError};
use crate::engine::yaml::Scalar;

/// Write to one device by hand, and read back what it holds then
///
/// Words are written as they are: decimal, negative or 0x…; coils as ON or OFF. --type and --order
/// write one value into two registers. With --config and --device, or with --profile, a point's
/// name is written by the rules of its profile. Ends with 1 if the device holds something else afterwards.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  busker write --serial /dev/ttyUSB0 --baud 19200 --parity even --unit 18 'coil 0' ON
  busker write --tcp 192.168.1.20:502 --unit 1 'holding 16..17' 135 0x00FF
  busker write --tcp 192.168.1.20:502 --unit 1 'holding 16' 21.5 --type f32 --order cdab
  busker write --config busker.yaml --device heating_relays relay_1 ON")]
pub struct Args {
    #[command(flatten)]
    device: ByHand,
    /// Where: `holding 16`, `coil 0..3`, or a point's name
    #[arg(value_name = "WHERE")]
    place: String,
    /// What, one for each register or coil
    #[arg(value_name = "VALUE", required = true, allow_negative_numbers = true)]
    values: Vec<String>,
    /// What a value is: u16, i16, u32, i32 or f32
    #[arg(long = "type", value_name = "TYPE", default_value = "word", hide_default_value = true, value_parser = ["word", "u16", "i16", "u32", "i32", "f32"])]
    kind: String,
    /// The order of a value's bytes: abcd, cdab, badc or dcba
    #[arg(long, default_value = "abcd", value_parser = order)]
    order: Order,
    /// The function code: 6 or 16 for registers, 5 or 15 for coils; by default the one for the count
    #[arg(long, value_name = "CODE", value_parser = clap::value_parser!(u8))]
    with: Option<u8>,
}

fn order(name: &str) -> Result<Order, String> {
    Order::parse(&name.to_ascii_lowercase())
}

pub fn run(args: Args) -> Result<(), Failure> {
    let Some(span) = span(&args.place).transpose()? else {
        return write_point(&mut args.device.open()?, &args);
    };
    let words = words(span.table(), &args)?;
    let span = span_to_write(span, words.len())?;
    let call = call(span, &words, args.with)?;
    let mut device = args.device.open()?;
    if let Some(profile) = device.device() {
        // The profile's rules are by point, and a bare register would go round them.
        return Err(Failure::wrong(format!(
            "with a profile only points are written, by the rules of {}; `busker profiles show {0}` lists them",
            profile.profile
        )));
    }
    write_words(&mut device, span, &words, &call)
}

fn write_words(device: &mut Asked, span: Span, words: &[u16], call: &Call) -> Result<(), Failure> {
    if device.is_broadcast() {
        device.ask(call)?.map_err(|error| anyhow!("{error}"))?;
        eprintln!("sent to all units; none answers");
        return Ok(());
    }
    // Also to learn whether the line returns what we send: a write's echo looks like its reply.
    match device.ask(&Call::Read(span))? {
        Ok(answer) => eprintln!("before:\n{}", as_text(span, &words_of(&answer))),
        Err(error @ RequestError::Exception(_)) => eprintln!("`{span}` cannot be read: {error}"),
        Err(error) => return Err(anyhow!("unit {}: nothing was written: {error}", device.unit()).into()),
    }
    let written = device.ask(call)?;
    if let Err(error) = &written {
        eprintln!("{call}: {error}");
    }
    let is_doing_it = written == Err(RequestError::Exception(ACKNOWLEDGE));
    let found = match read_back(device, span, words, is_doing_it)? {
        Ok(answer) => words_of(&answer),
        Err(error) if written == Ok(Answer::Written) => {
            return Err(anyhow!("written, but `{span}` cannot be read back: {error}").into());
        }
        Err(error) if is_doing_it => {
            return Err(anyhow!("{ACCEPTED}; `{span}` cannot be read back yet: {error}").into());
        }
        Err(error) => return Err(anyhow!("`{span}` cannot be read back: {error}").into()),
    };
    output::print(&as_text(span, &found))?;
    if found == words {
        return Ok(());
    }
    Err(match written {
        Ok(_) => anyhow!("the device confirmed the write and holds another value"),
        Err(_) if is_doing_it => {
            anyhow!("unit {}: {ACCEPTED}, but holds something else still", device.unit())
        }
        Err(error) => anyhow!("unit {}: {error}", device.unit()),
    }
    .into())
}

/// What the device holds now. One that has only accepted the words is given the time that a command gives it.
fn read_back(
    device: &mut Asked,
    span: Span,
    words: &[u16],
    is_doing_it: bool,
) -> Result<Result<Answer, RequestError>, Failure> {
    let times = if is_doing_it { BUSY_MAX } else { 0 };
    for _ in 0..times {
        std::thread::sleep(PAUSE_BUSY);
        match device.ask(&Call::Read(span))? {
            Err(RequestError::Exception(ACKNOWLEDGE)) => {}
            Ok(answer) if words_of(&answer) != words => {}
            ended => return Ok(ended),
        }
    }
    device.ask(&Call::Read(span))
}

fn write_point(asked: &mut Asked, args: &Args) -> Result<(), Failure> {
    let (device, index) = asked.point(&args.place)?;
    let [wanted] = &args.values[..] else {
        return Err(Failure::wrong("a point takes one value"));
    };
    if args.kind != "word" || args.with.is_some() || args.order != Order::Abcd {
        return Err(Failure::wrong("the profile knows the point's type, order and function code"));
    }
    let mut known = vec![None; device.points.len()];
    asked.learn(&device, index, &mut known)?;
    let outcome = match CommandFlow::begin(&device, index, wanted, &known) {
        Ok((flow, first)) => asked.carry_out(&device, flow, first, &known)?,
        Err(outcome) => return Err(Failure::wrong(outcome.reason.unwrap_or_default())),
    };
    let mut line = vec![args.place.clone(), outcome.kind.name().to_owned()];
    line.extend(outcome.found.map(|found| format!("the device holds {found}")));
    // Where it is not written as it was wished, or stood there already.
    if matches!(outcome.kind, OutcomeKind::Done | OutcomeKind::Unchanged) {
        line.extend(outcome.reason.clone());
    }
    output::print(&format!("{}\n", line.join("  ")))?;
    match outcome.kind {
        OutcomeKind::Done | OutcomeKind::Unchanged => Ok(()),
        _ => Err(anyhow!("{}", outcome.reason.unwrap_or_else(|| outcome.kind.name().into())).into()),
    }
}

/// The words (bits: 0 or 1) that the arguments say.
fn words(table: Table, args: &Args) -> Result<Vec<u16>, Failure> {
    if !table.is_writable() {
        return Err(Failure::wrong(format!("`{table}` can only be read; coil and holding can be written")));
    }
    let mut words = Vec::new();
    for value in &args.values {
        words.extend(words_of_value(table, value, &args.kind, args.order).map_err(Failure::wrong)?);
    }
    Ok(words)
}

fn words_of_value(table: Table, value: &str, kind: &str, order: Order) -> Result<Vec<u16>, String> {
    if table.is_bits() {
        return match value {
            "ON" | "on" | "1" => Ok(vec![1]),
            "OFF" | "off" | "0" => Ok(vec![0]),
            _ => Err(format!("`{value}` is no coil's value; expected ON or OFF")),
        };
    }
    let number = match value.strip_prefix("0x") {
        Some(digits) => i64::from_str_radix(digits, 16).ok(),
        None => value.parse().ok(),
    };
    let within = |low: i64, high: i64| match number {
        Some(number) if (low..=high).contains(&number) => Ok(number),
        _ => Err(format!("`{value}` is no {kind}; expected {low} to {high}")),
    };
    let wide = match kind {
        "u32" => within(0, u32::MAX.into())? as u32,
        "i32" => within(i32::MIN.into(), i32::MAX.into())? as u32,
        "f32" => match value.parse::<f32>() {
            Ok(number) if number.is_finite() => number.to_bits(),
            _ => return Err(format!("`{value}` is no f32; expected a number like 21.5")),
        },
        single => {
            let (low, high) = match single {
                "u16" => (0, u16::MAX.into()),
                "i16" => (i16::MIN.into(), i16::MAX.into()),
                _ => (i16::MIN.into(), u16::MAX.into()),
            };
            return Ok(order.turn(vec![within(low, high)? as u16]));
        }
    };
    Ok(order.turn(vec![(wide >> 16) as u16, wide as u16]))
}

/// A single address is where the words begin; a span must be filled exactly.
fn span_to_write(span: Span, count: usize) -> Result<Span, Failure> {
    if span.count() > 1 && span.count() as usize != count {
        let (needed, given) = (span.count(), count);
        return Err(Failure::wrong(format!(
            "`{span}` takes {needed} values of one address each; found {given}"
        )));
    }
    Span::with_count(span.table(), span.first(), count as u16)
        .ok_or_else(|| Failure::wrong(format!("{count} values from `{span}` on pass address 65535")))
}

fn call(span: Span, words: &[u16], with: Option<u8>) -> Result<Call, Failure> {
    let address = span.first();
    let bits = || words.iter().map(|word| *word == 1).collect();
    let default = match (span.table().is_bits(), words.len()) {
        (true, 1) => 5,
        (true, _) => 15,
        (false, 1) => 6,
        (false, _) => 16,
    };
    match (span.table().is_bits(), with.unwrap_or(default), words) {
        (true, 5, [word]) => Ok(Call::WriteCoil { address, on: *word == 1 }),
        (true, 15, _) => Ok(Call::WriteCoils { address, values: bits() }),
        (false, 6, [word]) => Ok(Call::WriteRegister { address, word: *word }),
        (false, 16, _) => Ok(Call::WriteRegisters { address, words: words.to_vec() }),
        (_, code, _) => Err(Failure::wrong(format!(
            "function {code} does not write {} of `{}`; expected {default}",
            if words.len() == 1 { "one address".into() } else { format!("{} addresses", words.len()) },
            span.table()
        ))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_become_words_or_are_refused_with_what_would_be_right() {
        let check = |value: &str, kind: &str, order: Order, words: Result<&[u16], &str>| {
            let found = words_of_value(Table::Holding, value, kind, order);
            assert_eq!(found.as_deref(), words.map_err(str::to_owned).as_ref().copied(), "{value} {kind}");
        };
        check("135", "word", Order::Abcd, Ok(&[135]));
        check("-1", "word", Order::Abcd, Ok(&[0xFFFF]));
        check("0x8000", "word", Order::Abcd, Ok(&[0x8000]));
        check("0x1234", "u16", Order::Badc, Ok(&[0x3412]));
        check("0x11223344", "u32", Order::Abcd, Ok(&[0x1122, 0x3344]));
        check("0x11223344", "u32", Order::Cdab, Ok(&[0x3344, 0x1122]));
        check("0x11223344", "u32", Order::Badc, Ok(&[0x2211, 0x4433]));
        check("0x11223344", "u32", Order::Dcba, Ok(&[0x4433, 0x2211]));
        check("-2", "i32", Order::Abcd, Ok(&[0xFFFF, 0xFFFE]));
        check("123.456", "f32", Order::Abcd, Ok(&[0x42F6, 0xE979]));
        check("65536", "word", Order::Abcd, Err("`65536` is no word; expected -32768 to 65535"));
        check("-1", "u16", Order::Abcd, Err("`-1` is no u16; expected 0 to 65535"));
        check("nan", "f32", Order::Abcd, Err("`nan` is no f32; expected a number like 21.5"));
        assert_eq!(words_of_value(Table::Coil, "ON", "word", Order::Abcd), Ok(vec![1]));
        assert!(words_of_value(Table::Coil, "2", "word", Order::Abcd).is_err());
    }

    #[test]
    fn the_function_code_follows_the_count_unless_it_is_given() {
        let code = |table, words: &[u16], with| {
            let span = Span::with_count(table, 0, words.len() as u16).expect("a span");
            call(span, words, with).ok().map(|call| call.function())
        };
        assert_eq!(code(Table::Coil, &[1], None), Some(5));
        assert_eq!(code(Table::Coil, &[1, 0], None), Some(15));
        assert_eq!(code(Table::Coil, &[1], Some(15)), Some(15));
        assert_eq!(code(Table::Holding, &[7], None), Some(6));
        assert_eq!(code(Table::Holding, &[7], Some(16)), Some(16));
        assert_eq!(code(Table::Holding, &[7, 8], None), Some(16));
        assert_eq!(code(Table::Holding, &[7, 8], Some(6)), None);
        assert_eq!(code(Table::Holding, &[7], Some(5)), None);
    }
}
