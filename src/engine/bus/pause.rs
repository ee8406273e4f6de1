//! A pause: the bus closes its port, so that a maker's own tool can use it, and opens it again by
//! itself.

use serde_json::json;

use crate::engine::request::{Request, Status, Wish};
use crate::engine::time::{Date, Duration};

use super::{Action, Bus, LinkState, Severity};

impl Bus {
    /// Somebody wants the port for so long; no time at all ends a pause.
    pub(super) fn pause(&mut self, request: Request, time: Duration) {
        if let Some(earlier) = self.requests.pause.take() {
            self.refuse(&earlier, "another pause took its place");
        }
        if !time.is_zero() {
            // It begins as soon as nothing is in flight.
            self.requests.pause = Some(request);
            return;
        }
        if let LinkState::Paused { .. } = self.link_state {
            self.context.say(Severity::Info, format!("bus {}: the pause is ended", self.name));
            self.link_state = LinkState::Down { reason: None, attempts: 0 };
            self.context.actions.push_back(Action::Reopen { after: Duration::ZERO });
        }
        self.tell(&request, Status::Ok, json!({"bus": self.name, "paused_until": null}), None);
    }

    /// Begins a pause that is wanted, if nothing is on the wire. Whether one is wanted: then nothing
    /// else begins.
    pub(super) fn begin_pause(&mut self) -> bool {
        if self.requests.pause.is_none() {
            return false;
        }
        // A command that has begun is finished first, as far as the wire is concerned.
        if self.in_flight.is_some() {
            return true;
        }
        let Some(request) = self.requests.pause.take() else { return true };
        let (time, until) = match request.wish {
            Wish::Pause { time, until } => (time, until),
            _ => (Duration::ZERO, Date::default()),
        };
        let reason = format!("paused until {until}");
        self.context.say(Severity::Info, format!("bus {}: {reason}", self.name));
        self.record_note(&reason);
        self.leave_link(&reason);
        self.link_state = LinkState::Paused { reason };
        self.context.actions.push_back(Action::Reopen { after: time });
        let data = json!({"bus": self.name, "paused_until": until.to_string()});
        self.tell(&request, Status::Ok, data, None);
        true
    }
}
