//! MR-SI4 against its manual: requests and replies as bytes.

use crate::simulator::device::Model;
use crate::simulator::testing::Bench;

fn check(rows: &[(&str, &str)]) {
    Bench::new(Model::MrSi4).check(rows);
}

#[test]
fn the_settings_leave_the_factory_as_the_table_says_page_17() {
    check(&[
        ("03 0000 0014", &format!("03 28 {}", "0000".repeat(20))),
        ("03 0014 000C", &format!("03 18 {}", "0001".repeat(12))),
        ("03 0020 0004", "03 08 0000 0000 0000 0000"),
        ("03 0024 0004", "03 08 0701 0701 0701 0701"),
        ("03 0028 0004", "03 08 0001 0001 0001 0001"),
    ]);
}

#[test]
fn long_values_are_read_and_written_only_whole_page_16() {
    check(&[
        ("04 0000 0015", &format!("04 2A {}", "0000".repeat(21))),
        ("04 0003 0003", "04 06 0000 0000 0000"),
        ("04 0009 0005", "04 0A 0000 0000 0000 0000 0000"),
        ("04 0014 0001", "04 02 0000"),
        ("04 0001 0003", "84 02"),
        ("04 0000 0002", "84 02"),
        ("04 000C 0001", "84 02"),
        ("04 000D 0002", "84 02"),
        ("04 0014 0002", "84 02"),
        ("04 0000 0000", "84 03"),
        (
            "03 0000 002C",
            &format!(
                "03 58 {}{}{}{}",
                "0000".repeat(20),
                "0001".repeat(12),
                "0000".repeat(4),
                "0701".repeat(4) + &"0001".repeat(4)
            ),
        ),
        ("03 000B 0001", "83 02"),
        ("03 002C 0001", "83 02"),
        ("03 0041 0001", "83 02"),
        ("10 0003 0003 06 1234 5678 9ABC", "10 0003 0003"),
        ("03 0003 0003", "03 06 1234 5678 9ABC"),
        ("10 0004 0002 04 0000 0000", "90 02"),
        ("10 000E 0002 04 0001 0002", "10 000E 0002"),
        ("10 000E 0001 02 0001", "90 02"),
        ("03 000E 0002", "03 04 0001 0002"),
    ]);
}

#[test]
fn function_6_writes_20_to_43_and_65_alone_page_16() {
    check(&[
        ("06 0013 0001", "86 02"),
        ("06 0000 0001", "86 02"),
        ("06 002C 0001", "86 02"),
        ("06 0014 03E8", "06 0014 03E8"),
        ("06 0041 5315", "06 0041 5315"),
        ("10 0014 0002 04 07D0 0BB8", "10 0014 0002"),
        ("03 0014 0002", "03 04 07D0 0BB8"),
        ("01 0000 0001", "81 01"),
        ("05 0000 FF00", "85 01"),
    ]);
}

#[test]
fn digits_and_decimals_are_limited_each_to_its_greatest_and_flags_to_bit_0_page_17() {
    check(&[
        ("06 0024 0A04", "06 0024 0A04"),
        ("03 0024 0001", "03 02 0903"),
        ("06 0025 FF02", "06 0025 FF02"),
        ("03 0025 0001", "03 02 0902"),
        ("06 0020 FFFE", "06 0020 FFFE"),
        ("03 0020 0001", "03 02 0000"),
        ("06 0028 FFFF", "06 0028 FFFF"),
        ("03 0028 0001", "03 02 0001"),
    ]);
}

#[test]
fn pulses_are_counted_when_they_are_60_ms_apart_page_19() {
    for (every, after, counted) in [(60, 599, 10), (60, 5400, 91), (50, 999, 10), (200, 999, 5)] {
        let mut bench = Bench::new(Model::MrSi4);
        bench.act(&format!("input 2 pulses 91 every {every}ms")).expect("pulses");
        bench.wait(after);
        assert_eq!(bench.output("counter_2"), counted.to_string(), "every {every} ms for {after} ms");
    }
}

#[test]
fn inputs_are_closed_while_a_contact_is_and_during_the_first_half_of_a_pulse_page_16() {
    let mut bench = Bench::new(Model::MrSi4);
    bench.act("input 1 contact closed").expect("a contact");
    bench.act("input 4 pulses 2 every 80ms").expect("pulses");
    bench.check(&[
        ("02 0000 0004", "02 01 09"),
        ("04 0014 0001", "04 02 0009"),
        ("02 0003 0001", "02 01 01"),
        ("02 0003 0002", "82 02"),
        ("02 0000 0005", "82 03"),
    ]);
    bench.wait(30);
    bench.check(&[("02 0000 0004", "02 01 01")]);
    bench.wait(50);
    bench.check(&[("02 0000 0004", "02 01 09"), ("04 0009 0003", "04 06 0000 0000 0002")]);
    bench.act("input 1 contact open").expect("a contact");
    bench.wait(60);
    bench.act("input 1 contact closed").expect("a contact");
    bench.check(&[("02 0000 0004", "02 01 01"), ("04 0000 0003", "04 06 0000 0000 0002")]);
    assert!(bench.act("input 5 contact open").is_err());
    assert!(bench.act("input 1 ohms 5").is_err());
}

#[test]
fn the_button_copies_the_counters_whose_flag_is_set_page_17() {
    let mut bench = Bench::new(Model::MrSi4);
    bench.act("input 1 counter 78187493530").expect("a counter");
    bench.act("input 2 counter 5").expect("a counter");
    bench.check(&[("06 0029 0000", "06 0029 0000")]);
    bench.act("button").expect("a button");
    bench.check(&[
        ("04 0000 0003", "04 06 0012 3456 789A"),
        ("03 0000 0006", "03 0C 0012 3456 789A 0000 0000 0000"),
    ]);
}

/// Sets input 3 and compares its BZ.
#[track_caller]
fn check_reading(counter: u64, settings: Settings, reading: u32) {
    let Settings { at_button, initial, per_unit, current, voltage, formula, format } = settings;
    let mut bench = Bench::new(Model::MrSi4);
    bench.act(&format!("input 3 counter {counter}")).expect("a counter");
    bench.ask(&format!("10 0006 0003 06 {at_button:012X}"));
    bench.ask(&format!("10 0010 0002 04 {initial:08X}"));
    for (register, word) in [(22, per_unit), (26, current), (30, voltage), (34, formula), (38, format)] {
        bench.ask(&format!("06 {register:04X} {word:04X}"));
    }
    bench.check(&[("04 0010 0002", &format!("04 04 {reading:08X}"))]);
}

struct Settings {
    at_button: u64,
    initial: u32,
    per_unit: u16,
    current: u16,
    voltage: u16,
    formula: u16,
    format: u16,
}

impl Default for Settings {
    fn default() -> Settings {
        Settings { at_button: 0, initial: 0, per_unit: 1, current: 1, voltage: 1, formula: 0, format: 0x0701 }
    }
}

#[test]
fn the_calculated_reading_follows_the_details_of_the_calculation_page_20() {
    let usual = Settings::default;
    // 2000 pulses are one unit, with one decimal: 1.5 more than the 12345.6 at the start.
    let meter = || Settings { at_button: 1000, initial: 123_456, per_unit: 2000, ..usual() };
    check_reading(4000, meter(), 123_471);
    // The division comes behind the multiplication, and cuts off.
    check_reading(4199, meter(), 123_471);
    check_reading(4200, meter(), 123_472);
    // The manual's factors: 200/5 A is 40, 20000/100 V is 200. Formula 0 multiplies AZ, 1 does not.
    let transformers = || Settings { current: 40, voltage: 200, initial: 7, format: 0x0901, ..meter() };
    check_reading(4000, transformers(), 15 * 8000 + 7 * 8000);
    check_reading(4000, Settings { formula: 1, ..transformers() }, 15 * 8000 + 7);
    // With seven digits the meter rolls over; with none nothing is left.
    check_reading(12_345_678, usual(), 3_456_780);
    check_reading(5, Settings { format: 0x0000, ..usual() }, 0);
    // Nothing overflows on the way: 2^48 - 1 pulses, all factors and three decimals.
    let full = Settings { current: 65535, voltage: 65535, format: 0x0903, initial: u32::MAX, ..usual() };
    let wide =
        (0xFFFF_FFFF_FFFFu128 * 65535 * 65535 * 1000 + 0xFFFF_FFFFu128 * 65535 * 65535) % 1_000_000_000;
    check_reading(0xFFFF_FFFF_FFFF, full, wide as u32);
    // IT above IZ, as after a written IT: the difference is a uint48_t too.
    let behind = (0xFFFF_FFFF_FFFFu64 % 10_000_000) as u32;
    check_reading(0, Settings { at_button: 1, format: 0x0700, ..usual() }, behind);
    // What 0 pulses per unit give is not told: nothing counts.
    check_reading(10, Settings { per_unit: 0, initial: 5, ..usual() }, 5);
}

#[test]
fn a_restart_forgets_neither_settings_nor_counters_page_17() {
    let mut bench = Bench::new(Model::MrSi4);
    bench.act("input 1 counter 281474976710655").expect("a counter");
    bench.check(&[
        ("10 0000 0003 06 0000 0000 0001", "10 0000 0003"),
        ("10 0024 0004 08 0902 0801 0700 0603", "10 0024 0004"),
    ]);
    let kept = bench.device.eeprom();
    let mut other = Bench::new(Model::MrSi4);
    other.device.load_eeprom(other.now, &kept).expect("an EEPROM of the same device");
    for bench in [&mut bench, &mut other] {
        bench.check(&[
            ("08 0001 0000", "08 0001 0000"),
            ("04 0000 0003", "04 06 FFFF FFFF FFFF"),
            ("03 0000 0003", "03 06 0000 0000 0001"),
            ("03 0024 0004", "03 08 0902 0801 0700 0603"),
        ]);
    }
    // And it begins again at 0 after the last of 48 bits.
    bench.act("input 1 contact closed").expect("a contact");
    bench.check(&[("04 0000 0003", "04 06 0000 0000 0000")]);
}
