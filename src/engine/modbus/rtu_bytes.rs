//! What lies in the bytes of a serial line: frames with a right checksum, found at any place, and
//! what remains when they are taken out.

use crate::engine::modbus::crc::crc;
use crate::engine::modbus::pdu::{self, Length};
use crate::engine::modbus::{Answer, Call, Discarded, Request, RequestError};
use crate::engine::time::Time;

/// Unit, function and checksum: no frame is shorter.
const FRAME_MIN: usize = 4;

/// The frame of a request: unit, protocol data unit, checksum.
pub fn frame(unit: u8, pdu: &[u8]) -> Vec<u8> {
    let mut frame = vec![unit];
    frame.extend(pdu);
    frame.extend(crc(&frame).to_le_bytes());
    frame
}

/// A request that nobody answered yet.
#[derive(Clone, Debug)]
pub struct Unanswered {
    pub request: Request,
    /// When its last byte had left.
    pub transmitted_at: Time,
    /// When its answer should have come.
    pub due: Time,
    /// When it was given up.
    pub at: Time,
}

/// What the beginning of some bytes is to a request that waits for its reply.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Beginning {
    /// A whole reply of this many bytes, checksum included.
    Reply(usize, Result<Answer, RequestError>),
    /// It may become a reply.
    Open,
    Other,
}

/// Looks for the reply to `request` at the very beginning of `bytes`.
pub fn beginning(bytes: &[u8], request: &Request) -> Beginning {
    let Some((&unit, rest)) = bytes.split_first() else { return Beginning::Open };
    if unit != request.unit {
        return Beginning::Other;
    }
    match pdu::reply_length(&request.call, request.any_exception, rest) {
        Length::Never => Beginning::Other,
        Length::Unknown => Beginning::Open,
        Length::Whole(length) if bytes.len() < length + 3 => Beginning::Open,
        Length::Whole(length) if crc(&bytes[..length + 3]) != 0 => Beginning::Other,
        Length::Whole(length) => match pdu::decode(&request.call, request.any_exception, &rest[..length]) {
            Err(RequestError::WrongFrame) => Beginning::Other,
            result => Beginning::Reply(length + 3, result),
        },
    }
}

/// The length of a whole reply to `call` on the line, where the call alone tells it.
pub fn expected_length(call: &Call) -> Option<usize> {
    let known = match call {
        Call::Read(span) if span.table().is_bits() => 2 + (span.count() as usize).div_ceil(8),
        Call::Read(span) => 2 + 2 * span.count() as usize,
        Call::ReadIdentification { .. } | Call::ReportServerId => return None,
        _ => match pdu::reply_length(call, false, &[call.function()]) {
            Length::Whole(length) => length,
            _ => return None,
        },
    };
    Some(known + 3)
}

/// Bytes that are no answer, sorted.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Sorted {
    pub discarded: Discarded,
    /// The length of the longest run of bytes that looks like a damaged reply.
    pub damaged: usize,
    /// Indices of the unanswered requests whose replies were found.
    pub late: Vec<usize>,
    /// Where each of these replies ends.
    pub late_ends: Vec<usize>,
}

/// Sorts `bytes`, which hold no answer to `request` and are over: nothing more belongs to them.
///
/// Copies of `own` (the request's frame) are echoes, replies to `unanswered` requests late, other
/// frames with a right checksum foreign. What remains is noise, except from a place on where the
/// unit and function of `request` stand: that is a damaged reply.
pub fn sort(bytes: &[u8], own: &[u8], request: Option<&Request>, unanswered: &[Unanswered]) -> Sorted {
    let mut sorted = Sorted::default();
    let mut at = 0;
    // Where the run of bytes that belong to no frame began to look like a reply.
    let mut damaged_from = None;
    // Another master's request, whose confirmation may follow.
    let mut before = None;
    while at < bytes.len() {
        let rest = &bytes[at..];
        let length = if !own.is_empty() && rest.starts_with(own) {
            sorted.discarded.echoes += 1;
            own.len()
        } else if let Some((index, length)) = late_reply(rest, unanswered, &sorted.late) {
            sorted.discarded.late_replies += 1;
            sorted.late.push(index);
            sorted.late_ends.push(at + length);
            length
        } else if let Some(length) = foreign_frame(rest) {
            sorted.discarded.foreign_frames += 1;
            let frame = &rest[..length];
            // A confirmation that looks like its request follows it.
            if pdu::is_request(&frame[1..length - 2]) && before != Some(frame) {
                let others = &mut sorted.discarded.requests_of_others;
                (others.count, others.unit) = (others.count + 1, frame[0]);
                before = Some(frame);
            } else {
                before = None;
            }
            length
        } else {
            if damaged_from.is_none() && request.is_some_and(|request| looks_like_reply(rest, request)) {
                damaged_from = Some(at);
                sorted.discarded.checksum_errors += 1;
            }
            sorted.discarded.noise_bytes += u32::from(damaged_from.is_none());
            at += 1;
            continue;
        };
        sorted.damaged = sorted.damaged.max(damaged_from.take().map_or(0, |from| at - from));
        at += length;
    }
    sorted.damaged = sorted.damaged.max(damaged_from.map_or(0, |from| at - from));
    sorted
}

/// The unanswered request that `bytes` begin to answer, and the reply's length.
pub fn late_reply(bytes: &[u8], unanswered: &[Unanswered], found: &[usize]) -> Option<(usize, usize)> {
    let candidates = unanswered.iter().enumerate().filter(|(index, _)| !found.contains(index));
    candidates
        .filter_map(|(index, late)| match beginning(bytes, &late.request) {
            Beginning::Reply(length, _) => Some((index, length)),
            _ => None,
        })
        .next()
}

/// The length of a frame with a right checksum at the beginning of `bytes`.
pub fn foreign_frame(bytes: &[u8]) -> Option<usize> {
    let valid = |length: usize| length >= FRAME_MIN && length <= bytes.len() && crc(&bytes[..length]) == 0;
    let known = pdu::foreign_lengths(bytes.get(1..)?).map(|length| length + 3).find(|length| valid(*length));
    // A function that is not known here: only the end of the bytes tells where it ends.
    known.or_else(|| Some(bytes.len()).filter(|length| valid(*length)))
}

fn looks_like_reply(bytes: &[u8], request: &Request) -> bool {
    match bytes {
        [unit, function, ..] => *unit == request.unit && function & 0x7F == request.call.function(),
        _ => false,
    }
}
