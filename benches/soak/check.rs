//! What must be true of everything that is published: a value was told by its device in answer to the
//! request that the gateway was waiting for, none comes back after a later one, and each command has
//! exactly one outcome, which is true.

use std::collections::BTreeMap;

use busker::engine::time::{Duration, Time};

use crate::device::{Change, Store};
use crate::line::LiveLine;
use crate::points::{self, Point};

/// A command that was given.
struct Given {
    at: Time,
    outcomes: Vec<Outcome>,
}

struct Outcome {
    kind: String,
    /// How often the way to the broker had been closed before.
    closings: u32,
    text: String,
}

/// A topic that shows a value.
#[derive(Default)]
struct Watched {
    last: Option<String>,
    last_at: Time,
    /// The number of the reply that told it, in the line's log.
    told_by: u64,
}

#[derive(Default)]
pub struct Checker {
    watched: BTreeMap<String, Watched>,
    /// By topic and wanted value, which no two commands for a register share.
    given: BTreeMap<(String, String), Given>,
    /// Commands for coils, by topic, and their outcomes.
    coils: BTreeMap<String, (u32, u32)>,
    availability: BTreeMap<String, String>,
    /// How often the way to the broker has been closed.
    pub closings: u32,
    pub values: u64,
    pub nones: u64,
    pub kinds: BTreeMap<String, u64>,
    pub commands: u64,
    /// What was wrong; of very many the first.
    pub wrong: Vec<String>,
    pub wrongs: u64,
}

const WRONG_KEPT: usize = 20;
/// A command waits for ten seconds, and is on the wire for a few more.
const COMMAND_LIFE: Duration = Duration::from_secs(25);

impl Checker {
    fn complain(&mut self, text: String) {
        self.wrongs += 1;
        if self.wrong.len() < WRONG_KEPT {
            eprintln!("WRONG: {text}");
            self.wrong.push(text);
        }
    }

    pub fn command(&mut self, at: Time, topic: &str, store: Store, wanted: &str) {
        self.commands += 1;
        match store {
            Store::Coil(_) => self.coils.entry(topic.into()).or_default().0 += 1,
            Store::Holding(_) => {
                let given = Given { at, outcomes: Vec::new() };
                self.given.insert((topic.into(), wanted.into()), given);
            }
        }
    }

    /// A message as it was seen at `at`.
    pub fn message(&mut self, at: Time, topic: &str, payload: &str, lines: &[LiveLine]) {
        if let Some(topic) = topic.strip_suffix("/outcome") {
            return self.outcome(topic, payload);
        }
        if let Some(device) = topic.strip_suffix("/availability") {
            self.availability.insert(device.into(), payload.into());
        }
        let Some(point) = points::of_topic(topic) else { return };
        let watched = self.watched.entry(topic.into()).or_default();
        watched.last_at = at;
        if payload == "None" {
            self.nones += 1;
            watched.last = None;
            return;
        }
        self.values += 1;
        // Told again: to whoever is new at the broker, or to a switch that was moved in vain.
        if watched.last.as_deref() == Some(payload) {
            return;
        }
        watched.last = Some(payload.into());
        let Some(value) = points::value(payload) else {
            return self.complain(format!("{topic} says `{payload}`"));
        };
        let (function, address) = point.place();
        let from = watched.told_by;
        let found = lines[point.line].look(|log| {
            let says = |told: &crate::line::Told| {
                let is_it = (told.unit, told.function) == (point.unit, function);
                let index = address.checked_sub(told.first).map(usize::from);
                is_it && index.and_then(|index| told.words.get(index)) == Some(&value)
            };
            let skipped = from.saturating_sub(log.first);
            let mut later = log.told.iter().enumerate().skip(skipped as usize);
            let in_time = later.find(|(_, told)| says(told) && !told.is_late());
            in_time.map(|(index, _)| log.first + index as u64).ok_or_else(|| {
                let last = log.told.iter().enumerate().rev().find(|(_, told)| says(told));
                last.map_or("never".into(), |(index, told)| {
                    let when =
                        if (index as u64) < skipped { "before what was shown last" } else { "too late" };
                    format!(
                        "{when}, asked at {}, sent at {}, next request at {}",
                        told.asked_at,
                        told.sent_at,
                        told.next_asked_at.unwrap_or_default()
                    )
                })
            })
        });
        match found {
            Ok(number) => watched.told_by = number,
            Err(why) => {
                self.complain(format!("at {at} {topic} shows {payload}, which its device told: {why}"))
            }
        }
    }

    fn outcome(&mut self, topic: &str, payload: &str) {
        let outcome: serde_json::Value = serde_json::from_str(payload).unwrap_or_default();
        let kind = outcome["outcome"].as_str().unwrap_or("?").to_owned();
        *self.kinds.entry(kind.clone()).or_default() += 1;
        match points::of_topic(topic).map(|point| point.point) {
            Some(Point::Stored(Store::Coil(_))) => self.coils.entry(topic.into()).or_default().1 += 1,
            Some(Point::Stored(Store::Holding(_))) => {
                let wanted = outcome["wanted"].as_str().unwrap_or_default();
                let outcome = Outcome { kind, closings: self.closings, text: payload.into() };
                match self.given.get_mut(&(topic.into(), wanted.into())) {
                    Some(given) => given.outcomes.push(outcome),
                    None => self.complain(format!("{topic} tells the outcome of no command: {payload}")),
                }
            }
            _ => self.complain(format!("{topic} cannot have an outcome: {payload}")),
        }
    }

    /// What is left to say when no command waits any more: `changes` are those of all devices, by line.
    pub fn commands_ended(&mut self, changes: &[Vec<Change>]) {
        let mut wrong = Vec::new();
        for ((topic, wanted), given) in &self.given {
            let Some(point) = points::of_topic(topic) else { continue };
            let Point::Stored(store) = point.point else { continue };
            let outcomes = &given.outcomes;
            // What was on its way when the way was closed may be told once more.
            let again = outcomes
                .windows(2)
                .all(|two| two[0].text == two[1].text && two[0].closings < two[1].closings);
            let texts: Vec<&str> = outcomes.iter().map(|outcome| outcome.text.as_str()).collect();
            if outcomes.is_empty() || !again {
                wrong.push(format!("{topic}: {wanted} of {} has the outcomes {texts:?}", given.at));
            }
            let is_it = |change: &&Change| {
                (change.unit, change.store) == (point.unit, store)
                    && Some(change.value) == points::value(wanted)
            };
            let written = changes[point.line]
                .iter()
                .filter(|change| change.written)
                .find(is_it)
                .map(|change| change.at);
            let kind = outcomes.first().map(|outcome| outcome.kind.as_str());
            match (kind, written) {
                (Some("done"), None) => wrong.push(format!("{topic}: {texts:?}, but nothing was written")),
                (Some("expired" | "refused" | "unchanged"), Some(at)) => {
                    wrong.push(format!("{topic}: {texts:?}, but written at {at}"));
                }
                (_, Some(at)) if at < given.at || at - given.at > COMMAND_LIFE => {
                    wrong.push(format!("{topic}: {wanted} of {} was written at {at}", given.at));
                }
                _ => {}
            }
        }
        for (line, changes) in changes.iter().enumerate() {
            for change in changes.iter().filter(|change| change.written) {
                let topic = points::topic(line, change.unit, Point::Stored(change.store));
                let is_known = match change.store {
                    Store::Coil(_) => self.coils.contains_key(&topic),
                    Store::Holding(_) => self.given.contains_key(&(topic.clone(), change.value.to_string())),
                };
                if !is_known {
                    wrong.push(format!("nobody asked for this: {topic}: {change:?}"));
                }
            }
        }
        for (topic, (given, outcomes)) in &self.coils {
            if outcomes < given || *outcomes > given + self.closings {
                wrong.push(format!("{topic}: {given} commands and {outcomes} outcomes"));
            }
        }
        wrong.into_iter().for_each(|text| self.complain(text));
    }

    /// Whether all is well again: every device is there, each reading is new, and what is stored is shown
    /// as it is. Otherwise what is not.
    pub fn is_well(&self, now: Time, holds: impl Fn(usize, u8, Store) -> u16) -> Result<(), String> {
        for (line, unit) in points::units() {
            let device = points::device(line, unit);
            let available = self.availability.get(&format!("busker/{device}")).map(String::as_str);
            if available != Some("online") {
                return Err(format!("{device} is {available:?}"));
            }
            for point in points::all() {
                let topic = points::topic(line, unit, point);
                let watched = self.watched.get(&topic);
                let shown = watched.and_then(|watched| watched.last.as_deref());
                match point {
                    Point::Stored(store) => {
                        let held = points::payload(store, holds(line, unit, store));
                        if shown != Some(&held) {
                            return Err(format!("{topic} shows {shown:?}, but holds {held}"));
                        }
                    }
                    Point::Reading(_) => {
                        let at = watched.map_or(Time(0), |watched| watched.last_at);
                        if shown.is_none() || now.since(at) > Duration::from_secs(5) {
                            return Err(format!("{topic} showed {shown:?} at {at}"));
                        }
                    }
                }
            }
        }
        Ok(())
    }
}
