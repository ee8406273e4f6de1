//! MR-TP against its manual: requests and replies as bytes, on simulated time.

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
fn a_command_moves_both_blinds_for_the_long_time_and_locks_the_buttons_page_42() {
    let mut bench = bench("0003");
    command(&mut bench, 2);
    follow(&mut bench, &[(0, "open 1"), (59_999, "open 1")]);
    assert_eq!(relay(&mut bench, 2), "open 1");
    follow(&mut bench, &[(1, "off 1")]);
    assert_eq!(relay(&mut bench, 2), "off 1");
    press(&mut bench, 1);
    follow(&mut bench, &[(0, "off 1"), (5000, "off 1")]);
    // The button that is still held must be pressed anew when it may.
    command(&mut bench, 0);
    follow(&mut bench, &[(0, "off 0"), (5000, "off 0")]);
    release(&mut bench, 1);
    press(&mut bench, 1);
    follow(&mut bench, &[(0, "open 0")]);
    command(&mut bench, 1);
    follow(&mut bench, &[(0, "off 1"), (5000, "off 1")]);
    command(&mut bench, 3);
    follow(&mut bench, &[(0, "close 1"), (59_999, "close 1"), (1, "off 1")]);
}

#[test]
fn a_command_begins_only_when_the_register_changes_page_42() {
    let mut bench = bench("0003");
    command(&mut bench, 3);
    bench.wait(59_000);
    command(&mut bench, 3);
    follow(&mut bench, &[(999, "close 1"), (1, "off 1")]);
    command(&mut bench, 3);
    bench.check(&[("10 0000 0002 04 0000 0003", "10 0000 0002"), ("06 0001 0103", "06 0001 0103")]);
    follow(&mut bench, &[(0, "off 1")]);
    command(&mut bench, 0);
    command(&mut bench, 3);
    follow(&mut bench, &[(0, "close 1")]);
    // Another one begins anew, behind the pause where it goes the other way.
    bench.wait(30_000);
    command(&mut bench, 4);
    follow(&mut bench, &[(59_999, "close 1")]);
    command(&mut bench, 2);
    follow(&mut bench, &[(0, "off 1"), (500, "open 1"), (59_999, "open 1"), (1, "off 1")]);
    // Normal operation and the lock both stop a blind at once.
    for stop in [0, 1] {
        command(&mut bench, 3);
        bench.wait(1000);
        command(&mut bench, stop);
        follow(&mut bench, &[(0, &format!("off {stop}")), (70_000, &format!("off {stop}"))]);
    }
}

#[test]
fn command_4_closes_and_then_turns_the_slats_by_opening_a_little_page_42() {
    let mut bench = bench("0003");
    // 3 s and 0.8 s.
    bench.check(&[("10 0006 0002 04 012C 0050", "10 0006 0002")]);
    command(&mut bench, 4);
    let turn = [
        (0, "close 1"),
        (2999, "close 1"),
        (1, "off 1"),
        (499, "off 1"),
        (1, "open 1"),
        (799, "open 1"),
        (1, "off 1"),
        (70_000, "off 1"),
    ];
    follow(&mut bench, &turn);
    assert_eq!(relay(&mut bench, 2), "off 1");
    // Nobody need look meanwhile: one step of time gives the same as many.
    command(&mut bench, 0);
    command(&mut bench, 4);
    follow(&mut bench, &[(4299, "open 1"), (1, "off 1")]);
    // A command between them takes the turning with it.
    command(&mut bench, 3);
    follow(&mut bench, &[(3499, "close 1"), (1, "off 1"), (600, "off 1")]);
}

#[test]
fn a_command_waits_for_no_mode_it_begins_when_it_is_written_in_one_with_blinds_page_42() {
    let mut bench = bench("0002");
    command(&mut bench, 2);
    follow(&mut bench, &[(0, "off 0")]);
    bench.check(&[("06 0002 0003", "06 0002 0003")]);
    follow(&mut bench, &[(0, "off 1")]);
    // Both in one request.
    bench.check(&[("06 0002 0002", "06 0002 0002"), ("10 0001 0002 04 0003 0003", "10 0001 0002")]);
    follow(&mut bench, &[(0, "close 1")]);
    // Another mode ends what goes on.
    bench.check(&[("06 0002 0004", "06 0002 0004")]);
    follow(&mut bench, &[(0, "off 1")]);
}

#[test]
fn one_motor_hangs_between_both_relays_in_sunblind_2_page_41() {
    let both = |bench: &mut Bench| (relay(bench, 1), relay(bench, 2));
    let mut bench = bench("0004");
    command(&mut bench, 2);
    assert_eq!(both(&mut bench), ("open 1".into(), "open 1".into()));
    command(&mut bench, 3);
    bench.wait(500);
    assert_eq!(both(&mut bench), ("close 1".into(), "close 1".into()));
    bench.act("toggle 1 up").expect("a switch");
    bench.wait(500);
    assert_eq!(both(&mut bench), ("open 3".into(), "open 3".into()));
    bench.act("toggle 1 middle").expect("a switch");
    bench.act("toggle 2 up").expect("a switch");
    bench.wait(500);
    assert_eq!(both(&mut bench), ("close 1".into(), "close 1".into()));
    command(&mut bench, 0);
    press(&mut bench, 2);
    assert_eq!(both(&mut bench), ("close 0".into(), "close 0".into()));
    bench.wait(1000);
    release(&mut bench, 2);
    // Inputs 4 and 5 are free.
    press(&mut bench, 4);
    press(&mut bench, 5);
    bench.check(&[("02 0000 0006", "02 01 18")]);
    assert_eq!(both(&mut bench), ("off 0".into(), "off 0".into()));
}

#[test]
fn each_blind_of_sunblind_1_has_its_two_buttons_and_its_switch_page_40() {
    for (input, moved, state) in [(1, 1, "open 0"), (2, 1, "close 0"), (4, 2, "open 0"), (5, 2, "close 0")] {
        let mut bench = bench("0003");
        press(&mut bench, input);
        assert_eq!(relay(&mut bench, moved), state, "{input}");
        assert_eq!(relay(&mut bench, 3 - moved), "off 0", "{input}");
        bench.act(&format!("toggle {moved} up")).expect("a switch");
        bench.wait(500);
        assert_eq!(relay(&mut bench, moved), "open 3");
        assert_eq!(relay(&mut bench, 3 - moved), "off 0");
    }
    for input in [3, 6] {
        let mut bench = bench("0003");
        press(&mut bench, input);
        assert_eq!((relay(&mut bench, 1), relay(&mut bench, 2)), ("off 0".into(), "off 0".into()));
    }
    // In the other modes they are inputs like any other.
    let mut bench = bench("0002");
    press(&mut bench, 1);
    follow(&mut bench, &[(0, "off 0"), (3000, "off 0")]);
}

#[test]
fn a_short_press_gives_the_pulse_of_its_kind_page_42() {
    // The time is 0.5 s. For each kind, how long the relay is on after presses of 0.2 s and of 1 s.
    for (kind, after_short, after_long) in
        [("0", 500, 500), ("1", 200, 500), ("2", 500, 1000), ("3", 200, 1000), ("7", 200, 1000)]
    {
        for (pressed, on) in [(200, after_short), (1000, after_long)] {
            let mut bench = bench(&format!("0{kind}03"));
            press(&mut bench, 1);
            for elapsed in (0..1500).step_by(50) {
                if elapsed == pressed {
                    release(&mut bench, 1);
                }
                let state = if elapsed < on { "open 0" } else { "off 0" };
                assert_eq!(relay(&mut bench, 1), state, "kind {kind}, {pressed} ms, after {elapsed} ms");
                bench.wait(50);
            }
        }
    }
    for pressed in [200, 1000, 1999] {
        let mut bench = bench("0403");
        press(&mut bench, 2);
        follow(&mut bench, &[(0, "off 0"), (pressed, "off 0")]);
        release(&mut bench, 2);
        follow(&mut bench, &[(0, "close 0"), (499, "close 0"), (1, "off 0"), (9999, "off 0")]);
    }
}

#[test]
fn a_long_press_gives_the_long_pulse_but_for_kind_7_page_42() {
    for (kind, before) in
        [("0", "off 0"), ("1", "off 0"), ("2", "open 0"), ("3", "open 0"), ("4", "off 0"), ("7", "open 0")]
    {
        let mut bench = bench(&format!("0{kind}03"));
        press(&mut bench, 1);
        follow(&mut bench, &[(1999, before), (1, "open 0")]);
        if kind == "7" {
            follow(&mut bench, &[(100_000, "open 0")]);
            release(&mut bench, 1);
            follow(&mut bench, &[(0, "off 0")]);
            continue;
        }
        // Let go or not, it is as long as it is.
        if kind != "3" {
            release(&mut bench, 1);
        }
        follow(&mut bench, &[(0, "open 0"), (59_999, "open 0"), (1, "off 0"), (70_000, "off 0")]);
        release(&mut bench, 1);
        follow(&mut bench, &[(0, "off 0")]);
    }
}

#[test]
fn a_short_press_ends_the_long_pulse_and_a_long_one_makes_another_page_42() {
    for kind in ["0", "1", "2", "3", "4"] {
        for input in [1, 2] {
            let mut bench = bench(&format!("0{kind}03"));
            press_for(&mut bench, 1, 2500);
            follow(&mut bench, &[(5000, "open 0")]);
            press_for(&mut bench, input, 200);
            follow(&mut bench, &[(0, "off 0"), (70_000, "off 0")]);
            press_for(&mut bench, 1, 2500);
            follow(&mut bench, &[(5000, "open 0")]);
            press_for(&mut bench, input, 2000);
            let state = if input == 1 { "open 0" } else { "close 0" };
            follow(&mut bench, &[(0, state), (59_999, state), (1, "off 0")]);
        }
    }
}

#[test]
fn a_pulse_keeps_its_length_behind_a_pause_and_the_button_pressed_last_counts_pages_40_and_42() {
    let mut bench = bench("0003");
    press(&mut bench, 1);
    bench.wait(300);
    press(&mut bench, 2);
    follow(&mut bench, &[(0, "off 0"), (499, "off 0"), (1, "close 0"), (499, "close 0"), (1, "off 0")]);
    // Letting the other go ends nothing: this one has been held for two seconds now.
    release(&mut bench, 1);
    follow(&mut bench, &[(999, "off 0"), (1, "close 0")]);
}

#[test]
fn the_times_are_those_of_registers_4_to_7_page_39() {
    let mut bench = bench("0003");
    // 1 s, 0.2 s, 5 s, 0.3 s.
    bench.check(&[("10 0004 0004 08 0064 0014 01F4 001E", "10 0004 0004")]);
    press(&mut bench, 1);
    follow(&mut bench, &[(199, "open 0"), (1, "off 0"), (799, "off 0"), (1, "open 0"), (4999, "open 0")]);
    follow(&mut bench, &[(1, "off 0")]);
    bench.wait(1000);
    command(&mut bench, 4);
    follow(&mut bench, &[(4999, "close 1"), (1, "off 1"), (500, "open 1"), (299, "open 1"), (1, "off 1")]);
    // Times of 0 are pulses that are over before they begin.
    command(&mut bench, 0);
    bench.check(&[("10 0004 0004 08 0000 0000 0000 0000", "10 0004 0004")]);
    release(&mut bench, 1);
    press(&mut bench, 1);
    follow(&mut bench, &[(0, "off 0"), (5000, "off 0")]);
    command(&mut bench, 4);
    follow(&mut bench, &[(0, "off 1"), (5000, "off 1")]);
}

#[test]
fn wind_opens_like_command_2_and_rules_over_commands_and_buttons_page_41() {
    // A contact that closes, and one that opens.
    for (flags, calm, blows) in [("80", "open", "closed"), ("C0", "closed", "open")] {
        let mut bench = Bench::new(Model::MrTp);
        bench.act(&format!("input 3 contact {calm}")).expect("a contact");
        set_up(&mut bench, &format!("{flags}03"));
        command(&mut bench, 3);
        follow(&mut bench, &[(1000, "close 1")]);
        bench.act(&format!("input 3 contact {blows}")).expect("a contact");
        follow(&mut bench, &[(499, "off 2"), (1, "open 2")]);
        assert_eq!(relay(&mut bench, 2), "open 2");
        // Neither a command nor a button does anything, the switch does.
        command(&mut bench, 0);
        press_for(&mut bench, 2, 100);
        follow(&mut bench, &[(0, "open 2")]);
        bench.act("toggle 1 down").expect("a switch");
        follow(&mut bench, &[(500, "close 3")]);
        bench.act("toggle 1 middle").expect("a switch");
        follow(&mut bench, &[(500, "open 2"), (58_899, "open 2"), (1, "off 2"), (70_000, "off 2")]);
        // When it drops, the levels below rule again.
        bench.act(&format!("input 3 contact {calm}")).expect("a contact");
        follow(&mut bench, &[(0, "off 0")]);
        press_for(&mut bench, 2, 100);
        follow(&mut bench, &[(0, "close 0"), (1000, "off 0")]);
        // A gust opens the blind whole.
        bench.act(&format!("input 3 contact {blows}")).expect("a contact");
        bench.wait(100);
        bench.act(&format!("input 3 contact {calm}")).expect("a contact");
        follow(&mut bench, &[(59_899, "open 2"), (1, "off 0")]);
    }
}

#[test]
fn wind_that_blows_already_when_the_flag_comes_or_the_device_starts_opens_too_page_41() {
    let mut bench = bench("0003");
    press(&mut bench, 3);
    follow(&mut bench, &[(0, "off 0")]);
    bench.check(&[("06 0002 8003", "06 0002 8003")]);
    follow(&mut bench, &[(0, "open 2"), (60_000, "off 2")]);
    bench.check(&[("08 0001 0000", "08 0001 0000")]);
    follow(&mut bench, &[(0, "open 2"), (60_000, "off 2")]);
    // No such contact in the other modes.
    bench.check(&[("06 0002 8002", "06 0002 8002")]);
    follow(&mut bench, &[(0, "off 0")]);
}

#[test]
fn an_open_door_prevents_closing_by_commands_and_buttons_and_nothing_else_page_41() {
    for (flags, shut, open) in [("20", "open", "closed"), ("30", "closed", "open")] {
        let mut bench = Bench::new(Model::MrTp);
        bench.act(&format!("input 6 contact {shut}")).expect("a contact");
        set_up(&mut bench, &format!("{flags}03"));
        command(&mut bench, 3);
        follow(&mut bench, &[(1000, "close 1")]);
        bench.act(&format!("input 6 contact {open}")).expect("a contact");
        follow(&mut bench, &[(0, "off 2"), (30_000, "off 2")]);
        assert_eq!(relay(&mut bench, 2), "off 2");
        // The pulse's time has passed meanwhile.
        bench.act(&format!("input 6 contact {shut}")).expect("a contact");
        follow(&mut bench, &[(0, "close 1"), (28_999, "close 1"), (1, "off 1")]);
        bench.act(&format!("input 6 contact {open}")).expect("a contact");
        follow(&mut bench, &[(0, "off 1")]);
        command(&mut bench, 2);
        follow(&mut bench, &[(0, "off 1"), (500, "open 1")]);
        command(&mut bench, 0);
        press(&mut bench, 2);
        follow(&mut bench, &[(0, "off 2"), (499, "off 2"), (501, "off 0")]);
        release(&mut bench, 2);
        press_for(&mut bench, 1, 100);
        follow(&mut bench, &[(0, "open 0"), (1000, "off 0")]);
        bench.act("toggle 1 down").expect("a switch");
        follow(&mut bench, &[(0, "close 3")]);
    }
}

#[test]
fn the_switch_lets_a_command_s_time_pass_page_41() {
    let mut bench = bench("0003");
    command(&mut bench, 2);
    bench.wait(10_000);
    bench.act("toggle 1 up").expect("a switch");
    follow(&mut bench, &[(20_000, "open 3")]);
    bench.act("toggle 1 middle").expect("a switch");
    follow(&mut bench, &[(0, "open 1"), (29_999, "open 1"), (1, "off 1")]);
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
