//! How a request on a serial line ends: what it is told, and what is learnt from everything that was heard.

use super::{Found, Guard, SILENCE, State, Waiting};
use crate::engine::modbus::rtu_bytes::{Sorted, Unanswered, expected_length, late_reply, sort};
use crate::engine::modbus::{Answer, Discarded, LateReply, Reply, RequestError, RequestsOfOthers};
use crate::engine::time::{Duration, Time};

/// As many bytes without any frame are a damaged reply rather than noise.
const DAMAGED_MIN: u32 = 4;

impl Guard {
    pub(super) fn replied(&mut self, waiting: Waiting, found: Found) -> Reply {
        if self.has_collided(&waiting, found.start) {
            self.collided(waiting)
        } else {
            self.answered(waiting, found)
        }
    }

    fn answered(&mut self, waiting: Waiting, found: Found) -> Reply {
        let sorted =
            sort(&self.heard[..found.start], &self.frame, Some(&waiting.request), self.overdue.requests());
        let too_late_for_an_echo = self.heard_at[found.end - 1] > waiting.transmitted_at + SILENCE;
        if sorted.discarded.echoes > 0 {
            self.echo.came();
        } else if !self.reply_looks_like_echo(&waiting) || too_late_for_an_echo {
            self.echo.never_comes();
        }
        self.count(&sorted);
        // Units answer in order: no request gets a reply any more that is older than the one answered.
        // That may be an earlier write of the same; then this one still has its reply to come.
        let bytes = &self.heard[found.start..found.end];
        let earlier = late_reply(bytes, self.overdue.requests(), &sorted.late).map(|(index, _)| index);
        let earlier = earlier.filter(|_| found.result == Ok(Answer::Written));
        self.overdue.settle_unit(waiting.request.unit, earlier, &sorted.late);
        if earlier.is_some() {
            self.remember(&waiting, self.heard_at[found.end - 1]);
        }
        let times = (self.heard_at[found.start], self.heard_at[found.end - 1]);
        self.clear(found.end);
        self.state = State::Idle;
        Reply::new(found.result, waiting.sent_at, Some(times), &mut self.discarded)
    }

    /// A broadcast has had its time.
    pub(super) fn obeyed(&mut self, waiting: Waiting) -> Reply {
        if self.has_collided(&waiting, self.heard.len()) {
            return self.collided(waiting);
        }
        let sent_at = waiting.sent_at;
        let sorted = sort(&self.heard, &self.frame, None, self.overdue.requests());
        // Nobody replies, so a copy of the request can only be an echo.
        match sorted.discarded.echoes {
            0 => self.echo.never_comes(),
            _ => self.echo.came(),
        }
        self.account(&sorted);
        self.clear(self.heard.len());
        self.state = State::Idle;
        Reply::new(Ok(Answer::Written), sent_at, None, &mut self.discarded)
    }

    /// Our request was damaged on the line, and what was heard besides may be anybody's. What may still
    /// come is waited for as after a timeout.
    pub(super) fn collided(&mut self, waiting: Waiting) -> Reply {
        let sorted = sort(&self.heard, &self.frame, Some(&waiting.request), self.overdue.requests());
        // What remained of our request is neither noise nor a damaged reply.
        let discarded = Discarded { noise_bytes: 0, checksum_errors: 0, ..sorted.discarded };
        self.account(&Sorted { discarded, ..sorted });
        self.echo.missed();
        self.await_reply(&waiting);
        self.clear(self.heard.len());
        self.state = State::Idle;
        Reply::new(Err(RequestError::Collision), waiting.sent_at, None, &mut self.discarded)
    }

    /// The error that can be told before the deadline: a reply came, but damaged.
    pub(super) fn damaged_reply(&mut self, waiting: &Waiting) -> Option<Reply> {
        let sorted = sort(&self.heard, &self.frame, Some(&waiting.request), self.overdue.requests());
        let expected = expected_length(&waiting.request.call);
        let alone = sorted.discarded.noise_bytes as usize == self.heard.len();
        let looks_damaged = sorted.damaged > 0 || (alone && Some(self.heard.len()) == expected);
        // A damaged echo begins like a damaged reply.
        let echo_possible = self.echo.is_possible() && sorted.discarded.echoes == 0;
        if !looks_damaged || (echo_possible && sorted.damaged <= self.frame.len()) {
            return None;
        }
        // The reply may have been something else that only looked like it, unless it was all there.
        if Some(sorted.damaged) != expected || echo_possible {
            self.await_reply(waiting);
        }
        Some(self.failed(waiting.clone(), true))
    }

    /// The deadline has passed.
    pub(super) fn unanswered(&mut self, now: Time, waiting: Waiting) -> Reply {
        let reply = self.failed(waiting.clone(), false);
        let unit = waiting.request.unit;
        let quarantine = match (waiting.request.is_probe, waiting.request.may_take) {
            // Others are asked meanwhile: a late reply is known by its unit.
            (_, Some(full)) => {
                self.overdue.let_rest(unit, waiting.transmitted_at + full * 2);
                Duration::ZERO
            }
            (true, None) => self.overdue.quarantine_after_probe(unit, waiting.timeout),
            (false, None) => self.quarantine.unwrap_or(waiting.timeout),
        };
        self.quarantine_until = Some(now + quarantine);
        self.remember(&waiting, now);
        reply
    }

    /// Ends a request without an answer, with the error that what was heard amounts to.
    fn failed(&mut self, waiting: Waiting, damaged: bool) -> Reply {
        let mut sorted = sort(&self.heard, &self.frame, Some(&waiting.request), self.overdue.requests());
        let heard = &mut sorted.discarded;
        if heard.checksum_errors == 0
            && (damaged || heard.noise_bytes >= DAMAGED_MIN && heard.foreign_frames == 0)
        {
            heard.checksum_errors = 1;
            heard.noise_bytes = 0;
        }
        let error = if heard.checksum_errors > 0 {
            RequestError::Checksum
        } else if heard.foreign_frames > 0 {
            RequestError::WrongFrame
        } else {
            RequestError::Timeout
        };
        if heard.echoes > 0 && !self.reply_looks_like_echo(&waiting) {
            self.echo.came();
        }
        if heard.echoes == 0 && self.echo.is_certain() {
            self.echo.missed();
        }
        self.account(&sorted);
        let first = self.heard_at.first().copied();
        let last = self.heard_at.last().copied();
        self.clear(self.heard.len());
        self.state = State::Idle;
        Reply::new(Err(error), waiting.sent_at, first.zip(last), &mut self.discarded)
    }

    pub(super) fn impossible(&mut self, now: Time, reason: &'static str) -> Reply {
        Reply::new(Err(RequestError::Impossible(reason)), now, None, &mut self.discarded)
    }

    /// What was heard ended the request before its time: until then its reply may come.
    fn await_reply(&mut self, waiting: &Waiting) {
        self.quarantine_until = Some(waiting.deadline);
        if let Some(full) = waiting.request.may_take {
            self.overdue.let_rest(waiting.request.unit, waiting.transmitted_at + full);
        }
        self.remember(waiting, self.heard_at.last().copied().unwrap_or(waiting.deadline));
    }

    fn remember(&mut self, waiting: &Waiting, at: Time) {
        let transmitted_at = waiting.transmitted_at;
        let due = transmitted_at + waiting.request.may_take.unwrap_or(waiting.timeout);
        self.overdue.remember(Unanswered { request: waiting.request.clone(), transmitted_at, due, at });
    }

    /// Counts and drops the first `count` bytes, which answer nothing that is asked now.
    pub(super) fn drop_strays(&mut self, count: usize) {
        let sorted = sort(&self.heard[..count], &[], None, self.overdue.requests());
        self.account(&sorted);
        self.clear(count);
    }

    /// Counts what was heard beside an answer. Those whose late replies are in it owe nothing more.
    fn account(&mut self, sorted: &Sorted) {
        self.count(sorted);
        self.overdue.settle(&sorted.late);
    }

    /// Before anything of it is forgotten.
    fn count(&mut self, sorted: &Sorted) {
        let more = sorted.discarded;
        let sum = &mut self.discarded;
        for (index, end) in sorted.late.iter().zip(&sorted.late_ends) {
            let late = &self.overdue.requests()[*index];
            let after = self.heard_at[end - 1].since(late.transmitted_at);
            sum.late = Some(LateReply { unit: late.request.unit, after });
        }
        sum.noise_bytes += more.noise_bytes;
        sum.late_replies += more.late_replies;
        sum.foreign_frames += more.foreign_frames;
        sum.echoes += more.echoes;
        sum.checksum_errors += more.checksum_errors;
        let others = more.requests_of_others;
        if others.count > 0 {
            let count = sum.requests_of_others.count + others.count;
            sum.requests_of_others = RequestsOfOthers { count, ..others };
        }
    }

    pub(super) fn clear(&mut self, count: usize) {
        self.heard.drain(..count);
        self.heard_at.drain(..count);
    }
}
