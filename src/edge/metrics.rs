//! A report as OpenMetrics.

use std::fmt;
use std::sync::atomic::AtomicU64;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::text::encode;
use prometheus_client::encoding::{DescriptorEncoder, NoLabelSet};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::Registry;

use crate::engine::health::{
    BrokerReport, BusHealth, Counters, GatewayReport, Percentiles, PeriodReport, Readout, ReadoutValue,
    SpreadReport, TimingReport,
};

/// What a scraper is told that it gets.
pub const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

type Labels = Vec<(&'static str, String)>;
type OneGauge = Gauge<f64, AtomicU64>;
type Gauges = Family<Labels, OneGauge>;

/// The counts live in the report; the library is only asked to write them down.
pub fn render(mut report: GatewayReport) -> Result<String, fmt::Error> {
    let readings = Readings::taken_from(&mut report);
    let mut registry = Registry::with_prefix("busker");
    tell_broker(&mut registry, &report.broker);
    tell_buses(&mut registry, &report);
    tell_devices(&mut registry, &report);
    registry.register_collector(Box::new(readings));

    let mut text = String::new();
    encode(&mut text, &registry)?;
    Ok(text)
}

fn flag(on: bool) -> f64 {
    if on { 1.0 } else { 0.0 }
}

fn tell_broker(registry: &mut Registry, broker: &BrokerReport) {
    for (name, help, value) in [
        ("connected", "Whether the broker is connected", flag(broker.connected)),
        (
            "client_id_taken",
            "Whether another client with the same identifier takes this one's place again and again",
            flag(broker.client_id_taken),
        ),
        (
            "state_denied",
            "Whether others tell something else of this gateway's state again and again",
            flag(broker.state_denied),
        ),
        (
            "kept_back",
            "Topics that miss something, since the broker takes no message as long",
            broker.kept_back.len() as f64,
        ),
        (
            "not_arriving",
            "Topics of which the broker does not hand on what is told there, although it confirms it",
            broker.not_arriving.len() as f64,
        ),
        (
            "announced_by_others",
            "Devices that another gateway announces to Home Assistant under the same identity",
            broker.announced_by_others.len() as f64,
        ),
    ] {
        let gauge = OneGauge::default();
        gauge.set(value);
        registry.register(format!("broker_{name}"), help, gauge);
    }
    counter(registry, "broker_connects", "Connections made", broker.connects);
    counter(registry, "messages_dropped", "Messages that waited too long", broker.dropped);
}

fn tell_buses(registry: &mut Registry, report: &GatewayReport) {
    let of_buses = |value: &dyn Fn(&BusHealth) -> f64| {
        report.buses.iter().map(|bus| (vec![("bus", bus.report.name.clone())], value(bus))).collect()
    };
    gauges(registry, "bus_up", "Whether the link is up", of_buses(&|bus| flag(bus.report.up)));
    gauges(
        registry,
        "bus_responding",
        "Whether the bus answers for itself",
        of_buses(&|bus| flag(bus.responding)),
    );
    gauges(
        registry,
        "bus_load_ratio",
        "Share of the last minute in which the wire was busy",
        of_buses(&|bus| bus.report.load),
    );
    let all_buses = || report.buses.iter().map(|bus| (vec![("bus", bus.report.name.clone())], &bus.report));
    wire_counters(registry, "bus", all_buses().map(|(labels, bus)| (labels, &bus.counters)).collect());
    codes(registry, "bus", all_buses().map(|(labels, bus)| (labels, &bus.counters)));
    times(registry, "bus", all_buses().map(|(labels, bus)| (labels, &bus.timing)));
    periods(registry, "bus", all_buses().map(|(labels, bus)| (labels, bus.periods())));
}

fn tell_devices(registry: &mut Registry, report: &GatewayReport) {
    let labels = |bus: &str, device: &str| vec![("bus", bus.to_string()), ("device", device.to_string())];
    let all_devices = || report.devices().map(|(bus, device)| (labels(&bus.name, &device.name), device));
    let online = all_devices().map(|(labels, device)| (labels, flag(device.online))).collect();
    gauges(registry, "device_online", "Whether the device answers", online);
    let loads = all_devices().map(|(labels, device)| (labels, device.load)).collect();
    let help = "Share of the last minute in which the wire was busy with it";
    gauges(registry, "device_load_ratio", help, loads);
    let counted = all_devices().map(|(labels, device)| (labels, &device.counters)).collect();
    wire_counters(registry, "device", counted);
    codes(registry, "device", all_devices().map(|(labels, device)| (labels, &device.counters)));
    times(registry, "device", all_devices().map(|(labels, device)| (labels, &device.timing)));
    periods(registry, "device", all_devices().map(|(labels, device)| (labels, device.periods.clone())));
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

/// Exceptions by their codes: only those that there were.
fn codes<'c>(registry: &mut Registry, of: &str, counted: impl Iterator<Item = (Labels, &'c Counters)>) {
    let mut values = Vec::new();
    for (labels, counters) in counted {
        for (code, count) in counters.exceptions_by_code() {
            values.push(([&labels[..], &[("code", code)]].concat(), count));
        }
    }
    let help = "exceptions by code since the start";
    counters(registry, &format!("{of}_exceptions_by_code"), help, values);
}

/// How often the reads of a poll class come round, and how often they should.
fn periods(registry: &mut Registry, of: &str, told: impl Iterator<Item = (Labels, Vec<PeriodReport>)>) {
    let (mut real, mut wanted) = (Vec::new(), Vec::new());
    for (labels, periods) in told {
        for period in periods {
            let labels = [&labels[..], &[("class", period.class.name().to_string())]].concat();
            real.extend(period.real.map(|real| (labels.clone(), real.as_secs_f64())));
            wanted.push((labels, period.wanted.as_secs_f64()));
        }
    }
    let help = "How often the reads of a poll class come round";
    gauges(registry, &format!("{of}_period_seconds"), help, real);
    gauges(registry, &format!("{of}_wanted_period_seconds"), "How often they should", wanted);
}

/// One histogram for each kind of time that has been seen, and how it was lately.
fn times<'t>(registry: &mut Registry, of: &str, timings: impl Iterator<Item = (Labels, &'t TimingReport)>) {
    let timings: Vec<(Labels, &TimingReport)> = timings.collect();
    for (index, (name, _)) in TimingReport::default().list().into_iter().enumerate() {
        let told = |(labels, timing): &(Labels, &TimingReport)| {
            Some((labels.clone(), timing.list()[index].1.clone()?))
        };
        let values: Vec<_> = timings.iter().filter_map(told).collect();
        let help = match name {
            "turnaround" => "From a read's last character to the first one of its answer.",
            "gap_wait" => "From the decision on a request until it was on the wire.",
            "lateness" => "How much of that the silence before a request did not ask for.",
            _ => "From a command's arrival until it was on the wire.",
        };
        let mut lately = Vec::new();
        for (labels, spread) in &values {
            let Some(percentiles) = spread.lately else { continue };
            let Percentiles { p50, p95, p99 } = percentiles;
            for (percentile, time) in [("50", p50), ("95", p95), ("99", p99)] {
                let labels = [&labels[..], &[("percentile", percentile.to_string())]].concat();
                lately.push((labels, time.as_secs_f64()));
            }
        }
        let whole = format!("{of}_{name}_seconds");
        registry.register_collector(Box::new(Histograms { name: whole, help, values }));
        gauges(
            registry,
            &format!("{of}_{name}_lately_seconds"),
            "Lately: so many of a hundred took at most this",
            lately,
        );
    }
}

/// What has been counted already, as histograms.
#[derive(Debug)]
struct Histograms {
    name: String,
    help: &'static str,
    values: Vec<(Labels, SpreadReport)>,
}

impl Collector for Histograms {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), fmt::Error> {
        if self.values.is_empty() {
            return Ok(());
        }
        let mut family = encoder.encode_descriptor(&self.name, self.help, None, MetricType::Histogram)?;
        for (labels, spread) in &self.values {
            let bounds = SpreadReport::bounds().map(|bound| bound.as_secs_f64()).chain([f64::INFINITY]);
            let buckets: Vec<(f64, u64)> =
                bounds.zip(spread.counts.iter().map(|count| u64::from(*count))).collect();
            let count = buckets.iter().map(|(_, count)| count).sum();
            let mut one = family.encode_family(labels)?;
            one.encode_histogram::<NoLabelSet>(spread.sum.as_secs_f64(), count, &buckets, None)?;
        }
        Ok(())
    }
}

/// The readings of all devices that are true now: of what is missing or old there is no line.
#[derive(Debug)]
struct Readings(Vec<(String, Vec<Readout>)>);

impl Readings {
    /// The readings are many: they are not copied.
    fn taken_from(report: &mut GatewayReport) -> Readings {
        let devices =
            report.buses.iter_mut().filter(|bus| bus.responding).flat_map(|bus| &mut bus.report.devices);
        let online = devices.filter(|device| device.online);
        Readings(online.map(|device| (device.name.clone(), std::mem::take(&mut device.readings))).collect())
    }

    fn all(&self) -> impl Iterator<Item = (&str, &Readout)> {
        self.0
            .iter()
            .flat_map(|(device, readings)| readings.iter().map(move |reading| (device.as_str(), reading)))
    }
}

impl Collector for Readings {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), fmt::Error> {
        let help = "What the device holds; a flag is 0 or 1. Absent while it is not known.";
        let mut family = encoder.encode_descriptor("reading", help, None, MetricType::Gauge)?;
        for (device, reading) in self.all() {
            let unit = reading.unit.as_deref().unwrap_or_default();
            let labels = [("device", device), ("point", &reading.point), ("unit", unit)];
            match &reading.value {
                ReadoutValue::Number(value) => family.encode_family(&labels)?.encode_gauge(value)?,
                ReadoutValue::Numbers(values) => {
                    for (element, value) in values {
                        let element = element.to_string();
                        let [device, point, unit] = labels;
                        let labels = [device, point, ("element", &element), unit];
                        family.encode_family(&labels)?.encode_gauge(value)?;
                    }
                }
                ReadoutValue::Name { .. } => {}
            }
        }
        // As a state set: one line for each name, of which one is 1.
        let help = "Which of its names the point holds. Absent while it is not known.";
        let mut family = encoder.encode_descriptor("reading_state", help, None, MetricType::Gauge)?;
        for (device, reading) in self.all() {
            let ReadoutValue::Name { holds, names } = &reading.value else { continue };
            for name in names {
                let value = if name == holds { 1.0 } else { 0.0 };
                let labels = [("device", device), ("point", &reading.point), ("state", name)];
                family.encode_family(&labels)?.encode_gauge(&value)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::device::Poll;
    use crate::engine::health::{BrokerReport, BusReport, DeviceReport, PeriodReport, Timing};
    use crate::engine::time::{Duration, Time};

    #[test]
    fn every_bus_and_device_has_its_lines() {
        let mut exceptions_by_code = Counters::default().exceptions_by_code;
        (exceptions_by_code[0], exceptions_by_code[2]) = (1, 5);
        let mut timing = Timing::default();
        for millis in [3, 4, 40] {
            timing.turned_around(Time(0), Duration::from_millis(millis));
        }
        let reading = |point: &str, unit: Option<&str>, value| Readout {
            point: point.into(),
            unit: unit.map(str::to_string),
            value,
        };
        let mode = ReadoutValue::Name { holds: "\"on\"".into(), names: vec!["off".into(), "\"on\"".into()] };
        let device = DeviceReport {
            timing: timing.report(Time(0)),
            periods: vec![PeriodReport {
                class: Poll::Fast,
                wanted: Duration::from_millis(250),
                real: Some(Duration::from_millis(400)),
            }],
            readings: vec![
                reading("flow", Some("°C"), ReadoutValue::Number(21.5)),
                reading("relay", None, ReadoutValue::Number(1.0)),
                reading("curve", None, ReadoutValue::Numbers(vec![(0, 0.5), (2, -1.0)])),
                reading("mode", None, mode),
            ],
            name: "relays".into(),
            title: "Relays".into(),
            profile: "test".into(),
            unit: 1,
            online: true,
            counters: Counters { timeouts: 7, exceptions_by_code, ..Counters::default() },
            load: 0.125,
            ..DeviceReport::default()
        };
        let report = BusReport {
            name: "cellar".into(),
            up: true,
            counters: Counters { requests: 12, ..Counters::default() },
            load: 0.25,
            devices: vec![device],
            ..BusReport::default()
        };
        let broker = BrokerReport { connected: true, ..BrokerReport::default() };
        let gateway = |responding| GatewayReport {
            broker: broker.clone(),
            buses: vec![BusHealth { report: report.clone(), responding }],
            configuration_error: None,
        };
        let text = render(gateway(true)).expect("text takes everything");
        let stuck = render(gateway(false)).expect("text takes everything");
        assert!(!stuck.contains("busker_reading{"), "nobody knows what a stuck bus would tell:\n{stuck}");
        for line in [
            "busker_broker_connected 1.0",
            "busker_broker_client_id_taken 0.0",
            "busker_broker_state_denied 0.0",
            "busker_broker_kept_back 0.0",
            "busker_bus_up{bus=\"cellar\"} 1.0",
            "busker_bus_load_ratio{bus=\"cellar\"} 0.25",
            "busker_bus_requests_total{bus=\"cellar\"} 12",
            "busker_device_timeouts_total{bus=\"cellar\",device=\"relays\"} 7",
            "busker_device_online{bus=\"cellar\",device=\"relays\"} 1.0",
            "busker_device_exceptions_by_code_total{bus=\"cellar\",device=\"relays\",code=\"2\"} 5",
            "busker_device_exceptions_by_code_total{bus=\"cellar\",device=\"relays\",code=\"other\"} 1",
            "# TYPE busker_device_turnaround_seconds histogram",
            "busker_device_turnaround_seconds_sum{bus=\"cellar\",device=\"relays\"} 0.047",
            "busker_device_turnaround_seconds_count{bus=\"cellar\",device=\"relays\"} 3",
            "busker_device_turnaround_seconds_bucket{le=\"0.002\",bus=\"cellar\",device=\"relays\"} 0",
            "busker_device_turnaround_seconds_bucket{le=\"0.005\",bus=\"cellar\",device=\"relays\"} 2",
            "busker_device_turnaround_seconds_bucket{le=\"+Inf\",bus=\"cellar\",device=\"relays\"} 3",
            "busker_device_turnaround_lately_seconds{bus=\"cellar\",device=\"relays\",percentile=\"99\"} 0.0397",
            "busker_device_load_ratio{bus=\"cellar\",device=\"relays\"} 0.125",
            "busker_bus_period_seconds{bus=\"cellar\",class=\"fast\"} 0.4",
            "busker_bus_wanted_period_seconds{bus=\"cellar\",class=\"fast\"} 0.25",
            "busker_device_period_seconds{bus=\"cellar\",device=\"relays\",class=\"fast\"} 0.4",
            "busker_device_wanted_period_seconds{bus=\"cellar\",device=\"relays\",class=\"fast\"} 0.25",
            "# TYPE busker_reading gauge",
            "busker_reading{device=\"relays\",point=\"flow\",unit=\"°C\"} 21.5",
            "busker_reading{device=\"relays\",point=\"relay\",unit=\"\"} 1.0",
            "busker_reading{device=\"relays\",point=\"curve\",element=\"2\",unit=\"\"} -1.0",
            "busker_reading_state{device=\"relays\",point=\"mode\",state=\"off\"} 0.0",
            "busker_reading_state{device=\"relays\",point=\"mode\",state=\"\\\"on\\\"\"} 1.0",
            "# EOF",
        ] {
            assert!(text.lines().any(|found| found == line), "{line} is not in\n{text}");
        }
    }
}
