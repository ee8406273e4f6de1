//! What the broker has to tell the rest of the program, and who brings it there.

use std::sync::Mutex;

use rumqttc::Publish;

use super::lock;
use crate::engine::arrivals::{Arrival, Arrivals, Mail};
use crate::engine::time::Duration;

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

/// Brings news where they belong; whoever hears of something hands it over.
pub(super) struct Courier<Tell> {
    arrivals: Mutex<Arrivals>,
    tell: Tell,
}

impl<Tell: Fn(News)> Courier<Tell> {
    /// `tell` must not wait.
    pub fn new(arrivals: Arrivals, tell: Tell) -> Courier<Tell> {
        Courier { arrivals: Mutex::new(arrivals), tell }
    }

    /// On a new connection: says what to subscribe to.
    pub fn begin_anew(&self) -> Vec<String> {
        let mut arrivals = lock(&self.arrivals);
        arrivals.begin_anew();
        arrivals.filters().to_vec()
    }

    /// Listens to this from now on, on the same connection; says what was subscribed to before.
    pub fn listen_to(&self, now: Arrivals) -> Vec<String> {
        let mut arrivals = lock(&self.arrivals);
        let filters = arrivals.filters().to_vec();
        arrivals.listen_to(now);
        filters
    }

    /// Says what a message is to this gateway.
    pub fn sort<'m>(&self, mail: &Mail<'m>) -> Arrival<'m> {
        lock(&self.arrivals).sort(mail)
    }

    pub fn tell(&self, news: News) {
        (self.tell)(news);
    }

    /// Brings what somebody wants of a bus there; `false`: it is something else. In the order in which it came, and
    /// with nothing in between: a command that comes too late for the next request waits for a whole transaction.
    pub fn bring(&self, mail: &Mail<'_>) -> bool {
        let (payload, retained) = (mail.payload.into(), mail.retained);
        let news = match self.sort(mail) {
            Arrival::Set { device, point } => {
                News::Set { device: device.into(), point: point.into(), payload, retained }
            }
            Arrival::Get { device, point } => News::Get { device: device.into(), point: point.into() },
            Arrival::Request { verb, stale } => News::Request { verb: verb.into(), payload, retained, stale },
            _ => return false,
        };
        self.tell(news);
        true
    }
}

/// A message of the library in the engine's words. `payload` is its own, as text.
pub(super) fn mail<'m>(publish: &'m Publish, payload: &'m str, stale_for: Option<Duration>) -> Mail<'m> {
    Mail { topic: &publish.topic, payload, retained: publish.retain, repeated: publish.dup, stale_for }
}
