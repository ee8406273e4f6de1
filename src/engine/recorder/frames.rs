//! The frames on a tape, and what each of them was: found out afterwards, from the bytes and from how
//! the requests ended.

use crate::engine::modbus::crc::crc;
use crate::engine::modbus::exception_name;
use crate::engine::modbus::rtu_bytes::foreign_frame;
use crate::engine::recorder::{End, Entry, Recording};
use crate::engine::time::{Duration, Time};

/// A longer silence ends a frame, whole or not: adapters and serial servers pass frames on in pieces.
const SILENCE: Duration = Duration::from_millis(100);
/// The longest frame on a serial line (Modbus over serial line V1.02, 2.5.1.1).
const RTU_MAX: usize = 256;
/// Bytes that lie together and belong to no frame are shown in parts no longer than this.
const RUN_MAX: usize = 2048;
/// What stands before a frame of Modbus TCP: transaction, protocol, length; then comes the unit.
const TCP_HEADER: usize = 6;
/// As many bytes without any frame are a damaged frame rather than noise.
const DAMAGED_MIN: usize = 4;

/// One frame, or bytes that are none.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    /// Of its first byte, as far as that is known.
    pub time: Time,
    pub is_sent: bool,
    /// Who sent it, or whom it is sent to; `None`: that cannot be told.
    pub unit: Option<u8>,
    pub bytes: Vec<u8>,
    /// What people should know of it, each a note.
    pub notes: Vec<String>,
}

/// All frames of a recording, the oldest first.
pub fn frames(recording: &Recording) -> Vec<Frame> {
    let mut reader = Reader { is_tcp: recording.is_tcp, ..Reader::default() };
    for (time, entry) in recording.entries() {
        match entry {
            Entry::Sent(bytes) => reader.sent(time, bytes),
            Entry::Heard(bytes) => reader.heard(time, &bytes),
            Entry::Ended(end) => reader.ended(end),
            Entry::Said(text) => {
                reader.end_run(None);
                reader.notes.push(text);
            }
        }
    }
    reader.end_run(None);
    // What was said last has no frame behind it.
    let notes = std::mem::take(&mut reader.notes);
    if let Some(last) = reader.frames.last_mut() {
        last.notes.extend(notes.into_iter().map(|note| format!("after this: {note}")));
    }
    reader.frames
}

#[derive(Default)]
struct Reader {
    is_tcp: bool,
    frames: Vec<Frame>,
    /// For the next frame.
    notes: Vec<String>,
    /// The last frame that was sent, and whether its answer is still awaited.
    request: Vec<u8>,
    request_at: Option<usize>,
    is_open: bool,
    /// What has been heard since, with the place in it at which each piece begins.
    run: Vec<u8>,
    pieces: Vec<(usize, Time)>,
}

impl Reader {
    fn sent(&mut self, time: Time, bytes: Vec<u8>) {
        self.end_run(None);
        self.request.clone_from(&bytes);
        self.is_open = true;
        self.request_at = Some(self.frames.len());
        let notes = std::mem::take(&mut self.notes);
        self.frames.push(Frame { time, is_sent: true, unit: self.unit_of(&bytes), bytes, notes });
    }

    fn heard(&mut self, time: Time, bytes: &[u8]) {
        let was_silent = self.pieces.last().is_some_and(|(_, last)| time.since(*last) > SILENCE);
        // A stream has no silence, but an end of what anybody can make sense of.
        if (was_silent && !self.is_tcp) || self.run.len() + bytes.len() > RUN_MAX {
            self.end_run(None);
        }
        self.pieces.push((self.run.len(), time));
        self.run.extend_from_slice(bytes);
    }

    fn ended(&mut self, end: End) {
        self.end_run(Some(end));
        let note = match end {
            End::Answered | End::Exception(_) => None,
            End::Timeout => Some("no answer in time"),
            End::Checksum => Some("no answer but a damaged one"),
            End::WrongFrame => Some("no answer that fits"),
            End::Collision => Some("another spoke at the same time"),
            End::Lost => Some("the link broke before the answer"),
        };
        let request = self.request_at.and_then(|at| self.frames.get_mut(at)).filter(|_| self.is_open);
        if let (Some(note), Some(request)) = (note, request) {
            request.notes.push(note.into());
        }
        self.is_open = false;
    }

    /// What was heard is over: it is cut into frames. `end`: how the request ended with it.
    fn end_run(&mut self, end: Option<End>) {
        let (run, pieces) = (std::mem::take(&mut self.run), std::mem::take(&mut self.pieces));
        let parts = if self.is_tcp { tcp_parts(&run) } else { self.rtu_parts(&run) };
        let is_answer = |part: &Part| part.is_whole && self.answers(&run[part.from..part.to]);
        let has_answer = matches!(end, Some(End::Answered | End::Exception(_)));
        // The last one that fits is the one that was believed.
        let answer = parts.iter().rposition(is_answer).filter(|_| has_answer);
        for (index, part) in parts.iter().enumerate() {
            let bytes = &run[part.from..part.to];
            let piece = pieces.iter().rev().find(|(from, _)| *from <= part.from);
            let note = match (answer == Some(index), end) {
                (true, Some(End::Exception(code))) => {
                    Some(format!("exception {code}: {}", exception_name(code)))
                }
                (true, _) => None,
                (false, _) => Some(self.stranger(bytes, part.is_whole)),
            };
            let mut notes = std::mem::take(&mut self.notes);
            notes.extend(note);
            let unit =
                if part.is_whole || self.begins_like_answer(bytes) { self.unit_of(bytes) } else { None };
            self.frames.push(Frame {
                time: piece.map(|(_, time)| *time).unwrap_or_default(),
                is_sent: false,
                unit,
                bytes: bytes.into(),
                notes,
            });
        }
    }

    /// What bytes are that are no answer.
    fn stranger(&self, bytes: &[u8], is_whole: bool) -> String {
        if is_whole && self.is_open && bytes == self.request {
            return "our own request: an echo".into();
        }
        if self.is_tcp && is_whole {
            let number = |bytes: &[u8]| bytes.first_chunk().copied().map(u16::from_be_bytes);
            return match (number(bytes), number(&self.request)) {
                (Some(found), Some(last)) if found == last && !self.is_open => "late: nobody waits for it",
                (Some(found), Some(last)) if found != last && last.wrapping_sub(found) < 32 => {
                    "late: the answer to an earlier request"
                }
                _ => "not what was asked for",
            }
            .into();
        }
        match (is_whole, self.answers(bytes), self.is_open) {
            (true, true, false) => "late: nobody waits for it".into(),
            (true, true, true) => "looks like the answer, but was not believed: a late one?".into(),
            (true, false, _) => "a frame that nobody asked for".into(),
            (false, ..) if self.is_tcp => "no frame of Modbus TCP".into(),
            (false, ..) if self.begins_like_answer(bytes) => "damaged: wrong checksum".into(),
            (false, ..) if bytes.len() >= DAMAGED_MIN => "no frame: noise, or a damaged one".into(),
            (false, ..) => "noise".into(),
        }
    }

    /// Whether unit and function (and of Modbus TCP the transaction) are those that were asked for.
    fn answers(&self, frame: &[u8]) -> bool {
        let same_number = !self.is_tcp || frame.get(..2) == self.request.get(..2);
        same_number && self.begins_like_answer(frame)
    }

    fn begins_like_answer(&self, frame: &[u8]) -> bool {
        let at = if self.is_tcp { TCP_HEADER } else { 0 };
        match (frame.get(at..at + 2), self.request.get(at..at + 2)) {
            (Some([unit, function]), Some([asked, called])) => unit == asked && function & 0x7F == *called,
            _ => false,
        }
    }

    fn unit_of(&self, frame: &[u8]) -> Option<u8> {
        frame.get(if self.is_tcp { TCP_HEADER } else { 0 }).copied()
    }

    fn rtu_parts(&self, run: &[u8]) -> Vec<Part> {
        let mut parts = Vec::new();
        let (mut from, mut at) = (0, 0);
        while at < run.len() {
            let rest = &run[at..run.len().min(at + RTU_MAX)];
            let own =
                (!self.request.is_empty() && rest.starts_with(&self.request)).then_some(self.request.len());
            let Some(length) =
                own.or_else(|| foreign_frame(rest)).filter(|length| crc(&rest[..*length]) == 0)
            else {
                at += 1;
                continue;
            };
            self.push_broken(&mut parts, run, from, at);
            parts.push(Part { from: at, to: at + length, is_whole: true });
            at += length;
            from = at;
        }
        self.push_broken(&mut parts, run, from, at);
        parts
    }

    /// Bytes between frames: from where they look like the answer on they are a damaged one.
    fn push_broken(&self, parts: &mut Vec<Part>, run: &[u8], from: usize, to: usize) {
        let damaged = (from..to).find(|at| self.begins_like_answer(&run[*at..to])).unwrap_or(to);
        for (from, to) in [(from, damaged), (damaged, to)] {
            if from < to {
                parts.push(Part { from, to, is_whole: false });
            }
        }
    }
}

/// A place in what was heard.
struct Part {
    from: usize,
    to: usize,
    /// A frame, and nothing that only might be one.
    is_whole: bool,
}

fn tcp_parts(run: &[u8]) -> Vec<Part> {
    let mut parts = Vec::new();
    let mut at = 0;
    while at < run.len() {
        let to = match &run[at..] {
            [_, _, 0, 0, 0, length, ..] if *length >= 2 => at + TCP_HEADER + usize::from(*length),
            _ => run.len() + 1,
        };
        parts.push(Part { from: at, to: to.min(run.len()), is_whole: to <= run.len() });
        at = to;
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::modbus::rtu_bytes;
    use crate::engine::recorder::Tape;
    use crate::engine::settings::{Line, Link, Parity, Rs485};

    fn bytes(hex: &str) -> Vec<u8> {
        let digits: Vec<char> = hex.chars().filter(|c| !c.is_whitespace()).collect();
        let byte = |pair: &[char]| u8::from_str_radix(&String::from_iter(pair), 16).expect("hexadecimal");
        digits.chunks(2).map(byte).collect()
    }

    /// `18 04 0000 0001` with its checksum behind it.
    fn rtu(hex: &str) -> Vec<u8> {
        let bytes = bytes(hex);
        rtu_bytes::frame(bytes[0], &bytes[1..])
    }

    enum Does {
        Sends(Vec<u8>),
        Hears(Vec<u8>),
        Ends(End),
        Says(&'static str),
        Waits(u64),
    }
    use Does::{Ends, Hears, Says, Sends, Waits};

    /// One frame in a line: its time in milliseconds, `>` if it was sent, the unit, the bytes (a right
    /// checksum as `ok`), the notes.
    fn told(is_tcp: bool, events: Vec<Does>) -> Vec<String> {
        let mut tape = Tape::new(10_000);
        let mut now = Time(0);
        for event in events {
            now += Duration::from_millis(5);
            match event {
                Sends(bytes) => tape.sent(now, &bytes),
                Hears(bytes) => tape.heard(now, &bytes),
                Ends(end) => tape.ended(now, end),
                Says(text) => tape.said(now, text),
                Waits(millis) => now += Duration::from_millis(millis),
            }
        }
        let link = match is_tcp {
            true => Link::Tcp { host: "192.168.1.20".into(), port: 502 },
            false => Link::Serial {
                path: "/dev/ttyUSB0".into(),
                line: Line { baud: 19200, parity: Parity::Even, stop_bits: 1 },
                rs485: Rs485::Auto,
            },
        };
        let recording = tape.recording(now, "basement", &link, "a test");
        let line = |frame: Frame| {
            let way = if frame.is_sent { ">" } else { "<" };
            let unit = frame.unit.map_or("?".into(), |unit| unit.to_string());
            let (body, end) = match crc(&frame.bytes) == 0 && frame.bytes.len() > 2 {
                true => (&frame.bytes[..frame.bytes.len() - 2], " ok"),
                false => (&frame.bytes[..], ""),
            };
            let hex: String = body.iter().map(|byte| format!("{byte:02X}")).collect();
            let notes = frame.notes.join("; ");
            format!("{} {way} {unit} {hex}{end} {notes}", frame.time.0 / 1000).trim_end().to_string()
        };
        frames(&recording).into_iter().map(line).collect()
    }

    #[track_caller]
    fn check(events: Vec<Does>, expected: &[&str]) {
        assert_eq!(told(false, events), expected);
    }

    #[track_caller]
    fn check_tcp(events: Vec<Does>, expected: &[&str]) {
        assert_eq!(told(true, events), expected);
    }

    fn asks() -> Does {
        Sends(rtu("12 04 0000 0001"))
    }

    fn good() -> Vec<u8> {
        rtu("12 04 02 0015")
    }

    #[test]
    fn a_good_answer_in_whatever_pieces_is_one_frame_without_a_note() {
        let pieces = vec![
            asks(),
            Hears(good()[..1].into()),
            Hears(good()[1..5].into()),
            Hears(good()[5..].into()),
            Ends(End::Answered),
            asks(),
            Hears(rtu("12 84 02")),
            Ends(End::Exception(2)),
        ];
        check(
            pieces,
            &[
                "5 > 18 120400000001 ok",
                "10 < 18 1204020015 ok",
                "30 > 18 120400000001 ok",
                "35 < 18 128402 ok exception 2: illegal data address",
            ],
        );
    }

    #[test]
    fn silence_is_told_where_the_question_stands_and_a_late_answer_as_what_it_is() {
        let late = vec![asks(), Waits(500), Ends(End::Timeout), Waits(100), Hears(good())];
        check(
            late,
            &["5 > 18 120400000001 ok no answer in time", "625 < 18 1204020015 ok late: nobody waits for it"],
        );
        let later = vec![
            asks(),
            Ends(End::Timeout),
            asks(),
            Hears([good(), rtu("12 04 02 0016")].concat()),
            Ends(End::Answered),
        ];
        check(
            later,
            &[
                "5 > 18 120400000001 ok no answer in time",
                "15 > 18 120400000001 ok",
                "20 < 18 1204020015 ok looks like the answer, but was not believed: a late one?",
                "20 < 18 1204020016 ok",
            ],
        );
    }

    #[test]
    fn what_is_damaged_what_is_noise_and_what_is_of_others_are_told_apart() {
        let mut damaged = good();
        damaged[3] ^= 0x10;
        check(
            vec![asks(), Hears(damaged), Ends(End::Checksum)],
            &[
                "5 > 18 120400000001 ok no answer but a damaged one",
                "10 < 18 1204021015FD3C damaged: wrong checksum",
            ],
        );
        check(
            vec![asks(), Hears(vec![0xFF, 0, 0x12, 4, 2, 0]), Ends(End::Checksum)],
            &[
                "5 > 18 120400000001 ok no answer but a damaged one",
                "10 < ? FF00 noise",
                "10 < 18 12040200 damaged: wrong checksum",
            ],
        );
        check(
            vec![asks(), Hears([&[0xFF, 0][..], &good(), &[0]].concat()), Ends(End::Answered)],
            &["5 > 18 120400000001 ok", "10 < ? FF00 noise", "10 < 18 1204020015 ok", "10 < ? 00 noise"],
        );
        let other = rtu("13 04 02 0007");
        check(
            vec![asks(), Hears([other, good()].concat()), Ends(End::Answered)],
            &[
                "5 > 18 120400000001 ok",
                "10 < 19 1304020007 ok a frame that nobody asked for",
                "10 < 18 1204020015 ok",
            ],
        );
        check(
            vec![asks(), Hears(rtu("12 03 02 0015")), Ends(End::WrongFrame)],
            &[
                "5 > 18 120400000001 ok no answer that fits",
                "10 < 18 1203020015 ok a frame that nobody asked for",
            ],
        );
    }

    #[test]
    fn an_echo_is_known_also_where_the_answer_looks_the_same() {
        let set = rtu("12 05 0003 FF00");
        check(
            vec![Sends(set.clone()), Hears([set.clone(), set.clone()].concat()), Ends(End::Answered)],
            &[
                "5 > 18 12050003FF00 ok",
                "10 < 18 12050003FF00 ok our own request: an echo",
                "10 < 18 12050003FF00 ok",
            ],
        );
        check(
            vec![Sends(set.clone()), Hears(set), Ends(End::Answered)],
            &["5 > 18 12050003FF00 ok", "10 < 18 12050003FF00 ok"],
        );
        check(
            vec![asks(), Hears([rtu("12 04 0000 0001"), good()].concat()), Ends(End::Answered)],
            &[
                "5 > 18 120400000001 ok",
                "10 < 18 120400000001 ok our own request: an echo",
                "10 < 18 1204020015 ok",
            ],
        );
    }

    #[test]
    fn what_is_said_stands_at_the_next_frame_or_behind_the_last() {
        check(
            vec![Says("the link is up"), asks(), Ends(End::Lost), Says("the link is down: unplugged")],
            &[
                "10 > 18 120400000001 ok the link is up; the link broke before the answer; after this: the link is down: unplugged",
            ],
        );
        check(vec![Says("the link is up")], &[]);
    }

    #[test]
    fn modbus_tcp_is_cut_by_its_lengths_and_known_by_its_numbers() {
        let request = || bytes("0007 0000 0006 01 03 0000 0001");
        let answer = || bytes("0007 0000 0005 01 03 02 0015");
        let earlier = bytes("0006 0000 0005 01 03 02 0014");
        check_tcp(
            vec![
                Sends(request()),
                Hears(earlier),
                Hears(answer()[..3].into()),
                Waits(150),
                Hears(answer()[3..].into()),
                Ends(End::Answered),
            ],
            &[
                "5 > 1 000700000006010300000001",
                "10 < 1 0006000000050103020014 late: the answer to an earlier request",
                "15 < 1 0007000000050103020015",
            ],
        );
        check_tcp(
            vec![Sends(request()), Ends(End::Timeout), Hears(answer())],
            &[
                "5 > 1 000700000006010300000001 no answer in time",
                "15 < 1 0007000000050103020015 late: nobody waits for it",
            ],
        );
        check_tcp(
            vec![Sends(request()), Hears(b"HTTP".into()), Ends(End::Lost)],
            &[
                "5 > 1 000700000006010300000001 the link broke before the answer",
                "10 < ? 48545450 no frame of Modbus TCP",
            ],
        );
    }

    proptest::proptest! {
        /// Whatever is on a tape: every byte of it is in a frame, in its order.
        #[test]
        fn no_byte_is_lost(
            is_tcp in proptest::bool::ANY,
            events in proptest::collection::vec((0u8..4, proptest::collection::vec(0u8..5, 1..40)), 0..30),
        ) {
            let mut all: Vec<u8> = Vec::new();
            let mut tape = Tape::new(100_000);
            for (index, (kind, bytes)) in events.into_iter().enumerate() {
                let now = Time::from_millis(index as u64 * 5);
                match kind {
                    0 => tape.sent(now, &bytes),
                    1 | 2 => tape.heard(now, &bytes),
                    _ => tape.ended(now, End::Answered),
                }
                all.extend(bytes.iter().filter(|_| kind < 3));
            }
            let link = Link::Tcp { host: String::new(), port: 0 };
            let recording = Recording { is_tcp, ..tape.recording(Time(0), "", &link, "") };
            let shown: Vec<u8> = frames(&recording).into_iter().flat_map(|frame| frame.bytes).collect();
            assert_eq!(shown, all);
        }
    }
}
