//! What programs ask the gateway over MQTT, and how it answers.

use busker::edge::link::Link;
use busker::engine::settings::{self, Line, Parity};
use busker::simulator::{DeviceAt, Model, Options, Simulation};
use serde_json::{Value as Json, json};

use crate::support::{Broker, Gateway, Watcher};
use crate::{configuration, json, over_tcp, relay, simulation, wait_until_all_is_online};

/// Asks, and waits for the answer to that very request.
#[track_caller]
fn ask(watcher: &Watcher, verb: &str, mut request: Json, transaction: &str) -> Json {
    request["transaction"] = transaction.into();
    watcher.publish(&format!("busker/bridge/request/{verb}"), &request.to_string());
    let topic = format!("busker/bridge/response/{verb}");
    let is_answer = |payload: &str| {
        let payload = json(payload);
        payload["transaction"] == transaction && payload["status"] != "progress"
    };
    let answer = watcher
        .wait_until(&format!("an answer to {request}"), |got| got.topic == topic && is_answer(&got.payload));
    assert!(!answer.retained);
    json(&answer.payload)
}

#[test]
fn a_program_reads_writes_and_finds_out_over_mqtt() {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let watcher = Watcher::start(&broker, "watcher");
    let text =
        configuration(&port).replace("name: Relays", "name: Relays, raw_write: [holding 66, coil 0..3]");
    let gateway = Gateway::start(&broker, &text);
    wait_until_all_is_online(&watcher);

    let read = ask(&watcher, "read", json!({"device": "relays", "at": "coil 0..3"}), "1");
    assert_eq!(read["data"]["words"], json!([0, 0, 0, 0]), "{read}");
    assert_eq!(read["data"]["points"]["relay_4"], "OFF");

    let write = json!({"device": "relays", "at": "coil 0..3", "value": [0, 1, 1, 0]});
    let written = ask(&watcher, "write", write, "2");
    assert_eq!(written["data"]["outcome"], "done", "{written}");
    assert_eq!(written["error"], Json::Null);
    assert_eq!([1, 2, 3, 4].map(|number| relay(&simulation, number)), ["OFF", "ON", "ON", "OFF"]);
    watcher.wait_for("busker/relays/relay_3", "ON");
    let again = ask(&watcher, "write", json!({"device": "relays", "at": "holding 66", "value": 3000}), "3");
    assert_eq!(again["status"], "ok", "{again}");
    let refused = ask(&watcher, "write", json!({"device": "relays", "at": "holding 65", "value": 1}), "4");
    assert_eq!(refused["status"], "error");
    let refused = ask(&watcher, "write", json!({"device": "counters", "at": "coil 0", "value": 1}), "5");
    assert!(
        refused["error"].as_str().is_some_and(|error| error.contains("raw_write: [coil 0]")),
        "{refused}"
    );

    let identity = ask(&watcher, "identify", json!({"device": "relays"}), "6");
    assert_eq!(identity["data"]["objects"]["product"], "MR-DO4", "{identity}");
    assert_eq!(identity["data"]["profile"]["matches"], true);

    let diagnostics = ask(&watcher, "diagnostics", json!({"device": "counters"}), "7");
    assert!(
        diagnostics["data"]["busker"]["requests"].as_u64().is_some_and(|count| count > 3),
        "{diagnostics}"
    );

    watcher.forget();
    let refreshed = ask(&watcher, "refresh", json!({"device": "counters"}), "8");
    assert_eq!(refreshed["status"], "ok", "{refreshed}");
    watcher.wait_until("discovery", |got| got.topic == "homeassistant/device/busker_counters/config");
    assert!(watcher.received().iter().any(|got| got.topic == "busker/counters/input_1_counter"
        || got.topic.starts_with("busker/counters/") && !got.topic.ends_with("/info")));

    let nonsense = "{\"device\":\"relays\"";
    watcher.publish("busker/bridge/request/read", nonsense);
    let answer = watcher.wait_until("an error", |got| {
        got.topic == "busker/bridge/response/read" && got.payload.contains("this is no JSON")
    });
    assert!(answer.payload.contains("expected an object like"), "{}", answer.payload);
    assert!(gateway.terminate().success());
}

#[test]
fn a_scan_finds_who_is_not_configured_and_proposes_how_it_would_be() {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let watcher = Watcher::start(&broker, "watcher");
    let without_counters = configuration(&port);
    let without_counters = without_counters.split("  counters:").next().expect("a text");
    let _gateway = Gateway::start(&broker, without_counters);
    watcher.wait_for("busker/relays/availability", "online");
    let scan = ask(&watcher, "scan", json!({"bus": "line", "units": "18..20"}), "s");
    assert_eq!(scan["status"], "ok", "{scan}");
    let found = scan["data"]["found"].as_array().expect("a list");
    assert_eq!(found[0]["device"], "relays");
    let counters = found.iter().find(|found| found["unit"] == 20).expect("unit 20");
    assert_eq!(counters["configuration"], "mr_si4_20: {profile: metz-connect/mr-si4, bus: line, unit: 20}");
}

#[test]
fn a_paused_bus_gives_its_port_away_and_takes_it_back() {
    let broker = Broker::start();
    let devices = [DeviceAt { model: Model::MrDo4, unit: 18 }, DeviceAt { model: Model::MrSi4, unit: 20 }];
    let simulation = Simulation::new(&devices, Options::default()).expect("the simulation starts");
    let line = simulation.serve_pty(None).expect("a pseudo-terminal");
    let watcher = Watcher::start(&broker, "watcher");
    let link = format!("serial: {}, baud: 19200, parity: even", line.path().display());
    let gateway = Gateway::start(&broker, &crate::devices_on(&link));
    wait_until_all_is_online(&watcher);
    let path = line.path().display().to_string();
    let line_settings = Line { baud: 19200, parity: Parity::Even, stop_bits: 1 };
    let is_taken = || {
        Link::open(&settings::Link::Serial {
            path: path.clone(),
            line: line_settings,
            rs485: settings::Rs485::Auto,
        })
        .is_err()
    };
    assert!(is_taken(), "the port is the gateway's alone");

    let paused = ask(&watcher, "pause", json!({"bus": "line", "for": "10m"}), "1");
    assert!(paused["data"]["paused_until"].is_string(), "{paused}");
    watcher.wait_for("busker/relays/availability", "offline");
    assert!(!is_taken(), "the port is free for others");
    let info = watcher.wait_until("the reason", |got| {
        got.topic == "busker/relays/info" && got.payload.contains("paused until")
    });
    assert_eq!(json(&info.payload)["online"], false);
    watcher.wait_until("the pause in bridge/info", |got| {
        got.topic == "busker/bridge/info" && json(&got.payload)["paused"]["line"].is_string()
    });
    let (code, health) = gateway.get("/health");
    let health = json(&health);
    assert_eq!(
        (code, &health["status"], &health["buses"]["line"]["paused"]),
        (200, &"degraded".into(), &true.into())
    );

    watcher.forget();
    ask(&watcher, "pause", json!({"device": "relays", "for": "0s"}), "2");
    for device in ["relays", "counters"] {
        watcher.wait_for(&format!("busker/{device}/availability"), "online");
    }
    watcher.wait_until("the end of the pause in bridge/info", |got| {
        got.topic == "busker/bridge/info" && json(&got.payload)["paused"] == json!({})
    });

    // By itself.
    watcher.forget();
    ask(&watcher, "pause", json!({"bus": "line", "for": "100ms"}), "3");
    watcher.wait_for("busker/relays/availability", "offline");
    watcher.wait_for("busker/relays/availability", "online");
}

#[test]
fn a_retained_request_is_ignored_and_that_is_said() {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let watcher = Watcher::start(&broker, "watcher");
    let request = r#"{"bus":"line","for":"1h"}"#;
    watcher.publish_retained("busker/bridge/request/pause", request);
    watcher.wait_for("busker/bridge/request/pause", request);
    let gateway = Gateway::start(&broker, &configuration(&port));
    wait_until_all_is_online(&watcher);
    gateway.wait_for_log("`busker/bridge/request/pause` is ignored");
    ask(&watcher, "identify", json!({"device": "relays"}), "1");
    assert!(watcher.payloads("busker/bridge/response/pause").is_empty());
}
