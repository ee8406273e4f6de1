//! Rows about lines and connections: silence, echo, direction, adapters that go, other masters, mute servers.

use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use busker::engine::time::Duration;

use crate::Row;
use crate::peer::{Framing, LIE, Peer, Placeholder, Step, read_pdu, rtu};
use crate::stage::{Shown, Stage};
use crate::support::wait_for;

pub const ROWS: &[Row] = &[
    Row {
        number: 3,
        fault: "The silence of 3.5 characters before a request is missing, above all when the unit changes",
        done: "Three strict units, which ignore a request that comes sooner, at 19200 8E1",
        seen: "None is ignored: the silence is counted from the last byte on the wire, in either direction",
        run: strict_units,
    },
    Row {
        number: 6,
        fault: "The adapter returns every request",
        done: "Each request comes back before the reply; now and then it comes back damaged, with another's reply behind it; later the unit no longer hears writes",
        seen: "Skips the copy, counted as `echoes`. One that is not what was sent is a collision, counted as `collisions`: the read is asked again at once, and what came behind it is shown nowhere. A copy is no confirmation of a write: the outcome is not `done`",
        run: echo,
    },
    Row {
        number: 7,
        fault: "The transceiver is turned round too early or too late",
        done: "A 00 of the floating line before each reply; one reply in three has lost its first byte, at no fixed step",
        seen: "The spoilt ones are asked again, and nothing is read out of them. `rs485: kernel` asks the driver to turn the direction at the right moment, and names the driver that cannot. (That it does was not tried here: a pseudo-terminal has no direction, and refuses)",
        run: direction,
    },
    Row {
        number: 8,
        fault: "The adapter is pulled out, and comes back under another name",
        done: "The pseudo-terminal goes, and another gets its name; a new one comes behind the same link, as udev keeps it in `/dev/serial/by-id/`",
        seen: "Closes the dead port at once, so that its name is free, says that it is unplugged, and goes on with the new one, whatever has the old name",
        run: unplugged,
    },
    Row {
        number: 12,
        fault: "A unit takes the next request for the reply of a silent one",
        done: "Units that hear a request to another unit wait 400 ms for its reply, and take whatever comes for it; one unit dies",
        seen: "The 500 ms of the default timeout and a quarantine behind it keep requests apart; with `response_timeout` in its profile the probes of a dead unit too",
        run: confused_units,
    },
    Row {
        number: 19,
        fault: "A second master on the line",
        done: "Requests to other units, to our own one, and their replies, while we wait and while we do not",
        seen: "Counts them as `foreign_frames`, takes none of them, and keeps the line; the bus's reason says that another master speaks on it, and to which unit. (Its reply to the same question of the same unit, at the same moment, could not be told from ours)",
        run: second_master,
    },
    Row {
        number: 21,
        fault: "A serial server accepts connections and stays mute",
        done: "The first two connections are accepted and never answered, with Modbus TCP and with RTU",
        seen: "After five unanswered requests in a row it connects anew, until there are answers",
        run: mute_server,
    },
    Row {
        number: 22,
        fault: "A request begins while the second stop bit of the reply is on the wire",
        done: "A unit at 9600 8N2 hears nothing before 3.5 characters less one bit are over",
        seen: "Every request is heard",
        run: second_stop_bit,
    },
    Row {
        number: 26,
        fault: "A server closes its connections: each behind the answer, or one on which nothing was asked for a while",
        done: "Modbus TCP and RTU over TCP: each connection is closed behind its first answer; later each that is idle for 300 ms",
        seen: "Connects again at once, tells nobody, and loses no command; where each connection is good for one answer, makes one for each request",
        run: closing_server,
    },
];

const THREE: &str = "  one: {bus: line, unit: 1, poll: {fast: 100ms}, points: {a: {at: input 0, poll: fast}}}
  two: {bus: line, unit: 2, poll: {fast: 100ms}, points: {a: {at: input 0, poll: fast}}}
  three: {bus: line, unit: 3, poll: {fast: 100ms}, points: {a: {at: input 0, poll: fast}}}
";
const THREE_SHOWN: [Shown; 3] = [("one/a", (1, 4, 0)), ("two/a", (2, 4, 0)), ("three/a", (3, 4, 0))];

const RELAY: &str = "  one:
    bus: line
    unit: 1
    poll: {fast: 100ms}
    points:
      a: {at: input 0, poll: fast}
      relay: {at: coil 0, poll: fast, write: any}
";
const RELAY_SHOWN: [Shown; 2] = [("one/a", (1, 4, 0)), ("one/relay", (1, 1, 0))];

/// Units that ignore what comes before the line has been silent for so long.
fn deaf_before(peer: &Peer, silence: Duration) -> Arc<AtomicUsize> {
    let ignored = Arc::new(AtomicUsize::new(0));
    let count = ignored.clone();
    let mut is_first = true;
    peer.misbehave(move |asked, good| {
        if asked.silence < silence && !std::mem::take(&mut is_first) {
            count.fetch_add(1, Ordering::SeqCst);
            return Vec::new();
        }
        vec![Step::Say(good)]
    });
    ignored
}

/// Polls all three for a while, and finds that nothing was ignored.
fn none_is_ignored(line: &str, silence: Duration) {
    let peer = Peer::on_a_pseudo_terminal();
    let ignored = deaf_before(&peer, silence);
    let link = format!("serial: {}, {line}", peer.path().display());
    // So often that each request comes right behind a reply.
    let devices = THREE.replace("100ms", "5ms");
    let stage = Stage::start_on(&peer, &link, &devices, &THREE_SHOWN);
    stage.shows_all();
    wait_for("a hundred requests", || (peer.asked().len() >= 100).then_some(()));
    assert_eq!(ignored.load(Ordering::SeqCst), 0, "requests came too early");
    stage.ends_well();
}

fn strict_units() {
    // 3.5 characters of 11 bits.
    none_is_ignored("baud: 19200, parity: even", Duration::from_micros(2005));
}

fn second_stop_bit() {
    // 3.5 characters of 11 bits, less one bit.
    none_is_ignored("baud: 9600, parity: none, stop_bits: 2", Duration::from_micros(4010 - 104));
}

fn echo() {
    let peer = Peer::on_a_pseudo_terminal();
    let damages = Arc::new(AtomicBool::new(false));
    let (collides, mut reads) = (damages.clone(), 0);
    peer.misbehave(move |asked, good| {
        let mut returned = asked.frame.clone();
        if asked.function == 4 && collides.load(Ordering::SeqCst) {
            reads += 1;
            if reads % 5 == 0 {
                // What another master asked of the same unit is answered.
                returned[3] ^= 0x3C;
                return vec![Step::Say(returned), Step::Pause(4), Step::Say(rtu(1, &read_pdu(4, &[LIE])))];
            }
        }
        vec![Step::Say(returned), Step::Pause(4), Step::Say(good)]
    });
    let stage = Stage::start(&peer, "", RELAY, &RELAY_SHOWN);
    stage.shows_all();
    assert_eq!(stage.command("one/relay", "ON")["outcome"], "done");
    stage.counts("echoes", 10);
    damages.store(true, Ordering::SeqCst);
    stage.counts("collisions", 3);
    stage.tells_changes();
    damages.store(false, Ordering::SeqCst);
    // A collision is no silence, and no fault of the unit's.
    assert_eq!((stage.counter("timeouts"), stage.counter("checksum_errors")), (0, 0));
    assert_eq!(stage.watcher.payloads("busker/one/availability").last().map(String::as_str), Some("online"));
    peer.be_deaf_to_writes();
    let outcome = stage.command("one/relay", "OFF");
    assert_ne!(outcome["outcome"], "done", "{outcome}");
    stage.ends_well();
}

fn direction() {
    let peer = Peer::on_a_pseudo_terminal();
    let mut count = 0;
    peer.misbehave(move |_, good| {
        count += 1;
        // At no fixed step, which could be that of the polls: then one point would be spoilt each time.
        let from = usize::from(matches!(count % 9, 0 | 3 | 5));
        vec![Step::Say([&[0], &good[from..]].concat())]
    });
    let stage = Stage::start(&peer, "", RELAY, &RELAY_SHOWN);
    stage.shows_all();
    for _ in 0..3 {
        stage.tells_changes();
    }
    stage.counts("checksum_errors", 2);
    stage.ends_well();
}

fn unplugged() {
    let peer = Peer::on_a_pseudo_terminal();
    let stage = Stage::start(&peer, "", RELAY, &RELAY_SHOWN);
    stage.shows_all();
    let terminal = || fs::read_link(peer.path()).expect("a link to the terminal");
    let before = terminal();
    let holds = |path: &Path| {
        let files = stage.gateway.open_files();
        files.iter().any(|file| file.to_string_lossy().starts_with(&*path.to_string_lossy()))
    };
    assert!(holds(&before), "the port is open");
    peer.unplug();
    stage.watcher.shows("busker/one/availability", "offline");
    stage.watcher.shows("busker/one/a", "None");
    wait_for("the dead port to be closed", || (!holds(&before)).then_some(()));
    let reason = wait_for("the bus to be down", || stage.bus()?["reason"].as_str().map(str::to_owned));
    assert!(reason == "unplugged" || reason.contains("is the adapter plugged in?"), "{reason}");
    // Somebody else gets the old name.
    let others = Placeholder::take(&before);
    peer.plug_in();
    assert_ne!(terminal(), before, "another name");
    stage.watcher.shows("busker/one/availability", "online");
    stage.shows_all();
    assert_eq!(stage.command("one/relay", "ON")["outcome"], "done");
    stage.ends_well();
    drop(others);
}

fn confused_units() {
    let peer = Peer::on_a_pseudo_terminal();
    let (is_dead, swallowed) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicUsize::new(0)));
    let (dead, swallows) = (is_dead.clone(), swallowed.clone());
    let mut awaits_reply = false;
    peer.misbehave(move |asked, good| {
        if asked.unit == 1 && dead.load(Ordering::SeqCst) > 0 {
            dead.fetch_add(1, Ordering::SeqCst);
            awaits_reply = true;
            return Vec::new();
        }
        if std::mem::take(&mut awaits_reply) && asked.silence < Duration::from_millis(400) {
            swallows.fetch_add(1, Ordering::SeqCst);
            return Vec::new();
        }
        vec![Step::Say(good)]
    });
    let devices = "  one: {bus: line, unit: 1, poll: {fast: 100ms}, wire: {response_timeout: 500ms}, points: {b: {at: input 0, poll: fast}}}
  two:
    bus: line
    unit: 2
    poll: {fast: 100ms}
    points: {a: {at: input 0, poll: fast}, relay: {at: coil 0, poll: fast, write: any}}
";
    let stage = Stage::start(&peer, "", devices, &[("two/a", (2, 4, 0)), ("two/relay", (2, 1, 0))]);
    stage.shows_all();
    stage.watcher.shows("busker/one/availability", "online");
    is_dead.store(1, Ordering::SeqCst);
    stage.watcher.shows("busker/one/availability", "offline");
    wait_for("two probes", || (is_dead.load(Ordering::SeqCst) > 5).then_some(()));
    assert_eq!(stage.command("two/relay", "ON")["outcome"], "done");
    // One may be lost where the machine keeps this thread waiting.
    let lost = swallowed.load(Ordering::SeqCst);
    assert!(lost <= 1, "{lost} requests were taken for replies");
    stage.ends_well();
}

fn second_master() {
    let peer = Peer::on_a_pseudo_terminal();
    let lies = |unit: u8, count: u16| {
        let words = vec![LIE; usize::from(count)];
        [rtu(unit, &[4, 0, 0, 0, count as u8]), rtu(unit, &read_pdu(4, &words))]
    };
    let mut count = 0;
    peer.misbehave(move |_, good| {
        count += 1;
        let speaks =
            |frames: [Vec<u8>; 2]| frames.into_iter().flat_map(|frame| [Step::Say(frame), Step::Pause(8)]);
        let own = [Step::Say(good)];
        match count % 4 {
            0 => speaks(lies(9, 1)).chain(own).collect(),
            1 => own.into_iter().chain([Step::Pause(20)]).chain(speaks(lies(9, 1))).collect(),
            2 => speaks(lies(1, 2)).chain(own).collect(),
            _ => own.into_iter().chain([Step::Pause(20)]).chain(speaks(lies(1, 2))).collect(),
        }
    });
    let stage = Stage::start(&peer, "", RELAY, &RELAY_SHOWN);
    stage.shows_all();
    assert_eq!(stage.command("one/relay", "ON")["outcome"], "done");
    for _ in 0..3 {
        stage.tells_changes();
    }
    stage.counts("foreign_frames", 20);
    let bus = wait_for("the API", || stage.bus());
    assert_eq!((&bus["up"], &bus["answers"]), (&true.into(), &bus["requests"]), "{bus}");
    let reason = bus["reason"].as_str().unwrap_or_default();
    assert!(reason.starts_with("another master speaks on this line: "), "{bus}");
    stage.ends_well();
}

fn mute_server() {
    for framing in [Framing::Tcp, Framing::Rtu] {
        let peer = Peer::on_tcp(framing);
        peer.misbehave(|asked, good| if asked.connection < 2 { Vec::new() } else { vec![Step::Say(good)] });
        let stage = Stage::start(&peer, "response_timeout: 100ms", THREE, &THREE_SHOWN);
        stage.shows_all();
        assert!(peer.connections() >= 3);
        stage.ends_well();
    }
}

fn closing_server() {
    for framing in [Framing::Tcp, Framing::Rtu] {
        let peer = Peer::on_tcp(framing);
        peer.misbehave(|_, good| vec![Step::Say(good), Step::HangUp]);
        let devices = "  one: {bus: line, unit: 1, poll: {fast: 100ms}, points: {a: {at: input 0, poll: fast}, \
                       b: {at: holding 7, poll: fast, write: 0..9}, c: {at: input 900, poll: fast}}}\n";
        let shown = [("one/a", (1, 4, 0)), ("one/b", (1, 3, 7)), ("one/c", (1, 4, 900))];
        let stage = Stage::start(&peer, "", devices, &shown);
        stage.shows_all();
        wait_for("a connection for each request", || (peer.connections() >= 10).then_some(()));
        assert_eq!(stage.command("one/b", "5")["outcome"], "done");
        stage.tells_changes();
        assert_eq!(stage.counter("timeouts"), 0);
        let was_offline =
            |told: &[String]| told.iter().skip_while(|told| *told != "online").any(|told| told == "offline");
        let availability = stage.watcher.payloads("busker/one/availability");
        assert!(!was_offline(&availability), "{availability:?}");
        let log = stage.gateway.log();
        assert!(!log.iter().any(|line| line.contains("WARN")), "{log:?}");
        // Now it closes only those on which it says nothing for a while; the polls come more seldom than that.
        peer.misbehave(|_, good| vec![Step::Say(good), Step::Pause(300), Step::HangUp]);
        stage.ends_well();
    }
}
