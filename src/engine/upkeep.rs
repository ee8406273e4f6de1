//! Keeps a device's settings as its owner wants them: compares, and chooses what is written next.
//!
//! Each wish is written once for each change of the section that it stands in; what differs later
//! is a drift, which is told, and written again only where the wish is enforced. A point comes after
//! those that decide its meaning, and only once they hold what is wanted of them. Of two coupled
//! points (`re_read`) that must not cross, the one that the device does not take waits for the other.
//! The writing itself is that of any command.

use std::collections::BTreeMap;

use crate::engine::codec;
use crate::engine::command::{Outcome, OutcomeKind};
use crate::engine::device::{Device, PointIndex};
use crate::engine::health::Drift;
use crate::engine::memory::Memory;
use crate::engine::settings::Wanted;
use crate::engine::state::Values;
use crate::engine::time::{Duration, Time};
use crate::engine::value::{Missing, Reading};
use crate::engine::wanted;

/// An enforced setting is written again after this at the earliest, whoever changes it meanwhile.
const MEND_INTERVAL: Duration = Duration::from_secs(600);
/// A write of which nobody knows whether it arrived is tried so often.
const TRIES: u32 = 3;

/// The wishes for one device, and how far each has come.
#[derive(Clone, Debug, Default)]
pub struct Upkeep {
    /// Those that decide others come first.
    wishes: Vec<Wish>,
    section: BTreeMap<String, String>,
    notes: Vec<Note>,
    told_drift: Vec<Drift>,
    settled_changed: bool,
}

#[derive(Clone, Debug)]
struct Wish {
    point: PointIndex,
    name: String,
    value: String,
    enforce: bool,
    /// The wishes for the points that decide the meaning of this one.
    deciding: Vec<usize>,
    /// The wishes for points that a write to this one may change, or the other way round.
    coupled: Vec<usize>,
    progress: Progress,
    standing: Standing,
    /// How the writing for the present section ended.
    settled: Option<String>,
    /// Why it does not hold, although it was written.
    reason: Option<String>,
    /// What it held when it last differed.
    last_found: Option<String>,
    tries: u32,
    /// Enforced anew, and not before this.
    mend_at: Time,
    mending: bool,
    said: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Progress {
    /// A difference is to be written.
    Due,
    /// The device did not take it; perhaps it does when a coupled one has been written.
    Postponed,
    /// A coupled one has been written: once more, for the last time.
    Again,
    /// Nothing is to be done.
    Rests,
}

/// What a wish is, compared with what the device holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Standing {
    /// Not read yet, or what decides it is not yet known or not yet written.
    Unknown {
        found: Option<String>,
    },
    Right,
    /// `command` is the wanted value as a command says it.
    Differs {
        found: String,
        command: String,
    },
    /// It cannot be written as things are.
    Faulty {
        found: Option<String>,
        reason: String,
    },
}

/// Something for the log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Note {
    pub is_warning: bool,
    pub text: String,
}

impl Upkeep {
    /// The wishes for `device`, continued from what is remembered of them.
    pub fn new(device: &Device, wanted: &[Wanted], memory: &Memory) -> Upkeep {
        let name = |wanted: &Wanted| device.points[wanted.point].name.clone();
        let section: BTreeMap<String, String> =
            wanted.iter().map(|wanted| (name(wanted), wanted.value.clone())).collect();
        let unchanged = section == memory.section;
        let mut sorted: Vec<&Wanted> = wanted.iter().collect();
        sorted.sort_by_key(|wanted| depth(device, wanted.point));
        let among = |points: &[PointIndex]| -> Vec<usize> {
            (0..sorted.len()).filter(|index| points.contains(&sorted[*index].point)).collect()
        };
        let wishes = sorted
            .iter()
            .map(|wanted| {
                let details = &device.points[wanted.point];
                let settled = memory.settled.get(&details.name).filter(|_| unchanged).cloned();
                let back = |other: &Wanted| device.points[other.point].re_read.contains(&wanted.point);
                let coupled: Vec<PointIndex> = sorted
                    .iter()
                    .filter(|other| details.re_read.contains(&other.point) || back(other))
                    .map(|other| other.point)
                    .collect();
                Wish {
                    point: wanted.point,
                    name: details.name.clone(),
                    value: wanted.value.clone(),
                    enforce: wanted.enforce,
                    deciding: among(&details.selectors()),
                    coupled: among(&coupled),
                    progress: if settled.is_some() { Progress::Rests } else { Progress::Due },
                    standing: Standing::Unknown { found: None },
                    settled,
                    reason: None,
                    last_found: None,
                    tries: 0,
                    mend_at: Time::default(),
                    mending: false,
                    said: false,
                }
            })
            .collect();
        Upkeep { wishes, section, ..Upkeep::default() }
    }

    /// What is not yet written will not be, except where it is enforced: without a memory each start
    /// would be the first one, and would write.
    pub fn write_nothing(&mut self, reason: &str) {
        for wish in self.wishes.iter_mut().filter(|wish| wish.progress == Progress::Due) {
            wish.progress = Progress::Rests;
            wish.reason = (!wish.enforce).then(|| reason.to_string());
        }
    }

    /// The section as it is remembered.
    pub fn section(&self) -> &BTreeMap<String, String> {
        &self.section
    }

    /// Which settings are done with, and how that ended.
    pub fn settled(&self) -> BTreeMap<String, String> {
        let settled = |wish: &Wish| Some((wish.name.clone(), wish.settled.clone()?));
        self.wishes.iter().filter_map(settled).collect()
    }

    /// Whether more of them are settled than when this was last asked.
    pub fn take_settled_changed(&mut self) -> bool {
        std::mem::take(&mut self.settled_changed)
    }

    /// Nothing of what was read holds any more.
    pub fn forget(&mut self) {
        for wish in &mut self.wishes {
            wish.standing = Standing::Unknown { found: None };
        }
    }

    /// Compares every wish with what is known of the device now.
    pub fn compare(&mut self, now: Time, device: &Device, values: &Values) {
        for index in 0..self.wishes.len() {
            let standing = self.standing(index, device, values);
            let wish = &mut self.wishes[index];
            wish.standing = standing;
            if let Standing::Differs { found, .. } = &wish.standing {
                wish.last_found = Some(found.clone());
            }
            if wish.standing == Standing::Right {
                wish.progress = Progress::Rests;
                wish.reason = None;
                wish.mending = false;
                if wish.settled.is_none() {
                    // After a write that nobody confirmed, it was that write.
                    let kind = if wish.tries > 0 { OutcomeKind::Done } else { OutcomeKind::Unchanged };
                    wish.settled = Some(kind.name().into());
                    self.settled_changed = true;
                }
            }
            let differs = matches!(wish.standing, Standing::Differs { .. });
            if differs && wish.enforce && wish.progress == Progress::Rests && now >= wish.mend_at {
                wish.progress = Progress::Due;
                wish.tries = 0;
                wish.mending = true;
                wish.mend_at = now + MEND_INTERVAL;
            }
        }
        self.give_up_waiting();
        self.note_drift();
    }

    /// The next point to write, and the command for it; `may_write` knows what else is in the way.
    pub fn next(&self, may_write: impl Fn(PointIndex) -> bool) -> Option<(PointIndex, String)> {
        self.wishes.iter().find_map(|wish| match &wish.standing {
            Standing::Differs { command, .. } if wish.is_to_be_written() && may_write(wish.point) => {
                Some((wish.point, command.clone()))
            }
            _ => None,
        })
    }

    /// The points that wait to be written.
    pub fn pending(&self) -> impl Iterator<Item = PointIndex> {
        self.wishes.iter().filter(|wish| wish.is_to_be_written()).map(|wish| wish.point)
    }

    /// The command for `point` has ended. Whether that was the last word on it.
    pub fn ended(&mut self, now: Time, point: PointIndex, outcome: &Outcome) -> bool {
        let Some(index) = self.wishes.iter().position(|wish| wish.point == point) else { return true };
        let reason = outcome.reason.clone().unwrap_or_else(|| outcome.kind.name().into());
        let may_wait = self.wishes[index].progress == Progress::Due
            && self.wishes[index].coupled.iter().any(|other| self.wishes[*other].is_to_be_written());
        self.settled_changed = true;
        let wish = &mut self.wishes[index];
        wish.tries += 1;
        match outcome.kind {
            OutcomeKind::Done | OutcomeKind::Unchanged => {
                if let (OutcomeKind::Done, Some(before)) = (outcome.kind, &wish.last_found) {
                    let again = if wish.mending { "was written again" } else { "was written" };
                    let holds = outcome.found.as_ref().unwrap_or(&wish.value);
                    let text =
                        format!("{} {again} as its settings want: {holds}, before {before}", wish.name);
                    self.notes.push(Note { is_warning: false, text });
                }
                wish.said = false;
                wish.settle(outcome.kind, None);
                for other in self.wishes[index].coupled.clone() {
                    let other = &mut self.wishes[other];
                    if other.progress == Progress::Postponed {
                        other.progress = Progress::Again;
                    }
                }
            }
            OutcomeKind::NotTaken | OutcomeKind::Refused if may_wait => {
                wish.progress = Progress::Postponed;
                wish.reason = Some(reason);
                return false;
            }
            OutcomeKind::NoReply | OutcomeKind::Expired if wish.tries < TRIES => return false,
            _ => {
                wish.mend_at = now + MEND_INTERVAL;
                wish.settle(outcome.kind, Some(reason));
            }
        }
        true
    }

    /// What does not hold as it is wanted, and is not just about to be written.
    pub fn drift(&self) -> Vec<Drift> {
        self.wishes.iter().filter_map(Wish::drift).collect()
    }

    /// Whether the drift has changed since this was last asked.
    pub fn take_drift_changed(&mut self) -> bool {
        let drift = self.drift();
        let changed = drift != self.told_drift;
        self.told_drift = drift;
        changed
    }

    /// What is to be said since this was last asked: each drift once.
    pub fn take_notes(&mut self) -> Vec<Note> {
        std::mem::take(&mut self.notes)
    }

    /// Every wish with its point, its wanted value and how it stands, those that decide others first.
    pub fn standings(&self) -> impl Iterator<Item = (PointIndex, &str, &Standing)> {
        self.wishes.iter().map(|wish| (wish.point, wish.value.as_str(), &wish.standing))
    }

    fn standing(&self, index: usize, device: &Device, values: &Values) -> Standing {
        let wish = &self.wishes[index];
        let details = &device.points[wish.point];
        let reading = values.reading(wish.point);
        let found = match reading {
            Reading::Missing(_) => None,
            reading => Some(reading.to_string()),
        };
        for deciding in wish.deciding.iter().map(|deciding| &self.wishes[*deciding]) {
            match &deciding.standing {
                Standing::Right => {}
                Standing::Unknown { .. } => return Standing::Unknown { found },
                Standing::Differs { .. } if deciding.is_pending() => return Standing::Unknown { found },
                // Its value is meant for what the deciding point does not hold.
                _ => {
                    let reason = format!("{} does not hold what is wanted", deciding.name);
                    return Standing::Faulty { found, reason };
                }
            }
        }
        let resolved = match codec::resolve(device, wish.point, values.known()) {
            Ok(resolved) => resolved,
            Err(Missing::WaitingFor(_)) => return Standing::Unknown { found },
            Err(missing) => return Standing::Faulty { found, reason: missing.to_string() },
        };
        let command = wanted::as_command(&resolved, &wish.value);
        let words = wanted::encode(details, &resolved, &wish.value);
        let (command, words) = match (command, words) {
            (Ok(command), Ok(words)) => (command, words),
            (Err(reason), _) | (_, Err(reason)) => return Standing::Faulty { found, reason },
        };
        match reading {
            // Compared as it would be read: 30, 30.0 and 30s are one time.
            reading if *reading == codec::read(&resolved, &words) => Standing::Right,
            // It was read, and is nothing that could be wanted.
            Reading::Missing(
                missing @ (Missing::UnknownValue(_)
                | Missing::NotANumber
                | Missing::TooManyDigits(_)
                | Missing::NotText
                | Missing::EmptyText),
            ) => Standing::Differs { found: missing.to_string(), command },
            Reading::Missing(_) => Standing::Unknown { found },
            reading => Standing::Differs { found: reading.to_string(), command },
        }
    }

    /// Who waits for a coupled point that nobody writes any more, waits in vain.
    fn give_up_waiting(&mut self) {
        for index in 0..self.wishes.len() {
            let wish = &self.wishes[index];
            let waits = wish.progress == Progress::Postponed;
            if !waits || wish.coupled.iter().any(|other| self.wishes[*other].is_to_be_written()) {
                continue;
            }
            self.settled_changed = true;
            let is_right = |other: &usize| self.wishes[*other].standing == Standing::Right;
            let helped = wish.coupled.iter().any(is_right);
            let wish = &mut self.wishes[index];
            if helped {
                wish.progress = Progress::Again;
            } else {
                let reason = wish.reason.take();
                wish.settle(OutcomeKind::NotTaken, reason);
            }
        }
    }

    fn note_drift(&mut self) {
        for wish in &mut self.wishes {
            match wish.drift() {
                Some(drift) if !wish.said => {
                    wish.said = true;
                    let found = drift.found.map_or("is unknown".into(), |found| format!("holds {found}"));
                    let rest = match drift.reason {
                        Some(reason) => format!(" ({reason})"),
                        None if wish.enforce => String::new(),
                        None => "; it is left so until they change, or say `enforce: true`".into(),
                    };
                    let text = format!("{} {found}, and its settings want {}{rest}", wish.name, wish.value);
                    self.notes.push(Note { is_warning: true, text });
                }
                None if wish.said && wish.standing == Standing::Right => {
                    wish.said = false;
                    let text = format!("{} holds again what its settings want: {}", wish.name, wish.value);
                    self.notes.push(Note { is_warning: false, text });
                }
                _ => {}
            }
        }
    }
}

impl Wish {
    /// Whether a difference is to be written, now or after another one.
    fn is_pending(&self) -> bool {
        self.progress != Progress::Rests
    }

    fn is_to_be_written(&self) -> bool {
        matches!(self.progress, Progress::Due | Progress::Again)
            && matches!(self.standing, Standing::Differs { .. })
    }

    fn settle(&mut self, kind: OutcomeKind, reason: Option<String>) {
        self.progress = Progress::Rests;
        self.settled = Some(kind.name().into());
        self.reason = reason;
        self.mending = false;
    }

    fn drift(&self) -> Option<Drift> {
        let (found, reason) = match &self.standing {
            Standing::Differs { found, .. } if !self.is_pending() || self.mending => {
                (Some(found.clone()), self.reason.clone())
            }
            Standing::Faulty { found, reason } => (found.clone(), Some(reason.clone())),
            _ => return None,
        };
        Some(Drift { point: self.name.clone(), wanted: self.value.clone(), found, reason })
    }
}

/// How many points must be known before this one can be understood.
fn depth(device: &Device, point: PointIndex) -> usize {
    // A point may be decided by one that another decides; no device has longer chains.
    let deeper = |selector: PointIndex| 1 + device.points[selector].selectors().len();
    device.points[point].selectors().into_iter().map(deeper).max().unwrap_or(0)
}
