//! How long a device usually takes to answer, and reads that are planned with it.
//!
//! A request to a slow device costs more, so that reading over a gap pays sooner; to a quick one it pays
//! later. Reads are planned anew only when what was measured is far from what they were planned with, and
//! then only if that changes them: each plan is good for a while.

use crate::engine::health::{Timing, TimingReport};
use crate::engine::plan;
use crate::engine::time::{Duration, Time};

use super::{Context, DeviceState, Severity};

/// So many answers are looked at before a plan is thought over; after each new plan twice as many, or one that
/// makes a device look quick and slow in turn would be exchanged without end.
const ANSWERS: u32 = 64;
const DOUBLINGS_MAX: u32 = 10;
/// No device is planned with less: below it, it is the program's own time that is measured.
const LEAST: Duration = Duration::from_micros(200);

/// What is known of a device's way to answer.
#[derive(Clone, Debug)]
pub(super) struct Turnaround {
    timing: Timing,
    planned_with: Duration,
    /// Half of its answers took longer, as near as that can be told without keeping them.
    typical: Duration,
    /// Answers since the plan was thought over.
    answers: u32,
    /// How often it was far from what was measured.
    changes: u32,
    /// The log has been told that it is slower than it may be.
    told_slow: bool,
}

impl Default for Turnaround {
    fn default() -> Turnaround {
        let planned_with = plan::USUAL_TURNAROUND;
        Turnaround {
            timing: Timing::default(),
            planned_with,
            typical: planned_with,
            answers: 0,
            changes: 0,
            told_slow: false,
        }
    }
}

impl Turnaround {
    pub(super) fn planned_with(&self) -> Duration {
        self.planned_with
    }

    pub(super) fn report(&self, now: Time) -> TimingReport {
        self.timing.report(now)
    }

    fn took(&mut self, time: Duration) {
        self.answers += 1;
        // A step towards each answer, however far it is: one that is very slow moves it no more than any.
        let typical = self.typical;
        self.typical = match time > typical {
            true => (typical * 17 / 16).max(typical + Duration::from_micros(1)).min(time),
            false => (typical * 16 / 17).max(time),
        };
    }

    /// What the reads should be planned with instead, if it is time to think it over.
    fn think_over(&mut self) -> Option<Duration> {
        if self.answers < ANSWERS << self.changes.min(DOUBLINGS_MAX) {
            return None;
        }
        self.answers = 0;
        let typical = self.typical.max(LEAST);
        let is_far = plan::is_far(typical, self.planned_with);
        self.changes += u32::from(is_far);
        is_far.then_some(typical)
    }
}

impl DeviceState {
    /// Says once that an answer came only because the device is waited for longer than it should need.
    pub(in crate::engine::bus) fn complain_of_slowness(&mut self, took: Duration, context: &mut Context) {
        let limit = self.full_timeout;
        // Nobody is waited for twice as long.
        if took <= limit || took >= limit * 2 || std::mem::replace(&mut self.turnaround.told_slow, true) {
            return;
        }
        let (name, took, limit) = (&self.settings.name, took.as_millis(), limit.as_millis());
        let text = format!(
            "device {name} answers after {took} ms, later than the response timeout of {limit} ms; it is waited \
             for, but a longer `response_timeout` of its bus or profile would spare the others"
        );
        context.say(Severity::Warning, text);
    }

    /// The wire was busy with it.
    pub(in crate::engine::bus) fn had_wire(&mut self, from: Time, until: Time) {
        self.load.add(from, until);
    }

    /// A request to it has ended.
    pub(in crate::engine::bus) fn keep_time(
        &mut self,
        now: Time,
        waited: Duration,
        turnaround: Option<Duration>,
        command_waited: Option<Duration>,
    ) {
        let timing = &mut self.turnaround.timing;
        timing.waited_for_gap(now, waited);
        command_waited.into_iter().for_each(|time| timing.command_waited(now, time));
        if let Some(time) = turnaround {
            timing.turned_around(now, time);
            self.turnaround.took(time);
        }
    }

    /// Plans the reads anew if the device is much slower or quicker than they were planned for. Only while
    /// none of them is on the wire, and none is refused: in one with it, others would be refused too.
    pub(super) fn adapt_plan(&mut self, context: &mut Context) {
        if self.polls.is_any_refused() {
            return;
        }
        let Some(turnaround) = self.turnaround.think_over() else { return };
        self.turnaround.planned_with = turnaround;
        let reads = self.plan();
        if self.polls.has_reads(&reads) {
            return;
        }
        let (before, after) = (self.polls.len(), reads.len());
        self.polls
            .rearrange(reads, self.settings.device.wire.intervals, |point| self.values.is_selector(point));
        self.values.forget_words();
        self.wake_reads();
        let text = format!(
            "device {}: it takes {} ms to answer, and is read with {after} request{} instead of {before}",
            self.settings.name,
            (turnaround.as_secs_f64() * 10_000.0).round() / 10.0,
            if after == 1 { "" } else { "s" },
        );
        context.say(Severity::Info, text);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn millis(millis: u64) -> Duration {
        Duration::from_millis(millis)
    }

    /// After answers that took so long, what the reads should be planned with.
    fn thought(answers: impl IntoIterator<Item = u64>) -> Vec<u64> {
        let mut turnaround = Turnaround::default();
        let mut plans = Vec::new();
        for answer in answers {
            turnaround.took(millis(answer));
            if let Some(wanted) = turnaround.think_over() {
                turnaround.planned_with = wanted;
                plans.push(wanted.as_millis() as u64);
            }
        }
        plans
    }

    #[test]
    fn a_plan_is_thought_over_only_when_a_device_is_usually_far_from_what_it_was_made_for() {
        let always = |time, count| std::iter::repeat_n(time, count);
        for (what, answers, expected) in [
            ("as planned", always(5, 1000).collect::<Vec<_>>(), vec![]),
            ("not far", always(9, 1000).collect(), vec![]),
            ("slow", always(40, 1000).collect(), vec![40]),
            ("quick", always(1, 1000).collect(), vec![1]),
            ("too few answers", always(40, 63).collect(), vec![]),
            ("slow now and then", (0..1000).map(|at| if at % 4 == 0 { 400 } else { 6 }).collect(), vec![]),
            ("to and fro", (0..1000).map(|at| if at % 2 == 0 { 3 } else { 8 }).collect(), vec![]),
        ] {
            assert_eq!(thought(answers), expected, "{what}");
        }
        // What the new plan itself makes look quick is planned ever more seldom.
        let mut turnaround = Turnaround::default();
        let mut plans = 0;
        for _ in 0..10_000 {
            turnaround.took(millis(if turnaround.planned_with > millis(20) { 1 } else { 60 }));
            if let Some(wanted) = turnaround.think_over() {
                turnaround.planned_with = wanted;
                plans += 1;
            }
        }
        assert!(plans <= 8, "{plans}");
        // It changes for good: in a step or two, and then no more.
        let plans = thought(always(5, 200).chain(always(50, 1000)));
        assert!(plans.len() <= 2 && plans.last().is_some_and(|last| *last > 25), "{plans:?}");
    }
}
