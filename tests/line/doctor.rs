//! `busker doctor` on lines that are well and lines that are not.

use std::process::{Command, Output, Stdio};
use std::time::Duration;

use serde_json::Value;

use crate::peer::{Peer, Step, rtu};
use crate::support::{program, temporary_file, temporary_folder};
use crate::typed::terminal;

fn doctor(arguments: &[&str]) -> Output {
    Command::new(program()).arg("doctor").args(arguments).output().expect("the program is built")
}

/// The state and the text of what was found.
fn found(output: &Output, what: &str) -> Option<(String, String)> {
    let reports: Value = serde_json::from_slice(&output.stdout).expect("JSON on standard output");
    let findings = reports[0]["findings"].as_array().expect("findings");
    let finding = findings.iter().find(|finding| finding["what"] == what)?;
    Some((finding["state"].as_str()?.to_owned(), finding["found"].as_str()?.to_owned()))
}

fn good(text: &str) -> Option<(String, String)> {
    Some(("good".into(), text.into()))
}

fn bad(text: &str) -> Option<(String, String)> {
    Some(("bad".into(), text.into()))
}

#[test]
fn a_quiet_line_is_well_and_nobody_is_asked() {
    let peer = Peer::on_a_pseudo_terminal();
    let path = peer.path().display().to_string();
    let output = doctor(&["--serial", &path, "--listen", "300ms", "--json"]);
    assert!(output.status.success(), "{output:?}");
    assert_eq!(found(&output, "port"), good("can be opened"));
    assert_eq!(found(&output, "noise"), good("none in 0.3 s"));
    assert_eq!(found(&output, "echo"), None);
    let (_, direction) = found(&output, "RS485").expect("it is looked at");
    assert!(direction.starts_with("the driver cannot switch a transceiver"), "{direction}");
    assert!(peer.asked().is_empty(), "nothing is sent unasked");

    let table = doctor(&["--serial", &path, "--listen", "0s"]);
    let table = String::from_utf8(table.stdout).expect("text");
    assert!(table.starts_with(&format!("{path}\n  ok  leads to")), "{table}");
}

#[test]
fn an_echo_is_found_out_by_a_request_that_nobody_obeys() {
    let peer = Peer::on_a_pseudo_terminal();
    let path = peer.path().display().to_string();
    let sent = || doctor(&["--serial", &path, "--listen", "0s", "--send", "--json"]);
    peer.misbehave(|_, _| Vec::new());
    assert_eq!(found(&sent(), "echo"), good("none: the line does not return what is sent"));
    peer.misbehave(|asked, _| vec![Step::Say(asked.frame.clone())]);
    let (state, text) = found(&sent(), "echo").expect("it is looked for");
    assert!(state == "good" && text.starts_with("the line returns what is sent"), "{text}");
    peer.misbehave(|asked, _| vec![Step::Say(asked.frame[2..].to_vec())]);
    let damaged = sent();
    assert_eq!(found(&damaged, "echo"), bad("not what was sent came back, but 6 other bytes"));
    assert_eq!(damaged.status.code(), Some(1));
    let asked = peer.asked();
    assert_eq!(asked.len(), 3);
    assert!(asked.iter().all(|asked| (asked.unit, asked.function) == (248, 8)), "{asked:?}");
}

#[test]
fn what_is_heard_unasked_is_bad() {
    for (said, expected) in
        [(rtu(7, &[3, 0, 0, 0, 2]), "another master"), (vec![0x00, 0xFF, 0x13], "belong to no frame")]
    {
        let (far, path) = terminal();
        let path = path.display().to_string();
        let mut child = Command::new(program())
            .args(["doctor", "--serial", &path, "--listen", "500ms", "--json"])
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the program is built");
        // It throws away what came before it opened the port, so it is said until it has ended.
        while child.try_wait().expect("a child can be asked").is_none() {
            rustix::io::write(&far, &said).expect("the line is open");
            std::thread::sleep(Duration::from_millis(20));
        }
        let output = child.wait_with_output().expect("it has ended");
        let (state, text) = found(&output, "noise").expect("it has listened");
        assert!(state == "bad" && text.contains(expected), "{text}");
        assert_eq!(output.status.code(), Some(1));
    }
}

#[test]
fn what_cannot_be_looked_at_is_told_with_its_reason() {
    let peer = Peer::on_a_pseudo_terminal();
    let path = peer.path().display().to_string();
    for (port, expected) in [
        ("/dev/no-such", "`/dev/no-such` is not there; is the adapter plugged in?"),
        ("/dev/null", "`/dev/null` is no serial port"),
    ] {
        let output = doctor(&["--serial", port, "--json"]);
        assert_eq!(found(&output, "port"), bad(expected));
        assert_eq!(output.status.code(), Some(1));
    }

    // As the configuration wants it.
    let folder = temporary_folder();
    let text = format!("buses:\n  shed: {{serial: {path}, rs485: kernel}}\n");
    let config = temporary_file(&folder, "shed.yaml", &text).display().to_string();
    let output = doctor(&["--config", &config, "--listen", "0s", "--json"]);
    assert_eq!(
        found(&output, "RS485"),
        bad("the driver cannot switch the transceiver, as `rs485: kernel` wants it to")
    );
    let text = "buses: {plant: {tcp: \"127.0.0.1:502\"}}\n";
    let config = temporary_file(&folder, "plant.yaml", text).display().to_string();
    let output = doctor(&["--config", &config]);
    assert_eq!(output.status.code(), Some(2));
    assert_eq!(doctor(&[]).status.code(), Some(2));
}
