//! Which read of a bus is next: the one that is furthest past its period.
//!
//! Urgency is the time since a read had its turn, divided by its period: in the time of the bus ([`Pace`]), which goes
//! slower than the clock where the bus cannot keep up, so that every period stretches by the same factor and nothing
//! starves. Reads that are wanted at once (after a connect, after a write, on request) come before all of them,
//! selectors first.

use std::sync::Arc;

use crate::engine::address::{Address, Span};
use crate::engine::device::{Intervals, PointIndex, Poll};
use crate::engine::pace::{Moment, Pace};
use crate::engine::plan::Read;
use crate::engine::time::{Duration, Time};

/// The reads of one device, and when each is wanted.
#[derive(Clone, Debug)]
pub struct Polls {
    reads: Vec<Planned>,
}

#[derive(Clone, Debug)]
struct Planned {
    read: Arc<Read>,
    /// Those of the read, for whoever wants nothing else of it: what is not touched need not be fetched from memory.
    span: Span,
    poll: Poll,
    /// `None`: only after a connect or on request.
    period: Option<Duration>,
    /// Some point in it decides how others are read.
    has_selector: bool,
    /// Since when it counts its period, in the time of the bus.
    began_at: Option<Time>,
    /// When it was last sent.
    sent_at: Option<Time>,
    /// How long after the one before it a read began by its period, on average of the last few.
    real_period: Option<Duration>,
    wanted_now: bool,
    /// Has been asked in vain until then, and is due again whatever its period says.
    failed_at: Option<Time>,
    /// How often it has been answered since the device connected, as far as that is counted.
    answers: u8,
    /// Has been answered as it stands, be it before the device was away.
    was_given: bool,
    /// Has been answered since the device connected, if only with an exception.
    tried: bool,
    /// Answered with an exception: not asked again before.
    paused_until: Time,
    /// That was the last answer.
    is_refused: bool,
    /// Holds nothing that lives now.
    sleeps: bool,
}

/// For so long what was asked in vain waits behind everything that is due, also behind what has had more than its
/// share: or a device that dies would keep the line from it twice in a row, and one that is busy again and again. On
/// a bus that is never done with that its turn comes nevertheless.
const REPEATED_BEHIND: Duration = Duration::from_secs(2);

/// A read that comes at least so often, and has been answered so often since its device connected, holds no
/// surprise any more. After one that was not answered it takes a few more.
const PERIOD_WELL_KNOWN: Duration = Duration::from_secs(10);
const ANSWERS_WELL_KNOWN: u8 = 32;
const ANSWERS_TO_FORGIVE: u8 = 8;

/// Where a read stood in the schedule before it began.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Place {
    began_at: Option<Time>,
    sent_at: Option<Time>,
    real_period: Option<Duration>,
    wanted_now: bool,
    failed_at: Option<Time>,
    was_due: bool,
}

impl Place {
    /// Its period was over, and that is why it began.
    pub fn was_in_turn(&self) -> bool {
        self.was_due
    }

    /// It was wanted at once, and not because its period was over.
    pub fn was_wanted(&self) -> bool {
        self.wanted_now
    }
}

/// How much a read is wanted; the greatest is next.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd)]
pub enum Urgency {
    /// Time since it had its turn ÷ its period, in the time of the bus. Less than 1 where it is not due by that, and
    /// goes because nothing else is.
    Overdue(f64),
    Wanted,
    WantedSelector,
}

/// How urgent the next question to a device can be at most: enough to see that another one goes first.
#[derive(Clone, Copy, Debug)]
pub struct Outlook {
    /// Nothing is asked before.
    pub not_before: Time,
    /// `None`: it has to be looked at.
    pub reads: Option<ByPeriod>,
    /// How many reads a second it wants.
    pub wanted: f64,
    /// When it was last asked.
    pub served_at: Time,
}

/// Of the fast and of the slow reads, the one that has waited longest.
pub type ByPeriod = [Option<Waiting>; 2];

/// What a read waits for that is wanted by its period.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Waiting {
    /// Since when it counts its period, in the time of the bus.
    began_at: Time,
    /// When it was last sent, if that is known.
    sent_at: Option<Time>,
    /// In microseconds, since it is reckoned with for each device of a bus before each request.
    period: u64,
}

impl Waiting {
    /// By the time of the bus.
    fn due(&self) -> Time {
        Time(self.began_at.0.saturating_add(self.period))
    }

    /// By the clock, if the bus has nothing to do until then: on a bus where nothing else is due it waits for no more
    /// than its period.
    fn due_at(&self, at: Moment) -> Time {
        let by_turns = at.now + (self.due() - at.until);
        self.sent_at.map_or(by_turns, |sent_at| by_turns.min(sent_at + self.period()))
    }

    fn period(&self) -> Duration {
        Duration::from_micros(self.period)
    }

    /// `None`: it is not due.
    fn urgency(&self, at: Moment) -> Option<f64> {
        if at.turns >= self.due() {
            return Some((at.turns.0 - self.began_at.0) as f64 / self.period.max(1) as f64);
        }
        // What is due first goes first.
        (self.due_at(at) <= at.now).then(|| 1.0 / (1.0 + (self.due() - at.turns).as_secs_f64()))
    }

    /// What is as urgent as either of them at any time, or more.
    fn or(self, other: Waiting) -> Waiting {
        Waiting {
            began_at: self.began_at.min(other.began_at),
            sent_at: self.sent_at.into_iter().chain(other.sent_at).min(),
            period: self.period.min(other.period),
        }
    }
}

impl Outlook {
    /// `None`: nothing is due.
    pub fn at_most(&self, at: Moment) -> Option<Urgency> {
        if at.now < self.not_before {
            return None;
        }
        let Some(reads) = &self.reads else { return Some(Urgency::WantedSelector) };
        let overdue = reads.iter().flatten().filter_map(|waiting| waiting.urgency(at));
        overdue.reduce(f64::max).map(Urgency::Overdue)
    }
}

/// How many of its periods a read has waited.
fn periods(waited: Duration, period: Duration) -> f64 {
    waited.as_micros() as u64 as f64 / (period.as_micros() as u64).max(1) as f64
}

impl Polls {
    /// All of `reads`, each wanted at once. `is_selector` tells the points that others wait for.
    pub fn new(reads: Vec<Read>, intervals: Intervals, is_selector: impl Fn(PointIndex) -> bool) -> Polls {
        let planned = |read: Read| Planned {
            period: match read.poll {
                Poll::Fast => Some(intervals.fast),
                Poll::Slow => Some(intervals.slow),
                Poll::Once | Poll::Never => None,
            },
            has_selector: read.points.iter().any(|(point, _)| is_selector(*point)),
            span: read.span,
            poll: read.poll,
            read: Arc::new(read),
            began_at: None,
            sent_at: None,
            real_period: None,
            wanted_now: true,
            failed_at: None,
            answers: 0,
            was_given: false,
            tried: false,
            paused_until: Time::default(),
            is_refused: false,
            sleeps: false,
        };
        Polls { reads: reads.into_iter().map(planned).collect() }
    }

    pub fn read(&self, index: usize) -> &Read {
        &self.reads[index].read
    }

    /// The same, for whoever wants to keep it.
    pub fn shared_read(&self, index: usize) -> &Arc<Read> {
        &self.reads[index].read
    }

    pub fn span(&self, index: usize) -> Span {
        self.reads[index].span
    }

    pub fn class(&self, index: usize) -> Poll {
        self.reads[index].poll
    }

    pub fn len(&self) -> usize {
        self.reads.len()
    }

    pub fn is_empty(&self) -> bool {
        self.reads.is_empty()
    }

    /// Whether these are the very reads that there are.
    pub fn has_reads(&self, reads: &[Read]) -> bool {
        self.reads.iter().map(|planned| &*planned.read).eq(reads)
    }

    /// The most urgent read that may begin now.
    pub fn most_urgent(&self, at: Moment) -> Option<(usize, Urgency)> {
        let mut best: Option<(usize, Urgency)> = None;
        for (index, planned) in self.reads.iter().enumerate() {
            let Some(urgency) = planned.urgency(at) else { continue };
            if best.is_none_or(|(_, greatest)| urgency > greatest) {
                best = Some((index, urgency));
            }
        }
        best
    }

    /// By which the reads are wanted, if it is only their periods.
    pub fn by_period(&self, now: Time) -> Option<ByPeriod> {
        let mut oldest: ByPeriod = [None; 2];
        for planned in self.reads.iter().filter(|planned| !planned.sleeps) {
            if planned.wanted_now || planned.failed_at.is_some() || now < planned.paused_until {
                return None;
            }
            if let Some(waiting) = planned.waiting() {
                let oldest = &mut oldest[usize::from(planned.poll == Poll::Slow)];
                *oldest = Some(oldest.map_or(waiting, |oldest| oldest.or(waiting)));
            }
        }
        Some(oldest)
    }

    /// The read that has waited longest among those that may begin now, whether it is wanted at once or
    /// not, and for how many of its periods.
    pub fn longest_waiting(&self, at: Moment) -> Option<(usize, f64)> {
        let waiting = self.reads.iter().enumerate();
        let waiting = waiting.filter_map(|(index, planned)| Some((index, planned.waited(at)?)));
        waiting.reduce(|best, other| if other.1 > best.1 { other } else { best })
    }

    /// The read that began longest ago, due or not. Only if there is no other one that the device refuses,
    /// or that clears what it reads.
    pub fn oldest(&self, now: Time) -> Option<usize> {
        let awake = self.reads.iter().enumerate().filter(|(_, planned)| !planned.sleeps);
        let oldest = awake
            .min_by_key(|(_, planned)| (planned.read.alone, now < planned.paused_until, planned.began_at));
        oldest.map(|(index, _)| index)
    }

    /// Whether a read that is sent now and then takes `point` from this place.
    pub fn reads_at(&self, point: PointIndex, place: Address) -> bool {
        let holds = |planned: &Planned| planned.read.points.contains(&(point, place)) && !planned.sleeps;
        self.reads.iter().any(holds)
    }

    /// When the next read will be due, if nothing asks for one before.
    pub fn due_at(&self, at: Moment) -> Option<Time> {
        self.reads.iter().filter_map(|planned| planned.due_at(at)).min()
    }

    /// How many reads a second are wanted by their periods.
    pub fn wanted(&self) -> f64 {
        let awake = self.reads.iter().filter(|planned| !planned.sleeps);
        awake.filter_map(|planned| Some(1.0 / planned.period?.as_secs_f64().max(1e-6))).sum()
    }

    /// By how much longer than wanted it takes until the reads come round, on average of all turns.
    fn stretch(&self) -> f64 {
        let awake = self.reads.iter().filter(|planned| !planned.sleeps);
        let had =
            awake.filter_map(|planned| planned.period.map(|period| planned.real_period.unwrap_or(period)));
        self.wanted() / had.map(|period| 1.0 / period.as_secs_f64().max(1e-6)).sum::<f64>()
    }

    /// The read is being sent; returns where it stood before. `pace` is that of the
    /// whole bus.
    pub fn begin(&mut self, index: usize, now: Time, pace: &mut Pace) -> Place {
        let (at, lets_ahead) = (pace.at(now), pace.lets_ahead());
        let planned = &self.reads[index];
        let Planned { began_at, sent_at, real_period, wanted_now, failed_at, .. } = *planned;
        let is_for_period = !wanted_now && failed_at.is_none();
        // Whoever feeds a watchdog does not wait until it is due.
        let has_turn = |urgency| urgency >= 1.0 || lets_ahead;
        let in_turn =
            planned.waiting().filter(|waiting| is_for_period && waiting.urgency(at).is_some_and(has_turn));
        let last = planned.sent_at.map(|sent_at| now - sent_at);
        let counts_from = match in_turn {
            Some(waiting) => {
                let period = waiting.period();
                let stretch = last.map_or(1.0, |last| periods(last, period));
                pace.begin_turn(now, waiting.due(), period, stretch, || self.stretch())
            }
            None => pace.begin(now, planned.period),
        };
        let planned = &mut self.reads[index];
        planned.began_at = Some(counts_from);
        // A read that was wanted out of turn says nothing about the turns. One that was kept waiting is followed by one
        // that makes up for it.
        if is_for_period {
            planned.real_period =
                last.map(|last| planned.real_period.map_or(last, |mean| (mean * 3 + last) / 4));
        }
        planned.sent_at = Some(now);
        (planned.wanted_now, planned.failed_at) = (false, None);
        Place { began_at, sent_at, real_period, wanted_now, failed_at, was_due: in_turn.is_some() }
    }

    /// The device turned out to be there by answering the read.
    pub fn began(&mut self, index: usize, sent_at: Time) {
        let planned = &mut self.reads[index];
        (planned.sent_at, planned.wanted_now) = (Some(sent_at), false);
    }

    /// The read was not sent after all.
    pub fn take_back(&mut self, index: usize, before: Place) {
        let planned = &mut self.reads[index];
        planned.began_at = before.began_at;
        (planned.sent_at, planned.real_period) = (before.sent_at, before.real_period);
        planned.wanted_now |= before.wanted_now;
        planned.failed_at = planned.failed_at.or(before.failed_at);
    }

    /// The poll class's period as the bus keeps it now: that of the slowest of its reads, a read that
    /// is late included. `None` while no read has come round, or if there is none.
    pub fn real_period(&self, class: Poll, now: Time) -> Option<Duration> {
        let of_class = self.reads.iter().filter(|planned| planned.poll == class && !planned.sleeps);
        let lasting = |planned: &Planned| {
            let waits = planned.sent_at.map(|sent_at| now - sent_at);
            planned.real_period.map(|period| waits.map_or(period, |waits| period.max(waits)))
        };
        of_class.filter_map(lasting).max()
    }

    /// Each read with the period in which it comes round, as far as it does: as wanted, or as long as it
    /// took.
    pub fn with_periods(&self) -> impl Iterator<Item = (&Read, Option<Duration>)> {
        let period = |planned: &Planned| {
            planned.period.map(|period| planned.real_period.map_or(period, |real| real.max(period)))
        };
        self.reads.iter().map(move |planned| (&*planned.read, period(planned)))
    }

    /// The read has been answered, if only with an exception.
    pub fn end(&mut self, index: usize) {
        self.reads[index].tried = true;
        self.reads[index].is_refused = false;
    }

    /// The read has brought what it asks for: that is counted.
    pub fn know_better(&mut self, index: usize) {
        let planned = &mut self.reads[index];
        planned.answers = (planned.answers + 1).min(ANSWERS_WELL_KNOWN);
        planned.was_given = true;
    }

    /// Whether the read comes so often, and has been answered so often, that nobody need wait for it much
    /// longer than it took.
    pub fn is_well_known(&self, index: usize) -> bool {
        let planned = &self.reads[index];
        let is_frequent = planned.period.is_some_and(|period| period <= PERIOD_WELL_KNOWN);
        is_frequent && planned.answers >= ANSWERS_WELL_KNOWN
    }

    /// Nothing came of the read: it is wanted as before.
    pub fn want_again(&mut self, index: usize) {
        self.reads[index].wanted_now = true;
    }

    /// Nothing came of the read, for the moment. It is the next that is asked, if it `goes_first`; else it is due at
    /// once, but goes before nothing else that is due: a device that dies must not keep the line from all others
    /// until it counts as dead, nor one that is busy until it is done. What has not been answered since the device
    /// connected is wanted as before: the device is not there for anybody until it is, and on a line that is full its
    /// period may last for minutes.
    pub fn try_again(&mut self, index: usize, now: Time, goes_first: bool) {
        let planned = &mut self.reads[index];
        planned.answers = planned.answers.min(ANSWERS_WELL_KNOWN - ANSWERS_TO_FORGIVE);
        if planned.period.is_some() && planned.tried && !goes_first {
            planned.failed_at = Some(now);
        } else {
            planned.wanted_now = true;
        }
    }

    /// Whether the read has brought anything since the device connected.
    pub fn has_been_answered(&self, index: usize) -> bool {
        self.reads[index].answers > 0
    }

    /// Whether the device has ever given the read as it stands.
    pub fn was_given(&self, index: usize) -> bool {
        self.reads[index].was_given
    }

    /// The read was refused by the device: ask again later than usual.
    pub fn pause(&mut self, index: usize, until: Time) {
        self.reads[index].paused_until = until;
        self.reads[index].is_refused = true;
    }

    /// Whether the device has refused any read when it was last asked.
    pub fn is_any_refused(&self) -> bool {
        self.reads.iter().any(|planned| planned.is_refused)
    }

    /// Every read that holds `point` is wanted at once.
    pub fn want(&mut self, point: PointIndex) {
        for planned in &mut self.reads {
            if planned.read.points.iter().any(|(held, _)| *held == point) {
                planned.wanted_now = true;
                planned.paused_until = Time::default();
            }
        }
    }

    /// The device has (re)connected: everything is wanted again.
    pub fn want_all(&mut self) {
        for planned in &mut self.reads {
            planned.wanted_now = true;
            planned.failed_at = None;
            planned.answers = 0;
            planned.tried = false;
            planned.paused_until = Time::default();
            planned.is_refused = false;
            // Nobody kept a period while the device was away.
            planned.sent_at = None;
            planned.real_period = None;
        }
    }

    /// Which reads hold nothing that lives now, and are not sent.
    pub fn sleep(&mut self, sleeps: impl Fn(&Read) -> bool) {
        for planned in &mut self.reads {
            planned.sleeps = sleeps(&planned.read);
        }
    }

    /// Whether each read has been answered since the connect.
    pub fn first_round_is_over(&self) -> bool {
        self.reads.iter().all(|planned| planned.tried || planned.sleeps)
    }

    /// Takes over the reads of another plan for the same points. Nothing was lost, so nothing is wanted
    /// sooner than its period says.
    pub fn rearrange(
        &mut self,
        reads: Vec<Read>,
        intervals: Intervals,
        is_selector: impl Fn(PointIndex) -> bool,
    ) {
        let old = std::mem::replace(self, Polls::new(reads, intervals, is_selector));
        for planned in &mut self.reads {
            let holds = |point: PointIndex| planned.read.points.iter().any(|(held, _)| *held == point);
            let shares = |before: &&Planned| before.read.points.iter().any(|(point, _)| holds(*point));
            let before: Vec<&Planned> = old.reads.iter().filter(shares).collect();
            if !before.is_empty() {
                planned.take_over(&before);
            }
        }
    }

    /// Takes over the reads of a new plan; what both plans have in common keeps its times, and only
    /// what is new is wanted at once.
    pub fn replace(
        &mut self,
        reads: Vec<Read>,
        intervals: Intervals,
        is_selector: impl Fn(PointIndex) -> bool,
    ) {
        let old = std::mem::replace(self, Polls::new(reads, intervals, is_selector));
        let known = |span: Span, poll: Poll| {
            old.reads.iter().find(|planned| planned.span == span && planned.poll == poll)
        };
        for planned in &mut self.reads {
            if let Some(before) = known(planned.span, planned.poll) {
                planned.began_at = before.began_at;
                planned.sent_at = before.sent_at;
                planned.real_period = before.real_period;
                planned.wanted_now = before.wanted_now;
                planned.failed_at = before.failed_at;
                planned.answers = before.answers;
                planned.was_given = before.was_given;
                planned.tried = before.tried;
                planned.paused_until = before.paused_until;
                planned.is_refused = before.is_refused;
            }
        }
    }
}

impl Planned {
    /// Takes the place of these reads, which together brought what this one brings: it is due when the
    /// first of them would have been, and has been tried when all of them have.
    fn take_over(&mut self, before: &[&Planned]) {
        let first = |of: fn(&Planned) -> Option<Time>| before.iter().filter_map(|planned| of(planned)).min();
        self.began_at = first(|planned| planned.began_at);
        self.sent_at = first(|planned| planned.sent_at);
        self.real_period = before.iter().filter_map(|planned| planned.real_period).max();
        self.wanted_now = before.iter().any(|planned| planned.wanted_now);
        self.failed_at = first(|planned| planned.failed_at);
        self.tried = before.iter().all(|planned| planned.tried);
        self.is_refused = before.iter().any(|planned| planned.is_refused);
        self.paused_until = before.iter().map(|planned| planned.paused_until).min().unwrap_or_default();
    }

    fn urgency(&self, at: Moment) -> Option<Urgency> {
        if at.now < self.paused_until || self.sleeps {
            return None;
        }
        if self.wanted_now {
            return Some(if self.has_selector { Urgency::WantedSelector } else { Urgency::Wanted });
        }
        let waiting = self.waiting()?;
        if let Some(failed_at) = self.failed_at {
            let waited = (at.now - failed_at).saturating_sub(REPEATED_BEHIND);
            return Some(Urgency::Overdue(periods(waited, waiting.period())));
        }
        waiting.urgency(at).map(Urgency::Overdue)
    }

    fn waiting(&self) -> Option<Waiting> {
        let period = self.period?.as_micros() as u64;
        Some(Waiting { began_at: self.began_at?, sent_at: self.sent_at, period })
    }

    /// For how many of its periods it has waited, if that is enough. What has no period and is wanted counts in tens of
    /// seconds, and comes first when it has never been read.
    fn waited(&self, at: Moment) -> Option<f64> {
        const NO_PERIOD: Duration = Duration::from_secs(10);
        match self.urgency(at)? {
            Urgency::Overdue(waited) => Some(waited),
            Urgency::Wanted | Urgency::WantedSelector => {
                let Some(began_at) = self.began_at else { return Some(f64::INFINITY) };
                let waited = periods(at.turns - began_at, self.period.unwrap_or(NO_PERIOD));
                (waited >= 1.0).then_some(waited)
            }
        }
    }

    fn due_at(&self, at: Moment) -> Option<Time> {
        if self.sleeps {
            return None;
        }
        let is_due = self.wanted_now || self.failed_at.is_some();
        let due = if is_due { Time::default() } else { self.waiting()?.due_at(at) };
        Some(due.max(self.paused_until))
    }
}

#[cfg(test)]
#[path = "schedule_tests.rs"]
mod tests;
