//! One bus as a state machine: what happened goes in ([`Event`]), what to do comes out ([`Action`]).
//!
//! [`Bus::handle`] is the page to read first. One request is in flight at a time, and `in_flight` says what it is for.
//! When it has ended, `request_ended` gives the answer to whoever wanted it, and `ask_next` in `turns` chooses the next.

// Who is asked next.
mod devices;
mod probing;
mod turns;

// What people and programs want.
mod commands;
mod fetch;
mod inbox;
mod requests;
mod waiting;

// The link, and what is heard on it.
mod line;
mod link;
mod load;
mod pause;
mod recording;
mod timekeeping;

// The devices, and what they share.
mod change;
mod context;
mod device;

use std::collections::VecDeque;

use crate::engine::address::Span;
use crate::engine::command;
use crate::engine::device::PointIndex;
use crate::engine::health::{BusReport, Counters};
use crate::engine::memory::{Memories, Record};
use crate::engine::modbus::{Answer, Call, Reply, Request, RequestError};
use crate::engine::pace::Pace;
use crate::engine::plan::Tariff;
use crate::engine::recorder::Recording;
use crate::engine::request;
use crate::engine::settings::{DeviceSettings, Link, OnBrokerLoss, Rules, Settings};
use crate::engine::time::{Date, Duration, Time};
use crate::engine::topics::Message;

pub use crate::engine::arrivals::Command;
pub use crate::engine::health::Severity;
pub use commands::STOPPING;
use commands::{Active, Settling};
use context::Context;
pub use context::Telling;
use device::{DeviceState, Turn};
pub use device::{FAILURES_UNTIL_OFFLINE, LEFT_ALONE_LEAST};
use devices::Devices;
use fetch::Fetch;
pub use inbox::{Full, Inbox, ended_at_once};
use recording::Recorder;
pub use recording::Saved;
use requests::Requests;
use timekeeping::Timekeeping;
pub use turns::AHEAD_OF_READS;
use waiting::{Target, WaitingCommands};

/// What can happen to a bus.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// The port is open, the connection stands.
    LinkUp,
    /// The link could not be opened, or is lost, for this reason.
    LinkDown(String),
    /// The request of the last [`Action::Send`] has ended.
    Reply(Reply),
    /// Somebody wants a point or a thing to be something else.
    Command(Command),
    /// Read this point now, and tell it even if it has not changed.
    Get { device: String, point: String },
    /// A program asks something.
    Request(request::Request),
    /// The device of this name leaves the bus: [`Bus::has_device`].
    Retire(String),
    /// Devices come to the bus, with what is remembered of them.
    Adopt(Vec<DeviceSettings>, Memories),
    /// What holds for every bus is from now on this.
    Rules(Rules),
    /// Everything is told there and so from now on, and what is known at once: [`Bus::tells_as`].
    Telling(Telling),
    /// The request of the last [`Action::Send`] was taken back before it was on the wire.
    Withdrawn,
    /// The recording of an [`Action::Record`] is in a file, or why not.
    Recorded(Option<request::Request>, Result<Saved, String>),
    /// The broker is there again. A bus takes it to be there when it begins.
    BrokerUp,
    /// Nobody hears what is told: see [`OnBrokerLoss`].
    BrokerDown,
    /// The time of [`Bus::wake_at`] has come.
    Wake,
    /// Finish the request in flight, refuse what waits, say `offline`.
    Shutdown,
}

/// What is to be done.
#[derive(Clone, Debug, PartialEq)]
pub enum Action {
    /// Ask the line. Exactly one request is in flight: the next `Send` comes after its reply.
    Send { request: Request, not_before: Time, timeout: Duration },
    /// If the last request is not on the wire yet, take it back and say [`Event::Withdrawn`].
    Withdraw,
    /// For the broker, in this order.
    Publish(Message),
    /// Keep this for the next start.
    Store(Record),
    /// Make a file of this, and say [`Event::Recorded`] with the request that asked for it.
    Record {
        recording: Box<Recording>,
        request: Option<request::Request>,
        /// So many files of this bus; an older one goes.
        keep: usize,
    },
    /// Close the link, if it is open, and open it after this long. The first action of all.
    Reopen { after: Duration },
    /// A line for the log: said once when something breaks and once when it heals.
    Say(Severity, String),
}

/// So many actions find room that no memory is asked for.
const ACTIONS_KEPT: usize = 16;

/// One serial line or TCP connection, and the devices on it.
pub struct Bus {
    name: String,
    link: Link,
    /// Silence before each request; `None`: the line's own.
    gap: Option<Duration>,
    response_timeout: Duration,
    rules: Rules,
    context: Context,
    devices: Devices,
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
    /// Requests in a row that went before reads that were due, because they were wanted at once.
    ahead: u32,
    /// Heartbeats and feedings of watchdogs in a row.
    fed_in_a_row: u32,
    pace: Pace,
    /// Before, who has left something unanswered goes behind all others.
    doubtful_from: Time,
    link_state: LinkState,
    connection: link::Connection,
    /// A device on this link needs silence behind a connect: nothing is asked before.
    silent_until: Time,
    /// Requests in a row that no device on this link answered.
    unanswered: u32,
    broker_up: bool,
    counters: Counters,
    times: Timekeeping,
    line: line::Line,
    stopping: bool,
    recorder: Recorder,
    /// When something is to be stored next.
    record_due_at: Option<Time>,
    /// Whether any device has heartbeats or a watchdog, and settings. Most have none, and with many devices looking for
    /// them costs more than everything else.
    feeds: bool,
    has_settings: bool,
    is_anyone_leaving: bool,
    now: Time,
}

#[derive(Clone, Debug, PartialEq)]
enum LinkState {
    Up,
    /// Being closed and opened again, because nothing answers on it or the other side has closed it.
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

/// The request on the wire, and whom its answer concerns.
struct InFlight {
    /// `None`: a unit that is no device of this gateway.
    device: Option<usize>,
    purpose: Purpose,
    sent_at: Time,
    /// When it was decided on.
    decided_at: Time,
    /// What it reads, if it does.
    reads: Option<Span>,
    /// When the command came of which this is the first request.
    commanded_at: Option<Time>,
    /// What the device's turn was before, in case this is taken back.
    before: Option<Turn>,
    /// Somebody wants it at once, while others wait for their turn.
    out_of_turn: bool,
    /// Who may take its turn while it is not on the wire.
    gives_way: GivesWay,
}

/// To whom a request gives way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum GivesWay {
    Nobody,
    Commands,
    /// And commands, as any poll.
    Feeding,
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
    Scan,
}

impl Bus {
    /// The bus number `index` of `settings`, with the devices that are on it and what is remembered
    /// of them.
    pub fn new(now: Time, settings: &Settings, index: usize, memories: &Memories) -> Bus {
        let bus = &settings.buses[index];
        let mut context = Context::new(settings, &bus.name);
        let tariff = Tariff::of(&bus.link, bus.gap);
        let of_bus = || settings.devices.iter().filter(|device| device.bus == index);
        let rests = tariff.idle_rests(&of_bus().map(|device| &*device.device).collect::<Vec<_>>());
        let mut devices: Vec<DeviceState> = of_bus()
            .zip(rests)
            .map(|(device, rest)| DeviceState::new(device.clone(), tariff, rest, settings.eeprom))
            .collect();
        let mut counters = Counters::default();
        for device in &mut devices {
            counters.persistent_writes += device.recall(now, memories);
            device.introduce(now, &mut context);
        }
        let record_due_at = devices.iter().filter_map(DeviceState::record_due_at).min();
        let feeds = devices.iter().any(DeviceState::wants_feeding);
        let has_settings = devices.iter().any(DeviceState::has_settings);
        Bus {
            name: bus.name.clone(),
            link: bus.link.clone(),
            gap: bus.gap,
            response_timeout: bus.response_timeout,
            rules: settings.rules(),
            context,
            devices: devices.into(),
            waiting: WaitingCommands::default(),
            active: None,
            settling: Vec::new(),
            beat: None,
            fetches: VecDeque::new(),
            requests: Requests::default(),
            wrote_setting: false,
            in_flight: None,
            ahead: 0,
            fed_in_a_row: 0,
            pace: Pace::default(),
            link_state: LinkState::Down { reason: None, attempts: 0 },
            connection: link::Connection::default(),
            silent_until: now,
            doubtful_from: now,
            unanswered: 0,
            broker_up: true,
            counters,
            times: Timekeeping::default(),
            line: line::Line::default(),
            stopping: false,
            recorder: Recorder::new(settings.recorder),
            record_due_at,
            feeds,
            has_settings,
            is_anyone_leaving: false,
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
            Event::Rules(rules) => self.change_rules(rules),
            Event::Telling(telling) => self.change_telling(telling),
            Event::Recorded(request, result) => self.recorded(request, result),
            Event::BrokerUp => {
                self.broker_up = true;
                self.devices.iter_mut().for_each(DeviceState::forget_retained);
            }
            Event::BrokerDown => self.broker_up = false,
            Event::Wake => self.make_way(),
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
        if self.context.telling.json {
            self.devices.iter_mut().for_each(|device| device.tell_whole(now, &mut self.context));
        }
        self.remember();
        self.save_trouble();
    }

    /// Says what date it is, for texts: nothing is decided by it, and it may jump.
    pub fn set_date(&mut self, now: Time, date: Date) {
        self.context.date = Some((now, date));
    }

    /// Takes the next thing to do, until there is none.
    pub fn next_action(&mut self) -> Option<Action> {
        let action = self.context.actions.pop_front();
        if action.is_none() {
            // At the start every value was in it at once.
            self.context.actions.shrink_to(ACTIONS_KEPT);
        }
        action
    }

    /// When to call `handle(now, Event::Wake)` if nothing else happens before. While a request is in
    /// flight its reply is what happens next.
    pub fn wake_at(&self) -> Option<Time> {
        let whatever_the_line_does = self.due_without_line();
        if self.in_flight.is_some() || self.link_state != LinkState::Up || self.stopping {
            return whatever_the_line_does.chain(self.makes_way_at()).min();
        }
        if self.now < self.silent_until {
            return whatever_the_line_does.chain([self.silent_until]).min();
        }
        let at = self.pace.at(self.now);
        let of_devices = self.askable().filter_map(|(_, device)| device.due_at(at));
        let spared =
            self.waiting.iter().map(|waiting| self.devices[waiting.device].writable_at(waiting.target));
        let settings = self.devices.iter().filter_map(DeviceState::next_setting_at);
        let beats = self.askable().filter_map(|(_, device)| device.beats_at());
        whatever_the_line_does
            .chain(of_devices)
            .chain(spared.chain(settings).filter(|at| *at > self.now))
            .chain(self.settled_at())
            .chain(self.requests_wake_at())
            .chain(beats)
            .min()
    }

    /// When something is to be stored or told, or has waited for too long.
    fn due_without_line(&self) -> impl Iterator<Item = Time> {
        let in_one_message: &[DeviceState] = if self.context.telling.json { &self.devices } else { &[] };
        let wholes = in_one_message.iter().filter_map(DeviceState::whole_due_at);
        let records = self.record_due_at.into_iter().chain(self.recorder.due_at());
        let expiring = self.waiting.next_deadline().into_iter().chain(self.requests_expire_at());
        records.chain(wholes).chain(expiring)
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

    /// The same for `/metrics`: each device's readings as numbers, and no points.
    pub fn readings(&self, now: Time) -> BusReport {
        let mut report = self.summary(now);
        for (told, device) in report.devices.iter_mut().zip(&self.devices) {
            told.readings = device.readings(now);
        }
        report
    }

    /// The same without points and readings, which are most of it.
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
            load: self.times.load(now),
            timing: self.times.report(now),
            devices: self.devices.iter().map(|device| device.summary(now)).collect(),
        }
    }

    // What happened to a request.

    /// The request on the wire has ended: counts what is to be learnt about the line, and then sees to the answer.
    fn reply(&mut self, reply: Reply) {
        let Some(in_flight) = self.in_flight.take() else { return };
        self.record_reply(in_flight.device, &reply);
        self.counters.count_result(&reply.result);
        self.counters.count_discarded(reply.discarded);
        self.keep_time(&in_flight, &reply);
        if let Some(device) = in_flight.device {
            self.devices[device].count(self.now, &reply, in_flight.reads.is_some());
            self.unanswered =
                if reply.result == Err(RequestError::Timeout) { self.unanswered + 1 } else { 0 };
        }
        self.count_late(in_flight.device, reply.discarded);
        if matches!(reply.result, Ok(_) | Err(RequestError::Exception(_) | RequestError::Unreachable(_))) {
            self.connection.answered(self.now);
        }
        self.look_for_others(&reply);
        self.look_for_signs(in_flight.device, &reply);
        let silence = in_flight.device.zip(self.silence_behind(&reply));
        let Some(in_flight) = self.repeat_collided(in_flight, &reply) else { return };
        self.count_turn(&in_flight, &reply);
        let took = self.now - in_flight.decided_at;
        // Before anything more is asked on it.
        self.renew_used_connection(&reply.result);
        self.renew_silent_connection();
        self.request_ended(in_flight, reply.result);
        if let Some((device, silence)) = silence {
            self.keep_silence(device, &silence);
        }
        self.put_doubtful_off(took);
    }

    /// Gives the answer to whoever wanted it.
    fn request_ended(&mut self, in_flight: InFlight, result: Result<Answer, RequestError>) {
        if matches!(in_flight.purpose, Purpose::Scan) {
            return self.scan_answered(in_flight.sent_at, &result);
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
            Purpose::Scan => {}
        }
    }

    // What somebody wants.

    /// Somebody wants to be told a point or a thing.
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

    /// The number of a device, and what of it has this name.
    fn find(&self, device: &str, name: &str) -> Option<(usize, Target)> {
        let index = self.devices.iter().position(|state| state.name() == device)?;
        Some((index, self.devices[index].target_named(name)?))
    }

    /// Lets devices store what is to outlive a restart, when it is time or the bus ends.
    fn remember(&mut self) {
        let is_due = self.record_due_at.is_some_and(|due| self.now >= due);
        if !std::mem::take(&mut self.context.has_to_remember) && !is_due && !self.stopping {
            return;
        }
        for device in &mut self.devices {
            if let Some(record) = device.record(self.now, self.stopping) {
                self.context.actions.push_back(Action::Store(record));
            }
        }
        self.record_due_at = self.devices.iter().filter_map(DeviceState::record_due_at).min();
    }
}
