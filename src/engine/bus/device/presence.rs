//! Whether a device is there: how it comes and goes, and what its silence and its late answers say.

use crate::engine::homeassistant;
use crate::engine::identity;
use crate::engine::modbus::{ACKNOWLEDGE, Answer, BUSY, Discarded, Reply, RequestError};
use crate::engine::time::{Duration, Time};
use crate::engine::value::Missing;

use super::patience::{FAILURES_UNTIL_OFFLINE, Patience};
use super::withheld::PAUSE_BUSY_LONG;
use super::{Context, DeviceState, Presence, Severity};

/// A device that is not the one that the profile describes is asked again after this.
const PAUSE_MISMATCH: Duration = Duration::from_secs(30);
/// One that may have been slow is waited for fully for so long.
const SLOW_PERHAPS: Duration = Duration::from_secs(30);

impl DeviceState {
    /// Before anything is known: what an earlier run left at the broker is taken back.
    pub(in crate::engine::bus) fn introduce(&mut self, now: Time, context: &mut Context) {
        self.publish_availability(false, context);
        // Less than all would take entities away that were announced before the start.
        if homeassistant::is_settled(&self.settings.device, self.values.known()) {
            self.announce(context);
        }
        self.tell_all(now, context);
        self.tell_info(now, context);
    }

    /// The link is up: ask at once.
    pub(in crate::engine::bus) fn reconnect(&mut self, now: Time) {
        self.patience.start_anew();
        self.paused_until = now;
        self.polls.want_all();
    }

    pub(in crate::engine::bus) fn identified(
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
            (Err(error @ RequestError::Exception(ACKNOWLEDGE | BUSY)), _) => {
                self.lose(now, &format!("it answers its identification with {error}"), context);
                self.paused_until = now + PAUSE_BUSY_LONG;
            }
            (Err(RequestError::Exception(code)), _) => {
                let exception = RequestError::Exception(code);
                let reason = format!("it answers its identification with {exception}: another device?");
                self.mistake(now, reason, context);
            }
            (Err(error), _) => self.failed(now, &error, context),
            (Ok(_), None) => {}
        }
    }

    pub(super) fn arrive(&mut self, now: Time, context: &mut Context) {
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
    pub(in crate::engine::bus) fn lose(&mut self, now: Time, reason: &str, context: &mut Context) {
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

    pub(in crate::engine::bus) fn failed(&mut self, now: Time, error: &RequestError, context: &mut Context) {
        self.patience.unanswered();
        self.be_left_alone(now);
        self.be_missed(now, error, context);
    }

    /// What a command has asked has ended so. What is asked next for it, or a poll, may be answered at once.
    pub(in crate::engine::bus) fn failed_command(
        &mut self,
        now: Time,
        error: &RequestError,
        context: &mut Context,
    ) {
        if matches!(error, RequestError::Exception(_) | RequestError::Impossible(_)) {
            return;
        }
        self.patience.unanswered();
        if self.patience.is_probing() {
            self.be_left_alone(now);
        }
        self.be_missed(now, error, context);
    }

    fn be_left_alone(&mut self, now: Time) {
        let demanded = self.settings.device.wire.response_timeout;
        self.paused_until = now + self.patience.pause(now, self.full_timeout, demanded);
    }

    /// It has failed so often that it counts as offline.
    fn be_missed(&mut self, now: Time, error: &RequestError, context: &mut Context) {
        if self.patience.failures() == FAILURES_UNTIL_OFFLINE {
            let advice = error.advice();
            let reason = format!("{error}, {FAILURES_UNTIL_OFFLINE} times in a row{advice}");
            context.say(Severity::Warning, format!("device {} is offline: {reason}", self.settings.name));
            self.lose(now, &reason, context);
        }
    }

    pub(in crate::engine::bus) fn count(&mut self, now: Time, reply: &Reply, is_read: bool) {
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

    /// The link has ended under a request to it.
    pub(in crate::engine::bus) fn count_lost(&mut self) {
        self.counters.requests += 1;
    }

    /// So many of its answers came too late.
    pub(in crate::engine::bus) fn count_late(&mut self, answers: u32) {
        self.counters.late_replies += u64::from(answers);
    }

    /// Its answer to an earlier request was heard, so long after that.
    pub(in crate::engine::bus) fn was_late(&mut self, now: Time, after: Duration) {
        self.patience.took(now, after);
        self.shows_sign(now);
    }

    /// Something was heard that may be its late answer. One that is slow again while it is waited for fully
    /// is known to be.
    pub(in crate::engine::bus) fn shows_sign(&mut self, now: Time) {
        if self.presence == Presence::Present {
            self.busy_until = self.busy_until.max(now + SLOW_PERHAPS);
        } else if self.patience.shows_sign() {
            self.paused_until = self.paused_until.min(now);
        }
    }

    /// How long its last request could have waited, had it not been a probe.
    pub(in crate::engine::bus) fn full_timeout(&self) -> Duration {
        self.full_timeout
    }

    /// Whether the request that ends now only asked whether it is there again.
    pub(in crate::engine::bus) fn is_probed(&self) -> bool {
        self.patience.is_probing()
    }

    /// Whether it has left something unanswered since its last answer, but not yet so often that it counts as offline.
    pub(in crate::engine::bus) fn is_doubtful(&self) -> bool {
        self.patience.failures() > 0 && !self.patience.is_probing()
    }

    /// A late answer may come until then.
    pub(in crate::engine::bus) fn rest_until(&mut self, until: Time) {
        self.paused_until = self.paused_until.max(until);
    }

    /// The line was left alone for so long because this device did not answer a probe: that counts in its
    /// share of the bus.
    pub(in crate::engine::bus) fn charge(&mut self, now: Time, waited: Duration) {
        if self.patience.is_probing() {
            self.paused_until = self.paused_until.max(now + Patience::pause_after(waited));
        }
    }
}
