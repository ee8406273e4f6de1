//! Whether the watchdogs and heartbeats of devices are fed in time, also while another device is silent.
//!
//! A watchdog is fed by any request to its device, so at least as often as the device's most frequent
//! read; and three times within its time, where that is known. What may come between: a read of everything
//! else that is due at the same moment; and of one that has just fallen silent the
//! wait for its answer, as long again in which the line is left alone, and a round of everything else that
//! has become due meanwhile.

use serde::Serialize;

use super::budget::Budget;
use super::{advice, told};
use crate::engine::codec;
use crate::engine::device::PointIndex;
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
    /// The longest time between two requests to this device; none where nothing is polled.
    asked_every: Option<f64>,
    /// The request that is on the wire when something comes; and all that is read again and again, once.
    one_request: f64,
    round: f64,
    /// A request that nobody answers, and the silence after it.
    one_silent: f64,
    /// How much of that is the response timeout, and how often it counts.
    timeout: f64,
    timeouts: f64,
}

impl Delays {
    pub fn of(bus: &Bus, settings: &DeviceSettings, asked_every: Option<f64>, budget: &Budget) -> Delays {
        let demanded = settings.device.wire.response_timeout.unwrap_or_default();
        Delays {
            asked_every,
            one_request: budget.longest(),
            round: budget.round(),
            one_silent: budget.one_silent.max(budget.longest()),
            timeout: bus.response_timeout.max(demanded).as_secs_f64(),
            timeouts: if bus.link.line().is_some() { 2.0 } else { 1.0 },
        }
    }

    /// The response timeout with which the rest is over in `time`, if there is a sensible one.
    fn timeout_for(&self, time: f64, every_one_silent: f64) -> Option<Duration> {
        let wanted = self.timeout - (every_one_silent - time) / self.timeouts;
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
    if let (Some(point), Some(asked_every)) = (device.wire.watchdog, delays.asked_every) {
        let time = declared_seconds(settings, point);
        // After a third of a time that is known it is fed before anything else is polled.
        let due = time.filter(|time| *time > 0.0).map_or(f64::INFINITY, |time| time / HEARTBEATS_WITHIN);
        // Otherwise one may be on the wire and everything else be due when it is due, and the device that
        // is silent among that.
        let polled_every = asked_every + delays.one_request + delays.round;
        let every = [
            polled_every.min(due + delays.one_request),
            (polled_every + delays.one_silent).min(due + delays.one_silent),
        ];
        let enough = (polled_every + delays.one_silent).min(delays.one_silent * LONGER);
        all.push(Feeding::new(settings, point, "watchdog", time, every, enough, delays));
    }
    let mut times: Vec<PointIndex> = device.points.iter().filter_map(|point| point.heartbeat).collect();
    times.dedup();
    for point in times {
        let time = declared_seconds(settings, point);
        // What is read and written is two requests, and what may go before each of them.
        let due = time.unwrap_or_default() / HEARTBEATS_WITHIN;
        let every =
            [delays.one_request, delays.one_silent].map(|delay| due + delay + 3.0 * delays.one_request);
        let enough = (delays.one_silent + 3.0 * delays.one_request) * LONGER;
        all.push(Feeding::new(settings, point, "heartbeat", time, every, enough, delays));
    }
    all
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
