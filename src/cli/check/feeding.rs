//! Whether the watchdogs and heartbeats of devices are fed in time, also while another device is silent.
//!
//! A watchdog is fed by any request to its device. When a third of its time has passed the program makes one that goes
//! before everything else: then only that may come between which is on the wire, and other watchdogs and heartbeats,
//! with a read behind each eight of them. By that alone it is judged whether the time is met. Of a device that has just
//! fallen silent it is the wait for its answer that is on the wire, and as long again in which a line is left alone.
//! Commands are not counted: they put a feeding off until two thirds of the time have passed, and no further.
//!
//! Most watchdogs are fed sooner by the polls, and then that is told: the longest wait that the rehearsal has seen, and
//! a request more; with a silence for each read of the device that falls silent, since all of them may be due before.

use serde::Serialize;

use super::budget::Budget;
use super::{advice, told};
use crate::engine::bus::{AHEAD_OF_READS, FAILURES_UNTIL_OFFLINE, LEFT_ALONE_LEAST};
use crate::engine::codec;
use crate::engine::device::{Point, PointIndex};
use crate::engine::plan::Cost;
use crate::engine::settings::{Bus, DeviceSettings};
use crate::engine::time::Duration;
use crate::engine::value::Reading;
use crate::engine::wanted;

/// So many times within the time that the device allows a heartbeat is written, and a watchdog fed.
const HEARTBEATS_WITHIN: f64 = 3.0;
/// What must fit into the rest of a time of which a third has passed fits into one so many times as long.
const LONGER: f64 = HEARTBEATS_WITHIN / (HEARTBEATS_WITHIN - 1.0);

/// A bus that cannot keep up gives the turns less evenly behind a silence: of sixty such buses with units that die, the
/// one with the longest wait made it 1.25 times as long.
const UNEVEN: f64 = 1.5;

/// What the bus does to a device's patience, in seconds.
#[derive(Clone, Copy)]
pub struct Delays {
    /// The longest time from one request to the next that its polls leave, and the same behind a silence; none where
    /// nothing is polled.
    polled_every: Option<[f64; 2]>,
    /// The request that is on the wire when something comes.
    one_request: f64,
    /// A request that nobody answers, and on a line the silence after it.
    one_silent: f64,
    /// What other watchdogs and heartbeats may send first, if all are due at once; and how many reads go between.
    others_fed: f64,
    reads_between: f64,
    /// And this device's own heartbeats.
    own_beats: f64,
    /// The response timeout, and so many times it is waited for: twice on a line.
    timeout: f64,
    timeouts: f64,
}

impl Delays {
    /// `device` is its number on the bus.
    pub fn of(bus: &Bus, device: usize, asked_every: Option<f64>, load: f64, budget: &Budget) -> Delays {
        let others = || budget.wants.iter().enumerate().filter(move |(other, _)| *other != device);
        let fed = |(other, wants): (usize, &Wants)| {
            wants.fed_every.map_or(0.0, |_| budget.longest_of(other)) + wants.time_of_beats()
        };
        let requests = |wants: &Wants| usize::from(wants.fed_every.is_some()) + 2 * wants.beats.len();
        let requests: usize = others().map(|(_, wants)| requests(wants)).sum();
        let is_line = bus.link.line().is_some();
        let reads = others().map(|(other, _)| budget.asked_again_and_again(other)).max().unwrap_or_default();
        // Not where the others find the time between two of them; a line is left alone for as long as the device.
        let others_between = !is_line && budget.longest() + budget.round() <= LEFT_ALONE_LEAST.as_secs_f64();
        let most = if others_between { 1.0 } else { f64::from(FAILURES_UNTIL_OFFLINE) };
        let in_vain = (reads as f64).clamp(1.0, most);
        let one_silent = budget.one_silent.max(budget.longest());
        // A poll is put off for up to half as long again, at random.
        let random = if is_line { budget.timeout / 2.0 } else { 0.0 };
        let uneven = if load > 1.0 { UNEVEN } else { 1.0 };
        let polled_every = |every: f64| {
            let behind_silence = every * uneven + in_vain * (one_silent + random);
            [every, behind_silence].map(|every| every + budget.longest())
        };
        Delays {
            polled_every: asked_every.map(polled_every),
            one_request: budget.longest(),
            one_silent,
            others_fed: others().map(fed).sum(),
            reads_between: (requests / AHEAD_OF_READS as usize) as f64,
            own_beats: budget.wants[device].time_of_beats(),
            timeout: budget.timeout,
            timeouts: if is_line { 2.0 } else { 1.0 },
        }
    }

    /// What may come before that which goes before everything else: while all devices answer, and where one is silent.
    fn before(&self) -> [f64; 2] {
        let rest = self.others_fed + self.reads_between * self.one_request;
        [self.one_request, self.silences() * self.one_silent].map(|first| first + rest)
    }

    /// So often a device that falls silent may be asked meanwhile.
    fn silences(&self) -> f64 {
        (1.0 + self.reads_between).min(f64::from(FAILURES_UNTIL_OFFLINE))
    }

    /// The response timeout with which the rest is over in `time`, if there is a sensible one.
    fn timeout_for(&self, time: f64, every_one_silent: f64) -> Option<Duration> {
        let wanted = self.timeout - (every_one_silent - time) / (self.timeouts * self.silences());
        (wanted >= SHORTEST_TIMEOUT).then(|| advice::round_down(Duration::from_secs_f64(wanted)))
    }
}

/// A response timeout that no device should be offered less than.
const SHORTEST_TIMEOUT: f64 = 0.1;

/// One watchdog or heartbeat.
#[derive(Serialize)]
pub struct Feeding {
    /// The point that holds the time.
    point: String,
    /// `watchdog` or `heartbeat`.
    kind: &'static str,
    /// The time that the configuration wants of it, in seconds; none where the device decides.
    time: Option<f64>,
    /// How long it may take from one feeding to the next, in seconds.
    fed_every: f64,
    fed_every_one_silent: f64,
    /// Whether the time is met; none where it is not known.
    met: Option<bool>,
    met_one_silent: Option<bool>,
    /// What to change where it is not met.
    advice: Option<String>,
}

/// The watchdog and the heartbeats of a device.
pub fn of_device(settings: &DeviceSettings, delays: Delays) -> Vec<Feeding> {
    let device = &settings.device;
    let mut all = Vec::new();
    if let Some(point) = device.wire.watchdog {
        let time = declared_seconds(settings, point);
        let before = delays.before();
        let every = match (time.filter(|time| *time > 0.0), delays.polled_every) {
            // After a third of a time that is known it is fed before anything else is polled. How often it is polled
            // does not count where that is too late.
            (Some(time), polled) => {
                let fed = before.map(|before| time / HEARTBEATS_WITHIN + before);
                let [polled, polled_one_silent] = polled.unwrap_or(fed);
                let sooner = |fed: f64, polled: f64| if fed < time { fed.min(polled) } else { fed };
                Some([sooner(fed[0], polled), sooner(fed[1], polled_one_silent)])
            }
            // Nothing can be said where nothing is polled again and again and its time is not known.
            (None, polled) => polled,
        };
        if let Some(every) = every {
            all.push(Feeding::new(settings, point, "watchdog", time, every, before[1] * LONGER, delays));
        }
    }
    for point in times_of_heartbeats(settings) {
        let time = declared_seconds(settings, point);
        // What is read and written is two requests, and what may go before each of them.
        let due = time.unwrap_or_default() / HEARTBEATS_WITHIN;
        let own = 3.0 * delays.one_request + delays.own_beats;
        let every = delays.before().map(|before| due + before + own);
        let enough = (delays.before()[1] + own) * LONGER;
        all.push(Feeding::new(settings, point, "heartbeat", time, every, enough, delays));
    }
    all
}

/// The points that hold how long a heartbeat may stay away, each once.
fn times_of_heartbeats(settings: &DeviceSettings) -> Vec<PointIndex> {
    let mut times: Vec<PointIndex> =
        settings.device.points.iter().filter_map(|point| point.heartbeat).collect();
    times.sort_unstable();
    times.dedup();
    times
}

/// What a device wants of the wire besides its polls, as far as the configuration says it.
pub struct Wants {
    /// The longest time without a request that its watchdog is left, in seconds.
    pub fed_every: Option<f64>,
    pub beats: Vec<Beat>,
}

/// A heartbeat: a register that is read and written again and again.
pub struct Beat {
    /// Seconds between two.
    pub every: f64,
    /// Both requests on the wire, in seconds.
    pub time: f64,
}

/// The data of the request that writes one register, and of its answer, beyond those of a read.
const BYTES_OF_WRITE: u64 = 3;

impl Wants {
    /// `cost`: of requests to this device.
    pub fn of(settings: &DeviceSettings, cost: Cost) -> Wants {
        let part = |time: PointIndex| {
            let seconds = declared_seconds(settings, time)?;
            (seconds > 0.0).then_some(seconds / HEARTBEATS_WITHIN)
        };
        let delay = settings.device.wire.limits.delay;
        let beat = |point: &Point| {
            let write = Duration::from_nanos(cost.request + BYTES_OF_WRITE * cost.byte);
            let time = cost.time_of(point.at.span) + write + delay * 2;
            Some(Beat { every: part(point.heartbeat?)?, time: time.as_secs_f64() })
        };
        Wants {
            fed_every: settings.device.wire.watchdog.and_then(part),
            beats: settings.device.points.iter().filter_map(beat).collect(),
        }
    }

    /// Seconds of wire in a second.
    pub fn load_of_beats(&self) -> f64 {
        self.beats.iter().map(|beat| beat.time / beat.every).sum()
    }

    /// All of them once.
    fn time_of_beats(&self) -> f64 {
        self.beats.iter().map(|beat| beat.time).sum()
    }
}

impl Feeding {
    fn new(
        settings: &DeviceSettings,
        point: PointIndex,
        kind: &'static str,
        time: Option<f64>,
        [fed_every, fed_every_one_silent]: [f64; 2],
        enough: f64,
        delays: Delays,
    ) -> Feeding {
        // 0 switches it off.
        let met = |every: f64| time.map(|time| time == 0.0 || every < time);
        let mut feeding = Feeding {
            point: settings.device.points[point].name.clone(),
            kind,
            time,
            fed_every,
            fed_every_one_silent,
            met: met(fed_every),
            met_one_silent: met(fed_every_one_silent),
            advice: None,
        };
        feeding.advice = feeding.what_to_change(enough, delays);
        feeding
    }

    /// `enough`: the time that would be met.
    fn what_to_change(&self, enough: f64, delays: Delays) -> Option<String> {
        if self.met_one_silent != Some(false) {
            return None;
        }
        let longer = advice::text(advice::round_up(Duration::from_secs_f64(enough * 1.01)));
        let mut advice = format!("set `{}` to {longer} or longer", self.point);
        if let (Some(true), Some(timeout)) =
            (self.met, delays.timeout_for(self.time?, self.fed_every_one_silent))
        {
            advice += &format!(", or `response_timeout` of the bus to {}", advice::text(timeout));
        }
        Some(advice)
    }

    /// A line for people, with what to change where it is not met.
    pub fn text(&self, device: &str) -> String {
        let name = format!("{device}: {} `{}`", self.kind, self.point);
        let advice = self.advice.as_deref().unwrap_or_default();
        let (every, silent) = (told(self.fed_every), told(self.fed_every_one_silent));
        match (self.time, self.met, self.met_one_silent) {
            (Some(0.0), ..) => format!("{name} is off"),
            (Some(time), Some(true), Some(true)) => format!(
                "{name} of {} is fed at least every {every}, {silent} while a device is silent",
                told(time)
            ),
            (Some(time), Some(true), _) => format!(
                "{name} of {} may run out while another device is silent: it is then fed every {silent}; {advice}",
                told(time)
            ),
            (Some(time), ..) => {
                format!("{name} of {} will run out: it is fed every {every}; {advice}", told(time))
            }
            (None, ..) if self.kind == "watchdog" => format!(
                "{name} is as the device has it; it is fed at least every {every}, {silent} while a device is silent"
            ),
            (None, ..) => format!("{name} is as the device has it; it is written three times within it"),
        }
    }
}

/// What the configuration's `settings` want the point to hold, in seconds.
fn declared_seconds(settings: &DeviceSettings, point: PointIndex) -> Option<f64> {
    let declared = settings.wanted.iter().find(|wanted| wanted.point == point)?;
    // In a mode in which there is such a time.
    let mut known = vec![None; settings.device.points.len()];
    for condition in &settings.device.points[point].when {
        known[condition.point] = condition.values.first().map(|(raw, _)| *raw);
    }
    let resolved = codec::resolve(&settings.device, point, &known).ok()?;
    let words = wanted::encode(&settings.device.points[point], &resolved, &declared.value).ok()?;
    match codec::read(&resolved, &words) {
        Reading::Number(seconds) => Some(seconds.to_f64()),
        _ => None,
    }
}
