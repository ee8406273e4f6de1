//! Requests of programs on a bus: they wait, ask what they have to ask, and end in exactly one answer.
//!
//! Between two questions of a request whatever else is due has its turn, so that no program that asks
//! without end keeps the polls from the wire.

mod finding;
mod raw;
mod scan;

use std::collections::VecDeque;

use serde_json::{Value as Json, json};

use crate::engine::device::PointIndex;
use crate::engine::modbus::{Answer, Call, RequestError};
use crate::engine::request::{Request, Status, Wish};
use crate::engine::time::{Duration, Time};

use super::commands::STOPPING;
use super::device::DeviceState;
use super::waiting::Target;
use super::{Bus, LinkState, Purpose};
use finding::{Diagnosis, Identification};
use raw::{RawRead, RawWrite};
pub(super) use scan::Scanning;

/// More requests than this are not kept waiting.
const WAITING_MAX: usize = 16;
const TOO_MANY: &str = "16 requests of this bus wait already; ask again when they are answered";
/// After a question to a device that may be away, and that nobody answers, requests leave the bus alone so
/// many times as long as it took.
const SILENCE_FACTOR: u32 = 3;
/// How long a request may wait until it begins.
const TIME_TO_LIVE: Duration = Duration::from_secs(10);

/// All requests of one bus.
#[derive(Default)]
pub(super) struct Requests {
    waiting: VecDeque<Waiting>,
    running: Option<Running>,
    refreshes: Vec<Refresh>,
    pub(super) scanning: Option<Scanning>,
    /// A pause that begins as soon as nothing is in flight any more.
    pub(super) pause: Option<Request>,
    /// Something has just been asked for a request: what else is due comes before its next question.
    asked: bool,
    /// Nothing is asked before, since nobody answered.
    not_before: Time,
}

/// A request that has not begun.
struct Waiting {
    request: Request,
    device: usize,
    deadline: Time,
    flow: Flow,
}

/// The one that has begun.
struct Running {
    request: Request,
    device: usize,
    flow: Flow,
    next: Next,
}

enum Next {
    Ask(Call),
    /// The device takes its time; then this is asked.
    At(Time, Call),
    InFlight,
}

/// What a request does, question by question.
enum Flow {
    Read(RawRead),
    Write(RawWrite),
    Identify(Identification),
    Diagnose(Diagnosis),
}

/// How a request goes on.
pub(super) enum Progress {
    Ask(Call),
    Settle(Duration, Call),
    Done { status: Status, data: Json, error: Option<String> },
}

impl Requests {
    /// The numbers of all devices that requests are for.
    pub(super) fn devices(&mut self) -> impl Iterator<Item = &mut usize> {
        let waiting = self.waiting.iter_mut().map(|waiting| &mut waiting.device);
        let running = self.running.iter_mut().map(|running| &mut running.device);
        waiting.chain(running).chain(self.refreshes.iter_mut().map(|refresh| &mut refresh.device))
    }
}

impl Progress {
    fn failed(error: impl Into<String>) -> Progress {
        Progress::Done { status: Status::Error, data: Json::Null, error: Some(error.into()) }
    }

    fn done(data: Json) -> Progress {
        Progress::Done { status: Status::Ok, data, error: None }
    }
}

/// Points that are being read again because a program wants to hear them.
struct Refresh {
    request: Request,
    device: usize,
    points: Vec<PointIndex>,
    deadline: Time,
}

impl Flow {
    /// Whether only the device of the profile may be asked, and only while it is there.
    fn wants_presence(&self) -> bool {
        matches!(self, Flow::Read(_) | Flow::Write(_))
    }

    fn begin(&mut self, device: &DeviceState) -> Progress {
        match self {
            Flow::Read(read) => read.begin(),
            Flow::Write(write) => write.begin(device),
            Flow::Identify(identification) => identification.begin(device),
            Flow::Diagnose(diagnosis) => diagnosis.begin(),
        }
    }
}

impl Bus {
    /// A message on a request's topic.
    pub(super) fn request(&mut self, request: Request) {
        match request.wish.clone() {
            Wish::Read { device, span, clears } => self.wait(request, &device, |state| {
                state.may_read(span, clears)?;
                Ok(Flow::Read(RawRead { span }))
            }),
            Wish::Write { device, span, words } => self.wait(request, &device, |state| {
                state.may_write_raw(span)?;
                Ok(Flow::Write(RawWrite::new(span, words, state)?))
            }),
            Wish::Identify { device } => {
                self.wait(request, &device, |state| Ok(Flow::Identify(Identification::new(state))));
            }
            Wish::Diagnostics { device } => {
                self.wait(request, &device, |_| Ok(Flow::Diagnose(Diagnosis::default())));
            }
            Wish::Refresh { device, point } => self.refresh(request, &device, point.as_deref()),
            Wish::Scan(scan) => self.scan(request, &scan),
            Wish::Pause { time, .. } => self.pause(request, time),
            Wish::Record => self.record(request),
        }
    }

    /// Lets a request wait for its turn; `check` says what it does, or why it must not.
    fn wait(
        &mut self,
        request: Request,
        device: &str,
        check: impl FnOnce(&DeviceState) -> Result<Flow, String>,
    ) {
        let Some(device) = self.devices.iter().position(|state| state.name() == device) else {
            return self.refuse(&request, "the device is not here any more");
        };
        if self.requests.waiting.len() == WAITING_MAX {
            return self.refuse(&request, TOO_MANY);
        }
        match check(&self.devices[device]) {
            Ok(flow) => {
                let deadline = self.now + TIME_TO_LIVE;
                self.requests.waiting.push_back(Waiting { request, device, deadline, flow });
            }
            Err(reason) => self.refuse(&request, &reason),
        }
    }

    pub(super) fn refuse(&mut self, request: &Request, reason: &str) {
        let message = request.refusal(&self.context.telling.gateway.topics, reason);
        self.context.publish(message);
    }

    pub(super) fn tell(&mut self, request: &Request, status: Status, data: Json, error: Option<&str>) {
        let message = request.answer(&self.context.telling.gateway.topics, status, data, error);
        self.context.publish(message);
    }

    // What is asked.

    /// Goes on with the request that has begun, or begins the first that can. Whether anything was done.
    pub(super) fn begin_request(&mut self) -> bool {
        if self.requests.asked || self.now < self.requests.not_before {
            return false;
        }
        if self.requests.running.is_none() {
            let devices = &self.devices;
            let can_begin = |waiting: &Waiting| {
                let device = &devices[waiting.device];
                let is_there = !waiting.flow.wants_presence() || device.is_present_and_answers();
                is_there && self.may_ask(device)
            };
            let Some(at) = self.requests.waiting.iter().position(can_begin) else { return false };
            let Some(Waiting { request, device, mut flow, .. }) = self.requests.waiting.remove(at) else {
                return false;
            };
            let progress = flow.begin(&self.devices[device]);
            self.go_on(request, device, flow, progress);
        }
        let Some(running) = &mut self.requests.running else { return true };
        let call = match &running.next {
            Next::Ask(call) => call.clone(),
            Next::At(time, call) if *time <= self.now => call.clone(),
            Next::At(..) | Next::InFlight => return false,
        };
        running.next = Next::InFlight;
        let device = running.device;
        if call.is_write() {
            if let Flow::Write(write) = &running.flow {
                let points = write.points().to_vec();
                self.counters.writes += 1;
                self.devices[device].about_to_write_raw(self.now, &points, &mut self.context);
            }
        }
        self.requests.asked = true;
        self.send(device, call, Purpose::Request);
        true
    }

    /// The question of the request that has begun was answered, or not.
    pub(super) fn request_answered(&mut self, sent_at: Time, result: Result<Answer, RequestError>) {
        let Some(Running { request, device, mut flow, .. }) = self.requests.running.take() else { return };
        self.count_written(device, &result);
        let state = &mut self.devices[device];
        if flow.wants_presence() {
            match &result {
                Ok(_) | Err(RequestError::Exception(_) | RequestError::Impossible(_)) => {}
                Err(error) => state.failed(self.now, error, &mut self.context),
            }
        } else if result == Err(RequestError::Timeout) {
            self.requests.not_before = self.now + (self.now - sent_at) * SILENCE_FACTOR;
        }
        let state = &mut self.devices[device];
        let progress = match &mut flow {
            Flow::Read(read) => read.answered(self.now, state, result, &mut self.context),
            Flow::Write(write) => write.answered(self.now, state, result, &mut self.context),
            Flow::Identify(identification) => identification.answered(state, &result),
            Flow::Diagnose(diagnosis) => diagnosis.answered(state, result),
        };
        self.go_on(request, device, flow, progress);
    }

    fn go_on(&mut self, request: Request, device: usize, flow: Flow, progress: Progress) {
        let next = match progress {
            Progress::Ask(call) => Next::Ask(call),
            Progress::Settle(time, call) => Next::At(self.now + time, call),
            Progress::Done { status, data, error } => {
                if let Flow::Write(write) = &flow {
                    let points = write.points().to_vec();
                    self.devices[device].raw_write_ended(self.now, &points, &mut self.context);
                }
                return self.tell(&request, status, data, error.as_deref());
            }
        };
        self.requests.running = Some(Running { request, device, flow, next });
    }

    /// What else is due has had its turn. Whether a request may have waited for that.
    pub(super) fn requests_go_on(&mut self) -> bool {
        std::mem::take(&mut self.requests.asked)
    }

    // Refreshes.

    fn refresh(&mut self, request: Request, device: &str, name: Option<&str>) {
        let Some(index) = self.devices.iter().position(|state| state.name() == device) else {
            return self.refuse(&request, "the device is not here any more");
        };
        if self.requests.refreshes.len() == WAITING_MAX {
            return self.refuse(&request, TOO_MANY);
        }
        let target = match name {
            None => None,
            Some(name) => match self.devices[index].target_named(name) {
                Some(target) => Some(target),
                None => {
                    let reason = self.devices[index].no_point(name, &self.devices[index].names_to_read());
                    return self.refuse(&request, &reason);
                }
            },
        };
        match target {
            Some(Target::Point(point) | Target::Setting(point)) => {
                if self.devices[index].details(point).is_button() {
                    return self.refuse(&request, "a button holds nothing that could be read");
                }
                if self.devices[index].details(point).is_read_on_request() {
                    self.fetch(index, point);
                }
            }
            Some(Target::Thing(_)) | None => {}
        }
        let state = &mut self.devices[index];
        let points = state.refresh(self.now, target, &mut self.context);
        let deadline = self.now + TIME_TO_LIVE;
        self.requests.refreshes.push(Refresh { request, device: index, points, deadline });
    }

    /// Answers the refreshes of which everything has been told.
    pub(super) fn end_refreshes(&mut self) {
        if self.requests.refreshes.is_empty() {
            return;
        }
        let (ended, rest): (Vec<Refresh>, Vec<Refresh>) =
            std::mem::take(&mut self.requests.refreshes).into_iter().partition(|refresh| {
                let state = &self.devices[refresh.device];
                state.is_present() && refresh.points.iter().all(|point| !state.is_to_be_told(*point))
            });
        self.requests.refreshes = rest;
        for Refresh { request, device, points, .. } in ended {
            let data = json!({"device": self.devices[device].name(), "points": points.len()});
            self.tell(&request, Status::Ok, data, None);
        }
    }

    // The end of what takes too long.

    pub(super) fn expire_requests(&mut self) {
        let now = self.now;
        if self.requests_expire_at().is_none_or(|at| now < at) {
            return;
        }
        let late = |waiting: &Waiting| waiting.deadline <= now;
        let (expired, rest): (Vec<_>, VecDeque<_>) = {
            let all = std::mem::take(&mut self.requests.waiting).into_iter();
            let (expired, rest): (Vec<_>, Vec<_>) = all.partition(late);
            (expired, rest.into())
        };
        self.requests.waiting = rest;
        for Waiting { request, device, .. } in expired {
            let reason = self.why_not(device);
            self.refuse(&request, &format!("it did not begin in time: {reason}"));
        }
        let refreshes = std::mem::take(&mut self.requests.refreshes).into_iter();
        let (expired, rest): (Vec<_>, Vec<_>) = refreshes.partition(|refresh| refresh.deadline <= now);
        self.requests.refreshes = rest;
        for Refresh { request, device, .. } in expired {
            let reason = self.why_not(device);
            self.refuse(&request, &format!("not everything was read in time: {reason}"));
        }
    }

    fn why_not(&self, device: usize) -> String {
        match &self.link_state {
            LinkState::Paused { reason, .. } => reason.clone(),
            LinkState::Down { reason: Some(reason), .. } => format!("the link is down: {reason}"),
            _ => self.devices[device].why_not_asked(),
        }
    }

    /// The link is gone, or about to be: what has begun cannot go on.
    pub(super) fn break_requests(&mut self, reason: &str) {
        self.break_running(reason);
        self.end_scan(Some(reason));
    }

    fn break_running(&mut self, reason: &str) {
        if let Some(Running { request, device, flow, .. }) = self.requests.running.take() {
            let error = match &flow {
                Flow::Write(write) => {
                    let points = write.points().to_vec();
                    let text = write.broken(reason);
                    self.devices[device].raw_write_ended(self.now, &points, &mut self.context);
                    text
                }
                _ => reason.to_string(),
            };
            self.refuse(&request, &error);
        }
    }

    /// The program ends.
    pub(super) fn refuse_requests(&mut self) {
        let reason = STOPPING;
        for Waiting { request, .. } in std::mem::take(&mut self.requests.waiting) {
            self.refuse(&request, reason);
        }
        for Refresh { request, .. } in std::mem::take(&mut self.requests.refreshes) {
            self.refuse(&request, reason);
        }
        if let Some(request) = self.requests.pause.take() {
            self.refuse(&request, reason);
        }
        if self.in_flight.is_none() {
            self.break_requests(reason);
        }
    }

    /// A device leaves.
    pub(super) fn refuse_requests_of(&mut self, device: usize, reason: &str) {
        if self.requests.running.as_ref().is_some_and(|running| running.device == device) {
            self.break_running(reason);
        }
        let all = std::mem::take(&mut self.requests.waiting).into_iter();
        let (of_it, rest): (Vec<_>, Vec<_>) = all.partition(|waiting| waiting.device == device);
        self.requests.waiting = rest.into();
        let all = std::mem::take(&mut self.requests.refreshes).into_iter();
        let (refreshes, rest): (Vec<_>, Vec<_>) = all.partition(|refresh| refresh.device == device);
        self.requests.refreshes = rest;
        let requests = of_it.into_iter().map(|waiting| waiting.request);
        for request in requests.chain(refreshes.into_iter().map(|refresh| refresh.request)) {
            self.refuse(&request, reason);
        }
    }

    /// When the bus must be woken for a request.
    pub(super) fn requests_wake_at(&self) -> Option<Time> {
        let not_before = self.requests.not_before;
        let running = self.requests.running.as_ref().and_then(|running| match running.next {
            Next::At(time, _) => Some(time),
            Next::Ask(_) if not_before > self.now => Some(not_before),
            Next::Ask(_) | Next::InFlight => None,
        });
        let silence = (!self.requests.waiting.is_empty()).then_some(not_before);
        let scan = self.requests.scanning.as_ref().map(Scanning::next_at);
        silence.into_iter().filter(|at| *at > self.now).chain(running).chain(scan).min()
    }

    /// When the next request has waited too long.
    pub(super) fn requests_expire_at(&self) -> Option<Time> {
        let waiting = self.requests.waiting.iter().map(|waiting| waiting.deadline);
        waiting.chain(self.requests.refreshes.iter().map(|refresh| refresh.deadline)).min()
    }
}
