//! A scan: which units answer on a bus, who they are, and how they would stand in the configuration.
//! One cheap question for each unit, a few more for one that answers without its names, with pauses, so that the polls
//! go on.

use serde_json::{Value as Json, json};

use crate::engine::bus::{Bus, LinkState, Purpose};
use crate::engine::identity::{Interview, entry, name_for};
use crate::engine::modbus::{Answer, Call, Request as Question, RequestError};
use crate::engine::request::{Request, Scan, Status};
use crate::engine::time::{Duration, Time};

/// After each question the scan leaves the bus alone so many times as long as the question took: it has
/// a fourth of the bus at most.
const PAUSE_FACTOR: u32 = 3;
/// How often it is told how far the scan is.
const PROGRESS_EVERY: Duration = Duration::from_secs(5);

/// A scan under way.
pub(in crate::engine::bus) struct Scanning {
    request: Request,
    scan: Scan,
    unit: u8,
    /// Who this unit is.
    interview: Interview,
    found: Vec<Json>,
    next_at: Time,
    tell_at: Time,
}

impl Scanning {
    pub(super) fn next_at(&self) -> Time {
        self.next_at
    }

    fn begin_unit(&mut self) {
        self.interview = Interview::in_brief(self.scan.known.clone());
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
        let scanning = Scanning {
            request,
            scan: scan.clone(),
            unit: scan.first,
            interview: Interview::in_brief(scan.known.clone()),
            found: Vec::new(),
            next_at: self.now,
            tell_at: self.now + PROGRESS_EVERY,
        };
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
        let Some(call) = scanning.interview.question() else { return false };
        self.send_to(unit, call);
        true
    }

    fn send_to(&mut self, unit: u8, call: Call) {
        // Nobody waits for a late answer: it is told apart by its unit.
        let question = Question { is_probe: true, ..Question::new(unit, call) };
        self.send_stranger(question, Purpose::Scan);
    }

    pub(in crate::engine::bus) fn scan_answered(
        &mut self,
        sent_at: Time,
        result: &Result<Answer, RequestError>,
    ) {
        let now = self.now;
        let Some(scanning) = &mut self.requests.scanning else { return };
        scanning.interview.answered(result);
        scanning.next_at = now + (now - sent_at) * PAUSE_FACTOR;
        if scanning.interview.question().is_some() {
            return;
        }
        if scanning.interview.was_heard() {
            let unit = scanning.unit;
            let bus = &self.name;
            let (profile, told) = scanning.interview.only_fitting().unzip();
            let proposal =
                profile.map(|profile| format!("{}: {}", name_for(profile, unit), entry(profile, bus, unit)));
            let identity = told.or_else(|| scanning.interview.names());
            scanning.found.push(json!({
                "unit": unit,
                "device": null,
                "identity": identity,
                "profile": profile,
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
