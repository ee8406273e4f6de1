//! Random buses, and what may befall them: nobody starves, the periods that a bus can keep are kept, and a bus that
//! cannot keep them stretches all alike, also after a disturbance. It sleeps past nothing that is due, and wakes for
//! nothing that is not.
//!
//! `CASES=2000 SEED=7 cargo test --test budget turns` looks at more of them, and at others.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::fmt::Write;

use busker::engine::time::{Duration, Time};
use proptest::prelude::*;
use proptest::test_runner::{Config, RngAlgorithm, TestRng, TestRunner};

use super::plain::Plain;
use super::{by_magnitude, number};

#[test]
fn nobody_starves_and_all_have_equal_shares_after_whatever_befell_the_bus() {
    let cases = number("CASES").unwrap_or(CASES);
    let config = Config { cases, failure_persistence: None, ..Config::default() };
    let mut seed = [0; 32];
    seed[..4].copy_from_slice(&number::<u32>("SEED").unwrap_or(1).to_le_bytes());
    let random = TestRng::from_seed(RngAlgorithm::ChaCha, &seed);
    let all = Cell::new(Compared::default());
    let outcome = TestRunner::new_with_rng(config, random).run(&case(), |case| {
        all.set(all.get().and(live(&case)?));
        Ok(())
    });
    outcome.unwrap_or_else(|fault| panic!("{fault}"));
    println!("{:?}", all.get());
    assert!(cases < CASES || all.get().shows_something(), "{:?}", all.get());
}

const CASES: u32 = 24;

/// What random cases have found.
#[test]
fn nobody_starves_where_somebody_did() {
    let unit = |[fast, slow, cost, rest]: [u64; 4], [fast_reads, slow_reads]: [u16; 2]| Unit {
        fast,
        slow,
        cost,
        rest,
        fast_reads,
        slow_reads,
        once_reads: 0,
    };
    let commanded = || unit([1_000, 10_000, 20, 0], [1, 0]);
    let resting = |rest| unit([100, 1_000, 5, rest], [3, 1]);
    let mut all = Compared::default();
    for (what, closes, units, trouble) in [
        (
            "commands: turns that went before their time did not count, and fast reads had them all",
            false,
            vec![commanded(), unit([100, 2_000, 20, 0], [1, 2])],
            Trouble::Commands(0),
        ),
        (
            "commands without a moment between them: the time that they took did not count, and who was ahead stayed so",
            false,
            vec![unit([20, 120, 38, 0], [0, 0]), unit([20, 40, 1, 0], [1, 1])],
            Trouble::SomeCommands(0, 5),
        ),
        (
            "commands for a device that rests behind each: they waited for that on the wire, and reads did not",
            false,
            vec![resting(20)],
            Trouble::Commands(0),
        ),
        (
            "wishes for a point of a device that rests: meanwhile nothing was due, and they were counted anew",
            false,
            vec![resting(100)],
            Trouble::Gets(0, 20),
        ),
        (
            "wishes for a point of a device that rests: meanwhile another had its turns, and they were counted anew",
            false,
            vec![unit([20, 20, 1, 0], [1, 0]), unit([20, 20, 1, 11], [1, 1])],
            Trouble::Gets(1, 5),
        ),
        (
            "the same where the other takes longer than the device rests",
            false,
            vec![unit([20, 20, 30, 0], [1, 0]), unit([20, 20, 1, 11], [1, 1])],
            Trouble::Gets(1, 5),
        ),
        (
            "commands for it that come in its silence, beside another that has its turns in that",
            false,
            vec![unit([20, 20, 1, 0], [1, 0]), unit([20, 20, 1, 21], [2, 0])],
            Trouble::SomeCommands(1, 44),
        ),
        (
            "a server that closes each connection: the bus was taken to be done with everything at each new one",
            true,
            vec![unit([11, 66, 8, 0], [2, 3]), unit([7, 77, 1, 0], [4, 0])],
            Trouble::Nothing,
        ),
        (
            "a device that rests on a bus that is never done: its fast reads had put off its slow ones by more than \
             those had waited",
            false,
            vec![
                unit([34, 408, 60, 84], [4, 3]),
                unit([42, 42, 14, 0], [2, 0]),
                unit([128, 1_024, 1, 0], [3, 0]),
            ],
            Trouble::Nothing,
        ),
        (
            "a device that is asked much more seldom than it wants: one of its reads made up for all that it had waited",
            false,
            vec![unit([1, 1, 1, 5], [3, 3]), unit([46, 138, 3, 0], [2, 3])],
            Trouble::Slow(1),
        ),
    ] {
        let case = Case { is_network: true, closes, units, troubles: vec![(trouble, 40_000)] };
        let compared = live(&case).unwrap_or_else(|fault| panic!("{what}: {fault}"));
        all = all.and(compared);
    }
    assert!(all.shows_something(), "{all:?}");
}

/// It is no matter of the bus, which has time enough; but whom the device keeps waiting for its silence, it keeps waiting
/// alike.
#[test]
fn a_device_that_wants_more_than_its_silence_allows_stretches_all_its_reads_alike() {
    let resting = |[fast, slow, rest]: [u64; 3], [fast_reads, slow_reads]: [u16; 2]| Unit {
        fast,
        slow,
        cost: 1,
        rest,
        fast_reads,
        slow_reads,
        once_reads: 0,
    };
    let other = resting([70, 70, 0], [1, 0]);
    for units in [
        vec![resting([72, 288, 151], [2, 3])],
        vec![resting([72, 288, 151], [2, 3]), other.clone()],
        vec![resting([100, 2_000, 150], [1, 4])],
        vec![resting([140, 2_000, 150], [1, 4]), other.clone()],
        vec![resting([300, 1_200, 151], [2, 3])],
        vec![resting([5, 60, 40], [3, 1])],
        vec![resting([100, 2_000, 240], [1, 4])],
        vec![resting([100, 500, 100], [1, 4])],
    ] {
        let case = Case { is_network: true, closes: false, units, troubles: Vec::new() };
        let mut line = Plain::new(&case.configuration(), vec![1; 2]);
        line.run_for(SETTLES).expect("no fault");
        line.asked.clear();
        line.run_for(300_000).expect("no fault");
        let times = times(&mut line);
        let stretch = |(read, period): (_, f64)| {
            let asked: &Vec<Time> = &times[&read];
            (asked[asked.len() - 1] - asked[0]).as_secs_f64() / (asked.len() - 1) as f64 / period
        };
        let of_first = case.periods().into_iter().filter(|(read, _)| read.0 == 1);
        let stretches: Vec<f64> = of_first.map(stretch).collect();
        let (least, most) = stretches
            .iter()
            .fold((f64::MAX, 0.0_f64), |(least, most), one| (least.min(*one), most.max(*one)));
        assert!(most > 1.05 && most < least * (1.0 + WITHIN), "{stretches:.3?}\n{}", case.configuration());
    }
}

/// What is asked again at once is one turn, and its period is not over the sooner.
#[test]
fn a_read_that_collides_each_time_comes_no_more_often() {
    let unit =
        Unit { fast: 1_000, slow: 1_000, cost: 100, rest: 0, fast_reads: 1, slow_reads: 0, once_reads: 0 };
    let case = Case { is_network: false, closes: false, units: vec![unit], troubles: Vec::new() };
    let mut line = Plain::new(&case.configuration(), vec![100]);
    line.collides_each = Some(2);
    line.run_for(SETTLES).expect("no fault");
    line.asked.clear();
    line.run_for(60_000).expect("no fault");
    assert!((59..=61).contains(&line.asked.len()), "{}", line.asked.len());
}

/// A request that is sent on a connection which the other side is about to close is lost, and its device seems to be as
/// dead as the one whose silence was before it.
#[test]
fn where_each_connection_is_closed_also_behind_a_silence_no_request_is_lost() {
    let unit = Unit { fast: 100, slow: 100, cost: 10, rest: 0, fast_reads: 2, slow_reads: 0, once_reads: 0 };
    let units = vec![unit; 2];
    let case = Case { is_network: true, closes: true, units, troubles: Vec::new() };
    let mut line = Plain::new(&case.configuration(), vec![10; 2]);
    line.closes = true;
    line.run_for(SETTLES).expect("no fault");
    line.lost = 0;
    line.dead = vec![1];
    line.run_for(20_000).expect("no fault");
    assert_eq!(line.lost, 0);
}

/// A part of a cabinet loses its power: each of its units is asked three times in vain, and the others have the line behind
/// each two of these silences.
#[test]
fn where_many_die_at_once_the_others_are_asked_between_their_silences() {
    for (fast, reads, count, dead) in [
        (10, 1, 10, 5),
        (10, 1, 20, 10),
        (10, 1, 10, 9),
        (1_000, 1, 10, 5),
        (1_000, 3, 10, 5),
        (1_000, 1, 30, 25),
    ] {
        let unit =
            Unit { fast, slow: fast, cost: 37, rest: 0, fast_reads: reads, slow_reads: 0, once_reads: 0 };
        let case = Case { is_network: false, closes: false, units: vec![unit; count], troubles: Vec::new() };
        let mut line = Plain::new(&case.configuration(), vec![37; count]);
        line.run_for(SETTLES).expect("no fault");
        line.dead = (count - dead..count).collect();
        line.asked.clear();
        let from = line.now;
        line.run_for(60_000).expect("no fault");
        let until = line.now;
        let mut times = times(&mut line);
        let round = 0.037 * f64::from(reads) * count as f64;
        // Each of the dead may come first before it is known to be silent. It is waited for, the line is left alone for as
        // long again, and the others may have it for as long.
        let most = dead as f64 * 3.0 * 0.5 + round.max(fast as f64 / 1e3);
        let what = format!("{dead} of {count} with {reads} reads each {fast} ms");
        for (read, period) in
            case.periods().into_iter().filter(|(read, _)| usize::from(read.0) <= count - dead)
        {
            let asked = times.remove(&read).unwrap_or_default();
            let longest = longest_wait(&asked, [from, until]);
            assert!(longest <= most, "{what}: {read:?} waited for {longest:.2} s, more than {most:.2} s");
            // Two such silences, and then half a second: a fifth of the time.
            let least = 60.0 / period.max(round) / 5.0;
            let turns = asked.len();
            assert!(turns as f64 >= least, "{what}: {read:?} had {turns} turns, less than {least:.0}");
        }
    }
}

/// Its reads are wanted again at once and wait for its silence: that is no reason to go before anything while it lasts.
#[test]
fn a_device_that_rests_and_is_busy_is_asked_when_the_bus_wakes_and_not_before() {
    let units = [[228, 1, 0, 1, 0], [168, 29, 17, 3, 3]].map(|[fast, cost, rest, fast_reads, slow_reads]| {
        let [fast_reads, slow_reads] = [fast_reads, slow_reads].map(|count: u64| count as u16);
        Unit { fast, slow: fast * 12, cost, rest, fast_reads, slow_reads, once_reads: 0 }
    });
    let troubles = vec![(Trouble::Refuses(1, 5), 10_497)];
    let case = Case { is_network: false, closes: false, units: units.to_vec(), troubles };
    live(&case).unwrap_or_else(|fault| panic!("{fault}"));
}

/// On a bus that cannot keep up the others have no less while a device is busy, and it is asked nearly as often as
/// before.
#[test]
fn a_device_that_is_busy_takes_no_turns_from_others() {
    let unit = |fast, fast_reads| Unit {
        fast,
        slow: fast,
        cost: 30,
        rest: 0,
        fast_reads,
        slow_reads: 0,
        once_reads: 0,
    };
    let units = vec![unit(4_000, 8), unit(50, 2)];
    let case = Case { is_network: true, closes: false, units, troubles: Vec::new() };
    let mut line = Plain::new(&case.configuration(), vec![30; 2]);
    line.run_for(SETTLES).expect("no fault");
    line.asked.clear();
    let turns_in = |line: &mut Plain, millis: u64| {
        line.run_for(millis).expect("no fault");
        let of_other = line.asked.iter().filter(|asked| asked.unit == 2).count();
        let all = std::mem::take(&mut line.asked).len();
        [all - of_other, of_other]
    };
    for code in [5, 6] {
        let [turns, usual] = turns_in(&mut line, 10_000);
        line.refuses = Some((0, code));
        let [asked, meanwhile] = turns_in(&mut line, 10_000);
        assert!(meanwhile >= usual * 99 / 100, "exception {code}: {meanwhile} turns instead of {usual}");
        assert!(asked * 3 >= turns * 2, "exception {code}: {asked} times instead of {turns}");
        line.refuses = None;
        line.run_for(FORGOTTEN).expect("no fault");
        line.asked.clear();
    }
}

/// So many times what it would be if everybody had their share at each moment a read may wait: others may be two periods
/// behind when it has just had its turn, and those and its own it then waits for.
const UNEVENLY: f64 = 4.0;
/// And so long in any case, behind a silence and what is asked again behind that.
const SILENCE: f64 = 2.0;
/// A device that dies is waited for so long, with the silences behind that: three requests, if each in another read.
const DYING: f64 = 3.6;
const WITHIN: f64 = 0.1;
/// What has come round more seldom has no mean to speak of.
const ROUNDS: usize = 30;

/// The life of a bus: what befalls it, and how it is behind that.
fn live(case: &Case) -> Result<Compared, TestCaseError> {
    let mut line = Plain::new(&case.configuration(), case.units.iter().map(|unit| unit.cost).collect());
    let fail = |text: String| TestCaseError::fail(format!("{text}\n{}", case.configuration()));
    line.closes = case.closes;
    line.run_for(SETTLES).map_err(fail)?;
    for (trouble, lasts) in &case.troubles {
        line.asked.clear();
        let from = line.now;
        let outcome = case.perform(&mut line, *trouble, *lasts);
        let span = [from, line.now];
        let outcome = outcome.and_then(|()| case.judge(*trouble, &times(&mut line), span));
        outcome.map_err(|text| fail(format!("{trouble:?}: {text}")))?;
        // A device that is away, or refuses something, is asked again only so often.
        if matches!(trouble, Trouble::Dead(_) | Trouble::Refuses(..) | Trouble::Breaks(_)) {
            line.run_for(FORGOTTEN).map_err(fail)?;
        }
    }
    line.run_for(SETTLES).map_err(fail)?;
    line.asked.clear();
    let from = line.now;
    // For as long as the slowest needs, within reason.
    let longest = case.periods().values().copied().fold(1.0, f64::max) * case.load(Unit::cost).max(1.0);
    let until = from + Duration::from_secs_f64(longest * (ROUNDS + 2) as f64);
    while line.now < until && line.asked.len() < REQUESTS {
        line.run_for(1_000).map_err(fail)?;
    }
    let times = times(&mut line);
    case.look_for_starving(&times, [from, line.now], None, Unit::cost).map_err(fail)?;
    case.look_for_unfairness(&times).map_err(fail)
}

const REQUESTS: usize = 4_000;

#[derive(Clone, Debug)]
struct Unit {
    /// All of these in milliseconds: the poll periods, how long a request takes, and the silence that it wants.
    fast: u64,
    slow: u64,
    cost: u64,
    rest: u64,
    /// How many reads it has of each class.
    fast_reads: u16,
    slow_reads: u16,
    /// And those that are read once.
    once_reads: u16,
}

/// What happens to a bus for a while.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Trouble {
    Nothing,
    /// A command for this unit as soon as there is no other.
    Commands(usize),
    /// One now and then, so many milliseconds apart.
    SomeCommands(usize, u64),
    /// Somebody wants this unit's first point to be told, again and again.
    Gets(usize, u64),
    /// It does not answer.
    Dead(usize),
    /// It answers with this exception.
    Refuses(usize, u8),
    /// It takes five times as long.
    Slow(usize),
    /// Each so-manieth request meets another.
    Collisions(u64),
    /// The link breaks, and breaks again.
    Breaks(u64),
    /// It leaves the configuration, and comes back in the end.
    Leaves(usize),
    /// Somebody wants the port, again and again for half of so many milliseconds.
    Pauses(u64),
}

impl Trouble {
    /// Whom it befalls, if not all: any number, which stands for one of those that there are.
    fn unit(self) -> Option<usize> {
        match self {
            Trouble::Commands(unit)
            | Trouble::SomeCommands(unit, _)
            | Trouble::Gets(unit, _)
            | Trouble::Dead(unit)
            | Trouble::Refuses(unit, _)
            | Trouble::Slow(unit)
            | Trouble::Leaves(unit) => Some(unit),
            Trouble::Nothing | Trouble::Collisions(_) | Trouble::Breaks(_) | Trouble::Pauses(_) => None,
        }
    }
}

#[derive(Clone, Debug)]
struct Case {
    is_network: bool,
    /// A server that closes each connection behind its answer.
    closes: bool,
    units: Vec<Unit>,
    troubles: Vec<(Trouble, u64)>,
}

fn log(from: f64, to: f64) -> impl Strategy<Value = u64> {
    (0.0..1.0_f64).prop_map(move |part| by_magnitude(part, from, to))
}

fn unit() -> impl Strategy<Value = Unit> {
    let fast = prop_oneof![9 => log(20.0, 5_000.0), 1 => log(1.0, 20.0)];
    let times = (fast, 1..15_u64, log(1.0, 80.0), prop_oneof![4 => Just(0), 1 => log(5.0, 200.0)]);
    let reads = prop_oneof![8 => (1..5_u16, 0..4_u16), 1 => (0..1_u16, 1..4_u16), 1 => (0..1_u16, 0..1_u16)];
    (times, reads, prop_oneof![3 => Just(0_u16), 1 => Just(1)]).prop_map(
        |((fast, ratio, cost, rest), (fast_reads, slow_reads), once_reads)| Unit {
            fast,
            slow: fast * ratio,
            cost,
            rest,
            fast_reads,
            slow_reads,
            once_reads,
        },
    )
}

fn trouble() -> impl Strategy<Value = Trouble> {
    let any = 0..100_usize;
    prop_oneof![
        1 => Just(Trouble::Nothing),
        2 => any.clone().prop_map(Trouble::Commands),
        1 => (any.clone(), log(5.0, 3000.0)).prop_map(|(unit, every)| Trouble::SomeCommands(unit, every)),
        1 => (any.clone(), log(5.0, 3000.0)).prop_map(|(unit, every)| Trouble::Gets(unit, every)),
        2 => any.clone().prop_map(Trouble::Dead),
        2 => (any.clone(), prop_oneof![Just(4_u8), Just(5), Just(6)])
            .prop_map(|(unit, code)| Trouble::Refuses(unit, code)),
        1 => any.clone().prop_map(Trouble::Slow),
        1 => (2..20_u64).prop_map(Trouble::Collisions),
        1 => log(100.0, 20_000.0).prop_map(Trouble::Breaks),
        1 => any.prop_map(Trouble::Leaves),
        1 => log(2_000.0, 20_000.0).prop_map(Trouble::Pauses),
    ]
}

fn case() -> impl Strategy<Value = Case> {
    let troubles = prop::collection::vec((trouble(), log(1_000.0, 60_000.0)), 0..4);
    let link = prop_oneof![3 => Just((false, false)), 3 => Just((true, false)), 1 => Just((true, true))];
    (link, prop::collection::vec(unit(), 1..6), troubles)
        .prop_map(|((is_network, closes), units, troubles)| Case { is_network, closes, units, troubles })
}

/// The reads of a unit are too far apart to be one, and the slow ones lie behind these.
const APART: u16 = 200;
const SLOW_FROM: u16 = 2_000;
const ONCE_FROM: u16 = 4_000;
const WRITABLE: u16 = 6_000;
/// So long it takes at most until a device that was left alone is asked again.
const FORGOTTEN: u64 = 70_000;
/// A device that leaves for a while has all of its reads answered again, and some rounds.
const SETTLES: u64 = 10_000;

impl Case {
    fn configuration(&self) -> String {
        let link = match self.is_network {
            true => "tcp: \"10.0.0.1:502\"",
            false => "serial: /dev/serial/by-id/usb-A, baud: 115200",
        };
        let mut text = format!("buses:\n  line: {{{link}, response_timeout: 500ms}}\ndevices:\n");
        for (index, unit) in self.units.iter().enumerate() {
            let mut points =
                format!("w: {{at: holding {WRITABLE}, type: u16, poll: never, write: 0..65535}}");
            let mut reads = |class: &str, count: u16, from: u16| {
                for number in 0..count {
                    let at = from + number * APART;
                    let _ =
                        write!(points, ", {class}{number}: {{at: holding {at}, type: u16, poll: {class}}}");
                }
            };
            reads("fast", unit.fast_reads, 0);
            reads("slow", unit.slow_reads, SLOW_FROM);
            reads("once", unit.once_reads, ONCE_FROM);
            let _ = writeln!(
                text,
                "  unit_{number}: {{bus: line, unit: {number}, poll: {{fast: {}ms, slow: {}ms}}, \
                 wire: {{limits: {{delay: {}ms}}}}, points: {{{points}}}}}",
                unit.fast,
                unit.slow,
                unit.rest,
                number = number_of(index),
            );
        }
        text
    }

    /// By unit and address: the period, in seconds.
    fn periods(&self) -> BTreeMap<(u8, u16), f64> {
        let mut periods = BTreeMap::new();
        for (index, unit) in self.units.iter().enumerate() {
            let place = |from: u16, number: u16| (number_of(index), from + number * APART);
            let fast = (0..unit.fast_reads).map(|number| (place(0, number), unit.fast as f64 / 1e3));
            let slow = (0..unit.slow_reads).map(|number| (place(SLOW_FROM, number), unit.slow as f64 / 1e3));
            periods.extend(fast.chain(slow));
        }
        periods
    }

    /// How much of the wire's time is wanted.
    fn load(&self, cost: impl Fn(&Unit) -> f64) -> f64 {
        self.units.iter().map(|unit| unit.reads_a_second() * cost(unit)).sum()
    }
}

impl Unit {
    fn cost(&self) -> f64 {
        self.cost as f64 / 1e3
    }

    fn rest(&self) -> f64 {
        self.rest as f64 / 1e3
    }

    fn count(&self) -> f64 {
        f64::from(self.fast_reads + self.slow_reads)
    }

    fn reads_a_second(&self) -> f64 {
        // What is never read is asked nevertheless whether it is there.
        let is_silent = self.fast_reads + self.slow_reads + self.once_reads == 0;
        let slow_reads = if is_silent { 1 } else { self.slow_reads };
        f64::from(self.fast_reads) * 1e3 / self.fast as f64 + f64::from(slow_reads) * 1e3 / self.slow as f64
    }
}

/// That of the unit at this place in the list.
fn number_of(place: usize) -> u8 {
    place as u8 + 1
}

/// By unit and address, when it was asked.
type Times = BTreeMap<(u8, u16), Vec<Time>>;

fn times(line: &mut Plain) -> Times {
    let mut times = Times::new();
    for asked in line.asked.drain(..) {
        times.entry((asked.unit, asked.address)).or_default().push(asked.at);
    }
    times
}

/// In seconds, from one moment in which a read was asked to the next. One that is never asked has waited all the time.
fn longest_wait(asked: &[Time], [from, until]: [Time; 2]) -> f64 {
    let moments: Vec<Time> = [&[from], asked, &[until]].concat();
    moments.windows(2).map(|pair| (pair[1] - pair[0]).as_secs_f64()).fold(0.0, f64::max)
}

impl Case {
    /// Lets it befall the bus for so many milliseconds.
    fn perform(&self, line: &mut Plain, trouble: Trouble, lasts: u64) -> Result<(), String> {
        let unit = self.befallen_by(trouble);
        let until = line.now + Duration::from_millis(lasts);
        match trouble {
            Trouble::Nothing => line.run_for(lasts)?,
            Trouble::Commands(_) => {
                line.flood = Some(unit);
                line.run_for(lasts)?;
                line.flood = None;
            }
            Trouble::SomeCommands(_, every) => {
                while line.now < until {
                    line.command(unit);
                    line.run_for(every)?;
                }
            }
            Trouble::Gets(_, every) => {
                while line.now < until {
                    line.get(unit, "fast0");
                    line.run_for(every)?;
                }
            }
            Trouble::Dead(_) => {
                line.dead = vec![unit];
                line.run_for(lasts)?;
                line.dead.clear();
            }
            Trouble::Refuses(_, code) => {
                line.refuses = Some((unit, code));
                line.run_for(lasts)?;
                line.refuses = None;
            }
            Trouble::Slow(_) => {
                line.costs[unit] *= SLOWER;
                line.run_for(lasts)?;
                line.costs[unit] /= SLOWER;
            }
            Trouble::Collisions(each) => {
                line.collides_each = Some(each);
                line.run_for(lasts)?;
                line.collides_each = None;
            }
            Trouble::Breaks(every) => {
                while line.now < until {
                    line.break_link();
                    line.run_for(every)?;
                }
            }
            Trouble::Leaves(_) => {
                line.retire(unit);
                line.run_for(lasts)?;
                line.adopt(unit);
            }
            Trouble::Pauses(every) => {
                while line.now < until {
                    let ends_at = line.now + Duration::from_millis(every / 2);
                    line.pause(ends_at - line.now);
                    // What has been decided on is asked, behind its silence.
                    line.run_for(BEGUN)?;
                    let asked = line.asked.len();
                    line.run_for((ends_at - line.now).as_millis() as u64 - 1)?;
                    if line.asked.len() > asked {
                        return Err(format!("asked at {} in a pause", line.asked[asked].at));
                    }
                    line.run_for(every / 2)?;
                }
            }
        }
        Ok(())
    }

    /// Whether everybody had turns while it lasted, by what was asked then.
    fn judge(&self, trouble: Trouble, times: &Times, span: [Time; 2]) -> Result<(), String> {
        let befallen = self.befallen_by(trouble);
        let unit = &self.units[befallen];
        match trouble {
            // Each read comes behind eight others.
            Trouble::Commands(_) | Trouble::SomeCommands(..) | Trouble::Gets(..) => {
                let of_others = AHEAD * (unit.rest() + unit.cost());
                self.look_for_starving(times, span, None, |of| of.cost() + of_others)
            }
            Trouble::Slow(_) => self.look_for_starving(times, span, None, |of| of.cost() * SLOWER as f64),
            Trouble::Nothing => self.look_for_starving(times, span, None, Unit::cost),
            Trouble::Leaves(_) | Trouble::Refuses(..) => {
                self.look_for_starving(times, span, Some(number_of(befallen)), Unit::cost)
            }
            Trouble::Collisions(_) => self.look_for_starving(times, span, None, |of| of.cost() + COLLISION),
            // Others have to wait for its silence, and it is asked as seldom as it pleases.
            Trouble::Dead(_) => {
                self.look_for_starving_but_for(DYING, times, span, Some(number_of(befallen)), Unit::cost)
            }
            Trouble::Breaks(_) | Trouble::Pauses(_) => Ok(()),
        }
    }

    /// The place of the unit which that befalls; where it befalls all of them, any.
    fn befallen_by(&self, trouble: Trouble) -> usize {
        trouble.unit().unwrap_or_default() % self.units.len()
    }

    /// Each read has its turn within a few times what would be its share of the wire, but for those of a unit that is
    /// away, or refuses them. One that is never asked has waited all the time.
    fn look_for_starving(
        &self,
        times: &Times,
        span: [Time; 2],
        away: Option<u8>,
        cost: impl Fn(&Unit) -> f64,
    ) -> Result<(), String> {
        self.look_for_starving_but_for(0.0, times, span, away, cost)
    }

    /// The same where so many seconds of a wait are no affair of the schedule's.
    fn look_for_starving_but_for(
        &self,
        seconds: f64,
        times: &Times,
        span: [Time; 2],
        away: Option<u8>,
        cost: impl Fn(&Unit) -> f64,
    ) -> Result<(), String> {
        let load = self.load(&cost).max(1.0);
        let round: f64 = self.units.iter().map(|unit| unit.count() * cost(unit)).sum();
        for (read, period) in self.periods().into_iter().filter(|(read, _)| Some(read.0) != away) {
            let longest = longest_wait(times.get(&read).map_or(&[], Vec::as_slice), span);
            self.within(read, longest - seconds, period, load, round)?;
        }
        Ok(())
    }

    fn within(&self, read: (u8, u16), waited: f64, period: f64, load: f64, round: f64) -> Result<(), String> {
        let unit = &self.units[usize::from(read.0) - 1];
        // The silence that it wants is its own affair.
        let of_its_own = unit.reads_a_second() * (unit.rest() + unit.cost());
        let most = (load + of_its_own) * period * UNEVENLY + round + SILENCE;
        (waited <= most)
            .then_some(())
            .ok_or_else(|| format!("{read:?} waited for {waited:.3} s, more than {most:.3} s"))
    }

    /// By how much the periods are longer than they should be, but for those of units that must be slower for their silence.
    fn stretches(&self, times: &Times) -> Vec<f64> {
        let mut stretches = Vec::new();
        for (read, period) in self.periods() {
            let Some(asked) = times.get(&read).filter(|asked| asked.len() > ROUNDS) else { continue };
            let found = (asked[asked.len() - 1] - asked[0]).as_secs_f64() / (asked.len() - 1) as f64;
            stretches.push((read.0, found / period));
        }
        let least = stretches.iter().map(|(_, stretch)| *stretch).fold(f64::MAX, f64::min);
        let can_be_had = |unit: u8| self.slower_for_its_silence(unit) < least * NEARLY;
        stretches.iter().filter(|(unit, _)| can_be_had(*unit)).map(|(_, stretch)| *stretch).collect()
    }

    /// By how much a unit's periods are longer at least. Nobody waits for the end of its silence: behind that it
    /// waits in turn for what another one was asked meanwhile.
    fn slower_for_its_silence(&self, number: u8) -> f64 {
        let index = usize::from(number) - 1;
        let unit = &self.units[index];
        let others = self.units.iter().enumerate().filter(|(other, _)| *other != index);
        let begun = others.map(|(_, other)| other.cost()).fold(0.0, f64::max);
        let of_request = if unit.rest > 0 { unit.cost() + unit.rest() + begun } else { 0.0 };
        unit.reads_a_second() * of_request
    }

    /// Where the bus keeps up so does each read; where it does not all are slower by the same factor.
    fn look_for_unfairness(&self, times: &Times) -> Result<Compared, String> {
        let load = self.load(Unit::cost);
        let stretches = self.stretches(times);
        let least = stretches.iter().copied().fold(f64::MAX, f64::min);
        let most = stretches.iter().copied().fold(0.0, f64::max);
        let is_kept = load > KEEPS_UP || (least > 1.0 - WITHIN && most < 1.0 + WITHIN);
        let is_fair = load < OVERLOADED || most < least * (1.0 + WITHIN);
        if !is_kept || !is_fair {
            return Err(format!("load {load:.3}: stretched by {stretches:.3?}"));
        }
        let count = stretches.len();
        Ok(Compared {
            kept: if load <= KEEPS_UP { count } else { 0 },
            // One alone is as slow as itself.
            shared: if load >= OVERLOADED && count > 1 { count } else { 0 },
        })
    }
}

/// How many periods were looked at: a run of cases in which none was shows nothing.
#[derive(Clone, Copy, Debug, Default)]
struct Compared {
    /// Where the bus keeps up: with what they should be.
    kept: usize,
    /// Where it does not: with each other.
    shared: usize,
}

impl Compared {
    fn and(self, other: Compared) -> Compared {
        Compared { kept: self.kept + other.kept, shared: self.shared + other.shared }
    }

    fn shows_something(self) -> bool {
        self.kept > 0 && self.shared > 0
    }
}

/// What has begun is over after so many milliseconds.
const BEGUN: u64 = 700;
/// So many requests that somebody wants at once may go before a read.
const AHEAD: f64 = 8.0;
const SLOWER: u64 = 5;
/// What a request that meets another takes until it is asked again.
const COLLISION: f64 = 0.6;
/// So much of what a unit with a silence of its own can have it does have.
const NEARLY: f64 = 0.95;
/// A bus keeps up at less, and does not at more.
const KEEPS_UP: f64 = 0.7;
const OVERLOADED: f64 = 1.1;
