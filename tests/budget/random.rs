//! Configurations that nobody would write: what `busker check` forecasts of them is what the program's own bus does.
//!
//! `SEEDS=100 cargo test --test budget random` looks at more of them.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use busker::engine::time::{Duration, Time};
use fastrand::Rng;
use serde_json::Value as Json;

use super::wire::Wire;
use super::{by_magnitude, check, number};

const SEEDS: u64 = 12;
const WITHIN: f64 = 0.05;
/// What has come round more seldom has no mean to speak of, where the bus is not in time.
const ROUNDS: usize = 12;
/// The slow reads of a unit are far from its fast ones.
const SLOW_FROM: u16 = 500;

fn log(random: &mut Rng, from: f64, to: f64) -> u64 {
    by_magnitude(random.f64(), from, to)
}

fn one_of<T: Copy>(random: &mut Rng, all: &[T]) -> T {
    *random.choice(all).expect("some")
}

pub struct Case {
    pub configuration: String,
    pub turnaround: u64,
    /// The silence that each unit wants, in seconds.
    pub delays: Vec<f64>,
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
    let mut delays = Vec::new();
    let mut configuration = format!("buses:\n  line: {{{link}, response_timeout: 500ms}}\ndevices:\n");
    for unit in 1..=units {
        let fast = log(random, 30.0, 3000.0) * busy;
        let slow = fast * (1 + random.u64(..15));
        let delay = if random.u64(..4) == 0 { log(random, 5.0, 200.0) } else { 0 };
        delays.push(delay as f64 / 1e3);
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
    Case { configuration, turnaround, delays }
}

/// So many cases, and one of them is a network; and so many, and one of them has a device with a watchdog.
const NETWORK_EACH: u64 = 5;
const WATCHDOG_EACH: u64 = 3;
const RELAYS: u8 = 40;

#[test]
fn what_is_forecast_of_any_configuration_is_what_its_bus_does() {
    let seeds = number("SEEDS").unwrap_or(SEEDS);
    let (next, compared) = (AtomicU64::new(0), AtomicUsize::new(0));
    let faults: Vec<String> = std::thread::scope(|scope| {
        let work = || {
            let mut faults = Vec::new();
            loop {
                match next.fetch_add(1, Ordering::Relaxed) {
                    seed if seed < seeds => faults.extend(faults_of(seed, &compared)),
                    _ => return faults,
                }
            }
        };
        let threads: Vec<_> = (0..2).map(|_| scope.spawn(work)).collect();
        threads.into_iter().flat_map(|thread| thread.join().expect("no fault in the test")).collect()
    });
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    let compared = compared.into_inner();
    assert!(seeds < SEEDS || compared > 0, "no bus was too busy");
}

/// `compared` counts the periods that were held against each other.
fn faults_of(seed: u64, compared: &AtomicUsize) -> Vec<String> {
    let Case { configuration, turnaround, delays } = case(seed);
    let units = delays.len() as u8;
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
        let stretches = stretches(&delays, &forecast, &wire, &counts);
        faults.extend(fault_of_stretches(seed, &stretches));
        // One alone is as slow as itself.
        if stretches.len() > 1 {
            compared.fetch_add(stretches.len(), Ordering::Relaxed);
        }
    }
    let feeding = &forecast["devices"][usize::from(units)]["feeding"][0];
    if feeding.is_object() {
        faults.extend(faults_of_feeding(seed, units, feeding, &mut wire));
    }
    faults
}

/// By how much the periods are longer than they should be, but for those of a unit that its silence keeps from its share.
fn stretches(delays: &[f64], forecast: &Json, wire: &Wire, counts: &BTreeMap<(u8, u16), usize>) -> Vec<f64> {
    let mut stretches = Vec::new();
    for ((unit, address), found) in wire.periods() {
        if counts[&(unit, address)] >= ROUNDS_OF_STRETCH && unit != RELAYS {
            let class = if address >= SLOW_FROM { "slow" } else { "fast" };
            let period = &forecast["devices"][usize::from(unit) - 1]["polls"][class]["period"];
            stretches.push((unit, found / period.as_f64().expect("a period")));
        }
    }
    let least = stretches.iter().map(|(_, stretch)| *stretch).fold(f64::MAX, f64::min);
    stretches.retain(|(unit, _)| slower_for_its_silence(*unit, delays, forecast) < least * (1.0 - WITHIN));
    stretches.into_iter().map(|(_, stretch)| stretch).collect()
}

/// All are stretched by the same factor.
fn fault_of_stretches(seed: u64, stretches: &[f64]) -> Option<String> {
    let least = stretches.iter().copied().fold(f64::MAX, f64::min);
    let most = stretches.iter().copied().fold(0.0, f64::max);
    println!("seed {seed}: {} reads, stretched by {least:.3} to {most:.3}", stretches.len());
    (most > least * (1.0 + WITHIN)).then(|| format!("seed {seed}: stretched by {stretches:.3?}"))
}

/// By how much longer a unit's periods are at least, for the silence that it wants: nobody waits for its end, and what
/// another one is asked meanwhile may last beyond it.
fn slower_for_its_silence(unit: u8, delays: &[f64], forecast: &Json) -> f64 {
    let of_class = |polls: &Json| ["reads", "seconds", "period"].map(|name| polls[name].as_f64());
    let classes = |index: usize| {
        let polls = &forecast["devices"][index]["polls"];
        ["fast", "slow"].into_iter().filter_map(move |class| match of_class(&polls[class]) {
            [Some(reads), Some(seconds), Some(period)] => Some((reads, seconds, period)),
            _ => None,
        })
    };
    let index = usize::from(unit) - 1;
    if delays[index] == 0.0 {
        return 0.0;
    }
    let others = (0..delays.len()).filter(|other| *other != index);
    let longest = others.flat_map(classes).map(|(reads, seconds, _)| seconds / reads).fold(0.0, f64::max);
    let wanted = |(reads, seconds, period)| (seconds + reads * (delays[index] + longest)) / period;
    classes(index).map(wanted).sum()
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
