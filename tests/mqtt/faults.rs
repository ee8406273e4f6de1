//! What may happen to a broker and to the way to it, and that nothing is lost by it. The table of
//! `docs/reliability.md` is made from these rows.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::thread;

use busker::engine::time::Duration;
use busker::simulator::{Simulation, TcpPort};

use super::proxy::Proxy;
use super::{configuration, json, over_tcp, relay, remembered, simulation, table};
use crate::clients;
use crate::support::{self, Broker, Gateway, Received, Watcher};

const DOCUMENT: &str = "docs/reliability.md";

/// Rows that run at the same time; most of each is waiting.
const AT_ONCE: usize = 6;

/// More than what ten thousand messages occupy is no noise of the allocator.
const GROWTH_MAX: u64 = 12 << 20;

/// One line of the table.
struct Row {
    /// What is done to the broker, or to the way to it.
    fault: &'static str,
    /// What becomes of a command that is given meanwhile; the row gives it where it says something.
    command: Meanwhile,
    keep_alive: &'static str,
    persistent: bool,
    act: fn(&mut Stage),
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Meanwhile {
    /// Nobody can give one.
    NotGiven,
    /// It is not obeyed, neither then nor later.
    NotObeyed,
    /// It is not obeyed, and its sender is told so.
    Expires,
    /// It came before the end, is obeyed at once, and its outcome is told after the reconnect.
    ObeyedAtOnce,
}

impl Meanwhile {
    fn told(self) -> &'static str {
        match self {
            Meanwhile::NotGiven => "—",
            Meanwhile::NotObeyed => "is not obeyed, then or later",
            Meanwhile::Expires => "is not obeyed; its outcome is `expired`",
            Meanwhile::ObeyedAtOnce => "is obeyed at once; its outcome is told after the reconnect",
        }
    }
}

/// Everything that a row needs. The gateway reaches the broker through the proxy, others directly.
struct Stage {
    broker: Broker,
    proxy: Proxy,
    simulation: Simulation,
    _port: TcpPort,
    gateway: Gateway,
    watcher: Watcher,
}

const ROWS: &[Row] = &[
    Row {
        fault: "killed and started again, without persistence: it has forgotten everything",
        command: Meanwhile::NotGiven,
        keep_alive: "15s",
        persistent: false,
        act: |stage| {
            stage.proxy.refuse();
            stage.broker.kill();
            stage.meanwhile();
            stage.broker.start_again();
            stage.proxy.open();
        },
    },
    Row {
        fault: "stopped and started again, with persistence",
        command: Meanwhile::NotGiven,
        keep_alive: "15s",
        persistent: true,
        act: |stage| {
            stage.proxy.refuse();
            stage.broker.stop();
            stage.meanwhile();
            stage.broker.start_again();
            stage.proxy.open();
        },
    },
    Row {
        fault: "with persistence; the gateway was away, and a command was published for it with QoS 1 and one retained",
        command: Meanwhile::NotObeyed,
        keep_alive: "15s",
        persistent: true,
        act: |stage| {
            // A session of the gateway's own identifier that the broker shall keep.
            stage.proxy.refuse();
            stage.meanwhile();
            clients::leave_a_session(&stage.broker, "busker_gateway", "busker/+/+/set");
            stage.watcher.publish("busker/relays/relay_1/set", "ON");
            stage.watcher.publish_retained("busker/relays/relay_1/set", "ON");
            stage.watcher.wait_for("busker/relays/relay_1/set", "ON");
            stage.broker.stop();
            stage.broker.start_again();
            stage.proxy.open();
        },
    },
    Row {
        fault: "stopped and started three times in a row",
        command: Meanwhile::NotGiven,
        keep_alive: "15s",
        persistent: false,
        act: |stage| {
            stage.hand();
            for _ in 0..3 {
                let before = stage.connects();
                stage.broker.stop();
                stage.broker.start_again();
                stage.wait_for_connects(before + 1);
            }
            let taken = json(&stage.gateway.get("/health").1)["broker"]["client_id_taken"].clone();
            assert_eq!(taken, false, "nobody wants the gateway's place");
        },
    },
    Row {
        fault: "stalled for some seconds, too short for the gateway to give it up",
        command: Meanwhile::Expires,
        keep_alive: "30s",
        persistent: false,
        act: |stage| {
            let connects = stage.connects();
            stage.wait_for_question();
            stage.broker.stall();
            stage.watcher.publish("busker/relays/relay_1/set", "ON");
            // The gateway has nothing to tell. It asks, and waits for an answer. The fault is that it takes so long.
            stage.wait_for_question();
            thread::sleep(Duration::from_millis(3200));
            stage.broker.go_on();
            stage.expect_outcome();
            assert_eq!(stage.connects(), connects, "the connection is the same");
        },
    },
    Row {
        fault: "well, but the gateway itself stood still for some seconds",
        command: Meanwhile::Expires,
        keep_alive: "30s",
        persistent: false,
        act: |stage| {
            let connects = stage.connects();
            stage.wait_for_question();
            stage.gateway.stall();
            stage.watcher.publish("busker/relays/relay_1/set", "ON");
            // The fault is that it takes so long.
            thread::sleep(Duration::from_millis(9200));
            stage.gateway.go_on();
            stage.expect_outcome();
            assert_eq!(stage.connects(), connects, "the connection is the same");
        },
    },
    Row {
        fault: "stalled until the gateway gives it up, and longer",
        command: Meanwhile::NotObeyed,
        keep_alive: "1s",
        persistent: false,
        act: |stage| {
            stage.broker.stall();
            stage.watcher.publish("busker/relays/relay_1/set", "ON");
            stage.meanwhile();
            // Somebody stands in the queue behind the gateway.
            stage.proxy.forget_told();
            stage.proxy.wait_until_told(b"MQTT");
            let late = clients::queue_up(&stage.broker, "busker/relays/relay_1/set", "ON");
            stage.broker.go_on();
            late.join().expect("it is published");
        },
    },
    Row {
        fault: "cut off without a sign, as by a pulled cable, and back",
        command: Meanwhile::NotObeyed,
        keep_alive: "1s",
        persistent: false,
        act: |stage| {
            stage.proxy.hold();
            stage.watcher.publish("busker/relays/relay_1/set", "ON");
            stage.meanwhile();
            stage.watcher.wait_for("busker/bridge/state", "offline");
            stage.proxy.open();
        },
    },
    Row {
        fault: "takes connections and closes them at once",
        command: Meanwhile::NotObeyed,
        keep_alive: "15s",
        persistent: false,
        act: |stage| {
            stage.proxy.refuse();
            stage.watcher.publish("busker/relays/relay_1/set", "ON");
            stage.meanwhile();
            let before = stage.proxy.accepted();
            support::find(|| (stage.proxy.accepted() >= before + 2).then_some(())).expect("it tries again");
            stage.proxy.open();
        },
    },
    Row {
        fault: "cut off in the middle of a packet to it, at three places",
        command: Meanwhile::NotGiven,
        keep_alive: "15s",
        persistent: false,
        act: |stage| {
            for bytes in [40, 2000, 9000] {
                let before = stage.proxy.accepted();
                stage.proxy.cut_after(Some(bytes), None);
                stage.proxy.cut();
                support::find(|| (stage.proxy.accepted() > before).then_some(())).expect("it tries again");
            }
            stage.meanwhile();
            stage.proxy.open();
        },
    },
    Row {
        fault: "cut off in the middle of a packet from it, at three places",
        command: Meanwhile::NotGiven,
        keep_alive: "15s",
        persistent: false,
        act: |stage| {
            for bytes in [3, 11, 700] {
                let before = stage.proxy.accepted();
                stage.proxy.cut_after(None, Some(bytes));
                stage.proxy.cut();
                support::find(|| (stage.proxy.accepted() > before).then_some(())).expect("it tries again");
            }
            stage.meanwhile();
            stage.proxy.open();
        },
    },
    Row {
        fault: "cut off right behind a command",
        command: Meanwhile::ObeyedAtOnce,
        keep_alive: "15s",
        persistent: false,
        act: |stage| {
            stage.proxy.hold();
            stage.watcher.publish("busker/relays/relay_1/set", "ON");
            stage.proxy.wait_until_held(b"busker/relays/relay_1/set");
            // It finds both at once.
            stage.gateway.stall();
            stage.proxy.pass_last_words();
            stage.gateway.go_on();
            let obeyed = support::find(|| (relay(&stage.simulation, 1) == "ON").then_some(()));
            obeyed.expect("the command came in time");
            stage.meanwhile();
            stage.proxy.open();
        },
    },
    Row {
        fault: "cut off when a command was obeyed, before its outcome came through",
        command: Meanwhile::ObeyedAtOnce,
        keep_alive: "15s",
        persistent: false,
        act: |stage| {
            stage.proxy.hold_to_broker();
            stage.watcher.publish("busker/relays/relay_1/set", "ON");
            stage.proxy.wait_until_held(b"busker/relays/relay_1/outcome");
            stage.proxy.refuse();
            stage.meanwhile();
            stage.proxy.open();
        },
    },
    Row {
        fault: "its address leads to another broker, which knows nothing",
        command: Meanwhile::NotGiven,
        keep_alive: "15s",
        persistent: false,
        act: |stage| {
            let other = Broker::start();
            stage.hand();
            stage.proxy.lead_to(other.port);
            stage.watcher = Watcher::start(&other, "watcher_2");
            // The old one ends here.
            stage.broker = other;
        },
    },
    Row {
        fault: "Home Assistant is restarted, and asks by its birth message",
        command: Meanwhile::NotGiven,
        keep_alive: "15s",
        persistent: false,
        act: |stage| {
            stage.watcher.publish("homeassistant/status", "offline");
            stage.hand();
            stage.watcher.wait_for("busker/relays/relay_3", "ON");
            stage.watcher.forget();
            stage.watcher.publish("homeassistant/status", "online");
            for topic in ["homeassistant/device/busker_relays/config", "busker/counters/availability"] {
                stage.watcher.wait_until(topic, |got| got.topic == topic);
            }
            stage.watcher.wait_for("busker/relays/relay_3", "ON");
            stage.watcher.wait_for("busker/bridge/state", "online");
        },
    },
];

#[test]
fn whatever_happens_to_the_broker_nothing_is_lost_and_no_stale_command_is_obeyed() {
    let results: Mutex<Vec<Option<Vec<String>>>> = Mutex::new(vec![None; ROWS.len()]);
    let next = Mutex::new(0..ROWS.len());
    thread::scope(|scope| {
        for _ in 0..AT_ONCE {
            scope.spawn(|| {
                loop {
                    let Some(index) = next.lock().expect("nobody panics with it").next() else { return };
                    let row = &ROWS[index];
                    // A row that fails says itself why; the others go on.
                    let lost = thread::Builder::new()
                        .name(row.fault.into())
                        .spawn(|| row.run())
                        .expect("a thread")
                        .join()
                        .unwrap_or_else(|_| vec!["everything: the test of this row failed".into()]);
                    results.lock().expect("nobody panics with it")[index] = Some(lost);
                }
            });
        }
    });
    let results = results.into_inner().expect("nobody panicked with it");
    let results: Vec<Vec<String>> = results.into_iter().map(|lost| lost.expect("each row has run")).collect();
    let mut table =
        "| what is done to the broker | a command given meanwhile | lost |\n|---|---|---|\n".to_string();
    for (row, lost) in ROWS.iter().zip(&results) {
        let lost = if lost.is_empty() { "nothing".into() } else { lost.join(", ") };
        table += &format!("| {} | {} | {lost} |\n", row.fault, row.command.told());
    }
    assert!(results.iter().all(Vec::is_empty), "something is lost:\n{table}");
    table::check_document(DOCUMENT, &table);
}

impl Row {
    /// What is lost by this fault.
    fn run(&self) -> Vec<String> {
        let mut stage = Stage::set(self);
        let mut expected = stage.retained("before");
        assert!(expected.len() > 60, "{expected:?}");
        let resident = stage.gateway.resident();

        (self.act)(&mut stage);

        for topic in ["busker/relays/relay_3", "busker/relays/relay_3_hand"] {
            expected.insert(topic.into(), "ON".into());
        }
        if self.command == Meanwhile::ObeyedAtOnce {
            expected.insert("busker/relays/relay_1".into(), "ON".into());
        }
        let mut lost = stage.lost(&expected);
        stage.check_commands(self.command);
        // The answer to the last command has been told: what was queued has been sent.
        let health = stage.health();
        assert_eq!(health["broker"]["dropped"], 0, "{health}");
        assert_eq!(health["broker"]["client_id_taken"], false, "{health}");
        assert_eq!(health["status"], "ok", "{health}");
        let growth = stage.gateway.resident().saturating_sub(resident);
        assert!(growth < GROWTH_MAX, "{growth} bytes more than before");
        if self.command == Meanwhile::ObeyedAtOnce && stage.outcomes(1) != ["done"] {
            lost.push("the outcome".into());
        }
        lost
    }
}

impl Stage {
    fn set(row: &Row) -> Stage {
        let broker = if row.persistent { Broker::start_persistent() } else { Broker::start() };
        let proxy = Proxy::to(broker.port);
        let simulation = simulation();
        let port = over_tcp(&simulation);
        let watcher = Watcher::start(&broker, "watcher");
        let gateway = Gateway::start_with(&format!(
            "mqtt: {{url: 'mqtt://127.0.0.1:{}', keep_alive: {}}}\n{}",
            proxy.port,
            row.keep_alive,
            configuration(&port)
        ));
        super::wait_until_all_is_online(&watcher);
        watcher.wait_for("busker/relays/relay_4", "OFF");
        gateway.wait_for_health(200);
        watcher.wait_until("health", |got| got.topic == "busker/bridge/health");
        Stage { broker, proxy, simulation, _port: port, gateway, watcher }
    }

    /// While the gateway knows that the broker is away: a device changes, and what waits is counted.
    fn meanwhile(&self) {
        self.gateway.wait_for_health(503);
        self.hand();
        let waiting = || self.health()["broker"]["waiting"].as_u64().expect("a number");
        // One for each topic, and what is told once.
        assert!(waiting() < 400, "{} messages wait", waiting());
    }

    /// Until the gateway asks for the question's own sake, which it does when it has nothing to tell.
    fn wait_for_question(&self) {
        self.proxy.forget_told();
        self.proxy.wait_until_told(b"busker/bridge/question");
    }

    /// Of the command given meanwhile. Then a device changes.
    fn expect_outcome(&self) {
        let is_told = |got: &Received| got.topic == "busker/relays/relay_1/outcome";
        self.watcher.wait_until("the outcome", is_told);
        // What comes right behind a stall may have been sent in it.
        thread::sleep(Duration::from_millis(600));
        self.hand();
    }

    fn hand(&self) {
        self.simulation.command("unit 18 relay 3 hand on").expect("a hand on the relay");
    }

    fn health(&self) -> serde_json::Value {
        json(&self.gateway.get("/health").1)
    }

    fn connects(&self) -> u64 {
        self.health()["broker"]["connects"].as_u64().expect("a number")
    }

    #[track_caller]
    fn wait_for_connects(&self, count: u64) {
        let connected = || (self.connects() >= count).then_some(());
        support::find(connected).unwrap_or_else(|| panic!("{}", self.gateway.log().join("\n")));
    }

    /// What the broker remembers, by topic.
    fn retained(&self, name: &str) -> BTreeMap<String, String> {
        let all = remembered(&self.broker, name).into_iter();
        let ours = all.filter(|got| !got.topic.ends_with("/set"));
        ours.map(|got| (got.topic, got.payload)).collect()
    }

    /// What of this the broker does not come to remember, and what it should not.
    fn lost(&self, expected: &BTreeMap<String, String>) -> Vec<String> {
        let mut lost = Vec::new();
        let _ = support::find(|| {
            let found = self.retained("after");
            let is_wrong = |topic: &&String| match found.get(*topic) {
                // They tell counts and times.
                Some(_) if topic.ends_with("/info") || topic.ends_with("/health") => false,
                Some(payload) => *payload != expected[*topic],
                None => true,
            };
            let strange = found.keys().filter(|topic| !expected.contains_key(*topic));
            lost = expected.keys().filter(is_wrong).chain(strange).cloned().collect();
            lost.is_empty().then_some(())
        });
        lost
    }

    /// The outcomes of commands to a relay that the watcher has seen. One may come twice, when its
    /// confirmation was lost.
    fn outcomes(&self, number: u8) -> Vec<String> {
        let told = self.watcher.payloads(&format!("busker/relays/relay_{number}/outcome"));
        let mut outcomes: Vec<String> = told
            .iter()
            .map(|payload| json(payload)["outcome"].as_str().expect("an outcome").to_string())
            .collect();
        outcomes.dedup();
        outcomes
    }

    /// A new command works, and the one given meanwhile did not wait before it.
    fn check_commands(&self, meanwhile: Meanwhile) {
        self.watcher.publish("busker/relays/relay_2/set", "ON");
        self.watcher.wait_until("an outcome", |got| got.topic == "busker/relays/relay_2/outcome");
        assert_eq!(self.outcomes(2), ["done"], "commands work");
        assert_eq!(relay(&self.simulation, 2), "ON");
        let (obeyed, written) = match meanwhile {
            Meanwhile::ObeyedAtOnce => ("ON", 2),
            _ => ("OFF", 1),
        };
        assert_eq!(relay(&self.simulation, 1), obeyed, "its outcomes are {:?}", self.outcomes(1));
        let (_, metrics) = self.gateway.get("/metrics");
        let writes = "busker_device_writes_total{bus=\"line\",device=\"relays\"} ";
        let writes = metrics.lines().find_map(|line| line.strip_prefix(writes)).expect("writes are counted");
        assert_eq!(writes, written.to_string(), "no command but these was obeyed");
        match meanwhile {
            Meanwhile::NotGiven | Meanwhile::ObeyedAtOnce => {}
            Meanwhile::NotObeyed => assert!(!self.outcomes(1).contains(&"done".to_string())),
            Meanwhile::Expires => assert_eq!(self.outcomes(1), ["expired"]),
        }
    }
}
