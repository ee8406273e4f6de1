//! Rows about units with wishes and habits of their own.

use std::collections::BTreeMap;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use busker::edge::clock::Clock;
use busker::engine::time::{Duration, Time};

use crate::Row;
use crate::peer::{Framing, Peer, Step, exception, rtu};
use crate::stage::Stage;
use crate::support::{program, wait_for};

pub const ROWS: &[Row] = &[
    Row {
        number: 9,
        fault: "Devices that want silence before each request, or behind a connect",
        done: "A unit ignores what comes within 60 ms of its last reply, another beside it does not; a network device stays mute on a connection on which it was asked within 300 ms, and hangs up once",
        seen: "Keeps `delay` for the one and not for the other, and `connect_delay` behind each connect",
        run: delays,
    },
    Row {
        number: 11,
        fault: "One dead unit slows the bus",
        done: "One unit of three falls silent, and comes back",
        seen: "Asks it ever less often, with short probes: the others have a hundred reads to at most fifteen of them. It is offline with the reason, and shown again soon after it answers",
        run: dead_unit,
    },
    Row {
        number: 13,
        fault: "Nobody replies to a broadcast; and unit 0 of Modbus TCP is an ordinary one",
        done: "A write to unit 0 of a serial line by hand; unit 0 in a configuration of Modbus TCP",
        seen: "Sends the broadcast once, waits for nobody, refuses to read by it; reads and writes unit 0 on TCP like any other. A configuration with unit 0 on a serial line is refused",
        run: broadcasts,
    },
    Row {
        number: 15,
        fault: "A register takes only function 6, or only 16; a coil only 15",
        done: "Units that refuse the other function with exception 1; one refuses them all, with another function's code",
        seen: "Writes with the function that `write_with` names; what is refused has the outcome `refused` with the exception, and nothing is shown but what is read",
        run: write_functions,
    },
];

fn delays() {
    let peer = Peer::on_a_pseudo_terminal();
    let clock = Clock::start();
    let mut answered_at: BTreeMap<u8, Time> = BTreeMap::new();
    peer.misbehave(move |asked, good| {
        let now = clock.now();
        let silent_for = answered_at.insert(asked.unit, now).map(|before| now - before);
        match silent_for {
            Some(silence) if asked.unit == 1 && silence < Duration::from_millis(60) => Vec::new(),
            _ => vec![Step::Say(good)],
        }
    });
    let devices = "  one:
    bus: line
    unit: 1
    poll: {fast: 50ms}
    wire: {limits: {delay: 80ms, gap: 0}}
    points: {a: {at: input 0, poll: fast}, b: {at: input 9, poll: fast}}
  two: {bus: line, unit: 2, poll: {fast: 50ms}, points: {a: {at: input 0, poll: fast}}}
";
    let shown = [("one/a", (1, 4, 0)), ("one/b", (1, 4, 9)), ("two/a", (2, 4, 0))];
    let stage = Stage::start(&peer, "response_timeout: 5s", devices, &shown);
    stage.shows_all();
    wait_for("sixty requests", || (peer.asked().len() >= 60).then_some(()));
    let bus = wait_for("the API", || stage.bus());
    assert_eq!(bus["timeouts"], 0, "{bus}");
    let of_unit = |unit: u8| peer.asked().iter().filter(|asked| asked.unit == unit).count();
    assert!(of_unit(2) > 10, "the one without a delay is asked meanwhile");
    stage.ends_well();

    let peer = Peer::on_tcp(Framing::Tcp);
    let (mut mute, mut has_hung_up) = (None, false);
    peer.misbehave(move |asked, good| {
        if asked.connected_for < Duration::from_millis(300) {
            mute = Some(asked.connection);
        }
        if mute == Some(asked.connection) {
            return Vec::new();
        }
        if !std::mem::replace(&mut has_hung_up, true) {
            return vec![Step::Say(good), Step::Pause(300), Step::HangUp];
        }
        vec![Step::Say(good)]
    });
    let devices = "  one: {bus: line, unit: 1, poll: {fast: 100ms}, wire: {connect_delay: 1s}, points: {a: {at: input 0, poll: fast}}}\n";
    let stage = Stage::start(&peer, "", devices, &[("one/a", (1, 4, 0))]);
    stage.shows_all();
    wait_for("another connection", || (peer.connections() >= 2).then_some(()));
    stage.ends_well();
}

fn dead_unit() {
    let peer = Peer::on_a_pseudo_terminal();
    let is_dead = Arc::new(AtomicBool::new(false));
    let dead = is_dead.clone();
    peer.misbehave(move |asked, good| match asked.unit == 3 && dead.load(Ordering::SeqCst) {
        true => Vec::new(),
        false => vec![Step::Say(good)],
    });
    let devices = "  one: {bus: line, unit: 1, poll: {fast: 50ms}, points: {a: {at: input 0, poll: fast}}}
  two: {bus: line, unit: 2, poll: {fast: 50ms}, points: {a: {at: input 0, poll: fast}}}
  three: {bus: line, unit: 3, poll: {fast: 50ms}, points: {a: {at: input 0, poll: fast}}}
";
    let shown = [("one/a", (1, 4, 0)), ("two/a", (2, 4, 0)), ("three/a", (3, 4, 0))];
    let stage = Stage::start(&peer, "response_timeout: 200ms", devices, &shown);
    stage.shows_all();
    let from = peer.asked().len();
    is_dead.store(true, Ordering::SeqCst);
    stage.watcher.shows("busker/three/availability", "offline");
    stage.watcher.shows("busker/three/a", "None");
    let of_dead = || peer.asked()[from..].iter().filter(|asked| asked.unit == 3).count();
    wait_for("a hundred reads of the others", || {
        (peer.asked().len() - from >= 100 + of_dead()).then_some(())
    });
    assert!(of_dead() <= 15, "{} requests to the dead one", of_dead());
    let three = stage.device("three");
    assert!(three["reason"].as_str().is_some_and(|reason| reason.contains("no answer in time")), "{three}");
    is_dead.store(false, Ordering::SeqCst);
    stage.watcher.shows("busker/three/availability", "online");
    stage.ends_well();
}

fn broadcasts() {
    let peer = Peer::on_a_pseudo_terminal();
    let by_hand = |verb: &str, rest: &[&str]| {
        let all = [&["--unit", "0", "holding 7"][..], rest].concat();
        let output = Command::new(program()).arg(verb).args(peer.arguments()).args(all).output();
        output.expect("the program is built")
    };
    let written = by_hand("write", &["135"]);
    assert!(written.status.success(), "{written:?}");
    let refused = by_hand("read", &[]);
    assert_eq!(refused.status.code(), Some(2), "{refused:?}");
    let asked: Vec<Vec<u8>> = peer.asked().into_iter().map(|asked| asked.frame).collect();
    assert_eq!(asked, [rtu(0, &[6, 0, 7, 0, 135])]);

    let peer = Peer::on_tcp(Framing::Tcp);
    let devices = "  zero:
    bus: line
    unit: 0
    poll: {fast: 100ms}
    points: {a: {at: input 0, poll: fast}, relay: {at: coil 0, poll: fast, write: any}}
";
    let stage = Stage::start(&peer, "", devices, &[("zero/a", (0, 4, 0)), ("zero/relay", (0, 1, 0))]);
    stage.shows_all();
    assert_eq!(stage.command("zero/relay", "ON")["outcome"], "done");
    stage.ends_well();
}

fn write_functions() {
    let peer = Peer::on_a_pseudo_terminal();
    peer.misbehave(|asked, good| {
        let refuses = match asked.unit {
            1 => asked.function == 6,
            2 => asked.function == 16,
            3 => asked.function == 5,
            _ => matches!(asked.function, 5 | 6 | 15 | 16),
        };
        vec![Step::Say(match (refuses, asked.unit) {
            (false, _) => good,
            // It answers 0x84 to whatever it refuses.
            (true, 4) => rtu(4, &[0x84, 1]),
            (true, _) => exception(asked, Framing::Rtu, 1),
        })]
    });
    // What a unit refuses it has not obeyed.
    peer.obey(|asked| match asked.unit {
        1 => asked.function != 6,
        2 => asked.function != 16,
        3 => asked.function != 5,
        _ => false,
    });
    let device = |name: &str, unit: u8, wire: &str, point: &str| {
        format!(
            "  {name}: {{bus: line, unit: {unit}, poll: {{fast: 100ms}}, wire: {{{wire}}}, points: {{x: {{{point}, poll: fast}}}}}}\n"
        )
    };
    let devices = device("only_16", 1, "", "at: holding 0, write: 0..1000, write_with: 16")
        + &device("only_6", 2, "", "at: holding 0, write: 0..1000")
        + &device("only_15", 3, "", "at: coil 0, write: any, write_with: 15")
        + &device("none", 4, "quirks: [exception_function_varies]", "at: holding 0, write: 0..1000");
    let shown =
        [("only_16/x", (1, 3, 0)), ("only_6/x", (2, 3, 0)), ("only_15/x", (3, 1, 0)), ("none/x", (4, 3, 0))];
    let stage = Stage::start(&peer, "", &devices, &shown);
    stage.shows_all();
    for (point, wanted) in [("only_16/x", "7"), ("only_6/x", "7"), ("only_15/x", "ON")] {
        let outcome = stage.command(point, wanted);
        assert_eq!(outcome["outcome"], "done", "{point}: {outcome}");
    }
    let outcome = stage.command("none/x", "7");
    assert_eq!(outcome["outcome"], "refused", "{outcome}");
    assert!(outcome["reason"].as_str().is_some_and(|reason| reason.contains("exception 1")), "{outcome}");
    stage.shows_all();
    stage.ends_well();
}
