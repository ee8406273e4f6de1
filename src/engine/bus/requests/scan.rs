//! A scan: which units answer on a bus, who they are, and how they would stand in the configuration.
//! One cheap question for each unit, with pauses, so that the polls go on.

use std::collections::VecDeque;

use serde_json::{Value as Json, json};

use crate::engine::address::Span;
use crate::engine::bus::{Bus, LinkState, Purpose};
use crate::engine::device::Identify;
use crate::engine::identity;
use crate::engine::modbus::{Answer, Call, Request as Question, RequestError};
use crate::engine::request::{Request, Scan, Status};
use crate::engine::time::{Duration, Time};

/// After each question the scan leaves the bus alone so many times as long as the question took: it has
/// a fourth of the bus at most.
const PAUSE_FACTOR: u32 = 3;
/// How often it is told how far the scan is.
const PROGRESS_EVERY: Duration = Duration::from_secs(5);
/// The registers by which profiles know their devices, asked of a unit that does not tell its name.
const REGISTERS_MAX: usize = 4;

/// A scan under way.
pub(in crate::engine::bus) struct Scanning {
    request: Request,
    scan: Scan,
    unit: u8,
    /// What is still to be asked of this unit.
    questions: VecDeque<Call>,
    /// What this unit has said so far; `None`: nothing.
    heard: Option<Heard>,
    found: Vec<Json>,
    next_at: Time,
    tell_at: Time,
}

#[derive(Default)]
struct Heard {
    identity: Option<String>,
    profile: Option<String>,
}

impl Scanning {
    pub(super) fn next_at(&self) -> Time {
        self.next_at
    }

    fn begin_unit(&mut self) {
        // Function 43/14 changes nothing on any device, and one that does not know it says so.
        self.questions = VecDeque::from([Call::ReadIdentification { code: 1, object: 0 }]);
        self.heard = None;
    }

    fn take(&mut self, call: &Call, result: &Result<Answer, RequestError>) {
        let is_silence = match result {
            Ok(_) | Err(RequestError::Exception(_)) => false,
            Err(_) => true,
        };
        if is_silence {
            self.questions.clear();
            return;
        }
        let heard = self.heard.get_or_insert_with(Heard::default);
        match (call, result) {
            (Call::ReadIdentification { .. }, Ok(Answer::Identification(found))) => {
                let texts: Vec<&str> = found.objects.iter().map(|(_, text)| text.as_str()).collect();
                heard.identity = Some(texts.join(" "));
            }
            (Call::ReadIdentification { .. }, _) => {
                let mut registers: Vec<Span> = Vec::new();
                for (_, identify) in self.scan.known.iter() {
                    if let Identify::Word { at, .. } = identify {
                        if !registers.contains(at) && registers.len() < REGISTERS_MAX {
                            registers.push(*at);
                        }
                    }
                }
                self.questions = registers.into_iter().map(Call::Read).collect();
            }
            _ => {}
        }
        let Ok(answer) = result else { return };
        let fits = |(_, identify): &&(String, Identify)| {
            identity::question(identify) == *call && identity::check(identify, answer).is_ok()
        };
        let mut fitting = self.scan.known.iter().filter(fits);
        if let (Some((id, identify)), None) = (fitting.next(), fitting.next()) {
            heard.profile = Some(id.clone());
            heard.identity = identity::check(identify, answer).ok();
            self.questions.clear();
        }
    }

    fn data(&self) -> Json {
        json!({
            "units": format!("{}..{}", self.scan.first, self.scan.last),
            "asked_to": self.unit.saturating_sub(1).max(self.scan.first - 1),
            "found": self.found,
        })
    }
}

impl Bus {
    pub(super) fn scan(&mut self, request: Request, scan: &Scan) {
        // The desk that gave the ticket may be another one since a reload.
        if self.requests.scanning.is_some() {
            return self.refuse(&request, "a scan of this bus is under way; it is one at a time");
        }
        match &self.link_state {
            LinkState::Up | LinkState::Renewing => {}
            LinkState::Paused { reason, .. } => {
                let reason = reason.clone();
                return self.refuse(&request, &reason);
            }
            LinkState::Down { .. } => return self.refuse(&request, "the link is down"),
        }
        let mut scanning = Scanning {
            request,
            scan: scan.clone(),
            unit: scan.first,
            questions: VecDeque::new(),
            heard: None,
            found: Vec::new(),
            next_at: self.now,
            tell_at: self.now + PROGRESS_EVERY,
        };
        scanning.begin_unit();
        self.requests.scanning = Some(scanning);
    }

    /// Asks the next unit, if its time has come. Whether anything was done.
    pub(in crate::engine::bus) fn next_scan(&mut self) -> bool {
        let now = self.now;
        let Some(scanning) = self.requests.scanning.as_mut().filter(|scanning| scanning.next_at <= now)
        else {
            return false;
        };
        let unit = scanning.unit;
        if let Some(device) = self.devices.iter().find(|device| device.unit() == unit) {
            // It is asked all the time; what is known of it is the answer.
            let known = json!({
                "unit": unit,
                "device": device.name(),
                "online": device.is_present(),
                "identity": device.identity(),
                "profile": device.device().profile,
            });
            scanning.found.push(known);
            self.scanned_unit();
            return true;
        }
        let Some(call) = scanning.questions.pop_front() else { return false };
        self.send_to(unit, call);
        true
    }

    fn send_to(&mut self, unit: u8, call: Call) {
        // Nobody waits for a late answer: it is told apart by its unit.
        let question = Question { is_probe: true, ..Question::new(unit, call.clone()) };
        self.send_stranger(question, Purpose::Scan(call));
    }

    pub(in crate::engine::bus) fn scan_answered(
        &mut self,
        call: &Call,
        sent_at: Time,
        result: &Result<Answer, RequestError>,
    ) {
        let now = self.now;
        let Some(scanning) = &mut self.requests.scanning else { return };
        scanning.take(call, result);
        scanning.next_at = now + (now - sent_at) * PAUSE_FACTOR;
        if !scanning.questions.is_empty() {
            return;
        }
        if let Some(heard) = scanning.heard.take() {
            let unit = scanning.unit;
            let bus = &self.name;
            let proposal = heard.profile.as_ref().map(|profile| {
                format!("{}: {{profile: {profile}, bus: {bus}, unit: {unit}}}", name_for(profile, unit))
            });
            scanning.found.push(json!({
                "unit": unit,
                "device": null,
                "identity": heard.identity,
                "profile": heard.profile,
                "configuration": proposal,
            }));
        }
        self.scanned_unit();
    }

    /// All has been asked of a unit: the next one, or the end.
    fn scanned_unit(&mut self) {
        let now = self.now;
        let Some(scanning) = &mut self.requests.scanning else { return };
        if scanning.unit == scanning.scan.last {
            return self.end_scan(None);
        }
        scanning.unit += 1;
        scanning.begin_unit();
        if now >= scanning.tell_at {
            scanning.tell_at = now + PROGRESS_EVERY;
            let (request, data) = (scanning.request.clone(), scanning.data());
            self.tell(&request, Status::Progress, data, None);
        }
    }

    pub(super) fn end_scan(&mut self, reason: Option<&str>) {
        let Some(scanning) = self.requests.scanning.take() else { return };
        let mut data = scanning.data();
        match reason {
            None => {
                data["asked_to"] = scanning.scan.last.into();
                self.tell(&scanning.request, Status::Ok, data, None);
            }
            Some(_) => self.tell(&scanning.request, Status::Error, data, reason),
        }
    }
}

/// `metz-connect/mr-do4` on unit 18 → `mr_do4_18`.
fn name_for(profile: &str, unit: u8) -> String {
    let model = profile.rsplit('/').next().unwrap_or(profile);
    let plain = |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '_' };
    let name: String = model.chars().map(plain).collect();
    let begins_well = name.starts_with(|c: char| c.is_ascii_lowercase());
    if begins_well { format!("{name}_{unit}") } else { format!("device_{name}_{unit}") }
}
