//! What programs ask over MQTT: a verb and a JSON object to a request for one bus, or to the answer
//! that says what would be right.
//!
//! What needs the device (its limits, what is forbidden) is checked where the device is, by the bus.

mod desk;
mod object;
mod verb;

use std::sync::Arc;

use serde::Serialize;
use serde_json::Value as Json;

use crate::engine::address::Span;
use crate::engine::identity::Known;
use crate::engine::time::{Date, Duration};
use crate::engine::topics::{Message, Topics};
use crate::engine::transaction::Transaction;

pub use desk::{Decision, Desk};
pub use verb::Verb;

/// One request, checked as far as it can be without its device.
#[derive(Clone, Debug, PartialEq)]
pub struct Request {
    pub verb: Verb,
    /// Comes back with the answer, whatever it is.
    pub transaction: Transaction,
    pub wish: Wish,
}

#[derive(Clone, Debug, PartialEq)]
pub enum Wish {
    Read {
        device: String,
        span: Span,
        /// A register that reading clears may be read.
        clears: bool,
    },
    /// As many words as the span has addresses; a bit is 0 or 1.
    Write {
        device: String,
        span: Span,
        words: Vec<u16>,
    },
    Identify {
        device: String,
    },
    Diagnostics {
        device: String,
    },
    /// Without a point all of them.
    Refresh {
        device: String,
        point: Option<String>,
    },
    Scan(Scan),
    /// `until` is for people; a pause of no time ends one.
    Pause {
        time: Duration,
        until: Date,
    },
    /// A file of what was last on the wire.
    Record,
}

/// Which units are asked, and what is known of devices that may be found there.
#[derive(Clone, Debug, PartialEq)]
pub struct Scan {
    pub first: u8,
    pub last: u8,
    pub known: Known,
    /// As long as somebody has it, the scan is under way, and the desk takes no other.
    pub ticket: Arc<()>,
}

/// How far a request has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Status {
    Ok,
    Error,
    /// More will be told.
    Progress,
}

impl Request {
    /// `{"transaction":"1","status":"ok","data":{…},"error":null}`
    pub fn answer(&self, topics: &Topics, status: Status, data: Json, error: Option<&str>) -> Message {
        answer(topics, self.verb.name(), &self.transaction, status, data, error)
    }

    pub fn refusal(&self, topics: &Topics, error: &str) -> Message {
        self.answer(topics, Status::Error, Json::Null, Some(error))
    }
}

fn answer(
    topics: &Topics,
    verb: &str,
    transaction: &Transaction,
    status: Status,
    data: Json,
    error: Option<&str>,
) -> Message {
    #[derive(Serialize)]
    struct Answer<'a> {
        transaction: &'a Transaction,
        status: &'a str,
        data: Json,
        error: Option<&'a str>,
    }
    let status = match status {
        Status::Ok => "ok",
        Status::Error => "error",
        Status::Progress => "progress",
    };
    let payload = serde_json::to_string(&Answer { transaction, status, data, error });
    Message::once(topics.response(verb), payload.expect("texts are its only keys"))
}
