//! `busker simulate` as a person uses it: arguments, commands on its standard input, and its end; and
//! the simulated devices against the profiles.

mod examples;
#[path = "../support/mod.rs"]
mod support;
mod two_readings;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Output, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use busker::simulator::Model;
use rustix::process::{Pid, Signal, kill_process};

/// Far longer than anything here takes; only a failing test waits for it.
const PATIENCE: Duration = Duration::from_secs(30);
const MR_DO4: &str = "metz-connect/mr-do4@18";

fn busker(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_busker"));
    command.arg("simulate").args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped());
    command
}

fn run(arguments: &[&str]) -> Output {
    busker(arguments).stderr(Stdio::piped()).output().expect("it starts")
}

#[test]
fn the_help_shows_devices_commands_faults_and_an_example() {
    let told = String::from_utf8(run(&["--help"]).stdout).expect("text");
    let devices = Model::ALL.map(|model| format!("\n  {model}\n"));
    for wanted in devices.iter().map(String::as_str).chain([
        "  unit N input I ohms X | volts X | celsius X | open\n",
        "wrong-identity",
        "Example:\n  busker simulate metz-connect/mr-do4@18 metz-connect/mr-ai8@19 --pty /tmp/line",
    ]) {
        assert!(told.contains(wanted), "{wanted:?} in\n{told}");
    }
}

#[test]
fn wrong_arguments_end_with_2_and_say_what_would_be_right() {
    let tcp = ["--tcp", "127.0.0.1:0"];
    for (arguments, wanted) in [
        (&[][..], "PROFILE@UNIT"),
        (&[MR_DO4], "--pty <LINK>"),
        (
            &["metz-connect/mr-do5@18"],
            "`metz-connect/mr-do5` is not simulated; there are `metz-connect/mr-do4`",
        ),
        (&["metz-connect/mr-do4"], "names no unit; write it as `metz-connect/mr-do4@18`"),
        (&["metz-connect/mr-do4@248"], "`248` is not a unit; a unit is 1 to 247"),
        (&[MR_DO4, MR_DO4], "have the same unit; give each its own"),
        (&[MR_DO4, "--fault", "deaf"], "`deaf` is not a fault; there are silent"),
        (&[MR_DO4, "--fault", "unit=19,silent"], "unit 19 is not on this line; there are 18"),
        (&[MR_DO4, "--parity", "odds"], "a parity is `even`, `odd` or `none`"),
        (&[MR_DO4, "--turnaround", "5"], "`5` is not a duration; write it as `80ms`"),
        (&["--profile", "my.yaml"], "`my.yaml` names no unit; write it as `my-device.yaml@5`"),
        (&["--profile", "my.yaml@0"], "`0` is not a unit; a unit is 1 to 247"),
        (&["--profile", "/nowhere/my.yaml@5"], "cannot read the profile `/nowhere/my.yaml`"),
    ] {
        let with_door: Vec<&str> = match arguments.len() {
            0 => Vec::new(),
            1 if arguments == [MR_DO4] => arguments.to_vec(),
            _ => arguments.iter().chain(&tcp).copied().collect(),
        };
        let output = run(&with_door);
        let told = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {told}");
        assert!(told.contains(wanted), "{arguments:?}: {told}");
    }
}

#[test]
fn all_errors_of_a_script_are_told_with_their_places_and_nothing_is_started() {
    let directory = tempfile::tempdir().expect("a directory");
    let script = directory.path().join("script");
    std::fs::write(&script, "unit 18 restart\nunit 18 fly\n\nat 5 unit 18 restart\n").expect("written");
    let output = run(&[MR_DO4, "--tcp", "127.0.0.1:0", "--script", text(&script)]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{told}");
    for wanted in [
        format!("{}:2: `fly` is not a command", script.display()),
        format!("{}:4: `5` is not a duration", script.display()),
        "error: 2 faults, nothing was started".into(),
    ] {
        assert!(told.contains(&wanted), "{wanted:?} in {told}");
    }
}

#[test]
fn devices_are_served_obey_commands_tell_of_their_relays_and_leave_nothing_behind() {
    let directory = tempfile::tempdir().expect("a directory");
    let link = directory.path().join("line");
    let script = directory.path().join("script");
    std::fs::write(&script, "at 10ms unit 18 relay 4 hand on\n").expect("written");
    // What an earlier run that was killed has left is replaced.
    std::os::unix::fs::symlink("/nowhere", &link).expect("a link");

    let state = directory.path().join("state");
    let arguments = [
        MR_DO4,
        "--pty",
        text(&link),
        "--tcp",
        "127.0.0.1:0",
        "--state-dir",
        text(&state),
        "--script",
        text(&script),
    ];
    let mut simulation = Running::start(&arguments);
    assert_eq!(simulation.next_line(), format!("pty {}", link.display()));
    let address = simulation.next_line().strip_prefix("tcp ").expect("an address").to_string();
    simulation.wait_for("metz-connect/mr-do4@18 hand_4 ON");

    let mut stream = TcpStream::connect(&address).expect("connected");
    let switch_on = [0, 1, 0, 0, 0, 6, 18, 5, 0, 1, 0xFF, 0];
    exchange(&mut stream, &switch_on, &switch_on);
    simulation.wait_for("metz-connect/mr-do4@18 relay_2 ON");
    let defaults = [0, 2, 0, 0, 0, 6, 18, 6, 0, 1, 0, 4];
    exchange(&mut stream, &defaults, &defaults);
    simulation.say("unit 18 relay 1 hand on");
    simulation.wait_for("metz-connect/mr-do4@18 relay_1 ON");
    simulation.end(Signal::TERM);
    assert!(std::fs::symlink_metadata(&link).is_err(), "the link is still there");

    // The relays' defaults were in the EEPROM.
    let mut simulation = Running::start(&[MR_DO4, "--tcp", "127.0.0.1:0", "--state-dir", text(&state)]);
    let address = simulation.next_line().strip_prefix("tcp ").expect("an address").to_string();
    let mut stream = TcpStream::connect(&address).expect("connected");
    exchange(&mut stream, &[0, 3, 0, 0, 0, 6, 18, 1, 0, 0, 0, 4], &[0, 3, 0, 0, 0, 4, 18, 1, 1, 4]);
    simulation.end(Signal::INT);
}

/// Its cases are in a file beside it, as those of the shipped profiles are.
const PROFILE: &str = "device: acme/thermostat
manufacturer: Acme
model: Thermostat
source: invented
identify: {at: input 9, equals: 0x5A00}
points:
  temperature: {at: input 0, type: i16, decimals: 1, unit: °C, poll: fast}
  setpoint: {at: holding 0, decimals: 1, unit: °C, poll: slow, write: 5..30, default: 200, persistent: true}
  mode: {at: holding 1, poll: slow, values: shared/modes, write: any}
";

#[test]
fn a_profile_of_ones_own_is_served_beside_other_devices_and_read_back() {
    let directory = tempfile::tempdir().expect("a directory");
    let (link, state) = (directory.path().join("line"), directory.path().join("state"));
    std::fs::create_dir(directory.path().join("shared")).expect("a folder");
    let shared = "1: {name: heat, unit: °C}\n2: {name: cool, unit: °C}\n";
    std::fs::write(directory.path().join("shared/modes.yaml"), shared).expect("written");
    let profile = directory.path().join("thermostat.yaml");
    std::fs::write(&profile, PROFILE).expect("written");
    let profile_at_19 = format!("{}@19", profile.display());
    let pty = ["--pty", text(&link), "--state-dir", text(&state)];
    let arguments = [&[MR_DO4, "--profile", profile_at_19.as_str()], &pty[..]].concat();
    let mut simulation = Running::start(&arguments);
    assert_eq!(simulation.next_line(), format!("pty {}", link.display()));

    simulation.say("unit 19 set 'holding 1' 2");
    simulation.wait_for("acme/thermostat@19 mode cool");
    simulation.say("unit 19 set 'input 0' -55");
    simulation.say("unit 18 relay 1 hand on");
    simulation.wait_for("metz-connect/mr-do4@18 relay_1 ON");
    // By hand, as raw registers of the one and the other device.
    let by_hand = |verb: &str, unit: &str, rest: &[&str]| by_hand(verb, &link, unit, rest);
    assert!(by_hand("read", "19", &["input 0"]).contains("-55"));
    assert!(by_hand("read", "19", &["input 9"]).contains("5A00"));
    assert!(by_hand("read", "18", &["coil 0..3"]).contains("coil 0  ON"));
    assert!(by_hand("write", "19", &["holding 0", "225"]).contains("225"));
    simulation.wait_for("acme/thermostat@19 setpoint 22.5");

    // By the profile, as the gateway understands it.
    let configuration = directory.path().join("busker.yaml");
    let profiles = directory.path().join("profiles/acme");
    std::fs::create_dir_all(&profiles).expect("a folder");
    std::fs::create_dir(directory.path().join("profiles/shared")).expect("a folder");
    std::fs::write(directory.path().join("profiles/shared/modes.yaml"), shared).expect("written");
    std::fs::write(profiles.join("thermostat.yaml"), PROFILE).expect("written");
    let told = format!(
        "mqtt: {{url: mqtt://127.0.0.1}}
profiles: [{}]
buses: {{line: {{serial: {}, baud: 19200, parity: even}}}}
devices: {{thermostat: {{profile: acme/thermostat, bus: line, unit: 19}}}}
",
        directory.path().join("profiles").display(),
        link.display()
    );
    std::fs::write(&configuration, told).expect("written");
    let by_name = ["--config", text(&configuration), "--device", "thermostat"];
    for (point, wanted) in [("temperature", "-5.5"), ("setpoint", "22.5"), ("mode", "cool")] {
        let told = succeed("read", &[&by_name[..], &[point]].concat());
        assert!(told.contains(wanted), "{told}");
    }
    // What is made of a value is said.
    let told = succeed("write", &[&by_name[..], &["setpoint", "22.48"]].concat());
    assert_eq!(told, "setpoint  unchanged  the device holds 22.5  `22.48` is rounded to 22.5\n");
    let told = succeed("write", &[&by_name[..], &["setpoint", "22.5"]].concat());
    assert_eq!(told, "setpoint  unchanged  the device holds 22.5\n");
    simulation.end(Signal::TERM);

    // The setpoint was in the EEPROM, and nothing else.
    let mut simulation = Running::start(&arguments);
    assert_eq!(simulation.next_line(), format!("pty {}", link.display()));
    assert!(by_hand("read", "19", &["holding 0"]).contains("225"));
    assert!(by_hand("read", "19", &["holding 1"]).contains("0001"));
    simulation.end(Signal::TERM);
}

#[test]
fn faults_of_a_profile_are_told_with_their_places_and_nothing_is_started() {
    let directory = tempfile::tempdir().expect("a directory");
    let profile = directory.path().join("my.yaml");
    std::fs::write(&profile, PROFILE.replace("poll: fast", "poll: often")).expect("written");
    let output = run(&["--profile", &format!("{}@5", profile.display()), "--tcp", "127.0.0.1:0"]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{told}");
    assert!(told.contains(&format!("{}:7:", profile.display())), "{told}");
    assert!(output.stdout.is_empty(), "{output:?}");
}

/// What `busker VERB` says of registers at a unit of the line.
fn by_hand(verb: &str, link: &Path, unit: &str, rest: &[&str]) -> String {
    succeed(verb, &[&["--serial", text(link), "--unit", unit], rest].concat())
}

fn succeed(verb: &str, arguments: &[&str]) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_busker"));
    let output = command.arg(verb).args(arguments).output().expect("it starts");
    assert!(output.status.success(), "{verb} {arguments:?}: {output:?}");
    String::from_utf8(output.stdout).expect("text")
}

#[test]
fn a_file_that_is_no_link_is_not_replaced() {
    let directory = tempfile::tempdir().expect("a directory");
    let file = directory.path().join("line");
    std::fs::write(&file, "precious").expect("written");
    let output = run(&[MR_DO4, "--pty", text(&file)]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{told}");
    assert!(told.contains("is there and no symbolic link; name another place"), "{told}");
    assert_eq!(std::fs::read_to_string(&file).expect("still there"), "precious");
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a path of text")
}

fn exchange(stream: &mut TcpStream, request: &[u8], wanted: &[u8]) {
    stream.set_read_timeout(Some(PATIENCE)).expect("a socket");
    stream.write_all(request).expect("sent");
    let mut reply = vec![0; wanted.len()];
    stream.read_exact(&mut reply).expect("a reply");
    assert_eq!(reply, wanted);
}

/// A running `busker simulate`; it is killed if the test fails.
struct Running {
    child: Child,
    input: ChildStdin,
    lines: Receiver<String>,
}

impl Running {
    fn start(arguments: &[&str]) -> Running {
        let mut child = busker(arguments).spawn().expect("it starts");
        let input = child.stdin.take().expect("a pipe");
        let output = BufReader::new(child.stdout.take().expect("a pipe"));
        let (sender, lines) = channel();
        std::thread::spawn(move || {
            for line in output.lines() {
                if line.is_ok_and(|line| sender.send(line).is_err()) {
                    return;
                }
            }
        });
        Running { child, input, lines }
    }

    fn next_line(&mut self) -> String {
        self.lines.recv_timeout(PATIENCE).expect("a line")
    }

    #[track_caller]
    fn wait_for(&mut self, wanted: &str) {
        while self.next_line() != wanted {}
    }

    fn say(&mut self, command: &str) {
        writeln!(self.input, "{command}").expect("it listens");
    }

    fn end(mut self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).expect("signalled");
        assert_eq!(self.child.wait().expect("a child").code(), Some(0));
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
