//! Registers, and the modes that have no alarm codes: Direct_Control, Fire_Damper, Input_Logic_Control.

use super::*;
use crate::simulator::device::{Addressed, Model};
use crate::simulator::testing::Bench;

fn check(rows: &[(&str, &str)]) {
    Bench::new(Model::MrDio42).check(rows);
}

/// A bench on which these registers have been written.
fn bench(registers: &[(u16, u16)]) -> Bench {
    let mut bench = Bench::new(Model::MrDio42);
    for (register, word) in registers {
        write(&mut bench, *register, *word);
    }
    bench
}

#[track_caller]
fn write(bench: &mut Bench, register: u16, word: u16) {
    let request = format!("06{register:04X}{word:04X}");
    bench.check(&[(&request, &request)]);
}

/// Closes and opens contacts, input 1 first: `1..0` closes 1, opens 4 and leaves the others.
fn connect(bench: &mut Bench, contacts: &str) {
    for (input, state) in contacts.chars().enumerate() {
        match state {
            '1' => bench.act(&format!("input {} contact closed", input + 1)).expect("a contact"),
            '0' => bench.act(&format!("input {} contact open", input + 1)).expect("a contact"),
            _ => {}
        }
    }
}

#[test]
fn addresses_are_those_of_page_21() {
    check(&[
        ("02 0000 0010", "02 02 0000"),
        ("02 000F 0001", "02 01 00"),
        ("02 000F 0002", "82 02"),
        ("02 0010 0001", "82 02"),
        ("02 0000 0011", "82 02"),
        ("02 0000 0000", "82 03"),
        ("02 0000 07D1", "82 03"),
        ("01 0000 0010", "01 02 0000"),
        ("01 0009 0003", "01 01 00"),
        ("01 0010 0001", "81 02"),
        ("01 0000 0000", "81 03"),
        ("04 0000 0003", "04 06 0000 0000 0000"),
        ("04 0002 0001", "04 02 0000"),
        ("04 0002 0002", "84 02"),
        ("04 0003 0001", "84 02"),
        ("04 0000 0000", "84 03"),
        ("03 0013 0001", "03 02 0000"),
        ("03 0013 0002", "83 02"),
        ("03 0014 0001", "83 02"),
        ("03 0040 0001", "83 02"),
        ("03 0040 0002", "83 02"),
        ("03 0042 0002", "83 02"),
        ("03 0043 0001", "83 02"),
        ("03 0000 007E", "83 03"),
        ("05 000F FF00", "05 000F FF00"),
        ("05 0010 FF00", "85 02"),
        ("05 0000 0001", "85 03"),
        ("0F 0000 0010 02 0000", "0F 0000 0010"),
        ("0F 000F 0002 01 00", "8F 02"),
        ("06 0013 0000", "06 0013 0000"),
        ("06 0014 0000", "86 02"),
        ("06 0040 0000", "86 02"),
        ("06 0043 0000", "86 02"),
        ("10 0012 0003 06 0000 0000 0000", "90 02"),
        ("10 0042 0001 02 0000", "10 0042 0001"),
        ("17 0000 0001 0000 0001 02 0000", "97 01"),
    ]);
}

#[test]
fn registers_leave_the_factory_as_on_pages_22_to_24() {
    check(&[(
        "03 0000 0014",
        "03 28 0000 0000 0000 0000 0960 0960 015E 015E 0000 0000 0000 0000 0000 0000 0000 0000 0000 0000 0000 0000",
    )]);
}

#[test]
fn register_65_is_read_and_is_written_only_alone_page_24() {
    check(&[
        ("03 0041 0001", "03 02 0015"),
        ("03 0041 0002", "03 04 0015 0000"),
        ("10 0041 0002 04 5338 0001", "90 02"),
        ("06 0041 0038", "86 03"),
        ("10 0041 0001 02 5338", "10 0041 0001"),
        ("06 0042 0007", "06 0042 0007"),
        ("03 0041 0002", "03 04 0038 0007"),
        ("03 0042 0001", "03 02 0007"),
    ]);
}

#[test]
fn values_outside_the_tables_are_refused_and_nothing_of_their_request_is_written_pages_23_to_25() {
    let mut bench = bench(&[(1, 0xFFFE), (3, 9)]);
    bench.check(&[
        ("06 0002 000A", "86 03"),
        ("06 0003 FFFF", "86 03"),
        // Toggling and following at once.
        ("06 0012 0101", "86 03"),
        ("06 0013 0F0F", "86 03"),
        ("10 0001 0003 06 0001 0002 000A", "90 03"),
        ("10 0012 0002 04 0001 0801", "90 03"),
        ("03 0001 0003", "03 06 0002 0000 0009"),
        ("03 0012 0002", "03 04 0000 0000"),
        // Where a mode has no drive and no alarm code, any word is taken and none is kept.
        ("10 000A 0008 10 0007 0007 0007 0007 0007 0007 0007 0007", "10 000A 0008"),
        ("03 000A 0008", "03 10 0000 0000 0000 0000 0000 0000 0000 0000"),
        ("06 0002 0008", "06 0002 0008"),
        ("06 000A 0000", "86 03"),
        ("06 000A 0003", "86 03"),
        ("06 000B 0003", "06 000B 0003"),
        ("06 0010 0000", "86 03"),
        ("06 0010 0006", "86 03"),
        ("06 0011 0006", "06 0011 0006"),
        ("10 000A 0008 10 0002 0000 0001 0000 0001 0000 0001 0000", "10 000A 0008"),
        ("03 000A 0008", "03 10 0002 0000 0003 0000 0000 0000 0001 0000"),
        ("06 0002 0003", "06 0002 0003"),
        ("06 000A 0000", "06 000A 0000"),
        ("06 0010 0000", "86 03"),
    ]);
}

#[test]
fn all_ten_modes_can_be_set_for_each_channel_page_25() {
    for mode in 0..10 {
        let other = 9 - mode;
        bench(&[(2, mode), (3, other)]).check(&[("03 0002 0002", &format!("03 04 {mode:04X} {other:04X}"))]);
    }
}

#[test]
fn relays_are_switched_by_coils_and_by_the_output_register_pages_22_and_25() {
    check(&[
        ("05 0000 FF00", "05 0000 FF00"),
        ("01 0000 0010", "01 02 1100"),
        ("05 0005 FF00", "05 0005 FF00"),
        ("01 0000 0010", "01 02 3300"),
        ("03 0000 0001", "03 02 0033"),
        ("0F 0000 0002 01 00", "0F 0000 0002"),
        ("01 0000 0010", "01 02 0000"),
        // Of Relay and RelaySet in one request the later wins; what has no function changes nothing.
        ("0F 0000 0010 02 EEFF", "0F 0000 0010"),
        ("01 0000 0010", "01 02 2200"),
        // Of the register only bits 0 and 1 switch.
        ("06 0000 FFFD", "06 0000 FFFD"),
        ("03 0000 0001", "03 02 0011"),
        ("10 0000 0001 02 0002", "10 0000 0001"),
        ("01 0000 0010", "01 02 2200"),
        ("01 0001 0004", "01 01 01"),
    ]);
}

#[test]
fn a_hand_switch_goes_before_the_bus_and_what_the_bus_wants_waits_pages_22_and_25() {
    let mut bench = bench(&[]);
    bench.act("relay 1 hand on").expect("a hand switch");
    bench.act("relay 2 hand off").expect("a hand switch");
    bench.check(&[
        ("01 0000 0010", "01 02 0D00"),
        ("05 0001 FF00", "05 0001 FF00"),
        ("01 0000 0010", "01 02 2D00"),
        ("05 0002 0000", "05 0002 0000"),
        ("01 0000 0010", "01 02 2D00"),
    ]);
    assert_eq!((bench.output("relay_1"), bench.output("hand_1")), ("ON".into(), "ON".into()));
    assert_eq!((bench.output("relay_2"), bench.output("hand_2")), ("OFF".into(), "ON".into()));
    bench.act("relay 1 hand automatic").expect("a hand switch");
    bench.act("relay 2 hand automatic").expect("a hand switch");
    bench.check(&[("01 0000 0010", "01 02 2200")]);
    for nothing in ["relay 0 hand on", "relay 3 hand on", "input 0 contact closed", "input 5 contact closed"]
    {
        assert!(bench.act(nothing).is_err(), "{nothing}");
    }
    for nothing in ["input 1 volts 5", "button", "output 1 hand 5"] {
        assert!(bench.act(nothing).is_err(), "{nothing}");
    }
}

#[test]
fn inputs_are_told_as_bits_and_as_a_register_and_switch_no_relay_pages_21_and_25() {
    let mut bench = bench(&[]);
    connect(&mut bench, "1001");
    bench.check(&[
        ("02 0000 0010", "02 02 0900"),
        ("02 0003 0002", "02 01 01"),
        ("04 0000 0001", "04 02 0009"),
        ("01 0000 0010", "01 02 0000"),
    ]);
    connect(&mut bench, "0110");
    bench.check(&[("02 0000 0010", "02 02 0600"), ("04 0000 0001", "04 02 0006")]);
}

#[test]
fn toggle_bits_turn_over_at_each_rise_and_at_each_fall_page_22() {
    let mut bench = bench(&[]);
    for (contacts, now, risen, fallen) in [
        ("1...", 1, 1, 0),
        ("1...", 1, 1, 0),
        ("0...", 0, 1, 1),
        ("1...", 1, 0, 1),
        ("0..1", 8, 8, 0),
        // A pulse between two polls leaves its trace in both.
        (".1..", 10, 10, 0),
        (".0..", 8, 10, 2),
        (".1..", 10, 8, 2),
        (".0.0", 0, 8, 8),
    ] {
        connect(&mut bench, contacts);
        bench.check(&[("04 0000 0003", &format!("04 06 {now:04X} {risen:04X} {fallen:04X}"))]);
    }
    // A restart forgets them, and what is closed then has not just been closed.
    connect(&mut bench, "..1.");
    bench.act("restart").expect("a restart");
    bench.check(&[("04 0000 0003", "04 06 0004 0000 0000")]);
    // Neither has what a mode that looks every 100 ms has not seen before.
    write(&mut bench, 2, 6);
    bench.wait(10);
    connect(&mut bench, "1");
    bench.check(&[("04 0000 0003", "04 06 0004 0000 0000")]);
    bench.act("restart").expect("a restart");
    bench.check(&[("04 0000 0003", "04 06 0005 0000 0000")]);
}

#[test]
fn a_watchdog_that_no_message_feeds_sets_the_defaults_in_direct_control_alone_page_26() {
    // 500 ms. Defaults: relay 2 alone.
    let mut bench = bench(&[(1, 2), (0, 1), (66, 50)]);
    bench.wait(499);
    // Any message to the device will do, even one that it refuses.
    bench.check(&[("03 0030 0001", "83 02")]);
    bench.wait(499);
    assert_eq!((bench.output("relay_1"), bench.output("red_led")), ("ON".into(), "OFF".into()));
    // One to all is not addressed to it.
    assert_eq!(bench.send(Addressed::Broadcast, "05 0000 FF00"), "silence");
    bench.wait(1);
    assert_eq!((bench.output("relay_1"), bench.output("relay_2")), ("OFF".into(), "ON".into()));
    assert_eq!(bench.output("red_led"), "ON");
    bench.check(&[("06 0000 0001", "06 0000 0001"), ("01 0000 0010", "01 02 1100")]);
    assert_eq!(bench.output("red_led"), "OFF");
    // Input_Logic_Control and Fire_Damper take no notice (pages 26 and 34).
    for mode in [9, 6] {
        write(&mut bench, 3, mode);
        bench.act("restart").expect("a restart");
        write(&mut bench, 1, 1);
        for millis in [1000, 100] {
            bench.wait(millis);
            let relays = (bench.output("relay_1"), bench.output("relay_2"));
            assert_eq!(relays, ("ON".into(), "ON".into()), "{mode}");
            assert_eq!(bench.output("red_led"), "ON");
        }
        write(&mut bench, 1, 2);
    }
}

#[test]
fn settings_outlive_a_restart_and_the_relays_begin_with_their_defaults_pages_22_to_26() {
    let settings = "0002 0006 0009 0001 0002 0003 0004 0005 0006";
    let mut bench = bench(&[]);
    bench.check(&[
        (&format!("10 0001 0009 12 {settings}"), "10 0001 0009"),
        ("06 0013 0003", "06 0013 0003"),
        ("06 0042 0007", "06 0042 0007"),
    ]);
    bench.act("restart").expect("a restart");
    bench.wait(60);
    bench.check(&[
        ("03 0001 0009", &format!("03 12 {settings}")),
        ("03 0012 0002", "03 04 0000 0000"),
        ("03 0042 0001", "03 02 0007"),
        ("01 0000 0010", "01 02 2200"),
    ]);
    let kept = bench.device.eeprom();
    let mut other = Bench::new(Model::MrDio42);
    other.device.load_eeprom(other.now, &kept).expect("an EEPROM of the same device");
    other.check(&[("03 0001 0009", &format!("03 12 {settings}")), ("01 0000 0010", "01 02 2200")]);
    assert!(other.device.load_eeprom(other.now, &kept[1..]).is_err());
}

#[test]
fn another_mode_begins_with_the_default_and_the_same_mode_again_changes_nothing() {
    let mut bench = bench(&[(1, 1), (0, 2), (2, 0), (3, 0)]);
    bench.check(&[("01 0000 0010", "01 02 2200")]);
    for (register, word, coils) in [(2, 9, "3300"), (3, 9, "1100"), (0, 3, "1100"), (2, 0, "1100")] {
        write(&mut bench, register, word);
        bench.check(&[("01 0000 0010", &format!("01 02 {coils}"))]);
    }
}

#[test]
fn a_relay_toggles_each_time_that_an_assigned_input_closes_pages_23_and_35() {
    // Relay 1: inputs 1, 2 and 4. Relay 2: input 2, and on from the start.
    let mut bench = bench(&[(1, 2), (2, 9), (3, 9), (18, 0b1011), (19, 0b0010)]);
    for (contacts, coils) in [
        ("....", "2200"),
        ("1...", "3300"),
        ("1...", "3300"),
        ("0...", "3300"),
        ("..1.", "3300"),
        (".1..", "0000"),
        ("...1", "1100"),
        ("1...", "0000"),
        ("0000", "0000"),
    ] {
        connect(&mut bench, contacts);
        bench.check(&[("01 0000 0010", &format!("01 02 {coils}"))]);
    }
    // The bus has nothing to say here, the hand switch has; toggling goes on behind it.
    bench.check(&[("05 0000 FF00", "05 0000 FF00"), ("06 0000 0003", "06 0000 0003")]);
    bench.check(&[("01 0000 0010", "01 02 0000")]);
    bench.act("relay 1 hand off").expect("a hand switch");
    connect(&mut bench, "1");
    bench.check(&[("01 0000 0010", "01 02 1400")]);
    bench.act("relay 1 hand automatic").expect("a hand switch");
    bench.check(&[("01 0000 0010", "01 02 1100")]);
    // A closed contact has not just been closed when the device starts: the default holds (page 34).
    bench.act("restart").expect("a restart");
    bench.check(&[("01 0000 0010", "01 02 2200")]);
}

#[test]
fn each_of_several_inputs_that_close_at_once_toggles_page_35() {
    for (closing, toggles) in [(0b0001, true), (0b0011, false), (0b0111, true), (0b1000, false)] {
        let mut channel = Channel::new(Time(0));
        channel.settings = Settings { mode: Mode::InputLogicControl, logic: 0b0111, ..FACTORY };
        channel.decide(closing, closing);
        assert_eq!(channel.wanted, toggles, "{closing:04b}");
    }
}

#[test]
fn a_relay_follows_its_assigned_inputs_while_one_of_them_is_closed_pages_23_and_35() {
    // Relay 1: inputs 1 and 3. Relay 2: input 4, and the defaults do not matter.
    let mut bench = bench(&[(1, 3), (18, 0x0500), (19, 0x0800), (2, 9), (3, 9)]);
    for (contacts, coils) in [
        ("....", "0000"),
        ("1...", "1100"),
        (".11.", "1100"),
        ("0...", "1100"),
        ("..0.", "0000"),
        ("...1", "2200"),
        ("..1.", "3300"),
    ] {
        connect(&mut bench, contacts);
        bench.check(&[("01 0000 0010", &format!("01 02 {coils}"))]);
    }
    bench.act("relay 1 hand off").expect("a hand switch");
    bench.check(&[("01 0000 0010", "01 02 3600")]);
    bench.act("relay 1 hand automatic").expect("a hand switch");
    bench.act("restart").expect("a restart");
    bench.check(&[("03 0012 0002", "03 04 0500 0800"), ("01 0000 0010", "01 02 3300")]);
    let kept = bench.device.eeprom();
    let mut other = Bench::new(Model::MrDio42);
    other.device.load_eeprom(other.now, &kept).expect("an EEPROM of the same device");
    other.check(&[("03 0012 0002", "03 04 0500 0800"), ("01 0000 0010", "01 02 0000")]);
    // Bits that are nobody's are not kept.
    bench.check(&[("06 0012 F0F0", "06 0012 F0F0"), ("03 0012 0001", "03 02 0000")]);
}

#[test]
fn inputs_of_a_channel_with_a_damper_are_taken_from_the_other_channel_s_logic_page_23() {
    for mode in 1..=8 {
        // Set before, and set after.
        let mut bench = bench(&[(2, 9), (18, 0x0F00), (3, mode)]);
        bench.check(&[
            ("03 0012 0001", "03 02 0300"),
            ("06 0012 000F", "06 0012 000F"),
            ("03 0012 0001", "03 02 0003"),
        ]);
        connect(&mut bench, "..11");
        bench.wait(200);
        bench.check(&[("01 0000 0001", "01 01 00")]);
        connect(&mut bench, "1...");
        bench.check(&[("01 0000 0001", "01 01 01")]);
        self::bench(&[(3, 9), (19, 0x000F), (2, mode)]).check(&[("03 0013 0001", "03 02 000C")]);
    }
    bench(&[(2, 9), (18, 0x0F00), (3, 9), (3, 0)]).check(&[("03 0012 0001", "03 02 0F00")]);
}

/// Both channels are dampers in the mode Fire_Damper; rows of what is done, how long is waited, and
/// what discrete inputs 0 to 15 and coils 0 to 15 say then.
#[track_caller]
fn play(bench: &mut Bench, rows: &[(&str, u64, &str, &str)]) {
    for (number, (action, millis, inputs, coils)) in rows.iter().enumerate() {
        match action.split_once(' ') {
            Some(("write", request)) => bench.check(&[(request, request)]),
            Some(("connect", contacts)) => connect(bench, contacts),
            Some(_) => bench.act(action).expect("something to do"),
            None => {}
        }
        bench.wait(*millis);
        let told = [bench.ask("02 0000 0010"), bench.ask("01 0000 0010")];
        assert_eq!(told, [format!("0202{inputs}"), format!("0102{coils}")], "row {number}: {action}");
    }
}

#[test]
fn the_bus_and_the_hand_switch_a_fire_damper_every_100_ms_pages_21_and_26() {
    let mut bench = bench(&[(1, 2), (2, 6), (3, 6)]);
    play(
        &mut bench,
        &[
            ("write 05 0000 FF00", 99, "0000", "3000"),
            ("", 1, "0000", "3300"),
            ("connect 1001", 99, "0000", "3300"),
            ("", 1, "0900", "3300"),
            ("relay 2 hand off", 99, "0900", "3300"),
            ("", 1, "0900", "3900"),
            ("write 06 0000 0002", 100, "0900", "2800"),
            ("relay 2 hand automatic", 100, "0900", "2200"),
            // The default holds after a start only.
            ("write 06 0001 0001", 1000, "0900", "2200"),
            ("write 08 0001 0000", 0, "0900", "1000"),
            ("", 100, "0900", "1100"),
        ],
    );
}

#[test]
fn a_fire_damper_that_moves_too_long_is_a_fault_until_it_is_reset_page_26() {
    // 2 s to open, 1 s to close. Channel 2 stays closed, and right.
    let mut bench = bench(&[(2, 6), (3, 6), (4, 20), (6, 10)]);
    play(
        &mut bench,
        &[
            ("connect 0101", 2000, "0A00", "0000"),
            ("write 05 0000 FF00", 100, "0A00", "1100"),
            ("connect 00..", 1900, "0800", "1100"),
            // Fault_1 and FaultRun_1.
            ("", 100, "0805", "1100"),
            // Nothing else is found until it is reset, not even both contacts at once.
            ("connect 11..", 1000, "0B05", "1100"),
            ("connect 10..", 1000, "0905", "1100"),
            ("write 05 0008 FF00", 99, "0905", "1101"),
            ("", 1, "0900", "1100"),
            // Arrived; from now on it has to stay.
            ("connect 00..", 100, "0805", "1100"),
            // 0 has no function, neither after 1.
            ("write 06 0000 0101", 0, "0805", "1101"),
            ("write 06 0000 0001", 0, "0805", "1101"),
            ("write 05 0008 0000", 0, "0805", "1101"),
            ("", 100, "0800", "1100"),
            // What lasts is found again.
            ("", 100, "0805", "1100"),
            // Closing begins to measure anew, but the fault has to be reset all the same.
            ("write 05 0004 0000", 100, "0805", "0000"),
            ("write 05 0008 FF00", 100, "0800", "0000"),
            ("", 800, "0800", "0000"),
            ("", 100, "0805", "0000"),
            ("connect 01..", 1000, "0A05", "0000"),
            ("write 05 0008 FF00", 100, "0A00", "0000"),
            ("", 100_000, "0A00", "0000"),
        ],
    );
}

#[test]
fn the_position_is_not_looked_at_with_a_time_of_0_nor_while_a_hand_switches_page_26() {
    let mut bench = bench(&[(2, 6), (3, 6), (4, 0), (6, 10), (5, 10), (7, 0)]);
    play(
        &mut bench,
        &[
            // Channel 1 is looked at while its relay is off, channel 2 while its is on.
            ("", 900, "0000", "0000"),
            ("", 200, "0005", "0000"),
            ("write 06 0000 0103", 1000, "0000", "3300"),
            ("", 200, "000A", "3300"),
            ("write 06 0000 0200", 1000, "0000", "0000"),
            ("relay 1 hand on", 10_000, "0000", "0500"),
            ("relay 1 hand off", 10_000, "0000", "0400"),
            ("relay 2 hand on", 10_000, "0000", "0E00"),
            // Both contacts at once are found all the same.
            ("connect ..11", 100, "0C22", "0E00"),
        ],
    );
}

#[test]
fn both_contacts_of_a_fire_damper_at_once_are_a_fault_of_their_own_page_27() {
    let mut bench = bench(&[(2, 6), (3, 6), (4, 0), (5, 0), (6, 0), (7, 0)]);
    play(
        &mut bench,
        &[
            // Fault_1 and FaultMan_1, and then those of channel 2.
            ("connect 1100", 100, "0311", "0000"),
            ("connect ..11", 100, "0F33", "0000"),
            ("connect 1010", 1000, "0533", "0000"),
            ("write 06 0000 0300", 99, "0533", "0003"),
            ("", 1, "0500", "0000"),
        ],
    );
    // InputReg and the toggle bits have them as well: each has risen and fallen once.
    bench.check(&[("04 0000 0003", "04 06 0005 330F 330A")]);
}

#[test]
fn no_message_for_too_long_is_a_fault_of_a_fire_damper_page_27() {
    // 2 s for channel 1; channel 2 is not watched, and neither contacts nor times say anything else.
    let mut bench = bench(&[(2, 6), (3, 6), (4, 0), (5, 0), (6, 0), (7, 0), (8, 20)]);
    play(
        &mut bench,
        &[
            // The test's own questions are messages, too.
            ("", 1900, "0000", "0000"),
            ("", 1900, "0000", "0000"),
            // Fault_1 and FaultCom_1.
            ("", 2000, "0041", "0000"),
            ("write 05 0008 FF00", 100, "0000", "0000"),
            ("write 06 0008 0000", 100_000, "0000", "0000"),
        ],
    );
    // Only what is addressed to the device counts.
    write(&mut bench, 8, 20);
    bench.wait(1900);
    bench.send(Addressed::Broadcast, "05 0000 0000");
    bench.wait(100);
    bench.check(&[("02 0008 0008", "02 01 41")]);
}

#[test]
fn faults_are_fire_damper_s_alone_and_go_with_the_mode() {
    let mut bench = bench(&[(2, 6)]);
    play(
        &mut bench,
        &[
            ("connect 1111", 100, "0F11", "0000"),
            ("write 06 0002 0000", 0, "0F00", "0000"),
            ("write 05 0008 FF00", 100, "0F00", "0000"),
        ],
    );
}
