//! Whether the watchdogs and heartbeats of devices are fed in time, also while another device is silent.
//!
//! A watchdog is fed by any request to its device: by its most frequent poll, and where that is too seldom
//! by a read that the program makes when a third of the watchdog's time has passed. Where the configuration
//! does not say what that time is, only the polls are counted. What may come between: a read of everything
//! else that is due at the same moment; other watchdogs and heartbeats; and of a device that has just fallen
//! silent the wait for its answer, as long again in which the line is left alone, and a round of everything
//! else that has become due meanwhile. Before a poll that may be once for each read of the silent device, since all
//! of them may be due for longer. Commands are not counted: they put a feeding off until two thirds of the
//! time have passed, and no further.

use serde::Serialize;

use super::budget::Budget;
use super::{advice, told};
use crate::engine::bus::FAILURES_UNTIL_OFFLINE;
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

/// What the bus does to a device's patience, in seconds.
#[derive(Clone, Copy)]
pub struct Delays {
    asked: Asked,
    /// The request that is on the wire when something comes; and all that is read again and again, once.
    one_request: f64,
    round: f64,
    /// What other watchdogs and heartbeats may send first, if all are due at once.
    others_fed: f64,
    /// And this device's own heartbeats.
    own_beats: f64,
    /// A request that nobody answers, the silence after it, and what is left of the silence after the one
    /// before it.
    one_silent: f64,
    /// The same for all that may be asked of such a device before a poll of this one.
    all_silent: f64,
    /// The response timeout, and whether a line is left alone for as long again.
    timeout: f64,
    is_line: bool,
}

/// How often a device is asked by its polls, in seconds.
#[derive(Clone, Copy)]
pub struct Asked {
    /// The longest time between two requests; none where nothing is polled.
    pub every: Option<f64>,
    /// The longest that was seen to pass between two, where the bus cannot keep up: there a round of everything else
    /// between two polls is not the most.
    pub waited_for: f64,
}

impl Delays {
    /// `device` is its number on the bus.
    pub fn of(bus: &Bus, settings: &DeviceSettings, device: usize, asked: Asked, budget: &Budget) -> Delays {
        let others = budget.wants.iter().enumerate().filter(|(other, _)| *other != device);
        let fed = |wants: &Wants| wants.fed_every.map_or(0.0, |_| budget.longest()) + wants.time_of_beats();
        let demanded = settings.device.wire.response_timeout.unwrap_or_default();
        let timeout = bus.response_timeout.max(demanded).as_secs_f64();
        let is_line = bus.link.line().is_some();
        let one_silent = (budget.one_silent + repeated(timeout, is_line)).max(budget.longest());
        let reads = (0..budget.wants.len()).filter(|other| *other != device);
        let reads = reads.map(|other| budget.asked_again_and_again(other)).max().unwrap_or_default();
        let all_silent = all_silent(budget, reads, timeout, is_line).max(one_silent);
        Delays {
            asked,
            one_request: budget.longest(),
            round: budget.round(),
            others_fed: others.map(|(_, wants)| fed(wants)).sum(),
            own_beats: budget.wants[device].time_of_beats(),
            one_silent,
            all_silent,
            timeout,
            is_line,
        }
    }

    /// The response timeout with which the rest is over in `time`, if there is a sensible one.
    fn timeout_for(&self, time: f64, every_one_silent: f64) -> Option<Duration> {
        let silent = |timeout: f64| timeout * 2.0 + repeated(timeout, true);
        let wanted = if self.is_line {
            // As much less silence as it takes, with the repeat or already without one.
            let left = silent(self.timeout) - (every_one_silent - time);
            if left > silent(REPEATED_AFTER) { (left + REPEATED_AFTER) / 3.0 } else { left / 2.0 }
        } else {
            self.timeout - (every_one_silent - time)
        };
        (wanted >= SHORTEST_TIMEOUT).then(|| advice::round_down(Duration::from_secs_f64(wanted)))
    }
}

/// A device that has not answered is asked again so soon at the earliest.
const REPEATED_AFTER: f64 = 0.24;

/// On a serial line its next request may be decided while the line is still left alone after the last one,
/// and wait for the rest of that; what is due meanwhile comes after it.
fn repeated(timeout: f64, is_line: bool) -> f64 {
    if is_line { (timeout - REPEATED_AFTER).max(0.0) } else { 0.0 }
}

/// What a device that has just fallen silent keeps the bus before a poll of another one: each of its `reads` may
/// have been due for longer, and be asked in vain until the device counts as offline. Not where the others find the
/// time between two of them.
fn all_silent(budget: &Budget, reads: usize, timeout: f64, is_line: bool) -> f64 {
    let left_alone = if is_line { timeout } else { 0.0 };
    let most = f64::from(FAILURES_UNTIL_OFFLINE);
    let asked = match budget.longest() + budget.round() <= REPEATED_AFTER - left_alone {
        true => 1.0,
        false => (reads as f64).clamp(1.0, most),
    };
    (asked * budget.one_silent + repeated(timeout, is_line)).min(most * budget.one_silent)
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
        // After a third of a time that is known it is fed before anything else is polled.
        let due = time.filter(|time| *time > 0.0).map_or(f64::INFINITY, |time| time / HEARTBEATS_WITHIN);
        // Otherwise one may be on the wire and everything else be due when it is due, and the device that
        // is silent among that.
        let Asked { every, waited_for } = delays.asked;
        let every = every.unwrap_or(f64::INFINITY);
        let polled_every = (every + delays.round).max(waited_for) + delays.one_request;
        // Behind a silence there may be such a round as well.
        let uneven = every.max(waited_for) + delays.round + delays.one_request;
        let polled_every_one_silent = uneven + delays.all_silent;
        let [before, before_one_silent] =
            [delays.one_request, delays.one_silent].map(|delay| delay + delays.others_fed);
        let every = [polled_every.min(due + before), polled_every_one_silent.min(due + before_one_silent)];
        let enough = polled_every_one_silent.min(before_one_silent * LONGER);
        // Nothing can be said where nothing is polled again and again and its time is not known.
        if every[0].is_finite() {
            all.push(Feeding::new(settings, point, "watchdog", time, every, enough, delays));
        }
    }
    for point in times_of_heartbeats(settings) {
        let time = declared_seconds(settings, point);
        // What is read and written is two requests, and what may go before each of them.
        let due = time.unwrap_or_default() / HEARTBEATS_WITHIN;
        let before = 3.0 * delays.one_request + delays.others_fed + delays.own_beats;
        let every = [delays.one_request, delays.one_silent].map(|delay| due + delay + before);
        let enough = (delays.one_silent + before) * LONGER;
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
