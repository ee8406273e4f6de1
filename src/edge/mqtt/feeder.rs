//! Feeds the client library from the mailbox, which also learns from what comes in.

use std::sync::{Arc, Mutex};

use rumqttc::{AsyncClient, Packet, QoS, SubscribeFilter, SubscribeReasonCode};
use tokio::sync::{mpsc, oneshot};

use super::courier::{Courier, News, mail};
use super::lock;
use super::mailbox::Mailbox;
use super::poller::Seen;
use super::warnings;
use crate::edge::clock::Clock;
use crate::engine::arrivals::{Arrival, Arrivals, Mail};
use crate::engine::connection::Connection;
use crate::engine::health::BrokerReport;
use crate::engine::settings::Manner;
use crate::engine::time::{Duration, Time};
use crate::engine::topics::Topics;

/// What the feeder is asked to do.
pub(super) enum Order {
    /// To hear this from now on, and nothing else; and to say when the broker has confirmed it.
    ListenTo(Arrivals, oneshot::Sender<()>),
    /// To send what waits, and `offline`, and to disconnect. What waits is in this one, if the usual one is another
    /// connection's by now.
    End(Option<Arc<Mailbox>>),
}

/// Feeds the library from the outbox, and tells it what comes in but for what is for a bus: that has been brought there.
pub(super) struct Feeder<Tell> {
    pub client: AsyncClient,
    pub clock: Clock,
    pub topics: Topics,
    pub courier: Arc<Courier<Tell>>,
    pub mailbox: Arc<Mailbox>,
    pub state: Arc<Mutex<BrokerReport>>,
    pub connection: Arc<Mutex<Connection>>,
    pub connected: bool,
    /// What was last told of the connection.
    pub told_up: Option<bool>,
    /// What is still to be subscribed to.
    pub wanted: Vec<String>,
    /// What the broker was asked for last.
    pub asked_for: Vec<String>,
    /// Who wants to know when it has answered.
    pub awaits_answer: Option<oneshot::Sender<()>>,
    /// What is still to be let go of.
    pub unwanted: Vec<String>,
    pub ending: bool,
}

impl<Tell: Fn(News)> Feeder<Tell> {
    pub async fn run(mut self, mut events: mpsc::Receiver<Seen>, mut orders: mpsc::Receiver<Order>) {
        loop {
            let until = self.wake_at().map_or(Duration::from_secs(3600), |time| self.clock.until(time));
            tokio::select! {
                seen = events.recv() => match seen {
                    Some(seen) => self.handle(seen),
                    None => return,
                },
                () = self.mailbox.news.notified() => {}
                () = tokio::time::sleep(until) => self.wake(),
                order = orders.recv(), if !self.ending => match order {
                    Some(Order::ListenTo(arrivals, told)) => self.listen_to(arrivals, told),
                    Some(Order::End(rest)) => {
                        self.mailbox = rest.unwrap_or(self.mailbox);
                        self.end();
                    }
                    None => self.end(),
                },
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

    fn end(&mut self) {
        self.ending = true;
        self.mailbox.outbox().goodbye();
    }

    /// On the same connection: what stays is not asked for again.
    fn listen_to(&mut self, arrivals: Arrivals, told: oneshot::Sender<()>) {
        let now = arrivals.filters().to_vec();
        let before = self.courier.listen_to(arrivals);
        self.wanted.retain(|filter| now.contains(filter));
        self.unwanted.retain(|filter| !now.contains(filter));
        let (stays, goes): (Vec<String>, Vec<String>) =
            before.into_iter().partition(|filter| now.contains(filter));
        self.wanted.extend(now.into_iter().filter(|filter| !stays.contains(filter)));
        self.unwanted.extend(goes);
        // Whoever waits waits no longer where nothing is asked, or nobody could answer.
        self.awaits_answer = (self.connected && !self.wanted.is_empty()).then_some(told);
    }

    fn handle(&mut self, seen: Seen) {
        match seen {
            Seen::Up => {
                tracing::info!("connected to the broker");
                lock(&self.state).made();
                self.connected = true;
                (self.wanted, self.unwanted) = (self.courier.begin_anew(), Vec::new());
                self.mailbox.outbox().connected();
                self.told_up = Some(true);
                self.courier.tell(News::Up);
            }
            Seen::Down { reason, contested, suspect } => {
                if lock(&self.state).lost(reason.clone(), contested) {
                    tracing::warn!("{reason}");
                }
                (self.connected, self.awaits_answer) = (false, None);
                self.mailbox.outbox().disconnected();
                self.judge_length(suspect);
                if self.told_up != Some(false) {
                    self.told_up = Some(false);
                    self.courier.tell(News::Down);
                }
            }
            Seen::Unsent(messages) => self.mailbox.outbox().give_back(messages),
            Seen::Packet { packet: Packet::Publish(publish), stale_for } => {
                let payload = String::from_utf8_lossy(&publish.payload);
                self.receive(&mail(&publish, &payload, stale_for));
            }
            Seen::Packet { packet: Packet::SubAck(answer), .. } => {
                let codes = answer.return_codes.iter().zip(&self.asked_for);
                let refused = codes.filter(|(code, _)| **code == SubscribeReasonCode::Failure);
                let refused: Vec<&str> = refused.map(|(_, filter)| filter.as_str()).collect();
                if !refused.is_empty() {
                    tracing::warn!(
                        "the broker does not let this user subscribe to `{}`; what is told there, commands perhaps, \
                         will not arrive",
                        refused.join("`, `")
                    );
                }
                let mut outbox = self.mailbox.outbox();
                outbox.cannot_hear(&refused);
                outbox.listens(self.clock.now());
                drop(outbox);
                if let Some(told) = self.awaits_answer.take() {
                    // Perhaps nobody waits any more.
                    let _ = told.send(());
                }
            }
            Seen::Packet { .. } | Seen::Room => {}
        }
    }

    /// A broker that takes no message as long as the one which it was sent has no other word for that than to close
    /// the connection.
    fn judge_length(&self, suspect: Option<(String, usize)>) {
        let mut outbox = self.mailbox.outbox();
        let Some((topic, bytes)) = suspect else { return outbox.lost() };
        if outbox.closed_on(&topic, bytes) {
            tracing::warn!(
                "the broker closes the connection whenever it is sent what belongs on `{topic}`, {bytes} bytes: most \
                 likely it takes no message that long (`max_packet_size` of mosquitto). It is not sent again; the \
                 topics that miss something stand under `kept_back` in `/health`"
            );
        }
    }

    fn receive(&mut self, mail: &Mail<'_>) {
        let Mail { topic, payload, .. } = *mail;
        match self.courier.sort(mail) {
            // The last word is this gateway's own, when it ends.
            Arrival::OwnState if self.ending => {}
            Arrival::OwnState => self.heard_state(payload),
            Arrival::FormerState => {
                let somebody = {
                    let mut outbox = self.mailbox.outbox();
                    let somebody = outbox.heard_former(topic, payload);
                    warnings::tell(&mut outbox, &self.topics);
                    somebody
                };
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
            Arrival::Announcement { is_news } => {
                let mut outbox = self.mailbox.outbox();
                match is_news {
                    true => outbox.heard_announcement(topic, payload, self.clock.now()),
                    false => outbox.found(topic, payload),
                }
                warnings::tell(&mut outbox, &self.topics);
            }
            Arrival::Expired { reason, outcome } => {
                tracing::warn!("`{topic}` is not obeyed: {reason}");
                self.mailbox.outbox().push(outcome);
            }
            // The courier has brought it.
            Arrival::Set { .. } | Arrival::Get { .. } | Arrival::Request { .. } | Arrival::Nothing => {}
        }
    }

    fn wake_at(&self) -> Option<Time> {
        let of_outbox = {
            let outbox = self.mailbox.outbox();
            outbox.wake_at().into_iter().chain(outbox.awaits_until()).min()
        };
        of_outbox.into_iter().chain(self.asks_at()).min()
    }

    fn wake(&self) {
        let now = self.clock.now();
        let waits = lock(&self.connection).waits();
        let mut outbox = self.mailbox.outbox();
        if waits {
            outbox.listen_longer(now);
        }
        outbox.wake(now);
        warnings::tell(&mut outbox, &self.topics);
    }

    fn heard_state(&mut self, payload: &str) {
        if self.mailbox.outbox().heard_state(payload, self.clock.now()) {
            tracing::warn!(
                "somebody else tells `{}` on `{}` again and again, and is put right some times a minute: has another \
                 gateway `base_topic: {}`?",
                payload.chars().take(20).collect::<String>(),
                self.topics.bridge_state(),
                self.topics.base()
            );
        }
    }

    /// When the broker is asked next whether it is there.
    fn asks_at(&self) -> Option<Time> {
        if self.connected && self.wanted.is_empty() { lock(&self.connection).asks_at() } else { None }
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
        self.subscribe();
        self.ask();
        let mut outbox = self.mailbox.outbox();
        if !outbox.is_connected() {
            // It is for another connection, which follows this one.
            return false;
        }
        while let Some(message) = outbox.next_message(self.clock.now()) {
            let Manner { confirmed, retain } = outbox.manner(&message);
            let qos = if confirmed { QoS::AtLeastOnce } else { QoS::AtMostOnce };
            let taken = self.client.try_publish(&message.topic, qos, retain, message.payload.as_bytes());
            if taken.is_err() {
                outbox.put_back(message);
                return false;
            }
        }
        self.wanted.is_empty() && outbox.is_empty()
    }

    fn subscribe(&mut self) {
        if !self.wanted.is_empty() {
            let filter = |path: &String| SubscribeFilter::new(path.clone(), QoS::AtLeastOnce);
            if self.client.try_subscribe_many(self.wanted.iter().map(filter)).is_ok() {
                self.asked_for = std::mem::take(&mut self.wanted);
            }
        }
        // Where the library has no room, it is tried again when it has.
        while let Some(filter) = self.unwanted.last() {
            if self.client.try_unsubscribe(filter).is_err() {
                return;
            }
            self.unwanted.pop();
        }
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
