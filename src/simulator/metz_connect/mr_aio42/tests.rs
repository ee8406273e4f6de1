//! MR-AIO4/2 against its chapter: registers, outputs and inputs, pages 60 to 69. What is between inputs
//! and outputs is in [`regulation`], and the algorithm alone beside the algorithm.

mod regulation;

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
