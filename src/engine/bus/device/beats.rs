//! Heartbeats and watchdogs: registers that must be written again and again, and devices that must be
//! spoken to, or the device acts on the silence.
//!
//! What is written is what was read from the register just before, so that no older order comes back
//! and nobody's wish is made true by it. A watchdog is fed by any request: a read goes before its time.

use crate::engine::codec::{self, Resolved};
use crate::engine::command::{words_of, write_call};
use crate::engine::device::{Device, PointIndex};
use crate::engine::modbus::{Answer, Call, RequestError};
use crate::engine::time::{Duration, Time};
use crate::engine::value::{Decimal, Reading};

use super::{Context, DeviceState, Presence, Severity};

/// So many times within the time that the device allows a heartbeat is due, or a request of any kind.
const WITHIN: u32 = 3;

/// How long a heartbeat or a watchdog has waited.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::engine::bus) enum Need {
    /// It is due: a third of the time that the device allows is over, or more.
    Due,
    /// Two thirds are over: the device is about to act on the silence.
    Late,
}

impl Need {
    /// The parts of that time that are over then.
    fn parts(self) -> u32 {
        match self {
            Need::Due => 1,
            Need::Late => 2,
        }
    }
}

/// The registers of one device that want to be written.
#[derive(Clone, Debug, Default)]
pub(super) struct Beats {
    list: Vec<Beat>,
}

#[derive(Clone, Debug)]
struct Beat {
    point: PointIndex,
    /// The point with the longest time between two writes.
    time: PointIndex,
    /// When the last one was tried; `None`: never since the device came.
    tried_at: Option<Time>,
    /// Said once: the device does not take it.
    is_refused: bool,
}

impl Beats {
    pub(super) fn new(device: &Device) -> Beats {
        let beat = |(point, details): (PointIndex, &crate::engine::device::Point)| {
            Some(Beat { point, time: details.heartbeat?, tried_at: None, is_refused: false })
        };
        Beats { list: device.points.iter().enumerate().filter_map(beat).collect() }
    }

    /// The device is gone; when it comes back its time runs anew.
    pub(super) fn stop(&mut self) {
        self.list.iter_mut().for_each(|beat| beat.tried_at = None);
    }
}

impl DeviceState {
    /// The first heartbeat with that need.
    pub(in crate::engine::bus) fn beat_due(&self, now: Time, need: Need) -> Option<PointIndex> {
        let due = |beat: &&Beat| {
            let Some(interval) = self.interval_of(beat) else { return false };
            let Some(tried_at) = beat.tried_at else { return true };
            now >= tried_at + interval * need.parts()
        };
        self.beats.list.iter().find(due).map(|beat| beat.point)
    }

    /// The read that feeds the watchdog, if nothing has spoken to the device for so long that it has that need.
    pub(in crate::engine::bus) fn feed_due(&self, now: Time, need: Need) -> Option<usize> {
        let interval = self.feeding_interval()?;
        let due = now >= self.served_at + interval * need.parts();
        if due && now >= self.paused_until { self.polls.oldest(now) } else { None }
    }

    /// When the next heartbeat or watchdog is due.
    pub(in crate::engine::bus) fn beats_at(&self) -> Option<Time> {
        let at = |beat: &Beat| {
            let interval = self.interval_of(beat)?;
            Some(beat.tried_at.map_or(Time::default(), |tried_at| tried_at + interval))
        };
        let fed = self.feeding_interval().map(|interval| (self.served_at + interval).max(self.paused_until));
        self.beats.list.iter().filter_map(at).chain(fed).min()
    }

    fn feeding_interval(&self) -> Option<Duration> {
        match self.values.reading(self.device().wire.watchdog?) {
            Reading::Number(seconds) => self.part_of(*seconds),
            _ => None,
        }
    }

    /// `None` also while the register has no meaning in this mode, or its time is not known.
    fn interval_of(&self, beat: &Beat) -> Option<Duration> {
        codec::resolve(self.device(), beat.point, self.known()).ok()?;
        let resolved = codec::resolve(self.device(), beat.time, self.known()).ok()?;
        self.part_of(codec::to_unit(&resolved, self.known()[beat.time]?)?)
    }

    /// A part of the time that the device allows. `None`: nothing is wanted, since the device is away or
    /// does not answer, or the time is 0.
    fn part_of(&self, seconds: Decimal) -> Option<Duration> {
        if self.presence != Presence::Present || self.patience.failures() > 0 {
            return None;
        }
        let micros = seconds.checked_mul(Decimal::integer(1_000_000))?.to_f64();
        let time = Duration::from_micros(micros.max(0.0) as u64);
        (!time.is_zero()).then_some(time / WITHIN)
    }

    /// The register has been read: the write that repeats it, if it holds anything to repeat.
    pub(in crate::engine::bus) fn beat_read(
        &mut self,
        now: Time,
        point: PointIndex,
        result: &Result<Answer, RequestError>,
        context: &mut Context,
    ) -> Option<Call> {
        self.beat_tried(now, point);
        let answer = match result {
            Ok(answer) => answer,
            Err(error) => {
                self.beat_failed(now, point, error, context);
                return None;
            }
        };
        let words = words_of(answer);
        self.read_beside(now, self.details(point).at.span, &words, context);
        let details = self.details(point);
        let field = codec::words_at(details.at, details.at.span.first(), &words)?;
        let resolved: Resolved<'_> = codec::resolve(self.device(), point, self.known()).ok()?;
        if let Reading::Missing(_) = codec::read(&resolved, &field) {
            return None;
        }
        Some(write_call(details.write.as_ref()?, &field))
    }

    pub(in crate::engine::bus) fn beat_written(
        &mut self,
        now: Time,
        point: PointIndex,
        result: &Result<Answer, RequestError>,
        context: &mut Context,
    ) {
        self.counters.writes += 1;
        match result {
            Ok(_) => {
                if let Some(beat) = self.beats.list.iter_mut().find(|beat| beat.point == point) {
                    beat.is_refused = false;
                }
            }
            Err(error) => self.beat_failed(now, point, error, context),
        }
    }

    fn beat_tried(&mut self, now: Time, point: PointIndex) {
        if let Some(beat) = self.beats.list.iter_mut().find(|beat| beat.point == point) {
            beat.tried_at = Some(now);
        }
    }

    fn beat_failed(&mut self, now: Time, point: PointIndex, error: &RequestError, context: &mut Context) {
        if !matches!(error, RequestError::Exception(_)) {
            self.failed(now, error, context);
            return;
        }
        let name = format!("{}: {}", self.settings.name, self.details(point).name);
        let Some(beat) = self.beats.list.iter_mut().find(|beat| beat.point == point) else { return };
        if !std::mem::replace(&mut beat.is_refused, true) {
            let text = format!("device {name}: the heartbeat fails: {error}; the device will act on it");
            context.say(Severity::Warning, text);
        }
    }
}
