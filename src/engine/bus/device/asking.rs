//! What a device is asked next, and how long its answer may take.

use crate::engine::identity;
use crate::engine::modbus::{Call, Request};
use crate::engine::pace::{Moment, Pace};
use crate::engine::schedule::{Outlook, Place, Polls, Urgency};
use crate::engine::time::{Duration, Time};

use super::{DeviceState, Presence};

/// After a write a device is waited for fully for so long.
const BUSY_AFTER_WRITE: Duration = Duration::from_secs(5);

/// What the schedule wants from this device.
pub(in crate::engine::bus) enum Polled {
    Identification(Call),
    Read(usize, Call),
}

/// Where a device stood before it was asked.
#[derive(Clone, Copy, Debug)]
pub(in crate::engine::bus) struct Turn {
    place: Option<Place>,
    served_at: Time,
}

impl Turn {
    /// It was asked because the period of a read was over.
    pub(in crate::engine::bus) fn was_in_turn(&self) -> bool {
        self.place.is_some_and(|place| place.was_in_turn())
    }

    /// It was asked out of turn.
    pub(in crate::engine::bus) fn was_wanted(&self) -> bool {
        self.place.is_some_and(|place| place.was_wanted())
    }
}

impl DeviceState {
    /// When it wants to be asked again.
    pub(in crate::engine::bus) fn due_at(&self, at: Moment) -> Option<Time> {
        match self.presence {
            Presence::Present => self.polls.due_at(at).map(|due| due.max(self.not_before())),
            _ => Some(self.not_before()),
        }
    }

    /// Whether something is due, and not only since it is wanted at once, and only the silence that it wants behind what
    /// went out of turn was in its way when it was decided what is asked instead.
    pub(in crate::engine::bus) fn keeps_waiting(&self, at: Moment, decided_at: Time) -> bool {
        let has_waited = || self.polls.longest_waiting(at).is_some();
        self.was_asked_out_of_turn && decided_at < self.not_before() && self.is_present() && has_waited()
    }

    /// Before, it is not asked because something is due.
    fn not_before(&self) -> Time {
        self.paused_until.max(self.rested_at())
    }

    /// Before, it wants silence. Others may be asked meanwhile.
    fn rested_at(&self) -> Time {
        self.last_answer_end + self.settings.device.wire.limits.delay
    }

    /// How urgent its next question can be at most.
    pub(in crate::engine::bus) fn outlook(&self, now: Time) -> Outlook {
        let (reads, wanted) = match self.is_present() {
            true => (self.polls.by_period(now), self.polls.wanted()),
            false => (None, 0.0),
        };
        Outlook { not_before: self.not_before(), reads, wanted, served_at: self.served_at }
    }

    pub(in crate::engine::bus) fn most_urgent(&self, at: Moment) -> Option<(Polled, Urgency)> {
        if at.now < self.rested_at() {
            return None;
        }
        self.next_question(at.now, Urgency::Wanted, |polls| polls.most_urgent(at))
    }

    /// What has waited longest, wanted at once or not, and for how many of its periods. If what goes out of turn is for
    /// this device, that would go on as soon as it has rested: then the read waits for that on the wire, as a command does.
    pub(in crate::engine::bus) fn longest_waiting(&self, at: Moment) -> Option<(Polled, f64)> {
        if at.now < self.rested_at() && !self.was_asked_out_of_turn {
            return None;
        }
        self.next_question(at.now, f64::INFINITY, |polls| polls.longest_waiting(at))
    }

    /// Its identification, if that is not known, which is as urgent as `of_identification`; or the read that
    /// `of_polls` finds.
    fn next_question<U>(
        &self,
        now: Time,
        of_identification: U,
        of_polls: impl FnOnce(&Polls) -> Option<(usize, U)>,
    ) -> Option<(Polled, U)> {
        if now < self.paused_until {
            return None;
        }
        if self.presence != Presence::Present {
            if let Some(call) = self.identification_call() {
                return Some((Polled::Identification(call), of_identification));
            }
        }
        let (index, urgency) = of_polls(&self.polls)?;
        let other = self.asks_other_than(index).then(|| self.polls.oldest(now));
        Some((self.read_call(other.flatten().unwrap_or(index)), urgency))
    }

    /// After a request in vain another one than the most urgent is asked: it may be that read alone which gets no
    /// answer. Not where it seems to be in step with what disturbs it: then it is asked twice in a row.
    fn asks_other_than(&self, index: usize) -> bool {
        let is_in_step = || self.withheld.is_in_step(self.polls.span(index), self.polls.class(index));
        self.patience.failures() % 3 == 1 && !is_in_step()
    }

    pub(in crate::engine::bus) fn read_call(&self, index: usize) -> Polled {
        Polled::Read(index, Call::Read(self.span_of(index)))
    }

    fn identification_call(&self) -> Option<Call> {
        self.settings.device.identify.as_ref().map(identity::question)
    }

    /// Returns what its turn was before.
    pub(in crate::engine::bus) fn begin_read(&mut self, read: usize, now: Time, pace: &mut Pace) -> Turn {
        let place = self.polls.begin(read, now, pace);
        Turn { place: Some(place), ..self.turn() }
    }

    pub(in crate::engine::bus) fn turn(&self) -> Turn {
        Turn { place: None, served_at: self.served_at }
    }

    /// The read that had begun never was on the wire.
    pub(in crate::engine::bus) fn take_back(&mut self, read: usize, before: Turn) {
        self.served_at = before.served_at;
        if let Some(place) = before.place {
            self.polls.take_back(read, place);
        }
    }

    /// The device is being asked: returns the time before which nothing may be sent.
    pub(in crate::engine::bus) fn asked(&mut self, now: Time) -> Time {
        self.served_at = now;
        now.max(self.rested_at())
    }

    /// How long the next request may wait for its answer; less where it is known how quick that is, for the
    /// reads of [`DeviceState::is_well_known`].
    pub(in crate::engine::bus) fn timeout(&mut self, of_bus: Duration, is_well_known: bool) -> Duration {
        let demanded = self.settings.device.wire.response_timeout;
        self.full_timeout = demanded.unwrap_or(of_bus).max(of_bus);
        match is_well_known && !self.patience.is_probing() {
            true => self.patience.hurried_timeout(self.full_timeout, demanded),
            false => self.patience.timeout(self.full_timeout, demanded),
        }
    }

    /// Whether it is known how long the device takes for this read. One that has just been written to may
    /// still be busy with its EEPROM.
    pub(in crate::engine::bus) fn is_well_known(&self, read: usize, now: Time) -> bool {
        self.polls.is_well_known(read) && now >= self.busy_until
    }

    pub(in crate::engine::bus) fn request(&mut self, now: Time, call: Call, timeout: Duration) -> Request {
        if call.is_write() {
            self.busy_until = now + BUSY_AFTER_WRITE;
        }
        let is_probe = self.patience.is_probing();
        Request {
            unit: self.settings.unit,
            call,
            any_exception: self.settings.device.wire.quirks.exception_function_varies,
            is_probe,
            may_take: Some(self.full_timeout).filter(|full| !is_probe && timeout < *full),
        }
    }
}
