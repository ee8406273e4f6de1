//! MQTT topic names, both ways, and the message that carries a payload to one.

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
