//! What a device refuses for a moment is asked as before when the moment is over, and what it refuses for good is
//! found out; what it leaves unanswered costs the others little; and what was on the wire is counted, however it ended.

use std::collections::BTreeMap;

use busker::engine::address::{Span, Table};
use busker::engine::bus::{Command, Event};
use busker::engine::settings::Settings;
use busker::engine::time::{Duration, Time};
use busker::simulator::Stimulus;
use busker::simulator::device::SimulatedDevice;
use busker::simulator::script::Action;

use crate::device::{BLOCK, BLOCKS, Diary, STORED, Timepiece};
use crate::watched::{Holes, Ledger, Watched};
use crate::world::World;
use crate::{device_name, load};

const SERIAL: &str = "serial: /dev/ttyUSB0";
const UNIT: u8 = 1;
const OTHER: u8 = 3;
/// Two blocks, the coils and the registers of both units, each second.
const EACH_SECOND: usize = 8;

#[test]
fn what_is_refused_for_a_moment_is_read_in_one_request_again() {
    // A gateway that mixes something up, and a device that is there before its registers are.
    for restarts in [false, true] {
        let mut world = world(SERIAL, "1s");
        world.run_until(world.now + Duration::from_secs(20));
        if restarts {
            world.act(UNIT, &Action::Power { unit: UNIT, on: false });
            world.run_until(world.now + Duration::from_secs(20));
            world.act(UNIT, &Action::Power { unit: UNIT, on: true });
        }
        world.fault(UNIT, "exception=2");
        world.run_until(world.now + Duration::from_secs(5));
        check_that_it_is_over(&mut world, &format!("restarts: {restarts}"));
    }
}

#[test]
fn a_device_that_was_busy_for_long_and_then_refuses_something_once_has_not_refused_it_for_long() {
    for before in ["exception=6", "silent,every=2"] {
        let mut world = world(SERIAL, "1s");
        world.run_until(world.now + Duration::from_secs(20));
        world.fault(UNIT, before);
        world.run_until(world.now + Duration::from_secs(15));
        world.act(UNIT, &Action::Repair { unit: UNIT });
        world.fault(UNIT, "exception=2");
        world.run_until(world.now + Duration::from_secs(3));
        check_that_it_is_over(&mut world, before);
    }
}

/// Once the unit is well again all is soon read as before, and nothing of it is remembered.
#[track_caller]
fn check_that_it_is_over(world: &mut World, what: &str) {
    world.act(UNIT, &Action::Repair { unit: UNIT });
    world.run_until(world.now + Duration::from_secs(70));
    assert_eq!(requests(world, 10), 10 * EACH_SECOND, "{what}");
    let memory = world.memories.devices.get(&device_name(UNIT));
    assert!(memory.is_none_or(|memory| memory.refused.is_empty()), "{what}: {memory:?}");
}

#[test]
fn what_is_refused_for_good_by_a_device_that_gave_it_before_is_found_out_soon_and_the_rest_is_read_again() {
    let of_input = |first, count| Span::with_count(Table::Input, first, count).expect("a span");
    let of_holding = |first, count| Span::with_count(Table::Holding, first, count).expect("a span");
    let all = [of_input(0, 4), of_input(100, 4), of_holding(0, 2)];
    let of_all = [0, 1, 2, 100, 101, 102].map(|first| of_input(first, 2));
    let of_all: Vec<Span> = of_all.into_iter().chain([of_holding(0, 2)]).collect();
    // What is missing since the new firmware, how many points that are, and what therefore is not read in one request.
    let rows: [(&[Span], usize, &[Span]); 5] = [
        (&[of_input(1, 1)], 1, &[of_input(0, 2), of_input(1, 2)]),
        (&[of_input(2, 2)], 2, &[of_input(1, 2), of_input(2, 2)]),
        (&[of_input(103, 1), of_holding(0, 1)], 2, &[of_input(101, 2), of_input(102, 2), of_holding(0, 2)]),
        (&[of_input(0, 4)], 4, &[of_input(0, 2), of_input(1, 2), of_input(2, 2)]),
        (&all, 10, &of_all),
    ];
    for (missing, count, expected) in rows {
        let (mut world, holes) = with_firmware();
        world.run_until(world.now + Duration::from_secs(20));
        *holes.lock().expect("nobody panicked") = missing.to_vec();
        // Ten until it is believed, and a little for the halves that are tried.
        world.run_until(world.now + Duration::from_secs(15));
        // All of it changes: what is told is told anew.
        for span in BLOCKS.map(|first| of_input(first, BLOCK)).into_iter().chain([of_holding(0, STORED)]) {
            let stimulus = Stimulus::Set { span, words: vec![7; span.count() as usize] };
            world.act(UNIT, &Action::Stimulate { unit: UNIT, stimulus });
        }
        world.run_until(world.now + Duration::from_secs(3));
        let mut told: BTreeMap<&str, &str> = BTreeMap::new();
        for published in &world.published {
            let point = published.message.topic.strip_prefix(&format!("busker/{}/", device_name(UNIT)));
            told.extend(point.map(|point| (point, &*published.message.payload)));
        }
        let registers =
            told.iter().filter(|(point, _)| point.starts_with("reading") || point.starts_with("level"));
        let (gone, there): (Vec<_>, Vec<_>) = registers.partition(|(_, payload)| **payload == "None");
        assert_eq!(gone.len(), count, "{missing:?}: {told:?}");
        assert_eq!(there.len() + gone.len(), BLOCKS.len() * usize::from(BLOCK) + usize::from(STORED));
        assert!(there.iter().all(|(_, payload)| **payload == "7"), "{missing:?}: {told:?}");
        // It is stored once a minute at most.
        world.run_until(world.now + Duration::from_secs(60));
        let mut refused = world.memories.devices[&device_name(UNIT)].refused.clone();
        refused.sort_by_key(|span| (span.table(), span.first()));
        assert_eq!(refused, expected, "{missing:?}");
    }
}

#[test]
fn commands_to_a_device_that_has_died_are_not_waited_for_one_by_one() {
    let mut world = world(SERIAL, "1s");
    world.run_until(world.now + Duration::from_secs(20));
    world.act(UNIT, &Action::Power { unit: UNIT, on: false });
    // As a scene does it: all that there is, and once more.
    let points = || (0..STORED).flat_map(|number| [format!("relay_{number}"), format!("level_{number}")]);
    let died_at = world.now;
    for wait in [0, 1500] {
        world.run_until(world.now + Duration::from_millis(wait));
        for point in points() {
            let (device, payload) = (device_name(UNIT), "1".into());
            world.tell(Event::Command(Command { device, point, payload, retained: false }));
        }
    }
    world.run_until(world.now + Duration::from_secs(20));
    let requests = world.requests();
    let to_other = requests.iter().filter(|(at, unit)| *unit == OTHER && *at >= died_at).map(|(at, _)| *at);
    let times: Vec<Time> = std::iter::once(died_at).chain(to_other).collect();
    let longest = times.windows(2).map(|pair| pair[1] - pair[0]).max().expect("it is asked");
    // A write and its read-back; each wait is followed by as long a silence.
    assert!(longest <= Duration::from_millis(2700), "{longest:?}");
    let outcomes = world.published.iter().filter(|published| published.message.topic.ends_with("/outcome"));
    assert_eq!(outcomes.count(), 2 * points().count());
}

/// On a line that is full a period may last for minutes; who is back waits for none.
#[test]
fn a_device_that_returns_to_a_full_line_is_back_soon_although_some_of_its_first_answers_are_lost() {
    // Whichever of the first answers are lost.
    for number in 0..6 {
        // Sixty times as much as the line can carry.
        let mut world = world(SERIAL, "2ms");
        world.run_until(world.now + Duration::from_secs(5));
        world.act(UNIT, &Action::Power { unit: UNIT, on: false });
        world.run_until(world.now + Duration::from_secs(20));
        world.act(UNIT, &Action::Power { unit: UNIT, on: true });
        world.fault(UNIT, ["silent,every=2", "silent,every=3"][number % 2]);
        world.run_until(world.now + Duration::from_millis(2000 + 700 * number as u64));
        world.act(UNIT, &Action::Repair { unit: UNIT });
        world.run_until(world.now + Duration::from_secs(10));
        let topic = format!("busker/{}/availability", device_name(UNIT));
        let last = world.published.iter().rev().find(|published| published.message.topic == topic);
        assert_eq!(last.expect("it was told").message.payload, "online", "{number}");
    }
}

#[test]
fn a_request_whose_link_ends_under_it_is_counted() {
    for link in [SERIAL, "tcp: \"10.0.0.9:502\""] {
        let mut world = world(link, "1s");
        for number in 0..20 {
            world.run_until(world.now + Duration::from_millis(5000 + number * 7));
            // It waits for an answer that does not come.
            world.fault(UNIT, "silent");
            let asked = |world: &World| world.requests().iter().filter(|(_, unit)| *unit == UNIT).count();
            let before = asked(&world);
            while asked(&world) == before {
                world.run_until(world.now + Duration::from_millis(5));
            }
            world.run_until(world.now + Duration::from_millis(1));
            world.unplug(Duration::from_millis(100));
            world.act(UNIT, &Action::Repair { unit: UNIT });
        }
        world.run_until(world.now + Duration::from_secs(5));
        // The last one may be under way.
        let (report, seen) = (world.report(), world.requests().len() as u64);
        let of_devices = report.devices.iter().map(|device| device.counters.requests).sum();
        for counted in [report.counters.requests, of_devices] {
            assert!((seen - 1..=seen).contains(&counted), "{link}: {counted} of {seen}");
        }
    }
}

/// How many requests there are in so many seconds.
fn requests(world: &mut World, seconds: u64) -> usize {
    let before = world.requests().len();
    world.run_until(world.now + Duration::from_secs(seconds));
    world.requests().len() - before
}

/// A unit whose firmware may be exchanged for one that does not have all addresses.
fn with_firmware() -> (World, Holes) {
    let (settings, holes) = (gateway(SERIAL, "1s"), Holes::default());
    let device = settings.devices[0].device.clone();
    let watched = Watched::new(Time(0), UNIT, device, Ledger::default(), holes.clone());
    (world_with(settings, Box::new(watched)), holes)
}

fn world(link: &str, fast: &str) -> World {
    world_with(gateway(link, fast), Box::new(Timepiece::new(UNIT, Diary::default())))
}

fn world_with(settings: Settings, of_unit: Box<dyn SimulatedDevice>) -> World {
    let mut of_unit = Some(of_unit);
    World::with_devices(settings, |unit| match unit {
        UNIT => of_unit.take().expect("there is one"),
        other => Box::new(Timepiece::new(other, Diary::default())),
    })
}

fn gateway(link: &str, fast: &str) -> Settings {
    let readings = BLOCKS.iter().zip(["fast", "slow"]).flat_map(|(block, poll)| {
        let reading = move |address| format!("reading_{address}: {{at: input {address}, poll: {poll}}}");
        (*block..block + BLOCK).map(reading)
    });
    let stores = (0..STORED).flat_map(|number| {
        [
            format!("relay_{number}: {{at: coil {number}, write: any, poll: slow}}"),
            format!("level_{number}: {{at: holding {number}, write: 0..65535, poll: slow}}"),
        ]
    });
    let points = readings.chain(stores).collect::<Vec<_>>().join(", ");
    let mut text = format!("buses: {{line: {{{link}, response_timeout: 400ms}}}}\ndevices:\n");
    for unit in [UNIT, OTHER] {
        let name = device_name(unit);
        text += &format!(
            "  {name}: {{bus: line, unit: {unit}, poll: {{fast: {fast}, slow: 1s}}, points: {{{points}}}}}\n"
        );
    }
    load(&text)
}
