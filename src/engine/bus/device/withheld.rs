//! Reads that a device does not give although it is there: it refuses them, is busy, or leaves them without
//! an answer while it answers others.
//!
//! Such a read is not the device's end. It is asked ever less often, so that waiting for it costs the bus
//! little; its points say `None` and why; and the device is online with the rest.

use crate::engine::device::Poll;
use crate::engine::modbus::{ACKNOWLEDGE, BUSY, RequestError};
use crate::engine::time::{Duration, Time};
use crate::engine::value::Missing;

use super::super::line::at_random;
use super::patience::FAILURES_UNTIL_OFFLINE;
use super::{Context, DeviceState, Severity, Span};

/// A read that the device answers with an exception is asked again after this.
const PAUSE_EXCEPTION: Duration = Duration::from_secs(60);
/// For what a device is too busy (exceptions 5 and 6) it is asked again after this, and then after as long as it has
/// been busy with it, up to [`PAUSE_BUSY_LONG`].
const PAUSE_BUSY: Duration = Duration::from_millis(200);
pub(super) const PAUSE_BUSY_LONG: Duration = Duration::from_secs(2);
/// One that is busy for so long is not done soon.
const BUSY_LONG: Duration = Duration::from_secs(10);
/// One that was given before and is refused now may be wanted of a device that is still starting, or of a gateway that
/// has lost it: only what is refused for so long is believed to be refused for good.
const REFUSED_LONG: Duration = Duration::from_secs(10);
const PAUSE_REFUSED: Duration = Duration::from_secs(2);
/// A read without an answer is left alone for so long, then for twice as long, and so on.
const PAUSE_UNANSWERED: Duration = Duration::from_secs(5);
const PAUSE_UNANSWERED_LONGEST: Duration = Duration::from_secs(60);
/// One that has been answered since the device connected is rather disturbed than unknown to the device: at first it is
/// left alone for so long only, so many times.
const PAUSE_DISTURBED: Duration = Duration::from_secs(2);
const DISTURBED_MAX: u32 = 6;
/// One that has failed so often while others were answered may be in step with what disturbs it.
const IN_STEP_AFTER: u32 = 2;

/// The reads that are withheld now; of most devices none.
#[derive(Clone, Debug, Default)]
pub(super) struct Withheld {
    reads: Vec<WithheldRead>,
}

#[derive(Clone, Debug)]
struct WithheldRead {
    span: Span,
    poll: Poll,
    since: Time,
    /// Since when it has been refused each time, as what the device does not have.
    refused_since: Option<Time>,
    /// Times in a row without an answer that could be used.
    failures: u32,
    /// Has been answered since the device connected.
    was_answered: bool,
}

impl Withheld {
    /// The device is to be asked as if for the first time.
    pub(super) fn forget(&mut self) {
        self.reads.clear();
    }

    fn read(&mut self, span: Span, poll: Poll, was_answered: bool, now: Time) -> &mut WithheldRead {
        let known = self.reads.iter().position(|read| (read.span, read.poll) == (span, poll));
        let at = known.unwrap_or_else(|| {
            let (refused_since, failures) = (None, 0);
            self.reads.push(WithheldRead { span, poll, since: now, refused_since, failures, was_answered });
            self.reads.len() - 1
        });
        &mut self.reads[at]
    }

    /// Whether something may be in step with the read, so that it fails whenever its turn comes.
    pub(super) fn is_in_step(&self, span: Span, poll: Poll) -> bool {
        self.reads.iter().any(|read| (read.span, read.poll) == (span, poll) && read.failures == IN_STEP_AFTER)
    }

    /// It has been given, or refused for good; whether it had been left without an answer for long.
    fn end(&mut self, span: Span, poll: Poll) -> bool {
        if self.reads.is_empty() {
            return false;
        }
        let known = self.reads.iter().position(|read| (read.span, read.poll) == (span, poll));
        known.is_some_and(|at| self.reads.swap_remove(at).failures >= FAILURES_UNTIL_OFFLINE)
    }
}

impl WithheldRead {
    /// How long to leave it alone, once it has failed as often as a device may; a little more or less at random, or
    /// what disturbs it at regular times might do so each time.
    fn pause(&self, now: Time) -> Option<Duration> {
        let tries = self.failures.checked_sub(FAILURES_UNTIL_OFFLINE)?;
        let disturbed = if self.was_answered { DISTURBED_MAX } else { 0 };
        let pause = match tries.checked_sub(disturbed) {
            None => PAUSE_DISTURBED,
            Some(doublings) => (PAUSE_UNANSWERED * (1 << doublings.min(8))).min(PAUSE_UNANSWERED_LONGEST),
        };
        Some(pause * 9 / 10 + at_random(now, pause / 5))
    }
}

impl DeviceState {
    /// The device has given the read.
    pub(super) fn given(&mut self, index: usize, context: &mut Context) {
        let (span, poll) = (self.polls.span(index), self.polls.class(index));
        if self.withheld.end(span, poll) {
            let text = format!("device {}: {span} is answered again", self.settings.name);
            context.say(Severity::Info, text);
        }
    }

    /// Nothing that can be used came for the read. It is tried again; and if the device answers others, it waits,
    /// and longer each time.
    pub(super) fn unanswered(
        &mut self,
        now: Time,
        index: usize,
        error: &RequestError,
        context: &mut Context,
    ) {
        if !self.is_present() {
            return self.polls.want_again(index);
        }
        let read = self.polls.shared_read(index).clone();
        let was_answered = self.polls.has_been_answered(index);
        let withheld = self.withheld.read(read.span, read.poll, was_answered, now);
        withheld.refused_since = None;
        withheld.failures += 1;
        let (failures, pause) = (withheld.failures, withheld.pause(now));
        let answers_others = self.patience.failures() == 1;
        // Of the others the device is there, and only its answer was spoilt.
        let is_unheard =
            matches!(error, RequestError::Timeout | RequestError::Unreachable(_) | RequestError::Link(_));
        let is_in_step = answers_others && failures == IN_STEP_AFTER;
        self.polls.try_again(index, now, is_in_step || !is_unheard);
        let Some(pause) = pause else { return };
        if failures == FAILURES_UNTIL_OFFLINE {
            let text = format!(
                "device {}: {}: {error}, {FAILURES_UNTIL_OFFLINE} times in a row, while it answers others; what \
                 stands there is told as missing, and asked for less often",
                self.settings.name, read.span
            );
            context.say(Severity::Warning, text);
        }
        self.withhold(now, index, pause, &Missing::Unanswered(error.to_string()), context);
    }

    /// The device answered a read with an exception: it is there, but will not tell this.
    pub(super) fn refused(&mut self, now: Time, index: usize, code: u8, context: &mut Context) {
        let read = self.polls.read(index).clone();
        if matches!(code, ACKNOWLEDGE | BUSY) {
            let was_answered = self.polls.has_been_answered(index);
            let withheld = self.withheld.read(read.span, read.poll, was_answered, now);
            withheld.refused_since = None;
            let busy_for = now - withheld.since;
            let pause = busy_for.clamp(PAUSE_BUSY, PAUSE_BUSY_LONG);
            if busy_for >= BUSY_LONG {
                self.withhold(now, index, pause, &Missing::Exception(code), context);
            } else {
                self.polls.pause(index, now + pause);
            }
            // Nobody else has to wait because this one is busy.
            self.polls.try_again(index, now, false);
            return;
        }
        let suspects = if code == 2 { read.refused() } else { Vec::new() };
        if !suspects.is_empty() && self.polls.was_given(index) {
            let was_answered = self.polls.has_been_answered(index);
            let withheld = self.withheld.read(read.span, read.poll, was_answered, now);
            if now - *withheld.refused_since.get_or_insert(now) < REFUSED_LONG {
                return self.withhold(now, index, PAUSE_REFUSED, &Missing::Exception(code), context);
            }
        }
        self.given(index, context);
        if !suspects.is_empty() {
            self.refused.extend(suspects);
            self.keeping.has_changed(context);
            let reads = self.plan();
            self.values.forget_words();
            let values = &self.values;
            self.polls.replace(reads, self.settings.device.wire.intervals, |point| values.is_selector(point));
            self.wake_reads();
            let text = format!(
                "device {}: {} cannot be read in one request, and will be read in parts",
                self.settings.name, read.span
            );
            context.say(Severity::Info, text);
            return;
        }
        self.withhold(now, index, PAUSE_EXCEPTION, &Missing::Exception(code), context);
    }

    /// The read has been tried, and its points have no values; it is not asked again before `pause` is over.
    fn withhold(
        &mut self,
        now: Time,
        index: usize,
        pause: Duration,
        missing: &Missing,
        context: &mut Context,
    ) {
        self.polls.end(index);
        self.polls.pause(index, now + pause);
        let read = self.polls.shared_read(index).clone();
        for (point, _) in &read.points {
            self.values.lose(*point, missing.clone());
            self.tell(now, *point, context);
        }
    }
}
