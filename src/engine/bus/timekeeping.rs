//! How long things take on a bus: how busy its wire is, how long its devices need to answer, how long
//! requests wait for the line and commands for their turn.

use crate::engine::health::{Timing, TimingReport};
use crate::engine::modbus::{Reply, RequestError};
use crate::engine::plan::data_bytes;
use crate::engine::settings::Link;
use crate::engine::time::{Duration, Time};

use super::load::Load;
use super::{Bus, InFlight};

/// The characters of a read's request, and of its answer without data; the latter as many as an
/// exception has.
const OF_REQUEST: u32 = 8;
const OF_ANSWER: u32 = 5;

#[derive(Clone, Debug, Default)]
pub(super) struct Timekeeping {
    load: Load,
    timing: Timing,
    busy_until: Time,
    /// When the last answer's last byte came; `None`: the last request had none, and the line is left
    /// silent for longer than usual.
    quiet_since: Option<Time>,
    /// The device that left the last request unanswered.
    to_blame: Option<usize>,
}

impl Timekeeping {
    /// The share of the last minute in which the bus could do nothing else.
    pub(super) fn load(&self, now: Time) -> f64 {
        self.load.share(now)
    }

    pub(super) fn report(&self, now: Time) -> TimingReport {
        self.timing.report(now)
    }
}

impl Bus {
    /// Devices have got other numbers.
    pub(super) fn forget_blame(&mut self) {
        self.times.to_blame = None;
    }

    /// A request has ended.
    pub(super) fn keep_time(&mut self, asked: &InFlight, reply: &Reply) {
        if matches!(reply.result, Err(RequestError::Link(_) | RequestError::Impossible(_))) {
            self.times.quiet_since = None;
            return;
        }
        let (now, sent_at) = (self.now, reply.sent_at);
        let gap = match &self.link {
            Link::Tcp { .. } => Duration::ZERO,
            Link::Serial { line, .. } | Link::RtuOverTcp { line, .. } => {
                self.gap.unwrap_or_else(|| line.frame_gap())
            }
        };
        // The silence before a request is taken by it, also where the line had long been silent.
        let silent_from = sent_at.before(gap);
        let busy_from = asked.decided_at.min(silent_from).max(self.times.busy_until);
        self.times.load.add(busy_from, now);
        self.times.busy_until = now;

        let timing = &mut self.times.timing;
        let waited = sent_at - asked.decided_at;
        timing.waited_for_gap(now, waited);
        if let Some(quiet_since) = self.times.quiet_since {
            timing.began_late(now, sent_at - asked.decided_at.max(asked.sent_at).max(quiet_since + gap));
        }
        let command_waited = asked.commanded_at.map(|came_at| sent_at - came_at);
        command_waited.into_iter().for_each(|time| timing.command_waited(now, time));
        let turnaround = turnaround(&self.link, asked, reply);
        turnaround.into_iter().for_each(|time| timing.turned_around(now, time));
        let answered = matches!(reply.result, Ok(_) | Err(RequestError::Exception(_)));
        self.times.quiet_since = reply.last_byte_at.filter(|_| answered);

        // Who left the line to a quarantine pays for it, and not who had to wait.
        let own_from = silent_from.max(busy_from);
        let blamed = self.times.to_blame.take();
        if let Some(silent) = blamed {
            self.devices[silent].charge(now, waited);
            self.devices[silent].had_wire(busy_from, own_from);
            self.probed(silent, waited);
        }
        let timed_out = reply.result == Err(RequestError::Timeout);
        self.times.to_blame = asked.device.filter(|device| timed_out && self.devices[*device].is_probed());
        if let Some(silent) = self.times.to_blame {
            self.probed(silent, now - own_from);
        }
        if let Some(device) = asked.device {
            self.devices[device].had_wire(if blamed.is_some() { own_from } else { busy_from }, now);
            self.devices[device].keep_time(now, waited, turnaround, command_waited);
            turnaround
                .into_iter()
                .for_each(|took| self.devices[device].complain_of_slowness(took, &mut self.context));
        }
    }
}

/// How long the device took beside the characters of both frames, as the reply's last byte tells it: the
/// first one may have been held back by the adapter. Only of reads, whose answers have a known length, and
/// which make no device wait for its EEPROM.
fn turnaround(link: &Link, asked: &InFlight, reply: &Reply) -> Option<Duration> {
    let data = match &reply.result {
        Ok(_) => data_bytes(asked.reads?),
        Err(RequestError::Exception(_)) if asked.reads.is_some() => 0,
        Err(_) => return None,
    };
    let taken = reply.last_byte_at? - reply.sent_at;
    let on_wire = match link.line() {
        Some(line) => line.characters(OF_REQUEST + OF_ANSWER + data),
        None => Duration::ZERO,
    };
    Some(taken.saturating_sub(on_wire))
}
