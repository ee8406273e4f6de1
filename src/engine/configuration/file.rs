//! Exactly what a configuration file may say. What is true is in `settings`.
//!
//! A [`Part`] that cannot be read does not keep the rest from being checked.

use std::marker::PhantomData;

use serde_json::json;

use crate::engine::address::Span;
use crate::engine::configuration::words::{
    BaudRate, BrokerUrl, HostPort, Listen, Name, Part, Qos, StopBits, Token, Topic, Unit,
};
use crate::engine::device::{OutOfRange, Poll};
use crate::engine::profile::file::{Intervals, Point, Presentation, Thing, Wire};
use crate::engine::settings::{self, Layout, OnBrokerLoss, Parity};
use crate::engine::time::Duration;
use crate::engine::units::Release;
use crate::engine::value::Decimal;
use crate::engine::yaml::{At, Content, Definitions, Faults, Json, Map, Node, Place, Read, Scalar, record};

record! {
    /// The configuration of one gateway.
    pub struct Configuration {
        /// The broker.
        mqtt: Option<Part<Mqtt>>,
        /// How devices are announced to Home Assistant.
        home_assistant: Option<Part<HomeAssistant>>,
        /// The HTTP interface, which only tells; `null` turns it off.
        http: Option<Part<Http>> = Some(Part::of(Http::usual())),
        /// The folder in which the gateway remembers things between runs.
        state_dir: Part<At<String>> = Part::of(At::nowhere("/var/lib/busker".into())),
        /// An unchanged value is told again after this time.
        republish: Part<At<Duration>> = Part::of(At::nowhere(Duration::from_secs(600))),
        /// What happens while the broker cannot be reached: `keep` polls on, so that the watchdogs of
        /// devices stay fed; `stop_feeding` leaves devices with a watchdog alone, so that their outputs
        /// fall to the safe state.
        on_broker_loss: Part<OnBrokerLoss> = Part::of(OnBrokerLoss::Keep),
        /// How often what is kept in EEPROM may be written, for it wears out.
        eeprom: Option<Part<Eeprom>>,
        /// The flight recorder: what was last on the wire of each bus.
        recorder: Option<Part<Recorder>>,
        /// Folders with profiles beside the shipped ones; a profile there wins.
        profiles: Part<Vec<At<String>>> = Part::of(Vec::new()),
        /// Serial lines and TCP connections, by name.
        buses: Part<Map<Name, Bus>>,
        /// Devices by name; topics and identifiers are made of it.
        devices: Part<Map<Name, Device>> = Part::of(Map::default()),
    }
}

record! {
    /// The broker.
    pub struct Mqtt {
        /// Where it listens: `mqtt://host:1883`, with TLS `mqtts://host:8883`; through a websocket
        /// `ws://host:80/mqtt`, with TLS `wss://host:443/mqtt`. Port and path are these unless said.
        url: At<BrokerUrl> = At::nowhere(BrokerUrl::localhost()),
        username: Option<At<String>>,
        /// Better kept in a file of its own, see `password_file`. Where neither is given, the environment
        /// may hold it in `BUSKER_MQTT_PASSWORD`, else systemd in the credential `mqtt-password`.
        password: Option<At<String>>,
        /// A file whose first line is the password. A relative path is meant from where this file lies.
        password_file: Option<At<String>>,
        /// The first level of all topics; one per gateway where several share a broker.
        base_topic: At<Topic> = At::nowhere(Topic("busker".into())),
        /// Where the values of devices stand: the levels `{base}`, `{bus}`, `{device}` and `{point}`, and
        /// others as they are typed; `{base}` comes first and `{point}` last. `set`, `get` and `outcome` come
        /// behind it, `availability` and `info` in the place of `{point}`.
        topics: At<Layout> = At::nowhere(Layout::default()),
        /// The quality of service with which values are told: 1, each is sent until the broker has confirmed
        /// it, or 0, it is sent once.
        qos: At<Qos> = At::nowhere(Qos(1)),
        /// Whether the broker keeps the last value of each point for who comes later. Without, Home Assistant
        /// knows none after its start until they are told again, which is some seconds later.
        retain: bool = true,
        /// Whether each device tells all its values in one JSON message too, on the topic above its points.
        json: bool = false,
        /// Certificates, where the URL asks for TLS.
        tls: Option<Tls>,
        /// After this time without a message the broker is asked for a sign of life; after a second one
        /// without an answer it is lost.
        keep_alive: At<Duration> = At::nowhere(Duration::from_secs(15)),
    }
}

record! {
    /// Certificates for TLS, each a path to a file in the form PEM. A relative path is meant from where
    /// this file lies.
    pub struct Tls {
        /// The certificates of the authorities that may vouch for the broker; those of the system
        /// unless said.
        ca_file: Option<At<String>>,
        /// The certificate by which this gateway proves itself to the broker.
        cert_file: Option<At<String>>,
        /// The key that belongs to `cert_file`.
        key_file: Option<At<String>>,
    }
}

record! {
    /// How devices are announced to Home Assistant.
    pub struct HomeAssistant {
        /// Whether they are announced at all.
        discovery: bool = true,
        /// Home Assistant's discovery prefix.
        prefix: At<Topic> = At::nowhere(Topic("homeassistant".into())),
        /// Where Home Assistant says that it has started.
        status_topic: At<Topic> = At::nowhere(Topic("homeassistant/status".into())),
        /// The oldest Home Assistant that is to understand it, in quotes: `"2025.4"`. An older one knows fewer
        /// device classes, and takes ids under another name.
        minimum_version: At<Release> = At::nowhere(Release::USUAL),
        /// After this a sensor of which nothing was told is unavailable: for a broker that may end together with
        /// the gateway and comes back alone. At least three times `republish`; never unless said.
        expire_after: Option<At<Duration>>,
    }
}

record! {
    /// The HTTP interface, which only tells.
    pub struct Http {
        /// `host:port`; port 0 takes a free one, `null` turns HTTP off.
        listen: Option<Listen> = Http::usual().listen,
        /// What a reader must send as bearer token to see anything but `/health`. Better kept in a file of
        /// its own, see `token_file`.
        token: Option<At<Token>>,
        /// A file whose first line is the token. A relative path is meant from where this file lies.
        token_file: Option<At<String>>,
    }
}

impl Http {
    /// As it is when nothing is said of it.
    fn usual() -> Http {
        let listen = Listen(HostPort { host: "127.0.0.1".into(), port: 8485 });
        Http { place: Place::nowhere(), listen: Some(listen), token: None, token_file: None }
    }

    /// As it is under `http: null`.
    pub fn off() -> Http {
        Http { listen: None, ..Http::usual() }
    }
}

record! {
    /// How often what is kept in EEPROM may be written, for it wears out.
    pub struct Eeprom {
        /// A point not more than once in this time; a newer value waits. `0s`: at any time.
        interval: At<Duration> = At::nowhere(Duration::from_secs(60)),
        /// All points of a device together not more often in 24 hours; then commands are refused.
        daily: At<u16> = At::nowhere(500),
    }
}

record! {
    /// The flight recorder: what was last on the wire of each bus.
    pub struct Recorder {
        /// So many kilobytes are kept in memory for each bus; 0: nothing.
        kilobytes: At<u32> = At::nowhere(32),
        /// Whether they are saved when something goes wrong on the bus, and not only on request.
        on_error: bool = true,
        /// Then not more often than once in this time, and less often while it goes on going wrong.
        interval: At<Duration> = At::nowhere(Duration::from_secs(900)),
        /// So many files are kept of each bus; an older one goes.
        keep: At<u16> = At::nowhere(10),
    }
}

record! {
    /// One serial line or TCP connection: exactly one of `serial`, `tcp` and `rtu_over_tcp`.
    pub struct Bus {
        /// The path of a serial port that speaks Modbus RTU.
        serial: Option<Part<At<String>>>,
        /// `host:port` of a device or gateway that speaks Modbus TCP.
        tcp: Option<Part<At<HostPort>>>,
        /// `host:port` of a serial server that passes RTU frames through.
        rtu_over_tcp: Option<Part<At<HostPort>>>,
        /// Bits a second on the serial line; 19200 unless said.
        baud: Option<Part<At<BaudRate>>>,
        /// The parity on the serial line; even unless said.
        parity: Option<Part<At<Parity>>>,
        /// 1 unless said.
        stop_bits: Option<Part<At<StopBits>>>,
        /// How long a reply may take before the request counts as unanswered.
        response_timeout: Part<At<Duration>> = Part::of(At::nowhere(Duration::from_millis(500))),
        /// Silence before each request; 3.5 characters unless said.
        gap: Option<Part<At<Duration>>>,
        /// Who switches the RS485 transceiver of a serial port between sending and listening: `auto` leaves
        /// it to the adapter, or to the kernel where the device tree says so; `kernel` lets the kernel do it by
        /// RTS, with `{delay_before_send: 1ms}` after a time; `none` keeps the kernel from it.
        rs485: Option<Part<Rs485>>,
    }
}

/// Who switches a transceiver: `kernel`, or the longer form with its delays.
#[derive(Clone, Debug)]
pub enum Rs485 {
    Word(At<settings::Rs485>),
    Kernel(KernelRs485),
}

record! {
    /// The kernel switches the transceiver by the port's RTS.
    pub struct KernelRs485 {
        /// Whether RTS is on, and not off, while a frame is sent.
        rts_on_send: bool = true,
        /// From the switch to the first bit: up to 100ms, in whole milliseconds.
        delay_before_send: At<Duration> = At::nowhere(Duration::ZERO),
        /// From the last bit to the switch back: up to 100ms, in whole milliseconds.
        delay_after_send: At<Duration> = At::nowhere(Duration::ZERO),
    }
}

impl Read for Rs485 {
    fn read(node: &Node, faults: &mut Faults) -> Option<Rs485> {
        match node.content {
            Content::Map(_) => KernelRs485::read(node, faults).map(Rs485::Kernel),
            Content::Scalar { .. } | Content::List(_) => At::read(node, faults).map(Rs485::Word),
        }
    }

    fn schema(definitions: &mut Definitions) -> Json {
        let short = <settings::Rs485 as Scalar>::schema();
        json!({"anyOf": [short, KernelRs485::schema(definitions)]})
    }
}

record! {
    /// One device on one bus, with a profile or with points of its own.
    pub struct Device {
        /// The identifier of a profile, as `busker profiles list` tells them.
        profile: Option<At<String>>,
        /// The name of its bus.
        bus: Part<At<Name>>,
        /// Its address on the bus: 1 to 247, on Modbus TCP 0 to 255.
        unit: Part<At<Unit>>,
        /// What people call it.
        name: Option<String>,
        /// With a profile: wishes for its points, by their names. Without: the points themselves, in the
        /// form of a profile.
        points: Option<Points>,
        /// Without a profile: things made of several points, in the form of a profile.
        things: Option<Later<Map<String, Thing>>>,
        /// Without a profile: how the device behaves on the wire, in the form of a profile.
        wire: Option<Later<Wire>>,
        /// Without a profile: how the points look, in the form of a profile.
        home_assistant: Option<Later<Map<String, Presentation>>>,
        /// The periods of the poll classes.
        poll: Option<Part<Intervals>>,
        /// What the device's settings shall hold, by the names of its points. Compared on each connect;
        /// a difference is written once for each change of this section, a later one is reported.
        settings: Option<Part<Map<String, Setting>>>,
        /// Coils and holding registers that a `write` request on MQTT may write as they are, past the
        /// rules of the profile: `[holding 10..19]`. None unless said.
        raw_write: Part<Vec<Part<At<Span>>>> = Part::of(Vec::new()),
    }
}

/// What one setting shall hold: `30s`, or the longer form with `enforce`.
#[derive(Clone, Debug)]
pub struct Setting {
    pub value: At<SettingValue>,
    pub enforce: bool,
}

record! {
    /// A setting that may be enforced.
    pub struct LongSetting {
        /// What it shall hold.
        value: At<SettingValue>,
        /// Whether it is written again when the device holds something else later.
        enforce: bool = false,
    }
}

impl Read for Setting {
    fn read(node: &Node, faults: &mut Faults) -> Option<Setting> {
        match node.content {
            Content::Map(_) => LongSetting::read(node, faults)
                .map(|LongSetting { value, enforce, .. }| Setting { value, enforce }),
            Content::Scalar { .. } | Content::List(_) => {
                At::<SettingValue>::read(node, faults).map(|value| Setting { value, enforce: false })
            }
        }
    }

    fn schema(definitions: &mut Definitions) -> Json {
        let short = <SettingValue as Scalar>::schema();
        json!({"anyOf": [short, LongSetting::schema(definitions)]})
    }
}

/// A number in the point's unit, a duration, a name, `ON` or `OFF`; only the point knows which.
#[derive(Clone, Debug)]
pub struct SettingValue(pub String);

impl Scalar for SettingValue {
    const EXPECTED: &'static str =
        "a value like `30s`, `21.5` or `ON`, or a map like `{value: 30s, enforce: true}`";

    fn parse(text: &str) -> Result<SettingValue, String> {
        Ok(SettingValue(text.into()))
    }

    fn schema() -> Json {
        json!({"type": ["string", "number", "boolean"]})
    }
}

record! {
    /// Wishes for one point of a profile.
    pub struct PointWish {
        /// What the number means as the device is set up: one of the profile's `ranges`.
        range: Option<At<String>>,
        /// It is told only while each of these points has one of these values: what `range` was stated for.
        when: Map<Name, Vec<At<String>>> = Map::default(),
        /// The unit of a number of which the profile does not know it.
        unit: Option<At<String>>,
        /// A reading that differs less than this from the last one told is not told.
        deadband: Option<At<Decimal>>,
        /// When it is read.
        poll: Option<At<Poll>>,
        /// What becomes of a command with a number beyond the range.
        out_of_range: Option<At<OutOfRange>>,
    } and presentation: Presentation
}

/// What stands under a device's `points`: wishes or whole points, which only its `profile` decides.
#[derive(Clone, Debug)]
pub struct Points(pub Node);

impl Read for Points {
    fn read(node: &Node, _: &mut Faults) -> Option<Points> {
        Some(Points(node.clone()))
    }

    fn schema(definitions: &mut Definitions) -> Json {
        let either = [PointWish::schema(definitions), Point::schema(definitions)];
        json!({"type": "object", "additionalProperties": {"anyOf": either}})
    }
}

/// A `T` that is read when more is known.
#[derive(Clone, Debug)]
pub struct Later<T> {
    pub node: Node,
    shape: PhantomData<T>,
}

impl<T: Read> Read for Later<T> {
    fn read(node: &Node, _: &mut Faults) -> Option<Later<T>> {
        Some(Later { node: node.clone(), shape: PhantomData })
    }

    fn schema(definitions: &mut Definitions) -> Json {
        T::schema(definitions)
    }
}
