//! `busker check` as a person and as a program see it.

use std::fs;
use std::process::{Command, Output, Stdio};

use serde_json::Value as Json;

const GOOD: &str = "\
buses:
  basement: {serial: /dev/serial/by-id/usb-A, baud: 9600}
  plant: {tcp: '192.168.1.20:502'}
devices:
  relays: {profile: metz-connect/mr-do4, bus: basement, unit: 18}
  more_relays: {profile: metz-connect/mr-do4, bus: basement, unit: 19, poll: {fast: 20ms}}
  boiler:
    bus: plant
    unit: 1
    points: {flow: {at: input 0, type: i16, decimals: 1, unit: °C, poll: fast}}
";

#[test]
fn a_good_configuration_is_summed_up_for_people() {
    let output = check(GOOD, &[]);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let text = text(&output.stdout);
    for part in
        ["is good", "bus basement: serial /dev/serial/by-id/usb-A 9600 8E1", "bus plant: tcp", "unit 18"]
    {
        assert!(text.contains(part), "`{part}` is missing in:\n{text}");
    }
    // A relay module every 20 ms is more than 9600 baud carry.
    assert!(text.contains("too slow"), "{text}");
    assert_eq!(self::text(&output.stderr), "");
}

#[test]
fn a_good_configuration_is_summed_up_for_programs() {
    let output = check(GOOD, &["--json"]);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let json = json(&output);
    assert_eq!(json["status"], "good");
    let bus = &json["buses"][0];
    assert_eq!(bus["name"], "basement");
    let load = bus["load"].as_f64().expect("a number");
    assert!(load > 1.0, "{load}");
    let fast = &bus["devices"][1]["polls"]["fast"];
    assert_eq!(fast["period"], 0.02);
    let real = fast["real_period"].as_f64().expect("a number");
    assert!((real / (0.02 * load) - 1.0).abs() < 0.05, "every period stretches by the load: {real}, {load}");
    assert_eq!(json["buses"][1]["devices"][0]["profile"], "inline");
}

#[test]
fn faults_end_with_exit_code_2_and_begin_with_their_places() {
    let faulty = GOOD
        .replace("unit: 18", "unit: 300")
        .replace("plant, unit", "plnt, unit")
        .replace("bus: plant", "bus: plnt");
    for arguments in [[].as_slice(), &["--json"]] {
        let output = check(&faulty, arguments);
        assert_eq!(output.status.code(), Some(2));
        let told = text(&output.stderr);
        let places: Vec<&str> =
            told.lines().filter_map(|line| line.split_once("busker.yaml:")).map(|(_, rest)| rest).collect();
        assert_eq!(places.len(), 2, "{told}");
        assert!(places[0].starts_with("5:") && places[1].starts_with("8:"), "{told}");
    }
    let json = json(&check(&faulty, &["--json"]));
    assert_eq!(json["status"], "faulty");
    assert_eq!(json["faults"][0]["line"], 5);
    assert_eq!(json["faults"][1]["column"], 10);
    assert_eq!(text(&check(&faulty, &[]).stdout), "");
}

#[test]
fn the_last_line_says_what_did_not_happen_only_where_something_was_to_happen() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("busker.yaml");
    fs::write(&path, GOOD.replace("unit: 18", "unit: 300")).expect("a file");
    for (verb, last) in [("check", "error: 1 fault"), ("run", "error: 1 fault, nothing was started")] {
        let output = run(Command::new(env!("CARGO_BIN_EXE_busker")).args([verb, "--config"]).arg(&path));
        assert_eq!(text(&output.stderr).lines().last(), Some(last), "{verb}");
    }
}

#[test]
fn a_bus_without_devices_is_not_busy_and_the_zero_has_no_sign() {
    let config = GOOD.replace("buses:\n", "buses:\n  attic: {tcp: \"127.0.0.1:1502\"}\n");
    let told = text(&check(&config, &[]).stdout);
    assert!(told.contains("\n  busy 0 % of the time; a command waits at most 0 ms"), "{told}");
}

#[test]
fn warnings_do_not_fail() {
    let output = check(&GOOD.replace("/dev/serial/by-id/usb-A", "/dev/ttyUSB0"), &[]);
    assert_eq!(output.status.code(), Some(0));
    assert!(text(&output.stderr).starts_with("warning: "), "{output:?}");
    assert!(text(&output.stderr).contains("/dev/serial/by-id/"), "{output:?}");
}

#[test]
fn a_profile_of_the_owner_wins_over_the_shipped_one() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let profiles = folder.path().join("own/metz-connect");
    fs::create_dir_all(&profiles).expect("a folder");
    let profile = "device: metz-connect/mr-do4\nmanufacturer: M\nmodel: D\nsource: a test, revision 1\n\
        points: {only: {at: coil 0, poll: fast}}\n";
    fs::write(profiles.join("mr-do4.yaml"), profile).expect("a file");
    let path = folder.path().join("busker.yaml");
    // Relative to the configuration, wherever the program runs.
    fs::write(&path, format!("profiles: [own]\n{GOOD}")).expect("a file");
    let output =
        run(Command::new(env!("CARGO_BIN_EXE_busker")).args(["check", "--json", "--config"]).arg(&path));
    let json = json(&output);
    assert_eq!(json["buses"][0]["devices"][0]["points"], 1, "{json}");

    fs::write(&path, format!("profiles: [nowhere]\n{GOOD}")).expect("a file");
    let output = run(Command::new(env!("CARGO_BIN_EXE_busker")).args(["check", "--config"]).arg(&path));
    assert_eq!(output.status.code(), Some(2));
    assert!(
        text(&output.stderr).contains("busker.yaml:1:12: cannot read the profiles in `nowhere`"),
        "{output:?}"
    );
}

#[test]
fn a_file_that_is_not_there_is_a_wrong_input() {
    let output =
        run(Command::new(env!("CARGO_BIN_EXE_busker")).args(["check", "--config", "/nowhere/busker.yaml"]));
    assert_eq!(output.status.code(), Some(2));
    let told = text(&output.stderr);
    assert!(told.starts_with("error: cannot read the configuration `/nowhere/busker.yaml`\n"), "{told}");
    assert!(told.contains("because: "), "{told}");
}

#[test]
fn a_reader_that_has_read_enough_is_no_failure() {
    let mut child = Command::new(env!("CARGO_BIN_EXE_busker"))
        .args(["check", "--schema"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    drop(child.stdout.take());
    let output = child.wait_with_output().expect("it ends");
    assert_eq!((output.status.code(), text(&output.stderr)), (Some(0), String::new()));
}

fn check(configuration: &str, arguments: &[&str]) -> Output {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("busker.yaml");
    fs::write(&path, configuration).expect("a file");
    run(Command::new(env!("CARGO_BIN_EXE_busker")).args(["check", "--config"]).arg(&path).args(arguments))
}

fn run(command: &mut Command) -> Output {
    command.output().expect("the program starts")
}

fn json(output: &Output) -> Json {
    serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {output:?}"))
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).expect("output is UTF-8")
}

#[test]
fn watchdogs_and_heartbeats_that_will_not_be_fed_in_time_are_named_with_what_to_change() {
    let with = |watchdog: &str, heartbeat: &str| {
        format!(
            "buses: {{basement: {{serial: /dev/serial/by-id/usb-A, baud: 19200}}}}\n\
             devices:\n\
             \x20 relays: {{profile: metz-connect/mr-do4, bus: basement, unit: 18, settings: {{watchdog: {watchdog}}}}}\n\
             \x20 dampers: {{profile: metz-connect/mr-dio42, bus: basement, unit: 19, settings: {{channel_1_receive_time: {heartbeat}}}}}\n"
        )
    };
    let met = |file: &str, device: usize| {
        let feeding = json(&check(file, &["--json"]))["buses"][0]["devices"][device]["feeding"].clone();
        let kind = if device == 0 { "watchdog" } else { "heartbeat" };
        let feeding = feeding.as_array().expect("a list").iter().find(|feeding| feeding["kind"] == kind);
        let feeding = feeding.expect("one of this kind");
        (feeding["met"].as_bool(), feeding["met_one_silent"].as_bool())
    };
    for (watchdog, heartbeat, relays, dampers) in [
        ("3s", "30s", (Some(true), Some(true)), (Some(true), Some(true))),
        ("900ms", "1s", (Some(true), Some(false)), (Some(true), Some(false))),
        ("20ms", "100ms", (Some(false), Some(false)), (Some(false), Some(false))),
        ("0s", "0s", (Some(true), Some(true)), (Some(true), Some(true))),
    ] {
        let file = with(watchdog, heartbeat);
        assert_eq!((met(&file, 0), met(&file, 1)), (relays, dampers), "{watchdog} {heartbeat}");
    }
    let told = text(&check(&with("900ms", "100ms"), &[]).stdout);
    for part in [
        "relays: watchdog `watchdog` of 900 ms may run out while another device is silent",
        "set `watchdog` to 1.6s or longer, or `response_timeout` of the bus to 280ms",
        "dampers: heartbeat `channel_1_receive_time` of 100 ms will run out",
        "dampers: watchdog `watchdog` is as the device has it",
    ] {
        assert!(told.contains(part), "`{part}` is missing in:\n{told}");
    }
}

#[test]
fn a_watchdog_that_would_run_out_is_met_with_either_of_what_is_advised() {
    let watchdog = |watchdog: &str, timeout: &str| {
        let configuration = format!(
            "buses: {{basement: {{serial: /dev/serial/by-id/usb-A, baud: 19200, response_timeout: {timeout}}}}}\n\
             devices:\n\
             \x20 relays: {{profile: metz-connect/mr-do4, bus: basement, unit: 18, settings: {{watchdog: {watchdog}}}}}\n\
             \x20 inputs: {{profile: metz-connect/mr-di4, bus: basement, unit: 19}}\n"
        );
        json(&check(&configuration, &["--json"]))["buses"][0]["devices"][0]["feeding"][0].clone()
    };
    let faulty = watchdog("1200ms", "500ms");
    assert_eq!((&faulty["met"], &faulty["met_one_silent"]), (&true.into(), &false.into()), "{faulty}");
    let advice = faulty["advice"].as_str().expect("an advice");
    let longer = advice.split_once("set `watchdog` to ").and_then(|(_, rest)| rest.split_once(" or longer"));
    let (longer, _) = longer.unwrap_or_else(|| panic!("{advice}"));
    let (_, shorter) = advice.split_once("`response_timeout` of the bus to ").expect("a shorter timeout");
    for (time, timeout) in [(longer, "500ms"), ("1200ms", shorter)] {
        let told = watchdog(time, timeout);
        assert_eq!(told["met_one_silent"], true, "{time} {timeout}: {told}");
    }
}
