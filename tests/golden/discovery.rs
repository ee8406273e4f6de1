//! What Home Assistant is told of each device, in the states that make a difference.

use busker::engine::device::Device;
use busker::engine::homeassistant::{Gateway, announcement};
use busker::engine::settings::DeviceSettings;
use busker::engine::topics::Topics;
use busker::engine::units::Release;
use serde_json::{Map, Value};

/// A state of a profile's selectors: what it is called, and what which points hold. A name without
/// its repetition (`code`) means all of them.
type State = (&'static str, &'static str, &'static [(&'static str, i128)]);

/// The states beside the one that a device leaves the factory with.
const STATES: &[State] = &[
    ("btr/mr-ai8", "pt1000 as integer", &[("code", 0x85)]),
    ("fuehlersysteme/analog-in8", "contacts", &[("function", 1)]),
    ("fuehlersysteme/analog-out8", "current outputs", &[("signal", 1)]),
    ("fuehlersysteme/sensor", "extremes and relay of the temperature", &[("of", 2)]),
    ("metz-connect/mr-ai8", "pt1000 as float, °C", &[("code", 0x84)]),
    ("metz-connect/mr-ai8", "pt1000 as integer, °F", &[("code", 0x85), ("temperature_unit", 1)]),
    ("metz-connect/mr-ai8", "resistance in steps of 100 ohms", &[("code", 0x44)]),
    ("metz-connect/mr-ai8", "interpolation table, °F", &[("code", 0xF9), ("temperature_unit", 1)]),
    (
        "metz-connect/mr-aio42",
        "controller 1 a heater, output 2 in percent",
        &[
            ("controller_1_setpoint_source", 2),
            ("output_1_source", 2),
            ("channel_1_code", 0x84),
            ("output_2_source", 1),
        ],
    ),
    (
        "metz-connect/mr-aio42",
        "controller 2 a cooler, output 1 by controller 1 with a setpoint of input 2",
        &[
            ("controller_2_setpoint_source", 2),
            ("controller_2_action", 0),
            ("output_1_source", 2),
            ("output_2_source", 2),
            ("channel_3_code", 0x95),
        ],
    ),
    (
        "metz-connect/mr-aio42",
        "controller 1 a heater by hand",
        &[
            ("controller_1_setpoint_source", 2),
            ("controller_1_manual", 1),
            ("output_1_source", 2),
            ("channel_1_code", 0x84),
        ],
    ),
    ("metz-connect/mr-multi-io", "pt1000 as float, °F", &[("channel_1_code", 0x84), ("temperature_unit", 1)]),
    ("metz-connect/mr-multi-io", "current as integer", &[("current_code", 1)]),
    ("metz-connect/mr-dio42", "motorized, safe is open", &[("mode", 1)]),
    ("metz-connect/mr-dio42", "motor 2, safe is closed", &[("mode", 8)]),
    ("metz-connect/mr-dio42", "two switches of one damper", &[("mode", 3)]),
    ("metz-connect/mr-dio42", "a switch of each of two dampers", &[("mode", 4)]),
    ("metz-connect/mr-dio42", "fire dampers", &[("mode", 6)]),
    ("metz-connect/mr-dio42", "input logic", &[("mode", 9)]),
    ("metz-connect/mr-dio42", "input logic beside a damper", &[("channel_1_mode", 9), ("channel_2_mode", 2)]),
    ("metz-connect/mr-ld6", "combinations", &[("mode", 4)]),
    ("metz-connect/mr-ld6", "relays on the bus, cables not watched", &[("mode", 5), ("break_watched", 0)]),
    ("metz-connect/mr-si4", "three decimals", &[("decimals", 3)]),
    ("metz-connect/mr-tp", "relays by hand only", &[("mode", 0)]),
    ("metz-connect/mr-tp", "two blinds", &[("mode", 3)]),
];

/// The message of a fresh device, and for each further state the components that differ from it.
pub fn told(device: &Device) -> String {
    let fresh = payload(device, &factory_settings(device));
    let mut told = Map::new();
    for (_, state, changes) in STATES.iter().filter(|(profile, _, _)| *profile == device.profile) {
        let mut known = factory_settings(device);
        for (name, raw) in *changes {
            for (index, point) in device.points.iter().enumerate() {
                if point.name == *name || point.name.ends_with(&format!("_{name}")) {
                    known[index] = Some(*raw);
                }
            }
        }
        let changed = components(&payload(device, &known));
        let before = components(&fresh);
        let mut differing: Map<String, Value> =
            changed.iter().filter(|(key, value)| before.get(*key) != Some(value)).map(cloned).collect();
        for (key, _) in before.iter().filter(|(key, _)| !changed.contains_key(*key)) {
            differing.insert(key.clone(), Value::Null);
        }
        told.insert(format!("then {state}"), differing.into());
    }
    told.insert("unknown selectors leave out".into(), waiting(device, &fresh).into());
    let mut all = Map::new();
    all.insert("fresh".into(), fresh);
    all.extend(told);
    format!("{:#}\n", Value::Object(all))
}

/// The keys that are not announced before anything has been read.
fn waiting(device: &Device, fresh: &Value) -> Vec<Value> {
    let at_first = components(&payload(device, &vec![None; device.points.len()]));
    components(fresh)
        .keys()
        .filter(|key| !at_first.contains_key(*key))
        .map(|key| key.clone().into())
        .collect()
}

/// What each point holds that has a factory setting; a selector without one holds 0.
fn factory_settings(device: &Device) -> Vec<Option<i128>> {
    let selectors: Vec<usize> = device.points.iter().flat_map(|point| point.selectors()).collect();
    (0..device.points.len())
        .map(|index| device.points[index].default.or(selectors.contains(&index).then_some(0)))
        .collect()
}

fn payload(device: &Device, known: &[Option<i128>]) -> Value {
    let gateway = Gateway {
        topics: Topics::new("busker"),
        prefix: "homeassistant".into(),
        release: Release::USUAL,
        expire_after: None,
    };
    let settings = DeviceSettings {
        name: "device".into(),
        title: "Device".into(),
        bus: 0,
        unit: 1,
        device: device.clone().into(),
        wanted: Vec::new(),
        raw_write: Vec::new(),
    };
    let message = announcement(&gateway, &settings, "bus", known).message();
    serde_json::from_str(&message.payload).expect("a discovery message is JSON")
}

fn components(payload: &Value) -> Map<String, Value> {
    payload["components"].as_object().expect("a discovery message has components").clone()
}

fn cloned((key, value): (&String, &Value)) -> (String, Value) {
    (key.clone(), value.clone())
}
