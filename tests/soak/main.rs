//! Hours of bus life with faults of every kind, in seconds: whatever is published was true between
//! the request and its answer, each command has one outcome, and nothing moves without a command.
//!
//! `SEEDS=100 cargo test --test soak -- life lives` lives a hundred times as long: what happens by chance is another
//! one with each seed. `FIRST_SEED=7 SEEDS=1` repeats one of them.

mod dead_unit;
mod device;
mod faults;
mod losses;
#[path = "../support/number.rs"]
mod number;
mod profiles;
mod refusals;
mod watched;
mod world;

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

use busker::engine::bus::{Command, Event};
use busker::engine::configuration;
use busker::engine::profile::Library;
use busker::engine::settings::Settings;
use busker::engine::time::{Duration, Time};
use busker::simulator::Fault;
use busker::simulator::device::SimulatedDevice;
use busker::simulator::script::Action;
use fastrand::Rng;

use device::{BLOCK, BLOCKS, Diary, STORED, Store, Timepiece, held};
use faults::FAULTS;
use number::number;
use world::{Published, World};

/// The units; the addresses between them belong to nobody, so that a device with a wrong address is
/// not taken for another one, as it would on any line.
const UNITS: [u8; 8] = [1, 3, 5, 7, 9, 11, 13, 15];
/// How much bus life each seed gets.
const LIFE: Duration = Duration::from_secs(15 * 60);
/// After the faults everything must be right again within this: what a device has refused is asked again after a
/// minute.
const CALM: Duration = Duration::from_secs(65);
/// A command waits for ten seconds, and is on the wire for a few more.
const COMMAND_LIFE: Duration = Duration::from_secs(20);

#[test]
fn an_hour_of_life_on_a_serial_line_brings_nothing_false() {
    live(4, Link::Serial, None);
}

#[test]
fn nor_does_a_life_behind_an_adapter_that_returns_every_request() {
    live(1, Link::Serial, Some("echo"));
}

#[test]
fn nor_does_half_an_hour_of_life_over_modbus_tcp() {
    live(2, Link::Tcp, None);
}

/// So many lives as usual, or those that are wanted.
fn live(usual: u64, link: Link, always: Option<&str>) {
    let seeds = Seeds::wanted(usual);
    let mut seen = Seen::default();
    for seed in seeds.all {
        println!("seed {seed}");
        Soak::new(seed, link, always).run(&mut seen);
    }
    println!("{seen:?}");
    if !seeds.are_enough {
        return;
    }
    assert!(FAULTS.iter().all(|kind| seen.faults.contains(*kind)), "{seen:?}");
    assert!(seen.values > 5_000 && seen.missing > 250, "{seen:?}");
    assert_eq!(seen.collisions > 0, link == Link::Serial, "{seen:?}");
    for kind in ["done", "no_reply", "expired", "refused"] {
        assert!(seen.outcomes.contains_key(kind), "no command was ever `{kind}`: {seen:?}");
    }
}

/// Which lives are lived.
struct Seeds {
    all: Range<u64>,
    /// Something of every kind happens in them: in the usual ones it is known to, and in so many others it does. In one
    /// that is repeated perhaps nothing does.
    are_enough: bool,
    are_many: bool,
}

impl Seeds {
    const MANY: u64 = 10;

    /// So many as usual, or those that whoever looks for something rare wants.
    fn wanted(usual: u64) -> Seeds {
        let begin = number("FIRST_SEED").unwrap_or(1);
        let count = number("SEEDS").unwrap_or(usual);
        let are_many = count >= Seeds::MANY * usual;
        let are_enough = are_many || (begin == 1 && count >= usual);
        Seeds { all: begin..begin + count, are_enough, are_many }
    }
}

/// What was looked at: lives in which nothing happens prove nothing.
#[derive(Debug, Default)]
struct Seen {
    values: usize,
    missing: usize,
    collisions: u32,
    outcomes: BTreeMap<String, usize>,
    /// Which kinds befell a device.
    faults: BTreeSet<String>,
}

/// How the devices are reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Link {
    Serial,
    Tcp,
}

/// One life of a bus.
struct Soak {
    random: Rng,
    link: Link,
    /// A fault that all devices have all the time.
    always: Option<Fault>,
    world: World,
    diary: Diary,
    commands: Vec<Sent>,
}

/// A command that was sent.
struct Sent {
    at: Time,
    unit: u8,
    store: Store,
    value: u16,
}

impl Soak {
    fn new(seed: u64, link: Link, always: Option<&str>) -> Soak {
        let diary = Diary::default();
        let timepiece = |unit| Box::new(Timepiece::new(unit, diary.clone())) as Box<dyn SimulatedDevice>;
        let mut world = World::with_devices(gateway(link), timepiece);
        let always = always.map(|fault| fault.parse::<Fault>().expect("a fault"));
        if let Some(fault) = &always {
            world.line.add_fault(Time(0), fault).expect("all units");
        }
        Soak { random: Rng::with_seed(seed), link, always, world, diary, commands: Vec::new() }
    }

    fn run(mut self, seen: &mut Seen) {
        let end = Time(0) + LIFE;
        while self.world.now < end {
            let pause = Duration::from_millis(self.random.u64(5..1500));
            self.world.run_until(self.world.now + pause);
            self.something_happens();
        }
        for unit in UNITS {
            self.world.act(unit, &Action::Power { unit, on: true });
            self.repair(unit);
        }
        self.world.tell(Event::BrokerUp);
        self.world.run_until(end + CALM);
        self.check_messages(seen);
        self.check_commands(seen);
        self.check_end();
        seen.collisions += self.world.collisions;
        seen.faults.extend(self.world.faults);
    }

    fn something_happens(&mut self) {
        let unit = UNITS[self.random.usize(..UNITS.len())];
        match self.random.u8(0..100) {
            0..10 => {
                self.repair(unit);
                let kind = FAULTS[self.random.usize(..FAULTS.len())];
                self.world.fault(unit, kind);
            }
            10..25 => self.repair(unit),
            25..27 => self.world.act(unit, &Action::Power { unit, on: false }),
            27..31 => self.world.act(unit, &Action::Power { unit, on: true }),
            31..33 => self.world.act(unit, &Action::Restart { unit }),
            33 => self.world.unplug(Duration::from_millis(self.random.u64(1..5000))),
            34..40 => {
                let noise = (0..self.random.usize(1..40)).map(|_| self.random.u8(..)).collect();
                // A stream of bytes has none.
                if self.link == Link::Serial {
                    self.world.disturb(noise);
                }
            }
            40..42 => self.world.tell(Event::BrokerDown),
            42..46 => self.world.tell(Event::BrokerUp),
            _ => {
                // A burst, as a slider gives it, or one.
                for _ in 0..if self.random.u8(..4) == 0 { 10 } else { 1 } {
                    self.command(unit);
                }
            }
        }
    }

    fn command(&mut self, unit: u8) {
        let number = self.random.u16(..STORED);
        let (store, value) = match self.random.bool() {
            true => (Store::Coil(number), self.random.u16(..2)),
            false => (Store::Holding(number), self.random.u16(..)),
        };
        self.commands.push(Sent { at: self.world.now, unit, store, value });
        self.world.tell(Event::Command(Command {
            device: device_name(unit),
            point: point_name(store),
            payload: payload(store, value),
            retained: false,
        }));
    }

    fn repair(&mut self, unit: u8) {
        self.world.act(unit, &Action::Repair { unit });
        if let Some(fault) = self.always.clone() {
            self.world.act(unit, &Action::Fault(Fault { unit: Some(unit), ..fault }));
        }
    }

    /// Whatever was published was so between the request and its answer.
    fn check_messages(&self, seen: &mut Seen) {
        let mut told: BTreeMap<&str, &str> = BTreeMap::new();
        for published in &self.world.published {
            let Some((unit, point)) = state_of(&published.message.topic) else { continue };
            if published.message.payload == "None" {
                told.remove(published.message.topic.as_str());
                seen.missing += 1;
                continue;
            }
            // After a command that was refused, a switch that was moved on a screen is told to move back.
            let again = told.insert(&published.message.topic, &published.message.payload);
            let (from, to) = (published.asked_at[usize::from(unit)], published.at);
            let text = &published.message.payload;
            let is_true = match point {
                Point::Reading(address) => held(unit, address, from, to, text.parse().expect("a number")),
                Point::Stored(_) if again == Some(text) => true,
                Point::Stored(store) => self.diary.held(unit, store, from, to, value(text)),
            };
            assert!(
                is_true,
                "{} {text}, asked at {from}, published at {to}:{}",
                published.message.topic,
                self.world.heard_before(to, unit)
            );
            seen.values += 1;
        }
    }

    /// Each command has one outcome, which is true; and nothing was written without one.
    fn check_commands(&self, seen: &mut Seen) {
        let mut outcomes: BTreeMap<(u8, Store), usize> = BTreeMap::new();
        for published in &self.world.published {
            let Some(topic) = published.message.topic.strip_suffix("/outcome") else { continue };
            let Some((unit, Point::Stored(store))) = state_of(topic) else { panic!("{topic}") };
            *outcomes.entry((unit, store)).or_default() += 1;
            let outcome: serde_json::Value = serde_json::from_str(&published.message.payload).expect("JSON");
            let kind = outcome["outcome"].as_str().expect("a kind");
            *seen.outcomes.entry(kind.to_owned()).or_default() += 1;
            if kind == "done" {
                let wanted = value(outcome["wanted"].as_str().expect("a value"));
                let sent = self.commands.iter().rev().find(|sent| {
                    (sent.unit, sent.store, sent.value) == (unit, store, wanted) && sent.at <= published.at
                });
                let from = sent.expect("a command for each outcome").at;
                assert!(self.diary.held(unit, store, from, published.at, wanted), "{topic} {outcome}");
            }
        }
        for sent in &self.commands {
            *outcomes.entry((sent.unit, sent.store)).or_default() -= 1;
        }
        assert!(outcomes.values().all(|left| *left == 0), "outcomes too many: {outcomes:?}");
        let mut reasons: Vec<&Sent> = self.commands.iter().collect();
        for write in self.diary.changes().iter().filter(|change| change.written) {
            let reason = reasons.iter().position(|sent| {
                (sent.unit, sent.store, sent.value) == (write.unit, write.store, write.value)
                    && sent.at <= write.at
                    && write.at.since(sent.at) < COMMAND_LIFE
            });
            reasons.remove(reason.unwrap_or_else(|| panic!("nobody asked for this: {write:?}")));
        }
    }

    /// Soon after the last fault everything is known, new and right.
    fn check_end(&self) {
        let mut last: BTreeMap<&str, &Published> = BTreeMap::new();
        for published in &self.world.published {
            last.insert(&published.message.topic, published);
        }
        for unit in UNITS {
            let topic = |point: &str| format!("busker/{}/{point}", device_name(unit));
            let says = |point: &str| last[topic(point).as_str()].message.payload.as_str();
            assert_eq!(says("availability"), "online", "unit {unit}");
            for address in BLOCKS.iter().flat_map(|block| *block..block + BLOCK) {
                let reading = last[topic(&format!("reading_{address}")).as_str()];
                assert!(self.world.now.since(reading.at) < Duration::from_secs(2), "unit {unit}: {address}");
            }
            for store in stores() {
                let holds = payload(store, self.diary.value(unit, store));
                assert_eq!(says(&point_name(store)), holds, "unit {unit}: {store:?}");
            }
        }
    }
}

/// A point of the configuration.
enum Point {
    Reading(u16),
    Stored(Store),
}

/// The unit and point of a state topic.
fn state_of(topic: &str) -> Option<(u8, Point)> {
    let (device, point) = topic.strip_prefix("busker/")?.split_once('/')?;
    let unit = device.strip_prefix("device_")?.parse().ok()?;
    let reading = point.strip_prefix("reading_").and_then(|address| address.parse().ok());
    let stored = || stores().find(|store| point_name(*store) == point);
    let point = reading.map(Point::Reading).or_else(|| stored().map(Point::Stored))?;
    Some((unit, point))
}

fn stores() -> impl Iterator<Item = Store> {
    (0..STORED).flat_map(|number| [Store::Coil(number), Store::Holding(number)])
}

fn device_name(unit: u8) -> String {
    format!("device_{unit}")
}

fn point_name(store: Store) -> String {
    match store {
        Store::Coil(number) => format!("relay_{number}"),
        Store::Holding(number) => format!("level_{number}"),
    }
}

fn payload(store: Store, value: u16) -> String {
    match (store, value) {
        (Store::Coil(_), 0) => "OFF".into(),
        (Store::Coil(_), _) => "ON".into(),
        (Store::Holding(_), value) => value.to_string(),
    }
}

fn value(payload: &str) -> u16 {
    match payload {
        "ON" => 1,
        "OFF" => 0,
        number => number.parse().expect("a number"),
    }
}

/// The gateway's settings: all points of all devices, as fast as the line allows.
fn gateway(link: Link) -> Settings {
    let mut points = String::new();
    for address in BLOCKS.iter().flat_map(|block| *block..block + BLOCK) {
        points += &format!("      reading_{address}: {{at: input {address}, poll: fast}}\n");
    }
    for store in stores() {
        let place = match store {
            Store::Coil(number) => format!("at: coil {number}, write: any"),
            Store::Holding(number) => format!("at: holding {number}, write: 0..65535"),
        };
        points += &format!("      {}: {{{place}, poll: fast}}\n", point_name(store));
    }
    let link = match link {
        Link::Serial => "serial: /dev/ttyUSB0, baud: 19200, parity: even",
        Link::Tcp => "tcp: \"10.0.0.9:502\"",
    };
    let mut text = format!("buses: {{line: {{{link}, response_timeout: 400ms}}}}\ndevices:\n");
    for unit in UNITS {
        text += &format!(
            "  {}:\n    bus: line\n    unit: {unit}\n    poll: {{fast: 500ms}}\n    points:\n{points}",
            device_name(unit)
        );
    }
    load(&text)
}

/// The settings that a configuration makes.
#[track_caller]
fn load(text: &str) -> Settings {
    match configuration::load("soak.yaml", text.as_bytes(), &Library::shipped()) {
        Ok((settings, _)) => settings,
        Err(faults) => panic!("{}", faults.iter().map(ToString::to_string).collect::<String>()),
    }
}
