//! The guard of an RTU line against everything that a line can do.

use proptest::prelude::*;

use super::*;
use crate::engine::address::{Span, Table};
use crate::engine::modbus::crc::crc;
use crate::engine::modbus::{Call, RequestsOfOthers};
use crate::engine::settings::Parity;

mod echo;
mod late;

const TIMEOUT: Duration = Duration::from_millis(200);
const LINE: Line = Line { baud: 19_200, parity: Parity::Even, stop_bits: 1 };

/// Bytes from text such as `01 04 02`.
fn raw(text: &str) -> Vec<u8> {
    let byte = |part| u8::from_str_radix(part, 16).expect("two hexadecimal digits");
    text.split_whitespace().map(byte).collect()
}

/// A frame: the bytes of `text` and their checksum.
fn framed(text: &str) -> Vec<u8> {
    let mut bytes = raw(text);
    bytes.extend(crc(&bytes).to_le_bytes());
    bytes
}

fn read(unit: u8, table: Table, first: u16, count: u16) -> Request {
    Request::new(unit, Call::Read(Span::with_count(table, first, count).expect("a span")))
}

fn two_inputs() -> Request {
    read(1, Table::Input, 0, 2)
}

fn set_relay() -> Request {
    Request::new(1, Call::WriteCoil { address: 3, on: true })
}

fn words(words: &[u16]) -> Result<Answer, RequestError> {
    Ok(Answer::Words(words.to_vec()))
}

/// A line on which time passes as the test says.
struct Scene {
    guard: Guard,
    now: Time,
    sent_at: Time,
    reply: Option<Reply>,
}

impl Scene {
    fn new() -> Scene {
        let guard = Guard::new(LINE, None, None);
        Scene { guard, now: Time::from_millis(1000), sent_at: Time(0), reply: None }
    }

    /// A line that is known to return nothing of what we send.
    fn without_echo() -> Scene {
        let mut scene = Scene::new();
        scene.ask(&two_inputs()).wait(8).hears(framed("01 04 04 00 07 00 08"));
        scene.expect("the first reading", words(&[7, 8]));
        scene
    }

    /// Begins, waits as long as the guard wants, sends.
    fn ask(&mut self, request: &Request) -> &mut Scene {
        assert_eq!(self.guard.begin(self.now, request, TIMEOUT), None);
        self.now = self.now.max(self.guard.earliest_send(self.now));
        self.guard.sent(self.now);
        self.sent_at = self.now;
        self
    }

    /// Lets time pass, waking the guard when it wants to be.
    fn wait(&mut self, millis: u64) -> &mut Scene {
        let end = self.now + Duration::from_millis(millis);
        while let Some(at) = self.guard.wake_at().filter(|at| *at <= end && self.reply.is_none()) {
            self.now = self.now.max(at);
            self.reply = self.guard.wake(self.now);
        }
        self.now = end;
        self
    }

    fn hears(&mut self, bytes: Vec<u8>) -> &mut Scene {
        if let Some(reply) = self.guard.received(self.now, &bytes) {
            assert_eq!(self.reply.replace(reply), None);
        }
        self
    }

    /// The reply to the last request, waited for; and how long after sending it came.
    fn reply(&mut self) -> (Reply, Duration) {
        while self.reply.is_none() {
            let at = self.guard.wake_at().expect("a request is on its way");
            self.now = self.now.max(at);
            self.reply = self.guard.wake(self.now);
        }
        (self.reply.take().expect("just waited for"), self.now - self.sent_at)
    }

    fn expect(&mut self, what: &str, result: Result<Answer, RequestError>) -> Discarded {
        let (reply, _) = self.reply();
        assert_eq!(reply.result, result, "{what}");
        Discarded { late: None, ..reply.discarded }
    }

    /// The line still works, and says what it is asked.
    fn expect_the_next_reading_right(&mut self, what: &str) {
        self.ask(&two_inputs()).wait(5).hears(framed("01 04 04 00 2A 00 2B"));
        self.expect(what, words(&[42, 43]));
    }
}

/// What a guard counts, in the order of `Discarded`: noise bytes, late, foreign, echoes, checksum errors.
fn counts(counts: [u32; 5]) -> Discarded {
    let [noise_bytes, late_replies, foreign_frames, echoes, checksum_errors] = counts;
    Discarded { noise_bytes, late_replies, foreign_frames, echoes, checksum_errors, ..Discarded::default() }
}

#[test]
fn whatever_comes_only_the_answer_is_taken_and_the_rest_is_counted_as_what_it_was() {
    let good = "01 04 04 00 01 00 02";
    let join = |parts: &[Vec<u8>]| parts.concat();
    let noise: Vec<u8> = (0..30).map(|index| 0x81 + index * 3).collect();
    let mut bad = framed(good);
    bad[4] ^= 0x10;
    let mut long = framed(good);
    long.insert(4, 0x55);
    let mut another = framed(good);
    another[0] = 9;
    let answer = words(&[1, 2]);
    let checksum = Err(RequestError::Checksum);
    let wrong = Err(RequestError::WrongFrame);
    for (what, bytes, result, counted) in [
        ("the answer", framed(good), answer.clone(), [0, 0, 0, 0, 0]),
        ("an exception", framed("01 84 02"), Err(RequestError::Exception(2)), [0, 0, 0, 0, 0]),
        ("nothing", vec![], Err(RequestError::Timeout), [0, 0, 0, 0, 0]),
        ("a zero byte first", join(&[vec![0], framed(good)]), answer.clone(), [1, 0, 0, 0, 0]),
        ("noise first", join(&[noise.clone(), framed(good)]), answer.clone(), [30, 0, 0, 0, 0]),
        ("noise behind", join(&[framed(good), vec![0xFF; 3]]), answer.clone(), [0, 0, 0, 0, 0]),
        ("the unit's byte first", join(&[vec![1], framed(good)]), answer.clone(), [1, 0, 0, 0, 0]),
        ("one noise byte alone", vec![0], Err(RequestError::Timeout), [1, 0, 0, 0, 0]),
        ("noise alone", noise, checksum.clone(), [0, 0, 0, 0, 1]),
        ("a wrong bit", bad.clone(), checksum.clone(), [0, 0, 0, 0, 1]),
        ("half a reply", framed(good)[..5].to_vec(), checksum.clone(), [0, 0, 0, 0, 1]),
        ("a byte too many", long, checksum.clone(), [0, 0, 0, 0, 1]),
        ("a damaged one first", join(&[bad, framed(good)]), answer.clone(), [0, 0, 0, 0, 1]),
        ("a damaged unit", another, checksum, [0, 0, 0, 0, 1]),
        ("another unit", framed("02 04 04 00 01 00 02"), wrong.clone(), [0, 0, 1, 0, 0]),
        ("another function", framed("01 03 04 00 01 00 02"), wrong.clone(), [0, 0, 1, 0, 0]),
        ("another count", framed("01 04 02 00 01"), wrong.clone(), [0, 0, 1, 0, 0]),
        ("a larger count", framed("01 04 06 00 01 00 02 00 03"), wrong.clone(), [0, 0, 1, 0, 0]),
        ("another's exception", framed("02 84 02"), wrong.clone(), [0, 0, 1, 0, 0]),
        ("a function nobody knows", framed("05 64 01 02 03"), wrong, [0, 0, 1, 0, 0]),
        ("foreign first", join(&[framed("02 04 02 00 01"), framed(good)]), answer, [0, 0, 1, 0, 0]),
    ] {
        let mut scene = Scene::without_echo();
        scene.ask(&two_inputs()).wait(8).hears(bytes.clone());
        assert_eq!(scene.expect(what, result.clone()), counts(counted), "{what}");
        scene.expect_the_next_reading_right(what);

        let mut scene = Scene::without_echo();
        scene.ask(&two_inputs());
        for byte in bytes {
            scene.wait(3).hears(vec![byte]);
            if scene.reply.is_some() {
                break;
            }
        }
        assert_eq!(scene.expect(what, result), counts(counted), "{what}, in single bytes");
    }
}

#[test]
fn a_damaged_reply_is_told_as_soon_as_the_line_is_silent() {
    let mut bad = framed("01 04 04 00 01 00 02");
    bad[4] ^= 1;
    for (what, length, at_most) in [("whole", 9, 30), ("short", 6, 110)] {
        let mut scene = Scene::without_echo();
        scene.ask(&two_inputs()).wait(8).hears(bad[..length].to_vec());
        let (reply, after) = scene.reply();
        assert_eq!(reply.result, Err(RequestError::Checksum), "{what}");
        assert!(after <= Duration::from_millis(at_most), "{what}: {after:?}");
    }
}

#[test]
fn the_timeout_counts_from_the_requests_last_bit_and_waits_while_bytes_flow() {
    let mut scene = Scene::new();
    let (reply, after) = scene.ask(&two_inputs()).reply();
    assert_eq!(reply.result, Err(RequestError::Timeout));
    assert_eq!(after, Time(0) + TIMEOUT + LINE.characters(8) - Time(0));

    let mut scene = Scene::new();
    let good = framed("01 04 04 00 01 00 02");
    scene.ask(&two_inputs()).wait(198).hears(good[..4].to_vec()).wait(30).hears(good[4..].to_vec());
    scene.expect("a reply that began in time", words(&[1, 2]));

    // A line that babbles does not hold the request for ever.
    let mut scene = Scene::new();
    scene.ask(&two_inputs());
    while scene.reply.is_none() && scene.now - scene.sent_at < Duration::from_secs(2) {
        scene.wait(1).hears(vec![0xAA]);
    }
    let (reply, after) = scene.reply();
    assert_eq!(reply.result, Err(RequestError::Checksum));
    assert!(after < Duration::from_millis(500), "{after:?}");
}

#[test]
fn a_frame_that_waits_for_its_transceiver_is_given_that_time_too() {
    let delay = Duration::from_millis(40);
    let mut scene = Scene::new();
    scene.guard = Guard::new(LINE, None, None).with_delay_before_send(delay);
    let (reply, after) = scene.ask(&two_inputs()).reply();
    assert_eq!(reply.result, Err(RequestError::Timeout));
    assert_eq!(after, Time(0) + delay + TIMEOUT + LINE.characters(8) - Time(0));
}

#[test]
fn before_each_request_the_line_is_silent() {
    let mut scene = Scene::without_echo();
    let answered_at = scene.now;
    scene.ask(&two_inputs());
    assert_eq!(scene.now, answered_at + whole_micros(LINE.frame_gap()));

    // Bytes that come before it is sent put it off, but not for ever.
    let mut scene = Scene::without_echo();
    assert_eq!(scene.guard.begin(scene.now, &two_inputs(), TIMEOUT), None);
    scene.wait(1).hears(vec![0x55]);
    assert_eq!(scene.guard.earliest_send(scene.now), scene.now + whole_micros(LINE.frame_gap()));
    let begun_at = scene.now;
    while scene.guard.earliest_send(scene.now) > scene.now {
        scene.wait(1).hears(vec![0x55]);
        assert!(scene.now - begun_at < Duration::from_millis(1100));
    }
}

#[test]
fn no_gap_is_shorter_than_the_stop_bits_of_the_byte_before() {
    let two = Line { stop_bits: 2, parity: Parity::None, baud: 300 };
    for (what, line, gap, micros) in [
        ("a wide one", LINE, Some(9_000), 9_000),
        ("a narrow one", LINE, Some(100), 100),
        ("none, as long as it lasts", LINE, Some(0), 53),
        ("two stop bits on a slow line", two, Some(100), 6_667),
        ("3.5 characters", LINE, None, 2_006),
        ("3.5 characters with two stop bits", two, None, 128_334),
        ("a fast line", Line { baud: 115_200, ..LINE }, None, 1_750),
    ] {
        let guard = Guard::new(line, gap.map(Duration::from_micros), None);
        assert_eq!(guard.gap, Duration::from_micros(micros), "{what}");
    }
}

#[test]
fn a_late_reply_in_the_quarantine_is_dropped_and_ends_it() {
    let mut scene = Scene::without_echo();
    scene.ask(&two_inputs());
    scene.expect("no answer", Err(RequestError::Timeout));
    let given_up_at = scene.now;
    assert_eq!(scene.guard.begin(scene.now, &two_inputs(), TIMEOUT), None);
    assert_eq!(scene.guard.earliest_send(scene.now), given_up_at + TIMEOUT);
    scene.wait(50).hears(framed("01 04 04 00 63 00 63"));
    let sent_at = scene.guard.earliest_send(scene.now);
    assert_eq!(sent_at, scene.now + whole_micros(LINE.frame_gap()));
    scene.now = sent_at;
    scene.guard.sent(scene.now);
    scene.wait(5).hears(framed("01 04 04 00 01 00 02"));
    assert_eq!(scene.expect("the next", words(&[1, 2])), counts([0, 1, 0, 0, 0]));
}

#[test]
fn a_reply_later_than_the_quarantine_is_told_apart_by_unit_function_and_count() {
    let late = framed("01 04 04 00 63 00 63");
    for (what, request, reply, answer) in [
        ("another unit", read(2, Table::Input, 0, 2), "02 04 04 00 01 00 02", words(&[1, 2])),
        ("another function", read(1, Table::Holding, 0, 2), "01 03 04 00 01 00 02", words(&[1, 2])),
        ("another count", read(1, Table::Input, 0, 1), "01 04 02 00 01", words(&[1])),
    ] {
        let mut scene = Scene::without_echo();
        scene.ask(&two_inputs());
        scene.expect("no answer", Err(RequestError::Timeout));
        scene.ask(&request).wait(5).hears(late.clone()).wait(20).hears(framed(reply));
        assert_eq!(scene.expect(what, answer), counts([0, 1, 0, 0, 0]), "{what}");
        scene.expect_the_next_reading_right(what);
    }
}

#[test]
fn a_reply_that_might_be_the_late_one_is_believed_only_if_no_second_follows() {
    let mut scene = Scene::without_echo();
    scene.ask(&two_inputs());
    scene.expect("no answer", Err(RequestError::Timeout));
    scene.ask(&two_inputs()).wait(5).hears(framed("01 04 04 00 63 00 63")).wait(20);
    assert_eq!(scene.reply, None);
    scene.hears(framed("01 04 04 00 01 00 02"));
    assert_eq!(scene.expect("the second", words(&[1, 2])), counts([0, 1, 0, 0, 0]));
    scene.expect_the_next_reading_right("after the second");

    let mut scene = Scene::without_echo();
    scene.ask(&two_inputs());
    scene.expect("no answer", Err(RequestError::Timeout));
    scene.ask(&two_inputs()).wait(5).hears(framed("01 04 04 00 01 00 02"));
    let (reply, after) = scene.reply();
    assert_eq!(reply.result, words(&[1, 2]));
    assert!(after >= TIMEOUT, "{after:?}");
    let before = scene.now;
    scene.expect_the_next_reading_right("after a believed one");
    assert!(scene.now - before < Duration::from_millis(20), "only once");
}

#[test]
fn behind_several_late_replies_the_answer_is_the_one_in_its_place() {
    let stale = framed("01 04 04 00 63 00 63");
    let unanswered_twice = || {
        let mut scene = Scene::without_echo();
        for _ in 0..2 {
            scene.ask(&two_inputs());
            scene.expect("no answer", Err(RequestError::Timeout));
        }
        scene.ask(&two_inputs()).wait(5).hears(stale.clone()).wait(5).hears(stale.clone()).wait(5);
        scene
    };
    let mut scene = unanswered_twice();
    assert_eq!(scene.reply, None);
    scene.hears(framed("01 04 04 00 01 00 02"));
    assert_eq!(scene.expect("the third", words(&[1, 2])), counts([0, 2, 0, 0, 0]));
    scene.expect_the_next_reading_right("after the third");

    // The deadline comes first: both are late ones.
    scene = unanswered_twice();
    assert_eq!(scene.expect("none of the two", Err(RequestError::Timeout)), counts([0, 2, 0, 0, 0]));
}

#[test]
fn a_repeated_write_may_be_confirmed_by_the_earlier_one_and_what_lies_between_is_still_to_come() {
    let mut scene = Scene::without_echo();
    let relay = frame(1, &pdu::encode(&set_relay().call).expect("a request that can be asked"));
    for request in [set_relay(), two_inputs()] {
        scene.ask(&request);
        scene.expect("no answer", Err(RequestError::Timeout));
    }
    scene.ask(&set_relay()).wait(5).hears(relay.clone());
    scene.expect("the earlier one's", Ok(Answer::Written));
    scene.ask(&two_inputs()).wait(5).hears(framed("01 04 04 00 63 00 63")).wait(1).hears(relay).wait(1);
    assert_eq!(scene.reply, None);
    scene.hears(framed("01 04 04 00 01 00 02"));
    assert_eq!(scene.expect("the read's own", words(&[1, 2])), counts([0, 2, 0, 0, 0]));
}

#[test]
fn another_masters_requests_are_counted_with_the_unit_they_were_to() {
    let relay = "03 05 00 00 FF 00";
    for (what, frames, count, unit) in [
        ("a read and its reply", &["07 03 00 00 00 02", "07 03 04 00 01 00 02"][..], 1, 7),
        ("a reply alone", &["07 03 04 00 01 00 02"], 0, 0),
        ("an exception", &["07 83 02"], 0, 0),
        ("24 coils, as long as a request", &["07 01 03 FF FF FF"], 0, 0),
        ("a write and its confirmation", &[relay, relay], 1, 3),
        ("the same write twice", &[relay, relay, relay, relay], 2, 3),
        ("two writes", &[relay, relay, "03 06 00 01 00 02", "03 06 00 01 00 02"], 2, 3),
        ("many registers", &["09 10 00 01 00 01 02 00 05", "09 10 00 01 00 01"], 1, 9),
        ("a broadcast", &["00 06 00 01 00 02"], 1, 0),
    ] {
        let mut scene = Scene::without_echo();
        for frame in frames {
            scene.wait(20).hears(framed(frame));
        }
        scene.wait(20).ask(&two_inputs()).wait(5).hears(framed("01 04 04 00 2A 00 2B"));
        let counted = scene.expect(what, words(&[42, 43]));
        assert_eq!(counted.requests_of_others, RequestsOfOthers { count, unit }, "{what}");
        assert_eq!(counted.foreign_frames as usize, frames.len(), "{what}");
    }
}

#[test]
fn a_broadcast_writes_without_an_answer_and_never_reads() {
    let mut scene = Scene::new();
    let refused = scene.guard.begin(scene.now, &read(0, Table::Input, 0, 1), TIMEOUT);
    assert!(matches!(refused.map(|reply| reply.result), Some(Err(RequestError::Impossible(_)))));
    let everyone = Request::new(0, Call::WriteRegister { address: 5, word: 1 });
    let (reply, after) = scene.ask(&everyone).reply();
    assert_eq!(reply.result, Ok(Answer::Written));
    assert_eq!(after, Time(0) + LINE.characters(8) + TURNAROUND - Time(0));
    scene.expect_the_next_reading_right("after a broadcast");
}

#[test]
fn an_exception_of_another_function_is_taken_only_where_the_device_is_known_for_it() {
    let call = Call::WriteRegister { address: 0, word: 99 };
    let mut strange = Request::new(1, call.clone());
    strange.any_exception = true;
    let mut scene = Scene::without_echo();
    scene.ask(&strange).wait(3).hears(framed("01 84 03"));
    scene.expect("the quirk", Err(RequestError::Exception(3)));
    scene.ask(&Request::new(1, call)).wait(3).hears(framed("01 84 03"));
    scene.expect("no quirk", Err(RequestError::WrongFrame));
}

#[test]
fn long_and_split_replies_of_functions_8_17_and_43_arrive_whole() {
    let echo = Call::Diagnostics { function: 0, data: vec![0xA537, 0x0102] };
    let names = Call::ReadIdentification { code: 1, object: 0 };
    let text = |objects: &[(u8, &str)], next| {
        let objects = objects.iter().map(|(number, text)| (*number, (*text).to_owned())).collect();
        Ok(Answer::Identification(crate::engine::modbus::Identification { conformity: 1, next, objects }))
    };
    for (call, reply, answer) in [
        (echo, "12 08 00 00 A5 37 01 02", Ok(Answer::Diagnostics(vec![0xA537, 0x0102]))),
        (Call::ReportServerId, "12 11 02 41 FF", Ok(Answer::ServerId(vec![0x41, 0xFF]))),
        (names, "12 2B 0E 01 01 00 00 02 00 02 4D 43 01 03 44 4F 34", text(&[(0, "MC"), (1, "DO4")], None)),
    ] {
        let bytes = framed(reply);
        for split in 1..bytes.len() {
            let mut scene = Scene::without_echo();
            scene.ask(&Request::new(18, call.clone()));
            scene.wait(6).hears(bytes[..split].to_vec()).wait(9).hears(bytes[split..].to_vec());
            scene.expect(&format!("{call}, split after {split}"), answer.clone());
        }
    }
}

#[test]
fn a_lost_link_ends_the_request_and_forgets_the_line() {
    let mut scene = Scene::without_echo();
    scene.ask(&two_inputs()).wait(3).hears(raw("01 04"));
    let reply = scene.guard.link_lost(scene.now, "unplugged").expect("a request was on its way");
    assert_eq!(reply.result, Err(RequestError::Link("unplugged".into())));
    assert_eq!(scene.guard.link_lost(scene.now, "unplugged"), None);
    assert!(scene.guard.echo.is_possible() && !scene.guard.echo.is_certain());
    scene.expect_the_next_reading_right("after the link is back");
}

proptest! {
    /// Whole or byte by byte, the same is understood; and no bytes make it stumble.
    #[test]
    fn the_same_bytes_give_the_same_reply_in_any_pieces(
        pieces in proptest::collection::vec(piece(), 0..8),
        cuts in proptest::collection::vec(1usize..12, 1..40),
        write in any::<bool>(),
        unanswered in any::<bool>(),
    ) {
        let bytes = pieces.concat();
        let run = |cuts: &[usize]| {
            let mut scene = Scene::new();
            if unanswered {
                scene.ask(&two_inputs());
                scene.expect("no answer", Err(RequestError::Timeout));
            }
            scene.ask(&if write { set_relay() } else { two_inputs() });
            let mut rest = &bytes[..];
            for cut in cuts.iter().cycle() {
                let (piece, tail) = rest.split_at((*cut).min(rest.len()));
                scene.hears(piece.to_vec());
                rest = tail;
                if rest.is_empty() || scene.reply.is_some() {
                    break;
                }
            }
            scene.reply().0.result
        };
        let whole = run(&[usize::MAX]);
        prop_assert_eq!(&whole, &run(&[1]));
        prop_assert_eq!(&whole, &run(&cuts));
    }

    /// What is delivered stood in the bytes as a whole frame with a right checksum.
    #[test]
    fn nothing_is_delivered_that_no_frame_said(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
        let mut scene = Scene::without_echo();
        scene.ask(&two_inputs()).wait(3).hears(bytes.clone());
        if let Ok(Answer::Words(words)) = scene.reply().0.result {
            let reply = framed(&format!(
                "01 04 04 {:02X} {:02X} {:02X} {:02X}",
                words[0] >> 8, words[0] & 0xFF, words[1] >> 8, words[1] & 0xFF
            ));
            prop_assert!(bytes.windows(reply.len()).any(|window| window == reply));
        }
    }
}

/// Something that may be on a line: noise, good replies, damaged, foreign, echoes.
fn piece() -> impl Strategy<Value = Vec<u8>> {
    let request = frame(1, &pdu::encode(&two_inputs().call).expect("a request that can be asked"));
    let relay = frame(1, &pdu::encode(&set_relay().call).expect("a request that can be asked"));
    prop_oneof![
        proptest::collection::vec(any::<u8>(), 0..20),
        any::<[u8; 4]>().prop_map(|word| framed(&format!(
            "01 04 04 {}",
            word.map(|byte| format!("{byte:02X}")).join(" ")
        ))),
        Just(framed("01 84 02")),
        Just(raw("01 04 04 00 01 00")),
        Just(raw("01 04")),
        Just(framed("02 04 02 00 01")),
        Just(request),
        Just(relay),
    ]
}
