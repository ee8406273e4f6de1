//! MR-AIO4/2 against its chapter, pages 60 to 78; the controllers alone are tested beside them.

use crate::simulator::device::{Addressed, Model};
use crate::simulator::testing::Bench;

/// How long it takes until each input has been measured once and the controllers have calculated.
const ROUND: u64 = 1000;
// Registers of the first controller; those of the second are 50 further on.
const SWITCH: u16 = 100;
const MODE: u16 = 101;
const FP_XP: u16 = 102;
const TI: u16 = 104;
const TD: u16 = 106;
const T1: u16 = 108;
const Y_MIN: u16 = 110;
const Y_MAX: u16 = 112;
const DEAD_RANGE: u16 = 114;
const DEACT_Y: u16 = 116;
const INIT_Y: u16 = 118;
const INIT_W: u16 = 120;
const INIT_OUT_F: u16 = 122;
const YP: u16 = 130;
const YI: u16 = 132;
const YDT: u16 = 134;
const W: u16 = 136;
const OUT_F: u16 = 138;
const LIMIT: u16 = 140;
const MANUAL_Y: u16 = 142;
// The linear maps, page 75 and 76.
const LCL: [u16; 4] = [200, 208, 216, 228];

fn bench() -> Bench {
    Bench::new(Model::MrAio42)
}

/// Function 16 with floats.
#[track_caller]
fn write(bench: &mut Bench, first: u16, numbers: &[f32]) {
    let count = 2 * numbers.len();
    let data: String = numbers.iter().map(|number| format!("{:08X}", number.to_bits())).collect();
    bench.check(&[(
        &format!("10 {first:04X} {count:04X} {:02X} {data}", 2 * count),
        &format!("10 {first:04X} {count:04X}"),
    )]);
}

/// Function 16 with one register.
#[track_caller]
fn write_word(bench: &mut Bench, register: u16, word: u16) {
    bench.check(&[(&format!("10 {register:04X} 0001 02 {word:04X}"), &format!("10 {register:04X} 0001"))]);
}

/// Function 3 for a float.
#[track_caller]
fn read(bench: &mut Bench, first: u16) -> f32 {
    let reply = bench.ask(&format!("03 {first:04X} 0002"));
    let digits = reply.strip_prefix("0304").unwrap_or_else(|| panic!("{first}: {reply}"));
    f32::from_bits(u32::from_str_radix(digits, 16).expect("hexadecimal"))
}

#[track_caller]
fn read_word(bench: &mut Bench, register: u16) -> u16 {
    let reply = bench.ask(&format!("03 {register:04X} 0001"));
    let digits = reply.strip_prefix("0302").unwrap_or_else(|| panic!("{register}: {reply}"));
    u16::from_str_radix(digits, 16).expect("hexadecimal")
}

#[track_caller]
fn near(bench: &mut Bench, register: u16, wanted: f32) {
    let told = read(bench, register);
    assert!((told - wanted).abs() < 1e-4, "register {register}: {told}, wanted {wanted}");
}

/// Connects voltages to inputs 1 to 4, which are left at their factory setting, and waits a round.
#[track_caller]
fn connect(bench: &mut Bench, volts: [f64; 4]) {
    for (number, volts) in (1..).zip(volts) {
        bench.act(&format!("input {number} volts {volts}")).expect("an input");
    }
    bench.wait(ROUND);
}

#[test]
fn each_address_is_read_and_written_by_the_functions_of_page_60_and_no_others() {
    let (mut read, mut written_alone, mut written) = (Vec::new(), Vec::new(), Vec::new());
    for register in 0..300 {
        let mut bench = bench();
        let word = if register == 65 { "5315" } else { "0000" };
        if bench.ask(&format!("03 {register:04X} 0001")) != "8302" {
            read.push(register);
        }
        if bench.ask(&format!("06 {register:04X} {word}")) != "8602" {
            written_alone.push(register);
        }
        if bench.ask(&format!("10 {register:04X} 0001 02 {word}")) != "9002" {
            written.push(register);
        }
    }
    // 239 where page 60 says 231: LCL4 ends there on page 76.
    let spans = [0..=63, 65..=66, 68..=68, 100..=123, 130..=143, 150..=173, 180..=193, 200..=239];
    let listed: Vec<u16> = spans.into_iter().flatten().collect();
    assert_eq!(read, listed);
    assert_eq!(written, listed);
    assert_eq!(written_alone, [16, 17, 18, 19, 20, 21, 22, 23, 65, 66, 68]);
}

#[test]
fn a_request_stays_within_one_span_of_page_60() {
    for (first, last) in
        [(0, 63), (65, 65), (66, 66), (68, 68), (100, 123), (130, 143), (150, 173), (180, 193), (200, 239)]
    {
        let count = last - first + 1;
        let whole = bench().ask(&format!("03 {first:04X} {count:04X}"));
        assert_eq!(whole.len(), 4 + 4 * usize::from(count), "{first}");
        let zeros = |count: u16| format!("{:02X} {}", 2 * count, "0000".repeat(count.into()));
        let more = count + 1;
        bench().check(&[
            (&format!("03 {first:04X} {more:04X}"), "83 02"),
            (&format!("10 {first:04X} {more:04X} {}", zeros(more)), "90 02"),
        ]);
        if first != 65 {
            let written = format!("10 {first:04X} {count:04X}");
            bench().check(&[(&format!("{written} {}", zeros(count)), &written)]);
        }
    }
    bench().check(&[
        ("04 0000 0008", "04 10 0000 0000 0000 0000 0000 0000 0000 0000"),
        ("04 0003 0001", "04 02 0000"),
        ("04 0007 0002", "84 02"),
        ("04 0008 0001", "84 02"),
        ("04 0000 0009", "84 03"),
        ("03 0000 0000", "83 03"),
        ("03 0000 007E", "83 03"),
        ("10 0000 0001 04 0000 0000", "90 03"),
        ("01 0000 0001", "81 01"),
        ("02 0000 0001", "82 01"),
        ("05 0000 FF00", "85 01"),
        ("0F 0000 0001 01 01", "8F 01"),
    ]);
}

#[test]
fn register_65_is_read_without_its_magic_number_and_written_with_it_pages_3_and_60() {
    bench().check(&[
        ("03 0041 0001", "03 02 0015"),
        ("06 0041 5338", "06 0041 5338"),
        ("03 0041 0001", "03 02 0038"),
        ("10 0041 0001 02 5321", "10 0041 0001"),
        ("03 0041 0001", "03 02 0021"),
        ("06 0041 0015", "86 03"),
        ("03 0041 0002", "83 02"),
        ("10 0041 0002 04 5315 0000", "90 02"),
    ]);
}

#[test]
fn the_factory_s_settings_are_those_of_pages_61_to_77() {
    let mut bench = bench();
    bench.check(&[
        ("03 0000 0018", &format!("03 30 {}", "0000".repeat(24))),
        ("03 0042 0001", "03 02 0000"),
        ("03 0044 0001", "03 02 0000"),
        ("03 0064 0002", "03 04 0000 0005"),
        ("03 0096 0002", "03 04 0000 0005"),
    ]);
    for side in [0, 50] {
        for (register, number) in [
            (FP_XP, 3.0),
            (TI, 300.0),
            (TD, 1.0),
            (T1, 10.0),
            (Y_MIN, 0.0),
            (Y_MAX, 100.0),
            (DEAD_RANGE, 0.0),
            (DEACT_Y, 0.0),
            (INIT_Y, 0.0),
            (INIT_W, 0.0),
            (INIT_OUT_F, 0.0),
        ] {
            assert_eq!(read(&mut bench, side + register), number, "{register}");
        }
    }
    for (map, numbers) in LCL.into_iter().zip([4, 4, 6, 6]) {
        for (number, wanted) in (0..numbers).zip([0.0, 100.0, 0.0, 100.0, 0.0, 100.0]) {
            assert_eq!(read(&mut bench, map + 2 * number), wanted, "{map}, {number}");
        }
    }
}

#[test]
fn all_that_is_marked_as_eeprom_outlives_a_restart_and_nothing_else_pages_61_to_77() {
    let mut bench = bench();
    // Two words of each span are enough to know it, if they are its ends; the codes have to be some.
    let kept = [0, 7, 8, 15, 22, 23, 24, 63, 66, 101, 123, 151, 173, 200, 239];
    for (register, word) in kept.into_iter().zip(0x3C01..) {
        write_word(&mut bench, register, word);
    }
    bench.check(&[
        ("10 0010 0004 08 0080 0081 0040 00F9", "10 0010 0004"),
        ("06 0044 FFFF", "06 0044 FFFF"),
        ("10 0064 0001 02 0066", "10 0064 0001"),
        // The second side has no register of this meaning.
        ("10 0096 0001 02 1234", "10 0096 0001"),
    ]);
    let eeprom = bench.device.eeprom();
    let mut other = self::bench();
    other.device.load_eeprom(other.now, &eeprom).expect("an EEPROM of the same device");
    for bench in [&mut bench, &mut other] {
        bench.act("restart").expect("it restarts");
        for (register, word) in kept.into_iter().zip(0x3C01..) {
            assert_eq!(read_word(bench, register), word, "{register}");
        }
        bench.check(&[
            ("03 0010 0004", "03 08 0080 0081 0040 00F9"),
            ("03 0044 0001", "03 02 0001"),
            ("03 0064 0001", "03 02 0066"),
            ("03 0096 0001", "03 02 0000"),
        ]);
    }
}

#[test]
fn outputs_and_set_points_begin_with_their_initial_values_page_62() {
    let mut bench = bench();
    // Both set points by the bus, output 1 by OutI and output 2 by OutF.
    bench.check(&[
        ("10 0064 0001 02 004A", "10 0064 0001"),
        ("10 0016 0002 04 3E80 0001", "10 0016 0002"),
        ("06 0014 0001", "06 0014 0001"),
    ]);
    for (register, number) in [
        (INIT_W, 21.5),
        (50 + INIT_W, 19.0),
        (INIT_OUT_F, 1.0),
        (50 + INIT_OUT_F, 25.0),
        (50 + OUT_F, 2.0),
        (W, 1.0),
        (50 + W, 2.0),
        (MANUAL_Y, 3.0),
    ] {
        write(&mut bench, register, &[number]);
    }
    assert_eq!([bench.output("output_1"), bench.output("output_2")], ["0.000 V", "0.200 V"]);
    bench.check(&[("08 0001 0000", "08 0001 0000"), ("03 0014 0002", "03 04 3E80 1F40")]);
    assert_eq!([bench.output("output_1"), bench.output("output_2")], ["5.000 V", "2.500 V"]);
    for (register, number) in [(W, 21.5), (50 + W, 19.0), (OUT_F, 50.0), (50 + OUT_F, 25.0), (MANUAL_Y, 0.0)]
    {
        assert_eq!(read(&mut bench, register), number, "{register}");
    }
}

#[test]
fn an_output_takes_the_register_that_switch_chooses_and_both_tell_it_pages_61_and_77() {
    // The chosen register's value, the other's, and the volts.
    for (steps, percent, volts) in [
        (0, 0.0, "0.000 V"),
        (16_000, 50.0, "5.000 V"),
        (1, 0.003_125, "0.000 V"),
        (32_767, 102.396_87, "10.240 V"),
        (-1, 0.0, "0.000 V"),
    ] {
        let mut bench = bench();
        for (number, register) in [(1, 20), (2, 21)] {
            bench.ask(&format!("06 {register:04X} {:04X}", steps as u16));
            assert_eq!(read(&mut bench, OUT_F + 50 * (number - 1)), percent, "{steps}");
            assert_eq!(read_word(&mut bench, register), steps as u16);
            assert_eq!(bench.output(&format!("output_{number}")), volts, "{steps}");
        }
    }
    for (percent, steps, volts) in [
        (0.0, 0, "0.000 V"),
        (25.0, 8000, "2.500 V"),
        (102.4, 32_767, "10.240 V"),
        (150.0, 32_767, "10.240 V"),
        (-1.0, 0, "0.000 V"),
        (f32::INFINITY, 32_767, "10.240 V"),
    ] {
        let mut bench = bench();
        write_word(&mut bench, SWITCH, 0x50);
        for (number, register) in [(1, 20), (2, 21)] {
            let out_f = OUT_F + 50 * (number - 1);
            write(&mut bench, out_f, &[percent]);
            assert_eq!(read_word(&mut bench, register), steps, "{percent}");
            assert_eq!(read(&mut bench, out_f), percent);
            assert_eq!(bench.output(&format!("output_{number}")), volts, "{percent}");
        }
    }
}

#[test]
fn what_is_written_to_a_register_that_is_not_chosen_has_no_effect_pages_61_and_77() {
    let mut bench = bench();
    // Output 1 by OutI, output 2 by OutF.
    write_word(&mut bench, SWITCH, 0x40);
    bench.check(&[("06 0014 3E80", "06 0014 3E80"), ("06 0015 3E80", "06 0015 3E80")]);
    write(&mut bench, OUT_F, &[10.0]);
    write(&mut bench, 50 + OUT_F, &[10.0]);
    bench.check(&[("06 0015 3E80", "06 0015 3E80"), ("03 0014 0002", "03 04 3E80 0C80")]);
    assert_eq!([read(&mut bench, OUT_F), read(&mut bench, 50 + OUT_F)], [50.0, 10.0]);
    // Half of a float is written, too, and then it is another number: 10.0 becomes 2.5.
    write_word(&mut bench, 50 + OUT_F, 0x4020);
    assert_eq!(bench.output("output_2"), "0.250 V");
    // Another choice begins where the output was.
    write_word(&mut bench, SWITCH, 0x10);
    assert_eq!([bench.output("output_1"), bench.output("output_2")], ["5.000 V", "0.250 V"]);
}

#[test]
fn the_fourth_choice_of_each_field_of_switch_is_refused_page_77() {
    let mut bench = bench();
    write_word(&mut bench, SWITCH, 0xAA);
    for word in ["0003", "000C", "0030", "00C0"] {
        bench.check(&[
            (&format!("10 0064 0001 02 {word}"), "90 03"),
            // Nothing of the request is written.
            (&format!("10 0064 0002 04 {word} 0000"), "90 03"),
        ]);
    }
    bench.check(&[("03 0064 0002", "03 04 00AA 0005")]);
}

#[test]
fn a_watchdog_that_no_message_feeds_loads_the_initial_values_and_lights_up_pages_61_and_62() {
    let mut bench = bench();
    bench.check(&[
        // Set points by the bus, output 1 by OutI, output 2 by OutF.
        ("10 0064 0001 02 004A", "10 0064 0001"),
        ("06 0042 0032", "06 0042 0032"),
        ("10 0014 0003 06 0001 0002 0C80", "10 0014 0003"),
    ]);
    for side in [0, 50] {
        write(&mut bench, side + INIT_W, &[21.0]);
        write(&mut bench, side + INIT_OUT_F, &[30.0]);
        write(&mut bench, side + W, &[5.0]);
    }
    write(&mut bench, 50 + OUT_F, &[80.0]);
    bench.wait(499);
    assert_eq!(bench.output("red_light"), "OFF");
    // Even a message that is refused feeds it; one to all does not.
    bench.check(&[("2B 0E 04 00", "AB 03")]);
    bench.wait(499);
    bench.send(Addressed::Broadcast, "06 0014 0007");
    assert_eq!([bench.output("output_1"), bench.output("output_2")], ["0.002 V", "8.000 V"]);
    bench.wait(1);
    assert_eq!(bench.output("red_light"), "ON");
    assert_eq!([bench.output("output_1"), bench.output("output_2")], ["1.000 V", "3.000 V"]);
    assert_eq!([read(&mut bench, W), read(&mut bench, 50 + W)], [21.0, 21.0]);
    // It has been fed again, and what is written now stays.
    assert_eq!(bench.output("red_light"), "OFF");
    bench.check(&[("06 0014 0001", "06 0014 0001")]);
    bench.wait(499);
    bench.check(&[("03 0014 0001", "03 02 0001"), ("06 0042 0000", "06 0042 0000")]);
    bench.wait(60_000);
    bench.check(&[("03 0014 0001", "03 02 0001")]);
}

#[test]
fn inputs_are_measured_in_turn_and_each_about_once_a_second_page_62() {
    let mut bench = bench();
    let values = |values: [&str; 4]| format!("04 10 {}", values.map(|value| format!("{value}0000")).concat());
    for number in 1..=4 {
        bench.act(&format!("input {number} volts 1")).expect("an input");
    }
    for (pause, wanted) in [
        (249, ["0000", "0000", "0000", "0000"]),
        (1, ["3F80", "0000", "0000", "0000"]),
        (250, ["3F80", "3F80", "0000", "0000"]),
        (250, ["3F80", "3F80", "3F80", "0000"]),
        (250, ["3F80", "3F80", "3F80", "3F80"]),
    ] {
        bench.wait(pause);
        bench.check(&[("04 0000 0008", &values(wanted))]);
    }
    // A change is seen with the next measurement, and a new configuration begins without a value.
    bench.act("input 1 volts 2").expect("an input");
    bench.act("input 2 volts 2").expect("an input");
    bench.check(&[("06 0011 0001", "06 0011 0001")]);
    bench.check(&[("04 0000 0008", &values(["3F80", "0000", "3F80", "3F80"]))]);
    bench.wait(250);
    bench.check(&[("04 0000 0008", &values(["4000", "0000", "3F80", "3F80"]))]);
    bench.wait(250);
    bench.check(&[("04 0000 0008", &values(["4000", "1900", "3F80", "3F80"]))]);
}

#[test]
fn every_code_of_pages_66_and_67_is_taken_and_reserved_ones_are_refused() {
    let mut tabled: Vec<u16> = vec![0, 1, 32, 33, 64, 65, 66, 67, 68];
    tabled.extend(128..=155);
    tabled.extend(240..=251);
    let mut bench = bench();
    for code in 0..=0x2FF {
        let request = format!("06 0013 {code:04X}");
        let reply = if tabled.contains(&code) { request.clone() } else { "86 03".into() };
        bench.check(&[(&request, &reply)]);
    }
    bench.check(&[
        ("10 000F 0003 06 1234 0081 0181", "90 03"),
        ("03 000F 0003", "03 06 0000 0000 0000"),
        // The registers behind the codes are no codes.
        ("10 0013 0002 04 0080 0181", "10 0013 0002"),
    ]);
}

#[test]
fn the_code_decides_type_and_unit_of_the_value_pages_64_to_68() {
    for (code, signal, words) in [
        (0x00, "volts 2.5", "4020 0000"),
        (0x01, "volts 10", "7D00 0000"),
        (0x20, "open", "40A0 0000"),
        (0x40, "ohms 107.8", "42D7 999A"),
        (0x44, "ohms 107.8", "0001 0000"),
        (0x81, "ohms 107.794", "00C8 0000"),
        (0x9B, "celsius 120", "044C 0000"),
        (0x8A, "celsius 21.5", "41AC 0000"),
        // Two points of the table, 0 °C at 1000 Ω and 100 °C at 2000 Ω.
        (0xF8, "ohms 1250", "41C8 0000"),
        (0xF9, "ohms 1250", "00FA 0000"),
    ] {
        let mut bench = bench();
        write(&mut bench, 24, &[0.0, 1000.0, 100.0, 2000.0]);
        bench.check(&[(&format!("06 0012 {code:04X}"), &format!("06 0012 {code:04X}"))]);
        bench.act(&format!("input 3 {signal}")).expect("a signal");
        bench.wait(ROUND);
        bench.check(&[("04 0004 0002", &format!("04 04 {words}"))]);
    }
}

#[test]
fn there_are_four_inputs_and_nothing_else_to_touch_page_62() {
    let mut bench = bench();
    for command in ["input 0 volts 1", "input 5 volts 1", "input 1 milliamps 4", "button", "output 1 hand 5"]
    {
        assert!(bench.act(command).is_err(), "{command}");
    }
}

#[test]
fn the_offset_is_added_in_the_value_s_own_format_and_outlives_a_restart_page_63() {
    let mut bench = bench();
    // Input 1 a PT100 as an integer, input 2 as a float.
    bench.check(&[
        ("10 0010 0002 04 0081 0080", "10 0010 0002"),
        ("10 0000 0004 08 FFFB 0000 BF00 0000", "10 0000 0004"),
    ]);
    bench.act("input 1 celsius 20").expect("a signal");
    bench.act("input 2 celsius 20").expect("a signal");
    for restart in [false, true] {
        if restart {
            bench.act("restart").expect("it restarts");
        }
        bench.wait(ROUND);
        bench.check(&[("04 0000 0004", "04 08 00C3 0000 419C 0000")]);
    }
}

#[test]
fn register_68_changes_the_unit_of_the_registers_and_not_of_the_controllers_pages_69_and_76() {
    let mut bench = bench();
    // Inputs 1 and 3 as integers, 2 and 4 as floats: sensors, but input 4, which is the table.
    bench.check(&[("10 0010 0004 08 0081 0080 00F9 00F8", "10 0010 0004"), ("06 0044 0001", "06 0044 0001")]);
    for number in 1..=4 {
        bench.act(&format!("input {number} celsius 20")).expect("a signal");
    }
    bench.wait(ROUND);
    bench.check(&[("04 0000 0008", "04 10 02A8 0000 4288 0000 00C8 0000 41A0 0000")]);
    near(&mut bench, W, 20.0);
    near(&mut bench, 50 + W, 20.0);
    // Offsets are added to what is told: 1.8 °F are 1 °C.
    bench.check(&[("10 0000 0001 02 0012", "10 0000 0001")]);
    write(&mut bench, 2, &[3.6]);
    bench.wait(ROUND);
    bench.check(&[("04 0000 0001", "04 02 02BA")]);
    near(&mut bench, W, 22.0);
    // X is 21, and the factory's controller negates: Yp = -3 (21 - 22).
    near(&mut bench, YP, 3.0);
}

#[test]
fn the_set_point_is_input_2_or_4_or_its_linear_map_or_the_bus_s_page_77() {
    let mut bench = bench();
    // 2 to 10 V are 10 to 30 °C for the first, and 30 to 10 °C for the second.
    write(&mut bench, LCL[0], &[10.0, 30.0, 2.0, 10.0]);
    write(&mut bench, LCL[1], &[30.0, 10.0, 2.0, 10.0]);
    for (switch, first, second) in [(0x0, 4.0, 6.0), (0x1, 15.0, 6.0), (0x4, 4.0, 20.0), (0x5, 15.0, 20.0)] {
        write_word(&mut bench, SWITCH, switch);
        connect(&mut bench, [0.0, 4.0, 0.0, 6.0]);
        assert_eq!([read(&mut bench, W), read(&mut bench, 50 + W)], [first, second], "{switch:X}");
        // The bus has no say.
        write(&mut bench, W, &[1.0]);
        write(&mut bench, 50 + W, &[1.0]);
        assert_eq!([read(&mut bench, W), read(&mut bench, 50 + W)], [first, second], "{switch:X}");
    }
    // Its set point begins with the last one, and the inputs have no say.
    write_word(&mut bench, SWITCH, 0xA);
    assert_eq!([read(&mut bench, W), read(&mut bench, 50 + W)], [15.0, 20.0]);
    write(&mut bench, W, &[21.5]);
    write(&mut bench, 50 + W, &[22.5]);
    connect(&mut bench, [0.0, 5.0, 0.0, 7.0]);
    assert_eq!([read(&mut bench, W), read(&mut bench, 50 + W)], [21.5, 22.5]);
}

#[test]
fn lcl1_and_lcl2_map_between_two_points_and_end_there_page_74() {
    for (map, side, input) in [(0, 0, 2), (1, 50, 4)] {
        for (points, rows) in [
            ([10.0, 30.0, 2.0, 10.0], [(0.0, 10.0), (2.0, 10.0), (4.0, 15.0), (10.0, 30.0), (10.2, 30.0)]),
            ([30.0, 10.0, 2.0, 10.0], [(0.0, 30.0), (2.0, 30.0), (4.0, 25.0), (10.0, 10.0), (10.2, 10.0)]),
            // The points in the other order.
            ([30.0, 10.0, 10.0, 2.0], [(0.0, 10.0), (2.0, 10.0), (4.0, 15.0), (10.0, 30.0), (10.2, 30.0)]),
            // Above each other.
            ([10.0, 30.0, 5.0, 5.0], [(0.0, 10.0), (5.0, 10.0), (5.5, 30.0), (6.0, 30.0), (10.0, 30.0)]),
        ] {
            let mut bench = bench();
            write_word(&mut bench, SWITCH, 0x5);
            write(&mut bench, LCL[map], &points);
            for (volts, wanted) in rows {
                bench.act(&format!("input {input} volts {volts}")).expect("a signal");
                bench.wait(ROUND);
                assert_eq!(read(&mut bench, side + W), wanted, "{points:?} at {volts} V");
            }
        }
    }
}

#[test]
fn lcl3_and_lcl4_map_through_two_points_and_end_at_y3_and_y4_page_75() {
    for (map, side, input) in [(2, 0, 2), (3, 50, 4)] {
        for (numbers, rows) in [
            // The line goes on beyond its points.
            (
                [20.0, 40.0, 4.0, 6.0, 5.0, 75.0],
                [(0.0, 5.0), (3.0, 10.0), (5.0, 30.0), (8.0, 60.0), (10.0, 75.0)],
            ),
            // A frost protection: 5 V and less are 100 %.
            (
                [100.0, 0.0, 5.0, 10.0, 0.0, 100.0],
                [(0.0, 100.0), (5.0, 100.0), (7.5, 50.0), (9.0, 20.0), (10.2, 0.0)],
            ),
            // Limits within the points.
            (
                [0.0, 100.0, 0.0, 10.0, 20.0, 60.0],
                [(0.0, 20.0), (1.0, 20.0), (5.0, 50.0), (6.0, 60.0), (10.0, 60.0)],
            ),
        ] {
            let mut bench = bench();
            write(&mut bench, LCL[map], &numbers);
            for (volts, wanted) in rows {
                bench.act(&format!("input {input} volts {volts}")).expect("a signal");
                bench.wait(ROUND);
                near(&mut bench, side + LIMIT, wanted);
            }
        }
    }
}

/// Both controllers with Fp = 2 alone and not negated, InitY = 20 %, set points by the bus, and both
/// outputs by the controllers.
fn controlled() -> Bench {
    let mut bench = bench();
    for side in [0, 50] {
        write(&mut bench, side + FP_XP, &[2.0, 0.0, 0.0, 0.0, 0.0, 100.0, 0.0, 7.0, 20.0]);
        write_word(&mut bench, side + MODE, 0x01);
    }
    write_word(&mut bench, SWITCH, 0xAA);
    bench
}

#[test]
fn a_controller_has_inputs_1_and_2_or_3_and_4_and_its_own_output_page_77() {
    let mut bench = controlled();
    write(&mut bench, W, &[1.0]);
    write(&mut bench, 50 + W, &[2.0]);
    // Nothing is calculated before all inputs are measured.
    assert_eq!(bench.output("output_1"), "0.000 V");
    connect(&mut bench, [3.0, 9.0, 5.0, 9.0]);
    // The first value is InitY: Yp = 4 and 6, Yi = 16 and 14.
    for (side, yp, yi) in [(0, 4.0, 16.0), (50, 6.0, 14.0)] {
        assert_eq!([YP, YI, YDT, MANUAL_Y].map(|at| read(&mut bench, side + at)), [yp, yi, 0.0, 20.0]);
    }
    connect(&mut bench, [4.0, 9.0, 8.0, 9.0]);
    for (number, side, percent, steps) in [(1, 0, 22.0, 7040), (2, 50, 26.0, 8320)] {
        assert_eq!(read(&mut bench, side + OUT_F), percent);
        assert_eq!(read_word(&mut bench, 19 + number), steps);
        assert_eq!(bench.output(&format!("output_{number}")), format!("{:.3} V", percent / 10.0));
    }
    // They are told, and cannot be written.
    bench.check(&[("06 0014 0001", "06 0014 0001")]);
    write(&mut bench, YP, &[1.0, 1.0, 1.0]);
    write(&mut bench, OUT_F, &[1.0, 1.0]);
    assert_eq!([YP, YI, YDT, OUT_F].map(|at| read(&mut bench, at)), [6.0, 16.0, 0.0, 22.0]);
    assert_eq!(read(&mut bench, LIMIT), 9.0);
    assert_eq!(read_word(&mut bench, 20), 7040);
}

#[test]
fn all_of_a_controller_s_settings_reach_it_page_73() {
    for side in [0, 50] {
        let mut bench = controlled();
        write(&mut bench, side + W, &[1.0]);
        // Fp 2, Ti 4, Td 3, T1 4, 0 to 40 %, DeadR 0, DeactY 7 %, InitY 20 %.
        write(&mut bench, side + FP_XP, &[2.0, 4.0, 3.0, 4.0, 0.0, 40.0, 0.0, 7.0, 20.0]);
        let values = |bench: &mut Bench| [YP, YI, YDT, OUT_F].map(|at| read(bench, side + at));
        let step = |bench: &mut Bench, x: f64| {
            connect(bench, [x, 0.0, x, 0.0]);
            values(bench)
        };
        assert_eq!(step(&mut bench, 3.0), [4.0, 17.0, 0.0, 21.0]);
        assert_eq!(step(&mut bench, 4.0), [6.0, 18.5, 1.5, 26.0]);
        assert_eq!(step(&mut bench, 9.0), [16.0, 22.5, 8.625, 40.0]);
        // The derivative of X alone does not see the set point.
        write_word(&mut bench, side + MODE, 0x09);
        step(&mut bench, 9.0);
        let before = values(&mut bench)[2];
        write(&mut bench, side + W, &[5.0]);
        assert_eq!(step(&mut bench, 9.0)[2], before * 0.75);
        // Negated, with a range Xp of 8: Fp = 5.
        write_word(&mut bench, side + MODE, 0x07);
        write(&mut bench, side + FP_XP, &[8.0]);
        assert_eq!(step(&mut bench, 4.0)[0], 5.0);
        // Ymin and the dead range: 25 % is too near to 22 %, 27 % is not.
        let mut bench = controlled();
        write(&mut bench, side + Y_MIN, &[22.0, 100.0, 4.0]);
        assert_eq!(step(&mut bench, 0.0)[3], 22.0);
        assert_eq!(step(&mut bench, 1.5)[3], 22.0);
        assert_eq!(step(&mut bench, 2.5)[3], 27.0);
    }
}

#[test]
fn amin_lifts_pid1_and_bmax_lowers_pid2_where_they_are_released_pages_70_and_73() {
    let mut bench = controlled();
    // Amin and Bmax are ten times the volts of inputs 2 and 4.
    for map in [LCL[2], LCL[3]] {
        write(&mut bench, map, &[0.0, 100.0, 0.0, 10.0]);
    }
    let outputs = |bench: &mut Bench| [bench.output("output_1"), bench.output("output_2")];
    connect(&mut bench, [0.0, 5.0, 0.0, 1.0]);
    assert_eq!([read(&mut bench, LIMIT), read(&mut bench, 50 + LIMIT)], [50.0, 10.0]);
    assert_eq!(outputs(&mut bench), ["2.000 V", "2.000 V"]);
    write_word(&mut bench, MODE, 0x11);
    write_word(&mut bench, 50 + MODE, 0x11);
    bench.wait(ROUND);
    assert_eq!(outputs(&mut bench), ["5.000 V", "1.000 V"]);
    // The other way round they do not matter.
    connect(&mut bench, [0.0, 1.0, 0.0, 5.0]);
    assert_eq!(outputs(&mut bench), ["2.000 V", "2.000 V"]);
}

#[test]
fn many_follows_the_output_and_leads_it_by_hand_page_70() {
    for (number, side) in [(1, 0), (2, 50)] {
        let mut bench = controlled();
        let output = format!("output_{number}");
        connect(&mut bench, [5.0, 0.0, 5.0, 0.0]);
        connect(&mut bench, [6.0, 0.0, 6.0, 0.0]);
        assert_eq!([read(&mut bench, side + MANUAL_Y), read(&mut bench, side + OUT_F)], [22.0, 22.0]);
        // In automatic operation ManY is soon overwritten.
        write(&mut bench, side + MANUAL_Y, &[50.0]);
        bench.wait(ROUND);
        assert_eq!(read(&mut bench, side + MANUAL_Y), 22.0);
        write_word(&mut bench, side + MODE, 0x21);
        connect(&mut bench, [9.0, 0.0, 9.0, 0.0]);
        assert_eq!(bench.output(&output), "2.200 V");
        write(&mut bench, side + MANUAL_Y, &[64.0]);
        bench.wait(ROUND);
        assert_eq!(bench.output(&output), "6.400 V");
        // It goes on from there.
        write_word(&mut bench, side + MODE, 0x01);
        bench.wait(ROUND);
        assert_eq!(bench.output(&output), "6.400 V");
        connect(&mut bench, [10.0, 0.0, 10.0, 0.0]);
        assert_eq!(bench.output(&output), "6.600 V");
    }
}

#[test]
fn an_inactive_controller_gives_deact_y_and_begins_anew_with_init_y_page_70() {
    for (number, side) in [(1, 0), (2, 50)] {
        let mut bench = controlled();
        let output = format!("output_{number}");
        connect(&mut bench, [5.0, 0.0, 5.0, 0.0]);
        write_word(&mut bench, side + MODE, 0x00);
        bench.wait(ROUND);
        assert_eq!(bench.output(&output), "0.700 V");
        connect(&mut bench, [9.0, 0.0, 9.0, 0.0]);
        assert_eq!(bench.output(&output), "0.700 V");
        write_word(&mut bench, side + MODE, 0x01);
        bench.wait(ROUND);
        assert_eq!(bench.output(&output), "2.000 V");
        // The same after a restart, with an output of nothing until then.
        connect(&mut bench, [10.0, 0.0, 10.0, 0.0]);
        assert_eq!(bench.output(&output), "2.200 V");
        bench.act("restart").expect("it restarts");
        assert_eq!(bench.output(&output), "0.000 V");
        bench.wait(ROUND);
        assert_eq!(bench.output(&output), "2.000 V");
    }
}

#[test]
fn an_output_gives_no_more_than_it_can_of_what_a_controller_asks_page_61() {
    let mut bench = controlled();
    write_word(&mut bench, MODE, 0x21);
    for (manual_y, percent, steps) in [(120.0, 102.4, 32_767), (-5.0, 0.0, 0), (102.0, 102.0, 32_640)] {
        write(&mut bench, MANUAL_Y, &[manual_y]);
        bench.wait(ROUND);
        assert_eq!((read(&mut bench, OUT_F), read_word(&mut bench, 20)), (percent, steps));
    }
}

#[test]
fn a_controller_has_the_initial_set_point_from_the_moment_the_watchdog_expires_page_62() {
    let prepared = || {
        let mut bench = controlled();
        write(&mut bench, TI, &[100.0]);
        write(&mut bench, INIT_W, &[4.0]);
        bench.act("input 1 volts 5").expect("a signal");
        bench.check(&[("06 0042 00FA", "06 0042 00FA")]);
        bench
    };
    // Looking at an output feeds nothing.
    let (mut looked_at, mut left_alone) = (prepared(), prepared());
    for _ in 0..200 {
        looked_at.wait(100);
        looked_at.output("output_1");
    }
    left_alone.wait(20_000);
    assert_eq!(looked_at.output("output_1"), left_alone.output("output_1"));
    // Yi begins with 20 - 10 %. Two steps with W = 0 add 0.1 % each, eighteen with W = 4 0.02 % each.
    assert_eq!(left_alone.output("red_light"), "ON");
    near(&mut left_alone, W, 4.0);
    let told = read(&mut left_alone, YI);
    assert!((told - 10.56).abs() < 0.001, "{told}");
}

#[test]
fn a_controller_goes_on_whether_or_not_it_is_asked_page_72() {
    // Fp = 1, Ti = 100 s, Xw = 5: 0.05 % in each second, so 30 % in ten minutes.
    let prepared = || {
        let mut bench = controlled();
        write(&mut bench, FP_XP, &[1.0, 100.0]);
        bench.act("input 1 volts 5").expect("a signal");
        bench
    };
    let (mut asked, mut left_alone) = (prepared(), prepared());
    for _ in 0..6000 {
        asked.wait(100);
        asked.ask("03 0082 000E");
    }
    left_alone.wait(600_000);
    let values = "03 0082 000E";
    assert_eq!(asked.ask(values), left_alone.ask(values));
    let told = read(&mut left_alone, OUT_F);
    assert!((told - 50.0).abs() < 0.01, "{told}");
}

#[test]
fn a_negated_controller_heats_a_room_to_its_set_point_page_73() {
    let mut bench = bench();
    // PT1000 in degrees, the factory's controller but for a short Ti, and a set point by the bus.
    bench.check(&[("06 0010 0084", "06 0010 0084"), ("10 0064 0001 02 0022", "10 0064 0001")]);
    write(&mut bench, TI, &[60.0]);
    write(&mut bench, W, &[21.0]);
    // A room that full heating would take from 10 to 40 °C, and half of the way in about a minute.
    let mut room = 10.0;
    for _ in 0..1800 {
        bench.act(&format!("input 1 celsius {room}")).expect("a signal");
        bench.wait(ROUND);
        let percent = f64::from(read(&mut bench, OUT_F));
        assert!((0.0..=100.0).contains(&percent), "{percent}");
        room += (10.0 + 0.3 * percent - room) / 90.0;
    }
    assert!((room - 21.0).abs() < 0.05, "{room} °C");
}
