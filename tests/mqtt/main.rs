//! The whole program between simulated devices and a real broker.

mod clients;
mod faults;
mod floods;
mod limits;
mod manners;
mod neighbours;
mod orphans;
mod proxy;
mod reload;
mod requests;
mod retelling;
mod secure;
#[path = "../support/mod.rs"]
mod support;
#[path = "../support/table.rs"]
mod table;
mod watching;

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::UnixDatagram;
use std::process::Command;

use busker::engine::time::Duration;
use busker::simulator::{DeviceAt, Framing, Model, Options, Simulation, TcpPort};
use serde_json::Value as Json;

use support::{Broker, Gateway, Received, Watcher};

/// A relay module with unit 18 and a counter module with unit 20.
fn simulation() -> Simulation {
    let devices = [DeviceAt { model: Model::MrDo4, unit: 18 }, DeviceAt { model: Model::MrSi4, unit: 20 }];
    Simulation::new(&devices, Options::default()).expect("the simulation starts")
}

fn over_tcp(simulation: &Simulation) -> TcpPort {
    simulation.serve_tcp("127.0.0.1:0", Framing::Tcp).expect("a free port")
}

fn devices_on(link: &str) -> String {
    format!(
        "buses: {{line: {{{link}}}}}\n\
         devices:\n  \
           relays: {{profile: metz-connect/mr-do4, bus: line, unit: 18, name: Relays}}\n  \
           counters: {{profile: metz-connect/mr-si4, bus: line, unit: 20, name: Counters}}\n"
    )
}

fn configuration(port: &TcpPort) -> String {
    devices_on(&format!("tcp: '{}'", port.address()))
}

#[track_caller]
fn wait_until_all_is_online(watcher: &Watcher) {
    for topic in ["busker/bridge/state", "busker/relays/availability", "busker/counters/availability"] {
        watcher.wait_for(topic, "online");
    }
}

/// A gateway between its devices and a broker when all is online, and who watches that: in the reverse of the order in
/// which they end.
#[track_caller]
fn all_online() -> ((TcpPort, Simulation), Broker, Watcher, Gateway) {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let watcher = Watcher::start(&broker, "watcher");
    let gateway = Gateway::start(&broker, &configuration(&port));
    wait_until_all_is_online(&watcher);
    ((port, simulation), broker, watcher, gateway)
}

/// What a newcomer is told at once, by topic.
fn remembered(broker: &Broker, name: &str) -> Vec<Received> {
    let newcomer = Watcher::start(broker, name);
    // The broker tells what it remembers before it tells what comes after the subscription.
    newcomer.publish("test/end", name);
    newcomer.wait_for("test/end", name);
    newcomer.received().into_iter().filter(|got| got.retained).collect()
}

#[track_caller]
fn payload<'m>(messages: &'m [Received], topic: &str) -> &'m str {
    let found = messages.iter().find(|got| got.topic == topic);
    &found.unwrap_or_else(|| panic!("`{topic}` is not remembered")).payload
}

fn json(text: &str) -> Json {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error}: {text}"))
}

#[test]
fn the_broker_remembers_states_availability_and_discovery() {
    let (_devices, broker, watcher, gateway) = all_online();
    watcher.wait_for("busker/relays/relay_1", "OFF");
    watcher.wait_until("good health", |got| {
        got.topic == "busker/bridge/health" && json(&got.payload)["status"] == "ok"
    });

    let all = remembered(&broker, "newcomer");
    assert_eq!(payload(&all, "busker/bridge/state"), "online");
    assert_eq!(payload(&all, "busker/relays/availability"), "online");
    assert_eq!(payload(&all, "busker/relays/relay_4"), "OFF");
    assert_eq!(json(payload(&all, "busker/relays/info"))["unit"], 18);
    assert_eq!(json(payload(&all, "busker/bridge/info"))["devices"]["counters"]["bus"], "line");
    assert_eq!(json(payload(&all, "busker/bridge/health"))["broker"]["connected"], true);
    let config = json(payload(&all, "homeassistant/device/busker_relays/config"));
    assert_eq!(config["components"]["relay_1"]["unique_id"], "busker_relays_relay_1");
    for device in ["busker_bridge", "busker_bus_line", "busker_counters"] {
        payload(&all, &format!("homeassistant/device/{device}/config"));
    }
    // Nobody published anything, so nothing but what is retained may be there.
    let outcomes = all.iter().filter(|got| got.topic.ends_with("/outcome"));
    assert_eq!(outcomes.count(), 0);
    assert!(gateway.terminate().success());
}

#[test]
fn everything_is_sent_again_when_the_broker_has_forgotten_it() {
    let (mut broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let watcher = Watcher::start(&broker, "watcher");
    let gateway = Gateway::start(&broker, &configuration(&port));
    wait_until_all_is_online(&watcher);
    gateway.wait_for_health(200);
    let topics = |all: &[Received]| all.iter().map(|got| got.topic.clone()).collect::<BTreeSet<_>>();
    let before = topics(&remembered(&broker, "before"));
    assert!(before.len() > 60, "{before:?}");

    broker.kill();
    gateway.wait_for_health(503);
    // What changes meanwhile is told as it is when the broker is back, and not as it was.
    simulation.command("unit 18 relay 3 hand on").expect("a hand on the relay");
    broker.restart();
    gateway.wait_for_health(200);
    let watcher = Watcher::start(&broker, "watcher_2");
    watcher.wait_for("busker/bridge/state", "online");
    watcher.wait_for("busker/relays/relay_3", "ON");
    assert_eq!(topics(&remembered(&broker, "after")), before);

    watcher.publish("busker/relays/relay_2/set", "ON");
    let outcome = watcher.wait_until("an outcome", |got| got.topic == "busker/relays/relay_2/outcome");
    assert_eq!(json(&outcome.payload)["outcome"], "done", "commands arrive again");
}

#[test]
fn a_birth_message_is_answered_with_discovery_and_a_second_later_with_states() {
    let (_devices, _broker, watcher, _gateway) = all_online();

    watcher.forget();
    watcher.publish("homeassistant/status", "online");
    let config = |got: &Received| got.topic == "homeassistant/device/busker_counters/config";
    let config = watcher.wait_until("discovery", config);
    let state = watcher.wait_for("busker/relays/relay_4", "OFF");
    assert!(state.at - config.at >= Duration::from_secs(1), "{:?} after discovery", state.at - config.at);
    let order: Vec<String> = watcher
        .received()
        .into_iter()
        .filter(|got| got.topic.starts_with("homeassistant/device/"))
        .map(|got| got.topic)
        .collect();
    assert_eq!(order[0], "homeassistant/device/busker_bridge/config", "{order:?}");
}

#[test]
fn a_retained_command_is_ignored_and_said_so_once() {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let watcher = Watcher::start(&broker, "watcher");
    watcher.publish_retained("busker/relays/relay_1/set", "ON");
    watcher.wait_for("busker/relays/relay_1/set", "ON");
    let gateway = Gateway::start(&broker, &configuration(&port));
    wait_until_all_is_online(&watcher);
    gateway.wait_for_log("`busker/relays/relay_1/set` is ignored");

    // Commands are obeyed in order: when this one is done, the other was not waiting before it.
    watcher.publish("busker/relays/relay_2/set", "ON");
    let outcome = watcher.wait_until("an outcome", |got| got.topic == "busker/relays/relay_2/outcome");
    assert_eq!(json(&outcome.payload)["outcome"], "done");
    assert_eq!(relay(&simulation, 1), "OFF");
    assert_eq!(relay(&simulation, 2), "ON");
    assert_eq!(watcher.payloads("busker/relays/relay_1/outcome"), [""; 0]);
    let said = gateway.log().iter().filter(|line| line.contains("relay_1/set")).count();
    assert_eq!(said, 1, "{:?}", gateway.log());
}

#[track_caller]
fn relay(simulation: &Simulation, number: u8) -> String {
    let outputs = simulation.outputs(18).expect("unit 18 is simulated");
    let name = format!("relay_{number}");
    let found = outputs.into_iter().find(|(output, _)| *output == name);
    found.unwrap_or_else(|| panic!("there is no {name}")).1
}

#[test]
fn a_command_is_done_when_it_has_been_read_back_and_the_state_shows_what_was_read() {
    let (broker, simulation) = (Broker::start(), simulation());
    let line = simulation.serve_pty(None).expect("a pseudo-terminal");
    let watcher = Watcher::start(&broker, "watcher");
    let link = format!("serial: {}, baud: 19200, parity: even", line.path().display());
    let _gateway = Gateway::start(&broker, &devices_on(&link));
    wait_until_all_is_online(&watcher);

    watcher.publish("busker/relays/relay_2/set", "ON");
    let outcome = watcher.wait_until("an outcome", |got| got.topic == "busker/relays/relay_2/outcome");
    assert_eq!(json(&outcome.payload)["outcome"], "done");
    assert_eq!(json(&outcome.payload)["found"], "ON");
    watcher.wait_for("busker/relays/relay_2", "ON");
    assert_eq!(relay(&simulation, 2), "ON");

    for (wanted, expected) in [("maybe", "refused"), ("1", "refused"), ("", "refused")] {
        watcher.forget();
        watcher.publish("busker/relays/relay_2/set", wanted);
        let outcome = watcher.wait_until("an outcome", |got| got.topic == "busker/relays/relay_2/outcome");
        assert_eq!(json(&outcome.payload)["outcome"], expected, "{wanted:?}");
        assert_eq!(json(&outcome.payload)["wanted"], wanted);
    }

    // A relay that is held by hand does not follow; its state stays what it is.
    simulation.command("unit 18 relay 4 hand on").expect("a hand on the relay");
    watcher.wait_for("busker/relays/relay_4", "ON");
    watcher.forget();
    watcher.publish("busker/relays/relay_4/set", "OFF");
    let outcome = watcher.wait_until("an outcome", |got| got.topic == "busker/relays/relay_4/outcome");
    assert_eq!(json(&outcome.payload)["outcome"], "not_taken");
    assert_eq!(json(&outcome.payload)["found"], "ON");
    assert!(!watcher.payloads("busker/relays/relay_4").contains(&"OFF".to_string()));
}

#[test]
fn a_flood_of_commands_ends_with_the_newest_and_leaves_the_gateway_well() {
    const FLOOD: usize = 2000;
    // By itself the broker drops what is more than a thousand messages ahead of a client.
    let broker = Broker::start_with("allow_anonymous true\npersistence false\nmax_queued_messages 0\n");
    let simulation = simulation();
    let port = over_tcp(&simulation);
    let watcher = Watcher::start(&broker, "watcher");
    let gateway = Gateway::start(&broker, &configuration(&port));
    wait_until_all_is_online(&watcher);
    for number in 0..FLOOD {
        watcher.publish("busker/relays/relay_3/set", if number % 2 == 0 { "ON" } else { "OFF" });
    }
    watcher.publish("busker/relays/relay_3/set", "ON");
    // From another point, so that it waits behind the flood.
    watcher.publish("busker/relays/relay_1/set", "ON");
    watcher.wait_until("an outcome", |got| got.topic == "busker/relays/relay_1/outcome");
    watcher.wait_until("the last outcome", |got| {
        got.topic == "busker/relays/relay_3/outcome"
            && json(&got.payload)["outcome"] == "done"
            && json(&got.payload)["wanted"] == "ON"
    });
    support::find(|| (relay(&simulation, 3) == "ON").then_some(())).expect("the newest has won");
    gateway.wait_for_health(200);
    let (_, metrics) = gateway.get("/metrics");
    let writes = metrics
        .lines()
        .find_map(|line| line.strip_prefix("busker_device_writes_total{bus=\"line\",device=\"relays\"} "))
        .and_then(|count| count.parse::<usize>().ok())
        .expect("writes are counted");
    assert!(writes < FLOOD / 2, "{writes} writes: a newer value replaces one that waits");
}

#[test]
fn the_last_message_is_offline_when_the_gateway_is_asked_to_end() {
    let (_devices, broker, watcher, gateway) = all_online();
    watcher.forget();
    let status = gateway.terminate();
    assert_eq!(status.code(), Some(0));
    watcher.wait_for("busker/bridge/state", "offline");
    let ours: Vec<String> = watcher
        .received()
        .into_iter()
        .filter(|got| got.topic.ends_with("/availability") || got.topic == "busker/bridge/state")
        .map(|got| format!("{} {}", got.topic, got.payload))
        .collect();
    assert_eq!(
        ours,
        [
            "busker/relays/availability offline",
            "busker/counters/availability offline",
            "busker/bridge/state offline"
        ]
    );
    let last = watcher.received().into_iter().rfind(|got| got.topic.starts_with("busker/"));
    assert_eq!(last.map(|got| got.topic).as_deref(), Some("busker/bridge/state"));
    let all = remembered(&broker, "newcomer");
    assert_eq!(payload(&all, "busker/bridge/state"), "offline");
}

#[test]
fn the_last_will_says_offline_when_the_gateway_is_killed() {
    let (_devices, broker, watcher, gateway) = all_online();
    watcher.forget();
    gateway.kill();
    watcher.wait_for("busker/bridge/state", "offline");
    let all = remembered(&broker, "newcomer");
    assert_eq!(payload(&all, "busker/bridge/state"), "offline");
    assert_eq!(payload(&all, "busker/relays/availability"), "online", "nobody was there to say more");
}

#[test]
fn what_the_configuration_has_no_more_is_taken_from_home_assistant() {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let watcher = Watcher::start(&broker, "watcher");
    let board = |points: &str| {
        format!(
            "buses: {{line: {{tcp: '{}'}}}}\ndevices:\n  board: {{bus: line, unit: 18, points: {{{points}}}}}\n",
            port.address()
        )
    };
    let both = board("one: {at: coil 0, poll: fast}, two: {at: coil 1, poll: fast}");
    let counters = "  counters: {profile: metz-connect/mr-si4, bus: line, unit: 20}\n";
    let config = "homeassistant/device/busker_board/config";
    let gateway = Gateway::start(&broker, &format!("{both}{counters}"));
    watcher.wait_for("busker/board/availability", "online");
    watcher.wait_for("busker/counters/availability", "online");
    assert!(gateway.terminate().success());
    watcher.publish_retained("homeassistant/device/somebody/config", "{}");
    watcher.wait_for("homeassistant/device/somebody/config", "{}");
    let before = payload(&remembered(&broker, "between"), config).to_string();

    watcher.forget();
    let _gateway = Gateway::start(&broker, &board("one: {at: coil 0, poll: fast}"));
    watcher.wait_until("the removal of the counters", |got| {
        got.topic == "homeassistant/device/busker_counters/config" && got.payload.is_empty()
    });
    let tombstone = serde_json::json!({"platform": "binary_sensor"});
    let buried = |got: &Received| got.topic == config && json(&got.payload)["components"]["two"] == tombstone;
    watcher.wait_until("the burial of the point", buried);
    let told = || -> Vec<String> {
        watcher.received().into_iter().filter(|got| got.topic == config).map(|got| got.payload).collect()
    };
    let is_without = |payload: &String| json(payload)["components"].get("two").is_none();
    support::find(|| told().last().is_some_and(is_without).then_some(())).expect("it ends without the point");
    let told = told();
    let at = told.iter().position(|payload| json(payload)["components"]["two"] == tombstone);
    let at = at.expect("it was buried");
    let (known, before) = (json(&told[at - 1]), json(&before));
    let two = &before["components"]["two"];
    assert_eq!(
        known["components"],
        serde_json::json!({"two": two}),
        "Home Assistant buries only what it knows"
    );

    let all = remembered(&broker, "after");
    assert!(json(payload(&all, config))["components"].get("two").is_none());
    assert!(!all.iter().any(|got| got.topic == "homeassistant/device/busker_counters/config"));
    assert_eq!(payload(&all, "homeassistant/device/somebody/config"), "{}");
}

#[test]
fn http_tells_how_everything_is() {
    let ((port, simulation), _broker, watcher, gateway) = all_online();
    let (status, body) = gateway.get("/health");
    assert_eq!((status, json(&body)["status"].as_str()), (200, Some("ok")));

    // One dead device is no reason for an alarm that restarts the gateway.
    watcher.forget();
    simulation.command("unit 20 fault silent").expect("the fault is known");
    watcher.wait_for("busker/counters/availability", "offline");
    let (status, body) = gateway.get("/health");
    assert_eq!((status, json(&body)["status"].as_str()), (200, Some("degraded")));
    assert_eq!(json(&body)["devices"]["relays"]["online"], true);

    let (_, body) = gateway.get("/api/devices");
    let devices = json(&body);
    assert_eq!(devices[0]["name"], "relays");
    assert_eq!(devices[0]["identity"], "METZ CONNECT GmbH MR-DO4 V1.4");
    assert_eq!(devices[0]["points"][0]["value"], "OFF");
    assert_eq!(devices[1]["online"], false);
    let (_, body) = gateway.get("/api/buses");
    assert_eq!(json(&body)[0]["devices"], serde_json::json!(["relays", "counters"]));
    let (_, body) = gateway.get("/metrics");
    assert!(body.contains("busker_device_online{bus=\"line\",device=\"counters\"} 0.0"), "{body}");
    assert!(body.ends_with("# EOF\n"));
    assert_eq!(gateway.get("/anything").0, 404);

    drop(port);
    gateway.wait_for_health(503);
}

/// `mosquitto_passwd` on `busker` and `open sesame`.
const HASH: &str = "busker:$7$101$BtdmltEzcLwk8OSY$\
E/hZue7W5k918I4FS8G53PMCS/qjssXbAFlKHAqCMycxZVLVqN+w0FWxALcZUZnXHN79lYWz/wzftKwo29BOUQ==\n";

#[test]
fn a_broker_that_wants_a_password_gets_it_and_no_log_does() {
    let folder = tempfile::tempdir().expect("a folder");
    let hashes = support::temporary_file(&folder, "hashes", HASH);
    // A mosquitto that is started by root reads it as another user.
    fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o755)).expect("the folder can be opened");
    fs::set_permissions(&hashes, fs::Permissions::from_mode(0o644)).expect("the file can be opened");
    let broker = Broker::start_with(&format!("allow_anonymous false\npassword_file {}\n", hashes.display()));
    let simulation = simulation();
    let port = over_tcp(&simulation);
    let start = |password: &str| {
        let file = support::temporary_file(&folder, "password", password);
        Gateway::start_with(&format!(
            "mqtt: {{url: 'mqtt://127.0.0.1:{}', username: busker, password_file: {}}}\n{}",
            broker.port,
            file.display(),
            configuration(&port)
        ))
    };
    let gateway = start("wrong sesame\n");
    gateway.wait_for_log("refuses this user name and password");
    gateway.wait_for_health(503);
    assert!(!gateway.log().join("\n").contains("sesame"), "{:?}", gateway.log());
    gateway.kill();

    let gateway = start("open sesame\n");
    let watcher = Watcher::start_as(&broker, "watcher", Some(("busker", "open sesame")));
    wait_until_all_is_online(&watcher);
    assert!(!gateway.log().join("\n").contains("sesame"), "{:?}", gateway.log());
    assert!(watcher.received().iter().all(|got| !got.payload.contains("sesame")));
}

#[test]
fn systemd_is_told_of_start_life_and_end_and_the_journal_stamps_the_lines() {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("notify");
    let socket = UnixDatagram::bind(&path).expect("a socket");
    socket.set_read_timeout(Some(Duration::from_secs(20))).expect("the time is positive");
    let next = || {
        let mut bytes = [0; 256];
        let length = socket.recv(&mut bytes).expect("systemd is told something");
        String::from_utf8_lossy(&bytes[..length]).trim_end().to_string()
    };
    let path = path.to_str().expect("the path is text");
    let gateway = Gateway::start_in(
        &[("NOTIFY_SOCKET", path), ("WATCHDOG_USEC", "900000"), ("JOURNAL_STREAM", "8:1")],
        &format!("mqtt: {{url: 'mqtt://127.0.0.1:{}'}}\n{}", broker.port, configuration(&port)),
    );
    // The watchdog may be fed for the first time before all is ready.
    let mut told: Vec<String> = (0..4).map(|_| next()).collect();
    assert!(told.contains(&"READY=1".to_string()), "{told:?}");
    told.retain(|line| line != "READY=1");
    assert_eq!(told, ["WATCHDOG=1"; 3]);
    let line = gateway.wait_for_log("HTTP on");
    assert!(line.trim_start().starts_with("INFO HTTP on"), "`{line}` has a time of its own");
    assert!(gateway.terminate().success());
    support::find(|| (next() == "STOPPING=1").then_some(())).expect("the end is told");
}

#[test]
fn a_wrong_configuration_starts_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = support::temporary_file(&folder, "busker.yaml", "buses: {line: {tcp: nowhere}}\nfoo: 1\n");
    let output = Command::new(env!("CARGO_BIN_EXE_busker"))
        .args(["run", "--config"])
        .arg(&file)
        .output()
        .expect("busker starts");
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{text}");
    for place in ["busker.yaml:1:21: ", "busker.yaml:2:1: "] {
        assert!(text.contains(place), "`{place}` is not in\n{text}");
    }
    assert!(!text.contains("HTTP on"), "{text}");
}
