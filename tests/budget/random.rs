//! Configurations that nobody would write: what `busker check` forecasts of them is what the program's own bus does.
//!
//! `SEEDS=100 cargo test --test budget random` looks at more of them.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::sync::atomic::{AtomicU64, Ordering};

use busker::engine::time::{Duration, Time};
use fastrand::Rng;
use serde_json::Value as Json;

use super::check;
use super::wire::Wire;

const SEEDS: u64 = 12;
const WITHIN: f64 = 0.05;
/// What has come round more seldom has no mean to speak of, where the bus is not in time.
const ROUNDS: usize = 12;
/// The slow reads of a unit are far from its fast ones.
const SLOW_FROM: u16 = 500;

/// One as likely between 1 and 10 as between 10 and 100.
fn log(random: &mut Rng, from: f64, to: f64) -> u64 {
    (from * libm::pow(to / from, random.f64())) as u64
}

fn one_of<T: Copy>(random: &mut Rng, all: &[T]) -> T {
    *random.choice(all).expect("some")
}

pub struct Case {
    pub configuration: String,
    pub turnaround: u64,
    pub units: u8,
}

pub fn case(seed: u64) -> Case {
    let random = &mut Rng::with_seed(seed);
    let baud = one_of(random, &[4800, 9600, 19200, 19200, 38400, 115_200]);
    let parity = one_of(random, &["none", "even"]);
    let turnaround = log(random, 1.0, 40.0);
    let busy = log(random, 1.0, 12.0);
    let units = 1 + random.u64(..12);
    let link = match seed % NETWORK_EACH {
        0 => "tcp: \"10.0.0.1:502\"".to_string(),
        _ => format!("serial: /dev/serial/by-id/usb-A, baud: {baud}, parity: {parity}"),
    };
    let mut configuration = format!("buses:\n  line: {{{link}, response_timeout: 500ms}}\ndevices:\n");
    for unit in 1..=units {
        let fast = log(random, 30.0, 3000.0) * busy;
        let slow = fast * (1 + random.u64(..15));
        let delay = if random.u64(..4) == 0 { log(random, 5.0, 200.0) } else { 0 };
        let apart = one_of(random, &[1, 1, 2, 9]);
        let mut points = Vec::new();
        for number in 0..1 + random.u64(..20) {
            points.push(format!("f{number}: {{at: holding {}, type: u16, poll: fast}}", number * apart));
        }
        for number in 0..random.u64(..12) {
            let address = u64::from(SLOW_FROM) + number * apart;
            points.push(format!("s{number}: {{at: input {address}, type: u16, poll: slow}}"));
        }
        let _ = writeln!(
            configuration,
            "  unit_{unit}: {{bus: line, unit: {unit}, poll: {{fast: {fast}ms, slow: {slow}ms}}, \
             wire: {{limits: {{delay: {delay}ms}}}}, points: {{{}}}}}",
            points.join(", ")
        );
    }
    if seed % WATCHDOG_EACH == 0 {
        let (watchdog, fast) = (one_of(random, &["2s", "5s", "30s"]), log(random, 300.0, 20_000.0));
        let _ = writeln!(
            configuration,
            "  relays: {{bus: line, unit: {RELAYS}, profile: metz-connect/mr-do4, \
             poll: {{fast: {fast}ms, slow: 60s}}, settings: {{watchdog: {watchdog}}}}}"
        );
    }
    Case { configuration, turnaround, units: units as u8 }
}

/// So many cases, and one of them is a network; and so many, and one of them has a device with a watchdog.
const NETWORK_EACH: u64 = 5;
const WATCHDOG_EACH: u64 = 3;
const RELAYS: u8 = 40;

#[test]
fn what_is_forecast_of_any_configuration_is_what_its_bus_does() {
    let seeds = std::env::var("SEEDS").ok().and_then(|seeds| seeds.parse().ok()).unwrap_or(SEEDS);
    let next = AtomicU64::new(0);
    let faults: Vec<String> = std::thread::scope(|scope| {
        let work = || {
            let mut faults = Vec::new();
            loop {
                match next.fetch_add(1, Ordering::Relaxed) {
                    seed if seed < seeds => faults.extend(faults_of(seed)),
                    _ => return faults,
                }
            }
        };
        let threads: Vec<_> = (0..2).map(|_| scope.spawn(work)).collect();
        threads.into_iter().flat_map(|thread| thread.join().expect("no fault in the test")).collect()
    });
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

fn faults_of(seed: u64) -> Vec<String> {
    let Case { configuration, turnaround, units } = case(seed);
    let forecast = check(&configuration, &["--turnaround", &format!("{turnaround}ms")])["buses"][0].clone();
    let mut wire = Wire::new(&configuration, Duration::from_millis(turnaround));
    wire.run_until(Time::from_millis(60_000));
    wire.asked.clear();
    // Slow lines and long periods take their time.
    let mut loads = Vec::new();
    while wire.now < Time::from_millis(1_200_000) && wire.asked.len() < 12_000 {
        wire.run_until(wire.now + Duration::from_secs(60));
        // That of the last minute, in which there may be hardly a request.
        loads.push(wire.bus.report(wire.now).load);
    }
    let mut faults = Vec::new();
    let mut agree = |what: &str, forecast: f64, found: f64| {
        let off = (forecast / found - 1.0) * 100.0;
        if off.abs() > WITHIN * 100.0 {
            faults
                .push(format!("seed {seed}: {what}: forecast {forecast:.4}, found {found:.4}: {off:+.1} %"));
        }
    };
    let seconds = |told: &Json| told.as_f64().expect("a time");
    let load = seconds(&forecast["load"]);
    agree("load", load.min(1.0), loads.iter().sum::<f64>() / loads.len() as f64);
    let mut counts: BTreeMap<(u8, u16), usize> = BTreeMap::new();
    wire.asked.iter().for_each(|asked| *counts.entry((asked.unit, asked.address)).or_default() += 1);
    let is_in_time = load < 0.95;
    let mut told = 0;
    for ((unit, address), found) in wire.periods() {
        if !is_in_time && counts[&(unit, address)] < ROUNDS {
            continue;
        }
        let class = if address >= SLOW_FROM { "slow" } else { "fast" };
        if unit == RELAYS {
            continue;
        }
        let polls = &forecast["devices"][usize::from(unit) - 1]["polls"][class];
        agree(&format!("{class} of unit {unit}"), seconds(&polls["real_period"]), found);
        told += 1;
    }
    assert!(told > 0, "seed {seed} shows nothing");
    if load > OVERLOADED {
        faults.extend(fault_of_stretches(seed, &configuration, &forecast, &wire, &counts));
    }
    let feeding = &forecast["devices"][usize::from(units)]["feeding"][0];
    if feeding.is_object() {
        faults.extend(faults_of_feeding(seed, units, feeding, &mut wire));
    }
    faults
}

/// All periods are stretched by the same factor, but for those of units that want silence: how long that makes them
/// wait, they decide themselves.
fn fault_of_stretches(
    seed: u64,
    configuration: &str,
    forecast: &Json,
    wire: &Wire,
    counts: &BTreeMap<(u8, u16), usize>,
) -> Option<String> {
    let rests = |unit: u8| {
        let unit = format!("  unit_{unit}:");
        !configuration.lines().any(|line| line.starts_with(&unit) && line.contains("delay: 0ms"))
    };
    let stretch = |unit: u8, address: u16, found: f64| {
        let class = if address >= SLOW_FROM { "slow" } else { "fast" };
        found
            / forecast["devices"][usize::from(unit) - 1]["polls"][class]["period"].as_f64().expect("a period")
    };
    let periods = wire.periods().into_iter();
    let counted =
        periods.filter(|(read, _)| counts[read] >= ROUNDS_OF_STRETCH && read.0 != RELAYS && !rests(read.0));
    let stretches: Vec<f64> = counted.map(|((unit, address), found)| stretch(unit, address, found)).collect();
    let least = stretches.iter().copied().fold(f64::MAX, f64::min);
    let most = stretches.iter().copied().fold(0.0, f64::max);
    println!("seed {seed}: {} reads, stretched by {least:.3} to {most:.3}", stretches.len());
    (most > least * (1.0 + WITHIN)).then(|| format!("seed {seed}: stretched by {stretches:.3?}"))
}

/// Where the load is said to be more than this every period is longer than it should be.
const OVERLOADED: f64 = 1.05;
/// What waits for a long request of others has no mean to speak of after a few rounds.
const ROUNDS_OF_STRETCH: usize = 40;

/// The watchdog waits no longer than is forecast, but nearly as long: while all answer, and while one unit after the other
/// dies, at moments that keep no step with the relays' polls, and returns.
fn faults_of_feeding(seed: u64, units: u8, feeding: &Json, wire: &mut Wire) -> Vec<String> {
    let mut faults = Vec::new();
    let mut at_most = |what: &str, found: f64| {
        let [time, forecast] = ["time", what].map(|name| feeding[name].as_f64().expect("a time"));
        let met = &feeding[what.replace("fed_every", "met")];
        println!("seed {seed}: {what}: forecast {forecast:.4}, found {found:.4} of {time}: {met}");
        let is_worse_than_told = met == true && found >= time;
        if found > forecast || found < forecast * NEARLY || is_worse_than_told {
            faults.push(format!("seed {seed}: {what} of {time} s: forecast {forecast:.4}, found {found:.4}"));
        }
    };
    at_most("fed_every", wire.longest_wait(RELAYS));
    let periods = wire.periods();
    let mut worst = 0.0_f64;
    for number in 0..DEATHS {
        wire.asked.clear();
        let unit = 1 + (number % u64::from(units)) as u8;
        wire.run_until(soon_before_its_rarest(wire, &periods, unit, 317 * number % 2_000));
        wire.set_dead(unit, true);
        wire.run_until(wire.now + Duration::from_millis(8_000));
        worst = worst.max(wire.longest_wait(RELAYS));
        wire.set_dead(unit, false);
        wire.run_until(wire.now + Duration::from_millis(12_000));
    }
    at_most("fed_every_one_silent", worst);
    faults
}

/// So long before the unit is asked for what it is asked for most seldom: then most of its reads are due together.
fn soon_before_its_rarest(wire: &Wire, periods: &Periods, unit: u8, millis: u64) -> Time {
    let of_unit = periods.iter().filter(|((of, _), _)| *of == unit);
    let ((_, rarest), period) = of_unit.max_by(|one, other| one.1.total_cmp(other.1)).expect("it is polled");
    let mut asked = wire.ever.iter().rev();
    let last = asked.find(|asked| (asked.unit, asked.address) == (unit, *rarest)).expect("it was asked");
    let mut moment = last.at;
    while moment < wire.now + Duration::from_millis(6_000 + millis) {
        moment += Duration::from_secs_f64(*period);
    }
    Time(moment.0 - millis * 1_000)
}

/// Seconds, by unit and address.
type Periods = BTreeMap<(u8, u16), f64>;

const DEATHS: u64 = 60;
/// What is forecast is the longest of all waits, and a test sees only some: seldom are all reads of a unit due when it
/// dies.
const NEARLY: f64 = 0.5;
