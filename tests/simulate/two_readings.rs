//! The profiles and the simulators are two readings of the same manuals, made apart: here the gateway
//! reads every point of every simulated device and writes every setting, and the two must agree.

use std::process::Command;
use std::time::Duration;

use busker::engine::value::Decimal;
use busker::simulator::{DeviceAt, Model, Options, PtyPort, Simulation};
use serde_json::Value;

use crate::support::{Broker, Gateway, Watcher};

#[test]
fn the_gateway_reads_every_point_and_writes_every_setting_of_the_simulated_devices() {
    // Each on a line of its own, and all at the same time: on a common line each would wait for the others' polls.
    let served = Model::ALL.map(Served::start);
    let broker = Broker::start();
    let gateway = Gateway::start(&broker, &configuration(&served));
    let findings: Vec<Findings> = std::thread::scope(|scope| {
        let compared = served.each_ref().map(|served| scope.spawn(|| served.compare(&broker)));
        compared.into_iter().map(|compared| compared.join().expect("it is compared")).collect()
    });

    // Which of the two is wrong, the manual knows.
    let disagreements: Vec<&str> =
        findings.iter().flat_map(|found| &found.disagreements).map(String::as_str).collect();
    assert!(disagreements.is_empty(), "{}", disagreements.join("\n"));
    // A test that finds no points would find no disagreement either.
    let read: usize = findings.iter().map(|found| found.read).sum();
    let written: usize = findings.iter().map(|found| found.written).sum();
    assert!(read > 1100 && written > 800, "{read} read, {written} written");
    assert!(gateway.terminate().success());
}

/// A simulated device on its line.
struct Served {
    model: Model,
    line: PtyPort,
    _simulation: Simulation,
}

#[derive(Default)]
struct Findings {
    read: usize,
    written: usize,
    disagreements: Vec<String>,
}

impl Served {
    fn start(model: Model) -> Served {
        let options = Options { turnaround: Duration::ZERO, ..Options::default() };
        let simulation = Simulation::new(&[DeviceAt { model, unit: 1 }], options).expect("a simulation");
        let line = simulation.serve_pty(None).expect("a pseudo-terminal");
        Served { model, line, _simulation: simulation }
    }

    fn name(&self) -> String {
        self.model.id().replace(['/', '-'], "_")
    }

    fn compare(&self, broker: &Broker) -> Findings {
        let device = self.name();
        let watcher = Watcher::start_of(&format!("busker/{device}/#"), broker, &device, None);
        // By then the gateway listens.
        watcher.shows(&format!("busker/{device}/availability"), "online");
        let points = points(self.model.id());
        let mut found = Findings::default();
        // Some devices measure for seconds before they tell; meanwhile others can be written.
        let mut lives_always = Vec::new();
        for point in &points {
            bring_to_life(&watcher, &device, &points, point);
            // What is read on request only is read below.
            if point["access"].as_str().is_some_and(|access| access.contains('r'))
                && point["poll"] != "never"
                && point["event"].is_null()
            {
                match point["when"].is_null() {
                    true => lives_always.push(topic(&device, point)),
                    false => shows_a_value(&watcher, &topic(&device, point)),
                }
                found.read += 1;
            }
            if let Some(value) = value_to_write(point) {
                let outcome = write(&watcher, &topic(&device, point), &value);
                found.written += 1;
                if !is_taken(&outcome) && !is_rightly_not_taken(&topic(&device, point), &outcome) {
                    found.disagreements.push(format!("{}: {value}: {outcome}", topic(&device, point)));
                }
            }
        }
        for topic in &lives_always {
            shows_a_value(&watcher, topic);
        }
        if self.model.id() == "metz-connect/mr-sm3" {
            shows_a_curve(&watcher, &device);
        }
        found
    }
}

fn shows_a_value(watcher: &Watcher, topic: &str) {
    watcher.shows_what(topic, "a value", |payload| payload != "None");
}

/// A fault has stopped the recording of the first voltage; the curve comes when somebody asks for it.
fn shows_a_curve(watcher: &Watcher, device: &str) {
    let curve = format!("busker/{device}/phase_1_waveform");
    watcher.shows(&format!("busker/{device}/recording"), "stopped");
    watcher.publish(&format!("{curve}/get"), "");
    watcher.shows_what(&curve, "a curve of 128 samples", |payload| {
        serde_json::from_str::<Vec<f64>>(payload).is_ok_and(|samples| samples.len() == 128)
    });
}

/// Sets what decides whether the point lives.
fn bring_to_life(watcher: &Watcher, device: &str, points: &[Value], point: &Value) {
    for (selector, names) in point["when"].as_object().into_iter().flatten() {
        let selector = points.iter().find(|other| other["name"] == *selector.as_str()).expect("a point");
        let is_enough =
            |says: &str| names.as_array().is_some_and(|names| names.iter().any(|name| name == says));
        if watcher.last(&topic(device, selector)).as_deref().is_some_and(is_enough) {
            continue;
        }
        let name = names[0].as_str().expect("a name");
        if selector["access"] == "rw" {
            let outcome = write(watcher, &topic(device, selector), name);
            assert!(is_taken(&outcome), "{}: {name}: {outcome}", topic(device, selector));
        }
        watcher.shows(&topic(device, selector), name);
    }
}

/// How a command ended.
fn write(watcher: &Watcher, topic: &str, value: &str) -> String {
    let from = watcher.count();
    watcher.publish(&format!("{topic}/set"), value);
    watcher.wait_for_next(&format!("{topic}/outcome"), from)
}

fn is_taken(outcome: &str) -> bool {
    outcome.contains("\"done\"") || outcome.contains("\"unchanged\"")
}

/// Writes that the device, as it stands here, does not take, each with the reason.
const RIGHTLY_NOT_TAKEN: &[(&str, &str, &str)] = &[
    // No end contact is closed, so that the damper is in its fire position and the alarm comes back (page 30).
    ("metz_connect_mr_dio42/channel_", "_alarm", "\"found\":\"alarm\""),
    // The same input toggles this relay already; the device keeps the two apart (page 34).
    ("metz_connect_mr_dio42/channel_", "_follows_input_1", "exception 3"),
    ("metz_connect_mr_dio42/channel_", "_follows_input_2", "exception 3"),
    ("metz_connect_mr_dio42/channel_", "_follows_input_3", "exception 3"),
    ("metz_connect_mr_dio42/channel_", "_follows_input_4", "exception 3"),
    // An analog input sets it all the time (page 77).
    ("metz_connect_mr_aio42/controller_", "_setpoint", "\"not_taken\""),
    // This input is for a current, and so no contact (chapter 6.3.2).
    ("fuehlersysteme_analog_in8/", "channel_8_function", "\"found\":\"analog\""),
    // The relay follows itself, a flag (RWreg 51 is 50).
    ("fuehlersysteme_sensor/", "relay_off_below", "neither `ON` nor `OFF`"),
    ("fuehlersysteme_sensor/", "relay_on_above", "neither `ON` nor `OFF`"),
];

fn is_rightly_not_taken(topic: &str, outcome: &str) -> bool {
    let fits = |(begins, ends, says): &&(&str, &str, &str)| {
        topic.contains(begins) && topic.ends_with(ends) && outcome.contains(says)
    };
    RIGHTLY_NOT_TAKEN.iter().find(fits).is_some()
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
    if let Some(name) = point["writable_names"].as_array().and_then(|names| names.last()) {
        return name.as_str().map(str::to_string);
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

fn configuration(all: &[Served]) -> String {
    let bus = |served: &Served| {
        let (name, line) = (served.name(), served.line.path().display());
        format!("  {name}: {{serial: {line}, baud: 19200, parity: even, response_timeout: 10s}}\n")
    };
    let device = |served: &Served| {
        let (name, profile) = (served.name(), served.model.id());
        format!("  {name}: {{profile: {profile}, bus: {name}, unit: 1}}\n")
    };
    let buses: String = all.iter().map(bus).collect();
    let devices: String = all.iter().map(device).collect();
    format!("eeprom: {{interval: 0s, daily: 65535}}\nbuses:\n{buses}devices:\n{devices}")
}
