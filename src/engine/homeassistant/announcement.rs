//! A discovery message, and the farewell to what it no longer has.

use std::collections::{BTreeMap, BTreeSet};
use std::hash::{DefaultHasher, Hash, Hasher};

use serde_json::{Map, Value, json};

use super::release;
use crate::engine::settings;
use crate::engine::time::Duration;
use crate::engine::topics::{self, Message, Topics};
use crate::engine::units::Release;

/// What all announcements of one gateway have in common.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Gateway {
    pub topics: Topics,
    /// Where Home Assistant looks: `homeassistant`.
    pub prefix: String,
    /// The oldest that must understand it.
    pub release: Release,
    /// After this what tells nothing is unavailable; `None`: never.
    pub expire_after: Option<Duration>,
}

impl Gateway {
    pub fn new(mqtt: &settings::Mqtt, home_assistant: &settings::HomeAssistant) -> Gateway {
        Gateway {
            topics: Topics::of(mqtt),
            prefix: home_assistant.prefix.clone(),
            release: home_assistant.minimum_version,
            expire_after: home_assistant.expire_after,
        }
    }

    /// The seconds after which an entity is unavailable of which nothing is told, where it is told once in `period`
    /// or more often.
    pub(super) fn expiry(&self, period: Duration) -> Option<u64> {
        let after = self.expire_after?.max(period * 3);
        Some(after.as_secs() + u64::from(after.subsec_nanos() > 0))
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
    pub(super) components: Components,
}

/// In the order of the device's points.
pub(super) type Components = Vec<(String, Map<String, Value>)>;

impl Announcement {
    /// What Home Assistant takes for granted of an availability and of a device (`connections`) is said all the same: while
    /// one of its threads loads a platform, others may pass over what gives these parts their defaults, and an entity
    /// that comes in that moment is refused for want of them.
    pub(super) fn new(
        gateway: &Gateway,
        identity: &str,
        mut device: Value,
        availability: &[String],
        mut components: Components,
    ) -> Announcement {
        device["connections"] = json!([]);
        for (_, component) in &mut components {
            release::fit(component, gateway.release);
        }
        let mut head = Map::new();
        head.insert("device".into(), device);
        head.insert("origin".into(), gateway.origin());
        if !availability.is_empty() {
            let entries: Vec<Value> = availability.iter().map(|topic| availability_on(topic)).collect();
            head.insert("availability".into(), entries.into());
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
        self.components.iter().map(|(key, component)| (key.as_str(), platform(component)))
    }

    /// What of it `present` does not have: what stands under other keys, or is another platform. As of the device
    /// that `present` announces; `None` if that is nothing.
    pub fn without(&self, present: &Announcement) -> Option<Announcement> {
        let kept: BTreeMap<&str, &str> = present.components().collect();
        let is_gone = |key: &str, component: &Map<String, Value>| kept.get(key) != Some(&platform(component));
        let gone = self.components.iter().filter(|(key, component)| is_gone(key, component));
        let components: Components = gone.cloned().collect();
        let head = present.head.clone();
        (!components.is_empty()).then(|| Announcement { topic: self.topic.clone(), head, components })
    }

    /// Takes in what `other` has, in the place of what is the same here. Returns what cannot be told in one message
    /// with it, since the key means another platform here.
    pub fn join(&mut self, other: Announcement) -> Option<Announcement> {
        let mut apart = Announcement { components: Vec::new(), ..other.clone() };
        for (key, component) in other.components {
            match self.components.iter_mut().find(|(here, _)| *here == key) {
                None => self.components.push((key, component)),
                Some((_, here)) if platform(here) == platform(&component) => *here = component,
                Some(_) => apart.components.push((key, component)),
            }
        }
        (!apart.is_empty()).then_some(apart)
    }

    /// The topics on which what it announces is told.
    pub fn told_on(&self) -> BTreeSet<&str> {
        let availability = self.head.get("availability").and_then(Value::as_array).into_iter().flatten();
        let availability = availability.filter_map(|entry| entry.get("topic"));
        let keys = self.components.iter().flat_map(|(_, component)| component);
        let told = keys.filter(|(key, _)| is_told(key)).map(|(_, topic)| topic);
        availability.chain(told).filter_map(Value::as_str).collect()
    }

    /// The topics of which this one makes something else than `previous` did.
    pub fn told_otherwise_than(&self, previous: &Announcement) -> BTreeSet<String> {
        let before = previous.meanings();
        let now = self.meanings().into_iter();
        let changed = now.filter(|(topic, now)| before.get(topic).is_some_and(|before| before != now));
        changed.map(|(topic, _)| topic.to_string()).collect()
    }

    /// What stands on each topic: for which components, and what decides there which values are right.
    fn meanings(&self) -> BTreeMap<&str, Vec<Meaning<'_>>> {
        let mut meanings: BTreeMap<&str, Vec<Meaning>> = BTreeMap::new();
        for (key, component) in &self.components {
            let topics = component.iter().filter(|(key, _)| is_told(key));
            for topic in topics.filter_map(|(_, topic)| topic.as_str()) {
                let meaning = MEANING.map(|key| component.get(key));
                meanings.entry(topic).or_default().push((key.as_str(), meaning));
            }
        }
        meanings
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

    /// Takes away all that it announces, and leaves the device. Not retained, since it is said beside what is announced.
    pub fn tombstones(&self) -> Message {
        let nothing = Announcement { components: Vec::new(), ..self.clone() };
        let gone: Vec<(&str, &str)> = self.components().collect();
        Message::once(self.topic.clone(), nothing.payload_with(&gone))
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

/// The base topic of the gateway that has published this announcement; `None` where none like this one has.
pub fn announcer(payload: &str) -> Option<String> {
    // Most of what others announce is not taken apart.
    if !payload.contains("/bridge/state") {
        return None;
    }
    let announced: Value = serde_json::from_str(payload).ok()?;
    if announced["origin"]["name"] != "busker" {
        return None;
    }
    let available_by =
        announced["availability"].as_array().into_iter().flatten().map(|entry| &entry["topic"]);
    let components = announced["components"].as_object().into_iter().flatten();
    let mut named = available_by.chain(components.map(|(_, component)| &component["state_topic"]));
    named.find_map(|topic| Topics::base_of_state(topic.as_str()?)).map(str::to_string)
}

fn availability_on(topic: &str) -> Value {
    json!({"topic": topic, "payload_available": "online", "payload_not_available": "offline"})
}

fn platform(component: &Map<String, Value>) -> &str {
    component.get("platform").and_then(Value::as_str).unwrap_or_default()
}

/// What decides of a component which values are right for it: Home Assistant logs a warning for a name that is no
/// option, and for a number that is to be a moment.
const MEANING: [&str; 8] = [
    "platform",
    "device_class",
    "unit_of_measurement",
    "state_class",
    "suggested_display_precision",
    "options",
    "modes",
    "temperature_unit",
];

/// A component's key, and what stands in it of [`MEANING`].
type Meaning<'a> = (&'a str, [Option<&'a Value>; MEANING.len()]);

/// Whether under this key of a component stands a topic on which something is told.
fn is_told(key: &str) -> bool {
    key.ends_with("_topic") && !key.ends_with("command_topic")
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
