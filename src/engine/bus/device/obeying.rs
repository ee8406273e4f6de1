//! What a device does with commands: which it can take, what is asked for them, and what follows.

use crate::engine::codec;
use crate::engine::command::{CommandFlow, Outcome, OutcomeKind};
use crate::engine::device::PointIndex;
use crate::engine::modbus::{Answer, BUSY, RequestError};
use crate::engine::plan::Read;
use crate::engine::time::Time;
use crate::engine::yaml::nearest;

use super::{Context, DeviceState, Presence, Target};
use crate::engine::bus::waiting::Waiting;

/// The targets of which a retained command was seen.
#[derive(Clone, Debug, Default)]
pub(super) struct Retained {
    warned_of: Vec<Target>,
    /// As far as this connection has told.
    at_the_broker: Vec<Target>,
}

impl DeviceState {
    pub(in crate::engine::bus) fn target_named(&self, name: &str) -> Option<Target> {
        let device = &self.settings.device;
        let point = device.point_named(name).map(Target::Point);
        point.or_else(|| device.things.iter().position(|thing| thing.name == name).map(Target::Thing))
    }

    /// What a message on a `set` topic may name.
    pub(in crate::engine::bus) fn names_to_set(&self) -> Vec<&str> {
        let device = &self.settings.device;
        let points = device.points.iter().filter(|point| point.write.is_some());
        points.map(|point| &*point.name).chain(device.things.iter().map(|thing| &*thing.name)).collect()
    }

    /// What can be read again.
    pub(in crate::engine::bus) fn names_to_read(&self) -> Vec<&str> {
        let device = &self.settings.device;
        let points = device.points.iter().filter(|point| !point.is_button());
        points.map(|point| &*point.name).chain(device.things.iter().map(|thing| &*thing.name)).collect()
    }

    /// That there is no such point, and which of `names` may be meant.
    pub(in crate::engine::bus) fn no_point(&self, found: &str, names: &[&str]) -> String {
        let meant = nearest(found, names).map(|name| format!("; did you mean `{name}`?"));
        format!("`{}` has no point `{found}`{}", self.name(), meant.unwrap_or_default())
    }

    pub(in crate::engine::bus) fn name_of(&self, target: Target) -> &str {
        match target {
            Target::Point(point) | Target::Setting(point) => &self.settings.device.points[point].name,
            Target::Thing(thing) => &self.settings.device.things[thing].name,
        }
    }

    pub(in crate::engine::bus) fn is_press(&self, target: Target) -> bool {
        match target {
            Target::Point(point) | Target::Setting(point) => self.details(point).is_button(),
            Target::Thing(thing) => self.settings.device.things[thing].states.is_empty(),
        }
    }

    /// The points that a command to `target` may write.
    pub(in crate::engine::bus) fn written_by(&self, target: Target) -> Vec<PointIndex> {
        match target {
            Target::Point(point) | Target::Setting(point) => vec![point],
            Target::Thing(thing) => {
                let commands = &self.settings.device.things[thing].commands;
                commands.iter().flat_map(|command| &command.orders).map(|(point, _)| *point).collect()
            }
        }
    }

    /// What is written when the thing is told `wanted`; an error is the rule that this breaks.
    pub(in crate::engine::bus) fn orders(
        &self,
        thing: usize,
        wanted: &str,
    ) -> Result<Vec<(PointIndex, String)>, String> {
        let thing = &self.settings.device.things[thing];
        if codec::lives(self.device(), &thing.when, self.known()) != Ok(true) {
            return Err(format!("`{}` does not exist in the present mode of the device", thing.name));
        }
        match thing.command(wanted.trim()) {
            Some(command) => Ok(command.orders.clone()),
            None => {
                let known: Vec<String> =
                    thing.commands.iter().map(|command| format!("`{}`", command.name)).collect();
                Err(format!("`{wanted}` is none of {}", known.join(", ")))
            }
        }
    }

    /// Whether `wanted` is something that the target can be told, as far as it is known now.
    pub(in crate::engine::bus) fn is_valid(&self, target: Target, wanted: &str) -> bool {
        match target {
            Target::Point(point) | Target::Setting(point) => self.obeyed(point, wanted).is_some(),
            Target::Thing(thing) => self.orders(thing, wanted).is_ok(),
        }
    }

    /// What of a point is written for a command, and with which meaning of it.
    fn obeyed(&self, point: PointIndex, wanted: &str) -> Option<(codec::Resolved<'_>, Vec<u16>)> {
        let details = self.details(point);
        let resolved = codec::resolve(self.device(), point, self.known()).ok()?;
        let obeyed = codec::obey(details, details.write.as_ref()?, &resolved, wanted).ok()?;
        Some((resolved, obeyed.words))
    }

    /// Whether a command can begin: the device is there, is the right one, what decides about the points
    /// is known, and their EEPROM has been spared long enough.
    pub(in crate::engine::bus) fn can_take(&self, now: Time, target: Target, wanted: &str) -> bool {
        !self.spares_eeprom(now, target, wanted)
            && self.presence == Presence::Present
            && self.patience.failures() == 0
            && self.unknown_selector(target).is_none()
    }

    /// Whether the command has to wait because what it writes has just been written.
    pub(in crate::engine::bus) fn spares_eeprom(&self, now: Time, target: Target, wanted: &str) -> bool {
        now < self.writable_at(target) && !self.seems_to_hold(target, wanted)
    }

    /// Whether the point's last reading is what is wanted: to find it so again wears out nothing.
    fn seems_to_hold(&self, target: Target, wanted: &str) -> bool {
        let Target::Point(point) = target else { return false };
        let obeyed = self.obeyed(point, wanted);
        obeyed.is_some_and(|(resolved, words)| codec::read(&resolved, &words) == *self.values.reading(point))
    }

    fn unknown_selector(&self, target: Target) -> Option<PointIndex> {
        let of_points = self.written_by(target).into_iter().flat_map(|point| self.details(point).selectors());
        let of_thing = match target {
            Target::Point(_) | Target::Setting(_) => None,
            Target::Thing(thing) => Some(self.settings.device.things[thing].when.iter()),
        };
        let of_thing = of_thing.into_iter().flatten().map(|condition| condition.point);
        of_thing.chain(of_points).find(|selector| self.known()[*selector].is_none())
    }

    /// From when on all that is written may be written, for its EEPROM's sake.
    pub(in crate::engine::bus) fn writable_at(&self, target: Target) -> Time {
        let written = self.written_by(target).into_iter().filter(|point| self.details(*point).persistent);
        let allowed = written.map(|point| self.wear.allowed_at(point)).max();
        match (target, allowed) {
            // A person is told that the budget is spent; a setting waits for it.
            (Target::Setting(_), Some(allowed)) => allowed.max(self.wear.budget_at()),
            (_, allowed) => allowed.unwrap_or_default(),
        }
    }

    /// Why a button that wears out EEPROM is not pressed now. It does not wait as a value does: pressed a
    /// minute late, it would surprise.
    pub(in crate::engine::bus) fn is_too_soon(&self, now: Time, target: Target) -> Option<String> {
        let allowed = self.writable_at(target);
        (now < allowed).then(|| {
            format!(
                "its EEPROM has just been written (`eeprom: {{interval: …}}`); it may be pressed again in {} s",
                (allowed - now).as_secs() + 1
            )
        })
    }

    /// Why a command that waits for its EEPROM's sake waits in vain: its time will have passed before the budget
    /// allows another write.
    pub(in crate::engine::bus) fn is_in_vain(&self, now: Time, waiting: &Waiting) -> Option<String> {
        let is_point = matches!(waiting.target, Target::Point(_));
        if !is_point || !self.spares_eeprom(now, waiting.target, &waiting.wanted.text) {
            return None;
        }
        self.wear.spent_until(now, waiting.deadline_from(self.writable_at(waiting.target)))
    }

    /// Why the point may not be written now, although its own time has come.
    pub(in crate::engine::bus) fn is_spent(&self, now: Time, point: PointIndex) -> Option<String> {
        if self.details(point).persistent { self.wear.spent(now) } else { None }
    }

    /// Why a command has not begun.
    pub(in crate::engine::bus) fn why_not(&self, target: Target) -> String {
        match &self.presence {
            Presence::Absent { reason } | Presence::Mismatch { reason } => reason.clone(),
            Presence::Present => match self.unknown_selector(target) {
                Some(selector) => {
                    format!(
                        "`{}`, which decides what it means, was not read in time",
                        self.details(selector).name
                    )
                }
                None if self.patience.failures() > 0 => "the device does not answer".to_string(),
                None => "the bus had no time for it".to_string(),
            },
        }
    }

    /// Whether this is the first retained command seen for the target.
    pub(in crate::engine::bus) fn warn_of_retained(&mut self, target: Target) -> bool {
        let Retained { warned_of, at_the_broker } = &mut self.retained;
        if !at_the_broker.contains(&target) {
            at_the_broker.push(target);
        }
        let first = !warned_of.contains(&target);
        if first {
            warned_of.push(target);
        }
        first
    }

    /// Why the wish breaks a rule, whatever the device says until it would have its turn: nothing that could change
    /// meanwhile decides what the point means.
    pub(in crate::engine::bus) fn refusal_of(
        &self,
        target: Target,
        wanted: &str,
    ) -> Option<(PointIndex, Outcome)> {
        let Target::Point(point) = target else { return None };
        if !self.is_present() || !self.details(point).selectors().is_empty() {
            return None;
        }
        let outcome = CommandFlow::begin(self.device(), point, wanted, self.known()).err()?;
        Some((point, outcome))
    }

    /// The connection is new: the broker tells again which retained commands it holds.
    pub(in crate::engine::bus) fn forget_retained(&mut self) {
        self.retained.at_the_broker.clear();
    }

    /// Why an empty message on a `set` topic is no value. It is what deletes a retained one, and who had
    /// subscribed before cannot tell the one from the other: only a text may be meant to be empty.
    pub(in crate::engine::bus) fn why_empty_is_no_value(&mut self, target: Target) -> Option<&'static str> {
        let may_be_empty = match target {
            Target::Thing(_) => false,
            Target::Point(point) | Target::Setting(point) => {
                // Of what is not known yet, the command finds out when it begins.
                let resolved = codec::resolve(self.device(), point, self.known());
                resolved.map_or(true, |resolved| resolved.form.kind.is_text())
            }
        };
        if !may_be_empty {
            return Some("an empty message is no value; it only deletes a retained one");
        }
        let at = self.retained.at_the_broker.iter().position(|other| *other == target)?;
        self.retained.at_the_broker.swap_remove(at);
        Some("an empty message deletes the retained one; sent once more, it is an empty text")
    }

    /// A write to `point` goes out: what it decides is unknown until it has been read back.
    pub(in crate::engine::bus) fn about_to_write(
        &mut self,
        now: Time,
        point: PointIndex,
        context: &mut Context,
    ) {
        self.counters.writes += 1;
        if self.details(point).persistent {
            self.wear.spend(now, point);
        }
        if self.values.is_selector(point) {
            self.values.forget_selector(&self.settings.device, point);
            self.wake_reads();
            self.tell_changes(now, context);
        }
    }

    /// What was asked last has ended. If it was a write: how many points' EEPROM it wore out, as far as anybody
    /// can know. Exception 6 is a request that has not been carried out and is to be sent again, 5 one that is
    /// being carried out (Modbus application protocol V1.1b3, 7). Also 1 to 3 should come before anything is
    /// done, but there are devices that answer 3 and write the nearest value.
    pub(in crate::engine::bus) fn has_written(
        &mut self,
        now: Time,
        result: &Result<Answer, RequestError>,
        context: &mut Context,
    ) -> u64 {
        let writes = self.wear.end(*result != Err(RequestError::Exception(BUSY)));
        if writes > 0 {
            self.counters.persistent_writes += writes;
            self.keeping.is_to_be_kept_soon(now, context);
        }
        writes
    }

    /// Words that a command has read at the point's own place.
    pub(in crate::engine::bus) fn read_for_command(
        &mut self,
        now: Time,
        point: PointIndex,
        words: &[u16],
        context: &mut Context,
    ) {
        if self.details(point).is_read() {
            self.read_beside(now, self.details(point).at.span, words, context);
        }
    }

    /// Words that were read at `span` for another purpose than a poll: they are news for every polled
    /// point in it.
    pub(in crate::engine::bus) fn read_beside(
        &mut self,
        now: Time,
        span: crate::engine::address::Span,
        words: &[u16],
        context: &mut Context,
    ) {
        let inside = self.settings.device.points.iter().enumerate();
        let points: Vec<_> = inside
            .filter(|(_, other)| other.is_read() && span.contains(other.at.span))
            .map(|(index, other)| (index, other.at))
            .collect();
        let Some((first, _)) = points.first() else { return };
        let poll = self.details(*first).poll;
        self.absorb(now, &Read { poll, span, points, alone: false }, words, context);
    }

    /// The command has ended: what it may have changed is read again, and told as it is.
    pub(in crate::engine::bus) fn command_ended(
        &mut self,
        now: Time,
        point: PointIndex,
        outcome: &Outcome,
        context: &mut Context,
    ) {
        for partner in self.details(point).re_read.clone() {
            self.polls.want(partner);
        }
        if self.details(point).is_read() {
            if matches!(outcome.kind, OutcomeKind::NoReply) {
                self.want(point);
            } else {
                // Told even if unchanged, so that a switch flips back that was moved in vain.
                self.told.want(point);
                self.tell(now, point, context);
            }
        }
        self.after_news(now, context);
        if self.details(point).persistent && self.is_present() {
            // How often the EEPROM has been written stands there.
            self.tell_info(now, context);
        }
    }
}
