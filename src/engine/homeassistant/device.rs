//! One discovery message for each Modbus device: its points, its things, and how it is on its wire.

use serde_json::{Map, Value, json};

use super::announcement::{Announcement, Components, Gateway};
use super::beside::companions;
use super::diagnostics::Place;
use super::entity::Entity;
use super::point::entity;
use super::thing::thing_component;
use crate::engine::device::{Platform, Poll, ThingKind, sentence};
use crate::engine::health::TOLD_EVERY;
use crate::engine::keys::{EEPROM_WRITES, WIRE};
use crate::engine::settings::DeviceSettings;
use crate::engine::topics::DeviceTopics;

/// The announcement of one device on the bus called `bus`, with the entities that exist while its
/// selectors say what is `known`.
pub fn announcement(
    gateway: &Gateway,
    device: &DeviceSettings,
    bus: &str,
    known: &[Option<i128>],
) -> Announcement {
    let topics = &gateway.topics;
    let own = &topics.of_device(bus, &device.name);
    let identity = topics.identity(&device.name);
    let mut components = Components::new();
    for (index, point) in device.device.points.iter().enumerate() {
        let entities =
            entity(&device.device, index, known).into_iter().chain(companions(&device.device, index, known));
        for entity in entities {
            let mut component = component(&identity, own, device, &point.name, &entity);
            let expiry = expires_after(gateway, device, point.poll, entity.platform);
            component.extend(expiry.map(|seconds| ("expire_after".into(), seconds.into())));
            let is_no_number =
                matches!(entity.device_class.as_deref(), Some("enum" | "timestamp" | "uptime"));
            if is_no_number {
                component.insert("value_template".into(), NOTHING_IS_NONE.into());
            }
            components.push((entity.key.clone(), component));
        }
    }
    if device.device.points.iter().any(|point| point.persistent) {
        let mut component = eeprom_writes(&identity, own, device);
        // The device's info is told again as its points are read.
        let poll = device.device.points.iter().map(|point| point.poll).min().unwrap_or(Poll::Never);
        let expiry = expires_after(gateway, device, poll, Platform::Sensor);
        component.extend(expiry.map(|seconds| ("expire_after".into(), seconds.into())));
        components.push((EEPROM_WRITES.into(), component));
    }
    for thing in &device.device.things {
        if let Some(mut component) = thing_component(&identity, own, device, thing, known) {
            if thing.kind == ThingKind::Climate {
                component.insert("mode_state_template".into(), NOTHING_IS_NONE.into());
            }
            components.push((thing.name.clone(), component));
        }
    }
    components.extend(diagnostics(gateway, &identity, own, device));
    let about = json!({
        "identifiers": [identity],
        "name": device.title,
        "manufacturer": device.device.manufacturer,
        "model": device.device.model,
        "via_device": topics.bus_identity(bus),
    });
    let availability = [topics.bridge_state(), own.availability()];
    Announcement::new(gateway, &identity, without_empty(about), &availability, components)
}

/// The seconds after which a point's entity expires, if it does: only what Home Assistant only shows can, and only
/// what is read again and again is told again and again.
fn expires_after(gateway: &Gateway, device: &DeviceSettings, poll: Poll, platform: Platform) -> Option<u64> {
    let intervals = device.device.wire.intervals;
    let period = match poll {
        Poll::Fast => intervals.fast,
        Poll::Slow => intervals.slow,
        Poll::Once | Poll::Never => return None,
    };
    let can = matches!(platform, Platform::Sensor | Platform::BinarySensor);
    gateway.expiry(period).filter(|_| can)
}

/// How the device is on its wire.
fn diagnostics(gateway: &Gateway, identity: &str, own: &DeviceTopics, device: &DeviceSettings) -> Components {
    let (topic, entity, key, object) = (own.health(), &device.name, WIRE, "value_json");
    let expiry = gateway.expiry(TOLD_EVERY);
    let place = Place { identity, entity, key, topic: &topic, object, may_lack: false, expiry };
    let mut components = place.times(&["turnaround_p95"]);
    for (class, name) in [(Poll::Fast, "Period of fast polls"), (Poll::Slow, "Period of slow polls")] {
        if device.device.points.iter().any(|point| point.poll == class) {
            components.push(place.period(class.name(), name, class == Poll::Fast));
        }
    }
    components.push(place.load("Share of the wire", false));
    components.extend(place.counters(&["timeouts"]));
    components
}

/// What the broker keeps is taken back with an empty message, where nothing is to be kept, and of a point that is
/// gone before Home Assistant has let go of its entity. Home Assistant passes over it for most, and warns of it where there are names or moments: of enumerations, of a climate's
/// modes, of timestamps.
const NOTHING_IS_NONE: &str = "{{ value or none }}";

fn eeprom_writes(identity: &str, own: &DeviceTopics, device: &DeviceSettings) -> Map<String, Value> {
    let component = json!({
        "platform": "sensor",
        "name": "EEPROM writes",
        "unique_id": format!("{identity}_{EEPROM_WRITES}"),
        "default_entity_id": format!("sensor.{}_{EEPROM_WRITES}", device.name),
        "state_topic": own.info(),
        "value_template": format!("{{{{ value_json.{EEPROM_WRITES} }}}}"),
        "state_class": "total_increasing",
        "entity_category": "diagnostic",
        "icon": "mdi:memory",
        // What the guard holds back at the moment; the broker may keep an info from before there was one.
        "json_attributes_topic": own.info(),
        "json_attributes_template": "{{ value_json.eeprom | tojson if value_json.eeprom is defined else '{}' }}",
    });
    if let Value::Object(component) = component { component } else { Map::new() }
}

fn component(
    identity: &str,
    own: &DeviceTopics,
    device: &DeviceSettings,
    point: &str,
    entity: &Entity,
) -> Map<String, Value> {
    let mut component = entity.component();
    component.insert("name".into(), name_beside(&entity.name, &device.title));
    let platform = entity.platform;
    component.insert("unique_id".into(), format!("{identity}_{}", entity.key).into());
    // With the case's unit: Home Assistant still has the entity of the case before when the new one
    // comes, and would end the id of the same name in `_2`.
    component.insert(
        "default_entity_id".into(),
        format!("{}.{}_{}", platform.name(), device.name, entity.key).into(),
    );
    if platform != Platform::Button {
        component.insert("state_topic".into(), own.state(point).into());
    }
    if !matches!(platform, Platform::Sensor | Platform::BinarySensor | Platform::Event) {
        component.insert("command_topic".into(), own.set(point).into());
    }
    component
}

/// The entity's name without the device's in front, which Home Assistant puts there itself; null for
/// an entity that is called as its device.
pub(super) fn name_beside(name: &str, title: &str) -> Value {
    let begins_so = name.get(..title.len()).is_some_and(|start| start.eq_ignore_ascii_case(title));
    match name.get(title.len()..) {
        Some("") if begins_so => Value::Null,
        Some(rest) if begins_so && rest.starts_with([' ', ':', ',']) => {
            // `Heating: flow`, `Heating – flow`.
            let beside = |c: char| c.is_whitespace() || matches!(c, ':' | ',' | '-' | '–');
            Some(sentence(rest.trim_matches(beside))).filter(|rest| !rest.is_empty()).into()
        }
        _ => name.into(),
    }
}

/// Without keys whose text is empty: Home Assistant refuses some of them.
fn without_empty(mut value: Value) -> Value {
    if let Value::Object(map) = &mut value {
        map.retain(|_, value| value.as_str() != Some(""));
    }
    value
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_device_is_not_named_twice() {
        for (name, expected) in [
            ("Flow", Some("Flow")),
            ("Büro", None),
            ("büro", None),
            ("Büro:", None),
            ("Büro flow", Some("Flow")),
            ("BÜRO flow", Some("BÜRO flow")),
            ("Büro: Übergabe", Some("Übergabe")),
            ("Büro – flow", Some("Flow")),
            ("Büro-Nord", Some("Büro-Nord")),
            ("Bürofläche", Some("Bürofläche")),
            ("B", Some("B")),
        ] {
            assert_eq!(name_beside(name, "Büro").as_str(), expected, "{name}");
        }
    }
}
