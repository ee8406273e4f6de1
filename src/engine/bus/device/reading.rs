//! What becomes of the answer to a read: values, news, and what follows from them.

use crate::engine::address::Span;
use crate::engine::codec;
use crate::engine::command::words_of;
use crate::engine::device::{PointIndex, Poll};
use crate::engine::modbus::{Answer, RequestError};
use crate::engine::plan::Read;
use crate::engine::state::Absorbed;
use crate::engine::time::Time;
use crate::engine::value::Missing;

use super::{Context, DeviceState, Presence, Severity};

impl DeviceState {
    pub(in crate::engine::bus) fn polled(
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
            self.polls.began(index, self.served_at);
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
                let absorbed = self.values.absorb_poll(now, &self.settings.device, read, &words);
                if !absorbed.is_told || self.told.is_anything_wanted() {
                    let read = read.clone();
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
                self.unanswered(now, index, &error, context);
            }
        }
        self.after_news(now, context);
        self.adapt_plan(context);
    }

    pub(super) fn absorb(&mut self, now: Time, read: &Read, words: &[u16], context: &mut Context) {
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
            self.told.announcement_due = true;
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
            if self.told.is_anything_wanted() || self.values.may_be_told(now, *point, again) {
                self.tell(now, *point, context);
            }
        }
    }

    /// Reads that hold only points which do not live now are not sent.
    pub(super) fn wake_reads(&mut self) {
        let (device, known) = (&self.settings.device, self.values.known());
        let sleeps = |point: PointIndex| codec::resolve(device, point, known) == Err(Missing::NotInThisMode);
        self.polls
            .sleep(|read| !read.points.is_empty() && read.points.iter().all(|(point, _)| sleeps(*point)));
    }

    /// After a poll: what became complete with it is told. The device is told to be there together with its
    /// values, and not before: who waits for `online` looks at them next.
    pub(super) fn after_news(&mut self, now: Time, context: &mut Context) {
        self.tell_things(now, context);
        if !self.is_present() || !self.polls.first_round_is_over() {
            return;
        }
        if !self.told.is_available() {
            if !self.is_known() {
                return;
            }
            self.tell_whole_at_once(now, context);
        }
        if self.told.announcement_due {
            self.announce(context);
        }
        self.publish_availability(true, context);
        let drift_changed = self.keep_settings(now, context);
        let missing_changed = self.values.take_missing_changed() | self.told.take_missing_changed();
        let is_news = missing_changed || !self.told.present || drift_changed;
        if is_news || self.info_is_old(now, context) {
            self.tell_info(now, context);
        }
    }

    /// Whether of all that is polled it is known what it says, or why it says nothing. What was read while that
    /// which decides its meaning was not known is not: it is read again.
    fn is_known(&self) -> bool {
        let mut polled = self.settings.device.points.iter().enumerate().filter(|(_, point)| point.is_read());
        polled.all(|(point, _)| self.values.is_settled(point))
    }

    pub(in crate::engine::bus) fn span_of(&self, read: usize) -> Span {
        self.polls.span(read)
    }

    /// Whether one of the fast polls reads this point at its own place, and nothing waits for what it
    /// decides.
    pub(in crate::engine::bus) fn is_polled_fast(&self, point: PointIndex) -> bool {
        self.details(point).poll == Poll::Fast
            && self.is_present()
            && !self.values.is_selector(point)
            && self.polls.reads_at(point, self.details(point).at)
    }

    /// The point is wanted now, and told even if it has not changed.
    pub(in crate::engine::bus) fn want(&mut self, point: PointIndex) {
        self.polls.want(point);
        self.told.want(point);
    }

    /// The point's poll comes before others, since it is a command's read-back.
    pub(in crate::engine::bus) fn want_poll(&mut self, point: PointIndex) {
        self.polls.want(point);
    }
}
