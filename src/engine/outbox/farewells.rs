//! What is announced no more is taken away from Home Assistant, also when another run announced it, or when
//! nobody was there to hear.

use crate::engine::homeassistant::{self, Announcement};
use crate::engine::time::Time;
use crate::engine::topics::{DeviceTopics, Message};

use super::{Outbox, Queued};

impl Outbox {
    /// The broker remembers this announcement, perhaps of an earlier run. What it holds and we do not
    /// have any more is taken away properly; announcements that are not ours are left alone.
    pub(super) fn found(&mut self, topic: &str, payload: &str) {
        let Some(found) = Announcement::parse(&self.topics, topic, payload) else {
            if !self.found_of_former(topic, payload) {
                self.found_of_rival(topic, payload);
            }
            return;
        };
        let is_gone = |topic: &&str| self.topics.are_above(topic) && !self.wanted.contains(*topic);
        for topic in found.told_on().into_iter().filter(is_gone) {
            self.left_behind.insert(topic.to_string());
            // What stands beside it without being announced.
            if let Some(device) = DeviceTopics::with_availability_on(topic) {
                self.left_behind.extend([device.json().to_string(), device.info(), device.health()]);
            }
        }
        if self.retained.contains_key(topic) {
            self.take_leave(found);
        } else if self.own_devices.contains(topic) {
            if let Some(earlier) = self.remembered.remove(topic) {
                earlier.without(&found).into_iter().for_each(|gone| self.departed.add(gone));
            }
            self.remembered.insert(topic.to_string(), found);
        } else {
            // Not twice, if both the broker and we remember it: Home Assistant warns of the second time.
            if !self.departed.has(topic) {
                self.queue_last(Queued::Removal(topic.to_string()));
            }
            self.departed.add(found);
        }
    }

    /// The next topic on which an earlier run told something, and this one tells nothing: a point that is
    /// gone, or another layout. To be asked when everything has been told, for only then it is known.
    pub(super) fn next_left_behind(&mut self) -> Option<Message> {
        while let Some(topic) = self.left_behind.pop_first() {
            if !self.wanted.contains(&topic) && !self.retained.contains_key(&*topic) {
                self.taken_back.add(&topic);
                return Some(Message::retained(topic, ""));
            }
        }
        None
    }

    /// Buries what `found` has and the present announcement on its topic has not.
    pub(super) fn take_leave(&mut self, found: Announcement) {
        let Some(present) = self.announced_on(found.topic()) else { return };
        if let Some(gone) = found.without(&present) {
            self.bury(std::slice::from_ref(&gone), &present);
            self.departed.add(gone);
        }
        self.hold(&found, &present);
    }

    /// This is announced for the first time in this run, and earlier ones may have announced something else.
    pub(super) fn take_leave_of_earlier_runs(&mut self, topic: &str) {
        let remembered = self.remembered.remove(topic);
        let Some(present) = self.announced_on(topic) else { return };
        if let Some(gone) = remembered.as_ref().and_then(|found| found.without(&present)) {
            self.departed.add(gone);
        }
        self.departed.is_announced(&present);
        let gone = self.departed.of(topic);
        self.bury(&gone, &present);
        // What departed before that was held back then.
        remembered.iter().for_each(|found| self.hold(found, &present));
    }

    /// Takes away once more what was taken away while Home Assistant may not have listened: it keeps
    /// entities over its own restart, and lets go only of what it has been told since.
    pub(super) fn take_leave_again(&mut self, now: Time) {
        for topic in self.departed.topics() {
            let gone = self.departed.of(&topic);
            if let Some(present) = self.announced_on(&topic) {
                self.bury(&gone, &present);
                gone.iter().for_each(|gone| self.hold(gone, &present));
            } else if self.own_devices.contains(&topic) {
                // That is done when it is announced.
                continue;
            } else {
                self.announce_to_remove(&gone);
                self.queue_last(Queued::Removal(topic.clone()));
            }
            self.departed.is_told(&topic, now);
        }
    }

    /// Tells of all parts of what stood on a topic, since Home Assistant lets go only of what it has been told since its
    /// start. Its removal shall follow, by which Home Assistant takes away one platform for each key: what has been
    /// several of them is taken away here, all but one.
    pub(super) fn announce_to_remove(&mut self, parts: &[Announcement]) {
        for (number, part) in parts.iter().enumerate() {
            self.push_once(Message { retain: false, ..part.message() });
            if number > 0 {
                self.push_once(part.tombstones());
            }
        }
    }

    /// Takes these away from beside what is announced now.
    fn bury(&mut self, gone: &[Announcement], present: &Announcement) {
        for gone in gone {
            // Home Assistant may have started since then, and buries only what it knows.
            self.push_once(Message { retain: false, ..gone.message() });
            homeassistant::farewell(gone, present).into_iter().for_each(|farewell| self.push_once(farewell));
        }
        if !gone.is_empty() {
            self.push_retained(present.message());
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::super::tests::{LATER, check_sent, outbox, retained, take_all};
    use super::super::{Outbox, Tree};
    use crate::engine::time::Time;

    /// What this gateway announces of a device with these components.
    fn announcement(keys: &[&str]) -> String {
        announced(keys.iter().map(|key| format!("\"{key}\":{{\"platform\":\"sensor\"}}")))
    }

    /// The same of a device that tells something on these topics.
    fn telling_on(topics: &[&str]) -> String {
        announced(topics.iter().map(|topic| {
            format!(
                "\"{topic}\":{{\"platform\":\"switch\",\"state_topic\":\"{topic}\",\"command_topic\":\"{topic}/set\"}}"
            )
        }))
    }

    /// Where the boiler tells something now.
    const WANTED: [&str; 4] =
        ["busker/boiler/availability", "busker/boiler/info", "busker/boiler/health", "busker/boiler/flow"];

    /// No earlier run is remembered.
    fn recall_nothing(outbox: &mut Outbox) {
        outbox.recall(BTreeMap::new(), Vec::new(), &WANTED.map(String::from).into());
    }

    fn announced(components: impl Iterator<Item = String>) -> String {
        format!(
            "{{\"origin\":{{\"name\":\"busker\"}},\"availability\":[{{\"topic\":\"busker/bridge/state\"}}],\
             \"components\":{{{}}}}}",
            components.collect::<Vec<_>>().join(",")
        )
    }

    #[test]
    fn nothing_is_taken_back_that_a_device_is_about_to_tell() {
        let mut outbox = outbox();
        recall_nothing(&mut outbox);
        // The broker is quicker than the device's bus.
        let found = telling_on(&[WANTED[0], "busker/boiler/flow", "busker/boiler/old"]);
        outbox.found("homeassistant/device/busker_boiler/config", &found);
        retained(&mut outbox, "busker/boiler/availability", "offline");
        check_sent(&mut outbox, &["busker/boiler/availability offline", "busker/boiler/old "]);
        retained(&mut outbox, "busker/boiler/info", "{}");
        check_sent(&mut outbox, &["busker/boiler/info {}"]);
    }

    #[test]
    fn the_message_of_all_values_is_taken_back_where_it_is_wanted_no_more() {
        let mut outbox = outbox();
        let tree = Tree { base_topic: "busker".into(), topics: ["busker/boiler".to_string()].into() };
        outbox.recall(BTreeMap::new(), vec![tree], &WANTED.map(String::from).into());
        retained(&mut outbox, WANTED[0], "online");
        check_sent(&mut outbox, &["busker/boiler/availability online", "busker/boiler "]);
    }

    #[test]
    fn what_an_earlier_run_told_on_topics_that_are_ours_no_more_is_forgotten_when_all_else_is_told() {
        let config = "homeassistant/device/busker_boiler/config";
        let mut outbox = outbox();
        recall_nothing(&mut outbox);
        let told = ["busker/boiler/flow", "busker/boiler/health", "busker/bridge/health"];
        outbox.found(config, &telling_on(&[&told[..], &["busker/boiler/old", "elsewhere/x"]].concat()));
        retained(&mut outbox, "busker/boiler/availability", "online");
        retained(&mut outbox, "busker/boiler/flow", "21.5");
        check_sent(
            &mut outbox,
            &["busker/boiler/availability online", "busker/boiler/flow 21.5", "busker/boiler/old "],
        );
        check_sent(&mut outbox, &[]);
    }

    #[test]
    fn what_an_earlier_run_announced_and_is_gone_is_taken_away() {
        let config = "homeassistant/device/busker_boiler/config";
        let (old, new) = (announcement(&["flow", "level"]), announcement(&["level"]));
        // `flow` stands there as a tombstone, behind what is left.
        let (gone, farewell) = (announcement(&["flow"]), announcement(&["level", "flow"]));
        let expected =
            [format!("{config} {gone}!"), format!("{config} {farewell}!"), format!("{config} {new}")];
        let expected: Vec<&str> = expected.iter().map(String::as_str).collect();

        // Found before it is announced anew, and after.
        let mut early = outbox();
        early.found(config, &old);
        check_sent(&mut early, &[]);
        retained(&mut early, config, &new);
        check_sent(&mut early, &expected);
        let mut late = outbox();
        retained(&mut late, config, &new);
        assert!(late.next_message(LATER).is_some());
        late.found(config, &old);
        check_sent(&mut late, &expected);
        late.found(config, &new);
        check_sent(&mut late, &[]);

        // A device that is no longer there goes whole, once; others' are left alone.
        let mut outbox = outbox();
        outbox.found("homeassistant/device/busker_gone/config", &old);
        outbox.found("homeassistant/device/busker_2_gone/config", &old.replace("busker/", "busker_2/"));
        outbox.found("homeassistant/device/stranger/config", "{}");
        let removal = outbox.next_message(LATER).expect("the device is removed");
        outbox.put_back(removal);
        check_sent(&mut outbox, &["homeassistant/device/busker_gone/config "]);
    }

    #[test]
    fn what_was_taken_away_while_home_assistant_was_not_there_is_taken_away_again_once() {
        let config = "homeassistant/device/busker_boiler/config";
        let gone = "homeassistant/device/busker_gone/config";
        let (old, new) = (announcement(&["flow", "level"]), announcement(&["level"]));
        let mut outbox = outbox();
        retained(&mut outbox, config, &new);
        outbox.found(config, &old);
        outbox.found(gone, &old);
        take_all(&mut outbox);
        outbox.home_assistant_started(Time::from_millis(0));
        let (flow, farewell) = (announcement(&["flow"]), announcement(&["level", "flow"]));
        let expected = [
            format!("{config} {flow}!"),
            format!("{config} {farewell}!"),
            format!("{config} {new}"),
            format!("{gone} {old}!"),
            format!("{gone} "),
        ];
        check_sent(&mut outbox, &expected.each_ref().map(String::as_str));
        outbox.settle(Time::from_millis(60_000));
        outbox.home_assistant_started(Time::from_millis(60_000));
        check_sent(&mut outbox, &[&expected[2]]);
    }
}
