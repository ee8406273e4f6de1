//! MR-LD6 against its manual: requests and replies as bytes, on simulated time.

use crate::simulator::device::{Addressed, Model};
use crate::simulator::testing::Bench;

/// Six dry sensors on whole cables.
fn bench() -> Bench {
    let mut bench = Bench::new(Model::MrLd6);
    for input in 1..=6 {
        bench.act(&format!("input {input} ohms 1000000")).expect("a sensor");
    }
    bench
}

/// Wets these sensors and dries the others.
#[track_caller]
fn wet(bench: &mut Bench, inputs: &[u8]) {
    for input in 1..=6 {
        let ohms = if inputs.contains(&input) { 5000 } else { 1_000_000 };
        bench.act(&format!("input {input} ohms {ohms}")).expect("a sensor");
    }
}

#[track_caller]
fn write(bench: &mut Bench, register: u16, word: u16) {
    let write = format!("06 {register:04X} {word:04X}");
    bench.check(&[(&write, &write)]);
}

/// Both relays in one byte, as coils, as a register and to the eye.
#[track_caller]
fn relays(bench: &mut Bench, on: u8) {
    bench.check(&[
        ("01 0000 0002", &format!("01 01 {on:02X}")),
        ("03 0000 0001", &format!("03 02 00{on:02X}")),
    ]);
    for relay in 1..=2 {
        let state = if on >> (relay - 1) & 1 == 1 { "ON" } else { "OFF" };
        assert_eq!(bench.output(&format!("relay_{relay}")), state, "relay {relay}");
    }
}

#[test]
fn addresses_end_where_the_list_of_page_103_has_them_end_and_hold_0_between_the_tables() {
    bench().check(&[
        ("01 0000 0020", "01 04 00000000"),
        ("01 001F 0001", "01 01 00"),
        ("01 001F 0002", "81 02"),
        ("01 0000 0021", "81 03"),
        ("01 0000 0000", "81 03"),
        ("02 0000 0020", "02 04 00000000"),
        ("02 0010 0006", "02 01 00"),
        ("02 0020 0001", "82 02"),
        ("02 0000 0021", "82 03"),
        ("05 001F FF00", "05 001F FF00"),
        ("05 0000 FF01", "85 03"),
        ("05 0020 FF00", "85 02"),
        ("0F 0000 0020 04 FFFFFFFF", "0F 0000 0020"),
        ("0F 001F 0002 01 03", "8F 02"),
        ("01 0000 0020", "01 04 00000000"),
        ("04 000E 0002", "04 04 0000 0000"),
        ("04 0063 0001", "04 02 0000"),
        ("04 0063 0002", "84 02"),
        ("04 0064 0001", "84 02"),
        ("04 0000 007E", "84 03"),
        ("03 0025 0002", "03 04 0000 0000"),
        ("03 0063 0001", "03 02 0000"),
        ("03 0064 0001", "83 02"),
        ("03 0000 0065", "83 02"),
        ("03 0000 007E", "83 03"),
        ("06 0025 1234", "06 0025 1234"),
        ("06 0064 1234", "86 02"),
        ("10 0062 0003 06 0001 0002 0003", "90 02"),
        ("10 0041 0003 06 0001 0002 0003", "10 0041 0003"),
        ("03 0025 0001", "03 02 0000"),
        ("03 0040 0004", "03 08 0000 0000 0002 0000"),
    ]);
}

#[test]
fn the_settings_leave_the_factory_as_pages_104_to_108_say() {
    let threshold = |word: &str| word.repeat(6);
    bench().check(&[
        (
            "03 0000 0025",
            &format!(
                "03 4A 0000 0000 {} {} 0000 0000 0007 0038 003F 0000 0000 {}",
                threshold("00C8"),
                threshold("006E"),
                "0000".repeat(16)
            ),
        ),
        ("03 0042 0001", "03 02 0000"),
    ]);
}

#[test]
fn only_the_bits_that_the_tables_name_are_kept_pages_107_and_108() {
    let mut bench = bench();
    for (register, kept) in [
        (1, 0x0003),
        (2, 0xFFFF),
        (13, 0xFFFF),
        (14, 0xFFFF),
        (16, 0x003F),
        (17, 0x003F),
        (18, 0x003F),
        (19, 0x003F),
        (20, 0x003F),
        (21, 0x01FF),
        (36, 0x01FF),
        (66, 0xFFFF),
    ] {
        write(&mut bench, register, 0xFFFF);
        bench.check(&[(&format!("03 {register:04X} 0001"), &format!("03 02 {kept:04X}"))]);
    }
}

#[test]
fn resistances_count_in_100_ohms_up_to_10000_and_voltages_in_100_millivolts_page_105() {
    let mut bench = Bench::new(Model::MrLd6);
    let rows = [
        ("input 1 ohms 0", "0000", "0064"),
        ("input 2 ohms 20000", "00C8", "0064"),
        ("input 3 ohms 1000000", "2710", "0064"),
        ("input 4 ohms 5000000", "2710", "0064"),
        ("input 5 volts 8.25", "2710", "0053"),
        ("input 6 volts 0", "2710", "0000"),
    ];
    for (command, resistance, voltage) in rows {
        let input: u16 = command[6..7].parse().expect("a number");
        let read = |register: u16| format!("04 {register:04X} 0001");
        let word = |word: &str| format!("04 02 {word}");
        bench.check(&[(&read(input + 1), &word("2710")), (&read(input + 7), &word("00A0"))]);
        bench.act(command).expect("a sensor");
        bench.check(&[(&read(input + 1), &word(resistance)), (&read(input + 7), &word(voltage))]);
    }
    bench.check(&[(
        "04 0000 000E",
        "04 1C 0001 0000 0000 00C8 2710 2710 2710 2710 0064 0064 0064 0064 0053 0000",
    )]);
    // A sensor's two sides are told apart.
    bench.act("input 6 ohms 300").expect("a sensor");
    bench.act("input 2 volts 6.2").expect("a sensor");
    bench.check(&[("04 0007 0001", "04 02 0003"), ("04 000D 0001", "04 02 0000")]);
    bench.check(&[("04 0003 0001", "04 02 00C8"), ("04 0009 0001", "04 02 003E")]);
    bench.act("input 6 open").expect("no sensor");
    bench.check(&[("04 0007 0001", "04 02 2710"), ("04 000D 0001", "04 02 00A0")]);
}

#[test]
fn a_leak_comes_below_95_percent_of_the_threshold_and_goes_above_105_page_104() {
    let mut bench = bench();
    // 20 kΩ for input 1, 1 kΩ for input 6: 950 Ω and 1050 Ω lie between two steps of 100 Ω.
    write(&mut bench, 7, 10);
    for (input, ohms, leaks) in [
        (1, 19_000, 0x00),
        (1, 18_900, 0x01),
        (1, 19_100, 0x01),
        (1, 21_000, 0x01),
        (1, 21_100, 0x00),
        (1, 19_000, 0x00),
        (1, 0, 0x01),
        (6, 1000, 0x01),
        (6, 900, 0x21),
        (6, 1000, 0x21),
        (6, 1100, 0x01),
        (1, 1_000_000, 0x00),
    ] {
        bench.act(&format!("input {input} ohms {ohms}")).expect("a sensor");
        let bits = format!("{leaks:02X}");
        bench.check(&[
            ("02 0000 0006", &format!("02 01 {bits}")),
            ("04 0000 0001", &format!("04 02 00{bits}")),
        ]);
    }
    // Another threshold is compared at once.
    bench.act("input 2 ohms 50000").expect("a sensor");
    write(&mut bench, 3, 527);
    bench.check(&[("04 0000 0001", "04 02 0002")]);
    write(&mut bench, 3, 476);
    bench.check(&[("04 0000 0001", "04 02 0000")]);
    write(&mut bench, 3, 0);
    bench.act("input 2 ohms 0").expect("a sensor");
    bench.check(&[("04 0000 0001", "04 02 0000")]);
}

#[test]
fn a_cable_breaks_above_102_5_percent_of_the_threshold_and_is_whole_below_97_5_page_104() {
    let mut bench = bench();
    // 11 V for input 2, 6 V for input 5, whose 6.15 V and 5.85 V lie between two steps of 100 mV.
    write(&mut bench, 12, 60);
    bench.act("input 5 volts 5").expect("a sensor");
    // And 20 V for input 6, whose 20.5 V and 19.5 V are such steps.
    write(&mut bench, 13, 200);
    for (input, volts, breaks) in [
        (2, "11.2", 0x00),
        (2, "11.3", 0x02),
        (2, "11.0", 0x02),
        (2, "10.8", 0x02),
        (2, "10.7", 0x00),
        (2, "11.2", 0x00),
        (5, "6.1", 0x00),
        (5, "6.2", 0x10),
        (5, "5.9", 0x10),
        (5, "5.8", 0x00),
        (6, "20.5", 0x00),
        (6, "20.6", 0x20),
        (6, "19.5", 0x20),
        (6, "19.4", 0x00),
    ] {
        bench.act(&format!("input {input} volts {volts}")).expect("a sensor");
        let bits = format!("{breaks:02X}");
        bench.check(&[
            ("02 0010 0006", &format!("02 01 {bits}")),
            ("02 0000 0018", &format!("02 03 0000{bits}")),
            ("04 0001 0001", &format!("04 02 00{bits}")),
        ]);
    }
}

#[test]
fn only_inputs_of_zener_enable_tell_a_broken_cable_page_107() {
    let mut bench = Bench::new(Model::MrLd6);
    bench.check(&[("04 0000 0002", "04 04 0000 003F")]);
    write(&mut bench, 18, 0b10_0101);
    bench.check(&[("04 0001 0001", "04 02 0025"), ("02 0010 0006", "02 01 25")]);
    bench.act("input 3 ohms 1000000").expect("a sensor");
    bench.check(&[("04 0001 0001", "04 02 0021")]);
    write(&mut bench, 18, 0b11_1111);
    bench.check(&[("04 0001 0001", "04 02 003B")]);
}

#[test]
fn a_relay_reports_the_leaks_of_its_own_sensors_pages_105_and_107() {
    let mut bench = bench();
    for (inputs, on) in [(&[][..], 0), (&[1], 1), (&[2, 3], 1), (&[4], 2), (&[5], 2), (&[3, 6], 3), (&[], 0)]
    {
        wet(&mut bench, inputs);
        relays(&mut bench, on);
    }
    write(&mut bench, 16, 0b10_0000);
    write(&mut bench, 17, 0b10_0001);
    for (inputs, on) in [(&[1][..], 2), (&[2, 3, 4, 5], 0), (&[6], 3)] {
        wet(&mut bench, inputs);
        relays(&mut bench, on);
    }
}

#[test]
fn a_relay_reports_broken_cables_only_where_its_break_enable_says_so_page_107() {
    let mut bench = bench();
    bench.act("input 2 open").expect("no sensor");
    bench.check(&[("04 0001 0001", "04 02 0002")]);
    relays(&mut bench, 0);
    write(&mut bench, 20, 0b00_0010);
    relays(&mut bench, 2);
    write(&mut bench, 19, 0b00_0011);
    relays(&mut bench, 3);
    // What is no cable break is not reported as one.
    write(&mut bench, 18, 0b00_0001);
    relays(&mut bench, 0);
}

#[test]
fn polarity_turns_inactive_to_on_for_leaks_and_levels_page_106() {
    let mut bench = bench();
    write(&mut bench, 1, 0b01);
    relays(&mut bench, 1);
    wet(&mut bench, &[1, 4]);
    relays(&mut bench, 2);
    write(&mut bench, 1, 0b10);
    relays(&mut bench, 1);
    write(&mut bench, 1, 0b11);
    relays(&mut bench, 0);
    // One electrode alone keeps the activity that was there.
    write(&mut bench, 15, 2);
    relays(&mut bench, 0);
    wet(&mut bench, &[]);
    relays(&mut bench, 3);
    wet(&mut bench, &[3, 4]);
    relays(&mut bench, 0);
}

#[test]
fn a_level_is_active_with_both_electrodes_inactive_with_none_and_kept_with_one_pages_105_and_107() {
    for (mode, upper, lower) in [(1, 1, 2), (2, 3, 4), (3, 5, 6)] {
        let mut bench = bench();
        write(&mut bench, 14, mode);
        // The other relay reports no leaks meanwhile.
        write(&mut bench, 17, 0);
        for (inputs, on) in [
            (&[][..], 0),
            (&[lower], 0),
            (&[lower, upper], 1),
            (&[lower], 1),
            (&[upper], 1),
            (&[], 0),
            (&[upper], 0),
        ] {
            // First what gets wet, so that no electrode is dry on the way from one to both.
            for input in 1..=6 {
                if inputs.contains(&input) {
                    bench.act(&format!("input {input} ohms 5000")).expect("a sensor");
                }
            }
            for input in 1..=6 {
                if !inputs.contains(&input) {
                    bench.act(&format!("input {input} ohms 1000000")).expect("a sensor");
                }
            }
            relays(&mut bench, on);
        }
        // Other inputs are nothing to it.
        let others: Vec<u8> = (1..=6).filter(|input| *input != upper && *input != lower).collect();
        wet(&mut bench, &others);
        relays(&mut bench, 0);
        // A restart begins inactive.
        wet(&mut bench, &[lower, upper]);
        wet(&mut bench, &[lower]);
        relays(&mut bench, 1);
        bench.check(&[("08 0001 0000", "08 0001 0000")]);
        relays(&mut bench, 0);
    }
}

#[test]
fn the_matrix_has_a_bit_for_each_of_the_64_combinations_of_inputs_page_108() {
    for relay in 0..2 {
        for combination in 0..64u16 {
            let mut bench = bench();
            write(&mut bench, 16, 0);
            write(&mut bench, 17, 0);
            write(&mut bench, 14 + relay, 4);
            // Turned round, for the state is not one of activity.
            write(&mut bench, 1, 1 << relay);
            let inputs: Vec<u8> =
                (0..6).filter(|input| combination >> input & 1 == 1).map(|input| input + 1).collect();
            wet(&mut bench, &inputs);
            let register = 21 + 8 * relay + combination / 8;
            relays(&mut bench, 0);
            write(&mut bench, register, 1 << (combination % 8));
            relays(&mut bench, 1 << relay);
            // All other combinations, and bit 8, which is that of none.
            for other in 0..8 {
                write(&mut bench, 21 + 8 * relay + other, 0x1FF);
            }
            write(&mut bench, register, 0x1FF & !(1 << (combination % 8)));
            relays(&mut bench, 0);
        }
    }
}

#[test]
fn in_any_other_mode_the_bus_switches_a_relay_pages_105_and_107() {
    for mode in [5, 0x100, 0xFFFF] {
        let mut bench = bench();
        write(&mut bench, 14, mode);
        write(&mut bench, 15, mode);
        wet(&mut bench, &[1, 2, 3, 4, 5, 6]);
        relays(&mut bench, 0);
        bench.check(&[("05 0001 FF00", "05 0001 FF00")]);
        relays(&mut bench, 2);
        bench.check(&[("0F 0000 0002 01 01", "0F 0000 0002")]);
        relays(&mut bench, 1);
        bench.check(&[("06 0000 FFFE", "06 0000 FFFE")]);
        relays(&mut bench, 2);
        // A coil is a state, not an activity.
        write(&mut bench, 1, 3);
        relays(&mut bench, 2);
        bench.check(&[("05 0000 FF00", "05 0000 FF00"), ("05 0001 0000", "05 0001 0000")]);
        relays(&mut bench, 1);
    }
}

#[test]
fn a_coil_that_can_only_be_read_stays_as_it_is_page_105() {
    for mode in 0..=4 {
        let mut bench = bench();
        write(&mut bench, 15, mode);
        bench.check(&[("05 0001 FF00", "05 0001 FF00"), ("06 0000 0003", "06 0000 0003")]);
        relays(&mut bench, 0);
        // Of both in one request the other obeys.
        write(&mut bench, 14, 5);
        bench.check(&[("0F 0000 0002 01 03", "0F 0000 0002")]);
        relays(&mut bench, 1);
        // What was written then is not remembered: the bus begins with the inactive state.
        write(&mut bench, 15, 5);
        relays(&mut bench, 1);
        write(&mut bench, 14, 0);
        write(&mut bench, 1, 1);
        write(&mut bench, 14, 5);
        relays(&mut bench, 1);
    }
}

#[test]
fn a_watchdog_that_no_message_feeds_makes_the_bus_s_relays_inactive_and_lights_the_led_page_103() {
    let mut bench = bench();
    wet(&mut bench, &[4]);
    write(&mut bench, 14, 5);
    bench.check(&[("05 0000 FF00", "05 0000 FF00"), ("06 0042 0032", "06 0042 0032")]);
    relays(&mut bench, 3);
    bench.wait(499);
    // Even a message that is refused feeds it; one to all does not.
    bench.check(&[("03 00FF 0001", "83 02")]);
    bench.wait(400);
    bench.send(Addressed::Broadcast, "05 0000 FF00");
    bench.wait(99);
    assert_eq!((bench.output("relay_1"), bench.output("red_led")), ("ON".into(), "OFF".into()));
    bench.wait(1);
    assert_eq!((bench.output("relay_1"), bench.output("red_led")), ("OFF".into(), "ON".into()));
    // The leak is still reported.
    relays(&mut bench, 2);
    assert_eq!(bench.output("red_led"), "OFF");
    // With the other polarity the inactive state is on.
    write(&mut bench, 1, 1);
    bench.check(&[("05 0000 0000", "05 0000 0000")]);
    relays(&mut bench, 2);
    bench.wait(500);
    assert_eq!((bench.output("relay_1"), bench.output("red_led")), ("ON".into(), "ON".into()));
    // Without relays of the bus there is nothing to watch.
    write(&mut bench, 14, 0);
    bench.wait(500);
    assert_eq!(bench.output("red_led"), "OFF");
    // And a time of 0 is none.
    write(&mut bench, 14, 5);
    write(&mut bench, 66, 0);
    bench.check(&[("05 0000 0000", "05 0000 0000")]);
    bench.wait(1_000_000);
    relays(&mut bench, 2);
}

#[test]
fn settings_outlive_a_restart_after_which_the_bus_s_relays_are_inactive_pages_104_to_108() {
    let mut bench = bench();
    let settings = "0002 0001 0002 0003 0004 0005 0006 0007 0008 0009 000A 000B 000C 0005 0006 0021 0012 003E \
                    0004 0008 0101 0102 0103 0104 0105 0106 0107 0108 0011 0012 0013 0014 0015 0016 0017 0018";
    let write = format!("10 0000 0025 4A 0003 {settings}");
    let read = format!("03 48 {settings}");
    bench.check(&[
        (&write, "10 0000 0025"),
        ("03 0001 0024", &read),
        ("06 0042 0123", "06 0042 0123"),
        ("05 0000 FF00", "05 0000 FF00"),
        ("05 0001 0000", "05 0001 0000"),
    ]);
    relays(&mut bench, 1);
    let kept = bench.device.eeprom();
    let rows = [("08 0001 0000", "08 0001 0000"), ("03 0001 0024", &read), ("03 0042 0001", "03 02 0123")];
    bench.check(&rows);
    relays(&mut bench, 2);
    let mut other = Bench::new(Model::MrLd6);
    other.device.load_eeprom(other.now, &kept).expect("an EEPROM of the same device");
    other.check(&rows[1..]);
    relays(&mut other, 2);
}

#[test]
fn a_restart_forgets_what_lies_within_the_hysteresis_page_104() {
    let mut bench = bench();
    bench.act("input 1 ohms 5000").expect("a sensor");
    bench.act("input 1 ohms 20000").expect("a sensor");
    bench.act("input 1 volts 12").expect("a sensor");
    bench.act("input 1 volts 11").expect("a sensor");
    bench.check(&[
        ("04 0000 0002", "04 04 0001 0001"),
        ("08 0001 0000", "08 0001 0000"),
        ("04 0000 0002", "04 04 0000 0000"),
    ]);
}

#[test]
fn an_input_takes_ohms_volts_or_nothing() {
    let mut bench = bench();
    for wrong in
        ["input 0 open", "input 7 ohms 5", "input 1 contact closed", "input 1 celsius 5", "relay 1 hand on"]
    {
        assert!(bench.act(wrong).is_err(), "{wrong}");
    }
    bench.check(&[("04 0000 0002", "04 04 0000 0000")]);
}
