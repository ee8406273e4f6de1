//! The whole program on lines that misbehave: whatever comes, nothing false is published, each
//! fault is counted as what it was, and the next reading is right.

mod by_hand;
mod doctor;
mod identify;
mod pcapng;
#[path = "../support/peer.rs"]
mod peer;
mod recorder;
mod scan;
mod settings;
#[path = "../support/mod.rs"]
mod support;
mod typed;

use peer::{ALIKE, Asked, Framing, LIE, Misbehave, Peer, Step, lie, read_pdu, reply, rtu};
use serde_json::Value;
use support::{Broker, Gateway, Watcher, wait_for};

/// How long the gateway waits for a reply, and then for a late one, in milliseconds.
const TIMEOUT: u64 = 500;

/// The counters that a fault may raise; the others follow the polls.
const FAULTS: [&str; 9] = [
    "timeouts",
    "checksum_errors",
    "collisions",
    "wrong_frames",
    "exceptions",
    "late_replies",
    "foreign_frames",
    "echoes",
    "noise_bytes",
];

/// What is done to one reply, and what that counts as.
struct Fault {
    name: &'static str,
    how: Misbehave,
    counts: &'static [(&'static str, u64)],
}

const RTU_FAULTS: &[Fault] = &[
    Fault { name: "silence", how: |_, _| vec![], counts: &[("timeouts", 1)] },
    Fault {
        name: "a late reply before the next request",
        how: |asked, _| vec![Step::Pause(TIMEOUT + 100), Step::Say(lie(asked))],
        counts: &[("timeouts", 1), ("late_replies", 1)],
    },
    Fault {
        name: "a late reply after the next request",
        how: |asked, _| vec![Step::SayBeforeNext(lie(asked))],
        counts: &[("timeouts", 1), ("late_replies", 1)],
    },
    Fault {
        name: "a different count",
        how: |asked, _| vec![Step::Say(rtu(asked.unit, &read_pdu(4, &[LIE, LIE])))],
        counts: &[("wrong_frames", 1), ("foreign_frames", 1)],
    },
    Fault {
        name: "another function",
        how: |asked, _| vec![Step::Say(rtu(asked.unit, &read_pdu(3, &[LIE])))],
        counts: &[("wrong_frames", 1), ("foreign_frames", 1)],
    },
    Fault {
        name: "a wrong checksum",
        how: |asked, _| vec![Step::Say(changed(lie(asked), |frame| frame[6] ^= 0x10))],
        counts: &[("checksum_errors", 1)],
    },
    Fault {
        name: "a wrong checksum, cut short",
        how: |asked, _| vec![Step::Say(changed(lie(asked), |frame| frame.truncate(4)))],
        counts: &[("checksum_errors", 1)],
    },
    Fault {
        name: "a wrong checksum, a byte too many",
        how: |asked, _| vec![Step::Say(changed(lie(asked), |frame| frame.insert(4, 0x55)))],
        counts: &[("checksum_errors", 1)],
    },
    Fault {
        name: "30 noise bytes first",
        how: |_, good| vec![Step::Say([noise(30), good].concat())],
        counts: &[("noise_bytes", 30)],
    },
    Fault {
        name: "noise behind",
        how: |_, good| vec![Step::Say([good, noise(3)].concat())],
        counts: &[("noise_bytes", 3)],
    },
    Fault {
        name: "a zero byte first",
        how: |_, good| vec![Step::Say([vec![0], good].concat())],
        counts: &[("noise_bytes", 1)],
    },
    Fault { name: "single bytes", how: |_, good| in_single_bytes(good), counts: &[] },
    Fault {
        name: "another unit's reply first",
        how: |_, good| vec![Step::Say(rtu(9, &read_pdu(4, &[LIE]))), Step::Pause(10), Step::Say(good)],
        counts: &[("foreign_frames", 1)],
    },
    Fault {
        name: "only another unit's reply",
        how: |_, _| vec![Step::Say(rtu(9, &read_pdu(4, &[LIE])))],
        counts: &[("wrong_frames", 1), ("foreign_frames", 1)],
    },
    Fault {
        name: "somebody's broadcast first",
        how: |_, good| vec![Step::Say(rtu(0, &[6, 0, 0, 0x27, 0x0F])), Step::Pause(10), Step::Say(good)],
        counts: &[("foreign_frames", 1)],
    },
    Fault {
        name: "an echo of the request first",
        how: |asked, good| vec![Step::Say(asked.frame.clone()), Step::Pause(5), Step::Say(good)],
        counts: &[("echoes", 1)],
    },
    Fault {
        name: "an echo and nothing else",
        how: |asked, _| vec![Step::Say(asked.frame.clone())],
        counts: &[("timeouts", 1), ("echoes", 1)],
    },
];

const TCP_FAULTS: &[Fault] = &[
    Fault { name: "silence", how: |_, _| vec![], counts: &[("timeouts", 1)] },
    Fault {
        name: "a late reply",
        how: |asked, _| vec![Step::Pause(TIMEOUT + 100), Step::Say(tcp_lie(asked))],
        counts: &[("timeouts", 1), ("late_replies", 1)],
    },
    Fault {
        name: "a late reply after the next request",
        how: |asked, _| vec![Step::SayBeforeNext(tcp_lie(asked))],
        counts: &[("timeouts", 1), ("late_replies", 1)],
    },
    Fault {
        name: "a different count",
        how: |asked, _| vec![Step::Say(reply(asked, Framing::Tcp, &read_pdu(4, &[LIE, LIE])))],
        counts: &[("wrong_frames", 1), ("foreign_frames", 1)],
    },
    Fault {
        name: "another unit",
        how: |asked, _| vec![Step::Say(changed(tcp_lie(asked), |frame| frame[6] = 9))],
        counts: &[("wrong_frames", 1), ("foreign_frames", 1)],
    },
    Fault {
        name: "another transaction first",
        how: |asked, good| {
            vec![Step::Say([changed(tcp_lie(asked), |frame| frame[0] ^= 0x80), good].concat())]
        },
        counts: &[("foreign_frames", 1)],
    },
    Fault { name: "single bytes", how: |_, good| in_single_bytes(good), counts: &[] },
];

fn tcp_lie(asked: &Asked) -> Vec<u8> {
    reply(asked, Framing::Tcp, &read_pdu(4, &[LIE]))
}

fn changed(mut frame: Vec<u8>, change: fn(&mut Vec<u8>)) -> Vec<u8> {
    change(&mut frame);
    frame
}

fn noise(count: u8) -> Vec<u8> {
    (0..count).map(|index| 0x80 + 4 * index).collect()
}

fn in_single_bytes(frame: Vec<u8>) -> Vec<Step> {
    frame.into_iter().flat_map(|byte| [Step::Pause(3), Step::Say(vec![byte])]).collect()
}

#[test]
fn on_a_serial_line_every_fault_is_counted_and_none_is_believed() {
    check_faults(&Peer::on_a_pseudo_terminal(), MIXED, RTU_FAULTS);
}

#[test]
fn a_late_reply_is_not_believed_where_every_request_looks_like_the_last() {
    let is_late = |fault: &&Fault| fault.name.contains("late");
    let late: Vec<&Fault> = RTU_FAULTS.iter().filter(is_late).collect();
    check_faults(&Peer::on_a_pseudo_terminal(), ALIKE, late);
}

#[test]
fn through_a_serial_server_every_fault_is_counted_and_none_is_believed() {
    check_faults(&Peer::on_tcp(Framing::Rtu), MIXED, RTU_FAULTS);
}

#[test]
fn on_modbus_tcp_every_fault_is_counted_and_none_is_believed() {
    check_faults(&Peer::on_tcp(Framing::Tcp), MIXED, TCP_FAULTS);
}

/// Each fault happens once to a read of `busker/one/a`, which rises by one at the same time. The
/// other points of the same shape stay as they are: nothing of `a` may be told as theirs.
fn check_faults<'f>(peer: &Peer, devices: &str, faults: impl IntoIterator<Item = &'f Fault>) {
    let stage = Stage::start(peer, devices);
    let mut truth = 100;
    stage.watcher.shows("busker/one/a", "100");
    stage.watcher.shows("busker/one/b", "500");
    if devices == MIXED {
        stage.watcher.shows("busker/two/a", "700");
    }
    let mut expected = stage.counters();
    for fault in faults {
        truth += 1;
        peer.misbehave_once(1, 4, 0, fault.how);
        peer.hold(1, 4, 0, truth);
        wait_for(fault.name, || peer.has_misbehaved().then_some(()));
        stage.watcher.shows("busker/one/a", &truth.to_string());
        for (name, count) in fault.counts {
            let index = FAULTS.iter().position(|fault| fault == name).expect("a counter");
            expected[index] += count;
        }
        let mut found = Vec::new();
        let reached = support::find(|| {
            found = stage.counters();
            (found == expected).then_some(())
        });
        assert!(reached.is_some(), "{}:\n{}", fault.name, told(&found, &expected));
    }
    // Not one more, also after the last.
    let from = stage.watcher.count();
    peer.hold(1, 4, 100, 501);
    stage.watcher.wait_for_next("busker/one/b", from);
    assert_eq!(stage.counters(), expected);

    let told_of_a = stage.values("busker/one/a");
    let rising: Vec<u64> = (100..=u64::from(truth)).collect();
    assert_eq!(told_of_a, rising, "every value once and in order, nothing else");
    assert_eq!(stage.values("busker/one/b"), [500, 501]);
    assert_eq!(stage.values("busker/two/a"), if devices == MIXED { &[700][..] } else { &[] });
}

fn told(found: &[u64], expected: &[u64]) -> String {
    let rows = FAULTS.iter().zip(found).zip(expected);
    rows.map(|((name, found), expected)| format!("{name}: {found}, expected {expected}\n")).collect()
}

#[test]
fn a_write_is_not_confirmed_by_its_own_echo() {
    let peer = Peer::on_a_pseudo_terminal();
    peer.misbehave(|asked, good| vec![Step::Say(asked.frame.clone()), Step::Pause(4), Step::Say(good)]);
    let stage = Stage::start(&peer, MIXED);
    stage.watcher.shows("busker/one/relay", "OFF");
    assert_eq!(stage.set_relay("ON")["outcome"], "done");
    stage.watcher.shows("busker/one/relay", "ON");

    // The unit does not hear writes any more, but the adapter still returns them.
    peer.be_deaf_to_writes();
    let outcome = stage.set_relay("OFF");
    assert_ne!(outcome["outcome"], "done", "{outcome}");
    peer.hold(1, 4, 0, 101);
    stage.watcher.shows("busker/one/a", "101");
    let told: Vec<String> = stage.watcher.payloads("busker/one/relay");
    assert_eq!(told.last().map(String::as_str), Some("ON"), "{told:?}");
    assert_eq!(told.iter().filter(|payload| *payload == "OFF").count(), 1, "only at first: {told:?}");
}

#[test]
fn an_adapter_may_be_unplugged_and_plugged_in_again() {
    let peer = Peer::on_a_pseudo_terminal();
    let stage = Stage::start(&peer, MIXED);
    stage.watcher.shows("busker/one/a", "100");
    for truth in [101, 102] {
        peer.unplug();
        stage.watcher.shows("busker/one/availability", "offline");
        let reason = wait_for("the bus to be down", || {
            let bus = stage.bus()?;
            (bus["up"] == false).then(|| bus["reason"].as_str().unwrap_or_default().to_owned())
        });
        assert!(reason == "unplugged" || reason.contains("is the adapter plugged in?"), "{reason}");
        peer.hold(1, 4, 0, truth);
        peer.plug_in();
        stage.watcher.shows("busker/one/availability", "online");
        stage.watcher.shows("busker/one/a", &truth.to_string());
    }
    assert_eq!(stage.values("busker/one/a"), [100, 101, 102]);
}

#[test]
fn an_adapter_that_comes_back_under_another_name_is_found_by_its_link() {
    let peer = Peer::on_a_pseudo_terminal();
    let stage = Stage::start(&peer, MIXED);
    stage.watcher.shows("busker/one/a", "100");
    let old_name = std::fs::read_link(peer.path()).expect("the link leads to a port");
    assert!(stage.gateway.open_files().contains(&old_name));

    let from = stage.watcher.count();
    peer.unplug();
    stage.watcher.shows("busker/one/availability", "offline");
    for topic in ["busker/one/a", "busker/one/relay", "busker/two/a"] {
        stage.watcher.shows(topic, "None");
    }
    let info = stage.watcher.payloads("busker/one/info").pop().expect("it has been told");
    assert!(info.contains("the link is down: unplugged"), "{info}");
    // The name is free again as soon as the adapter is gone: held, it would force another one on it.
    let held = |held: &std::path::PathBuf| held.to_string_lossy().starts_with(&*old_name.to_string_lossy());
    assert!(!stage.gateway.open_files().iter().any(held), "{old_name:?} is still held open");

    // Another one has the old name meanwhile.
    let taken = peer::Placeholder::take(&old_name);
    peer.hold(1, 4, 0, 101);
    peer.plug_in();
    let new_name = std::fs::read_link(peer.path()).expect("the link leads to a port");
    assert_ne!(new_name, old_name);
    stage.watcher.shows("busker/one/availability", "online");
    stage.watcher.shows("busker/one/a", "101");
    stage.watcher.shows("busker/two/a", "700");
    drop(taken);
    let seen = stage.watcher.received();
    let told = seen[from..].iter().filter(|seen| seen.topic == "busker/one/a").map(|seen| &*seen.payload);
    assert_eq!(told.collect::<Vec<_>>(), ["None", "101"], "nothing else in between");
}

#[test]
fn a_request_that_comes_back_damaged_has_collided_and_is_asked_again() {
    let peer = Peer::on_a_pseudo_terminal();
    let echoed: Misbehave =
        |asked, good| vec![Step::Say(asked.frame.clone()), Step::Pause(4), Step::Say(good)];
    peer.misbehave(echoed);
    let stage = Stage::start(&peer, MIXED);
    stage.watcher.shows("busker/one/a", "100");
    // What another master asks of the same unit at the same time is answered; it looks like our reply.
    let collisions: [Misbehave; 3] = [
        |asked, _| {
            vec![Step::Say(changed(asked.frame.clone(), |frame| frame[4] ^= 0x3C)), Step::Say(lie(asked))]
        },
        |asked, _| vec![Step::Say(rtu(asked.unit, &[4, 0, 99, 0, 1])), Step::Pause(4), Step::Say(lie(asked))],
        |asked, _| vec![Step::Say(asked.frame[..3].to_vec())],
    ];
    for (count, how) in (1..).zip(collisions) {
        let from = stage.watcher.count();
        peer.misbehave_once(1, 4, 0, how);
        peer.hold(1, 4, 0, 100 + count);
        assert_eq!(stage.watcher.wait_for_next("busker/one/a", from), (100 + count).to_string());
        wait_for("the collision to be counted", || (stage.bus()?["collisions"] == count).then_some(()));
    }
    assert_eq!(stage.values("busker/one/a"), [100, 101, 102, 103]);
    assert!(!stage.watcher.payloads("busker/one/availability")[1..].contains(&"offline".to_string()));
    let bus = wait_for("the API", || stage.bus());
    assert_eq!((&bus["timeouts"], &bus["checksum_errors"]), (&0.into(), &0.into()), "{bus}");

    // A write whose echo is damaged is not confirmed by what follows, but by what the unit holds.
    peer.misbehave_once(1, 5, 0, |asked, good| {
        vec![Step::Say(changed(asked.frame.clone(), |frame| frame[2] ^= 1)), Step::Pause(30), Step::Say(good)]
    });
    assert_eq!(stage.set_relay("ON")["outcome"], "done");
    wait_for("the collision to be counted", || (stage.bus()?["collisions"] == 4).then_some(()));
}

#[test]
fn a_second_master_is_told_and_the_link_stays() {
    let peer = Peer::on_a_pseudo_terminal();
    let stage = Stage::start(&peer, MIXED);
    stage.watcher.shows("busker/one/a", "100");
    peer.misbehave_once(1, 4, 0, |_, good| {
        let others = [rtu(7, &[3, 0, 0, 0, 2]), rtu(7, &read_pdu(3, &[LIE, LIE])), rtu(7, &[3, 0, 2, 0, 2])];
        let said = others.into_iter().flat_map(|frame| [Step::Pause(10), Step::Say(frame)]);
        [Step::Say(good)].into_iter().chain(said).collect()
    });
    let told = "another master speaks on this line: 2 requests to unit 7 in the last minute";
    let bus = wait_for("the second master to be told", || stage.bus().filter(|bus| bus["reason"] == told));
    assert_eq!((&bus["up"], &bus["foreign_frames"]), (&true.into(), &3.into()), "{bus}");
    let health = wait_for("the health", || stage.gateway.json("/health"));
    assert_eq!(health["buses"]["line"]["reason"], told);
    assert!(stage.gateway.has_said(&format!("bus line: {told}")));
    peer.hold(1, 4, 0, 101);
    stage.watcher.shows("busker/one/a", "101");
    assert_eq!(stage.values("busker/one/a"), [100, 101]);
}

/// Two units, with points of several kinds.
const MIXED: &str = "  one:
    bus: line
    unit: 1
    poll: {fast: 100ms}
    wire: {limits: {gap: 0}}
    points:
      a: {at: input 0, poll: fast}
      b: {at: input 100, poll: fast}
      relay: {at: coil 0, poll: fast, write: any}
  two:
    bus: line
    unit: 2
    poll: {fast: 100ms}
    points: {a: {at: input 0, poll: fast}}
";

/// The program on a peer's line, with a few devices.
struct Stage {
    // In the order in which they end.
    gateway: Gateway,
    watcher: Watcher,
    _broker: Broker,
}

impl Stage {
    fn start(peer: &Peer, devices: &str) -> Stage {
        Stage::start_with(peer, "", devices)
    }

    /// With more lines of configuration.
    fn start_with(peer: &Peer, sections: &str, devices: &str) -> Stage {
        peer.hold(1, 4, 0, 100);
        peer.hold(1, 4, 100, 500);
        peer.hold(2, 4, 0, 700);
        let broker = Broker::start();
        let watcher = Watcher::start(&broker, "watcher");
        let configuration = format!(
            "home_assistant: {{discovery: false}}
{sections}buses:
  line: {{{}, response_timeout: {TIMEOUT}ms}}
devices:
{devices}",
            peer.link()
        );
        let gateway = Gateway::start(&broker, &configuration);
        Stage { gateway, watcher, _broker: broker }
    }

    fn bus(&self) -> Option<Value> {
        self.gateway.json("/api/buses")?.get(0).cloned()
    }

    /// In the order of [`FAULTS`].
    fn counters(&self) -> Vec<u64> {
        let bus = wait_for("the API", || self.bus());
        FAULTS.iter().map(|name| bus[name].as_u64().expect("a counter")).collect()
    }

    /// Every value that was published, without `None` and without repetitions.
    fn values(&self, topic: &str) -> Vec<u64> {
        let payloads = self.watcher.payloads(topic);
        let numbers = payloads.iter().filter(|payload| *payload != "None");
        let mut values: Vec<u64> = numbers.map(|payload| payload.parse().expect("a number")).collect();
        values.dedup();
        values
    }

    fn set_relay(&self, wanted: &str) -> Value {
        let from = self.watcher.count();
        self.watcher.publish("busker/one/relay/set", wanted);
        let outcome = self.watcher.wait_for_next("busker/one/relay/outcome", from);
        serde_json::from_str(&outcome).expect("an outcome is JSON")
    }
}
