//! Whoever asks without end stretches what is polled, but never keeps it from the wire.

use busker::engine::address::Table;
use busker::engine::bus::{Action, Bus, Command, Event};
use busker::engine::memory::Memories;
use busker::engine::modbus::{Answer, Call, Discarded, Reply};
use busker::engine::time::{Duration, Time};

use crate::devices;

/// How long a request and its answer take.
const TRANSACTION: Duration = Duration::from_millis(20);
const MINUTE: Time = Time(60_000_000);

#[test]
fn a_flood_of_commands_lets_polls_through() {
    check(|bus, now| {
        // A script that moves four sliders and never stops.
        let step = (now.0 / 20_000 % 2) as usize;
        for device in ["board_1", "board_2"] {
            for (point, values) in [("order", ["OFF", "ON"]), ("level", ["10", "20"])] {
                let (device, point, payload) = (device.into(), point.into(), values[step].into());
                bus.handle(now, Event::Command(Command { device, point, payload, retained: false }));
            }
        }
    });
}

#[test]
fn a_flood_of_gets_lets_polls_through() {
    check(|bus, now| {
        for point in ["temperature", "strokes"] {
            bus.handle(now, Event::Get { device: "heating".into(), point: point.into() });
        }
    });
}

/// Plays a minute in which somebody asks at each moment, and looks how often unit 9 was polled, which
/// nobody asks for: it wants to be polled 60 times.
fn check(ask: impl Fn(&mut Bus, Time)) {
    let header = "device board_1 1 clamping\ndevice board_2 2 clamping\ndevice heating 3 thermometer\n\
        device garden 9 thermometer\n";
    let mut bus = Bus::new(Time::default(), &devices::settings(header), 0, &Memories::default());
    let mut now = Time::default();
    let mut held = std::collections::BTreeMap::new();
    let (mut polls, mut last, mut longest) = (0, now, Duration::ZERO);
    bus.handle(now, Event::LinkUp);
    while now < MINUTE {
        let actions: Vec<Action> = std::iter::from_fn(|| bus.next_action()).collect();
        let sent = actions.into_iter().find_map(|action| match action {
            Action::Send { request, .. } => Some(request),
            _ => None,
        });
        let Some(request) = sent else {
            now += TRANSACTION;
            ask(&mut bus, now);
            continue;
        };
        if request.unit == 9
            && matches!(request.call, Call::Read(span) if span.table() == Table::Input && span.first() == 0)
        {
            polls += 1;
            longest = longest.max(now - last);
            last = now;
        }
        let sent_at = now;
        // Just before the answer is the worst time.
        now += TRANSACTION;
        ask(&mut bus, now);
        let answer = match request.call {
            Call::Read(span) => {
                let words = span.first()..=span.last();
                Answer::Words(words.map(|at| held.get(&(request.unit, at)).copied().unwrap_or(0)).collect())
            }
            Call::WriteRegister { address, word } => {
                held.insert((request.unit, address), word);
                Answer::Written
            }
            _ => Answer::Written,
        };
        let reply = Reply::new(Ok(answer), sent_at, Some((now, now)), &mut Discarded::default());
        bus.handle(now, Event::Reply(reply));
    }
    assert!(polls >= 30, "{polls} polls in a minute");
    assert!(longest < Duration::from_secs(2), "{longest:?} without a poll");
}
