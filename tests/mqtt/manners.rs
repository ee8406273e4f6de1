//! What an owner may want otherwise: where values stand, whether they are retained, all of them in one
//! message.

use serde_json::Value as Json;

use super::{devices_on, json, over_tcp, payload, remembered, simulation};
use crate::support::{self, Broker, Gateway, Received, Watcher};

fn start(broker: &Broker, mqtt: &str, link: &str) -> Gateway {
    let url = format!("url: 'mqtt://127.0.0.1:{}'", broker.port);
    Gateway::start_with(&format!("mqtt: {{{url}, {mqtt}}}\nrepublish: 2s\n{}", devices_on(link)))
}

#[test]
fn in_another_layout_everything_is_found_and_commands_arrive() {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let watcher = Watcher::start(&broker, "watcher");
    let layout = "topics: '{base}/modbus/{bus}/{device}/{point}', json: true";
    let gateway = start(&broker, layout, &format!("tcp: '{}'", port.address()));
    watcher.wait_for("busker/modbus/line/relays/availability", "online");
    watcher.wait_for("busker/bridge/state", "online");
    watcher.wait_for("busker/modbus/line/relays/relay_1", "OFF");

    // As Home Assistant does: from what is announced.
    let all = remembered(&broker, "newcomer");
    let config = json(payload(&all, "homeassistant/device/busker_relays/config"));
    let relay = &config["components"]["relay_2"];
    let topic = |value: &Json| value.as_str().expect("a topic").to_string();
    assert_eq!(payload(&all, &topic(&relay["state_topic"])), "OFF");
    for named in config["availability"].as_array().expect("a list") {
        assert_eq!(payload(&all, &topic(&named["topic"])), "online");
    }
    let info = json(payload(&all, &topic(&config["components"]["eeprom_writes"]["state_topic"])));
    assert_eq!(info["eeprom_writes"], 0);
    watcher.publish(&topic(&relay["command_topic"]), "ON");
    let outcome = |got: &Received| got.topic == "busker/modbus/line/relays/relay_2/outcome";
    assert_eq!(json(&watcher.wait_until("an outcome", outcome).payload)["outcome"], "done");
    watcher.wait_for(&topic(&relay["state_topic"]), "ON");
    watcher.wait_until("all of it together", |got| {
        got.topic == "busker/modbus/line/relays" && json(&got.payload)["relay_2"] == "ON"
    });
    watcher.forget();
    watcher.publish("busker/modbus/line/relays/relay_1/get", "");
    watcher.wait_for("busker/modbus/line/relays/relay_1", "OFF");
    // Where the usual layout has them, there is nothing and nobody listens.
    assert!(all.iter().all(|got| !got.topic.starts_with("busker/relays")));

    // Back to the usual one without a restart: the broker keeps nothing of the other.
    let usual = format!(
        "mqtt: {{url: 'mqtt://127.0.0.1:{}'}}\n{}",
        broker.port,
        devices_on(&format!("tcp: '{}'", port.address()))
    );
    gateway.write(&usual);
    gateway.reload("what has changed is at work");
    watcher.wait_for("busker/relays/availability", "online");
    watcher.wait_for("busker/relays/relay_2", "ON");
    let mut left = Vec::new();
    // That is taken back behind all that is told anew.
    let _ = support::find(|| {
        let all = remembered(&broker, "later").into_iter();
        left = all.map(|got| got.topic).filter(|topic| topic.contains("/modbus/")).collect();
        left.is_empty().then_some(())
    });
    assert_eq!(left, [""; 0]);
}

#[test]
fn what_is_not_retained_is_told_to_who_listens_and_kept_for_nobody() {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let watcher = Watcher::start(&broker, "watcher");
    let link = format!("tcp: '{}'", port.address());
    let before = start(&broker, "json: true", &link);
    watcher.wait_for("busker/relays/relay_1", "OFF");
    watcher.wait_for("busker/relays/availability", "online");
    watcher.wait_until("all of it together", |got| got.topic == "busker/relays");
    assert!(before.terminate().success());
    payload(&remembered(&broker, "between"), "busker/relays/relay_1");

    watcher.forget();
    let _gateway = start(&broker, "json: true, retain: false, qos: 0", &link);
    watcher.wait_for("busker/relays/relay_1", "OFF");
    watcher.wait_for("busker/relays/availability", "online");
    watcher.wait_for("busker/bridge/state", "online");
    watcher.wait_until("its health", |got| got.topic == "busker/relays/health");
    watcher.wait_until("all of it together", |got| {
        got.topic == "busker/relays" && !got.payload.is_empty() && json(&got.payload)["relay_1"] == "OFF"
    });
    let all = remembered(&broker, "newcomer");
    let mut kept: Vec<&str> =
        all.iter().map(|got| got.topic.as_str()).filter(|topic| topic.starts_with("busker/relays")).collect();
    kept.sort_unstable();
    assert_eq!(kept, ["availability", "health", "info"].map(|name| format!("busker/relays/{name}")));
    payload(&all, "homeassistant/device/busker_relays/config");

    // Home Assistant starts, and knows nothing: it is told, at the latest after `republish`.
    watcher.forget();
    watcher.publish("homeassistant/status", "online");
    watcher.wait_until("discovery", |got| got.topic == "homeassistant/device/busker_relays/config");
    watcher.wait_for("busker/relays/relay_4", "OFF");
}

#[test]
fn a_device_tells_all_it_says_in_one_message_and_not_more_than_once_a_second() {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let watcher = Watcher::start(&broker, "watcher");
    let _gateway = start(&broker, "json: true", &format!("tcp: '{}'", port.address()));
    let whole = |got: &Received| got.topic == "busker/relays";
    watcher.wait_until("all of it", |got| whole(got) && json(&got.payload)["watchdog"] == 0.0);
    // When the device comes it may tell twice.
    let counter = Watcher::start(&broker, "counter");
    for round in 0..12 {
        watcher.forget();
        let wanted = if round % 2 == 0 { "ON" } else { "OFF" };
        for relay in ["relay_1", "relay_2", "relay_3", "relay_4"] {
            watcher.publish(&format!("busker/relays/{relay}/set"), wanted);
        }
        for relay in ["relay_1", "relay_2", "relay_3", "relay_4"] {
            watcher.wait_for(&format!("busker/relays/{relay}"), wanted);
        }
        if round == 11 {
            // The last word is how it is now.
            watcher.wait_until("the last of it", |got| {
                let relays = ["relay_1", "relay_2", "relay_3", "relay_4"];
                whole(got) && relays.iter().all(|relay| json(&got.payload)[relay] == "OFF")
            });
        }
    }
    // The rounds may take less than a second, and the last word comes to one before it comes to the other.
    counter.wait_until("one message", |got| whole(got) && !got.retained);
    let told: Vec<Received> =
        counter.received().into_iter().filter(|got| whole(got) && !got.retained).collect();
    let took = told[told.len() - 1].at - told[0].at;
    assert!(told.len() as u64 <= 2 + took.as_secs(), "{} in {took:?}", told.len());
    let later = Watcher::start(&broker, "later");
    let last = later.wait_until("all of it", whole);
    assert_eq!(json(&last.payload)["relay_1"], "OFF");
    assert_eq!(json(&last.payload)["relay_1_default"], "OFF");
    assert!(last.payload.contains("\"watchdog\":0.00"), "with its digits: {}", last.payload);
}

#[test]
fn the_info_tells_when_each_value_was_last_read_and_is_not_told_for_that_alone() {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let watcher = Watcher::start(&broker, "watcher");
    let _gateway = start(&broker, "qos: 1", &format!("tcp: '{}'", port.address()));
    let date =
        |got: &Received, point: &str| json(&got.payload)["last_read"][point].as_str().map(String::from);
    let info = |got: &Received| got.topic == "busker/relays/info";
    let first = watcher.wait_until("dates", |got| info(got) && date(got, "watchdog").is_some());
    let first = date(&first, "relay_1").expect("it was read");
    assert!(first.len() == "2026-11-27T02:10:00Z".len() && first.ends_with('Z'), "{first}");
    // Told again with everything else, and with other dates.
    watcher
        .wait_until("later dates", |got| info(got) && date(got, "relay_1").is_some_and(|date| date > first));
    let infos: Vec<Received> = watcher.received().into_iter().filter(info).collect();
    let same_but_dates = |got: &&Received| date(got, "relay_1").is_some();
    let told: Vec<&Received> = infos.iter().filter(same_but_dates).collect();
    for pair in told.windows(2) {
        let apart = pair[1].at - pair[0].at;
        // `republish` is 2 s; the relays are read twice in a second.
        assert!(apart.as_millis() > 1000, "{apart:?} apart");
    }
}
