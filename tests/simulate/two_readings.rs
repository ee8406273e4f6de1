//! The profiles and the simulators are two readings of the same manuals, made apart: here the gateway
//! reads every point of every simulated device and writes every setting, and the two must agree.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use busker::engine::value::Decimal;
use busker::simulator::{DeviceAt, Model, Options, Simulation};
use serde_json::Value;

use crate::support::{Broker, Gateway, Watcher};

/// The first device's unit; each further one has the next.
const FIRST_UNIT: u8 = 1;

#[test]
fn the_gateway_reads_every_point_and_writes_every_setting_of_the_simulated_devices() {
    let devices: Vec<DeviceAt> =
        Model::ALL.into_iter().zip(FIRST_UNIT..).map(|(model, unit)| DeviceAt { model, unit }).collect();
    let options = Options { turnaround: Duration::ZERO, ..Options::default() };
    let simulation = Simulation::new(&devices, options).expect("a simulation");
    let line = simulation.serve_pty(None).expect("a pseudo-terminal");
    let broker = Broker::start();
    let watcher = Watcher::start(&broker, "watcher");
    let gateway = Gateway::start(&broker, &configuration(&devices, line.path()));

    let (mut read, mut written) = (0, 0);
    let mut disagreements = Vec::new();
    for device in &devices {
        let points = points(device.model.id());
        let device = name_of(device);
        for point in &points {
            bring_to_life(&watcher, &device, &points, point);
            // What is read on request only has a test of its own.
            if point["access"].as_str().is_some_and(|access| access.contains('r'))
                && point["poll"] != "never"
                && point["event"].is_null()
            {
                watcher.shows_what(&topic(&device, point), "a value", |payload| payload != "None");
                read += 1;
            }
            if let Some(value) = value_to_write(point) {
                let outcome = write(&watcher, &topic(&device, point), &value);
                written += 1;
                if !is_taken(&outcome) && !is_rightly_not_taken(&topic(&device, point), &outcome) {
                    disagreements.push(format!("{}: {value}: {outcome}", topic(&device, point)));
                }
            }
        }
    }
    // A fault has stopped the recording of the first voltage; the curve comes when somebody asks for it.
    let curve = "busker/metz_connect_mr_sm3/phase_1_waveform";
    watcher.shows("busker/metz_connect_mr_sm3/recording", "stopped");
    watcher.publish(&format!("{curve}/get"), "");
    watcher.shows_what(curve, "a curve of 128 samples", |payload| {
        serde_json::from_str::<Vec<f64>>(payload).is_ok_and(|samples| samples.len() == 128)
    });

    // Which of the two is wrong, the manual knows.
    assert!(disagreements.is_empty(), "{}", disagreements.join("\n"));
    // A test that finds no points would find no disagreement either.
    assert!(read > 700 && written > 500, "{read} read, {written} written");
    assert!(gateway.terminate().success());
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

fn name_of(device: &DeviceAt) -> String {
    device.model.id().replace(['/', '-'], "_")
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

fn configuration(devices: &[DeviceAt], line: &Path) -> String {
    let entry = |device: &DeviceAt| {
        let (name, profile, unit) = (name_of(device), device.model.id(), device.unit);
        format!("  {name}: {{profile: {profile}, bus: line, unit: {unit}}}\n")
    };
    let devices: String = devices.iter().map(entry).collect();
    format!(
        "eeprom: {{interval: 0s, daily: 65535}}
buses:
  line: {{serial: {}, baud: 19200, parity: even, response_timeout: 10s}}
devices:
{devices}",
        line.display()
    )
}
