//! What the broker has to tell the rest of the program, and who brings it there.

use std::sync::Mutex;

use rumqttc::Publish;

use super::lock;
use crate::engine::arrivals::{Arrival, Arrivals, Errand, Mail};
use crate::engine::outbox::Heard;
use crate::engine::time::Duration;

/// What the broker has to tell the rest of the program.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum News {
    Up,
    Down,
    Errand(Errand),
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

    pub fn tell(&self, news: News) {
        (self.tell)(news);
    }

    /// Brings what somebody wants of a bus there, in the order in which it came, and with nothing in between: a command
    /// that comes too late for the next request waits for a whole transaction. Returns what the outbox has to know.
    pub fn bring(&self, publish: &Publish, stale_for: Option<Duration>) -> Option<Heard> {
        let payload = &String::from_utf8_lossy(&publish.payload);
        let (retained, repeated) = (publish.retain, publish.dup);
        let mail = Mail { topic: &publish.topic, payload, retained, repeated, stale_for };
        let arrival = lock(&self.arrivals).sort(&mail);
        match arrival {
            Arrival::Errand(errand) => {
                self.tell(News::Errand(errand));
                None
            }
            Arrival::Heard(heard) => Some(heard),
            Arrival::Nothing => None,
        }
    }
}
