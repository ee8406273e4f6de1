//! MR-TP against its manual: requests and replies as bytes, on simulated time.

mod blinds;

use proptest::collection::vec;
use proptest::prelude::*;

use crate::simulator::device::Model;
use crate::simulator::testing::Bench;

/// A bench whose mode register has been written, with both switches in the middle, which is off in
/// all modes but 1.
fn bench(mode: &str) -> Bench {
    let mut bench = Bench::new(Model::MrTp);
    set_up(&mut bench, mode);
    bench
}

#[track_caller]
fn set_up(bench: &mut Bench, mode: &str) {
    let write = format!("06 0002 {mode}");
    bench.check(&[(&write, &write)]);
    bench.act("toggle 1 middle").expect("a switch");
    bench.act("toggle 2 middle").expect("a switch");
    // Meanwhile the switches have moved relays.
    bench.wait(500);
}

/// A relay as register and discrete inputs tell it: its stage and the cause of it.
fn relay(bench: &mut Bench, relay: u32) -> String {
    let reply = bench.ask("04 0000 0001");
    let status = u16::from_str_radix(&reply[4..], 16).expect("a register");
    let bits = status >> (4 + 4 * relay);
    let stage = ["off", "?", "open", "close"][usize::from(bits & 3)];
    let seen = ["OFF", "?", "STAGE 1", "STAGE 2"][usize::from(bits & 3)];
    assert_eq!(bench.output(&format!("relay_{relay}")), seen);
    format!("{stage} {}", bits >> 2 & 3)
}

/// After so many milliseconds more, relay 1 is so.
#[track_caller]
fn follow(bench: &mut Bench, rows: &[(u64, &str)]) {
    for (row, (wait, state)) in rows.iter().enumerate() {
        bench.wait(*wait);
        assert_eq!(relay(bench, 1), *state, "row {row}: {wait} ms later");
    }
}

#[track_caller]
fn press(bench: &mut Bench, input: u8) {
    bench.act(&format!("input {input} contact closed")).expect("a contact");
}

#[track_caller]
fn release(bench: &mut Bench, input: u8) {
    bench.act(&format!("input {input} contact open")).expect("a contact");
}

#[track_caller]
fn command(bench: &mut Bench, command: u8) {
    let write = format!("06 0001 {command:04X}");
    bench.check(&[(&write, &write)]);
}

/// Presses a button for so long.
#[track_caller]
fn press_for(bench: &mut Bench, input: u8, millis: u64) {
    press(bench, input);
    bench.wait(millis);
    release(bench, input);
}

#[test]
fn sixteen_discrete_inputs_and_one_register_tell_the_same_page_36() {
    let mut bench = bench("0002");
    press(&mut bench, 1);
    press(&mut bench, 6);
    bench.act("toggle 2 down").expect("a switch");
    bench.check(&[
        // Transistor output 2 on, relay 1 in stage 1.
        ("0F 0000 0006 01 0A", "0F 0000 0006"),
        ("02 0000 0010", "02 02 A1 F2"),
        ("04 0000 0001", "04 02 F2A1"),
        ("02 0005 0001", "02 01 01"),
        ("02 0008 0002", "02 01 02"),
        ("02 000C 0004", "02 01 0F"),
        ("02 000F 0001", "02 01 01"),
        ("02 000F 0002", "82 02"),
        ("02 0010 0001", "82 02"),
        ("02 0000 0011", "82 03"),
        ("02 0000 0000", "82 03"),
        ("04 0001 0001", "84 02"),
        ("04 0000 0002", "84 03"),
    ]);
    assert_eq!((bench.output("output_1"), bench.output("output_2")), ("OFF".into(), "ON".into()));
    release(&mut bench, 1);
    bench.check(&[("02 0000 0008", "02 01 A0")]);
}

#[test]
fn coils_0_to_5_are_read_and_written_in_any_span_pages_37_and_38() {
    bench("0002").check(&[
        ("01 0000 0006", "01 01 00"),
        ("0F 0000 0006 01 FF", "0F 0000 0006"),
        ("01 0000 0006", "01 01 3F"),
        ("01 0005 0001", "01 01 01"),
        ("01 0005 0002", "81 02"),
        ("01 0006 0001", "81 02"),
        ("01 0000 0007", "81 03"),
        ("01 0000 0000", "81 03"),
        ("05 0005 0000", "05 0005 0000"),
        ("05 0005 FF01", "85 03"),
        ("05 0006 FF00", "85 02"),
        ("01 0000 0006", "01 01 1F"),
        ("0F 0001 0003 01 02", "0F 0001 0003"),
        ("01 0000 0006", "01 01 15"),
        ("0F 0005 0002 01 03", "8F 02"),
        ("0F 0000 0007 01 7F", "8F 03"),
        // Function 0x15, as page 38 has it, is no function.
        ("15 0000 0006 01 00", "95 01"),
    ]);
}

#[test]
fn two_coils_are_one_relay_of_two_stages_page_37() {
    for (value, state) in [(0, "off 0"), (1, "off 0"), (2, "open 0"), (3, "close 0")] {
        for number in [1, 2] {
            let mut bench = bench("0002");
            let shift = 2 * number;
            let coils = format!("{:02X}", value << shift);
            bench.check(&[
                (&format!("0F 0000 0006 01 {coils}"), "0F 0000 0006"),
                ("01 0000 0006", &format!("01 01 {coils}")),
                ("03 0000 0001", &format!("03 02 00{coils}")),
            ]);
            assert_eq!(relay(&mut bench, number), state, "{value}");
            assert_eq!(relay(&mut bench, 3 - number), "off 0");
            // The same as register 0.
            bench.check(&[("06 0000 FFC0", "06 0000 FFC0"), ("03 0000 0001", "03 02 0000")]);
            assert_eq!(relay(&mut bench, number), "off 0");
            bench.wait(500);
            let write = format!("06 0000 00{coils}");
            bench.check(&[(&write, &write)]);
            assert_eq!(relay(&mut bench, number), state, "{value}");
        }
    }
}

#[test]
fn registers_are_0_to_7_and_66_with_the_times_of_the_factory_pages_38_and_39() {
    Bench::new(Model::MrTp).check(&[
        ("03 0000 0008", "03 10 0000 0000 0001 0000 00C8 0032 1770 0064"),
        ("03 0042 0001", "03 02 0000"),
        ("03 0007 0001", "03 02 0064"),
        ("03 0007 0002", "83 02"),
        ("03 0008 0001", "83 02"),
        ("03 0000 0009", "83 03"),
        ("03 0000 0000", "83 03"),
        ("03 0041 0002", "83 02"),
        ("03 0042 0002", "83 02"),
        ("06 0008 0000", "86 02"),
        ("10 0003 0005 0A FFFF 0001 0002 0003 FFFF", "10 0003 0005"),
        ("03 0003 0005", "03 0A 003F 0001 0002 0003 FFFF"),
        ("10 0042 0001 02 1234", "10 0042 0001"),
        ("03 0042 0001", "03 02 1234"),
        ("10 0007 0002 04 0000 0000", "90 02"),
        ("10 0000 0009 12 000000000000000000000000000000000000", "90 03"),
    ]);
}

#[test]
fn commands_modes_and_kinds_of_pulse_that_are_in_no_table_are_refused_pages_40_and_42() {
    let mut bench = Bench::new(Model::MrTp);
    bench.check(&[
        // "Im Low-Byte": the high byte is not part of it.
        ("06 0001 1204", "06 0001 1204"),
        ("03 0001 0001", "03 02 0004"),
        ("06 0001 0005", "86 03"),
        ("06 0002 0005", "86 03"),
        ("06 0002 0503", "86 03"),
        ("06 0002 0603", "86 03"),
        ("10 0000 0003 06 0003 0001 0008", "90 03"),
        ("03 0000 0003", "03 06 0000 0004 0001"),
        ("06 0002 F704", "06 0002 F704"),
        ("03 0002 0001", "03 02 F704"),
    ]);
}

#[test]
fn half_a_second_lies_between_two_stages_page_40() {
    let mut bench = bench("0002");
    bench.check(&[("06 0000 0008", "06 0000 0008")]);
    follow(&mut bench, &[(0, "open 0"), (3000, "open 0")]);
    bench.check(&[("06 0000 000C", "06 0000 000C")]);
    follow(&mut bench, &[(0, "off 0"), (499, "off 0"), (1, "close 0")]);
    // Off and back to the same stage needs no pause; what has been off for a while, only its rest.
    bench.check(&[("06 0000 0000", "06 0000 0000"), ("06 0000 000C", "06 0000 000C")]);
    follow(&mut bench, &[(0, "close 0")]);
    bench.check(&[("06 0000 0000", "06 0000 0000")]);
    bench.wait(300);
    bench.check(&[("06 0000 0008", "06 0000 0008")]);
    follow(&mut bench, &[(199, "off 0"), (1, "open 0")]);
    // A change of mind in the pause.
    bench.check(&[("06 0000 000C", "06 0000 000C")]);
    bench.wait(400);
    bench.check(&[("06 0000 0008", "06 0000 0008")]);
    follow(&mut bench, &[(0, "open 0")]);
}

#[test]
fn a_switch_means_by_its_mode_what_page_40_says_and_rules_while_it_is_not_off() {
    for (mode, position, bus, state) in [
        ("0000", "up", "close", "open 3"),
        ("0000", "middle", "close", "off 3"),
        ("0000", "down", "open", "close 3"),
        ("0001", "up", "close", "close 0"),
        ("0001", "up", "off", "off 0"),
        ("0001", "middle", "close", "open 3"),
        ("0001", "down", "open", "close 3"),
        ("0002", "up", "close", "open 3"),
        ("0002", "middle", "close", "close 0"),
        ("0002", "down", "off", "close 3"),
        ("0003", "up", "close", "open 3"),
        ("0003", "middle", "close", "off 0"),
        ("0003", "down", "open", "close 3"),
        ("0004", "up", "close", "open 3"),
        ("0004", "middle", "close", "off 0"),
        ("0004", "down", "open", "close 3"),
    ] {
        let mut bench = bench("0002");
        let coils = match bus {
            "open" => "08",
            "close" => "0C",
            _ => "00",
        };
        bench.act(&format!("toggle 1 {position}")).expect("a switch");
        bench.ask(&format!("06 0002 {mode}"));
        // The coils are what the bus wrote, whatever rules.
        bench.check(&[
            (&format!("0F 0000 0006 01 {coils}"), "0F 0000 0006"),
            ("01 0000 0006", &format!("01 01 {coils}")),
        ]);
        bench.wait(500);
        assert_eq!(relay(&mut bench, 1), state, "mode {mode}, switch {position}, coils {bus}");
    }
}

#[test]
fn the_switches_stand_up_which_is_off_in_the_mode_of_the_factory_page_40() {
    let mut bench = Bench::new(Model::MrTp);
    assert_eq!((relay(&mut bench, 1), relay(&mut bench, 2)), ("off 0".into(), "off 0".into()));
    bench.act("toggle 2 middle").expect("a switch");
    assert_eq!((relay(&mut bench, 1), relay(&mut bench, 2)), ("off 0".into(), "open 3".into()));
}

#[test]
fn a_watchdog_that_no_message_feeds_puts_the_coils_to_register_3_page_39() {
    let mut bench = bench("0002");
    bench.check(&[
        ("06 0003 0031", "06 0003 0031"),
        ("06 0042 0032", "06 0042 0032"),
        ("06 0000 0022", "06 0000 0022"),
    ]);
    assert_eq!(relay(&mut bench, 2), "open 0");
    bench.wait(499);
    bench.check(&[("01 0000 0006", "01 01 22")]);
    // The time at which it expired counts for the pause, not that at which somebody looks.
    bench.wait(999);
    assert_eq!(bench.output("relay_2"), "OFF");
    bench.wait(1);
    assert_eq!(bench.output("relay_2"), "STAGE 2");
    assert_eq!(bench.output("output_1"), "ON");
    bench.check(&[("01 0000 0006", "01 01 31"), ("06 0000 0001", "06 0000 0001")]);
    bench.wait(499);
    bench.check(&[("01 0000 0006", "01 01 01")]);
}

#[test]
fn settings_outlive_a_restart_which_loads_the_coils_and_forgets_the_command_pages_38_and_39() {
    let mut bench = bench("0002");
    let written = "10 0000 0008 10 0008 0004 9303 003D 0001 0002 1000 0004";
    bench.check(&[(written, "10 0000 0008"), ("06 0042 7000", "06 0042 7000")]);
    follow(&mut bench, &[(0, "close 1")]);
    let kept = bench.device.eeprom();
    let after = "03 10 003D 0000 9303 003D 0001 0002 1000 0004";
    let rows = [("08 0001 0000", "08 0001 0000"), ("03 0000 0008", after), ("03 0042 0001", "03 02 7000")];
    bench.check(&rows);
    follow(&mut bench, &[(0, "off 0"), (60_000, "off 0")]);
    let mut other = Bench::new(Model::MrTp);
    other.device.load_eeprom(other.now, &kept).expect("an EEPROM of the same device");
    other.check(&rows[1..]);
    // A mode that is in no table is the factory's.
    let mut broken = kept.clone();
    let mode = broken.iter().position(|word| *word == 0x9303).expect("the mode");
    broken[mode] = 0x9309;
    other.device.load_eeprom(other.now, &broken).expect("an EEPROM of the same device");
    other.check(&[("03 0002 0002", "03 04 0001 003D")]);
}

#[test]
fn a_restart_leaves_the_pause_between_two_stages_page_40() {
    let mut bench = bench("0002");
    bench.check(&[("06 0003 000C", "06 0003 000C"), ("06 0000 0008", "06 0000 0008")]);
    follow(&mut bench, &[(0, "open 0")]);
    bench.check(&[("08 0001 0000", "08 0001 0000")]);
    follow(&mut bench, &[(0, "off 0"), (499, "off 0"), (1, "close 0")]);
}

#[test]
fn there_are_six_contacts_and_two_switches_to_touch() {
    let mut bench = bench("0003");
    for wrong in [
        "input 0 contact closed",
        "input 7 contact closed",
        "input 1 volts 5",
        "toggle 0 up",
        "toggle 3 up",
        "relay 1 hand on",
        "button",
    ] {
        assert!(bench.act(wrong).is_err(), "{wrong}");
    }
    bench.check(&[("04 0000 0001", "04 02 0000")]);
}

/// What happens to a device: a request, or a change of the process side.
const HAPPENINGS: [&str; 20] = [
    "06 0001 0000",
    "06 0001 0002",
    "06 0001 0003",
    "06 0001 0004",
    "06 0000 0008",
    "06 0000 000C",
    "06 0002 A003",
    "06 0002 A203",
    "06 0002 A304",
    "06 0002 A404",
    "06 0002 0002",
    "08 0001 0000",
    "input 1 contact closed",
    "input 1 contact open",
    "input 2 contact closed",
    "input 2 contact open",
    "input 3 contact closed",
    "input 3 contact open",
    "input 6 contact closed",
    "toggle 1 middle",
];

proptest! {
    #[test]
    fn it_is_the_same_whether_somebody_looks_all_the_time_or_now_and_then(
        steps in vec((0..60u64, 0..HAPPENINGS.len()), 1..40),
    ) {
        let (mut watched, mut left_alone) = (bench("0003"), bench("0003"));
        for bench in [&mut watched, &mut left_alone] {
            bench.check(&[
                // 0.3 s, 0.2 s, 2 s, 0.1 s, and a watchdog of 1.5 s.
                ("10 0003 0005 0A 000C 001E 0014 00C8 000A", "10 0003 0005"),
                ("06 0042 0096", "06 0042 0096"),
            ]);
        }
        for (pause, happening) in steps {
            for _ in 0..pause {
                watched.wait(50);
                watched.device.advance(watched.now);
            }
            left_alone.wait(50 * pause);
            for bench in [&mut watched, &mut left_alone] {
                let happening = HAPPENINGS[happening];
                if happening.starts_with('0') {
                    bench.ask(happening);
                } else {
                    bench.act(happening).expect("something to touch");
                }
            }
            prop_assert_eq!(watched.device.outputs(), left_alone.device.outputs());
        }
    }
}
