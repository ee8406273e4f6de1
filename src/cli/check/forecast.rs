//! What a bus will do while all its devices answer, as its rehearsal shows it: how busy it is, and how often everything
//! is really read.

use std::collections::BTreeMap;

use super::budget::{Budget, Planned};
use super::rehearsal::Rehearsal;
use crate::engine::address::Span;
use crate::engine::device::Poll;
use crate::engine::modbus::Call;
use crate::engine::settings::{DeviceSettings, Settings};
use crate::engine::time::{Duration, Time};

/// Before anything is counted each device has answered so often, and a minute has passed: then every plan is the one
/// for the device that there is, and everything has its place in the schedule.
const ANSWERS_UNTIL_SETTLED: usize = 250;
const SETTLED_AFTER: Duration = Duration::from_secs(60);
/// But no more than so many requests are waited for, nor longer than so.
const REQUESTS_UNTIL_SETTLED: usize = 10_000;
const SETTLED_BEFORE: Duration = Duration::from_secs(3600);
/// Then everything comes round so often, unless that takes more requests than so: since what is read together is due
/// together, whole rounds are counted, one at least.
const ROUNDS: u32 = 24;
const REQUESTS: usize = 10_000;
/// A round is no shorter: more often nothing is counted.
const ROUND_SHORTEST: Duration = Duration::from_millis(2_500);
/// And one round takes no more requests than so.
const REQUESTS_MOST: usize = 60_000;

/// What there is to say of a bus. Times are seconds.
pub struct Forecast {
    /// The share of time in which the wire can do nothing else; above 1, where it is never done, by how much every
    /// period is longer than it should be.
    pub load: f64,
    /// By device and class: how often it is really read, where that is told.
    periods: BTreeMap<(usize, Poll), f64>,
    /// By unit: the longest time from one request to the next that was seen.
    waits: BTreeMap<u8, f64>,
}

impl Forecast {
    /// The bus of this number, with its devices and what is planned for it.
    pub fn of(
        settings: &Settings,
        index: usize,
        devices: &[&DeviceSettings],
        turnaround: Duration,
        budget: &Budget,
    ) -> Forecast {
        let mut rehearsal = Rehearsal::new(settings, index, turnaround);
        settle(&mut rehearsal, devices.len());
        count(&mut rehearsal, devices, budget)
    }

    /// How often the reads of this class, which are wanted so often, really come round.
    pub fn real_period(&self, device: usize, poll: Poll, wanted: f64) -> f64 {
        // What comes round too seldom to be counted is stretched as everything is.
        self.periods.get(&(device, poll)).copied().unwrap_or(wanted * self.load.max(1.0))
    }

    /// The longest time from one request to this unit to the next, as far as it was seen.
    pub fn longest_wait(&self, unit: u8) -> f64 {
        self.waits.get(&unit).copied().unwrap_or_default()
    }
}

fn settle(rehearsal: &mut Rehearsal, devices: usize) {
    let enough = (ANSWERS_UNTIL_SETTLED * devices).min(REQUESTS_UNTIL_SETTLED);
    let (soonest, latest) = (Time(0) + SETTLED_AFTER, Time(0) + SETTLED_BEFORE);
    while rehearsal.now < latest && rehearsal.asked.len() < REQUESTS_UNTIL_SETTLED {
        if rehearsal.now >= soonest && rehearsal.asked.len() >= enough {
            break;
        }
        rehearsal.step_until(latest);
    }
    rehearsal.asked.clear();
}

fn count(rehearsal: &mut Rehearsal, devices: &[&DeviceSettings], budget: &Budget) -> Forecast {
    let longest = budget.reads.iter().filter_map(|read| read.period).fold(0.0, f64::max);
    // As much longer as the periods are where the polls want more than the wire carries.
    let longest = longest * budget.load_of_polls().max(1.0);
    let round = ROUND_SHORTEST.max(Duration::from_secs_f64(longest));
    let (begin, busy) = (rehearsal.now, rehearsal.busy);
    for _ in 0..ROUNDS {
        let end = rehearsal.now + round;
        while rehearsal.now < end && rehearsal.asked.len() < REQUESTS_MOST {
            rehearsal.step_until(end);
        }
        if rehearsal.asked.len() >= REQUESTS {
            break;
        }
    }
    let share = (rehearsal.busy - busy).as_secs_f64() / (rehearsal.now - begin).as_secs_f64();

    let mut times: BTreeMap<(u8, Span), Seen> = BTreeMap::new();
    let mut waits: BTreeMap<u8, (Time, Duration)> = BTreeMap::new();
    for asked in rehearsal.asked.drain(..) {
        let (last, longest) = waits.entry(asked.unit).or_insert((asked.at, Duration::ZERO));
        *longest = (asked.at - *last).max(*longest);
        *last = asked.at;
        if let Call::Read(span) = asked.call {
            let seen =
                times.entry((asked.unit, span)).or_insert(Seen { first: asked.at, last: asked.at, count: 0 });
            (seen.last, seen.count) = (asked.at, seen.count + 1);
        }
    }
    let real = |read: &Planned| {
        let seen = times.get(&(devices[read.device].unit, read.span))?;
        seen.period(read.period?)
    };
    let told: Vec<(&Planned, f64)> =
        budget.reads.iter().filter_map(|read| Some((read, real(read)?))).collect();
    let mut periods: BTreeMap<(usize, Poll), f64> = BTreeMap::new();
    for (read, real) in &told {
        let of_class = periods.entry((read.device, read.poll)).or_insert(*real);
        *of_class = of_class.max(*real);
    }
    let load = if share > NEVER_DONE { stretch(&told).max(share) } else { share };
    let waits = waits.into_iter().map(|(unit, (_, longest))| (unit, longest.as_secs_f64())).collect();
    Forecast { load, periods, waits }
}

/// By how much the periods are longer than they should be: those of devices that want silence may be so for that alone,
/// and do not count where there are others.
fn stretch(told: &[(&Planned, f64)]) -> f64 {
    let of = |counts: &dyn Fn(&Planned) -> bool| {
        let counted = || told.iter().filter(|(read, _)| counts(read));
        let wanted: f64 = counted().filter_map(|(read, _)| read.load()).sum();
        let kept: f64 = counted().map(|(read, real)| read.time / real).sum();
        (kept > 0.0).then(|| wanted / kept)
    };
    of(&|read| read.rest == 0.0).or_else(|| of(&|_| true)).unwrap_or(1.0)
}

/// The share of a wire for which something is always due.
const NEVER_DONE: f64 = 0.995;

/// How often a read was on the wire, the first and the last time included.
struct Seen {
    first: Time,
    last: Time,
    count: u32,
}

/// A period is told where it was kept so often at least.
const ROUNDS_TOLD: u32 = 12;
/// So little is no difference.
const AS_WANTED: f64 = 0.005;

impl Seen {
    /// The mean time from one to the next, in seconds; that which is wanted, where it is as good as kept.
    fn period(&self, wanted: f64) -> Option<f64> {
        let rounds = self.count - 1;
        let real = (self.last - self.first).as_secs_f64() / f64::from(rounds.max(1));
        let real = if (real / wanted - 1.0).abs() < AS_WANTED { wanted } else { real };
        (rounds >= ROUNDS_TOLD).then_some(real)
    }
}
