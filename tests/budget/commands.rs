//! How long a command waits at most, on buses that nobody would build: as `busker check` forecasts it, and found with
//! commands that come at the worst moments, while all units answer and while one is dead.

use busker::engine::time::{Duration, Time};

use super::random::{Case, case};
use super::wire::Wire;
use super::{check, number};

/// Every unit has a point that can be written.
fn writable(configuration: &str) -> String {
    let first = "f0: {at: holding 0, type: u16, poll: fast}";
    configuration.replace(first, "f0: {at: holding 0, type: u16, poll: fast, write: 0..65535}")
}

/// Lets a command come, and tells how long it waits in seconds.
fn wait_of_command(wire: &mut Wire, unit: u8, value: u16) -> f64 {
    let (came_at, before) = (wire.now, wire.ever.len());
    wire.command(&format!("unit_{unit}"), "f0", value);
    let is_written = |wire: &Wire| {
        wire.ever[before..]
            .iter()
            .find(|asked| asked.function == 6 && asked.unit == unit)
            .map(|asked| asked.at)
    };
    loop {
        if let Some(at) = is_written(wire) {
            return at.since(came_at).as_secs_f64();
        }
        assert!(wire.now < came_at + Duration::from_secs(60), "it is never written");
        wire.run_until(wire.now + Duration::from_millis(20));
    }
}

/// Until something has just been asked of this unit, if that is soon.
fn until_asked(wire: &mut Wire, unit: u8) {
    let latest = wire.now + Duration::from_secs(20);
    let mut seen = wire.ever.len();
    while wire.now < latest && !wire.ever[seen..].iter().any(|asked| asked.unit == unit) {
        seen = wire.ever.len();
        wire.run_until(wire.now + Duration::from_millis(1));
    }
}

/// The longest wait of commands that come when a request has just gone out, to each unit: while all answer, and while
/// the one that was asked is dead.
fn longest_waits(wire: &mut Wire, units: u8) -> [f64; 2] {
    let (mut calm, mut one_silent) = (0.0_f64, 0.0_f64);
    let pairs = |number: u8| {
        let asked = 1 + number % units;
        (asked, 1 + (asked + number / units) % units)
    };
    let mut value = 0;
    let mut wait = |wire: &mut Wire, unit: u8| {
        value += 1;
        wait_of_command(wire, unit, value)
    };
    for number in 0..COMMANDS {
        let (asked, commanded) = pairs(number);
        wire.run_until(wire.now + Duration::from_millis(300 + 37 * u64::from(number)));
        until_asked(wire, asked);
        calm = calm.max(wait(wire, commanded));
    }
    wire.run_until(wire.now + Duration::from_secs(5));
    for (asked, commanded) in (0..COMMANDS).map(pairs).filter(|(asked, commanded)| asked != commanded) {
        wire.set_dead(asked, true);
        until_asked(wire, asked);
        // The one before has been read back: none waits for another.
        for pause in [0, 4_000, 4_170] {
            wire.run_until(wire.now + Duration::from_millis(pause));
            one_silent = one_silent.max(wait(wire, commanded));
        }
        wire.set_dead(asked, false);
        // Until it is known to be back.
        wire.run_until(wire.now + Duration::from_secs(20));
    }
    [calm, one_silent]
}

const COMMANDS: u8 = 40;
const SEEDS: u64 = 12;
/// The wire rounds up to microseconds.
const ROUNDING: f64 = 0.000_01;

#[test]
fn no_command_waits_longer_than_is_forecast_on_any_bus() {
    let seeds = number("SEEDS").unwrap_or(SEEDS);
    let mut faults = Vec::new();
    let (mut all, mut near) = (0, 0);
    for seed in 0..seeds {
        let Case { configuration, turnaround, delays } = case(seed);
        let units = delays.len() as u8;
        let configuration = writable(&configuration);
        let told = check(&configuration, &["--turnaround", &format!("{turnaround}ms")])["buses"][0].clone();
        let mut wire = Wire::new(&configuration, Duration::from_millis(turnaround));
        wire.run_until(Time::from_millis(90_000));
        let found = longest_waits(&mut wire, units);
        for (what, found) in ["command_wait", "command_wait_one_silent"].into_iter().zip(found) {
            let forecast = told[what].as_f64().expect("a time");
            println!(
                "seed {seed}: {what}: forecast {forecast:.4}, found {found:.4}: {:.3}",
                found / forecast
            );
            all += 1;
            near += usize::from(found > forecast * 0.95);
            if found > forecast + ROUNDING {
                faults.push(format!("seed {seed}: {what}: forecast {forecast:.4}, found {found:.4}"));
            }
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    // The longest request of some is seldom on the wire.
    assert!(near * 2 > all, "{near} of {all} are near");
}
