//! What is wrong on a line that is open: requests that collide, and another master.
//!
//! Modbus RTU has one master. A second one, perhaps a maker's tool that somebody has plugged in, is heard by
//! the requests that are not ours. The link goes on: what collides with them is asked again.

use std::collections::VecDeque;

use super::{Action, Bus, DeviceState, InFlight, Severity};
use crate::engine::modbus::{Discarded, Reply, Request, RequestError, RequestsOfOthers};
use crate::engine::settings::Link;
use crate::engine::time::{Duration, Time};

/// So often a read that has collided is asked again before it counts as unanswered.
const REPEATS_MAX: u32 = 3;
/// The repetition comes at random within this time, or two masters that keep step would collide again.
const SPREAD: Duration = Duration::from_millis(50);
/// A read's request is on the wire for less, also at 1200 baud.
const TRANSMITTING: Duration = Duration::from_millis(80);
/// What was heard this long ago says nothing of now.
const MEMORY: Duration = Duration::from_secs(60);
/// Noise that happens to be a request is rare, and does not come twice in a minute.
const REQUESTS_UNTIL_TOLD: usize = 2;
/// Requests of others that are remembered.
const HEARD_MAX: usize = 1000;
/// Units that are named.
const UNITS_MAX: usize = 3;

/// Until when no poll is sent behind a request without an answer, and nothing to the device.
pub(super) struct Silence {
    of_line: Time,
    of_device: Time,
}

/// What was heard on the line beside the answers.
#[derive(Debug, Default)]
pub(super) struct Line {
    /// The request in flight.
    asked: Option<(Request, Duration)>,
    collisions_in_a_row: u32,
    /// When requests of others were heard, and to which unit.
    others: VecDeque<(Time, u8)>,
    /// The log has been told of another master.
    told: bool,
    /// The device that was last given up before its full time, and until when its late answer may come.
    given_up: Option<(usize, Time)>,
    /// No poll is sent before.
    polls_from: Time,
}

impl Line {
    fn hear(&mut self, now: Time, others: RequestsOfOthers) {
        let count = (others.count as usize).min(HEARD_MAX);
        self.others.extend(std::iter::repeat_n((now, others.unit), count));
        let forgotten = self.others.iter().take_while(|(at, _)| now.since(*at) > MEMORY).count();
        let too_many = self.others.len().saturating_sub(HEARD_MAX);
        self.others.drain(..forgotten.max(too_many));
    }

    /// No poll is sent before.
    pub(super) fn polls_from(&self) -> Time {
        self.polls_from
    }

    /// What is asked next cannot wait.
    pub(super) fn hurry(&mut self) {
        self.polls_from = Time::default();
    }

    /// What is wrong with the line, for people.
    pub(super) fn trouble(&self, now: Time) -> Option<String> {
        let lately = self.others.iter().filter(|(at, _)| now.since(*at) <= MEMORY);
        let count = lately.clone().count();
        if count < REQUESTS_UNTIL_TOLD {
            return None;
        }
        let mut units: Vec<u8> = lately.map(|(_, unit)| *unit).collect();
        units.sort_unstable();
        units.dedup();
        let more = if units.len() > UNITS_MAX { " and others" } else { "" };
        let named: Vec<String> = units.iter().take(UNITS_MAX).map(u8::to_string).collect();
        let plural = if units.len() == 1 { "" } else { "s" };
        let named = named.join(", ");
        Some(format!(
            "another master speaks on this line: {count} requests to unit{plural} {named}{more} in the last \
             minute"
        ))
    }
}

impl Bus {
    /// Asks the line, and remembers what, in case it collides.
    pub(super) fn ask(&mut self, request: Request, not_before: Time, timeout: Duration) {
        self.line.asked = Some((request.clone(), timeout));
        self.context.actions.push_back(Action::Send { request, not_before, timeout });
    }

    /// Takes what was heard beside a reply, and says once when another master begins or ends.
    pub(super) fn look_for_others(&mut self, reply: &Reply) {
        self.line.hear(self.now, reply.discarded.requests_of_others);
        let trouble = self.line.trouble(self.now);
        if trouble.is_some() == self.line.told {
            return;
        }
        self.line.told = trouble.is_some();
        let (severity, text) = match trouble {
            Some(trouble) => (Severity::Warning, trouble),
            None => (Severity::Info, "no other master has spoken for a minute".into()),
        };
        self.context.say(severity, format!("bus {}: {text}", self.name));
    }

    /// Counts late answers for the device whose they are: another one may be asked when they come.
    pub(super) fn count_late(&mut self, asked: Option<usize>, discarded: Discarded) {
        let is_of = |device: &DeviceState| discarded.late.is_none_or(|late| late.unit == device.unit());
        let asked = asked.filter(|device| is_of(&self.devices[*device]));
        if let Some(device) = asked.or_else(|| self.devices.iter().position(is_of)) {
            self.devices[device].count_late(discarded.late_replies);
        }
    }

    /// Whether a device that was not waited for fully is only slower than that: its late answer is heard, or
    /// meets what another one says, and spoils it.
    pub(super) fn look_for_signs(&mut self, asked: Option<usize>, reply: &Reply) {
        let now = self.now;
        if let Some(late) = reply.discarded.late {
            let devices = self.devices.iter_mut().filter(|device| device.unit() == late.unit);
            devices.for_each(|device| device.was_late(now, late.after));
        }
        let Some(asked) = asked.filter(|_| !matches!(self.link, Link::Tcp { .. })) else { return };
        let is_probe = self.devices[asked].is_probed();
        let is_spoilt = match &reply.result {
            Ok(_) | Err(RequestError::Exception(_)) => reply.discarded.noise_bytes > 0,
            Err(RequestError::Link(_) | RequestError::Impossible(_)) => false,
            Err(_) => true,
        };
        if let Some((silent, until)) = self.line.given_up {
            if is_spoilt && !is_probe && silent != asked && reply.sent_at < until {
                self.devices[silent].shows_sign(now);
            }
        }
        let is_hurried = self.line.asked.as_ref().is_some_and(|(request, _)| request.may_take.is_some());
        if (is_probe || is_hurried) && reply.result == Err(RequestError::Timeout) {
            let full = self.devices[asked].full_timeout();
            self.line.given_up = Some((asked, reply.sent_at + if is_probe { full * 2 } else { full }));
        }
    }

    /// What is left alone behind the request that ends now, if nobody answered it: the line until a late answer would
    /// have come, and the device too, if it was not waited for as long as it may take. Each at random a little longer,
    /// or what disturbs the line at regular times might meet it again and again: a wait and the silence behind it last
    /// as long as those before them, so the line itself may lose whatever it begins with, whoever is asked.
    pub(super) fn silence_behind(&self, reply: &Reply) -> Option<Silence> {
        let (request, timeout) = self.line.asked.as_ref()?;
        let is_unanswered = !matches!(reply.result, Ok(_) | Err(RequestError::Exception(_)));
        // One that ended before its time is waited for by the line.
        let is_over = is_unanswered && self.now - reply.sent_at >= *timeout;
        if !is_over || request.is_probe || matches!(self.link, Link::Tcp { .. }) {
            return None;
        }
        let some_of = |time: Duration| at_random(self.now, time);
        Some(match request.may_take {
            // Others are asked meanwhile, after no more than that.
            Some(full) => Silence {
                of_line: self.now + some_of(full / 2),
                of_device: reply.sent_at + full * 2 + TRANSMITTING + some_of(full / 2),
            },
            None => {
                let until = self.now + *timeout + some_of(*timeout / 2);
                Silence { of_line: until, of_device: until }
            }
        })
    }

    /// Leaves the line and the device alone.
    pub(super) fn keep_silence(&mut self, device: usize, silence: &Silence) {
        self.devices[device].rest_until(silence.of_device);
        self.line.polls_from = silence.of_line;
    }

    /// Devices have got other numbers.
    pub(super) fn forget_given_up(&mut self) {
        self.line.given_up = None;
    }

    /// Asks a read that has collided again, after whatever may still come for it; returns the request if
    /// it has ended. A write is never repeated: who is at the other end of the line may have heard it whole,
    /// and its read-back tells what became of it.
    pub(super) fn repeat_collided(&mut self, in_flight: InFlight, reply: &Reply) -> Option<InFlight> {
        let asked = self.line.asked.take();
        if reply.result != Err(RequestError::Collision) {
            self.line.collisions_in_a_row = 0;
            return Some(in_flight);
        }
        let repeated = asked.filter(|(request, _)| {
            !request.call.is_write() && !self.stopping && self.line.collisions_in_a_row < REPEATS_MAX
        });
        let Some((request, timeout)) = repeated else {
            self.line.collisions_in_a_row = 0;
            return Some(in_flight);
        };
        self.line.collisions_in_a_row += 1;
        let not_before = reply.sent_at + timeout + at_random(self.now, SPREAD);
        self.in_flight = Some(InFlight { sent_at: not_before, ..in_flight });
        self.ask(request, not_before, timeout);
        None
    }
}

/// A part of `spread`: the middle of a product with a large odd number is as good as random.
pub(super) fn at_random(now: Time, spread: Duration) -> Duration {
    let part = (now.0.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40) as u32 % 1000;
    spread * part / 1000
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: u64) -> Time {
        Time::from_millis(seconds * 1000)
    }

    #[test]
    fn another_master_is_told_by_what_it_asked_in_the_last_minute() {
        let beginning = "another master speaks on this line: ";
        for (what, heard, now, expected) in [
            ("nothing", &[][..], 5, None),
            ("once may be noise", &[(5, 1, 7)], 6, None),
            ("one unit", &[(5, 1, 7), (8, 2, 7)], 9, Some("3 requests to unit 7")),
            ("two units", &[(5, 1, 7), (8, 2, 3)], 9, Some("3 requests to units 3, 7")),
            (
                "many units",
                &[(1, 1, 5), (2, 1, 4), (3, 1, 3), (4, 1, 2)],
                9,
                Some("4 requests to units 2, 3, 4 and others"),
            ),
            ("some of it long ago", &[(5, 4, 7), (60, 2, 7)], 66, Some("2 requests to unit 7")),
            ("all of it long ago", &[(5, 4, 7)], 66, None),
            ("without end", &[(5, 700, 7), (6, 700, 7)], 6, Some("1000 requests to unit 7")),
        ] {
            let mut line = Line::default();
            for (seconds, count, unit) in heard {
                line.hear(at(*seconds), RequestsOfOthers { count: *count, unit: *unit });
            }
            let expected = expected.map(|text| format!("{beginning}{text} in the last minute"));
            assert_eq!(line.trouble(at(now)), expected, "{what}");
        }
    }

    #[test]
    fn repetitions_are_spread() {
        let spread: Vec<Duration> = (0..20).map(|index| at_random(Time(index * 37_411), SPREAD)).collect();
        assert!(spread.iter().all(|part| *part < SPREAD));
        assert!(spread.iter().min() < Some(&(SPREAD / 4)) && spread.iter().max() > Some(&(SPREAD * 3 / 4)));
    }
}
