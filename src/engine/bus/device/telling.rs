//! What a device tells: its values, whether it is there, what it is to Home Assistant, and why
//! something is missing.

use std::collections::BTreeMap;

use serde_json::json;

use crate::engine::codec;
use crate::engine::device::{Device, PointIndex, Poll, Thing};
use crate::engine::health::drift_json;
use crate::engine::homeassistant::{self, Announcement, Outline};
use crate::engine::time::{Duration, Time};
use crate::engine::topics::{Message, OFFLINE, ONLINE};
use crate::engine::value::{Missing, Reading};

use super::whole::Whole;
use super::{Context, DeviceState};

/// What the broker was last told of a device.
pub(super) struct Told {
    available: Option<bool>,
    /// Without dates.
    info: String,
    info_at: Time,
    /// The last info said that the device is there.
    pub(super) present: bool,
    announced: Option<Outline>,
    pub(super) announcement_due: bool,
    /// A `get` or a command wants these told even if they have not changed.
    wanted: Vec<PointIndex>,
    /// What each thing was last told to be.
    things: Vec<Option<ToldThing>>,
    /// Why a thing has no state has changed since the last info.
    missing_changed: bool,
    /// When the points that tell events last did.
    happened: BTreeMap<PointIndex, Time>,
    pub(super) whole: Whole,
}

#[derive(Clone)]
struct ToldThing {
    text: String,
    /// Why it had no state.
    missing: Option<Missing>,
    at: Time,
}

impl Told {
    pub(super) fn nothing(device: &Device) -> Told {
        Told {
            available: None,
            info: String::new(),
            info_at: Time::default(),
            present: false,
            announced: None,
            announcement_due: true,
            wanted: Vec::new(),
            things: vec![None; device.things.len()],
            missing_changed: false,
            happened: BTreeMap::new(),
            whole: Whole::default(),
        }
    }

    /// The point is told next time even if it has not changed.
    pub(super) fn want(&mut self, point: PointIndex) {
        if !self.wanted.contains(&point) {
            self.wanted.push(point);
        }
    }

    pub(super) fn is_wanted(&self, point: PointIndex) -> bool {
        self.wanted.contains(&point)
    }

    pub(super) fn is_anything_wanted(&self) -> bool {
        !self.wanted.is_empty()
    }

    fn take_wanted(&mut self, point: PointIndex) -> bool {
        let at = self.wanted.iter().position(|other| *other == point);
        at.map(|at| self.wanted.remove(at)).is_some()
    }

    /// Whether why a thing has no state has changed since this was last called.
    pub(super) fn take_missing_changed(&mut self) -> bool {
        std::mem::take(&mut self.missing_changed)
    }

    pub(super) fn is_available(&self) -> bool {
        self.available == Some(true)
    }

    pub(super) fn has_announced(&self) -> bool {
        self.announced.is_some()
    }

    pub(super) fn happened_at(&self, point: PointIndex) -> Option<Time> {
        self.happened.get(&point).copied()
    }
}

impl DeviceState {
    pub(super) fn tell_all(&mut self, now: Time, context: &mut Context) {
        for point in 0..self.settings.device.points.len() {
            self.tell(now, point, context);
        }
        self.tell_things(now, context);
    }

    /// Tells what has changed, and nothing else: nothing has been read now, so whoever waits for a reading goes on
    /// waiting, and what was told long ago does not become newer.
    pub(super) fn tell_changes(&mut self, now: Time, context: &mut Context) {
        for point in 0..self.settings.device.points.len() {
            self.tell_if(now, point, false, Duration::MAX, context);
        }
        self.tell_things_after(now, Duration::MAX, context);
    }

    pub(super) fn tell(&mut self, now: Time, point: PointIndex, context: &mut Context) {
        let anyway = self.told.take_wanted(point);
        let again = self.told_again_after(self.details(point).poll, context.republish);
        self.tell_if(now, point, anyway, again, context);
    }

    /// Tells the point if it has changed, was told longer ago than `again`, or `anyway`.
    fn tell_if(
        &mut self,
        now: Time,
        point: PointIndex,
        anyway: bool,
        again: Duration,
        context: &mut Context,
    ) {
        let details = &self.settings.device.points[point];
        if details.is_button() {
            return;
        }
        if let Some(event) = &details.event {
            if self.values.take_flip(now, point) {
                self.told.happened.insert(point, now);
                let topic = context.topics_of(&self.settings.name).state(&details.name);
                context.publish(Message::once(topic, json!({"event_type": event}).to_string()));
            }
            return;
        }
        if !anyway && !self.values.may_be_told(now, point, again) {
            return;
        }
        let before = self.values.told(point).map(Reading::to_string);
        if let Some(text) = self.values.tell(now, point, details, again, anyway) {
            if before.as_ref() == Some(&text) {
                self.told.whole.is_told_again(now, context.republish);
            } else {
                self.told.whole.has_changed();
            }
            let topic = context.topics_of(&self.settings.name).state(&details.name);
            context.publish(Message::retained(topic, text));
        }
    }

    /// After which time what has not changed is told again. It is told when it is read: where the next reading
    /// would be too late for `republish`, this one is the time.
    pub(super) fn told_again_after(&self, poll: Poll, republish: Duration) -> Duration {
        let early = |period: Duration| {
            let latest = republish.as_micros().saturating_sub(period.as_micros()) as u64;
            Duration::from_micros(latest + 1).min(republish)
        };
        self.period_of(poll).map_or(republish, early)
    }

    /// What things are follows from what their points say. They are looked at after each poll.
    pub(super) fn tell_things(&mut self, now: Time, context: &mut Context) {
        if self.settings.device.things.is_empty() {
            return;
        }
        let is_fast = self.settings.device.points.iter().any(|point| point.poll == Poll::Fast);
        let again = self.told_again_after(if is_fast { Poll::Fast } else { Poll::Slow }, context.republish);
        self.tell_things_after(now, again, context);
    }

    /// The same, and again what was told so long ago.
    fn tell_things_after(&mut self, now: Time, again: Duration, context: &mut Context) {
        for (index, thing) in self.settings.device.things.iter().enumerate() {
            if thing.states.is_empty() {
                continue;
            }
            let state = self.state_of(thing);
            let text = *state.as_ref().unwrap_or(&"None");
            let missing = state.err();
            let Told { things, whole, missing_changed, .. } = &mut self.told;
            let told = &mut things[index];
            let before = told.as_ref().map(|told| told.text.as_str());
            if told.as_ref().is_none_or(|told| told.missing != missing) {
                *missing_changed = true;
            }
            if before == Some(text) && told.as_ref().is_some_and(|told| now - told.at < again) {
                told.iter_mut().for_each(|told| told.missing.clone_from(&missing));
                continue;
            }
            if before == Some(text) {
                whole.is_told_again(now, context.republish);
            } else {
                whole.has_changed();
            }
            *told = Some(ToldThing { text: text.to_string(), missing, at: now });
            let topic = context.topics_of(&self.settings.name).state(&thing.name);
            context.publish(Message::retained(topic, text));
        }
    }

    /// The first of the thing's states whose row holds, or why there is none. One that might hold, if a point were known
    /// that has no value now, keeps those behind it from being told.
    pub(super) fn state_of<'t>(&self, thing: &'t Thing) -> Result<&'t str, Missing> {
        if !codec::lives(self.device(), &thing.when, self.known())? {
            return Err(Missing::NotInThisMode);
        }
        let denies = |(point, text): &(PointIndex, String)| match self.values.reading(*point) {
            Reading::Missing(_) => false,
            reading => reading.to_string() != *text,
        };
        let is_missing = |point: &PointIndex| matches!(self.values.reading(*point), Reading::Missing(_));
        let state = thing.states.iter().find(|state| !state.row.iter().any(denies));
        let state = state.ok_or(Missing::NoState)?;
        match state.row.iter().map(|(point, _)| *point).find(is_missing) {
            Some(point) => Err(Missing::WaitingFor(self.details(point).name.clone())),
            None => Ok(&state.name),
        }
    }

    /// The thing is told again even if it has not changed.
    pub(in crate::engine::bus) fn want_thing(&mut self, thing: usize) {
        self.told.things[thing] = None;
        let states = &self.settings.device.things[thing].states;
        for point in states.iter().flat_map(|state| &state.row).map(|(point, _)| *point) {
            self.polls.want(point);
        }
    }

    pub(super) fn publish_availability(&mut self, available: bool, context: &mut Context) {
        if self.told.available == Some(available) {
            return;
        }
        self.told.available = Some(available);
        let topic = context.topics_of(&self.settings.name).availability();
        context.publish(Message::retained(topic, if available { ONLINE } else { OFFLINE }));
    }

    /// What was told counts no more, since all is told elsewhere or otherwise from now on: what is known is told again.
    /// `is_announced_there`: what was announced stands where it is announced now.
    pub(in crate::engine::bus) fn tell_anew(
        &mut self,
        now: Time,
        is_announced_there: bool,
        context: &mut Context,
    ) {
        let available = self.told.available.take() == Some(true);
        self.told.info.clear();
        self.told.things.fill(None);
        self.told.whole = Whole::default();
        self.values.forget_what_was_told(&self.settings.device);
        if !is_announced_there {
            self.told.announced = None;
        }
        self.told.announcement_due = true;
        // Of a device that is away it may not be known what it is, and less than all would take entities away.
        if available || homeassistant::is_settled(&self.settings.device, self.values.known()) {
            self.announce(context);
        }
        self.tell_changes(now, context);
        self.tell_whole_at_once(now, context);
        self.publish_availability(available, context);
        self.tell_info(now, context);
    }

    /// The last word before the end.
    pub(in crate::engine::bus) fn say_offline(&mut self, context: &mut Context) {
        self.publish_availability(false, context);
    }

    pub(super) fn announce(&mut self, context: &mut Context) {
        self.told.announcement_due = false;
        if !context.telling.discovery {
            return;
        }
        let next = self.announcement(context);
        if next.is_empty() && self.told.announced.is_none() {
            return;
        }
        let message = next.message();
        let outline = Outline::of(&next, &message);
        if self.told.announced.as_ref() == Some(&outline) {
            return;
        }
        let previous = self.told.announced.replace(outline);
        if let Some(farewell) = previous.and_then(|previous| previous.farewell(&next)) {
            context.publish(farewell);
        }
        context.publish(message);
    }

    /// What Home Assistant is to know of the device now.
    pub(super) fn announcement(&self, context: &Context) -> Announcement {
        homeassistant::announcement(
            &context.telling.gateway,
            &self.settings,
            &context.bus_name,
            self.values.known(),
        )
    }

    /// Whether the info is as old as anything is told again.
    pub(super) fn info_is_old(&self, now: Time, context: &Context) -> bool {
        now - self.told.info_at >= context.republish
    }

    /// What is known of the device beside its values. When each of them was last read belongs to it, and is
    /// no reason to tell it: so it is as of when this was told.
    pub(super) fn tell_info(&mut self, now: Time, context: &mut Context) {
        let is_online = self.told.is_available();
        let missing = if is_online { self.missing_json() } else { json!({}) };
        let mut info = json!({
            "profile": self.settings.device.profile,
            "manufacturer": self.settings.device.manufacturer,
            "model": self.settings.device.model,
            "identity": self.identity,
            "bus": context.bus_name,
            "unit": self.settings.unit,
            "online": is_online,
            "reason": self.why_not_online(),
            "missing": missing,
            "eeprom_writes": self.counters.persistent_writes,
            "drift": drift_json(&self.upkeep.drift()),
        });
        if self.settings.device.points.iter().any(|point| point.persistent) {
            info["eeprom"] = self.eeprom_json(now, context);
        }
        self.told.present = is_online;
        let without_dates = info.to_string();
        if without_dates == self.told.info && !self.info_is_old(now, context) {
            return;
        }
        (self.told.info, self.told.info_at) = (without_dates, now);
        info["last_read"] = self.dates_of_readings(context);
        context.publish(Message::retained(context.topics_of(&self.settings.name).info(), info.to_string()));
    }

    /// Why there is no value on the topics on which `None` stands.
    fn missing_json(&self) -> serde_json::Value {
        let device = &self.settings.device;
        let points = device.points.iter().enumerate().filter(|(_, point)| !point.is_button());
        let of_points = points.filter_map(|(index, point)| Some((&point.name, self.why_missing(index)?.1)));
        let things = device.things.iter().filter(|thing| !thing.states.is_empty());
        let of_things =
            things.filter_map(|thing| Some((&thing.name, self.state_of(thing).err()?.to_string())));
        of_points
            .chain(of_things)
            .map(|(name, why)| (name.clone(), why.into()))
            .collect::<serde_json::Map<_, _>>()
            .into()
    }

    /// What the guard of the EEPROM holds back: values that wait, each until when, and until when nothing at all
    /// is written.
    fn eeprom_json(&self, now: Time, context: &Context) -> serde_json::Value {
        let date = |time: Time| match context.date_of(time) {
            Some(date) => serde_json::Value::from(date.to_string()),
            None => serde_json::Value::Null,
        };
        let waiting = self.wear.waiting.iter().map(|point| {
            let name = self.settings.device.points[*point].name.clone();
            (name, date(self.wear.allowed_at(*point)))
        });
        let waiting: serde_json::Map<String, serde_json::Value> = waiting.collect();
        let is_spent = self.wear.spent(now).is_some();
        json!({"waiting": waiting, "spent": is_spent, "spent_until": is_spent.then(|| date(self.wear.budget_at()))})
    }

    /// These points wait for their EEPROM's sake; who looks at the device shall see it.
    pub(in crate::engine::bus) fn wait_for_eeprom(
        &mut self,
        now: Time,
        points: Vec<PointIndex>,
        context: &mut Context,
    ) {
        if self.wear.waiting != points {
            self.wear.waiting = points;
            self.tell_info(now, context);
        }
    }

    /// When each point was last read, also those that say nothing now.
    fn dates_of_readings(&self, context: &Context) -> serde_json::Value {
        let points = self.settings.device.points.iter().enumerate();
        let dates = points.filter(|(_, point)| !point.is_button() && point.event.is_none()).filter_map(
            |(index, point)| {
                let date = context.date_of(self.values.read_at(index)?)?;
                Some((point.name.clone(), serde_json::Value::from(date.to_string())))
            },
        );
        serde_json::Value::Object(dates.collect())
    }
}
