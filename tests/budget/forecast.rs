//! What `busker check` forecasts, held against the program's own bus on a wire that charges what a line
//! charges: the configurations of the benchmark, and some that nobody would write.

use std::fmt::Write;

use busker::engine::time::{Duration, Time};
use serde_json::Value as Json;

use super::check;
use super::wire::Wire;

/// A line of configuration for the bus, and the devices with these points and poll sections.
struct Case {
    what: &'static str,
    bus: &'static str,
    turnaround: &'static str,
    devices: Vec<(String, String)>,
}

impl Case {
    fn configuration(&self) -> String {
        let mut text =
            format!("buses:\n  line: {{serial: /dev/serial/by-id/usb-A, {}}}\ndevices:\n", self.bus);
        for (number, (poll, points)) in self.devices.iter().enumerate() {
            let unit = number + 1;
            let _ = writeln!(
                text,
                "  unit_{unit}: {{bus: line, unit: {unit}, poll: {{{poll}}}, points: {{{points}}}}}"
            );
        }
        text
    }

    fn turnaround(&self) -> Duration {
        let millis = self.turnaround.strip_suffix("ms").and_then(|millis| millis.parse().ok());
        Duration::from_millis(millis.expect("milliseconds"))
    }

    fn forecast(&self) -> Json {
        check(&self.configuration(), &["--turnaround", self.turnaround])["buses"][0].clone()
    }

    fn wire(&self) -> Wire {
        Wire::new(&self.configuration(), self.turnaround())
    }
}

const W1: &str = "baud: 19200, parity: even, response_timeout: 500ms";
const W8: &str = "baud: 115200, parity: none, response_timeout: 500ms";

/// Behind a poll section.
const DELAY: &str = "}, wire: {limits: {delay: 50ms}";

/// Twenty registers, in one piece or in four of five with gaps of three; the first one can be written.
fn twenty(gapless: bool, poll: &str) -> String {
    let register = |number: usize| if gapless { number } else { number / 5 * 8 + number % 5 };
    let write = |number: usize| if number == 0 { ", write: 0..65535" } else { "" };
    let point = |number: usize| {
        format!(
            "{poll}{number}: {{at: holding {}, type: u16, poll: {poll}{}}}",
            register(number),
            write(number)
        )
    };
    (0..20).map(point).collect::<Vec<_>>().join(", ")
}

/// Some registers far from those of [`twenty`].
fn more(count: usize, poll: &str) -> String {
    let point = |number| format!("{poll}{number}: {{at: input {}, type: u16, poll: {poll}}}", 500 + number);
    (0..count).map(point).collect::<Vec<_>>().join(", ")
}

fn cases() -> Vec<Case> {
    let ten = |poll: &str, points: String| vec![(poll.to_string(), points); 10];
    let mixed = |fast: &str, slow: &str| -> Vec<(String, String)> {
        (0..6)
            .map(|number| {
                let poll = format!("fast: {fast}, slow: {slow}");
                (poll, format!("{}, {}", more(2 + number, "fast"), twenty(true, "slow")))
            })
            .collect()
    };
    let with_one_resting = |fast: &str, slow: &str| {
        let mut devices = mixed(fast, slow);
        devices[0] = (format!("fast: 20ms, slow: {slow}{DELAY}"), more(2, "fast"));
        devices
    };
    vec![
        Case { what: "W1", bus: W1, turnaround: "5ms", devices: ten("fast: 1ms", twenty(true, "fast")) },
        Case { what: "W2", bus: W1, turnaround: "5ms", devices: ten("fast: 1ms", twenty(false, "fast")) },
        Case { what: "W7", bus: W1, turnaround: "5ms", devices: ten("fast: 10s", twenty(true, "fast")) },
        Case { what: "W8", bus: W8, turnaround: "1ms", devices: ten("fast: 1ms", twenty(true, "fast")) },
        Case {
            what: "slow units",
            bus: W1,
            turnaround: "40ms",
            devices: ten("fast: 1ms", twenty(false, "fast")),
        },
        Case {
            what: "units that want silence, while which others are asked",
            bus: W1,
            turnaround: "5ms",
            devices: ten(
                &format!("fast: 300ms{DELAY}"),
                format!(
                    "{}, {}",
                    twenty(true, "fast"),
                    more(2, "fast").replace("fast", "far").replace("poll: far", "poll: fast")
                ),
            ),
        },
        Case {
            what: "two units that want more silence than their periods leave them",
            bus: W1,
            turnaround: "5ms",
            devices: ten(&format!("fast: 60ms{DELAY}"), twenty(true, "fast"))[..2].to_vec(),
        },
        Case {
            what: "a unit that wants silence and has the line for itself",
            bus: W1,
            turnaround: "5ms",
            devices: ten(&format!("fast: 20ms{DELAY}"), twenty(true, "fast"))[..1].to_vec(),
        },
        Case {
            what: "two classes, time to spare",
            bus: W1,
            turnaround: "5ms",
            devices: mixed("500ms", "5s"),
        },
        Case {
            what: "two classes, hardly enough",
            bus: W1,
            turnaround: "5ms",
            devices: mixed("170ms", "3s"),
        },
        Case {
            what: "one unit of six wants more silence than its periods leave it",
            bus: W1,
            turnaround: "5ms",
            devices: with_one_resting("250ms", "5s"),
        },
        Case {
            what: "one of six wants silence, and all are too slow",
            bus: W1,
            turnaround: "5ms",
            devices: with_one_resting("100ms", "1s"),
        },
        Case { what: "two classes, too slow", bus: W1, turnaround: "5ms", devices: mixed("100ms", "1s") },
        Case {
            what: "two classes, far too slow",
            bus: W1,
            turnaround: "5ms",
            devices: mixed("20ms", "700ms"),
        },
    ]
}

const RUN: Time = Time::from_millis(190_000);
const WITHIN: f64 = 0.05;

#[track_caller]
fn agree(what: &str, forecast: &Json, found: f64) {
    let forecast = forecast.as_f64().unwrap_or_else(|| panic!("{what}: no forecast"));
    let off = forecast / found - 1.0;
    assert!(off.abs() <= WITHIN, "{what}: forecast {forecast:.4}, found {found:.4}: {:+.1} %", off * 100.0);
}

#[test]
fn load_and_periods_are_those_of_the_running_bus() {
    for case in cases() {
        let forecast = case.forecast();
        let mut wire = case.wire();
        // Until its plans are those of the devices that there are.
        wire.run_until(Time::from_millis(60_000));
        wire.asked.clear();
        wire.run_until(RUN);
        let load = forecast["load"].as_f64().expect("a load").min(1.0);
        let told = wire.bus.report(wire.now);
        agree(&format!("{}: load", case.what), &load.into(), told.load);
        let of_devices: f64 = told.devices.iter().map(|device| device.load).sum();
        assert!((of_devices - told.load).abs() < 0.001, "{}: {of_devices}, {}", case.what, told.load);
        for ((unit, address), found) in wire.periods() {
            let class = if address >= 500 || case.devices[0].1.starts_with("fast0: {at: holding") {
                "fast"
            } else {
                "slow"
            };
            let polls = &forecast["devices"][usize::from(unit) - 1]["polls"];
            let what = format!("{}: {class} of unit {unit}", case.what);
            agree(&what, &polls[class]["real_period"], found);
        }
        // And what the bus itself says of them.
        for (number, device) in wire.bus.report(wire.now).devices.iter().enumerate() {
            for period in &device.periods {
                let real = period.real.expect("it has come round").as_secs_f64();
                let forecast = &forecast["devices"][number]["polls"][period.class.name()]["real_period"];
                let forecast = forecast.as_f64().expect("a forecast");
                let off = real / forecast - 1.0;
                assert!(off.abs() < 0.35, "{}: {} says {real}, forecast {forecast}", case.what, device.name);
            }
        }
    }
}

#[test]
fn an_overloaded_bus_stretches_every_period_of_every_unit_by_the_same_factor() {
    for case in cases().iter().filter(|case| case.what.ends_with("too slow")) {
        let mut wire = case.wire();
        wire.run_until(RUN);
        // How long a unit waits that wants silence, it decides itself.
        let rests = |unit: u8| case.devices[usize::from(unit) - 1].0.ends_with(DELAY);
        let stretches: Vec<f64> = wire
            .periods()
            .into_iter()
            .filter(|((unit, _), _)| !rests(*unit))
            .map(|((unit, address), found)| {
                let poll = &case.devices[usize::from(unit) - 1].0;
                let (fast, slow) = poll.split_once(", ").expect("two classes");
                let wanted = if address >= 500 { fast } else { slow };
                let wanted = wanted.split_once(": ").expect("a period").1;
                let seconds = match wanted.strip_suffix("ms") {
                    Some(millis) => millis.parse::<f64>().expect("a number") / 1000.0,
                    None => wanted.trim_end_matches('s').parse().expect("a number"),
                };
                found / seconds
            })
            .collect();
        let (least, most) = stretches
            .iter()
            .fold((f64::MAX, 0.0_f64), |(least, most), one| (least.min(*one), most.max(*one)));
        assert!(stretches.len() >= 10 && least > 1.3, "{}: {stretches:?}", case.what);
        assert!(most / least < 1.05, "{}: {stretches:?}", case.what);
    }
}

#[test]
fn no_command_waits_longer_than_is_forecast_and_the_worst_one_as_long() {
    for case in cases().iter().filter(|case| ["W1", "W2", "W8", "two classes, too slow"].contains(&case.what))
    {
        let forecast = case.forecast()["command_wait"].as_f64().expect("a time");
        let mut wire = case.wire();
        wire.run_until(Time::from_millis(20_000));
        let mut worst = 0.0_f64;
        let point = if case.what.starts_with("two") { "slow0" } else { "fast0" };
        for number in 0..400_u16 {
            // At moments that keep no step with the polls.
            wire.run_until(wire.now + Duration::from_micros(311_003 + 97 * u64::from(number)));
            let came_at = wire.now;
            wire.asked.clear();
            wire.command(&format!("unit_{}", number % 3 + 1), point, number + 1);
            wire.run_until(came_at + Duration::from_millis(150));
            let written = wire.asked.iter().find(|asked| asked.function == 6).expect("it is written");
            worst = worst.max(written.at.since(came_at).as_secs_f64());
        }
        let off = forecast / worst - 1.0;
        assert!((0.0..=WITHIN).contains(&off), "{}: forecast {forecast:.5}, worst {worst:.5}", case.what);
        let told = wire.bus.report(wire.now).timing.command_wait.expect("there were commands");
        let told = told.lately.expect("just now").p99.as_secs_f64();
        assert!((0.8..=1.001).contains(&(told / worst)), "{}: told {told}, worst {worst}", case.what);
    }
}

/// A relay module with a watchdog, and seven units that keep the line busy.
fn watched(poll: &str) -> String {
    let units = (2..=8).map(|unit| {
        let points = twenty(true, "fast");
        format!("  unit_{unit}: {{bus: line, unit: {unit}, poll: {{fast: 300ms}}, points: {{{points}}}}}\n")
    });
    format!(
        "buses:\n  line: {{serial: /dev/serial/by-id/usb-A, {W1}}}\ndevices:\n  \
         relays: {{bus: line, unit: 1, profile: metz-connect/mr-do4, poll: {{fast: {poll}}}, settings: {{watchdog: 30s}}}}\n"
    ) + &units.collect::<String>()
}

/// One of the busy units dies, and `meanwhile`; it comes back, and dies again at another moment.
fn dies_and_returns(wire: &mut Wire, times: u64, mut meanwhile: impl FnMut(&mut Wire, u64)) {
    wire.run_until(Time::from_millis(20_000));
    for number in 0..times {
        wire.asked.clear();
        wire.run_until(wire.now + Duration::from_millis(3_000 + 17 * number));
        wire.set_dead(5, true);
        meanwhile(wire, number);
        wire.set_dead(5, false);
        // It may die again before everything has been caught up with.
        wire.run_until(wire.now + Duration::from_millis(3_000 + 137 * number % 14_000));
    }
}

const POLLS: [&str; 2] = ["250ms", "1s"];

#[test]
fn no_watchdog_waits_longer_than_is_forecast_when_a_unit_dies() {
    for poll in POLLS {
        let forecast = check(&watched(poll), &[])["buses"][0]["devices"][0]["feeding"][0].clone();
        let seconds = |key: &str| forecast[key].as_f64().expect("a time");
        let (fed, fed_one_silent) = (seconds("fed_every"), seconds("fed_every_one_silent"));
        let mut wire = Wire::new(&watched(poll), Duration::from_millis(5));
        wire.run_until(Time::from_millis(20_000));
        wire.asked.clear();
        wire.run_until(Time::from_millis(200_000));
        let (calm, mut worst) = (wire.longest_wait(1), 0.0_f64);
        dies_and_returns(&mut wire, 60, |wire, _| {
            wire.run_until(wire.now + Duration::from_millis(9_000));
            worst = worst.max(wire.longest_wait(1));
        });
        assert!(calm <= fed && calm > 0.4 * fed, "{poll}: forecast {fed}, found {calm}");
        assert!(
            worst <= fed_one_silent && worst > 0.5 * fed_one_silent,
            "{poll}: forecast {fed_one_silent}, found {worst}"
        );
    }
}

#[test]
fn no_command_waits_longer_than_is_forecast_when_a_unit_dies() {
    for poll in POLLS {
        let forecast = check(&watched(poll), &[])["buses"][0]["command_wait_one_silent"].clone();
        let forecast = forecast.as_f64().expect("a time");
        let mut wire = Wire::new(&watched(poll), Duration::from_millis(5));
        let mut worst = 0.0_f64;
        dies_and_returns(&mut wire, 30, |wire, number| {
            for step in 0..4 {
                // The first one while the line waits for the first answer that does not come.
                let pause = if step == 0 { 31 + number * 37 % 300 } else { 701 + 41 * step };
                wire.run_until(wire.now + Duration::from_millis(pause));
                let came_at = wire.now;
                wire.command("unit_3", "fast0", (number * 4 + step + 1) as u16);
                wire.run_until(came_at + Duration::from_millis(1_500));
                let written = wire.asked.iter().find(|asked| asked.function == 6 && asked.at >= came_at);
                worst = worst.max(written.expect("it is written").at.since(came_at).as_secs_f64());
            }
        });
        assert!(worst <= forecast && worst > 0.8 * forecast, "{poll}: forecast {forecast}, found {worst}");
    }
}

#[test]
fn nor_does_a_watchdog_when_the_unit_dies_again_soon_after_its_return() {
    let configuration = watched("1s");
    let forecast = check(&configuration, &[])["buses"][0].clone();
    let fed = forecast["devices"][0]["feeding"][0]["fed_every_one_silent"].as_f64().expect("a time");
    let mut worst = 0.0_f64;
    for life in [500, 1_000, 2_000, 8_000] {
        let mut wire = Wire::new(&configuration, Duration::from_millis(5));
        wire.run_until(Time::from_millis(20_000));
        for number in 0..60 {
            wire.set_dead(5, true);
            wire.asked.clear();
            let dead = [3_000, 6_000, 9_000, 30_000][number as usize % 4] + 131 * (number % 7);
            wire.run_until(wire.now + Duration::from_millis(dead));
            worst = worst.max(wire.longest_wait(1));
            wire.set_dead(5, false);
            wire.run_until(wire.now + Duration::from_millis(life + 37 * number));
        }
    }
    // With a period less it would be too short.
    assert!(worst <= fed && worst > fed - 1.0, "forecast {fed}, found {worst}");
}

#[test]
fn what_is_advised_is_enough() {
    let case = cases().into_iter().find(|case| case.what == "two classes, too slow").expect("a case");
    let text = case.configuration();
    let told = check(&text, &[])["buses"][0]["advice"].clone();
    let advice: Vec<&str> = told.as_array().expect("a list").iter().filter_map(Json::as_str).collect();
    let period = advice[0].strip_prefix("poll the class `fast` every ").expect("the heaviest class");
    let period = period.strip_suffix(" instead of 100ms").expect("what it was");
    let baud =
        advice[1].strip_prefix("raise `baud` to ").and_then(|rest| rest.split_once(' ')).expect("a rate").0;
    let slower = text.replace("fast: 100ms", &format!("fast: {period}"));
    let faster = text.replace("baud: 19200", &format!("baud: {baud}"));
    for (what, text) in [("slower polls", slower), ("a faster line", faster)] {
        let bus = check(&text, &[])["buses"][0].clone();
        let load = bus["load"].as_f64().expect("a load");
        assert!((0.5..=0.901).contains(&load), "{what}: {load}");
        assert_eq!(bus["advice"].as_array().map(Vec::len), Some(0), "{what}");
    }
}
