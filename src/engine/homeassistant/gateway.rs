//! The gateway itself and its buses in Home Assistant.

use serde_json::json;

use super::announcement::{Announcement, Gateway};
use super::diagnostics::{Place, object};
use crate::engine::device::Poll;
use crate::engine::health::TOLD_EVERY;
use crate::engine::keys::{CONNECTION, LINK};
use crate::engine::settings::Settings;
use crate::engine::topics::{Message, OFFLINE, ONLINE, Topics};

/// The identities of everything that Home Assistant shall know: the gateway, its buses and its devices.
pub fn identities(settings: &Settings) -> Vec<String> {
    if !settings.home_assistant.discovery {
        return Vec::new();
    }
    let topics = Topics::of(&settings.mqtt);
    let buses = settings.buses.iter().map(|bus| topics.bus_identity(&bus.name));
    let devices = settings.devices.iter().map(|device| topics.identity(&device.name));
    buses.chain(devices).chain([topics.bridge_identity()]).collect()
}

/// What is announced before anything is known of the devices: the gateway, then its buses.
pub fn introduction(settings: &Settings) -> Vec<Message> {
    let of_gateway = announcing(settings).map(|gateway| announce_bridge(&gateway).message());
    let buses = settings.buses.iter().filter_map(|bus| introduction_of_bus(settings, &bus.name));
    of_gateway.into_iter().chain(buses).collect()
}

/// The same of one bus.
pub fn introduction_of_bus(settings: &Settings, bus: &str) -> Option<Message> {
    announcing(settings).map(|gateway| announce_bus(&gateway, bus).message())
}

/// `None` where nothing is announced.
fn announcing(settings: &Settings) -> Option<Gateway> {
    let home_assistant = &settings.home_assistant;
    home_assistant.discovery.then(|| Gateway::new(&settings.mqtt, home_assistant))
}

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
        "unique_id": format!("{identity}_{CONNECTION}"),
        "default_entity_id": format!("binary_sensor.{identity}_{CONNECTION}"),
        "state_topic": topics.bridge_state(),
        "payload_on": ONLINE,
        "payload_off": OFFLINE,
    });
    let components = vec![(CONNECTION.to_string(), object(connection))];
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
    let topic = topics.bridge_health();
    // In brackets: a bus may be called `items`, which is also a method of a mapping.
    let object = format!("value_json.buses['{bus}']");
    let place = Place {
        identity: &identity,
        entity: &identity,
        key: "",
        topic: &topic,
        object: &object,
        // A bus is announced before it is told of, and the health of before may be all that the broker has.
        may_lack: true,
        expiry: gateway.expiry(TOLD_EVERY),
    };
    let link = json!({"device_class": "connectivity"});
    let mut components = vec![
        place.entity("binary_sensor", LINK, "Link", "'ON' if OBJECT.up else 'OFF'", link),
        place.load("Load", true),
        place.period(Poll::Fast.name(), "Period of fast polls", false),
        place.period(Poll::Slow.name(), "Period of slow polls", false),
    ];
    let often = ["requests", "timeouts", "checksum_errors", "exceptions", "late_replies"];
    components.extend(place.counters(&often));
    components.extend(place.times(&["turnaround_p95", "command_wait_p95"]));
    Announcement::new(gateway, &identity, device, &[topics.bridge_state()], components)
}
