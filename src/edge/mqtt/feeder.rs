//! Feeds the client library from the mailbox, and hands on what comes in.

use std::sync::{Arc, Mutex};

use rumqttc::{AsyncClient, Packet, QoS, SubscribeFilter, SubscribeReasonCode};
use tokio::sync::{mpsc, oneshot};

use super::lock;
use super::mailbox::Mailbox;
use super::poller::Seen;
use crate::edge::clock::Clock;
use crate::engine::arrivals::{Arrival, Arrivals, Mail};
use crate::engine::connection::Connection;
use crate::engine::health::BrokerReport;
use crate::engine::settings::Manner;
use crate::engine::time::{Duration, Time};
use crate::engine::topics::Topics;

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

/// Feeds the library from the outbox and hands on what comes in.
pub(super) struct Feeder<Tell> {
    pub client: AsyncClient,
    pub clock: Clock,
    pub topics: Topics,
    pub arrivals: Arrivals,
    pub mailbox: Arc<Mailbox>,
    pub state: Arc<Mutex<BrokerReport>>,
    pub connection: Arc<Mutex<Connection>>,
    pub connected: bool,
    /// Whether the last connection was lost to somebody else with our identifier.
    pub contested: bool,
    /// What was last told of the connection.
    pub told_up: Option<bool>,
    pub subscribed: bool,
    pub ending: bool,
    /// Whether it was told that others tell something else of this gateway's state.
    pub denied: bool,
    pub tell: Tell,
}

impl<Tell: Fn(News)> Feeder<Tell> {
    pub async fn run(mut self, mut events: mpsc::Receiver<Seen>, mut goodbye: oneshot::Receiver<()>) {
        loop {
            let wake_at = self.mailbox.outbox().wake_at().into_iter().chain(self.asks_at()).min();
            let until = wake_at.map_or(Duration::from_secs(3600), |time| self.clock.until(time));
            tokio::select! {
                seen = events.recv() => match seen {
                    Some(seen) => self.handle(seen),
                    None => return,
                },
                () = self.mailbox.news.notified() => {}
                () = tokio::time::sleep(until) => self.mailbox.outbox().wake(self.clock.now()),
                _ = &mut goodbye, if !self.ending => {
                    self.ending = true;
                    self.mailbox.outbox().goodbye();
                }
            }
            if self.ending && !self.connected {
                return;
            }
            let all_sent = self.feed();
            if self.ending && all_sent {
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
            Seen::Down { reason, contested, closed_on } => {
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
                self.mailbox.outbox().disconnected();
                self.judge_length(closed_on);
                if self.told_up != Some(false) {
                    self.told_up = Some(false);
                    (self.tell)(News::Down);
                }
            }
            Seen::Unsent(messages) => self.mailbox.outbox().give_back(messages),
            Seen::Packet { packet: Packet::Publish(publish), stale_for } => {
                let payload = String::from_utf8_lossy(&publish.payload);
                self.receive(&Mail {
                    topic: &publish.topic,
                    payload: &payload,
                    retained: publish.retain,
                    repeated: publish.dup,
                    stale_for,
                });
            }
            Seen::Packet { packet: Packet::SubAck(answer), .. } => {
                let codes = answer.return_codes.iter().zip(self.arrivals.filters());
                let refused = codes.filter(|(code, _)| **code == SubscribeReasonCode::Failure);
                let refused: Vec<&str> = refused.map(|(_, filter)| filter.as_str()).collect();
                if !refused.is_empty() {
                    tracing::warn!(
                        "the broker does not let this user subscribe to `{}`; what is told there, commands perhaps, \
                         will not arrive",
                        refused.join("`, `")
                    );
                }
                self.mailbox.outbox().listens(self.clock.now());
            }
            Seen::Packet { .. } | Seen::Room => {}
        }
    }

    /// A broker that takes no message as long as the one which it was sent has no other word for that than to close
    /// the connection.
    fn judge_length(&self, closed_on: Option<(String, usize)>) {
        let mut outbox = self.mailbox.outbox();
        let Some((topic, bytes)) = closed_on else { return outbox.lost() };
        if outbox.closed_on(&topic, bytes) {
            tracing::warn!(
                "the broker closes the connection whenever it is sent what belongs on `{topic}`, {bytes} bytes: most \
                 likely it takes no message that long (`max_packet_size` of mosquitto). It is not sent again; the \
                 topics that miss something stand under `kept_back` in `/health`"
            );
        }
    }

    fn receive(&mut self, mail: &Mail<'_>) {
        let Mail { topic, payload, retained, .. } = *mail;
        match self.arrivals.sort(mail) {
            // The last word is this gateway's own, when it ends.
            Arrival::OwnState if self.ending => {}
            Arrival::OwnState => self.heard_state(payload),
            Arrival::FormerState => {
                let somebody = self.mailbox.outbox().heard_former(topic, payload);
                if let Some(base) = somebody {
                    tracing::warn!(
                        "what this gateway told below `{base}` before is not taken back: somebody else is online there"
                    );
                }
            }
            Arrival::HomeAssistantStarted => {
                tracing::info!("Home Assistant is there: it is told of everything again");
                self.mailbox.outbox().home_assistant_started(self.clock.now());
            }
            Arrival::Announcement => self.mailbox.outbox().found(topic, payload),
            Arrival::Expired { reason, outcome } => {
                tracing::warn!("`{topic}` is not obeyed: {reason}");
                self.mailbox.outbox().push(outcome);
            }
            Arrival::Set { device, point } => {
                let (device, point, payload) = (device.into(), point.into(), payload.into());
                (self.tell)(News::Set { device, point, payload, retained });
            }
            Arrival::Get { device, point } => {
                (self.tell)(News::Get { device: device.into(), point: point.into() });
            }
            Arrival::Request { verb, stale } => {
                (self.tell)(News::Request { verb: verb.into(), payload: payload.into(), retained, stale });
            }
            Arrival::Nothing => {}
        }
    }

    fn heard_state(&mut self, payload: &str) {
        let now = self.clock.now();
        let mut outbox = self.mailbox.outbox();
        outbox.heard_state(payload, now);
        let is_denied = outbox.is_denied(now);
        if is_denied && !self.denied {
            tracing::warn!(
                "somebody else tells `{}` on `{}` again and again, and is put right some times a minute: has another \
                 gateway `base_topic: {}`?",
                payload.chars().take(20).collect::<String>(),
                self.topics.bridge_state(),
                self.topics.base()
            );
        }
        self.denied = is_denied;
    }

    /// When the broker is asked next whether it is there.
    fn asks_at(&self) -> Option<Time> {
        if self.connected && self.subscribed { lock(&self.connection).asks_at() } else { None }
    }

    /// Asks what a broker answers and nobody else hears of: to be told no more of what this gateway was never told
    /// of. A broker that is slow to answer may hold others' messages as well.
    fn ask(&mut self) {
        let now = self.clock.now();
        if self.asks_at().is_some_and(|at| now >= at) {
            // Told before the answer can be here.
            lock(&self.connection).asked(now);
            // Where the library has no room for it, it waits for other answers.
            let _ = self.client.try_unsubscribe(self.topics.question());
        }
    }

    /// Hands over as much as the library has room for; `true` if nothing is left.
    fn feed(&mut self) -> bool {
        if !self.connected {
            return false;
        }
        if !self.subscribed {
            let filter = |path: &String| SubscribeFilter::new(path.clone(), QoS::AtLeastOnce);
            self.subscribed =
                self.client.try_subscribe_many(self.arrivals.filters().iter().map(filter)).is_ok();
        }
        self.ask();
        let mut outbox = self.mailbox.outbox();
        while let Some(message) = outbox.next_message(self.clock.now()) {
            let Manner { confirmed, retain } = outbox.manner(&message);
            let qos = if confirmed { QoS::AtLeastOnce } else { QoS::AtMostOnce };
            let taken = self.client.try_publish(&message.topic, qos, retain, message.payload.as_bytes());
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
