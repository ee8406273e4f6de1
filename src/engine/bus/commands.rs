//! Commands on a bus: they wait, begin, are written, settle, are read back, and end in exactly one
//! outcome. A thing's command is the commands of its points, one after the other.

use std::collections::VecDeque;

use crate::engine::address::Span;
use crate::engine::command::{self, CommandFlow, Outcome, OutcomeKind, Step, Wish};
use crate::engine::device::PointIndex;
use crate::engine::modbus::{Answer, Call, RequestError};
use crate::engine::time::{Duration, Time};
use crate::engine::topics::Message;

use super::change::CHANGED;
use super::device::DeviceState;
use super::waiting::{REPLACED, Target, Waiting};
use super::{Bus, Command, LinkState, Purpose, Severity};

/// A command that has begun.
pub(super) struct Active {
    pub(super) device: usize,
    target: Target,
    wanted: Wish,
    /// When it came, until its first request is on its way; not of a setting, which nobody gave.
    pub(super) came_at: Option<Time>,
    flow: CommandFlow,
    /// It began before its EEPROM may be written again, since the device seems to hold what is wanted.
    is_early: bool,
    /// What of a thing's command is still to be written.
    orders: VecDeque<(PointIndex, String)>,
}

/// A command that waits until it can go on: most were written, and take their time until they can be read
/// back.
pub(super) struct Settling {
    /// When it goes on, mostly to be read back with a request of its own.
    until: Time,
    pub(super) active: Active,
    then: Then,
}

/// How a command goes on.
enum Then {
    /// It is read back.
    ReadBack,
    /// The same, if no poll that begins from now on has brought it before.
    ReadBackUnlessPolled,
    /// This is asked.
    Ask(Call),
}

/// What commands and requests are told that a bus leaves behind when it ends: it does not know which of the two
/// it is.
pub const STOPPING: &str = "busker stops, or begins this bus anew";

/// The poll that reads a command back is wanted at once. When even so it does not come within this time,
/// the command is read back by itself.
const POLL_AWAITED: Duration = Duration::from_secs(1);

impl Bus {
    /// A message on a `set` topic.
    pub(super) fn command(&mut self, command: Command) {
        let Some((device, target)) = self.find(&command.device, &command.point) else {
            if !command.retained {
                self.refuse_unknown(&command);
            }
            return;
        };
        if command.retained {
            if self.devices[device].warn_of_retained(target) {
                let topic = self.context.topics_of(&command.device).set(&command.point);
                self.context
                    .say(Severity::Warning, format!("a retained message on `{topic}` is ignored; delete it"));
            }
            return;
        }
        if command.payload.is_empty() {
            if let Some(reason) = self.devices[device].why_empty_is_no_value(target) {
                let outcome = Outcome::new(OutcomeKind::Refused, "", reason);
                return self.tell_outcome(device, target, outcome);
            }
        }
        let is_press = self.devices[device].is_press(target);
        let wish = Wish::parse(&command.payload);
        if let Some(fault) = &wish.fault {
            return self.tell_outcome(device, target, wish.ended(OutcomeKind::Refused, fault));
        }
        if is_press {
            if let Some(reason) = self.devices[device].is_too_soon(self.now, target) {
                self.tell_outcome(device, target, wish.ended(OutcomeKind::Refused, reason));
                return;
            }
        }
        // What will never be written takes no other value's place.
        if let Some((point, outcome)) = self.devices[device].refusal_of(target, &wish.text) {
            if !self.is_being_written(device, point) {
                self.devices[device].command_ended(self.now, point, &outcome, &mut self.context);
            }
            return self.tell_outcome(device, target, wish.of(outcome));
        }
        self.let_wait(Waiting::new(self.now, device, target, wish, is_press));
    }

    /// Lets a command wait for its turn, in the place of an older one for the same.
    fn let_wait(&mut self, command: Waiting) {
        let device = command.device;
        for (replaced, reason) in self.waiting.push(command) {
            let outcome = replaced.wanted.ended(OutcomeKind::Expired, reason);
            self.tell_outcome(replaced.device, replaced.target, outcome);
        }
        self.tell_what_waits(device);
    }

    /// Whether a write to the point is on its way, or not yet read back: what it holds is told behind that.
    fn is_being_written(&self, device: usize, point: PointIndex) -> bool {
        let mut begun = self.active.iter().chain(self.settling.iter().map(|settling| &settling.active));
        begun.any(|active| active.device == device && active.flow.point() == point)
    }

    /// There is no such point, or its device is just being exchanged for what a new configuration says of it.
    fn refuse_unknown(&mut self, command: &Command) {
        let Command { device, point, payload, .. } = command;
        let reason = match self.devices.iter().find(|state| state.name() == device) {
            Some(state) => state.no_point(point, &state.names_to_set()),
            None => CHANGED.to_string(),
        };
        let topic = self.context.topics_of(device).outcome(point);
        let outcome = Wish::parse(payload).ended(OutcomeKind::Refused, reason);
        self.context.publish(Message::once(topic, outcome.to_json()));
    }

    pub(super) fn expire_commands(&mut self) {
        if self.waiting.next_deadline().is_none_or(|at| self.now < at) {
            return;
        }
        for mut waiting in self.waiting.take_expired(self.now) {
            let device = &self.devices[waiting.device];
            let writable_at = device.writable_at(waiting.target);
            if writable_at > self.now {
                // A write that had begun before it has put it off.
                waiting.put_off(writable_at);
                self.waiting.push(waiting);
                continue;
            }
            let reason = device.why_not(waiting.target);
            let outcome = waiting.wanted.ended(OutcomeKind::Expired, reason);
            self.tell_outcome(waiting.device, waiting.target, outcome);
            self.tell_what_waits(waiting.device);
        }
    }

    pub(super) fn refuse_what_waits(&mut self) {
        for waiting in self.waiting.take_all() {
            let outcome = waiting.wanted.ended(OutcomeKind::Refused, STOPPING);
            self.tell_outcome(waiting.device, waiting.target, outcome);
        }
        self.refuse_requests();
        if self.in_flight.is_none() {
            self.end_settling(STOPPING);
            for device in &mut self.devices {
                device.say_offline(&mut self.context);
            }
        }
    }

    /// A point of this device has been written, or a command waits: what waits in vain is told so at once.
    pub(super) fn refuse_what_is_in_vain(&mut self, device: usize) {
        let why = |waiting: &Waiting| {
            let is_of_it = waiting.device == device;
            is_of_it.then(|| self.devices[device].is_in_vain(self.now, waiting)).flatten()
        };
        let in_vain: Vec<(Target, String)> =
            self.waiting.iter().filter_map(|waiting| Some((waiting.target, why(waiting)?))).collect();
        for (target, reason) in in_vain {
            let is_it = |waiting: &Waiting| waiting.device == device && waiting.target == target;
            let Some(waiting) = self.waiting.take_first(is_it) else { continue };
            self.tell_outcome(device, target, waiting.wanted.ended(OutcomeKind::Refused, reason));
        }
    }

    /// Tells which values of this device wait until their EEPROM may be written again.
    pub(super) fn tell_what_waits(&mut self, device: usize) {
        self.refuse_what_is_in_vain(device);
        let state = &self.devices[device];
        let of_device = self.waiting.iter().filter(|waiting| waiting.device == device);
        let points = of_device.filter_map(|waiting| match waiting.target {
            Target::Point(point) if state.details(point).persistent => {
                state.spares_eeprom(self.now, waiting.target, &waiting.wanted.text).then_some(point)
            }
            _ => None,
        });
        let points = points.collect();
        self.devices[device].wait_for_eeprom(self.now, points, &mut self.context);
    }

    /// Nothing can be read back any more.
    pub(super) fn end_settling(&mut self, reason: &str) {
        self.end_settling_of(None, reason);
    }

    /// The same for one device; `None` for all.
    pub(super) fn end_settling_of(&mut self, device: Option<usize>, reason: &str) {
        let is_of_it = |active: &Active| device.is_none_or(|device| active.device == device);
        let all = std::mem::take(&mut self.settling).into_iter();
        let (ended, rest): (Vec<_>, Vec<_>) = all.partition(|settling| is_of_it(&settling.active));
        self.settling = rest;
        for Settling { active, then, .. } in ended {
            let is_unwritten = matches!(then, Then::Ask(call) if call.is_write());
            let what = if is_unwritten { "not written" } else { "written, but not read back" };
            let outcome = active.wanted.ended(OutcomeKind::NoReply, format!("{what}: {reason}"));
            self.end_command(active, outcome);
        }
    }

    /// Goes on with a command that has settled, or begins the first waiting one whose device can take
    /// it. Whether anything was done.
    pub(super) fn begin_command(&mut self) -> bool {
        if self.active.is_some() {
            return false;
        }
        if let Some(at) = self.settling.iter().position(|settling| settling.until <= self.now) {
            let Settling { mut active, then, .. } = self.settling.remove(at);
            match then {
                // What the device was too busy for; the newer value goes on in its place.
                Then::Ask(_) if self.is_overtaken(&active) => {
                    let outcome = active.wanted.ended(OutcomeKind::Expired, REPLACED);
                    self.end_command(active, outcome);
                }
                Then::Ask(call) => {
                    self.take_step(active, Step::Ask(call));
                    return true;
                }
                Then::ReadBack | Then::ReadBackUnlessPolled => {
                    let call = active.flow.settled(self.devices[active.device].device());
                    let device = active.device;
                    self.active = Some(active);
                    self.send(device, call, Purpose::Command);
                    return true;
                }
            }
        }
        let (devices, settling, now) = (&self.devices, &self.settling, self.now);
        let can_begin = |waiting: &Waiting| can_begin(devices, settling, now, waiting);
        let Some(waiting) = self.waiting.take_first(can_begin) else { return false };
        let Waiting { device, target, wanted, came_at, .. } = waiting;
        self.tell_what_waits(device);
        let orders = match target {
            Target::Point(point) | Target::Setting(point) => VecDeque::from([(point, wanted.text.clone())]),
            Target::Thing(thing) => match self.devices[device].orders(thing, &wanted.text) {
                Ok(orders) => orders.into(),
                Err(reason) => {
                    self.tell_outcome(device, target, wanted.ended(OutcomeKind::Refused, reason));
                    return true;
                }
            },
        };
        self.begin_order(device, target, wanted, Some(came_at), orders);
        true
    }

    /// Whether nothing of the command has been written yet, and a newer value waits for the same point, which the
    /// device can take.
    fn is_overtaken(&self, active: &Active) -> bool {
        let device = &self.devices[active.device];
        let is_newer = |waiting: &Waiting| {
            let is_same = waiting.device == active.device && waiting.target == active.target;
            is_same && device.is_valid(waiting.target, &waiting.wanted.text)
        };
        active.flow.is_unwritten() && self.waiting.iter().any(is_newer)
    }

    /// Whether a waiting command could begin if nothing were in flight.
    pub(super) fn command_can_begin(&self) -> bool {
        let can_begin = |waiting: &Waiting| can_begin(&self.devices, &self.settling, self.now, waiting);
        self.active.is_none() && self.waiting.iter().any(can_begin)
    }

    /// Begins to write a setting that a device holds otherwise than it is wanted. Whether anything was
    /// done. Many settings take their time, in which watchdogs want to be fed: after each, what is due
    /// comes first.
    pub(super) fn begin_setting(&mut self) -> bool {
        if !self.has_settings || self.active.is_some() || self.wrote_setting {
            return false;
        }
        let next = |(index, device): (usize, &DeviceState)| {
            let is_settling = |point| {
                let same = |active: &Active| active.device == index && active.flow.point() == point;
                self.settling.iter().any(|settling| same(&settling.active))
            };
            Some((index, device.next_setting(self.now, is_settling)?))
        };
        let Some((device, (point, wanted))) = self.askable().find_map(next) else { return false };
        let orders = VecDeque::from([(point, wanted.clone())]);
        self.begin_order(device, Target::Setting(point), wanted.into(), None, orders);
        true
    }

    /// Begins the first of `orders`, which there is.
    fn begin_order(
        &mut self,
        device: usize,
        target: Target,
        wanted: Wish,
        came_at: Option<Time>,
        mut orders: VecDeque<(PointIndex, String)>,
    ) {
        let Some((point, value)) = orders.pop_front() else { return };
        let state = &self.devices[device];
        match CommandFlow::begin(state.device(), point, &value, state.known()) {
            Ok((flow, call)) => {
                let is_point = matches!(target, Target::Point(_));
                let is_early = is_point && self.now < state.writable_at(target);
                let active = Active { device, target, wanted, came_at, flow, is_early, orders };
                self.take_step(active, Step::Ask(call));
            }
            Err(outcome) => {
                self.setting_ended(device, target, &outcome);
                self.devices[device].command_ended(self.now, point, &outcome, &mut self.context);
                self.tell_outcome(device, target, wanted.of(outcome));
            }
        }
    }

    pub(super) fn command_answered(&mut self, result: Result<Answer, RequestError>) {
        let Some(mut active) = self.active.take() else { return };
        self.count_written(active.device, &result);
        let state = &mut self.devices[active.device];
        if let (true, Ok(answer)) = (active.flow.reads(), &result) {
            let words = command::words_of(answer);
            state.read_for_command(self.now, active.flow.point(), &words, &mut self.context);
        }
        // What it leaves unanswered says as much of it as a poll in vain: else each of many commands would be waited for.
        if let Err(error) = &result {
            state.failed_command(self.now, error, &mut self.context);
        }
        let step = active.flow.answered(state.device(), state.known(), &result);
        self.take_step(active, step);
    }

    /// What was asked last may have been a write to EEPROM.
    pub(super) fn count_written(&mut self, device: usize, result: &Result<Answer, RequestError>) {
        let writes = self.devices[device].has_written(self.now, result, &mut self.context);
        self.counters.persistent_writes += writes;
        if writes > 0 {
            self.tell_what_waits(device);
        }
    }

    fn take_step(&mut self, active: Active, step: Step) {
        let (device, point) = (active.device, active.flow.point());
        match step {
            // It goes on with another connection.
            Step::Ask(call) if self.link_state == LinkState::Renewing => {
                self.settling.push(Settling { until: self.now, active, then: Then::Ask(call) });
            }
            Step::Ask(_) if self.link_state != LinkState::Up => {
                let mut active = active;
                let state = &self.devices[device];
                let lost = Err(RequestError::Link("it is down".into()));
                let step = active.flow.answered(state.device(), state.known(), &lost);
                self.take_step(active, step);
            }
            Step::Ask(_) if self.next_poll_confirms(&active) => {
                self.devices[device].want_poll(point);
                let until = self.now + POLL_AWAITED;
                self.settling.push(Settling { until, active, then: Then::ReadBackUnlessPolled });
            }
            // The device holds something else by now.
            Step::Ask(call) if active.is_early && call.is_write() => self.let_wait_again(active),
            Step::Ask(call) => {
                if let (true, Some(reason)) =
                    (call.is_write(), self.devices[device].is_spent(self.now, point))
                {
                    let outcome = Outcome::new(OutcomeKind::Refused, active.flow.wanted(), reason);
                    self.end_command(active, outcome);
                    return;
                }
                if call.is_write() {
                    self.counters.writes += 1;
                    self.devices[device].about_to_write(self.now, point, &mut self.context);
                }
                self.active = Some(active);
                self.send(device, call, Purpose::Command);
            }
            Step::Settle(time) => {
                self.settling.push(Settling { until: self.now + time, active, then: Then::ReadBack });
            }
            Step::AskLater(time, call) => {
                self.settling.push(Settling { until: self.now + time, active, then: Then::Ask(call) });
            }
            Step::Finished(outcome) => {
                let is_done = matches!(outcome.kind, OutcomeKind::Done | OutcomeKind::Unchanged);
                if is_done && !active.orders.is_empty() {
                    self.devices[device].command_ended(self.now, point, &outcome, &mut self.context);
                    let Active { target, wanted, came_at, orders, .. } = active;
                    self.begin_order(device, target, wanted, came_at, orders);
                } else {
                    self.end_command(active, outcome);
                }
            }
        }
    }

    /// Whether the next poll will read back what was written, so that no request of its own is needed. A
    /// fast point is polled soon anyway; what decides about others is read at once.
    fn next_poll_confirms(&self, active: &Active) -> bool {
        let device = &self.devices[active.device];
        let is_point = matches!(active.target, Target::Point(_));
        // Where polls end soon, what has begun is still brought to its end.
        let goes_on = !self.stopping && !device.is_leaving && self.requests.pause.is_none();
        goes_on && is_point && active.flow.only_confirms() && device.is_polled_fast(active.flow.point())
    }

    /// A poll of a device has brought these words for `span`, or nothing.
    pub(super) fn poll_ended(&mut self, device: usize, span: Span, words: Option<&[u16]>) {
        let is_read_back = |settling: &Settling, devices: &[DeviceState]| {
            let awaits_poll = matches!(settling.then, Then::ReadBackUnlessPolled);
            let is_of_it = awaits_poll && settling.active.device == device;
            is_of_it && span.contains(devices[device].details(settling.active.flow.point()).at.span)
        };
        let Some(words) = words else {
            for settling in &mut self.settling {
                if is_read_back(settling, &self.devices) {
                    (settling.until, settling.then) = (self.now, Then::ReadBack);
                }
            }
            return;
        };
        while let Some(at) = self.settling.iter().position(|settling| is_read_back(settling, &self.devices)) {
            let Settling { mut active, .. } = self.settling.remove(at);
            let state = &self.devices[device];
            let own = state.details(active.flow.point()).at.span;
            let begin = usize::from(own.first() - span.first());
            let own_words = words.get(begin..begin + own.count() as usize).unwrap_or_default().to_vec();
            let step = active.flow.answered(state.device(), state.known(), &Ok(Answer::Words(own_words)));
            self.take_step(active, step);
        }
    }

    /// Nothing has been written of it, nor may be yet.
    fn let_wait_again(&mut self, active: Active) {
        let Active { device, target, .. } = active;
        // Whatever waits for the same is newer, and keeps its place, also where nobody can say yet whether it is good.
        if self.waiting.iter().any(|waiting| (waiting.device, waiting.target) == (device, target)) {
            let outcome = active.wanted.ended(OutcomeKind::Expired, REPLACED);
            return self.end_command(active, outcome);
        }
        let from = self.devices[device].writable_at(target);
        self.let_wait(Waiting::new(from, device, target, active.wanted, false));
    }

    fn end_command(&mut self, active: Active, outcome: Outcome) {
        let Active { device, target, wanted, flow, .. } = active;
        self.setting_ended(device, target, &outcome);
        self.devices[device].command_ended(self.now, flow.point(), &outcome, &mut self.context);
        // Of a thing it names what was wanted of the thing, and holds what its last point answered.
        self.tell_outcome(device, target, wanted.of(outcome));
    }

    fn setting_ended(&mut self, device: usize, target: Target, outcome: &Outcome) {
        if let Target::Setting(point) = target {
            self.wrote_setting = true;
            self.devices[device].setting_ended(self.now, point, outcome);
        }
    }

    pub(super) fn tell_outcome(&mut self, device: usize, target: Target, outcome: Outcome) {
        if matches!(target, Target::Setting(_)) {
            return;
        }
        let state = &self.devices[device];
        let topic = self.context.topics_of(state.name()).outcome(state.name_of(target));
        self.context.publish(Message::once(topic, outcome.to_json()));
    }

    /// When the next command that was written can be read back.
    pub(super) fn settled_at(&self) -> Option<Time> {
        self.settling.iter().map(|settling| settling.until).min()
    }
}

/// A point that was written and is not yet read back is left alone until then.
fn can_begin(devices: &[DeviceState], settling: &[Settling], now: Time, waiting: &Waiting) -> bool {
    let device = &devices[waiting.device];
    let is_settling = |point: &PointIndex| {
        let same = |active: &Active| active.device == waiting.device && active.flow.point() == *point;
        settling.iter().any(|settling| same(&settling.active))
    };
    device.can_take(now, waiting.target, &waiting.wanted.text)
        && !device.written_by(waiting.target).iter().any(is_settling)
}
