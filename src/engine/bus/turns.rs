//! Whose turn it is on the bus, and who may take it from whom.
//!
//! The order: the command that has begun, heartbeats and watchdogs that are late, waiting commands,
//! heartbeats and watchdogs, what somebody asked for, settings that are not as they are wanted, a scan, then
//! whichever device's read (or identification) is most urgent. Nobody who asks without end keeps a read that
//! is due from the wire: [`AHEAD_OF_READS`]; and no watchdog that wants too much keeps a command from it:
//! [`FED_IN_A_ROW`].

use crate::engine::address::Span;
use crate::engine::modbus::{Call, Reply, Request, RequestError};
use crate::engine::settings::Link;
use crate::engine::time::{Duration, Time};

use super::device::{DeviceState, Need, Polled};
use super::devices::Next;
use super::{Action, Bus, GivesWay, InFlight, LinkState, OnBrokerLoss, Purpose};

/// So many requests in a row may go before a read that is due, because somebody wants them at once. Then
/// the read has its turn: under a flood of commands every period stretches, but nothing starves.
pub const AHEAD_OF_READS: u32 = 8;

/// So many heartbeats and feedings in a row may go before whatever else somebody wants. More are never needed but
/// where a device allows less time than the line can keep. There they may not keep from the wire what ends it: the
/// command, perhaps, that puts the time right.
const FED_IN_A_ROW: u32 = 8;

/// Behind so many silences in a row the others have the line for as long as the last one took, if there is anything to ask
/// them, before a device is asked again that has been silent already. Where half of a cabinet has lost its power each of its
/// devices has to be asked three times in vain, and that may not be all that the line does meanwhile. (Behind each single
/// one, a device on a disturbed line would be asked too seldom.)
const SILENCES_IN_A_ROW: u32 = 2;

impl Bus {
    /// Asks what is to be asked next, if the line is free.
    pub(super) fn ask_next(&mut self) {
        if self.now < self.silent_until {
            return;
        }
        while self.in_flight.is_none() && self.link_state == LinkState::Up {
            if let Some((device, point, call)) = self.beat.take() {
                self.send(device, call, Purpose::BeatWrite(point));
                continue;
            }
            if self.begin_overdue_read() || self.nourish(Need::Late) {
                continue;
            }
            if self.begin_command() {
                self.fed_in_a_row = 0;
                continue;
            }
            if self.nourish(Need::Due) {
                continue;
            }
            // Whoever else wants something has had the chance, and the next feeding may come.
            let was_held_back = std::mem::take(&mut self.fed_in_a_row) >= FED_IN_A_ROW;
            if self.next_fetch() || self.begin_request() || self.begin_setting() || self.next_scan() {
                continue;
            }
            if was_held_back && self.nourish(Need::Due) {
                // Reads that are due have their turns between feedings: the next setting, or question of a
                // request, has not to wait for them.
                self.wrote_setting = false;
                self.requests_go_on();
                continue;
            }
            let now = self.now;
            let runs_out = self.watchdogs_run_out();
            // Who is not looked at need not be fetched from memory.
            let may_all = !runs_out && !self.is_anyone_leaving;
            let may_ask = |device: &DeviceState| may_all || may_ask(device, runs_out);
            let may_go_first = |device: &DeviceState| may_ask(device) && !device.is_doubtful();
            let first = match now < self.doubtful_from {
                true => self.devices.most_urgent(now, &mut self.pace, may_go_first),
                false => None,
            };
            let next = first.or_else(|| self.devices.most_urgent(now, &mut self.pace, may_ask));
            let read_before_setting = std::mem::take(&mut self.wrote_setting);
            let read_before_request = self.requests_go_on();
            let Some(Next { device, polled, .. }) = next else {
                // Nothing is due: the next setting, or question of a request, need not wait for it.
                if read_before_setting || read_before_request {
                    continue;
                }
                self.pace.idle(now);
                self.nobody_was_kept_waiting(now);
                return;
            };
            self.poll(device, polled);
        }
    }

    /// A read had its turn, or nothing that is due may be asked: what went out of turn keeps no read waiting any more,
    /// but for those of a device that wanted silence behind it when that was decided.
    fn nobody_was_kept_waiting(&mut self, decided_at: Time) {
        let at = self.pace.at(self.now);
        if self.ahead > 0 && !self.askable().any(|(_, device)| device.keeps_waiting(at, decided_at)) {
            self.ahead = 0;
        }
    }

    fn poll(&mut self, device: usize, polled: Polled) {
        let (call, purpose) = match polled {
            Polled::Identification(call) => (call, Purpose::Identify),
            Polled::Read(read, call) => (call, Purpose::Poll { read }),
        };
        self.send(device, call, purpose);
    }

    /// A request has had its turn.
    pub(super) fn count_turn(&mut self, ended: &InFlight, reply: &Reply) {
        // In a silence all have waited: nobody makes up for it.
        let was_turn = ended.before.is_some_and(|before| before.was_in_turn());
        let is_silence = reply.result == Err(RequestError::Timeout);
        let took = if is_silence { Duration::ZERO } else { self.now - ended.decided_at };
        if was_turn {
            self.pace.had_turn(took);
        } else {
            self.pace.went_before(took);
        }
        if let Some(device) = ended.device {
            self.devices[device].was_asked_out_of_turn = ended.out_of_turn;
        }
        if ended.out_of_turn {
            self.ahead += 1;
        } else if matches!(ended.purpose, Purpose::Poll { .. }) {
            self.nobody_was_kept_waiting(ended.decided_at);
        }
    }

    /// The request that has just ended took so long. If nobody answered it, nor the one before, others have the line first.
    pub(super) fn put_doubtful_off(&mut self, took: Duration) {
        if self.unanswered >= SILENCES_IN_A_ROW {
            self.doubtful_from = self.now.max(self.line.polls_from()) + took;
        }
    }

    /// A read that is due, after [`AHEAD_OF_READS`] requests that went before it.
    fn begin_overdue_read(&mut self) -> bool {
        if self.ahead < AHEAD_OF_READS {
            return false;
        }
        let at = self.pace.at(self.now);
        let overdue = self.askable().filter_map(|(index, device)| {
            let (polled, waited) = device.longest_waiting(at)?;
            Some((index, polled, waited))
        });
        let longest = overdue.reduce(|best, other| if other.2 > best.2 { other } else { best });
        let Some((device, polled, _)) = longest else {
            self.nobody_was_kept_waiting(self.now);
            return false;
        };
        self.ahead = 0;
        // It is a turn as any other, also where it is not due by the time of the bus, which hardly goes on now.
        self.pace.let_ahead();
        self.poll(device, polled);
        if let Some(in_flight) = &mut self.in_flight {
            in_flight.out_of_turn = false;
            in_flight.gives_way = GivesWay::Nobody;
        }
        true
    }

    /// Serves a heartbeat or a watchdog with that need; until there were [`FED_IN_A_ROW`]. Whether anything was begun.
    fn nourish(&mut self, need: Need) -> bool {
        let is_begun = self.fed_in_a_row < FED_IN_A_ROW && (self.begin_beat(need) || self.feed(need));
        self.fed_in_a_row += u32::from(is_begun);
        is_begun
    }

    /// Begins a heartbeat: what is to be written is read first.
    fn begin_beat(&mut self, need: Need) -> bool {
        if !self.feeds {
            return false;
        }
        let now = self.now;
        let due = self.askable().find_map(|(index, device)| Some((index, device.beat_due(now, need)?)));
        let Some((device, point)) = due else { return false };
        let call = Call::Read(self.devices[device].details(point).at.span);
        self.send(device, call, Purpose::BeatRead(point));
        true
    }

    /// Asks a device something whose watchdog wants to be fed. If it is late, no command goes before.
    fn feed(&mut self, need: Need) -> bool {
        if !self.feeds {
            return false;
        }
        let now = self.now;
        let due = self.askable().find_map(|(index, device)| Some((index, device.feed_due(now, need)?)));
        let Some((device, read)) = due else { return false };
        self.line.hurry();
        self.poll(device, self.devices[device].read_call(read));
        if let Some(in_flight) = &mut self.in_flight {
            in_flight.out_of_turn = true;
            in_flight.gives_way = if need == Need::Late { GivesWay::Nobody } else { GivesWay::Commands };
        }
        true
    }

    /// The devices that may be asked something by the bus itself, and their numbers.
    pub(super) fn askable(&self) -> impl Iterator<Item = (usize, &DeviceState)> {
        let runs_out = self.watchdogs_run_out();
        self.devices.iter().enumerate().filter(move |(_, device)| may_ask(device, runs_out))
    }

    pub(super) fn may_ask(&self, device: &DeviceState) -> bool {
        may_ask(device, self.watchdogs_run_out())
    }

    /// Whether devices with a watchdog are left to it, since the broker is away.
    fn watchdogs_run_out(&self) -> bool {
        !self.broker_up && self.rules.on_broker_loss != OnBrokerLoss::Keep
    }

    /// What any device has.
    pub(super) fn look_what_they_have(&mut self) {
        self.feeds = self.devices.iter().any(DeviceState::wants_feeding);
        self.has_settings = self.devices.iter().any(DeviceState::has_settings);
    }

    /// A poll that waits for the line to be silent must not keep a command waiting for a whole turn, and no
    /// watchdog either. If it is on the wire, nobody has to ask again.
    pub(super) fn make_way(&mut self) {
        let gives_way = self.in_flight.as_ref().map_or(GivesWay::Nobody, |in_flight| in_flight.gives_way);
        let is_wanted = match gives_way {
            GivesWay::Nobody => false,
            GivesWay::Commands => self.command_can_begin(),
            GivesWay::Feeding => self.command_can_begin() || self.wants_to_feed(),
        };
        if let Some(in_flight) = self.in_flight.as_mut().filter(|_| is_wanted) {
            in_flight.gives_way = GivesWay::Nobody;
            self.context.actions.push_back(Action::Withdraw);
        }
    }

    fn wants_to_feed(&self) -> bool {
        let now = self.now;
        let is_hungry = |device: &DeviceState| {
            device.beat_due(now, Need::Due).is_some() || device.feed_due(now, Need::Due).is_some()
        };
        self.feeds && self.askable().any(|(_, device)| is_hungry(device))
    }

    /// When the request that has begun should make way, if it can.
    pub(super) fn makes_way_at(&self) -> Option<Time> {
        let gives_way = |in_flight: &InFlight| in_flight.gives_way == GivesWay::Feeding;
        if !self.feeds || !self.in_flight.as_ref().is_some_and(gives_way) {
            return None;
        }
        let beats = self.askable().filter_map(|(_, device)| device.beats_at());
        beats.filter(|at| *at > self.now).min()
    }

    pub(super) fn withdrawn(&mut self) {
        let Some(in_flight) = self.in_flight.take() else { return };
        if let (Purpose::Poll { read }, Some(device), Some(before)) =
            (in_flight.purpose, in_flight.device, in_flight.before)
        {
            self.devices[device].take_back(read, before);
        }
    }

    pub(super) fn send(&mut self, device: usize, call: Call, purpose: Purpose) {
        let state = &mut self.devices[device];
        let before = match purpose {
            Purpose::Poll { read } => state.begin_read(read, self.now, &mut self.pace),
            _ => {
                self.pace.busy(self.now);
                state.turn()
            }
        };
        let is_poll = matches!(purpose, Purpose::Poll { .. });
        let is_wish = matches!(purpose, Purpose::Command | Purpose::Fetch | Purpose::BeatRead(_));
        // A network may hold up a packet for longer than any device takes.
        let may_hurry = matches!(self.link, Link::Serial { .. });
        let is_well_known = match purpose {
            Purpose::Poll { read } => may_hurry && state.is_well_known(read, self.now),
            _ => false,
        };
        let timeout = state.timeout(self.response_timeout, is_well_known);
        let mut not_before = state.asked(self.now);
        let commanded_at = match purpose {
            Purpose::Command => self.active.as_mut().and_then(|active| active.came_at.take()),
            _ => None,
        };
        let request = state.request(self.now, call, timeout);
        if is_poll {
            not_before = not_before.max(self.line.polls_from());
        }
        self.in_flight = Some(InFlight {
            device: Some(device),
            purpose,
            sent_at: not_before,
            decided_at: self.now,
            reads: reads_of(&request.call),
            commanded_at,
            out_of_turn: is_wish || (is_poll && before.was_wanted()),
            before: Some(before),
            gives_way: if is_poll { GivesWay::Feeding } else { GivesWay::Nobody },
        });
        self.ask(request, not_before, timeout);
    }

    /// Asks a unit that is no device of this gateway.
    pub(super) fn send_stranger(&mut self, request: Request, purpose: Purpose) {
        let (now, timeout) = (self.now, self.response_timeout);
        self.pace.busy(now);
        self.in_flight = Some(InFlight {
            device: None,
            purpose,
            sent_at: now,
            decided_at: now,
            reads: None,
            commanded_at: None,
            before: None,
            out_of_turn: false,
            gives_way: GivesWay::Nobody,
        });
        self.ask(request, now, timeout);
    }
}

/// Not a device that leaves. And one whose watchdog must run out is not spoken to.
fn may_ask(device: &DeviceState, watchdogs_run_out: bool) -> bool {
    let is_left_alone = watchdogs_run_out && device.wants_feeding();
    !device.is_leaving && !is_left_alone
}

fn reads_of(call: &Call) -> Option<Span> {
    match call {
        Call::Read(span) => Some(*span),
        _ => None,
    }
}
