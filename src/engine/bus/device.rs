//! One device on the bus: whether it is there, what is known of it, what to ask it next.

mod beats;
mod fetching;
mod keeping;
mod obeying;
mod patience;
mod reporting;
mod requested;
mod telling;
mod turnaround;
mod wear;
mod whole;
mod withheld;

use std::collections::BTreeMap;

use crate::engine::address::Span;
use crate::engine::codec;
use crate::engine::command::words_of;
use crate::engine::device::{Device, Point, PointIndex, Poll};
use crate::engine::health::Counters;
use crate::engine::homeassistant::{self, Outline};
use crate::engine::identity;
use crate::engine::modbus::{Answer, Call, Discarded, Reply, Request, RequestError};
use crate::engine::plan::{self, Read, Tariff};
use crate::engine::schedule::{Outlook, Pace, Place, Polls, Urgency};
use crate::engine::settings::{DeviceSettings, Eeprom};
use crate::engine::state::{Absorbed, Values};
use crate::engine::time::{Duration, Time};
use crate::engine::upkeep::Upkeep;
use crate::engine::value::Missing;

use super::load::Load;
use super::waiting::Target;
use super::{Context, Severity};
use beats::Beats;
use keeping::Keeping;
use patience::{FAILURES_UNTIL_OFFLINE, Patience};
use turnaround::Turnaround;
use wear::Wear;
use whole::Whole;
use withheld::{PAUSE_BUSY_LONG, Withheld};

/// A device that is not the one that the profile describes is asked again after this.
const PAUSE_MISMATCH: Duration = Duration::from_secs(30);
/// After a write a device is waited for fully for so long,
const BUSY_AFTER_WRITE: Duration = Duration::from_secs(5);
/// and when it may have been slow, for so long.
const SLOW_PERHAPS: Duration = Duration::from_secs(30);

pub(super) struct DeviceState {
    settings: DeviceSettings,
    tariff: Tariff,
    /// What is lost with each request of the silence that it wants.
    pub(super) idle_rest: Duration,
    turnaround: Turnaround,
    /// Its share of the wire.
    load: Load,
    values: Values,
    polls: Polls,
    /// What the device has refused to give in one answer.
    refused: Vec<Span>,
    withheld: Withheld,
    presence: Presence,
    patience: Patience,
    wear: Wear,
    upkeep: Upkeep,
    keeping: Keeping,
    /// How long a request may wait, as the bus and the profile ask for it.
    full_timeout: Duration,
    /// Nothing is asked before.
    paused_until: Time,
    /// It may be slow until then: it has been written to, or seemed to be slow.
    busy_until: Time,
    served_at: Time,
    last_answer_end: Time,
    last_answer_at: Option<Time>,
    counters: Counters,
    identity: Option<String>,
    told_available: Option<bool>,
    /// Without dates.
    told_info: String,
    told_info_at: Time,
    /// The last info said that the device is there.
    told_present: bool,
    whole: Whole,
    announced: Option<Outline>,
    announcement_due: bool,
    /// A `get` or a command wants these told even if they have not changed.
    tell_anyway: Vec<PointIndex>,
    warned_of_retained: Vec<Target>,
    /// Of which the broker holds a retained command, as far as this connection has told.
    retained_at_the_broker: Vec<Target>,
    /// What each thing was last told to be, and when.
    told_things: Vec<Option<(String, Time)>>,
    beats: Beats,
    /// When the points that tell events last did.
    happened: BTreeMap<PointIndex, Time>,
    /// How it keeps up with its periods, where it wants silence before each request.
    own_pace: Pace,
    /// The configuration knows it no more, or knows it otherwise: nothing more is begun with it.
    pub(super) is_leaving: bool,
}

#[derive(Clone, Debug, PartialEq)]
enum Presence {
    /// Not heard of since the link came up, or fallen silent.
    Absent { reason: String },
    /// Something answers, but it is not the device that the profile describes.
    Mismatch { reason: String },
    /// Identified and being read.
    Present,
}

/// What the schedule wants from this device.
pub(super) enum Polled {
    Identification(Call),
    Read(usize, Call),
}

/// Where a device stood before it was asked.
#[derive(Clone, Copy, Debug)]
pub(super) struct Turn {
    place: Option<Place>,
    served_at: Time,
}

impl Turn {
    /// It was asked out of turn.
    pub(super) fn was_wanted(&self) -> bool {
        self.place.is_some_and(|place| place.was_wanted())
    }
}

impl DeviceState {
    pub(super) fn new(
        settings: DeviceSettings,
        tariff: Tariff,
        idle_rest: Duration,
        eeprom: Eeprom,
    ) -> DeviceState {
        let values = Values::new(&settings.device);
        let turnaround = Turnaround::default();
        let reads = plan::plan(&settings.device, tariff.cost(turnaround.planned_with() + idle_rest), &[]);
        let polls = Polls::new(reads, settings.device.wire.intervals, |point| values.is_selector(point));
        DeviceState {
            tariff,
            idle_rest,
            turnaround,
            load: Load::default(),
            values,
            polls,
            refused: Vec::new(),
            withheld: Withheld::default(),
            presence: Presence::Absent { reason: "not yet asked".into() },
            patience: Patience::default(),
            wear: Wear::new(eeprom),
            upkeep: Upkeep::default(),
            keeping: Keeping::default(),
            full_timeout: Duration::ZERO,
            paused_until: Time::default(),
            busy_until: Time::default(),
            served_at: Time::default(),
            last_answer_end: Time::default(),
            last_answer_at: None,
            counters: Counters::default(),
            identity: None,
            told_available: None,
            told_info: String::new(),
            told_info_at: Time::default(),
            told_present: false,
            whole: Whole::default(),
            announced: None,
            announcement_due: true,
            tell_anyway: Vec::new(),
            warned_of_retained: Vec::new(),
            retained_at_the_broker: Vec::new(),
            told_things: vec![None; settings.device.things.len()],
            beats: Beats::new(&settings.device),
            happened: BTreeMap::new(),
            own_pace: Pace::default(),
            is_leaving: false,
            settings,
        }
    }

    /// The cheapest reads, as far as it is known what they cost and what the device refuses.
    fn plan(&self) -> Vec<Read> {
        let cost = self.tariff.cost(self.turnaround.planned_with() + self.idle_rest);
        plan::plan(&self.settings.device, cost, &self.refused)
    }

    // What others ask about it.

    pub(super) fn name(&self) -> &str {
        &self.settings.name
    }

    pub(super) fn device(&self) -> &Device {
        &self.settings.device
    }

    pub(super) fn details(&self, point: PointIndex) -> &Point {
        &self.settings.device.points[point]
    }

    pub(super) fn known(&self) -> &[Option<i128>] {
        self.values.known()
    }

    pub(super) fn served_at(&self) -> Time {
        self.served_at
    }

    /// Whether its outputs fall to their safe state when nobody speaks to it, or writes to it.
    pub(super) fn wants_feeding(&self) -> bool {
        let device = &self.settings.device;
        device.wire.watchdog.is_some() || device.points.iter().any(|point| point.heartbeat.is_some())
    }

    pub(super) fn has_settings(&self) -> bool {
        !self.settings.wanted.is_empty()
    }

    pub(super) fn is_present(&self) -> bool {
        self.presence == Presence::Present
    }

    fn reason(&self) -> Option<String> {
        match &self.presence {
            Presence::Absent { reason } | Presence::Mismatch { reason } => Some(reason.clone()),
            Presence::Present => None,
        }
    }

    // What to ask it.

    /// When it wants to be asked again.
    pub(super) fn due_at(&self) -> Option<Time> {
        let rested = self.paused_until.max(self.rested_at());
        match self.presence {
            Presence::Present => self.polls.due_at().map(|due| due.max(rested)),
            _ => Some(rested),
        }
    }

    /// Before, it wants silence. Others may be asked meanwhile.
    fn rested_at(&self) -> Time {
        self.last_answer_end + self.settings.device.wire.limits.delay
    }

    /// Whether something is due that only waits until the device has rested.
    pub(super) fn only_rests(&self, now: Time) -> bool {
        now < self.rested_at() && self.is_present() && self.polls.due_at().is_some_and(|due| due <= now)
    }

    /// Whether it wants silence before each request.
    pub(super) fn wants_rest(&self) -> bool {
        !self.settings.device.wire.limits.delay.is_zero()
    }

    /// Whether its requests and the silence before them take so long that its periods are longer by more than those
    /// of its bus.
    fn is_filled_by_rest(&self, of_bus: &Pace) -> bool {
        let cost = self.tariff.cost(self.turnaround.planned_with());
        let rest = self.settings.device.wire.limits.delay;
        !rest.is_zero() && self.polls.filled(|read| cost.time_of(read.span) + rest) > of_bus.stretch()
    }

    /// Nothing is due on its bus.
    pub(super) fn is_idle(&mut self, now: Time) {
        if !self.only_rests(now) {
            self.own_pace.idle(now);
        }
    }

    /// How urgent its next question can be at most.
    pub(super) fn outlook(&self, now: Time) -> Outlook {
        let reads = if self.is_present() { self.polls.by_period(now) } else { None };
        Outlook { not_before: self.paused_until.max(self.rested_at()), reads }
    }

    pub(super) fn most_urgent(&self, now: Time) -> Option<(Polled, Urgency)> {
        self.next_question(now, Urgency::Wanted, |polls| polls.most_urgent(now))
    }

    /// What has waited longest, wanted at once or not, and for how many of its periods.
    pub(super) fn longest_waiting(&self, now: Time) -> Option<(Polled, f64)> {
        self.next_question(now, f64::INFINITY, |polls| polls.longest_waiting(now))
    }

    /// Its identification, if that is not known, which is as urgent as `of_identification`; or the read that
    /// `of_polls` finds.
    fn next_question<U>(
        &self,
        now: Time,
        of_identification: U,
        of_polls: impl FnOnce(&Polls) -> Option<(usize, U)>,
    ) -> Option<(Polled, U)> {
        if now < self.paused_until || now < self.rested_at() {
            return None;
        }
        if self.presence != Presence::Present {
            if let Some(call) = self.identification_call() {
                return Some((Polled::Identification(call), of_identification));
            }
        }
        let (index, urgency) = of_polls(&self.polls)?;
        // After a request in vain another one than the most urgent: it may be that read alone which gets no answer.
        // After two, where it seems to be in step with what disturbs it: then it is asked twice in a row.
        let asks_other_after = if self.polls.is_in_step(index) { 2 } else { 1 };
        let other = (self.patience.failures() % 3 == asks_other_after).then(|| self.polls.oldest(now));
        Some((self.read_call(other.flatten().unwrap_or(index)), urgency))
    }

    pub(super) fn read_call(&self, index: usize) -> Polled {
        Polled::Read(index, Call::Read(self.span_of(index)))
    }

    fn identification_call(&self) -> Option<Call> {
        self.settings.device.identify.as_ref().map(identity::question)
    }

    /// Returns what its turn was before.
    pub(super) fn begin_read(&mut self, read: usize, now: Time, pace: &mut Pace) -> Turn {
        // What keeps it behind is its own rest, which says nothing of the line's other devices.
        let pace = if self.is_filled_by_rest(pace) { &mut self.own_pace } else { pace };
        let place = self.polls.begin(read, now, pace);
        Turn { place: Some(place), ..self.turn() }
    }

    pub(super) fn turn(&self) -> Turn {
        Turn { place: None, served_at: self.served_at }
    }

    pub(super) fn span_of(&self, read: usize) -> Span {
        self.polls.read(read).span
    }

    /// Whether one of the fast polls reads this point at its own place, and nothing waits for what it
    /// decides.
    pub(super) fn is_polled_fast(&self, point: PointIndex) -> bool {
        self.details(point).poll == Poll::Fast
            && self.is_present()
            && !self.values.is_selector(point)
            && self.polls.reads_at(point, self.details(point).at)
    }

    /// The point's poll comes before others, since it is a command's read-back.
    pub(super) fn want_poll(&mut self, point: PointIndex) {
        self.polls.want(point);
    }

    /// The read that had begun never was on the wire.
    pub(super) fn take_back(&mut self, read: usize, before: Turn) {
        self.served_at = before.served_at;
        if let Some(place) = before.place {
            self.polls.take_back(read, place);
        }
    }

    /// The device is being asked: returns the time before which nothing may be sent.
    pub(super) fn asked(&mut self, now: Time) -> Time {
        self.served_at = now;
        now.max(self.rested_at())
    }

    /// How long the next request may wait for its answer; less where it is known how quick that is, for the
    /// reads of [`DeviceState::is_well_known`].
    pub(super) fn timeout(&mut self, of_bus: Duration, is_well_known: bool) -> Duration {
        let demanded = self.settings.device.wire.response_timeout;
        self.full_timeout = demanded.unwrap_or(of_bus).max(of_bus);
        match is_well_known && !self.patience.is_probing() {
            true => self.patience.hurried_timeout(self.full_timeout, demanded),
            false => self.patience.timeout(self.full_timeout, demanded),
        }
    }

    /// Whether it is known how long the device takes for this read. One that has just been written to may
    /// still be busy with its EEPROM.
    pub(super) fn is_well_known(&self, read: usize, now: Time) -> bool {
        self.polls.is_well_known(read) && now >= self.busy_until
    }

    pub(super) fn request(&mut self, now: Time, call: Call, timeout: Duration) -> Request {
        if call.is_write() {
            self.busy_until = now + BUSY_AFTER_WRITE;
        }
        let is_probe = self.patience.is_probing();
        Request {
            unit: self.settings.unit,
            call,
            any_exception: self.settings.device.wire.quirks.exception_function_varies,
            is_probe,
            may_take: Some(self.full_timeout).filter(|full| !is_probe && timeout < *full),
        }
    }

    /// The point is wanted now, and told even if it has not changed.
    pub(super) fn want(&mut self, point: PointIndex) {
        self.polls.want(point);
        if !self.tell_anyway.contains(&point) {
            self.tell_anyway.push(point);
        }
    }

    // What happened to it.

    /// Before anything is known: what an earlier run left at the broker is taken back.
    pub(super) fn introduce(&mut self, now: Time, context: &mut Context) {
        self.publish_availability(false, context);
        // Less than all would take entities away that were announced before the start.
        if homeassistant::is_settled(&self.settings.device, self.values.known()) {
            self.announce(context);
        }
        self.tell_all(now, context);
        self.tell_info(now, context);
    }

    /// The link is up: ask at once.
    pub(super) fn reconnect(&mut self, now: Time) {
        self.patience.start_anew();
        self.paused_until = now;
        self.polls.want_all();
    }

    pub(super) fn count(&mut self, now: Time, reply: &Reply, is_read: bool) {
        self.counters.count_result(&reply.result);
        // What was late may be another's.
        self.counters.count_discarded(Discarded { late_replies: 0, ..reply.discarded });
        self.last_answer_end = reply.last_byte_at.unwrap_or(now);
        if matches!(reply.result, Ok(_) | Err(RequestError::Exception(_))) {
            self.last_answer_at = Some(now);
            let latency = reply.first_byte_at.map(|first| first - reply.sent_at);
            self.patience.answered(latency);
            if let Some(latency) = latency.filter(|_| is_read) {
                self.patience.took(now, latency);
            }
        }
    }

    pub(super) fn identified(
        &mut self,
        now: Time,
        result: Result<Answer, RequestError>,
        context: &mut Context,
    ) {
        match (result, &self.settings.device.identify) {
            (Ok(answer), Some(identify)) => match identity::check(identify, &answer) {
                Ok(identity) => {
                    self.identity = Some(identity);
                    self.arrive(now, context);
                }
                Err(found) => self.mistake(now, found, context),
            },
            (Err(error @ RequestError::Exception(5 | 6)), _) => {
                self.lose(now, &format!("it answers its identification with {error}"), context);
                self.paused_until = now + PAUSE_BUSY_LONG;
            }
            (Err(RequestError::Exception(code)), _) => {
                let reason = format!("it answers its identification with exception {code}: another device?");
                self.mistake(now, reason, context);
            }
            (Err(error), _) => self.failed(now, &error, context),
            (Ok(_), None) => {}
        }
    }

    fn arrive(&mut self, now: Time, context: &mut Context) {
        if let Presence::Absent { reason } | Presence::Mismatch { reason } = &self.presence {
            if self.last_answer_at.is_some() && reason != "not yet asked" {
                let text = format!("device {} is back", self.settings.name);
                context.say(Severity::Info, text);
            }
        }
        self.presence = Presence::Present;
        self.paused_until = now;
        self.polls.want_all();
    }

    fn mistake(&mut self, now: Time, reason: String, context: &mut Context) {
        self.paused_until = now + PAUSE_MISMATCH;
        let presence = Presence::Mismatch { reason: reason.clone() };
        if self.presence != presence {
            context.say(Severity::Warning, format!("device {}: {reason}", self.settings.name));
            self.presence = presence;
            self.disappear(now, context);
        }
    }

    /// The device (or the way to it) is gone.
    pub(super) fn lose(&mut self, now: Time, reason: &str, context: &mut Context) {
        let presence = Presence::Absent { reason: reason.to_string() };
        if self.presence != presence {
            self.presence = presence;
            self.disappear(now, context);
        }
    }

    fn disappear(&mut self, now: Time, context: &mut Context) {
        self.publish_availability(false, context);
        self.values.lose_all(Missing::Offline);
        self.wake_reads();
        // It is asked as after a connect, selectors first: what lived only in another mode than the device
        // was in may not be answered at all.
        self.polls.want_all();
        self.withheld.forget();
        self.beats.stop();
        self.upkeep.forget();
        self.tell_all(now, context);
        self.tell_info(now, context);
    }

    pub(super) fn failed(&mut self, now: Time, error: &RequestError, context: &mut Context) {
        self.patience.unanswered();
        let demanded = self.settings.device.wire.response_timeout;
        self.paused_until = now + self.patience.pause(now, self.full_timeout, demanded);
        if self.patience.failures() == FAILURES_UNTIL_OFFLINE {
            let advice = error.what_to_check().map_or(String::new(), |advice| format!("; {advice}"));
            let reason = format!("{error}, {FAILURES_UNTIL_OFFLINE} times in a row{advice}");
            context.say(Severity::Warning, format!("device {} is offline: {reason}", self.settings.name));
            self.lose(now, &reason, context);
        }
    }

    /// How long its last request could have waited, had it not been a probe.
    pub(super) fn full_timeout(&self) -> Duration {
        self.full_timeout
    }

    /// Whether the request that ends now only asked whether it is there again.
    pub(super) fn is_probed(&self) -> bool {
        self.patience.is_probing()
    }

    /// So many of its answers came too late.
    pub(super) fn count_late(&mut self, answers: u32) {
        self.counters.late_replies += u64::from(answers);
    }

    /// Its answer to an earlier request was heard, so long after that.
    pub(super) fn was_late(&mut self, now: Time, after: Duration) {
        self.patience.took(now, after);
        self.shows_sign(now);
    }

    /// A late answer may come until then.
    pub(super) fn rest_until(&mut self, until: Time) {
        self.paused_until = self.paused_until.max(until);
    }

    /// Something was heard that may be its late answer. One that is slow again while it is waited for fully
    /// is known to be.
    pub(super) fn shows_sign(&mut self, now: Time) {
        if self.presence == Presence::Present {
            self.busy_until = self.busy_until.max(now + SLOW_PERHAPS);
        } else if self.patience.shows_sign() {
            self.paused_until = self.paused_until.min(now);
        }
    }

    /// The line was left alone for so long because this device did not answer a probe: that counts in its
    /// share of the bus.
    pub(super) fn charge(&mut self, now: Time, waited: Duration) {
        if self.patience.is_probing() {
            self.paused_until = self.paused_until.max(now + Patience::pause_after(waited));
        }
    }

    pub(super) fn polled(
        &mut self,
        now: Time,
        index: usize,
        result: Result<Answer, RequestError>,
        context: &mut Context,
    ) {
        let answered = matches!(result, Ok(_) | Err(RequestError::Exception(_)));
        if answered && self.presence != Presence::Present {
            // A device without an identification is there when it answers a read.
            self.arrive(now, context);
            self.polls.begin(index, self.served_at, &mut Pace::default());
        }
        match result {
            Ok(answer) => {
                self.polls.end(index);
                self.given(index, context);
                self.polls.know_better(index);
                let read = self.polls.shared_read(index);
                let words = match answer {
                    Answer::Words(words) => words,
                    bits => words_of(&bits),
                };
                let absorbed = self.values.absorb_poll(now, &self.settings.device, &read, &words);
                if !absorbed.is_told || !self.tell_anyway.is_empty() {
                    self.learn(now, &read, absorbed, context);
                    let again = self.told_again_after(read.poll, context.republish);
                    self.values.has_been_told(&read, again);
                }
            }
            // It was only asked whether it is there.
            Err(RequestError::Exception(_)) if self.polls.read(index).points.is_empty() => {
                self.polls.end(index)
            }
            Err(RequestError::Exception(code)) => self.refused(now, index, code, context),
            Err(error) => {
                self.failed(now, &error, context);
                let is_unheard = matches!(
                    error,
                    RequestError::Timeout | RequestError::Unreachable(_) | RequestError::Link(_)
                );
                if self.is_present() {
                    self.polls.try_again(index, now, self.patience.failures() == 1);
                }
                // It is there, and only its answer was spoilt.
                if !(self.is_present() && is_unheard) {
                    self.polls.want_again(index);
                }
                self.unanswered(now, index, &error, context);
            }
        }
        self.after_news(now, context);
        self.adapt_plan(context);
    }

    fn absorb(&mut self, now: Time, read: &Read, words: &[u16], context: &mut Context) {
        let absorbed = self.values.absorb(now, &self.settings.device, read, words);
        self.learn(now, read, absorbed, context);
    }

    /// Tells what a read has brought, and does what follows from it.
    fn learn(&mut self, now: Time, read: &Read, absorbed: Absorbed, context: &mut Context) {
        for point in &absorbed.dropped {
            self.polls.want(*point);
            self.tell(now, *point, context);
        }
        if absorbed.decided {
            self.announcement_due = true;
            self.wake_reads();
        }
        for (point, raw) in absorbed.unnamed {
            let name = &self.settings.device.points[point].name;
            let text =
                format!("device {}: {name} holds {raw}, which the profile does not name", self.settings.name);
            context.say(Severity::Warning, text);
        }
        for (point, _) in &read.points {
            let again = self.told_again_after(self.details(*point).poll, context.republish);
            if !self.tell_anyway.is_empty() || self.values.may_be_told(now, *point, again) {
                self.tell(now, *point, context);
            }
        }
    }

    /// Reads that hold only points which do not live now are not sent.
    fn wake_reads(&mut self) {
        let (device, known) = (&self.settings.device, self.values.known());
        let sleeps = |point: PointIndex| codec::resolve(device, point, known) == Err(Missing::NotInThisMode);
        self.polls
            .sleep(|read| !read.points.is_empty() && read.points.iter().all(|(point, _)| sleeps(*point)));
    }

    /// After a poll: what became complete with it is told.
    fn after_news(&mut self, now: Time, context: &mut Context) {
        self.tell_things(now, context);
        if self.presence != Presence::Present {
            return;
        }
        if self.polls.first_round_is_over() {
            if self.announcement_due {
                self.announce(context);
            }
            self.publish_availability(true, context);
            let drift_changed = self.keep_settings(now, context);
            let is_news = self.values.take_missing_changed() || !self.told_present || drift_changed;
            if is_news || self.info_is_old(now, context) {
                self.tell_info(now, context);
            }
        }
    }
}
