//! The guard of a serial line: an automaton fed with bytes and times that takes no reply for
//! another's, although RTU frames carry nothing that says which request they answer.
//!
//! * Only a whole frame with a right checksum is an answer, and only if unit, function and count
//!   (or the returned address and value) are those asked for. It is found at any place, so noise
//!   before and after it does no harm. Everything else is counted and the wait goes on.
//! * After a request without an answer the line stays silent for a quarantine, in which a late
//!   reply is dropped. It ends early when that reply comes. After a probe of a silent device it lasts
//!   as long as that device's replies have come late before: for most not at all.
//! * A unit that is known to be quick is waited for less. When its answer does not come, that unit alone is
//!   left in peace for as long as its reply might be late after a full wait; others are asked meanwhile, since
//!   a late reply says whose it is.
//! * A unit that has been heard to answer late is waited for longer, within bounds: a timeout that is too
//!   short makes itself known, and does no harm.
//! * A reply later than the quarantine may meet the next request. If it differs in unit, function
//!   or count it is told apart. If it does not, a reply to such a request is believed at once only
//!   behind as many others as there are late ones to come, and at the deadline only if nothing else
//!   came from that unit. The limit: a device that answers neither in its time nor in the quarantine,
//!   but while a later request of the same shape waits, and leaves that one unanswered, cannot be told
//!   from a good one.
//! * Some adapters return our own bytes. Such an echo is skipped and remembered: the replies to
//!   functions 5, 6 and 8 look like it.
//! * Where the line is known to do so, what comes back must be what was sent. If it is not, another spoke
//!   at the same time: no reply to that request is believed, it may be the other's.

mod echo;
mod ending;
mod overdue;

use crate::engine::modbus::pdu;
use crate::engine::modbus::rtu_bytes::{Beginning, beginning, expected_length, frame, late_reply, sort};
use crate::engine::modbus::{Answer, Discarded, Reply, Request, RequestError};
use crate::engine::settings::Line;
use crate::engine::time::{Duration, Time};

use echo::Echo;
use overdue::Overdue;

/// A silence that ends a damaged frame of full length. Adapters hand bytes over late: the FTDI
/// latency timer is 16 ms.
const SILENCE: Duration = Duration::from_millis(20);
/// A silence that ends a frame of which a part is missing: adapters and serial servers under load
/// pass frames on in pieces.
const SILENCE_INSIDE_A_FRAME: Duration = Duration::from_millis(100);
/// How long a broadcast is given to be obeyed (Modbus over serial line V1.02, 2.4.1: 100 to 200 ms).
const TURNAROUND: Duration = Duration::from_millis(100);
/// A line that is never silent is spoken on after this, or it would be lost for good.
const PATIENCE: Duration = Duration::from_secs(1);
/// The longest frame (2.5.1.1).
const FRAME_MAX: u32 = 256;
/// What is heard beyond this without a frame in it is noise.
const HEARD_MAX: usize = 2048;

/// One serial line. For each request: [`Guard::begin`], wait for [`Guard::earliest_send`], send
/// [`Guard::frame`], [`Guard::sent`]; then whatever comes first of bytes and [`Guard::wake_at`],
/// until a reply is returned.
#[derive(Debug)]
pub struct Guard {
    line: Line,
    gap: Duration,
    /// From handing a frame over until its first bit: a transceiver is switched.
    delay_before_send: Duration,
    /// `None`: as long as the request's own timeout.
    quarantine: Option<Duration>,
    state: State,
    frame: Vec<u8>,
    heard: Vec<u8>,
    /// When each byte of `heard` came.
    heard_at: Vec<Time>,
    echo: Echo,
    /// When the last byte was on the wire, in either direction.
    busy_until: Option<Time>,
    quarantine_until: Option<Time>,
    overdue: Overdue,
    discarded: Discarded,
}

#[derive(Debug)]
enum State {
    Idle,
    Begun { request: Request, timeout: Duration, at: Time },
    Waiting(Waiting),
}

/// A request on its way.
#[derive(Clone, Debug)]
struct Waiting {
    request: Request,
    timeout: Duration,
    sent_at: Time,
    /// When its last byte has left.
    transmitted_at: Time,
    deadline: Time,
    /// How many bytes were there at the last look after a silence.
    looked_at: usize,
}

/// A reply's place in what was heard.
struct Found {
    start: usize,
    end: usize,
    result: Result<Answer, RequestError>,
}

impl Guard {
    /// `gap`: silence before each request, `None`: the line's own; never less than the last byte's stop bits
    /// take. `quarantine`: how long the line
    /// stays silent after a request timed out, `None`: as long as that request's timeout.
    pub fn new(line: Line, gap: Option<Duration>, quarantine: Option<Duration>) -> Guard {
        Guard {
            line,
            gap: whole_micros(gap.unwrap_or_else(|| line.frame_gap()).max(line.stop())),
            delay_before_send: Duration::ZERO,
            quarantine,
            state: State::Idle,
            frame: Vec::new(),
            heard: Vec::new(),
            heard_at: Vec::new(),
            echo: Echo::default(),
            busy_until: None,
            quarantine_until: None,
            overdue: Overdue::default(),
            discarded: Discarded::default(),
        }
    }

    /// The same line, on which a frame waits so long before its first bit.
    pub fn with_delay_before_send(self, delay_before_send: Duration) -> Guard {
        Guard { delay_before_send, ..self }
    }

    /// Takes the next request. A reply at once means that it cannot be asked on this line.
    pub fn begin(&mut self, now: Time, request: &Request, timeout: Duration) -> Option<Reply> {
        if request.unit == 0 && !request.call.is_write() {
            return Some(self.impossible(now, "nobody answers to a broadcast, so it can only write"));
        }
        match pdu::encode(&request.call) {
            Err(reason) => Some(self.impossible(now, reason)),
            Ok(pdu) => {
                self.frame = frame(request.unit, &pdu);
                self.overdue.give_up_old(now);
                self.state = State::Begun { request: request.clone(), timeout, at: now };
                None
            }
        }
    }

    /// When the frame may be sent: after the quarantine and the silent gap. Ask again after each
    /// byte that comes before.
    pub fn earliest_send(&self, now: Time) -> Time {
        let (begun, rests_until) = match &self.state {
            State::Begun { request, at, .. } => (*at, self.overdue.rests_until(request.unit)),
            _ => (now, None),
        };
        let quarantine = self.quarantine_until.max(rests_until).unwrap_or(begun);
        let silent = self.busy_until.map_or(begun, |busy| busy + self.gap);
        silent.min(begun.max(quarantine) + PATIENCE).max(quarantine)
    }

    /// The bytes to send.
    pub fn frame(&self) -> &[u8] {
        &self.frame
    }

    /// The frame was handed to the line at `now`.
    pub fn sent(&mut self, now: Time) {
        let State::Begun { request, timeout, .. } = std::mem::replace(&mut self.state, State::Idle) else {
            return;
        };
        self.drop_strays(self.heard.len());
        self.quarantine_until = None;
        self.overdue.has_rested(request.unit);
        let transmitted_at = now + self.delay_before_send + self.line.characters(self.frame.len() as u32);
        self.busy_until = Some(transmitted_at);
        let wait = if request.unit == 0 {
            TURNAROUND
        } else {
            timeout + self.overdue.more_time(request.unit, timeout)
        };
        let deadline = transmitted_at + wait;
        self.state = State::Waiting(Waiting {
            request,
            timeout,
            sent_at: now,
            transmitted_at,
            deadline,
            looked_at: 0,
        });
    }

    /// Bytes were read at `now`.
    pub fn received(&mut self, now: Time, bytes: &[u8]) -> Option<Reply> {
        self.heard.extend_from_slice(bytes);
        self.heard_at.resize(self.heard.len(), now);
        self.busy_until = Some(self.busy_until.map_or(now, |busy| busy.max(now)));
        if self.heard.len() > HEARD_MAX {
            self.drop_strays(self.heard.len() - HEARD_MAX / 2);
        }
        match &self.state {
            State::Waiting(waiting) if waiting.request.unit != 0 => {
                let waiting = waiting.clone();
                let found = self.trusted_reply(&waiting, false)?;
                Some(self.replied(waiting, found))
            }
            State::Waiting(_) => None,
            State::Idle | State::Begun { .. } => {
                self.notice_late_reply();
                None
            }
        }
    }

    /// When to call [`Guard::wake`].
    pub fn wake_at(&self) -> Option<Time> {
        let State::Waiting(waiting) = &self.state else { return None };
        if waiting.request.unit == 0 {
            return Some(waiting.deadline);
        }
        let deadline = self.deadline(waiting);
        match self.silent_at(waiting) {
            Some(silent) if self.heard.len() != waiting.looked_at => Some(silent.min(deadline)),
            _ => Some(deadline),
        }
    }

    /// Decides what only time can tell.
    pub fn wake(&mut self, now: Time) -> Option<Reply> {
        let State::Waiting(waiting) = &mut self.state else { return None };
        if waiting.request.unit == 0 {
            let waiting = waiting.clone();
            return (now >= waiting.deadline).then(|| self.obeyed(waiting));
        }
        let mut waiting = waiting.clone();
        if self.silent_at(&waiting).is_some_and(|silent| now >= silent) {
            waiting.looked_at = self.heard.len();
            self.state = State::Waiting(waiting.clone());
            if let Some(found) = self.trusted_reply(&waiting, true) {
                return Some(self.replied(waiting, found));
            }
            if self.has_collided(&waiting, self.heard.len()) {
                return Some(self.collided(waiting));
            }
            if let Some(reply) = self.damaged_reply(&waiting) {
                return Some(reply);
            }
        }
        if now < self.deadline(&waiting) {
            return None;
        }
        Some(match self.only_reply(&waiting) {
            Some(found) => self.replied(waiting, found),
            None if self.has_collided(&waiting, self.heard.len()) => self.collided(waiting),
            None => self.unanswered(now, waiting),
        })
    }

    /// The port or connection broke; what is known of the line is forgotten.
    pub fn link_lost(&mut self, now: Time, reason: &str) -> Option<Reply> {
        let state = std::mem::replace(&mut self.state, State::Idle);
        self.drop_strays(self.heard.len());
        self.overdue.give_up_all();
        self.quarantine_until = None;
        self.busy_until = None;
        self.echo.forget();
        let sent_at = match state {
            State::Idle => return None,
            State::Begun { .. } => now,
            State::Waiting(waiting) => waiting.sent_at,
        };
        Some(Reply::new(Err(RequestError::Link(reason.to_owned())), sent_at, None, &mut self.discarded))
    }

    /// The reply that can be delivered without waiting longer: units answer in order, so it comes
    /// behind as many others as earlier requests could still get.
    fn trusted_reply(&self, waiting: &Waiting, silent: bool) -> Option<Found> {
        let mut late = Vec::new();
        let mut start = 0;
        loop {
            let found = self.reply_from(waiting, start, silent)?;
            match late_reply(&self.heard[found.start..found.end], self.overdue.requests(), &late) {
                // A repeated write confirms the same either way.
                Some((index, _)) if found.result != Ok(Answer::Written) => late.push(index),
                _ => return Some(found),
            }
            start = found.end;
        }
    }

    /// The reply to believe when nothing more comes in time: one that could be late, but is the only
    /// one heard of its unit. Where there are more, they are late, and so may this one be.
    fn only_reply(&self, waiting: &Waiting) -> Option<Found> {
        let late = sort(&self.heard, &self.frame, None, self.overdue.requests()).late;
        let of_unit =
            late.iter().filter(|late| self.overdue.requests()[**late].request.unit == waiting.request.unit);
        if of_unit.count() > 1 { None } else { self.reply_from(waiting, 0, true) }
    }

    /// The first whole reply from `start` on. One that has begun earlier and may still become whole
    /// has the first word, until the line has fallen `silent`.
    fn reply_from(&self, waiting: &Waiting, start: usize, silent: bool) -> Option<Found> {
        let mut at = start;
        let mut echoes = 0;
        while at < self.heard.len() {
            let rest = &self.heard[at..];
            if rest.starts_with(&self.frame) && self.is_echo(waiting, at + self.frame.len() - 1, echoes) {
                echoes += 1;
                at += self.frame.len();
                continue;
            }
            match beginning(rest, &waiting.request) {
                Beginning::Reply(length, result) => {
                    return Some(Found { start: at, end: at + length, result });
                }
                Beginning::Open if !silent => return None,
                Beginning::Open | Beginning::Other => at += 1,
            }
        }
        None
    }

    /// Whether a copy of the request, complete with byte number `last`, is an echo and not the
    /// reply of a function that returns its request.
    fn is_echo(&self, waiting: &Waiting, last: usize, echoes: usize) -> bool {
        if !self.reply_looks_like_echo(waiting) {
            return true;
        }
        let too_late = self.heard_at[last] > waiting.transmitted_at + SILENCE;
        echoes == 0 && !too_late && self.echo.is_possible()
    }

    fn reply_looks_like_echo(&self, waiting: &Waiting) -> bool {
        matches!(beginning(&self.frame, &waiting.request), Beginning::Reply(length, _) if length == self.frame.len())
    }

    /// When the bytes heard are over, whole or not.
    fn silent_at(&self, waiting: &Waiting) -> Option<Time> {
        let whole = expected_length(&waiting.request.call).is_some_and(|length| self.heard.len() >= length);
        let silence = if whole { SILENCE } else { SILENCE_INSIDE_A_FRAME };
        self.heard_at.last().map(|last| *last + silence)
    }

    /// The request's deadline, put off while bytes flow, though not for ever.
    fn deadline(&self, waiting: &Waiting) -> Time {
        let latest = waiting.deadline + self.line.characters(FRAME_MAX) + SILENCE_INSIDE_A_FRAME;
        let silent = self.silent_at(waiting).unwrap_or(waiting.deadline);
        waiting.deadline.max(silent.min(latest))
    }

    /// Whether the first `count` bytes heard should hold our own request, and hold something else. Where
    /// nothing was heard, the line may no longer return what we send.
    fn has_collided(&self, waiting: &Waiting, count: usize) -> bool {
        let heard = &self.heard[..count];
        self.echo.is_certain()
            && !heard.is_empty()
            && sort(heard, &self.frame, Some(&waiting.request), self.overdue.requests()).discarded.echoes == 0
    }

    /// Between requests: a late reply ends the quarantine that waits for it.
    fn notice_late_reply(&mut self) {
        for at in 0..self.heard.len() {
            if let Some((index, length)) = late_reply(&self.heard[at..], self.overdue.requests(), &[]) {
                // The quarantine waits for the last one.
                if self.overdue.hears(index, self.heard_at[at + length - 1]) {
                    self.quarantine_until = None;
                }
                self.drop_strays(at + length);
                return;
            }
        }
    }
}

/// Rounded up to what [`Time`] can tell: a gap is never a microsecond short.
fn whole_micros(duration: Duration) -> Duration {
    Duration::from_micros(duration.as_nanos().div_ceil(1000) as u64)
}

#[cfg(test)]
mod tests;
