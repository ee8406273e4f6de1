//! A bus and units that hold what was last written to any of them, on simulated time: a request takes as long as its unit
//! takes, and nothing else.
//!
//! It looks at what the bus sleeps for: a wake that comes too soon must find nothing to do, and behind one that was in vain
//! the bus must not want another at the same moment.

use busker::engine::bus::{Action, Bus, Command, Event};
use busker::engine::memory::Memories;
use busker::engine::modbus::{Answer, Call, Discarded, Reply, Request, RequestError};
use busker::engine::request::{self, Verb, Wish};
use busker::engine::settings::Settings;
use busker::engine::time::{Date, Duration, Time};
use busker::engine::transaction::Transaction;
use fastrand::Rng;

use super::settings;

/// What was on the wire.
#[derive(Clone, Copy, Debug)]
pub struct Asked {
    pub at: Time,
    pub unit: u8,
    pub address: u16,
}

pub struct Plain {
    pub now: Time,
    pub asked: Vec<Asked>,
    /// By the number of a unit, from nought: in milliseconds.
    pub costs: Vec<u64>,
    /// Somebody commands this unit's point `w` as soon as the command before has been written.
    pub flood: Option<usize>,
    /// It does not answer.
    pub dead: Vec<usize>,
    /// It answers with this exception.
    pub refuses: Option<(usize, u8)>,
    /// Each so-manieth request meets another's.
    pub collides_each: Option<u64>,
    /// The other side closes each connection behind its answer.
    pub closes: bool,
    /// Requests that were under way when the link broke.
    pub lost: u32,
    settings: Settings,
    bus: Bus,
    to_send: Option<Sending>,
    answer: Option<(Time, Reply)>,
    reopen_at: Option<Time>,
    requests: u64,
    commands: u16,
    commanded: u16,
    random: Rng,
}

struct Sending {
    request: Request,
    not_before: Time,
    timeout: Duration,
}

impl Plain {
    pub fn new(configuration: &str, costs: Vec<u64>) -> Plain {
        let settings = settings(configuration);
        let mut plain = Plain {
            now: Time(0),
            asked: Vec::new(),
            costs,
            flood: None,
            dead: Vec::new(),
            refuses: None,
            collides_each: None,
            closes: false,
            lost: 0,
            bus: Bus::new(Time(0), &settings, 0, &Memories::default()),
            settings,
            to_send: None,
            answer: None,
            reopen_at: None,
            requests: 0,
            commands: 0,
            commanded: 0,
            random: Rng::with_seed(1),
        };
        plain.tell(Event::LinkUp);
        plain
    }

    pub fn command(&mut self, unit: usize) {
        self.commands = self.commands.wrapping_add(1);
        let (device, point) = (format!("unit_{}", unit + 1), "w".into());
        let payload = self.commands.to_string();
        self.tell(Event::Command(Command { device, point, payload, retained: false }));
    }

    pub fn get(&mut self, unit: usize, point: &str) {
        self.tell(Event::Get { device: format!("unit_{}", unit + 1), point: point.into() });
    }

    pub fn break_link(&mut self) {
        self.lost += u32::from(self.to_send.is_some() || self.answer.is_some());
        (self.to_send, self.answer) = (None, None);
        if self.reopen_at.is_none() {
            self.tell(Event::LinkDown("it broke".into()));
        }
    }

    /// Somebody wants the port for so long.
    pub fn pause(&mut self, time: Duration) {
        let wish = Wish::Pause { time, until: Date::default() };
        let request = request::Request { verb: Verb::Pause, transaction: Transaction::default(), wish };
        self.tell(Event::Request(request));
    }

    pub fn retire(&mut self, unit: usize) {
        self.tell(Event::Retire(format!("unit_{}", unit + 1)));
    }

    pub fn adopt(&mut self, unit: usize) {
        let settings = self.settings.devices[unit].clone();
        self.tell(Event::Adopt(vec![settings], Memories::default()));
    }

    /// So many milliseconds.
    pub fn run_for(&mut self, millis: u64) -> Result<(), String> {
        let end = self.now + Duration::from_millis(millis);
        let mut was_woken_at = None;
        loop {
            if let Some(unit) = self.flood.filter(|_| self.commanded == self.commands) {
                self.command(unit);
            }
            let send = self.to_send.as_ref().map(|sending| sending.not_before);
            let answer = self.answer.as_ref().map(|(at, _)| *at);
            let wake = self.bus.wake_at();
            let is_asleep = send.is_none() && answer.is_none() && self.reopen_at.is_none();
            let next = [send, answer, self.reopen_at, wake].into_iter().flatten().min();
            let next = next.map_or(end + Duration::from_millis(1), |next| next.max(self.now));
            if is_asleep {
                self.wake_too_soon(next.min(end))?;
            }
            if next > end {
                self.now = end;
                return Ok(());
            }
            self.now = next;
            if self.reopen_at.is_some_and(|at| at <= next) {
                self.reopen_at = None;
                self.tell(Event::LinkUp);
            } else if send.is_some_and(|at| at <= next) {
                self.send();
            } else if answer.is_some_and(|at| at <= next) {
                let (_, reply) = self.answer.take().expect("it is there");
                self.tell(Event::Reply(reply));
                if self.closes {
                    self.break_link();
                }
            } else {
                self.tell(Event::Wake);
                if self.to_send.is_none() && was_woken_at.replace(next) == Some(next) {
                    return Err(format!("at {} the bus is awake, and does nothing: {wake:?}", self.now));
                }
            }
        }
    }

    /// Before what it sleeps for, nothing is to be done.
    fn wake_too_soon(&mut self, next: Time) -> Result<(), String> {
        let between = (next - self.now).as_micros() as u64;
        if between < 2 || self.random.u8(..4) != 0 {
            return Ok(());
        }
        self.now = Time(self.now.0 + self.random.u64(1..between));
        self.tell(Event::Wake);
        match self.to_send {
            Some(_) => Err(format!("at {} the bus would have slept until {next}", self.now)),
            None => Ok(()),
        }
    }

    fn send(&mut self) {
        let Sending { request, timeout, .. } = self.to_send.take().expect("it is there");
        self.requests += 1;
        let index = usize::from(request.unit) - 1;
        let mut took = Duration::from_millis(self.costs[index]);
        let result = match &request.call {
            _ if self.dead.contains(&index) => Err(RequestError::Timeout),
            _ if self.collides_each.is_some_and(|each| self.requests % each == 0) => {
                Err(RequestError::Collision)
            }
            Call::Read(span) => {
                self.asked.push(Asked { at: self.now, unit: request.unit, address: span.first() });
                let code = self.refuses.filter(|(unit, _)| *unit == index).map(|(_, code)| code);
                match code {
                    Some(code) => Err(RequestError::Exception(code)),
                    None => Ok(Answer::Words(vec![self.commanded; span.count() as usize])),
                }
            }
            Call::WriteRegister { word, .. } => {
                self.commanded = *word;
                Ok(Answer::Written)
            }
            call => panic!("nobody asks for {call:?}"),
        };
        let result = if took > timeout { Err(RequestError::Timeout) } else { result };
        if result == Err(RequestError::Timeout) {
            took = timeout;
        }
        let end = self.now + took;
        let times = Some((end, end)).filter(|_| matches!(result, Ok(_) | Err(RequestError::Exception(_))));
        self.answer = Some((end, Reply::new(result, self.now, times, &mut Discarded::default())));
    }

    fn tell(&mut self, event: Event) {
        self.bus.handle(self.now, event);
        while let Some(action) = self.bus.next_action() {
            match action {
                Action::Send { request, not_before, timeout } => {
                    assert!(self.to_send.is_none() && self.answer.is_none(), "one request at a time");
                    self.to_send = Some(Sending { request, not_before, timeout });
                }
                Action::Withdraw => {
                    if self.to_send.take_if(|sending| sending.not_before > self.now).is_some() {
                        self.bus.handle(self.now, Event::Withdrawn);
                    }
                }
                Action::Reopen { after } => {
                    (self.to_send, self.answer) = (None, None);
                    self.reopen_at = Some(self.now + after);
                }
                Action::Publish(_) | Action::Say(..) | Action::Store(_) | Action::Record { .. } => {}
            }
        }
    }
}
