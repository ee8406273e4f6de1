//! The broker as its owner wants it: how it is reached, and what is told there in which way.

use std::fmt;
use std::path::PathBuf;

use super::{Password, host_and_port};
use crate::engine::time::Duration;

#[derive(Clone, PartialEq, Eq)]
pub struct Mqtt {
    pub host: String,
    pub port: u16,
    /// Where MQTT travels in a websocket, the path of its URL.
    pub websocket: Option<String>,
    /// `None`: not encrypted.
    pub tls: Option<Tls>,
    /// After this time without a message the broker is asked for a sign of life; a second one without
    /// an answer is the end of the connection.
    pub keep_alive: Duration,
    pub username: Option<String>,
    pub password: Password,
    /// One per gateway where several share a broker.
    pub base_topic: String,
    /// Where what is told of devices stands below the base topic.
    pub topics: Layout,
    /// How values are told.
    pub values: Manner,
    /// Whether each device tells all its values in one message too.
    pub json: bool,
}

impl Default for Mqtt {
    /// A broker on this machine that lets everybody in.
    fn default() -> Mqtt {
        Mqtt {
            host: "localhost".into(),
            port: 1883,
            websocket: None,
            tls: None,
            keep_alive: Duration::from_secs(15),
            username: None,
            password: Password::None,
            base_topic: "busker".into(),
            topics: Layout::default(),
            values: Manner::default(),
            json: false,
        }
    }
}

impl Mqtt {
    /// Where the broker is: `localhost:1883`.
    pub fn address(&self) -> String {
        host_and_port(&self.host, self.port)
    }

    /// Whether the same connection serves both, whatever is told on it and in which way.
    pub fn is_reached_as(&self, other: &Mqtt) -> bool {
        let Mqtt { topics, values, json, .. } = other.clone();
        Mqtt { topics, values, json, ..self.clone() } == *other
    }
}

impl fmt::Debug for Mqtt {
    /// Tells everything but the password.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Mqtt({}, base topic {})", self.address(), self.base_topic)
    }
}

/// How the broker proves itself, and how we do; the edge reads the files.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Tls {
    /// The only authorities that are trusted; `None`: those of the system.
    pub ca_file: Option<PathBuf>,
    pub client: Option<ClientCertificate>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ClientCertificate {
    pub cert_file: PathBuf,
    pub key_file: PathBuf,
}

/// How a message is told.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Manner {
    /// Sent until the broker has confirmed it (quality of service 1), or once (0).
    pub confirmed: bool,
    /// Whether the broker shall keep it for who comes later.
    pub retain: bool,
}

impl Default for Manner {
    fn default() -> Manner {
        Manner { confirmed: true, retain: true }
    }
}

/// Where what is told of a device stands: the levels between the base topic and the point.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layout {
    /// [`Level::Device`] is one of them, once.
    pub levels: Vec<Level>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Level {
    Device,
    Bus,
    Fixed(String),
}

impl Default for Layout {
    /// `{base}/{device}/{point}`
    fn default() -> Layout {
        Layout { levels: vec![Level::Device] }
    }
}

/// Of a topic in the configuration, and of a layout. A base topic and a layout together, with the longest names in
/// their places, are still short enough to be understood as the topic of a command.
pub const TOPIC_PART_BYTES_MAX: usize = 255;

impl Layout {
    /// Reads `{base}/{bus}/{device}/{point}`; an error says why it cannot be a layout.
    pub fn parse(text: &str) -> Result<Layout, String> {
        if text.len() > TOPIC_PART_BYTES_MAX {
            return Err(format!("it has {} bytes, more than {TOPIC_PART_BYTES_MAX}", text.len()));
        }
        let texts: Vec<&str> = text.split('/').collect();
        let inner = match texts[..] {
            ["{base}", ref inner @ .., "{point}"] => inner,
            ["{base}", ..] => return Err("it does not end with the level `{point}`".into()),
            _ => return Err("it does not begin with the level `{base}`".into()),
        };
        let levels = inner.iter().map(|level| Layout::level(level)).collect::<Result<Vec<_>, _>>()?;
        for (level, name) in [(Level::Device, "device"), (Level::Bus, "bus")] {
            if levels.iter().filter(|other| **other == level).count() > 1 {
                return Err(format!("`{{{name}}}` stands in it twice"));
            }
        }
        if !levels.contains(&Level::Device) {
            return Err("without `{device}` two devices would share their topics".into());
        }
        if levels[0] == Level::Fixed("bridge".into()) {
            return Err("below `{base}/bridge` the gateway tells of itself".into());
        }
        Ok(Layout { levels })
    }

    fn level(text: &str) -> Result<Level, String> {
        match text {
            "{device}" => Ok(Level::Device),
            "{bus}" => Ok(Level::Bus),
            "{base}" | "{point}" => Err(format!("`{text}` stands in it twice")),
            "" => Err("a level of it is empty".into()),
            _ if text.contains(['{', '}']) => Err(format!(
                "`{text}` is none of the levels `{{base}}`, `{{bus}}`, `{{device}}` and `{{point}}`"
            )),
            _ if text.contains(['+', '#']) => Err("`+` and `#` are wildcards".into()),
            _ if text.chars().any(|c| c.is_control() || c.is_whitespace()) => {
                Err("there is a space in it".into())
            }
            _ => Ok(Level::Fixed(text.into())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn check(text: &str, expected: Result<&[Level], &str>) {
        let found = Layout::parse(text);
        match (&found, expected) {
            (Ok(layout), Ok(levels)) => assert_eq!(layout.levels, levels, "{text}"),
            (Err(found), Err(part)) => assert!(found.contains(part), "{text}: {found}"),
            _ => panic!("{text}: {found:?}"),
        }
    }

    #[test]
    fn a_layout_says_where_each_device_stands_and_leaves_the_gateway_its_place() {
        let fixed = |text: &str| Level::Fixed(text.into());
        check("{base}/{device}/{point}", Ok(&[Level::Device]));
        check("{base}/{bus}/{device}/{point}", Ok(&[Level::Bus, Level::Device]));
        check("{base}/house/{device}/bridge/{point}", Ok(&[fixed("house"), Level::Device, fixed("bridge")]));
        for (text, why) in [
            ("", "does not begin"),
            ("busker/{device}/{point}", "does not begin"),
            ("{base}", "does not end"),
            ("{base}/{point}/{device}", "does not end"),
            ("{base}/{device}/{point}/state", "does not end"),
            ("{base}/{point}", "without `{device}`"),
            ("{base}/{bus}/{point}", "without `{device}`"),
            ("{base}/{device}/{device}/{point}", "`{device}` stands in it twice"),
            ("{base}/{bus}/{device}/{bus}/{point}", "`{bus}` stands in it twice"),
            ("{base}/{point}/{device}/{point}", "`{point}` stands in it twice"),
            ("{base}/bridge/{device}/{point}", "tells of itself"),
            ("{base}//{device}/{point}", "empty"),
            ("{base}/+/{device}/{point}", "wildcards"),
            ("{base}/a b/{device}/{point}", "space"),
            ("{base}/{unit}/{device}/{point}", "`{unit}` is none of the levels"),
            ("{base}/x_{device}/{point}", "`x_{device}` is none of the levels"),
        ] {
            check(text, Err(why));
        }
    }
}
