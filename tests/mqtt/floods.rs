//! What a slider that is dragged, or a script that has gone wild, does to a device: little. Each of its
//! commands has one outcome all the same.

use std::collections::BTreeMap;

use busker::engine::time::Duration;
use busker::simulator::{DeviceAt, Framing, Model, Options, Simulation, TcpPort};

use super::json;
use crate::support::{self, Broker, Gateway, Received, Watcher};

const BURST: usize = 1000;

struct Bench {
    _broker: Broker,
    _simulation: Simulation,
    _port: TcpPort,
    watcher: Watcher,
    gateway: Gateway,
}

impl Bench {
    /// Analog outputs with unit 12; `more` is the rest of the configuration.
    fn start(more: &str) -> Bench {
        // By itself it drops what is more than a thousand messages ahead of a client, and who watches is
        // sent several for each command.
        let broker = Broker::start_with("allow_anonymous true\npersistence false\nmax_queued_messages 0\n");
        let devices = [DeviceAt { model: Model::MrAo4, unit: 12 }];
        let simulation = Simulation::new(&devices, Options::default()).expect("the simulation starts");
        let port = simulation.serve_tcp("127.0.0.1:0", Framing::Tcp).expect("a free port");
        let watcher = Watcher::start(&broker, "watcher");
        let gateway = Gateway::start(
            &broker,
            &format!(
                "{more}\nbuses: {{line: {{tcp: '{}'}}}}\n\
                 devices: {{valves: {{profile: metz-connect/mr-ao4, bus: line, unit: 12}}}}\n",
                port.address()
            ),
        );
        watcher.wait_for("busker/valves/availability", "online");
        Bench { _broker: broker, _simulation: simulation, _port: port, watcher, gateway }
    }

    /// Sets a point to each of the values and waits for an outcome of each; tells how many there are of
    /// each kind.
    #[track_caller]
    fn burst(&self, point: &str, values: &[String]) -> BTreeMap<String, usize> {
        self.watcher.forget();
        for value in values {
            self.watcher.publish(&format!("busker/valves/{point}/set"), value);
        }
        let outcomes = || self.watcher.payloads(&format!("busker/valves/{point}/outcome"));
        let all = support::find(|| (outcomes().len() >= values.len()).then_some(()));
        assert!(all.is_some(), "{} outcomes of {} commands", outcomes().len(), values.len());
        let mut answered: Vec<String> = Vec::new();
        let mut kinds: BTreeMap<String, usize> = BTreeMap::new();
        for outcome in outcomes() {
            let outcome = json(&outcome);
            let text = |key: &str| outcome[key].as_str().unwrap_or_default().to_string();
            answered.push(text("wanted"));
            *kinds.entry(text("outcome")).or_default() += 1;
        }
        let mut wanted = values.to_vec();
        wanted.sort_unstable();
        answered.sort_unstable();
        assert_eq!(answered, wanted, "exactly one outcome for each command");
        kinds
    }

    /// A counter of the device in `/metrics`.
    #[track_caller]
    fn counted(&self, name: &str) -> usize {
        let (_, metrics) = self.gateway.get("/metrics");
        let line = format!("busker_device_{name}_total{{bus=\"line\",device=\"valves\"}} ");
        let count = metrics.lines().find_map(|found| found.strip_prefix(&line));
        count.and_then(|count| count.parse().ok()).unwrap_or_else(|| panic!("no `{line}` in\n{metrics}"))
    }
}

/// 1,000 different values, each of them one that the output can have: 0.0125, 0.0250, … V.
fn slider() -> Vec<String> {
    (1..=BURST).map(|step| format!("{}", step as f64 * 0.01)).collect()
}

#[test]
fn a_burst_of_slider_values_ends_in_the_last_one_with_few_writes() {
    let bench = Bench::start("");
    let values = slider();
    let kinds = bench.burst("output_1", &values);
    let last = values.last().expect("there are values");
    let state = json(&bench.watcher.payloads("busker/valves/output_1/outcome").pop().expect("an outcome"));
    assert_eq!(state["wanted"], *last, "{kinds:?}");
    assert_eq!(state["outcome"], "done", "{kinds:?}");
    let found = state["found"].as_str().expect("it was read back");
    bench.watcher.wait_for("busker/valves/output_1", found);
    // Each write is one that was begun, and has an outcome of its own; whatever waited meanwhile was
    // replaced.
    let writes = bench.counted("writes");
    assert_eq!(kinds["done"], writes, "{kinds:?}");
    assert_eq!(kinds["expired"], BURST - writes, "{kinds:?}");
    assert!(writes <= BURST / 4, "{writes} writes");
}

#[test]
fn a_script_that_floods_what_is_kept_in_eeprom_writes_once_in_an_interval() {
    let interval = Duration::from_secs(3);
    let bench = Bench::start("eeprom: {interval: 3s}");
    let clock = busker::edge::clock::Clock::start();
    let values: Vec<String> = (1..=BURST).map(|seconds| (seconds % 600).to_string()).collect();
    let kinds = bench.burst("watchdog", &values);
    let took = clock.now().since(busker::engine::time::Time::default());
    let writes = bench.counted("writes");
    assert_eq!(bench.counted("persistent_writes"), writes);
    // The first, and then one in each interval, the last of them after the end of the flood.
    let most = 2 + took.as_micros() / interval.as_micros();
    assert!(writes >= 2 && writes as u128 <= most, "{writes} writes in {took:?}: {kinds:?}");
    assert_eq!(kinds["done"] + kinds.get("unchanged").unwrap_or(&0), BURST - kinds["expired"], "{kinds:?}");
    bench.watcher.wait_for("busker/valves/watchdog", "400.00");

    // Counted for the installation, and shown to Home Assistant.
    let config = bench.watcher.received();
    assert!(config.iter().all(|got| !got.topic.ends_with("/config")), "nothing is announced anew for it");
    let told =
        |got: &Received| got.topic == "busker/valves/info" && json(&got.payload)["eeprom_writes"] == writes;
    bench.watcher.wait_until("the count in the info", told);
}

#[test]
fn when_the_budget_of_a_device_is_spent_the_rest_is_refused_and_wears_nothing() {
    // Half of the budget at once.
    let bench = Bench::start("eeprom: {interval: 0s, daily: 10}");
    for round in 0..40 {
        let kinds = bench.burst("watchdog", &[(100 + round).to_string()]);
        let expected = if round < 5 { "done" } else { "refused" };
        assert_eq!(kinds, BTreeMap::from([(expected.to_string(), 1)]), "round {round}");
    }
    assert_eq!(bench.counted("persistent_writes"), 5);
    let refused = json(&bench.watcher.payloads("busker/valves/watchdog/outcome")[0]);
    let reason = refused["reason"].as_str().expect("a reason");
    assert!(reason.contains("`eeprom: {daily: 10}`") && reason.contains("the next write may come in"));
    // Not of another point either; what is not kept goes on, and so does what is there already.
    assert!(bench.burst("output_2_default", &["5".into()]).contains_key("refused"));
    assert!(bench.burst("watchdog", &["104".into()]).contains_key("unchanged"));
    assert!(bench.burst("output_2", &["5".into()]).contains_key("done"));
    assert_eq!(bench.counted("persistent_writes"), 5);
    assert!(bench.gateway.terminate().success());
}
