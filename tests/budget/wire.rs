//! A bus, its guard and a wire that charges what a line charges, on simulated time: units that hold zeros. The wire's
//! arithmetic is the specification's, and not the program's own. A network charges the devices' turnaround alone.

use std::collections::{BTreeMap, VecDeque};

use busker::engine::bus::{Action, Bus, Command, Event};
use busker::engine::device::Identify;
use busker::engine::memory::Memories;
use busker::engine::modbus::Reply;
use busker::engine::modbus::crc::crc;
use busker::engine::modbus::guard::Guard;
use busker::engine::settings::Settings;
use busker::engine::time::{Duration, Time};

use super::settings;

/// What was on the wire.
#[derive(Clone, Copy, Debug)]
pub struct Asked {
    pub at: Time,
    pub unit: u8,
    pub function: u8,
    pub address: u16,
    /// The count of a read, the value of a write.
    pub argument: u16,
}

/// What stands before the unit on Modbus TCP: the transaction, the protocol, the length.
const MBAP: usize = 6;

/// So many bytes: less than comes in a tenth of a second, in which a frame would be taken to be over.
const HANDED_OVER: usize = 32;

pub struct Wire {
    pub now: Time,
    pub bus: Bus,
    /// What whoever tests it has not taken away, and everything.
    pub asked: Vec<Asked>,
    pub ever: Vec<Asked>,
    /// The last message on each topic.
    pub published: BTreeMap<String, String>,
    pub said: Vec<String>,
    settings: Settings,
    guard: Guard,
    turnaround: Duration,
    /// Units that do not answer.
    dead: Vec<u8>,
    to_send: Option<Time>,
    /// What is still to come of it, and when.
    answer: VecDeque<(Time, Vec<u8>)>,
    reopen_at: Option<Time>,
    registers: BTreeMap<(u8, u16), u16>,
    /// Registers that answer with this exception whatever read they are in.
    refusing: BTreeMap<(u8, u16), u8>,
}

impl Wire {
    pub fn new(configuration: &str, turnaround: Duration) -> Wire {
        let settings = settings(configuration);
        let mut wire = Wire {
            now: Time(0),
            bus: Bus::new(Time(0), &settings, 0, &Memories::default()),
            asked: Vec::new(),
            ever: Vec::new(),
            published: BTreeMap::new(),
            said: Vec::new(),
            guard: Guard::new(&settings.buses[0].link, settings.buses[0].gap),
            settings,
            turnaround,
            dead: Vec::new(),
            to_send: None,
            answer: VecDeque::new(),
            reopen_at: None,
            registers: BTreeMap::new(),
            refusing: BTreeMap::new(),
        };
        wire.perform();
        wire
    }

    pub fn set_dead(&mut self, unit: u8, dead: bool) {
        self.dead.retain(|other| *other != unit);
        if dead {
            self.dead.push(unit);
        }
    }

    pub fn set_turnaround(&mut self, turnaround: Duration) {
        self.turnaround = turnaround;
    }

    pub fn hold(&mut self, unit: u8, register: u16, value: u16) {
        self.registers.insert((unit, register), value);
    }

    /// The device has no such register.
    pub fn forbid(&mut self, unit: u8, register: u16) {
        self.refusing.insert((unit, register), 2);
    }

    /// The device cannot tell it.
    pub fn fail(&mut self, unit: u8, register: u16) {
        self.refusing.insert((unit, register), 4);
    }

    pub fn command(&mut self, device: &str, point: &str, value: u16) {
        let (device, point, payload) = (device.into(), point.into(), value.to_string());
        let command = Command { device, point, payload, retained: false };
        self.bus.handle(self.now, Event::Command(command));
        self.perform();
    }

    pub fn run_until(&mut self, end: Time) {
        loop {
            let send = self.to_send.map(|not_before| not_before.max(self.guard.earliest_send(self.now)));
            let answer = self.answer.front().map(|(at, _)| *at);
            let times = [self.reopen_at, send.or(self.guard.wake_at()), answer, self.bus.wake_at()];
            let next = times.into_iter().flatten().min().expect("something is to come").max(self.now);
            if next > end {
                self.now = end;
                return;
            }
            self.now = next;
            self.step();
        }
    }

    fn step(&mut self) {
        let now = self.now;
        if self.reopen_at.is_some_and(|at| at <= now) {
            self.reopen_at = None;
            self.tell(Event::LinkUp);
        }
        let is_heard = self.answer.front().is_some_and(|(at, _)| *at <= now);
        let heard = if is_heard { self.answer.pop_front() } else { None };
        if let Some((_, bytes)) = heard {
            let reply = self.guard.received(now, &bytes);
            self.replied(reply);
        }
        match self.to_send {
            Some(not_before) if now >= not_before.max(self.guard.earliest_send(now)) => self.send(),
            None if self.guard.wake_at().is_some_and(|at| at <= now) => {
                let reply = self.guard.wake(now);
                self.replied(reply);
            }
            _ => {}
        }
        if self.bus.wake_at().is_some_and(|at| at <= now) {
            self.tell(Event::Wake);
        }
    }

    fn send(&mut self) {
        self.to_send = None;
        let whole = self.guard.frame().to_vec();
        let is_line = self.settings.buses[0].link.line().is_some();
        let frame = if is_line { &whole[..] } else { &whole[MBAP..] };
        // A question for the name is shorter than any other.
        let byte = |at: usize| frame.get(at).copied().unwrap_or(0);
        let word = |at: usize| u16::from_be_bytes([byte(at), byte(at + 1)]);
        let (unit, function) = (frame[0], frame[1]);
        let asked = Asked { at: self.now, unit, function, address: word(2), argument: word(4) };
        self.asked.push(asked);
        self.ever.push(asked);
        self.guard.sent(self.now);
        if self.dead.contains(&unit) {
            return;
        }
        let refusal = || {
            let span = word(2)..word(2).saturating_add(word(4));
            self.refusing.iter().find(|((of, register), _)| *of == unit && span.contains(register))
        };
        let refusal = if function == 6 { None } else { refusal().map(|(_, code)| *code) };
        let mut answer = vec![unit, function];
        match function {
            _ if refusal.is_some() => answer = vec![unit, function | 0x80, refusal.unwrap_or_default()],
            1 | 2 => {
                answer.push(word(4).div_ceil(8) as u8);
                answer.resize(answer.len() + usize::from(answer[2]), 0);
            }
            3 | 4 => {
                answer.push(word(4) as u8 * 2);
                for address in word(2)..word(2) + word(4) {
                    let held = self.registers.get(&(unit, address)).copied().unwrap_or(0);
                    answer.extend(held.to_be_bytes());
                }
            }
            6 => {
                self.registers.insert((unit, word(2)), word(4));
                answer.extend(&frame[2..6]);
            }
            43 => answer.extend(self.names(unit)),
            _ => answer = vec![unit, function | 0x80, 1],
        }
        let begins = self.now + self.turnaround;
        if is_line {
            answer.extend(crc(&answer).to_le_bytes());
            // As an adapter hands them over that waits until it has a few.
            let mut said = frame.len();
            for bytes in answer.chunks(HANDED_OVER) {
                said += bytes.len();
                self.answer.push_back((begins + self.characters(said), bytes.to_vec()));
            }
        } else {
            answer.splice(..0, [whole[0], whole[1], 0, 0, 0, answer.len() as u8]);
            self.answer.push_back((begins, answer));
        }
    }

    /// The answer to function 43/14: the names that the unit's profile wants to hear.
    fn names(&self, unit: u8) -> Vec<u8> {
        let device = self.settings.devices.iter().find(|device| device.unit == unit).expect("a unit");
        let Some(Identify::Names { vendor, product }) = &device.device.identify else {
            panic!("nobody asks such a device for its name")
        };
        let mut answer = vec![14, 1, 1, 0, 0, 2];
        for (object, name) in [vendor, product].into_iter().enumerate() {
            answer.extend([object as u8, name.len() as u8]);
            answer.extend(name.as_bytes());
        }
        answer
    }

    /// Eleven bits each with parity, ten without.
    fn characters(&self, count: usize) -> Duration {
        let line = self.settings.buses[0].link.line().expect("a serial line");
        let told = line.to_string();
        let bits = if told.contains("8N1") { 10 } else { 11 };
        let nanos = count as u64 * bits * 1_000_000_000 / u64::from(line.baud);
        Duration::from_micros(nanos.div_ceil(1000))
    }

    fn replied(&mut self, reply: Option<Reply>) {
        if let Some(reply) = reply {
            self.tell(Event::Reply(reply));
        }
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
                        None => self.to_send = Some(not_before),
                    }
                }
                Action::Withdraw => {
                    if self.to_send.take().is_some() {
                        self.bus.handle(self.now, Event::Withdrawn);
                    }
                }
                Action::Reopen { after } => self.reopen_at = Some(self.now + after),
                Action::Say(_, text) => self.said.push(text),
                Action::Publish(message) => {
                    self.published.insert(message.topic, message.payload);
                }
                Action::Store(_) | Action::Record { .. } => {}
            }
        }
    }

    /// By unit and first register of a read: the mean time between two of them.
    pub fn periods(&self) -> BTreeMap<(u8, u16), f64> {
        let mut times: BTreeMap<(u8, u16), Vec<Time>> = BTreeMap::new();
        for asked in self.asked.iter().filter(|asked| (1..=4).contains(&asked.function)) {
            times.entry((asked.unit, asked.address)).or_default().push(asked.at);
        }
        let mean = |times: &Vec<Time>| {
            let whole = times[times.len() - 1].since(times[0]).as_secs_f64();
            whole / (times.len() - 1) as f64
        };
        times
            .iter()
            .filter(|(_, times)| times.len() > 2)
            .map(|(place, times)| (*place, mean(times)))
            .collect()
    }

    /// The longest time between two requests to this unit.
    pub fn longest_wait(&self, unit: u8) -> f64 {
        let of_unit: Vec<Time> =
            self.asked.iter().filter(|asked| asked.unit == unit).map(|asked| asked.at).collect();
        let gaps = of_unit.windows(2).map(|pair| pair[1].since(pair[0]).as_secs_f64());
        gaps.fold(0.0, f64::max)
    }
}
