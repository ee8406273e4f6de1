//! The connection to the broker: sends what the outbox holds, hands on what comes in, and connects
//! again. One task does nothing but poll the client library; another feeds it.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rumqttc::{
    AsyncClient, ConnectReturnCode, ConnectionError, EventLoop, LastWill, MqttOptions, Packet, QoS,
    SubscribeFilter, SubscribeReasonCode,
};
use tokio::sync::{Notify, mpsc, oneshot};
use tokio::task::JoinHandle;

use crate::edge::clock::Clock;
use crate::engine::health::BrokerReport;
use crate::engine::outbox::Outbox;
use crate::engine::settings::Settings;
use crate::engine::time::Duration;
use crate::engine::topics::{self, Incoming, Message, OFFLINE, ONLINE, Topics};

/// Requests that the library may hold; the others wait in the outbox, where a newer value replaces an
/// older one.
const IN_FLIGHT: usize = 50;

/// A device with a thousand points is announced in 215 kB. Larger than anything sane, since a packet
/// above the limit ends the connection.
const PACKET_BYTES_MAX: usize = 16 * 1024 * 1024;

/// Half of it after a silent loss of the connection, the broker publishes the last will.
const KEEP_ALIVE: Duration = Duration::from_secs(15);

const RECONNECT_FIRST: Duration = Duration::from_millis(500);
const RECONNECT_LAST: Duration = Duration::from_secs(30);

/// A connection that held this long counts as a good one: after it the waits begin anew.
const GOOD_CONNECTION: Duration = Duration::from_secs(10);

/// How long the last messages may take when the program ends.
const GOODBYE: Duration = Duration::from_secs(3);

/// Where everybody puts messages for the broker, whether it is there or not.
pub struct Mailbox {
    outbox: Mutex<Outbox>,
    news: Notify,
}

impl Mailbox {
    pub fn new(outbox: Outbox) -> Mailbox {
        Mailbox { outbox: Mutex::new(outbox), news: Notify::new() }
    }

    /// Never waits for the broker.
    pub fn push(&self, message: Message) {
        self.outbox().push(message);
        self.news.notify_one();
    }

    /// Does something with all that waits or is remembered.
    pub fn change(&self, change: impl FnOnce(&mut Outbox)) {
        change(&mut self.outbox());
        self.news.notify_one();
    }

    fn outbox(&self) -> MutexGuard<'_, Outbox> {
        // The outbox is whole after every call, whoever panicked meanwhile.
        self.outbox.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What the broker has to tell the rest of the program.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum News {
    Up,
    Down,
    Set { device: String, point: String, payload: String, retained: bool },
    Get { device: String, point: String },
    Request { verb: String, payload: String, retained: bool },
}

/// How the connection is, for whoever wants to tell.
#[derive(Clone)]
pub struct BrokerState {
    state: Arc<Mutex<BrokerReport>>,
    mailbox: Arc<Mailbox>,
}

impl BrokerState {
    pub fn report(&self) -> BrokerReport {
        let mut report = lock(&self.state).clone();
        report.dropped = self.mailbox.outbox().dropped();
        report
    }
}

/// The running connection.
pub struct Broker {
    state: BrokerState,
    goodbye: Option<oneshot::Sender<()>>,
    feeder: JoinHandle<()>,
}

impl Broker {
    /// Connects, and goes on connecting. `tell` is called from the runtime and must not wait.
    pub fn start(
        settings: &Settings,
        password: Option<String>,
        clock: Clock,
        mailbox: Arc<Mailbox>,
        tell: impl Fn(News) + Send + 'static,
    ) -> Broker {
        let topics = Topics::new(&settings.mqtt.base_topic);
        let (client, event_loop) = AsyncClient::new(options(settings, &topics, password), IN_FLIGHT);
        let state = Arc::new(Mutex::new(BrokerReport::default()));
        let (events_out, events) = mpsc::channel(IN_FLIGHT);
        let address = format!("{}:{}", settings.mqtt.host, settings.mqtt.port);
        let poller = tokio::spawn(poll(event_loop, events_out, address, clock));
        let (goodbye, goodbye_heard) = oneshot::channel();
        let mut filters = topics.subscriptions();
        if settings.home_assistant.discovery {
            filters.push(settings.home_assistant.status_topic.clone());
            // What an earlier run announced, to take away what is gone.
            filters.push(topics::discovery(&settings.home_assistant.prefix, "+"));
        }
        let feeder = Feeder {
            client,
            clock,
            topics,
            status_topic: settings.home_assistant.status_topic.clone(),
            filters,
            mailbox: mailbox.clone(),
            state: state.clone(),
            connected: false,
            told_up: None,
            subscribed: false,
            tell,
        };
        let feeder = tokio::spawn(async move {
            feeder.run(events, goodbye_heard).await;
            poller.abort();
        });
        Broker { state: BrokerState { state, mailbox }, goodbye: Some(goodbye), feeder }
    }

    pub fn state(&self) -> BrokerState {
        self.state.clone()
    }

    /// Sends what waits, then `offline`, and disconnects, so that no last will follows. Gives up after
    /// some seconds: then the last will says the same.
    pub async fn finish(mut self) {
        if let Some(goodbye) = self.goodbye.take() {
            // The other side is gone only if the feeder has ended already.
            let _ = goodbye.send(());
        }
        if tokio::time::timeout(GOODBYE, &mut self.feeder).await.is_err() {
            tracing::warn!("the broker did not take the last messages in time");
            self.feeder.abort();
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn options(settings: &Settings, topics: &Topics, password: Option<String>) -> MqttOptions {
    // The same after every start: a gateway that was cut off takes its own place again.
    let client = format!("{}_gateway", topics.instance());
    let mut options = MqttOptions::new(client, settings.mqtt.host.clone(), settings.mqtt.port);
    options.set_keep_alive(KEEP_ALIVE);
    // A command is for now: the broker shall not keep any for a gateway that is not there.
    options.set_clean_session(true);
    options.set_max_packet_size(PACKET_BYTES_MAX, PACKET_BYTES_MAX);
    options.set_last_will(LastWill::new(topics.bridge_state(), OFFLINE, QoS::AtLeastOnce, true));
    if let Some(username) = &settings.mqtt.username {
        options.set_credentials(username.clone(), password.unwrap_or_default());
    }
    options
}

/// What the polling task saw.
enum Seen {
    Up,
    Down(String),
    Packet(Packet),
    /// The library has taken something: there is room for more.
    Room,
}

/// Polls the client library and nothing else: a library that is not polled neither sends nor answers
/// pings. Waits between attempts to connect, a little longer each time.
async fn poll(mut event_loop: EventLoop, seen: mpsc::Sender<Seen>, address: String, clock: Clock) {
    let mut attempts = 0;
    let mut connected_at = None;
    loop {
        let news = match event_loop.poll().await {
            Ok(rumqttc::Event::Incoming(Packet::ConnAck(_))) => {
                connected_at = Some(clock.now());
                Seen::Up
            }
            Ok(rumqttc::Event::Incoming(packet)) => Seen::Packet(packet),
            Ok(rumqttc::Event::Outgoing(_)) => Seen::Room,
            Err(error) => {
                // A collision of packet numbers from the old connection would stop publishing for ever.
                event_loop.state.collision = None;
                if seen.send(Seen::Down(reason(&error, &address))).await.is_err() {
                    return;
                }
                // Two gateways of one name throw each other out; then the waits shall grow as well.
                if connected_at.take().is_some_and(|since| clock.now() - since >= GOOD_CONNECTION) {
                    attempts = 0;
                }
                tokio::time::sleep(reconnect_after(attempts, clock.now().0)).await;
                attempts += 1;
                continue;
            }
        };
        if seen.send(news).await.is_err() {
            return;
        }
    }
}

/// Doubles with each attempt up to a bound, and varies by a quarter, so that many gateways do not come
/// back to a restarted broker in the same moment. `seed` is any number that varies.
fn reconnect_after(attempts: u32, seed: u64) -> Duration {
    let full = RECONNECT_FIRST.saturating_mul(1 << attempts.min(10)).min(RECONNECT_LAST);
    // The middle of a product with a large odd number is as good as random.
    let spread = (seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40) as u32 % 256;
    full - full / 4 * spread / 256
}

/// Without credentials, since the library's errors hold none.
fn reason(error: &ConnectionError, address: &str) -> String {
    match error {
        ConnectionError::ConnectionRefused(
            ConnectReturnCode::BadUserNamePassword | ConnectReturnCode::NotAuthorized,
        ) => format!("the broker at {address} refuses this user name and password"),
        ConnectionError::ConnectionRefused(code) => format!("the broker at {address} refuses: {code:?}"),
        ConnectionError::Io(error) => format!("no connection to the broker at {address}: {error}"),
        error => format!("the connection to the broker at {address} is lost: {error}"),
    }
}

/// Feeds the library from the outbox and hands on what comes in.
struct Feeder<Tell> {
    client: AsyncClient,
    clock: Clock,
    topics: Topics,
    status_topic: String,
    filters: Vec<String>,
    mailbox: Arc<Mailbox>,
    state: Arc<Mutex<BrokerReport>>,
    connected: bool,
    /// What was last told of the connection.
    told_up: Option<bool>,
    subscribed: bool,
    tell: Tell,
}

impl<Tell: Fn(News)> Feeder<Tell> {
    async fn run(mut self, mut events: mpsc::Receiver<Seen>, mut goodbye: oneshot::Receiver<()>) {
        let mut ending = false;
        loop {
            let wake_at = self.mailbox.outbox().wake_at();
            let until = wake_at.map_or(Duration::from_secs(3600), |time| self.clock.until(time));
            tokio::select! {
                seen = events.recv() => match seen {
                    Some(seen) => self.handle(seen),
                    None => return,
                },
                () = self.mailbox.news.notified() => {}
                () = tokio::time::sleep(until) => self.mailbox.outbox().wake(self.clock.now()),
                _ = &mut goodbye, if !ending => {
                    ending = true;
                    self.mailbox.outbox().goodbye();
                }
            }
            if ending && !self.connected {
                return;
            }
            let all_sent = self.feed();
            if ending && all_sent {
                return self.disconnect(events).await;
            }
        }
    }

    fn handle(&mut self, seen: Seen) {
        match seen {
            Seen::Up => {
                tracing::info!("connected to the broker");
                let mut state = lock(&self.state);
                state.connected = true;
                state.reason = None;
                state.connects += 1;
                drop(state);
                (self.connected, self.subscribed) = (true, false);
                self.mailbox.outbox().connected();
                self.told_up = Some(true);
                (self.tell)(News::Up);
            }
            Seen::Down(reason) => {
                let mut state = lock(&self.state);
                state.connected = false;
                // Once for each reason, not once for each attempt.
                if state.reason.as_ref() != Some(&reason) {
                    tracing::warn!("{reason}");
                }
                state.reason = Some(reason);
                drop(state);
                self.connected = false;
                if self.told_up != Some(false) {
                    self.told_up = Some(false);
                    (self.tell)(News::Down);
                }
            }
            Seen::Packet(Packet::Publish(publish)) => {
                let payload = String::from_utf8_lossy(&publish.payload).into_owned();
                self.receive(&publish.topic, payload, publish.retain);
            }
            Seen::Packet(Packet::SubAck(answer)) => {
                if answer.return_codes.contains(&SubscribeReasonCode::Failure) {
                    tracing::warn!("the broker does not let this user subscribe; commands will not arrive");
                }
            }
            Seen::Packet(_) | Seen::Room => {}
        }
    }

    fn receive(&self, topic: &str, payload: String, retained: bool) {
        if topic == self.status_topic {
            // A retained birth message is old news: everything was sent when the connection was made.
            if payload == ONLINE && !retained {
                tracing::info!("Home Assistant has started: announcing all devices again");
                self.mailbox.outbox().home_assistant_started(self.clock.now());
            }
            return;
        }
        if topic.ends_with("/config") {
            if retained {
                self.mailbox.outbox().found(topic, &payload);
            }
            return;
        }
        match self.topics.parse(topic) {
            Some(Incoming::Set { device, point }) => {
                let (device, point) = (device.to_string(), point.to_string());
                (self.tell)(News::Set { device, point, payload, retained });
            }
            Some(Incoming::Get { device, point }) if !retained => {
                (self.tell)(News::Get { device: device.to_string(), point: point.to_string() });
            }
            Some(Incoming::Request { verb }) => {
                (self.tell)(News::Request { verb: verb.to_string(), payload, retained });
            }
            Some(Incoming::Get { .. }) | None => {}
        }
    }

    /// Hands over as much as the library has room for; `true` if nothing is left.
    fn feed(&mut self) -> bool {
        if !self.connected {
            return false;
        }
        if !self.subscribed {
            let filter = |path: &String| SubscribeFilter::new(path.clone(), QoS::AtLeastOnce);
            self.subscribed = self.client.try_subscribe_many(self.filters.iter().map(filter)).is_ok();
        }
        let mut outbox = self.mailbox.outbox();
        while let Some(message) = outbox.next_message() {
            let payload = message.payload.as_bytes();
            let taken = self.client.try_publish(&message.topic, QoS::AtLeastOnce, message.retain, payload);
            if taken.is_err() {
                outbox.put_back(message);
                return false;
            }
        }
        self.subscribed
    }

    /// Waits until the library has sent everything and the connection is closed.
    async fn disconnect(self, mut events: mpsc::Receiver<Seen>) {
        while self.client.try_disconnect().is_err() {
            if events.recv().await.is_none() {
                return;
            }
        }
        while let Some(seen) = events.recv().await {
            if matches!(seen, Seen::Down(_)) {
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_wait_between_attempts_grows_to_a_bound_and_varies() {
        for (attempts, longest) in [(0, 500), (1, 1000), (2, 2000), (6, 30_000), (40, 30_000)] {
            let waits: Vec<Duration> = (0..100).map(|seed| reconnect_after(attempts, seed * 1017)).collect();
            let longest = Duration::from_millis(longest);
            assert!(waits.iter().all(|wait| *wait <= longest && *wait >= longest * 3 / 4), "{waits:?}");
            assert!(waits.iter().min() != waits.iter().max());
        }
    }
}
