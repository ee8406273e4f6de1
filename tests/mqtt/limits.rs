//! Brokers that take less than others do.

use busker::simulator::TcpPort;
use serde_json::Value as Json;

use super::support::{self, Broker, Gateway, Watcher, wait_for};
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
    broker.be_told(with_memory);
    broker.start_again();
    for topic in [RELAYS, COUNTERS] {
        watcher.wait_until("it is announced", |got| got.topic == topic);
    }
    wait_until_kept_back(&gateway, &[]);
}

/// A broker with these lines, and a gateway of which these topics do not arrive, as it says in its log in these words.
#[track_caller]
fn check_silence(lines: &str, topics: &[&str], words: &[&str]) -> (Broker, Gateway, TcpPort) {
    let broker = Broker::start_with(&format!("allow_anonymous true\npersistence false\n{lines}"));
    let simulation = simulation();
    let port = over_tcp(&simulation);
    let gateway = Gateway::start(&broker, &configuration(&port));
    wait_for(&format!("{topics:?} to be missed"), || {
        (health(&gateway).0["not_arriving"] == serde_json::json!(topics)).then_some(())
    });
    assert_eq!(health(&gateway).1, "degraded");
    let line = gateway.wait_for_log("the broker confirms what this gateway tells on");
    assert!(words.iter().all(|word| line.contains(word)), "{line}");
    assert_eq!(gateway.log().iter().filter(|other| **other == line).count(), 1);
    (broker, gateway, port)
}

const ANNOUNCED: [&str; 4] = ["bridge", "bus_line", "counters", "relays"];

#[test]
fn a_user_who_may_not_write_is_noticed_where_the_broker_confirms_everything() {
    let folder = support::temporary_folder();
    let rules = |name: &str, text: &str| {
        let file = support::temporary_file(&folder, name, text);
        format!("acl_file {}\n", file.display())
    };
    // Everything but announcements; its own topics are others; nothing at all.
    let announced = ANNOUNCED.map(|device| format!("homeassistant/device/busker_{device}/config"));
    let announced: Vec<&str> = announced.iter().map(String::as_str).collect();
    let all = [&["busker/bridge/state"], &announced[..]].concat();
    let words = ["topic readwrite", announced[0]];
    check_silence(&rules("some", "topic read #\ntopic readwrite busker/#\n"), &announced, &words);
    check_silence(&rules("none", "topic read #\n"), &all, &["topic readwrite", all[0], "and on 4 more"]);
    check_silence(&rules("unread", "topic write #\ntopic read busker/#\n"), &announced, &words);
}

#[test]
fn a_message_that_the_broker_drops_for_its_length_is_noticed_until_it_arrives() {
    const RELAYS: &str = "homeassistant/device/busker_relays/config";
    const COUNTERS: &str = "homeassistant/device/busker_counters/config";
    let words = [" bytes (`message_size_limit` of mosquitto)"];
    let (mut broker, gateway, _port) =
        check_silence("message_size_limit 9500\n", &[COUNTERS, RELAYS], &words);
    assert!(gateway.get("/metrics").1.contains("busker_broker_not_arriving 2.0"));
    broker.kill();
    broker.be_told("allow_anonymous true\n");
    broker.start_again();
    wait_for("everything to arrive", || {
        (health(&gateway).0["not_arriving"] == serde_json::json!([])).then_some(())
    });
    gateway.wait_for_health(200);
    let status = || (health(&gateway).1 == "ok").then_some(());
    wait_for("nothing to be amiss", status);
}
