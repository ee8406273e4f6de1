//! MQTT topic names, both ways, and the message that carries a payload to one.

/// The payload of a `state` or `availability` topic while all is well.
pub const ONLINE: &str = "online";
/// The payload of a `state` or `availability` topic otherwise; also the last will.
pub const OFFLINE: &str = "offline";

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

/// The topics of one gateway, all below its base topic.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Topics {
    base: String,
}

impl Topics {
    /// `base` is the configured base topic, `busker` or `house/cellar`, without a slash at its end.
    pub fn new(base: &str) -> Topics {
        Topics { base: base.to_string() }
    }

    pub fn base(&self) -> &str {
        &self.base
    }

    /// Retained; the last will.
    pub fn bridge_state(&self) -> String {
        format!("{}/bridge/state", self.base)
    }

    /// Retained.
    pub fn bridge_info(&self) -> String {
        format!("{}/bridge/info", self.base)
    }

    /// Retained.
    pub fn bridge_health(&self) -> String {
        format!("{}/bridge/health", self.base)
    }

    /// Retained.
    pub fn availability(&self, device: &str) -> String {
        format!("{}/{device}/availability", self.base)
    }

    /// Retained.
    pub fn info(&self, device: &str) -> String {
        format!("{}/{device}/info", self.base)
    }

    /// How the device is on its wire; retained, told each minute.
    pub fn health(&self, device: &str) -> String {
        format!("{}/{device}/health", self.base)
    }

    /// Where a point's value stands; retained.
    pub fn state(&self, device: &str, point: &str) -> String {
        format!("{}/{device}/{point}", self.base)
    }

    /// Where a wanted value is published by others.
    pub fn set(&self, device: &str, point: &str) -> String {
        format!("{}/{device}/{point}/set", self.base)
    }

    /// Where others ask for a reading.
    pub fn get(&self, device: &str, point: &str) -> String {
        format!("{}/{device}/{point}/get", self.base)
    }

    /// How a command ended; not retained.
    pub fn outcome(&self, device: &str, point: &str) -> String {
        format!("{}/{device}/{point}/outcome", self.base)
    }

    /// Where programs ask the gateway for something.
    pub fn request(&self, verb: &str) -> String {
        format!("{}/bridge/request/{verb}", self.base)
    }

    /// How a request ended; not retained.
    pub fn response(&self, verb: &str) -> String {
        format!("{}/bridge/response/{verb}", self.base)
    }

    /// The filters to subscribe to, so that everything [`Topics::parse`] knows arrives.
    pub fn subscriptions(&self) -> Vec<String> {
        ["+/+/set", "+/+/get", "bridge/request/+"]
            .iter()
            .map(|tail| format!("{}/{tail}", self.base))
            .collect()
    }

    /// What a message on `topic` asks for; `None` if it is none of our business.
    pub fn parse<'t>(&self, topic: &'t str) -> Option<Incoming<'t>> {
        let below = topic.strip_prefix(self.base.as_str())?.strip_prefix('/')?;
        let levels: Vec<&str> = below.split('/').collect();
        match levels[..] {
            ["bridge", "request", verb] if !verb.is_empty() => Some(Incoming::Request { verb }),
            ["bridge", ..] => None,
            [device, point, "set"] => Some(Incoming::Set { device, point }),
            [device, point, "get"] => Some(Incoming::Get { device, point }),
            _ => None,
        }
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

/// Where Home Assistant looks for the device called `identity`: `homeassistant/device/<id>/config`.
pub fn discovery(prefix: &str, identity: &str) -> String {
    format!("{prefix}/device/{identity}/config")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_parse(base: &str, topic: &str, expected: Option<Incoming>) {
        assert_eq!(Topics::new(base).parse(topic), expected, "{topic}");
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

    #[test]
    fn a_set_topic_is_understood_as_it_is_announced() {
        let topics = Topics::new("busker");
        let topic = topics.set("boiler", "flow");
        assert_eq!(topics.parse(&topic), Some(Incoming::Set { device: "boiler", point: "flow" }));
        let topic = topics.get("boiler", "flow");
        assert_eq!(topics.parse(&topic), Some(Incoming::Get { device: "boiler", point: "flow" }));
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
