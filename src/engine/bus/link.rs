//! Whether the link is there, and how it is made anew.
//!
//! A port that is gone and a server that is not there are tried again, ever less often, and told once. A
//! connection that the other side closes is another matter: many devices close one that was idle for a
//! minute, and some close it behind each answer. It is made anew, and nobody need know.

use super::{Action, Bus, InFlight, LinkState, Purpose, Severity};
use crate::engine::modbus::{Answer, RequestError};
use crate::engine::settings::Link;
use crate::engine::time::{Duration, Time};

/// After so many requests in a row that nobody answers, a TCP connection is made anew; where only one device
/// is behind it, already when that one counts as offline, for then it is asked but seldom.
const UNANSWERED_UNTIL_RENEWED: u32 = 5;
const UNANSWERED_BY_THE_ONLY_ONE: u32 = 3;
/// And again after so many, if the new one is as mute.
const UNANSWERED_AGAIN: u32 = 2;
/// So often in a row a connection that is closed without an answer is made anew in silence, if there were
/// answers before.
const CLOSED_IN_SILENCE: u32 = 3;
/// After so many connections that were closed behind their first answer, each is closed by us before that.
const SINGLE_USES_UNTIL_KNOWN: u32 = 3;
/// A connection that is closed within this time was closed because of what happened last on it, and not
/// because it was idle.
const SOON: Duration = Duration::from_secs(1);
/// A link that breaks sooner, without one answer, has not really been there.
const STEADY: Duration = Duration::from_secs(10);
const PAUSE_SHORTEST: Duration = Duration::from_millis(500);
const PAUSE_LONGEST: Duration = Duration::from_secs(15);

/// How links of this bus have come and gone.
#[derive(Debug, Default)]
pub(super) struct Connection {
    up_at: Time,
    /// Answers since the link came up, or was made anew, and when the last one came.
    answers: u32,
    answered_at: Time,
    /// Has been answered since it came up, and not only since it was made anew.
    is_proven: bool,
    /// How often in a row it was closed by the other side without an answer.
    closed_in_silence: u32,
    /// How often in a row it was closed behind the first answer.
    single_uses: u32,
    /// How often in a row it came up and broke without an answer.
    breaks: u32,
    /// It was made anew because nobody answered, and nobody has answered since.
    is_renewed_for_silence: bool,
}

impl Connection {
    /// A device has answered.
    pub(super) fn answered(&mut self, now: Time) {
        self.answers = self.answers.saturating_add(1);
        self.answered_at = now;
        self.is_proven = true;
        self.closed_in_silence = 0;
        self.is_renewed_for_silence = false;
    }

    /// The other side wants one request on each connection.
    fn is_for_single_use(&self) -> bool {
        self.single_uses >= SINGLE_USES_UNTIL_KNOWN
    }
}

impl Bus {
    pub(super) fn link_up(&mut self) {
        let delays = self.devices.iter().map(|device| device.device().wire.connect_delay);
        self.silent_until = self.now + delays.max().unwrap_or_default();
        self.record_note("the link is up");
        (self.connection.up_at, self.connection.answers) = (self.now, 0);
        match std::mem::replace(&mut self.link_state, LinkState::Up) {
            // The devices are as silent as they were, and are asked as seldom.
            LinkState::Renewing => return,
            LinkState::Down { attempts, .. } if attempts > 0 && self.connection.breaks == 0 => {
                self.context.say(Severity::Info, format!("bus {}: the link is back", self.name));
            }
            LinkState::Paused { .. } => {
                self.context.say(Severity::Info, format!("bus {}: the pause is over", self.name));
            }
            LinkState::Down { .. } | LinkState::Up => {}
        }
        // All have waited for it. Not for one connection after the other, as a server makes them that closes each behind
        // its answer: they come also where reads are due all the time.
        self.pace.idle(self.now);
        self.connection.is_proven = false;
        for device in &mut self.devices {
            device.reconnect(self.now);
        }
    }

    pub(super) fn link_down(&mut self, reason: String) {
        if self.was_only_closed() {
            return self.go_on_with_another(reason);
        }
        let attempts = match &self.link_state {
            LinkState::Up => self.broken(),
            LinkState::Renewing | LinkState::Paused { .. } => 0,
            LinkState::Down { attempts, .. } => *attempts,
        };
        if attempts == 0 {
            let text = format!("the link is down: {reason}");
            self.context.say(Severity::Warning, format!("bus {}: {text}", self.name));
            self.record_note(&text);
            if self.in_flight.is_some() {
                self.record_trouble(&text);
            }
        }
        self.link_state = LinkState::Down { reason: Some(reason.clone()), attempts: attempts + 1 };
        self.count_lost();
        if let Some(in_flight) = self.in_flight.take() {
            self.request_ended(in_flight, Err(RequestError::Link(reason.clone())));
        }
        self.leave_link(&format!("the link is down: {reason}"));
        let after = PAUSE_SHORTEST * (1 << attempts.min(6));
        self.context.actions.push_back(Action::Reopen { after: after.min(PAUSE_LONGEST) });
    }

    /// How often it has come up and broken at once before: then this is no news.
    fn broken(&mut self) -> u32 {
        let connection = &mut self.connection;
        let is_steady = connection.is_proven || self.now - connection.up_at >= STEADY;
        connection.breaks = if is_steady { 0 } else { connection.breaks + 1 };
        connection.breaks.saturating_sub(1)
    }

    /// Whether the other side has closed a connection on which there were answers.
    fn was_only_closed(&self) -> bool {
        let connection = &self.connection;
        self.is_connection()
            && self.link_state == LinkState::Up
            && connection.is_proven
            && connection.closed_in_silence < CLOSED_IN_SILENCE
    }

    /// Connects again at once. A request that was under way has failed, unless the connection was closed behind
    /// an answer, so that nobody can have heard it; everything else goes on.
    fn go_on_with_another(&mut self, reason: String) {
        let connection = &mut self.connection;
        let was_asked = self.in_flight.is_some() || self.now - connection.up_at < SOON;
        let was_closed_behind_answer = connection.answers > 0 && self.now - connection.answered_at < SOON;
        match connection.answers {
            0 if was_asked => connection.closed_in_silence += 1,
            1 if was_closed_behind_answer => connection.single_uses += 1,
            0 => {}
            _ => connection.single_uses = 0,
        }
        let is_known_now = connection.single_uses == SINGLE_USES_UNTIL_KNOWN;
        self.record_note(&format!("connecting anew: {reason}"));
        if is_known_now {
            let text = "the other side closes each connection behind its first answer; from now on one is made \
                        for each request";
            self.context.say(Severity::Info, format!("bus {}: {text}", self.name));
        }
        self.renew();
        self.count_lost();
        let is_poll = |in_flight: &InFlight| matches!(in_flight.purpose, Purpose::Poll { .. });
        if was_closed_behind_answer && self.in_flight.as_ref().is_some_and(is_poll) {
            self.withdrawn();
        }
        if let Some(in_flight) = self.in_flight.take() {
            self.request_ended(in_flight, Err(RequestError::Link(reason)));
        }
    }

    /// The link has ended, perhaps under a request. Where that had been sent, it was one.
    fn count_lost(&mut self) {
        let Some(in_flight) = self.in_flight.as_ref().filter(|in_flight| self.now > in_flight.sent_at) else {
            return;
        };
        self.counters.requests += 1;
        if let Some(device) = in_flight.device {
            self.devices[device].count_lost();
        }
    }

    /// After a request: a connection that is good for one is not used for a second one, which nobody would hear. Also
    /// where the first had no answer: the other side may close it at any moment, and the second would be lost for the
    /// sake of a device that is silent.
    pub(super) fn renew_used_connection(&mut self, result: &Result<Answer, RequestError>) {
        let was_used = !matches!(result, Err(RequestError::Link(_) | RequestError::Impossible(_)));
        if was_used && self.connection.is_for_single_use() && self.link_state == LinkState::Up {
            self.renew();
        }
    }

    /// A serial server may accept a connection and never pass anything on; only a new one helps. A
    /// serial port has no such state.
    pub(super) fn renew_silent_connection(&mut self) {
        if !self.is_connection() || self.link_state != LinkState::Up {
            return;
        }
        let connection = &self.connection;
        let most = match self.devices.len() {
            _ if connection.is_renewed_for_silence => UNANSWERED_AGAIN,
            1 => UNANSWERED_BY_THE_ONLY_ONE,
            _ => UNANSWERED_UNTIL_RENEWED,
        };
        if self.unanswered >= most {
            self.unanswered = 0;
            self.renew();
            self.connection.is_renewed_for_silence = true;
        }
    }

    fn renew(&mut self) {
        self.link_state = LinkState::Renewing;
        self.context.actions.push_back(Action::Reopen { after: Duration::ZERO });
    }

    fn is_connection(&self) -> bool {
        !matches!(self.link, Link::Serial { .. })
    }

    /// Nothing more can be asked, and why.
    pub(super) fn leave_link(&mut self, reason: &str) {
        self.beat = None;
        self.fetches.clear();
        self.break_requests(reason);
        self.end_settling(reason);
        for device in &mut self.devices {
            device.lose(self.now, reason, &mut self.context);
        }
    }
}
