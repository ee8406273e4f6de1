//! `make demo` as a newcomer does it: start it, read what it prints, do what it says, interrupt it.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use busker::simulator::Model;
use rustix::process::{Pid, Signal, kill_process, kill_process_group};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Winsize, tcsetwinsize};

/// Far longer than anything here takes; only a failing test waits for it.
const PATIENCE: Duration = Duration::from_secs(120);

const DEVICES: [&str; 4] =
    ["metz_connect_mr_do4", "metz_connect_mr_ai8", "metz_connect_mr_si4", "fuehlersysteme_relay8"];

#[test]
fn make_demo_shows_live_values_and_its_three_commands_do_what_they_say() {
    let temporary = tempfile::tempdir().expect("a temporary folder");
    let mut command = Command::new("make");
    command.args(["--silent", "demo"]).env("TMPDIR", temporary.path());
    // A make within a make would ask the outer one how many jobs it may run. And a library is built anew
    // where what cargo says of a package is in its environment: here that is said of this test.
    for (variable, _) in std::env::vars_os() {
        let name = variable.to_string_lossy();
        let is_of_make = ["MAKEFLAGS", "MFLAGS", "MAKELEVEL"].contains(&name.as_ref());
        let is_of_cargo =
            name == "OUT_DIR" || name.starts_with("CARGO_PKG_") || name.starts_with("CARGO_MANIFEST_");
        if is_of_make || is_of_cargo {
            command.env_remove(&variable);
        }
    }
    let mut demo = Demo::start(&mut command);
    let introduction = demo.introduction();

    // In whatever order they answer.
    let mut awaited: Vec<String> = DEVICES.iter().map(|device| format!("{device} online")).collect();
    while !awaited.is_empty() {
        let online = demo.wait_for("every device online", |line| awaited.iter().any(|other| other == line));
        awaited.retain(|other| *other != online);
    }
    let health = ureq::get(&introduction.health).call().expect("health is answered");
    assert_eq!(health.status(), 200);
    let health: serde_json::Value =
        serde_json::from_reader(health.into_body().into_reader()).expect("health is JSON");
    assert_eq!(health["status"], "ok", "{health}");

    let mut watch = Demo::start(Command::new("sh").arg("-c").arg(format!("exec {}", introduction.watch)));
    watch.wait_for("the bridge", |line| line == "busker/bridge/state online");
    watch.wait_for("a relay", |line| line == "busker/metz_connect_mr_do4/relay_1 OFF");

    shell(&introduction.switch);
    demo.wait_for("the relay on", |line| line == "metz_connect_mr_do4/relay_1 ON");
    watch.wait_for("the relay on", |line| line == "busker/metz_connect_mr_do4/relay_1 ON");
    watch.wait_for("the outcome", |line| {
        line.starts_with("busker/metz_connect_mr_do4/relay_1/outcome ") && line.contains("\"done\"")
    });

    shell(&introduction.change);
    demo.wait_for("degrees", |line| {
        line.starts_with("metz_connect_mr_ai8/channel_1_value 2") && line.ends_with(" °C")
    });

    demo.signal_group(Signal::INT);
    let status = demo.wait();
    watch.wait_for("the last word", |line| line == "busker/bridge/state offline");
    drop(watch);
    // make says that it was interrupted; everything below it ended well.
    assert!(status.code() == Some(0) || status.code() == Some(2) || status.signal() == Some(2), "{status:?}");
    assert!(TcpStream::connect(introduction.broker).is_err(), "the broker is still there");
    let left: Vec<_> = temporary.path().read_dir().expect("a folder").collect();
    assert!(left.is_empty(), "{left:?}");
}

#[test]
fn on_a_terminal_it_is_a_table_that_is_redrawn_in_place() {
    let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
    let controller = openpt(flags).expect("a pseudo-terminal");
    grantpt(&controller).and_then(|()| unlockpt(&controller)).expect("it can be used");
    let path = ptsname(&controller, Vec::new()).expect("its name").into_string().expect("in UTF-8");
    let terminal = File::options().read(true).write(true).open(path).expect("it opens");
    let size = Winsize { ws_row: 40, ws_col: 100, ws_xpixel: 0, ws_ypixel: 0 };
    tcsetwinsize(&terminal, size).expect("a size");
    let mut child = Command::new(env!("CARGO_BIN_EXE_busker"))
        .arg("demo")
        .stdin(Stdio::null())
        .stdout(terminal)
        .spawn()
        .expect("the program starts");

    // What it writes, frame by frame: each begins at the upper left corner.
    let mut controller = File::from(controller);
    let (mut text, mut buffer, mut is_stopping) = (String::new(), [0; 4096], false);
    // Reading fails when the last writer has gone.
    while let Ok(count @ 1..) = controller.read(&mut buffer) {
        text.push_str(&String::from_utf8_lossy(&buffer[..count]));
        // The reading of a meter that counts: the table lives.
        let counts = |frame: &&str| frame.contains("meter_1_reading ") && frame.contains("relay_1 OFF");
        if !is_stopping && text.split("\x1b[H").filter(counts).count() >= 3 {
            kill_process(Pid::from_child(&child), Signal::TERM).expect("it can be signalled");
            is_stopping = true;
        }
    }
    assert_eq!(child.wait().expect("it ends").code(), Some(0));
    assert!(text.starts_with("\x1b[2J\x1b[?25l"), "it begins on an empty screen, without a cursor");
    assert!(text.ends_with("\x1b[?25h\r\n"), "it gives the cursor back");
    assert!(
        text.split("\x1b[H").skip(1).all(|frame| frame.starts_with("busker demo: 4 simulated")),
        "{text}"
    );
}

#[test]
fn with_all_every_device_that_there_is_answers() {
    let mut demo = Demo::start(Command::new(env!("CARGO_BIN_EXE_busker")).args(["demo", "--all"]));
    let introduction = demo.introduction();
    let mut awaited: Vec<String> =
        Model::ALL.map(|model| format!("{} online", model.id().replace(['/', '-'], "_"))).to_vec();
    while !awaited.is_empty() {
        let online = demo.wait_for("every device online", |line| awaited.iter().any(|other| other == line));
        awaited.retain(|other| *other != online);
    }
    let health = ureq::get(&introduction.health).call().expect("health is answered");
    let health: serde_json::Value =
        serde_json::from_reader(health.into_body().into_reader()).expect("health is JSON");
    assert_eq!(health["status"], "ok", "{health}");
    assert_eq!(health["buses"].as_object().map(serde_json::Map::len), Some(3), "{health}");
    demo.signal(Signal::TERM);
    assert_eq!(demo.wait().code(), Some(0));
}

#[test]
fn a_request_to_terminate_ends_it_well() {
    let mut demo = Demo::start(Command::new(env!("CARGO_BIN_EXE_busker")).arg("demo"));
    let introduction = demo.introduction();
    demo.wait_for("a value", |line| line.starts_with("metz_connect_mr_do4/relay_1 "));
    demo.signal(Signal::TERM);
    assert_eq!(demo.wait().code(), Some(0));
    assert!(TcpStream::connect(introduction.broker).is_err(), "the broker is still there");
}

#[test]
fn a_killed_demo_takes_its_broker_with_it() {
    let mut demo = Demo::start(Command::new(env!("CARGO_BIN_EXE_busker")).arg("demo"));
    let introduction = demo.introduction();
    demo.signal(Signal::KILL);
    demo.wait();
    let gone = (0..1000).any(|_| {
        // Nobody tells us when a stranger's child has ended; so it is asked again and again.
        std::thread::sleep(Duration::from_millis(10));
        TcpStream::connect(introduction.broker).is_err()
    });
    assert!(gone, "the broker is still there");
}

#[test]
fn a_port_that_is_taken_is_said_and_nothing_is_left() {
    let taken = TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = taken.local_addr().expect("its address").to_string();
    for option in ["--mqtt", "--http"] {
        let output = Command::new(env!("CARGO_BIN_EXE_busker"))
            .args(["demo", option, &address])
            .output()
            .expect("the program starts");
        assert_eq!(output.status.code(), Some(1), "{option}: {output:?}");
        let told = String::from_utf8_lossy(&output.stderr);
        assert!(told.contains("error: ") && told.contains(&address), "{option}: {told}");
    }
}

/// What the first lines say.
struct Introduction {
    broker: SocketAddr,
    health: String,
    watch: String,
    switch: String,
    change: String,
}

/// A running program whose lines are read. It is killed with its group if the test fails.
struct Demo {
    child: Child,
    lines: Receiver<String>,
    seen: Vec<String>,
}

impl Demo {
    fn start(command: &mut Command) -> Demo {
        let mut child = command
            .current_dir(Path::new(env!("CARGO_MANIFEST_DIR")))
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .process_group(0)
            .spawn()
            .expect("it starts");
        let stdout = child.stdout.take().expect("its output");
        let (sender, lines) = channel();
        std::thread::spawn(move || {
            for line in BufReader::new(stdout).lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        Demo { child, lines, seen: Vec::new() }
    }

    fn introduction(&mut self) -> Introduction {
        let broker = self.wait_for("the broker", |line| line.starts_with("broker "));
        let broker = broker.split("mqtt://").nth(1).expect("an address").parse().expect("an address");
        let health = self.wait_for("health", |line| line.starts_with("health "));
        let health = health.split_whitespace().nth(1).expect("an address").to_string();
        let mut after = |label: &str| {
            self.wait_for(label, |line| line == label);
            self.wait_for("the command", |_| true)
        };
        let watch = after("watch everything:");
        let switch = after("switch a relay:");
        let change = after("change an input's sensor type:");
        Introduction { broker, health, watch, switch, change }
    }

    /// The next line that fits.
    #[expect(clippy::disallowed_methods, reason = "other lines come for ever")]
    fn wait_for(&mut self, what: &str, fits: impl Fn(&str) -> bool) -> String {
        let begun = Instant::now();
        loop {
            match self.lines.recv_timeout(PATIENCE.saturating_sub(begun.elapsed())) {
                Ok(line) if fits(&line) => return line,
                Ok(line) => self.seen.push(line),
                Err(error) => panic!("{what} did not come ({error}); seen:\n{}", self.seen.join("\n")),
            }
        }
    }

    fn pid(&self) -> Pid {
        Pid::from_child(&self.child)
    }

    fn signal(&self, signal: Signal) {
        kill_process(self.pid(), signal).expect("it can be signalled");
    }

    /// As a terminal does it: everything in the foreground gets the signal.
    fn signal_group(&self, signal: Signal) {
        kill_process_group(self.pid(), signal).expect("it can be signalled");
    }

    fn wait(&mut self) -> ExitStatus {
        self.child.wait().expect("it ends")
    }
}

impl Drop for Demo {
    fn drop(&mut self) {
        if matches!(self.child.try_wait(), Ok(None)) {
            let _ = kill_process_group(self.pid(), Signal::KILL);
            let _ = self.child.wait();
        }
    }
}

fn shell(command: &str) {
    let status = Command::new("sh").arg("-c").arg(command).status().expect("a shell");
    assert!(status.success(), "{command}");
}
