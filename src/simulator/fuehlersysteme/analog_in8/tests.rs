//! The board with analog inputs against its manual: requests and replies as bytes.

use crate::simulator::device::{Addressed, Model};
use crate::simulator::testing::Bench;

fn check(rows: &[(&str, &str)]) {
    Bench::new(Model::AnalogIn8).check(rows);
}

/// Connects a signal and lets the longest damping pass.
fn settle(bench: &mut Bench, signal: &str) {
    bench.act(signal).expect("a signal");
    bench.wait(6000);
}

#[test]
fn the_registers_leave_the_factory_as_the_tables_say_6_3() {
    let words = |word: &str, count: usize| format!("{:02X}{}", 2 * count, word.repeat(count));
    check(&[
        // The manual's own example: input 8 is for current.
        ("04 0000 0009", "04 12 4080 0000 0000 0000 0000 0000 0000 0000 0190"),
        ("04 000B 0008", &format!("04 {}", words("0000", 8))),
        ("04 004F 0001", "04 02 03FA"),
        ("04 00DA 000A", &format!("04 {}", words("0000", 10))),
        ("03 0000 0009", "03 12 5300 2B67 2B67 2B67 2B67 2B67 2B67 2B67 2B67"),
        ("03 000B 0008", &format!("03 {}", words("000A", 8))),
        ("03 0015 0008", &format!("03 {}", words("0000", 8))),
        ("03 001F 0008", &format!("03 {}", words("03E8", 8))),
        ("03 0029 000A", &format!("03 {}", words("0000", 10))),
        ("03 0033 0009", &format!("03 {}", words("0000", 9))),
        ("03 004F 0001", "03 02 0000"),
        ("03 00C8 000A", &format!("03 {}", words("0000", 10))),
    ]);
}

#[test]
fn holes_are_refused_with_exception_2_and_more_than_10_registers_with_3_chapter_9() {
    check(&[
        ("04 0000 000B", "84 03"),
        ("04 0009 0001", "84 02"),
        ("04 0008 0002", "84 02"),
        ("04 0013 0001", "84 02"),
        ("03 0009 0001", "83 02"),
        ("03 000A 0001", "83 02"),
        ("03 0013 0001", "83 02"),
        ("03 001D 0001", "83 02"),
        ("03 0027 0001", "83 02"),
        ("03 0028 0001", "83 02"),
        ("03 003C 0001", "83 02"),
        // RWreg_90 to 99, which this table alone leaves out.
        ("03 005A 0001", "83 02"),
        ("06 0063 0000", "86 02"),
        ("03 01F4 0001", "83 02"),
        ("06 0273 1234", "06 0273 1234"),
        ("04 00E3 0001", "04 02 1234"),
        ("10 0008 0002 04 0001 0001", "90 02"),
        ("03 0008 0001", "03 02 2B67"),
        ("02 0000 0001", "82 01"),
    ]);
}

#[test]
fn values_outside_their_range_are_limited_used_and_refused_chapter_9() {
    check(&[
        ("06 0001 07D1", "84 03"),
        ("03 0001 0001", "03 02 07D0"),
        ("06 000B 003D", "84 03"),
        ("03 000B 0001", "03 02 003C"),
        ("06 0015 03E8", "84 03"),
        ("03 0015 0001", "03 02 03E7"),
        ("06 001F D8F1", "84 03"),
        ("03 001F 0001", "03 02 03E8"),
        ("06 0029 0003", "84 03"),
        ("03 0029 0001", "03 02 0002"),
        ("06 0031 0100", "84 03"),
        ("03 0031 0001", "03 02 00FF"),
        ("06 0032 FFFF", "84 03"),
        ("03 0032 0001", "03 02 00FF"),
        ("06 0033 0002", "84 03"),
        ("10 003B 0001 02 0100", "90 03"),
    ]);
}

#[test]
fn volts_and_milliamperes_are_told_in_hundredths_within_their_range_6_3() {
    let mut bench = Bench::new(Model::AnalogIn8);
    for (volts, value) in [("5", 500), ("0.004", 0), ("0.006", 1), ("10", 1000), ("11.5", 1000), ("-2", 0)] {
        settle(&mut bench, &format!("input 1 volts {volts}"));
        bench.check(&[("04 0001 0001", &format!("04 02 {value:04X}"))]);
    }
    for (milliamps, value) in [("12", 1200), ("4", 400), ("3", 400), ("20", 2000), ("22", 2000)] {
        settle(&mut bench, &format!("input 8 milliamps {milliamps}"));
        bench.check(&[("04 0008 0001", &format!("04 02 {value:04X}"))]);
    }
    settle(&mut bench, "input 8 open");
    bench.check(&[("04 0008 0001", "04 02 0190")]);
    for command in ["input 8 volts 5", "input 1 milliamps 5", "input 1 ohms 5", "input 9 open", "button"] {
        assert!(bench.act(command).is_err(), "{command}");
    }
}

#[test]
fn measured_values_are_calculated_from_zero_and_end_6_3() {
    let mut bench = Bench::new(Model::AnalogIn8);
    // The manual's example for input 8, and -50.0 to 150.0 at input 7.
    bench.check(&[
        ("06 0026 1388", "06 0026 1388"),
        ("06 001B FE0C", "06 001B FE0C"),
        ("06 0025 05DC", "06 0025 05DC"),
    ]);
    for (milliamps, volts, calculated) in [
        ("4", "0", "FE0C 0000"),
        ("20", "10", "05DC 1388"),
        ("12", "5", "01F4 09C4"),
        ("2", "2.5", "0000 0000"),
    ] {
        settle(&mut bench, &format!("input 7 volts {volts}"));
        settle(&mut bench, &format!("input 8 milliamps {milliamps}"));
        bench.check(&[("04 0011 0002", &format!("04 04 {calculated}"))]);
    }
}

#[test]
fn a_value_is_the_mean_of_as_many_measurements_as_its_damping_says_6_3() {
    let mut bench = Bench::new(Model::AnalogIn8);
    bench.check(&[("10 000C 0003 06 0000 0014 003C", "10 000C 0003")]);
    settle(&mut bench, "input 1 volts 0");
    for input in 1..=4 {
        bench.act(&format!("input {input} volts 6")).expect("a signal");
    }
    bench.check(&[("04 0001 0004", "04 08 0000 0000 0000 0000")]);
    bench.wait(100);
    bench.check(&[("04 0001 0004", "04 08 003C 0258 001E 000A")]);
    bench.wait(900);
    bench.check(&[("04 0001 0004", "04 08 0258 0258 012C 0064")]);
    bench.wait(5000);
    bench.check(&[("04 0001 0004", "04 08 0258 0258 0258 0258")]);
}

#[test]
fn fixed_values_stand_in_for_the_input_and_11111_gives_it_back_6_3() {
    let mut bench = Bench::new(Model::AnalogIn8);
    settle(&mut bench, "input 1 volts 5");
    settle(&mut bench, "input 8 milliamps 12");
    bench.check(&[
        ("06 0001 02EE", "06 0001 02EE"),
        ("06 0008 0320", "06 0008 0320"),
        ("04 0001 0001", "04 02 02EE"),
        ("04 0008 0001", "04 02 0320"),
        ("04 000B 0001", "04 02 02EE"),
        ("04 0012 0001", "04 02 00FA"),
        ("06 0001 07D0", "06 0001 07D0"),
        ("04 0001 0001", "04 02 03E8"),
        ("06 0008 0000", "06 0008 0000"),
        ("04 0008 0001", "04 02 0190"),
        ("06 0001 2B67", "06 0001 2B67"),
        ("06 0008 2B67", "06 0008 2B67"),
        ("04 0001 0001", "04 02 01F4"),
        ("04 0008 0001", "04 02 04B0"),
    ]);
}

#[test]
fn digital_inputs_are_low_below_1_volt_and_high_above_2_5_at_once_6_3() {
    let mut bench = Bench::new(Model::AnalogIn8);
    bench.check(&[("10 0029 0002 04 0001 0002", "10 0029 0002")]);
    for (volts, states) in [
        ("0.99", "0000 0001"),
        ("2.5", "0000 0001"),
        ("2.51", "0001 0000"),
        ("1", "0001 0000"),
        ("0.99", "0000 0001"),
        ("10", "0001 0000"),
    ] {
        bench.act(&format!("input 1 volts {volts}")).expect("a signal");
        bench.act(&format!("input 2 volts {volts}")).expect("a signal");
        bench.check(&[
            ("04 0001 0002", &format!("04 04 {states}")),
            ("04 000B 0002", &format!("04 04 {states}")),
        ]);
    }
    // A contact to ground, with the DIP switch's potential behind it.
    bench.act("input 1 contact closed").expect("a contact");
    bench.check(&[("04 0001 0001", "04 02 0000")]);
    bench.act("input 1 contact open").expect("a contact");
    bench.check(&[("04 0001 0001", "04 02 0001"), ("06 0001 0063", "06 0001 0063")]);
    bench.check(&[("04 0001 0001", "04 02 0000")]);
}

#[test]
fn an_input_for_current_is_always_analog_6_3() {
    check(&[
        ("06 0030 0001", "06 0030 0001"),
        ("03 0030 0001", "03 02 0000"),
        ("10 002F 0002 04 0002 0002", "10 002F 0002"),
        ("03 002F 0002", "03 04 0002 0000"),
        ("04 0008 0001", "04 02 0190"),
    ]);
}

#[test]
fn a_held_input_stays_on_until_one_of_its_two_registers_has_been_read_6_3() {
    let mut bench = Bench::new(Model::AnalogIn8);
    // Inputs 1 and 2 digital, 3 digital and negated, 4 analog; all of them held.
    bench.check(&[("10 0029 0003 06 0001 0001 0002", "10 0029 0003"), ("06 0031 000F", "06 0031 000F")]);
    // Input 3 was on, since nothing was connected.
    bench.check(&[("04 0001 0004", "04 08 0000 0000 0001 0000")]);
    let pulse = |bench: &mut Bench, input: u8| {
        bench.act(&format!("input {input} volts 5")).expect("a signal");
        bench.wait(10);
        bench.act(&format!("input {input} volts 0")).expect("a signal");
        bench.wait(1000);
    };
    pulse(&mut bench, 1);
    pulse(&mut bench, 2);
    // Neither a read that nobody is told, nor another register, nor a refused request lets go.
    assert_eq!(bench.send(Addressed::Broadcast, "04 0001 0008"), "silence");
    bench.check(&[
        ("04 0003 0001", "04 02 0001"),
        ("04 0001 000A", "84 02"),
        ("03 0001 0001", "03 02 2B67"),
        ("04 000B 0001", "04 02 0001"),
        ("04 0001 0002", "04 04 0000 0001"),
        ("04 0001 0002", "04 04 0000 0000"),
    ]);
    // What is still on when it is read stays on, and is held again.
    bench.act("input 1 volts 5").expect("a signal");
    bench.check(&[("04 0001 0001", "04 02 0001"), ("04 0001 0001", "04 02 0001")]);
    bench.act("input 1 volts 0").expect("a signal");
    bench.check(&[("04 0001 0001", "04 02 0001"), ("04 0001 0001", "04 02 0000")]);
}

#[test]
fn an_input_held_until_its_reset_stays_on_however_often_it_is_read_6_3() {
    let mut bench = Bench::new(Model::AnalogIn8);
    bench.check(&[("10 0029 0003 06 0001 0001 0001", "10 0029 0003"), ("06 0032 0007", "06 0032 0007")]);
    for input in 1..=3 {
        bench.act(&format!("input {input} volts 5")).expect("a signal");
    }
    for input in 1..=2 {
        bench.act(&format!("input {input} volts 0")).expect("a signal");
    }
    bench.check(&[
        ("04 0001 0003", "04 06 0001 0001 0001"),
        ("04 000B 0003", "04 06 0001 0001 0001"),
        ("06 0033 0000", "06 0033 0000"),
        ("04 0001 0001", "04 02 0001"),
        ("06 0033 0001", "06 0033 0001"),
        ("03 0033 0001", "03 02 0000"),
        ("04 0001 0003", "04 06 0000 0001 0001"),
        // Input 3 is on by itself.
        ("06 003B 0006", "06 003B 0006"),
        ("03 003B 0001", "03 02 0000"),
        ("04 0001 0003", "04 06 0000 0000 0001"),
    ]);
    bench.act("input 3 volts 0").expect("a signal");
    bench.check(&[
        ("04 0003 0001", "04 02 0001"),
        ("06 0032 0000", "06 0032 0000"),
        ("04 0003 0001", "04 02 0000"),
    ]);
}

#[test]
fn settings_with_a_star_outlive_a_restart_and_20_brings_the_factory_s_back_6_3() {
    let mut bench = Bench::new(Model::AnalogIn8);
    bench.check(&[
        ("06 0000 4101", "06 0000 4101"),
        ("06 0002 0064", "06 0002 0064"),
        ("06 000B 0000", "06 000B 0000"),
        ("06 0015 0005", "06 0015 0005"),
        ("06 0026 0006", "06 0026 0006"),
        ("06 0029 0001", "06 0029 0001"),
        ("06 0031 0007", "06 0031 0007"),
        ("06 0032 0001", "06 0032 0001"),
        ("06 0147 4321", "06 0147 4321"),
    ]);
    bench.act("input 1 volts 5").expect("a signal");
    bench.act("input 1 volts 0").expect("a signal");
    bench.check(&[("04 0001 0001", "04 02 0001")]);
    let kept = [
        ("03 0000 0001", "03 02 4101"),
        ("03 0002 0001", "03 02 2B67"),
        ("03 000B 0001", "03 02 0000"),
        ("03 0015 0001", "03 02 0005"),
        ("03 0026 0001", "03 02 0006"),
        ("03 0029 0001", "03 02 0001"),
        ("03 0031 0002", "03 04 0007 0001"),
        ("03 0147 0001", "03 02 4321"),
        // What was held has been forgotten.
        ("04 0001 0001", "04 02 0000"),
    ];
    let words = bench.device.eeprom();
    bench.check(&[("06 004F 000A", "06 004F 000A")]);
    bench.check(&kept);
    let mut other = Bench::new(Model::AnalogIn8);
    other.device.load_eeprom(other.now, &words).expect("an EEPROM of the same board");
    other.check(&kept);
    // What is connected stays connected.
    settle(&mut other, "input 1 volts 5");
    other.check(&[
        ("06 004F 0014", "06 004F 0014"),
        ("03 0000 0001", "03 02 5300"),
        ("03 000B 0001", "03 02 000A"),
        ("03 0015 0001", "03 02 0000"),
        ("03 0026 0001", "03 02 03E8"),
        ("03 0029 0001", "03 02 0000"),
        ("03 0031 0002", "03 04 0000 0000"),
        ("03 0147 0001", "03 02 0000"),
    ]);
    other.wait(1000);
    other.check(&[("04 0001 0001", "04 02 01F4")]);
}

#[test]
fn a_board_can_move_its_own_registers_chapter_7() {
    let mut bench = Bench::new(Model::AnalogIn8);
    // Rreg_01 to RWreg_02, for ever.
    bench.check(&[("10 00C8 0002 04 FF01 FF02", "10 00C8 0002")]);
    settle(&mut bench, "input 1 volts 5");
    bench.check(&[("04 0002 0001", "04 02 01F4"), ("04 0064 0002", "04 04 01F4 5300")]);
}
