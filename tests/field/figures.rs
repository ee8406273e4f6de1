//! What the bus does is told: each figure of a bus and of a device stands in `/metrics`, in `bridge/health` and
//! as a diagnostic entity, and tells the same.

use std::io::Write;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use serde_json::Value;

use crate::peer::{Framing, LIE, Misbehave, Peer, Step, exception, garbled, read_pdu, rtu};
use crate::stage::Stage;
use crate::support::wait_for;

/// A figure by the three names that it has: its place in JSON, in `/metrics` and as an entity.
struct Figure {
    json: &'static str,
    metric: &'static str,
    /// `Exceptions` has what it says of each code as attributes.
    entity: &'static str,
    /// It has had reason to be more than nothing, and none to change since.
    has_happened: bool,
}

const fn figure(json: &'static str, metric: &'static str, entity: &'static str) -> Figure {
    Figure { json, metric, entity, has_happened: false }
}

const fn happened(json: &'static str, metric: &'static str, entity: &'static str) -> Figure {
    Figure { json, metric, entity, has_happened: true }
}

const FIGURES: &[Figure] = &[
    figure("/load", "load_ratio{", "load"),
    figure("/periods/fast/seconds", "period_seconds{class=\"fast\"", "fast_period"),
    figure("/periods/slow/seconds", "period_seconds{class=\"slow\"", "slow_period"),
    figure("/turnaround_seconds/p50", "turnaround_lately_seconds{percentile=\"50\"", "turnaround_p50"),
    figure("/turnaround_seconds/p95", "turnaround_lately_seconds{percentile=\"95\"", "turnaround_p95"),
    figure("/turnaround_seconds/p99", "turnaround_lately_seconds{percentile=\"99\"", "turnaround_p99"),
    figure("/gap_wait_seconds/p95", "gap_wait_lately_seconds{percentile=\"95\"", "gap_wait_p95"),
    figure("/command_wait_seconds/p95", "command_wait_lately_seconds{percentile=\"95\"", "command_wait_p95"),
    figure("/requests", "requests_total{", "requests"),
    happened("/timeouts", "timeouts_total{", "timeouts"),
    happened("/checksum_errors", "checksum_errors_total{", "checksum_errors"),
    happened("/exceptions", "exceptions_total{", "exceptions"),
    happened("/exceptions_by_code/4", "exceptions_by_code_total{code=\"4\"", "exceptions"),
    happened("/exceptions_by_code/other", "exceptions_by_code_total{code=\"other\"", "exceptions"),
    happened("/late_replies", "late_replies_total{", "late_replies"),
    happened("/noise_bytes", "noise_bytes_total{", "noise_bytes"),
    happened("/wrong_frames", "wrong_frames_total{", "wrong_frames"),
];

/// `two` says something else in place of its readings, while it is told to be bad; then it is silent.
const DEVICES: &str = r#"  one:
    bus: line
    unit: 1
    poll: {fast: 100ms, slow: 1s}
    points:
      a: {at: input 0, poll: fast, unit: °C}
      b: {at: holding 7, poll: slow, write: 0..9}
      mode: {at: input 40, poll: slow, values: {0: 'as it is "meant" \ said', 1: other}}
      curve: {at: input 50, poll: slow, count: 3}
      relay: {at: coil 0, poll: fast}
  two: {bus: line, unit: 2, poll: {fast: 100ms}, points: {a: {at: input 0, poll: fast}}}
"#;

/// Does everything to unit 1 that is counted, once or more often, and a command.
fn eventful(peer: &Peer) -> Stage<'_> {
    peer.misbehave(|_, good| taking_its_time(good));
    let stage = Stage::start(peer, "response_timeout: 200ms", DEVICES, &[("one/a", (1, 4, 0))]);
    stage.shows_all();
    stage.watcher.shows("busker/two/a", "0");
    stage.watcher.shows("busker/one/curve", "[0,0,0]");
    assert_eq!(stage.command("one/b", "5")["outcome"], "done");
    // What is refused is left alone for a minute: nobody waits for that.
    let (a, b, relay) = ((4, 0), (3, 7), (1, 0));
    let faults: &[((u8, u16), Misbehave)] = &[
        (a, |_, _| Vec::new()),
        (a, |asked, _| vec![Step::SayBeforeNext(rtu(asked.unit, &read_pdu(4, &[LIE])))]),
        (a, |_, good| vec![Step::Say(garbled(good))]),
        (a, |_, good| vec![Step::Say([vec![0xFF, 0, 0], good].concat())]),
        (a, |asked, _| vec![Step::Say(rtu(asked.unit + 8, &read_pdu(4, &[LIE])))]),
        (b, |asked, _| vec![Step::Say(exception(asked, Framing::Rtu, 4))]),
        (relay, |asked, _| vec![Step::Say(exception(asked, Framing::Rtu, 77))]),
    ];
    for ((function, address), how) in faults {
        peer.misbehave_once(1, *function, *address, *how);
        wait_for("the fault", || peer.has_misbehaved().then_some(()));
        stage.tells_changes();
    }
    stage
}

/// No pseudo-terminal takes the time of a wire: what answers at once has no turnaround at all.
fn taking_its_time(good: Vec<u8>) -> Vec<Step> {
    vec![Step::Pause(20), Step::Say(good)]
}

fn number(text: &str) -> f64 {
    text.parse().unwrap_or_else(|_| panic!("{text} is no number"))
}

/// The value of the line of this name that has all these labels.
fn metric(text: &str, of: &str, name: &str, labels: &[String]) -> Option<f64> {
    let (name, label) = name.split_once('{').unwrap_or((name, ""));
    let begins = format!("busker_{of}_{name}{{");
    let fits = |line: &&str| {
        line.starts_with(&begins) && line.contains(label) && labels.iter().all(|label| line.contains(label))
    };
    text.lines().find(fits).and_then(|line| line.rsplit_once(' ')).map(|(_, value)| number(value))
}

#[test]
fn every_figure_of_a_bus_and_of_a_device_is_told_in_three_places() {
    let peer = Peer::on_a_pseudo_terminal();
    let stage = eventful(&peer);
    // What changes how a device is, is told at once, and everything else with it.
    let is_silent = Arc::new(AtomicBool::new(true));
    let silent = is_silent.clone();
    peer.misbehave(move |asked, good| match asked.unit == 2 && silent.load(Ordering::SeqCst) {
        true => Vec::new(),
        false => taking_its_time(good),
    });
    let told = stage.watcher.shows_what("busker/bridge/health", "that unit 2 is away", |told| {
        let told: Value = serde_json::from_str(told).expect("JSON");
        told["devices"]["two"]["online"] == false
    });
    let health: Value = serde_json::from_str(&told).expect("JSON");
    let (_, metrics) = stage.gateway.get("/metrics");
    let bus = "bus=\"line\"".to_string();
    let device = "device=\"one\"".to_string();
    for (of, at, labels, config, prefix) in [
        ("bus", "/buses/line", vec![bus.clone()], "busker_bus_line", ""),
        ("device", "/devices/one", vec![bus, device], "busker_one", "wire_"),
    ] {
        let announced = stage.watcher.last(&format!("homeassistant/device/{config}/config"));
        let announced: Value = serde_json::from_str(&announced.expect("it is announced")).expect("JSON");
        for Figure { json, metric: name, entity, has_happened } in FIGURES {
            let found = health.pointer(&format!("{at}{json}")).and_then(Value::as_f64);
            let found = found.unwrap_or_else(|| panic!("{of}: no {json} in {health}"));
            let scraped = metric(&metrics, of, name, &labels);
            let scraped = scraped.unwrap_or_else(|| panic!("{of}: no {name} in\n{metrics}"));
            // Unit 2 does not answer: that is counted on the bus.
            if *has_happened && !(of == "bus" && *json == "/timeouts") {
                assert!(found >= 1.0 && scraped == found, "{of}: {json} is {found}, {name} {scraped}");
            } else {
                assert!(found > 0.0 && scraped > 0.0, "{of}: {json} is {found}, {name} {scraped}");
            }
            let component = &announced["components"][format!("{prefix}{entity}")];
            assert_eq!(component["entity_category"], "diagnostic", "{of}: no entity {entity}");
            let key = json.trim_start_matches('/').split('/').collect::<Vec<_>>();
            let key = if key[0] == "exceptions_by_code" { key[0].to_string() } else { key.join(".") };
            assert!(component.to_string().contains(&key), "{of}: {component} does not tell {key}");
        }
    }
    // Unit 2 was asked when some of it came.
    assert_eq!(health["devices"]["two"]["late_replies"], 0, "{health}");
    is_silent.store(false, Ordering::SeqCst);
    stage.ends_well();
}

/// Reads OpenMetrics on standard input as Prometheus's own library does, and prints each family with its
/// type and how many samples it has.
const READER: &str = "
import sys
from prometheus_client.openmetrics.parser import text_string_to_metric_families
for family in text_string_to_metric_families(sys.stdin.read()):
    print(family.name, family.type, len(family.samples))
";

#[test]
#[ignore = "needs prometheus-client of PyPI: `make test-openmetrics`"]
fn the_strict_reader_of_prometheus_reads_the_metrics() {
    let peer = Peer::on_a_pseudo_terminal();
    let stage = eventful(&peer);
    let (_, metrics) = stage.gateway.get("/metrics");
    let python = std::env::var("BUSKER_OPENMETRICS_PYTHON").expect("`make test-openmetrics` says which");
    let read = |text: &str| {
        let mut child = Command::new(&python)
            .args(["-c", READER])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("python starts");
        child.stdin.take().expect("it is piped").write_all(text.as_bytes()).expect("it reads");
        child.wait_with_output().expect("it ends")
    };
    let output = read(&metrics);
    let told = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{}\n{metrics}", String::from_utf8_lossy(&output.stderr));
    for family in [
        "busker_broker_connected gauge 1",
        "busker_bus_load_ratio gauge 1",
        "busker_device_load_ratio gauge 2",
        "busker_device_requests counter 2",
        "busker_device_exceptions_by_code counter 2",
        "busker_device_turnaround_lately_seconds gauge 6",
        "busker_bus_period_seconds gauge 2",
        // Two numbers and three of the curve; and of each name whether it is the one.
        "busker_reading gauge 5",
        "busker_reading_state gauge 2",
    ] {
        assert!(told.lines().any(|line| line == family), "`{family}` is not in\n{told}");
    }
    let histograms = told.lines().filter(|line| line.contains(" histogram ")).count();
    assert!(histograms >= 7, "{told}");
    assert!(metrics.contains(r#"state="as it is \"meant\" \\ said""#), "{metrics}");
    // It is strict: each of these is a fault.
    for (what, broken) in [
        ("no end", metrics.replace("# EOF\n", "")),
        ("a counter without its ending", metrics.replace("_requests_total{", "_requests{")),
        ("a bucket that is less than the one before", metrics.replacen("le=\"+Inf\"", "le=\"0.000001\"", 1)),
    ] {
        assert!(!read(&broken).status.success(), "{what} is taken");
    }
    stage.ends_well();
}
