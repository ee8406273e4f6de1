//! What becomes of retained topics when the configuration changes while the gateway runs.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use crate::engine::homeassistant::{self, Announcement};
use crate::engine::settings::Settings;
use crate::engine::topics::{Kind, Message, Topics};

use super::{Outbox, Queued, Rank, Tree};

impl Outbox {
    /// The gateway will be as these settings want it, below the base topic that it had: its devices tell something on
    /// `wanted`. What stood elsewhere is taken back by [`Outbox::reconfigure`], when it has been told anew.
    pub fn tell_otherwise(&mut self, settings: &Settings, wanted: &BTreeSet<String>) {
        let home_assistant = &settings.home_assistant;
        let prefix = format!("{}/device/", home_assistant.prefix);
        if prefix != self.discovery_prefix {
            for topic in self.in_order(|rank| rank == Rank::Discovery) {
                self.take_back_announcement(&topic);
            }
        }
        let values = settings.mqtt.values;
        let is_kept_otherwise = values.retain != self.values.retain;
        (self.topics, self.discovery_prefix, self.values) = (Topics::of(&settings.mqtt), prefix, values);
        if is_kept_otherwise {
            self.keep_otherwise();
        }
        // Nothing of it that an earlier run has left is taken back before it is told.
        let own: Vec<String> =
            homeassistant::identities(settings).into_iter().map(|own| self.discovery(&own)).collect();
        self.own_devices.extend(own);
        self.wanted.extend(wanted.iter().cloned());
    }

    /// The broker is to keep values that it does not, or the other way round.
    fn keep_otherwise(&mut self) {
        for topic in self.in_order(|rank| rank == Rank::State) {
            let is_value = self.topics.kind(&topic) == Kind::Value;
            let Some(entry) = self.retained.get_mut(&topic).filter(|_| is_value) else { continue };
            entry.kept = !self.values.retain;
            self.tell_again(&topic);
        }
    }

    /// The gateway has something else now: `identities` as for [`Outbox::new`], and on `wanted` its devices
    /// tell something, on `before` they did. What it has told of anything else, perhaps only in an earlier run,
    /// is taken back at the broker.
    pub fn reconfigure(
        &mut self,
        identities: impl IntoIterator<Item = String>,
        before: &BTreeSet<String>,
        wanted: &BTreeSet<String>,
    ) {
        let told_earlier = before.difference(wanted).filter(|topic| !self.retained.contains_key(&***topic));
        self.left_behind.extend(told_earlier.cloned());
        self.wanted.clone_from(wanted);
        self.own_devices = identities.into_iter().map(|identity| self.discovery(&identity)).collect();
        let of_devices = self.in_order(|rank| !matches!(rank, Rank::Bridge | Rank::BridgeState));
        for topic in of_devices {
            if self.rank(&topic) == Rank::Discovery {
                if !self.own_devices.contains(&*topic) {
                    self.take_back_announcement(&topic);
                }
            } else if !wanted.contains(&*topic) {
                self.take_back(&topic);
                self.taken_back.add(&topic);
            }
        }
        // What has not been announced in this run was in an earlier one.
        let is_gone = |topic: &&String| !self.own_devices.contains(*topic);
        let gone: Vec<String> = self.remembered.keys().filter(is_gone).cloned().collect();
        for topic in gone {
            if let Some(found) = self.remembered.remove(&topic) {
                self.push_once(Message { retain: false, ..found.message() });
                self.take_back(&topic);
                self.departed.add(found);
            }
        }
        let is_told = |topic: &str| self.retained.contains_key(topic);
        self.arriving.keep(is_told);
        self.meet_rivals();
    }

    /// Something will be announced anew: what it has no more is buried then.
    pub fn announced_anew(&mut self, identity: &str) {
        let topic = self.discovery(identity);
        let Some(entry) = self.retained.remove(&*topic) else { return };
        if let Some(found) = Announcement::parse(&self.topics, &topic, &entry.payload) {
            self.remembered.insert(topic, found);
        }
    }

    /// The gateway will be another one: nothing that it told stays at the broker, but that it is offline.
    /// Returns the announcements that stood until now, by topic, told already or not.
    pub fn take_back_everything(&mut self) -> BTreeMap<String, Vec<String>> {
        // First what Home Assistant was announced, so that nobody reads anything out of the empty messages.
        let announced = self.in_order(|rank| rank == Rank::Discovery);
        let others = self.in_order(|rank| rank != Rank::Discovery && rank != Rank::BridgeState);
        let payload = |topic: &Arc<str>| (topic.to_string(), vec![self.retained[topic].payload.clone()]);
        let stood = announced.iter().map(payload).collect();
        for topic in announced.into_iter().chain(others) {
            self.take_back(&topic);
        }
        stood
    }

    /// What the gateway's next outbox, below another base topic, has to [`Outbox::recall`] when this one has ended:
    /// `announced` is what [`Outbox::take_back_everything`] returned, `told_on` is where the devices told something.
    /// That this gateway is offline stands there still.
    pub fn legacy(
        &self,
        announced: BTreeMap<String, Vec<String>>,
        told_on: BTreeSet<String>,
    ) -> (BTreeMap<String, Vec<String>>, Vec<Tree>) {
        if self.is_empty() {
            // Everything has been taken back, but Home Assistant may not have heard of all that departed before.
            let departed = self.departed.topics().into_iter().map(|topic| {
                let parts = self.departed.of(&topic);
                (topic, parts.iter().map(|part| part.message().payload).collect())
            });
            let present = Tree { base_topic: self.topics.base().into(), topics: BTreeSet::new() };
            (departed.collect(), std::iter::once(present).chain(self.former_trees()).collect())
        } else {
            (announced, self.trees(told_on))
        }
    }

    /// What an earlier run has announced, and the broker may have forgotten. What is there no more is announced
    /// once again and taken away then.
    pub(super) fn recall_announcements(&mut self, topic: &str, payloads: &[String]) {
        if !self.own_devices.contains(topic) {
            let parse = |payload: &String| Announcement::parse(&self.topics, topic, payload);
            let parts: Vec<Announcement> = payloads.iter().filter_map(parse).collect();
            self.announce_to_remove(&parts);
        }
        // The first is what was announced last.
        payloads.iter().rev().for_each(|payload| self.found(topic, payload));
    }

    fn take_back_announcement(&mut self, topic: &str) {
        let found = self.announced_on(topic);
        self.take_back(topic);
        // If Home Assistant is not there to hear it, it is told again when it starts.
        found.into_iter().for_each(|found| self.departed.add(found));
    }

    fn take_back(&mut self, topic: &str) {
        self.retained.remove(topic);
        self.queue_last(Queued::Removal(topic.to_string()));
    }
}

#[cfg(test)]
mod tests {
    use super::super::taken_back::ARRIVES_WITHIN;
    use super::*;
    use crate::engine::configuration;
    use crate::engine::profile::Library;
    use crate::engine::time::Time;
    use crate::engine::topics::Topics;

    fn outbox() -> Outbox {
        let identities = ["busker_bridge", "busker_boiler", "busker_pump"].map(String::from);
        let mut outbox = Outbox::new(Topics::new("busker"), "homeassistant", identities);
        for (topic, payload) in [
            ("busker/bridge/info", "{}"),
            ("homeassistant/device/busker_bridge/config", "{}"),
            ("homeassistant/device/busker_boiler/config", "{}"),
            ("homeassistant/device/busker_pump/config", "{}"),
            ("busker/boiler/availability", "online"),
            ("busker/boiler/flow", "21.5"),
            ("busker/boiler/old", "7"),
            ("busker/pump/availability", "online"),
        ] {
            outbox.push(Message::retained(topic, payload));
        }
        outbox.connected();
        while outbox.next_message(Time(0)).is_some() {}
        outbox
    }

    fn sent(outbox: &mut Outbox) -> Vec<String> {
        let next =
            || outbox.next_message(Time(0)).map(|message| format!("{} {}", message.topic, message.payload));
        std::iter::from_fn(next).collect()
    }

    fn without_the_pump(outbox: &mut Outbox) {
        let wanted = ["busker/boiler/availability", "busker/boiler/flow"].map(String::from).into();
        outbox.reconfigure(["busker_bridge", "busker_boiler"].map(String::from), &BTreeSet::new(), &wanted);
    }

    /// The same gateway, with `more` in its configuration; its devices are `boiler` and `pump`.
    fn settings(more: &str) -> Settings {
        let text = format!(
            "{more}\nbuses: {{a: {{tcp: 'h:1'}}}}\ndevices:\n  boiler: {{bus: a, unit: 1, points: {{flow: {{at: input 0, poll: fast}}}}}}\n  \
             pump: {{bus: a, unit: 2, points: {{speed: {{at: input 0, poll: fast}}}}}}\n"
        );
        let loaded = configuration::load("busker.yaml", text.as_bytes(), &Library::shipped());
        loaded.unwrap_or_else(|faults| panic!("{faults:?}")).0
    }

    #[test]
    fn what_stands_elsewhere_is_taken_back_when_it_has_been_told_anew() {
        let new = settings(
            "mqtt: {url: 'mqtt://h', topics: '{base}/x/{device}/{point}'}\nhome_assistant: {prefix: ha}",
        );
        let wanted = ["availability", "flow"].map(|point| format!("busker/x/boiler/{point}")).into();
        let mut outbox = outbox();
        outbox.tell_otherwise(&new, &wanted);
        // Found of an earlier life there: it will be announced.
        let earlier = "{\"origin\":{\"name\":\"busker\"},\"availability\":[{\"topic\":\"busker/bridge/state\"}],\
             \"components\":{}}";
        outbox.found("ha/device/busker_pump/config", earlier);
        let told = [
            ("ha/device/busker_boiler/config", "{}"),
            ("busker/x/boiler/availability", "online"),
            ("busker/x/boiler/flow", "21.5"),
        ];
        told.iter().for_each(|(topic, payload)| outbox.push(Message::retained(*topic, *payload)));
        let announced =
            ["bridge", "boiler", "pump"].map(|of| format!("homeassistant/device/busker_{of}/config "));
        let told = told.map(|(topic, payload)| format!("{topic} {payload}"));
        let all = sent(&mut outbox);
        assert_eq!(all.len(), 6, "{all:?}");
        assert!(announced.iter().chain(&told).all(|message| all.contains(message)), "{all:?}");
        outbox.reconfigure(homeassistant::identities(&new), &BTreeSet::new(), &wanted);
        let gone = ["boiler/availability", "boiler/flow", "boiler/old", "pump/availability"];
        assert_eq!(sent(&mut outbox), gone.map(|topic| format!("busker/{topic} ")));
    }

    #[test]
    fn values_that_the_broker_shall_keep_or_not_are_told_so_at_once() {
        let mut outbox = outbox();
        let without = settings("mqtt: {url: 'mqtt://h', retain: false}");
        let values = ["flow", "old"].map(|point| format!("busker/boiler/{point} "));
        outbox.tell_otherwise(&without, &BTreeSet::new());
        let told = sent(&mut outbox);
        assert!(values.iter().all(|removal| told.contains(removal)) && told.len() == 4, "{told:?}");
        outbox.tell_otherwise(&settings("mqtt: {url: 'mqtt://h'}"), &BTreeSet::new());
        let message = outbox.next_message(Time(0)).expect("a value");
        assert!(outbox.manner(&message).retain, "{message:?}");
        assert_eq!((message.payload.as_str(), sent(&mut outbox).len()), ("21.5", 1));
    }

    const TAKEN_BACK: [&str; 3] =
        ["homeassistant/device/busker_pump/config ", "busker/pump/availability ", "busker/boiler/old "];

    #[test]
    fn what_is_gone_is_taken_back_and_the_rest_is_left_alone() {
        let mut outbox = outbox();
        without_the_pump(&mut outbox);
        assert_eq!(sent(&mut outbox), TAKEN_BACK);
        assert!(outbox.settle(Time(0) + ARRIVES_WITHIN));
        outbox.connected();
        let again = sent(&mut outbox);
        assert_eq!(again.len(), 6, "{again:?}");
        assert!(!again.iter().any(|sent| sent.contains("pump") || sent.contains("old")), "{again:?}");
    }

    #[test]
    fn what_is_gone_while_the_broker_is_away_is_taken_back_when_it_is_there() {
        let mut outbox = outbox();
        without_the_pump(&mut outbox);
        // Meanwhile one of them is there again.
        outbox.push(Message::retained("busker/boiler/old", "8"));
        outbox.connected();
        let sent = sent(&mut outbox);
        let is_sent = |message: &str| sent.iter().any(|other| other == message);
        assert!(TAKEN_BACK[..2].iter().all(|message| is_sent(message)), "{sent:?}");
        assert!(is_sent("busker/boiler/old 8"), "{sent:?}");
        assert!(!is_sent(TAKEN_BACK[2]), "{sent:?}");
    }

    #[test]
    fn what_cannot_be_taken_back_is_left_to_the_next_outbox() {
        let (mut outbox, told_on) = (outbox(), BTreeSet::from(["busker/boiler/flow".to_string()]));
        let announced = outbox.take_back_everything();
        let boiler = "homeassistant/device/busker_boiler/config";
        assert_eq!((announced.len(), &announced[boiler]), (3, &vec!["{}".to_string()]));
        let (of_boiler, trees) = outbox.legacy(announced.clone(), told_on.clone());
        assert_eq!(of_boiler, announced);
        assert_eq!(trees, [Tree { base_topic: "busker".into(), topics: told_on.clone() }]);
        sent(&mut outbox);
        let nothing_but_its_state = Tree { base_topic: "busker".into(), topics: BTreeSet::new() };
        assert_eq!(outbox.legacy(announced, told_on), (BTreeMap::new(), vec![nothing_but_its_state]));
    }

    #[test]
    fn everything_can_be_taken_back() {
        let mut outbox = outbox();
        outbox.take_back_everything();
        let sent = sent(&mut outbox);
        assert_eq!(sent.len(), 8, "{sent:?}");
        assert!(sent.iter().all(|sent| sent.ends_with(' ')), "{sent:?}");
        let is_announcement = |sent: &&String| sent.starts_with("homeassistant/");
        let announced = sent.iter().take_while(is_announcement).count();
        assert!(announced > 0 && announced == sent.iter().filter(is_announcement).count(), "{sent:?}");
    }

    #[test]
    fn what_an_earlier_run_announced_is_taken_away_also_when_the_broker_has_forgotten_it() {
        let announcement = |keys: &[&str]| {
            let keys: Vec<String> =
                keys.iter().map(|key| format!("\"{key}\":{{\"platform\":\"sensor\"}}")).collect();
            format!(
                "{{\"availability\":[{{\"topic\":\"busker/bridge/state\"}}],\"origin\":{{\"name\":\"busker\"}},\
                 \"components\":{{{}}}}}",
                keys.join(",")
            )
        };
        let [boiler, pump] =
            ["boiler", "pump"].map(|device| format!("homeassistant/device/busker_{device}/config"));
        let mut outbox = Outbox::new(Topics::new("busker"), "homeassistant", ["busker_boiler".to_string()]);
        outbox.recall_announcements(&boiler, &[announcement(&["flow", "level"])]);
        outbox.recall_announcements(&pump, &[announcement(&["speed"])]);
        outbox.recall_announcements("homeassistant/device/strange/config", &["{}".to_string()]);
        let present = announcement(&["level"]);
        outbox.push(Message::retained(boiler.clone(), present.clone()));
        outbox.connected();
        let expected = [
            format!("{boiler} {}", announcement(&["flow"])),
            format!("{boiler} {}", announcement(&["level", "flow"])),
            format!("{boiler} {present}"),
            format!("{pump} {}", announcement(&["speed"])),
            format!("{pump} "),
            "busker/bridge/state online".to_string(),
        ];
        assert_eq!(sent(&mut outbox), expected);
        // The broker had not forgotten it after all.
        outbox.found(&pump, &announcement(&["speed"]));
        assert_eq!(sent(&mut outbox), [""; 0], "once is enough");
    }
}
