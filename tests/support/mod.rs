//! What tests of the whole program share: a broker of their own, the built program, and somebody who
//! listens on MQTT. Each takes free ports and ends with the test.

#![allow(dead_code, reason = "each test uses its own part of it")]

use std::fs;
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

use busker::edge::clock::Clock;
use rumqttc::{Client, Event, MqttOptions, Packet, QoS};
use serde_json::Value;
use tempfile::TempDir;

/// What a test waits for comes within this time, or the test fails.
pub const PATIENCE: Duration = Duration::from_secs(20);

/// Looks until there is something; fails with `what` after [`PATIENCE`].
pub fn wait_for<T>(what: &str, look: impl FnMut() -> Option<T>) -> T {
    find(look).unwrap_or_else(|| panic!("waited in vain for {what}"))
}

/// Looks until there is something, for as long as [`PATIENCE`].
pub fn find<T>(mut look: impl FnMut() -> Option<T>) -> Option<T> {
    let clock = Clock::start();
    let end = clock.now() + PATIENCE;
    loop {
        if let Some(found) = look() {
            return Some(found);
        }
        if clock.now() > end {
            return None;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A port that nobody listens on at this moment.
pub fn free_port() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").expect("loopback has free ports");
    listener.local_addr().expect("a bound listener has an address").port()
}

/// A mosquitto on a free port of the loopback, without anything on disk but its configuration.
pub struct Mosquitto {
    child: Child,
    port: u16,
    folder: TempDir,
}

impl Mosquitto {
    pub fn start() -> Mosquitto {
        let folder = tempfile::tempdir().expect("a temporary folder");
        // Somebody may take the port between the look and the start.
        for _ in 0..5 {
            let port = free_port();
            if let Some(child) = start_mosquitto(&folder, port) {
                return Mosquitto { child, port, folder };
            }
        }
        panic!("mosquitto does not start; is it installed? `scripts/get-mosquitto` gets it");
    }

    pub fn port(&self) -> u16 {
        self.port
    }

    pub fn url(&self) -> String {
        format!("mqtt://127.0.0.1:{}", self.port)
    }

    /// Kills it, with everything retained.
    pub fn stop(&mut self) {
        end(&mut self.child);
    }

    /// Starts it again on the same port.
    pub fn start_again(&mut self) {
        self.child = start_mosquitto(&self.folder, self.port).expect("mosquitto starts again");
    }
}

impl Drop for Mosquitto {
    fn drop(&mut self) {
        end(&mut self.child);
    }
}

/// `None` if the port is taken.
fn start_mosquitto(folder: &TempDir, port: u16) -> Option<Child> {
    let configuration = folder.path().join("mosquitto.conf");
    let text =
        format!("listener {port} 127.0.0.1\nallow_anonymous true\npersistence false\nlog_dest stderr\n");
    fs::write(&configuration, text).expect("a temporary file can be written");
    // Debian keeps it where only root's PATH leads.
    let path = format!("{}:/usr/sbin:/usr/local/sbin", std::env::var("PATH").unwrap_or_default());
    let mut command = Command::new("mosquitto");
    command.arg("-c").arg(configuration).env("PATH", path).stdout(Stdio::null()).stderr(Stdio::piped());
    let mut child = command.spawn().expect("mosquitto is installed; `scripts/get-mosquitto` gets it");
    let mut log = BufReader::new(child.stderr.take().expect("it is piped")).lines().map_while(Result::ok);
    // A connection would prove nothing: somebody else's broker may have been faster. Without the
    // port it ends, and so does its log.
    let runs = log.any(|line| line.ends_with(" running"));
    if !runs {
        end(&mut child);
        return None;
    }
    std::thread::spawn(move || log.for_each(drop));
    Some(child)
}

/// The built program, its log kept for the failure message.
pub struct Busker {
    child: Child,
    log: Arc<Mutex<String>>,
    /// `host:port`
    http: Option<String>,
    folder: TempDir,
}

impl Busker {
    /// `busker run` with a configuration made of `rest` (buses, devices, …), this broker, a free
    /// port for HTTP and a state directory of its own.
    pub fn run(broker: &Mosquitto, rest: &str) -> Busker {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let text = format!(
            "mqtt:\n  url: {}\nhttp: {{listen: \"127.0.0.1:0\"}}\nstate_dir: {}\n{rest}",
            broker.url(),
            folder.path().display(),
        );
        let config = folder.path().join("busker.yaml");
        fs::write(&config, text).expect("a temporary file can be written");
        let mut busker = Busker::start(&["run", "--config", &config.to_string_lossy()], folder);
        busker.http = Some(wait_for("the address of HTTP", || {
            let log = busker.log();
            let (_, behind) = log.split_once("HTTP on http://")?;
            behind.split_once("/health").map(|(address, _)| address.to_owned())
        }));
        busker
    }

    fn start(arguments: &[&str], folder: TempDir) -> Busker {
        let mut child = Command::new(program())
            .args(arguments)
            .env("RUST_LOG", "debug")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the program is built");
        let log = Arc::new(Mutex::new(String::new()));
        let lines = BufReader::new(child.stderr.take().expect("it is piped")).lines();
        let written = log.clone();
        std::thread::spawn(move || {
            for line in lines.map_while(Result::ok) {
                *written.lock().expect("nobody panics with it") += &format!("{line}\n");
            }
        });
        Busker { child, log, http: None, folder }
    }

    /// What it said so far on standard error.
    pub fn log(&self) -> String {
        self.log.lock().expect("nobody panics with it").clone()
    }

    /// The files that it holds open.
    pub fn open_files(&self) -> Vec<PathBuf> {
        let folder = fs::read_dir(format!("/proc/{}/fd", self.child.id())).expect("it runs");
        folder.filter_map(|entry| fs::read_link(entry.ok()?.path()).ok()).collect()
    }

    /// `GET path`; `None` while nobody answers.
    pub fn get(&self, path: &str) -> Option<String> {
        let url = format!("http://{}{path}", self.http.as_ref()?);
        let agent: ureq::Agent = ureq::Agent::config_builder().http_status_as_error(false).build().into();
        agent.get(&url).call().ok()?.body_mut().read_to_string().ok()
    }

    /// `GET path`, whatever bytes it is made of, with what the answer says of itself under `header`.
    pub fn download(&self, path: &str, header: &str) -> Option<(Vec<u8>, String)> {
        let url = format!("http://{}{path}", self.http.as_ref()?);
        let mut answer = ureq::get(&url).call().ok()?;
        let told = answer.headers().get(header)?.to_str().ok()?.to_owned();
        Some((answer.body_mut().read_to_vec().ok()?, told))
    }

    /// Where its configuration lies, and what it keeps.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// `GET path` as JSON.
    pub fn json(&self, path: &str) -> Option<Value> {
        serde_json::from_str(&self.get(path)?).ok()
    }

    /// The number of its process.
    pub fn process(&self) -> u32 {
        self.child.id()
    }

    /// Asks it to end, and waits for that.
    pub fn stop(&mut self) -> ExitStatus {
        let id = rustix::process::Pid::from_child(&self.child);
        // It may have ended by itself.
        let _ = rustix::process::kill_process(id, rustix::process::Signal::TERM);
        wait_for("the program's end", || self.child.try_wait().expect("a child can be asked"))
    }

    /// Ends it without a chance to say anything.
    pub fn kill(&mut self) {
        end(&mut self.child);
    }
}

impl Drop for Busker {
    fn drop(&mut self) {
        end(&mut self.child);
        if std::thread::panicking() {
            eprintln!("what the program said:\n{}", self.log());
        }
    }
}

/// The program as it was built for this test.
pub fn program() -> PathBuf {
    Path::new(env!("CARGO_BIN_EXE_busker")).to_owned()
}

fn end(child: &mut Child) {
    // It may have ended by itself.
    let _ = child.kill();
    let _ = child.wait();
}

/// A message as somebody saw it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Seen {
    pub topic: String,
    pub payload: String,
    /// It was there before the observer was.
    pub retained: bool,
}

/// Subscribes to everything on a broker and remembers it in its order.
pub struct Observer {
    client: Client,
    seen: Arc<(Mutex<Vec<Seen>>, Condvar)>,
}

impl Observer {
    /// Returns when the subscription stands: nothing that is published afterwards is missed.
    pub fn of(broker: &Mosquitto) -> Observer {
        let mut options = MqttOptions::new(format!("observer-{}", free_port()), "127.0.0.1", broker.port());
        options.set_max_packet_size(1 << 20, 1 << 20);
        let (client, mut connection) = Client::new(options, 1000);
        let seen = Arc::new((Mutex::new(Vec::new()), Condvar::new()));
        let (subscribed, stands) = std::sync::mpsc::channel();
        let (thread_client, thread_seen) = (client.clone(), seen.clone());
        std::thread::spawn(move || {
            for event in connection.iter() {
                match event {
                    Ok(Event::Incoming(Packet::ConnAck(_))) => {
                        thread_client.try_subscribe("#", QoS::AtLeastOnce).expect("there is room");
                    }
                    // The test that asked for it may be over.
                    Ok(Event::Incoming(Packet::SubAck(_))) => drop(subscribed.send(())),
                    Ok(Event::Incoming(Packet::Publish(publish))) => {
                        let payload = String::from_utf8_lossy(&publish.payload).into_owned();
                        let message = Seen { topic: publish.topic, payload, retained: publish.retain };
                        let (messages, changed): &(Mutex<Vec<Seen>>, Condvar) = &thread_seen;
                        messages.lock().expect("nobody panics with it").push(message);
                        changed.notify_all();
                    }
                    Ok(Event::Outgoing(rumqttc::Outgoing::Disconnect)) => return,
                    Ok(_) => {}
                    // The broker is away; it comes back, or the test ends.
                    Err(_) => std::thread::sleep(Duration::from_millis(50)),
                }
            }
        });
        stands.recv_timeout(PATIENCE).expect("the broker takes the subscription");
        Observer { client, seen }
    }

    /// Publishes without retaining.
    pub fn publish(&self, topic: &str, payload: &str) {
        self.client.publish(topic, QoS::AtLeastOnce, false, payload).expect("there is room");
    }

    pub fn publish_retained(&self, topic: &str, payload: &str) {
        self.client.publish(topic, QoS::AtLeastOnce, true, payload).expect("there is room");
    }

    /// Everything so far.
    pub fn seen(&self) -> Vec<Seen> {
        self.seen.0.lock().expect("nobody panics with it").clone()
    }

    /// Every payload of `topic` so far.
    pub fn payloads(&self, topic: &str) -> Vec<String> {
        self.seen().into_iter().filter(|seen| seen.topic == topic).map(|seen| seen.payload).collect()
    }

    /// How many messages there are so far: a place from which to wait.
    pub fn count(&self) -> usize {
        self.seen.0.lock().expect("nobody panics with it").len()
    }

    /// Waits until the last payload of `topic` is `payload`.
    pub fn wait_for(&self, topic: &str, payload: &str) {
        let is_last = |seen: &[Seen]| {
            let last = seen.iter().rev().find(|seen| seen.topic == topic);
            last.filter(|seen| seen.payload == payload).map(|_| ())
        };
        if self.wait(is_last).is_none() {
            panic!("waited in vain for `{payload}` on {topic}; it said {:?}", self.payloads(topic));
        }
    }

    /// Waits for a message on `topic` after the first `from` messages; returns its payload.
    pub fn wait_for_next(&self, topic: &str, from: usize) -> String {
        let next = |seen: &[Seen]| {
            seen.iter().skip(from).find(|seen| seen.topic == topic).map(|seen| seen.payload.clone())
        };
        self.wait(next).unwrap_or_else(|| panic!("waited in vain for a message on {topic}"))
    }

    fn wait<T>(&self, look: impl Fn(&[Seen]) -> Option<T>) -> Option<T> {
        let (messages, changed) = &*self.seen;
        let mut found = None;
        let guard = messages.lock().expect("nobody panics with it");
        let waited = changed.wait_timeout_while(guard, PATIENCE, |seen| {
            found = look(seen);
            found.is_none()
        });
        drop(waited);
        found
    }
}

impl Drop for Observer {
    fn drop(&mut self) {
        // The broker may be gone already.
        let _ = self.client.try_disconnect();
    }
}
