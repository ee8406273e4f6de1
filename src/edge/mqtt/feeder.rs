//! Feeds the client library from the mailbox, which also hears what comes in.

use std::sync::{Arc, Mutex};

use rumqttc::{AsyncClient, QoS, SubAck, SubscribeFilter, SubscribeReasonCode};
use tokio::sync::{mpsc, oneshot};

use super::courier::{Courier, News};
use super::lock;
use super::mailbox::Mailbox;
use super::poller::Seen;
use crate::edge::clock::Clock;
use crate::edge::log;
use crate::engine::arrivals::{Arrivals, Subscriptions};
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

/// Feeds the client library with what the outbox holds, and lets the outbox hear what comes in. What is for a bus does
/// not come by here: the poller has brought it there.
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
    pub subscriptions: Subscriptions,
    /// Who wants to know when the broker has answered what it was asked for.
    pub awaits_answer: Option<oneshot::Sender<()>>,
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
        self.subscriptions.change(self.courier.listen_to(arrivals), now);
        // Whoever waits waits no longer where nothing is asked, or nobody could answer.
        self.awaits_answer = (self.connected && !self.subscriptions.wanted().is_empty()).then_some(told);
    }

    fn handle(&mut self, seen: Seen) {
        match seen {
            Seen::Up => {
                tracing::info!("connected to the broker");
                lock(&self.state).made();
                self.connected = true;
                self.subscriptions = Subscriptions::new(self.courier.begin_anew());
                self.mailbox.outbox().connected();
                self.told_up = Some(true);
                self.courier.tell(News::Up);
            }
            Seen::Down { reason, contested, suspect } => {
                if lock(&self.state).lost(reason.clone(), contested) {
                    tracing::warn!("{reason}");
                }
                (self.connected, self.awaits_answer) = (false, None);
                let line = {
                    let mut outbox = self.mailbox.outbox();
                    outbox.disconnected();
                    outbox.connection_ended(suspect)
                };
                log::say_all(line);
                if self.told_up != Some(false) {
                    self.told_up = Some(false);
                    self.courier.tell(News::Down);
                }
            }
            Seen::Unsent(messages) => self.mailbox.outbox().give_back(messages),
            Seen::Heard { heard, publish } => {
                let payload = String::from_utf8_lossy(&publish.payload);
                let now = self.clock.now();
                let lines = self.mailbox.outbox().hear(heard, &publish.topic, &payload, now);
                log::say_all(lines);
            }
            Seen::Subscribed(answer) => self.subscribed(&answer),
            Seen::Room => {}
        }
    }

    fn subscribed(&mut self, answer: &SubAck) {
        let is_granted = |code: &SubscribeReasonCode| *code != SubscribeReasonCode::Failure;
        let refused = self.subscriptions.refused(answer.return_codes.iter().map(is_granted));
        if !refused.is_empty() {
            tracing::warn!(
                "the broker does not let this user subscribe to `{}`; what is told there, commands perhaps, will not \
                 arrive",
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
        let lines = outbox.take_lines();
        drop(outbox);
        log::say_all(lines);
    }

    /// When the broker is asked next whether it is there.
    fn asks_at(&self) -> Option<Time> {
        if self.connected && self.subscriptions.wanted().is_empty() {
            lock(&self.connection).asks_at()
        } else {
            None
        }
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
        self.subscriptions.wanted().is_empty() && outbox.is_empty()
    }

    fn subscribe(&mut self) {
        let wanted = self.subscriptions.wanted();
        if !wanted.is_empty() {
            let filter = |path: &String| SubscribeFilter::new(path.clone(), QoS::AtLeastOnce);
            if self.client.try_subscribe_many(wanted.iter().map(filter)).is_ok() {
                self.subscriptions.asked();
            }
        }
        // Where the library has no room, it is tried again when it has.
        while let Some(filter) = self.subscriptions.unwanted() {
            if self.client.try_unsubscribe(filter).is_err() {
                return;
            }
            self.subscriptions.let_go();
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
