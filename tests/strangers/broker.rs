//! A mosquitto of the test's own, and what is told on it.

use std::collections::BTreeMap;
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use busker::edge::clock::Clock;
use rumqttc::{Client, Event, MqttOptions, Packet, QoS};

/// Far longer than anything here takes; only a failing test waits for it.
const PATIENCE: Duration = Duration::from_secs(60);

/// A running mosquitto; it ends with this.
pub struct Broker {
    child: Child,
    port: u16,
}

impl Broker {
    /// Starts one, with its configuration in `directory`.
    pub fn start(directory: &Path) -> Broker {
        // The port is free now; should another take it before mosquitto does, the next one is tried.
        for _ in 0..10 {
            let free = TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr());
            let port = free.expect("a free port").port();
            let configuration = directory.join("mosquitto.conf");
            let text = format!("listener {port} 127.0.0.1\nallow_anonymous true\n");
            std::fs::write(&configuration, text).expect("written");
            // Debian keeps it where ordinary users do not look.
            let path = std::env::var("PATH").unwrap_or_default() + ":/usr/sbin:/usr/local/sbin";
            let mut child = Command::new("mosquitto")
                .arg("-c")
                .arg(&configuration)
                .env("PATH", path)
                .stderr(Stdio::null())
                .spawn()
                .expect("mosquitto starts; `make test` fetches it");
            loop {
                if TcpStream::connect(("127.0.0.1", port)).is_ok() {
                    return Broker { child, port };
                }
                if child.try_wait().expect("a child").is_some() {
                    break;
                }
                std::thread::yield_now();
            }
        }
        panic!("mosquitto ends at once on ten free ports");
    }

    pub fn port(&self) -> u16 {
        self.port
    }

    /// A client that hears everything below `busker/`.
    pub fn listen(&self) -> Listener {
        let mut options = MqttOptions::new("strangers", "127.0.0.1", self.port);
        options.set_max_packet_size(1 << 20, 1 << 20);
        let (client, mut connection) = Client::new(options, 64);
        client.subscribe("busker/#", QoS::AtLeastOnce).expect("subscribed");
        let (sender, messages) = channel();
        std::thread::spawn(move || {
            for event in connection.iter() {
                let Ok(event) = event else { return };
                if let Event::Incoming(Packet::Publish(publish)) = event {
                    let payload = String::from_utf8_lossy(&publish.payload).into_owned();
                    if sender.send((publish.topic, payload)).is_err() {
                        return;
                    }
                }
            }
        });
        Listener { client, messages, last: BTreeMap::new() }
    }
}

impl Drop for Broker {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What has been told so far.
pub struct Listener {
    client: Client,
    messages: Receiver<(String, String)>,
    last: BTreeMap<String, String>,
}

impl Listener {
    pub fn publish(&self, topic: &str, payload: &str) {
        self.client.publish(topic, QoS::AtLeastOnce, false, payload).expect("published");
    }

    /// Waits until `topic` has said something that `is_it`.
    #[track_caller]
    pub fn wait(&mut self, topic: &str, is_it: impl Fn(&str) -> bool) {
        let clock = Clock::start();
        let end = clock.now() + PATIENCE;
        while !self.last.get(topic).is_some_and(|payload| is_it(payload)) {
            let Ok((topic_told, payload)) = self.messages.recv_timeout(clock.until(end)) else {
                panic!("`{topic}` says {:?}; everything: {:#?}", self.last.get(topic), self.last);
            };
            self.last.insert(topic_told, payload);
        }
    }

    /// What `topic` has said last, as far as it has been listened to.
    pub fn says(&self, topic: &str) -> Option<&str> {
        self.last.get(topic).map(String::as_str)
    }

    /// What `topic` has said until now does not count any more.
    pub fn forget(&mut self, topic: &str) {
        self.last.remove(topic);
    }

    /// Compares what `topic` has said last.
    #[track_caller]
    pub fn check(&self, topic: &str, is_it: impl Fn(&str) -> bool) {
        let told = self.last.get(topic);
        assert!(told.is_some_and(|payload| is_it(payload)), "`{topic}` says {told:?}");
    }
}
