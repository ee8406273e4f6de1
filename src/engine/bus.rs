//! One bus as a state machine: what happened goes in, what to do comes out.

use crate::engine::health::BusReport;
use crate::engine::modbus::{Reply, Request};
use crate::engine::settings::Settings;
use crate::engine::time::{Duration, Time};
use crate::engine::topics::Message;

/// What can happen to a bus.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// The port is open, the connection stands.
    LinkUp,
    LinkDown(String),
    /// The request of the last [`Action::Send`] has ended.
    Reply(Reply),
    Command(Command),
    /// Read this point now.
    Get {
        device: String,
        point: String,
    },
    BrokerUp,
    BrokerDown,
    /// The time of [`Bus::wake_at`] has come.
    Wake,
    /// Finish the request in flight, refuse what waits, say `offline`.
    Shutdown,
}

/// A message on a `set` topic, as it came.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Command {
    pub device: String,
    pub point: String,
    pub payload: String,
    /// A replayed one; it is never obeyed.
    pub retained: bool,
}

/// What is to be done.
#[derive(Clone, Debug, PartialEq)]
pub enum Action {
    /// Ask the line. Exactly one request is in flight: the next `Send` comes after its reply.
    Send {
        request: Request,
        not_before: Time,
        timeout: Duration,
    },
    Publish(Message),
    /// Close the link and open it again.
    Reopen {
        after: Duration,
    },
    /// A line for the log: said once when something breaks and once when it heals.
    Say(Severity, String),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Severity {
    Info,
    Warning,
}

/// One serial line or TCP connection, and the devices on it.
pub struct Bus {}

impl Bus {
    /// The bus number `index` of `settings`, with the devices that are on it.
    pub fn new(_now: Time, _settings: &Settings, _index: usize) -> Bus {
        Bus {}
    }

    /// Tells the bus what happened. Never fails: what goes wrong becomes a reading or a report.
    pub fn handle(&mut self, _now: Time, _event: Event) {}

    /// Takes the next thing to do, until there is none.
    pub fn next_action(&mut self) -> Option<Action> {
        None
    }

    /// When to call `handle(now, Event::Wake)` if nothing else happens before.
    pub fn wake_at(&self) -> Option<Time> {
        None
    }

    /// The bus as it is now, for `/health`, `/metrics`, `/api` and `bridge/health`.
    pub fn report(&self, _now: Time) -> BusReport {
        BusReport {
            name: String::new(),
            link: String::new(),
            up: false,
            reason: None,
            counters: Default::default(),
            load: 0.0,
            devices: Vec::new(),
        }
    }
}
