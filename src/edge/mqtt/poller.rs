//! Polls the client library and connects again: what came, and that a connection was made or lost.

use std::sync::{Arc, Mutex};

use rumqttc::{ConnectionError, EventLoop, Outgoing, Packet, Publish, Request, SubAck};
use tokio::sync::mpsc;

use super::courier::{Courier, News};
use super::lock;
use super::losses::{Ends, loss};
use crate::edge::clock::Clock;
use crate::edge::secrets::Secrets;
use crate::engine::connection::Connection;
use crate::engine::outbox::Heard;
use crate::engine::settings::Mqtt;
use crate::engine::topics::Message;

/// Polls the client library and nothing else: a library that is not polled neither sends nor answers
/// pings. Waits between attempts to connect.
pub(super) struct Poller<Tell> {
    pub event_loop: EventLoop,
    pub courier: Arc<Courier<Tell>>,
    pub seen: mpsc::Sender<Seen>,
    pub connection: Arc<Mutex<Connection>>,
    pub mqtt: Mqtt,
    pub ends: Ends,
    /// Why its files could not be read, the last time.
    pub unreadable: Option<String>,
    pub clock: Clock,
}

impl<Tell: Fn(News)> Poller<Tell> {
    /// Until nobody listens.
    pub async fn run(mut self) {
        loop {
            let seen = match self.event_loop.poll().await {
                Ok(rumqttc::Event::Incoming(Packet::ConnAck(_))) => {
                    let wait = lock(&self.connection).made(self.clock.now());
                    tokio::time::sleep(wait).await;
                    Seen::Up
                }
                Ok(event) => match self.seen(event) {
                    Some(seen) => seen,
                    None => continue,
                },
                Err(error) => {
                    if self.lost(error).await.is_err() {
                        return;
                    }
                    continue;
                }
            };
            if self.tell(seen).await.is_err() {
                return;
            }
        }
    }

    /// What is to be told of it. What is for a bus is brought there. A question for its own sake is asked by the
    /// feeder, and its answer is nobody else's business.
    fn seen(&self, event: rumqttc::Event) -> Option<Seen> {
        let now = self.clock.now();
        let mut connection = lock(&self.connection);
        match event {
            rumqttc::Event::Incoming(packet) => {
                connection.heard(now);
                let stale_for = connection.stale_for(now);
                drop(connection);
                match packet {
                    Packet::Publish(publish) => {
                        let heard = self.courier.bring(&publish, stale_for)?;
                        Some(Seen::Heard { heard, publish })
                    }
                    Packet::SubAck(answer) => Some(Seen::Subscribed(answer)),
                    Packet::UnsubAck(_) => None,
                    // Whatever the broker confirms makes room.
                    _ => Some(Seen::Room),
                }
            }
            rumqttc::Event::Outgoing(Outgoing::Unsubscribe(_)) => None,
            rumqttc::Event::Outgoing(sent) => {
                // What is published with QoS 0, which has the number 0, is not answered.
                if matches!(sent, Outgoing::Publish(1..) | Outgoing::Subscribe(_) | Outgoing::PingReq) {
                    connection.asked(now);
                }
                Some(Seen::Room)
            }
        }
    }

    /// Tells what is left of the connection, and waits before the next attempt.
    async fn lost(&mut self, error: ConnectionError) -> Result<(), NobodyListens> {
        // What came together with the end. The library would hand it out after the next connect,
        // when a command in it is no longer meant.
        for event in std::mem::take(&mut self.event_loop.state.events) {
            if let rumqttc::Event::Incoming(_) = event {
                if let Some(seen) = self.seen(event) {
                    self.tell(seen).await?;
                }
            }
        }
        // A collision of packet numbers from the old connection would stop publishing for ever.
        let collided = self.event_loop.state.collision.take();
        // What was on its way, and some of what would have been next.
        let unconfirmed = self.event_loop.pending.iter().filter_map(|request| match request {
            Request::Publish(publish) => Some(publish),
            _ => None,
        });
        let longest = unconfirmed.max_by_key(|publish| publish.payload.len());
        let longest = longest.map(|publish| (publish.topic.clone(), publish.payload.len()));
        let now = self.clock.now();
        let (was_made, after, contested) = {
            let mut connection = lock(&self.connection);
            let was_made = connection.is_made();
            let after = connection.lost(now, loss(&error), longest, now.0);
            (was_made, after, connection.is_contested(now))
        };
        let reason = match contested {
            true => self.ends.contested(),
            false => self.ends.reason(&error, was_made),
        };
        self.tell(Seen::Down { reason, contested, suspect: after.suspect }).await?;
        tokio::time::sleep(after.pause).await;
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
        self.tell(Seen::Unsent(unsent)).await
    }

    async fn tell(&mut self, seen: Seen) -> Result<(), NobodyListens> {
        self.seen.send(seen).await.map_err(|_| NobodyListens)
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
}

/// The feeder has ended.
struct NobodyListens;

/// What the polling task saw.
pub(super) enum Seen {
    Up,
    Down {
        reason: String,
        /// Somebody else takes this gateway's place again and again.
        contested: bool,
        /// The topic and the bytes of a message that the broker may have closed it for.
        suspect: Option<(String, usize)>,
    },
    /// Messages told once that the library had taken and the broker has not.
    Unsent(Vec<Message>),
    /// A message for the outbox.
    Heard {
        heard: Heard,
        publish: Publish,
    },
    /// The broker's answer to what it was asked to send.
    Subscribed(SubAck),
    /// The library has taken something, or the broker has: there may be room for more.
    Room,
}

/// A message that the library gives back.
fn once(publish: Publish) -> Option<Message> {
    // It was text when it was handed over.
    Some(Message::once(publish.topic, String::from_utf8(publish.payload.to_vec()).ok()?))
}

#[cfg(test)]
mod tests {
    use rumqttc::{AsyncClient, MqttOptions, QoS, StateError};

    use super::*;
    use crate::engine::arrivals::{Arrivals, Command, Errand};
    use crate::engine::configuration;
    use crate::engine::profile::Library;
    use crate::engine::time::Time;

    #[test]
    fn only_what_the_broker_answers_is_a_question() {
        let (_client, event_loop) = AsyncClient::new(MqttOptions::new("id", "localhost", 1883), 10);
        let poller = poller(event_loop, mpsc::channel(10).0, Box::new(drop));
        let asks_at = || lock(&poller.connection).asks_at();
        lock(&poller.connection).made(Time::default());
        for (sent, is_question) in [
            (Outgoing::Publish(0), false),
            (Outgoing::PubAck(7), false),
            (Outgoing::Publish(7), true),
            (Outgoing::PingReq, true),
        ] {
            let before = asks_at();
            // The clock goes on, by microseconds.
            while poller.clock.now()
                <= before.map_or(poller.clock.now(), |at| Time(at.0.saturating_sub(6_000_000)))
            {}
            poller.seen(rumqttc::Event::Outgoing(sent.clone()));
            assert_eq!(asks_at() != before, is_question, "{sent:?}");
        }
    }

    type Tell = Box<dyn Fn(News) + Send + Sync>;

    fn poller(event_loop: EventLoop, seen: mpsc::Sender<Seen>, tell: Tell) -> Poller<Tell> {
        let text = b"mqtt: {url: 'mqtt://localhost'}\nbuses: {cellar: {tcp: 'host:502'}}\n";
        let loaded = configuration::load("busker.yaml", text, &Library::shipped());
        let arrivals = Arrivals::new(&loaded.expect("settings").0, Vec::new());
        Poller {
            event_loop,
            courier: Arc::new(Courier::new(arrivals, tell)),
            seen,
            connection: Arc::new(Mutex::new(Connection::default())),
            mqtt: Mqtt::default(),
            ends: Ends {
                address: "localhost:1883".into(),
                client_id: "id".into(),
                base_topic: "busker".into(),
                websocket: false,
            },
            unreadable: None,
            clock: Clock::start(),
        }
    }

    /// The library keeps such a message, and would hand it out after the next connect.
    #[test]
    fn what_came_with_the_end_of_a_connection_is_brought_where_it_belongs_before_the_end_is_told() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("a runtime");
        runtime.block_on(async {
            let (_client, mut event_loop) = AsyncClient::new(MqttOptions::new("id", "localhost", 1883), 10);
            for (topic, payload) in [("busker/a/b/set", "ON"), ("busker/bridge/state", "offline")] {
                let publish = Publish::new(topic, QoS::AtLeastOnce, payload);
                event_loop.state.events.push_back(rumqttc::Event::Incoming(Packet::Publish(publish)));
            }
            let (seen, mut events) = mpsc::channel(1);
            let told = Arc::new(Mutex::new(Vec::new()));
            let of_poller = told.clone();
            let mut poller = poller(event_loop, seen, Box::new(move |news| lock(&of_poller).push(news)));
            lock(&poller.connection).made(poller.clock.now());
            let end = ConnectionError::MqttState(StateError::ConnectionAborted);
            let task = tokio::spawn(async move { poller.lost(end).await.is_ok() });
            let first = events.recv().await.expect("two things are told");
            // What is for a bus is there, and nobody else hears of it.
            let (device, point, payload) = ("a".into(), "b".into(), "ON".into());
            let command = Command { device, point, payload, retained: false };
            assert_eq!(*lock(&told), [News::Errand(Errand::Set(command))]);
            let Seen::Heard { heard: Heard::OwnState, publish } = first else {
                panic!("the state was not handed on")
            };
            assert_eq!(publish.topic, "busker/bridge/state");
            let second = events.recv().await.expect("two things are told");
            assert!(matches!(second, Seen::Down { reason, contested: false, .. } if reason.contains("`id`")));
            task.abort();
        });
    }
}
