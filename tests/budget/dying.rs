//! A unit dies at the worst moment for a watchdog: before the relays are polled, all its reads may be due. And there may
//! be many watchdogs, all of which are due when it is over.

use std::fmt::Write;

use busker::engine::time::{Duration, Time};

use super::wire::Wire;
use super::{LINE, TURNAROUND, check, neighbours};

/// Of this device's watchdog, in seconds.
fn fed_every_one_silent(configuration: &str, device: usize) -> f64 {
    let forecast = check(configuration, &[])["buses"][0]["devices"][device]["feeding"][0].clone();
    forecast["fed_every_one_silent"].as_f64().unwrap_or_else(|| panic!("no time in {forecast}"))
}

#[test]
fn a_watchdog_that_only_polls_feed_waits_for_each_read_of_a_unit_that_dies() {
    for reads in 1..=4_u16 {
        // Far from each other, and due together.
        let points: Vec<String> = (0..reads)
            .map(|number| format!("p{number}: {{at: holding {}, type: u16, poll: fast}}", 1000 * number))
            .collect();
        let mut configuration = format!(
            "{LINE}  relays: {{bus: line, unit: 1, profile: metz-connect/mr-do4, poll: {{fast: 600ms, slow: 60s}}}}\n  \
             meter: {{bus: line, unit: 2, poll: {{fast: 10s}}, points: {{{}}}}}\n",
            points.join(", ")
        );
        // These are asked while the meter alone is left alone.
        let held = neighbours(40);
        for unit in 3..=6 {
            let _ = writeln!(
                configuration,
                "  unit_{unit}: {{bus: line, unit: {unit}, poll: {{fast: 290ms}}, points: {{{held}}}}}"
            );
        }
        let forecast = fed_every_one_silent(&configuration, 0);
        let mut wire = Wire::new(&configuration, TURNAROUND);
        wire.run_until(Time::from_millis(60_000));
        let mut worst = 0.0_f64;
        for number in 0..30 {
            // Shortly before the meter is asked again.
            let last = wire.asked.iter().rev().find(|asked| asked.unit == 2).expect("it is polled").at;
            let soon = last + Duration::from_millis(9_500 + 7 * number);
            if soon > wire.now {
                wire.run_until(soon);
            }
            wire.set_dead(2, true);
            wire.asked.retain(|asked| wire.now.since(asked.at) < Duration::from_secs(2));
            wire.run_until(wire.now + Duration::from_secs(9));
            worst = worst.max(wire.longest_wait(1));
            wire.set_dead(2, false);
            wire.run_until(wire.now + Duration::from_secs(31));
        }
        println!("{reads} reads: forecast {forecast}, found {worst}");
        assert!(
            worst <= forecast && worst > 0.7 * forecast,
            "{reads} reads: forecast {forecast}, found {worst}"
        );
    }
}

#[test]
fn many_watchdogs_are_fed_as_soon_as_is_forecast_when_a_unit_dies() {
    const WATCHDOGS: u8 = 24;
    let mut configuration = LINE.to_string();
    for unit in 1..=WATCHDOGS {
        let _ = writeln!(
            configuration,
            "  relays_{unit}: {{bus: line, unit: {unit}, profile: metz-connect/mr-do4, poll: {{fast: 20s, slow: 60s}}, \
             settings: {{watchdog: 4s}}}}"
        );
    }
    let points = neighbours(100);
    let _ = writeln!(
        configuration,
        "  meter: {{bus: line, unit: 40, poll: {{fast: 700ms}}, points: {{{points}}}}}"
    );
    let forecast = fed_every_one_silent(&configuration, 0);
    let mut wire = Wire::new(&configuration, TURNAROUND);
    wire.run_until(Time::from_millis(120_000));
    let mut worst = 0.0_f64;
    for number in 0..30_u64 {
        let dead = if number % 2 == 0 { 40 } else { 1 + (number % 24) as u8 };
        wire.run_until(wire.now + Duration::from_millis(9_000 + 137 * number));
        wire.asked.clear();
        wire.set_dead(dead, true);
        wire.run_until(wire.now + Duration::from_secs(12));
        let others = (1..=WATCHDOGS).filter(|unit| *unit != dead);
        worst = worst.max(others.map(|unit| wire.longest_wait(unit)).fold(0.0, f64::max));
        wire.set_dead(dead, false);
    }
    println!("forecast {forecast}, found {worst}");
    assert!(worst <= forecast && worst > 0.5 * forecast, "forecast {forecast}, found {worst}");
}
