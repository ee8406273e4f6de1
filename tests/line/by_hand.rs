//! One device by hand: `busker read`, `write` and `diagnose` as somebody types them.

use std::process::{Command, Output};

use serde_json::Value;

use crate::peer::{Framing, Misbehave, Peer, Step, rtu};
use crate::support::{program, temporary_file, temporary_folder};
use crate::{MIXED, in_single_bytes};

#[test]
fn registers_are_read_in_every_interpretation_on_every_kind_of_link() {
    for peer in [Peer::on_a_pseudo_terminal(), Peer::on_tcp(Framing::Rtu), Peer::on_tcp(Framing::Tcp)] {
        peer.hold(1, 3, 4, 0x42F6);
        peer.hold(1, 3, 5, 0xE979);
        let output = by_hand("read", &peer, &["--unit", "1", "holding 4..5", "--json"]);
        assert!(output.status.success(), "{output:?}");
        let found: Value = serde_json::from_slice(&output.stdout).expect("JSON");
        assert_eq!(found["registers"][1]["hex"], "E979");
        assert_eq!(found["registers"][1]["i16"], -5767);
        assert_eq!(found["pairs"][0]["f32"]["abcd"], 123.456);
        assert_eq!(found["pairs"][0]["u32"]["cdab"], 0xE979_42F6_u32);
    }
}

#[test]
fn what_is_written_is_read_back_and_shown() {
    let peer = Peer::on_a_pseudo_terminal();
    let output = by_hand("write", &peer, &["--unit", "1", "holding 9", "0x8001"]);
    assert!(output.status.success(), "{output:?}");
    assert!(String::from_utf8_lossy(&output.stdout).contains("32769"), "{output:?}");
    let asked: Vec<u8> = peer.asked().iter().map(|asked| asked.function).collect();
    assert_eq!(asked, [3, 6, 3]);

    peer.be_deaf_to_writes();
    let output = by_hand("write", &peer, &["--unit", "1", "holding 9", "7"]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(String::from_utf8_lossy(&output.stdout).contains("32769"), "what it holds: {output:?}");
}

#[test]
fn an_echo_is_no_confirmation_also_by_hand() {
    let peer = Peer::on_a_pseudo_terminal();
    peer.misbehave(|asked, good| vec![Step::Say(asked.frame.clone()), Step::Pause(4), Step::Say(good)]);
    let output = by_hand("write", &peer, &["--unit", "1", "coil 3", "ON"]);
    assert!(output.status.success(), "{output:?}");
    peer.be_deaf_to_writes();
    let output = by_hand("write", &peer, &["--unit", "1", "coil 3", "OFF"]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
}

#[test]
fn with_a_configuration_points_are_read_and_written_by_their_rules() {
    let peer = Peer::on_a_pseudo_terminal();
    peer.hold(1, 4, 0, 123);
    let folder = temporary_folder();
    let text = format!("buses:\n  line: {{{}}}\ndevices:\n{MIXED}", peer.link());
    let config = temporary_file(&folder, "busker.yaml", &text).display().to_string();
    let run = |verb: &str, rest: &[&str]| {
        let output = Command::new(program())
            .args([verb, "--config", &config, "--device", "one"])
            .args(rest)
            .output()
            .expect("the program is built");
        let said = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
        (output.status.code(), said)
    };
    for (verb, rest, code, says) in [
        ("read", &["a"][..], 0, "123"),
        ("write", &["relay", "ON"], 0, "done"),
        ("read", &["relay"], 0, "ON"),
        ("write", &["relay", "maybe"], 2, "`maybe` is neither `ON` nor `OFF`"),
        ("write", &["a", "5"], 2, "`a` is read-only"),
        ("write", &["holding 0", "5"], 2, "only points are written"),
        ("read", &["c"], 2, "`c` is no point"),
        ("read", &["input 0..1"], 0, "007B"),
    ] {
        let (found, said) = run(verb, rest);
        assert_eq!(found, Some(code), "{verb} {rest:?}: {said}");
        assert!(said.contains(says), "{verb} {rest:?}: {said}");
    }
}

#[test]
fn wrong_input_is_told_from_what_failed() {
    let peer = Peer::on_a_pseudo_terminal();
    for (verb, rest, code) in [
        ("read", &["--unit", "1", "hold 3"][..], 2),
        ("read", &["--unit", "1", "holding 3..1"], 2),
        ("read", &["--unit", "248", "holding 3"], 2),
        ("read", &["--unit", "1", "holding 0..200"], 2),
        ("write", &["--unit", "1", "input 3", "1"], 2),
        ("write", &["--unit", "1", "holding 0..1", "1"], 2),
        ("write", &["--unit", "1", "holding 0", "65536"], 2),
        ("read", &["holding 3"], 2),
    ] {
        let output = by_hand(verb, &peer, rest);
        assert_eq!(output.status.code(), Some(code), "{verb} {rest:?}: {output:?}");
        assert!(peer.asked().is_empty(), "{verb} {rest:?} reached the line");
    }
    peer.unplug();
    let output = by_hand("read", &peer, &["--unit", "1", "holding 3"]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(String::from_utf8_lossy(&output.stderr).contains("is the adapter plugged in?"), "{output:?}");
}

#[test]
fn a_broadcast_is_sent_and_nobody_is_waited_for() {
    let peer = Peer::on_a_pseudo_terminal();
    let output = by_hand("write", &peer, &["--unit", "0", "holding 7", "135"]);
    assert!(output.status.success(), "{output:?}");
    assert_eq!(peer.asked().len(), 1);
    assert_eq!(peer.asked()[0].frame, rtu(0, &[6, 0, 7, 0, 135]));
    let refused = by_hand("read", &peer, &["--unit", "0", "holding 7"]);
    assert_eq!(refused.status.code(), Some(2), "{refused:?}");
    assert_eq!(peer.asked().len(), 1);
    peer.hold(1, 3, 7, 4711);
    let read = by_hand("read", &peer, &["--unit", "1", "holding 7"]);
    assert!(String::from_utf8_lossy(&read.stdout).contains("4711"), "{read:?}");
}

#[test]
fn what_a_device_says_of_itself_arrives_whole_in_any_pieces() {
    let splits: [Misbehave; 3] = [
        |_, good| vec![Step::Say(good)],
        |_, good| {
            let middle = good.len() / 2;
            vec![Step::Say(good[..middle].to_vec()), Step::Pause(10), Step::Say(good[middle..].to_vec())]
        },
        |_, good| in_single_bytes(good),
    ];
    for split in splits {
        let peer = Peer::on_a_pseudo_terminal();
        peer.misbehave(split);
        let output = by_hand("diagnose", &peer, &["--unit", "1", "--json"]);
        assert!(output.status.success(), "{output:?}");
        let found: Value = serde_json::from_slice(&output.stdout).expect("JSON");
        for (name, value) in
            [("vendor", "ACME"), ("product", "RA1"), ("revision", "1.23"), ("server_id", "42 31 FF")]
        {
            assert_eq!(found[name], value, "{name}");
        }
        assert_eq!(found["query_returned"], true);
        assert_eq!(found["bus_messages"], 0);
    }
}

fn by_hand(verb: &str, peer: &Peer, rest: &[&str]) -> Output {
    let output = Command::new(program()).arg(verb).args(peer.arguments()).args(rest).output();
    output.expect("the program is built")
}
