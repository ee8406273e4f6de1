//! The profiles and the simulators are two readings of the same manuals, made apart: here the gateway
//! reads every point of every simulated device and writes every setting, and the two must agree.

use std::path::Path;
use std::process::{Child, Command};
use std::time::Duration;

use busker::engine::value::Decimal;
use busker::simulator::{Options, Simulation};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

use crate::broker::{Broker, Listener};

/// Each device's name in the configuration, its profile, and its unit.
const DEVICES: [(&str, &str, u8); 13] = [
    ("relays", "metz-connect/mr-do4", 18),
    ("inputs", "metz-connect/mr-ai8", 19),
    ("meters", "metz-connect/mr-si4", 20),
    ("board", "fuehlersysteme/relay8", 7),
    ("contacts_4", "metz-connect/mr-di4", 21),
    ("contacts_10", "metz-connect/mr-di10", 22),
    ("more_relays", "metz-connect/mr-doa4", 23),
    ("voltages", "metz-connect/mr-ao4", 24),
    ("voltages_by_hand", "metz-connect/mr-aop4", 25),
    ("currents", "metz-connect/mr-ci4", 26),
    ("triacs", "metz-connect/mr-to4", 27),
    ("old_inputs", "btr/mr-ai8", 28),
    ("output_board", "fuehlersysteme/analog-out8", 8),
];

#[test]
fn the_gateway_reads_every_point_and_writes_every_setting_of_the_simulated_devices() {
    let directory = tempfile::tempdir().expect("a directory");
    let devices = DEVICES.map(|(_, profile, unit)| format!("{profile}@{unit}").parse().expect("a device"));
    let options = Options { turnaround: Duration::ZERO, ..Options::default() };
    let simulation = Simulation::new(&devices, options).expect("a simulation");
    let line = simulation.serve_pty(None).expect("a pseudo-terminal");
    let broker = Broker::start(directory.path());
    let mut listener = broker.listen();
    let configuration = directory.path().join("busker.yaml");
    std::fs::write(&configuration, configuration_text(&broker, directory.path(), line.path()))
        .expect("written");
    let mut gateway = Gateway::start(&configuration);

    let (mut read, mut written) = (0, 0);
    for (device, profile, _) in DEVICES {
        let points = points(profile);
        for point in &points {
            if point["access"].as_str().is_some_and(|access| access.contains('r')) {
                listener.wait(&topic(device, point), |payload| payload != "None");
                read += 1;
            }
        }
        for point in &points {
            if let Some(value) = value_to_write(point) {
                check_write(&mut listener, &topic(device, point), &value);
                written += 1;
            }
        }
    }
    // A test that finds no points would find no disagreement either.
    assert!(read > 200 && written > 150, "{read} read, {written} written");
    gateway.end();
}

fn check_write(listener: &mut Listener, topic: &str, value: &str) {
    listener.publish(&format!("{topic}/set"), value);
    let outcome = format!("{topic}/outcome");
    listener.wait(&outcome, |_| true);
    // Which of the two is wrong, the manual knows.
    listener.check(&outcome, |payload| payload.contains("\"done\"") || payload.contains("\"unchanged\""));
}

fn topic(device: &str, point: &Value) -> String {
    format!("busker/{device}/{}", point["name"].as_str().expect("a name"))
}

/// The greatest or last thing that the profile allows; `None` for what can only be read, and for
/// buttons, one of which restarts the device.
fn value_to_write(point: &Value) -> Option<String> {
    let is_button = point["entity"]["platform"] == "button";
    if is_button || !point["access"].as_str().is_some_and(|access| access.contains('w')) {
        return None;
    }
    let number = |key: &str| Decimal::parse(&point[key].to_string()).expect("a number");
    if !point["max"].is_null() {
        if !point["decimals_by"].is_null() {
            return Some("2".into());
        }
        // A lower threshold's greatest value is bounded by the upper threshold, a zero's by the end.
        let is_lower = |name: &str| name.ends_with("off_below") || name.ends_with("zero");
        let is_lower = point["name"].as_str().is_some_and(is_lower);
        let raw = number(if is_lower { "min" } else { "max" });
        return Some(raw.checked_mul(number("scale")).expect("a small number").normalized().to_string());
    }
    let names = point["values"].as_object().expect("a map");
    if let Some(name) = names.values().next_back() {
        return name.as_str().map(str::to_string);
    }
    Some(if point["type"] == "letter_number" { "R017" } else { "5" }.into())
}

fn points(profile: &str) -> Vec<Value> {
    let output = Command::new(env!("CARGO_BIN_EXE_busker"))
        .args(["profiles", "show", profile, "--json"])
        .output()
        .expect("it starts");
    let shown: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    shown["points"].as_array().expect("a list").clone()
}

fn configuration_text(broker: &Broker, directory: &Path, line: &Path) -> String {
    let devices: String = DEVICES
        .iter()
        .map(|(name, profile, unit)| format!("  {name}: {{profile: {profile}, bus: line, unit: {unit}}}\n"))
        .collect();
    format!(
        "mqtt: {{url: mqtt://127.0.0.1:{}}}
http: {{listen: null}}
state_dir: {}
buses:
  line: {{serial: {}, baud: 19200, parity: even}}
devices:
{devices}",
        broker.port(),
        directory.join("state").display(),
        line.display()
    )
}

/// `busker run`; it is killed if the test fails.
struct Gateway {
    child: Child,
}

impl Gateway {
    fn start(configuration: &Path) -> Gateway {
        let mut command = Command::new(env!("CARGO_BIN_EXE_busker"));
        let child = command.arg("run").arg("--config").arg(configuration).spawn();
        Gateway { child: child.expect("the gateway starts") }
    }

    fn end(&mut self) {
        kill_process(Pid::from_child(&self.child), Signal::TERM).expect("signalled");
        assert_eq!(self.child.wait().expect("a child").code(), Some(0));
    }
}

impl Drop for Gateway {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
