//! What each test needs: a real mosquitto, the built program, and somebody who watches the topics.

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use busker::edge::clock::Clock;
use busker::engine::time::Time;
use rumqttc::{Client, Event, MqttOptions, Packet, QoS};
use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

/// No event takes this long unless it never comes.
const PATIENCE: Duration = Duration::from_secs(20);

/// A mosquitto on a port of its own, that forgets everything when it ends unless it is told to persist.
pub struct Broker {
    pub port: u16,
    address: &'static str,
    folder: TempDir,
    extra: String,
    child: Option<Child>,
}

impl Broker {
    pub fn start() -> Broker {
        Broker::start_with("allow_anonymous true\npersistence false\n")
    }

    /// It remembers what is retained, and sessions, over its own end.
    pub fn start_persistent() -> Broker {
        Broker::start_with("allow_anonymous true\npersistence true\nautosave_interval 1\n")
    }

    /// `extra` are lines of its configuration.
    pub fn start_with(extra: &str) -> Broker {
        // Somebody else may take the port between our look and mosquitto's.
        for _ in 0..10 {
            if let Some(broker) = Broker::try_at("127.0.0.1", free_port(), extra) {
                return broker;
            }
        }
        panic!("mosquitto does not start");
    }

    /// `None` if there is no such address, or the port is taken.
    pub fn try_at(address: &'static str, port: u16, extra: &str) -> Option<Broker> {
        let folder = tempfile::tempdir().expect("a folder");
        let mut broker = Broker { port, address, folder, extra: extra.into(), child: None };
        broker.launch().then_some(broker)
    }

    /// As if its machine lost power.
    pub fn kill(&mut self) {
        if let Some(mut child) = self.child.take() {
            child.kill().expect("mosquitto is killed");
            child.wait().expect("mosquitto has ended");
        }
    }

    /// Asks it to end; it writes down what it shall remember.
    pub fn stop(&mut self) {
        self.signal(Signal::TERM);
        if let Some(mut child) = self.child.take() {
            child.wait().expect("mosquitto has ended");
        }
    }

    /// It runs no longer and has not ended, like a machine that swaps.
    pub fn stall(&self) {
        self.signal(Signal::STOP);
    }

    /// The end of [`Broker::stall`].
    pub fn go_on(&self) {
        self.signal(Signal::CONT);
    }

    fn signal(&self, signal: Signal) {
        if let Some(child) = &self.child {
            kill_process(Pid::from_child(child), signal).expect("the signal is sent");
        }
    }

    /// Again on the same port, with what it remembers.
    pub fn restart(&mut self) {
        self.kill();
        self.start_again();
    }

    /// The same after its end.
    pub fn start_again(&mut self) {
        assert!(self.launch(), "mosquitto starts again on port {}", self.port);
    }

    fn launch(&mut self) -> bool {
        let folder = self.folder.path();
        let file = folder.join("mosquitto.conf");
        // Started by root it would become another user, who may not read what tests write.
        let text = format!(
            "listener {} {}\nuser root\npersistence_location {}/\n{}",
            self.port,
            self.address,
            folder.display(),
            self.extra
        );
        fs::write(&file, text).expect("its configuration is written");
        let program = ["/usr/sbin/mosquitto", "/usr/local/sbin/mosquitto", "/opt/homebrew/sbin/mosquitto"]
            .into_iter()
            .find(|path| Path::new(path).exists())
            .unwrap_or("mosquitto");
        let mut child = Command::new(program)
            .arg("-c")
            .arg(&file)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("mosquitto is installed: it is in the Debian package `mosquitto`");
        let started = eventually(|| {
            let ended = child.try_wait().expect("its state is known").is_some();
            let listens = TcpStream::connect((self.address, self.port)).is_ok();
            (ended || listens).then_some(!ended)
        });
        self.child = Some(child);
        started == Some(true)
    }
}

impl Drop for Broker {
    fn drop(&mut self) {
        if let Some(mut child) = self.child.take() {
            // It may have ended by itself.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

pub fn free_port() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    listener.local_addr().expect("its address").port()
}

/// The built program, run as a service would run it.
pub struct Gateway {
    child: Child,
    log: Arc<(Mutex<Vec<String>>, Condvar)>,
    http: String,
    folder: TempDir,
}

impl Gateway {
    /// `rest` is the configuration without the broker, HTTP and the state directory.
    pub fn start(broker: &Broker, rest: &str) -> Gateway {
        Gateway::start_with(&format!("mqtt: {{url: 'mqtt://127.0.0.1:{}'}}\n{rest}", broker.port))
    }

    /// `rest` is the configuration without HTTP and the state directory.
    pub fn start_with(rest: &str) -> Gateway {
        Gateway::start_in(&[], rest)
    }

    /// The same with more variables in its environment.
    pub fn start_in(environment: &[(&str, &str)], rest: &str) -> Gateway {
        Gateway::start_at(tempfile::tempdir().expect("a folder"), environment, rest)
    }

    /// Ends it, does something meanwhile, and starts it again where it was, with this configuration.
    pub fn start_again(mut self, meanwhile: impl FnOnce(), rest: &str) -> Gateway {
        let folder = std::mem::replace(&mut self.folder, tempfile::tempdir().expect("a folder"));
        assert!(self.terminate().success());
        meanwhile();
        Gateway::start_at(folder, &[], rest)
    }

    fn start_at(folder: TempDir, environment: &[(&str, &str)], rest: &str) -> Gateway {
        let file = write_configuration(&folder, rest);
        let mut child = Command::new(env!("CARGO_BIN_EXE_busker"))
            .args(["run", "--config"])
            .arg(&file)
            .env_remove("JOURNAL_STREAM")
            .envs(environment.iter().copied())
            .stdin(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("busker starts");
        let log = Arc::new((Mutex::new(Vec::new()), Condvar::new()));
        let stderr = child.stderr.take().expect("it has a log");
        let lines = log.clone();
        thread::spawn(move || {
            for line in BufReader::new(stderr).lines().map_while(Result::ok) {
                lock(&lines.0).push(line);
                lines.1.notify_all();
            }
        });
        let gateway = Gateway { child, log, http: String::new(), folder };
        gateway.listening()
    }

    /// Waits until it has told where it listens.
    fn listening(mut self) -> Gateway {
        let gateway = &mut self;
        let line = gateway.wait_for_log("HTTP on http://");
        let address = line.split("http://").nth(1).and_then(|rest| rest.split('/').next());
        gateway.http = format!("http://{}", address.expect("the line names the address"));
        self
    }

    /// The first line of the log that contains `part`; waits for it.
    #[track_caller]
    pub fn wait_for_log(&self, part: &str) -> String {
        let find = |lines: &mut Vec<String>| lines.iter().find(|line| line.contains(part)).cloned();
        let found = wait_on(&self.log, find);
        found.unwrap_or_else(|| panic!("`{part}` is not in the log:\n{}", self.log().join("\n")))
    }

    pub fn log(&self) -> Vec<String> {
        lock(&self.log.0).clone()
    }

    /// `http://127.0.0.1:…`
    pub fn http(&self) -> &str {
        &self.http
    }

    /// Status and body of a page.
    pub fn get(&self, path: &str) -> (u16, String) {
        let agent: ureq::Agent = ureq::Agent::config_builder()
            .http_status_as_error(false)
            .timeout_global(Some(PATIENCE))
            .build()
            .into();
        let mut answer = agent.get(format!("{}{path}", self.http)).call().expect("HTTP answers");
        let body = answer.body_mut().read_to_string().expect("the body is text");
        (answer.status().as_u16(), body)
    }

    /// Waits until `/health` answers with this status.
    #[track_caller]
    pub fn wait_for_health(&self, status: u16) {
        let seen = eventually(|| (self.get("/health").0 == status).then_some(()));
        assert!(seen.is_some(), "/health is {:?}, not {status}", self.get("/health"));
    }

    /// The memory that it occupies, in bytes.
    pub fn resident(&self) -> u64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.child.id())).expect("it runs");
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).expect("Linux tells it");
        let kilobytes = line.trim().trim_end_matches(" kB").parse::<u64>().expect("a number");
        kilobytes * 1024
    }

    /// It runs no longer and has not ended.
    pub fn stall(&self) {
        kill_process(Pid::from_child(&self.child), Signal::STOP).expect("the signal is sent");
    }

    /// The end of [`Gateway::stall`].
    pub fn go_on(&self) {
        kill_process(Pid::from_child(&self.child), Signal::CONT).expect("the signal is sent");
    }

    /// Its configuration file, and what it runs as.
    pub fn file(&self) -> PathBuf {
        self.folder.path().join("busker.yaml")
    }

    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Puts another configuration in the place of its own, as for [`Gateway::start_with`].
    pub fn write(&self, rest: &str) {
        write_configuration(&self.folder, rest);
    }

    /// The same without anything added.
    pub fn write_whole(&self, text: &str) {
        fs::write(self.folder.path().join("busker.yaml"), text).expect("its configuration is written");
    }

    /// Asks it to read its configuration again, and waits until it says this.
    #[track_caller]
    pub fn reload(&self, expected: &str) {
        let before = self.log().len();
        kill_process(Pid::from_child(&self.child), Signal::HUP).expect("the signal is sent");
        let find =
            |lines: &mut Vec<String>| lines.iter().skip(before).find(|line| line.contains(expected)).cloned();
        let found = wait_on(&self.log, find);
        assert!(found.is_some(), "`{expected}` is not in the log:\n{}", self.log().join("\n"));
    }

    /// Asks it to end, and waits until it has.
    pub fn terminate(mut self) -> ExitStatus {
        let pid = Pid::from_child(&self.child);
        kill_process(pid, Signal::TERM).expect("the signal is sent");
        self.child.wait().expect("it ends")
    }

    /// Ends it without asking.
    pub fn kill(mut self) {
        self.child.kill().expect("it is killed");
        self.child.wait().expect("it has ended");
    }
}

fn write_configuration(folder: &TempDir, rest: &str) -> PathBuf {
    let file = folder.path().join("busker.yaml");
    let state = folder.path().join("state");
    let text = format!("http: {{listen: '127.0.0.1:0'}}\nstate_dir: {}\n{rest}", state.display());
    fs::write(&file, text).expect("its configuration is written");
    file
}

impl Drop for Gateway {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Connects as `client_id` with a session that the broker shall keep, subscribes, and goes.
pub fn leave_a_session(broker: &Broker, client_id: &str, filter: &str) {
    let mut options = MqttOptions::new(client_id, broker.address, broker.port);
    options.set_clean_session(false);
    let (client, mut connection) = Client::new(options, 10);
    client.subscribe(filter, QoS::AtLeastOnce).expect("there is room");
    for event in connection.iter() {
        match event.expect("the broker is there") {
            Event::Incoming(Packet::SubAck(_)) => client.disconnect().expect("there is room"),
            Event::Outgoing(rumqttc::Outgoing::Disconnect) => return,
            _ => {}
        }
    }
}

/// Comes to a broker that does not answer yet, and publishes as soon as it is let in. By hand, since a
/// client library would not wait here until it stands in the broker's queue.
pub fn queue_up(broker: &Broker, topic: &str, payload: &str) -> thread::JoinHandle<()> {
    let mut stream = TcpStream::connect((broker.address, broker.port)).expect("the system takes it");
    // CONNECT: MQTT 3.1.1, a clean session, a minute's keep-alive, the identifier `late`.
    let connect = [b"\x10\x10\0\x04MQTT\x04\x02\0\x3c\0\x04late".as_slice()].concat();
    stream.write_all(&connect).expect("the system takes it");
    let length = u8::try_from(2 + topic.len() + payload.len()).expect("a short message");
    let publish = [&[0x30, length, 0, topic.len() as u8], topic.as_bytes(), payload.as_bytes()].concat();
    thread::spawn(move || {
        let mut let_in = [0; 4];
        stream.read_exact(&mut let_in).expect("the broker lets it in");
        stream.write_all(&publish).expect("it is published");
    })
}

/// Ends a verb of the program: whether it is content, and what it says on standard error.
pub fn busker(arguments: &[&str], environment: &[(&str, &str)]) -> (Option<i32>, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_busker"))
        .args(arguments)
        .envs(environment.iter().copied())
        .output()
        .expect("busker starts");
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

/// One message as somebody else received it.
#[derive(Clone, Debug, PartialEq)]
pub struct Received {
    pub topic: String,
    pub payload: String,
    /// Told from the broker's memory and not because it was just published.
    pub retained: bool,
    pub at: Time,
}

/// Watches every topic, through restarts of the broker.
pub struct Watcher {
    client: Client,
    received: Arc<(Mutex<Vec<Received>>, Condvar)>,
}

impl Watcher {
    /// Returns when the broker has confirmed that everything will come.
    pub fn start(broker: &Broker, name: &str) -> Watcher {
        Watcher::start_as(broker, name, None)
    }

    pub fn start_as(broker: &Broker, name: &str, user: Option<(&str, &str)>) -> Watcher {
        let mut options = MqttOptions::new(name, broker.address, broker.port);
        options.set_max_packet_size(1 << 24, 1 << 24);
        if let Some((user, password)) = user {
            options.set_credentials(user, password);
        }
        let (client, mut connection) = Client::new(options, 5000);
        let received = Arc::new((Mutex::new(Vec::new()), Condvar::new()));
        let (subscribed, is_subscribed) = std::sync::mpsc::channel();
        let (own_client, own_received, clock) = (client.clone(), received.clone(), Clock::start());
        thread::spawn(move || {
            for event in connection.iter() {
                match event {
                    Ok(Event::Incoming(Packet::ConnAck(_))) => {
                        own_client.try_subscribe("#", QoS::AtLeastOnce).expect("there is room");
                    }
                    Ok(Event::Incoming(Packet::SubAck(_))) => {
                        // Nobody waits for the second time.
                        let _ = subscribed.send(());
                    }
                    Ok(Event::Incoming(Packet::Publish(publish))) => {
                        let payload = String::from_utf8_lossy(&publish.payload).into_owned();
                        let (topic, retained, at) = (publish.topic, publish.retain, clock.now());
                        lock(&own_received.0).push(Received { topic, payload, retained, at });
                        own_received.1.notify_all();
                    }
                    Ok(Event::Outgoing(rumqttc::Outgoing::Disconnect)) => return,
                    Ok(_) => {}
                    Err(_) => thread::sleep(Duration::from_millis(50)),
                }
            }
        });
        is_subscribed.recv_timeout(PATIENCE).expect("the broker takes the subscription");
        Watcher { client, received }
    }

    pub fn publish(&self, topic: &str, payload: &str) {
        self.client.publish(topic, QoS::AtLeastOnce, false, payload).expect("it is published");
    }

    pub fn publish_retained(&self, topic: &str, payload: &str) {
        self.client.publish(topic, QoS::AtLeastOnce, true, payload).expect("it is published");
    }

    /// Everything so far.
    pub fn received(&self) -> Vec<Received> {
        lock(&self.received.0).clone()
    }

    /// The payloads on one topic so far.
    pub fn payloads(&self, topic: &str) -> Vec<String> {
        self.received().into_iter().filter(|got| got.topic == topic).map(|got| got.payload).collect()
    }

    /// Forgets what came.
    pub fn forget(&self) {
        lock(&self.received.0).clear();
    }

    /// Waits until `payload` has come on `topic`.
    #[track_caller]
    pub fn wait_for(&self, topic: &str, payload: &str) -> Received {
        self.wait_until(&format!("`{payload}` on `{topic}`"), |got| {
            got.topic == topic && got.payload == payload
        })
    }

    /// Waits for the first message that fits.
    #[track_caller]
    pub fn wait_until(&self, what: &str, fits: impl Fn(&Received) -> bool) -> Received {
        let find = |all: &mut Vec<Received>| all.iter().find(|got| fits(got)).cloned();
        let found = wait_on(&self.received, find);
        found.unwrap_or_else(|| {
            let all = self.received();
            let lines: Vec<String> =
                all.iter().map(|got| format!("{} {:.80}", got.topic, got.payload)).collect();
            panic!("{what} has not come, but\n{}", lines.join("\n"))
        })
    }
}

impl Drop for Watcher {
    fn drop(&mut self) {
        // The broker may be gone.
        let _ = self.client.try_disconnect();
    }
}

/// A file that only lives as long as the test.
pub fn temporary_file(folder: &TempDir, name: &str, text: &str) -> PathBuf {
    let path = folder.path().join(name);
    fs::write(&path, text).expect("the file is written");
    path
}

/// Looks again and again until there is something, or patience ends.
pub fn eventually<T>(mut look: impl FnMut() -> Option<T>) -> Option<T> {
    let clock = Clock::start();
    while clock.now() < Time::default() + PATIENCE {
        if let Some(found) = look() {
            return Some(found);
        }
        thread::sleep(Duration::from_millis(20));
    }
    None
}

fn wait_on<T, F>(
    shared: &(Mutex<Vec<T>>, Condvar),
    mut find: impl FnMut(&mut Vec<T>) -> Option<F>,
) -> Option<F> {
    let clock = Clock::start();
    let deadline = Time::default() + PATIENCE;
    let mut all = lock(&shared.0);
    loop {
        if let Some(found) = find(&mut all) {
            return Some(found);
        }
        let left = clock.until(deadline);
        if left.is_zero() {
            return None;
        }
        all = shared.1.wait_timeout(all, left).unwrap_or_else(PoisonError::into_inner).0;
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
