//! Whoever asks without end stretches what is polled, but never keeps it from the wire; and what a
//! watchdog needs comes in time.

use std::collections::BTreeMap;
use std::sync::Arc;

use busker::engine::address::{Span, Table};
use busker::engine::bus::{Action, Bus, Command, Event};
use busker::engine::memory::Memories;
use busker::engine::modbus::{Answer, Call, Discarded, Reply, Request};
use busker::engine::request::{self, Verb, Wish};
use busker::engine::time::{Duration, Time};
use busker::engine::transaction::Transaction;

use crate::devices;

/// Unit 9 is polled each second and nobody asks for it; unit 20 wants to hear something every 0.6 s.
const DEVICES: &str = "device board_1 1 clamping\ndevice board_2 2 clamping\ndevice heating 3 thermometer\n\
    device garden 9 thermometer\ndevice relays 20 relays\n";
const WATCHDOG: Duration = Duration::from_millis(600);
/// How long a request and its answer take.
const TRANSACTION: Duration = Duration::from_millis(20);
const MINUTE: Time = Time::from_millis(60_000);

/// What somebody does at each moment.
type Flood = fn(&mut Bus, Time);

#[test]
fn a_flood_lets_polls_through() {
    for flood in [move_sliders, get] {
        let asked = play(flood);
        let polls: Vec<Time> =
            asked.iter().filter(|(_, unit, first)| (*unit, *first) == (9, 0)).map(|asked| asked.0).collect();
        assert!(polls.len() >= 30, "{} polls in a minute", polls.len());
        assert!(longest(&polls) < Duration::from_secs(2), "{:?} without a poll", longest(&polls));
    }
}

#[test]
fn a_watchdog_is_fed_in_time() {
    for flood in [move_sliders as Flood, get, nothing] {
        let asked = play(flood).into_iter().filter(|asked| asked.1 == 20);
        // Its time is known once it has been read.
        let requests: Vec<Time> = asked.skip_while(|asked| asked.2 != 66).map(|asked| asked.0).collect();
        assert!(longest(&requests) < WATCHDOG - TRANSACTION, "{:?} without a request", longest(&requests));
    }
}

#[test]
fn a_watchdog_that_no_line_could_feed_in_time_is_put_right_by_a_command() {
    let asked = play_with(1, |bus, now| {
        if now == Time::from_millis(10_000) {
            let (device, point, payload) = ("relays".into(), "watchdog".into(), "0".into());
            bus.handle(now, Event::Command(Command { device, point, payload, retained: false }));
        }
    });
    let asked_between = |from: u64, to: u64| {
        let within = Time::from_millis(from)..Time::from_millis(to);
        asked.iter().filter(|asked| asked.1 == 20 && within.contains(&asked.0)).count()
    };
    // Before it, the line is full of feedings; a second later there are its polls.
    assert!(asked_between(5_000, 10_000) > 150, "{}", asked_between(5_000, 10_000));
    assert!(asked_between(11_000, 16_000) < 20, "{}", asked_between(11_000, 16_000));
}

#[test]
fn nor_does_it_keep_requests_from_the_line() {
    let asked = play_with(1, |bus, now| {
        if now == Time::from_millis(10_000) {
            for at in [40, 41] {
                let span = Span::new(Table::Input, at, at).expect("a register");
                let wish = Wish::Read { device: "heating".into(), span, clears: false };
                let transaction = Transaction::default();
                bus.handle(now, Event::Request(request::Request { verb: Verb::Read, transaction, wish }));
            }
        }
    });
    let of_requests = asked.into_iter().filter(|asked| asked.2 >= 40 && asked.2 < 42);
    let told: Vec<(u16, bool)> =
        of_requests.map(|asked| (asked.2, asked.0 < Time::from_millis(11_000))).collect();
    assert_eq!(told, [(40, true), (41, true)]);
}

#[test]
fn a_poll_that_waits_for_the_line_makes_way_for_a_heartbeat() {
    let settings = devices::settings("device damper 1 damper.yaml\ndevice heating 2 thermometer\n");
    let mut bus = Bus::new(Time::default(), &settings, 0, &Memories::default());
    // The heartbeat is due each second.
    let mut registers = BTreeMap::from([0, 1, 2, 3].map(|at| ((1, at), 1)));
    registers.insert((1, 4), 30);
    let mut now = Time::default();
    bus.handle(now, Event::LinkUp);
    loop {
        let Some(request) = sent(&mut bus) else {
            now = bus.wake_at().expect("polls without end").max(now);
            bus.handle(now, Event::Wake);
            continue;
        };
        if now > Time::from_millis(5_000) && request.unit == 2 {
            break;
        }
        let sent_at = now;
        now += TRANSACTION;
        let answer = answer(&mut registers, &request);
        let reply = Reply::new(Ok(answer), sent_at, Some((now, now)), &mut Discarded::default());
        bus.handle(now, Event::Reply(reply));
    }
    // The line is noisy, and the poll not yet on it.
    let until = now + Duration::from_secs(2);
    while !std::iter::from_fn(|| bus.next_action()).any(|action| action == Action::Withdraw) {
        now = bus.wake_at().filter(|at| *at > now && *at < until).expect("the heartbeat is due soon");
        bus.handle(now, Event::Wake);
    }
    bus.handle(now, Event::Withdrawn);
    let request = sent(&mut bus).expect("the heartbeat at once");
    assert_eq!((request.unit, request.call.to_string()), (1, "read holding 1".into()));
}

/// Everything that may want the line wants it at the same moment.
#[test]
fn when_everything_wants_the_line_it_is_given_out_in_the_stated_order() {
    let settings = devices::settings(
        "device damper 1 damper.yaml\ndevice heating 2 thermometer\ndevice board 3 clamping\n\
         device meter 5 selectable\ndevice fuse 20 relays\ndevice relays 21 relays\n\
         setting meter mode voltage enforced\n",
    );
    let mut bus = Bus::new(Time::default(), &settings, 0, &Memories::default());
    let mut registers = BTreeMap::from([0, 1, 2, 3].map(|at| ((1, at), 1)));
    // What the damper and the relays allow: 4.5 s, 2 s of which most is over then, and 4.5 s.
    registers.extend([((1, 4), 45), ((20, 66), 200), ((21, 66), 450)]);
    let mut now = Time::default();
    let mut asked = Vec::new();
    bus.handle(now, Event::LinkUp);
    let mut is_crowded = false;
    while asked.len() < 13 {
        let Some(request) = sent(&mut bus) else {
            now = bus.wake_at().expect("polls without end").max(now);
            bus.handle(now, Event::Wake);
            continue;
        };
        let sent_at = now;
        now += TRANSACTION;
        if is_crowded {
            asked.push(format!("{} {}", request.unit, request.call));
        }
        let reads_mode = request.unit == 5 && request.call.to_string() == "read holding 16";
        if !is_crowded && now > Time::from_millis(80_000) && reads_mode {
            is_crowded = true;
            // Somebody has turned the setting back, as this answer tells; it takes long to come.
            registers.insert((5, 16), 0);
            now += Duration::from_millis(1_600);
            let (device, point, payload) = ("board".into(), "level".into(), "10".into());
            bus.handle(now, Event::Command(Command { device, point, payload, retained: false }));
            let span = Span::new(Table::Input, 40, 40).expect("a register");
            let wish = Wish::Read { device: "heating".into(), span, clears: false };
            let transaction = Transaction::default();
            bus.handle(now, Event::Request(request::Request { verb: Verb::Read, transaction, wish }));
            let wish = Wish::Scan(request::Scan {
                first: 40,
                last: 40,
                known: Arc::default(),
                ticket: Arc::default(),
            });
            let transaction = Transaction::default();
            bus.handle(now, Event::Request(request::Request { verb: Verb::Scan, transaction, wish }));
        }
        let answer = answer(&mut registers, &request);
        let reply = Reply::new(Ok(answer), sent_at, Some((now, now)), &mut Discarded::default());
        bus.handle(now, Event::Reply(reply));
    }
    assert_eq!(
        asked,
        [
            // A watchdog that is late, a command, a heartbeat and a watchdog that are due;
            "20 read holding 66",
            "3 write holding 2 000A",
            "1 read holding 1",
            "1 write holding 1 0001",
            "21 read holding 1",
            // a program's request, a setting with all that belongs to it, a scan;
            "2 read input 40",
            "5 read holding 16",
            "5 write holding 16 0001",
            "5 read holding 16",
            "40 identification 1 0",
            // the poll that is the command's read-back, and whatever else is due.
            "3 read holding 1..2",
            "2 read input 0",
            "5 read input 0",
        ]
    );
}

/// What the bus asks next.
fn sent(bus: &mut Bus) -> Option<Request> {
    let actions: Vec<Action> = std::iter::from_fn(|| bus.next_action()).collect();
    actions.into_iter().find_map(|action| match action {
        Action::Send { request, .. } => Some(request),
        _ => None,
    })
}

/// A script that moves four sliders and never stops.
fn move_sliders(bus: &mut Bus, now: Time) {
    let step = (now.0 / 20_000 % 2) as usize;
    for device in ["board_1", "board_2"] {
        for (point, values) in [("order", ["OFF", "ON"]), ("level", ["10", "20"])] {
            let (device, point, payload) = (device.into(), point.into(), values[step].into());
            bus.handle(now, Event::Command(Command { device, point, payload, retained: false }));
        }
    }
}

fn get(bus: &mut Bus, now: Time) {
    for point in ["temperature", "strokes"] {
        bus.handle(now, Event::Get { device: "heating".into(), point: point.into() });
    }
}

fn nothing(_: &mut Bus, _: Time) {}

fn longest(times: &[Time]) -> Duration {
    times.windows(2).map(|pair| pair[1] - pair[0]).max().unwrap_or(Duration::MAX)
}

/// Plays a minute; returns when which unit was asked, and for which register first.
fn play(flood: Flood) -> Vec<(Time, u8, u16)> {
    play_with(60, flood)
}

/// The same, with so many hundredths of a second for the watchdog.
fn play_with(watchdog: u16, flood: Flood) -> Vec<(Time, u8, u16)> {
    let mut bus = Bus::new(Time::default(), &devices::settings(DEVICES), 0, &Memories::default());
    let mut registers = BTreeMap::from([((20, 66), watchdog)]);
    let mut asked = Vec::new();
    let mut now = Time::default();
    bus.handle(now, Event::LinkUp);
    while now < MINUTE {
        let sent = sent(&mut bus);
        let sent_at = now;
        now += TRANSACTION;
        // Just before the answer is the worst time.
        flood(&mut bus, now);
        let Some(request) = sent else {
            bus.handle(now, Event::Wake);
            continue;
        };
        if let Call::Read(span) = request.call {
            asked.push((sent_at, request.unit, span.first()));
        }
        let answer = answer(&mut registers, &request);
        let reply = Reply::new(Ok(answer), sent_at, Some((now, now)), &mut Discarded::default());
        bus.handle(now, Event::Reply(reply));
    }
    asked
}

fn answer(registers: &mut BTreeMap<(u8, u16), u16>, request: &Request) -> Answer {
    match request.call {
        Call::Read(span) if span.table().is_bits() => Answer::Bits(vec![false; span.count() as usize]),
        Call::Read(span) => {
            let held = |at| registers.get(&(request.unit, at)).copied().unwrap_or(0);
            Answer::Words((span.first()..=span.last()).map(held).collect())
        }
        Call::WriteRegister { address, word } => {
            registers.insert((request.unit, address), word);
            Answer::Written
        }
        _ => Answer::Written,
    }
}
