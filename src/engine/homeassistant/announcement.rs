//! One discovery message for each Modbus device, and the farewell to what it no longer has.

use std::collections::{BTreeMap, BTreeSet};
use std::hash::{DefaultHasher, Hash, Hasher};

use serde_json::{Map, Value, json};

use super::beside::companions;
use super::diagnostics::Place;
use super::entity::Entity;
use super::point::{entity, sentence};
use super::release;
use super::thing::thing_component;
use crate::engine::device::{Platform, Poll, ThingKind};
use crate::engine::settings::{self, DeviceSettings};
use crate::engine::topics::{self, DeviceTopics, Message, Topics};
use crate::engine::units::Release;

/// What all announcements of one gateway have in common.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Gateway {
    pub topics: Topics,
    /// Where Home Assistant looks: `homeassistant`.
    pub prefix: String,
    /// The oldest that must understand it.
    pub release: Release,
    /// Whether the broker keeps values.
    pub retains: bool,
}

impl Gateway {
    pub fn new(mqtt: &settings::Mqtt, home_assistant: &settings::HomeAssistant) -> Gateway {
        Gateway {
            topics: Topics::of(mqtt),
            prefix: home_assistant.prefix.clone(),
            release: home_assistant.minimum_version,
            retains: mqtt.values.retain,
        }
    }

    /// The part that says who speaks; Home Assistant refuses a message without it.
    fn origin(&self) -> Value {
        json!({"name": "busker", "sw_version": env!("CARGO_PKG_VERSION")})
    }
}

/// The announcement of one device, with its components by key.
#[derive(Clone, Debug, PartialEq)]
pub struct Announcement {
    topic: String,
    /// Everything but the components.
    head: Map<String, Value>,
    components: Components,
}

/// In the order of the device's points.
type Components = Vec<(String, Map<String, Value>)>;

impl Announcement {
    pub(super) fn new(
        gateway: &Gateway,
        identity: &str,
        device: Value,
        availability: &[String],
        mut components: Components,
    ) -> Announcement {
        for (_, component) in &mut components {
            release::fit(component, gateway.release);
        }
        let mut head = Map::new();
        head.insert("device".into(), device);
        head.insert("origin".into(), gateway.origin());
        if !availability.is_empty() {
            let topics: Vec<Value> = availability.iter().map(|topic| json!({"topic": topic})).collect();
            head.insert("availability".into(), topics.into());
            head.insert("availability_mode".into(), "all".into());
        }
        // No `qos`: with 1, Home Assistant keeps a command that is given while the broker is away, and
        // sends it when the broker is back, however long that takes. With 0 it tells its user that
        // the command failed. States are retained, and come with 0 as well.
        Announcement { topic: topics::discovery(&gateway.prefix, identity), head, components }
    }

    /// An announcement that this gateway has published, perhaps in an earlier run; `None` for anybody
    /// else's. Whose it is shows in the topics, since one gateway's identities may begin like
    /// another's.
    pub fn parse(topics: &Topics, topic: &str, payload: &str) -> Option<Announcement> {
        let Value::Object(mut head) = serde_json::from_str(payload).ok()? else { return None };
        let Value::Object(components) = head.remove("components")? else { return None };
        let components: Components = components
            .into_iter()
            .filter_map(|(key, component)| match component {
                Value::Object(component) => Some((key, component)),
                _ => None,
            })
            .collect();
        let bridge_state = topics.bridge_state();
        let available_by = head.get("availability").and_then(Value::as_array).into_iter().flatten();
        let mut named = available_by
            .filter_map(|entry| entry.get("topic"))
            .chain(components.iter().filter_map(|(_, component)| component.get("state_topic")));
        let ours = head.get("origin")?.get("name")? == "busker"
            && named.any(|named| named.as_str() == Some(bridge_state.as_str()));
        ours.then(|| Announcement { topic: topic.into(), head, components })
    }

    pub fn topic(&self) -> &str {
        &self.topic
    }

    /// The keys and platforms of the components.
    pub fn components(&self) -> impl Iterator<Item = (&str, &str)> {
        self.components.iter().map(|(key, component)| {
            (key.as_str(), component.get("platform").and_then(Value::as_str).unwrap_or_default())
        })
    }

    /// The topics on which what it announces is told.
    pub fn told_on(&self) -> BTreeSet<&str> {
        let availability = self.head.get("availability").and_then(Value::as_array).into_iter().flatten();
        let availability = availability.filter_map(|entry| entry.get("topic"));
        let keys = self.components.iter().flat_map(|(_, component)| component);
        let is_told = |key: &str| key.ends_with("_topic") && !key.ends_with("command_topic");
        let told = keys.filter(|(key, _)| is_told(key)).map(|(_, topic)| topic);
        availability.chain(told).filter_map(Value::as_str).collect()
    }

    /// Nothing to announce: such a device is better not mentioned at all, since Home Assistant takes
    /// an empty message for its removal.
    pub fn is_empty(&self) -> bool {
        self.components.is_empty()
    }

    /// The retained message.
    pub fn message(&self) -> Message {
        Message::retained(self.topic.clone(), self.payload_with(&[]))
    }

    /// With tombstones for `gone` components beside those that are there.
    fn payload_with(&self, gone: &[(&str, &str)]) -> String {
        let mut components: Map<String, Value> = self
            .components
            .iter()
            .map(|(key, component)| (key.clone(), Value::Object(component.clone())))
            .collect();
        for (key, platform) in gone {
            components.insert((*key).into(), json!({"platform": platform}));
        }
        let mut payload = self.head.clone();
        payload.insert("components".into(), components.into());
        Value::Object(payload).to_string()
    }
}

/// What is kept of an announcement that was made: taken apart it is eight times as large as its text, and
/// this is a tenth of it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outline {
    fingerprint: u64,
    /// A line for each component: its key and its platform.
    components: String,
}

impl Outline {
    pub fn of(announcement: &Announcement, message: &Message) -> Outline {
        let mut hasher = DefaultHasher::new();
        message.payload.hash(&mut hasher);
        let mut components = String::new();
        for (key, platform) in announcement.components() {
            components.extend([key, " ", platform, "\n"]);
        }
        components.shrink_to_fit();
        Outline { fingerprint: hasher.finish(), components }
    }

    /// As [`farewell`].
    pub fn farewell(&self, next: &Announcement) -> Option<Message> {
        farewell_to(self.components.lines().filter_map(|line| line.split_once(' ')), next)
    }
}

/// What must be said before `next` when `previous` was announced: a component that is merely left
/// out stays in Home Assistant as an orphan, and so does one that is another platform from now on. `None` if
/// nothing is dropped. Not retained, since the topic keeps what `next` says.
pub fn farewell(previous: &Announcement, next: &Announcement) -> Option<Message> {
    farewell_to(previous.components(), next)
}

fn farewell_to<'p>(
    previous: impl Iterator<Item = (&'p str, &'p str)>,
    next: &Announcement,
) -> Option<Message> {
    let kept: BTreeMap<&str, &str> = next.components().collect();
    // The tombstone of one that changes its platform stands in its own place, and `next` brings it back.
    let gone: Vec<(&str, &str)> =
        previous.filter(|(key, platform)| kept.get(key) != Some(platform)).collect();
    if gone.is_empty() {
        return None;
    }
    Some(Message::once(next.topic.clone(), next.payload_with(&gone)))
}

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
            let is_no_number =
                matches!(entity.device_class.as_deref(), Some("enum" | "timestamp" | "uptime"));
            if !gateway.retains && is_no_number {
                component.insert("value_template".into(), NOTHING_IS_NONE.into());
            }
            components.push((entity.key.clone(), component));
        }
    }
    if device.device.points.iter().any(|point| point.persistent) {
        components.push((EEPROM_WRITES.into(), eeprom_writes(&identity, own, device)));
    }
    for thing in &device.device.things {
        if let Some(mut component) = thing_component(&identity, own, device, thing, known) {
            if !gateway.retains && thing.kind == ThingKind::Climate {
                component.insert("mode_state_template".into(), NOTHING_IS_NONE.into());
            }
            components.push((thing.name.clone(), component));
        }
    }
    components.extend(diagnostics(&identity, own, device));
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

/// How the device is on its wire.
fn diagnostics(identity: &str, own: &DeviceTopics, device: &DeviceSettings) -> Components {
    let (topic, entity, key, object) = (own.health(), &device.name, "wire_", "value_json");
    let place = Place { identity, entity, key, topic: &topic, object, may_lack: false };
    let mut components = place.times(&["turnaround_p95"]);
    for (class, name) in [(Poll::Fast, "Period of fast polls"), (Poll::Slow, "Period of slow polls")] {
        if device.device.points.iter().any(|point| point.poll == class) {
            components.push(place.period(class.name(), name, class == Poll::Fast));
        }
    }
    components.extend(place.counters(&["timeouts"]));
    components
}

/// What the broker keeps of an earlier run is taken back with an empty message, if nothing is to be kept. Home
/// Assistant passes over it for most, and warns of it where there are names or moments: of enumerations, of a climate's
/// modes, of timestamps.
const NOTHING_IS_NONE: &str = "{{ value or none }}";

/// The key of the entity that counts the writes to the device's EEPROM, and the info's too.
const EEPROM_WRITES: &str = "eeprom_writes";

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
        Some(rest) if begins_so && rest.starts_with(' ') => sentence(rest.trim()).into(),
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
    use crate::engine::address::{Address, Span, Table};
    use crate::engine::device::{Case, Encoding, Form, Kind, Names, Point, Poll, Unit, Write, WriteRule};
    use crate::engine::homeassistant::{announce_bridge, announce_bus};
    use crate::engine::test_device::device_of;

    fn gateway() -> Gateway {
        Gateway {
            topics: Topics::new("busker"),
            prefix: "homeassistant".into(),
            release: Release::USUAL,
            retains: true,
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
            },
            "origin": {"name": "busker", "sw_version": env!("CARGO_PKG_VERSION")},
            "availability": [{"topic": "busker/bridge/state"}, {"topic": "busker/heating/availability"}],
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
    fn an_empty_message_which_takes_a_value_back_is_none_of_an_enumerations_names() {
        let mut mode =
            Point::new("mode", Address { span: Span::single(Table::Input, 0), bits: None }, Poll::Fast);
        let names = Names::All(vec![(0, "mains".into()), (1, "battery".into())]);
        mode.encoding = Encoding::Plain(Form { names, ..Form::new(Kind::U16) });
        let device = DeviceSettings { device: device_of(vec![mode]).into(), ..device() };
        let template = |retains: bool| {
            let gateway = Gateway { retains, ..gateway() };
            let told = payload(&announcement(&gateway, &device, "cellar", &[None]).message());
            assert_eq!(told["components"]["mode"]["device_class"], "enum");
            told["components"]["mode"]["value_template"].clone()
        };
        assert_eq!(template(false), "{{ value or none }}");
        assert_eq!(template(true), Value::Null);
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
        assert_eq!(wire().count(), 14);
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
}
