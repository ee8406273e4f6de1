//! What the owner wants: broker, buses, devices. Resolved and checked; the file's shape is
//! `configuration::file`.

mod mqtt;
mod units;

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::engine::address::Span;
use crate::engine::device::{Device, PointIndex};
use crate::engine::time::Duration;
use crate::engine::units::Release;

pub use self::mqtt::{ClientCertificate, Layout, Level, Manner, Mqtt, TOPIC_PART_BYTES_MAX, Tls};
pub use self::units::{UNIT_OF_LINE_MAX, units};

#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    pub mqtt: Mqtt,
    pub home_assistant: HomeAssistant,
    pub http: Http,
    pub state_dir: PathBuf,
    /// An unchanged value is told again after this.
    pub republish: Duration,
    pub on_broker_loss: OnBrokerLoss,
    pub eeprom: Eeprom,
    pub recorder: Recorder,
    pub buses: Vec<Bus>,
    pub devices: Vec<DeviceSettings>,
}

/// What holds for every bus, and may change while it goes on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rules {
    pub republish: Duration,
    pub on_broker_loss: OnBrokerLoss,
    pub eeprom: Eeprom,
    pub recorder: Recorder,
}

impl Settings {
    pub fn rules(&self) -> Rules {
        Rules {
            republish: self.republish,
            on_broker_loss: self.on_broker_loss,
            eeprom: self.eeprom,
            recorder: self.recorder,
        }
    }

    /// Takes relative paths of secrets and certificates from `folder`, in which the configuration lies.
    pub fn resolve_files(&mut self, folder: &Path) {
        let resolve = |path: &mut PathBuf| *path = folder.join(&*path);
        for secret in [&mut self.mqtt.password, &mut self.http.token] {
            if let Password::File(path) = secret {
                resolve(path);
            }
        }
        if let Some(tls) = &mut self.mqtt.tls {
            tls.ca_file.as_mut().map(resolve);
            if let Some(client) = &mut tls.client {
                resolve(&mut client.cert_file);
                resolve(&mut client.key_file);
            }
        }
    }
}

/// Where the broker's password, or HTTP's token, comes from; the edge reads the file.
#[derive(Clone, PartialEq, Eq)]
pub enum Password {
    None,
    Given(String),
    File(PathBuf),
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HomeAssistant {
    pub discovery: bool,
    /// `homeassistant`
    pub prefix: String,
    /// `homeassistant/status`
    pub status_topic: String,
    /// The oldest that must understand what it is told.
    pub minimum_version: Release,
    /// After this an entity of which nothing is told is unavailable; `None`: never.
    pub expire_after: Option<Duration>,
}

#[derive(Clone, PartialEq, Eq)]
pub struct Http {
    /// `host:port`; `None`: no HTTP.
    pub listen: Option<String>,
    /// Who asks for anything but `/health` must know it.
    pub token: Password,
}

impl fmt::Debug for Http {
    /// Tells everything but the token.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Http({:?})", self.listen)
    }
}

/// What a token is made of, for messages.
pub const TOKEN_FORM: &str = "letters, digits and `-._~+/`, of which `openssl rand -hex 16` makes a good one";

/// Whether it can stand behind `Authorization: Bearer` (RFC 6750, section 2.1).
pub fn is_token(text: &str) -> bool {
    let body = text.trim_end_matches('=');
    let good = |byte: u8| byte.is_ascii_alphanumeric() || b"-._~+/".contains(&byte);
    !body.is_empty() && body.bytes().all(good)
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OnBrokerLoss {
    /// Go on polling, so that devices' watchdogs stay fed.
    Keep,
    /// Stop talking to devices that have a watchdog, so that their outputs fall to the safe state.
    StopFeeding,
}

/// How often what wears out may be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Eeprom {
    /// A point not more than once in this time.
    pub interval: Duration,
    /// All points of a device together not more often in 24 hours.
    pub daily: u32,
}

/// What is kept of what was last on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Recorder {
    /// Of each bus, in memory; 0: nothing.
    pub bytes: usize,
    /// The shortest time between two files that are saved because something went wrong; `None`: none
    /// is.
    pub on_error: Option<Duration>,
    /// So many files of each bus; an older one goes.
    pub keep: usize,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Bus {
    pub name: String,
    pub link: Link,
    /// How long a reply may be late before the request counts as unanswered.
    pub response_timeout: Duration,
    /// Silence before each request; `None`: 3.5 characters, 1.75 ms above 19200 baud.
    pub gap: Option<Duration>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Link {
    /// Modbus RTU on a serial port.
    Serial { path: String, line: Line, rs485: Rs485 },
    /// Modbus TCP.
    Tcp { host: String, port: u16 },
    /// RTU frames over a TCP connection to a serial server, whose line runs at `line`.
    RtuOverTcp { host: String, port: u16, line: Line },
}

impl Link {
    /// The characters on the serial line, where there is one.
    pub const fn line(&self) -> Option<Line> {
        match self {
            Link::Serial { line, .. } | Link::RtuOverTcp { line, .. } => Some(*line),
            Link::Tcp { .. } => None,
        }
    }

    /// Where it is: `/dev/ttyUSB0`, `192.168.1.20:502`, `[::1]:502`.
    pub fn address(&self) -> String {
        match self {
            Link::Serial { path, .. } => path.clone(),
            Link::Tcp { host, port } | Link::RtuOverTcp { host, port, .. } => host_and_port(host, *port),
        }
    }
}

/// `192.168.1.20:502`; an address of version 6 stands in brackets.
pub fn host_and_port(host: &str, port: u16) -> String {
    if host.contains(':') { format!("[{host}]:{port}") } else { format!("{host}:{port}") }
}

impl fmt::Display for Link {
    /// `serial /dev/ttyUSB0`, `tcp 192.168.1.20:502`, `rtu over tcp 192.168.1.21:4196`
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kind = match self {
            Link::Serial { .. } => "serial",
            Link::Tcp { .. } => "tcp",
            Link::RtuOverTcp { .. } => "rtu over tcp",
        };
        write!(f, "{kind} {}", self.address())
    }
}

/// The characters on a serial line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Line {
    /// Bits a second.
    pub baud: u32,
    pub parity: Parity,
    /// 1 or 2.
    pub stop_bits: u8,
}

impl Line {
    /// Start bit, eight data bits, parity, stop bits: 10 to 12.
    pub const fn bits_per_character(self) -> u32 {
        let parity = match self.parity {
            Parity::None => 0,
            Parity::Even | Parity::Odd => 1,
        };
        9 + parity + self.stop_bits as u32
    }

    /// How long `count` characters take on the wire.
    pub fn characters(self, count: u32) -> Duration {
        let nanos = u64::from(count) * u64::from(self.bits_per_character()) * 1_000_000_000;
        Duration::from_nanos(nanos / u64::from(self.baud))
    }

    /// How long a byte's stop bits last after it has been handed over at the latest: a receiver reports it
    /// in the middle of the first one. Who sends before is heard at the same time as the sender.
    pub fn stop(self) -> Duration {
        self.characters(self.stop_bits.into()) / self.bits_per_character()
    }

    /// The silence between two frames: 3.5 characters, and 1.75 ms above 19200 baud (Modbus over
    /// serial line specification V1.02, 2.5.1.1).
    pub fn frame_gap(self) -> Duration {
        if self.baud > 19_200 {
            return Duration::from_micros(1750);
        }
        self.characters(7) / 2
    }
}

impl fmt::Display for Line {
    /// `19200 8E1`
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let parity = match self.parity {
            Parity::None => 'N',
            Parity::Even => 'E',
            Parity::Odd => 'O',
        };
        write!(f, "{} 8{parity}{}", self.baud, self.stop_bits)
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Parity {
    None,
    Even,
    Odd,
}

impl fmt::Display for Parity {
    /// As people write it: `even`
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Parity::None => "none",
            Parity::Even => "even",
            Parity::Odd => "odd",
        })
    }
}

/// Who switches an RS485 transceiver between sending and listening.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Rs485 {
    /// Whoever does it already: most adapters by themselves, the kernel where the device tree says so.
    #[default]
    Auto,
    /// The kernel, by the port's RTS.
    Kernel(Direction),
    /// Not the kernel, even if the device tree says so.
    None,
}

impl Rs485 {
    /// How long a frame waits between the write and its first bit.
    pub const fn delay_before_send(self) -> Duration {
        match self {
            Rs485::Kernel(direction) => direction.delay_before_send,
            Rs485::Auto | Rs485::None => Duration::ZERO,
        }
    }
}

/// How RTS switches the transceiver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Direction {
    /// Whether RTS is on, and not off, while a frame is sent.
    pub rts_on_send: bool,
    /// From the switch to the first bit, in whole milliseconds as the kernel counts them.
    pub delay_before_send: Duration,
    /// From the last bit to the switch back.
    pub delay_after_send: Duration,
}

impl Direction {
    /// The kernel allows no longer delay.
    pub const DELAY_MAX: Duration = Duration::from_millis(100);
}

impl Default for Direction {
    fn default() -> Direction {
        Direction { rts_on_send: true, delay_before_send: Duration::ZERO, delay_after_send: Duration::ZERO }
    }
}

/// One device on one bus.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviceSettings {
    /// The key in the configuration: topics and identifiers are made of it.
    pub name: String,
    /// What people call it.
    pub title: String,
    /// Index into [`Settings::buses`].
    pub bus: usize,
    pub unit: u8,
    /// The profile with this device's own wishes applied; the same one for all that wish the same.
    pub device: Arc<Device>,
    /// What its settings shall hold, in the file's order; each point once.
    pub wanted: Vec<Wanted>,
    /// What a `write` request may write as it is, past the profile's rules.
    pub raw_write: Vec<Span>,
}

/// A setting of a device, as its owner wants it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Wanted {
    pub point: PointIndex,
    /// As it was typed: `30s`, `ON`, `automatic`. What it means may depend on what the device holds.
    pub value: String,
    /// Whether it is written again when the device holds something else later.
    pub enforce: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_is_told_with_an_address_that_can_be_typed() {
        let line = Line { baud: 9600, parity: Parity::None, stop_bits: 1 };
        for (link, told) in [
            (Link::Serial { path: "/dev/ttyUSB0".into(), line, rs485: Rs485::Auto }, "serial /dev/ttyUSB0"),
            (Link::Tcp { host: "plc.local".into(), port: 502 }, "tcp plc.local:502"),
            (Link::Tcp { host: "fe80::1%eth0".into(), port: 502 }, "tcp [fe80::1%eth0]:502"),
            (Link::RtuOverTcp { host: "::1".into(), port: 4196, line }, "rtu over tcp [::1]:4196"),
        ] {
            assert_eq!(link.to_string(), told);
        }
    }
}
