//! A changed configuration while the gateway runs.

use std::fs::File;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::unix::net::UnixDatagram;
use std::sync::{Arc, Mutex};
use std::thread;

use busker::edge::clock::Clock;
use busker::engine::time::{Duration, Time};

use rustix::fs::{CWD, FileType, Mode, OFlags, mknodat};

use crate::support::{Broker, Gateway, Received, Watcher, find, temporary_folder, wait_for};
use crate::{json, over_tcp, remembered, simulation};

/// A server of Modbus TCP that answers every read with zeros and remembers when it was asked.
pub(super) struct Witness {
    pub(super) address: SocketAddr,
    asked: Arc<Mutex<Vec<Time>>>,
    connections: Arc<Mutex<u32>>,
}

impl Witness {
    pub(super) fn start() -> Witness {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = listener.local_addr().expect("its address");
        let witness = Witness { address, asked: Arc::default(), connections: Arc::default() };
        let (asked, connections, clock) =
            (witness.asked.clone(), witness.connections.clone(), Clock::start());
        thread::spawn(move || {
            for stream in listener.incoming().map_while(Result::ok) {
                *connections.lock().expect("nobody panics with it") += 1;
                let asked = asked.clone();
                thread::spawn(move || serve(stream, &asked, clock));
            }
        });
        witness
    }

    pub(super) fn count(&self) -> usize {
        self.asked.lock().expect("nobody panics with it").len()
    }

    pub(super) fn wait_for_more(&self, more: usize) {
        let wanted = self.count() + more;
        find(|| (self.count() >= wanted).then_some(())).expect("polls go on");
    }

    /// The longest time between two questions, from the question number `from` on.
    pub(super) fn longest_gap(&self, from: usize) -> Duration {
        let asked = self.asked.lock().expect("nobody panics with it");
        asked[from..].windows(2).map(|pair| pair[1] - pair[0]).max().expect("two questions")
    }

    pub(super) fn connections(&self) -> u32 {
        *self.connections.lock().expect("nobody panics with it")
    }
}

fn serve(mut stream: TcpStream, asked: &Mutex<Vec<Time>>, clock: Clock) {
    let mut request = [0; 12];
    while stream.read_exact(&mut request).is_ok() {
        asked.lock().expect("nobody panics with it").push(clock.now());
        let count = request[11];
        let mut reply = request[..4].to_vec();
        reply.extend([0, 3 + 2 * count, request[6], request[7], 2 * count]);
        reply.extend(vec![0; usize::from(2 * count)]);
        if stream.write_all(&reply).is_err() {
            return;
        }
    }
}

/// The unchanged bus and its only device.
pub(super) fn steady(witness: &Witness) -> (String, String) {
    (
        format!("steady: {{tcp: '{}'}}", witness.address),
        "pump: {bus: steady, unit: 1, points: {flow: {at: input 0, poll: fast}}, poll: {fast: 300ms}}".into(),
    )
}

pub(super) fn text(broker: &Broker, buses: &[&str], devices: &[&str]) -> String {
    format!(
        "mqtt: {{url: 'mqtt://127.0.0.1:{}'}}\nbuses:\n  {}\ndevices:\n  {}\n",
        broker.port,
        buses.join("\n  "),
        devices.join("\n  "),
    )
}

pub(super) const RELAYS: &str = "relays: {profile: metz-connect/mr-do4, bus: line, unit: 18, name: Relays}";
pub(super) const COUNTERS: &str =
    "counters: {profile: metz-connect/mr-si4, bus: line, unit: 20, name: Counters}";
pub(super) const DONE: &str = "what has changed is at work";

#[track_caller]
fn online(watcher: &Watcher, devices: &[&str]) {
    online_at(watcher, "busker", devices);
}

#[track_caller]
pub(super) fn online_at(watcher: &Watcher, base: &str, devices: &[&str]) {
    for device in devices {
        watcher.wait_for(&format!("{base}/{device}/availability"), "online");
    }
}

fn topics_of<'m>(all: &'m [Received], device: &str) -> Vec<&'m str> {
    let (below, identity) = (format!("busker/{device}/"), format!("/busker_{device}/config"));
    let of_it = |topic: &&str| topic.starts_with(&below) || topic.ends_with(&identity);
    all.iter().map(|got| got.topic.as_str()).filter(of_it).collect()
}

#[test]
fn what_is_unchanged_goes_on_while_the_rest_comes_goes_and_changes() {
    let (broker, simulation, witness) = (Broker::start(), simulation(), Witness::start());
    let port = over_tcp(&simulation);
    let line = format!("line: {{tcp: '{}'}}", port.address());
    let (steady, pump) = steady(&witness);
    let watcher = Watcher::start(&broker, "watcher");
    let first = text(&broker, &[&line, &steady], &[RELAYS, COUNTERS, &pump]);
    let gateway = Gateway::start_with(&first);
    online(&watcher, &["relays", "counters", "pump"]);
    watcher.wait_until("discovery", |got| got.topic == "homeassistant/device/busker_counters/config");
    witness.wait_for_more(3);

    // A device goes, one is called otherwise, a bus with a device comes.
    let (from, other) = (witness.count(), Witness::start());
    let new_bus = format!("other: {{tcp: '{}'}}", other.address);
    let valve = "valve: {bus: other, unit: 5, points: {position: {at: input 3, poll: fast}}}";
    let relays = RELAYS.replace("Relays", "Heating");
    gateway.write(&text(&broker, &[&steady, &new_bus, &line], &[&pump, valve, &relays]));
    watcher.forget();
    gateway.reload(DONE);
    online(&watcher, &["valve", "relays"]);
    watcher.wait_until("the new name", |got| {
        got.topic.ends_with("busker_relays/config") && got.payload.contains("Heating")
    });
    watcher.wait_for("homeassistant/device/busker_counters/config", "");
    watcher.wait_for("busker/counters/availability", "");
    watcher.wait_until("the new info", |got| {
        got.topic == "busker/bridge/info" && json(&got.payload)["devices"]["valve"]["bus"] == "other"
    });
    let told = watcher.received();
    // How it is on its wire is told when anything begins anew.
    let of_pump = topics_of(&told, "pump");
    let of_pump: Vec<&str> = of_pump.into_iter().filter(|topic| !topic.ends_with("/health")).collect();
    assert!(of_pump.is_empty(), "the pump is told of although it is unchanged: {of_pump:?}");
    let all = remembered(&broker, "newcomer");
    assert!(topics_of(&all, "counters").is_empty(), "{:?}", topics_of(&all, "counters"));
    assert!(topics_of(&all, "pump").len() >= 4, "{:?}", topics_of(&all, "pump"));
    // Commands find their way although the buses have other numbers.
    watcher.publish("busker/relays/relay_2/set", "ON");
    let outcome = watcher.wait_until("an outcome", |got| got.topic == "busker/relays/relay_2/outcome");
    assert_eq!(json(&outcome.payload)["outcome"], "done");

    // A bus goes, with its device; another one gets another link.
    gateway.write(&text(
        &broker,
        &[&steady, &line.replace("'}", "', response_timeout: 700ms}")],
        &[&pump, &relays],
    ));
    watcher.forget();
    gateway.reload(DONE);
    watcher.wait_for("homeassistant/device/busker_bus_other/config", "");
    watcher.wait_for("busker/valve/position", "");
    online(&watcher, &["relays"]);
    let (code, health) = gateway.get("/health");
    let health = json(&health);
    assert_eq!((code, &health["status"]), (200, &"ok".into()), "{health}");
    assert!(health["buses"]["other"].is_null() && health["devices"]["valve"].is_null(), "{health}");

    witness.wait_for_more(3);
    assert_eq!(witness.connections(), 1, "the unchanged bus kept its connection");
    // Each period is 300 ms: where a poll is left out, twice that passes.
    let longest = witness.longest_gap(from.saturating_sub(2));
    assert!(longest < Duration::from_millis(600), "a poll was lost: {longest:?}");
    assert!(gateway.terminate().success());
}

#[test]
fn another_budget_for_eeprom_is_taken_while_every_bus_goes_on_and_every_count() {
    let (broker, simulation, witness) = (Broker::start(), simulation(), Witness::start());
    let port = over_tcp(&simulation);
    let line = format!("line: {{tcp: '{}'}}", port.address());
    let (steady, pump) = steady(&witness);
    let watcher = Watcher::start(&broker, "watcher");
    let before = text(&broker, &[&line, &steady], &[RELAYS, &pump]);
    let gateway = Gateway::start_with(&format!("eeprom: {{daily: 2}}\n{before}"));
    online(&watcher, &["relays", "pump"]);
    let set = |number: u8, value: &str, wanted: &str| {
        let point = format!("busker/relays/relay_{number}_default");
        watcher.publish(&format!("{point}/set"), value);
        let outcome = watcher.wait_until("an outcome", |got| got.topic == format!("{point}/outcome"));
        assert_eq!(json(&outcome.payload)["outcome"], wanted, "{}", outcome.payload);
    };
    set(1, "ON", "done");
    set(2, "ON", "refused");
    let from = witness.count();
    gateway.write(&format!("eeprom: {{daily: 6}}\n{before}"));
    watcher.forget();
    gateway.reload(DONE);
    set(3, "ON", "done");
    set(4, "ON", "done");
    watcher.wait_until("all three counted", |got| {
        got.topic == "busker/relays/info" && json(&got.payload)["eeprom_writes"] == 3
    });
    for point in ["relays/availability", "pump/availability", "pump/flow"] {
        assert_eq!(watcher.payloads(&format!("busker/{point}")), [""; 0], "{point} is told anew");
    }
    witness.wait_for_more(3);
    assert_eq!(witness.connections(), 1, "the bus kept its connection");
    let longest = witness.longest_gap(from.saturating_sub(2));
    assert!(longest < Duration::from_millis(600), "a poll was lost: {longest:?}");
    assert!(gateway.terminate().success());
}

#[test]
fn what_is_remembered_goes_to_another_folder_while_every_bus_goes_on() {
    let (broker, simulation, witness) = (Broker::start(), simulation(), Witness::start());
    let port = over_tcp(&simulation);
    let line = format!("line: {{tcp: '{}'}}", port.address());
    let (steady, pump) = steady(&witness);
    let watcher = Watcher::start(&broker, "watcher");
    let text = text(&broker, &[&line, &steady], &[RELAYS, &pump]);
    let gateway = Gateway::start_with(&text);
    online(&watcher, &["relays", "pump"]);
    let set = |number: u8| {
        let point = format!("busker/relays/relay_{number}_default");
        watcher.publish(&format!("{point}/set"), "ON");
        let outcome = watcher.wait_until("an outcome", |got| got.topic == format!("{point}/outcome"));
        assert_eq!(json(&outcome.payload)["outcome"], "done", "{}", outcome.payload);
    };
    set(1);
    let from = witness.count();
    let folder = tempfile::tempdir().expect("a folder");
    let other = folder.path().display();
    gateway.write_whole(&format!("http: {{listen: '127.0.0.1:0'}}\nstate_dir: {other}\n{text}"));
    watcher.forget();
    gateway.reload(DONE);
    set(2);
    let file = folder.path().join("devices/relays.json");
    let written = || Some(json(&std::fs::read_to_string(&file).ok()?)["persistent_writes"] == 2);
    find(|| written().filter(|is_so| *is_so)).expect("both writes are remembered there");
    // Nothing but a lock is held of the old one, and that no more.
    let is_old = |path: &std::path::PathBuf| path.starts_with(gateway.state());
    assert!(!gateway.open_files().iter().any(is_old), "{:?}", gateway.open_files());
    for point in ["relays/availability", "pump/availability", "pump/flow"] {
        assert_eq!(watcher.payloads(&format!("busker/{point}")), [""; 0], "{point} is told anew");
    }
    witness.wait_for_more(2);
    assert_eq!(witness.connections(), 1, "the bus kept its connection");
    let longest = witness.longest_gap(from.saturating_sub(2));
    assert!(longest < Duration::from_millis(600), "a poll was lost: {longest:?}");
    assert!(gateway.terminate().success());
}

#[test]
fn a_faulty_configuration_changes_nothing_and_is_shown_where_people_look() {
    let (broker, witness) = (Broker::start(), Witness::start());
    let (steady, pump) = steady(&witness);
    let watcher = Watcher::start(&broker, "watcher");
    let good = text(&broker, &[&steady], &[&pump]);
    let gateway = Gateway::start_with(&good);
    online(&watcher, &["pump"]);

    gateway.write(&text(&broker, &[&steady.replace("tcp", "tpc")], &[&pump.replace("unit: 1", "unit: 300")]));
    watcher.forget();
    gateway.reload("the new configuration is refused, and the old one goes on");
    watcher.wait_until("the fault in bridge/info", |got| {
        let error = |got: &Received| json(&got.payload)["configuration"]["error"].to_string();
        got.topic == "busker/bridge/info" && error(got).contains("did you mean `tcp`?")
    });
    let (code, health) = gateway.get("/health");
    let error = json(&health)["configuration"]["error"].to_string();
    assert!(code == 200 && error.contains("300"), "{health}");
    witness.wait_for_more(3);
    assert_eq!(watcher.payloads("busker/pump/availability"), [""; 0]);

    // What cannot be had is found before anything changes.
    let taken = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = taken.local_addr().expect("its address");
    let http = format!("http: {{listen: '{address}'}}");
    let folder = tempfile::tempdir().expect("a folder");
    let whole = format!("{http}\nstate_dir: {}\n{}", folder.path().display(), good.replace("flow", "rate"));
    gateway.write_whole(&whole);
    gateway.reload("HTTP cannot listen on");
    watcher.wait_until("that fault in bridge/info", |got| {
        got.topic == "busker/bridge/info" && got.payload.contains("HTTP cannot listen on")
    });

    watcher.forget();
    gateway.write(&good);
    gateway.reload("the new configuration changes nothing that runs");
    watcher.wait_until("that all is good again", |got| {
        got.topic == "busker/bridge/info" && json(&got.payload)["configuration"]["error"].is_null()
    });
    witness.wait_for_more(2);
    assert_eq!(witness.connections(), 1);
}

#[test]
fn everything_is_told_below_another_base_topic_also_after_a_long_calm() {
    let (broker, simulation, witness) = (Broker::start(), simulation(), Witness::start());
    let port = over_tcp(&simulation);
    let (steady, pump) = steady(&witness);
    let line = format!("line: {{tcp: '{}'}}", port.address());
    let watcher = Watcher::start(&broker, "watcher");
    let before = text(&broker, &[&line, &steady], &[RELAYS, &pump]);
    let gateway = Gateway::start_with(&before);
    online(&watcher, &["relays", "pump"]);
    // Whoever looks at the gateway when something stirs does so at most once a second: only after a calm he
    // looks at once, and sees that there is no bus.
    witness.wait_for_more(12);
    gateway.write(&before.replace("mqtt: {", "mqtt: {base_topic: house, "));
    gateway.reload(DONE);
    watcher.wait_for("house/relays/availability", "online");

    // All is told again, also where it stands as before, and what is told each minute.
    watcher.wait_until("the health", |got| got.topic == "house/relays/health");
    let anew =
        before.replace("mqtt: {", "home_assistant: {minimum_version: '2025.4'}\nmqtt: {base_topic: house, ");
    gateway.write(&anew);
    watcher.forget();
    gateway.reload(DONE);
    online_at(&watcher, "house", &["relays", "pump"]);
    let clock = Clock::start();
    let since = clock.now();
    watcher.wait_until("the health once more", |got| {
        got.topic == "house/relays/health" && !got.payload.is_empty()
    });
    // Not only when the next minute begins.
    let after = clock.now() - since;
    assert!(after < Duration::from_secs(30), "{after:?}");
    assert!(gateway.terminate().success());
}

#[test]
fn another_broker_or_another_base_topic_is_taken_without_a_restart() {
    let (old, new, witness) = (Broker::start(), Broker::start(), Witness::start());
    let (steady, pump) = steady(&witness);
    let (of_old, of_new) = (Watcher::start(&old, "watcher"), Watcher::start(&new, "watcher"));
    let gateway = Gateway::start_with(&text(&old, &[&steady], &[&pump]));
    online(&of_old, &["pump"]);
    let from = witness.count();

    gateway.write(&text(&new, &[&steady], &[&pump]));
    gateway.reload(DONE);
    of_old.wait_for("busker/bridge/state", "offline");
    of_new.wait_for("busker/bridge/state", "online");
    of_new.wait_for("busker/pump/flow", "0");
    witness.wait_for_more(2);
    assert_eq!(witness.connections(), 1);
    let longest = witness.longest_gap(from);
    assert!(longest < Duration::from_millis(600), "a poll was lost: {longest:?}");

    gateway.write(&text(&new, &[&steady], &[&pump]).replace("mqtt: {", "mqtt: {base_topic: house, "));
    gateway.reload(DONE);
    of_new.wait_for("busker/bridge/state", "offline");
    of_new.wait_for("house/bridge/state", "online");
    of_new.wait_for("house/pump/availability", "online");
    let all = remembered(&new, "newcomer");
    let left: Vec<&str> =
        all.iter().map(|got| got.topic.as_str()).filter(|topic| topic.starts_with("busker/")).collect();
    assert_eq!(left, ["busker/bridge/state"]);
    assert!(topics_of(&all, "pump").is_empty());
    assert_eq!(gateway.get("/health").0, 200);
    assert!(gateway.terminate().success());
}

#[test]
fn systemd_is_told_when_the_configuration_is_being_read_and_when_that_is_over() {
    let (broker, witness) = (Broker::start(), Witness::start());
    let (steady, pump) = steady(&witness);
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("notify");
    let systemd = UnixDatagram::bind(&path).expect("a socket");
    systemd.set_read_timeout(Some(Duration::from_secs(20))).expect("a timeout");
    let hear = |wanted: &str| {
        let mut buffer = [0; 4096];
        loop {
            let count = systemd.recv(&mut buffer).unwrap_or_else(|error| panic!("{wanted}: {error}"));
            let told = String::from_utf8_lossy(&buffer[..count]).into_owned();
            if told.contains(wanted) {
                return told;
            }
        }
    };
    let environment = [("NOTIFY_SOCKET", path.to_str().expect("plain letters"))];
    let gateway = Gateway::start_in(&environment, &text(&broker, &[&steady], &[&pump]));
    hear("READY=1");
    for (text, status) in [("nonsense", "STATUS=the new configuration is refused"), ("", "STATUS=")] {
        match text {
            "" => gateway.write(&self::text(&broker, &[&steady], &[&pump])),
            nonsense => gateway.write(nonsense),
        }
        gateway.reload("SIGHUP");
        assert!(hear("RELOADING=1").contains("MONOTONIC_USEC="));
        hear(status);
        hear("READY=1");
    }
}

#[test]
fn what_a_changed_device_has_no_more_is_taken_back_at_the_broker() {
    let (broker, witness) = (Broker::start(), Witness::start());
    let (steady, pump) = steady(&witness);
    let watcher = Watcher::start(&broker, "watcher");
    let gateway = Gateway::start_with(&text(&broker, &[&steady], &[&pump]));
    watcher.wait_for("busker/pump/flow", "0");
    let config = "homeassistant/device/busker_pump/config";
    watcher.wait_until("discovery", |got| got.topic == config);

    watcher.forget();
    gateway.write(&text(&broker, &[&steady], &[&pump.replace("flow", "rate")]));
    gateway.reload(DONE);
    watcher.wait_for("busker/pump/flow", "");
    watcher.wait_for("busker/pump/rate", "0");
    // Home Assistant is told that the one is gone before it is told of the other alone.
    let components = |got: &Received| json(&got.payload)["components"].clone();
    watcher.wait_until("the farewell", |got| {
        got.topic == config && components(got)["flow"].as_object().is_some_and(|flow| flow.len() == 1)
    });
    let all = remembered(&broker, "newcomer");
    let left = all.iter().find(|got| got.topic == config).expect("the pump is announced");
    assert!(components(left)["flow"].is_null() && components(left)["rate"].is_object(), "{}", left.payload);
    assert!(!topics_of(&all, "pump").contains(&"busker/pump/flow"));
}

#[test]
fn http_moves_to_another_address() {
    let (broker, witness) = (Broker::start(), Witness::start());
    let (steady, pump) = steady(&witness);
    let text = text(&broker, &[&steady], &[&pump]);
    let gateway = Gateway::start_with(&text);
    let state = tempfile::tempdir().expect("a folder");
    let at = |http: &str| format!("http: {{listen: {http}}}\nstate_dir: {}\n{text}", state.path().display());
    gateway.write_whole(&at("'localhost:0'"));
    // To its end: what it says last would else be taken for the end of the next one.
    gateway.reload(DONE);
    let lines = gateway.log();
    let moved = lines.iter().rev().find_map(|line| line.split("HTTP on ").nth(1)).expect("its address");
    let status = |url: &str| ureq::get(url).call().map(|answer| answer.status().as_u16()).ok();
    find(|| (status(moved) == Some(200)).then_some(())).expect("HTTP answers at its new address");
    find(|| status(&format!("{}/health", gateway.http())).is_none().then_some(()))
        .expect("and not at the old one");
    // The same port by another name, and with a token.
    let port = moved.split('/').nth(2).and_then(|host| host.rsplit(':').next()).expect("its port");
    let token = "x".repeat(32);
    gateway.write_whole(&at(&format!("'localhost:{port}', token: {token}")));
    gateway.reload(DONE);
    let devices = moved.replace("/health", "/api/devices");
    assert_eq!(status(moved), Some(200));
    assert_eq!(status(&devices), None, "without the token nobody is let in");
    let with_token = ureq::get(&devices).header("Authorization", format!("Bearer {token}")).call();
    assert_eq!(with_token.expect("the token is known").status().as_u16(), 200);
    gateway.write_whole(&at("null"));
    gateway.reload(DONE);
    find(|| status(moved).is_none().then_some(())).expect("HTTP is off");
}

#[test]
fn http_stays_where_it_was_if_its_new_address_is_taken() {
    let (broker, witness) = (Broker::start(), Witness::start());
    let (steady, pump) = steady(&witness);
    let text = text(&broker, &[&steady], &[&pump]);
    let gateway = Gateway::start_with(&text);
    let port = gateway.http().rsplit(':').next().expect("a port").to_string();
    // The same port, so that the old address has to be left first; and another program has a part of the new one.
    let taken = TcpListener::bind(format!("127.0.0.2:{port}")).expect("nobody else is there");
    let everywhere = text.replace("flow", "rate");
    let state = gateway.state();
    gateway.write_whole(&format!(
        "http: {{listen: '0.0.0.0:{port}'}}\nstate_dir: {}\n{everywhere}",
        state.display()
    ));
    gateway.reload("HTTP cannot listen on");
    let points = || find(|| Some(gateway.get("/api/devices").1)).expect("HTTP answers");
    assert!(points().contains("\"flow\"") && !points().contains("\"rate\""), "{}", points());
    drop(taken);
    gateway.reload(DONE);
    assert!(points().contains("\"rate\""), "{}", points());
}

#[test]
fn a_hangup_while_the_gateway_starts_is_a_reload_and_not_its_end() {
    let folder = temporary_folder();
    let text = format!(
        "mqtt: {{url: 'mqtt://localhost:1'}}\nhttp: null\nstate_dir: {}\nbuses: {{plant: {{tcp: 'localhost:1'}}}}\n",
        folder.path().display()
    );
    mknodat(CWD, folder.path().join("busker.yaml"), FileType::Fifo, Mode::RWXU, 0).expect("a pipe");
    let gateway = Gateway::begin(folder, &[]);
    // Nobody can write into a pipe until somebody reads it: the gateway has begun, and cannot go on yet.
    let open = || {
        let pipe = wait_for("its reader", || {
            let flags = OFlags::WRONLY | OFlags::NONBLOCK | OFlags::CLOEXEC;
            rustix::fs::open(gateway.file(), flags, Mode::empty()).ok()
        });
        File::from(pipe)
    };
    let mut configuration = open();
    gateway.hang_up();
    configuration.write_all(text.as_bytes()).expect("it reads on");
    drop(configuration);
    // Before that it may still read the first time, and would read both.
    gateway.wait_for_log("SIGHUP: reading the configuration again");
    open().write_all(text.as_bytes()).expect("it is read again");
    gateway.wait_for_log("changes nothing that runs");
    assert!(gateway.terminate().success());
}
