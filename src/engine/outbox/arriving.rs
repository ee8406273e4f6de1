//! Whether what is told arrives. A broker confirms also what it drops in silence: what this user may not write, and
//! what is longer than it passes on. But it hands on to this gateway what stands on some of its own topics, its state
//! and its announcements, since those are listened to anyway. So what of that does not come back is noticed.

use std::collections::{BTreeMap, BTreeSet};

use super::Outbox;
use crate::engine::time::{Duration, Time};
use crate::engine::topics::Message;

/// When nothing has come back for so long, what is still awaited will not come.
const COMES_BACK_WITHIN: Duration = Duration::from_secs(20);

#[derive(Clone, Debug, Default)]
pub(super) struct Arriving {
    /// What was handed over on this connection and has not come back, with its bytes.
    awaited: BTreeMap<String, usize>,
    /// When something of that was handed over or came back last.
    since: Time,
    /// The bytes of the longest announcement that has come back on this connection.
    longest: usize,
    /// What did not come back.
    missing: BTreeSet<String>,
    news: Option<NotArriving>,
}

/// What the broker has confirmed and does not hand on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct NotArriving {
    pub topics: Vec<String>,
    /// The bytes of the shortest of it, if all that is shorter has come back: it may be too long.
    pub too_long: Option<usize>,
}

impl Arriving {
    pub(super) fn begin_anew(&mut self) {
        self.awaited.clear();
        self.longest = 0;
    }

    fn due(&self) -> Option<Time> {
        (!self.awaited.is_empty()).then(|| self.since + COMES_BACK_WITHIN)
    }

    pub(super) fn keep(&mut self, is_told: impl Fn(&str) -> bool) {
        self.awaited.retain(|topic, _| is_told(topic));
        self.missing.retain(|topic| is_told(topic));
    }
}

impl Outbox {
    /// The topics on which this gateway tells something that does not arrive.
    pub fn not_arriving(&self) -> Vec<String> {
        self.arriving.missing.iter().cloned().collect()
    }

    /// The same if nobody has been told of it yet: [`Outbox::take_lines`].
    pub(super) fn take_news_of_arriving(&mut self) -> Option<NotArriving> {
        self.arriving.news.take()
    }

    /// The broker does not let this gateway listen to what these filters name: what is told there does not come
    /// back, and may have arrived all the same.
    pub fn cannot_hear(&mut self, filters: &[String]) {
        let announcements = self.discovery("+");
        let is_deaf = |filter: &str| filters.iter().any(|known| known == filter);
        let (no_state, no_announcement) = (is_deaf(&self.topics.bridge_state()), is_deaf(&announcements));
        let prefix = &self.discovery_prefix;
        self.arriving.keep(|topic| if topic.starts_with(prefix) { !no_announcement } else { !no_state });
    }

    /// When [`Outbox::wake`] has to look whether all has come back.
    pub fn awaits_until(&self) -> Option<Time> {
        self.arriving.due()
    }

    /// The broker is slow to answer anything just now.
    pub fn listen_longer(&mut self, now: Time) {
        self.arriving.since = self.arriving.since.max(now);
    }

    pub(super) fn await_return(&mut self, message: &Message, now: Time) {
        // Most messages are values.
        let (topic, bytes) = (&message.topic, message.payload.len());
        let is_listened_to = topic.starts_with(&self.discovery_prefix) || topic.ends_with("/bridge/state");
        if message.retain && bytes > 0 && is_listened_to && self.retained.contains_key(&**topic) {
            self.arriving.awaited.insert(topic.clone(), bytes);
            self.arriving.since = now;
        }
    }

    pub(super) fn await_no_return(&mut self, topic: &str) {
        self.arriving.awaited.remove(topic);
    }

    /// What this gateway has told on this topic has come back.
    pub(super) fn has_arrived(&mut self, topic: &str, bytes: usize, now: Time) {
        let arriving = &mut self.arriving;
        arriving.missing.remove(topic);
        if topic.starts_with(&self.discovery_prefix) {
            arriving.longest = arriving.longest.max(bytes);
        }
        if arriving.awaited.remove(topic).is_some() {
            arriving.since = now;
        }
    }

    /// The time of [`Arriving::due`] may have come.
    pub(super) fn wake_arriving(&mut self, now: Time) {
        let arriving = &mut self.arriving;
        if arriving.due().is_none_or(|due| now < due) {
            return;
        }
        let awaited = std::mem::take(&mut arriving.awaited);
        let is_announcement = |topic: &String| topic.starts_with(&self.discovery_prefix);
        let shortest = awaited.values().min().copied().unwrap_or_default();
        let is_longer = arriving.longest > 0 && shortest > arriving.longest;
        let too_long = (is_longer && awaited.keys().all(is_announcement)).then_some(shortest);
        let topics: Vec<String> = awaited.into_keys().collect();
        let known = arriving.missing.len();
        arriving.missing.extend(topics.iter().cloned());
        if arriving.missing.len() > known {
            arriving.news = Some(NotArriving { topics, too_long });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{LATER, outbox, retained};
    use super::*;

    const STATE: &str = "busker/bridge/state";
    const BRIDGE: &str = "homeassistant/device/busker_bridge/config";
    const BOILER: &str = "homeassistant/device/busker_boiler/config";
    const SHORT: &str = "{\"origin\":{}}";

    /// An outbox that has told its state, a value and two announcements, of 13 and of 2000 bytes.
    fn told() -> Outbox {
        let mut outbox = outbox();
        retained(&mut outbox, BRIDGE, SHORT);
        retained(&mut outbox, BOILER, &"b".repeat(2000));
        retained(&mut outbox, "busker/boiler/flow", "21.5");
        outbox.connected();
        while outbox.next_message(LATER).is_some() {}
        outbox
    }

    fn at(seconds: u64) -> Time {
        LATER + Duration::from_secs(seconds)
    }

    fn comes_back(outbox: &mut Outbox, topic: &str, now: Time) {
        match topic {
            STATE => assert!(!outbox.heard_state("online", now), "nobody denies it"),
            BRIDGE => outbox.heard_announcement(topic, SHORT, now),
            _ => outbox.heard_announcement(topic, &"b".repeat(2000), now),
        }
    }

    /// What is told of it if of all that was told only `heard` comes back.
    #[track_caller]
    fn check(heard: &[&str], expected: Option<(&[&str], Option<usize>)>) {
        let mut outbox = told();
        heard.iter().for_each(|topic| comes_back(&mut outbox, topic, LATER));
        outbox.wake(at(20));
        let expected = expected.map(|(topics, too_long)| NotArriving {
            topics: topics.iter().map(|topic| topic.to_string()).collect(),
            too_long,
        });
        let topics = expected.as_ref().map_or_else(Vec::new, |expected| expected.topics.clone());
        assert_eq!(outbox.not_arriving(), topics);
        assert_eq!(outbox.take_news_of_arriving(), expected);
        assert_eq!(outbox.take_news_of_arriving(), None, "once");
    }

    #[test]
    fn what_does_not_come_back_is_noticed_and_why_if_that_can_be_seen() {
        check(&[STATE, BRIDGE, BOILER], None);
        check(&[], Some((&[STATE, BOILER, BRIDGE], None)));
        // A user may write below one of two prefixes.
        check(&[STATE], Some((&[BOILER, BRIDGE], None)));
        check(&[BOILER, BRIDGE], Some((&[STATE], None)));
        check(&[STATE, BOILER], Some((&[BRIDGE], None)));
        // Only what is long is missing.
        check(&[STATE, BRIDGE], Some((&[BOILER], Some(2000))));
    }

    #[test]
    fn as_long_as_something_comes_back_the_rest_may_follow_and_what_comes_late_has_arrived() {
        let mut outbox = told();
        assert_eq!(outbox.awaits_until(), Some(at(20)));
        comes_back(&mut outbox, STATE, at(15));
        outbox.wake(at(20));
        assert_eq!(outbox.awaits_until(), Some(at(35)));
        outbox.listen_longer(at(33));
        outbox.wake(at(35));
        assert_eq!((outbox.not_arriving(), outbox.awaits_until()), (Vec::new(), Some(at(53))));
        outbox.wake(at(53));
        assert_eq!(outbox.not_arriving(), [BOILER, BRIDGE]);
        comes_back(&mut outbox, BRIDGE, at(60));
        assert_eq!(outbox.not_arriving(), [BOILER]);
        outbox.reconfigure(["busker_bridge".to_string()], &[].into(), &[].into());
        assert_eq!(outbox.not_arriving(), [""; 0], "it is not told any more");
    }

    #[test]
    fn it_is_noticed_once_on_however_many_connections() {
        let mut outbox = told();
        for minute in 0..5 {
            outbox.disconnected();
            assert_eq!(outbox.awaits_until(), None, "there is nobody to wait for");
            outbox.connected();
            let now = at(60 * minute);
            while outbox.next_message(now).is_some() {}
            outbox.wake(now + COMES_BACK_WITHIN);
            assert_eq!(outbox.take_news_of_arriving().is_some(), minute == 0);
            assert_eq!(outbox.not_arriving().len(), 3);
        }
    }

    #[test]
    fn where_the_broker_does_not_let_us_listen_nothing_is_awaited() {
        for (filter, missing) in [
            ("homeassistant/device/+/config", &[STATE][..]),
            (STATE, &[BOILER, BRIDGE]),
            ("busker/+/+/set", &[STATE, BOILER, BRIDGE]),
        ] {
            let mut outbox = told();
            outbox.cannot_hear(&[filter.to_string()]);
            outbox.wake(at(20));
            assert_eq!(outbox.not_arriving(), missing, "{filter}");
        }
    }

    #[test]
    fn what_could_not_be_handed_over_is_not_awaited() {
        let mut outbox = outbox();
        outbox.connected();
        let state = outbox.next_message(LATER).expect("its state");
        outbox.put_back(state);
        outbox.wake(at(20));
        assert_eq!(outbox.not_arriving(), [""; 0]);
    }
}
