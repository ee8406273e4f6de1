//! Somebody who watches topics, mostly all, and remembers in which order what came.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use busker::edge::clock::Clock;
use busker::engine::time::Time;
use rumqttc::{Client, Event, MqttOptions, NetworkOptions, Packet, QoS};

use super::{Broker, Collected, PATIENCE, collect, lock, wait_on};

/// One message as somebody else received it.
#[derive(Clone, Debug, PartialEq)]
pub struct Received {
    pub topic: String,
    pub payload: String,
    /// Told from the broker's memory and not because it was just published.
    pub retained: bool,
    pub at: Time,
}

/// Watches topics, through restarts of the broker.
pub struct Watcher {
    client: Client,
    received: Arc<Collected<Received>>,
    /// Nobody watches any more.
    ended: Arc<AtomicBool>,
}

impl Watcher {
    /// Returns when the broker has confirmed that everything will come.
    pub fn start(broker: &Broker, name: &str) -> Watcher {
        Watcher::start_as(broker, name, None)
    }

    pub fn start_as(broker: &Broker, name: &str, user: Option<(&str, &str)>) -> Watcher {
        Watcher::start_of("#", broker, name, user)
    }

    /// Watches only these topics.
    pub fn start_of(topics: &str, broker: &Broker, name: &str, user: Option<(&str, &str)>) -> Watcher {
        let mut options = MqttOptions::new(name, broker.address, broker.port);
        options.set_max_packet_size(1 << 24, 1 << 24);
        if let Some((user, password)) = user {
            options.set_credentials(user, password);
        }
        let (client, mut connection) = Client::new(options, 5000);
        let mut network = NetworkOptions::new();
        network.set_tcp_nodelay(true);
        connection.eventloop.set_network_options(network);
        let received = Arc::<Collected<Received>>::default();
        let (subscribed, is_subscribed) = std::sync::mpsc::channel();
        let ended = Arc::<AtomicBool>::default();
        let (own_client, own_received, clock) = (client.clone(), received.clone(), Clock::start());
        let own_ended = ended.clone();
        let topics = topics.to_owned();
        std::thread::spawn(move || {
            for event in connection.iter() {
                match event {
                    Ok(Event::Incoming(Packet::ConnAck(_))) => {
                        own_client.try_subscribe(&topics, QoS::AtLeastOnce).expect("there is room");
                    }
                    Ok(Event::Incoming(Packet::SubAck(_))) => {
                        // Nobody waits for the second time.
                        let _ = subscribed.send(());
                    }
                    Ok(Event::Incoming(Packet::Publish(publish))) => {
                        let payload = String::from_utf8_lossy(&publish.payload).into_owned();
                        let (topic, retained, at) = (publish.topic, publish.retain, clock.now());
                        collect(&own_received, Received { topic, payload, retained, at });
                    }
                    Ok(Event::Outgoing(rumqttc::Outgoing::Disconnect)) => return,
                    Ok(_) => {}
                    // With the connection the library forgets that it was asked to disconnect. It would come back
                    // for ever, and take the place of whoever watches under its name by now.
                    Err(_) if own_ended.load(Ordering::SeqCst) => return,
                    // The broker is away; it comes back, or the test ends.
                    Err(_) => std::thread::sleep(Duration::from_millis(50)),
                }
            }
        });
        is_subscribed.recv_timeout(PATIENCE).expect("the broker takes the subscription");
        Watcher { client, received, ended }
    }

    /// Publishes without retaining.
    pub fn publish(&self, topic: &str, payload: &str) {
        self.client.publish(topic, QoS::AtLeastOnce, false, payload).expect("there is room");
    }

    pub fn publish_retained(&self, topic: &str, payload: &str) {
        self.client.publish(topic, QoS::AtLeastOnce, true, payload).expect("there is room");
    }

    /// Everything so far.
    pub fn received(&self) -> Vec<Received> {
        lock(&self.received.0).clone()
    }

    /// How many messages there are so far: a place from which to wait.
    pub fn count(&self) -> usize {
        lock(&self.received.0).len()
    }

    /// Every payload of `topic` so far.
    pub fn payloads(&self, topic: &str) -> Vec<String> {
        let all = lock(&self.received.0);
        all.iter().filter(|got| got.topic == topic).map(|got| got.payload.clone()).collect()
    }

    /// The last payload of `topic` so far.
    pub fn last(&self, topic: &str) -> Option<String> {
        last(&lock(&self.received.0), topic).map(str::to_owned)
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
        let find = |all: &[Received]| all.iter().find(|got| fits(got)).cloned();
        wait_on(&self.received, find).unwrap_or_else(|| {
            let all = self.received();
            let lines: Vec<String> =
                all.iter().map(|got| format!("{} {:.80}", got.topic, got.payload)).collect();
            panic!("{what} has not come, but\n{}", lines.join("\n"))
        })
    }

    /// Waits for a message on `topic` after the first `from` messages; returns its payload.
    #[track_caller]
    pub fn wait_for_next(&self, topic: &str, from: usize) -> String {
        let next = |all: &[Received]| {
            all.iter().skip(from).find(|got| got.topic == topic).map(|got| got.payload.clone())
        };
        let found = wait_on(&self.received, next);
        found.unwrap_or_else(|| panic!("waited in vain for a message on {topic}"))
    }

    /// Waits until the last payload of `topic` is `payload`.
    #[track_caller]
    pub fn shows(&self, topic: &str, payload: &str) {
        self.shows_what(topic, &format!("`{payload}`"), |told| told == payload);
    }

    /// Waits until the last payload of `topic` is one that fits, and returns it.
    #[track_caller]
    pub fn shows_what(&self, topic: &str, what: &str, fits: impl Fn(&str) -> bool) -> String {
        let find = |all: &[Received]| last(all, topic).filter(|told| fits(told)).map(str::to_owned);
        let found = wait_on(&self.received, find);
        found.unwrap_or_else(|| panic!("{topic} does not show {what}; it told {:?}", self.payloads(topic)))
    }
}

impl Drop for Watcher {
    fn drop(&mut self) {
        // Before it can be forgotten.
        self.ended.store(true, Ordering::SeqCst);
        // The broker may be gone.
        let _ = self.client.try_disconnect();
    }
}

fn last<'a>(all: &'a [Received], topic: &str) -> Option<&'a str> {
    all.iter().rev().find(|got| got.topic == topic).map(|got| got.payload.as_str())
}
