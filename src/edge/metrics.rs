//! A report as OpenMetrics.

use std::fmt;
use std::sync::atomic::AtomicU64;

use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::Registry;

use crate::engine::health::{BusHealth, Counters, GatewayReport};

/// What a scraper is told that it gets.
pub const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

type Labels = Vec<(&'static str, String)>;
type OneGauge = Gauge<f64, AtomicU64>;
type Gauges = Family<Labels, OneGauge>;

/// The counts live in the report; the library is only asked to write them down.
pub fn render(report: &GatewayReport) -> Result<String, fmt::Error> {
    let mut registry = Registry::with_prefix("busker");
    let flag = |on| if on { 1.0 } else { 0.0 };
    let connected = OneGauge::default();
    connected.set(flag(report.broker.connected));
    registry.register("broker_connected", "Whether the broker is connected", connected);
    let taken = OneGauge::default();
    taken.set(flag(report.broker.client_id_taken));
    let help = "Whether another client with the same identifier takes this one's place again and again";
    registry.register("broker_client_id_taken", help, taken);
    counter(&mut registry, "broker_connects", "Connections made", report.broker.connects);
    counter(&mut registry, "messages_dropped", "Messages that waited too long", report.broker.dropped);

    let of_buses = |value: &dyn Fn(&BusHealth) -> f64| {
        report.buses.iter().map(|bus| (vec![("bus", bus.report.name.clone())], value(bus))).collect()
    };
    gauges(&mut registry, "bus_up", "Whether the link is up", of_buses(&|bus| flag(bus.report.up)));
    gauges(
        &mut registry,
        "bus_responding",
        "Whether the bus answers for itself",
        of_buses(&|bus| flag(bus.responding)),
    );
    gauges(
        &mut registry,
        "bus_load_ratio",
        "Share of the last minute in which the wire was busy",
        of_buses(&|bus| bus.report.load),
    );
    let all_buses = report
        .buses
        .iter()
        .map(|bus| (vec![("bus", bus.report.name.clone())], &bus.report.counters))
        .collect();
    wire_counters(&mut registry, "bus", all_buses);

    let labels = |bus: &str, device: &str| vec![("bus", bus.to_string()), ("device", device.to_string())];
    let online = report
        .devices()
        .map(|(bus, device)| (labels(&bus.name, &device.name), flag(device.online)))
        .collect();
    gauges(&mut registry, "device_online", "Whether the device answers", online);
    let all_devices =
        report.devices().map(|(bus, device)| (labels(&bus.name, &device.name), &device.counters)).collect();
    wire_counters(&mut registry, "device", all_devices);

    let mut text = String::new();
    encode(&mut text, &registry)?;
    Ok(text)
}

fn gauges(registry: &mut Registry, name: &str, help: &str, values: Vec<(Labels, f64)>) {
    let family = Gauges::default();
    for (labels, value) in values {
        family.get_or_create(&labels).set(value);
    }
    registry.register(name, help, family);
}

fn counter(registry: &mut Registry, name: &str, help: &str, value: u64) {
    let counter: Counter = Counter::default();
    counter.inc_by(value);
    registry.register(name, help, counter);
}

fn counters(registry: &mut Registry, name: &str, help: &str, values: Vec<(Labels, u64)>) {
    let family = Family::<Labels, Counter>::default();
    for (labels, value) in values {
        family.get_or_create(&labels).inc_by(value);
    }
    registry.register(name, help, family);
}

/// One family for each kind of thing that is counted on the wire.
fn wire_counters(registry: &mut Registry, of: &str, counted: Vec<(Labels, &Counters)>) {
    for (index, (name, _)) in Counters::default().list().into_iter().enumerate() {
        let values =
            counted.iter().map(|(labels, counts)| (labels.clone(), counts.list()[index].1)).collect();
        let since = if name == "persistent_writes" { "installation" } else { "start" };
        let help = format!("{} since the {since}", name.replace('_', " "));
        counters(registry, &format!("{of}_{name}"), &help, values);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::health::{BrokerReport, BusReport, DeviceReport};

    #[test]
    fn every_bus_and_device_has_its_lines() {
        let device = DeviceReport {
            name: "relays".into(),
            title: "Relays".into(),
            profile: "test".into(),
            unit: 1,
            online: true,
            counters: Counters { timeouts: 7, ..Counters::default() },
            ..DeviceReport::default()
        };
        let report = BusReport {
            name: "cellar".into(),
            link: "tcp".into(),
            line: None,
            up: true,
            reason: None,
            paused: false,
            counters: Counters { requests: 12, ..Counters::default() },
            load: 0.25,
            devices: vec![device],
        };
        let broker = BrokerReport { connected: true, ..BrokerReport::default() };
        let text = render(&GatewayReport {
            broker,
            buses: vec![BusHealth { report, responding: true }],
            configuration_error: None,
        })
        .expect("text takes everything");
        for line in [
            "busker_broker_connected 1.0",
            "busker_broker_client_id_taken 0.0",
            "busker_bus_up{bus=\"cellar\"} 1.0",
            "busker_bus_load_ratio{bus=\"cellar\"} 0.25",
            "busker_bus_requests_total{bus=\"cellar\"} 12",
            "busker_device_timeouts_total{bus=\"cellar\",device=\"relays\"} 7",
            "busker_device_online{bus=\"cellar\",device=\"relays\"} 1.0",
            "# EOF",
        ] {
            assert!(text.lines().any(|found| found == line), "{line} is not in\n{text}");
        }
    }
}
