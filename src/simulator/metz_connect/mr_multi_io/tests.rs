//! MR-Multi I/O against its manual: requests and replies as bytes.

use crate::simulator::device::{Addressed, Model};
use crate::simulator::testing::Bench;

fn bench() -> Bench {
    Bench::new(Model::MrMultiIo)
}

#[track_caller]
fn act(bench: &mut Bench, command: &str) {
    bench.act(command).expect("a command for this device");
}

fn zeros(function: &str, count: usize) -> String {
    format!("{function}{:02X}{}", 2 * count, "0000".repeat(count))
}

#[test]
fn functions_reach_the_addresses_of_page_87_and_no_further() {
    bench().check(&[
        ("02 0000 0010", "02 02 0000"),
        ("02 000F 0001", "02 01 00"),
        ("02 0000 0011", "82 02"),
        ("02 0010 0001", "82 02"),
        ("02 0000 0000", "82 03"),
        ("01 0000 0030", "01 06 000000000000"),
        ("01 002F 0001", "01 01 00"),
        ("01 0000 0031", "81 02"),
        ("01 0030 0001", "81 02"),
        ("01 0000 07D1", "81 03"),
        ("05 002F FF00", "05 002F FF00"),
        ("05 0030 FF00", "85 02"),
        ("05 0000 0001", "85 03"),
        ("0F 0000 0030 06 000000000000", "0F 0000 0030"),
        ("0F 002F 0002 01 03", "8F 02"),
        ("04 0042 0022", &zeros("04", 34)),
        ("04 0063 0001", &zeros("04", 1)),
        ("04 0000 0065", "84 02"),
        ("04 0064 0001", "84 02"),
        ("04 0000 007E", "84 03"),
        ("03 0000 0041", &zeros("03", 65)),
        ("03 0063 0001", &zeros("03", 1)),
        ("03 0000 0065", "83 02"),
        ("03 0064 0001", "83 02"),
        ("03 0000 007E", "83 03"),
        ("06 0063 1234", "06 0063 1234"),
        ("06 0064 1234", "86 02"),
        ("10 0060 0004 08 0001 0002 0003 0004", "10 0060 0004"),
        ("10 0063 0002 04 0001 0002", "90 02"),
    ]);
}

#[test]
fn settings_leave_the_factory_as_pages_87_to_98_say() {
    bench().check(&[(
        "03 0041 0023",
        &format!("03 46 0015 {} 0001 0001 0001 0000 0701 0001 {}", "0000".repeat(24), "0000".repeat(4)),
    )]);
}

#[test]
fn what_means_nothing_or_is_only_read_takes_a_write_without_effect_page_87() {
    let mut bench = bench();
    for register in [14, 15, 23, 64, 67, 69, 70, 72, 76, 77, 80, 81, 96, 99] {
        bench.check(&[
            (&format!("06 {register:04X} FFFF"), &format!("06 {register:04X} FFFF")),
            (&format!("03 {register:04X} 0001"), "03 02 0000"),
        ]);
    }
    // All coils at once: of them 0 to 7 and 32 are for writing.
    bench.check(&[
        ("0F 0000 0030 06 FFFFFFFFFFFF", "0F 0000 0030"),
        ("01 0000 0030", "01 06 FF0000000100"),
        ("05 0010 FF00", "05 0010 FF00"),
        ("01 0010 0004", "01 01 00"),
    ]);
}

#[test]
fn register_65_is_changed_alone_and_left_in_peace_among_others_page_3() {
    bench().check(&[
        ("03 0041 0001", "03 02 0015"),
        ("06 0041 0035", "86 03"),
        ("06 0041 5338", "06 0041 5338"),
        ("03 0040 0003", "03 06 0000 0038 0000"),
        ("10 0041 0002 04 5315 0007", "10 0041 0002"),
        ("03 0041 0002", "03 04 0038 0007"),
    ]);
}

#[test]
fn digital_inputs_are_discrete_inputs_and_register_70_of_both_kinds_page_89() {
    let mut bench = bench();
    act(&mut bench, "input 1 contact closed");
    act(&mut bench, "input 11 contact closed");
    act(&mut bench, "input 12 contact closed");
    bench.check(&[
        ("02 0000 0010", "02 02 010C"),
        ("02 000A 0002", "02 01 03"),
        ("03 0046 0001", "03 02 0C01"),
        ("04 0046 0001", "04 02 0C01"),
    ]);
    act(&mut bench, "input 11 contact open");
    act(&mut bench, "input 12 contact open");
    bench.check(&[("02 0000 0010", "02 02 0100")]);
    for command in
        ["input 13 contact closed", "input 0 contact open", "input 1 pulses 5", "input 11 counter 5"]
    {
        assert!(bench.act(command).is_err(), "{command}");
    }
}

#[test]
fn digital_outputs_are_coils_0_to_7_and_register_71_page_89() {
    let mut bench = bench();
    bench.check(&[
        ("05 0003 FF00", "05 0003 FF00"),
        ("0F 0004 0004 01 09", "0F 0004 0004"),
        ("01 0000 0010", "01 02 9800"),
        ("03 0047 0001", "03 02 0098"),
        ("06 0047 FF41", "06 0047 FF41"),
        ("01 0000 0010", "01 02 4100"),
        ("03 0047 0001", "03 02 0041"),
    ]);
    for (output, state) in
        [("relay_1", "ON"), ("relay_4", "OFF"), ("photomos_3", "ON"), ("photomos_4", "OFF")]
    {
        assert_eq!(bench.output(output), state, "{output}");
    }
}

#[test]
fn a_relay_switched_by_hand_says_so_and_does_not_obey_the_bus_page_89() {
    let mut bench = bench();
    act(&mut bench, "relay 1 hand on");
    act(&mut bench, "relay 4 hand off");
    bench.check(&[
        ("06 0047 00FE", "06 0047 00FE"),
        ("01 0000 0008", "01 01 F7"),
        ("03 0047 0002", "03 04 00F7 0009"),
        ("01 0010 0010", "01 02 0900"),
    ]);
    assert_eq!((bench.output("relay_1"), bench.output("hand_1")), ("ON".into(), "ON".into()));
    assert_eq!((bench.output("relay_4"), bench.output("hand_2")), ("OFF".into(), "OFF".into()));
    // What the bus last wrote waits.
    act(&mut bench, "relay 1 hand automatic");
    act(&mut bench, "relay 4 hand automatic");
    bench.check(&[("03 0047 0002", "03 04 00FE 0000")]);
    for command in ["relay 0 hand on", "relay 5 hand on"] {
        assert!(bench.act(command).is_err(), "{command}");
    }
}

#[test]
fn a_long_press_changes_a_relay_s_mode_and_a_short_one_switches_it_by_hand_page_89() {
    let mut bench = bench();
    bench.check(&[("06 0047 0022", "06 0047 0022")]);
    // The states of the relays and which a hand has switched, after each press of the second's button.
    for (press, states, by_hand) in [
        // In automatic operation a short press does nothing.
        ("0.5s", 0x22, 0),
        ("1001ms", 0x22, 2),
        ("0.5s", 0x20, 2),
        ("1s", 0x22, 2),
        ("999ms", 0x20, 2),
        // What the bus says rules again, and hand operation begins with it.
        ("2s", 0x22, 0),
        ("2s", 0x22, 2),
    ] {
        act(&mut bench, &format!("relay 2 press {press}"));
        bench.check(&[("03 0047 0002", &format!("03 04 {states:04X} {by_hand:04X}"))]);
    }
    // The bus switches it off behind the hand's back.
    bench.check(&[("06 0047 0000", "06 0047 0000"), ("03 0047 0001", "03 02 0002")]);
    act(&mut bench, "relay 2 press 2s");
    act(&mut bench, "relay 2 press 2s");
    bench.check(&[("03 0047 0002", "03 04 0000 0002")]);
    assert!(bench.act("relay 5 press 2s").is_err());
}

#[test]
fn analog_outputs_give_10_24_volts_at_32767_page_90() {
    let mut bench = bench();
    bench.check(&[
        ("10 004A 0002 04 3E80 7FFF", "10 004A 0002"),
        ("03 004A 0002", "03 04 3E80 7FFF"),
        // They are no input registers.
        ("04 004A 0002", "04 04 0000 0000"),
    ]);
    assert_eq!((bench.output("output_1"), bench.output("output_2")), ("5.000 V".into(), "10.240 V".into()));
    bench.check(&[("06 004A FFFF", "06 004A FFFF"), ("03 004A 0001", "03 02 FFFF")]);
    assert_eq!(bench.output("output_1"), "0.000 V");
}

#[test]
fn a_watchdog_that_no_message_feeds_puts_the_outputs_to_their_defaults_and_lights_red_page_87() {
    let mut bench = bench();
    bench.check(&[
        ("06 0047 000F", "06 0047 000F"),
        ("06 0049 0082", "06 0049 0082"),
        ("10 004A 0006 0C 0001 0002 0000 0000 0064 00C8", "10 004A 0006"),
        ("06 0042 0032", "06 0042 0032"),
    ]);
    act(&mut bench, "relay 1 hand on");
    bench.wait(499);
    // Even a message that is refused feeds it; one to others does not.
    bench.check(&[("2B 0E 04 00", "AB 03")]);
    bench.wait(499);
    assert_eq!((bench.output("relay_3"), bench.output("red_light")), ("ON".into(), "OFF".into()));
    bench.send(Addressed::Broadcast, "06 0047 0001");
    bench.wait(1);
    assert_eq!((bench.output("relay_2"), bench.output("red_light")), ("ON".into(), "ON".into()));
    bench.check(&[("03 0047 0001", "03 02 0083"), ("03 004A 0002", "03 04 0064 00C8")]);
    // The message has fed it, and what is written now stays.
    assert_eq!(bench.output("red_light"), "OFF");
    bench.check(&[("06 0047 0010", "06 0047 0010")]);
    bench.wait(499);
    bench.check(&[("03 0047 0001", "03 02 0011"), ("06 0042 0000", "06 0042 0000")]);
    bench.wait(1_000_000);
    bench.check(&[("03 0047 0001", "03 02 0011")]);
    // "655,35 Sekunden".
    bench.check(&[("06 0042 FFFF", "06 0042 FFFF")]);
    bench.wait(655_349);
    assert_eq!(bench.output("red_light"), "OFF");
    bench.wait(1);
    assert_eq!(bench.output("red_light"), "ON");
}

/// Writes the code of an input, connects `signal`, waits until all have been measured and reads.
#[track_caller]
fn check_value(input: u16, code: u16, signal: &str, words: &str) {
    let mut bench = bench();
    bench.ask(&format!("06 {:04X} {code:04X}", 15 + input));
    act(&mut bench, &format!("input {input} {signal}"));
    bench.wait(1800);
    bench.check(&[(&format!("04 {:04X} 0002", 2 * input - 2), &format!("04 04 {words}"))]);
}

#[test]
fn the_code_decides_what_is_measured_and_how_it_is_told_pages_93_and_94() {
    for input in 1..=6 {
        check_value(input, 0x00, "volts 2.5", "4020 0000");
        check_value(input, 0x01, "volts 2.5", "1F40 0000");
    }
    // The float goes on to 11.5 V, the integer ends at 10.24 V.
    check_value(1, 0x00, "volts 11.25", "4134 0000");
    check_value(1, 0x00, "volts 12", "4138 0000");
    check_value(1, 0x01, "volts 10.24", "7FFF 0000");
    check_value(1, 0x01, "volts 11.25", "7FFF 0000");
    check_value(1, 0x20, "open", "40A0 0000");
    check_value(1, 0x21, "ohms 2000", "1F40 0000");
    check_value(2, 0x40, "ohms 107.8", "42D7 999A");
    check_value(2, 0x40, "open", "4A74 2400");
    check_value(2, 0x41, "ohms 3276.7", "7FFF 0000");
    check_value(2, 0x42, "ohms 32767", "7FFF 0000");
    check_value(2, 0x43, "ohms 100000", "2710 0000");
    check_value(2, 0x44, "ohms 1000000", "2710 0000");
    check_value(3, 0x80, "ohms 100", "0000 0000");
    check_value(4, 0x83, "ohms 500", "0000 0000");
    check_value(5, 0x85, "ohms 1077.94", "00C8 0000");
    check_value(6, 0x99, "volts 2.9815", "00FA 0000");
    check_value(6, 0x97, "ohms 20000", "00FA 0000");
    check_value(6, 0x81, "celsius -60", "FE0C 0000");
}

#[test]
fn input_i_measures_milliamperes_where_0_and_1_mean_volts_elsewhere_page_93() {
    check_value(7, 0x00, "milliamps 12.5", "4148 0000");
    check_value(7, 0x00, "milliamps 25", "41B0 0000");
    // 1600 steps to a milliampere.
    check_value(7, 0x01, "milliamps 10", "3E80 0000");
    check_value(7, 0x01, "milliamps 20.48", "7FFF 0000");
    check_value(7, 0x01, "milliamps 22", "7FFF 0000");
    check_value(7, 0x01, "open", "0000 0000");
    let mut bench = bench();
    for command in [
        "input 7 volts 5",
        "input 7 ohms 100",
        "input 7 celsius 20",
        "input 1 milliamps 5",
        "input 8 volts 1",
    ] {
        assert!(bench.act(command).is_err(), "{command}");
    }
}

#[test]
fn codes_are_those_of_pages_93_and_94_and_a_request_with_another_writes_nothing() {
    let mut bench = bench();
    let tabled: Vec<u16> =
        [0, 1, 32, 33].into_iter().chain(64..=68).chain(128..=153).chain(240..=251).collect();
    for code in (0..=0x1FF).chain([0x8000, 0xFFFF]) {
        let told = |is_known| if is_known { format!("06 0010 {code:04X}") } else { "86 03".to_string() };
        bench.check(&[(&format!("06 0010 {code:04X}"), &told(tabled.contains(&code)))]);
        let told = told(code <= 1).replace("0010", "0016");
        bench.check(&[(&format!("06 0016 {code:04X}"), &told)]);
    }
    bench.check(&[
        ("10 0010 0007 0E 0080 0081 0082 0083 0084 0085 0001", "10 0010 0007"),
        ("10 0010 0007 0E 0000 0000 0000 0000 0000 0000 0080", "90 03"),
        ("10 0014 0002 04 0000 009A", "90 03"),
        ("03 0010 0007", "03 0E 0080 0081 0082 0083 0084 0085 0001"),
    ]);
}

#[test]
fn each_input_is_measured_every_1_8_seconds_one_after_the_other_page_91() {
    let mut bench = bench();
    for input in 1..=6 {
        act(&mut bench, &format!("input {input} volts 1"));
    }
    act(&mut bench, "input 7 milliamps 1");
    let (one, none) = ("3F800000", "00000000");
    for measured in 0..=7 {
        let text = format!("04 1C {}{}", one.repeat(measured), none.repeat(7 - measured));
        bench.check(&[("04 0000 000E", &text)]);
        bench.wait(199);
        bench.check(&[("04 0000 000E", &text)]);
        bench.wait(1);
    }
    // 1.6 s have passed; input 1 is measured at 2.0 s and at 3.8 s.
    act(&mut bench, "input 1 volts 2");
    bench.wait(399);
    bench.check(&[("04 0000 0002", "04 04 3F80 0000")]);
    bench.wait(1);
    bench.check(&[("04 0000 0002", "04 04 4000 0000")]);
    act(&mut bench, "input 1 volts 1");
    bench.wait(1799);
    bench.check(&[("04 0000 0002", "04 04 4000 0000")]);
    bench.wait(1);
    bench.check(&[("04 0000 0002", "04 04 3F80 0000")]);
}

#[test]
fn an_offset_of_the_values_own_type_is_added_and_kept_page_92() {
    let mut bench = bench();
    bench.check(&[
        ("10 0010 0002 04 0080 0081", "10 0010 0002"),
        ("10 0000 0004 08 3FC0 0000 FFF6 0000", "10 0000 0004"),
        ("06 0016 0001", "06 0016 0001"),
        ("06 000C 0064", "06 000C 0064"),
    ]);
    act(&mut bench, "input 1 celsius 20");
    act(&mut bench, "input 2 celsius 20");
    act(&mut bench, "input 7 milliamps 1");
    let told = [("04 0000 0004", "04 08 41AC 0000 00BE 0000"), ("04 000C 0001", "04 02 06A4")];
    bench.wait(1800);
    bench.check(&told);
    bench.check(&[("08 0001 0000", "08 0001 0000"), ("04 0000 0002", "04 04 0000 0000")]);
    bench.wait(1800);
    bench.check(&told);
}

#[test]
fn register_68_and_coil_32_tell_temperatures_in_fahrenheit_but_not_those_of_the_table_page_88() {
    let mut bench = bench();
    // Input 1 PT100, input 2 by the table: 0 °C at 1000 Ω, 100 °C at 2000 Ω.
    bench.check(&[
        ("10 0018 0008 10 0000 0000 447A 0000 42C8 0000 44FA 0000", "10 0018 0008"),
        ("10 0010 0003 06 0080 00F8 0081", "10 0010 0003"),
        ("05 0020 FF00", "05 0020 FF00"),
        ("03 0044 0001", "03 02 0001"),
    ]);
    act(&mut bench, "input 1 celsius 100");
    act(&mut bench, "input 2 ohms 1250");
    act(&mut bench, "input 3 celsius 10");
    bench.wait(1800);
    bench.check(&[
        ("04 0000 0006", "04 0C 4354 0000 41C8 0000 01F4 0000"),
        ("06 0044 0000", "06 0044 0000"),
        ("01 0020 0001", "01 01 00"),
    ]);
    bench.wait(1800);
    bench.check(&[("04 0000 0006", "04 0C 42C8 0000 41C8 0000 0064 0000")]);
}

#[test]
fn the_time_that_s0_is_closed_is_counted_in_seconds_page_96() {
    let mut bench = bench();
    act(&mut bench, "input 12 contact closed");
    bench.wait(1999);
    bench.check(&[("03 0052 0002", "03 04 0000 0001"), ("04 0052 0002", "04 04 0000 0001")]);
    act(&mut bench, "input 12 contact open");
    bench.wait(60_000);
    bench.check(&[("03 0052 0002", "03 04 0000 0001")]);
    act(&mut bench, "input 12 contact closed");
    bench.wait(1);
    bench.check(&[("03 0052 0002", "03 04 0000 0002")]);
    // Writing sets the seconds, and the milliseconds to 0.
    bench.wait(999);
    bench.check(&[("10 0052 0002 04 0001 FFFF", "10 0052 0002")]);
    bench.wait(999);
    bench.check(&[("04 0052 0002", "04 04 0001 FFFF")]);
    bench.wait(1);
    bench.check(&[("04 0052 0002", "04 04 0002 0000"), ("06 0052 0000", "06 0052 0000")]);
    bench.wait(1000);
    bench.check(&[("04 0052 0002", "04 04 0000 0001"), ("06 0053 FFFF", "06 0053 FFFF")]);
    bench.check(&[("06 0052 FFFF", "06 0052 FFFF")]);
    bench.wait(1000);
    bench.check(&[("03 0052 0002", "03 04 0000 0000")]);
    // A pulse closes the contact for 30 ms.
    act(&mut bench, "input 12 contact open");
    bench.check(&[("10 0052 0002 04 0000 0000", "10 0052 0002")]);
    act(&mut bench, "input 12 pulses 100 every 80ms");
    bench.wait(99 * 80 + 29);
    bench.check(&[("03 0052 0002", "03 04 0000 0002")]);
    bench.wait(1);
    bench.check(&[("03 0052 0002", "03 04 0000 0003")]);
    bench.wait(100_000);
    bench.check(&[("03 0052 0002", "03 04 0000 0003")]);
}

#[test]
fn without_power_no_time_is_counted_and_the_parts_of_a_second_are_lost_page_96() {
    let mut bench = bench();
    act(&mut bench, "input 12 contact closed");
    bench.wait(3999);
    bench.check(&[("03 0052 0002", "03 04 0000 0003")]);
    // Nobody asks, and the device is started anew: it had no power.
    bench.wait(60_000);
    act(&mut bench, "restart");
    bench.wait(999);
    bench.check(&[("03 0052 0002", "03 04 0000 0003")]);
    bench.wait(1);
    bench.check(&[("03 0052 0002", "03 04 0000 0004")]);
}

#[test]
fn the_watchdog_begins_anew_with_a_restart_page_87() {
    let mut bench = bench();
    bench.check(&[("06 0042 0032", "06 0042 0032")]);
    bench.wait(600);
    assert_eq!(bench.output("red_light"), "ON");
    act(&mut bench, "restart");
    assert_eq!(bench.output("red_light"), "OFF");
    bench.wait(499);
    assert_eq!(bench.output("red_light"), "OFF");
    bench.wait(1);
    assert_eq!(bench.output("red_light"), "ON");
}

#[test]
fn the_counter_has_48_bits_in_four_registers_page_97() {
    let mut bench = bench();
    act(&mut bench, "input 12 counter 281474976710655");
    bench.check(&[
        ("04 0054 0004", "04 08 0000 FFFF FFFF FFFF"),
        // Nobody writes the counter itself: the same holding registers are IT.
        ("03 0054 0004", "03 08 0000 0000 0000 0000"),
        ("10 0054 0004 08 FFFF 1234 5678 9ABC", "10 0054 0004"),
        ("03 0054 0004", "03 08 0000 1234 5678 9ABC"),
        ("06 0056 0001", "06 0056 0001"),
        ("03 0054 0004", "03 08 0000 1234 0001 9ABC"),
        ("04 0054 0004", "04 08 0000 FFFF FFFF FFFF"),
    ]);
    act(&mut bench, "input 12 contact closed");
    bench.check(&[("04 0054 0004", "04 08 0000 0000 0000 0000")]);
    assert_eq!(bench.output("counter"), "0");
    act(&mut bench, "input 12 contact open");
    bench.wait(60);
    act(&mut bench, "input 12 pulses 10 every 60ms");
    bench.wait(599);
    bench.check(&[("04 0057 0001", "04 02 000A"), ("02 000B 0001", "02 01 00")]);
    assert!(bench.act("input 12 ohms 5").is_err());
}

#[test]
fn the_button_copies_the_counter_where_its_flag_is_set_pages_97_and_98() {
    let mut bench = bench();
    act(&mut bench, "input 12 counter 78187493530");
    act(&mut bench, "button");
    bench.check(&[("03 0054 0004", "03 08 0000 0012 3456 789A"), ("06 005F FFFE", "06 005F FFFE")]);
    act(&mut bench, "input 12 counter 5");
    act(&mut bench, "button");
    bench.check(&[("03 0054 0004", "03 08 0000 0012 3456 789A"), ("03 005F 0001", "03 02 0000")]);
}

#[test]
fn settings_of_the_counter_are_limited_page_98() {
    bench().check(&[
        ("10 005A 0006 0C 07D0 0028 00C8 FFFF 0A04 FFFF", "10 005A 0006"),
        ("03 005A 0006", "03 0C 07D0 0028 00C8 0001 0903 0001"),
        ("10 0058 0002 04 0001 E240", "10 0058 0002"),
        ("03 0058 0002", "03 04 0001 E240"),
        ("06 0059 0007", "06 0059 0007"),
        ("03 0058 0002", "03 04 0001 0007"),
    ]);
}

/// Sets IZ, IT, AZ and then IE, WI, WU, WP and ZS, and compares BZ.
#[track_caller]
fn check_reading(counter: u64, at_button: u64, initial: u32, settings: [u16; 5], reading: u32) {
    let mut bench = bench();
    act(&mut bench, &format!("input 12 counter {counter}"));
    let settings: String = settings.iter().map(|word| format!("{word:04X}")).collect();
    let request = format!("10 0054 000B 16 {at_button:016X} {initial:08X} {settings}");
    bench.check(&[(&request, "10 0054 000B"), ("04 0058 0002", &format!("04 04 {reading:08X}"))]);
}

#[test]
fn the_calculated_reading_follows_the_details_of_the_calculation_page_101() {
    // 2000 pulses are a kWh, with one decimal: 1.5 more than the 12345.6 at the start.
    check_reading(4000, 1000, 123_456, [2000, 1, 1, 0, 0x0701], 123_471);
    // The division comes behind the multiplications, and cuts off.
    check_reading(4199, 1000, 123_456, [2000, 1, 1, 0, 0x0701], 123_471);
    check_reading(4200, 1000, 123_456, [2000, 1, 1, 0, 0x0701], 123_472);
    check_reading(1001, 1000, 0, [2000, 40, 200, 0, 0x0700], 4);
    // 200/5 A is 40, 20000/100 V is 200 (page 100). WP decides whether AZ is multiplied.
    check_reading(4000, 1000, 7, [2000, 40, 200, 0, 0x0901], 15 * 8000 + 7 * 8000);
    check_reading(4000, 1000, 7, [2000, 40, 200, 1, 0x0901], 15 * 8000 + 7);
    // It begins again at 0 as often as the meter does.
    check_reading(12_345_678, 0, 0, [1, 1, 1, 0, 0x0701], 3_456_780);
    // Nothing overflows on the way: 2^48 - 1 pulses, all factors and three decimals.
    let wide =
        (0xFFFF_FFFF_FFFFu128 * 65535 * 65535 * 1000 / 7 + 0xFFFF_FFFFu128 * 65535 * 65535) % 1_000_000_000;
    check_reading(0xFFFF_FFFF_FFFF, 0, u32::MAX, [7, 65535, 65535, 0, 0x0903], wide as u32);
    // The counter that can be cleared: AZ = 0 and IT = IZ give 0 (page 101).
    check_reading(987_654, 987_654, 0, [1, 1, 1, 0, 0x0700], 0);
    check_reading(987_660, 987_654, 100, [1, 1, 1, 0, 0x0700], 106);
}

#[test]
fn everything_that_is_marked_outlives_a_restart_and_outputs_take_their_defaults_pages_87_to_98() {
    let mut bench = bench();
    bench.check(&[
        (
            "10 0000 000E 1C 0001 0002 0003 0004 0005 0006 0007 0008 0009 000A 000B 000C 000D 000E",
            "10 0000 000E",
        ),
        ("10 0010 0007 0E 0080 0081 0082 0083 0084 0085 0001", "10 0010 0007"),
        ("06 0018 1234", "06 0018 1234"),
        ("06 003F 4321", "06 003F 4321"),
        ("06 0042 1000", "06 0042 1000"),
        ("06 0044 0001", "06 0044 0001"),
        ("06 0047 0003", "06 0047 0003"),
        ("06 0049 00F4", "06 0049 00F4"),
        ("10 004A 0006 0C 0001 0002 0000 0000 0064 00C8", "10 004A 0006"),
        (
            "10 0052 000E 1C 0001 0002 0000 1111 2222 3333 0004 0005 0006 0007 0008 0001 0902 0000",
            "10 0052 000E",
        ),
    ]);
    act(&mut bench, "input 12 counter 281474976710654");
    act(&mut bench, "relay 2 hand on");
    act(&mut bench, "relay 3 hand off");
    let kept = bench.device.eeprom();
    let mut other = self::bench();
    other.device.load_eeprom(other.now, &kept).expect("an EEPROM of the same device");
    bench.check(&[("08 0001 0000", "08 0001 0000")]);
    for bench in [&mut bench, &mut other] {
        bench.check(&[
            ("03 0000 000E", "03 1C 0001 0002 0003 0004 0005 0006 0007 0008 0009 000A 000B 000C 000D 000E"),
            ("03 0010 0007", "03 0E 0080 0081 0082 0083 0084 0085 0001"),
            ("03 0018 0001", "03 02 1234"),
            ("03 003F 0001", "03 02 4321"),
            ("03 0042 0001", "03 02 1000"),
            ("03 0044 0001", "03 02 0001"),
            // The modes are stored; to what a hand had switched is not, and is the default then.
            ("03 0047 0003", "03 06 00F4 0006 00F4"),
            ("03 004A 0006", "03 0C 0064 00C8 0000 0000 0064 00C8"),
            ("03 0052 000E", "03 1C 0001 0002 0000 1111 2222 3333 0004 0005 0006 0007 0008 0001 0902 0000"),
            ("04 0054 0004", "04 08 0000 FFFF FFFF FFFE"),
        ]);
    }
}
