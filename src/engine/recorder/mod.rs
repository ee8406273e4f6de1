//! The flight recorder of a bus: what was last on the wire, with times, in a bounded piece of memory.
//!
//! [`Tape`] takes what is sent and heard as it comes, and costs next to nothing. What it means is
//! found out only when somebody wants to see it: `frames` finds the frames in it and says what each
//! was, `pcapng` makes the file that Wireshark reads, `watch` decides when one is worth keeping, and
//! `files` which of the kept ones must go.

pub mod files;
pub mod frames;
mod pcapng;
pub mod watch;

use std::collections::VecDeque;

use crate::engine::modbus::RequestError;
use crate::engine::settings::Link;
use crate::engine::time::{Duration, Time};

/// What is heard with less silence in between is kept as one piece, with the time of its first byte. An
/// adapter hands over a frame in many.
const SILENCE: Duration = Duration::from_millis(2);
/// A longer piece is kept in parts.
const PIECE_MAX: usize = 512;

/// A tape is kept in so many blocks, of which the oldest is forgotten as a whole: that costs nothing, while to
/// find the end of the oldest entry each time is most of what keeping one costs.
const BLOCKS: usize = 16;

/// What was last on one bus.
///
/// Entries, the oldest first: what it is, the time since the entry before, the length, and the bytes; both
/// numbers take as many bytes as they need.
#[derive(Clone, Debug)]
pub struct Tape {
    /// So many bytes at most; 0: nothing is kept.
    limit: usize,
    blocks: VecDeque<Block>,
    /// Bytes in all blocks.
    size: usize,
    /// Of the newest entry.
    newest: Time,
    /// What is being heard and is not yet in the ring: since when and until when.
    hearing: Vec<u8>,
    heard: (Time, Time),
}

/// Entries one behind the other.
#[derive(Clone, Debug)]
struct Block {
    /// The time of the entry before the first.
    before: Time,
    bytes: Vec<u8>,
}

/// One thing that happened on a bus.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Entry {
    Sent(Vec<u8>),
    Heard(Vec<u8>),
    /// The request that was sent before has ended.
    Ended(End),
    /// Something that people should know: the link went down.
    Said(String),
}

/// How a request ended, as far as the recorder tells it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    Answered,
    Exception(u8),
    Timeout,
    Checksum,
    WrongFrame,
    /// What the line returned was not what was sent.
    Collision,
    /// The link broke.
    Lost,
}

impl End {
    /// `None`: it was never on the wire.
    pub fn of<T>(result: &Result<T, RequestError>) -> Option<End> {
        Some(match result {
            Ok(_) => End::Answered,
            Err(RequestError::Exception(code) | RequestError::Unreachable(code)) => End::Exception(*code),
            Err(RequestError::Timeout) => End::Timeout,
            Err(RequestError::Checksum) => End::Checksum,
            Err(RequestError::WrongFrame) => End::WrongFrame,
            Err(RequestError::Collision) => End::Collision,
            Err(RequestError::Link(_)) => End::Lost,
            Err(RequestError::Impossible(_)) => return None,
        })
    }

    const fn code(self) -> [u8; 2] {
        match self {
            End::Answered => [0, 0],
            End::Exception(code) => [1, code],
            End::Timeout => [2, 0],
            End::Checksum => [3, 0],
            End::WrongFrame => [4, 0],
            End::Lost => [5, 0],
            End::Collision => [6, 0],
        }
    }

    fn of_code(bytes: &[u8]) -> End {
        match bytes {
            [0, ..] => End::Answered,
            [1, code, ..] => End::Exception(*code),
            [2, ..] => End::Timeout,
            [3, ..] => End::Checksum,
            [4, ..] => End::WrongFrame,
            [6, ..] => End::Collision,
            _ => End::Lost,
        }
    }
}

const SENT: u8 = 0;
const HEARD: u8 = 1;
const ENDED: u8 = 2;
const SAID: u8 = 3;

impl Tape {
    /// Keeps the last `limit` bytes; it takes their memory as they come.
    pub fn new(limit: usize) -> Tape {
        Tape {
            limit,
            blocks: VecDeque::new(),
            size: 0,
            newest: Time::default(),
            hearing: Vec::new(),
            heard: Default::default(),
        }
    }

    /// Whether anything is kept at all.
    pub fn is_on(&self) -> bool {
        self.limit > 0
    }

    /// A frame was handed to the line.
    pub fn sent(&mut self, now: Time, frame: &[u8]) {
        self.keep(now, SENT, frame);
    }

    /// Bytes were read.
    pub fn heard(&mut self, now: Time, bytes: &[u8]) {
        let goes_on = now.since(self.heard.1) <= SILENCE && self.hearing.len() + bytes.len() <= PIECE_MAX;
        if !goes_on {
            self.end_piece();
        }
        if self.hearing.is_empty() {
            self.heard.0 = now;
        }
        self.heard.1 = now;
        if self.limit > 0 {
            self.hearing.extend_from_slice(bytes);
        }
    }

    /// The request in flight has ended.
    pub fn ended(&mut self, now: Time, end: End) {
        self.keep(now, ENDED, &end.code());
    }

    /// Something happened that is no frame.
    pub fn said(&mut self, now: Time, text: &str) {
        self.keep(now, SAID, text.as_bytes());
    }

    fn keep(&mut self, now: Time, kind: u8, bytes: &[u8]) {
        self.end_piece();
        self.push(now, kind, bytes);
    }

    /// What was heard becomes an entry.
    fn end_piece(&mut self) {
        if !self.hearing.is_empty() {
            let piece = std::mem::take(&mut self.hearing);
            self.push(self.heard.0, HEARD, &piece);
            // Its memory is used again.
            self.hearing = piece;
            self.hearing.clear();
        }
    }

    fn push(&mut self, time: Time, kind: u8, bytes: &[u8]) {
        let time = time.max(self.newest);
        let mut head = [0; 1 + 2 * NUMBER_MAX];
        head[0] = kind;
        let mut length = 1;
        for number in [(time - self.newest).as_micros() as u64, bytes.len() as u64] {
            length += write_number(number, &mut head[length..]);
        }
        let size = length + bytes.len();
        if size > self.limit {
            return;
        }
        let block = self.block_for(size);
        block.extend_from_slice(&head[..length]);
        block.extend_from_slice(bytes);
        self.size += size;
        self.newest = time;
    }

    /// The block that takes an entry of this size; for its sake others may be forgotten.
    fn block_for(&mut self, size: usize) -> &mut Vec<u8> {
        let block_max = self.limit / BLOCKS;
        let mut used = None;
        while self.size + size > self.limit {
            let Some(oldest) = self.blocks.pop_front() else { break };
            self.size -= oldest.bytes.len();
            used = Some(oldest.bytes);
        }
        let has_room = self.blocks.back().is_some_and(|newest| newest.bytes.len() + size <= block_max);
        if !has_room {
            let mut bytes = used.unwrap_or_else(|| Vec::with_capacity(block_max));
            bytes.clear();
            self.blocks.push_back(Block { before: self.newest, bytes });
        }
        let newest = self.blocks.len() - 1;
        &mut self.blocks[newest].bytes
    }

    /// Everything that is kept, as it is now.
    pub fn recording(&self, now: Time, bus: &str, link: &Link, why: &str) -> Recording {
        let mut whole = self.clone();
        whole.end_piece();
        Recording {
            bus: bus.into(),
            link: match link.line() {
                Some(line) => format!("{link} {line}"),
                None => link.to_string(),
            },
            is_tcp: matches!(link, Link::Tcp { .. }),
            why: why.into(),
            made_at: now,
            before: whole.blocks.front().map_or(whole.newest, |oldest| oldest.before),
            bytes: whole.blocks.into_iter().map(|block| block.bytes).collect::<Vec<_>>().concat(),
        }
    }
}

/// What was on a tape at one moment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Recording {
    pub bus: String,
    /// `serial /dev/ttyUSB0 19200 8E1`
    pub link: String,
    /// Modbus TCP and not RTU.
    pub is_tcp: bool,
    /// Why it was made: `no answer from relays`.
    pub why: String,
    pub made_at: Time,
    before: Time,
    bytes: Vec<u8>,
}

impl Recording {
    /// What happened, the oldest first.
    pub fn entries(&self) -> impl Iterator<Item = (Time, Entry)> + '_ {
        let (mut at, mut time) = (0, self.before);
        std::iter::from_fn(move || {
            let head = Head::read(|index| self.bytes.get(at + index).copied())?;
            let bytes = self.bytes.get(at + head.length..at + head.length + head.size)?;
            time += head.since;
            at += head.length + head.size;
            let entry = match head.kind {
                SENT => Entry::Sent(bytes.into()),
                HEARD => Entry::Heard(bytes.into()),
                ENDED => Entry::Ended(End::of_code(bytes)),
                _ => Entry::Said(String::from_utf8_lossy(bytes).into_owned()),
            };
            Some((time, entry))
        })
    }
}

/// What stands before an entry's bytes.
struct Head {
    kind: u8,
    since: Duration,
    /// Of the head, and of what follows it.
    length: usize,
    size: usize,
}

impl Head {
    fn read(byte: impl Fn(usize) -> Option<u8>) -> Option<Head> {
        let kind = byte(0)?;
        let (since, after) = read_number(1, &byte)?;
        let (size, length) = read_number(after, &byte)?;
        Some(Head { kind, since: Duration::from_micros(since), length, size: size as usize })
    }
}

/// A number of 64 bits, seven to a byte.
const NUMBER_MAX: usize = 10;

fn write_number(mut number: u64, place: &mut [u8]) -> usize {
    let mut length = 0;
    while number >= 0x80 {
        place[length] = number as u8 | 0x80;
        number >>= 7;
        length += 1;
    }
    place[length] = number as u8;
    length + 1
}

/// The number at `at`, and the place behind it.
fn read_number(at: usize, byte: &impl Fn(usize) -> Option<u8>) -> Option<(u64, usize)> {
    let mut number = 0;
    for index in 0..NUMBER_MAX {
        let part = byte(at + index)?;
        number |= u64::from(part & 0x7F) << (7 * index);
        if part & 0x80 == 0 {
            return Some((number, at + index + 1));
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    const LINK: fn() -> Link = || Link::Tcp { host: "192.168.1.20".into(), port: 502 };

    fn entries(tape: &Tape) -> Vec<(u64, Entry)> {
        let recording = tape.recording(Time(0), "plant", &LINK(), "on request");
        recording.entries().map(|(time, entry)| (time.0, entry)).collect()
    }

    #[test]
    fn what_happened_is_told_in_its_order_and_what_came_in_pieces_is_one() {
        let mut tape = Tape::new(1000);
        tape.sent(Time(5), &[1, 2, 3]);
        for (time, byte) in [(1000, 4), (2000, 5), (4000, 6), (6001, 7)] {
            tape.heard(Time(time), &[byte]);
        }
        tape.ended(Time(7000), End::Exception(2));
        tape.said(Time(90_000_000_000), "the link is down: unplugged");
        tape.heard(Time(90_000_000_001), &[8]);
        let expected = [
            (5, Entry::Sent(vec![1, 2, 3])),
            (1000, Entry::Heard(vec![4, 5, 6])),
            (6001, Entry::Heard(vec![7])),
            (7000, Entry::Ended(End::Exception(2))),
            (90_000_000_000, Entry::Said("the link is down: unplugged".into())),
            (90_000_000_001, Entry::Heard(vec![8])),
        ];
        assert_eq!(entries(&tape), expected);
        assert_eq!(entries(&tape), expected, "looking changes nothing");
    }

    #[test]
    fn every_end_comes_back_as_it_was() {
        for end in [
            End::Answered,
            End::Exception(0),
            End::Exception(255),
            End::Timeout,
            End::Checksum,
            End::WrongFrame,
            End::Collision,
            End::Lost,
        ] {
            assert_eq!(End::of_code(&end.code()), end);
        }
    }

    #[test]
    fn a_tape_that_is_off_keeps_nothing() {
        let mut tape = Tape::new(0);
        tape.sent(Time(5), &[1]);
        tape.heard(Time(6), &[1]);
        tape.ended(Time(7), End::Answered);
        assert_eq!(entries(&tape), []);
        assert_eq!((tape.blocks.capacity(), tape.hearing.capacity()), (0, 0));
    }

    proptest::proptest! {
        /// Whatever comes: the newest entries are kept, whole and with their times, and never more than
        /// the limit.
        #[test]
        fn only_the_oldest_is_forgotten(
            limit in 0usize..3000,
            events in proptest::collection::vec((0u64..5_000_000, 0u8..4, 0usize..60), 0..200),
        ) {
            let mut tape = Tape::new(limit);
            let (mut now, mut told) = (0, Vec::new());
            for (index, (since, kind, length)) in events.into_iter().enumerate() {
                // No two pieces of what is heard are one.
                now += since + 2001;
                let bytes = vec![index as u8; length + 1];
                let time = Time(now);
                match kind {
                    0 => tape.sent(time, &bytes),
                    1 => tape.heard(time, &bytes),
                    2 => tape.ended(time, End::Exception(index as u8)),
                    _ => tape.said(time, "a text"),
                }
                told.push((now, match kind {
                    0 => Entry::Sent(bytes),
                    1 => Entry::Heard(bytes),
                    2 => Entry::Ended(End::Exception(index as u8)),
                    _ => Entry::Said("a text".into()),
                }));
                let size: usize = tape.blocks.iter().map(|block| block.bytes.len()).sum();
                assert!(size <= limit && size == tape.size);
            }
            let kept = entries(&tape);
            if limit >= 80 {
                let is_full = tape.size + limit / BLOCKS + 80 > limit;
                assert!(kept.len() == told.len() || (!kept.is_empty() && is_full));
                assert_eq!(kept, told[told.len() - kept.len()..]);
            }
        }
    }
}
