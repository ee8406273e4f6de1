//! `busker line` as somebody types it: a device whose line settings are changed, or not, and what is said of it.

use std::fs;
use std::process::{Command, Output, Stdio};

use busker::engine::time::Duration;
use busker::simulator::{Model, Parity, PtyPort, Simulation};

use crate::peer::{Asked, Framing, Peer, Step, exception, garbled, rtu};
use crate::support::{program, temporary_file, temporary_folder};
use crate::typed::{check, path, simulated, terminal};

/// Devices that hear only who speaks with their bit rate and parity: 9600 8N1.
fn devices(faults: &[&str]) -> (Simulation, PtyPort) {
    let models = [(Model::MrDo4, 18), (Model::Relay8, 19), (Model::BtrMrAi8, 20), (Model::MrDi4, 21)];
    simulated(Some((9600, Parity::None)), &models, faults)
}

fn line(port: &PtyPort, arguments: &str) -> Output {
    let words = arguments.split(' ').filter(|word| !word.is_empty());
    let mut line = Command::new(program());
    line.args(["line", "--serial", &path(port)]).args(words).stdin(Stdio::null());
    line.output().expect("the program is built")
}

const OLD: &str = "--baud 9600 --parity none";

#[test]
fn a_device_is_given_other_settings_and_answers_with_them_and_no_more_with_the_old() {
    let (_simulation, port) = devices(&[]);
    let output = line(&port, &format!("--unit 18 {OLD} --set 19200,even --yes"));
    check(&output, 0, "unit 18 at 9600 8N1: METZ CONNECT GmbH MR-DO4 V1.4 (metz-connect/mr-do4)");
    assert_eq!(String::from_utf8_lossy(&output.stdout), "unit 18 has 19200 8E1 now\n");
    check(
        &line(&port, &format!("--unit 18 {OLD} --set 9600,none --yes")),
        1,
        "it does not answer with these settings",
    );
    // What it has is not written again.
    check(&line(&port, "--unit 18 --set 19200,even --yes"), 0, "has 19200 8E1 already; nothing was written");
    check(&line(&port, "--unit 18 --set 1200,odd --yes"), 0, "unit 18 has 1200 8O1 now");
    // The others have kept theirs.
    check(&line(&port, &format!("--unit 21 {OLD} --set 38400,odd --yes")), 0, "unit 21 has 38400 8O1 now");
}

#[test]
fn what_cannot_be_is_refused_with_what_would_be_right() {
    let (_simulation, port) = devices(&[]);
    for (arguments, code, says) in [
        // Nobody can be asked.
        ("--unit 18 --set 19200,even", 2, "`--yes` says so beforehand"),
        ("--unit 18 --set 14400,even --yes", 2, "metz-connect/mr-do4 has no 14400 baud; expected 1200, 2400"),
        ("--unit 19 --set 19200,even --yes", 2, "are set at the device: the DIP switches of switch B"),
        (
            "--unit 19 --set-unit 7",
            2,
            "the unit of a fuehlersysteme/relay8 is set by the DIP switches of switch A",
        ),
        ("--unit 18 --set-unit 7", 2, "is set by its rotary address switches, and not over the line"),
        ("--unit 18 --set 19200 --yes", 2, "expected them as in `19200,even`"),
        ("--unit 0 --set 19200,even --yes", 2, "0 is not in 1..=247"),
        ("--unit 18", 2, "--set"),
        // It says that it is another one.
        (
            "--unit 18 --set 19200,even --yes --profile metz-connect/mr-di4",
            1,
            "it is no metz-connect/mr-di4: it says",
        ),
        (
            "--unit 18 --set 19200,even --yes --profile btr/mr-ai8",
            1,
            "it is no btr/mr-ai8: it says that it is a metz",
        ),
        // It tells nobody who it is, until somebody says it.
        ("--unit 20 --set 19200,even --yes", 1, "if you know which it is, name it with `--profile`"),
        (
            "--unit 77 --set 19200,even --yes",
            1,
            "`busker scan --serial PORT --units UNIT` finds those that it has",
        ),
    ] {
        check(&line(&port, &format!("{OLD} {arguments}")), code, says);
    }
    check(&line(&port, &format!("{OLD} --unit 18 --set 9600,none --yes")), 0, "already; nothing was written");
    let btr = "--unit 20 --set 19200,even --yes --profile btr/mr-ai8";
    check(&line(&port, &format!("{OLD} {btr}")), 0, "unit 20 has 19200 8E1 now");
}

#[test]
fn a_device_that_cannot_be_understood_is_not_written_to() {
    let peer = Peer::on_a_pseudo_terminal();
    peer.misbehave(|_, good| vec![Step::Say(garbled(good))]);
    let output = change(&peer, &["--yes", "--timeout", "300ms"], Stdio::null());
    check(&output, 1, "it does not answer with these settings: checksum error; check the wire");
    assert!(!peer.asked().is_empty());
    assert_eq!(writes(&peer), Vec::<Vec<u8>>::new());
}

#[test]
fn a_write_whose_answer_is_lost_is_looked_for_and_found_done() {
    // The answer to each fourth request is garbled, and the request obeyed: names, server id, names, the write.
    let (_simulation, port) = devices(&["unit=18,every=4,garbled"]);
    let output = line(&port, &format!("{OLD} --unit 18 --set 19200,even --yes"));
    check(&output, 0, "sent, and not confirmed: checksum error; looking for it");
    assert_eq!(String::from_utf8_lossy(&output.stdout), "unit 18 has 19200 8E1 now\n");
}

/// A device that says it is an MR-DO4, whatever is set at the port. It confirms the write, and is then silent to
/// so many questions.
fn impostor(silent: usize) -> Peer {
    let peer = Peer::on_a_pseudo_terminal();
    let mut left = 0;
    peer.misbehave(move |asked, _| {
        if left > 0 {
            left -= 1;
            return vec![];
        }
        if asked.function == 6 {
            left = silent;
        }
        vec![Step::Say(answer_of_an_mr_do4(asked))]
    });
    peer
}

/// Its names, and that it takes each write.
fn answer_of_an_mr_do4(asked: &Asked) -> Vec<u8> {
    let object = |number: u8, text: &str| [&[number, text.len() as u8], text.as_bytes()].concat();
    match asked.function {
        43 => {
            let names = [object(0, "METZ CONNECT GmbH"), object(1, "MR-DO4")].concat();
            rtu(asked.unit, &[vec![43, 14, 1, 1, 0, 0, 2], names].concat())
        }
        6 => asked.frame.clone(),
        _ => exception(asked, Framing::Rtu, 1),
    }
}

/// What becomes of a change of it, with this on standard input.
fn change(peer: &Peer, arguments: &[&str], input: Stdio) -> Output {
    let mut line = Command::new(program());
    line.arg("line").arg("--serial").arg(peer.path()).args(["--unit", "1", "--set", "9600,none"]);
    line.args(arguments).stdin(input).output().expect("the program is built")
}

fn writes(peer: &Peer) -> Vec<Vec<u8>> {
    peer.asked().iter().filter(|asked| asked.function == 6).map(|asked| asked.frame.clone()).collect()
}

#[test]
fn one_write_goes_to_one_device_and_what_it_answers_then_says_in_which_state_it_is() {
    for (silent, timeout, code, says) in [
        (0, "3s", 0, &["unit 1 has 9600 8N1 now"][..]),
        (
            3,
            "400ms",
            1,
            &[
                "unit 1 has 19200 8E1 as before: it has confirmed the write and not obeyed it; it works on with these",
            ],
        ),
        // It needs its time.
        (5, "400ms", 0, &["unit 1 has 9600 8N1 now"]),
        (
            99,
            "200ms",
            1,
            &[
                "unit 1 answers neither with 9600 8N1 nor with 19200 8E1",
                "switch it off and on, then `busker scan --serial",
            ],
        ),
    ] {
        let peer = impostor(silent);
        let output = change(&peer, &["--yes", "--timeout", timeout], Stdio::null());
        for says in says {
            check(&output, code, says);
        }
        assert_eq!(writes(&peer), [rtu(1, &[6, 0, 65, 0x53, 0x34])]);
    }
}

/// An MR-DO4 of which the port is gone from its answer to this function on.
fn on_a_port_that_goes(function: u8) -> Peer {
    let peer = Peer::on_a_pseudo_terminal();
    let path = peer.path();
    peer.misbehave(move |asked, _| {
        if asked.function == function {
            fs::remove_file(&path).expect("it goes once");
        }
        vec![Step::Say(answer_of_an_mr_do4(asked))]
    });
    peer
}

#[test]
fn a_port_that_does_not_open_with_the_new_settings_is_found_out_before_the_write() {
    let peer = on_a_port_that_goes(17);
    let output = change(&peer, &["--yes", "--timeout", "3s"], Stdio::null());
    check(&output, 1, "error: nothing was written\n  because: `");
    check(&output, 1, "is the adapter plugged in?");
    assert_eq!(writes(&peer), Vec::<Vec<u8>>::new());
}

#[test]
fn a_device_that_has_been_exchanged_before_the_write_is_not_written_to() {
    let peer = Peer::on_a_pseudo_terminal();
    let mut is_another = false;
    peer.misbehave(move |asked, _| {
        let answer = if is_another { exception(asked, Framing::Rtu, 1) } else { answer_of_an_mr_do4(asked) };
        is_another |= asked.function == 17;
        vec![Step::Say(answer)]
    });
    let output = change(&peer, &["--yes", "--timeout", "3s"], Stdio::null());
    check(&output, 1, "another one answers there now: it answers with exception 1");
    assert_eq!(writes(&peer), Vec::<Vec<u8>>::new());
}

#[test]
fn where_the_port_is_gone_behind_the_write_it_is_told_what_was_written() {
    let peer = on_a_port_that_goes(6);
    let output = change(&peer, &["--yes", "--timeout", "3s"], Stdio::null());
    let told = "error: unit 1 was sent the settings 9600 8N1, and has these or still 19200 8E1; `busker scan` finds out \
                which\n  because: `";
    check(&output, 1, told);
    assert_eq!(writes(&peer).len(), 1);
}

#[test]
fn what_the_profile_demands_of_a_question_holds_for_these_as_well() {
    let folder = temporary_folder();
    let text = "\
device: acme/slow
manufacturer: ACME
model: Slow
source: its manual
identify: {vendor: METZ CONNECT GmbH, product: MR-DO4}
wire: {response_timeout: 5s, limits: {delay: 60ms}, quirks: [exception_function_varies]}
line: {unit: a switch, at: holding 65, add: 0x5300, baud: {9600: 0x04, 19200: 0x05}, parity: {even: 0x10, none: 0x30}}
points: {flow: {at: input 0, poll: slow}}
";
    let profile = temporary_file(&folder, "slow.yaml", text).display().to_string();
    let peer = Peer::on_a_pseudo_terminal();
    peer.misbehave(|asked, _| {
        let answer = match asked.function {
            6 => rtu(asked.unit, &[0x83, 4]),
            _ => answer_of_an_mr_do4(asked),
        };
        vec![Step::Pause(600), Step::Say(answer)]
    });
    let output = change(&peer, &["--yes", "--timeout", "200ms", "--profile", &profile], Stdio::null());
    check(&output, 0, "sent, and not confirmed: exception 4");
    let silences: Vec<_> = peer.asked().iter().skip(1).map(|asked| asked.silence).collect();
    assert_eq!(silences.len(), 4);
    assert!(silences.iter().all(|silence| *silence >= Duration::from_millis(60)), "{silences:?}");
}

#[test]
fn at_a_terminal_somebody_is_asked_and_only_a_yes_writes() {
    for (typed, code, says, count) in [
        ("yes\n", 0, "unit 1 has 9600 8N1 now", 1),
        ("y\n", 1, "nothing was written", 0),
        ("\n", 1, "write it?", 0),
    ] {
        let (far, near) = terminal();
        let terminal = std::fs::File::options().read(true).write(true).open(near).expect("a terminal");
        rustix::io::write(&far, typed.as_bytes()).expect("typed");
        let peer = impostor(0);
        let output = change(&peer, &["--timeout", "3s"], terminal.into());
        check(&output, code, says);
        assert_eq!(writes(&peer).len(), count, "{typed:?}");
    }
}

#[test]
fn a_device_that_refuses_stays_with_its_settings() {
    let (_simulation, port) = devices(&["unit=18,every=4,exception=4"]);
    let output = line(&port, &format!("{OLD} --unit 18 --set 19200,even --yes"));
    check(&output, 1, "unit 18 has 9600 8N1 as before: the write was not taken: exception 4");
}
