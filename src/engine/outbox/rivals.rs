//! Another gateway that announces the same device to Home Assistant. Identities are made of the base topic and the
//! device's name: `busker` with `cellar_relays` is `busker_cellar` with `relays` to Home Assistant, and whoever
//! announced last would have its entities, the other's commands and all. So what stands there is left alone: a
//! gateway that finds another one's announcement in its place announces nothing there. The entities that somebody's
//! automations are made for go on meaning what they meant, whichever gateway starts when, and two gateways never
//! announce against each other.

use std::collections::BTreeMap;

use super::{Outbox, Queued};
use crate::engine::homeassistant::{self, Announcement};
use crate::engine::time::{Duration, Time};
use crate::engine::topics::{Message, Topics};

/// One that has only just come, and finds what stands here, puts it back in its place within this time.
const PUT_BACK_WITHIN: Duration = Duration::from_secs(10);

/// By discovery topic.
#[derive(Clone, Debug, Default)]
pub(super) struct Rivals {
    by_topic: BTreeMap<String, Rival>,
    /// Where other gateways announce what is nothing to this one, as long as its configuration is as it is; with their
    /// base topics.
    elsewhere: BTreeMap<String, String>,
    /// What has to be told to people.
    news: Vec<RivalNews>,
}

#[derive(Clone, Debug)]
struct Rival {
    base_topic: String,
    place: Place,
}

/// Whose the place is.
#[derive(Clone, Debug)]
enum Place {
    /// The other one has announced behind us. If that still stands then, the place is the other's.
    Disputed(Time),
    /// The other one's. This is what we would announce.
    Theirs(Option<String>),
}

/// Another gateway has been found in a place of this one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct RivalNews {
    /// Where Home Assistant looks for the device.
    pub topic: String,
    pub base_topic: String,
    /// Its announcement stays, and this gateway's is not told.
    pub stays: bool,
}

impl Rivals {
    /// Takes what is ours and not told.
    fn withhold(&mut self, topic: &str) -> Option<&mut Option<String>> {
        match &mut self.by_topic.get_mut(topic)?.place {
            Place::Theirs(ours) => Some(ours),
            Place::Disputed(_) => None,
        }
    }

    /// What stands there is ours.
    pub(super) fn give_way(&mut self, topic: &str) {
        if self.by_topic.get(topic).is_some_and(|rival| matches!(rival.place, Place::Disputed(_))) {
            self.by_topic.remove(topic);
        }
    }

    pub(super) fn due(&self) -> Option<Time> {
        let due = |rival: &Rival| match rival.place {
            Place::Disputed(due) => Some(due),
            Place::Theirs(_) => None,
        };
        self.by_topic.values().filter_map(due).min()
    }

    /// What is not this gateway's any more is only the other one's.
    fn keep(&mut self, is_own: impl Fn(&str) -> bool) {
        let (own, others) =
            std::mem::take(&mut self.by_topic).into_iter().partition(|(topic, _)| is_own(topic));
        self.by_topic = own;
        let others: BTreeMap<String, Rival> = others;
        self.elsewhere.extend(others.into_iter().map(|(topic, rival)| (topic, rival.base_topic)));
    }

    fn heard_elsewhere(&mut self, topic: &str, payload: &str) {
        match homeassistant::announcer(payload) {
            Some(base_topic) => self.elsewhere.insert(topic.into(), base_topic),
            None => self.elsewhere.remove(topic),
        };
    }

    fn tell(&mut self, topic: &str, base_topic: &str, stays: bool) {
        self.news.push(RivalNews { topic: topic.into(), base_topic: base_topic.into(), stays });
    }
}

impl Outbox {
    /// Where other gateways announce what has the identity of something of ours: by discovery topic, their base
    /// topics.
    pub fn rivals(&self) -> BTreeMap<String, String> {
        let rivals = self.rivals.by_topic.iter();
        rivals.map(|(topic, rival)| (topic.clone(), rival.base_topic.clone())).collect()
    }

    /// Those that nobody has been told of yet: [`Outbox::take_lines`].
    pub(super) fn take_news_of_rivals(&mut self) -> Vec<RivalNews> {
        std::mem::take(&mut self.rivals.news)
    }

    /// Somebody, this gateway most likely, has told something on a discovery topic just now.
    pub(super) fn heard_announcement(&mut self, topic: &str, payload: &str, now: Time) {
        if !self.own_devices.contains(topic) {
            return self.rivals.heard_elsewhere(topic, payload);
        }
        // All that this gateway announces comes back, and is not taken apart for that.
        let is_ours = |outbox: &Outbox| {
            outbox.retained.get(topic).is_some_and(|entry| entry.payload == payload)
                || Announcement::parse(&outbox.topics, topic, payload).is_some()
        };
        if payload.is_empty() {
            self.rival_has_gone(topic);
        } else if is_ours(self) {
            self.rivals.give_way(topic);
            self.has_arrived(topic, payload.len(), now);
        } else if let Some(base_topic) = homeassistant::announcer(payload) {
            let place = Place::Disputed(now + PUT_BACK_WITHIN);
            let is_known = self.rivals.by_topic.contains_key(topic);
            if !is_known {
                self.rivals.by_topic.insert(topic.into(), Rival { base_topic: base_topic.clone(), place });
                self.rivals.tell(topic, &base_topic, false);
            }
        }
    }

    /// The broker remembers this announcement, which is none of ours.
    pub(super) fn found_of_rival(&mut self, topic: &str, payload: &str) {
        if !self.own_devices.contains(topic) {
            return self.rivals.heard_elsewhere(topic, payload);
        }
        let Some(base_topic) = homeassistant::announcer(payload) else { return };
        let told = self.retained.get(topic).filter(|entry| self.is_connected && entry.is_told);
        let ours = told.map(|entry| entry.payload.clone());
        self.leave_to(topic, &base_topic);
        if let Some(ours) = ours {
            self.put_back_rivals(topic, &base_topic, &ours, payload);
        }
    }

    /// This gateway has something else now. Where another one announces already what is new, the place is the other's.
    pub(super) fn meet_rivals(&mut self) {
        let own = &self.own_devices;
        self.rivals.keep(|topic| own.contains(topic));
        let met = self
            .rivals
            .elsewhere
            .iter()
            .filter(|(topic, base)| own.contains(*topic) && *base != self.topics.base());
        let met: Vec<(String, String)> = met.map(|(topic, base)| (topic.clone(), base.clone())).collect();
        for (topic, base_topic) in met {
            self.rivals.elsewhere.remove(&topic);
            self.leave_to(&topic, &base_topic);
        }
    }

    /// The time of [`Rivals::due`] may have come.
    pub(super) fn wake_rivals(&mut self, now: Time) {
        let is_due = |rival: &Rival| matches!(rival.place, Place::Disputed(due) if due <= now);
        let due = self.rivals.by_topic.iter().filter(|(_, rival)| is_due(rival));
        let due: Vec<_> = due.map(|(topic, rival)| (topic.clone(), rival.base_topic.clone())).collect();
        for (topic, base_topic) in due {
            self.leave_to(&topic, &base_topic);
        }
    }

    /// Whether the place is another's: then what we would announce there is kept here.
    pub(super) fn is_withheld(&mut self, message: &Message) -> bool {
        let Some(ours) = self.rivals.withhold(&message.topic) else { return false };
        // What is told once prepares what is announced then.
        if message.retain {
            *ours = Some(message.payload.clone());
        }
        true
    }

    fn leave_to(&mut self, topic: &str, base_topic: &str) {
        let before = self.rivals.by_topic.remove(topic);
        let is_known = before.as_ref().is_some_and(|rival| rival.base_topic == base_topic);
        let withheld = match before.map(|rival| rival.place) {
            Some(Place::Theirs(ours)) if is_known => {
                let rival = Rival { base_topic: base_topic.into(), place: Place::Theirs(ours) };
                self.rivals.by_topic.insert(topic.into(), rival);
                return;
            }
            Some(Place::Theirs(ours)) => ours,
            Some(Place::Disputed(_)) | None => None,
        };
        self.remembered.remove(topic);
        self.departed.forget(topic);
        self.queue.forget(self.lane(topic), topic);
        self.await_no_return(topic);
        let ours = self.retained.remove(topic).map(|entry| entry.payload).or(withheld);
        let rival = Rival { base_topic: base_topic.into(), place: Place::Theirs(ours) };
        self.rivals.by_topic.insert(topic.into(), rival);
        self.rivals.tell(topic, base_topic, true);
    }

    /// What stood there was found only behind our own announcement.
    fn put_back_rivals(&mut self, topic: &str, base_topic: &str, ours: &str, theirs: &str) {
        let ours = Announcement::parse(&self.topics, topic, ours);
        let parsed = Announcement::parse(&Topics::new(base_topic), topic, theirs);
        if let (Some(ours), Some(theirs)) = (ours, parsed) {
            let lane = self.lane(topic);
            if let Some(farewell) = homeassistant::farewell(&ours, &theirs) {
                self.queue.push_back(lane, Queued::Once(Box::new(farewell)));
            }
        }
        self.queue_last(Queued::Once(Box::new(Message::retained(topic, theirs))));
    }

    /// Nothing is announced there any more.
    fn rival_has_gone(&mut self, topic: &str) {
        match self.rivals.by_topic.remove(topic).map(|rival| rival.place) {
            Some(Place::Theirs(Some(ours))) => self.push(Message::retained(topic, ours)),
            Some(Place::Disputed(_)) => self.tell_again(topic),
            Some(Place::Theirs(None)) | None => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{LATER, check_sent, outbox, retained, take_all};
    use super::*;

    const CONFIG: &str = "homeassistant/device/busker_boiler/config";

    fn announcement(base_topic: &str, keys: &[&str]) -> String {
        let keys: Vec<String> =
            keys.iter().map(|key| format!("\"{key}\":{{\"platform\":\"switch\"}}")).collect();
        format!(
            "{{\"origin\":{{\"name\":\"busker\"}},\"availability\":[{{\"topic\":\"{base_topic}/bridge/state\"}}],\
             \"components\":{{{}}}}}",
            keys.join(",")
        )
    }

    /// What is told of another gateway, `house`; the same of all tests.
    fn news(stays: bool) -> RivalNews {
        RivalNews { topic: CONFIG.into(), base_topic: "house".into(), stays }
    }

    #[track_caller]
    fn check_news(outbox: &mut Outbox, expected: &[RivalNews]) {
        assert_eq!(outbox.take_news_of_rivals(), expected);
    }

    #[track_caller]
    fn check_rival(outbox: &Outbox, is_there: bool) {
        let expected = is_there.then(|| (CONFIG.to_string(), "house".to_string()));
        assert_eq!(outbox.rivals(), BTreeMap::from_iter(expected));
    }

    #[test]
    fn what_another_gateway_has_announced_stays_and_ours_is_told_when_it_has_gone() {
        let mut outbox = outbox();
        outbox.connected();
        take_all(&mut outbox);
        outbox.found(CONFIG, &announcement("house", &["flow"]));
        check_news(&mut outbox, &[news(true)]);
        check_rival(&outbox, true);
        let (first, second) =
            (announcement("busker", &["level"]), announcement("busker", &["level", "flow"]));
        retained(&mut outbox, CONFIG, &first);
        outbox.push(Message::once(CONFIG, first));
        retained(&mut outbox, CONFIG, &second);
        retained(&mut outbox, "busker/boiler/flow", "21.5");
        check_sent(&mut outbox, &["busker/boiler/flow 21.5"]);
        // Neither a restart of Home Assistant nor one of the broker changes that.
        outbox.home_assistant_started(LATER);
        check_sent(&mut outbox, &[]);
        outbox.disconnected();
        outbox.connected();
        outbox.found(CONFIG, &announcement("house", &["flow"]));
        check_sent(&mut outbox, &["busker/boiler/flow 21.5", "busker/bridge/state online"]);
        check_news(&mut outbox, &[]);
        assert!(outbox.ledger().is_empty());
        // Nor is it taken back as if it were ours.
        let mut ending = outbox.clone();
        ending.take_back_everything();
        check_sent(&mut ending, &["busker/boiler/flow "]);
        let mut without = outbox.clone();
        without.reconfigure([], &[].into(), &["busker/boiler/flow".to_string()].into());
        check_sent(&mut without, &[]);
        check_rival(&without, false);

        outbox.heard_announcement(CONFIG, "", LATER);
        check_sent(&mut outbox, &[&format!("{CONFIG} {second}")]);
        check_rival(&outbox, false);
    }

    #[test]
    fn a_device_that_comes_with_a_new_configuration_finds_what_others_have_announced() {
        let other = "homeassistant/device/busker_pump/config";
        let (ours, theirs) = (announcement("busker", &["speed"]), announcement("house", &["flow"]));
        for (tell, is_there) in [
            (&(|outbox: &mut Outbox| outbox.found(other, &theirs)) as &dyn Fn(&mut Outbox), true),
            (&|outbox: &mut Outbox| outbox.heard_announcement(other, &theirs, LATER), true),
            (
                &|outbox: &mut Outbox| {
                    outbox.found(other, &theirs);
                    outbox.heard_announcement(other, "", LATER);
                },
                false,
            ),
            // What this gateway itself had before.
            (&|outbox: &mut Outbox| outbox.heard_announcement(other, &ours, LATER), false),
        ] {
            let mut outbox = outbox();
            outbox.connected();
            tell(&mut outbox);
            take_all(&mut outbox);
            let identities = ["busker_bridge", "busker_boiler", "busker_pump"].map(String::from);
            outbox.reconfigure(identities, &[].into(), &[].into());
            retained(&mut outbox, other, &ours);
            match is_there {
                true => check_sent(&mut outbox, &[]),
                false => check_sent(&mut outbox, &[&format!("{other} {ours}")]),
            }
            assert_eq!(outbox.rivals().contains_key(other), is_there);
            // And back, and once more.
            let before = ["busker_bridge", "busker_boiler"].map(String::from);
            outbox.reconfigure(before, &[].into(), &[].into());
            assert_eq!(outbox.rivals().len(), 0);
            let identities = ["busker_bridge", "busker_boiler", "busker_pump"].map(String::from);
            outbox.reconfigure(identities, &[].into(), &[].into());
            assert_eq!(outbox.rivals().contains_key(other), is_there);
        }
    }

    #[test]
    fn what_was_found_only_behind_our_announcement_is_put_back() {
        let (ours, theirs) = (announcement("busker", &["level"]), announcement("house", &["flow"]));
        let mut outbox = outbox();
        retained(&mut outbox, CONFIG, &ours);
        outbox.connected();
        take_all(&mut outbox);
        outbox.found(CONFIG, &theirs);
        let farewell = announcement("house", &["flow", "level"]);
        check_sent(&mut outbox, &[&format!("{CONFIG} {farewell}!"), &format!("{CONFIG} {theirs}")]);
        check_news(&mut outbox, &[news(true)]);
        // Our own comes back to us, and what was put back.
        outbox.heard_announcement(CONFIG, &ours, LATER);
        outbox.heard_announcement(CONFIG, &theirs, LATER);
        check_rival(&outbox, true);
        check_sent(&mut outbox, &[]);
        check_news(&mut outbox, &[]);
    }

    #[test]
    fn what_could_not_be_put_back_yet_is_not_taken_away_instead() {
        let mut outbox = outbox();
        retained(&mut outbox, CONFIG, &announcement("busker", &["level"]));
        outbox.connected();
        take_all(&mut outbox);
        let theirs = announcement("house", &["level"]);
        outbox.found(CONFIG, &theirs);
        let message = outbox.next_message(LATER).expect("it is put back");
        outbox.put_back(message);
        check_sent(&mut outbox, &[&format!("{CONFIG} {theirs}")]);
    }

    #[test]
    fn who_announces_behind_us_has_some_seconds_to_put_it_back() {
        let (ours, theirs) = (announcement("busker", &["level"]), announcement("house", &["flow"]));
        let mut outbox = outbox();
        retained(&mut outbox, CONFIG, &ours);
        outbox.connected();
        take_all(&mut outbox);
        outbox.heard_announcement(CONFIG, &ours, LATER);
        check_rival(&outbox, false);
        for _ in 0..3 {
            outbox.heard_announcement(CONFIG, &theirs, LATER);
            check_rival(&outbox, true);
            outbox.heard_announcement(CONFIG, &ours, LATER);
            check_rival(&outbox, false);
        }
        assert_eq!(outbox.wake_at(), None);
        assert!(outbox.take_news_of_rivals().iter().all(|news| !news.stays));

        outbox.heard_announcement(CONFIG, &theirs, LATER);
        let due = outbox.wake_at().expect("it stands for long");
        assert_eq!(due, LATER + PUT_BACK_WITHIN);
        outbox.take_news_of_rivals();
        outbox.wake(due);
        check_news(&mut outbox, &[news(true)]);
        outbox.home_assistant_started(due);
        check_sent(&mut outbox, &[]);
        assert!(outbox.wake_at().is_some_and(|at| at > due), "the states follow");

        // Before that its end is ours to make good.
        let mut outbox = super::super::tests::outbox();
        retained(&mut outbox, CONFIG, &ours);
        outbox.connected();
        take_all(&mut outbox);
        outbox.heard_announcement(CONFIG, &theirs, LATER);
        outbox.heard_announcement(CONFIG, "", LATER);
        check_sent(&mut outbox, &[&format!("{CONFIG} {ours}")]);
    }

    #[test]
    fn what_no_gateway_announced_is_replaced_and_what_is_not_in_our_place_is_nothing_to_us() {
        let ours = announcement("busker", &["level"]);
        for (topic, payload) in [
            (CONFIG, "{}".to_string()),
            (CONFIG, "nonsense".to_string()),
            (CONFIG, announcement("house", &["flow"]).replace("busker", "zigbee")),
            ("homeassistant/device/house_boiler/config", announcement("house", &["flow"])),
        ] {
            let mut outbox = outbox();
            outbox.connected();
            take_all(&mut outbox);
            outbox.found(topic, &payload);
            outbox.heard_announcement(topic, &payload, LATER);
            retained(&mut outbox, CONFIG, &ours);
            check_sent(&mut outbox, &[&format!("{CONFIG} {ours}")]);
            check_rival(&outbox, false);
        }
    }
}
