//! Devices leave a running bus and come to it, while the others go on as if nothing had happened.

use crate::engine::command::OutcomeKind;
use crate::engine::device::Device;
use crate::engine::memory::Memories;
use crate::engine::plan::Tariff;
use crate::engine::settings::{DeviceSettings, Rules};

use super::device::DeviceState;
use super::recording::Recorder;
use super::{Action, Bus, InFlight, LinkState, Purpose, Telling};

/// What commands and requests of a device are told that leaves.
pub(super) const CHANGED: &str = "the configuration of the device has changed";

impl Bus {
    /// The device begins nothing more, and is gone as soon as nothing of it is on the wire:
    /// [`Bus::has_device`].
    pub(super) fn retire(&mut self, name: &str) {
        if let Some(index) = self.devices.iter().position(|device| device.name() == name) {
            self.devices[index].is_leaving = true;
            self.is_anyone_leaving = true;
            self.refuse_all_of(index);
        }
    }

    /// Ends everything of this device that waits.
    fn refuse_all_of(&mut self, index: usize) {
        let (of_it, others): (Vec<_>, Vec<_>) =
            self.waiting.take_all().into_iter().partition(|waiting| waiting.device == index);
        self.waiting.put_all(others);
        for waiting in of_it {
            let outcome = waiting.wanted.ended(OutcomeKind::Refused, CHANGED);
            self.tell_outcome(waiting.device, waiting.target, outcome);
        }
        self.end_settling_of(Some(index), CHANGED);
        self.refuse_requests_of(index, CHANGED);
        self.beat = self.beat.take().filter(|(device, ..)| *device != index);
        // The answer to the one under way, which is the first, still comes.
        let is_under_way = |in_flight: &InFlight| matches!(in_flight.purpose, Purpose::Fetch);
        let kept = usize::from(self.in_flight.as_ref().is_some_and(is_under_way));
        let rest = self.fetches.split_off(kept.min(self.fetches.len()));
        self.fetches.extend(rest.into_iter().filter(|fetch| fetch.device != index));
    }

    /// Whether the device is here, if only until the question on the wire has been answered.
    pub fn has_device(&self, name: &str) -> bool {
        self.devices.iter().any(|device| device.name() == name)
    }

    /// Lets go of the devices that leave and have nothing on the wire any more.
    pub(super) fn end_retirements(&mut self) {
        if !self.is_anyone_leaving {
            return;
        }
        let asked = self.in_flight.as_ref().and_then(|in_flight| in_flight.device);
        let commanded = self.active.as_ref().map(|active| active.device);
        for index in (0..self.devices.len()).rev() {
            let is_busy = asked == Some(index) || commanded == Some(index);
            if is_busy || !self.devices[index].is_leaving {
                continue;
            }
            // What has come since it was told to leave, or waits to be read back.
            self.refuse_all_of(index);
            let mut device = self.devices.remove(index);
            if let Some(record) = device.record(self.now, true) {
                self.context.actions.push_back(Action::Store(record));
            }
            self.renumber(|other| if other > index { other - 1 } else { other });
        }
        self.is_anyone_leaving = self.devices.iter().any(|device| device.is_leaving);
    }

    /// Everything that names a device by its number; nothing names one that is gone.
    fn renumber(&mut self, new: impl Fn(usize) -> usize) {
        let change = |device: &mut usize| *device = new(*device);
        if let Some(device) = self.in_flight.as_mut().and_then(|in_flight| in_flight.device.as_mut()) {
            change(device);
        }
        self.active.iter_mut().for_each(|active| change(&mut active.device));
        self.forget_blame();
        self.forget_given_up();
        self.settling.iter_mut().for_each(|settling| change(&mut settling.active.device));
        self.beat.iter_mut().for_each(|(device, ..)| change(device));
        self.waiting.iter_mut().for_each(|waiting| change(&mut waiting.device));
        self.fetches.iter_mut().for_each(|fetch| change(&mut fetch.device));
        self.requests.devices().for_each(change);
    }

    /// The bus goes on, and all that it has counted and read stays.
    pub(super) fn change_rules(&mut self, rules: Rules) {
        let before = std::mem::replace(&mut self.rules, rules);
        if rules.recorder != before.recorder {
            self.recorder = Recorder::new(rules.recorder);
        }
        self.context.republish = rules.republish;
        for index in 0..self.devices.len() {
            self.devices[index].change_rules(self.now, &rules, &mut self.context);
            self.tell_what_waits(index);
        }
    }

    /// What is known is told as if for the first time, and nothing is read for it.
    pub(super) fn change_telling(&mut self, telling: Telling) {
        let is_announced_there = self.context.telling.announces_where(&telling);
        self.context.telling = telling;
        for device in &mut self.devices {
            device.tell_anew(self.now, is_announced_there, &mut self.context);
        }
    }

    /// Whether everything is told there and so.
    pub fn tells_as(&self, telling: &Telling) -> bool {
        self.context.telling == *telling
    }

    /// These devices come, as at the start of the bus.
    pub(super) fn adopt(&mut self, devices: Vec<DeviceSettings>, memories: &Memories) {
        let tariff = Tariff::of(&self.link, self.gap);
        let staying = self.devices.iter().map(DeviceState::device);
        let all: Vec<&Device> = staying.chain(devices.iter().map(|device| &*device.device)).collect();
        let mut rests = tariff.idle_rests(&all).into_iter();
        // Of those that stay it counts when they are planned anew for another reason.
        self.devices.iter_mut().zip(rests.by_ref()).for_each(|(device, rest)| device.idle_rest = rest);
        for (settings, rest) in devices.into_iter().zip(rests) {
            let mut device = DeviceState::new(settings, tariff, rest, self.rules.eeprom);
            self.counters.persistent_writes += device.recall(self.now, memories);
            device.introduce(self.now, &mut self.context);
            if self.link_state == LinkState::Up {
                device.reconnect(self.now);
            }
            self.devices.push(device);
        }
        self.context.has_to_remember = true;
        self.look_what_they_have();
    }
}
