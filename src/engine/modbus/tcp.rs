//! Modbus TCP: each reply carries the number of its request, so a late one is known as such, and
//! the reading goes on behind it. Sections are of Modbus messaging on TCP/IP V1.0b.

use std::collections::VecDeque;

use crate::engine::modbus::pdu;
use crate::engine::modbus::{Discarded, LateReply, Reply, Request, RequestError};
use crate::engine::time::{Duration, Time};

/// Transaction, protocol, length and unit (3.1.3).
const HEADER: usize = 7;
/// So many unanswered requests are remembered, to know their replies when they come late.
const UNANSWERED_MAX: usize = 32;

/// One connection; used like [`crate::engine::modbus::rtu::Guard`]. A reply with
/// [`RequestError::Link`] says that the connection is of no use any more.
#[derive(Debug, Default)]
pub struct Guard {
    transaction: u16,
    frame: Vec<u8>,
    state: State,
    heard: Vec<u8>,
    /// Why the stream cannot be read any further.
    broken: Option<&'static str>,
    unanswered: VecDeque<Unanswered>,
    discarded: Discarded,
}

#[derive(Debug)]
struct Unanswered {
    transaction: u16,
    unit: u8,
    sent_at: Time,
}

#[derive(Debug, Default)]
enum State {
    #[default]
    Idle,
    Begun {
        request: Request,
        timeout: Duration,
    },
    Waiting {
        request: Request,
        sent_at: Time,
        first_byte_at: Option<Time>,
        deadline: Time,
    },
}

impl Guard {
    pub fn new() -> Guard {
        Guard::default()
    }

    pub fn begin(&mut self, now: Time, request: &Request, timeout: Duration) -> Option<Reply> {
        if let Some(reason) = self.broken {
            return Some(Reply::new(Err(RequestError::Link(reason.into())), now, None, &mut self.discarded));
        }
        let pdu = match pdu::encode(&request.call) {
            Ok(pdu) => pdu,
            Err(reason) => {
                return Some(Reply::new(
                    Err(RequestError::Impossible(reason)),
                    now,
                    None,
                    &mut self.discarded,
                ));
            }
        };
        self.transaction = self.transaction.wrapping_add(1);
        self.frame.clear();
        self.frame.extend(self.transaction.to_be_bytes());
        self.frame.extend([0, 0]);
        self.frame.extend((pdu.len() as u16 + 1).to_be_bytes());
        self.frame.push(request.unit);
        self.frame.extend(pdu);
        self.state = State::Begun { request: request.clone(), timeout };
        None
    }

    pub fn earliest_send(&self, now: Time) -> Time {
        now
    }

    pub fn frame(&self) -> &[u8] {
        &self.frame
    }

    pub fn sent(&mut self, now: Time) {
        if let State::Begun { request, timeout } = std::mem::take(&mut self.state) {
            self.state =
                State::Waiting { request, sent_at: now, first_byte_at: None, deadline: now + timeout };
        }
    }

    pub fn received(&mut self, now: Time, bytes: &[u8]) -> Option<Reply> {
        self.heard.extend_from_slice(bytes);
        if let State::Waiting { first_byte_at: first @ None, .. } = &mut self.state {
            *first = Some(now);
        }
        let mut heard = std::mem::take(&mut self.heard);
        let (mut taken, mut reply) = (0, None);
        while self.broken.is_none() && reply.is_none() {
            match frame_length(&heard[taken..]) {
                Ok(Some(length)) => {
                    reply = self.frame_came(now, &heard[taken..taken + length]);
                    taken += length;
                }
                Ok(None) => break,
                Err(reason) => {
                    self.broken = Some(reason);
                    taken = heard.len();
                }
            }
        }
        heard.drain(..taken);
        self.heard = heard;
        match (self.broken, &self.state) {
            (Some(reason), State::Waiting { .. }) => self.link_lost(now, reason),
            _ => reply,
        }
    }

    pub fn wake_at(&self) -> Option<Time> {
        match &self.state {
            State::Waiting { deadline, .. } => Some(*deadline),
            _ => None,
        }
    }

    pub fn wake(&mut self, now: Time) -> Option<Reply> {
        let State::Waiting { request, sent_at, deadline, .. } = &self.state else { return None };
        let (unit, sent_at) = (request.unit, *sent_at);
        if now < *deadline {
            return None;
        }
        self.state = State::Idle;
        if self.unanswered.len() == UNANSWERED_MAX {
            self.unanswered.pop_front();
        }
        self.unanswered.push_back(Unanswered { transaction: self.transaction, unit, sent_at });
        Some(Reply::new(Err(RequestError::Timeout), sent_at, None, &mut self.discarded))
    }

    pub fn link_lost(&mut self, now: Time, reason: &str) -> Option<Reply> {
        let state = std::mem::take(&mut self.state);
        self.heard.clear();
        self.unanswered.clear();
        self.broken = None;
        let sent_at = match state {
            State::Idle => return None,
            State::Begun { .. } => now,
            State::Waiting { sent_at, .. } => sent_at,
        };
        Some(Reply::new(Err(RequestError::Link(reason.to_owned())), sent_at, None, &mut self.discarded))
    }

    fn frame_came(&mut self, now: Time, frame: &[u8]) -> Option<Reply> {
        let transaction = u16::from_be_bytes([frame[0], frame[1]]);
        let waiting = match &self.state {
            State::Waiting { request, sent_at, first_byte_at, .. } if transaction == self.transaction => {
                Some((request, *sent_at, first_byte_at.unwrap_or(now)))
            }
            _ => None,
        };
        let Some((request, sent_at, first_byte_at)) = waiting else {
            let index = self.unanswered.iter().position(|late| late.transaction == transaction);
            match index.and_then(|index| self.unanswered.remove(index)) {
                Some(Unanswered { unit, sent_at, .. }) => {
                    self.discarded.late_replies += 1;
                    self.discarded.late = Some(LateReply { unit, after: now - sent_at });
                }
                None => self.discarded.foreign_frames += 1,
            }
            return None;
        };
        let result = match frame[HEADER - 1] == request.unit {
            true => pdu::decode(&request.call, request.any_exception, &frame[HEADER..]),
            false => Err(RequestError::WrongFrame),
        };
        self.discarded.foreign_frames += u32::from(result == Err(RequestError::WrongFrame));
        self.state = State::Idle;
        Some(Reply::new(result, sent_at, Some((first_byte_at, now)), &mut self.discarded))
    }
}

/// How long the frame is that these bytes begin with, where it is whole; or why there will be none.
fn frame_length(heard: &[u8]) -> Result<Option<usize>, &'static str> {
    let [_, _, protocol_high, protocol_low, high, low, ..] = *heard else { return Ok(None) };
    let length = usize::from(u16::from_be_bytes([high, low]));
    if [protocol_high, protocol_low] != [0, 0] || !(2..=pdu::LENGTH_MAX + 1).contains(&length) {
        return Err("the other side does not speak Modbus TCP");
    }
    let whole = HEADER - 1 + length;
    match heard.get(whole..) {
        None => Ok(None),
        Some(behind) if !may_begin_a_frame(behind) => Err("a frame is not as long as its header says"),
        Some(_) => Ok(Some(whole)),
    }
}

/// Whether these bytes, which came behind a frame, can be the beginning of another. If not, the frame was
/// shorter than its header says, and the other's first bytes have been taken for its last ones: on a
/// stream without checksums that would become a value.
fn may_begin_a_frame(bytes: &[u8]) -> bool {
    let protocol = bytes.iter().skip(2).take(2);
    protocol.copied().all(|byte| byte == 0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::address::{Span, Table};
    use crate::engine::modbus::{Answer, Call};

    const TIMEOUT: Duration = Duration::from_millis(200);

    fn two_inputs() -> Request {
        Request::new(1, Call::Read(Span::with_count(Table::Input, 0, 2).expect("a span")))
    }

    /// A frame with this transaction and unit.
    fn frame(transaction: u16, unit: u8, pdu: &[u8]) -> Vec<u8> {
        let length = pdu.len() as u16 + 1;
        [&transaction.to_be_bytes()[..], &[0, 0], &length.to_be_bytes(), &[unit], pdu].concat()
    }

    /// A connection with request number 1 on its way.
    fn asked() -> Guard {
        let mut guard = Guard::new();
        assert_eq!(guard.begin(Time(0), &two_inputs(), TIMEOUT), None);
        assert_eq!(guard.frame(), frame(1, 1, &[4, 0, 0, 0, 2]));
        guard.sent(Time(0));
        guard
    }

    const GOOD: [u8; 6] = [4, 4, 0, 1, 0, 2];

    #[test]
    fn whatever_comes_only_the_answer_is_taken_and_the_rest_is_counted_as_what_it_was() {
        let answer = Ok(Answer::Words(vec![1, 2]));
        let wrong = Err(RequestError::WrongFrame);
        let broken = Err(RequestError::Link("the other side does not speak Modbus TCP".into()));
        let http = b"HTTP/1.1 400 Bad Request".to_vec();
        for (what, bytes, result, foreign) in [
            ("the answer", frame(1, 1, &GOOD), answer.clone(), 0),
            ("an exception", frame(1, 1, &[0x84, 2]), Err(RequestError::Exception(2)), 0),
            ("a gateway's exception", frame(1, 1, &[0x84, 11]), Err(RequestError::Unreachable(11)), 0),
            ("another's first", [frame(77, 1, &GOOD), frame(1, 1, &GOOD)].concat(), answer, 1),
            ("only another's", frame(77, 1, &GOOD), Err(RequestError::Timeout), 1),
            ("another unit", frame(1, 2, &GOOD), wrong.clone(), 1),
            ("another count", frame(1, 1, &[4, 2, 0, 1]), wrong.clone(), 1),
            ("another function", frame(1, 1, &[3, 4, 0, 1, 0, 2]), wrong, 1),
            ("another protocol", http, broken, 0),
            ("half an answer", frame(1, 1, &GOOD)[..9].to_vec(), Err(RequestError::Timeout), 0),
        ] {
            let mut whole = asked();
            let reply = whole.received(Time(5), &bytes).or_else(|| whole.wake(Time(200_000)));
            let reply = reply.expect("a reply at the deadline at the latest");
            assert_eq!(reply.result, result, "{what}");
            assert_eq!(
                reply.discarded,
                Discarded { foreign_frames: foreign, ..Default::default() },
                "{what}"
            );

            let mut single = asked();
            let reply = bytes.iter().find_map(|byte| single.received(Time(5), &[*byte]));
            let reply = reply.or_else(|| single.wake(Time(200_000))).expect("a reply at the deadline");
            assert_eq!(reply.result, result, "{what}, in single bytes");
        }
    }

    #[test]
    fn a_late_reply_is_dropped_before_and_after_the_next_request() {
        for after in [false, true] {
            let mut guard = asked();
            assert_eq!(guard.wake_at(), Some(Time(200_000)));
            assert_eq!(guard.wake(Time(199_999)), None);
            let reply = guard.wake(Time(200_000)).expect("the deadline has passed");
            assert_eq!(reply.result, Err(RequestError::Timeout));
            if !after {
                assert_eq!(guard.received(Time(200_001), &frame(1, 1, &[4, 4, 9, 9, 9, 9])), None);
            }
            assert_eq!(guard.begin(Time(200_002), &two_inputs(), TIMEOUT), None);
            guard.sent(Time(200_002));
            if after {
                assert_eq!(guard.received(Time(200_003), &frame(1, 1, &[4, 4, 9, 9, 9, 9])), None);
            }
            let reply = guard.received(Time(200_009), &frame(2, 1, &GOOD)).expect("the answer");
            assert_eq!(reply.result, Ok(Answer::Words(vec![1, 2])));
            let late = Some(LateReply {
                unit: 1,
                after: Duration::from_micros(if after { 200_003 } else { 200_001 }),
            });
            assert_eq!(reply.discarded, Discarded { late_replies: 1, late, ..Default::default() });
        }
    }

    #[test]
    fn the_beginning_of_another_frame_does_not_complete_one_that_is_too_short() {
        let short = &frame(1, 1, &GOOD)[..11];
        let late = frame(484, 3, &GOOD);
        for pieces in [vec![[short, &late].concat()], vec![short.to_vec(), late.clone()]] {
            let mut guard = asked();
            let reply = pieces.iter().find_map(|piece| guard.received(Time(5), piece));
            let reason = "a frame is not as long as its header says";
            assert_eq!(reply.expect("it is noticed").result, Err(RequestError::Link(reason.into())));
        }
        // Where the other one comes whole, nothing is wrong.
        let mut guard = asked();
        let reply = guard.received(Time(5), &[frame(1, 1, &GOOD), late].concat());
        assert_eq!(reply.expect("the answer").result, Ok(Answer::Words(vec![1, 2])));
    }

    #[test]
    fn a_stream_that_lost_its_frames_is_told_at_the_next_request_and_healed_by_a_new_connection() {
        let mut guard = Guard::new();
        assert_eq!(guard.received(Time(0), b"GET / HTTP"), None);
        let reply = guard.begin(Time(1), &two_inputs(), TIMEOUT).expect("it cannot be asked");
        assert!(matches!(reply.result, Err(RequestError::Link(_))));
        assert_eq!(guard.link_lost(Time(2), "closed"), None);
        assert_eq!(guard.begin(Time(3), &two_inputs(), TIMEOUT), None);
        let reply = guard.link_lost(Time(4), "closed").expect("a request had begun");
        assert_eq!(reply.result, Err(RequestError::Link("closed".into())));
    }

    proptest::proptest! {
        #[test]
        fn no_bytes_make_it_stumble(bytes in proptest::collection::vec(0u8..9, 0..600)) {
            let mut guard = asked();
            guard.received(Time(1), &bytes);
            assert!(guard.heard.len() <= 6 + 254);
        }
    }
}
