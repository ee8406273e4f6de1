//! A device as people see it on the status page: everything that is known of it now, and of the rest why
//! it is not known.

use crate::engine::codec;
use crate::engine::device::{Point, PointIndex, Poll, Thing, ThingKind};
use crate::engine::health::{DeviceReport, PeriodReport, PointReport, Readout, Role, ThingReport, good_for};
use crate::engine::time::{Duration, Time};
use crate::engine::value::{Missing, Reading};

use super::{DeviceState, Presence};

impl DeviceState {
    pub(in crate::engine::bus) fn report(&self, now: Time) -> DeviceReport {
        let device = &self.settings.device;
        let points = device.points.iter().enumerate().filter(|(_, point)| !point.is_button());
        // A button has no state.
        let things = device.things.iter().filter(|thing| thing.kind != ThingKind::Button);
        DeviceReport {
            points: points.map(|(index, point)| self.report_point(index, point)).collect(),
            things: things.map(|thing| self.report_thing(thing)).collect(),
            ..self.summary(now)
        }
    }

    /// Without points and things, which are most of it.
    pub(in crate::engine::bus) fn summary(&self, now: Time) -> DeviceReport {
        let device = &self.settings.device;
        DeviceReport {
            name: self.settings.name.clone(),
            title: self.settings.title.clone(),
            profile: device.profile.clone(),
            manufacturer: device.manufacturer.clone(),
            model: device.model.clone(),
            unit: self.settings.unit,
            online: self.told.is_available(),
            is_missed: !self.told.is_available()
                && (self.patience.is_probing() || matches!(self.presence, Presence::Mismatch { .. })),
            reason: self.why_not_online(),
            identity: self.identity.clone(),
            counters: self.counters,
            load: self.load.share(now),
            last_answer_at: self.last_answer_at,
            timing: self.turnaround.report(now),
            periods: self.report_periods(now),
            points: Vec::new(),
            readings: Vec::new(),
            things: Vec::new(),
            drift: self.upkeep.drift(),
        }
    }

    /// The readings that a poll has brought in its time. On a bus that is too slow that time is as long as
    /// it really takes.
    pub(in crate::engine::bus) fn readings(&self, now: Time) -> Vec<Readout> {
        let mut readings = Vec::new();
        for (read, period) in self.polls.with_periods() {
            for (point, _) in &read.points {
                let (details, reading) = (self.details(*point), self.values.reading(*point));
                let is_fresh = match (self.values.read_at(*point), period) {
                    (Some(read_at), Some(period)) => now - read_at <= good_for(period),
                    // What is read once is true as long as the device is there.
                    (read_at, None) => read_at.is_some(),
                    (None, _) => false,
                };
                if !is_fresh || details.event.is_some() || details.is_button() {
                    continue;
                }
                if let Ok(resolved) = codec::resolve(self.device(), *point, self.known()) {
                    readings.extend(Readout::of(&details.name, &resolved, reading));
                }
            }
        }
        readings
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
            title: point.presentation.title(&point.name),
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
            return match self.told.happened_at(index) {
                Some(at) => PointReport { value: event.clone(), read_at: Some(at), ..told },
                None => {
                    let missing = ("no_event", "not since the start".into());
                    PointReport { missing: Some(missing), ..told }
                }
            };
        }
        let reading = self.values.reading(index);
        PointReport {
            value: reading.to_string(),
            is_list: matches!(reading, Reading::List(_)),
            unit: self.unit_of(index),
            missing: self.why_missing(index),
            read_at: self.values.read_at(index),
            good_for: self.period_of(point.poll).map(good_for),
            ..told
        }
    }

    /// Why the point has no value, as a word for programs and as a sentence.
    pub(super) fn why_missing(&self, index: PointIndex) -> Option<(&'static str, String)> {
        match self.values.reading(index) {
            Reading::Missing(Missing::NotYetRead) if self.details(index).is_read_on_request() => {
                Some(("on_request", "read only when somebody asks for it".into()))
            }
            Reading::Missing(missing) => Some((missing.name(), missing.to_string())),
            _ => None,
        }
    }

    pub(super) fn period_of(&self, poll: Poll) -> Option<Duration> {
        let intervals = self.settings.device.wire.intervals;
        match poll {
            Poll::Fast => Some(intervals.fast),
            Poll::Slow => Some(intervals.slow),
            Poll::Once | Poll::Never => None,
        }
    }

    fn report_thing(&self, thing: &Thing) -> ThingReport {
        let state = self.state_of(thing);
        let missing = state.as_ref().err().map(|missing| match missing {
            _ if self.presence != Presence::Present => Missing::Offline,
            missing => missing.clone(),
        });
        let missing = missing.map(|missing| (missing.name(), missing.to_string()));
        let state = state.ok().map(str::to_string);
        let name_of = |point: PointIndex| self.details(point).name.clone();
        let mut made_of: Vec<String> =
            thing.states.iter().flat_map(|state| &state.row).map(|(point, _)| name_of(*point)).collect();
        made_of.dedup();
        ThingReport {
            name: thing.name.clone(),
            title: thing.presentation.title(&thing.name),
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::bus::{Action, Bus, Event};
    use crate::engine::configuration;
    use crate::engine::health::{BusReport, Freshness};
    use crate::engine::modbus::{Discarded, Reply, RequestError};
    use crate::engine::profile::Library;
    use crate::engine::settings::Settings;

    /// A meter with arrays, a damper with events and things, on one bus.
    fn settings() -> Settings {
        let text = "buses: {b: {rtu_over_tcp: 'h:1'}}\ndevices:\n  \
            meter: {profile: metz-connect/mr-sm3, bus: b, unit: 1}\n  \
            damper: {profile: metz-connect/mr-dio42, bus: b, unit: 2}\n";
        match configuration::load("f", text.as_bytes(), &Library::shipped()) {
            Ok((settings, _)) => settings,
            Err(faults) => panic!("{faults:?}"),
        }
    }

    fn bus() -> Bus {
        Bus::new(Time::default(), &settings(), 0, &Default::default())
    }

    fn point<'r>(report: &'r BusReport, device: usize, name: &str) -> &'r PointReport {
        report.devices[device].points.iter().find(|point| point.name == name).expect("a point of it")
    }

    #[test]
    fn of_what_nobody_has_asked_nothing_is_known_and_everything_has_its_reason() {
        let now = Time::from_millis(5000);
        let report = bus().report(now);
        assert_eq!(report.line.as_deref(), Some("19200 8E1"));
        for device in &report.devices {
            assert!(!device.online && device.last_answer_at.is_none());
            assert!(device.periods.iter().all(|period| period.real.is_none()), "{:?}", device.periods);
            for point in &device.points {
                assert_eq!(point.freshness(now, true), Freshness::Missing, "{point:?}");
                assert_eq!(point.read_at, None, "{point:?}");
            }
            for thing in &device.things {
                assert!(thing.state.is_none() && thing.missing.is_some(), "{thing:?}");
            }
        }
        for (device, name, role, missing) in [
            (0, "phase_1_voltage", Role::Value, "not_yet_read"),
            (0, "phase_1_waveform", Role::Value, "on_request"),
            (0, "phase_1_voltage_factor", Role::Setting, "not_yet_read"),
            (0, "phase_1_peak_voltage", Role::Diagnostic, "not_yet_read"),
            (1, "input_1_opened", Role::Event, "no_event"),
        ] {
            let told = point(&report, device, name);
            assert_eq!((told.role, told.missing.as_ref().map(|why| why.0)), (role, Some(missing)), "{name}");
        }
        assert_eq!(report.devices[1].things.iter().filter(|thing| thing.kind == "button").count(), 0);
        assert!(!report.devices[1].things.is_empty());
    }

    #[test]
    fn a_silent_device_tells_why_and_not_that_it_keeps_a_period() {
        let (mut bus, mut now) = (bus(), Time::default());
        for _ in 0..40 {
            while let Some(action) = bus.next_action() {
                match action {
                    // A connection that is made anew.
                    Action::Reopen { .. } => bus.handle(now, Event::LinkUp),
                    Action::Send { timeout, .. } => {
                        let sent_at = now;
                        now += timeout;
                        let result = Err(RequestError::Timeout);
                        let discarded = Discarded::default();
                        let reply =
                            Reply { result, sent_at, first_byte_at: None, last_byte_at: None, discarded };
                        bus.handle(now, Event::Reply(reply));
                    }
                    _ => {}
                }
            }
            now += Duration::from_secs(1);
            bus.handle(now, Event::Wake);
        }
        let report = bus.report(now);
        for device in &report.devices {
            assert!(device.counters.timeouts >= 3, "{:?}", device.counters);
            let reason = "no answer in time, 3 times in a row; check its power, its wiring and its unit";
            assert_eq!(device.reason.as_deref(), Some(reason));
            assert!(device.periods.iter().all(|period| period.real.is_none()));
            let events = device.points.iter().filter(|point| point.role == Role::Event);
            assert!(
                events.clone().all(|point| point.missing.as_ref().is_some_and(|why| why.0 == "no_event"))
            );
            let others = device.points.iter().filter(|point| point.role != Role::Event);
            assert!(others.clone().all(|point| point.missing.as_ref().is_some_and(|why| why.0 == "offline")));
        }
    }
}
