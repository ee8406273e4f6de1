//! MQTT topic names, both ways, and the message that carries a payload to one.

use crate::engine::settings::{Layout, Level, Mqtt};

/// The payload of a `state` or `availability` topic while all is well.
pub const ONLINE: &str = "online";
/// The payload of a `state` or `availability` topic otherwise; also the last will.
pub const OFFLINE: &str = "offline";

/// What stands where points stand and is told of the device itself: no point's name.
pub const AVAILABILITY: &str = "availability";
pub const INFO: &str = "info";
pub const HEALTH: &str = "health";

/// No topic of ours is longer.
const TOPIC_BYTES_MAX: usize = 1024;

/// One message for the broker.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Message {
    pub topic: String,
    pub payload: String,
    /// Retained messages are remembered and sent again after each reconnect; others are told once.
    pub retain: bool,
}

impl Message {
    pub fn retained(topic: impl Into<String>, payload: impl Into<String>) -> Message {
        Message { topic: topic.into(), payload: payload.into(), retain: true }
    }

    pub fn once(topic: impl Into<String>, payload: impl Into<String>) -> Message {
        Message { topic: topic.into(), payload: payload.into(), retain: false }
    }

    /// Whether it says of a device whether it is there, or what it lacks. Of one that is well only values are told.
    pub fn says_how_a_device_is(&self) -> bool {
        let last = self.topic.rsplit_once('/').map(|(_, last)| last);
        last == Some(AVAILABILITY) || last == Some(INFO)
    }
}

/// What somebody else published for us.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Incoming<'t> {
    /// `busker/<device>/<point>/set`
    Set { device: &'t str, point: &'t str },
    /// `busker/<device>/<point>/get`
    Get { device: &'t str, point: &'t str },
    /// `busker/bridge/request/<verb>`
    Request { verb: &'t str },
}

/// What is told on a topic of this gateway.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    BridgeState,
    /// Anything else below `bridge`.
    Bridge,
    Availability,
    Info,
    /// What a point or a thing says, or all of a device at once.
    Value,
    /// None of its device topics, as discovery is.
    Other,
}

/// The topics of one gateway, all below its base topic.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Topics {
    base: String,
    layout: Layout,
}

impl Topics {
    /// `base` is the configured base topic, `busker` or `house/cellar`, without a slash at its end; points
    /// stand at `<base>/<device>/<point>`.
    pub fn new(base: &str) -> Topics {
        Topics { base: base.to_string(), layout: Layout::default() }
    }

    /// As the configuration wants them.
    pub fn of(mqtt: &Mqtt) -> Topics {
        Topics { base: mqtt.base_topic.clone(), layout: mqtt.topics.clone() }
    }

    /// The topics of one device, which is on the bus called `bus`.
    pub fn of_device(&self, bus: &str, device: &str) -> DeviceTopics {
        let mut own = self.base.clone();
        for level in &self.layout.levels {
            own.push('/');
            own.push_str(match level {
                Level::Device => device,
                Level::Bus => bus,
                Level::Fixed(text) => text,
            });
        }
        DeviceTopics { own }
    }

    /// As it is configured.
    pub fn base(&self) -> &str {
        &self.base
    }

    /// Retained; the last will.
    pub fn bridge_state(&self) -> String {
        format!("{}/bridge/state", self.base)
    }

    /// The base topic of the gateway that tells its state on `topic`.
    pub fn base_of_state(topic: &str) -> Option<&str> {
        topic.strip_suffix("/bridge/state")
    }

    /// Retained.
    pub fn bridge_info(&self) -> String {
        format!("{}/bridge/info", self.base)
    }

    /// Whether this topic is below the base topic, and not the bridge's own.
    pub fn are_above(&self, topic: &str) -> bool {
        let below = topic.strip_prefix(self.base.as_str()).and_then(|rest| rest.strip_prefix('/'));
        below.is_some_and(|below| !below.starts_with("bridge/"))
    }

    /// Retained.
    pub fn bridge_health(&self) -> String {
        format!("{}/bridge/health", self.base)
    }

    /// Where programs ask the gateway for something.
    pub fn request(&self, verb: &str) -> String {
        format!("{}/bridge/request/{verb}", self.base)
    }

    /// How a request ended; not retained.
    pub fn response(&self, verb: &str) -> String {
        format!("{}/bridge/response/{verb}", self.base)
    }

    /// A topic of the gateway's own on which nobody ever tells anything.
    pub fn question(&self) -> String {
        format!("{}/bridge/question", self.base)
    }

    /// The filters to subscribe to, so that everything [`Topics::parse`] knows arrives, and the gateway's own state.
    pub fn subscriptions(&self) -> Vec<String> {
        let mut own = self.base.clone();
        for level in &self.layout.levels {
            own.push('/');
            own.push_str(if let Level::Fixed(text) = level { text } else { "+" });
        }
        let requests = format!("{}/bridge/request/+", self.base);
        // Its own state too: others may have told it.
        vec![format!("{own}/+/set"), format!("{own}/+/get"), requests, self.bridge_state()]
    }

    /// What a message on `topic` asks for; `None` if it is none of our business.
    pub fn parse<'t>(&self, topic: &'t str) -> Option<Incoming<'t>> {
        // The answer's topic is a little longer, and must not be longer than a topic can be.
        if topic.len() > TOPIC_BYTES_MAX {
            return None;
        }
        let levels = self.below(topic)?;
        match levels[..] {
            ["bridge", "request", verb] if !verb.is_empty() => return Some(Incoming::Request { verb }),
            ["bridge", ..] => return None,
            _ => {}
        }
        let device = self.device(&levels)?;
        match levels[self.layout.levels.len()..] {
            [point, "set"] => Some(Incoming::Set { device, point }),
            [point, "get"] => Some(Incoming::Get { device, point }),
            _ => None,
        }
    }

    /// What is told on `topic`.
    pub fn kind(&self, topic: &str) -> Kind {
        let Some(levels) = self.below(topic) else { return Kind::Other };
        match levels[..] {
            ["bridge", "state"] => return Kind::BridgeState,
            ["bridge", ..] => return Kind::Bridge,
            _ => {}
        }
        if self.device(&levels).is_none() {
            return Kind::Other;
        }
        match levels[self.layout.levels.len()..] {
            [AVAILABILITY] => Kind::Availability,
            [INFO | HEALTH] => Kind::Info,
            [] | [_] => Kind::Value,
            _ => Kind::Other,
        }
    }

    fn below<'t>(&self, topic: &'t str) -> Option<Vec<&'t str>> {
        let below = topic.strip_prefix(self.base.as_str())?.strip_prefix('/')?;
        Some(below.split('/').collect())
    }

    /// The device that these levels below the base name, if they are laid out as ours.
    fn device<'t>(&self, levels: &[&'t str]) -> Option<&'t str> {
        let mut found = None;
        for (index, wanted) in self.layout.levels.iter().enumerate() {
            let level = *levels.get(index)?;
            match wanted {
                Level::Device => found = Some(level),
                Level::Bus => {}
                Level::Fixed(text) if text == level => {}
                Level::Fixed(_) => return None,
            }
        }
        found
    }

    /// The device's identity in Home Assistant, `busker_heating_relays`: its discovery topic, its
    /// device identifier and the beginning of each `unique_id`.
    pub fn identity(&self, device: &str) -> String {
        format!("{}_{device}", self.instance())
    }

    /// The gateway's own identity in Home Assistant, `busker_bridge`.
    pub fn bridge_identity(&self) -> String {
        self.identity("bridge")
    }

    /// A bus's identity in Home Assistant, `busker_bus_basement`.
    pub fn bus_identity(&self, bus: &str) -> String {
        format!("{}_bus_{bus}", self.instance())
    }

    /// The base topic with every character outside `[a-z0-9_]` as `_`: two gateways at one broker
    /// have two base topics, so that their identities differ too.
    pub fn instance(&self) -> String {
        let keeps = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
        self.base.chars().map(|c| if keeps(c) { c } else { '_' }).collect()
    }
}

/// The topics of one device: `busker/heating_relays` and below.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DeviceTopics {
    own: String,
}

impl DeviceTopics {
    /// Those of the device, of this run or an earlier one, whose availability stands on `topic`.
    pub fn with_availability_on(topic: &str) -> Option<DeviceTopics> {
        let own = topic.strip_suffix(AVAILABILITY)?.strip_suffix('/')?;
        Some(DeviceTopics { own: own.to_string() })
    }

    /// All that the device says in one message, where that is wanted; retained.
    pub fn json(&self) -> &str {
        &self.own
    }

    /// How the device is on its wire; retained, told each minute.
    pub fn health(&self) -> String {
        self.state(HEALTH)
    }

    /// Retained.
    pub fn availability(&self) -> String {
        self.state(AVAILABILITY)
    }

    /// Retained.
    pub fn info(&self) -> String {
        self.state(INFO)
    }

    /// Where a point's value stands; retained.
    pub fn state(&self, point: &str) -> String {
        format!("{}/{point}", self.own)
    }

    /// Where a wanted value is published by others.
    pub fn set(&self, point: &str) -> String {
        format!("{}/{point}/set", self.own)
    }

    /// Where others ask for a reading.
    pub fn get(&self, point: &str) -> String {
        format!("{}/{point}/get", self.own)
    }

    /// How a command ended; not retained.
    pub fn outcome(&self, point: &str) -> String {
        format!("{}/{point}/outcome", self.own)
    }
}

/// Where Home Assistant looks for the device called `identity`: `homeassistant/device/<id>/config`.
pub fn discovery(prefix: &str, identity: &str) -> String {
    format!("{prefix}/device/{identity}/config")
}

/// Where the outcome of a command on the topic `set` belongs.
pub fn outcome_of(set: &str) -> String {
    format!("{}/outcome", set.strip_suffix("/set").unwrap_or(set))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::profile::NAME_BYTES_MAX;
    use crate::engine::settings::TOPIC_PART_BYTES_MAX;

    fn laid_out(base: &str, pattern: &str) -> Topics {
        Topics { base: base.into(), layout: Layout::parse(pattern).expect("a layout") }
    }

    fn check_parse(base: &str, topic: &str, expected: Option<Incoming>) {
        assert_eq!(Topics::new(base).parse(topic), expected, "{topic}");
    }

    #[test]
    fn a_topic_to_which_no_answer_could_be_written_is_none_of_ours() {
        let long = "x".repeat(65_500);
        check_parse("busker", &format!("busker/bridge/request/{long}"), None);
        check_parse("busker", &format!("busker/relays/{long}/set"), None);
    }

    #[test]
    fn a_command_is_understood_below_the_longest_base_topic_and_layout() {
        let name = "n".repeat(NAME_BYTES_MAX);
        let rest = TOPIC_PART_BYTES_MAX - "{base}//{bus}/{device}/{point}".len();
        let pattern = format!("{{base}}/{}/{{bus}}/{{device}}/{{point}}", "x".repeat(rest));
        let topics = laid_out(&"b".repeat(TOPIC_PART_BYTES_MAX), &pattern);
        let expected = Some(Incoming::Set { device: &name, point: &name });
        assert_eq!(topics.parse(&topics.of_device(&name, &name).set(&name)), expected);
    }

    #[test]
    fn what_is_subscribed_to_is_understood_and_nothing_else() {
        let set = |device, point| Some(Incoming::Set { device, point });
        check_parse("busker", "busker/relays/relay_1/set", set("relays", "relay_1"));
        check_parse(
            "busker",
            "busker/relays/relay_1/get",
            Some(Incoming::Get { device: "relays", point: "relay_1" }),
        );
        check_parse("house/cellar", "house/cellar/relays/relay_1/set", set("relays", "relay_1"));
        check_parse("busker", "busker/bridge/request/read", Some(Incoming::Request { verb: "read" }));
        for topic in [
            "busker/relays/relay_1",
            "busker/relays/relay_1/outcome",
            "busker/relays/relay_1/set/now",
            "busker/relays/set",
            "busker/bridge/state",
            "busker/bridge/health/set",
            "busker2/relays/relay_1/set",
            "buskerrelays/relay_1/set",
            "relays/relay_1/set",
            "busker",
            "",
        ] {
            check_parse("busker", topic, None);
        }
    }

    /// Topics in every layout are understood as they are told.
    #[track_caller]
    fn check_layout(pattern: &str, state: &str, filter: &str) {
        let topics = laid_out("house/busker", pattern);
        let device = topics.of_device("plant", "boiler");
        assert_eq!(device.state("flow"), state);
        assert_eq!(topics.subscriptions()[0], filter);
        assert_eq!(outcome_of(&device.set("flow")), device.outcome("flow"));
        assert_eq!(
            topics.parse(&device.set("flow")),
            Some(Incoming::Set { device: "boiler", point: "flow" })
        );
        assert_eq!(
            topics.parse(&device.get("flow")),
            Some(Incoming::Get { device: "boiler", point: "flow" })
        );
        for (topic, expected) in [
            (device.state("flow"), Kind::Value),
            (device.json().to_string(), Kind::Value),
            (device.availability(), Kind::Availability),
            (device.info(), Kind::Info),
            (device.outcome("flow"), Kind::Other),
            (topics.bridge_state(), Kind::BridgeState),
            (topics.bridge_health(), Kind::Bridge),
            ("homeassistant/device/busker_boiler/config".to_string(), Kind::Other),
        ] {
            assert_eq!(topics.kind(&topic), expected, "{topic}");
            assert_eq!(topics.parse(&topic), None, "{topic}");
            let says_how_it_is = matches!(expected, Kind::Availability | Kind::Info);
            assert_eq!(Message::once(topic, "").says_how_a_device_is(), says_how_it_is, "{expected:?}");
        }
    }

    #[test]
    fn every_layout_is_understood_as_it_is_told() {
        check_layout("{base}/{device}/{point}", "house/busker/boiler/flow", "house/busker/+/+/set");
        check_layout(
            "{base}/{bus}/{device}/{point}",
            "house/busker/plant/boiler/flow",
            "house/busker/+/+/+/set",
        );
        check_layout(
            "{base}/modbus/{device}/values/{point}",
            "house/busker/modbus/boiler/values/flow",
            "house/busker/modbus/+/values/+/set",
        );
        check_layout(
            "{base}/{device}/{bus}/{point}",
            "house/busker/boiler/plant/flow",
            "house/busker/+/+/+/set",
        );
    }

    #[test]
    fn a_device_that_is_called_like_a_reserved_level_is_a_device() {
        let topics = Topics::new("busker");
        assert_eq!(topics.kind(topics.of_device("line", "info").json()), Kind::Value);
        assert_eq!(topics.kind(&topics.of_device("line", "set").state("get")), Kind::Value);
    }

    #[test]
    fn identities_hold_only_what_home_assistant_allows() {
        let topics = Topics::new("house/Cellar-2");
        assert_eq!(topics.identity("boiler"), "house__ellar_2_boiler");
        assert_eq!(Topics::new("busker").bridge_identity(), "busker_bridge");
        assert_eq!(Topics::new("busker").bus_identity("basement"), "busker_bus_basement");
        assert_eq!(discovery("homeassistant", "busker_boiler"), "homeassistant/device/busker_boiler/config");
    }
}
