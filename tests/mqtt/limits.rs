//! Brokers that take less than others do.

use serde_json::Value as Json;

use super::support::{Broker, Gateway, Watcher, wait_for};
use super::{configuration, over_tcp, remembered, simulation, wait_until_all_is_online};

/// What `/health` says of the broker, and the status.
fn health(gateway: &Gateway) -> (Json, String) {
    let health = gateway.json("/health").expect("health is JSON");
    (health["broker"].clone(), health["status"].as_str().unwrap_or_default().to_string())
}

fn wait_until_kept_back(gateway: &Gateway, topics: &[&str]) {
    wait_for(&format!("{topics:?} to be kept back"), || {
        (health(gateway).0["kept_back"] == serde_json::json!(topics)).then_some(())
    });
}

#[test]
fn announcements_that_are_too_long_for_the_broker_cost_no_more_than_themselves() {
    const RELAYS: &str = "homeassistant/device/busker_relays/config";
    const COUNTERS: &str = "homeassistant/device/busker_counters/config";
    let with_memory = "allow_anonymous true\npersistence true\n";
    let mut broker = Broker::start_with(&format!("{with_memory}max_packet_size 9500\n"));
    let simulation = simulation();
    let port = over_tcp(&simulation);
    let watcher = Watcher::start(&broker, "watcher");
    let gateway = Gateway::start(&broker, &configuration(&port));
    gateway.wait_for_log(&format!(
        "the broker closes the connection whenever it is sent what belongs on `{COUNTERS}`"
    ));
    wait_until_kept_back(&gateway, &[COUNTERS, RELAYS]);
    watcher.forget();
    wait_until_all_is_online(&watcher);
    watcher.publish("busker/relays/relay_1/set", "ON");
    watcher.wait_for("busker/relays/relay_1", "ON");
    let (of_broker, status) = health(&gateway);
    assert_eq!((status.as_str(), &of_broker["client_id_taken"]), ("degraded", &Json::Bool(false)));
    let kept: Vec<String> = remembered(&broker, "later").into_iter().map(|message| message.topic).collect();
    assert!(kept.iter().any(|topic| topic == "homeassistant/device/busker_bridge/config"), "{kept:?}");

    // With another limit it takes them.
    broker.kill();
    gateway.wait_for_health(503);
    // It has been away: one that comes back at once, just when a long message was on its way, may be the same one.
    gateway.wait_for_log("no connection to the broker");
    broker.be_told(with_memory);
    broker.start_again();
    for topic in [RELAYS, COUNTERS] {
        watcher.wait_until("it is announced", |got| got.topic == topic);
    }
    wait_until_kept_back(&gateway, &[]);
}
