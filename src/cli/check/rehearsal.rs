//! The running program's own bus, with its guard, on simulated time: on a wire that charges what a wire charges,
//! with devices that are nothing but their profiles.
//!
//! Nothing here decides anything. Whatever the program does with this configuration it does here too, as long as
//! its devices hold what they are thought to hold: what `settings` want, and else what the factory set.

use std::collections::{BTreeMap, VecDeque};

use crate::engine::bus::{Action, Bus, Event};
use crate::engine::device::{Device, PointIndex};
use crate::engine::memory::Memories;
use crate::engine::modbus::guard::Guard;
use crate::engine::modbus::{Call, Reply, Request, RequestError};
use crate::engine::settings::{DeviceSettings, Settings};
use crate::engine::time::{Duration, Time};
use crate::simulator::Plain;
use crate::simulator::device::{Addressed, SimulatedDevice};
use crate::simulator::wire::{Frame, Framing};

/// A bus that lives as long as it is let, and what it has asked.
pub struct Rehearsal<'a> {
    pub now: Time,
    settings: &'a Settings,
    index: usize,
    turnaround: Duration,
    bus: Bus,
    guard: Guard,
    link: Link,
    players: Vec<Player>,
    /// Requests of every kind that were on the wire, the oldest first; whoever looks at them takes them away.
    pub asked: Vec<Asked>,
    /// For how long the wire could do nothing else.
    pub busy: Duration,
    busy_until: Time,
}

/// An answer comes in pieces that take no longer: of a long one the end may come after the response timeout.
const PIECE: Duration = Duration::from_millis(50);

/// What is under way.
#[derive(Default)]
struct Link {
    opens_at: Option<Time>,
    /// The request that waits for the line: what it is, and when it was decided on.
    to_send: Option<(Request, Time)>,
    /// Not before.
    not_before: Time,
    decided_at: Time,
    sent_at: Time,
    /// What comes of the answer, piece by piece.
    answer: VecDeque<(Time, Vec<u8>)>,
}

/// A request on the wire.
#[derive(Clone, Debug)]
pub struct Asked {
    pub at: Time,
    pub unit: u8,
    pub call: Call,
}

/// One device, and what it has answered to reads since something was written to it.
struct Player {
    unit: u8,
    device: Plain,
    answers: BTreeMap<Vec<u8>, Vec<u8>>,
}

impl<'a> Rehearsal<'a> {
    /// The bus of this number, and its devices, which take `turnaround` to begin their answers: on Modbus TCP until
    /// these are there.
    pub fn new(settings: &'a Settings, index: usize, turnaround: Duration) -> Rehearsal<'a> {
        let bus = &settings.buses[index];
        let player = |device: &DeviceSettings| Player {
            unit: device.unit,
            device: Plain::new(as_it_is_thought_to_be(device)),
            answers: BTreeMap::new(),
        };
        let mut rehearsal = Rehearsal {
            now: Time(0),
            settings,
            index,
            turnaround,
            bus: Bus::new(Time(0), settings, index, &Memories::default()),
            guard: Guard::new(&bus.link, bus.gap),
            link: Link::default(),
            players: settings.devices.iter().filter(|device| device.bus == index).map(player).collect(),
            asked: Vec::new(),
            busy: Duration::ZERO,
            busy_until: Time(0),
        };
        rehearsal.perform();
        rehearsal
    }

    /// Until the next request has been on the wire, or until then.
    pub fn step_until(&mut self, end: Time) {
        let before = self.asked.len();
        while self.asked.len() == before && self.now < end {
            let next = self.next_time().max(self.now);
            self.now = next.min(end);
            if next <= end {
                self.step();
            }
        }
    }

    fn next_time(&self) -> Time {
        let link = &self.link;
        let send = link.to_send.as_ref().map(|_| link.not_before.max(self.guard.earliest_send(self.now)));
        let answer = link.answer.front().map(|(at, _)| *at);
        let times = [link.opens_at, send.or(self.guard.wake_at()), answer, self.bus.wake_at()];
        times.into_iter().flatten().min().unwrap_or(Time(u64::MAX))
    }

    /// Does what is due, in the order of the program's own loop.
    fn step(&mut self) {
        let now = self.now;
        if self.link.opens_at.is_some_and(|at| at <= now) {
            self.link.opens_at = None;
            self.tell(Event::LinkUp);
        }
        let is_heard = self.link.answer.front().is_some_and(|(at, _)| *at <= now);
        let heard = if is_heard { self.link.answer.pop_front() } else { None };
        if let Some((_, bytes)) = heard {
            let reply = self.guard.received(now, &bytes);
            self.replied(reply);
        }
        let earliest = self.link.not_before.max(self.guard.earliest_send(now));
        if self.link.to_send.is_none() {
            if self.guard.wake_at().is_some_and(|at| at <= now) {
                let reply = self.guard.wake(now);
                self.replied(reply);
            }
        } else if now >= earliest {
            self.send();
        }
        if self.bus.wake_at().is_some_and(|at| at <= now) {
            self.tell(Event::Wake);
        }
    }

    fn send(&mut self) {
        let Some((Request { unit, call, .. }, decided_at)) = self.link.to_send.take() else { return };
        (self.link.decided_at, self.link.sent_at) = (decided_at, self.now);
        self.answer();
        self.asked.push(Asked { at: self.now, unit, call });
        self.guard.sent(self.now);
    }

    /// What the unit says to the frame that is being sent, and when it has been said.
    fn answer(&mut self) {
        let frame = self.guard.frame();
        let (framing, transaction, unit, pdu) = match &self.guard {
            Guard::Rtu(_) => (Framing::Rtu, 0, frame[0], &frame[1..frame.len() - 2]),
            Guard::Tcp(_) => (Framing::Tcp, u16::from_be_bytes([frame[0], frame[1]]), frame[6], &frame[7..]),
        };
        let Some(player) = self.players.iter_mut().find(|player| player.unit == unit) else { return };
        let Some(pdu) = player.answer(self.now, pdu) else { return };
        let asked = frame.len();
        let answer = Frame { transaction, unit, pdu }.encode(framing);
        let line = self.settings.buses[self.index].link.line();
        let on_wire = |bytes: usize| line.map_or(Duration::ZERO, |line| line.characters(bytes as u32));
        let begins = self.now + self.turnaround;
        let most = (PIECE.as_micros() / on_wire(1).as_micros().max(1)).max(1) as usize;
        let mut on_its_way = asked;
        for piece in answer.chunks(most) {
            on_its_way += piece.len();
            self.link.answer.push_back((begins + on_wire(on_its_way), piece.to_vec()));
        }
    }

    fn replied(&mut self, reply: Option<Reply>) {
        let Some(reply) = reply else { return };
        if let Err(RequestError::Link(reason)) = reply.result {
            self.close(Duration::ZERO);
            return self.tell(Event::LinkDown(reason));
        }
        // The silence before a request is taken by it, also where the line had long been silent.
        let bus = &self.settings.buses[self.index];
        let gap = bus.link.line().map_or(Duration::ZERO, |line| bus.gap.unwrap_or_else(|| line.frame_gap()));
        let silent_from = self.link.sent_at.before(gap);
        let busy_from = self.link.decided_at.min(silent_from).max(self.busy_until);
        self.busy += self.now - busy_from;
        self.busy_until = self.now;
        self.tell(Event::Reply(reply));
    }

    fn tell(&mut self, event: Event) {
        self.bus.handle(self.now, event);
        self.perform();
    }

    fn perform(&mut self) {
        while let Some(action) = self.bus.next_action() {
            match action {
                Action::Send { request, not_before, timeout } => {
                    match self.guard.begin(self.now, &request, timeout) {
                        Some(reply) => self.bus.handle(self.now, Event::Reply(reply)),
                        None => {
                            self.link.to_send = Some((request, self.now));
                            self.link.not_before = not_before;
                        }
                    }
                }
                Action::Withdraw => {
                    if self.link.to_send.take().is_some() {
                        self.bus.handle(self.now, Event::Withdrawn);
                    }
                }
                Action::Reopen { after } => self.close(after),
                Action::Publish(_) | Action::Store(_) | Action::Record { .. } | Action::Say(..) => {}
            }
        }
    }

    fn close(&mut self, after: Duration) {
        let bus = &self.settings.buses[self.index];
        self.guard = Guard::new(&bus.link, bus.gap);
        self.link = Link { opens_at: Some(self.now + after), ..Link::default() };
    }
}

impl Player {
    fn answer(&mut self, now: Time, pdu: &[u8]) -> Option<Vec<u8>> {
        if let Some(answer) = self.answers.get(pdu) {
            return Some(answer.clone());
        }
        let answer = self.device.request(now, Addressed::Unit, pdu)?;
        match pdu.first() {
            Some(1..=4) => _ = self.answers.insert(pdu.to_vec(), answer.clone()),
            _ => self.answers.clear(),
        }
        Some(answer)
    }
}

/// Fresh from the factory, but for its watchdog and heartbeats: those whose time the configuration does not say are
/// off, since nobody knows it, and those whose time it says are in a mode that has them.
fn as_it_is_thought_to_be(settings: &DeviceSettings) -> Device {
    let mut device = Device::clone(&settings.device);
    for time in times(&device) {
        if !is_wanted(settings, time) {
            device.points[time].default = Some(0);
            continue;
        }
        for condition in device.points[time].when.clone() {
            if !is_wanted(settings, condition.point) {
                device.points[condition.point].default = condition.values.first().map(|(raw, _)| *raw);
            }
        }
    }
    device
}

fn is_wanted(settings: &DeviceSettings, point: PointIndex) -> bool {
    settings.wanted.iter().any(|wanted| wanted.point == point)
}

/// The points that say how long a device waits for its watchdog or a heartbeat.
fn times(device: &Device) -> Vec<PointIndex> {
    device.wire.watchdog.into_iter().chain(device.points.iter().filter_map(|point| point.heartbeat)).collect()
}
