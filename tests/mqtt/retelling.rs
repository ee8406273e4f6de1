//! A reload that changes where everything is told, and in which way: no bus notices, and afterwards the broker has
//! what it would have of a gateway that was started so.

use std::collections::BTreeMap;

use busker::engine::time::Duration;
use serde_json::Value as Json;

use crate::reload::{COUNTERS, DONE, RELAYS, Witness, online_at, steady, text};
use crate::support::{Broker, Gateway, Received, Watcher, find};
use crate::{json, over_tcp, remembered, simulation};

/// What a configuration has beside buses and devices.
#[derive(Clone, Copy)]
struct Manner {
    /// Behind the broker's address.
    mqtt: &'static str,
    /// Of `home_assistant`.
    home_assistant: &'static str,
    /// Where commands for the relays are given.
    relays: &'static str,
}

const USUAL: Manner = Manner { mqtt: "", home_assistant: "", relays: "busker/relays" };

impl Manner {
    fn of(self, usual: &str) -> String {
        let Manner { mqtt, home_assistant, .. } = self;
        format!(
            "home_assistant: {{{home_assistant}}}\n{}",
            usual.replacen("mqtt: {", &format!("mqtt: {{{mqtt}"), 1)
        )
    }

    fn base(self) -> &'static str {
        self.relays.split('/').next().expect("it has a base topic")
    }

    /// What stands before the names of devices.
    fn base_of_devices(self) -> &'static str {
        self.relays.strip_suffix("/relays").expect("it ends with the device")
    }

    fn bridge_state(self) -> String {
        format!("{}/bridge/state", self.base())
    }
}

/// What the broker remembers, without what no two runs have in common.
fn lasting(all: &[Received], witness: &Witness) -> BTreeMap<String, Json> {
    let lasting = |got: &Received| {
        let text = got.payload.replace(&witness.address.to_string(), "its address");
        let mut payload = serde_json::from_str(&text).unwrap_or(Json::from(text));
        if got.topic.ends_with("/health") {
            payload = "told".into();
        } else if let Some(info) = payload.as_object_mut() {
            info.remove("last_read");
        }
        (got.topic.clone(), payload)
    };
    all.iter().map(lasting).collect()
}

fn difference(one: &BTreeMap<String, Json>, other: &BTreeMap<String, Json>) -> Vec<String> {
    let only = |one: &BTreeMap<String, Json>, other: &BTreeMap<String, Json>, word: &str| -> Vec<String> {
        let differing = one.iter().filter(|(topic, payload)| other.get(*topic) != Some(payload));
        differing.map(|(topic, payload)| format!("{word} {topic} {payload:.300}")).collect()
    };
    [only(one, other, "is"), only(other, one, "should be")].concat()
}

#[track_caller]
fn check(from: Manner, to: Manner) {
    let (broker, other_broker) = (Broker::start(), Broker::start());
    let (simulation, witness, other_witness) = (simulation(), Witness::start(), Witness::start());
    let port = over_tcp(&simulation);
    let line = format!("line: {{tcp: '{}'}}", port.address());
    let usual = |broker: &Broker, witness: &Witness| {
        let (steady, pump) = steady(witness);
        text(broker, &[&line, &steady], &[RELAYS, COUNTERS, &pump])
    };
    let watcher = Watcher::start(&broker, "watcher");
    let switch = |manner: Manner, relay: u8, value: &str| {
        let point = format!("{}/relay_{relay}", manner.relays);
        watcher.publish(&format!("{point}/set"), value);
        let outcome = watcher.wait_until("an outcome", |got| got.topic == format!("{point}/outcome"));
        assert_eq!(json(&outcome.payload)["outcome"], "done", "{}", outcome.payload);
    };
    let gateway = Gateway::start_with(&from.of(&usual(&broker, &witness)));
    watcher.wait_for(&from.bridge_state(), "online");
    online_at(&watcher, from.base_of_devices(), &["relays", "counters", "pump"]);
    switch(from, 2, "ON");
    witness.wait_for_more(3);

    let polls = witness.count();
    watcher.forget();
    gateway.write(&to.of(&usual(&broker, &witness)));
    gateway.reload(DONE);
    watcher.wait_for(&format!("{}/relay_2", to.relays), "ON");
    switch(to, 1, "ON");
    if from.relays != to.relays {
        watcher.publish(&format!("{}/relay_3/set", from.relays), "ON");
        switch(to, 1, "ON");
        assert_eq!(watcher.payloads(&format!("{}/relay_3/outcome", from.relays)), [""; 0]);
    }

    // What a gateway has told that was started so.
    let of_fresh = Watcher::start(&other_broker, "watcher");
    let fresh = Gateway::start_with(&to.of(&usual(&other_broker, &other_witness)));
    online_at(&of_fresh, to.base_of_devices(), &["relays", "counters", "pump"]);
    of_fresh.wait_for(&to.bridge_state(), "online");
    of_fresh.wait_until("health", |got| got.topic.ends_with("relays/health"));
    other_witness.wait_for_more(2);
    let wanted = lasting(&remembered(&other_broker, "newcomer"), &other_witness);
    assert!(fresh.terminate().success());
    let stands = || lasting(&remembered(&broker, "newcomer"), &witness);
    let same = find(|| (stands() == wanted).then_some(()));
    assert!(same.is_some(), "{}", difference(&stands(), &wanted).join("\n"));

    // Nobody was told meanwhile that anything is away or unknown.
    let is_unsettling = |got: &&Received| {
        let lasting = wanted.get(&got.topic).and_then(Json::as_str);
        let is_known = wanted.contains_key(&got.topic) && lasting != Some(&got.payload);
        is_known && ["offline", "None", ""].contains(&&*got.payload)
    };
    let told = watcher.received();
    let unsettling: Vec<&Received> = told.iter().filter(is_unsettling).collect();
    assert!(unsettling.is_empty(), "{unsettling:?}");
    assert_eq!(witness.connections(), 1, "the bus kept its connection");
    let longest = witness.longest_gap(polls.saturating_sub(2));
    assert!(longest < Duration::from_millis(600), "a poll was lost: {longest:?}");
    assert!(gateway.terminate().success());
}

#[test]
fn below_another_base_topic() {
    check(USUAL, Manner { mqtt: "base_topic: house, ", relays: "house/relays", ..USUAL });
}

#[test]
fn below_another_base_topic_at_other_places_and_all_values_in_one_message_too() {
    let mqtt = "base_topic: house, topics: '{base}/x/{device}/{point}', json: true, ";
    check(USUAL, Manner { mqtt, home_assistant: "prefix: ha", relays: "house/x/relays" });
}

#[test]
fn at_other_places_below_the_same_base_topic() {
    let other = Manner { mqtt: "topics: '{base}/x/{device}/{point}', ", relays: "busker/x/relays", ..USUAL };
    check(USUAL, other);
    check(other, USUAL);
}

#[test]
fn to_a_home_assistant_that_looks_elsewhere() {
    check(USUAL, Manner { home_assistant: "prefix: ha, status_topic: ha/status", ..USUAL });
}

#[test]
fn to_no_home_assistant_and_to_one_again() {
    let nobody = Manner { home_assistant: "discovery: false", ..USUAL };
    check(USUAL, nobody);
    check(nobody, USUAL);
}

#[test]
fn to_an_older_home_assistant_that_shall_take_what_is_silent_for_unavailable() {
    check(USUAL, Manner { home_assistant: "minimum_version: '2025.4', expire_after: 3h", ..USUAL });
}

#[test]
fn all_values_in_one_message_too_and_no_more() {
    let whole = Manner { mqtt: "json: true, ", ..USUAL };
    check(USUAL, whole);
    check(whole, USUAL);
}

#[test]
fn so_that_the_broker_keeps_no_values_and_so_that_it_does() {
    let unkept = Manner { mqtt: "retain: false, ", ..USUAL };
    check(USUAL, unkept);
    check(unkept, USUAL);
}

#[test]
fn at_most_once() {
    check(USUAL, Manner { mqtt: "qos: 0, ", ..USUAL });
}
