//! What the sensor does by itself with what it measures: volume flows, movements, the relay, extremes and
//! calibration (pages 7, 11 and 12).

use super::{bench, hex};
use crate::simulator::testing::Bench;

#[test]
fn the_volume_flow_follows_from_the_pressure_or_from_speed_and_cross_section_page_11() {
    let mut bench = bench();
    bench.around(&["measure pressure 60", "measure flow 2"]);
    bench.wait(10_000);
    let flows = |bench: &mut Bench| bench.ask("04 0028 0006");
    let words = |flows: [i32; 6]| format!("040C{}", flows.map(hex).concat());
    // √(60 Pa · 2 / 1.2) is 10; k is 75.
    assert_eq!(flows(&mut bench), words([750, 13, 0, 9999, 9999, 208]));
    bench.set(24, 0);
    assert_eq!(flows(&mut bench), words([0; 6]));
    bench.around(&["measure pressure 100"]);
    bench.wait(10_000);
    bench.set(24, 1001);
    assert_eq!(flows(&mut bench), words([10, 0, 0, 9999, 167, 3]));
    bench.around(&["measure pressure -100"]);
    bench.wait(10_000);
    assert_eq!(flows(&mut bench), words([0; 6]));
    // 2 m/s · 3600 · 500 cm² / 10000.
    bench.set(48, 500);
    assert_eq!(flows(&mut bench), words([360, 6, 0, 9999, 6000, 100]));
}

#[test]
fn a_movement_lasts_its_run_on_time_and_counts_in_the_dark_alone_where_that_is_set_page_12() {
    let mut bench = bench();
    bench.around(&["measure light 200", "motion"]);
    bench.is(4, 35, 1);
    bench.wait(40_000);
    bench.around(&["motion"]);
    bench.wait(59_999);
    bench.is(4, 35, 1);
    bench.wait(1);
    bench.is(4, 35, 0);
    bench.set(33, 200);
    bench.around(&["motion"]);
    bench.is(4, 35, 0);
    bench.around(&["measure light 199", "motion"]);
    bench.is(4, 35, 1);
    bench.wait(60_000);
    // RWreg_34: by the kilolux, of which 199 lx are 0.2.
    bench.set(33, 2);
    bench.around(&["motion"]);
    bench.is(4, 35, 0);
    bench.set(34, 31);
    bench.around(&["measure light 140", "motion"]);
    bench.is(4, 35, 1);
    bench.set(32, 0);
    bench.wait(60_000);
    bench.around(&["motion"]);
    bench.is(4, 35, 0);
}

#[test]
fn a_movement_that_is_written_goes_back_to_11111_after_the_run_on_time_page_7() {
    let mut bench = bench();
    bench.set(32, 5);
    bench.set(35, 1);
    bench.is(4, 35, 1);
    bench.wait(4_999);
    bench.is(3, 35, 1);
    bench.wait(1);
    bench.is(3, 35, 11111);
    bench.is(4, 35, 0);
    bench.set(35, 0);
    bench.around(&["motion"]);
    bench.is(4, 35, 0);
    bench.wait(5_000);
    bench.is(3, 35, 11111);
}

#[test]
fn the_relay_switches_by_a_reading_when_its_condition_has_held_long_enough_pages_7_and_12() {
    let mut bench = bench();
    // CO2, off at 800 and below, on at 1000 and above.
    bench.set(53, 1000);
    bench.set(52, 800);
    bench.set(51, 10);
    for (ppm, on) in [(999, 0), (1000, 1), (801, 1), (800, 0), (999, 0)] {
        bench.around(&[&format!("measure co2 {ppm}")]);
        bench.is(4, 50, on);
    }
    bench.set(55, 10);
    bench.set(54, 20);
    bench.around(&["measure co2 1200"]);
    bench.wait(9_000);
    // Interrupted, it begins anew.
    bench.around(&["measure co2 900", "measure co2 1200"]);
    bench.wait(9_999);
    bench.is(4, 50, 0);
    assert_eq!(bench.output("relay"), "OFF");
    bench.wait(1);
    bench.is(4, 50, 1);
    assert_eq!(bench.output("relay"), "ON");
    bench.around(&["measure co2 700"]);
    bench.wait(19_999);
    bench.is(4, 50, 1);
    bench.wait(1);
    bench.is(4, 50, 0);
    bench.set(50, 1);
    assert_eq!(bench.output("relay"), "ON");
    bench.set(50, 11111);
    assert_eq!(bench.output("relay"), "OFF");
    // What is no measured value switches nothing.
    bench.around(&["measure co2 1500"]);
    bench.wait(10_000);
    bench.is(4, 50, 1);
    bench.set(51, 7);
    bench.is(4, 50, 0);
}

#[test]
fn delays_count_from_the_moment_of_the_change_however_seldom_anybody_asks_page_12() {
    let mut bench = bench();
    bench.set(51, 35);
    bench.set(55, 10);
    bench.set(54, 20);
    bench.set(57, 50);
    bench.around(&["motion"]);
    // On from 10 s, the movement ends at 60 s, off at 80 s: nobody looked in between.
    bench.wait(100_000);
    bench.is(4, 50, 0);
    bench.check(&[("04 0037 0002", "04 04 0000 0001")]);
}

#[test]
fn the_least_and_greatest_value_slide_over_the_hours_of_rwreg_59_page_12() {
    let mut bench = bench();
    const HOUR: u64 = 3_600_000;
    bench.around(&["measure temperature 20", "measure co2 500"]);
    bench.set(57, 2);
    bench.set(58, 10);
    bench.set(59, 1);
    let told = |bench: &mut Bench, low: i32, high: i32| {
        bench.check(&[("04 0037 0002", &format!("04 04 {}{}", hex(low), hex(high)))]);
    };
    for (celsius, low, high) in [("25", 200, 250), ("18", 180, 250), ("22", 180, 250)] {
        bench.wait(HOUR / 4);
        bench.around(&[&format!("measure temperature {celsius}")]);
        told(&mut bench, low, high);
    }
    bench.check(&[("04 0039 0002", "04 04 01F4 01F4")]);
    // 20 °C ended a quarter after the start, 25 °C after two, 18 °C after three.
    for (wait, low, high) in
        [(HOUR / 2 - 1, 180, 250), (HOUR / 4 + 1, 180, 220), (HOUR / 4, 220, 220), (HOUR, 220, 220)]
    {
        bench.wait(wait);
        told(&mut bench, low, high);
    }
    bench.around(&["measure temperature 30"]);
    told(&mut bench, 220, 300);
    // A value written to RWreg_59 clears, be it the same.
    bench.set(59, 1);
    told(&mut bench, 300, 300);
    bench.around(&["measure temperature -5"]);
    told(&mut bench, -50, 300);
    // Another quantity begins anew, and 0 or no measured value is none.
    bench.set(57, 1);
    told(&mut bench, 450, 450);
    bench.set(57, 19);
    told(&mut bench, 0, 0);
}

#[test]
fn a_calibration_by_hand_sets_fresh_air_and_clears_its_bit_page_11() {
    let mut bench = bench();
    bench.around(&["measure co2 650", "measure voc 30", "measure oxygen 19"]);
    bench.set(19, 0x07);
    bench.is(4, 19, 0x07);
    bench.wait(9_999);
    bench.is(4, 10, 650);
    bench.wait(1);
    bench.is(4, 19, 0);
    bench.is(3, 19, 0);
    for (register, value) in [(10, 400), (11, 100), (15, 209)] {
        bench.is(4, register, value);
    }
    bench.around(&["measure co2 750"]);
    bench.is(4, 10, 500);
    bench.act("restart").expect("a command");
    bench.is(4, 10, 500);
    bench.set(79, 20);
    bench.is(4, 10, 750);
    // Bit 3 means nothing.
    bench.set(19, 0x78);
    bench.is(3, 19, 0x70);
}

#[test]
fn a_gas_calibrates_itself_after_seven_days_and_when_it_reads_too_low_pages_11_and_12() {
    let mut bench = bench();
    const DAY: u64 = 24 * 3_600_000;
    bench.around(&["measure co2 450", "measure oxygen 20"]);
    // The seven days begin when it is switched on.
    bench.set(19, 0);
    bench.set(19, 0x70);
    bench.wait(3 * DAY);
    bench.around(&["measure co2 900", "measure oxygen 19"]);
    bench.wait(4 * DAY - 1);
    bench.is(4, 10, 900);
    bench.wait(1);
    // The lowest reading is now 400, the greatest oxygen 20.9.
    bench.is(4, 10, 850);
    bench.is(4, 15, 199);
    // Fresh air is reached, so nothing changes.
    bench.around(&["measure co2 350"]);
    bench.wait(DAY);
    bench.around(&["measure co2 900"]);
    bench.wait(7 * DAY);
    bench.is(4, 10, 850);
    // Not in AUTO mode.
    bench.set(19, 0);
    bench.wait(8 * DAY);
    bench.is(4, 10, 850);

    let mut bench = super::bench();
    bench.around(&["measure co2 299", "measure voc 4.9"]);
    bench.wait(599_999);
    bench.is(4, 10, 299);
    bench.wait(1);
    bench.is(4, 10, 400);
    bench.is(4, 11, 100);
    bench.set(19, 0);
    bench.around(&["measure co2 100"]);
    bench.wait(1_000_000);
    bench.is(4, 10, 201);
}
