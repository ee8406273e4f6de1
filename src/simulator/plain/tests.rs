//! The device that is its profile: requests and replies as bytes, and every shipped profile whole.

use proptest::collection::vec;
use proptest::prelude::*;

use crate::engine::address::{Address, Span, Table};
use crate::engine::profile::Library;
use crate::engine::time::{Duration, Time};
use crate::simulator::device::{Addressed, SimulatedDevice, Stimulus};
use crate::simulator::plain::Plain;
use crate::simulator::testing::Bench;

const HEAD: &str = "device: acme/plain
manufacturer: Acme
model: Plain
source: invented
";

/// Something of everything.
const MIXED: &str = "identify: {vendor: Acme, product: Plain}
wire:
  limits: {read_registers: 8, read_bits: 4, write_registers: 3}
  readable: [coil 0..7, discrete 0..3, input 0..11, holding 0..20, holding 30..39]
  forbidden: {holding 9: it restarts the device}
points:
  relay: {for: 1..4, at: coil 0, poll: fast, write: any}
  contact: {for: 1..4, at: discrete 0, poll: fast}
  temperature: {at: input 0, type: i16, decimals: 1, unit: °C, poll: fast}
  energy: {at: input 2, type: u32, order: cdab, poll: slow, default: 70000}
  alarm: {at: input 8, poll: slow, read_clears: true}
  setpoint: {at: holding 0, decimals: 1, poll: slow, write: 5..30, default: 215, persistent: true}
  offset: {at: holding 1, type: i16, poll: slow, write: -100..100, difference: true, default: -5}
  mode: {at: holding 2, poll: slow, values: {1: heat, 2: cool, 4: dry}, write: [heat, cool]}
  flags_low: {at: holding 3.0, poll: slow, write: any, persistent: true}
  flags_high: {at: holding 3.8..11, poll: slow, write: 0..9}
  flags_read: {at: holding 3.12..15, poll: slow, default: 6}
  long: {at: holding 4, type: i32, poll: slow, write: -70000..70000, default: -2}
  float: {at: holding 6, type: f32, poll: slow, write: 0..10.5}
  restart: {at: holding 8, press: 10, self_clearing: true}
  only_16: {at: holding 10, poll: slow, write: 0..9, write_with: 16}
  code: {at: holding 11, type: letter_number, poll: slow, write: any, default: 0x5300}
  automatic: {at: holding 12, poll: slow, values: {11111: automatic}, write: 0..9, default: 11111}
  shown: {at: input 10, write_at: holding 13, poll: slow, write: 0..100}
  both: {at: holding 14.0, also: coil 6, poll: slow, write: any}
  case: {at: holding 16, poll: slow, values: {3: volts, 5: name}, write: any}
  by_case:
    at: holding 17
    poll: slow
    write: any
    by: case
    is: {volts: {decimals: 1, range: 0..10}, name: {values: {0: none, 7: seven}}}
  word: {at: holding 30, type: text 2, poll: slow, write: any}
";

fn plain(profile: &str) -> Plain {
    let library = Library::shipped();
    match library.check("test.yaml", format!("{HEAD}{profile}").as_bytes()) {
        Ok(device) => Plain::new(device),
        Err(faults) => panic!("{faults:?}"),
    }
}

fn bench(profile: &str) -> Bench {
    Bench { device: Box::new(plain(profile)), now: Time::from_millis(1000) }
}

#[track_caller]
fn check(profile: &str, rows: &[(&str, &str)]) {
    bench(profile).check(rows);
}

#[test]
fn defaults_stand_in_the_registers_from_the_start() {
    check(
        MIXED,
        &[
            // 70000 with the low word first.
            ("04 0000 0004", "04 08 0000 0000 1170 0001"),
            // Of names without one for 0, the first.
            ("03 0000 0006", "03 0C 00D7 FFFB 0001 6000 FFFF FFFE"),
            ("03 0006 0003", "03 06 0000 0000 0000"),
            ("03 000B 0002", "03 04 5300 2B67"),
            ("03 0010 0002", "03 04 0003 0000"),
            ("01 0000 0004", "01 01 00"),
            ("02 0000 0004", "02 01 00"),
        ],
    );
}

#[test]
fn reads_are_refused_beyond_limits_readable_spans_and_in_forbidden_ones() {
    check(
        MIXED,
        &[
            ("03 0000 0008", "03 10 00D7 FFFB 0001 6000 FFFF FFFE 0000 0000"),
            ("03 0000 0009", "83 03"),
            ("03 0000 0000", "83 03"),
            ("01 0000 0005", "81 03"),
            ("02 0000 0005", "82 03"),
            // Nothing is known of 18 to 20, but they may be read.
            ("03 0012 0003", "03 06 0000 0000 0000"),
            ("03 0014 0002", "83 02"),
            ("03 0015 0001", "83 02"),
            ("03 0008 0002", "83 02"),
            ("03 0009 0001", "83 02"),
            ("04 000B 0002", "84 02"),
            ("04 FFFF 0002", "84 02"),
            ("03 0000 00", "83 03"),
            ("08 0000 0000", "88 01"),
            ("17 0000", "97 01"),
        ],
    );
}

#[test]
fn without_readable_spans_gaps_are_read_over_unless_the_profile_says_never() {
    let points = "points:\n  a: {at: input 2, poll: fast}\n  b: {at: input 5, poll: fast}\n";
    check(points, &[("04 0002 0004", "04 08 0000 0000 0000 0000"), ("04 0001 0001", "84 02")]);
    check(points, &[("04 0006 0001", "84 02"), ("03 0002 0001", "83 01"), ("06 0002 0001", "86 01")]);
    let strict = format!("wire: {{limits: {{gap: 0}}}}\n{points}");
    check(&strict, &[("04 0002 0004", "84 02"), ("04 0002 0001", "04 02 0000")]);
}

#[test]
fn what_is_written_is_held_if_the_rules_allow_it() {
    check(
        MIXED,
        &[
            ("05 0001 FF00", "05 0001 FF00"),
            ("0F 0002 0002 01 03", "0F 0002 0002"),
            ("01 0000 0004", "01 01 0E"),
            ("05 0001 0001", "85 03"),
            ("05 0004 FF00", "85 02"),
            ("0F 0003 0002 01 03", "8F 02"),
            ("06 0000 012C", "06 0000 012C"),
            ("06 0000 012D", "86 03"),
            ("06 0000 0031", "86 03"),
            ("03 0000 0001", "03 02 012C"),
            ("06 0001 FF9C", "06 0001 FF9C"),
            ("06 0001 FF9B", "86 03"),
            ("06 0002 0002", "06 0002 0002"),
            ("06 0002 0003", "86 03"),
            ("06 0002 0004", "86 03"),
            ("06 0008 000A", "06 0008 000A"),
            ("03 0008 0001", "03 02 0000"),
            ("06 0008 0014", "86 03"),
            ("06 0009 0001", "86 02"),
            ("06 000B 5211", "06 000B 5211"),
            ("06 000B 0011", "86 03"),
            ("06 000C 000A", "86 03"),
            ("06 000C 0009", "06 000C 0009"),
            ("06 000C 2B67", "06 000C 2B67"),
            ("06 0012 0001", "86 02"),
            // All of several, or none.
            ("10 0000 0003 06 0096 0001 0003", "90 03"),
            ("03 0000 0002", "03 04 012C FF9C"),
            ("10 0000 0003 06 0096 0001 0001", "10 0000 0003"),
            ("03 0000 0003", "03 06 0096 0001 0001"),
            ("10 0000 0004 08 0096 0001 0001 0000", "90 03"),
            ("10 0007 0002 04 0000 000A", "90 02"),
            ("06 000A 0001", "86 02"),
            ("10 000A 0001 02 0001", "10 000A 0001"),
            ("10 001E 0002 04 4F6B 0000", "10 001E 0002"),
            ("10 001E 0002 04 FF00 0000", "90 03"),
        ],
    );
}

#[test]
fn values_of_several_registers_are_written_whole_and_bits_apart() {
    check(
        MIXED,
        &[
            ("06 0005 0001", "86 02"),
            ("10 0005 0001 02 0001", "90 02"),
            ("10 0004 0002 04 FFFE EE90", "10 0004 0002"),
            ("10 0004 0002 04 FFFE EE8F", "90 03"),
            ("03 0004 0002", "03 04 FFFE EE90"),
            ("10 0006 0002 04 4128 0000", "10 0006 0002"),
            ("10 0006 0002 04 4128 0001", "90 03"),
            ("10 0006 0002 04 7FC0 0000", "90 03"),
            // Bits 12 to 15 can only be read, 1 to 7 are nobody's.
            ("06 0003 09FF", "06 0003 09FF"),
            ("03 0003 0001", "03 02 6901"),
            ("06 0003 0A00", "86 03"),
        ],
    );
}

#[test]
fn a_value_that_stands_in_two_places_is_the_same_in_both() {
    let mut bench = bench(MIXED);
    bench.check(&[
        ("06 000D 0032", "06 000D 0032"),
        ("04 000A 0001", "04 02 0032"),
        ("06 000D 0065", "86 03"),
        ("06 000E 0001", "06 000E 0001"),
        ("01 0006 0001", "01 01 01"),
    ]);
    bench.act("set 'coil 6' 0").expect("a register");
    bench.check(&[("03 000E 0001", "03 02 0000")]);
    bench.act("set input 10 7").expect("a register");
    bench.check(&[("03 000D 0001", "03 02 0007")]);
}

#[test]
fn a_case_decides_which_values_are_taken() {
    check(
        MIXED,
        &[
            ("06 0011 0064", "06 0011 0064"),
            ("06 0011 0065", "86 03"),
            ("06 0010 0005", "06 0010 0005"),
            ("06 0011 0064", "86 03"),
            ("06 0011 0007", "06 0011 0007"),
            ("06 0010 0004", "86 03"),
        ],
    );
}

#[test]
fn a_device_that_clamps_uses_the_end_of_the_range_and_says_exception_3() {
    let clamps = "wire: {quirks: [clamps_with_exception, exception_function_varies]}
points:
  number: {at: holding 0, type: i16, decimals: 1, poll: slow, write: -5..30}
  flag: {at: holding 1, values: {0: OFF, 1: ON}, poll: slow, write: any}
  names: {at: holding 2, values: {0: none, 2: two, 5: five}, poll: slow, write: any}
";
    check(
        clamps,
        &[
            ("06 0000 012D", "84 03"),
            ("03 0000 0001", "03 02 012C"),
            ("06 0000 8000", "84 03"),
            ("03 0000 0001", "03 02 FFCE"),
            ("06 0001 0002", "84 03"),
            ("03 0001 0001", "03 02 0001"),
            ("06 0002 0006", "84 03"),
            ("03 0002 0001", "03 02 0005"),
            ("10 0000 0002 04 0001 0003", "90 03"),
            ("03 0000 0002", "03 04 0001 0001"),
            ("06 0003 0001", "86 02"),
        ],
    );
}

#[test]
fn what_reading_clears_is_cleared_when_it_was_told() {
    let mut bench = bench(MIXED);
    bench.act("set 'input 8' 3").expect("a register");
    bench.send(Addressed::Broadcast, "04 0008 0001");
    bench.check(&[("04 0007 0001", "04 02 0000"), ("04 0008 0001", "04 02 0003")]);
    bench.check(&[("04 0008 0001", "04 02 0000")]);
}

#[test]
fn registers_are_set_by_a_script_as_they_are() {
    let mut bench = bench(MIXED);
    for command in
        ["set 'input 0' 215", "set \"input 2\" 0x1234 -1", "set discrete 1 1", "set 'holding 0' 999"]
    {
        bench.act(command).expect("a register");
    }
    bench.check(&[
        ("04 0000 0004", "04 08 00D7 0000 1234 FFFF"),
        ("02 0000 0002", "02 01 02"),
        // Out of the range, which is for what is written over the line.
        ("03 0000 0001", "03 02 03E7"),
    ]);
    let told = bench.act("set 'input 12' 1").unwrap_err();
    let there = "this device has coil 0..6, discrete 0..3, input 0..10, holding 0..31";
    assert_eq!(told, format!("`input 12` is not there; {there}"));
    assert_eq!(bench.act("set 'coil 0' 2").unwrap_err(), "a coil is 0 or 1");
    assert!(bench.act("set 'holding 9' 1").is_err());
    assert!(bench.act("button").is_err());
}

#[test]
fn the_identification_is_that_which_the_gateway_asks_for() {
    check(
        MIXED,
        &[
            ("2B 0E 01 00", "2B 0E 01 01 00 00 03 00 04 41636D65 01 05 506C61696E 02 01 30"),
            ("2B 0E 02 00", "AB 03"),
            ("2B 0D 00 00", "AB 01"),
        ],
    );
    let word = "identify: {at: input 7, equals: 0x5000, mask: 0xF000}
points:
  code: {at: input 7, poll: once, default: 0x0123}
";
    check(word, &[("04 0007 0001", "04 02 5000"), ("2B 0E 01 00", "AB 01")]);
    assert_eq!(plain(word).identity_register(), Some((4, 7, 0x8000)));
    let elsewhere = "identify: {at: holding 90, equals: 7}\npoints:\n  a: {at: input 0, poll: fast}\n";
    check(elsewhere, &[("03 005A 0001", "03 02 0007"), ("06 005A 0007", "86 01")]);
}

#[test]
fn the_persistent_points_are_the_eeprom_and_what_is_only_read_is_the_world() {
    let mut bench = bench(MIXED);
    bench.act("set 'input 0' 215").expect("a register");
    bench.check(&[
        ("06 0000 0064", "06 0000 0064"),
        ("06 0001 0007", "06 0001 0007"),
        ("06 0003 0901", "06 0003 0901"),
        ("05 0000 FF00", "05 0000 FF00"),
    ]);
    assert_eq!(bench.device.eeprom(), [0x64, 1]);
    bench.act("restart").expect("a command");
    bench.check(&[
        ("04 0000 0001", "04 02 00D7"),
        ("03 0000 0002", "03 04 0064 FFFB"),
        ("03 0003 0001", "03 02 6001"),
        ("01 0000 0001", "01 01 00"),
    ]);
    let now = bench.now;
    bench.device.load_eeprom(now, &[200, 0]).expect("two words");
    bench.check(&[("03 0000 0001", "03 02 00C8"), ("03 0003 0001", "03 02 6000")]);
    let told = bench.device.load_eeprom(now, &[200]).unwrap_err();
    assert_eq!(told, "the EEPROM has 1 words; this device has 2");
}

#[test]
fn points_that_can_be_written_are_shown_as_the_gateway_tells_them() {
    let mut bench = bench(MIXED);
    bench.check(&[("05 0002 FF00", "05 0002 FF00"), ("06 0000 00E1", "06 0000 00E1")]);
    for (name, text) in [
        ("relay_1", "OFF"),
        ("relay_3", "ON"),
        ("setpoint", "22.5"),
        ("offset", "-5"),
        ("mode", "heat"),
        ("long", "-2"),
        ("code", "S000"),
        ("automatic", "automatic"),
        ("by_case", "0.0"),
    ] {
        assert_eq!(bench.output(name), text, "{name}");
    }
    let outputs = bench.device.outputs();
    assert!(
        outputs.iter().all(|(name, _)| !["restart", "temperature"].contains(&name.as_str())),
        "{outputs:?}"
    );
}

#[test]
fn every_point_of_every_shipped_profile_is_read_and_holds_its_default() {
    let library = Library::shipped();
    let (mut read, mut defaults) = (0, 0);
    for id in library.ids() {
        let device = library.load(id).expect("a profile without fault");
        let mut plain = Plain::new(device.clone());
        for point in device.points.iter().filter(|point| point.is_read()) {
            let words = ask(&mut plain, point.at);
            assert!(words.is_some(), "{id}: {}", point.name);
            read += 1;
            if let (Some(default), Some(words)) = (point.default, words.filter(|words| words.len() == 1)) {
                assert_eq!(words[0], default as u16, "{id}: {}", point.name);
                defaults += 1;
            }
        }
        for forbidden in &device.wire.forbidden {
            let first =
                Address { span: Span::single(forbidden.span.table(), forbidden.span.first()), bits: None };
            assert_eq!(ask(&mut plain, first), None, "{id}: {}", forbidden.span);
        }
    }
    assert!(read > 200 && defaults > 100, "{read} {defaults}");
}

/// The field at a place as it is told over the line.
fn ask(plain: &mut Plain, at: Address) -> Option<Vec<u16>> {
    let (first, count) = (at.span.first().to_be_bytes(), (at.span.count() as u16).to_be_bytes());
    let function = at.span.table().read_function();
    let pdu = [vec![function], first.to_vec(), count.to_vec()].concat();
    let reply = plain.request(Time::from_millis(1), Addressed::Unit, &pdu).expect("an answer");
    if reply[0] != function {
        return None;
    }
    let words: Vec<u16> = if at.span.table().is_bits() {
        (0..at.span.count() as usize).map(|bit| u16::from(reply[2 + bit / 8] >> (bit % 8) & 1)).collect()
    } else {
        reply[2..].chunks(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect()
    };
    crate::engine::codec::words_at(at, at.span.first(), &words)
}

proptest! {
    #[test]
    fn whatever_is_asked_it_answers_with_that_function_or_its_exception(
        eeprom in vec(any::<u16>(), 2),
        steps in vec((prop_oneof![pdu(), vec(any::<u8>(), 1..260)], 0..40u16, any::<u16>()), 1..40),
    ) {
        let mut device = plain(MIXED);
        let mut now = Time::from_millis(1);
        device.load_eeprom(now, &eeprom).expect("two words");
        for (pdu, address, word) in steps {
            now += Duration::from_millis(1);
            let span = Span::single(Table::Holding, address);
            let _ = device.stimulate(now, &Stimulus::Set { span, words: vec![word] });
            let reply = device.request(now, Addressed::Unit, &pdu).expect("an answer");
            prop_assert!((2..=253).contains(&reply.len()), "{:02X?}: {:02X?}", pdu, reply);
            prop_assert_eq!(reply[0] | 0x80, pdu[0] | 0x80);
            prop_assert_eq!(device.eeprom().len(), 2);
            device.outputs();
        }
    }
}

/// A read or a write of one, somewhere among the points.
fn pdu() -> impl Strategy<Value = Vec<u8>> {
    (1u8..=6, 0u16..40, any::<u16>()).prop_map(|(function, first, second)| {
        let second = if function < 5 { second % 10 } else { second };
        [vec![function], first.to_be_bytes().to_vec(), second.to_be_bytes().to_vec()].concat()
    })
}
