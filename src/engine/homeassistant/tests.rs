//! Announcements as Home Assistant is told them, and what they become.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Value, json};

use super::{Announcement, Gateway, Outline, announce_bridge, announce_bus, announcement, farewell};
use crate::engine::address::{Address, Span, Table};
use crate::engine::configuration;
use crate::engine::device::{Case, Encoding, Form, Kind, Names, Point, Poll, Unit, Write, WriteRule};
use crate::engine::keys;
use crate::engine::profile::Library;
use crate::engine::settings::DeviceSettings;
use crate::engine::test_device::device_of;
use crate::engine::time::Duration;
use crate::engine::topics::{Message, Topics};
use crate::engine::units::Release;

fn gateway() -> Gateway {
    Gateway {
        topics: Topics::new("busker"),
        prefix: "homeassistant".into(),
        release: Release::USUAL,
        expire_after: None,
    }
}

/// A relay, and an input that is °C or V as its mode (0, 1, 2: none) says.
fn device() -> DeviceSettings {
    let at = |table, first| Address { span: Span::single(table, first), bits: None };
    let mut relay = Point::new("relay", at(Table::Coil, 0), Poll::Fast);
    relay.write = Some(Write::new(relay.at, WriteRule::Any));
    relay.presentation.name = Some("Heating relay".into());
    let mode = Point::new("mode", at(Table::Holding, 0), Poll::Slow);
    let mut input = Point::new("input", at(Table::Input, 0), Poll::Fast);
    let form = |unit: &str| Some(Form { unit: Unit::Fixed(unit.into()), ..Form::new(Kind::I16) });
    let case = |key, name: &str, form| Case { key, name: name.into(), form };
    input.encoding = Encoding::Cases {
        by: 1,
        cases: vec![case(0, "pt100", form("°C")), case(1, "voltage", form("V")), case(2, "off", None)],
    };
    let device = device_of(vec![relay, mode, input]);
    DeviceSettings {
        name: "heating".into(),
        title: "Heating".into(),
        bus: 0,
        unit: 1,
        device: device.into(),
        wanted: Vec::new(),
        raw_write: Vec::new(),
    }
}

fn announced(mode: Option<i128>) -> Announcement {
    announcement(&gateway(), &device(), "cellar", &[None, mode, None])
}

fn payload(message: &Message) -> Value {
    serde_json::from_str(&message.payload).expect("an announcement is JSON")
}

#[test]
fn an_announcement_is_one_retained_message_with_everything_home_assistant_needs() {
    let message = announced(Some(0)).message();
    assert_eq!(message.topic, "homeassistant/device/busker_heating/config");
    assert!(message.retain);
    let expected = json!({
        "device": {
            "identifiers": ["busker_heating"],
            "name": "Heating",
            "manufacturer": "Test",
            "model": "T1",
            "via_device": "busker_bus_cellar",
            "connections": [],
        },
        "origin": {"name": "busker", "sw_version": env!("CARGO_PKG_VERSION")},
        "availability": [
            {"topic": "busker/bridge/state", "payload_available": "online", "payload_not_available": "offline"},
            {"topic": "busker/heating/availability", "payload_available": "online", "payload_not_available": "offline"},
        ],
        "availability_mode": "all",
        "components": {
            "relay": {
                "platform": "switch",
                "name": "Relay",
                "unique_id": "busker_heating_relay",
                "default_entity_id": "switch.heating_relay",
                "state_topic": "busker/heating/relay",
                "command_topic": "busker/heating/relay/set",
            },
            "mode": {
                "platform": "sensor",
                "name": "Mode",
                "suggested_display_precision": 0,
                "unique_id": "busker_heating_mode",
                "default_entity_id": "sensor.heating_mode",
                "state_topic": "busker/heating/mode",
            },
            "input_c": {
                "platform": "sensor",
                "name": "Input",
                "device_class": "temperature",
                "unit_of_measurement": "°C",
                "state_class": "measurement",
                "suggested_display_precision": 0,
                "unique_id": "busker_heating_input_c",
                "default_entity_id": "sensor.heating_input_c",
                "state_topic": "busker/heating/input",
            },
        },
    });
    let mut told = payload(&message);
    // How the device is on its wire is told by another test.
    let components = told["components"].as_object_mut().expect("an object");
    components.retain(|key, _| !key.starts_with("wire_"));
    assert_eq!(told, expected);
}

#[test]
fn a_thermostat_is_turned_in_the_steps_of_its_wanted_temperature() {
    for (target, step) in [
        ("type: i16, decimals: 1, write: 5..30 step 0.5", 0.5),
        ("type: i16, decimals: 1, write: 5..30", 0.1),
        ("type: i16, decimals: 2, write: 5..30", 0.1),
        ("write: 5..30", 1.0),
        ("type: f32, write: 5..30", 0.1),
    ] {
        let text = format!(
            "buses: {{plant: {{tcp: 'host:502'}}}}
devices:
  room:
    bus: plant
    unit: 1
    points:
      now: {{at: input 0, unit: °C, poll: fast}}
      target: {{at: holding 0, unit: °C, poll: fast, {target}}}
      heat: {{at: coil 0, poll: fast, write: any}}
    things:
      room:
        as: climate
        temperature: now
        target: target
        state: {{'off': {{heat: OFF}}, heat: {{heat: ON}}}}
        do: {{'off': [{{heat: OFF}}], heat: [{{heat: ON}}]}}
"
        );
        let loaded = configuration::load("busker.yaml", text.as_bytes(), &Library::shipped());
        let settings = loaded.unwrap_or_else(|faults| panic!("{faults:?}")).0;
        let told = payload(&announcement(&gateway(), &settings.devices[0], "plant", &[None; 3]).message());
        assert_eq!(told["components"]["room"]["temp_step"], json!(step), "{target}");
    }
}

#[test]
fn an_empty_message_which_takes_a_value_back_is_none_of_an_enumerations_names() {
    let mut mode =
        Point::new("mode", Address { span: Span::single(Table::Input, 0), bits: None }, Poll::Fast);
    let names = Names::All(vec![(0, "mains".into()), (1, "battery".into())]);
    mode.encoding = Encoding::Plain(Form { names, ..Form::new(Kind::U16) });
    let device = DeviceSettings { device: device_of(vec![mode]).into(), ..device() };
    let told = payload(&announcement(&gateway(), &device, "cellar", &[None]).message());
    assert_eq!(told["components"]["mode"]["device_class"], "enum");
    assert_eq!(told["components"]["mode"]["value_template"], "{{ value or none }}");
}

#[test]
fn what_is_only_shown_and_read_again_and_again_expires_where_that_is_wished() {
    let mut settings = device();
    let mut inner = (*settings.device).clone();
    (inner.wire.intervals.fast, inner.wire.intervals.slow) =
        (Duration::from_millis(500), Duration::from_secs(1000));
    let at = |first| Address { span: Span::single(Table::Holding, first), bits: None };
    let mut kept = Point::new("kept", at(10), Poll::Once);
    kept.persistent = true;
    inner.points.push(kept);
    settings.device = inner.into();
    let expiries = |wished: Option<u64>| {
        let gateway = Gateway { expire_after: wished.map(Duration::from_secs), ..gateway() };
        let device = announcement(&gateway, &settings, "cellar", &[None, Some(0), None, None]);
        let messages = [device, announce_bus(&gateway, "cellar"), announce_bridge(&gateway)];
        let payloads = messages.iter().map(|announcement| payload(&announcement.message()));
        let mut found = BTreeMap::new();
        for payload in payloads {
            for component in payload["components"].as_object().expect("an object").values() {
                let id = component["unique_id"].as_str().expect("an id").to_string();
                found.insert(id, component["expire_after"].as_u64());
            }
        }
        found
    };
    assert!(expiries(None).values().all(Option::is_none));
    let found = expiries(Some(100));
    for (id, expected) in [
        // Home Assistant knows it of sensors only.
        ("busker_heating_relay", None),
        ("busker_heating_input_c", Some(100)),
        // Three of its slow periods.
        ("busker_heating_mode", Some(3000)),
        // It is read once.
        ("busker_heating_kept", None),
        ("busker_heating_eeprom_writes", Some(100)),
        // Health is told each minute.
        ("busker_heating_wire_timeouts", Some(180)),
        ("busker_bus_cellar_load", Some(180)),
        ("busker_bus_cellar_link", Some(180)),
        // It is what the last will says.
        ("busker_bridge_connection", None),
    ] {
        assert_eq!(found[id], expected, "{id}");
    }
}

#[test]
fn ids_are_the_same_under_another_name_address_bus_or_order() {
    let ids = |announcement: Announcement| {
        let payload = payload(&announcement.message());
        let components = payload["components"].as_object().expect("an object").iter();
        let mut ids: Vec<(String, Value, Value)> = components
            .map(|(key, one)| (key.clone(), one["unique_id"].clone(), one["default_entity_id"].clone()))
            .collect();
        ids.sort_by(|one, other| one.0.cmp(&other.0));
        (announcement.topic().to_string(), payload["device"]["identifiers"].clone(), ids)
    };
    let mut moved = device();
    (moved.title, moved.unit, moved.bus) = ("Boiler room".into(), 77, 3);
    let mut inner = (*moved.device).clone();
    // The mode, by which the input is understood, stays in the middle.
    inner.points.reverse();
    for point in &mut inner.points {
        point.presentation.name = Some(format!("Another {}", point.name));
    }
    moved.device = inner.into();
    let known = [None, Some(0), None];
    assert_eq!(ids(announcement(&gateway(), &moved, "attic", &known)), ids(announced(Some(0))));
}

#[test]
fn how_a_device_is_on_its_wire_is_told_by_few_entities_and_by_more_that_can_be_enabled() {
    let told = payload(&announced(None).message());
    let components = told["components"].as_object().expect("an object");
    let wire = || components.iter().filter(|(key, _)| key.starts_with("wire_"));
    let enabled: Vec<&str> = wire()
        .filter(|(_, component)| component["enabled_by_default"] != json!(false))
        .map(|(key, _)| key.as_str())
        .collect();
    assert_eq!(enabled, ["wire_turnaround_p95", "wire_fast_period", "wire_timeouts"]);
    assert_eq!(wire().count(), 15);
    assert!(wire().all(|(_, component)| component["entity_category"] == "diagnostic"));
    let expected = json!({
        "platform": "sensor",
        "name": "Turnaround, 95th percentile",
        "entity_category": "diagnostic",
        "device_class": "duration",
        "unit_of_measurement": "ms",
        "state_class": "measurement",
        "suggested_display_precision": 1,
        "unique_id": "busker_heating_wire_turnaround_p95",
        "default_entity_id": "sensor.heating_wire_turnaround_p95",
        "state_topic": "busker/heating/health",
        "value_template": "{{ (value_json.turnaround_seconds.p95 * 1000) | round(2) \
                           if value_json.turnaround_seconds.p95 is not none else none }}",
    });
    assert_eq!(components["wire_turnaround_p95"], expected);
}

#[test]
fn what_a_new_case_drops_is_buried_before_the_new_is_announced() {
    let keys = |announcement: &Announcement| {
        let keys = announcement.components().map(|(key, _)| key.to_string());
        keys.filter(|key| !key.starts_with("wire_")).collect::<Vec<_>>()
    };
    assert_eq!(keys(&announced(None)), ["relay", "mode"]);
    assert_eq!(keys(&announced(Some(1))), ["relay", "mode", "input_v"]);
    assert_eq!(farewell(&announced(None), &announced(Some(0))), None);
    assert_eq!(farewell(&announced(Some(1)), &announced(Some(1))), None);

    let message = farewell(&announced(Some(0)), &announced(Some(1))).expect("°C is dropped");
    let components = &payload(&message)["components"];
    assert_eq!(components["input_c"], json!({"platform": "sensor"}));
    assert_eq!(components["input_v"]["unique_id"], "busker_heating_input_v");
    assert_eq!(components["relay"]["platform"], "switch");

    let message = farewell(&announced(Some(1)), &announced(Some(2))).expect("V is dropped");
    assert_eq!(payload(&message)["components"]["input_v"], json!({"platform": "sensor"}));
}

#[test]
fn what_becomes_another_platform_is_buried_before_it_comes_back_under_its_key() {
    let as_sensor = announced(Some(0));
    let mut as_number = as_sensor.clone();
    let input = as_number.components.iter_mut().find(|(key, _)| key == "input_c").expect("the input");
    input.1.insert("platform".into(), "number".into());
    let known = Outline::of(&as_sensor, &as_sensor.message());
    for message in [farewell(&as_sensor, &as_number), known.farewell(&as_number)] {
        let components = payload(&message.expect("the sensor is dropped"))["components"].clone();
        assert_eq!(components["input_c"], json!({"platform": "sensor"}));
        assert_eq!(components["relay"]["platform"], "switch");
    }
}

#[test]
fn an_announcement_is_known_again_by_the_gateway_that_made_it() {
    let message = announced(Some(0)).message();
    let parse = |base: &str| Announcement::parse(&Topics::new(base), &message.topic, &message.payload);
    assert_eq!(parse("busker"), Some(announced(Some(0))));
    assert_eq!(parse("busker_2"), None);
    let bridge = announce_bridge(&gateway());
    let message = bridge.message();
    let parse = |payload: &str| Announcement::parse(&gateway().topics, &message.topic, payload);
    assert_eq!(parse(&message.payload), Some(bridge));
    for strange in ["", "{}", "[]", "{\"components\":1}", "{\"components\":{}}", "nonsense"] {
        assert_eq!(parse(strange), None, "{strange}");
    }
    assert_eq!(parse(&message.payload.replace("\"name\":\"busker\"", "\"name\":\"other\"")), None);
}

#[test]
fn the_device_hangs_on_its_bus_and_the_bus_on_the_gateway() {
    let bridge = payload(&announce_bridge(&gateway()).message());
    let bus = payload(&announce_bus(&gateway(), "cellar").message());
    let device = payload(&announced(None).message());
    assert_eq!(device["device"]["via_device"], bus["device"]["identifiers"][0]);
    assert_eq!(bus["device"]["via_device"], bridge["device"]["identifiers"][0]);
    assert_eq!(bridge["availability"], Value::Null);
    assert_eq!(bridge["components"]["connection"]["state_topic"], "busker/bridge/state");
}

/// The keys that shipped devices are told by, in any of the modes that their selectors' names make one by one.
#[test]
fn every_key_that_is_announced_is_among_those_that_are_held_against_others() {
    let library = Library::shipped();
    for id in library.ids() {
        let inner = std::sync::Arc::new(library.load(id).expect("a shipped profile"));
        let known_keys = keys::of_device(&inner);
        let device = DeviceSettings { device: inner.clone(), ..device() };
        let first = |point: &Point| point.deciding_values().first().map(|(value, _)| *value);
        let usual: Vec<Option<i128>> = inner.points.iter().map(first).collect();
        for (index, point) in inner.points.iter().enumerate() {
            for (value, _) in point.deciding_values() {
                let mut known = usual.clone();
                known[index] = Some(value);
                for (key, _) in announcement(&gateway(), &device, "cellar", &known).components() {
                    assert!(known_keys.contains_key(key), "{id}: {key} with {} at {value}", point.name);
                }
            }
        }
    }
    let bus = announce_bus(&gateway(), "cellar");
    let own: BTreeSet<&str> = bus.components().map(|(key, _)| key).collect();
    assert_eq!(own, keys::OF_A_WIRE.into_iter().chain([keys::LINK]).collect());
}
