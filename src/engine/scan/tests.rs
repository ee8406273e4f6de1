//! Scans of lines that are a function, on a time that is only counted.

use std::sync::Arc;

use super::*;
use crate::engine::device::Identify;
use crate::engine::modbus::{Answer, Identification, LateReply, RequestsOfOthers};
use crate::engine::settings::{Link, Parity, Rs485};

const EVEN: Line = SPECIFIED;
const NONE: Line = Line { baud: 9600, parity: Parity::None, stop_bits: 1 };

type Result = std::result::Result<Answer, RequestError>;

/// What a line does with a question, and what was thrown away on the way.
type Behaviour<'a> = &'a mut dyn FnMut(Option<Line>, u8, &Call) -> (Result, Discarded);

fn relay() -> Result {
    let objects = [(0, "ACME"), (1, "RA8")].map(|(number, text)| (number, text.to_string())).to_vec();
    Ok(Answer::Identification(Identification { conformity: 1, next: None, objects }))
}

fn silence() -> (Result, Discarded) {
    (Err(RequestError::Timeout), Discarded::default())
}

fn clean(result: Result) -> (Result, Discarded) {
    (result, Discarded::default())
}

/// A device that knows nothing but its names.
fn named(call: &Call) -> Result {
    match call {
        Call::ReadIdentification { .. } => relay(),
        _ => Err(RequestError::Exception(1)),
    }
}

fn wanted(lines: Vec<Line>, units: impl IntoIterator<Item = u8>) -> Wanted {
    let relay = Identify::Names { vendor: "ACME".into(), product: "RA8".into() };
    Wanted {
        lines,
        units: units.into_iter().collect(),
        known: Arc::new(vec![("acme/ra8".into(), relay)]),
        nameless: vec!["acme/mute".into()],
        timeout: None,
        of_server: false,
    }
}

/// What was asked, one word for each question, until the end or until `most` questions.
struct Run {
    scan: Scan,
    asked: Vec<(Option<Line>, u8, String)>,
    news: Vec<String>,
    took: Duration,
}

fn run(wanted: Wanted, most: usize, line: Behaviour<'_>) -> Run {
    let mut scan = Scan::new(wanted);
    let (mut asked, mut news, mut took) = (Vec::new(), Vec::new(), Duration::ZERO);
    while asked.len() < most {
        let Some(Question { line: on, request, timeout }) = scan.next_question() else { break };
        assert!(!request.call.is_write() && request.unit != 0, "{request:?}");
        asked.push((on, request.unit, request.call.to_string()));
        let (result, mut discarded) = line(on, request.unit, &request.call);
        let wait = if result == Err(RequestError::Timeout) { timeout } else { Duration::from_millis(10) };
        took += wait + on.map_or(Duration::ZERO, |on| on.characters(REQUEST_CHARACTERS));
        let times = result.is_ok().then_some((Time::from_millis(5), Time::from_millis(9)));
        scan.answered(&Reply::new(result, Time(0), times, &mut discarded));
        news.extend(std::iter::from_fn(|| scan.next_news()));
    }
    Run { scan, asked, news, took }
}

impl Run {
    fn found(&self) -> Vec<u8> {
        self.scan.found.keys().copied().collect()
    }

    fn configuration(self) -> Option<String> {
        self.scan.report(true).configuration(&Link::Serial {
            path: "/dev/ttyUSB0".into(),
            line: NONE,
            rs485: Rs485::Auto,
        })
    }

    /// How often this unit was asked for its names there.
    fn names_asked(&self, line: Line, unit: u8) -> usize {
        let fits = |asked: &&(Option<Line>, u8, String)| {
            asked.0 == Some(line) && asked.1 == unit && asked.2.starts_with("identification")
        };
        self.asked.iter().filter(fits).count()
    }
}

#[test]
fn settings_are_tried_in_their_order_until_somebody_answers_and_then_only_those() {
    let run = run(wanted(lines(None, None, None), 1..=247), usize::MAX, &mut |line, unit, call| match (
        line == Some(NONE),
        unit,
    ) {
        (true, 30 | 200) => clean(named(call)),
        _ => silence(),
    });
    assert_eq!(run.found(), [30, 200]);
    let lines: BTreeSet<String> =
        run.asked.iter().filter_map(|(line, ..)| *line).map(|line| line.to_string()).collect();
    assert_eq!(lines.into_iter().collect::<Vec<_>>(), ["19200 8E1", "9600 8N1"]);
    assert_eq!(run.names_asked(EVEN, 33), 0, "the likely units come first");
    assert_eq!(run.names_asked(NONE, 247), 1);
    assert!(run.news[0].contains("the line has 9600 8N1"), "{:?}", run.news);
    let expected = "\
# Found by `busker scan`: units 1..247 were asked at 9600 8N1.
buses:
  line:
    serial: \"/dev/ttyUSB0\"
    baud: 9600
    parity: none
devices:
  # ACME RA8
  ra8_30:
    profile: acme/ra8
    bus: line
    unit: 30
  # ACME RA8
  ra8_200:
    profile: acme/ra8
    bus: line
    unit: 200
";
    assert_eq!(run.configuration().as_deref(), Some(expected));
}

#[test]
fn a_device_that_is_silent_to_what_it_does_not_know_is_found_by_a_register() {
    let run =
        run(wanted(vec![EVEN, NONE], 1..=40), usize::MAX, &mut |line, unit, call| match (line, unit, call) {
            (Some(NONE), 35, Call::Read(_)) => clean(Err(RequestError::Exception(2))),
            _ => silence(),
        });
    assert_eq!(run.found(), [35]);
    let configuration = run.configuration().expect("a device");
    assert!(
        configuration.contains("devices: {}\n  # Unit 35 answers: it does not tell who it is; no profile"),
        "{configuration}"
    );
    assert!(configuration.contains("acme/mute"), "{configuration}");
}

#[test]
fn when_nobody_answers_every_unit_has_been_asked_twice_with_all_settings_in_the_time_that_was_said() {
    let all = wanted(lines(None, None, None), 1..=247);
    let at_most = Scan::new(all.clone()).at_most();
    let run = run(all, usize::MAX, &mut |_, _, _| silence());
    assert_eq!(run.asked.len(), 24 * 247 * 2);
    let more = run.took.saturating_sub(at_most);
    assert!(run.took >= at_most && more < Duration::from_secs(30), "{at_most:?} {:?}", run.took);
    assert!(at_most < Duration::from_secs(20 * 60), "{at_most:?}");
    assert_eq!(run.scan.at_most(), Duration::ZERO);
    let report = run.scan.report(true);
    assert!(report.is_empty());
    let why = report.why_empty();
    assert!(why.starts_with("none of the units 1..247 answers with any of 24 settings; look at"), "{why}");
}

#[test]
fn with_known_settings_a_line_takes_half_a_minute() {
    let scan = Scan::new(wanted(vec![EVEN], 1..=247));
    assert!((30..35).contains(&scan.at_most().as_secs()), "{:?}", scan.at_most());
    assert_eq!(scan.at_most(), scan.at_best());
}

#[test]
fn a_late_answer_is_asked_for_again_with_all_patience() {
    let late = Discarded { foreign_frames: 1, ..Discarded::default() };
    let mut asked = BTreeMap::new();
    let run = run(wanted(vec![EVEN], 1..=20), usize::MAX, &mut |_, unit, call| {
        let times = asked.entry(unit).or_insert(0);
        *times += 1;
        match (unit, *times) {
            // Its answer comes in the time of the next unit.
            (8, 1) => (Err(RequestError::WrongFrame), late),
            (7, 2..) => clean(named(call)),
            _ => silence(),
        }
    });
    assert_eq!(run.found(), [7]);
    assert!(run.scan.garbled.is_empty(), "{:?}", run.scan.garbled);
}

#[test]
fn an_answer_that_comes_when_many_others_have_been_asked_is_not_forgotten() {
    let late = LateReply { unit: 2, after: Duration::from_millis(900) };
    let late = Discarded { late_replies: 1, late: Some(late), ..Discarded::default() };
    let mut times = 0;
    let run = run(wanted(vec![EVEN], 1..=20), usize::MAX, &mut |_, unit, call| {
        times += usize::from(unit == 2);
        match unit {
            12 => (Err(RequestError::Timeout), if times == 1 { late } else { Discarded::default() }),
            2 if times > 1 => clean(named(call)),
            _ => silence(),
        }
    });
    assert_eq!(run.found(), [2]);
    assert_eq!(run.names_asked(EVEN, 2), 3, "in its turn, since it was late, and for who it is");
}

#[test]
fn who_always_answers_damaged_is_told_and_not_taken_for_a_device() {
    let run = run(wanted(vec![EVEN], 1..=20), usize::MAX, &mut |_, unit, call| match unit {
        3 => clean(Err(RequestError::Checksum)),
        5 => clean(named(call)),
        _ => silence(),
    });
    assert_eq!(run.found(), [5]);
    assert_eq!(run.names_asked(EVEN, 3), 4, "once, and three times with patience");
    let told = "unit 3 answers at 19200 8E1, but not so that it can be understood: checksum error; two devices may \
                have this unit";
    assert!(run.news.iter().any(|news| news.starts_with(told)), "{:?}", run.news);
    let configuration = run.configuration().expect("a device");
    assert!(configuration.contains(&format!("# {told}")), "{configuration}");
    assert!(!configuration.contains("unit: 3"), "{configuration}");
}

#[test]
fn a_damaged_answer_now_and_then_is_repeated_and_told() {
    let mut count = 0;
    let run = run(wanted(vec![EVEN], 5..=5), usize::MAX, &mut |_, _, call| {
        count += 1;
        if count % 2 == 0 { clean(Err(RequestError::Checksum)) } else { clean(named(call)) }
    });
    assert_eq!(run.found(), [5]);
    let configuration = run.configuration().expect("a device");
    assert!(
        configuration.contains("of its answers were damaged: two devices may have this unit"),
        "{configuration}"
    );
    assert!(configuration.contains("profile: acme/ra8"), "{configuration}");
}

#[test]
fn who_answers_once_and_never_again_ends_the_scan_all_the_same() {
    let run = run(wanted(vec![EVEN], 5..=5), 1000, &mut |_, _, call| match call {
        Call::ReadIdentification { .. } => clean(Err(RequestError::Checksum)),
        _ => silence(),
    });
    assert!(run.asked.len() < 100, "{}", run.asked.len());
    let mut times = 0;
    let run = self::run(wanted(vec![EVEN], 5..=5), 1000, &mut |_, _, call| {
        times += 1;
        // It answers what the sweep asks, and nothing of the interview.
        if times % 5 == 1 { clean(named(call)) } else { silence() }
    });
    assert!(run.asked.len() < 100, "{}", run.asked.len());
}

#[test]
fn another_master_is_told_once() {
    let requests_of_others = RequestsOfOthers { count: 2, unit: 9 };
    let heard = Discarded { requests_of_others, ..Discarded::default() };
    let run = run(wanted(vec![EVEN], 1..=4), usize::MAX, &mut |_, _, _| (Err(RequestError::Timeout), heard));
    assert_eq!(run.news, [report::OTHER_MASTER]);
    assert_eq!(run.scan.report(true).notes(), [report::OTHER_MASTER]);
}

#[test]
fn one_device_that_does_not_look_at_the_unit_is_one_device() {
    let everybody = run(wanted(vec![], 1..=247), usize::MAX, &mut |_, _, call| clean(named(call)));
    assert_eq!(everybody.found().len(), 247);
    let text =
        everybody.scan.report(true).configuration(&Link::Tcp { host: "192.168.1.20".into(), port: 502 });
    let text = text.expect("a device");
    assert!(text.contains("tcp: \"192.168.1.20:502\"") && text.contains("  ra8_1:\n"), "{text}");
    assert!(!text.contains("ra8_2"), "{text}");
    // On a line so many alike are so many.
    let few = run(wanted(vec![EVEN], 1..=40), usize::MAX, &mut |_, _, call| clean(named(call)));
    assert!(few.configuration().is_some_and(|text| text.contains("ra8_40")));
}

#[test]
fn whom_a_gateway_calls_absent_is_not_asked_again() {
    let run = run(wanted(vec![], 1..=10), usize::MAX, &mut |_, unit, call| match unit {
        4 => clean(named(call)),
        _ => clean(Err(RequestError::Unreachable(11))),
    });
    assert_eq!(run.found(), [4]);
    let sweeps = run.asked.iter().filter(|(_, unit, _)| *unit != 4).count();
    assert_eq!(sweeps, 9);
}

#[test]
fn settings_that_the_port_does_not_take_are_left_out_and_a_port_that_is_gone_ends_it() {
    let mut scan = Scan::new(wanted(vec![EVEN, NONE], 1..=3));
    let question = scan.next_question().expect("a question");
    assert_eq!(question.line, Some(EVEN));
    assert_eq!(scan.not_opened(&question, "no such speed".into(), true), Ok(()));
    let question = scan.next_question().expect("a question");
    assert_eq!(question.line, Some(NONE));
    assert_eq!(scan.next_news().as_deref(), Some("19200 8E1 is left out: no such speed"));
    assert_eq!(scan.not_opened(&question, "not there".into(), false), Err("not there".into()));
    assert_eq!(scan.lost(question, "unplugged".into()), Err("unplugged".into()));
}

/// What a server does with its connection when it is asked.
enum Manner {
    Answers(Result),
    AnswersAndCloses(Result),
    Closes,
}

/// Asks units of a server; gives the scan, its news, and how often each of the units was asked for its names.
fn run_at_server(
    units: impl IntoIterator<Item = u8>,
    line: Vec<Line>,
    server: impl Fn(u8, &Call) -> Manner,
) -> (Scan, Vec<String>, BTreeMap<u8, u32>) {
    let mut scan = Scan::new(Wanted { of_server: true, ..wanted(line, units) });
    let (mut is_open, mut names) = (true, BTreeMap::new());
    for asked in 0.. {
        let Some(question) = scan.next_question() else { break };
        assert!(asked < 1000, "it does not end");
        if !std::mem::replace(&mut is_open, true) {
            scan.lost(question, "closed".into()).expect("another connection is as good");
            continue;
        }
        let Request { unit, call, .. } = &question.request;
        *names.entry(*unit).or_default() += u32::from(matches!(call, Call::ReadIdentification { .. }));
        match server(*unit, call) {
            Manner::Closes => scan.lost(question, "closed".into()).expect("another connection is as good"),
            Manner::Answers(result) => scan.answered(&reply(result)),
            Manner::AnswersAndCloses(result) => {
                scan.answered(&reply(result));
                is_open = false;
            }
        }
    }
    let news = std::iter::from_fn(|| scan.next_news()).collect();
    (scan, news, names)
}

fn reply(result: Result) -> Reply {
    let times = result.is_ok().then_some((Time::from_millis(5), Time::from_millis(9)));
    Reply::new(result, Time(0), times, &mut Discarded::default())
}

#[test]
fn a_server_that_closes_behind_each_answer_is_connected_to_again_for_the_same_question() {
    for line in [vec![], vec![EVEN]] {
        let (scan, news, names) = run_at_server(1..=4, line, |unit, call| match unit {
            2 | 3 => Manner::AnswersAndCloses(named(call)),
            _ => Manner::AnswersAndCloses(Err(RequestError::Timeout)),
        });
        assert_eq!(scan.found.keys().copied().collect::<Vec<_>>(), [2, 3]);
        assert_eq!(names, [(1, 1), (2, 2), (3, 2), (4, 1)].into(), "the sweep, and who it is");
        assert!(!news.iter().any(|news| news.contains("ends the connection")), "{news:?}");
        assert!(scan.report(true).notes().is_empty());
    }
}

#[test]
fn a_gateway_that_hangs_up_on_who_is_not_there_is_asked_on() {
    let (scan, news, names) = run_at_server(1..=6, vec![], |unit, call| match unit {
        4 => Manner::Answers(named(call)),
        _ => Manner::Closes,
    });
    assert_eq!(scan.found.keys().copied().collect::<Vec<_>>(), [4]);
    assert_eq!(news[0], "the other side ends the connection when unit 1 is asked; that counts as silence");
    assert_eq!(news.len(), 2, "told once: {news:?}");
    // Unit 5 came behind answers on its connection, which may have been closed for any reason.
    assert_eq!(names, [(1, 1), (2, 1), (3, 1), (4, 2), (5, 2), (6, 1)].into());
    assert_eq!(scan.report(true).notes(), ["10 questions ended the connection; that counted as silence"]);

    let (scan, ..) = run_at_server(1..=6, vec![], |_, _| Manner::Closes);
    let why = scan.report(true).why_empty();
    assert!(why.contains("ends the connection when it is asked: it may be no Modbus server"), "{why}");
}
