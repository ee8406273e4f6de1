//! What every row stands on: the program between a real broker and a line of scripted devices, and
//! somebody who compares what is published with what the devices have held.

use std::cell::RefCell;
use std::collections::BTreeMap;

use serde_json::Value;

use crate::peer::{Peer, Place};
use crate::support::{Broker, Gateway, Watcher, find, wait_for};

/// `busker/one/a`, and the register that it shows.
pub type Shown = (&'static str, Place);

/// The program on a peer's line.
pub struct Stage<'p> {
    // In the order in which they end.
    pub gateway: Gateway,
    pub watcher: Watcher,
    _broker: Broker,
    peer: &'p Peer,
    shown: Vec<Shown>,
    /// How many commands each point was given.
    commands: RefCell<BTreeMap<String, usize>>,
}

impl<'p> Stage<'p> {
    /// On the peer's own link; `bus` is what the configuration says of the bus besides.
    pub fn start(peer: &'p Peer, bus: &str, devices: &str, shown: &[Shown]) -> Stage<'p> {
        Stage::start_on(
            peer,
            &format!("{}{}{bus}", peer.link(), if bus.is_empty() { "" } else { ", " }),
            devices,
            shown,
        )
    }

    /// `link` is all that the configuration says of the bus. `shown` are the points that are watched;
    /// those of input registers are told a new value at the end.
    pub fn start_on(peer: &'p Peer, link: &str, devices: &str, shown: &[Shown]) -> Stage<'p> {
        let broker = Broker::start();
        let watcher = Watcher::start(&broker, "watcher");
        for (number, (_, (unit, function, address))) in (1..).zip(shown) {
            // Each register holds something else, so that none is taken for another.
            if peer.history((*unit, *function, *address)).is_empty() {
                peer.hold(*unit, *function, *address, if *function > 2 { number * 100 } else { 0 });
            }
        }
        let configuration = format!("buses: {{line: {{{link}}}}}\ndevices:\n{devices}");
        let gateway = Gateway::start(&broker, &configuration);
        Stage { gateway, watcher, _broker: broker, peer, shown: shown.to_vec(), commands: RefCell::default() }
    }

    /// Waits until every point that is watched shows what its register holds.
    #[track_caller]
    pub fn shows_all(&self) {
        for (topic, place) in &self.shown {
            self.shows(topic, *place);
        }
    }

    /// Waits until a point shows what its register holds.
    #[track_caller]
    pub fn shows(&self, topic: &str, place: Place) {
        self.watcher.shows(&format!("busker/{topic}"), &payload(place, self.peer.holds(place)));
    }

    /// Every register of a reading changes, and that is seen.
    #[track_caller]
    pub fn tells_changes(&self) {
        for (_, (unit, function, address)) in self.shown.iter().filter(|(_, (_, function, _))| *function == 4)
        {
            let next = self.peer.holds((*unit, *function, *address)) + 1;
            self.peer.hold(*unit, *function, *address, next);
        }
        self.shows_all();
    }

    /// Gives a command and waits for its outcome.
    #[track_caller]
    pub fn command(&self, point: &str, wanted: &str) -> Value {
        let from = self.watcher.count();
        self.publish(point, wanted);
        let outcome = self.watcher.wait_for_next(&format!("busker/{point}/outcome"), from);
        serde_json::from_str(&outcome).expect("an outcome is JSON")
    }

    /// Gives a command.
    pub fn publish(&self, point: &str, wanted: &str) {
        *self.commands.borrow_mut().entry(point.into()).or_default() += 1;
        self.watcher.publish(&format!("busker/{point}/set"), wanted);
    }

    /// The kinds of all outcomes of a point so far.
    pub fn outcomes(&self, point: &str) -> Vec<String> {
        let payloads = self.watcher.payloads(&format!("busker/{point}/outcome"));
        let kind =
            |payload: &String| serde_json::from_str::<Value>(payload).expect("JSON")["outcome"].clone();
        payloads.iter().map(|payload| kind(payload).as_str().expect("a kind").to_owned()).collect()
    }

    /// A counter of the bus.
    pub fn counter(&self, name: &str) -> u64 {
        let bus = wait_for("the API", || self.bus());
        bus[name].as_u64().unwrap_or_else(|| panic!("no counter `{name}` in {bus}"))
    }

    /// Waits until a counter of the bus has come so far.
    #[track_caller]
    pub fn counts(&self, name: &str, least: u64) {
        let reached = find(|| (self.counter(name) >= least).then_some(()));
        assert!(reached.is_some(), "{name} is {}, not {least}", self.counter(name));
    }

    pub fn bus(&self) -> Option<Value> {
        self.gateway.json("/api/buses")?.get(0).cloned()
    }

    /// What `/api/devices` says of one.
    pub fn device(&self, name: &str) -> Value {
        let devices = wait_for("the API", || self.gateway.json("/api/devices"));
        let device = devices.as_array().expect("a list").iter().find(|device| device["name"] == name);
        device.unwrap_or_else(|| panic!("no device `{name}`")).clone()
    }

    /// The end of each row: everything is shown as it is, changes still come, nothing that was shown was
    /// false, and every command has had exactly one outcome.
    #[track_caller]
    pub fn ends_well(&self) {
        self.tells_changes();
        self.nothing_was_false();
    }

    /// Each value that was shown was held by its register, none again after a later one.
    #[track_caller]
    pub fn nothing_was_false(&self) {
        for (topic, place) in &self.shown {
            let history = self.peer.history(*place);
            let mut told = self.watcher.payloads(&format!("busker/{topic}"));
            told.retain(|told| told != "None");
            told.dedup();
            let mut later = history.iter();
            for value in &told {
                assert!(
                    later.any(|held| payload(*place, *held) == *value),
                    "{topic} told {told:?}, but held {history:?}"
                );
            }
        }
        for (point, count) in self.commands.borrow().iter() {
            let outcomes = self.outcomes(point);
            assert_eq!(outcomes.len(), *count, "the outcomes of {point}: {outcomes:?}");
        }
    }
}

fn payload((_, function, _): Place, word: u16) -> String {
    match (function, word) {
        (1 | 2, 0) => "OFF".into(),
        (1 | 2, _) => "ON".into(),
        (_, word) => word.to_string(),
    }
}
