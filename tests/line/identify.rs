//! `busker identify` as somebody types it: who a device is, and whether it is the right one.

use std::process::{Command, Output};

use busker::simulator::Model;
use serde_json::{Value, json};

use crate::peer::{Framing, Peer, Step, exception, garbled};
use crate::support::{program, temporary_file, temporary_folder};
use crate::typed::{check, found, path, said, simulated};

const DEVICES: &[(Model, u8)] = &[(Model::MrDo4, 18), (Model::Relay8, 19), (Model::Sensor, 20)];

fn identify(line: &[&str], rest: &[&str]) -> Output {
    Command::new(program()).arg("identify").args(line).args(rest).output().expect("the program is built")
}

#[test]
fn a_device_is_known_by_its_names_or_by_the_register_that_a_profile_goes_by() {
    let (_simulation, port) = simulated(None, DEVICES, &[]);
    let path = path(&port);
    for (unit, names, profiles) in [
        (
            "18",
            json!({"vendor": "METZ CONNECT GmbH", "product": "MR-DO4", "revision": "V1.4"}),
            json!(["metz-connect/mr-do4"]),
        ),
        ("19", json!({}), json!(["fuehlersysteme/relay8"])),
        ("20", json!({}), json!([])),
    ] {
        let output = identify(&["--serial", &path], &["--unit", unit, "--json"]);
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        let found = found(&output);
        assert_eq!(found["objects"], names, "unit {unit}");
        assert_eq!(found["profiles"], profiles, "unit {unit}");
        assert_eq!(found["profile"], Value::Null, "unit {unit}");
    }
    let told = said(&identify(&["--serial", &path], &["--unit", "18"]));
    let expected = "\
vendor     METZ CONNECT GmbH
product    MR-DO4
revision   V1.4
server id  (exception 1 (illegal function))
fits       metz-connect/mr-do4
";
    assert_eq!(told, expected);
}

#[test]
fn another_device_than_the_one_of_the_profile_is_a_failure_that_says_who_it_is() {
    let (_simulation, port) = simulated(None, DEVICES, &["unit=18,wrong-identity"]);
    let path = path(&port);
    let folder = temporary_folder();
    let configuration = format!(
        "buses: {{line: {{serial: {path}}}}}\ndevices:\n  \
         relays: {{profile: metz-connect/mr-do4, bus: line, unit: 18}}\n  \
         board: {{profile: fuehlersysteme/relay8, bus: line, unit: 19}}\n  \
         air: {{profile: fuehlersysteme/sensor, bus: line, unit: 20}}\n"
    );
    let file = temporary_file(&folder, "busker.yaml", &configuration).display().to_string();
    let of_configuration = |device: &str| identify(&["--config", &file], &["--device", device]);
    let of_profile = |id: &str| identify(&["--serial", &path], &["--unit", "19", "--profile", id]);
    for (output, code, says) in [
        (
            of_configuration("relays"),
            1,
            "unit 18 is no metz-connect/mr-do4: it says that it is `METZ CONNECT GmbH MR-DOX V1.4`",
        ),
        (of_configuration("board"), 0, "yes, it is a fuehlersysteme/relay8"),
        (of_configuration("air"), 0, "fuehlersysteme/sensor goes by nothing that could be asked"),
        (of_configuration("attic"), 2, "attic"),
        (of_profile("fuehlersysteme/analog-in8"), 1, "holds 0x5000, not 0x4000"),
        (of_profile("fuehlersysteme/relay9"), 2, "did you mean `fuehlersysteme/relay8`?"),
    ] {
        check(&output, code, says);
    }
}

#[test]
fn names_are_asked_for_on_every_kind_of_link_and_nothing_is_written() {
    for peer in [Peer::on_a_pseudo_terminal(), Peer::on_tcp(Framing::Rtu), Peer::on_tcp(Framing::Tcp)] {
        let arguments = peer.arguments();
        let line: Vec<&str> = arguments.iter().map(String::as_str).collect();
        let output = identify(&line, &["--unit", "1", "--json"]);
        assert!(output.status.success(), "{output:?}");
        let found = found(&output);
        assert_eq!(found["objects"]["vendor"], "ACME");
        assert_eq!(found["server_id"], "42 31 FF");
        assert!(peer.asked().iter().all(|asked| matches!(asked.function, 3 | 4 | 17 | 43)), "{found}");
    }
}

#[test]
fn silence_and_a_damaged_answer_are_told_apart() {
    let peer = Peer::on_a_pseudo_terminal();
    let path = peer.path().display().to_string();
    let ask = || identify(&["--serial", &path], &["--unit", "1", "--timeout", "300ms"]);
    peer.misbehave(|_, _| vec![]);
    let says =
        "unit 1 answers nothing that fits: no answer in time; check its power, its wiring and its unit";
    check(&ask(), 1, says);
    let last = peer.asked().last().map(|asked| asked.function);
    assert_eq!(last, Some(3), "whoever knows nothing else knows a register");

    peer.misbehave(|_, good| vec![Step::Say(garbled(good))]);
    check(&ask(), 1, "checksum error; check the wire");

    // A refusal is an answer.
    peer.misbehave(|asked, _| vec![Step::Say(exception(asked, Framing::Rtu, 1))]);
    check(&ask(), 0, "no profile that goes by what it says");
}
