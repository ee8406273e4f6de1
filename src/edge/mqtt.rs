//! The connection to the broker: sends what the outbox holds, hands on what comes in, and connects
//! again. One task does nothing but poll the client library; another feeds it.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rumqttc::{
    AsyncClient, ConnectReturnCode, ConnectionError, EventLoop, LastWill, MqttOptions, Outgoing, Packet,
    Publish, QoS, Request, StateError, SubscribeFilter, SubscribeReasonCode, TlsError,
};
use tokio::sync::{Notify, mpsc, oneshot};
use tokio::task::JoinHandle;

use crate::edge::clock::Clock;
use crate::edge::secrets::Secrets;
use crate::edge::tls;
use crate::engine::command::{Outcome, OutcomeKind};
use crate::engine::connection::{Connection, Loss};
use crate::engine::health::BrokerReport;
use crate::engine::outbox::Outbox;
use crate::engine::settings::{Mqtt, Settings};
use crate::engine::time::Duration;
use crate::engine::topics::{self, Incoming, Message, OFFLINE, ONLINE, Topics};

/// Requests that the library may hold; the others wait in the outbox, where a newer value replaces an
/// older one.
const IN_FLIGHT: usize = 50;

/// A device with a thousand points is announced in 215 kB. Larger than anything sane, since a packet
/// above the limit ends the connection.
const PACKET_BYTES_MAX: usize = 16 * 1024 * 1024;

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
    Set {
        device: String,
        point: String,
        payload: String,
        retained: bool,
    },
    Get {
        device: String,
        point: String,
    },
    /// `stale` says why it would be too old to be obeyed.
    Request {
        verb: String,
        payload: String,
        retained: bool,
        stale: Option<String>,
    },
}

/// How the connection is, for whoever wants to tell.
#[derive(Clone)]
pub struct BrokerState {
    state: Arc<Mutex<BrokerReport>>,
    connection: Arc<Mutex<Connection>>,
    mailbox: Arc<Mailbox>,
    clock: Clock,
}

impl BrokerState {
    pub fn report(&self) -> BrokerReport {
        let mut report = lock(&self.state).clone();
        report.client_id_taken = lock(&self.connection).is_contested(self.clock.now());
        let outbox = self.mailbox.outbox();
        (report.waiting, report.dropped) = (outbox.waiting(), outbox.dropped());
        drop(outbox);
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
        secrets: Secrets,
        clock: Clock,
        mailbox: Arc<Mailbox>,
        tell: impl Fn(News) + Send + 'static,
    ) -> Broker {
        let topics = Topics::new(&settings.mqtt.base_topic);
        let options = options(&settings.mqtt, &topics, secrets);
        let client_id = options.client_id();
        let (client, event_loop) = AsyncClient::new(options, IN_FLIGHT);
        let state = Arc::new(Mutex::new(BrokerReport::default()));
        let connection = Arc::new(Mutex::new(Connection::default()));
        let (events_out, events) = mpsc::channel(IN_FLIGHT);
        let poller = Poller {
            event_loop,
            seen: events_out,
            connection: connection.clone(),
            mqtt: settings.mqtt.clone(),
            address: format!("{}:{}", settings.mqtt.host, settings.mqtt.port),
            client_id,
            unreadable: None,
            clock,
        };
        let poller = tokio::spawn(poller.run());
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
            contested: false,
            told_up: None,
            subscribed: false,
            tell,
        };
        let feeder = tokio::spawn(async move {
            feeder.run(events, goodbye_heard).await;
            poller.abort();
        });
        let state = BrokerState { state, connection, mailbox, clock };
        Broker { state, goodbye: Some(goodbye), feeder }
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

fn options(mqtt: &Mqtt, topics: &Topics, secrets: Secrets) -> MqttOptions {
    // The same after every start: a gateway that was cut off takes its own place again. And the same
    // for every gateway with this base topic: of two that would answer for the same devices, the broker
    // lets in one.
    let client = format!("{}_gateway", topics.instance());
    let address = match &mqtt.websocket {
        None => mqtt.host.clone(),
        // The library wants a whole URL.
        Some(path) => {
            let scheme = if mqtt.tls.is_some() { "wss" } else { "ws" };
            let host = if mqtt.host.contains(':') { format!("[{}]", mqtt.host) } else { mqtt.host.clone() };
            format!("{scheme}://{host}:{}{path}", mqtt.port)
        }
    };
    let mut options = MqttOptions::new(client, address, mqtt.port);
    // Told to the broker in whole seconds.
    options.set_keep_alive(Duration::from_secs(mqtt.keep_alive.as_millis().div_ceil(1000) as u64));
    // A command is for now: the broker shall not keep any for a gateway that is not there.
    options.set_clean_session(true);
    options.set_max_packet_size(PACKET_BYTES_MAX, PACKET_BYTES_MAX);
    options.set_last_will(LastWill::new(topics.bridge_state(), OFFLINE, QoS::AtLeastOnce, true));
    secrets.enter(&mut options, mqtt);
    options
}

/// What the polling task saw.
enum Seen {
    Up,
    Down {
        reason: String,
        /// Somebody else takes this gateway's place again and again.
        contested: bool,
    },
    /// Messages told once that the library had taken and the broker has not.
    Unsent(Vec<Message>),
    Packet {
        packet: Packet,
        /// How old it may be, if it was held up on its way.
        stale_for: Option<Duration>,
    },
    /// The library has taken something: there is room for more.
    Room,
}

/// Polls the client library and nothing else: a library that is not polled neither sends nor answers
/// pings. Waits between attempts to connect.
struct Poller {
    event_loop: EventLoop,
    seen: mpsc::Sender<Seen>,
    connection: Arc<Mutex<Connection>>,
    mqtt: Mqtt,
    address: String,
    client_id: String,
    /// Why its files could not be read, the last time.
    unreadable: Option<String>,
    clock: Clock,
}

impl Poller {
    /// Until nobody listens.
    async fn run(mut self) {
        loop {
            let seen = match self.event_loop.poll().await {
                Ok(rumqttc::Event::Incoming(Packet::ConnAck(_))) => {
                    let wait = lock(&self.connection).made(self.clock.now());
                    tokio::time::sleep(wait).await;
                    Seen::Up
                }
                Ok(event) => self.seen(event),
                Err(error) => {
                    if self.lost(error).await.is_err() {
                        return;
                    }
                    continue;
                }
            };
            if self.seen.send(seen).await.is_err() {
                return;
            }
        }
    }

    fn seen(&self, event: rumqttc::Event) -> Seen {
        let now = self.clock.now();
        let mut connection = lock(&self.connection);
        match event {
            rumqttc::Event::Incoming(packet) => {
                connection.heard(now);
                Seen::Packet { packet, stale_for: connection.stale_for(now) }
            }
            rumqttc::Event::Outgoing(sent) => {
                if let Outgoing::Publish(_) | Outgoing::Subscribe(_) | Outgoing::PingReq = sent {
                    connection.asked(now);
                }
                Seen::Room
            }
        }
    }

    /// Tells what is left of the connection, and waits before the next attempt.
    async fn lost(&mut self, error: ConnectionError) -> Result<(), mpsc::error::SendError<Seen>> {
        // What came together with the end. The library would hand it out after the next connect,
        // when a command in it is no longer meant.
        for event in std::mem::take(&mut self.event_loop.state.events) {
            if let rumqttc::Event::Incoming(_) = event {
                self.seen.send(self.seen(event)).await?;
            }
        }
        // A collision of packet numbers from the old connection would stop publishing for ever.
        let collided = self.event_loop.state.collision.take();
        let now = self.clock.now();
        let (was_made, pause, contested) = {
            let mut connection = lock(&self.connection);
            let was_made = connection.is_made();
            let pause = connection.lost(now, loss(&error), now.0);
            (was_made, pause, connection.is_contested(now))
        };
        let reason = match contested {
            true => format!(
                "the broker at {} lets this gateway in and closes the connection, again and again: most likely \
                 another client has the identifier `{}` too, as a second gateway with `base_topic: {}` has. Each \
                 needs a base topic of its own; this one tries again after growing pauses",
                self.address, self.client_id, self.mqtt.base_topic
            ),
            false => self.reason(&error, was_made),
        };
        self.seen.send(Seen::Down { reason, contested }).await?;
        tokio::time::sleep(pause).await;
        // Only now, when nobody hands over more: the library would send what it still holds before
        // anything newer, or drop it.
        self.event_loop.clean();
        let requests = self.event_loop.pending.drain(..).filter_map(|request| match request {
            Request::Publish(publish) => Some(publish),
            _ => None,
        });
        let unsent: Vec<Message> =
            requests.chain(collided).filter(|publish| !publish.retain).filter_map(once).collect();
        self.renew_secrets();
        self.seen.send(Seen::Unsent(unsent)).await
    }

    /// They may have changed since the last attempt. While they cannot be read, the old ones are used.
    fn renew_secrets(&mut self) {
        match Secrets::read(&self.mqtt) {
            Ok(secrets) => {
                self.unreadable = None;
                secrets.enter(&mut self.event_loop.mqtt_options, &self.mqtt);
            }
            Err(error) => {
                let reason = format!("{error:#}");
                if self.unreadable.as_ref() != Some(&reason) {
                    tracing::warn!("going on with what was read before: {reason}");
                }
                self.unreadable = Some(reason);
            }
        }
    }

    /// Without credentials, since the library's errors hold none.
    fn reason(&self, error: &ConnectionError, was_made: bool) -> String {
        let address = &self.address;
        if let Some(advice) = rustls_error(error).and_then(tls::advice) {
            return format!("no TLS with the broker at {address}: {advice} ({})", told(error));
        }
        match error {
            ConnectionError::ConnectionRefused(
                ConnectReturnCode::BadUserNamePassword | ConnectReturnCode::NotAuthorized,
            ) => format!("the broker at {address} refuses this user name and password"),
            ConnectionError::ConnectionRefused(code) => format!("the broker at {address} refuses: {code:?}"),
            ConnectionError::Io(error) => format!("no connection to the broker at {address}: {error}"),
            ConnectionError::NetworkTimeout => format!("the broker at {address} does not answer"),
            ConnectionError::MqttState(StateError::AwaitPingResp) | ConnectionError::FlushTimeout => {
                format!("the broker at {address} is silent")
            }
            ConnectionError::Tls(_) => format!(
                "no TLS with the broker at {address}: {}; does it speak TLS on this port?",
                told(error)
            ),
            error if loss(error) == Loss::Closed && !was_made => format!(
                "the broker at {address} closes the connection before it lets this gateway in; does it want \
                 TLS (`mqtts://`)?"
            ),
            error if loss(error) == Loss::Closed => format!(
                "the broker at {address} has closed the connection: it ends, or another client has come with \
                 the identifier `{}`",
                self.client_id
            ),
            error => format!("the connection to the broker at {address} is lost: {}", told(error)),
        }
    }
}

/// A message that the library gives back.
fn once(publish: Publish) -> Option<Message> {
    // It was text when it was handed over.
    Some(Message::once(publish.topic, String::from_utf8(publish.payload.to_vec()).ok()?))
}

fn loss(error: &ConnectionError) -> Loss {
    use std::io::ErrorKind;
    match error {
        ConnectionError::MqttState(StateError::ConnectionAborted) => Loss::Closed,
        ConnectionError::NetworkTimeout
        | ConnectionError::FlushTimeout
        | ConnectionError::MqttState(StateError::AwaitPingResp | StateError::CollisionTimeout) => {
            Loss::Silent
        }
        error => match io_error(error).map(std::io::Error::kind) {
            Some(ErrorKind::ConnectionReset | ErrorKind::UnexpectedEof | ErrorKind::BrokenPipe) => {
                Loss::Closed
            }
            Some(ErrorKind::TimedOut) => Loss::Silent,
            _ => Loss::Failed,
        },
    }
}

/// The error of the connection below MQTT, if it was one.
fn io_error(error: &ConnectionError) -> Option<&std::io::Error> {
    let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(error);
    while let Some(error) = cause {
        if let Some(error) = error.downcast_ref() {
            return Some(error);
        }
        cause = error.source();
    }
    None
}

fn rustls_error(error: &ConnectionError) -> Option<&rustls::Error> {
    if let ConnectionError::Tls(TlsError::TLS(error)) = error {
        return Some(error);
    }
    io_error(error)?.get_ref()?.downcast_ref()
}

/// The innermost error, which says it without the library's own words.
fn told(error: &ConnectionError) -> String {
    let mut cause: &dyn std::error::Error = error;
    while let Some(source) = cause.source() {
        cause = source;
    }
    cause.to_string()
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
    /// Whether the last connection was lost to somebody else with our identifier.
    contested: bool,
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
            Seen::Down { reason, contested } => {
                let mut state = lock(&self.state);
                state.connected = false;
                // Once for each reason, not once for each attempt; and a quarrel once, not each time
                // that it is lost.
                let is_known = state.reason.as_ref() == Some(&reason) || (contested && self.contested);
                if !is_known {
                    tracing::warn!("{reason}");
                }
                self.contested = contested;
                state.reason = Some(reason);
                drop(state);
                self.connected = false;
                if self.told_up != Some(false) {
                    self.told_up = Some(false);
                    (self.tell)(News::Down);
                }
            }
            Seen::Unsent(messages) => self.mailbox.outbox().give_back(messages),
            Seen::Packet { packet: Packet::Publish(publish), stale_for } => {
                let payload = String::from_utf8_lossy(&publish.payload).into_owned();
                // A broker repeats only what it has kept from an earlier connection.
                let stale = match (publish.dup, stale_for) {
                    (true, _) => Some("the broker has kept it from an earlier connection".to_string()),
                    (false, Some(age)) => Some(format!(
                        "the broker or the way to it was stalled; it may be {} s old",
                        age.as_secs()
                    )),
                    (false, None) => None,
                };
                self.receive(&publish.topic, payload, publish.retain, stale);
            }
            Seen::Packet { packet: Packet::SubAck(answer), .. } => {
                if answer.return_codes.contains(&SubscribeReasonCode::Failure) {
                    tracing::warn!("the broker does not let this user subscribe; commands will not arrive");
                }
            }
            Seen::Packet { .. } | Seen::Room => {}
        }
    }

    /// `stale` says why a command would be too old to be obeyed.
    fn receive(&self, topic: &str, payload: String, retained: bool, stale: Option<String>) {
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
            Some(Incoming::Set { device, point }) if !retained && stale.is_some() => {
                let reason = stale.unwrap_or_default();
                tracing::warn!("`{topic}` is not obeyed: {reason}");
                let outcome = Outcome::new(OutcomeKind::Expired, &payload, &reason);
                let topic = self.topics.outcome(device, point);
                self.mailbox.outbox().push(Message::once(topic, outcome.to_json()));
            }
            Some(Incoming::Set { device, point }) => {
                let (device, point) = (device.to_string(), point.to_string());
                (self.tell)(News::Set { device, point, payload, retained });
            }
            Some(Incoming::Get { device, point }) if !retained => {
                (self.tell)(News::Get { device: device.to_string(), point: point.to_string() });
            }
            Some(Incoming::Request { verb }) => {
                (self.tell)(News::Request { verb: verb.to_string(), payload, retained, stale });
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
        while let Some(message) = outbox.next_message(self.clock.now()) {
            let payload = message.payload.as_bytes();
            let taken = self.client.try_publish(&message.topic, QoS::AtLeastOnce, message.retain, payload);
            if taken.is_err() {
                outbox.put_back(message);
                return false;
            }
        }
        self.subscribed && outbox.is_empty()
    }

    /// Waits until the library has sent everything and the connection is closed.
    async fn disconnect(self, mut events: mpsc::Receiver<Seen>) {
        while self.client.try_disconnect().is_err() {
            if events.recv().await.is_none() {
                return;
            }
        }
        while let Some(seen) = events.recv().await {
            if matches!(seen, Seen::Down { .. }) {
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::settings::Password;

    /// The library keeps such a message, and would hand it out after the next connect.
    #[test]
    fn what_came_with_the_end_of_a_connection_is_handed_on_before_the_end_is_told() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("a runtime");
        runtime.block_on(async {
            let (_client, mut event_loop) = AsyncClient::new(MqttOptions::new("id", "localhost", 1883), 10);
            let command = Publish::new("busker/a/b/set", QoS::AtLeastOnce, "ON");
            let command = Packet::Publish(command);
            event_loop.state.events.push_back(rumqttc::Event::Incoming(command.clone()));
            let (seen, mut events) = mpsc::channel(10);
            let mqtt = Mqtt {
                host: "localhost".into(),
                port: 1883,
                websocket: None,
                tls: None,
                keep_alive: Duration::from_secs(15),
                username: None,
                password: Password::None,
                base_topic: "busker".into(),
            };
            let mut poller = Poller {
                event_loop,
                seen,
                connection: Arc::new(Mutex::new(Connection::default())),
                mqtt,
                address: "localhost:1883".into(),
                client_id: "id".into(),
                unreadable: None,
                clock: Clock::start(),
            };
            lock(&poller.connection).made(poller.clock.now());
            let end = ConnectionError::MqttState(StateError::ConnectionAborted);
            let task = tokio::spawn(async move { poller.lost(end).await.is_ok() });
            let first = events.recv().await.expect("two things are told");
            assert!(matches!(first, Seen::Packet { packet, stale_for: None } if packet == command));
            let second = events.recv().await.expect("two things are told");
            assert!(matches!(second, Seen::Down { reason, contested: false } if reason.contains("`id`")));
            task.abort();
        });
    }
}
