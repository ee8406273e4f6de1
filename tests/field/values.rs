//! Rows about values: how they are understood, and what commands make of them.

use std::process::Command;

use busker::edge::clock::Clock;
use busker::engine::time::Duration;

use crate::Row;
use crate::peer::{Framing, Peer, Step, read_pdu, rtu};
use crate::stage::Stage;
use crate::support::{program, wait_for};

pub const ROWS: &[Row] = &[
    Row {
        number: 16,
        fault: "Word and byte order of long values, and addresses that are off by one",
        done: "The same float in four orders; a 32-bit value of which both halves change with each reply",
        seen: "Each order is named by letters (`abcd` to `dcba`); a long value is never read in two requests; `busker read` shows a register in every interpretation",
        run: orders,
    },
    Row {
        number: 17,
        fault: "Automations wear EEPROM out",
        done: "Thirty commands in a row to a setting in EEPROM, some with the value that it holds",
        seen: "Writes it once in its interval and within the day's budget, and not at all what it holds already; each command has one outcome, and the last one says why it was not written",
        run: eeprom,
    },
    Row {
        number: 18,
        fault: "A poll that crosses a write lets the state flip back",
        done: "A command comes while a slow reply to a poll is on its way; another unit shows a new value only after 300 ms",
        seen: "Shows only what was read after the write, and reads back after the profile's `settle`: nothing flips",
        run: crossing,
    },
];

fn orders() {
    let peer = Peer::on_a_pseudo_terminal();
    // 123.456 is 42 F6 E9 79.
    peer.hold_all(1, 4, 0, &[0x42F6, 0xE979, 0xE979, 0x42F6, 0xF642, 0x79E9, 0x79E9, 0xF642]);
    let mut count = 0;
    peer.misbehave(move |asked, good| {
        if asked.unit == 1 {
            return vec![Step::Say(good)];
        }
        count += 1;
        let words: Vec<u16> = (0..asked.argument(Framing::Rtu)).map(|_| count).collect();
        vec![Step::Say(rtu(2, &read_pdu(4, &words)))]
    });
    let devices = "  floats:
    bus: line
    unit: 1
    points:
      abcd: {at: input 0, type: f32, order: abcd, poll: fast}
      cdab: {at: input 2, type: f32, order: cdab, poll: fast}
      badc: {at: input 4, type: f32, order: badc, poll: fast}
      dcba: {at: input 6, type: f32, order: dcba, poll: fast}
  halves:
    bus: line
    unit: 2
    poll: {fast: 50ms}
    wire: {limits: {read_registers: 3}}
    points:
      a: {at: input 0, type: u32, poll: fast}
      b: {at: input 2, type: u32, poll: fast}
";
    let stage = Stage::start(&peer, "", devices, &[]);
    for order in ["abcd", "cdab", "badc", "dcba"] {
        stage.watcher.shows(&format!("busker/floats/{order}"), "123.456");
    }
    let told = || -> Vec<u32> {
        let both = ["a", "b"].map(|point| stage.watcher.payloads(&format!("busker/halves/{point}")));
        both.iter().flatten().filter_map(|payload| payload.parse().ok()).collect()
    };
    wait_for("forty values", || (told().len() >= 40).then_some(()));
    let torn: Vec<u32> = told().into_iter().filter(|value| value >> 16 != value & 0xFFFF).collect();
    assert!(torn.is_empty(), "{torn:08X?}");
    stage.ends_well();
    // One that is killed would leave the terminal exclusive as long as the peer holds it.
    assert!(stage.gateway.terminate().success());

    let by_hand = Command::new(program())
        .arg("read")
        .args(peer.arguments())
        .args(["--unit", "1", "input 0..1", "--json"])
        .output()
        .expect("the program is built");
    assert!(by_hand.status.success(), "{by_hand:?}");
    let found: serde_json::Value = serde_json::from_slice(&by_hand.stdout).expect("JSON");
    assert_eq!(found["pairs"][0]["f32"]["abcd"], 123.456, "{found}");
}

fn eeprom() {
    let peer = Peer::on_a_pseudo_terminal();
    let devices = "  one:
    bus: line
    unit: 1
    poll: {fast: 100ms}
    points:
      setting: {at: holding 0, poll: fast, write: 0..100, persistent: true}
eeprom: {interval: 100ms, daily: 6}
";
    peer.hold(1, 3, 0, 50);
    let stage = Stage::start(&peer, "", devices, &[("one/setting", (1, 3, 0))]);
    stage.shows_all();
    assert_eq!(stage.command("one/setting", "50")["outcome"], "unchanged");
    for number in 1..=29 {
        stage.publish("one/setting", &number.to_string());
    }
    wait_for("thirty outcomes", || (stage.outcomes("one/setting").len() >= 30).then_some(()));
    assert_eq!(
        stage.outcomes("one/setting").last().map(String::as_str),
        Some("done"),
        "the newest value wins"
    );
    // Half of a day's budget may be spent at once.
    let mut last = serde_json::Value::Null;
    for number in 30..=33 {
        last = stage.command("one/setting", &number.to_string());
    }
    assert_eq!(last["outcome"], "refused", "{last}");
    assert!(last["reason"].as_str().is_some_and(|reason| reason.contains("budget")), "{last}");
    let writes = peer.asked().iter().filter(|asked| matches!(asked.function, 6 | 16)).count();
    assert!((1..=3).contains(&writes), "{writes} writes");
    stage.counts("persistent_writes", writes as u64);
    stage.ends_well();
}

fn crossing() {
    let peer = Peer::on_a_pseudo_terminal();
    let clock = Clock::start();
    let mut written = None;
    peer.misbehave(move |asked, good| match (asked.unit, asked.function) {
        (1, 1) => vec![Step::Pause(200), Step::Say(good)],
        (2, 6) => {
            written = Some(clock.now());
            vec![Step::Say(good)]
        }
        // It goes on to show what it held.
        (2, 3) if written.is_some_and(|at| clock.now() - at < Duration::from_millis(300)) => {
            vec![Step::Say(rtu(2, &read_pdu(3, &[40])))]
        }
        _ => vec![Step::Say(good)],
    });
    let devices = "  slow:
    bus: line
    unit: 1
    poll: {fast: 50ms}
    points: {relay: {at: coil 0, poll: fast, write: any}}
  late:
    bus: line
    unit: 2
    poll: {fast: 50ms}
    points: {level: {at: holding 0, poll: fast, write: 0..100, settle: 500ms}}
";
    peer.hold(2, 3, 0, 40);
    let stage = Stage::start(
        &peer,
        "response_timeout: 5s",
        devices,
        &[("slow/relay", (1, 1, 0)), ("late/level", (2, 3, 0))],
    );
    stage.shows_all();
    for wanted in ["ON", "OFF", "ON"] {
        let asked = |function: u8| {
            peer.asked().iter().filter(|asked| asked.unit == 1 && asked.function == function).count()
        };
        let polls = asked(1);
        wait_for("a poll to be on its way", || (asked(1) > polls).then_some(()));
        assert_eq!(stage.command("slow/relay", wanted)["outcome"], "done");
    }
    let outcome = stage.command("late/level", "60");
    assert_eq!(outcome["outcome"], "done", "{outcome}");
    let asked = peer.asked().len();
    wait_for("twenty more requests", || (peer.asked().len() > asked + 20).then_some(()));
    stage.ends_well();
}
