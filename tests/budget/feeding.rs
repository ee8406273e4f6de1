//! Watchdogs and heartbeats: what `busker check` forecasts of them, held against the program's own bus. A
//! watchdog is fed in time although its device is polled more seldom, the bus busy and another unit dead.

use busker::engine::time::{Duration, Time};
use serde_json::Value as Json;

use super::wire::Wire;
use super::{LINE, TURNAROUND, check, neighbours};

const WITHIN: f64 = 0.05;

/// A relay module with this watchdog and these polls, and seven units that are polled `others` often.
struct Case {
    what: &'static str,
    watchdog: &'static str,
    polls: &'static str,
    others: &'static str,
}

const CASES: [Case; 5] = [
    Case { what: "polled often enough", watchdog: "30s", polls: "fast: 1s, slow: 30s", others: "2s" },
    Case { what: "polled too seldom", watchdog: "3s", polls: "fast: 20s, slow: 60s", others: "10s" },
    Case {
        what: "polled a little too seldom",
        watchdog: "3s",
        polls: "fast: 1200ms, slow: 60s",
        others: "10s",
    },
    Case { what: "nearly too much", watchdog: "5s", polls: "fast: 10s, slow: 30s", others: "330ms" },
    Case { what: "a busy bus", watchdog: "2s", polls: "fast: 5s, slow: 60s", others: "100ms" },
];

impl Case {
    fn configuration(&self) -> String {
        let Case { watchdog, polls, others, .. } = self;
        let mut text = format!(
            "{LINE}  relays: {{bus: line, unit: 1, profile: metz-connect/mr-do4, poll: {{{polls}}}, \
             settings: {{watchdog: {watchdog}}}}}\n"
        );
        let points = neighbours(20);
        for unit in 2..=8 {
            text += &format!(
                "  unit_{unit}: {{bus: line, unit: {unit}, poll: {{fast: {others}}}, points: {{{points}}}}}\n"
            );
        }
        text
    }

    fn forecast(&self) -> Json {
        check(&self.configuration(), &[])["buses"][0].clone()
    }

    /// The bus once the watchdog is set, and everything in its step.
    fn wire(&self) -> Wire {
        let mut wire = Wire::new(&self.configuration(), TURNAROUND);
        wire.run_until(Time::from_millis(180_000));
        wire.asked.clear();
        wire
    }
}

fn seconds(of: &Json, name: &str) -> f64 {
    of[name].as_f64().unwrap_or_else(|| panic!("no {name} in {of}"))
}

#[test]
fn a_watchdog_is_fed_as_often_as_is_forecast_also_with_a_unit_dead() {
    for case in CASES {
        let forecast = case.forecast();
        let feeding = &forecast["devices"][0]["feeding"][0];
        let (fed, fed_one_silent) = (seconds(feeding, "fed_every"), seconds(feeding, "fed_every_one_silent"));
        assert_eq!(
            (&feeding["met"], &feeding["met_one_silent"]),
            (&true.into(), &true.into()),
            "{}",
            case.what
        );
        let mut wire = case.wire();
        let (mut calm, mut worst) = (0.0_f64, 0.0_f64);
        for number in 0..40 {
            wire.asked.clear();
            wire.run_until(wire.now + Duration::from_millis(20_000 + 317 * number));
            calm = calm.max(wire.longest_wait(1));
            wire.set_dead(5, true);
            wire.run_until(wire.now + Duration::from_millis(12_000));
            worst = worst.max(wire.longest_wait(1));
            wire.set_dead(5, false);
            wire.run_until(wire.now + Duration::from_millis(16_000));
        }
        let what = case.what;
        assert!(calm <= fed && calm > 0.5 * fed, "{what}: forecast {fed}, found {calm}");
        assert!(
            worst <= fed_one_silent && worst > 0.5 * fed_one_silent,
            "{what}: forecast {fed_one_silent}, found {worst}"
        );
    }
}

#[test]
fn what_watchdogs_cost_is_part_of_the_load_and_stretches_the_polls() {
    for case in CASES {
        let forecast = case.forecast();
        let load = seconds(&forecast, "load");
        let mut wire = case.wire();
        wire.run_until(Time::from_millis(600_000));
        let found = wire.bus.report(wire.now).load;
        let off = load.min(1.0) / found - 1.0;
        assert!(off.abs() <= WITHIN, "{}: forecast {load:.4}, found {found:.4}", case.what);
        let real = seconds(&forecast["devices"][4]["polls"]["fast"], "real_period");
        let found = wire.periods()[&(5, 0)];
        assert!((real / found - 1.0).abs() <= WITHIN, "{}: forecast {real:.4}, found {found:.4}", case.what);
    }
}

#[test]
fn what_heartbeats_cost_is_part_of_the_load() {
    // One channel moves a damper with a motor; the register of its time holds tenths of a second.
    let (mode, time, motor) = (2, 8, 1);
    let dampers = |settings: &str| {
        format!(
            "{LINE}  dampers: {{bus: line, unit: 1, profile: metz-connect/mr-dio42, \
             poll: {{fast: 5s, slow: 60s}}{settings}}}\n"
        )
    };
    let loads = |settings: &str, held: u16| {
        let configuration = dampers(settings);
        let mut wire = Wire::new(&configuration, TURNAROUND);
        wire.hold(1, mode, motor);
        wire.hold(1, time, held);
        wire.hold(1, 10, 1);
        wire.run_until(Time::from_millis(600_000));
        let forecast = check(&configuration, &[])["buses"][0].clone();
        (seconds(&forecast, "load"), wire.bus.report(wire.now).load)
    };
    let without = loads("", 0);
    let with = loads(", settings: {channel_1_receive_time: 900ms}", 9);
    let (forecast, found) = (with.0 - without.0, with.1 - without.1);
    assert!(found > 0.05, "{found}");
    assert!((forecast / found - 1.0).abs() <= WITHIN, "forecast {forecast:.4}, found {found:.4}");
}
