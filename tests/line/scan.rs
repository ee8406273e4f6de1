//! `busker scan` as somebody types it, on simulated lines whose bit rate and parity nobody has told it.

use std::process::{Command, Output};

use busker::simulator::{Framing, Model, Parity};
use serde_json::Value;

use crate::peer::{self, Peer};
use crate::support::{Ended, Running, program, temporary_file, temporary_folder};
use crate::typed::{found, path, simulated};

fn scan(arguments: &[&str]) -> Output {
    Command::new(program()).arg("scan").args(arguments).output().expect("the program is built")
}

const DEVICES: &[(Model, u8)] = &[(Model::MrDo4, 18), (Model::Relay8, 19), (Model::Sensor, 20)];

#[test]
fn what_it_prints_is_a_configuration_that_the_check_takes_as_it_is() {
    let (_simulation, port) = simulated(Some((9600, Parity::None)), DEVICES, &[]);
    let output = scan(&["--serial", &path(&port), "--units", "17..21"]);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let said = String::from_utf8_lossy(&output.stderr);
    for says in [
        "asking 5 units on /dev/pts/",
        "with up to 24 settings, the likeliest first",
        "the line has 9600 8N1; all units are asked there",
        "unit 18: METZ CONNECT GmbH MR-DO4 V1.4 (metz-connect/mr-do4)",
    ] {
        assert!(said.contains(says), "`{says}` in {said}");
    }
    let expected = format!(
        "\
# Found by `busker scan`: units 17..21 were asked at 9600 8N1.
buses:
  line:
    serial: \"{}\"
    baud: 9600
    parity: none
devices:
  # METZ CONNECT GmbH MR-DO4 V1.4
  mr_do4_18:
    profile: metz-connect/mr-do4
    bus: line
    unit: 18
  # no names, but 0x5000
  relay8_19:
    profile: fuehlersysteme/relay8
    bus: line
    unit: 19
  # Unit 20 answers: it does not tell who it is; no profile goes by that; these tell nobody who they are: \
         btr/mr-ai8, fuehlersysteme/sensor, metz-connect/mr-doa4; or write one beside its manual
  # device_20: {{profile: …, bus: line, unit: 20}}
",
        path(&port)
    );
    assert_eq!(String::from_utf8_lossy(&output.stdout), expected);

    let folder = temporary_folder();
    let file = temporary_file(&folder, "busker.yaml", &expected);
    let check =
        Command::new(program()).arg("check").arg("--config").arg(&file).output().expect("it is built");
    assert!(check.status.success(), "{check:?}");
}

#[test]
fn any_bit_rate_and_parity_are_found() {
    for (baud, parity, name) in [
        (19200, Parity::Even, "even"),
        (19200, Parity::Odd, "odd"),
        (115_200, Parity::None, "none"),
        (2400, Parity::Even, "even"),
    ] {
        let (_simulation, port) = simulated(Some((baud, parity)), &[(Model::MrAi8, 3)], &[]);
        let output = scan(&["--serial", &path(&port), "--units", "3", "--json"]);
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        let found = found(&output);
        assert_eq!(found["line"]["baud"], baud, "{found}");
        assert_eq!(found["line"]["parity"], name, "{found}");
        assert_eq!(found["complete"], true, "{found}");
        assert_eq!(found["found"][0]["profiles"][0], "metz-connect/mr-ai8", "{found}");
        assert_eq!(found["found"][0]["device"]["name"], "mr_ai8_3", "{found}");
    }
}

#[test]
fn what_is_known_of_the_line_is_not_tried_otherwise() {
    let (_simulation, port) = simulated(Some((9600, Parity::Odd)), &[(Model::MrDi4, 2)], &[]);
    for (arguments, code) in [
        (&["--baud", "9600"][..], 0),
        (&["--parity", "odd"], 0),
        (&["--baud", "9600", "--parity", "even"], 1),
        (&["--baud", "19200"], 1),
    ] {
        let place = path(&port);
        let output = scan(&[&["--serial", &place, "--units", "1..3"], arguments].concat());
        assert_eq!(output.status.code(), Some(code), "{arguments:?} {output:?}");
    }
}

#[test]
fn slow_and_late_devices_are_found_all_the_same() {
    let faults = ["unit=5,slow=150ms", "unit=9,slow=90ms"];
    let devices = [(Model::MrDo4, 5), (Model::MrDi4, 6), (Model::MrAi8, 9)];
    let (_simulation, port) = simulated(Some((19200, Parity::Even)), &devices, &faults);
    let output = scan(&["--serial", &path(&port), "--units", "1..9", "--json"]);
    let found = found(&output);
    let units: Vec<&Value> =
        found["found"].as_array().expect("a list").iter().map(|one| &one["unit"]).collect();
    assert_eq!(units, [5, 6, 9], "{output:?}");
    assert_eq!(found["garbled"], serde_json::json!([]), "{found}");
}

#[test]
fn who_cannot_be_understood_is_told_with_a_remedy_and_no_device() {
    let devices = [(Model::MrDo4, 18), (Model::MrDi4, 19)];
    for (faults, code, says) in [
        (
            &["unit=18,garbled"][..],
            0,
            "unit 18 answers at 19200 8E1, but not so that it can be understood: checksum error; two devices may have \
             this unit (connect one alone, and give it another)",
        ),
        (&["garbled"], 1, "nobody answers so that it can be understood at 19200 8E1"),
        (
            &["silent"],
            1,
            "none of the units 17..20 answers at 19200 8E1; look at the devices' power and units",
        ),
    ] {
        let (_simulation, port) = simulated(Some((19200, Parity::Even)), &devices, faults);
        let place = path(&port);
        let output =
            scan(&["--serial", &place, "--units", "17..20", "--baud", "19200", "--parity", "even", "--json"]);
        assert_eq!(output.status.code(), Some(code), "{output:?}");
        assert!(String::from_utf8_lossy(&output.stderr).contains(says), "{output:?}");
        let found = found(&output);
        let units = found["found"].as_array().expect("a list").iter().map(|one| one["unit"].clone());
        let expected = if code == 0 { vec![Value::from(19)] } else { vec![] };
        assert_eq!(units.collect::<Vec<_>>(), expected, "{found}");
    }
}

#[test]
fn a_gateway_is_asked_for_its_units_over_modbus_tcp() {
    let (simulation, _port) = simulated(Some((19200, Parity::Even)), DEVICES, &[]);
    let tcp = simulation.serve_tcp("127.0.0.1:0", Framing::Tcp).expect("a socket");
    let rtu = simulation.serve_tcp("127.0.0.1:0", Framing::Rtu).expect("a socket");
    for (option, address, units, asked, key) in [
        ("--tcp", tcp.address(), None, "1..247 and 255", "tcp: \""),
        ("--rtu-over-tcp", rtu.address(), Some("16..19"), "16..19", "rtu_over_tcp: \""),
    ] {
        let address = address.to_string();
        let mut arguments = vec![option, &address, "--json"];
        arguments.extend(units.iter().flat_map(|units| ["--units", units]));
        let output = scan(&arguments);
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        let found = found(&output);
        assert_eq!(found["units"], asked, "{found}");
        assert_eq!(found["found"][0]["unit"], 18, "{found}");
        assert_eq!(found["found"][1]["unit"], 19, "{found}");
        let configuration = found["configuration"].as_str().expect("a text");
        assert!(configuration.contains(&format!("{key}{address}\"")), "{configuration}");
    }
}

#[test]
fn a_server_that_closes_its_connections_is_asked_to_the_end() {
    for (framing, option) in [(peer::Framing::Tcp, "--tcp"), (peer::Framing::Rtu, "--rtu-over-tcp")] {
        let peer = Peer::on_tcp(framing);
        // Whoever is not there makes it hang up; and behind each answer it closes as well.
        peer.misbehave(|asked, good| match asked.unit {
            3 | 5 => vec![peer::Step::Say(good), peer::Step::HangUp],
            _ => vec![peer::Step::HangUp],
        });
        let arguments = peer.arguments();
        let output = scan(&[option, &arguments[1], "--units", "1..6", "--timeout", "3s", "--json"]);
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        let found = found(&output);
        assert_eq!(found["complete"], true, "{found}");
        let units: Vec<&Value> =
            found["found"].as_array().expect("a list").iter().map(|one| &one["unit"]).collect();
        assert_eq!(units, [3, 5], "{found}");
        let text = String::from_utf8_lossy(&output.stderr);
        assert!(text.contains("the other side ends the connection when unit 1 is asked"), "{text}");
    }
}

#[test]
fn an_interrupt_ends_it_with_what_was_found_so_far() {
    let (_simulation, port) = simulated(Some((19200, Parity::Even)), &[(Model::MrDo4, 2)], &[]);
    let ended = interrupted(&["--serial", &path(&port), "--json"], "unit 2: METZ CONNECT");
    assert_eq!(ended.status.code(), Some(0), "{ended:?}");
    let found: Value = serde_json::from_str(&ended.stdout).expect("JSON");
    assert_eq!(found["complete"], false, "{found}");
    assert_eq!(found["found"][0]["unit"], 2, "{found}");
    let text = found["configuration"].as_str().expect("a text");
    assert!(text.contains("it was interrupted before all of the units 1..247 were asked"), "{text}");

    let (_simulation, port) = simulated(Some((19200, Parity::Even)), &[(Model::MrDo4, 2)], &["silent"]);
    let ended = interrupted(&["--serial", &path(&port)], "asking 247 units");
    assert_eq!(ended.status.code(), Some(1), "{ended:?}");
    assert!(ended.stdout.is_empty(), "{ended:?}");
    let said = &ended.stderr;
    assert!(said.contains("interrupted") && said.contains("as far as was asked"), "{said}");
}

/// Interrupts the scan as soon as it has said this; gives its end.
fn interrupted(arguments: &[&str], sign: &str) -> Ended {
    let scan = Running::start(&[&["scan"], arguments].concat());
    scan.wait_for(sign);
    scan.interrupt()
}

#[test]
fn nothing_is_written_and_wrong_input_reaches_no_line() {
    let peer = Peer::on_a_pseudo_terminal();
    let place = peer.path().display().to_string();
    for arguments in [
        &["--serial", &place, "--units", "0..3"][..],
        &["--serial", &place, "--units", "1..248"],
        &["--serial", &place, "--parity", "mark"],
        &["--serial", &place, "--tcp", "127.0.0.1:502"],
        &["--tcp", "127.0.0.1:502", "--baud", "9600"],
        &["--tcp", "127.0.0.1:port"],
        &[],
    ] {
        let output = scan(arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?} {output:?}");
    }
    assert!(peer.asked().is_empty());
    let output = scan(&["--serial", &place, "--units", "1..2", "--baud", "115200", "--parity", "none"]);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    assert!(peer.asked().iter().all(|asked| matches!(asked.function, 3 | 4 | 17 | 43) && asked.unit > 0));
    // A second device of its unit answers at the same time.
    peer.misbehave(|asked, good| {
        let other = peer::rtu(asked.unit, &[43, 14, 1, 1, 0, 0, 1, 0, 3, b'X', b'Y', b'Z']);
        vec![peer::Step::Say(good.iter().zip(&other).map(|(one, two)| one & two).collect())]
    });
    let output = scan(&["--serial", &place, "--units", "1..2", "--baud", "115200", "--parity", "none"]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(String::from_utf8_lossy(&output.stderr).contains("two devices may have this unit"), "{output:?}");
    peer.unplug();
    let output = scan(&["--serial", &place]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(String::from_utf8_lossy(&output.stderr).contains("is the adapter plugged in?"), "{output:?}");
}
