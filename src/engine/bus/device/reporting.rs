//! A device as people see it on the status page: everything that is known of it now, and of the rest why
//! it is not known.

use crate::engine::codec;
use crate::engine::device::{Point, PointIndex, Poll, Thing, ThingKind};
use crate::engine::health::{DeviceReport, PeriodReport, PointReport, Role, ThingReport, good_for};
use crate::engine::homeassistant::sentence;
use crate::engine::time::{Duration, Time};
use crate::engine::value::{Missing, Reading};

use super::{DeviceState, Presence};

impl DeviceState {
    pub(in crate::engine::bus) fn report(&self, now: Time) -> DeviceReport {
        let device = &self.settings.device;
        let online = self.told_available == Some(true);
        // It answers, but nothing is told before everything has been read once.
        let begins = (!online && self.presence == Presence::Present).then(|| "being read".to_string());
        let points = device.points.iter().enumerate().filter(|(_, point)| !point.is_button());
        // A button has no state.
        let things = device.things.iter().filter(|thing| thing.kind != ThingKind::Button);
        DeviceReport {
            name: self.settings.name.clone(),
            title: self.settings.title.clone(),
            profile: device.profile.clone(),
            manufacturer: device.manufacturer.clone(),
            model: device.model.clone(),
            unit: self.settings.unit,
            online,
            reason: self.reason().or(begins),
            identity: self.identity.clone(),
            counters: self.counters,
            last_answer_at: self.last_answer_at,
            periods: self.report_periods(now),
            points: points.map(|(index, point)| self.report_point(index, point)).collect(),
            things: things.map(|thing| self.report_thing(thing)).collect(),
            drift: self.upkeep.drift(),
        }
    }

    fn report_periods(&self, now: Time) -> Vec<PeriodReport> {
        let intervals = self.settings.device.wire.intervals;
        [(Poll::Fast, intervals.fast), (Poll::Slow, intervals.slow)]
            .into_iter()
            .filter(|(class, _)| self.settings.device.points.iter().any(|point| point.poll == *class))
            .map(|(class, wanted)| {
                // Nobody keeps a period with a device that is not there.
                let real = self.is_present().then(|| self.polls.real_period(class, now)).flatten();
                PeriodReport { class, wanted, real }
            })
            .collect()
    }

    fn report_point(&self, index: PointIndex, point: &Point) -> PointReport {
        let told = PointReport {
            name: point.name.clone(),
            title: point.presentation.name.clone().unwrap_or_else(|| sentence(&point.name)),
            role: Role::of(point),
            value: "None".into(),
            is_list: false,
            unit: None,
            missing: None,
            read_at: None,
            good_for: None,
        };
        if let Some(event) = &point.event {
            // The bit itself means nothing; that it flipped does.
            return match self.happened.get(&index) {
                Some(at) => PointReport { value: event.clone(), read_at: Some(*at), ..told },
                None => {
                    let missing = ("no_event", "not since the start".into());
                    PointReport { missing: Some(missing), ..told }
                }
            };
        }
        let reading = self.values.reading(index);
        let missing = match reading {
            Reading::Missing(Missing::NotYetRead) if point.is_read_on_request() => {
                Some(("on_request", "read only when somebody asks for it".into()))
            }
            Reading::Missing(missing) => Some((missing.name(), missing.to_string())),
            _ => None,
        };
        PointReport {
            value: reading.to_string(),
            is_list: matches!(reading, Reading::List(_)),
            unit: self.unit_of(index),
            missing,
            read_at: self.values.read_at(index),
            good_for: self.period_of(point).map(good_for),
            ..told
        }
    }

    fn period_of(&self, point: &Point) -> Option<Duration> {
        let intervals = self.settings.device.wire.intervals;
        match point.poll {
            Poll::Fast => Some(intervals.fast),
            Poll::Slow => Some(intervals.slow),
            Poll::Once | Poll::Never => None,
        }
    }

    fn report_thing(&self, thing: &Thing) -> ThingReport {
        let state = self.state_of(thing).map(str::to_string);
        let why = |missing: Missing| Some((missing.name(), missing.to_string()));
        let missing = match codec::lives(self.device(), &thing.when, self.known()) {
            _ if state.is_some() => None,
            _ if self.presence != Presence::Present => why(Missing::Offline),
            Ok(false) => why(Missing::NotInThisMode),
            Err(missing) => why(missing),
            Ok(true) => Some(("no_state", "what its points say is none of its states".into())),
        };
        let name_of = |point: PointIndex| self.details(point).name.clone();
        let mut made_of: Vec<String> =
            thing.states.iter().flat_map(|state| &state.row).map(|(point, _)| name_of(*point)).collect();
        made_of.dedup();
        ThingReport {
            name: thing.name.clone(),
            title: thing.presentation.name.clone().unwrap_or_else(|| sentence(&thing.name)),
            kind: thing.kind.name(),
            state,
            missing,
            made_of,
            temperature: thing.temperature.map(name_of),
            target: thing.target.map(name_of),
        }
    }

    /// The unit of a point as it is told now.
    fn unit_of(&self, point: PointIndex) -> Option<String> {
        codec::resolve(self.device(), point, self.known()).ok().and_then(|resolved| resolved.unit)
    }
}
