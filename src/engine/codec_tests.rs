//! Tables for the codec: what registers say, and what may be written.

use super::*;
use crate::engine::address::{Address, Bits, Span, Table};
use crate::engine::device::{Order, OutOfRange, Point, Poll, Write, WriteRule};
use crate::engine::test_device::device_of;
use crate::engine::time::Date;

fn decimal(text: &str) -> Decimal {
    Decimal::parse(text).expect("a decimal in a test")
}

fn words(hex: &str) -> Vec<u16> {
    hex.split_whitespace().map(|word| u16::from_str_radix(word, 16).expect("hex in a test")).collect()
}

/// A device of one writable point at `holding 0` in this form.
fn device(form: Form, at: Address, rule: WriteRule) -> Device {
    let mut point = Point::new("point", at, Poll::Fast);
    point.encoding = Encoding::Plain(form);
    point.write = Some(Write::new(at, rule));
    device_of(vec![point])
}

fn registers(count: u16) -> Address {
    Address { span: Span::with_count(Table::Holding, 0, count).expect("a span"), bits: None }
}

fn check_read(form: Form, hex: &str, expected: &str) {
    let device = device(form.clone(), registers(form.kind.registers()), WriteRule::Any);
    let resolved = resolve(&device, 0, &[None]).expect("a plain form resolves");
    assert_eq!(read(&resolved, &words(hex)).to_string(), expected, "{form:?} {hex}");
}

/// Why there is no reading.
#[track_caller]
fn check_missing(form: Form, hex: &str, expected: &str) {
    let device = device(form.clone(), registers(form.kind.registers()), WriteRule::Any);
    let resolved = resolve(&device, 0, &[None]).expect("a plain form resolves");
    match read(&resolved, &words(hex)) {
        Reading::Missing(missing) => assert_eq!(missing.to_string(), expected, "{form:?} {hex}"),
        reading => panic!("{reading}"),
    }
}

#[test]
fn a_number_that_cannot_be_told_is_none_the_less_a_number() {
    let double = || Form::new(Kind::F64);
    check_missing(double(), "7E37 E43C 8800 759C", "1e300 has too many digits to be told");
    check_missing(double(), "FE37 E43C 8800 759C", "-1e300 has too many digits to be told");
    check_missing(double(), "01A5 6E1F C2F8 F359", "1e-300 has too many digits to be told");
    check_missing(double(), "7FF8 0000 0000 0000", "not a number");
    check_missing(double(), "7FF0 0000 0000 0000", "not a number");
    let scaled = Form { scale: Decimal::integer(1_000_000_000), ..double() };
    check_missing(scaled, "7FE1 CCF3 85EB C8A0", "1e308 has too many digits to be told");
    let whole = Form { scale: Decimal::integer(i128::MAX / 2), ..Form::new(Kind::U16) };
    check_missing(whole, "FFFF", "65535 has too many digits to be told");
}

fn check_write(form: Form, rule: WriteRule, text: &str, expected: Result<&str, &str>) {
    let device = device(form.clone(), registers(form.kind.registers()), rule.clone());
    let resolved = resolve(&device, 0, &[None]).expect("a plain form resolves");
    let found = encode(&device.points[0], &rule, &resolved, text);
    assert_eq!(found, expected.map(words).map_err(str::to_string), "{form:?} {text}");
}

fn with(kind: Kind, change: impl FnOnce(&mut Form)) -> Form {
    let mut form = Form::new(kind);
    change(&mut form);
    form
}

#[test]
fn numbers_keep_the_digits_of_their_scale() {
    let tenth = |kind| with(kind, |form| form.decimals = Some(Decimals::Fixed(1)));
    check_read(tenth(Kind::I16), "FF9C", "-10.0");
    check_read(tenth(Kind::I16), "0000", "0.0");
    check_read(tenth(Kind::U16), "FF9C", "6543.6");
    check_read(with(Kind::I16, |form| form.scale = decimal("0.0003125")), "7FFF", "10.2396875");
    check_read(with(Kind::I16, |form| form.scale = decimal("100")), "8000", "-3276800");
    check_read(with(Kind::U16, |form| form.offset = decimal("-273.15")), "0126", "20.85");
    check_read(Form::new(Kind::U48), "FFFF FFFF FFFF", "281474976710655");
    check_read(Form::new(Kind::U64), "FFFF FFFF FFFF FFFF", "18446744073709551615");
    check_read(Form::new(Kind::I64), "FFFF FFFF FFFF FFFE", "-2");
    check_read(Form::new(Kind::Bcd32), "0012 3456", "123456");
    check_read(Form::new(Kind::Bcd16), "00A1", "None");
}

#[test]
fn four_orders_of_the_same_number_read_the_same() {
    for (order, hex) in [
        (Order::Abcd, "1234 5678"),
        (Order::Cdab, "5678 1234"),
        (Order::Badc, "3412 7856"),
        (Order::Dcba, "7856 3412"),
    ] {
        check_read(with(Kind::U32, |form| form.order = order), hex, "305419896");
    }
    check_read(with(Kind::U48, |form| form.order = Order::Dcba), "0300 0200 0100", "4295098371");
}

#[test]
fn floats_are_told_shortest_and_without_exponent() {
    check_read(Form::new(Kind::F32), "41A8 CCCD", "21.1");
    check_read(Form::new(Kind::F32), "41A8 0000", "21");
    check_read(Form::new(Kind::F32), "8000 0000", "0");
    check_read(Form::new(Kind::F32), "2EDB E6FF", "0.0000000001");
    check_read(Form::new(Kind::F32), "7FC0 0000", "None");
    check_read(Form::new(Kind::F32), "FF80 0000", "None");
    check_read(with(Kind::F32, |form| form.scale = decimal("0.001")), "41A8 CCCD", "0.0211");
    check_read(with(Kind::F32, |form| form.decimals = Some(Decimals::Fixed(2))), "4049 0FDB", "3.14");
    // With the digits that were asked for, also where they are zeros.
    let two_digits = || with(Kind::F32, |form| form.decimals = Some(Decimals::Fixed(2)));
    check_read(two_digits(), "4020 0000", "2.50");
    check_read(two_digits(), "BA83 126F", "0.00");
    check_read(two_digits(), "60AD 78EC", "100000000000000000000.00");
    let beyond_a_decimal = with(Kind::F64, |form| form.decimals = Some(Decimals::Fixed(1)));
    check_read(beyond_a_decimal, "47EF FFFF E091 FF3D", "340282347000000000000000000000000000000");
    // A number that scaling makes too large, and what would be told with hundreds of digits.
    check_read(with(Kind::F64, |form| form.scale = decimal("1000")), "7FE1 CCF3 85EB C8A0", "None");
    check_read(Form::new(Kind::F64), "7FE1 CCF3 85EB C8A0", "None");
    check_read(Form::new(Kind::F64), "0000 0000 0000 0001", "None");
    check_read(Form::new(Kind::F64), "0000 0000 0000 0000", "0");
}

#[test]
fn names_and_sentinels_come_before_arithmetic() {
    let sentinel = |kind| {
        with(kind, |form| {
            form.names = Names::Some(vec![(11111, "automatic".into())]);
            form.decimals = Some(Decimals::Fixed(1));
            form.invalid = vec![(0x8000, "open loop".into())];
        })
    };
    check_read(sentinel(Kind::I16), "2B67", "automatic");
    check_read(sentinel(Kind::I16), "2B68", "1111.2");
    check_read(sentinel(Kind::I16), "8000", "None");
    let named =
        with(Kind::U16, |form| form.names = Names::All(vec![(0, "OFF".into()), (11111, "automatic".into())]));
    check_read(named.clone(), "0000", "OFF");
    check_read(named, "0002", "None");
    check_read(Form::new(Kind::Bool), "0001", "ON");
    check_read(Form::new(Kind::Bool), "0002", "None");
}

#[test]
fn texts_codes_and_dates() {
    check_read(Form::new(Kind::Text { registers: 3 }), "4D52 2D38 0000", "MR-8");
    check_read(with(Kind::Text { registers: 2 }, |form| form.order = Order::Badc), "524D 3820", "MR 8");
    check_read(Form::new(Kind::Text { registers: 1 }), "FF01", "None");
    check_read(Form::new(Kind::Text { registers: 2 }), "0000 2000", "None");
    check_read(Form::new(Kind::LetterNumber), "5211", "R017");
    check_read(Form::new(Kind::LetterNumber), "0011", "None");
    check_read(Form::new(Kind::DayMonthYear), "03FA", "01.01.2018");
    check_read(Form::new(Kind::DayMonthYear), "0000", "None");
}

#[test]
fn seconds_since_a_day_are_a_moment() {
    let since = |kind, year: u64| with(kind, |form| form.since = Date::of_day(year, 1, 1));
    check_read(since(Kind::U32, 1970), "6B09 13F0", "2026-11-27T05:24:00+00:00");
    check_read(since(Kind::U64, 1970), "0000 0000 6B09 13F0", "2026-11-27T05:24:00+00:00");
    check_read(since(Kind::U32, 2000), "3296 6E5A", "2026-11-23T03:24:10+00:00");
    // Of milliseconds; of days.
    let scaled = |scale: &str, kind| Form { scale: decimal(scale), ..since(kind, 1970) };
    check_read(scaled("0.001", Kind::U48), "01A1 6A5B E1C2", "2026-10-23T20:02:48.898+00:00");
    check_read(scaled("86400", Kind::U16), "5130", "2026-11-27T00:00:00+00:00");
    // Nobody has set the clock; before 1970; behind what there are dates for.
    check_read(since(Kind::U32, 1970), "0000 0000", "None");
    check_read(since(Kind::I32, 1970), "FFFF FFFF", "None");
    check_read(since(Kind::U64, 1970), "FFFF FFFF FFFF FFFF", "None");
    let invalid = Form { invalid: vec![(0xFFFF_FFFF, "not set".into())], ..since(Kind::U32, 1970) };
    check_read(invalid, "FFFF FFFF", "None");
    check_write(
        since(Kind::U32, 1970),
        WriteRule::Any,
        "2026-11-27T05:24:00+00:00",
        Err("a moment cannot be written"),
    );
}

#[test]
fn bytes_that_are_no_text_are_not_written_as_one() {
    let text = Form::new(Kind::Text { registers: 4 });
    check_write(text.clone(), WriteRule::Any, "K\u{fc}che", Ok("4BC3 BC63 6865 0000"));
    let wished = String::from_utf8_lossy(b"K\xFCche");
    check_write(text, WriteRule::Any, &wished, Err("`K\u{fffd}che` is not UTF-8; expected a text in it"));
}

#[test]
fn a_wish_is_checked_rounded_and_encoded() {
    let seconds = with(Kind::U16, |form| form.scale = decimal("0.01"));
    let range = |min: &str, max: &str, step: Option<&str>| WriteRule::Range {
        min: decimal(min),
        max: decimal(max),
        step: step.map(decimal),
    };
    let watchdog = range("0", "655.35", None);
    check_write(seconds.clone(), watchdog.clone(), "30", Ok("0BB8"));
    check_write(seconds.clone(), watchdog.clone(), "21.0", Ok("0834"));
    check_write(seconds.clone(), watchdog.clone(), "1e-05", Ok("0000"));
    check_write(seconds.clone(), watchdog.clone(), " 2.1E+1\n", Ok("0834"));
    check_write(seconds.clone(), watchdog.clone(), "655.354", Err("`655.354` is outside 0 to 655.35"));
    check_write(seconds.clone(), watchdog.clone(), "21.005", Ok("0835"));
    check_write(seconds.clone(), watchdog.clone(), "655.36", Err("`655.36` is outside 0 to 655.35"));
    check_write(seconds.clone(), watchdog.clone(), "-1", Err("`-1` is outside 0 to 655.35"));
    check_write(seconds.clone(), watchdog.clone(), "1,5", Err("`1,5` is not a number"));
    check_write(seconds, watchdog, "None", Err("`None` is not a number"));
    let half_steps = with(Kind::U16, |form| form.decimals = Some(Decimals::Fixed(1)));
    check_write(half_steps.clone(), range("4", "20", Some("0.5")), "4.3", Ok("002D"));
    check_write(half_steps.clone(), range("4", "20", Some("0.5")), "4.500000000000001", Ok("002D"));
    // Steps begin at the smallest value, and end before the largest where that is between two.
    check_write(half_steps.clone(), range("1", "9.8", Some("2")), "4.1", Ok("0032"));
    check_write(half_steps, range("1", "9.8", Some("2")), "9.8", Ok("005A"));
    let thirds = with(Kind::U16, |form| form.scale = decimal("0.3"));
    check_write(thirds.clone(), range("0", "10.4", None), "10.4", Ok("0022"));
    check_write(thirds, range("0.2", "10.4", None), "0.3", Ok("0001"));
    check_write(Form::new(Kind::I16), WriteRule::Any, "-32768", Ok("8000"));
    check_write(Form::new(Kind::I16), WriteRule::Any, "32768", Err("`32768` is outside -32768 to 32767"));
    check_write(Form::new(Kind::U48), WriteRule::Any, "281474976710655", Ok("FFFF FFFF FFFF"));
    check_write(Form::new(Kind::F32), WriteRule::Any, "21.1", Ok("41A8 CCCD"));
    check_write(Form::new(Kind::Bool), WriteRule::Any, "on", Err("`on` is neither `ON` nor `OFF`"));
    check_write(Form::new(Kind::LetterNumber), WriteRule::Any, "R017", Ok("5211"));
    check_write(
        Form::new(Kind::U16),
        WriteRule::Press { word: 0x55AA, self_clearing: true },
        "PRESS",
        Ok("55AA"),
    );
    let sentinel = with(Kind::I16, |form| form.names = Names::Some(vec![(11111, "automatic".into())]));
    check_write(sentinel.clone(), range("-9999", "9999", None), "automatic", Ok("2B67"));
    check_write(sentinel, range("-9999", "9999", None), "11111", Err("`11111` is outside -9999 to 9999"));
    let named = with(Kind::U16, |form| form.names = Names::All(vec![(0, "OFF".into()), (1, "ON".into())]));
    check_write(named.clone(), WriteRule::Names(vec!["OFF".into()]), "ON", Err("`ON` is none of `OFF`"));
    check_write(named, WriteRule::Any, "ON", Ok("0001"));
}

#[test]
fn blanks_around_a_wish_mean_something_only_in_a_text() {
    let press = WriteRule::Press { word: 1, self_clearing: false };
    let named = with(Kind::U16, |form| form.names = Names::All(vec![(3, "half open".into())]));
    for (form, rule, expected) in [
        (Form::new(Kind::Bool), WriteRule::Any, (" ON ", Ok("0001"))),
        (Form::new(Kind::Bool), WriteRule::Any, ("ON\n", Ok("0001"))),
        (Form::new(Kind::Bool), WriteRule::Any, (" on", Err("`on` is neither `ON` nor `OFF`"))),
        (
            Form::new(Kind::Bool),
            WriteRule::Any,
            ("  ", Err("an empty text is no value; expected `ON` or `OFF`")),
        ),
        (Form::new(Kind::U16), WriteRule::Any, ("\t21 ", Ok("0015"))),
        (Form::new(Kind::U16), WriteRule::Any, (" ", Err("an empty text is not a number"))),
        (named.clone(), WriteRule::Any, (" half open\r\n", Ok("0003"))),
        (named, WriteRule::Any, ("half  open", Err("`half  open` is none of `half open`"))),
        (Form::new(Kind::U16), press.clone(), ("PRESS ", Ok("0001"))),
        (Form::new(Kind::U16), press, ("ON", Err("`ON` is not what presses a button; expected `PRESS`"))),
        (Form::new(Kind::LetterNumber), WriteRule::Any, (" R017", Ok("5211"))),
        (Form::new(Kind::Text { registers: 2 }), WriteRule::Any, (" a ", Ok("2061 2000"))),
        (
            Form::new(Kind::Text { registers: 2 }),
            WriteRule::Any,
            ("abcde", Err("`abcde` has 5 bytes; expected at most 4")),
        ),
        (
            Form::new(Kind::Text { registers: 2 }),
            WriteRule::Any,
            ("a\n", Err(r#""a\n" has control characters; expected a text without"#)),
        ),
    ] {
        check_write(form, rule, expected.0, expected.1);
    }
}

#[test]
fn a_field_of_bits_takes_only_what_fits_it() {
    let at = Address { span: Span::single(Table::Holding, 36), bits: Bits::new(8, 15) };
    let rule = WriteRule::Range { min: Decimal::ZERO, max: Decimal::integer(999), step: None };
    let device = device(Form::new(Kind::U16), at, rule.clone());
    let resolved = resolve(&device, 0, &[None]).expect("a plain form resolves");
    assert_eq!(encode(&device.points[0], &rule, &resolved, "9"), Ok(vec![9]));
    assert_eq!(
        encode(&device.points[0], &rule, &resolved, "256"),
        Err("`256` does not fit the register, which holds 0 to 255".to_string())
    );
    assert_eq!(words_at(at, 32, &words("0 0 0 0 0703")), Some(vec![7]));
    assert_eq!(words_at(at, 37, &words("0703")), None);
}

#[test]
fn fahrenheit_moves_the_limits_of_values_and_of_differences() {
    let mut temperature = with(Kind::F32, |form| {
        form.range = Some((decimal("-50"), decimal("150")));
        form.unit = Unit::Fixed("°F".into());
    });
    let limits_of = |form: &Form| {
        let device = device(form.clone(), registers(2), WriteRule::Any);
        let resolved = resolve(&device, 0, &[None]).expect("a plain form resolves");
        let limits = limits(&resolved, &WriteRule::Any).expect("limits");
        format!("{} {}", limits.min, limits.max)
    };
    assert_eq!(limits_of(&temperature), "-58 302");
    temperature.difference = true;
    assert_eq!(limits_of(&temperature), "-360 360");
}

#[test]
fn the_digits_shown_are_those_that_one_step_of_the_register_moves() {
    for (scale, shift, expected) in
        [("1", 0, 0), ("0.01", 0, 2), ("1", 3, 3), ("0.0003125", 0, 4), ("0.05", 0, 2), ("100", 0, 0)]
    {
        let form = with(Kind::I16, |form| {
            form.scale = decimal(scale);
            form.decimals = Some(Decimals::Fixed(shift));
        });
        let device = device(form, registers(1), WriteRule::Any);
        let resolved = resolve(&device, 0, &[None]).expect("a plain form resolves");
        assert_eq!(resolved.display_precision(), Some(expected), "{scale} {shift}");
    }
}

#[test]
fn what_is_made_of_a_wish_is_said() {
    let tenths = with(Kind::I16, |form| {
        form.decimals = Some(Decimals::Fixed(1));
        form.names = Names::Some(vec![(11111, "automatic".into())]);
    });
    let range = |step: Option<&str>| WriteRule::Range {
        min: decimal("-5"),
        max: decimal("30"),
        step: step.map(decimal),
    };
    let (half, any) = (range(Some("0.5")), range(None));
    let (refuse, clamp) = (OutOfRange::Refuse, OutOfRange::Clamp);
    for (rule, out_of_range, text, expected) in [
        (&any, refuse, "21.5", Ok(("00D7", None))),
        (&any, refuse, "21.0", Ok(("00D2", None))),
        (&any, refuse, "automatic", Ok(("2B67", None))),
        // What a calculation with floats leaves is nothing to speak of.
        (&any, refuse, "21.400000000000002", Ok(("00D6", None))),
        (&any, refuse, "0.30000000000000004", Ok(("0003", None))),
        (&any, refuse, "5.551115123125783e-17", Ok(("0000", None))),
        (&any, refuse, "-2.220446049250313e-16", Ok(("0000", None))),
        (&any, refuse, "21.49999999999999911182158029987", Ok(("00D7", None))),
        (&any, refuse, "1e-300", Ok(("0000", None))),
        (&any, refuse, "1e31", Err("`1e31` is outside -5 to 30")),
        (&any, refuse, "-1e400", Err("`-1e400` is outside -5 to 30")),
        (&any, refuse, "inf", Err("`inf` is not a number; expected one from -5 to 30")),
        (&any, refuse, "1e", Err("`1e` is not a number; expected one from -5 to 30")),
        (&any, refuse, "21.44", Ok(("00D6", Some("`21.44` is rounded to 21.4")))),
        (&any, refuse, "1e-05", Ok(("0000", Some("`1e-05` is rounded to 0.0")))),
        (&half, refuse, "21.3", Ok(("00D7", Some("`21.3` is rounded to 21.5")))),
        (&any, refuse, "30.1", Err("`30.1` is outside -5 to 30")),
        (&any, clamp, "30.0", Ok(("012C", None))),
        (&any, clamp, "30.1", Ok(("012C", Some("`30.1` is out of range, and 30.0 the nearest value in it")))),
        (
            &half,
            clamp,
            "-1e6",
            Ok(("FFCE", Some("`-1e6` is out of range, and -5.0 the nearest value in it"))),
        ),
        (&any, clamp, "1e31", Ok(("012C", Some("`1e31` is out of range, and 30.0 the nearest value in it")))),
        (&any, clamp, "automatic", Ok(("2B67", None))),
        (&any, clamp, " automatic", Ok(("2B67", None))),
        (&any, clamp, "nan", Err("`nan` is not a number; expected one from -5 to 30")),
    ] {
        let mut device = device(tenths.clone(), registers(1), rule.clone());
        let mut write = device.points[0].write.take().expect("it is written");
        write.out_of_range = out_of_range;
        let resolved = resolve(&device, 0, &[None]).expect("a plain form resolves");
        let found = obey(&device.points[0], &write, &resolved, text);
        let expected = expected.map_err(str::to_string);
        let expected =
            expected.map(|(hex, note)| Obeyed { words: words(hex), note: note.map(str::to_string) });
        assert_eq!(found, expected, "{text} {out_of_range:?}");
    }
    // A float is as exact as a float is.
    let mut float = device(Form::new(Kind::F32), registers(2), WriteRule::Any);
    let write = float.points[0].write.take().expect("it is written");
    let resolved = resolve(&float, 0, &[None]).expect("a plain form resolves");
    let found = obey(&float.points[0], &write, &resolved, "21.1");
    assert_eq!(found, Ok(Obeyed { words: words("41A8 CCCD"), note: None }));
    for (text, hex) in [("3.4e38", "7F7F C99E"), ("5.551115123125783e-17", "2480 0000")] {
        let found = obey(&float.points[0], &write, &resolved, text).map(|obeyed| obeyed.words);
        assert_eq!(found, Ok(words(hex)), "{text}");
    }
    // But where the profile gives it steps, they are its steps.
    let quarters = WriteRule::Range {
        min: Decimal::integer(-1000),
        max: Decimal::integer(1000),
        step: Some(Decimal { units: 25, decimals: 2 }),
    };
    let quarters = Write { rule: quarters, ..write.clone() };
    for (text, hex, note) in [
        ("0.3", "3E80 0000", Some("`0.3` is rounded to 0.25")),
        ("-999.9", "C47A 0000", Some("`-999.9` is rounded to -1000")),
        ("999.7500000000001", "4479 F000", None),
        ("0.5", "3F00 0000", None),
    ] {
        let found = obey(&float.points[0], &quarters, &resolved, text);
        assert_eq!(found, Ok(Obeyed { words: words(hex), note: note.map(str::to_string) }), "{text}");
    }
    let found = obey(&float.points[0], &write, &resolved, "3.5e38");
    assert_eq!(found, Err("`3.5e38` is too large for the register".to_string()));
}
