//! What a device keeps for its owner: settings as they are wanted, and what outlives a restart.

use std::collections::BTreeSet;

use crate::engine::command::Outcome;
use crate::engine::device::PointIndex;
use crate::engine::memory::{self, Memories, Memory, Record};
use crate::engine::plan;
use crate::engine::settings::Rules;
use crate::engine::time::{Duration, Time};
use crate::engine::upkeep::Upkeep;

use super::{Context, DeviceState};
use crate::engine::bus::Severity;
use crate::engine::bus::waiting::Target;

/// A device's memory is stored no more often than this, whatever is written to the device: it may lie
/// on a memory card.
const STORE_INTERVAL: Duration = Duration::from_secs(10);
/// That a setting has been seen to is stored so soon: a restart right after it must not write again. And a write to
/// EEPROM, which is counted for life, and seldom enough by its budget: a power failure must not make it undone.
const STORE_SOON: Duration = Duration::from_secs(1);

/// What is stored of a device, and when next.
#[derive(Clone, Debug, Default)]
pub(super) struct Keeping {
    /// The fingerprint of the plan without refusals.
    plan: String,
    stored: Memory,
    changed: bool,
    not_before: Time,
}

impl Keeping {
    /// Something that is remembered has changed.
    pub(super) fn has_changed(&mut self, context: &mut Context) {
        (self.changed, context.has_to_remember) = (true, true);
    }

    /// The same for what is to outlive a power failure.
    pub(super) fn is_to_be_kept_soon(&mut self, now: Time, context: &mut Context) {
        self.not_before = self.not_before.min(now + STORE_SOON);
        self.has_changed(context);
    }
}

impl DeviceState {
    /// Goes on from what is remembered of the device; returns how often its EEPROM has been written.
    pub(in crate::engine::bus) fn recall(&mut self, now: Time, memories: &Memories) -> u64 {
        let device = &self.settings.device;
        // Whatever is measured later: what is refused is remembered for the plan that any start makes.
        let reads = plan::plan(device, self.tariff.cost(plan::USUAL_TURNAROUND), &[]);
        let memory = memories.devices.get(&self.settings.name).cloned().unwrap_or_default();
        self.keeping.plan = memory::fingerprint(device, &reads);
        self.counters.persistent_writes = memory.persistent_writes;
        if let Some(spent) = memory.writes_spent {
            let points = memory.written_lately.iter().filter_map(|name| device.point_named(name));
            self.wear.recall(now, spent, points);
        }
        // Another profile asks otherwise, and is refused otherwise.
        if memory.plan == self.keeping.plan {
            self.refused = memory.refused.clone();
            let reads = self.plan();
            let values = &self.values;
            self.polls.replace(reads, self.settings.device.wire.intervals, |point| values.is_selector(point));
        }
        self.upkeep = Upkeep::new(&self.settings.device, &self.settings.wanted, &memory);
        match memories.unkept_of(&self.settings.name) {
            Some(reason) => self.upkeep.write_nothing(reason),
            None => self.keeping.changed = true,
        }
        self.keeping.stored = memory;
        self.counters.persistent_writes
    }

    /// Goes on by other rules.
    pub(in crate::engine::bus) fn change_rules(&mut self, now: Time, rules: &Rules, context: &mut Context) {
        self.wear.change_rules(now, rules.eeprom);
        // Some of it may be due to be told again.
        self.values.look_again();
        self.tell_info(now, context);
    }

    fn memory(&self, now: Time) -> Memory {
        Memory {
            plan: if self.refused.is_empty() { String::new() } else { self.keeping.plan.clone() },
            refused: self.refused.clone(),
            persistent_writes: self.counters.persistent_writes,
            writes_spent: (self.counters.persistent_writes > 0).then(|| self.wear.writes_spent(now)),
            written_lately: self.written_lately(now),
            section: self.upkeep.section().clone(),
            settled: self.upkeep.settled(),
        }
    }

    /// The points that must not be written yet, since they have been.
    fn written_lately(&self, now: Time) -> BTreeSet<String> {
        let points = self.settings.device.points.iter().enumerate();
        let spared = points.filter(|(index, _)| now < self.wear.allowed_at(*index));
        spared.map(|(_, point)| point.name.clone()).collect()
    }

    /// What is to be stored now; `at_once` at the end, when there is no later.
    pub(in crate::engine::bus) fn record(&mut self, now: Time, at_once: bool) -> Option<Record> {
        match self.record_due_at() {
            Some(due) if now >= due || at_once => {}
            _ => return None,
        }
        self.keeping.changed = false;
        let memory = self.memory(now);
        if memory == self.keeping.stored {
            return None;
        }
        self.keeping.not_before = now + STORE_INTERVAL;
        self.keeping.stored = memory.clone();
        Some(Record { device: self.settings.name.clone(), memory })
    }

    pub(in crate::engine::bus) fn record_due_at(&self) -> Option<Time> {
        let changed = self.keeping.changed.then_some(self.keeping.not_before);
        // A start long after it shall spare nothing.
        let written = self.keeping.stored.written_lately.iter();
        let points = written.filter_map(|name| self.settings.device.point_named(name));
        let lapsed = points.map(|point| self.wear.allowed_at(point)).max();
        changed.into_iter().chain(lapsed.map(|at| at.max(self.keeping.not_before))).min()
    }

    /// Compares the settings with what the device holds. Whether what is told of them has changed.
    pub(super) fn keep_settings(&mut self, now: Time, context: &mut Context) -> bool {
        self.upkeep.compare(now, &self.settings.device, &self.values);
        for note in self.upkeep.take_notes() {
            let severity = if note.is_warning { Severity::Warning } else { Severity::Info };
            context.say(severity, format!("device {}: {}", self.settings.name, note.text));
        }
        if self.upkeep.take_settled_changed() {
            self.keeping.is_to_be_kept_soon(now, context);
        }
        self.upkeep.take_drift_changed()
    }

    /// The setting that is to be written next, and the command for it.
    pub(in crate::engine::bus) fn next_setting(
        &self,
        now: Time,
        is_settling: impl Fn(PointIndex) -> bool,
    ) -> Option<(PointIndex, String)> {
        self.upkeep.next(|point| !is_settling(point) && self.can_take(now, Target::Setting(point), ""))
    }

    /// From when on the next setting may be written, for its EEPROM's sake.
    pub(in crate::engine::bus) fn next_setting_at(&self) -> Option<Time> {
        self.upkeep.pending().map(|point| self.writable_at(Target::Setting(point))).min()
    }

    pub(in crate::engine::bus) fn setting_ended(&mut self, now: Time, point: PointIndex, outcome: &Outcome) {
        self.upkeep.ended(now, point, outcome);
    }
}
