//! Rows about replies: late, damaged, in pieces, another's, none.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::Row;
use crate::peer::{
    ALIKE, Asked, Framing, LIE, Misbehave, Peer, Step, exception, garbled, lie, read_pdu, reply, rtu,
};
use crate::stage::{Shown, Stage};
use crate::support::wait_for;

pub const ROWS: &[Row] = &[
    Row {
        number: 1,
        fault: "A late reply is taken for the next answer: RTU frames carry no number",
        done: "A unit whose replies all look alike answers after its timeout, after the next request, and twice so in a row, with what it no longer holds",
        seen: "Leaves the line silent for a quarantine, asks something else first, and believes the first reply to a look-alike request only when no second one comes: counted as `late_replies`, never shown",
        run: late_replies,
    },
    Row {
        number: 2,
        fault: "Noise before or behind a frame",
        done: "Each reply comes with 00 before it and FF 00 behind it; one behind thirty bytes of noise",
        seen: "Finds the reply by unit, function and checksum wherever it begins; the rest is counted as `noise_bytes`",
        run: noise,
    },
    Row {
        number: 4,
        fault: "The 1.5-character rule inside a frame is wrong on USB adapters",
        done: "Each reply pauses in its middle, for ten to thirty times as long as the rule allows; one comes in single bytes",
        seen: "A frame ends where its length says, and not with a pause",
        run: pieces,
    },
    Row {
        number: 5,
        fault: "A USB adapter hands bytes over only every 16 ms",
        done: "Each reply is held back for 16 ms, in two portions where it is longer than an adapter's buffer",
        seen: "Reads on, only slower. The driver is asked for low latency when the port is opened, which makes 1 ms of the 16. (That it grants it was not tried here: a pseudo-terminal has no such timer)",
        run: held_back,
    },
    Row {
        number: 10,
        fault: "An exception for one address inside a block",
        done: "A unit refuses every read that touches one of five registers; later it leaves one read of the others unanswered",
        seen: "Finds the register by halving, reads the others without it, and does not ask again at once; after a timeout the same read comes again, undivided",
        run: one_refused,
    },
    Row {
        number: 14,
        fault: "A response timeout that is too short at the edge",
        done: "One unit needs twice the bus's timeout, and its profile says so; another one half as much again, and nobody says so",
        seen: "Waits for the first one without a timeout; of the second one the first reply is late, counted, and taken for nobody's answer. Then it is waited for, and the log says what to set",
        run: slow_units,
    },
    Row {
        number: 20,
        fault: "The exceptions \"acknowledge\" and \"busy\" are shown as 0",
        done: "A unit answers 6 to three reads and 5 to three more; another answers 4 for good",
        seen: "Asks the busy one again until it has the value; of the other its points say `None`, never 0",
        run: busy,
    },
    Row {
        number: 23,
        fault: "Nobody can tell a timeout from a wrong checksum",
        done: "One unit is silent, one answers with a wrong checksum, one as another unit",
        seen: "Counts each as what it is (`timeouts`, `checksum_errors`, `wrong_frames`), and the device's reason says what to check: its power, wiring and unit; the wire; whether another device has its unit",
        run: three_faults,
    },
    Row {
        number: 24,
        fault: "Modbus TCP replies with another request's transaction",
        done: "Each reply comes behind one with another transaction, and one that was due to an earlier request",
        seen: "Takes the one that carries its own number; the others are counted",
        run: wrong_transactions,
    },
    Row {
        number: 25,
        fault: "Sloppy units, which keep no silence and add bytes",
        done: "A unit answers without a pause, with a byte too many behind each checksum, and now and then with a frame twice",
        seen: "Takes the first whole reply; what comes behind it is dropped before the next request",
        run: sloppy,
    },
    Row {
        number: 27,
        fault: "A device leaves one read without an answer, for good, and answers all others",
        done: "The first of three reads of a unit is never answered; later it is",
        seen: "Finds that the unit is there, and shows the others; the points of that read are `None` with the reason, and it is asked ever less often, so that waiting for it costs the bus little",
        run: one_unanswered,
    },
];

const ALIKE_SHOWN: [Shown; 2] = [("one/a", (1, 4, 0)), ("one/b", (1, 4, 100))];

/// A unit with a register for each of these names.
fn unit(name: &str, number: u8, wire: &str) -> String {
    format!(
        "  {name}: {{bus: line, unit: {number}, poll: {{fast: 100ms}}, wire: {{{wire}}}, \
         points: {{a: {{at: input 0, poll: fast}}}}}}\n"
    )
}

fn place(asked: &Asked) -> (u8, u8, u16) {
    (asked.unit, asked.function, asked.address)
}

/// Does each of these to one read of `one/a`, whose register changes at the same time.
fn each_once(stage: &Stage, peer: &Peer, faults: &[Misbehave]) {
    for how in faults {
        peer.misbehave_once(1, 4, 0, *how);
        peer.hold(1, 4, 0, peer.holds((1, 4, 0)) + 1);
        wait_for("the fault", || peer.has_misbehaved().then_some(()));
        stage.shows("one/a", (1, 4, 0));
    }
}

fn late_replies() {
    let peer = Peer::on_a_pseudo_terminal();
    let stage = Stage::start(&peer, "response_timeout: 200ms", ALIKE, &ALIKE_SHOWN);
    stage.shows_all();
    each_once(
        &stage,
        &peer,
        &[
            |asked, _| vec![Step::Pause(300), Step::Say(lie(asked))],
            |asked, _| vec![Step::SayBeforeNext(lie(asked))],
            |asked, _| vec![Step::SayBeforeNext(lie(asked))],
        ],
    );
    stage.counts("late_replies", 3);
    // What was not answered is not what is asked next, if there is anything else to ask.
    let (from, a) = (peer.asked().len(), (1, 4, 0));
    peer.misbehave_once(1, 4, 0, |_, _| Vec::new());
    let after = wait_for("the request behind it", || {
        let asked = peer.asked();
        let unanswered = (from..asked.len()).find(|at| place(&asked[*at]) == a)?;
        asked.get(unanswered + 1).cloned()
    });
    assert_ne!(place(&after), a, "the same again at once");
    // Two in a row of which nothing comes until the third.
    let mut unanswered = Vec::new();
    peer.misbehave(move |asked, good| match unanswered.len() {
        0 | 1 => {
            unanswered.push(lie(asked));
            Vec::new()
        }
        _ => {
            unanswered.drain(..).chain([good]).flat_map(|frame| [Step::Say(frame), Step::Pause(10)]).collect()
        }
    });
    let asked = peer.asked().len();
    wait_for("the late replies", || (peer.asked().len() > asked + 3).then_some(()));
    peer.behave();
    stage.counts("late_replies", 5);
    stage.ends_well();
}

fn noise() {
    let peer = Peer::on_a_pseudo_terminal();
    peer.misbehave(|_, good| vec![Step::Say([vec![0], good, vec![0xFF, 0]].concat())]);
    let stage = Stage::start(&peer, "", ALIKE, &ALIKE_SHOWN);
    stage.shows_all();
    let thirty: Misbehave =
        |_, good| vec![Step::Say([(0..30).map(|byte| 0x80 + 4 * byte).collect(), good].concat())];
    each_once(&stage, &peer, &[thirty]);
    stage.tells_changes();
    stage.counts("noise_bytes", 40);
    stage.ends_well();
}

fn pieces() {
    let peer = Peer::on_a_pseudo_terminal();
    peer.misbehave(|_, good| {
        let middle = good.len() / 2;
        vec![Step::Say(good[..middle].to_vec()), Step::Pause(25), Step::Say(good[middle..].to_vec())]
    });
    let stage = Stage::start(&peer, "", ALIKE, &ALIKE_SHOWN);
    stage.shows_all();
    each_once(
        &stage,
        &peer,
        &[|_, good| good.into_iter().flat_map(|byte| [Step::Pause(3), Step::Say(vec![byte])]).collect()],
    );
    stage.ends_well();
}

fn held_back() {
    let peer = Peer::on_a_pseudo_terminal();
    peer.misbehave(|_, good| {
        let portions = good.chunks(62).map(<[u8]>::to_vec);
        portions.flat_map(|portion| [Step::Pause(16), Step::Say(portion)]).collect()
    });
    let devices = "  one: {bus: line, unit: 1, poll: {fast: 100ms}, points: {a: {for: 1..60, at: input 0, poll: fast}}}\n";
    let shown = [("one/a_1", (1, 4, 0)), ("one/a_60", (1, 4, 59))];
    let stage = Stage::start(&peer, "", devices, &shown);
    stage.shows_all();
    // They are read in one request, or there would be no second portion.
    wait_for("one read of both", || {
        peer.asked().iter().any(|asked| asked.argument(Framing::Rtu) == 60).then_some(())
    });
    stage.ends_well();
}

fn one_refused() {
    const REFUSED: u16 = 2;
    let refuses =
        |asked: &Asked| (asked.address..asked.address + asked.argument(Framing::Rtu)).contains(&REFUSED);
    let peer = Peer::on_a_pseudo_terminal();
    peer.misbehave(move |asked, good| {
        vec![Step::Say(if refuses(asked) { exception(asked, Framing::Rtu, 2) } else { good })]
    });
    let devices = "  one:
    bus: line
    unit: 1
    poll: {fast: 100ms}
    points:
      a: {at: input 0, poll: fast}
      b: {at: input 1, poll: fast}
      c: {at: input 2, poll: fast}
      d: {at: input 3, poll: fast}
      e: {at: input 4, poll: fast}
";
    let shown = [("one/a", (1, 4, 0)), ("one/b", (1, 4, 1)), ("one/d", (1, 4, 3)), ("one/e", (1, 4, 4))];
    let stage = Stage::start(&peer, "", devices, &shown);
    stage.shows_all();
    let refused = peer.asked().iter().filter(|asked| refuses(asked)).count();
    let asked = peer.asked().len();
    wait_for("twenty more reads", || (peer.asked().len() >= asked + 20).then_some(()));
    let after = peer.asked();
    let again = after[asked..].iter().filter(|asked| refuses(asked)).count();
    // It may be tried alone once more, and then after a minute.
    assert!(refused <= 4 && again <= 1, "refused {refused} times, and {again} times later");
    assert!(stage.watcher.payloads("busker/one/c").iter().all(|payload| payload == "None"));

    // A timeout divides nothing: what is asked afterwards was asked before.
    let frames = |from: usize| {
        let mut frames: Vec<Vec<u8>> = peer.asked()[from..].iter().map(|asked| asked.frame.clone()).collect();
        frames.sort();
        frames.dedup();
        frames
    };
    let before = frames(asked);
    let (unit, function, address) = (1, 4, peer.asked().last().expect("it was asked").address);
    peer.misbehave_once(unit, function, address, |_, _| Vec::new());
    wait_for("the timeout", || peer.has_misbehaved().then_some(()));
    let from = peer.asked().len();
    stage.tells_changes();
    let after = frames(from);
    assert!(after.iter().all(|frame| before.contains(frame)), "before {before:02X?}, after {after:02X?}");
    stage.ends_well();
}

fn slow_units() {
    let peer = Peer::on_a_pseudo_terminal();
    peer.misbehave(|asked, good| match asked.unit {
        1 => vec![Step::Say(good)],
        2 => vec![Step::Pause(400), Step::Say(good)],
        _ => vec![Step::Pause(300), Step::Say(good)],
    });
    let devices = unit("one", 1, "") + &unit("patient", 2, "response_timeout: 10s") + &unit("unknown", 3, "");
    let shown = [("one/a", (1, 4, 0)), ("patient/a", (2, 4, 0)), ("unknown/a", (3, 4, 0))];
    let stage = Stage::start(&peer, "response_timeout: 200ms", &devices, &shown);
    stage.shows_all();
    stage.counts("late_replies", 1);
    let patient = stage.device("patient");
    assert_eq!(patient["counters"]["timeouts"], 0, "{patient}");
    stage.gateway.wait_for_log("device unknown answers after");
    stage.ends_well();
}

fn busy() {
    let peer = Peer::on_a_pseudo_terminal();
    let mut count = 0;
    peer.misbehave(move |asked, good| {
        if asked.unit == 2 {
            return vec![Step::Say(exception(asked, Framing::Rtu, 4))];
        }
        count += 1;
        vec![Step::Say(match count {
            1..=3 => exception(asked, Framing::Rtu, 6),
            4..=6 => exception(asked, Framing::Rtu, 5),
            _ => good,
        })]
    });
    let devices = unit("one", 1, "") + &unit("failing", 2, "");
    let stage = Stage::start(&peer, "", &devices, &[("one/a", (1, 4, 0))]);
    stage.shows_all();
    stage.ends_well();
    stage.watcher.shows("busker/failing/a", "None");
    let told = stage.watcher.payloads("busker/failing/a");
    assert!(told.iter().all(|told| told == "None"), "{told:?}");
    let failing = stage.device("failing");
    assert!(failing["points"][0]["reason"] == "exception 4 (device failure)", "{failing}");
}

fn three_faults() {
    let peer = Peer::on_a_pseudo_terminal();
    peer.misbehave(|asked, good| match asked.unit {
        1 => Vec::new(),
        2 => vec![Step::Say(garbled(good))],
        3 => vec![Step::Say(rtu(9, &read_pdu(4, &[LIE])))],
        _ => vec![Step::Say(good)],
    });
    let devices =
        unit("silent", 1, "") + &unit("damaged", 2, "") + &unit("mistaken", 3, "") + &unit("good", 4, "");
    let stage = Stage::start(&peer, "response_timeout: 250ms", &devices, &[("good/a", (4, 4, 0))]);
    for (device, counter, reason, advice) in [
        ("silent", "timeouts", "no answer in time", "check its power, its wiring and its unit"),
        ("damaged", "checksum_errors", "checksum error", "check the wire"),
        (
            "mistaken",
            "wrong_frames",
            "an answer that does not fit the request",
            "another device has its unit",
        ),
    ] {
        let said = wait_for(device, || {
            let said = stage.device(device);
            let is_offline = said["reason"].as_str().is_some_and(|said| said.contains("3 times in a row"));
            is_offline.then_some(said)
        });
        let told = said["reason"].as_str().unwrap_or_default();
        assert!(told.starts_with(reason) && told.contains(advice), "{said}");
        assert!(said["counters"][counter].as_u64() >= Some(3), "{said}");
        for other in ["timeouts", "checksum_errors", "wrong_frames"] {
            // A thread that was kept waiting may answer too late.
            let is_fair = other == counter || other == "timeouts" || said["counters"][other] == 0;
            assert!(is_fair, "{device} has {other}: {said}");
        }
        let told = stage.watcher.payloads(&format!("busker/{device}/a"));
        assert!(told.iter().all(|told| told == "None"), "{told:?}");
    }
    stage.ends_well();
}

fn wrong_transactions() {
    let peer = Peer::on_tcp(Framing::Tcp);
    let mut earlier = Vec::new();
    peer.misbehave(move |asked, good| {
        let mut other = reply(asked, Framing::Tcp, &read_pdu(asked.function, &[LIE]));
        other[0] ^= 0x80;
        let late =
            std::mem::replace(&mut earlier, reply(asked, Framing::Tcp, &read_pdu(asked.function, &[LIE])));
        vec![Step::Say([other, late, good].concat())]
    });
    let stage = Stage::start(&peer, "", ALIKE, &ALIKE_SHOWN);
    stage.shows_all();
    stage.counts("foreign_frames", 10);
    stage.ends_well();
}

fn sloppy() {
    let peer = Peer::on_a_pseudo_terminal();
    let mut count = 0;
    peer.misbehave(move |_, good| {
        count += 1;
        let twice = if count % 5 == 0 { good.clone() } else { Vec::new() };
        vec![Step::Say([good, vec![0x55], twice].concat())]
    });
    let stage = Stage::start(&peer, "", ALIKE, &ALIKE_SHOWN);
    stage.shows_all();
    for _ in 0..5 {
        stage.tells_changes();
    }
    stage.ends_well();
}

fn one_unanswered() {
    let peer = Peer::on_a_pseudo_terminal();
    let is_mute = Arc::new(AtomicBool::new(true));
    let mute = is_mute.clone();
    peer.misbehave(move |asked, good| match asked.address == 0 && mute.load(Ordering::SeqCst) {
        true => Vec::new(),
        false => vec![Step::Say(good)],
    });
    let devices = "  one:
    bus: line
    unit: 1
    poll: {fast: 50ms, slow: 60s}
    points: {a: {at: input 0, poll: fast}, b: {at: input 500, poll: fast}, c: {at: input 900, poll: slow}}
";
    let shown = [("one/b", (1, 4, 500))];
    let stage = Stage::start(&peer, "response_timeout: 100ms", devices, &shown);
    stage.shows_all();
    stage.watcher.shows("busker/one/availability", "online");
    let one = stage.device("one");
    let reason = one["points"][0]["reason"].as_str().unwrap_or_default();
    assert!(reason.contains("no answer in time"), "{one}");
    let (from, in_vain) = (peer.asked().len(), stage.counter("timeouts"));
    wait_for("a hundred reads", || (peer.asked().len() - from >= 100).then_some(()));
    assert!(stage.counter("timeouts") - in_vain <= 3, "{}", stage.counter("timeouts"));
    is_mute.store(false, Ordering::SeqCst);
    stage.watcher.shows("busker/one/a", "0");
    stage.ends_well();
}
