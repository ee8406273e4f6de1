//! One bus as a state machine: what happened goes in, what to do comes out.
//!
//! [`Bus::handle`] is the page to read first. One request is in flight at a time; when it has ended,
//! `ask_next` chooses the next: the command that has begun, heartbeats and watchdogs that are late, waiting commands,
//! heartbeats and watchdogs, what somebody asked for, settings that are not as they are wanted, a scan, then whichever
//! device's read (or identification) is most urgent. Nobody who asks without end keeps a read that is due from
//! the wire: [`AHEAD_OF_READS`].

mod change;
mod commands;
mod device;
mod fetch;
mod line;
mod pause;
mod requests;
mod waiting;

use std::collections::VecDeque;

use crate::engine::command;
use crate::engine::device::PointIndex;
use crate::engine::health::{BusReport, Counters};
use crate::engine::homeassistant::Gateway;
use crate::engine::memory::{Memories, Record};
use crate::engine::modbus::{Answer, Call, Reply, Request, RequestError};
use crate::engine::plan::Cost;
use crate::engine::request;
use crate::engine::settings::{DeviceSettings, Eeprom, Link, OnBrokerLoss, Settings};
use crate::engine::time::{Duration, Time};
use crate::engine::topics::Message;

use commands::{Active, Settling};
use device::{DeviceState, Polled, Turn};
use fetch::Fetch;
use requests::Requests;
use waiting::{Target, WaitingCommands};

/// So many requests in a row may go before a read that is due, because somebody wants them at once. Then
/// the read has its turn: under a flood of commands every period stretches, but nothing starves.
const AHEAD_OF_READS: u32 = 8;

/// What can happen to a bus.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// The port is open, the connection stands.
    LinkUp,
    LinkDown(String),
    /// The request of the last [`Action::Send`] has ended.
    Reply(Reply),
    Command(Command),
    /// Read this point now, and tell it even if it has not changed.
    Get {
        device: String,
        point: String,
    },
    /// A program asks something.
    Request(request::Request),
    /// The device of this name leaves the bus: [`Bus::has_device`].
    Retire(String),
    /// Devices come to the bus, with what is remembered of them.
    Adopt(Vec<DeviceSettings>, Memories),
    /// The request of the last [`Action::Send`] was taken back before it was on the wire.
    Withdrawn,
    BrokerUp,
    BrokerDown,
    /// The time of [`Bus::wake_at`] has come.
    Wake,
    /// Finish the request in flight, refuse what waits, say `offline`.
    Shutdown,
}

/// A message on a `set` topic, as it came.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Command {
    pub device: String,
    pub point: String,
    pub payload: String,
    /// A replayed one; it is never obeyed.
    pub retained: bool,
}

/// What is to be done.
#[derive(Clone, Debug, PartialEq)]
pub enum Action {
    /// Ask the line. Exactly one request is in flight: the next `Send` comes after its reply.
    Send {
        request: Request,
        not_before: Time,
        timeout: Duration,
    },
    /// If the last request is not on the wire yet, take it back and say [`Event::Withdrawn`].
    Withdraw,
    Publish(Message),
    /// Keep this for the next start.
    Store(Record),
    /// Close the link, if it is open, and open it after this long. The first action of all.
    Reopen {
        after: Duration,
    },
    /// A line for the log: said once when something breaks and once when it heals.
    Say(Severity, String),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Severity {
    Info,
    Warning,
}

/// One serial line or TCP connection, and the devices on it.
pub struct Bus {
    name: String,
    link: Link,
    response_timeout: Duration,
    on_broker_loss: OnBrokerLoss,
    eeprom: Eeprom,
    context: Context,
    devices: Vec<DeviceState>,
    waiting: WaitingCommands,
    /// The command that has begun.
    active: Option<Active>,
    /// Commands that were written and wait until they can be read back.
    settling: Vec<Settling>,
    /// What was read for a heartbeat, and is written before anything else is asked.
    beat: Option<(usize, PointIndex, Call)>,
    /// Points that are read only because somebody asked for them.
    fetches: VecDeque<Fetch>,
    requests: Requests,
    /// A setting has just been written: what is due to be read comes before the next one.
    wrote_setting: bool,
    in_flight: Option<InFlight>,
    /// Requests in a row that were wanted at once.
    ahead: u32,
    link_state: LinkState,
    /// Requests in a row that no device on this link answered.
    unanswered: u32,
    broker_up: bool,
    counters: Counters,
    line: line::Line,
    load: Load,
    stopping: bool,
    /// When something is to be stored next.
    record_due_at: Option<Time>,
    /// Whether any device has heartbeats or a watchdog, and settings. Most have none, and with many devices looking for
    /// them costs more than everything else.
    feeds: bool,
    has_settings: bool,
    now: Time,
}

/// What everything on a bus shares: where messages go, and the actions that wait to be taken.
struct Context {
    actions: VecDeque<Action>,
    gateway: Gateway,
    discovery: bool,
    bus_name: String,
    republish: Duration,
}

impl Context {
    fn publish(&mut self, message: Message) {
        self.actions.push_back(Action::Publish(message));
    }

    fn say(&mut self, severity: Severity, text: String) {
        self.actions.push_back(Action::Say(severity, text));
    }
}

#[derive(Clone, Debug, PartialEq)]
enum LinkState {
    Up,
    /// Being closed and opened again because nothing answers on it.
    Renewing,
    Down {
        reason: Option<String>,
        attempts: u32,
    },
    /// Left to somebody else for a time.
    Paused {
        reason: String,
    },
}

/// What the request on the wire is for.
struct InFlight {
    /// `None`: a unit that is no device of this gateway.
    device: Option<usize>,
    purpose: Purpose,
    sent_at: Time,
    /// What the device's turn was before, in case this is taken back.
    before: Option<Turn>,
    /// A command may take its turn.
    gives_way: bool,
}

enum Purpose {
    Identify,
    Poll {
        read: usize,
    },
    Command,
    Fetch,
    /// Reads what the heartbeat repeats.
    BeatRead(PointIndex),
    BeatWrite(PointIndex),
    /// A question of the request that has begun.
    Request,
    Scan(Call),
}

impl Bus {
    /// The bus number `index` of `settings`, with the devices that are on it and what is remembered
    /// of them.
    pub fn new(now: Time, settings: &Settings, index: usize, memories: &Memories) -> Bus {
        let bus = &settings.buses[index];
        let mut context = Context {
            actions: VecDeque::from([Action::Reopen { after: Duration::ZERO }]),
            gateway: Gateway::new(&settings.mqtt.base_topic, &settings.home_assistant),
            discovery: settings.home_assistant.discovery,
            bus_name: bus.name.clone(),
            republish: settings.republish,
        };
        let cost = cost(&bus.link);
        let of_bus = settings.devices.iter().filter(|device| device.bus == index);
        let mut devices: Vec<DeviceState> =
            of_bus.map(|device| DeviceState::new(device.clone(), cost, settings.eeprom)).collect();
        let mut counters = Counters::default();
        for device in &mut devices {
            counters.persistent_writes += device.recall(memories);
            device.introduce(now, &mut context);
        }
        let record_due_at = devices.iter().filter_map(DeviceState::record_due_at).min();
        let feeds = devices.iter().any(DeviceState::wants_feeding);
        let has_settings = devices.iter().any(DeviceState::has_settings);
        Bus {
            name: bus.name.clone(),
            link: bus.link.clone(),
            response_timeout: bus.response_timeout,
            on_broker_loss: settings.on_broker_loss,
            eeprom: settings.eeprom,
            context,
            devices,
            waiting: WaitingCommands::default(),
            active: None,
            settling: Vec::new(),
            beat: None,
            fetches: VecDeque::new(),
            requests: Requests::default(),
            wrote_setting: false,
            in_flight: None,
            ahead: 0,
            link_state: LinkState::Down { reason: None, attempts: 0 },
            unanswered: 0,
            broker_up: true,
            counters,
            line: line::Line::default(),
            load: Load::default(),
            stopping: false,
            record_due_at,
            feeds,
            has_settings,
            now,
        }
    }

    /// Tells the bus what happened. Never fails: what goes wrong becomes a reading or a report.
    pub fn handle(&mut self, now: Time, event: Event) {
        self.now = now;
        match event {
            Event::LinkUp => self.link_up(),
            Event::LinkDown(reason) => self.link_down(reason),
            Event::Reply(reply) => self.reply(reply),
            Event::Command(command) => {
                self.command(command);
                self.make_way();
            }
            Event::Withdrawn => self.withdrawn(),
            Event::Get { device, point } => self.get(&device, &point),
            Event::Request(request) => self.request(request),
            Event::Retire(device) => self.retire(&device),
            Event::Adopt(devices, memories) => self.adopt(devices, &memories),
            Event::BrokerUp => self.broker_up = true,
            Event::BrokerDown => self.broker_up = false,
            Event::Wake => {}
            Event::Shutdown => self.stopping = true,
        }
        self.end_retirements();
        self.expire_commands();
        self.expire_requests();
        if self.stopping {
            self.refuse_what_waits();
        } else if !self.begin_pause() {
            self.ask_next();
        }
        self.end_refreshes();
        self.remember();
    }

    /// Takes the next thing to do, until there is none.
    pub fn next_action(&mut self) -> Option<Action> {
        self.context.actions.pop_front()
    }

    /// When to call `handle(now, Event::Wake)` if nothing else happens before. While a request is in
    /// flight its reply is what happens next.
    pub fn wake_at(&self) -> Option<Time> {
        let records = self.record_due_at.into_iter();
        if self.in_flight.is_some() || self.link_state != LinkState::Up || self.stopping {
            return records.chain(self.waiting.next_deadline()).chain(self.requests_expire_at()).min();
        }
        let of_devices =
            self.devices.iter().filter(|device| self.may_ask(device)).filter_map(DeviceState::due_at);
        let spared =
            self.waiting.iter().map(|waiting| self.devices[waiting.device].writable_at(waiting.target));
        let settings = self.devices.iter().filter_map(DeviceState::next_setting_at);
        let beats =
            self.devices.iter().filter(|device| self.may_ask(device)).filter_map(DeviceState::beats_at);
        of_devices
            .chain(self.waiting.next_deadline())
            .chain(spared.chain(settings).filter(|at| *at > self.now))
            .chain(self.settled_at())
            .chain(self.requests_wake_at())
            .chain(self.requests_expire_at())
            .chain(beats)
            .chain(records)
            .min()
    }

    fn cost(&self) -> Cost {
        cost(&self.link)
    }

    /// Whether a shutdown has been asked for and nothing is in flight any more.
    pub fn is_finished(&self) -> bool {
        self.stopping && self.in_flight.is_none()
    }

    /// The bus as it is now, for `/health`, `/metrics`, `/api` and `bridge/health`.
    pub fn report(&self, now: Time) -> BusReport {
        let devices = self.devices.iter().map(|device| device.report(now)).collect();
        BusReport { devices, ..self.summary(now) }
    }

    /// The same without points, which are most of it.
    pub fn summary(&self, now: Time) -> BusReport {
        let reason = match &self.link_state {
            LinkState::Up | LinkState::Renewing => self.line.trouble(now),
            LinkState::Down { reason, .. } => Some(reason.clone().unwrap_or("not yet open".into())),
            LinkState::Paused { reason } => Some(reason.clone()),
        };
        BusReport {
            name: self.name.clone(),
            link: self.link.to_string(),
            line: self.link.line().map(|line| line.to_string()),
            up: matches!(self.link_state, LinkState::Up | LinkState::Renewing),
            reason,
            paused: matches!(self.link_state, LinkState::Paused { .. }),
            counters: self.counters,
            load: self.load.share(now),
            devices: self.devices.iter().map(|device| device.summary(now)).collect(),
        }
    }

    // What happened to the link.

    fn link_up(&mut self) {
        match std::mem::replace(&mut self.link_state, LinkState::Up) {
            // The devices are as silent as they were, and are asked as seldom.
            LinkState::Renewing => return,
            LinkState::Down { attempts, .. } if attempts > 0 => {
                self.context.say(Severity::Info, format!("bus {}: the link is back", self.name));
            }
            LinkState::Paused { .. } => {
                self.context.say(Severity::Info, format!("bus {}: the pause is over", self.name));
            }
            LinkState::Down { .. } | LinkState::Up => {}
        }
        for device in &mut self.devices {
            device.reconnect(self.now);
        }
    }

    fn link_down(&mut self, reason: String) {
        let attempts = match &self.link_state {
            LinkState::Up | LinkState::Renewing | LinkState::Paused { .. } => 0,
            LinkState::Down { attempts, .. } => *attempts,
        };
        if attempts == 0 {
            self.context.say(Severity::Warning, format!("bus {}: the link is down: {reason}", self.name));
        }
        if let Some(in_flight) = self.in_flight.take() {
            self.request_ended(in_flight, Err(RequestError::Link(reason.clone())));
        }
        self.leave_link(&format!("the link is down: {reason}"));
        self.link_state = LinkState::Down { reason: Some(reason), attempts: attempts + 1 };
        let after = Duration::from_millis(500 << attempts.min(6)).min(Duration::from_secs(15));
        self.context.actions.push_back(Action::Reopen { after });
    }

    /// Nothing more can be asked, and why.
    fn leave_link(&mut self, reason: &str) {
        self.beat = None;
        self.fetches.clear();
        self.break_requests(reason);
        self.end_settling(&format!("written, but not read back: {reason}"));
        for device in &mut self.devices {
            device.lose(self.now, reason, &mut self.context);
        }
    }

    // What happened to a request.

    fn reply(&mut self, reply: Reply) {
        let Some(in_flight) = self.in_flight.take() else { return };
        self.counters.count_result(&reply.result);
        self.counters.count_discarded(reply.discarded);
        self.load.add(in_flight.sent_at.max(reply.sent_at), self.now);
        if let Some(device) = in_flight.device {
            self.devices[device].count(self.now, &reply);
            self.unanswered =
                if reply.result == Err(RequestError::Timeout) { self.unanswered + 1 } else { 0 };
        }
        self.look_for_others(&reply);
        let Some(in_flight) = self.repeat_collided(in_flight, &reply) else { return };
        self.request_ended(in_flight, reply.result);
        self.renew_silent_connection();
    }

    fn request_ended(&mut self, in_flight: InFlight, result: Result<Answer, RequestError>) {
        if let Purpose::Scan(call) = &in_flight.purpose {
            return self.scan_answered(call, in_flight.sent_at, &result);
        }
        let Some(index) = in_flight.device else { return };
        let device = &mut self.devices[index];
        match in_flight.purpose {
            Purpose::Identify => device.identified(self.now, result, &mut self.context),
            Purpose::Poll { read } => {
                let span = device.span_of(read);
                let awaited = !self.settling.is_empty();
                let words = result.as_ref().ok().filter(|_| awaited).map(command::words_of);
                device.polled(self.now, read, result, &mut self.context);
                if awaited {
                    self.poll_ended(index, span, words.as_deref());
                }
            }
            Purpose::Command => self.command_answered(result),
            Purpose::Fetch => self.fetched(result),
            Purpose::BeatRead(point) => {
                let call = device.beat_read(self.now, point, &result, &mut self.context);
                self.beat = call.map(|call| (index, point, call));
            }
            Purpose::BeatWrite(point) => {
                self.counters.writes += 1;
                device.beat_written(self.now, point, &result, &mut self.context);
            }
            Purpose::Request => self.request_answered(in_flight.sent_at, result),
            // Has been seen to.
            Purpose::Scan(_) => {}
        }
    }

    // What somebody wants.

    fn get(&mut self, device: &str, name: &str) {
        match self.find(device, name) {
            Some((device, Target::Point(point)))
                if self.devices[device].details(point).is_read_on_request() =>
            {
                self.fetch(device, point);
            }
            Some((device, Target::Point(point))) => self.devices[device].want(point),
            Some((device, Target::Thing(thing))) => self.devices[device].want_thing(thing),
            Some((_, Target::Setting(_))) | None => {}
        }
    }

    fn find(&self, device: &str, name: &str) -> Option<(usize, Target)> {
        let index = self.devices.iter().position(|state| state.name() == device)?;
        Some((index, self.devices[index].target_named(name)?))
    }

    /// A poll that waits for the line to be silent must not keep a command waiting for a whole turn.
    fn make_way(&mut self) {
        let gives_way = |in_flight: &InFlight| in_flight.gives_way;
        if self.in_flight.as_ref().is_some_and(gives_way) && self.command_can_begin() {
            self.context.actions.push_back(Action::Withdraw);
        }
    }

    fn withdrawn(&mut self) {
        let Some(in_flight) = self.in_flight.take() else { return };
        if let (Purpose::Poll { read }, Some(device), Some(before)) =
            (in_flight.purpose, in_flight.device, in_flight.before)
        {
            self.devices[device].take_back(read, before);
        }
    }

    // What to ask next.

    fn ask_next(&mut self) {
        while self.in_flight.is_none() && self.link_state == LinkState::Up {
            if let Some((device, point, call)) = self.beat.take() {
                self.send(device, call, Purpose::BeatWrite(point));
                continue;
            }
            if self.begin_overdue_read()
                || self.begin_beat(true)
                || self.feed(true)
                || self.begin_command()
                || self.begin_beat(false)
                || self.feed(false)
                || self.next_fetch()
                || self.begin_request()
                || self.begin_setting()
                || self.next_scan()
            {
                continue;
            }
            let now = self.now;
            let candidates = self.devices.iter().enumerate().filter(|(_, device)| self.may_ask(device));
            let urgent = candidates.filter_map(|(index, device)| {
                device.most_urgent(now).map(|(polled, urgency)| (index, polled, urgency, device.served_at()))
            });
            // Of two equally urgent ones, that which has waited longest.
            let next = urgent.reduce(|best, other| {
                let better = other.2 > best.2 || (other.2 == best.2 && other.3 < best.3);
                if better { other } else { best }
            });
            let read_before_setting = std::mem::take(&mut self.wrote_setting);
            let read_before_request = self.requests_go_on();
            let Some((device, polled, ..)) = next else {
                // Nothing is due: the next setting, or question of a request, need not wait for it.
                if read_before_setting || read_before_request {
                    continue;
                }
                return;
            };
            self.poll(device, polled);
        }
    }

    fn poll(&mut self, device: usize, polled: Polled) {
        let (call, purpose) = match polled {
            Polled::Identification(call) => (call, Purpose::Identify),
            Polled::Read(read, call) => (call, Purpose::Poll { read }),
        };
        self.send(device, call, purpose);
    }

    /// A read that is due, after [`AHEAD_OF_READS`] requests that went before it.
    fn begin_overdue_read(&mut self) -> bool {
        if self.ahead < AHEAD_OF_READS {
            return false;
        }
        self.ahead = 0;
        let now = self.now;
        let candidates = self.devices.iter().enumerate().filter(|(_, device)| self.may_ask(device));
        let overdue = candidates.filter_map(|(index, device)| {
            let (polled, waited) = device.longest_waiting(now)?;
            Some((index, polled, waited))
        });
        let longest = overdue.reduce(|best, other| if other.2 > best.2 { other } else { best });
        let Some((device, polled, _)) = longest else { return false };
        self.poll(device, polled);
        self.ahead = 0;
        self.in_flight.iter_mut().for_each(|in_flight| in_flight.gives_way = false);
        true
    }

    /// Begins a heartbeat that is due, or `late`: then the device is about to act on its absence.
    fn begin_beat(&mut self, late: bool) -> bool {
        if !self.feeds {
            return false;
        }
        let now = self.now;
        let mut devices = self.devices.iter().enumerate().filter(|(_, device)| self.may_ask(device));
        let due = devices.find_map(|(index, device)| Some((index, device.beat_due(now, late)?)));
        let Some((device, point)) = due else { return false };
        let call = Call::Read(self.devices[device].details(point).at.span);
        self.send(device, call, Purpose::BeatRead(point));
        true
    }

    /// Asks a device something whose watchdog wants to be fed. If it is `late`, no command goes before.
    fn feed(&mut self, late: bool) -> bool {
        if !self.feeds {
            return false;
        }
        let now = self.now;
        let mut devices = self.devices.iter().enumerate().filter(|(_, device)| self.may_ask(device));
        let due = devices.find_map(|(index, device)| Some((index, device.feed_due(now, late)?)));
        let Some((device, read)) = due else { return false };
        let ahead = self.ahead + 1;
        self.poll(device, self.devices[device].read_call(read));
        self.ahead = ahead;
        self.in_flight.iter_mut().for_each(|in_flight| in_flight.gives_way &= !late);
        true
    }

    /// Not a device that leaves. And one whose watchdog must run out is not spoken to while the broker is away.
    fn may_ask(&self, device: &DeviceState) -> bool {
        let is_to_be_fed =
            self.broker_up || self.on_broker_loss == OnBrokerLoss::Keep || !device.wants_feeding();
        is_to_be_fed && !device.is_leaving
    }

    /// What any device has.
    fn look_what_they_have(&mut self) {
        self.feeds = self.devices.iter().any(DeviceState::wants_feeding);
        self.has_settings = self.devices.iter().any(DeviceState::has_settings);
    }

    fn remember(&mut self) {
        for device in &mut self.devices {
            if let Some(record) = device.record(self.now, self.stopping) {
                self.context.actions.push_back(Action::Store(record));
            }
        }
        self.record_due_at = self.devices.iter().filter_map(DeviceState::record_due_at).min();
    }

    fn send(&mut self, device: usize, call: Call, purpose: Purpose) {
        let state = &mut self.devices[device];
        let before = match purpose {
            Purpose::Poll { read } => state.begin_read(read, self.now),
            _ => state.turn(),
        };
        let gives_way = matches!(purpose, Purpose::Poll { .. });
        match purpose {
            Purpose::Command | Purpose::Fetch | Purpose::BeatRead(_) => self.ahead += 1,
            Purpose::Poll { .. } if before.was_wanted() => self.ahead += 1,
            Purpose::Poll { .. } => self.ahead = 0,
            _ => {}
        }
        let timeout = state.timeout(self.response_timeout);
        let not_before = state.asked(self.now);
        let request = state.request(call);
        self.in_flight = Some(InFlight {
            device: Some(device),
            purpose,
            sent_at: not_before,
            before: Some(before),
            gives_way,
        });
        self.ask(request, not_before, timeout);
    }

    /// Asks a unit that is no device of this gateway.
    fn send_stranger(&mut self, request: Request, purpose: Purpose) {
        let (now, timeout) = (self.now, self.response_timeout);
        self.in_flight =
            Some(InFlight { device: None, purpose, sent_at: now, before: None, gives_way: false });
        self.ask(request, now, timeout);
    }
}

/// What a read costs, until a device's own latency is measured.
fn cost(link: &Link) -> Cost {
    Cost::of(link, Duration::from_millis(5))
}

/// The share of time in which the wire is busy: two buckets of a minute.
#[derive(Clone, Copy, Debug, Default)]
struct Load {
    minute: u64,
    busy: Duration,
    busy_before: Option<Duration>,
}

impl Load {
    const MINUTE: u64 = 60_000_000;

    fn add(&mut self, from: Time, until: Time) {
        let minute = until.0 / Load::MINUTE;
        if minute != self.minute {
            self.busy_before = Some(if minute == self.minute + 1 { self.busy } else { Duration::ZERO });
            (self.minute, self.busy) = (minute, Duration::ZERO);
        }
        self.busy += until - from;
    }

    /// 0 to 1, over the last whole minute; before there is one, since the start.
    fn share(&self, now: Time) -> f64 {
        let (busy, time) = match (self.busy_before, now.0 / Load::MINUTE) {
            (_, minute) if minute > self.minute + 1 => (Duration::ZERO, Duration::from_secs(60)),
            (_, minute) if minute == self.minute + 1 => (self.busy, Duration::from_secs(60)),
            (Some(before), _) => (before, Duration::from_secs(60)),
            (None, _) => (self.busy, now - Time::default()),
        };
        if time.is_zero() { 0.0 } else { (busy.as_secs_f64() / time.as_secs_f64()).min(1.0) }
    }
}
