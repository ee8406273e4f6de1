//! What the help of each verb shows is typed here as it stands there, with simulated devices where the
//! examples have theirs: an example that fails is worse than none.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::process::{Command, Stdio};

use rustix::process::{Pid, Signal, kill_process_group};

use super::{Running, text};

/// The device of one's own that the examples speak of; it is what has unit 1, too.
const MY_DEVICE: &str = "device: acme/thermostat
manufacturer: Acme
model: Thermostat
source: invented
points:
  temperatures: {at: input 0, count: 10, type: i16, poll: never}
  setpoint: {at: holding 16, poll: slow, write: 0..65535}
  limit: {at: holding 17, poll: slow, write: 0..65535}
";

/// Verbs that go on until they are interrupted, with the word by which one sees that they have begun.
const GO_ON: [(&str, &str); 3] =
    [("busker run ", "started with 1 device"), ("busker demo", " online"), ("busker simulate ", "pty ")];

#[test]
fn each_example_of_the_help_does_what_it_shows() {
    let directory = tempfile::tempdir().expect("a directory");
    let file = |name: &str| directory.path().join(name);
    std::fs::write(file("my-device.yaml"), MY_DEVICE).expect("written");
    let (line, of_one) = (file("ttyUSB0"), format!("{}@1", file("my-device.yaml").display()));
    let devices = ["metz-connect/mr-do4@18", "--profile", &of_one];
    let mut simulation =
        Running::start(&[&devices[..], &["--pty", text(&line), "--tcp", "127.0.0.1:0"]].concat());
    simulation.next_line();
    let address = simulation.next_line().strip_prefix("tcp ").expect("an address").to_string();
    let configuration = format!(
        "mqtt: {{url: mqtt://127.0.0.1:9}}\nhttp: null\nstate_dir: {}\nbuses: {{basement: {{serial: {}, response_timeout: 5s}}}}\n\
         devices: {{heating_relays: {{profile: metz-connect/mr-do4, bus: basement, unit: 18}}}}\n",
        file("state").display(),
        line.display()
    );
    std::fs::write(file("busker.yaml"), configuration).expect("written");
    std::fs::create_dir(file("state")).expect("a folder");

    let examples = examples();
    assert!(examples.len() > 25, "{examples:#?}");
    for Example { shown, typed } in examples {
        let command = shown
            .replace("/dev/ttyUSB0", text(&line))
            .replace("192.168.1.20:502", &address)
            .replace("/etc/busker/", "")
            .replace("/tmp/line", text(&file("line")))
            .replace("127.0.0.1:8485", "127.0.0.1:0")
            .replace("127.0.0.1:1502", "127.0.0.1:0")
            .replacen("busker", env!("CARGO_BIN_EXE_busker"), 1);
        // The reply is what matters, and not how busy the machine is that runs the tests.
        let patience = match shown.split(' ').nth(1) {
            Some("doctor") => "",
            // Each unit that is not there costs its time.
            Some("scan") if shown.contains("--units") => "",
            Some("scan") => "--units 15..20",
            _ if shown.contains(" --serial ") || shown.contains(" --tcp 192") => "--timeout 5s",
            _ => "",
        };
        let mut shell = Command::new("sh");
        shell.arg("-c").arg(format!("exec 2>&1; exec {command} {patience}")).current_dir(directory.path());
        match GO_ON.iter().find(|(verb, _)| shown.starts_with(verb)) {
            Some((_, sign)) => goes_on(&shown, shell, &typed, sign),
            None => {
                let output = shell.stdin(Stdio::null()).output().expect("a shell");
                let told = String::from_utf8_lossy(&output.stdout);
                assert!(output.status.success(), "`{shown}` {}:\n{told}", output.status);
            }
        }
    }
    simulation.end(Signal::TERM);
}

/// A line of a help, and what is to be typed once it runs.
#[derive(Debug)]
struct Example {
    shown: String,
    typed: String,
}

/// All examples of all verbs, in the order of their help.
fn examples() -> Vec<Example> {
    let mut examples: Vec<Example> = Vec::new();
    let mut verbs = vec![Vec::new()];
    while !verbs.is_empty() {
        let verb: Vec<String> = verbs.remove(0);
        let output = Command::new(env!("CARGO_BIN_EXE_busker")).args(&verb).arg("--help").output();
        let help = String::from_utf8(output.expect("it starts").stdout).expect("text");
        let indented =
            |title: &str| help.split(title).nth(1).map(|text| text.lines().skip(1)).into_iter().flatten();
        let below = indented("\nCommands:").take_while(|line| line.starts_with("  "));
        for name in below.filter_map(|line| line.split_whitespace().next()) {
            verbs.push([&verb[..], &[name.to_string()]].concat());
        }
        let told = examples.len();
        for line in indented("\nExample").filter_map(|line| line.strip_prefix("  ")) {
            match examples[told..].last_mut() {
                _ if line.starts_with("busker ") => {
                    examples.push(Example { shown: line.to_string(), typed: String::new() });
                }
                Some(example) if !line.ends_with(':') => {
                    example.typed += line;
                    example.typed.push('\n');
                }
                _ => {}
            }
        }
        assert!(examples.len() > told, "`busker {}` shows no example:\n{help}", verb.join(" "));
    }
    examples
}

/// Waits for the sign of life, types, and interrupts: that is how it ends well.
#[track_caller]
fn goes_on(shown: &str, mut shell: Command, typed: &str, sign: &str) {
    let mut child =
        shell.process_group(0).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("a shell");
    let mut input = child.stdin.take().expect("a pipe");
    let mut lines = BufReader::new(child.stdout.take().expect("a pipe")).lines().map_while(Result::ok);
    let mut told = String::new();
    let mut wait_for = |sign: &str| {
        for line in lines.by_ref() {
            told += &line;
            told.push('\n');
            if line.contains(sign) {
                return;
            }
        }
        panic!("`{shown}` did not tell `{sign}`:\n{told}");
    };
    wait_for(sign);
    for line in typed.lines() {
        writeln!(input, "{line}").expect("it listens");
        // It is told of relays that switch; what is wrong with a line would be told as well, and first.
        if line.ends_with("hand on") {
            wait_for("relay_2 ON");
        }
    }
    kill_process_group(Pid::from_child(&child), Signal::INT).expect("signalled");
    let rest: Vec<String> = lines.collect();
    let status = child.wait().expect("a child");
    assert!(status.success() && !told.contains("error: "), "`{shown}` {status}:\n{told}{rest:#?}");
}
