//! The board with analog outputs against its manual: requests and replies as bytes.

use crate::simulator::device::{Addressed, Model};
use crate::simulator::testing::Bench;

fn check(rows: &[(&str, &str)]) {
    Bench::new(Model::AnalogOut8).check(rows);
}

#[test]
fn the_registers_leave_the_factory_as_the_tables_say_6_2() {
    let words = |word: &str, count: usize| format!("{:02X}{}", 2 * count, word.repeat(count));
    check(&[
        // The manual's own example: output 2 is for current.
        ("04 0000 0009", "04 12 3002 0000 0190 0000 0000 0000 0000 0000 0000"),
        ("04 004F 0001", "04 02 03FA"),
        ("04 0064 000A", &format!("04 {}", words("0000", 10))),
        ("03 0000 0009", "03 12 5300 2B67 2B67 2B67 2B67 2B67 2B67 2B67 2B67"),
        ("03 000A 0009", &format!("03 {}", words("0000", 9))),
        ("03 0015 0008", &format!("03 {}", words("0000", 8))),
        ("03 001F 0008", &format!("03 {}", words("03E8", 8))),
        ("03 0028 0009", &format!("03 {}", words("0000", 9))),
        ("03 0033 0008", &format!("03 {}", words("000A", 8))),
        ("03 003D 0008", &format!("03 {}", words("0258", 8))),
        ("03 004F 0001", "03 02 0000"),
        ("03 005A 000A", &format!("03 {}", words("0000", 10))),
        ("03 0147 0001", "03 02 0000"),
    ]);
}

#[test]
fn holes_are_refused_with_exception_2_and_more_than_10_registers_with_3_chapter_9() {
    check(&[
        ("04 0000 000B", "84 03"),
        ("04 0009 0001", "84 02"),
        ("04 0008 0002", "84 02"),
        // The example below the tables speaks of Rreg_12, which no table has.
        ("04 000C 0001", "84 02"),
        ("04 00E4 0001", "84 02"),
        ("03 0009 0001", "83 02"),
        ("03 0013 0002", "83 02"),
        ("03 001D 0001", "83 02"),
        ("03 0027 0001", "83 02"),
        ("03 0031 0001", "83 02"),
        ("03 003B 0001", "83 02"),
        ("03 0045 0001", "83 02"),
        ("03 0064 0001", "83 02"),
        ("03 0148 0001", "83 02"),
        ("03 FFFE 0003", "83 02"),
        ("03 0000 0000", "83 03"),
        ("06 0009 0000", "86 02"),
        ("10 0008 0002 04 0001 0001", "90 02"),
        ("03 0008 0001", "03 02 2B67"),
        ("01 0000 0001", "81 01"),
        ("2B 0E 01 00", "AB 01"),
    ]);
}

#[test]
fn values_outside_their_range_are_limited_used_and_refused_chapter_9() {
    check(&[
        ("06 0001 07D1", "84 03"),
        ("03 0001 0001", "03 02 07D0"),
        ("06 0001 2B67", "06 0001 2B67"),
        ("06 000A 0100", "84 03"),
        ("03 000A 0001", "03 02 00FF"),
        ("06 000B 2B67", "84 03"),
        ("03 000B 0001", "03 02 270F"),
        ("06 0012 D8F0", "84 03"),
        ("03 0012 0001", "03 02 D8F1"),
        ("06 0028 FFFF", "84 03"),
        ("03 0028 0001", "03 02 00FF"),
        ("06 0029 2710", "84 03"),
        ("03 0029 0001", "03 02 270F"),
        ("06 0033 0000", "84 03"),
        ("03 0033 0001", "03 02 0001"),
        ("06 003A 2710", "84 03"),
        ("03 003A 0001", "03 02 270F"),
        ("06 003D 0000", "06 003D 0000"),
        ("10 0044 0001 02 FFFF", "90 03"),
        ("03 0044 0001", "03 02 270F"),
    ]);
}

#[test]
fn the_zero_stays_below_the_end_6_2() {
    check(&[
        ("06 0015 03E8", "84 03"),
        ("03 0015 0001", "03 02 03E7"),
        ("06 001F 03E7", "84 03"),
        ("03 001F 0001", "03 02 03E8"),
        ("06 0015 FF9C", "06 0015 FF9C"),
        ("06 001F 0000", "06 001F 0000"),
    ]);
}

#[test]
fn measured_values_become_volts_or_milliamperes_within_their_span_6_2() {
    let mut bench = Bench::new(Model::AnalogOut8);
    // The manual's examples, for output 2; output 3 beside it gives volts, from -50.0 to 150.0.
    bench.check(&[("10 0017 0001 02 FE0C", "10 0017 0001"), ("10 0021 0001 02 05DC", "10 0021 0001")]);
    for (measured, current, voltage) in [
        (0, 400, 250),
        (1000, 2000, 750),
        (500, 1200, 500),
        (1500, 2000, 1000),
        (-500, 400, 0),
        (-9999, 400, 0),
        (334, 934, 417),
    ] {
        let word = measured as u16;
        bench.check(&[
            (&format!("10 000C 0002 04 {word:04X} {word:04X}"), "10 000C 0002"),
            ("04 0002 0002", &format!("04 04 {current:04X} {voltage:04X}")),
        ]);
    }
    bench.ask("10 000C 0002 04 01F4 01F4");
    assert_eq!((bench.output("output_2"), bench.output("output_3")), ("12.00 mA".into(), "5.00 V".into()));
}

#[test]
fn fixed_values_pass_by_everything_within_the_terminal_s_span_and_11111_is_automatic_again_6_2() {
    check(&[
        ("10 000B 0002 04 0064 0064", "10 000B 0002"),
        ("04 0001 0002", "04 04 0064 0230"),
        ("10 0001 0002 04 02EE 02EE", "10 0001 0002"),
        ("04 0001 0002", "04 04 02EE 02EE"),
        ("10 0001 0002 04 07D0 07D0", "10 0001 0002"),
        ("03 0001 0001", "03 02 07D0"),
        ("04 0001 0002", "04 04 03E8 07D0"),
        ("10 0001 0002 04 0000 0000", "10 0001 0002"),
        ("04 0001 0002", "04 04 0000 0190"),
        ("10 0001 0002 04 2B67 2B67", "10 0001 0002"),
        ("04 0001 0002", "04 04 0064 0230"),
    ]);
}

#[test]
fn a_regulated_output_follows_the_difference_once_a_second_6_2() {
    let mut bench = Bench::new(Model::AnalogOut8);
    // Output 8 for volts and output 2 for current; wanted 20.0, measured 18.0; P is 1.5, no I.
    bench.check(&[
        ("06 0030 00C8", "06 0030 00C8"),
        ("06 002A 00C8", "06 002A 00C8"),
        ("06 0012 00B4", "06 0012 00B4"),
        ("06 000C 00B4", "06 000C 00B4"),
        ("06 003A 000F", "06 003A 000F"),
        ("06 0034 000F", "06 0034 000F"),
        ("06 0044 0000", "06 0044 0000"),
        ("06 003E 0000", "06 003E 0000"),
        ("06 000A 0082", "06 000A 0082"),
        ("04 0008 0001", "04 02 0000"),
    ]);
    bench.wait(1000);
    bench.check(&[
        // 30 thousandths of 10 V; of 16 mA, from 4 mA on.
        ("04 0008 0001", "04 02 001E"),
        ("04 0002 0001", "04 02 01C0"),
        ("06 0012 00DC", "06 0012 00DC"),
        ("04 0008 0001", "04 02 001E"),
    ]);
    bench.wait(1000);
    // Above what is wanted there is nothing to heat, but to cool.
    bench.check(&[("04 0008 0001", "04 02 0000"), ("06 0028 0080", "06 0028 0080")]);
    bench.wait(1000);
    bench.check(&[("04 0008 0001", "04 02 001E"), ("06 000A 0000", "06 000A 0000")]);
    bench.check(&[("04 0008 0001", "04 02 00DC")]);
}

#[test]
fn the_integral_grows_with_time_and_no_further_than_the_output_6_2() {
    let mut bench = Bench::new(Model::AnalogOut8);
    // Wanted 60, measured 0, the factory's P of 1.0 and I of 600.
    bench.check(&[("06 0029 003C", "06 0029 003C"), ("06 000A 0001", "06 000A 0001")]);
    for (seconds, value) in [(10, 61), (90, 70), (900, 160), (8999, 1000), (1_000_000, 1000)] {
        bench.wait(seconds * 1000);
        bench.check(&[("04 0001 0001", &format!("04 02 {value:04X}"))]);
    }
    // What is wanted has been reached: the integral alone holds the output.
    bench.ask("06 000B 003C");
    bench.wait(1000);
    bench.check(&[("04 0001 0001", "04 02 03E8"), ("06 000B 0078", "06 000B 0078")]);
    bench.wait(10_000);
    bench.check(&[("04 0001 0001", "04 02 03AB")]);
    // Without an I there is no integral, and what it was has been forgotten.
    bench.check(&[("06 000B 003B", "06 000B 003B"), ("06 003D 0000", "06 003D 0000")]);
    bench.wait(1000);
    bench.check(&[("04 0001 0001", "04 02 0001"), ("06 003D 0258", "06 003D 0258")]);
    bench.wait(1000);
    bench.check(&[("04 0001 0001", "04 02 0001"), ("06 000B 0078", "06 000B 0078")]);
    // Switched off and on again it begins anew.
    bench.check(&[("06 000A 0000", "06 000A 0000"), ("06 000A 0001", "06 000A 0001")]);
    bench.wait(1000);
    bench.check(&[("04 0001 0001", "04 02 0000")]);
}

#[test]
fn settings_with_a_star_outlive_a_restart_and_20_brings_the_factory_s_back_6_2() {
    let mut bench = Bench::new(Model::AnalogOut8);
    bench.check(&[
        ("06 0000 4101", "06 0000 4101"),
        ("06 0001 0064", "06 0001 0064"),
        ("06 000A 0001", "06 000A 0001"),
        ("06 000B 0064", "06 000B 0064"),
        ("06 0015 0005", "06 0015 0005"),
        ("06 0026 0006", "06 0026 0006"),
        ("06 0028 0007", "06 0028 0007"),
        ("06 0029 0008", "06 0029 0008"),
        ("06 0033 0009", "06 0033 0009"),
        ("06 0044 000A", "06 0044 000A"),
        ("06 005A 1234", "06 005A 1234"),
        ("06 00C8 0101", "06 00C8 0101"),
        ("06 01F4 4321", "06 01F4 4321"),
        ("04 0064 0001", "04 02 4321"),
    ]);
    let kept = [
        ("03 0000 0001", "03 02 4101"),
        ("03 0001 0001", "03 02 2B67"),
        ("03 000A 0002", "03 04 0001 0000"),
        ("03 0015 0001", "03 02 0005"),
        ("03 0026 0001", "03 02 0006"),
        ("03 0028 0002", "03 04 0007 0008"),
        ("03 0033 0001", "03 02 0009"),
        ("03 0044 0001", "03 02 000A"),
        ("03 005A 0001", "03 02 0000"),
        ("03 00C8 0001", "03 02 0101"),
        ("04 0064 0001", "04 02 0000"),
    ];
    let words = bench.device.eeprom();
    bench.check(&[("06 004F 000A", "06 004F 000A"), ("03 004F 0001", "03 02 0000")]);
    bench.check(&kept);
    let mut other = Bench::new(Model::AnalogOut8);
    other.device.load_eeprom(other.now, &words).expect("an EEPROM of the same board");
    other.check(&kept);
    other.check(&[
        ("06 004F 0014", "06 004F 0014"),
        ("03 0000 0001", "03 02 5300"),
        ("03 000A 0001", "03 02 0000"),
        ("03 0015 0001", "03 02 0000"),
        ("03 0026 0001", "03 02 03E8"),
        ("03 0033 0001", "03 02 000A"),
        ("03 00C8 0001", "03 02 0000"),
    ]);
}

#[test]
fn a_broadcast_is_obeyed_and_there_is_nothing_to_touch_chapter_8() {
    let mut bench = Bench::new(Model::AnalogOut8);
    assert_eq!(bench.send(Addressed::Broadcast, "06 0001 0064"), "silence");
    bench.check(&[("04 0001 0001", "04 02 0064")]);
    assert!(bench.act("output 1 hand 5").is_err());
}
