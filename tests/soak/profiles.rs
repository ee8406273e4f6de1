//! Lives of devices as their profiles describe them: modes that change, things, buttons, EEPROM, whatever a profile
//! knows, on random lines with random faults, while programs ask and configurations change.
//!
//! `FIRST_SEED=100 SEEDS=50 cargo test --test soak real_profiles` lives fifty other lives.

mod checks;
mod choices;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use busker::engine::arrivals::Errand;
use busker::engine::bus::{Command, Event};
use busker::engine::device::{Device, Form, Identify};
use busker::engine::profile::Library;
use busker::engine::request::{Decision, Desk};
use busker::engine::settings::{Link, Settings};
use busker::engine::time::{Date, Duration, Time};
use busker::simulator::device::Place;
use busker::simulator::line::Line;
use busker::simulator::script::Action;
use busker::simulator::{LineSettings, Parity, Stimulus};
use fastrand::Rng;

use crate::Seeds;
use crate::faults::FAULTS;
use crate::watched::{Holes, Ledger, Watched};
use crate::world::{Disturbance, World};
use choices::{choose_touched, choose_writable, make_holes, value_for, with_wishes};

const LIFE: Duration = Duration::from_secs(6 * 60);
const CALM: Duration = Duration::from_secs(130);

/// And of one that is known by its profile: such a device is another one for a while, and refuses all that it has.
const OF_PROFILES: &[&str] = &[
    "silent,every=7",
    "slow=350ms,every=3",
    "exception=2",
    "exception=3,every=5",
    "exception=6",
    "exception=5",
    "exception=11,every=3",
    "reboot=4s",
    "wrong-identity",
    "wrong-identity,every=3",
];

#[test]
fn lives_of_real_profiles_bring_nothing_false() {
    let seeds = Seeds::wanted(1);
    let mut seen = Seen::default();
    for seed in seeds.all {
        println!("seed {seed}");
        Life::new(seed).run(&mut seen);
    }
    println!("{seen:?}");
    if !seeds.are_enough {
        return;
    }
    if seeds.are_many {
        let mut kinds = FAULTS.iter().chain(OF_PROFILES);
        assert!(kinds.all(|kind| seen.faults.contains(*kind)), "{seen:?}");
    }
    assert!(seen.values > 500 && seen.decided > 100 && seen.writes["to EEPROM"] > 10, "{seen:?}");
    for kind in ["done", "unchanged", "expired", "refused"] {
        assert!(seen.outcomes.contains_key(kind), "no command was ever `{kind}`: {seen:?}");
    }
}

/// What was looked at.
#[derive(Debug, Default)]
struct Seen {
    values: usize,
    /// Those whose meaning other points decide, and that had to be true,
    decided: usize,
    /// and those that did not, since what decides had just changed by itself.
    excused: usize,
    outcomes: BTreeMap<String, usize>,
    writes: BTreeMap<&'static str, usize>,
    /// Which kinds befell a device: in a single life not all of them.
    faults: BTreeSet<String>,
}

struct Unit {
    unit: u8,
    name: String,
    device: Arc<Device>,
    holes: Holes,
}

struct Sent {
    at: Time,
    unit: usize,
    target: String,
    value: String,
    /// The points that it may write.
    points: Vec<usize>,
    ended: Option<(Time, serde_json::Value)>,
}

struct Life {
    seed: u64,
    always: Option<&'static str>,
    random: Rng,
    text: String,
    settings: Settings,
    world: World,
    ledger: Ledger,
    units: Vec<Unit>,
    commands: Vec<Sent>,
    desk: Desk,
    requests: usize,
    starts: Vec<Time>,
    leaving: Vec<usize>,
    eeprom: (u64, u64),
    /// Since when a unit has had no power.
    dark_since: Vec<Option<Time>>,
    /// How often the link was closed since the last start.
    closed: u64,
    requests_before: u64,
    availability: BTreeMap<String, String>,
    looked_at: usize,
    /// The bus is somebody else's, or has no link, until then and a while.
    away_until: Time,
}

impl Life {
    fn new(seed: u64) -> Life {
        let mut random = Rng::with_seed(seed);
        let library = Library::shipped();
        let profiles: Vec<String> = library.ids().into_iter().map(String::from).collect();
        let baud = [9600, 19200, 38400, 115_200][random.usize(..4)];
        let even = random.bool();
        let is_tcp = random.u8(..4) == 0;
        let link = match is_tcp {
            true => "tcp: \"10.0.0.9:502\"".to_string(),
            false if random.u8(..5) == 0 => format!(
                "rtu_over_tcp: \"10.0.0.9:502\", baud: {baud}, parity: {}",
                if even { "even" } else { "none" }
            ),
            false => {
                format!("serial: /dev/ttyUSB0, baud: {baud}, parity: {}", if even { "even" } else { "none" })
            }
        };
        let eeprom = ([1, 10, 60][random.usize(..3)], [10, 100, 500][random.usize(..3)]);
        let mut text = format!(
            "eeprom: {{interval: {}s, daily: {}}}\nbuses: {{line: {{{link}, response_timeout: 400ms}}}}\ndevices:\n",
            eeprom.0, eeprom.1
        );
        let json = random.u8(..3) == 0;
        if json {
            text = format!("mqtt: {{json: true}}\n{text}");
        }
        let count = random.u8(1..=5);
        for index in 0..count {
            let profile = &profiles[random.usize(..profiles.len())];
            let fast = ["100ms", "500ms", "1s"][random.usize(..3)];
            let slow = ["1s", "3s", "5s"][random.usize(..3)];
            text += &format!(
                "  d_{index}: {{bus: line, unit: {}, profile: {profile}, poll: {{fast: {fast}, slow: {slow}}}}}\n",
                3 + 2 * index
            );
        }
        let settings = with_wishes(&mut random, &mut text);
        let parity = if even { Parity::Even } else { Parity::None };
        let of_line = LineSettings { baud, parity };
        let turnaround = Duration::from_millis(random.u64(1..15));
        let mut line = Line::new(Time(0), of_line, turnaround, true, &[]).expect("a line");
        let ledger = Ledger::default();
        let units: Vec<Unit> = settings
            .devices
            .iter()
            .map(|device| Unit {
                unit: device.unit,
                name: device.name.clone(),
                device: device.device.clone(),
                holes: Holes::default(),
            })
            .collect();
        let always = (!is_tcp && random.u8(..6) == 0).then_some("echo");
        for unit in &units {
            let at = Place { unit: unit.unit, device: unit.name.clone() };
            if random.u8(..3) == 0 {
                make_holes(&mut random, unit);
            }
            let device =
                Watched::new(Time(0), unit.unit, unit.device.clone(), ledger.clone(), unit.holes.clone());
            line.add(at, Box::new(device)).expect("a unit of its own");
        }
        for unit in &units {
            if let Some(always) = always {
                line.add_fault(Time(0), &format!("unit={},{always}", unit.unit).parse().expect("a fault"))
                    .expect("it is there");
            }
        }
        let desk = Desk::new(&settings, Library::shipped());
        let world = World::new(settings.clone(), line);
        Life {
            seed,
            always,
            random,
            text,
            settings,
            world,
            ledger,
            units,
            commands: Vec::new(),
            desk,
            requests: 0,
            starts: vec![Time(0)],
            leaving: Vec::new(),
            eeprom,
            dark_since: vec![None; count.into()],
            closed: 0,
            requests_before: 0,
            availability: BTreeMap::new(),
            looked_at: 0,
            away_until: Time(0),
        }
    }

    fn run(mut self, seen: &mut Seen) {
        let end = Time(0) + LIFE;
        while self.world.now < end {
            let pause = Duration::from_millis(self.random.u64(5..1500));
            self.world.run_until(self.world.now + pause);
            self.come_back();
            self.look_at_availability();
            self.something_happens();
        }
        for index in 0..self.units.len() {
            let unit = self.units[index].unit;
            self.world.act(unit, &Action::Power { unit, on: true });
            self.repair(unit);
        }
        self.world.disturbance = None;
        self.world.tell(Event::BrokerUp);
        self.world.run_until(self.world.now + Duration::from_secs(2));
        self.come_back();
        self.world.run_until(end + CALM);
        self.find_outcomes();
        self.check_messages(seen);
        self.check_commands(seen);
        self.check_writes(seen);
        self.check_counters();
        self.check_end();
        seen.faults.extend(self.world.faults);
    }

    fn come_back(&mut self) {
        let gone: Vec<usize> = std::mem::take(&mut self.leaving);
        for index in gone {
            if self.world.has_device(&self.units[index].name) {
                self.leaving.push(index);
                continue;
            }
            let memories = self.world.memories.clone();
            self.world.tell(Event::Adopt(vec![self.settings.devices[index].clone()], memories));
            self.starts.push(self.world.now);
        }
    }

    fn something_happens(&mut self) {
        let index = self.random.usize(..self.units.len());
        let unit = self.units[index].unit;
        match self.random.u8(0..100) {
            0..8 => {
                let kinds = [FAULTS, OF_PROFILES].concat();
                let kind = kinds[self.random.usize(..kinds.len())];
                // Two at once, now and then.
                if self.random.u8(..3) > 0 {
                    self.repair(unit);
                }
                self.world.fault(unit, kind);
            }
            8..22 => self.repair(unit),
            22..24 => {
                self.world.act(unit, &Action::Power { unit, on: false });
                self.dark_since[index].get_or_insert(self.world.now);
            }
            24..28 => {
                self.world.act(unit, &Action::Power { unit, on: true });
                self.dark_since[index] = None;
            }
            28..30 => {
                self.world.act(unit, &Action::Restart { unit });
                if self.random.u8(..3) == 0 {
                    // With another firmware.
                    make_holes(&mut self.random, &self.units[index]);
                }
            }
            30 => {
                self.closed += 1;
                self.away_until = self.world.now + Duration::from_secs(10);
                self.world.unplug(Duration::from_millis(self.random.u64(1..5000)));
            }
            31..34 => {
                let noise = (0..self.random.usize(1..40)).map(|_| self.random.u8(..)).collect();
                if !matches!(self.settings.buses[0].link, Link::Tcp { .. }) {
                    self.world.disturb(noise);
                }
            }
            34 if self.random.bool() => {
                let period = Duration::from_millis(self.random.u64(50..1500));
                let lasts = period * self.random.u32(5..40) / 100;
                self.world.disturbance = match self.random.u8(..3) {
                    0 if !matches!(self.settings.buses[0].link, Link::Tcp { .. }) => {
                        Some(Disturbance::Time { period, lasts })
                    }
                    1 if !matches!(self.settings.buses[0].link, Link::Tcp { .. }) => {
                        Some(Disturbance::Request(self.random.u32(2..9)))
                    }
                    _ => None,
                };
            }
            34 => self.world.tell(Event::BrokerDown),
            35..38 => self.world.tell(Event::BrokerUp),
            38..55 => self.touch(index),
            55..60 => self.request(index),
            60 => {
                if !self.leaving.contains(&index) {
                    self.leaving.push(index);
                    let name = self.units[index].name.clone();
                    self.world.tell(Event::Retire(name));
                }
            }
            61 if self.leaving.is_empty() => {
                self.world.restart();
                self.closed = 0;
                self.requests_before = self.world.requests().len() as u64;
                self.starts.push(self.world.now);
            }
            62..64 => {
                let device = &self.units[index].device;
                let point = device.points[self.random.usize(..device.points.len())].name.clone();
                self.world.tell(Event::Get { device: self.units[index].name.clone(), point });
            }
            _ => {
                for _ in 0..if self.random.u8(..4) == 0 { 8 } else { 1 } {
                    self.command(index);
                }
            }
        }
    }

    fn repair(&mut self, unit: u8) {
        self.world.act(unit, &Action::Repair { unit });
        if let Some(always) = self.always {
            self.world.fault(unit, always);
        }
    }

    /// Something changes at the device, by itself or by hand.
    fn touch(&mut self, index: usize) {
        let device = self.units[index].device.clone();
        let unit = self.units[index].unit;
        let point = &device.points[choose_touched(&mut self.random, &device)];
        let identity = match &device.identify {
            Some(Identify::Word { at, .. }) => Some(*at),
            _ => None,
        };
        if identity.is_some_and(|at| at.overlaps(point.at.span)) {
            return;
        }
        if point.is_button() || (point.at.span.table().is_writable() && self.random.u8(..3) > 0) {
            return;
        }
        let words: Vec<u16> = match point.at.span.table().is_bits() {
            true => (0..point.at.span.count()).map(|_| self.random.u16(..2)).collect(),
            false => {
                let named = point.plain().map(Form::named_values).unwrap_or_default();
                (0..point.at.span.count())
                    .map(|_| match self.random.u8(..4) {
                        0 => self.random.u16(..),
                        _ if !named.is_empty() => named[self.random.usize(..named.len())].0 as u16,
                        _ => self.random.u16(..300),
                    })
                    .collect()
            }
        };
        let stimulus = Stimulus::Set { span: point.at.span, words };
        // What has no power is not touched.
        let _ = self.world.line.act(self.world.now, &Action::Stimulate { unit, stimulus });
    }

    fn request(&mut self, index: usize) {
        let name = self.units[index].name.clone();
        let (verb, payload) = match self.random.u8(..7) {
            0 => ("read", format!(r#"{{"device":"{name}","at":"holding 0..3"}}"#)),
            1 => ("read", format!(r#"{{"device":"{name}","at":"input 0..9"}}"#)),
            2 => ("refresh", format!(r#"{{"device":"{name}"}}"#)),
            3 => ("identify", format!(r#"{{"device":"{name}"}}"#)),
            4 => {
                self.closed += 1;
                self.away_until = self.world.now + Duration::from_secs(10);
                ("pause", r#"{"bus":"line","for":"2s"}"#.to_string())
            }
            5 => ("scan", r#"{"bus":"line","units":"40..44"}"#.to_string()),
            _ => ("diagnostics", format!(r#"{{"device":"{name}"}}"#)),
        };
        let request = Errand::Request { verb: verb.into(), payload, retained: false, stale: None };
        match self.desk.decide(Date(0), request) {
            Decision::Ask(_, request) => {
                self.requests += 1;
                self.world.tell(Event::Request(request));
            }
            Decision::Answer(_) => {}
            other => panic!("{other:?}"),
        }
    }

    fn command(&mut self, index: usize) {
        let device = self.units[index].device.clone();
        let things = device.things.iter().filter(|thing| !thing.commands.is_empty()).count();
        let writable: Vec<usize> =
            (0..device.points.len()).filter(|point| device.points[*point].write.is_some()).collect();
        let count = writable.len() + things * 3;
        if count == 0 {
            return;
        }
        let (target, value, points) = match choose_writable(&mut self.random, &device, &writable, count) {
            at if at < writable.len() => {
                let point = writable[at];
                (device.points[point].name.clone(), self.value(&device, point), vec![point])
            }
            at => {
                let mut of_things = device.things.iter().filter(|thing| !thing.commands.is_empty());
                let thing = of_things.nth((at - writable.len()) / 3).expect("counted");
                let command = &thing.commands[self.random.usize(..thing.commands.len())];
                let points = command.orders.iter().map(|(point, _)| *point).collect();
                (thing.name.clone(), command.name.clone(), points)
            }
        };
        let number = self.commands.len();
        let value_json = serde_json::to_string(&value).expect("JSON");
        let payload = format!(r#"{{"value":{value_json},"transaction":{number}}}"#);
        self.commands.push(Sent {
            at: self.world.now,
            unit: index,
            target: target.clone(),
            value,
            points,
            ended: None,
        });
        let command =
            Command { device: self.units[index].name.clone(), point: target, payload, retained: false };
        self.world.tell(Event::Command(command));
    }

    fn value(&mut self, device: &Device, point: usize) -> String {
        if self.random.u8(..30) == 0 {
            return "nonsense".into();
        }
        value_for(&mut self.random, device, point)
    }
}
