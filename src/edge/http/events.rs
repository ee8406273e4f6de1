//! `GET /api/events`: passes on what a [`Feed`] says, to everybody who watches.
//!
//! While nobody does, nobody is asked. A reader who is slower than the news loses its connection; what
//! waits for it is bounded.

use std::convert::Infallible;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};

use bytes::Bytes;
use http_body::{Body, Frame};
use tokio::sync::mpsc::{Receiver, Sender, channel};
use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore};
use tokio::time::{MissedTickBehavior, interval};

use crate::edge::clock::Clock;
use crate::edge::lock::lock;
use crate::edge::reports::{Detail, Reporter};
use crate::engine::feed::{Feed, Look, News, Told};
use crate::engine::time::{Duration, Time};

const LOOK_EVERY: Duration = Duration::from_secs(1);

/// A comment, which a browser passes over.
const HEARTBEAT: &[u8] = b": still here\n\n";

/// How many may watch.
const READERS_MAX: usize = 32;

/// How many looks may wait for a reader, everything that it is told first among them.
const WAITING_MAX: usize = 16;

/// Where readers come in.
pub struct Hub {
    arrived: Mutex<Vec<Sender<Bytes>>>,
    bell: Notify,
    seats: Arc<Semaphore>,
}

impl Default for Hub {
    fn default() -> Hub {
        let seats = Arc::new(Semaphore::new(READERS_MAX));
        Hub { arrived: Mutex::default(), bell: Notify::new(), seats }
    }
}

impl Hub {
    /// What a new reader is to be sent; `None` if too many watch already.
    pub fn join(&self) -> Option<EventStream> {
        let seat = self.seats.clone().try_acquire_owned().ok()?;
        let (sender, news) = channel(WAITING_MAX);
        lock(&self.arrived).push(sender);
        self.bell.notify_one();
        Some(EventStream { news, _seat: seat })
    }

    fn take_arrived(&self) -> Vec<Sender<Bytes>> {
        std::mem::take(&mut *lock(&self.arrived))
    }
}

/// The body of an answer that does not end by itself.
pub struct EventStream {
    news: Receiver<Bytes>,
    _seat: OwnedSemaphorePermit,
}

impl Body for EventStream {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        self.news.poll_recv(context).map(|news| news.map(|bytes| Ok(Frame::data(bytes))))
    }
}

/// Looks at the gateway once a second while somebody watches, and tells what it sees. Does not end.
pub async fn tell(hub: Arc<Hub>, reporter: Arc<Reporter>, clock: Clock) {
    let mut ticks = interval(LOOK_EVERY);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut readers: Vec<Sender<Bytes>> = Vec::new();
    let mut feed = Feed::default();
    loop {
        readers.retain(|reader| !reader.is_closed());
        if readers.is_empty() {
            // What was seen before nobody watched is out of date when somebody does.
            feed = Feed::default();
            hub.bell.notified().await;
        } else {
            tokio::select! {
                _ = ticks.tick() => {}
                // A newcomer in between is told what the others know, and with them what comes next.
                () = hub.bell.notified() => {
                    welcome(&hub, &mut readers, &feed, clock.now());
                    continue;
                }
            }
        }
        let report = reporter.report(Detail::Points).await;
        // After the answer: what a stuck bus said last has grown older while we waited for it.
        let at = clock.now();
        match feed.look(Look { at, report }) {
            Told::News(news) => deliver(&mut readers, &text(&news)),
            Told::Heartbeat => deliver(&mut readers, &Bytes::from_static(HEARTBEAT)),
            Told::Nothing => {}
        }
        welcome(&hub, &mut readers, &feed, at);
        ticks.reset();
    }
}

fn welcome(hub: &Hub, readers: &mut Vec<Sender<Bytes>>, feed: &Feed, now: Time) {
    let mut newcomers = hub.take_arrived();
    if newcomers.is_empty() {
        return;
    }
    if let Some(everything) = feed.everything(now) {
        deliver(&mut newcomers, &text(&[everything]));
        readers.append(&mut newcomers);
    }
}

/// Who has no room for it is out.
fn deliver(readers: &mut Vec<Sender<Bytes>>, text: &Bytes) {
    readers.retain(|reader| reader.try_send(text.clone()).is_ok());
}

/// As server-sent events. JSON has no line breaks.
fn text(news: &[News]) -> Bytes {
    news.iter()
        .map(|news| format!("event: {}\ndata: {}\n\n", news.event, news.data))
        .collect::<String>()
        .into()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn who_does_not_read_loses_its_place_and_nobody_else() {
        let (slow, mut waiting) = channel(2);
        let (good, mut received) = channel(2);
        let mut readers = vec![slow, good];
        for number in 0..5u8 {
            deliver(&mut readers, &Bytes::from(vec![number]));
            assert_eq!(received.try_recv().ok().as_deref(), Some([number].as_slice()));
        }
        assert_eq!(readers.len(), 1);
        assert_eq!(waiting.try_recv().ok().as_deref(), Some([0].as_slice()));
        assert_eq!(waiting.try_recv().ok().as_deref(), Some([1].as_slice()));
        assert!(waiting.try_recv().is_err(), "its stream ends");
        assert!(waiting.is_closed());
    }

    #[test]
    fn only_so_many_may_watch_and_who_leaves_makes_room() {
        let hub = Hub::default();
        let mut streams: Vec<EventStream> = (0..READERS_MAX).filter_map(|_| hub.join()).collect();
        assert_eq!(streams.len(), READERS_MAX);
        assert!(hub.join().is_none());
        streams.pop();
        assert!(hub.join().is_some());
    }

    #[test]
    fn news_are_server_sent_events() {
        let news = |event, data| News { event, data };
        let told = text(&[news("bus", json!({"at": 1.5})), news("read", json!({"line": "a\nb"}))]);
        assert_eq!(told, "event: bus\ndata: {\"at\":1.5}\n\nevent: read\ndata: {\"line\":\"a\\nb\"}\n\n");
    }
}
