//! What a device has to do with requests: what of it may be read and written as it is, what words
//! mean, and what is read again because a program wants to hear it.

use serde_json::{Map, Value as Json};

use crate::engine::address::Span;
use crate::engine::codec;
use crate::engine::device::PointIndex;
use crate::engine::health::Counters;
use crate::engine::time::Time;
use crate::engine::value::Missing;

use super::{Context, DeviceState, Target};

impl DeviceState {
    pub(in crate::engine::bus) fn identity(&self) -> Option<&str> {
        self.identity.as_deref()
    }

    pub(in crate::engine::bus) fn counters(&self) -> Counters {
        self.counters
    }

    pub(in crate::engine::bus) fn clamps_with_exception(&self) -> bool {
        self.settings.device.wire.quirks.clamps_with_exception
    }

    pub(in crate::engine::bus) fn is_present_and_answers(&self) -> bool {
        self.is_present() && self.patience.failures() == 0
    }

    pub(in crate::engine::bus) fn why_not_asked(&self) -> String {
        self.reason().unwrap_or_else(|| "the bus is busy".into())
    }

    /// Every point that has an address in `span`, where it is read or where it is written.
    pub(in crate::engine::bus) fn points_touching(&self, span: Span) -> Vec<PointIndex> {
        let touches = |(_, point): &(PointIndex, &crate::engine::device::Point)| {
            let written = point.write.as_ref().map(|write| write.at.span);
            let also = point.also.map(|also| also.span);
            [Some(point.at.span), written, also].into_iter().flatten().any(|place| place.overlaps(span))
        };
        self.device().points.iter().enumerate().filter(touches).map(|(index, _)| index).collect()
    }

    /// Whether one read of `span` keeps to what the profile says of the device; an error is the rule
    /// that it breaks.
    pub(in crate::engine::bus) fn may_read(&self, span: Span, clears: bool) -> Result<(), String> {
        let wire = &self.device().wire;
        let limits = wire.limits;
        let most = if span.table().is_bits() { limits.read_bits } else { limits.read_registers };
        if span.count() > u32::from(most) {
            return Err(format!("`{span}` has {} addresses; one read takes at most {most}", span.count()));
        }
        self.is_allowed(span)?;
        if !wire.readable.is_empty() && !wire.readable.iter().any(|readable| readable.contains(span)) {
            let places: Vec<String> = wire.readable.iter().map(|span| format!("`{span}`")).collect();
            return Err(format!("`{span}` cannot be read; expected a part of {}", places.join(", ")));
        }
        for point in self.points_touching(span) {
            let details = self.details(point);
            if details.read_clears && details.at.span.overlaps(span) {
                let place = details.at.span;
                let name = &details.name;
                if !clears {
                    return Err(format!(
                        "reading `{name}` ({place}) changes the device; with \"clears\":true it is read"
                    ));
                }
                if place != span {
                    return Err(format!(
                        "reading `{name}` changes the device, and it is read alone; expected `{place}`"
                    ));
                }
            }
        }
        self.splits_nothing(span)
    }

    /// Whether the configuration lets `span` be written as it is.
    pub(in crate::engine::bus) fn may_write_raw(&self, span: Span) -> Result<(), String> {
        let allowed = &self.settings.raw_write;
        if !allowed.iter().any(|allowed| allowed.contains(span)) {
            let remedy = if allowed.is_empty() {
                format!("`raw_write: [{span}]` under `{}` in the configuration would allow it", self.name())
            } else {
                let places: Vec<String> = allowed.iter().map(|span| format!("`{span}`")).collect();
                format!("`raw_write` of `{}` allows {}", self.name(), places.join(", "))
            };
            return Err(format!("`{span}` must not be written as it is; {remedy}"));
        }
        self.is_allowed(span)?;
        let limits = self.device().wire.limits;
        if !span.table().is_bits() && span.count() > u32::from(limits.write_registers) {
            let most = limits.write_registers;
            return Err(format!("`{span}` has {} registers; one write takes at most {most}", span.count()));
        }
        self.splits_nothing(span)?;
        // It is read back, so that nobody has to believe it.
        self.may_read(span, false).map_err(|reason| format!("it could not be read back: {reason}"))
    }

    fn is_allowed(&self, span: Span) -> Result<(), String> {
        match self.device().wire.forbidden.iter().find(|forbidden| forbidden.span.overlaps(span)) {
            Some(forbidden) => Err(format!(
                "`{span}` touches `{}`, which is forbidden: {}",
                forbidden.span, forbidden.reason
            )),
            None => Ok(()),
        }
    }

    /// A value of several registers is asked for as a whole; an array may be cut between two elements.
    fn splits_nothing(&self, span: Span) -> Result<(), String> {
        for point in self.points_touching(span) {
            let details = self.details(point);
            let written = details.write.as_ref().map(|write| write.at.span);
            for place in
                [Some(details.at.span), details.also.map(|also| also.span), written].into_iter().flatten()
            {
                let elements = details.plain().map_or(1, |form| u32::from(form.elements).max(1));
                let width = (place.count() / elements).max(1);
                let is_cut = |at: u32| {
                    let first = u32::from(place.first());
                    at > first && at < first + place.count() && (at - first) % width != 0
                };
                let ends = [u32::from(span.first()), u32::from(span.last()) + 1];
                if place.table() == span.table() && ends.into_iter().any(is_cut) {
                    return Err(format!("`{span}` splits `{}`; expected all of `{place}`", details.name));
                }
            }
        }
        Ok(())
    }

    /// Why `points` may not be written now, for their EEPROM's sake.
    pub(in crate::engine::bus) fn why_spared(&self, now: Time, points: &[PointIndex]) -> Option<String> {
        let allowed = points.iter().map(|point| self.writable_at(Target::Point(*point))).max();
        if let Some(allowed) = allowed.filter(|allowed| now < *allowed) {
            let left = (allowed - now).as_secs() + 1;
            return Some(format!("this EEPROM has just been written; the next write may come in {left} s"));
        }
        points.iter().find_map(|point| self.is_spent(now, *point))
    }

    /// One write to all of `points` goes out.
    pub(in crate::engine::bus) fn about_to_write_raw(
        &mut self,
        now: Time,
        points: &[PointIndex],
        context: &mut Context,
    ) {
        let writes = self.counters.writes + 1;
        for point in points {
            self.about_to_write(now, *point, context);
        }
        self.counters.writes = writes;
    }

    /// What a raw write may have changed is read again, and told.
    pub(in crate::engine::bus) fn raw_write_ended(
        &mut self,
        now: Time,
        points: &[PointIndex],
        context: &mut Context,
    ) {
        for point in points {
            if self.details(*point).is_read() {
                self.want(*point);
            }
            for partner in self.details(*point).re_read.clone() {
                self.polls.want(partner);
            }
        }
        self.after_news(now, context);
    }

    /// Words that a request has read: news for the polled points in it.
    pub(in crate::engine::bus) fn read_for_request(
        &mut self,
        now: Time,
        span: Span,
        words: &[u16],
        context: &mut Context,
    ) {
        self.read_beside(now, span, words, context);
        self.after_news(now, context);
    }

    /// What the words of a span say where points lie, as it is published.
    pub(in crate::engine::bus) fn readings_in(&self, span: Span, words: &[u16]) -> Map<String, Json> {
        let device = self.device();
        let mut readings = Map::new();
        for (index, point) in device.points.iter().enumerate().filter(|(_, point)| !point.is_button()) {
            let places = [Some(point.at), point.also];
            let Some(at) = places.into_iter().flatten().find(|place| span.contains(place.span)) else {
                continue;
            };
            let Some(field) = codec::words_at(at, span.first(), words) else { continue };
            let text = match codec::resolve(device, index, self.known()) {
                Ok(resolved) => codec::read(&resolved, &field).to_string(),
                Err(_) => "None".into(),
            };
            readings.insert(point.name.clone(), text.into());
        }
        readings
    }

    /// Everything (or one thing) is read again and told even if it has not changed, and the device is
    /// announced again. Which points will be told.
    pub(in crate::engine::bus) fn refresh(
        &mut self,
        now: Time,
        target: Option<Target>,
        context: &mut Context,
    ) -> Vec<PointIndex> {
        let wanted: Vec<PointIndex> = match target {
            Some(Target::Point(point) | Target::Setting(point)) => vec![point],
            Some(Target::Thing(thing)) => {
                self.want_thing(thing);
                let states = &self.settings.device.things[thing].states;
                states.iter().flat_map(|state| &state.row).map(|(point, _)| *point).collect()
            }
            None => {
                (0..self.settings.device.things.len()).for_each(|thing| self.want_thing(thing));
                (0..self.settings.device.points.len())
                    .filter(|point| self.details(*point).is_read())
                    .collect()
            }
        };
        for point in &wanted {
            if self.details(*point).event.is_none() {
                self.want(*point);
            }
            // Nothing will be read that could tell it.
            let resolved = codec::resolve(self.device(), *point, self.known()).err();
            if resolved == Some(Missing::NotInThisMode) {
                self.tell(now, *point, context);
            }
        }
        if self.told.has_announced() {
            context.publish(self.announcement(context).message());
        }
        wanted
    }

    /// Whether the point still waits to be told although it may not have changed.
    pub(in crate::engine::bus) fn is_to_be_told(&self, point: PointIndex) -> bool {
        self.told.is_wanted(point)
    }
}
