//! The relay board against its manual: requests and replies as bytes.

use crate::simulator::device::{Addressed, Model};
use crate::simulator::testing::Bench;

fn check(rows: &[(&str, &str)]) {
    Bench::new(Model::Relay8).check(rows);
}

#[test]
fn the_registers_leave_the_factory_as_the_tables_say_6_1() {
    let words = |word: &str, count: usize| format!("{:02X}{}", 2 * count, word.repeat(count));
    check(&[
        ("04 0000 000A", &format!("04 14 5000 {}", "0000".repeat(9))),
        ("04 004F 0001", "04 02 03FA"),
        ("04 0064 000A", &format!("04 {}", words("0000", 10))),
        ("03 0000 000A", &format!("03 14 5300 {}", "2B67".repeat(9))),
        ("03 000B 0009", &format!("03 12 {} 0000", "2B67".repeat(8))),
        ("03 0015 0008", &format!("03 {}", words("0000", 8))),
        ("03 001F 0008", &format!("03 {}", words("0001", 8))),
        ("03 0028 000A", &format!("03 {}", words("0000", 10))),
        ("03 0033 0008", &format!("03 {}", words("0000", 8))),
        ("03 003D 0009", &format!("03 {}", words("0000", 9))),
        ("03 0047 0009", &format!("03 {}", words("0000", 9))),
        ("03 005A 000A", &format!("03 {}", words("0000", 10))),
        ("03 0147 0001", "03 02 0000"),
    ]);
}

#[test]
fn holes_are_refused_with_exception_2_and_more_than_10_registers_with_3_chapter_9() {
    check(&[
        ("04 0000 000B", "84 03"),
        ("04 0000 0000", "84 03"),
        ("04 0009 0002", "84 02"),
        ("04 00E3 0002", "84 02"),
        ("04 0300 0001", "84 02"),
        ("03 0009 0002", "83 02"),
        ("03 0014 0001", "83 02"),
        ("03 0027 0001", "83 02"),
        ("03 0064 0001", "83 02"),
        ("03 01F4 0001", "83 02"),
        ("03 FFFF 000A", "83 02"),
        ("03 0028 000B", "83 03"),
        ("06 000A 0000", "86 02"),
        ("06 0148 0000", "86 02"),
        ("10 001C 0002 04 0000 0000", "90 02"),
        ("10 005A 000B 16 0000000000000000000000000000000000000000 0000", "90 03"),
        ("10 005A 0002 02 0000", "90 03"),
    ]);
}

#[test]
fn other_functions_are_refused_with_exception_1_chapter_8() {
    check(&[
        ("01 0000 0001", "81 01"),
        ("05 0000 FF00", "85 01"),
        ("08 0000 1234", "88 01"),
        ("2B 0E 01 00", "AB 01"),
    ]);
}

#[test]
fn values_outside_their_range_are_limited_used_and_refused_chapter_9() {
    check(&[
        // With function 6 the manual prints 0x84, with function 16 0x90.
        ("06 0015 2710", "84 03"),
        ("03 0015 0001", "03 02 0000"),
        ("06 001F 2710", "84 03"),
        ("03 001F 0001", "03 02 270F"),
        ("06 000B D8F0", "84 03"),
        ("03 000B 0001", "03 02 D8F1"),
        ("06 0001 0002", "84 03"),
        ("03 0001 0001", "03 02 0001"),
        ("04 0001 0001", "04 02 0001"),
        ("06 0009 0100", "84 03"),
        ("03 0009 0001", "03 02 00FF"),
        ("06 0033 FFFF", "84 03"),
        ("03 0033 0001", "03 02 0708"),
        ("06 004E 003D", "84 03"),
        ("03 004E 0001", "03 02 003C"),
        ("06 0000 7B00", "84 03"),
        ("03 0000 0001", "03 02 7AFF"),
        ("06 0045 0100", "84 03"),
        ("03 0045 0001", "03 02 00FF"),
        ("10 003D 0003 06 0001 0709 0002", "90 03"),
        ("03 003D 0003", "03 06 0001 0708 0002"),
        ("06 004F 000B", "84 03"),
        ("06 0033 2B67", "84 03"),
    ]);
}

#[test]
fn the_lower_threshold_stays_below_the_upper_6_1() {
    check(&[
        ("06 001F 0064", "06 001F 0064"),
        ("06 0015 0064", "84 03"),
        ("03 0015 0001", "03 02 0063"),
        ("06 0015 0032", "06 0015 0032"),
        ("06 001F 0032", "84 03"),
        ("03 001F 0001", "03 02 0033"),
        ("06 0015 FF9C", "06 0015 FF9C"),
        ("06 001F FFCE", "06 001F FFCE"),
    ]);
}

#[test]
fn fixed_states_pass_by_everything_and_11111_is_automatic_again_6_1() {
    check(&[
        ("06 0045 0001", "06 0045 0001"),
        ("04 0001 0001", "04 02 0001"),
        ("06 0001 0000", "06 0001 0000"),
        ("04 0001 0009", "04 12 0000 0000 0000 0000 0000 0000 0000 0000 0000"),
        ("06 0009 00F1", "06 0009 00F1"),
        ("04 0009 0001", "04 02 00F0"),
        ("06 0001 2B67", "06 0001 2B67"),
        ("04 0009 0001", "04 02 00F1"),
        ("06 0009 2B67", "06 0009 2B67"),
        ("04 0001 0009", "04 12 0001 0000 0000 0000 0000 0000 0000 0000 0001"),
    ]);
}

#[test]
fn measured_values_switch_at_their_thresholds_6_1() {
    let mut bench = Bench::new(Model::Relay8);
    bench.check(&[("06 0020 00C8", "06 0020 00C8"), ("06 0016 0096", "06 0016 0096")]);
    for (measured, state) in
        [("00C7", 0), ("00C8", 1), ("0097", 1), ("0096", 0), ("00C7", 0), ("270F", 1), ("D8F1", 0)]
    {
        bench.ask(&format!("06 000C {measured}"));
        bench.check(&[("04 0002 0001", &format!("04 02 {state:04X}"))]);
    }
}

#[test]
fn measured_values_and_bits_of_register_19_displace_each_other_6_1() {
    check(&[
        ("06 000B 0001", "06 000B 0001"),
        ("06 0013 0003", "06 0013 0003"),
        ("03 000B 0003", "03 06 2B67 2B67 2B67"),
        ("04 0009 0001", "04 02 0003"),
        ("06 000B 0001", "06 000B 0001"),
        ("03 0013 0001", "03 02 0002"),
        ("06 000C 2B67", "06 000C 2B67"),
        ("03 0013 0001", "03 02 0002"),
        ("04 0009 0001", "04 02 0003"),
        ("06 0013 0000", "06 0013 0000"),
        ("03 000B 0001", "03 02 0001"),
        ("04 0009 0001", "04 02 0001"),
    ]);
}

/// Writes settings, then compares relay 1 at times after its demand.
#[track_caller]
fn check_times(settings: &[(u16, u16)], steps: &[(u64, Option<u16>, &str)]) {
    let mut bench = Bench::new(Model::Relay8);
    for (register, word) in settings {
        let request = format!("06 {register:04X} {word:04X}");
        bench.check(&[(&request, &request)]);
    }
    let mut elapsed = 0;
    for (at, wanted, state) in steps {
        bench.wait(at - elapsed);
        elapsed = *at;
        if let Some(wanted) = wanted {
            bench.ask(&format!("06 0013 {wanted:04X}"));
        }
        assert_eq!(bench.output("relay_1"), *state, "after {at} ms");
    }
}

#[test]
fn a_relay_switches_on_after_its_delay_and_off_after_its_run_on_time_6_1() {
    check_times(
        &[(51, 5), (61, 3)],
        &[
            (0, Some(1), "OFF"),
            (4999, None, "OFF"),
            (5000, None, "ON"),
            (6000, Some(0), "ON"),
            (8999, None, "ON"),
            (9000, None, "OFF"),
            // A demand that is shorter than the delay does nothing.
            (10_000, Some(1), "OFF"),
            (14_000, Some(0), "OFF"),
            (30_000, None, "OFF"),
            // One that comes back while the relay runs on goes on without a delay.
            (40_000, Some(1), "OFF"),
            (46_000, Some(0), "ON"),
            (47_000, Some(1), "ON"),
            (60_000, None, "ON"),
        ],
    );
}

#[test]
fn a_negated_relay_is_on_where_it_would_be_off_6_1() {
    check_times(&[(69, 1)], &[(0, None, "ON"), (10, Some(1), "OFF"), (20, Some(0), "ON")]);
}

#[test]
fn a_cycle_switches_on_for_its_first_half_from_the_moment_of_switching_on_6_1() {
    check_times(
        &[(71, 4), (51, 1)],
        &[
            (0, Some(1), "OFF"),
            // Nobody asked in between: the cycle counts from 1000 all the same.
            (2999, None, "ON"),
            (3000, None, "OFF"),
            (4999, None, "OFF"),
            (5000, None, "ON"),
            (7000, None, "OFF"),
            (9500, Some(0), "OFF"),
            (9600, None, "OFF"),
        ],
    );
}

#[test]
fn a_held_relay_stays_on_until_it_is_reset_and_the_command_is_0_again_6_1() {
    let mut bench = Bench::new(Model::Relay8);
    bench.check(&[
        ("06 0028 0007", "06 0028 0007"),
        ("06 0013 000F", "06 0013 000F"),
        ("06 0013 0004", "06 0013 0004"),
        ("04 0009 0001", "04 02 0007"),
        ("06 0029 0000", "06 0029 0000"),
        ("04 0009 0001", "04 02 0007"),
        ("06 0029 0001", "06 0029 0001"),
        ("03 0029 0001", "03 02 0000"),
        ("04 0009 0001", "04 02 0006"),
        // Relay 3 is still wanted: it stays on, and is held again.
        ("06 0031 00FF", "06 0031 00FF"),
        ("03 0031 0001", "03 02 0000"),
        ("04 0009 0001", "04 02 0004"),
        ("06 0013 0000", "06 0013 0000"),
        ("04 0009 0001", "04 02 0004"),
    ]);
}

#[test]
fn register_79_restarts_with_10_and_forgets_all_with_20_6_1() {
    let mut bench = Bench::new(Model::Relay8);
    bench.check(&[
        ("06 0000 4105", "06 0000 4105"),
        ("06 0024 0064", "06 0024 0064"),
        ("06 0001 0001", "06 0001 0001"),
        ("06 005A 1234", "06 005A 1234"),
        ("06 00C8 FF01", "06 00C8 FF01"),
        ("06 004F 000A", "06 004F 000A"),
        ("03 0000 0002", "03 04 4105 2B67"),
        ("04 0001 0001", "04 02 0000"),
        ("03 0024 0001", "03 02 0064"),
        ("03 005A 0001", "03 02 0000"),
        ("03 00C8 0001", "03 02 FF01"),
    ]);
    let kept = bench.device.eeprom();
    let mut other = Bench::new(Model::Relay8);
    other.device.load_eeprom(other.now, &kept).expect("an EEPROM of the same device");
    other.check(&[
        ("03 0000 0002", "03 04 4105 2B67"),
        ("03 0024 0001", "03 02 0064"),
        ("06 004F 0014", "06 004F 0014"),
        ("03 0000 0002", "03 04 5300 2B67"),
        ("03 0024 0001", "03 02 0001"),
        ("03 00C8 0001", "03 02 0000"),
    ]);
}

#[test]
fn special_registers_are_written_at_500_and_read_at_100_6_1() {
    check(&[
        ("10 01F4 0002 04 0102 0304", "10 01F4 0002"),
        ("06 0273 ABCD", "06 0273 ABCD"),
        ("04 0064 0002", "04 04 0102 0304"),
        ("04 00E3 0001", "04 02 ABCD"),
        ("06 0274 0000", "86 02"),
        ("10 005A 0002 04 1111 2222", "10 005A 0002"),
        ("03 005A 0002", "03 04 1111 2222"),
    ]);
}

#[test]
fn registers_that_name_the_device_itself_are_copied_always_chapter_7() {
    let mut bench = Bench::new(Model::Relay8);
    bench.check(&[
        // Rreg_01 to RWreg_90, and RWreg_00's neighbour 01 to RWreg_91.
        ("10 00C8 0004 08 FF01 FF5A FE01 FF5B", "10 00C8 0004"),
        ("03 005A 0002", "03 04 0000 2B67"),
        ("06 0001 0001", "06 0001 0001"),
        ("03 005A 0002", "03 04 0001 0001"),
        ("04 0064 0004", "04 08 0001 5300 0001 5300"),
    ]);
}

#[test]
fn a_broadcast_is_obeyed_and_not_answered_chapter_8() {
    let mut bench = Bench::new(Model::Relay8);
    assert_eq!(bench.send(Addressed::Broadcast, "06 0001 0001"), "silence");
    bench.check(&[("04 0001 0001", "04 02 0001")]);
}
