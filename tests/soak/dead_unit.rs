//! What a dead unit costs the others on its line, and how soon its return is noticed.

use busker::engine::settings::Settings;
use busker::engine::time::{Duration, Time};
use busker::simulator::script::Action;

use crate::device::{BLOCK, Diary, Timepiece};
use crate::load;
use crate::world::{Published, World};

const UNITS: u8 = 10;
const DEAD: u8 = UNITS;
/// The pauses between probes have grown to their full length by then.
const GROWN: Duration = Duration::from_secs(30);

#[test]
fn a_unit_that_died_costs_the_others_three_percent_at_most_and_is_back_within_two_seconds() {
    check(Duration::from_secs(5), Duration::from_secs(2));
}

#[test]
fn a_unit_that_never_answered_costs_no_more_and_is_back_within_fifteen_seconds() {
    check(Duration::ZERO, Duration::from_secs(15));
}

#[test]
fn a_unit_that_once_came_late_before_it_died_pays_for_the_silence_that_it_is_given() {
    let mut world = world(UNITS);
    world.run_until(world.now + Duration::from_secs(2));
    // Late by 200 ms, once; long ago when it dies.
    world.fault(DEAD, "slow=700ms");
    world.run_until(world.now + Duration::from_secs(2));
    world.act(DEAD, &Action::Repair { unit: DEAD });
    world.run_until(world.now + Duration::from_secs(90));
    power(&mut world, false);
    world.run_until(world.now + GROWN);
    let cost = live_cycle(&mut world) / live_cycle(&mut self::world(UNITS - 1)) - 1.0;
    // 3 % for what it is known to cost, and as long a quarantine as there is within the longest pause.
    assert!(cost > 0.01 && cost <= 0.045, "{:.2} %", cost * 100.0);
}

#[test]
fn a_unit_that_returns_soon_after_its_death_is_noticed_as_soon() {
    let mut world = world(UNITS);
    world.run_until(world.now + Duration::from_secs(5));
    power(&mut world, false);
    // Three requests in vain, and a little more.
    world.run_until(world.now + Duration::from_secs(6));
    power(&mut world, true);
    let returned_at = world.now;
    world.run_until(returned_at + Duration::from_secs(2));
    assert!(world.requests().iter().any(|(at, unit)| *unit == DEAD && *at >= returned_at));
}

#[test]
fn a_unit_that_returns_slower_than_it_went_is_heard_or_spoils_what_others_say_and_is_back_in_time() {
    let within = Duration::from_secs(15);
    for (alive, slow) in [(5, 60), (5, 200), (5, 400), (0, 300)] {
        for moment in 0..4 {
            let mut world = with_dead_unit(Duration::from_secs(alive));
            world.run_until(world.now + within * moment / 4);
            power(&mut world, true);
            world.fault(DEAD, &format!("slow={slow}ms"));
            let returned_at = world.now;
            world.run_until(returned_at + within);
            let topic = format!("busker/unit_{DEAD}/availability");
            let is_back = |published: &&Published| {
                published.message.topic == topic && published.message.payload == "online"
            };
            let back = world.published.iter().rev().find(is_back).filter(|back| back.at >= returned_at);
            assert!(back.is_some(), "alive for {alive} s, {slow} ms, moment {moment}");
        }
    }
}

#[test]
fn on_a_calm_line_the_late_answer_of_a_unit_that_returns_slower_is_heard_and_it_is_back_soon() {
    let (mut world, within) = (world_polled(2, "1s"), Duration::from_secs(5));
    let dead = 2;
    world.run_until(world.now + Duration::from_secs(5));
    world.act(dead, &Action::Power { unit: dead, on: false });
    world.run_until(world.now + GROWN);
    world.act(dead, &Action::Power { unit: dead, on: true });
    // Longer than a probe of it waits.
    world.fault(dead, "slow=200ms");
    let returned_at = world.now;
    world.run_until(returned_at + within);
    assert!(world.late_replies() > 0 && world.collisions == 0, "{} late", world.late_replies());
    let topic = format!("busker/unit_{dead}/availability");
    let last = world.published.iter().rev().find(|published| published.message.topic == topic);
    let last = last.expect("it was told");
    assert!(last.at >= returned_at && last.message.payload == "online", "{:?}", last.message);
}

#[test]
fn many_dead_units_together_cost_a_quarter_more_at_most() {
    for (alive, units, dead) in [(5, 20, 10), (5, 30, 25), (0, 20, 10), (0, 30, 25)] {
        let live = units - dead;
        let mut world = world(units);
        let power = |world: &mut World, on: bool| {
            (live + 1..=units).for_each(|unit| world.act(unit, &Action::Power { unit, on }));
        };
        power(&mut world, alive > 0);
        world.run_until(world.now + Duration::from_secs(alive));
        power(&mut world, false);
        // Where so many are dead, it takes long until they are known to be.
        world.run_until(world.now + Duration::from_secs(120));
        let time = Duration::from_secs(120);
        let cost = cycle(&mut world, live, time) / cycle(&mut self::world(live), live, time) - 1.0;
        let what = format!("{dead} of {units}, alive for {alive} s");
        assert!(cost > 0.15 && cost <= 0.26, "{what}: {:.1} %", cost * 100.0);
        power(&mut world, true);
        let returned_at = world.now;
        world.run_until(returned_at + Duration::from_secs(60));
        let all = (1..=units).map(|unit| is_online(&world, unit)).collect::<Vec<_>>();
        assert!(all.iter().all(|online| *online), "{what}: {all:?}");
    }
}

#[test]
fn where_there_is_time_to_spare_each_of_many_dead_units_is_asked_as_often_as_one() {
    let (units, live) = (20, 5);
    let mut world = world_polled(units, "5s");
    (live + 1..=units).for_each(|unit| world.act(unit, &Action::Power { unit, on: false }));
    world.run_until(world.now + Duration::from_secs(240));
    let from = world.now;
    world.run_until(from + Duration::from_secs(60));
    for unit in 1..=units {
        let requests = world.requests();
        let asked = requests.iter().filter(|(at, of)| *of == unit && *at >= from).map(|(at, _)| *at);
        let times: Vec<Time> = std::iter::once(from).chain(asked).chain([world.now]).collect();
        let longest = times.windows(2).map(|pair| pair[1] - pair[0]).max().expect("a minute");
        assert!(longest <= Duration::from_secs(17), "unit {unit}: {longest:?}");
    }
}

/// The mean cycle of the first units in seconds.
fn cycle(world: &mut World, units: u8, time: Duration) -> f64 {
    let from = world.now;
    world.run_until(from + time);
    let requests = world.requests();
    let count = requests.iter().filter(|(at, unit)| *unit <= units && *at >= from).count();
    time.as_secs_f64() / count as f64 * f64::from(units)
}

fn is_online(world: &World, unit: u8) -> bool {
    let topic = format!("busker/unit_{unit}/availability");
    let last = world.published.iter().rev().find(|published| published.message.topic == topic);
    last.expect("it was told").message.payload == "online"
}

/// The unit has been alive for so long, and its return is to be noticed within so long.
#[track_caller]
fn check(alive: Duration, noticed_within: Duration) {
    let cost = live_cycle(&mut with_dead_unit(alive)) / live_cycle(&mut world(UNITS - 1)) - 1.0;
    assert!(cost > 0.001 && cost <= 0.025, "{:.2} %", cost * 100.0);
    let mut latest = Duration::ZERO;
    for moment in 0..8 {
        let mut world = with_dead_unit(alive);
        world.run_until(world.now + noticed_within * moment / 8);
        power(&mut world, true);
        let returned_at = world.now;
        world.run_until(returned_at + noticed_within + Duration::from_secs(1));
        let requests = world.requests();
        let asked = requests.iter().find(|(at, unit)| *unit == DEAD && *at >= returned_at);
        latest = latest.max(asked.expect("it is asked again").0 - returned_at);
        let topic = format!("busker/unit_{DEAD}/availability");
        let last = world.published.iter().rev().find(|published| published.message.topic == topic);
        assert_eq!(last.expect("it was told").message.payload, "online");
    }
    assert!(latest <= noticed_within, "{latest:?}");
    assert!(latest >= noticed_within / 2, "the moments are not spread over a pause: {latest:?}");
}

/// The mean cycle of the others in seconds, over whole pauses of the dead unit.
fn live_cycle(world: &mut World) -> f64 {
    let from = world.now;
    world.run_until(from + Duration::from_secs(240));
    let requests = world.requests();
    let requests: Vec<&(Time, u8)> = requests.iter().filter(|(at, _)| *at >= from).collect();
    let probes: Vec<Time> = requests.iter().filter(|(_, unit)| *unit == DEAD).map(|(at, _)| *at).collect();
    // An even number: long probes and short ones may take turns.
    let (begin, end) = match probes.len() {
        0 => (from, world.now),
        count => (probes[0], probes[(count - 1) / 2 * 2]),
    };
    let live = requests.iter().filter(|(at, unit)| *unit != DEAD && (begin..end).contains(at)).count();
    end.since(begin).as_secs_f64() / live as f64 * f64::from(UNITS - 1)
}

/// A line whose last unit is dead and has been asked in vain for long.
fn with_dead_unit(alive: Duration) -> World {
    let mut world = world(UNITS);
    if alive.is_zero() {
        power(&mut world, false);
    }
    world.run_until(world.now + alive);
    power(&mut world, false);
    world.run_until(world.now + GROWN);
    world
}

fn power(world: &mut World, on: bool) {
    world.act(DEAD, &Action::Power { unit: DEAD, on });
}

/// Units from 1 on, polled as fast as the line allows.
fn world(units: u8) -> World {
    world_polled(units, "1ms")
}

fn world_polled(units: u8, poll: &str) -> World {
    World::with_devices(gateway(units, poll), |unit| Box::new(Timepiece::new(unit, Diary::default())))
}

fn gateway(units: u8, poll: &str) -> Settings {
    let points: Vec<String> =
        (0..BLOCK).map(|address| format!("reading_{address}: {{at: input {address}, poll: fast}}")).collect();
    let mut text = String::from(
        "buses: {line: {serial: /dev/ttyUSB0, baud: 19200, parity: even, response_timeout: 500ms}}\ndevices:\n",
    );
    for unit in 1..=units {
        let points = points.join(", ");
        text += &format!(
            "  unit_{unit}: {{bus: line, unit: {unit}, poll: {{fast: {poll}}}, points: {{{points}}}}}\n"
        );
    }
    load(&text)
}
