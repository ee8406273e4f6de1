//! The sensor against its manual: requests and replies as bytes, on simulated time.

mod functions;

use crate::simulator::device::{Addressed, Model};
use crate::simulator::testing::Bench;

fn bench() -> Bench {
    Bench::new(Model::Sensor)
}

fn hex(word: i32) -> String {
    format!("{:04X}", word as u16)
}

impl Bench {
    /// An Rreg (function 4) or RWreg (function 3).
    #[track_caller]
    fn is(&mut self, function: u8, register: u16, value: i32) {
        self.check(&[(
            &format!("{function:02X}{register:04X}0001"),
            &format!("{function:02X}02{}", hex(value)),
        )]);
    }

    /// Writes an RWreg, within its range.
    #[track_caller]
    fn set(&mut self, register: u16, value: i32) {
        let request = format!("06{register:04X}{}", hex(value));
        self.check(&[(&request, &request)]);
    }

    #[track_caller]
    fn around(&mut self, commands: &[&str]) {
        commands.iter().for_each(|command| self.act(command).expect("a command"));
    }
}

#[test]
fn the_reading_registers_tell_what_is_around_in_their_steps_page_5() {
    let mut bench = bench();
    bench.around(&[
        "measure humidity 50",
        "measure temperature 20",
        "measure co2 812",
        "measure voc 12.3",
        "measure co 4",
        "measure volts 9.9",
        "measure milliamps 12.5",
        "measure oxygen 20.9",
        "measure air_pressure 1013",
        "measure pressure 250",
        "measure light 640",
        "measure flow 2.5",
        "measure door open",
        "measure switch open",
    ]);
    bench.wait(10_000);
    for (register, value) in [
        (0, 0x1000),
        (1, 500),
        (2, 200),
        // Humid air of 20 °C, by the usual tables.
        (3, 86),
        (4, 72),
        (5, 93),
        (6, 138),
        (10, 812),
        (11, 123),
        (12, 4),
        (13, 99),
        (14, 125),
        (15, 209),
        (19, 0x70),
        (20, 1013),
        (21, 1013),
        (22, 0),
        (23, 250),
        (30, 640),
        (31, 6),
        (35, 0),
        (36, 1),
        (37, 0),
        (38, 1),
        (47, 25),
        (50, 0),
        (55, 0),
        (58, 0),
        (79, 1018),
        (100, 0),
        (139, 0),
    ] {
        bench.is(4, register, value);
    }
    bench.check(&[("04 0001 0006", "04 0C 01F4 00C8 0056 0048 005D 008A")]);
}

#[test]
fn what_is_beyond_a_range_is_told_as_its_end_page_5() {
    let mut bench = bench();
    for (command, register, value) in [
        ("measure humidity 100", 1, 999),
        ("measure temperature -120.5", 2, -999),
        ("measure temperature 300", 2, 2999),
        ("measure temperature 21", 2, 210),
        ("measure humidity 0", 5, -999),
        ("measure co2 12000", 10, 9999),
        ("measure air_pressure 700", 20, 750),
        ("measure light 1500", 30, 999),
        ("measure light 1500", 31, 15),
        ("measure light 100000", 31, 999),
        ("measure flow 30", 47, 200),
        ("measure oxygen 100", 15, 999),
    ] {
        bench.around(&[command]);
        bench.is(4, register, value);
    }
    for command in ["input 1 volts 5", "button", "relay 1 hand on"] {
        assert!(bench.act(command).is_err(), "{command}");
    }
}

#[test]
fn the_settings_leave_the_factory_as_the_table_says_pages_6_to_8() {
    let mut bench = bench();
    let overriding = [1, 2, 3, 4, 5, 6, 10, 11, 12, 13, 14, 15, 20, 21, 22, 23, 30, 31, 33, 35, 36, 37, 38];
    let overriding = overriding.into_iter().chain(40..=45).chain([47, 50]).map(|register| (register, 11111));
    let others = [
        (0, 0x5300),
        (8, 0),
        (9, 0),
        (18, 1),
        (24, 75),
        (25, 1000),
        (26, 0),
        (27, 10),
        (28, 0),
        (29, 0),
        (32, 60),
        (34, 30),
        (48, 0),
        (54, 0),
        (55, 0),
        (57, 0),
        (58, 0),
        (59, 6),
        (60, 2),
        (61, 24),
        (62, 1),
        (63, 0),
        (65, 0),
        (69, 0),
        (75, 0),
        (79, 0),
        (80, 911),
        (90, 0),
        (99, 0),
        (200, 0),
        (239, 0),
    ];
    for (register, value) in overriding.chain(others) {
        bench.is(3, register, value);
    }
}

#[test]
fn holes_are_refused_with_exception_2_and_more_than_10_registers_with_3_chapter_9() {
    let mut bench = bench();
    for hole in [7, 8, 9, 16, 18, 24, 29, 32, 34, 39, 46, 48, 51, 54, 59, 78, 80, 99, 140, 227] {
        bench.check(&[(&format!("04{hole:04X}0001"), "84 02")]);
    }
    for hole in [7, 16, 17, 39, 46, 49, 56, 76, 78, 81, 89, 100, 199, 240, 327, 500, 539] {
        bench.check(&[(&format!("03{hole:04X}0001"), "83 02")]);
    }
    bench.check(&[
        ("04 0000 000B", "84 03"),
        ("04 0001 0007", "84 02"),
        ("03 0000 000B", "83 03"),
        ("03 003C 000B", "83 03"),
        ("06 0007 0001", "86 02"),
        ("06 021C 0001", "86 02"),
        ("06 021B 1234", "06 021B 1234"),
        ("04 008B 0001", "04 02 1234"),
        ("10 0006 0002 04 0001 0001", "90 02"),
        ("03 0006 0001", "03 02 2B67"),
        ("01 0000 0001", "81 01"),
        ("2B 0E 01 00", "AB 01"),
    ]);
}

#[test]
fn values_outside_their_range_are_limited_used_and_refused_pages_6_to_8_and_26() {
    let mut bench = bench();
    for (register, low, high) in [
        (0, 0, 0x7AFF),
        (1, 0, 999),
        (2, -999, 2999),
        (5, -999, 999),
        (8, -100, 100),
        (9, -100, 100),
        (10, 0, 9999),
        (15, 0, 999),
        (18, 0, 2),
        (20, 750, 1150),
        (21, 750, 1500),
        (22, -9999, 9999),
        (23, -9999, 9999),
        (24, 0, 1999),
        (25, 800, 1200),
        (27, 1, 50),
        (28, -50, 50),
        (29, 0, 3000),
        (30, 0, 999),
        (33, 0, 999),
        (34, 30, 31),
        (35, 0, 1),
        (36, 0, 1),
        // After 35, which goes back at once where the run-on time is 0.
        (32, 0, 1500),
        (40, 0, 9999),
        (47, 0, 200),
        (48, 0, 9999),
        (50, 0, 1),
        (51, 0, 255),
        (54, 0, 1800),
        (57, 0, 255),
        (59, 1, 24),
        (60, 0, 3),
        (61, 0, 63),
        (62, 0, 1),
        (63, 0, 1),
        (64, 1, 3),
        (65, 1, 60),
        (66, 0, 255),
        (75, 0, 255),
        (80, 0, 9999),
    ] {
        if low != 0 {
            bench.check(&[(&format!("06{register:04X}{}", hex(low - 1)), "84 03")]);
            bench.is(3, register, low);
        }
        bench.check(&[(&format!("06{register:04X}{}", hex(high + 1)), "84 03")]);
        bench.is(3, register, high);
        bench.set(register, low);
        bench.is(3, register, low);
    }
    // Function 16 says its own exception, and writes the others as well.
    bench.check(&[("10 003C 0003 06 0001 0040 0000", "90 03"), ("03 003C 0003", "03 06 0001 003F 0000")]);
    // Between 1, 6, 12 and 24 hours.
    bench.check(&[("06 003B 000B", "84 03"), ("03 003B 0001", "03 02 0006")]);
    // Off has to stay below on.
    bench.check(&[("06 0034 0001", "84 03"), ("03 0034 0001", "03 02 0000")]);
    bench.check(&[("06 0035 0000", "84 03"), ("03 0035 0001", "03 02 0001")]);
    bench.check(&[("06 0013 0080", "84 03"), ("03 0013 0001", "03 02 0077")]);
    // RWreg_79 takes anything, "0 ... 0xffff".
    bench.set(79, 5);
    bench.set(90, 0xFFFF);
    bench.is(3, 90, 0xFFFF);
}

#[test]
fn a_written_value_takes_the_place_of_the_measured_one_until_11111_page_8() {
    let mut bench = bench();
    bench.around(&["measure humidity 50", "measure temperature 20"]);
    for (register, value) in [
        (1, 652),
        (2, -105),
        (3, 71),
        (10, 1234),
        (20, 1005),
        (22, -55),
        (31, 999),
        (36, 1),
        (42, 9),
        (47, 55),
        (50, 1),
    ] {
        let measured = bench.ask(&format!("04{register:04X}0001"));
        bench.set(register, value);
        bench.is(4, register, value);
        bench.set(register, 11111);
        assert_eq!(bench.ask(&format!("04{register:04X}0001")), measured, "{register}");
    }
    // What is calculated follows: the dew point of 20 °C and 99.9 %.
    bench.set(1, 999);
    bench.is(4, 5, 200);
}

#[test]
fn offsets_slope_height_and_damping_shape_the_readings_pages_6_and_7() {
    let mut bench = bench();
    bench.around(&["measure humidity 50", "measure temperature 20", "measure air_pressure 955"]);
    bench.set(8, -25);
    bench.set(9, 13);
    bench.set(28, 5);
    bench.is(4, 1, 475);
    bench.is(4, 2, 213);
    bench.is(4, 20, 960);
    bench.is(4, 21, 960);
    bench.set(28, 0);
    bench.set(29, 500);
    bench.is(4, 21, 1014);

    // The mean of ten measurements, ten a second.
    bench.wait(10_000);
    bench.around(&["measure pressure 1000"]);
    for (wait, pascals) in [(0, 0), (100, 100), (400, 500), (500, 1000)] {
        bench.wait(wait);
        bench.is(4, 23, pascals);
    }
    bench.set(25, 1100);
    bench.is(4, 23, 1100);
    bench.set(27, 1);
    bench.around(&["measure pressure 20"]);
    bench.wait(100);
    bench.is(4, 23, 22);
}

#[test]
fn the_zero_of_the_pressure_is_set_by_1_and_cleared_by_0_page_6() {
    let mut bench = bench();
    bench.around(&["measure pressure 12"]);
    bench.wait(10_000);
    bench.set(26, 1);
    bench.is(3, 26, -12);
    bench.is(4, 23, 0);
    bench.act("restart").expect("a command");
    bench.wait(10_000);
    bench.is(4, 23, 0);
    bench.set(26, 0);
    bench.is(4, 23, 12);
    bench.around(&["measure pressure 300"]);
    bench.wait(10_000);
    bench.set(26, 1);
    bench.is(3, 26, -100);
    bench.is(4, 23, 200);
}

#[test]
fn stars_are_kept_over_a_restart_and_nothing_else_pages_6_to_8() {
    let mut bench = bench();
    let kept = [
        (0, 0x4105),
        (8, 10),
        (9, -10),
        (18, 2),
        (19, 0x20),
        (24, 100),
        (27, 5),
        (28, -3),
        (29, 120),
        (32, 90),
        (33, 50),
        (34, 31),
        (48, 400),
        (51, 2),
        (53, 300),
        (52, -50),
        (54, 3),
        (55, 4),
        (57, 2),
        (58, 1),
        (59, 12),
        (60, 1),
        (61, 30),
        (62, 0),
        (64, 1),
        (65, 15),
        (66, 3),
        (67, 4),
        (75, 5),
        (80, 1234),
        (200, 0x0101),
        (239, 0x0102),
    ];
    let lost = [(25, 900, 1000), (63, 1, 0), (90, 7, 0), (1, 500, 11111), (50, 1, 11111)];
    kept.iter().for_each(|(register, value)| bench.set(*register, *value));
    lost.iter().for_each(|(register, value, _)| bench.set(*register, *value));
    bench.set(500, 77);
    bench.around(&["measure temperature 33"]);
    let eeprom = bench.device.eeprom();
    // RWreg_79 = 10 answers, and then starts anew.
    bench.set(79, 10);
    kept.iter().for_each(|(register, value)| bench.is(3, *register, *value));
    lost.iter().for_each(|(register, _, value)| bench.is(3, *register, *value));
    bench.is(3, 79, 0);
    bench.is(4, 100, 0);
    bench.is(4, 2, 320);
    // RWreg_79 = 20 forgets the rest.
    bench.set(79, 20);
    for (register, value) in [(0, 0x5300), (8, 0), (19, 0x70), (24, 75), (33, 11111), (80, 911), (200, 0)] {
        bench.is(3, register, value);
    }
    bench.is(4, 2, 330);
    let now = bench.now;
    bench.device.load_eeprom(now, &eeprom).expect("its own EEPROM");
    kept.iter().for_each(|(register, value)| bench.is(3, *register, *value));
    assert!(bench.device.load_eeprom(now, &eeprom[1..]).is_err());
}

#[test]
fn pairs_of_master_registers_copy_within_the_device_page_22() {
    let mut bench = bench();
    // The manual's example: the relay that CO2 switches gives its value priority in the display.
    bench.set(53, 1000);
    bench.set(51, 10);
    bench.set(75, 10);
    bench.set(200, 0xFF32);
    bench.set(201, 0xFF3F);
    bench.around(&["measure co2 1200"]);
    bench.is(3, 63, 1);
    bench.around(&["measure co2 0"]);
    bench.is(3, 63, 0);
    // And its other one: readings and settings in a row, to be read at once.
    bench.around(&["measure humidity 50", "measure temperature 20", "measure co2 700", "measure voc 20"]);
    bench.set(8, 5);
    bench.set(9, -5);
    let sources = [0xFF01, 0xFF02, 0xFE08, 0xFE09, 0xFF0A, 0xFF0B, 0xFF13];
    for (at, source) in (0u16..).zip(sources) {
        bench.set(200 + 2 * at, source);
        bench.set(201 + 2 * at, 0xFF5A + i32::from(at));
    }
    bench.check(&[("03 005A 0007", "03 0E 01F9 00C3 0005 FFFB 02BC 00C8 0070")]);
}

#[test]
fn a_value_that_is_copied_to_a_special_register_takes_the_customer_code_with_it_page_21() {
    let mut bench = bench();
    bench.set(0, 0x5207);
    bench.around(&["measure temperature 21"]);
    bench.set(200, 0xFF02);
    bench.set(201, 0xFF6E);
    bench.check(&[("04 0064 0002", "04 04 00D2 5207"), ("04 006E 0002", "04 04 00D2 5207")]);
}

#[test]
fn a_broadcast_is_obeyed_and_not_answered_page_23() {
    let mut bench = bench();
    assert_eq!(bench.send(Addressed::Broadcast, "06 0008 000A"), "silence");
    bench.is(3, 8, 10);
}
