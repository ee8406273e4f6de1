//! The reports as JSON, for HTTP and MQTT.

use std::collections::BTreeSet;

use serde_json::{Map, Value, json};

use super::{
    BusHealth, Counters, DeviceReport, Drift, GatewayReport, Percentiles, PeriodReport, PointReport,
    ThingReport, TimingReport,
};
use crate::engine::settings::Settings;
use crate::engine::time::{Duration, Time};

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
        "paused": {},
        "configuration": {"error": null},
    })
}

impl GatewayReport {
    /// `bridge/health` and, with the broker, `GET /health`: the state of everything, by name.
    pub fn to_json(&self) -> Value {
        let buses: Map<String, Value> =
            self.buses.iter().map(|bus| (bus.report.name.clone(), bus_json(bus))).collect();
        let devices: Map<String, Value> = self
            .devices()
            .map(|(bus, device)| (device.name.clone(), device.health_json(&bus.name)))
            .collect();
        let mut value = object(self.summary_json());
        value.insert("buses".into(), buses.into());
        value.insert("devices".into(), devices.into());
        value.into()
    }

    /// The gateway in one line, and its broker.
    pub fn summary_json(&self) -> Value {
        json!({
            "status": self.status().name(),
            "broker": {
                "connected": self.broker.connected,
                "reason": self.broker.reason,
                "connects": self.broker.connects,
                "client_id_taken": self.broker.client_id_taken,
                "state_denied": self.broker.state_denied,
                "kept_back": self.broker.kept_back,
                "not_arriving": self.broker.not_arriving,
                "announced_by_others": self.broker.announced_by_others,
                "waiting": self.broker.waiting,
                "dropped": self.broker.dropped,
            },
            "configuration": {"error": self.configuration_error},
        })
    }

    /// `bridge/info`, with what may change while the settings do not.
    pub fn info_json(&self, settings: &Settings) -> Value {
        let paused: Map<String, Value> = self
            .buses
            .iter()
            .filter(|bus| bus.report.paused)
            .map(|bus| (bus.report.name.clone(), bus.report.reason.clone().into()))
            .collect();
        let mut info = info_json(settings);
        info["paused"] = paused.into();
        info["configuration"] = json!({"error": self.configuration_error});
        info
    }

    /// `GET /api/buses`: a list.
    pub fn buses_json(&self) -> Value {
        self.buses.iter().map(BusHealth::named_json).collect()
    }

    /// `GET /api/devices`: a list, with the points as they were last told.
    pub fn devices_json(&self, now: Time) -> Value {
        let of_bus = |bus: &BusHealth| -> Vec<Value> {
            let with_points = |device: &DeviceReport| {
                let mut value = object(device_json(bus, device, now));
                let points = device.points.iter().map(|point| point_json(point, now, bus.responding));
                value.insert("points".into(), points.collect());
                value.into()
            };
            bus.report.devices.iter().map(with_points).collect()
        };
        self.buses.iter().flat_map(of_bus).collect()
    }
}

impl DeviceReport {
    /// How it is on its wire.
    pub fn health_json(&self, bus: &str) -> Value {
        let mut value = object(json!({
            "online": self.online,
            "reason": self.reason,
            "bus": bus,
            "unit": self.unit,
            "load": share(self.load),
            "periods": periods_json(&self.periods),
        }));
        value.extend(counters_json(&self.counters));
        value.insert("exceptions_by_code".into(), codes_json(&self.counters));
        value.extend(times_json(&self.timing, false));
        value.into()
    }
}

impl BusHealth {
    /// One entry of `GET /api/buses`.
    pub fn named_json(&self) -> Value {
        let mut value = object(json!({"name": self.report.name}));
        value.extend(object(bus_json(self)));
        let devices: Vec<&str> = self.report.devices.iter().map(|device| device.name.as_str()).collect();
        value.insert("devices".into(), devices.into());
        value.into()
    }
}

fn bus_json(bus: &BusHealth) -> Value {
    let report = &bus.report;
    let mut value = object(json!({
        "link": report.link,
        "line": report.line,
        "up": report.up,
        "reason": report.reason,
        "paused": report.paused,
        "responding": bus.responding,
        "load": share(report.load),
        "periods": periods_json(&report.periods()),
    }));
    value.extend(counters_json(&report.counters));
    value.insert("exceptions_by_code".into(), codes_json(&report.counters));
    value.extend(times_json(&report.timing, true));
    value.into()
}

/// Everything of a device but its points.
pub fn device_json(bus: &BusHealth, device: &DeviceReport, now: Time) -> Value {
    let things: Vec<Value> =
        device.things.iter().map(|thing| thing_json(thing, device, now, bus.responding)).collect();
    let mut value = json!({
        "name": device.name,
        "title": device.title,
        "profile": device.profile,
        "manufacturer": device.manufacturer,
        "model": device.model,
        "bus": bus.report.name,
        "unit": device.unit,
        "online": device.online,
        "reason": device.reason,
        "identity": device.identity,
        "last_answer_seconds_ago": device.last_answer_at.map(|at| seconds(now - at)),
        "load": share(device.load),
        "periods": periods_json(&device.periods),
        "counters": counters_json(&device.counters),
        "exceptions_by_code": codes_json(&device.counters),
        "things": things,
        "drift": drift_json(&device.drift),
    });
    for (name, times) in times_json(&device.timing, false) {
        value[name] = times;
    }
    value
}

/// As it stands in a device's info, too.
pub fn drift_json(drift: &[Drift]) -> Value {
    let told = |drift: &Drift| {
        json!({
            "point": drift.point,
            "wanted": drift.wanted,
            "found": drift.found,
            "reason": drift.reason,
        })
    };
    drift.iter().map(told).collect()
}

fn periods_json(periods: &[PeriodReport]) -> Value {
    let told = |period: &PeriodReport| {
        let told = json!({"wanted_seconds": seconds(period.wanted), "seconds": period.real.map(seconds)});
        (period.class.name().to_string(), told)
    };
    periods.iter().map(told).collect::<Map<_, _>>().into()
}

fn counters_json(counters: &Counters) -> Map<String, Value> {
    counters.list().into_iter().map(|(name, count)| (name.to_string(), count.into())).collect()
}

fn codes_json(counters: &Counters) -> Value {
    let codes: Map<String, Value> =
        counters.exceptions_by_code().map(|(code, count)| (code, count.into())).collect();
    codes.into()
}

/// Percentiles of the last minutes, of commands those of the last days; null where there was nothing. Only
/// a bus can be late.
fn times_json(timing: &TimingReport, is_bus: bool) -> Map<String, Value> {
    let told = timing.list().into_iter().filter(|(name, _)| is_bus || *name != "lateness");
    told.map(|(name, spread)| {
        let lately = spread.as_ref().and_then(|spread| spread.lately);
        let of =
            |percentile: fn(&Percentiles) -> Duration| lately.as_ref().map(|times| fine(percentile(times)));
        let told =
            json!({"p50": of(|times| times.p50), "p95": of(|times| times.p95), "p99": of(|times| times.p99)});
        (format!("{name}_seconds"), told)
    })
    .collect()
}

/// One point; `is_heard` as in [`PointReport::freshness`].
pub fn point_json(point: &PointReport, now: Time, is_heard: bool) -> Value {
    let (missing, reason) = told_missing(&point.missing);
    let mut value = json!({
        "name": point.name,
        "title": point.title,
        "role": point.role.name(),
        "value": point.value,
        "unit": point.unit,
        "freshness": point.freshness(now, is_heard).name(),
        "missing": missing,
        "reason": reason,
        "read_seconds_ago": point.read_at.map(|at| seconds(now - at)),
        "good_for_seconds": point.good_for.map(seconds),
    });
    if point.is_list {
        // The text of a list of numbers is JSON.
        value["list"] = serde_json::from_str(&point.value).unwrap_or_default();
    }
    value
}

fn thing_json(thing: &ThingReport, device: &DeviceReport, now: Time, is_heard: bool) -> Value {
    let (missing, reason) = told_missing(&thing.missing);
    json!({
        "name": thing.name,
        "title": thing.title,
        "kind": thing.kind,
        "state": thing.state,
        "freshness": thing.freshness(device, now, is_heard).name(),
        "missing": missing,
        "reason": reason,
        "temperature": thing.temperature,
        "target": thing.target,
    })
}

fn told_missing<'m>(missing: &'m Option<(&'static str, String)>) -> (Option<&'static str>, Option<&'m str>) {
    missing.as_ref().map(|(word, text)| (*word, text.as_str())).unzip()
}

/// With the digits that mean something.
pub fn seconds(duration: Duration) -> f64 {
    (duration.as_secs_f64() * 1000.0).round() / 1000.0
}

/// Of a whole: a device that is seldom asked takes less than a thousandth of its wire.
fn share(share: f64) -> f64 {
    (share * 100_000.0).round() / 100_000.0
}

/// What is short is told in hundredths of a millisecond.
fn fine(duration: Duration) -> f64 {
    (duration.as_secs_f64() * 100_000.0).round() / 100_000.0
}

fn object(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}
