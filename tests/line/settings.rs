//! `busker line` as somebody types it: a device whose line settings are changed, or not, and what is said of it.

use std::process::{Command, Output, Stdio};

use rustix::pty::{OpenptFlags, openpt, ptsname, unlockpt};

use busker::simulator::{DeviceAt, LineSettings, Model, Options, Parity, PtyPort, Simulation};

use crate::peer::{Framing, Peer, Step, exception, rtu};
use crate::support::program;

/// Devices that hear only who speaks with their bit rate and parity: 9600 8N1.
fn devices(faults: &[&str]) -> (Simulation, PtyPort) {
    let devices = [(Model::MrDo4, 18), (Model::Relay8, 19), (Model::BtrMrAi8, 20), (Model::MrDi4, 21)];
    let devices = devices.map(|(model, unit)| DeviceAt { model, unit });
    let options = Options {
        line: LineSettings { baud: 9600, parity: Parity::None },
        heeds_settings: true,
        faults: faults.iter().map(|fault| fault.parse().expect("a fault")).collect(),
        ..Options::default()
    };
    let simulation = Simulation::new(&devices, options).expect("devices");
    let port = simulation.serve_pty(None).expect("a pseudo-terminal");
    (simulation, port)
}

fn line(port: &PtyPort, arguments: &str) -> Output {
    let path = port.path().display().to_string();
    let words = arguments.split(' ').filter(|word| !word.is_empty());
    let mut line = Command::new(program());
    line.args(["line", "--serial", &path]).args(words).stdin(Stdio::null());
    line.output().expect("the program is built")
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&[&output.stdout[..], &output.stderr[..]].concat()).into_owned()
}

#[track_caller]
fn check(output: &Output, code: i32, says: &str) {
    assert_eq!(output.status.code(), Some(code), "{output:?}");
    assert!(said(output).contains(says), "`{says}` in {}", said(output));
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
    let (_simulation, port) = devices(&["unit=18,garbled"]);
    let output = line(&port, &format!("{OLD} --unit 18 --set 19200,even --yes"));
    check(&output, 1, "it does not answer with these settings: checksum error; check the wire");
}

#[test]
fn a_write_whose_answer_is_lost_is_looked_for_and_found_done() {
    // Each third request of it is left unanswered, and obeyed: names, server id, the write.
    let (_simulation, port) = devices(&["unit=18,every=3,garbled"]);
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
        let object = |number: u8, text: &str| [&[number, text.len() as u8], text.as_bytes()].concat();
        if left > 0 {
            left -= 1;
            return vec![];
        }
        match asked.function {
            43 => {
                let names = [object(0, "METZ CONNECT GmbH"), object(1, "MR-DO4")].concat();
                let pdu = [vec![43, 14, 1, 1, 0, 0, 2], names].concat();
                vec![Step::Say(rtu(asked.unit, &pdu))]
            }
            6 => {
                left = silent;
                vec![Step::Say(asked.frame.clone())]
            }
            _ => vec![Step::Say(exception(asked, Framing::Rtu, 1))],
        }
    });
    peer
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

#[test]
fn at_a_terminal_somebody_is_asked_and_only_a_yes_writes() {
    for (typed, code, says, count) in [
        ("yes\n", 0, "unit 1 has 9600 8N1 now", 1),
        ("y\n", 1, "nothing was written", 0),
        ("\n", 1, "write it?", 0),
    ] {
        let far = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).expect("a pseudo-terminal");
        unlockpt(&far).expect("a pseudo-terminal");
        let name = ptsname(&far, Vec::new()).expect("its name").into_string().expect("plain letters");
        let terminal = std::fs::File::options().read(true).write(true).open(name).expect("a terminal");
        rustix::io::write(&far, typed.as_bytes()).expect("typed");
        let peer = impostor(0);
        let output = change(&peer, &["--timeout", "3s"], terminal.into());
        check(&output, code, says);
        assert_eq!(writes(&peer).len(), count, "{typed:?}");
    }
}

#[test]
fn a_device_that_refuses_stays_with_its_settings() {
    let (_simulation, port) = devices(&["unit=18,every=3,exception=4"]);
    let output = line(&port, &format!("{OLD} --unit 18 --set 19200,even --yes"));
    check(&output, 1, "unit 18 has 9600 8N1 as before: the write was not taken: exception 4");
}
