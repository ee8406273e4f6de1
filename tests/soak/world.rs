//! A bus, its guard and a line of simulated devices, joined without threads, ports and clocks: an hour
//! passes as fast as it can be calculated.

use std::collections::{BTreeMap, BTreeSet};

use busker::engine::bus::{Action, Bus, Event};
use busker::engine::health::BusReport;
use busker::engine::memory::Memories;
use busker::engine::modbus::guard::Guard;
use busker::engine::modbus::{Reply, RequestError};
use busker::engine::settings::{Link, Settings};
use busker::engine::time::{Duration, Time};
use busker::engine::topics::Message;
use busker::simulator::device::{Place, SimulatedDevice};
use busker::simulator::line::{Line, Transmission};
use busker::simulator::wire::{Receiver, character_time};
use busker::simulator::{Framing, LineSettings, script};

pub struct World {
    pub now: Time,
    pub line: Line,
    framing: Framing,
    settings: Settings,
    bus: Bus,
    guard: Guard,
    port: Port,
    /// The request that is to be sent, and not before when.
    to_send: Option<Time>,
    receiver: Receiver,
    /// What is on its way to the gateway, and which unit sends it.
    coming: Vec<(Option<u8>, Transmission)>,
    /// The unit that was asked last.
    asked: u8,
    /// When each unit was last asked something.
    asked_at: [Time; 256],
    /// When each unit's last reply has come, or will.
    answered_at: [Time; 256],
    pub published: Vec<Published>,
    /// What was on the line, to look at when something is wrong.
    frames: Vec<(Time, u8, String)>,
    /// So often two spoke at the same time.
    pub collisions: u32,
    /// What befell a device, of whichever kind.
    pub faults: BTreeSet<String>,
    /// What spoils characters again and again, for ever.
    pub disturbance: Option<Disturbance>,
    /// So many requests have been sent since there was one.
    disturbed_requests: u32,
    /// What was stored for the next start.
    pub memories: Memories,
}

/// A disturbance that comes at a fixed period.
#[derive(Clone, Copy, Debug)]
pub enum Disturbance {
    /// Each so-manieth request on the line, whoever is asked.
    Request(u32),
    /// Once in each `period`, whatever is on the line for so long.
    Time { period: Duration, lasts: Duration },
}

impl Disturbance {
    /// Whether it meets characters that are on the line from `from` to `to`.
    fn meets(&self, from: Time, to: Time) -> bool {
        match self {
            Disturbance::Request(_) => false,
            Disturbance::Time { period, lasts } => {
                let (period, lasts) = (period.as_micros() as u64, lasts.as_micros() as u64);
                from.0 % period < lasts || from.0 / period != to.0 / period
            }
        }
    }
}

/// A message, and since when what it says may be true: since the request was sent that it answers.
pub struct Published {
    pub message: Message,
    pub at: Time,
    pub asked_at: [Time; 256],
}

/// What the line makes of characters that meet others.
fn spoil(bytes: &mut [u8]) {
    bytes.iter_mut().enumerate().for_each(|(index, byte)| *byte ^= 0x5A ^ (index as u8).wrapping_mul(29));
}

enum Port {
    Open,
    /// Nobody has asked for it.
    Closed,
    OpensAt(Time),
}

impl World {
    /// A usual line, with the device that `simulated` makes for each unit.
    pub fn with_devices(
        settings: Settings,
        mut simulated: impl FnMut(u8) -> Box<dyn SimulatedDevice>,
    ) -> World {
        let turnaround = Duration::from_millis(5);
        let mut line = Line::new(Time(0), LineSettings::default(), turnaround, true, &[]).expect("a line");
        for device in &settings.devices {
            let at = Place { unit: device.unit, device: device.name.clone() };
            line.add(at, simulated(device.unit)).expect("a unit of its own");
        }
        World::new(settings, line)
    }

    pub fn new(settings: Settings, line: Line) -> World {
        let now = Time(0);
        let framing = match &settings.buses[0].link {
            Link::Tcp { .. } => Framing::Tcp,
            Link::Serial { .. } | Link::RtuOverTcp { .. } => Framing::Rtu,
        };
        World {
            now,
            receiver: Receiver::new(framing, line.settings()),
            framing,
            line,
            bus: Bus::new(now, &settings, 0, &Memories::default()),
            guard: Guard::new(&settings.buses[0].link, None),
            settings,
            port: Port::OpensAt(now),
            to_send: None,
            coming: Vec::new(),
            asked: 0,
            asked_at: [now; 256],
            answered_at: [now; 256],
            published: Vec::new(),
            frames: Vec::new(),
            collisions: 0,
            faults: BTreeSet::new(),
            disturbance: None,
            disturbed_requests: 0,
            memories: Memories::default(),
        }
    }

    /// Hands the bus an event from outside.
    pub fn tell(&mut self, event: Event) {
        self.bus.handle(self.now, event);
        self.perform();
    }

    /// The gateway ends, and begins again with what it has stored.
    pub fn restart(&mut self) {
        self.tell(Event::Shutdown);
        while !self.bus.is_finished() {
            self.now = self.next_time().max(self.now);
            self.step();
        }
        self.close(self.now);
        self.bus = Bus::new(self.now, &self.settings, 0, &self.memories);
        self.perform();
    }

    pub fn report(&self) -> BusReport {
        self.bus.summary(self.now)
    }

    pub fn has_device(&self, name: &str) -> bool {
        self.bus.has_device(name)
    }

    /// The adapter is pulled out; the gateway may try to open it again, and can after `away`.
    pub fn unplug(&mut self, away: Duration) {
        if matches!(self.port, Port::Open) {
            self.close(self.now + away);
            self.tell(Event::LinkDown("unplugged".into()));
            self.port = Port::OpensAt(self.now + away);
        }
    }

    /// What happens to a device takes the replies with it that it still owes.
    pub fn act(&mut self, unit: u8, action: &script::Action) {
        self.line.act(self.now, action).expect("a unit of the line");
        self.coming.retain(|(sender, _)| *sender != Some(unit));
    }

    /// From now on the device does something that it should not.
    pub fn fault(&mut self, unit: u8, fault: &str) {
        self.faults.insert(fault.into());
        let fault = format!("unit={unit},{fault}").parse().expect("a fault");
        self.act(unit, &script::Action::Fault(fault));
    }

    /// Bytes that nobody sent come to the gateway.
    pub fn disturb(&mut self, bytes: Vec<u8>) {
        self.coming.push((None, Transmission { at: self.now, bytes }));
    }

    /// What was said to `unit` and by it in the twelve seconds before `at`.
    pub fn heard_before(&self, at: Time, unit: u8) -> String {
        let from = Time(at.0.saturating_sub(12_000_000));
        let frames = self.frames.iter().filter(|(time, who, _)| *who == unit && (from..=at).contains(time));
        frames.map(|(_, _, frame)| format!("\n{frame}")).collect()
    }

    /// What was said on the whole line in the 24 seconds before `at`.
    pub fn all_heard_before(&self, at: Time) -> String {
        let from = Time(at.0.saturating_sub(24_000_000));
        let frames = self.frames.iter().filter(|(time, ..)| (from..=at).contains(time));
        frames.map(|(_, who, frame)| format!("\n{who} {frame}")).collect()
    }

    /// All requests so far: when each was sent, and to which unit.
    pub fn requests(&self) -> Vec<(Time, u8)> {
        let requests = self.frames.iter().filter(|(.., frame)| frame.contains(" -> "));
        requests.map(|(at, unit, _)| (*at, *unit)).collect()
    }

    pub fn answers(&self) -> u64 {
        self.bus.summary(self.now).counters.answers
    }

    pub fn late_replies(&self) -> u64 {
        self.bus.summary(self.now).counters.late_replies
    }

    /// Lets time pass until `end`.
    pub fn run_until(&mut self, end: Time) {
        let mut steps_in_place = 0;
        loop {
            let next = self.next_time().max(self.now);
            if next > end {
                self.now = end;
                return;
            }
            steps_in_place = if next == self.now { steps_in_place + 1 } else { 0 };
            assert!(steps_in_place < 1000, "no time passes any more at {}", self.now);
            self.now = next;
            self.step();
        }
    }

    fn next_time(&self) -> Time {
        let port = match self.port {
            Port::OpensAt(at) => Some(at),
            Port::Open | Port::Closed => None,
        };
        let send = self.to_send.map(|not_before| not_before.max(self.guard.earliest_send(self.now)));
        let coming = self.coming.iter().map(|(_, transmission)| transmission.at).min();
        // The silence is no whole number of microseconds.
        let silent = self.receiver.deadline().map(|at| at + Duration::from_micros(1));
        let times = [port, send.or(self.guard.wake_at()), coming, silent, self.bus.wake_at()];
        // Of a bus without devices nothing is ever to come.
        times.into_iter().flatten().min().unwrap_or(Time(u64::MAX))
    }

    /// Does what is due, in the order of the program's own loop.
    fn step(&mut self) {
        let now = self.now;
        self.listen();
        if matches!(self.port, Port::OpensAt(at) if at <= now) {
            self.port = Port::Open;
            self.tell(Event::LinkUp);
        }
        self.coming.sort_by_key(|(_, transmission)| transmission.at);
        while self.coming.first().is_some_and(|(_, transmission)| transmission.at <= now) {
            let (sender, mut transmission) = self.coming.remove(0);
            if self.is_disturbed(now, transmission.bytes.len()) {
                spoil(&mut transmission.bytes);
            }
            let frame = format!("{now} <- {:02X?}", transmission.bytes);
            self.frames.push((now, sender.unwrap_or(0), frame));
            if matches!(self.port, Port::Open) {
                let reply = self.guard.received(now, &transmission.bytes);
                self.answered(reply);
            }
        }
        match self.to_send {
            Some(not_before) if now >= not_before.max(self.guard.earliest_send(now)) => {
                self.to_send = None;
                let mut heard = self.guard.frame().to_vec();
                let over_at = now + character_time(self.line.settings()) * heard.len() as u32;
                let is_met = self.framing == Framing::Rtu && self.meets_another(None, over_at, heard.len());
                if is_met || self.is_request_disturbed() || self.is_disturbed(over_at, heard.len()) {
                    spoil(&mut heard);
                }
                self.receiver.push(now, &heard);
                self.asked = self.guard.frame()[if self.framing == Framing::Rtu { 0 } else { 6 }];
                self.asked_at[usize::from(self.asked)] = now;
                let frame = format!("{now} -> {:02X?}", self.guard.frame());
                self.frames.push((now, self.asked, frame));
                self.guard.sent(now);
                if self.framing == Framing::Tcp {
                    self.listen();
                }
            }
            Some(_) => {}
            None if self.guard.wake_at().is_some_and(|at| at <= now) => {
                let reply = self.guard.wake(now);
                self.answered(reply);
            }
            None => {}
        }
        if self.bus.wake_at().is_some_and(|at| at <= now) {
            self.tell(Event::Wake);
        }
    }

    /// Hands the devices the request that has come whole.
    fn listen(&mut self) {
        if let Some(received) = self.receiver.next(self.now) {
            let answers = self.line.hear(self.now, self.framing, &received, None);
            self.owe(answers);
        }
    }

    /// The unit that was asked sends this.
    fn owe(&mut self, mut answers: Vec<Transmission>) {
        // A device that is late does one thing after the other: nothing overtakes.
        let unit = usize::from(self.asked);
        for answer in &mut answers {
            answer.at = answer.at.max(self.answered_at[unit] + Duration::from_millis(1));
            self.answered_at[unit] = answer.at;
        }
        match self.framing {
            Framing::Rtu => {
                for answer in &mut answers {
                    if self.meets_another(Some(self.asked), answer.at, answer.bytes.len()) {
                        spoil(&mut answer.bytes);
                    }
                }
            }
            Framing::Tcp => self.put_behind_others(&mut answers),
        }
        self.coming.extend(answers.into_iter().map(|answer| (Some(self.asked), answer)));
    }

    /// In a stream a frame that comes in pieces has no other one between them.
    fn put_behind_others(&mut self, answers: &mut [Transmission]) {
        while let (Some(first), Some(last)) = (answers.first(), answers.last()) {
            let (begin, end) = (first.at, last.at);
            let of_others = self.coming.iter().filter(|(sender, _)| *sender != Some(self.asked));
            let mut others: BTreeMap<Option<u8>, (Time, Time)> = BTreeMap::new();
            for (sender, coming) in of_others {
                let (from, to) = others.entry(*sender).or_insert((coming.at, coming.at));
                (*from, *to) = ((*from).min(coming.at), (*to).max(coming.at));
            }
            let Some((_, until)) = others.into_values().find(|(from, to)| *from <= end && begin <= *to)
            else {
                return;
            };
            let later = until + Duration::from_micros(1) - begin;
            answers.iter_mut().for_each(|answer| answer.at += later);
            self.answered_at[usize::from(self.asked)] = end + later;
        }
    }

    /// Whether `count` characters that are over at `at` are on the line together with those of another unit,
    /// which are spoilt by it.
    fn meets_another(&mut self, sender: Option<u8>, at: Time, count: usize) -> bool {
        let character = character_time(self.line.settings());
        let begins = |at: Time, count: usize| Time(at.0 - (character * count as u32).as_micros() as u64);
        let mut is_met = false;
        for (other, coming) in &mut self.coming {
            let is_other = other.is_some() && *other != sender;
            let length = coming.bytes.len();
            if is_other && begins(at, count) < coming.at && begins(coming.at, length) < at {
                spoil(&mut coming.bytes);
                is_met = true;
            }
        }
        self.collisions += u32::from(is_met);
        is_met
    }

    /// Whether the request that is sent now is one of those which are spoilt by their number.
    fn is_request_disturbed(&mut self) -> bool {
        let Some(Disturbance::Request(every)) = self.disturbance else { return false };
        self.disturbed_requests += 1;
        self.disturbed_requests % every == 0
    }

    /// Whether a disturbance meets `count` characters that are over at `at`.
    fn is_disturbed(&self, at: Time, count: usize) -> bool {
        let length = (character_time(self.line.settings()) * count as u32).as_micros() as u64;
        self.disturbance.is_some_and(|disturbance| disturbance.meets(Time(at.0.saturating_sub(length)), at))
    }

    fn answered(&mut self, reply: Option<Reply>) {
        if let Some(reply) = reply {
            self.hand_over(reply);
            self.perform();
        }
    }

    fn hand_over(&mut self, reply: Reply) {
        match reply.result {
            // No reply but the link's end.
            Err(RequestError::Link(reason)) => {
                self.close(self.now);
                self.port = Port::Closed;
                self.bus.handle(self.now, Event::LinkDown(reason));
            }
            _ => self.bus.handle(self.now, Event::Reply(reply)),
        }
    }

    fn perform(&mut self) {
        while let Some(action) = self.bus.next_action() {
            match action {
                Action::Send { .. } if !matches!(self.port, Port::Open) => {
                    self.bus.handle(self.now, Event::LinkDown("the link is not open".into()));
                }
                Action::Send { request, not_before, timeout } => {
                    match self.guard.begin(self.now, &request, timeout) {
                        Some(reply) => self.hand_over(reply),
                        None => self.to_send = Some(not_before),
                    }
                }
                Action::Withdraw => {
                    if self.to_send.take().is_some() {
                        self.bus.handle(self.now, Event::Withdrawn);
                    }
                }
                Action::Publish(message) => {
                    self.published.push(Published { message, at: self.now, asked_at: self.asked_at });
                }
                Action::Reopen { after } => {
                    self.close(self.now + after);
                }
                Action::Store(record) => {
                    self.memories.devices.insert(record.device, record.memory);
                }
                Action::Record { .. } | Action::Say(..) => {}
            }
        }
    }

    fn close(&mut self, until: Time) {
        self.port = Port::OpensAt(until);
        self.guard = Guard::new(&self.settings.buses[0].link, None);
        self.to_send = None;
        self.coming.clear();
    }
}
