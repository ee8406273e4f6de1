//! The replies that a serial line still owes: who is left in peace until they have come, and who is known to
//! take longer than others.

use std::collections::BTreeMap;

use crate::engine::modbus::Request;
use crate::engine::modbus::rtu_bytes::Unanswered;
use crate::engine::time::{Duration, Time};

/// A request unanswered for longer gets no answer any more.
const LATE_MAX: Duration = Duration::from_secs(10);
/// A unit whose reply came late is given so much of its lateness more, in halves, but never more than as
/// long again.
const LATENESS_HALVES: u32 = 3;
/// After a probe the line is silent for twice as long as that unit has come late, but never longer than this.
const QUARANTINE_AFTER_PROBE_MAX: Duration = Duration::from_millis(500);

#[derive(Debug, Default)]
pub(super) struct Overdue {
    requests: Vec<Unanswered>,
    /// Units that are not asked before, although others are.
    resting: BTreeMap<u8, Time>,
    /// How late each unit's latest reply came, behind the timeout that was asked for.
    lateness: BTreeMap<u8, Duration>,
}

impl Overdue {
    /// The requests that nobody has answered yet, oldest first.
    pub(super) fn requests(&self) -> &[Unanswered] {
        &self.requests
    }

    /// Nobody has answered this one.
    pub(super) fn remember(&mut self, request: Unanswered) {
        self.requests.push(request);
    }

    /// The unit is asked nothing before.
    pub(super) fn let_rest(&mut self, unit: u8, until: Time) {
        self.resting.insert(unit, until);
    }

    pub(super) fn rests_until(&self, unit: u8) -> Option<Time> {
        self.resting.get(&unit).copied()
    }

    /// The unit is being asked.
    pub(super) fn has_rested(&mut self, unit: u8) {
        self.resting.remove(&unit);
    }

    /// How much longer than its timeout a unit is waited for.
    pub(super) fn more_time(&self, unit: u8, timeout: Duration) -> Duration {
        (self.lateness(unit) * LATENESS_HALVES / 2).min(timeout)
    }

    /// For how long the line is left alone behind a probe in vain, in which the unit already had
    /// [`Overdue::more_time`].
    pub(super) fn quarantine_after_probe(&self, unit: u8, timeout: Duration) -> Duration {
        let late = (self.lateness(unit) * 2).saturating_sub(self.more_time(unit, timeout));
        late.min(QUARANTINE_AFTER_PROBE_MAX)
    }

    fn lateness(&self, unit: u8) -> Duration {
        self.lateness.get(&unit).copied().unwrap_or_default()
    }

    /// The late reply to the request of this number is being heard. Whether it is the last one that is owed.
    pub(super) fn hears(&mut self, index: usize, heard_at: Time) -> bool {
        let Unanswered { request: Request { unit, .. }, due, .. } = self.requests[index];
        let lateness = self.lateness.entry(unit).or_default();
        *lateness = (*lateness).max(heard_at.since(due));
        let later = &self.requests[index + 1..];
        if later.iter().all(|later| later.request.unit != unit) {
            self.resting.remove(&unit);
        }
        later.is_empty()
    }

    /// These owe nothing more.
    pub(super) fn settle(&mut self, numbers: &[usize]) {
        let mut index = 0;
        self.requests.retain(|_| {
            index += 1;
            !numbers.contains(&(index - 1))
        });
    }

    /// The unit has answered, and units answer in order: nothing of it that is older than what it has answered
    /// gets a reply any more. That may be the request with this number, and not the newest.
    pub(super) fn settle_unit(&mut self, unit: u8, answered: Option<usize>, late: &[usize]) {
        let until = answered.unwrap_or(self.requests.len());
        let over = self.requests.iter().enumerate().filter(|(index, request)| {
            late.contains(index) || (request.request.unit == unit && *index <= until)
        });
        let over: Vec<usize> = over.map(|(index, _)| index).collect();
        self.settle(&over);
    }

    /// What has been owed for too long is lost.
    pub(super) fn give_up_old(&mut self, now: Time) {
        self.requests.retain(|request| now.since(request.at) < LATE_MAX);
    }

    /// The link is another one.
    pub(super) fn give_up_all(&mut self) {
        self.requests.clear();
        self.resting.clear();
    }
}
