//! The words of a configuration file: names, addresses, topics, and what else is one scalar.

use serde_json::json;

use crate::engine::profile::{NAME_BYTES_MAX, short_name};
use crate::engine::settings::{self, Direction, Layout, OnBrokerLoss, Parity, Rs485, TOPIC_PART_BYTES_MAX};
use crate::engine::units::Release;
use crate::engine::yaml::{Definitions, Faults, Json, Node, Read, Scalar, choices};

choices! { "a parity", Parity { "none" => Parity::None, "even" => Parity::Even, "odd" => Parity::Odd } }

choices! { "a rule for a lost broker", OnBrokerLoss {
    "keep" => OnBrokerLoss::Keep,
    "stop_feeding" => OnBrokerLoss::StopFeeding,
} }

choices! { "a way to switch an RS485 transceiver", Rs485 {
    "auto" => Rs485::Auto,
    "kernel" => Rs485::Kernel(Direction::default()),
    "none" => Rs485::None,
} }

/// The name of a device, a bus or a point.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Name(pub String);

impl Scalar for Name {
    const EXPECTED: &'static str = "a name like `heating_relays`";

    fn parse(text: &str) -> Result<Name, String> {
        let good = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
        if text.starts_with(|c: char| c.is_ascii_lowercase()) && text.chars().all(good) {
            return short_name(text).map(Name);
        }
        let right = match suggestion(text) {
            Some(suggestion) => format!("perhaps `{suggestion}`"),
            None => "as in `heating_relays`".into(),
        };
        Err(format!(
            "`{text}` cannot be a name; names are small letters, digits and `_`, and begin with a letter, {right}"
        ))
    }

    fn schema() -> Json {
        json!({"type": "string", "pattern": "^[a-z][a-z0-9_]*$", "maxLength": NAME_BYTES_MAX})
    }
}

/// `Heating-Relays 2` → `heating_relays_2`; `None` if little would be left.
fn suggestion(text: &str) -> Option<String> {
    let plain: String = text
        .chars()
        .flat_map(char::to_lowercase)
        .map(|c| if c.is_ascii_alphanumeric() { c } else { '_' })
        .collect();
    let plain = plain.trim_matches('_');
    plain.starts_with(|c: char| c.is_ascii_lowercase()).then(|| plain.to_string())
}

/// The address of a device on its bus, before it is known whether that is a serial line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Unit(pub u8);

impl Scalar for Unit {
    const EXPECTED: &'static str = "a unit, 1 to 247";

    fn parse(text: &str) -> Result<Unit, String> {
        match i128::parse(text)? {
            unit @ 0..=255 => Ok(Unit(unit as u8)),
            unit => Err(format!("{unit} is no unit; expected 1 to 247 (on Modbus TCP 0 to 255)")),
        }
    }

    fn schema() -> Json {
        json!({"type": "integer", "minimum": 0, "maximum": 255})
    }
}

/// Bits a second on a serial line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BaudRate(pub u32);

/// What serial adapters and devices offer. A rate beside them is rather a slip of the fingers.
pub const BAUD_RATES: [u32; 19] = [
    300, 600, 1200, 2400, 4800, 9600, 14400, 19200, 28800, 38400, 57600, 76800, 115_200, 125_000, 187_500,
    230_400, 250_000, 460_800, 921_600,
];

impl Scalar for BaudRate {
    const EXPECTED: &'static str = "a baud rate like 9600 or 19200";

    fn parse(text: &str) -> Result<BaudRate, String> {
        let found = i128::parse(text)?;
        if let Some(rate) = BAUD_RATES.into_iter().find(|rate| i128::from(*rate) == found) {
            return Ok(BaudRate(rate));
        }
        let nearest = BAUD_RATES.into_iter().min_by_key(|rate| i128::from(*rate).abs_diff(found));
        let nearest = nearest.unwrap_or_default();
        Err(format!("{found} is no usual baud rate; the nearest is {nearest}"))
    }

    fn schema() -> Json {
        json!({"enum": BAUD_RATES})
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StopBits(pub u8);

impl Scalar for StopBits {
    const EXPECTED: &'static str = "1 or 2";

    fn parse(text: &str) -> Result<StopBits, String> {
        match text {
            "1" => Ok(StopBits(1)),
            "2" => Ok(StopBits(2)),
            _ => Err(format!("`{text}` is no number of stop bits; expected 1 or 2")),
        }
    }

    fn schema() -> Json {
        json!({"enum": [1, 2]})
    }
}

impl Scalar for Release {
    const EXPECTED: &'static str = "a release of Home Assistant like `2025.11`";

    fn parse(text: &str) -> Result<Release, String> {
        let mut parts = text.split('.');
        let year = parts.next().and_then(|year| year.parse().ok()).filter(|year| (2000..2100).contains(year));
        let month =
            parts.next().and_then(|month| month.parse().ok()).filter(|month| (1..=12).contains(month));
        // `2025.4.4` is the fourth mending of 2025.4.
        let rest = parts.all(|part| !part.is_empty() && part.chars().all(|c| c.is_ascii_digit()));
        let (Some(year), Some(month), true) = (year, month, rest) else {
            return Err(format!("`{text}` is no release of Home Assistant; expected one like `2025.11`"));
        };
        let release = Release { year, month };
        if release < Release::OLDEST {
            let oldest = Release::OLDEST;
            return Err(format!("Home Assistant {release} is too old; expected {oldest} or a later one"));
        }
        Ok(release)
    }

    fn schema() -> Json {
        json!({"type": "string", "pattern": r"^20[0-9]{2}\.[0-9]{1,2}(\.[0-9]+)?$"})
    }
}

/// `host:port`; an IPv6 address stands in brackets, and is kept without them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HostPort {
    pub host: String,
    pub port: u16,
}

impl Scalar for HostPort {
    const EXPECTED: &'static str = "an address like `192.168.1.20:502`";

    fn parse(text: &str) -> Result<HostPort, String> {
        let example = "as in `192.168.1.20:502`";
        let Some((host, port)) = text.rsplit_once(':') else {
            return Err(format!("`{text}` has no port; expected host and port, {example}"));
        };
        let port = parse_port(port)?;
        match parse_host(host) {
            Some(host) => Ok(HostPort { host, port }),
            None => Err(format!("`{host}` is no host; expected host and port, {example}")),
        }
    }

    fn schema() -> Json {
        json!({"type": "string", "pattern": "^(\\[[0-9A-Fa-f:.]+\\]|[A-Za-z0-9._-]+):[0-9]+$"})
    }
}

/// Where HTTP listens.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listen(pub HostPort);

impl Scalar for Listen {
    const EXPECTED: &'static str = "an address like `127.0.0.1:8485`";

    fn parse(text: &str) -> Result<Listen, String> {
        if ["off", "no", "false", "none"].contains(&text) {
            return Err(format!("`{text}` is no address; to turn HTTP off, write `listen: null`"));
        }
        HostPort::parse(text).map(Listen)
    }

    fn schema() -> Json {
        <HostPort as Scalar>::schema()
    }
}

/// What stands behind `Authorization: Bearer`.
#[derive(Clone)]
pub struct Token(pub String);

impl std::fmt::Debug for Token {
    /// It is a secret.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Token(…)")
    }
}

impl Scalar for Token {
    const EXPECTED: &'static str = "a token of letters and digits";

    fn parse(text: &str) -> Result<Token, String> {
        // No message repeats it.
        match settings::is_token(text) {
            true => Ok(Token(text.into())),
            false => Err(format!("this cannot be a token; expected {}", settings::TOKEN_FORM)),
        }
    }

    fn schema() -> Json {
        json!({"type": "string", "pattern": "^[A-Za-z0-9._~+/-]+=*$"})
    }
}

fn parse_port(text: &str) -> Result<u16, String> {
    let digits = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let port = if digits { text.parse().ok() } else { None };
    port.ok_or_else(|| format!("`{text}` is no port; expected a number up to 65535"))
}

/// A name, an IPv4 address, or an IPv6 address in brackets, which are taken off.
fn parse_host(text: &str) -> Option<String> {
    if let Some(inside) = text.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
        let address = inside.split('%').next().unwrap_or_default();
        return address.parse::<core::net::Ipv6Addr>().ok().map(|_| inside.to_string());
    }
    let good = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_');
    (!text.is_empty() && text.chars().all(good)).then(|| text.to_string())
}

/// `mqtt://host:port`, `mqtts://host:port`, `ws://host:port/path` or `wss://host:port/path`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BrokerUrl {
    pub host: String,
    pub port: u16,
    pub tls: bool,
    /// The path of a websocket.
    pub websocket: Option<String>,
}

impl BrokerUrl {
    pub fn localhost() -> BrokerUrl {
        BrokerUrl { host: "localhost".into(), port: 1883, tls: false, websocket: None }
    }
}

impl Scalar for BrokerUrl {
    const EXPECTED: &'static str = "a URL like `mqtt://localhost:1883` or `mqtts://broker.example:8883`";

    fn parse(text: &str) -> Result<BrokerUrl, String> {
        // Before anything that would repeat the text: there is a password in it.
        if text.contains('@') {
            return Err("a user stands in the URL; use the keys `username` and `password_file`".into());
        }
        if text.contains('?') {
            return Err("a query stands in the URL; expected nothing behind the path".into());
        }
        let expected = Self::EXPECTED;
        let Some((scheme, rest)) = text.split_once("://") else {
            return Err(format!("`{text}` is no URL; expected {expected}"));
        };
        let (usual_port, tls, is_websocket) = match scheme {
            "mqtt" => (1883, false, false),
            "mqtts" => (8883, true, false),
            "ws" => (80, false, true),
            "wss" => (443, true, true),
            _ => {
                return Err(format!(
                    "`{scheme}` is no way to a broker; expected one of `mqtt`, `mqtts` (TLS), `ws` (websocket) \
                     and `wss` (websocket with TLS)"
                ));
            }
        };
        let (address, path) = match rest.find('/') {
            Some(slash) => rest.split_at(slash),
            None => (rest, ""),
        };
        let websocket = match (is_websocket, path) {
            (false, "" | "/") => None,
            (false, _) => {
                return Err(format!("`{path}` leads nowhere: only a websocket (`ws`, `wss`) has a path"));
            }
            // What brokers listen on, where they care.
            (true, "") => Some("/mqtt".to_string()),
            (true, path)
                if path.bytes().all(|byte| byte.is_ascii_graphic() && !b"?#\"<>".contains(&byte)) =>
            {
                Some(path.to_string())
            }
            (true, _) => return Err(format!("`{path}` is no path; expected one like `/mqtt`")),
        };
        let ends_in_host = address.ends_with(']') || !address.contains(':');
        let (host, port) = match address.rsplit_once(':') {
            Some((host, port)) if !ends_in_host => (host, parse_port(port)?),
            _ => (address, usual_port),
        };
        match parse_host(host) {
            Some(_) if port == 0 => Err(format!("port 0 in `{text}`; expected {expected}")),
            Some(host) => Ok(BrokerUrl { host, port, tls, websocket }),
            None => Err(format!("`{host}` is no host; expected {expected}")),
        }
    }

    fn schema() -> Json {
        json!({"type": "string", "pattern": "^(mqtts?://[^@/]+/?|wss?://[^@/]+(/[^@?#]*)?)$"})
    }
}

/// A topic, or the beginning of topics.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Topic(pub String);

impl Scalar for Topic {
    const EXPECTED: &'static str = "a topic like `busker`";

    fn parse(text: &str) -> Result<Topic, String> {
        let why = if text.contains(['+', '#']) {
            "`+` and `#` are wildcards"
        } else if text.starts_with('$') {
            "topics that begin with `$` belong to the broker"
        } else if text.split('/').any(str::is_empty) {
            "a level of it is empty"
        } else if text.chars().any(|c| c.is_control() || c.is_whitespace()) {
            "there is a space in it"
        } else if text.len() > TOPIC_PART_BYTES_MAX {
            return Err(format!("a topic of {} bytes; expected at most {TOPIC_PART_BYTES_MAX}", text.len()));
        } else {
            return Ok(Topic(text.into()));
        };
        Err(format!("`{text}` cannot be a topic: {why}; expected one like `busker` or `house/busker`"))
    }

    fn schema() -> Json {
        json!({"type": "string", "pattern": "^[^$+#/\\s][^+#/\\s]*(/[^+#/\\s]+)*$", "maxLength": TOPIC_PART_BYTES_MAX})
    }
}

impl Scalar for Layout {
    const EXPECTED: &'static str = "a layout like `\"{base}/{device}/{point}\"`";

    fn parse(text: &str) -> Result<Layout, String> {
        Layout::parse(text).map_err(|why| {
            format!(
                "`{text}` cannot be a layout of topics: {why}; expected one like `{{base}}/{{device}}/{{point}}` or \
                 `{{base}}/{{bus}}/{{device}}/{{point}}`"
            )
        })
    }

    fn schema() -> Json {
        json!({"type": "string", "pattern": "^\\{base\\}/(([^{}+#/\\s]+|\\{(bus|device)\\})/)+\\{point\\}$", "maxLength": TOPIC_PART_BYTES_MAX})
    }
}

/// A quality of service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Qos(pub u8);

impl Scalar for Qos {
    const EXPECTED: &'static str = "0 or 1";

    fn parse(text: &str) -> Result<Qos, String> {
        match text {
            "0" => Ok(Qos(0)),
            "1" => Ok(Qos(1)),
            "2" => Err("2 would tell no value better: each replaces the one before; expected 0 or 1".into()),
            _ => Err(format!("`{text}` is no quality of service; expected 0 or 1")),
        }
    }

    fn schema() -> Json {
        json!({"enum": [0, 1]})
    }
}

/// Something that may be unreadable: its faults are noted, and the rest of the file goes on.
#[derive(Clone, Debug)]
pub struct Part<T>(Option<T>);

impl<T> Part<T> {
    pub fn of(value: T) -> Part<T> {
        Part(Some(value))
    }

    /// What was read; `None` if that is known to be faulty.
    pub fn get(&self) -> Option<&T> {
        self.0.as_ref()
    }
}

impl<T: Read> Read for Part<T> {
    fn read(node: &Node, faults: &mut Faults) -> Option<Part<T>> {
        Some(Part(T::read(node, faults)))
    }

    fn schema(definitions: &mut Definitions) -> Json {
        T::schema(definitions)
    }
}
