//! What a bus and its devices say of themselves: counters, states and reasons.

use std::collections::BTreeSet;

use serde_json::{Map, Value, json};

use crate::engine::modbus::{Discarded, RequestError};
use crate::engine::settings::Settings;
use crate::engine::time::{Duration, Time};

/// What happened on the wire, each error counted as what it was.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    pub requests: u64,
    pub answers: u64,
    pub timeouts: u64,
    pub checksum_errors: u64,
    pub wrong_frames: u64,
    pub exceptions: u64,
    pub late_replies: u64,
    pub foreign_frames: u64,
    pub echoes: u64,
    pub noise_bytes: u64,
    pub writes: u64,
    /// Writes to points in EEPROM, since the installation and not only since the start.
    pub persistent_writes: u64,
}

impl Counters {
    /// Each counter with its name, in JSON and in metrics.
    pub fn list(&self) -> [(&'static str, u64); 12] {
        [
            ("requests", self.requests),
            ("answers", self.answers),
            ("timeouts", self.timeouts),
            ("checksum_errors", self.checksum_errors),
            ("wrong_frames", self.wrong_frames),
            ("exceptions", self.exceptions),
            ("late_replies", self.late_replies),
            ("foreign_frames", self.foreign_frames),
            ("echoes", self.echoes),
            ("noise_bytes", self.noise_bytes),
            ("writes", self.writes),
            ("persistent_writes", self.persistent_writes),
        ]
    }

    /// Counts what was thrown away before a reply.
    pub fn count_discarded(&mut self, discarded: Discarded) {
        self.late_replies += u64::from(discarded.late_replies);
        self.foreign_frames += u64::from(discarded.foreign_frames);
        self.echoes += u64::from(discarded.echoes);
        self.noise_bytes += u64::from(discarded.noise_bytes);
        self.checksum_errors += u64::from(discarded.checksum_errors);
    }

    /// Counts how a request ended.
    pub fn count_result<T>(&mut self, result: &Result<T, RequestError>) {
        // It never reached the wire.
        if matches!(result, Err(RequestError::Impossible(_))) {
            return;
        }
        self.requests += 1;
        match result {
            Ok(_) => self.answers += 1,
            Err(RequestError::Exception(_)) => self.exceptions += 1,
            Err(RequestError::Timeout) => self.timeouts += 1,
            // Counted with what was thrown away.
            Err(RequestError::Checksum) => {}
            Err(RequestError::WrongFrame) => self.wrong_frames += 1,
            Err(RequestError::Link(_) | RequestError::Impossible(_)) => {}
        }
    }
}

/// A bus as it is now.
#[derive(Clone, Debug, PartialEq)]
pub struct BusReport {
    pub name: String,
    /// `serial /dev/ttyUSB0`, `tcp 192.168.1.20:502`
    pub link: String,
    pub up: bool,
    /// Why the link is down.
    pub reason: Option<String>,
    pub counters: Counters,
    /// The share of the last minute in which the wire was busy, 0 to 1.
    pub load: f64,
    pub devices: Vec<DeviceReport>,
}

/// A device as it is now.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviceReport {
    pub name: String,
    pub title: String,
    pub profile: String,
    pub unit: u8,
    pub online: bool,
    /// Why it is offline, or what is wrong with it although it answers.
    pub reason: Option<String>,
    /// What the device said of itself: `METZ CONNECT GmbH MR-DO4 V1.4`.
    pub identity: Option<String>,
    pub counters: Counters,
    pub last_answer_at: Option<Time>,
    pub points: Vec<PointReport>,
}

/// A point as it was last told.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PointReport {
    pub name: String,
    /// As published: `21.5`, `ON`, `None`.
    pub value: String,
    pub unit: Option<String>,
    /// Why it is `None`.
    pub reason: Option<String>,
    pub read_at: Option<Time>,
}

/// `bridge/info`: what the gateway is and what it was told to do, without secrets.
pub fn info_json(settings: &Settings) -> Value {
    let buses: Map<String, Value> =
        settings.buses.iter().map(|bus| (bus.name.clone(), bus.link.to_string().into())).collect();
    let devices: Map<String, Value> = settings
        .devices
        .iter()
        .map(|device| {
            let about = json!({
                "name": device.title,
                "profile": device.device.profile,
                "bus": settings.buses[device.bus].name,
                "unit": device.unit,
            });
            (device.name.clone(), about)
        })
        .collect();
    let profiles: BTreeSet<&str> =
        settings.devices.iter().map(|device| device.device.profile.as_str()).collect();
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "buses": buses,
        "devices": devices,
        "profiles": profiles,
    })
}

/// The whole gateway as it is now.
#[derive(Clone, Debug, PartialEq)]
pub struct GatewayReport {
    pub broker: BrokerReport,
    pub buses: Vec<BusHealth>,
}

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct BrokerReport {
    pub connected: bool,
    /// Why not.
    pub reason: Option<String>,
    /// How often the connection was made since the start.
    pub connects: u64,
    /// Messages told once that were dropped since too many waited.
    pub dropped: u64,
}

#[derive(Clone, Debug, PartialEq)]
pub struct BusHealth {
    /// The newest report there is.
    pub report: BusReport,
    /// Whether the bus has just answered for itself; a bus that does not is stuck.
    pub responding: bool,
}

impl BusHealth {
    /// Nothing on this bus can be reached. One dead device is no lost bus, even if it is the only one.
    fn is_lost(&self) -> bool {
        let devices = &self.report.devices;
        !self.report.up || (devices.len() > 1 && devices.iter().all(|device| !device.online))
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Status {
    Ok,
    /// Something does not answer; the rest works.
    Degraded,
    /// The broker or a whole bus is lost, or a bus is stuck.
    Lost,
}

impl Status {
    pub const fn name(self) -> &'static str {
        match self {
            Status::Ok => "ok",
            Status::Degraded => "degraded",
            Status::Lost => "lost",
        }
    }
}

impl GatewayReport {
    pub fn status(&self) -> Status {
        let mut devices = self.buses.iter().flat_map(|bus| &bus.report.devices);
        if !self.broker.connected || self.buses.iter().any(|bus| bus.is_lost() || !bus.responding) {
            Status::Lost
        } else if devices.any(|device| !device.online) {
            Status::Degraded
        } else {
            Status::Ok
        }
    }

    /// `bridge/health` and, with the broker, `GET /health`: the state of everything, by name.
    pub fn to_json(&self) -> Value {
        let buses: Map<String, Value> =
            self.buses.iter().map(|bus| (bus.report.name.clone(), bus_json(bus))).collect();
        let devices: Map<String, Value> = self
            .devices()
            .map(|(bus, device)| {
                let mut value = object(json!({
                    "online": device.online,
                    "reason": device.reason,
                    "bus": bus.name,
                    "unit": device.unit,
                }));
                value.extend(counters_json(&device.counters));
                (device.name.clone(), value.into())
            })
            .collect();
        json!({
            "status": self.status().name(),
            "broker": {
                "connected": self.broker.connected,
                "reason": self.broker.reason,
                "connects": self.broker.connects,
                "dropped": self.broker.dropped,
            },
            "buses": buses,
            "devices": devices,
        })
    }

    /// `GET /api/buses`: a list.
    pub fn buses_json(&self) -> Value {
        let named = |bus: &BusHealth| {
            let mut value = object(json!({"name": bus.report.name}));
            value.extend(object(bus_json(bus)));
            let devices: Vec<&str> = bus.report.devices.iter().map(|device| device.name.as_str()).collect();
            value.insert("devices".into(), devices.into());
            Value::Object(value)
        };
        self.buses.iter().map(named).collect()
    }

    /// `GET /api/devices`: a list, with the points as they were last told.
    pub fn devices_json(&self, now: Time) -> Value {
        self.devices()
            .map(|(bus, device)| {
                let points: Vec<Value> = device.points.iter().map(|point| point_json(point, now)).collect();
                json!({
                    "name": device.name,
                    "title": device.title,
                    "profile": device.profile,
                    "bus": bus.name,
                    "unit": device.unit,
                    "online": device.online,
                    "reason": device.reason,
                    "identity": device.identity,
                    "last_answer_seconds_ago": device.last_answer_at.map(|at| seconds(now - at)),
                    "counters": counters_json(&device.counters),
                    "points": points,
                })
            })
            .collect()
    }

    /// Every device with its bus.
    pub fn devices(&self) -> impl Iterator<Item = (&BusReport, &DeviceReport)> {
        self.buses.iter().flat_map(|bus| bus.report.devices.iter().map(|device| (&bus.report, device)))
    }
}

fn bus_json(bus: &BusHealth) -> Value {
    let report = &bus.report;
    let mut value = object(json!({
        "link": report.link,
        "up": report.up,
        "reason": report.reason,
        "responding": bus.responding,
        "load": (report.load * 1000.0).round() / 1000.0,
    }));
    value.extend(counters_json(&report.counters));
    value.into()
}

fn counters_json(counters: &Counters) -> Map<String, Value> {
    counters.list().into_iter().map(|(name, count)| (name.to_string(), count.into())).collect()
}

fn point_json(point: &PointReport, now: Time) -> Value {
    json!({
        "name": point.name,
        "value": point.value,
        "unit": point.unit,
        "reason": point.reason,
        "read_seconds_ago": point.read_at.map(|at| seconds(now - at)),
    })
}

/// With the digits that mean something.
fn seconds(duration: Duration) -> f64 {
    (duration.as_secs_f64() * 1000.0).round() / 1000.0
}

fn object(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn device(name: &str, online: bool) -> DeviceReport {
        DeviceReport {
            name: name.into(),
            title: name.into(),
            profile: "test".into(),
            unit: 1,
            online,
            reason: (!online).then(|| "no answer in time".into()),
            identity: None,
            counters: Counters { timeouts: 3, ..Counters::default() },
            last_answer_at: Some(Time::from_millis(1000)),
            points: vec![PointReport {
                name: "flow".into(),
                value: "21.5".into(),
                unit: Some("°C".into()),
                reason: None,
                read_at: Some(Time::from_millis(1500)),
            }],
        }
    }

    fn gateway(connected: bool, up: bool, responding: bool, online: &[bool]) -> GatewayReport {
        let devices = online.iter().enumerate().map(|(index, online)| device(&format!("d{index}"), *online));
        let report = BusReport {
            name: "cellar".into(),
            link: "tcp 127.0.0.1:502".into(),
            up,
            reason: None,
            counters: Counters::default(),
            load: 0.123_456,
            devices: devices.collect(),
        };
        let broker = BrokerReport { connected, ..BrokerReport::default() };
        GatewayReport { broker, buses: vec![BusHealth { report, responding }] }
    }

    #[test]
    fn the_gateway_is_lost_with_its_broker_or_a_bus_and_only_degraded_with_a_device() {
        for (connected, up, responding, online, expected) in [
            (true, true, true, &[true, true][..], Status::Ok),
            (true, true, true, &[true, false], Status::Degraded),
            (true, true, true, &[false], Status::Degraded),
            (true, true, true, &[false, false], Status::Lost),
            (false, true, true, &[true, true], Status::Lost),
            (true, false, true, &[true], Status::Lost),
            (true, true, false, &[true], Status::Lost),
            (true, true, true, &[], Status::Ok),
        ] {
            let report = gateway(connected, up, responding, online);
            assert_eq!(report.status(), expected, "{report:?}");
            assert_eq!(report.to_json()["status"], expected.name());
        }
    }

    #[test]
    fn reports_are_told_by_name_and_as_lists() {
        let report = gateway(true, true, true, &[false]);
        let health = report.to_json();
        assert_eq!(health["buses"]["cellar"]["load"], 0.123);
        assert_eq!(health["devices"]["d0"]["reason"], "no answer in time");
        assert_eq!(health["devices"]["d0"]["timeouts"], 3);
        assert_eq!(report.buses_json()[0]["name"], "cellar");
        assert_eq!(report.buses_json()[0]["devices"], json!(["d0"]));
        let device = &report.devices_json(Time::from_millis(2000))[0];
        assert_eq!(device["last_answer_seconds_ago"], 1.0);
        assert_eq!(device["points"][0]["value"], "21.5");
        assert_eq!(device["points"][0]["read_seconds_ago"], 0.5);
    }
}
