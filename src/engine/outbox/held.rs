//! Values of what is announced as something else than before: Home Assistant takes its time to follow, and until then
//! it would read the new value as the old thing, which may be none that it takes. It never says that it has followed;
//! only that it is there, when it has connected to the broker. So two times are waited for: the longer one where it
//! may still have to connect, and would read what the broker keeps before it hears of anything else.

use std::collections::BTreeSet;

use super::{Lane, Outbox, Queued};
use crate::engine::homeassistant::Announcement;
use crate::engine::time::{Duration, Time};
use crate::engine::topics::{Kind, Message};

/// Within this time a Home Assistant that is there follows. It does what it is told in the order in which it is told,
/// and so did one that stood still for three seconds when the value came after half of that; this is ample.
pub(super) const FOLLOWS_WITHIN: Duration = Duration::from_secs(5);

/// Within this time after its broker is there again, Home Assistant is connected and has said so: it tries every ten
/// seconds, and waits until nothing has been announced for five.
pub(super) const CONNECTS_WITHIN: Duration = Duration::from_secs(25);

/// What waits until Home Assistant knows what it is. Meanwhile nothing is known of it.
#[derive(Clone, Debug, Default)]
pub(super) struct Held {
    topics: BTreeSet<String>,
    /// When it knows, once it has been told.
    due: Option<Time>,
    home: Home,
}

/// Whether Home Assistant is there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Home {
    /// The broker has just come, or this gateway has: it may come as well.
    #[default]
    MayCome,
    /// If it has not come by then, it was there all the time, or there is none.
    ComesBefore(Time),
    IsThere,
}

impl Held {
    /// What is told on this topic as long as it is held back.
    pub(super) fn told_instead(&self, topic: &str) -> Option<&'static str> {
        self.topics.contains(topic).then_some("None")
    }

    /// Something is told now, perhaps what things are. The announcement itself may be too long to be told ever.
    pub(super) fn is_told(&mut self, now: Time, is_announcement: bool) {
        if self.home == Home::MayCome {
            self.home = Home::ComesBefore(now + CONNECTS_WITHIN);
        }
        if !self.topics.is_empty() && (is_announcement || self.due.is_none()) {
            let follows = now + FOLLOWS_WITHIN;
            self.due = Some(match self.home {
                Home::ComesBefore(time) => follows.max(time),
                Home::MayCome | Home::IsThere => follows,
            });
        }
    }

    /// Home Assistant has said so.
    pub(super) fn home_assistant_is_there(&mut self) {
        self.home = Home::IsThere;
    }

    /// The broker was away, and Home Assistant's connection with it.
    pub(super) fn broker_is_there(&mut self) {
        self.home = Home::MayCome;
    }

    pub(super) fn due(&self) -> Option<Time> {
        self.due
    }
}

impl Outbox {
    /// Holds back what `now` makes something else of than `before` did.
    pub(super) fn hold(&mut self, before: &Announcement, now: &Announcement) {
        let topics = now.told_otherwise_than(before).into_iter();
        let values: Vec<String> = topics.filter(|topic| self.topics.kind(topic) == Kind::Value).collect();
        if values.is_empty() {
            return;
        }
        for topic in values {
            if !self.retained.contains_key(&*topic) {
                self.push_retained(Message::retained(&*topic, "None"));
            }
            self.held.topics.insert(topic);
        }
        self.tell_held_first();
        // The time begins when it is told, which it may have been.
        self.tell_again(now.topic());
    }

    /// What the broker keeps of it may be the old thing's: it is taken back before anything is announced.
    pub(super) fn tell_held_first(&mut self) {
        for topic in &self.held.topics {
            let Some(entry) = self.retained.get_mut(&**topic) else { continue };
            entry.queued = true;
            let lane = self.lane(topic);
            self.queue.take_newest(lane, topic);
            self.queue.push_front(Lane::Announcements, Queued::Newest(topic.as_str().into()));
        }
    }

    /// The time of [`Held::due`] may have come.
    pub(super) fn wake_held(&mut self, now: Time) {
        if self.held.due.is_none_or(|due| now < due) {
            return;
        }
        self.held.due = None;
        for topic in std::mem::take(&mut self.held.topics) {
            if self.retained.get(&*topic).is_some_and(|entry| entry.payload != "None") {
                self.tell_again(&topic);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeMap, BTreeSet};

    use super::super::tests::{LATER, check_sent, outbox, retained};
    use super::*;

    const CONFIG: &str = "homeassistant/device/busker_boiler/config";
    const MOMENT: &str = "2026-11-27T05:24:00Z";

    /// An announcement of sensors that look so, each on the topic of its name.
    fn with(looks: &[(&str, &str)]) -> String {
        let component = |(key, looks): &(&str, &str)| {
            format!("\"{key}\":{{\"platform\":\"sensor\",{looks},\"state_topic\":\"busker/boiler/{key}\"}}")
        };
        let components: Vec<String> = looks.iter().map(component).collect();
        format!(
            "{{\"origin\":{{\"name\":\"busker\"}},\"availability\":[{{\"topic\":\"busker/bridge/state\"}}],\
             \"components\":{{{}}}}}",
            components.join(",")
        )
    }

    /// `since` is a length, and then a moment; `way` stays one under another name.
    fn before_and_now() -> (String, String) {
        let (metres, moment) = ("\"unit_of_measurement\":\"m\"", "\"device_class\":\"timestamp\"");
        let named = "\"unit_of_measurement\":\"m\",\"name\":\"Way\"";
        (with(&[("way", metres), ("since", metres)]), with(&[("way", named), ("since", moment)]))
    }

    #[track_caller]
    fn check_held(mut outbox: Outbox, now: &str) {
        let announced = format!("{CONFIG} {now}");
        let expected = ["busker/boiler/since None", &announced, "busker/boiler/way 8"];
        retained(&mut outbox, CONFIG, now);
        retained(&mut outbox, "busker/boiler/way", "8");
        retained(&mut outbox, "busker/boiler/since", MOMENT);
        check_sent(&mut outbox, &expected);
        // A broker that comes back may have kept what an earlier run told.
        outbox.connected();
        let online = "busker/bridge/state online";
        check_sent(&mut outbox, &[&expected[..], &[online]].concat());
        let due = outbox.wake_at().expect("it is told later");
        assert!(due >= LATER + CONNECTS_WITHIN, "Home Assistant may connect later than this gateway");
        outbox.wake(LATER);
        check_sent(&mut outbox, &[]);
        outbox.wake(due);
        check_sent(&mut outbox, &[&format!("busker/boiler/since {MOMENT}")]);
        assert_eq!(outbox.wake_at(), None);
    }

    #[test]
    fn what_is_something_else_now_is_not_told_before_home_assistant_knows() {
        let (before, now) = before_and_now();
        // Of this run: a mode has changed.
        let mut running = outbox();
        retained(&mut running, CONFIG, &before);
        retained(&mut running, "busker/boiler/way", "7");
        retained(&mut running, "busker/boiler/since", "7");
        super::super::tests::take_all(&mut running);
        check_held(running, &now);
        // Of an earlier run.
        let mut started = outbox();
        let recalled = BTreeMap::from([(CONFIG.to_string(), vec![before])]);
        started.recall(recalled, Vec::new(), &BTreeSet::new());
        check_held(started, &now);
    }

    #[test]
    fn a_home_assistant_that_has_said_that_it_is_there_is_not_waited_for() {
        let (before, now) = before_and_now();
        let mut outbox = outbox();
        retained(&mut outbox, CONFIG, &before);
        retained(&mut outbox, "busker/boiler/since", "7");
        outbox.connected();
        super::super::tests::take_all(&mut outbox);
        outbox.home_assistant_started(LATER);
        outbox.wake(LATER + Duration::from_secs(2));
        super::super::tests::take_all(&mut outbox);
        retained(&mut outbox, CONFIG, &now);
        retained(&mut outbox, "busker/boiler/since", MOMENT);
        check_sent(&mut outbox, &["busker/boiler/since None", &format!("{CONFIG} {now}")]);
        let due = outbox.wake_at().expect("it is told later");
        assert!(due < LATER + FOLLOWS_WITHIN + Duration::from_secs(1), "{due:?}");
        outbox.wake(due);
        check_sent(&mut outbox, &[&format!("busker/boiler/since {MOMENT}")]);
    }

    #[test]
    fn what_is_only_called_otherwise_is_told_at_once() {
        let (before, _) = before_and_now();
        let mut outbox = outbox();
        retained(&mut outbox, CONFIG, &before);
        super::super::tests::take_all(&mut outbox);
        let now = before.replace("\"m\"", "\"m\",\"name\":\"Length\"");
        retained(&mut outbox, CONFIG, &now);
        retained(&mut outbox, "busker/boiler/since", "8");
        check_sent(&mut outbox, &[&format!("{CONFIG} {now}"), "busker/boiler/since 8"]);
        assert_eq!(outbox.wake_at(), None);
    }
}
