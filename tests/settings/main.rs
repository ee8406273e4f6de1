//! A device's settings end to end: dumped and applied by hand, and declared in the configuration of a
//! gateway that is started again and again.

#[path = "../support/mod.rs"]
mod support;

use std::fs::{self, File};
use std::io::Write;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use busker::engine::profile::Library;
use busker::simulator::{DeviceAt, Framing, Model, Options, Simulation, TcpPort};
use rustix::fs::{Mode, OFlags};
use rustix::pty::{OpenptFlags, openpt, ptsname, unlockpt};
use tempfile::TempDir;

use support::{Broker, Gateway, Watcher, program, wait_for};

const RELAYS: &str = "metz-connect/mr-do4";
const METERS: &str = "metz-connect/mr-si4";
const BOARD: &str = "fuehlersysteme/relay8";

/// One simulated device with its unit on Modbus TCP, as it leaves the factory.
fn fresh(profile: &str, unit: u8) -> (Simulation, TcpPort) {
    let device: DeviceAt = format!("{profile}@{unit}").parse().expect("a simulated device");
    let simulation = Simulation::new(&[device], Options::default()).expect("the simulation starts");
    let port = simulation.serve_tcp("127.0.0.1:0", Framing::Tcp).expect("a free port");
    (simulation, port)
}

/// `busker VERB…` with this device.
fn by_hand(verb: &[&str], port: &TcpPort, profile: &str, unit: u8) -> Output {
    Command::new(program())
        .args(verb)
        .args(["--tcp", &port.address().to_string(), "--unit", &unit.to_string(), "--profile", profile])
        .stdin(Stdio::null())
        .output()
        .expect("the program is built")
}

#[track_caller]
fn dump(port: &TcpPort, profile: &str, unit: u8) -> String {
    let output = by_hand(&["settings", "dump"], port, profile, unit);
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).expect("text")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

struct Folder(TempDir);

impl Folder {
    fn new() -> Folder {
        Folder(tempfile::tempdir().expect("a temporary folder"))
    }

    fn file(&self, name: &str, content: &str) -> String {
        let path = self.0.path().join(name);
        fs::write(&path, content).expect("a file");
        path.display().to_string()
    }
}

#[test]
fn what_is_dumped_from_one_device_makes_another_like_it() {
    let folder = Folder::new();
    for (profile, unit, changes) in [
        (RELAYS, 18, &[("watchdog", "12.5"), ("relay_2_default", "ON")][..]),
        // The start of a meter is written in the digits that its decimals give it.
        (
            METERS,
            20,
            &[("meter_1_decimals", "3"), ("meter_1_start", "1.234"), ("meter_4_button_enabled", "OFF")],
        ),
    ] {
        let (_one, one) = fresh(profile, unit);
        for (point, value) in changes {
            let output = by_hand(&["write", point, value], &one, profile, unit);
            assert!(output.status.success(), "{point}: {output:?}");
        }
        let dumped = dump(&one, profile, unit);
        for (point, value) in changes {
            assert!(dumped.lines().any(|line| line.starts_with(&format!("{point}: {value}"))), "{dumped}");
        }
        let file = folder.file("dumped.yaml", &dumped);

        let (_other, other) = fresh(profile, unit);
        let before = dump(&other, profile, unit);
        assert_ne!(before, dumped);
        // Without a word of consent it only shows what it would do.
        let shown = by_hand(&["settings", "apply", &file], &other, profile, unit);
        assert_eq!(shown.status.code(), Some(1), "{shown:?}");
        assert!(text(&shown.stderr).contains("nothing was written; --yes writes"), "{shown:?}");
        assert_eq!(text(&shown.stdout).lines().count(), changes.len(), "{shown:?}");
        assert_eq!(dump(&other, profile, unit), before);

        let applied = by_hand(&["settings", "apply", &file, "--yes"], &other, profile, unit);
        assert!(applied.status.success(), "{applied:?}");
        let done = text(&applied.stdout).lines().filter(|line| line.ends_with("  done")).count();
        assert_eq!(done, changes.len(), "{applied:?}");
        assert_eq!(dump(&other, profile, unit), dumped);

        let again = by_hand(&["settings", "apply", &file, "--yes"], &other, profile, unit);
        assert!(again.status.success() && text(&again.stdout).starts_with("nothing to change"), "{again:?}");
    }
}

/// The near end of a terminal at which somebody has typed this, and its far end, which is to be kept.
fn terminal(typed: &str) -> (File, File) {
    let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
    let far = openpt(flags).expect("a pseudo-terminal");
    unlockpt(&far).expect("a pseudo-terminal");
    let near = ptsname(&far, Vec::new()).expect("its name");
    let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC;
    let near = rustix::fs::open(&near, flags, Mode::empty()).expect("its near end");
    let mut far = File::from(far);
    far.write_all(typed.as_bytes()).expect("it is typed");
    (File::from(near), far)
}

#[test]
fn at_a_terminal_only_yes_writes() {
    let folder = Folder::new();
    let (_simulation, port) = fresh(RELAYS, 18);
    let before = dump(&port, RELAYS, 18);
    let file = folder.file("relays.yaml", "watchdog: 12.5s\n");
    for (typed, writes) in [("no\n", false), ("\n", false), ("y\n", false), ("yes\n", true)] {
        let (near, _far) = terminal(typed);
        let output = Command::new(program())
            .args(["settings", "apply", &file, "--tcp", &port.address().to_string()])
            .args(["--unit", "18", "--profile", RELAYS])
            .stdin(near)
            .output()
            .expect("the program is built");
        let told = text(&output.stderr);
        assert!(told.contains("Write this setting? Type yes: "), "{typed:?}: {told}");
        assert_eq!(output.status.success(), writes, "{typed:?}: {told}");
        assert_eq!(told.contains("nothing was written"), !writes, "{typed:?}: {told}");
        assert_eq!(dump(&port, RELAYS, 18) == before, !writes, "{typed:?}: {told}");
    }
}

#[test]
fn what_any_device_holds_can_stand_under_its_settings() {
    let folder = Folder::new();
    let library = Library::shipped();
    for model in Model::ALL.into_iter().filter(|model| library.contains(model.id())) {
        let (profile, unit) = (model.id(), 9);
        let (_simulation, port) = fresh(profile, unit);
        let dumped = dump(&port, profile, unit);
        let file = folder.file("dumped.yaml", &dumped);
        let applied = by_hand(&["settings", "apply", &file, "--yes"], &port, profile, unit);
        assert!(applied.status.success(), "{profile}: {applied:?}\n{dumped}");
        assert!(text(&applied.stdout).starts_with("nothing to change"), "{profile}: {applied:?}\n{dumped}");
    }
}

#[test]
fn thresholds_that_must_not_cross_are_written_in_the_order_that_the_device_takes() {
    let folder = Folder::new();
    let (_simulation, port) = fresh(BOARD, 7);
    for (off_below, on_above) in [(50, 60), (-60, -50), (70, 80)] {
        let content = format!("relay_1_off_below: {off_below}\nrelay_1_on_above: {on_above}\n");
        let file = folder.file("thresholds.yaml", &content);
        let applied = by_hand(&["settings", "apply", &file, "--yes"], &port, BOARD, 7);
        assert!(applied.status.success(), "{applied:?}");
        assert!(dump(&port, BOARD, 7).contains(&content), "{content}");
    }
    // What cannot be had is told, and the rest is written.
    let content = "relay_1_off_below: 90\nrelay_1_on_above: 85\nrelay_2_on_delay: 30s\n";
    let file = folder.file("crossed.yaml", content);
    let applied = by_hand(&["settings", "apply", &file, "--yes"], &port, BOARD, 7);
    assert_eq!(applied.status.code(), Some(1), "{applied:?}");
    assert!(text(&applied.stderr).contains("one setting does not hold what is wanted"), "{applied:?}");
    let dumped = dump(&port, BOARD, 7);
    assert!(dumped.contains("relay_1_off_below: 84\nrelay_1_on_above: 85\n"), "{dumped}");
    assert!(dumped.contains("relay_2_on_delay: 30  # s\n"), "{dumped}");
}

#[test]
fn nothing_is_written_to_another_device_nor_from_a_faulty_file() {
    let folder = Folder::new();
    let (_simulation, port) = fresh(METERS, 20);
    let file = folder.file("relays.yaml", "watchdog: 30s\n");
    let wrong = by_hand(&["settings", "apply", &file, "--yes"], &port, RELAYS, 20);
    assert_eq!(wrong.status.code(), Some(1), "{wrong:?}");
    assert!(
        text(&wrong.stderr).contains("unit 20 is no metz-connect/mr-do4: it says that it is"),
        "{wrong:?}"
    );

    let file = folder.file("faulty.yaml", "meter_1_decimals: 4\nmeter_9_start: 3\n");
    let faulty = by_hand(&["settings", "apply", &file, "--yes"], &port, METERS, 20);
    assert_eq!(faulty.status.code(), Some(2), "{faulty:?}");
    for wanted in
        ["faulty.yaml:1:19: `4` is outside 0 to 3", "faulty.yaml:2:1: ", "2 faults, nothing was written"]
    {
        assert!(text(&faulty.stderr).contains(wanted), "{wanted}: {faulty:?}");
    }
    let without = Command::new(program())
        .args(["settings", "dump", "--unit", "20", "--tcp", &port.address().to_string()])
        .output()
        .expect("the program is built");
    assert_eq!(without.status.code(), Some(2), "{without:?}");
}

/// A configuration in which the relays have these settings.
fn declared(broker: &Broker, port: &TcpPort, settings: &str) -> String {
    format!(
        "mqtt: {{url: '{}'}}\nbuses: {{line: {{tcp: '{}'}}}}\n\
         devices: {{relays: {{profile: {RELAYS}, bus: line, unit: 18, settings: {settings}}}}}\n",
        broker.url(),
        port.address()
    )
}

/// How often the EEPROM was written, as the metrics tell it.
fn persistent_writes(gateway: &Gateway) -> String {
    let line = "busker_device_persistent_writes_total{bus=\"line\",device=\"relays\"} ";
    wait_for("the metrics", || {
        gateway.get("/metrics").1.lines().find_map(|found| found.strip_prefix(line)).map(str::to_string)
    })
}

/// Waits for a device's info, after the first `from` messages, in which the drift is this.
fn wait_for_drift(watcher: &Watcher, from: usize, drift: &str) {
    let wanted: serde_json::Value = serde_json::from_str(drift).expect("JSON");
    wait_for(drift, || {
        let seen = watcher.received();
        let mut infos = seen.iter().skip(from).filter(|seen| seen.topic == "busker/relays/info");
        infos.find(|seen| {
            let info: serde_json::Value = serde_json::from_str(&seen.payload).expect("JSON");
            info["online"] == true && info["drift"] == wanted
        })?;
        Some(())
    });
}

#[test]
fn a_declared_setting_is_written_once_and_a_restart_writes_nothing() {
    let broker = Broker::start();
    let (_simulation, port) = fresh(RELAYS, 18);
    let watcher = Watcher::start(&broker, "watcher");
    let with = |settings: &str| declared(&broker, &port, settings);

    let gateway = Gateway::start_with(&with("{watchdog: 30s}"));
    let state = gateway.state().join("devices/relays.json");
    watcher.shows("busker/relays/watchdog", "30.00");
    // What has been done is known soon, however the gateway ends.
    wait_for("the state file", || read(&state).filter(|text| text.contains("\"watchdog\": \"done\"")));

    // Somebody sets it otherwise; the gateway finds it so, tells it and leaves it.
    let mut from = 0;
    let meanwhile = || {
        let written = by_hand(&["write", "watchdog", "60"], &port, RELAYS, 18);
        assert!(written.status.success(), "{written:?}");
        from = watcher.count();
    };
    let gateway = gateway.kill_and_start_again(meanwhile, &with("{watchdog: 30s}"));
    wait_for_drift(&watcher, from, r#"[{"point":"watchdog","wanted":"30s","found":"60.00","reason":null}]"#);
    gateway.wait_for_log("device relays: watchdog holds 60.00, and its settings want 30s");
    assert_eq!(persistent_writes(&gateway), "1", "that of the first run");

    // The section changes, and every difference is written once.
    let gateway = gateway.start_again(|| {}, &with("{watchdog: 30s, relay_1_default: ON}"));
    watcher.shows("busker/relays/relay_1_default", "ON");
    watcher.shows("busker/relays/watchdog", "30.00");
    assert_eq!(persistent_writes(&gateway), "3");

    // A damaged file is kept, and the gateway runs.
    let meanwhile = || {
        fs::write(&state, "{\"version\": 1,").expect("a damaged file");
        from = watcher.count();
    };
    let gateway = gateway.start_again(meanwhile, &with("{watchdog: 30s, relay_1_default: ON}"));
    wait_for_drift(&watcher, from, "[]");
    gateway.wait_for_log("relays.json` cannot be used (EOF while parsing");
    gateway.wait_for_log("relays.json.broken`");
    assert_eq!(persistent_writes(&gateway), "0");
    assert_eq!(read(&state.with_extension("json.broken")).as_deref(), Some("{\"version\": 1,"));
    wait_for("the state file", || read(&state).filter(|text| text.contains("\"watchdog\": \"unchanged\"")));
}

fn read(path: &Path) -> Option<String> {
    fs::read_to_string(path).ok()
}
