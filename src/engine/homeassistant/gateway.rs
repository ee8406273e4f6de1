//! The gateway itself and its buses in Home Assistant.

use serde_json::{Map, Value, json};

use super::announcement::{Announcement, Gateway};
use crate::engine::topics::{OFFLINE, ONLINE};

/// The gateway: one entity that says whether it is connected. Announced before all others, which
/// name it as what they are reached through.
pub fn announce_bridge(gateway: &Gateway) -> Announcement {
    let topics = &gateway.topics;
    let identity = topics.bridge_identity();
    let device = json!({
        "identifiers": [identity],
        "name": "busker",
        "manufacturer": "busker",
        "model": "Modbus gateway",
        "sw_version": env!("CARGO_PKG_VERSION"),
    });
    // The last will is this entity's state, so it is always available.
    let connection = json!({
        "platform": "binary_sensor",
        "name": "Connection",
        "device_class": "connectivity",
        "entity_category": "diagnostic",
        "unique_id": format!("{identity}_connection"),
        "default_entity_id": format!("binary_sensor.{}_connection", topics.bridge_identity()),
        "state_topic": topics.bridge_state(),
        "payload_on": ONLINE,
        "payload_off": OFFLINE,
    });
    let components = vec![("connection".to_string(), object(connection))];
    Announcement::new(gateway, &identity, device, &[], components)
}

/// A bus: whether its link is up, how busy it is, and what went wrong on it, all from
/// `bridge/health`.
pub fn announce_bus(gateway: &Gateway, bus: &str) -> Announcement {
    let topics = &gateway.topics;
    let identity = topics.bus_identity(bus);
    let device = json!({
        "identifiers": [identity],
        "name": format!("Bus {bus}"),
        "manufacturer": "busker",
        "model": "Modbus bus",
        "via_device": topics.bridge_identity(),
    });
    let component = |key: &str, name: &str, template: String, more: Value| {
        let platform = if key == "link" { "binary_sensor" } else { "sensor" };
        let mut component = object(json!({
            "platform": platform,
            "name": name,
            "entity_category": "diagnostic",
            "unique_id": format!("{identity}_{key}"),
            "default_entity_id": format!("{platform}.{identity}_{key}"),
            "state_topic": topics.bridge_health(),
            "value_template": template,
        }));
        component.extend(object(more));
        (key.to_string(), component)
    };
    // In brackets: a bus may be called `items`, which is also a method of a mapping.
    let place = format!("value_json.buses['{bus}']");
    let of_bus = |expression: &str| format!("{{{{ {} }}}}", expression.replace("BUS", &place));
    let counter = |key: &str, name: &str| {
        let more = json!({"state_class": "total_increasing", "suggested_display_precision": 0});
        component(key, name, of_bus(&format!("BUS.{key}")), more)
    };
    let components = vec![
        component(
            "link",
            "Link",
            of_bus("'ON' if BUS.up else 'OFF'"),
            json!({"device_class": "connectivity"}),
        ),
        component(
            "load",
            "Load",
            of_bus("(BUS.load * 100) | round(1)"),
            json!({"unit_of_measurement": "%", "state_class": "measurement", "suggested_display_precision": 1}),
        ),
        counter("requests", "Requests"),
        counter("timeouts", "Timeouts"),
        counter("checksum_errors", "Checksum errors"),
        counter("exceptions", "Exceptions"),
        counter("late_replies", "Late replies"),
    ];
    Announcement::new(gateway, &identity, device, &[topics.bridge_state()], components)
}

fn object(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}
