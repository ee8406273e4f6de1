//! What must be true of a life, whatever happened in it.

use std::collections::BTreeMap;

use busker::engine::device::{Identify, Point, Poll};
use busker::engine::time::{Duration, Time};

use super::{Life, Seen, Unit};
use crate::watched::{Held, Write};

/// What decides about others is polled as often as this, or somewhat less where the line is full.
const SLOW: Duration = Duration::from_secs(20);

impl Life {
    /// Who has had no power for long is known to be away.
    pub fn look_at_availability(&mut self) {
        for published in &self.world.published[self.looked_at..] {
            if let Some(name) = published.message.topic.strip_suffix("/availability") {
                self.availability.insert(name.into(), published.message.payload.clone());
            }
        }
        self.looked_at = self.world.published.len();
        let now = self.world.now;
        for (index, dark) in self.dark_since.iter().enumerate() {
            let Some(since) = *dark else { continue };
            let name = format!("busker/{}", self.units[index].name);
            let calm_since = since.max(self.away_until).max(*self.starts.last().expect("one"));
            let says = self.availability.get(&name).map(String::as_str);
            if now.since(calm_since) > Duration::from_secs(90) && says == Some("online") {
                self.fail(&format!(
                    "{name} has no power since {since}, and is {says:?} at {now}{}",
                    self.world.all_heard_before(now)
                ));
            }
        }
    }

    /// What is counted is what was on the wire.
    pub fn check_counters(&self) {
        let report = self.world.report();
        let counted = report.counters.requests;
        let seen = self.world.requests().len() as u64 - self.requests_before;
        if counted > seen + self.closed || counted + self.closed + 1 < seen {
            self.fail(&format!(
                "{counted} requests counted, {seen} seen, link closed {} {report:?}",
                self.closed
            ));
        }
        for device in &report.devices {
            let unit = self.units.iter().find(|unit| unit.name == device.name).expect("one of them");
            let worn = self.ledger.of(unit.unit, |pages| {
                let is_worn = |write: &&Write| {
                    let at = |point: &Point| {
                        point.persistent
                            && point.write.as_ref().is_some_and(|own| own.at.span.overlaps(write.span))
                    };
                    !write.refused && !write.in_vain && unit.device.points.iter().any(at)
                };
                pages.writes.iter().filter(is_worn).count() as u64
            });
            if device.counters.persistent_writes < worn {
                self.fail(&format!(
                    "{}: {} writes to EEPROM are counted, and there were {worn}",
                    unit.name, device.counters.persistent_writes
                ));
            }
        }
    }

    pub fn find_outcomes(&mut self) {
        for published in &self.world.published {
            if !published.message.topic.ends_with("/outcome") {
                continue;
            }
            let outcome: serde_json::Value = serde_json::from_str(&published.message.payload).expect("JSON");
            let number = outcome["transaction"].as_u64().expect("each has one") as usize;
            let sent = &mut self.commands[number];
            assert!(sent.ended.is_none(), "two outcomes: {outcome} and {:?}", sent.ended);
            sent.ended = Some((published.at, outcome));
        }
        let responses = self.world.published.iter().filter(|published| {
            published.message.topic.contains("/response/")
                && !published.message.payload.contains(r#""status":"progress""#)
        });
        assert_eq!(responses.count(), self.requests, "responses");
    }

    pub fn check_messages(&self, seen: &mut Seen) {
        let mut told: BTreeMap<&str, &str> = BTreeMap::new();
        for published in &self.world.published {
            let topic = &published.message.topic;
            let Some((name, point)) = topic.strip_prefix("busker/").and_then(|rest| rest.split_once('/'))
            else {
                continue;
            };
            let Some(unit) = self.units.iter().find(|unit| unit.name == name) else { continue };
            let Some(index) = unit.device.point_named(point) else { continue };
            let details = &unit.device.points[index];
            let is_identity = match &unit.device.identify {
                Some(Identify::Word { at, .. }) => at.overlaps(details.at.span),
                _ => false,
            };
            if details.event.is_some() || is_identity {
                continue;
            }
            let text = &published.message.payload;
            let again = told.insert(topic, text);
            if text == "None" {
                continue;
            }
            seen.values += 1;
            if again == Some(text) && details.write.is_some() {
                continue;
            }
            let (from, to) = (published.asked_at[usize::from(unit.unit)], published.at);
            if self.may_be_old(unit, index, to) {
                seen.excused += 1;
                continue;
            }
            seen.decided += usize::from(!details.selectors().is_empty());
            let is_true = self.ledger.of(unit.unit, |pages| pages.held(index, from, to, text));
            if !is_true {
                let history = self.ledger.of(unit.unit, |pages| {
                    let is_near = |held: &&Held| held.since.0 + 60_000_000 > from.0 && held.since <= to;
                    let all = pages.texts[index].iter().filter(is_near);
                    format!("{:?}", all.collect::<Vec<_>>())
                });
                self.fail(&format!(
                    "{topic} {text}, asked at {from}, published at {to}; held {history}{}",
                    self.world.heard_before(to, unit.unit)
                ));
            }
        }
    }

    /// Whether what decides about the point was changed at the device, and perhaps not yet read again.
    fn may_be_old(&self, unit: &Unit, point: usize, at: Time) -> bool {
        let deciding = unit.device.points[point].selectors();
        self.ledger.of(unit.unit, |pages| pages.touched(&deciding, at, SLOW))
    }

    pub fn check_commands(&self, seen: &mut Seen) {
        for (number, sent) in self.commands.iter().enumerate() {
            let unit = &self.units[sent.unit];
            let what =
                format!("command {number} at {}: {}/{} {}", sent.at, unit.name, sent.target, sent.value);
            let Some((at, outcome)) = &sent.ended else { self.fail(&format!("no outcome: {what}")) };
            let kind = outcome["outcome"].as_str().expect("a kind");
            *seen.outcomes.entry(kind.into()).or_default() += 1;
            let Some(found) = outcome["found"].as_str() else { continue };
            let Some(point) = unit.device.point_named(&sent.target) else { continue };
            let held = self.ledger.of(unit.unit, |pages| pages.held(point, sent.at, *at, found));
            if !held && !self.may_be_old(unit, point, *at) {
                self.fail(&format!(
                    "{what} ended at {at} with {outcome}, which the device did not hold{}",
                    self.world.heard_before(*at, unit.unit)
                ));
            }
            if kind == "done" && found != sent.value {
                let numbers = found.parse::<f64>().ok().zip(sent.value.parse::<f64>().ok());
                let close = numbers.is_some_and(|(a, b)| (a - b).abs() < 1e-6);
                let noted = !outcome["reason"].is_null();
                if !close && !noted && !unit.device.points[point].is_button() {
                    self.fail(&format!("{what} ended with {outcome}"));
                }
            }
        }
    }

    pub fn check_writes(&self, seen: &mut Seen) {
        let requests = self.world.requests();
        for (index, unit) in self.units.iter().enumerate() {
            let to_unit: Vec<Time> =
                requests.iter().filter(|(_, asked)| *asked == unit.unit).map(|(at, _)| *at).collect();
            let writes = self.ledger.of(unit.unit, |pages| pages.writes.clone());
            let mut last: BTreeMap<usize, Time> = BTreeMap::new();
            let mut worn = 0;
            for write in &writes {
                let points: Vec<usize> = (0..unit.device.points.len())
                    .filter(|point| {
                        let at = unit.device.points[*point].write.as_ref().map(|write| write.at.span);
                        at.is_some_and(|at| at.overlaps(write.span))
                    })
                    .collect();
                // The device hears it when it is over, and by then the link may have ended, and with it the command.
                let begun = to_unit.iter().rev().find(|at| **at <= write.at).copied().unwrap_or(write.at);
                let cause = self.commands.iter().find(|sent| {
                    let Some((ended, outcome)) = &sent.ended else { return false };
                    let kind = outcome["outcome"].as_str().expect("a kind");
                    let wrote = !matches!(kind, "expired" | "unchanged");
                    sent.unit == index
                        && (sent.at..=*ended).contains(&begun)
                        && (wrote || sent.points.len() > 1)
                        && sent.points.iter().any(|point| points.contains(point))
                });
                let is_wished =
                    self.settings.devices[index].wanted.iter().any(|wanted| points.contains(&wanted.point));
                let beats =
                    is_wished || points.iter().any(|point| unit.device.points[*point].heartbeat.is_some());
                *seen.writes.entry(if cause.is_some() { "commanded" } else { "by itself" }).or_default() += 1;
                if cause.is_none() && !beats {
                    self.fail(&format!(
                        "nobody asked {} for {write:?}{}",
                        unit.name,
                        self.world.heard_before(write.at, unit.unit)
                    ));
                }
                let persistent: Vec<usize> =
                    points.iter().copied().filter(|point| unit.device.points[*point].persistent).collect();
                if persistent.is_empty() || write.refused {
                    continue;
                }
                let is_plain = persistent.iter().all(|point| {
                    let write = unit.device.points[*point].write.as_ref().expect("it is written");
                    !unit.device.points[*point].is_button() && write.on_change.is_none()
                });
                if is_plain && write.in_vain {
                    self.fail(&format!(
                        "EEPROM of {} is written in vain: {write:?} {:?}{}",
                        unit.name,
                        persistent.iter().map(|p| &unit.device.points[*p].name).collect::<Vec<_>>(),
                        self.world.heard_before(write.at, unit.unit)
                    ));
                }
                worn += 1;
                *seen.writes.entry("to EEPROM").or_default() += 1;
                for point in persistent {
                    if let Some(before) = last.insert(point, write.at) {
                        let restarted = self.starts.iter().any(|start| (before..write.at).contains(start));
                        let apart = write.at - before;
                        if !restarted
                            && apart + Duration::from_secs(2) < Duration::from_secs(self.eeprom.0)
                            && write.span.count() == 1
                            && is_plain
                        {
                            // Bits of one register are points of their own.
                            let own = unit.device.points[point].at.bits.is_none();
                            if own {
                                self.fail(&format!(
                                    "{} {} is written again after {apart:?}",
                                    unit.name, unit.device.points[point].name
                                ));
                            }
                        }
                    }
                }
            }
            if worn > self.eeprom.1 {
                self.fail(&format!("{} was worn {worn} times, allowed {}", unit.name, self.eeprom.1));
            }
        }
    }

    pub fn check_end(&self) {
        let mut last: BTreeMap<&str, &str> = BTreeMap::new();
        for published in &self.world.published {
            last.insert(&published.message.topic, &published.message.payload);
        }
        for unit in &self.units {
            let says = |what: &str| last.get(&*format!("busker/{}/{what}", unit.name)).copied();
            if says("availability") != Some("online") {
                self.fail(&format!(
                    "{} is {:?}: {:?}{}",
                    unit.name,
                    says("availability"),
                    says("info"),
                    self.world.all_heard_before(self.world.now)
                ));
            }
            self.check_things(&last, unit);
            for (index, point) in unit.device.points.iter().enumerate() {
                if !point.is_read() || point.event.is_some() || point.read_clears || point.poll == Poll::Once
                {
                    continue;
                }
                if point.also.is_some() && self.is_missing(unit, index) {
                    continue;
                }
                let holds = self.holds(unit, index);
                if says(&point.name) != Some(&holds) {
                    self.fail(&format!(
                        "{}/{} ({}) says {:?} and holds {holds}; {:?}{}",
                        unit.name,
                        point.name,
                        unit.device.profile,
                        says(&point.name),
                        says("info"),
                        self.world.heard_before(self.world.now, unit.unit)
                    ));
                }
            }
        }
    }

    /// What a thing is said to be fits what its points are said to be.
    fn check_things(&self, last: &BTreeMap<&str, &str>, unit: &Unit) {
        for thing in unit.device.things.iter().filter(|thing| !thing.states.is_empty()) {
            let says = |what: &str| last.get(&*format!("busker/{}/{what}", unit.name)).copied();
            let holds = |point: usize| self.holds(unit, point);
            let state = thing
                .states
                .iter()
                .find(|state| state.row.iter().all(|(point, text)| holds(*point) == *text));
            let expected = state.map_or("None", |state| &state.name);
            let said = says(&thing.name);
            if said != Some(expected) && !(said.is_none() && expected == "None") {
                let lives = thing.when.iter().all(|condition| {
                    condition.values.iter().any(|(_, name)| *name == holds(condition.point))
                });
                if lives {
                    self.fail(&format!("{}/{} says {said:?} and is {expected}", unit.name, thing.name));
                }
            }
        }
    }

    /// What whoever reads the point is told now.
    fn holds(&self, unit: &Unit, point: usize) -> String {
        match self.is_missing(unit, point) {
            true => "None".into(),
            false => self.ledger.of(unit.unit, |pages| pages.holds(point).to_string()),
        }
    }

    /// Whether the device does not have the addresses of the point.
    fn is_missing(&self, unit: &Unit, point: usize) -> bool {
        let point = &unit.device.points[point];
        let holes = unit.holes.lock().expect("nobody panicked");
        [Some(point.at), point.also]
            .iter()
            .flatten()
            .any(|at| holes.iter().any(|hole| hole.overlaps(at.span)))
    }

    fn fail(&self, text: &str) -> ! {
        panic!("{}", text.to_string() + "\n" + &self.text + &format!("seed {}", self.seed));
    }
}
