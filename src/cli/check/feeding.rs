//! Whether the watchdogs and heartbeats of devices are fed in time, also while another device is silent.
//!
//! A watchdog is fed by any request to its device, so at least as often as the device's most frequent
//! read. What may come between is one request of another device, and of a silent one the wait for its
//! answer and as long again in which the line is left alone.

use serde::Serialize;

use super::told;
use crate::engine::codec;
use crate::engine::device::PointIndex;
use crate::engine::settings::DeviceSettings;
use crate::engine::time::Duration;
use crate::engine::value::Reading;
use crate::engine::wanted;

/// So many times within the time that the device allows a heartbeat is written.
const HEARTBEATS_WITHIN: f64 = 3.0;

/// What the bus does to a device's patience.
#[derive(Clone, Copy)]
pub struct Delays {
    /// The longest time between two requests to this device, in seconds; none where nothing is polled.
    pub asked_every: Option<f64>,
    /// One request that goes before, in seconds: all devices answering, and one of them silent.
    pub one_request: f64,
    pub one_silent: f64,
}

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
}

/// The watchdog and the heartbeats of a device.
pub fn of_device(settings: &DeviceSettings, delays: Delays) -> Vec<Feeding> {
    let device = &settings.device;
    let mut all = Vec::new();
    if let (Some(point), Some(asked_every)) = (device.wire.watchdog, delays.asked_every) {
        let time = declared_seconds(settings, point);
        let every = [delays.one_request, delays.one_silent].map(|delay| asked_every + delay);
        all.push(Feeding::new(settings, point, "watchdog", time, every));
    }
    let mut times: Vec<PointIndex> = device.points.iter().filter_map(|point| point.heartbeat).collect();
    times.dedup();
    for point in times {
        let time = declared_seconds(settings, point);
        // What is read and written is two requests, and what may go before each of them.
        let due = time.unwrap_or_default() / HEARTBEATS_WITHIN;
        let every =
            [delays.one_request, delays.one_silent].map(|delay| due + delay + 3.0 * delays.one_request);
        all.push(Feeding::new(settings, point, "heartbeat", time, every));
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
    ) -> Feeding {
        // 0 switches it off.
        let met = |every: f64| time.map(|time| time == 0.0 || every < time);
        Feeding {
            point: settings.device.points[point].name.clone(),
            kind,
            time,
            fed_every,
            fed_every_one_silent,
            met: met(fed_every),
            met_one_silent: met(fed_every_one_silent),
        }
    }

    /// A line for people, with what to change where it is not met.
    pub fn text(&self, device: &str) -> String {
        let name = format!("{device}: {} `{}`", self.kind, self.point);
        let (every, silent) = (told(self.fed_every), told(self.fed_every_one_silent));
        match (self.time, self.met, self.met_one_silent) {
            (Some(0.0), ..) => format!("{name} is off"),
            (Some(time), Some(true), Some(true)) => format!(
                "{name} of {} is fed at least every {every}, {silent} while a device is silent",
                told(time)
            ),
            (Some(time), Some(true), _) => format!(
                "{name} of {} may run out while another device is silent: it is then fed every {silent}; \
                 make it longer, or `response_timeout` shorter",
                told(time)
            ),
            (Some(time), ..) => format!(
                "{name} of {} will run out: it is fed every {every}; make it longer, or the `poll` of \
                 {device} faster",
                told(time)
            ),
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

/// The delays that one device's reads meet on a bus.
pub fn delays(asked_every: Option<f64>, longest_read: Duration, longest_timeout: Duration) -> Delays {
    Delays {
        asked_every,
        one_request: longest_read.as_secs_f64(),
        // The wait, and as long again for a late answer.
        one_silent: (longest_timeout * 2).max(longest_read).as_secs_f64(),
    }
}
