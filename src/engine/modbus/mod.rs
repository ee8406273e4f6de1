//! Modbus as data: what is asked, what comes back, and what can go wrong.
//!
//! `pdu` turns calls into bytes and bytes into answers; `rtu` is the guard of a serial line, an
//! automaton fed with bytes and times that never takes a reply for another's; `tcp` is the same
//! for Modbus TCP, and `guard` the one door to both.

pub mod crc;
pub mod names;
pub mod pdu;
pub mod rtu_bytes;

pub mod rtu;
pub mod tcp;

pub mod guard;

use std::fmt;

use crate::engine::address::Span;
use crate::engine::time::{Duration, Time};
pub use crate::engine::value::exception_name;

/// The exception of a device that does not take the value. Some say so, too, when they take the nearest one.
pub const ILLEGAL_VALUE: u8 = 3;
/// "Accepted, and it will take long": the exception that says nothing is wrong.
pub const ACKNOWLEDGE: u8 = 5;
/// The device has done nothing, and wants to be asked again.
pub const BUSY: u8 = 6;

/// One question to one unit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Request {
    /// 1 to 247; 0 is a broadcast on a serial line, and an ordinary unit on Modbus TCP.
    pub unit: u8,
    pub call: Call,
    /// Take an exception of any function code as the answer: the device has the quirk
    /// `exception_function_varies`.
    pub any_exception: bool,
    /// Only asks whether a silent device is there again: without an answer in time the line does not
    /// wait for a late one, which unit, function and checksum tell apart from others'.
    pub is_probe: bool,
    /// The unit may take so long, although it is known to be quicker and is not waited for as long. Without an
    /// answer in time only this unit is left alone, until no late answer can come any more.
    pub may_take: Option<Duration>,
}

impl Request {
    /// The request to a device that keeps to the specification.
    pub const fn new(unit: u8, call: Call) -> Request {
        Request { unit, call, any_exception: false, is_probe: false, may_take: None }
    }
}

/// What is asked, by function code.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Call {
    /// Function 1, 2, 3 or 4, by the span's table.
    Read(Span),
    /// Function 5.
    WriteCoil { address: u16, on: bool },
    /// Function 6.
    WriteRegister { address: u16, word: u16 },
    /// Function 15.
    WriteCoils { address: u16, values: Vec<bool> },
    /// Function 16.
    WriteRegisters { address: u16, words: Vec<u16> },
    /// Function 8: a sub-function and its data.
    Diagnostics { function: u16, data: Vec<u16> },
    /// Function 43/14: `code` 1 basic, 2 regular, 3 extended, 4 one object.
    ReadIdentification { code: u8, object: u8 },
    /// Function 17.
    ReportServerId,
}

impl Call {
    pub const fn function(&self) -> u8 {
        match self {
            Call::Read(span) => span.table().read_function(),
            Call::WriteCoil { .. } => 5,
            Call::WriteRegister { .. } => 6,
            Call::Diagnostics { .. } => 8,
            Call::WriteCoils { .. } => 15,
            Call::WriteRegisters { .. } => 16,
            Call::ReportServerId => 17,
            Call::ReadIdentification { .. } => 43,
        }
    }

    pub const fn is_write(&self) -> bool {
        matches!(self.function(), 5 | 6 | 15 | 16)
    }
}

impl fmt::Display for Call {
    /// As in a transcript: `read input 0..7`, `write coil 3 ON`, `write holding 16 0087`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Call::Read(span) => write!(f, "read {span}"),
            Call::WriteCoil { address, on } => {
                write!(f, "write coil {address} {}", if *on { "ON" } else { "OFF" })
            }
            Call::WriteRegister { address, word } => write!(f, "write holding {address} {word:04X}"),
            Call::WriteCoils { address, values } => {
                write!(f, "write coils {address}")?;
                values.iter().try_for_each(|on| write!(f, " {}", if *on { "ON" } else { "OFF" }))
            }
            Call::WriteRegisters { address, words } => {
                write!(f, "write holdings {address}")?;
                words.iter().try_for_each(|word| write!(f, " {word:04X}"))
            }
            Call::Diagnostics { function, data } => {
                write!(f, "diagnostics {function}")?;
                data.iter().try_for_each(|word| write!(f, " {word:04X}"))
            }
            Call::ReadIdentification { code, object } => write!(f, "identification {code} {object}"),
            Call::ReportServerId => write!(f, "report server id"),
        }
    }
}

/// What a device said, checked against what it was asked: a read of eight registers is answered by
/// exactly eight.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Answer {
    Bits(Vec<bool>),
    Words(Vec<u16>),
    /// The write was confirmed (or, for a broadcast, sent).
    Written,
    Diagnostics(Vec<u16>),
    Identification(Identification),
    ServerId(Vec<u8>),
}

/// The answer to function 43/14.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identification {
    pub conformity: u8,
    /// The object to ask next, if more follow.
    pub next: Option<u8>,
    /// Object number and its text, any bytes outside UTF-8 replaced.
    pub objects: Vec<(u8, String)>,
}

/// Why there is no answer. The three groups send a person to three places: to the device
/// (exception), to its address and wiring (silence), to the line's quality (checksum, frame).
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RequestError {
    /// The device refused, with this exception code.
    Exception(u8),
    /// A gateway on the way says with exception 10 or 11 that the device does not answer it.
    Unreachable(u8),
    /// Nothing that fits came in time.
    Timeout,
    /// Bytes came, but with a wrong checksum.
    Checksum,
    /// A whole and valid frame came, and nothing better: another unit's, another function's, a wrong
    /// length, a wrong echo.
    WrongFrame,
    /// On a line that returns what we send, something else came back: another spoke at the same time.
    Collision,
    /// The port or the connection broke.
    Link(String),
    /// Nothing was sent, because no frame can ask this, and why: a broadcast read, 200 registers.
    Impossible(&'static str),
}

impl fmt::Display for RequestError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            RequestError::Exception(code) => write!(f, "exception {code} ({})", exception_name(*code)),
            RequestError::Unreachable(code) => {
                write!(f, "no answer behind the gateway: exception {code} ({})", exception_name(*code))
            }
            RequestError::Timeout => write!(f, "no answer in time"),
            RequestError::Checksum => write!(f, "checksum error"),
            RequestError::WrongFrame => write!(f, "an answer that does not fit the request"),
            RequestError::Collision => write!(f, "collision: another spoke on the line at the same time"),
            RequestError::Link(reason) => write!(f, "link: {reason}"),
            RequestError::Impossible(reason) => write!(f, "cannot be asked: {reason}"),
        }
    }
}

impl RequestError {
    /// What stands behind it where people are told of it: `; check …`, or nothing.
    pub fn advice(&self) -> String {
        self.what_to_check().map_or_else(String::new, |check| format!("; {check}"))
    }

    /// Where to look when it comes again and again: each has other causes.
    const fn what_to_check(&self) -> Option<&'static str> {
        match self {
            RequestError::Timeout => Some("check its power, its wiring and its unit"),
            RequestError::Unreachable(_) => Some("check the device behind the gateway"),
            RequestError::Checksum => Some("check the wire: its ends, its shield, baud rate and parity"),
            RequestError::WrongFrame => Some("check whether another device has its unit"),
            RequestError::Collision => Some("check who else speaks on the line"),
            RequestError::Exception(_) | RequestError::Link(_) | RequestError::Impossible(_) => None,
        }
    }
}

/// What the line did with one request, and when.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Reply {
    pub result: Result<Answer, RequestError>,
    /// When its first byte was handed to the line.
    pub sent_at: Time,
    pub first_byte_at: Option<Time>,
    pub last_byte_at: Option<Time>,
    /// What was thrown away on the way to this reply.
    pub discarded: Discarded,
}

impl Reply {
    /// The end of a request that was sent at `sent_at`. `times` are those of the answer's first and last
    /// byte, if there was one. Takes what was thrown away so far.
    pub fn new(
        result: Result<Answer, RequestError>,
        sent_at: Time,
        times: Option<(Time, Time)>,
        discarded: &mut Discarded,
    ) -> Reply {
        Reply {
            result,
            sent_at,
            first_byte_at: times.map(|(first, _)| first),
            last_byte_at: times.map(|(_, last)| last),
            discarded: std::mem::take(discarded),
        }
    }
}

/// Counts of what a line threw away; each is a hint at a different fault.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Discarded {
    /// Bytes that belonged to no frame.
    pub noise_bytes: u32,
    /// Whole frames that came after their request had timed out.
    pub late_replies: u32,
    /// Whole frames from other units or to other requests.
    pub foreign_frames: u32,
    /// Copies of our own request, as adapters without echo suppression return them.
    pub echoes: u32,
    /// Frames with a wrong checksum.
    pub checksum_errors: u32,
    /// Whole requests that we did not send: another master's.
    pub requests_of_others: RequestsOfOthers,
    /// Whose reply was late, the last one if there were several.
    pub late: Option<LateReply>,
}

/// A reply that came after its request had been given up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LateReply {
    pub unit: u8,
    /// How long after the request had been sent.
    pub after: Duration,
}

/// How many requests of another master were heard, and to which unit the last one was.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RequestsOfOthers {
    pub count: u32,
    pub unit: u8,
}
