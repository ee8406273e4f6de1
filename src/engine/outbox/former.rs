//! What earlier runs have left at the broker below another base topic: it is taken back, unless somebody else
//! has that base topic now.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use super::{Outbox, Queued};
use crate::engine::homeassistant::Announcement;
use crate::engine::time::{Duration, Time};
use crate::engine::topics::{Message, ONLINE, Topics};

/// A broker tells what it remembers of a topic within this time after it was asked.
const LISTEN_FOR: Duration = Duration::from_secs(2);

/// The retained topics of a gateway's devices below one base topic; kept in `state_dir`.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Tree {
    pub base_topic: String,
    pub topics: BTreeSet<String>,
}

/// A tree that this gateway had, and what was announced of it.
#[derive(Clone, Debug)]
pub(super) struct Former {
    tree: Tree,
    announced: Vec<Announcement>,
}

impl Former {
    fn topics(&self) -> Topics {
        Topics::new(&self.tree.base_topic)
    }

    pub(super) fn announced(&self) -> &[Announcement] {
        &self.announced
    }
}

impl Outbox {
    /// What earlier runs have announced ([`Outbox::ledger`]) and told. Of that on `wanted` something is told again; what
    /// else was told is taken back: at once what stands below the present base topic, and what stands below
    /// another when it is known that nobody else is there.
    pub fn recall(
        &mut self,
        announced: BTreeMap<String, Vec<String>>,
        trees: Vec<Tree>,
        wanted: &BTreeSet<String>,
    ) {
        self.wanted.clone_from(wanted);
        for mut tree in trees {
            tree.topics.retain(|topic| !wanted.contains(topic));
            if Topics::new(&tree.base_topic).bridge_state() == self.topics.bridge_state() {
                self.left_behind.extend(tree.topics);
            } else {
                self.formers.push(Former { tree, announced: Vec::new() });
            }
        }
        for (topic, payloads) in announced {
            self.recall_announcements(&topic, &payloads);
        }
    }

    pub(super) fn former_trees(&self) -> impl Iterator<Item = Tree> + '_ {
        self.formers.iter().map(|former| former.tree.clone())
    }

    /// Where it is told whether somebody is below a base topic that this gateway had.
    pub fn former_states(&self) -> Vec<String> {
        self.formers.iter().map(|former| former.topics().bridge_state()).collect()
    }

    /// The broker listens to what this gateway asks: it tells now what it remembers.
    pub fn listens(&mut self, now: Time) {
        self.watch_suspect(now);
        self.formers_due = (!self.formers.is_empty()).then(|| now + LISTEN_FOR);
    }

    /// What stands on one of [`Outbox::former_states`]. The base topic that is left alone, since somebody is there.
    pub(super) fn heard_former(&mut self, topic: &str, payload: &str) -> Option<String> {
        let at = self.formers.iter().position(|former| former.topics().bridge_state() == topic)?;
        if payload != ONLINE {
            return None;
        }
        self.is_left_to_others = true;
        let former = self.formers.remove(at);
        for found in former.announced {
            self.found_of_rival(found.topic(), &found.message().payload);
        }
        Some(former.tree.base_topic)
    }

    /// The broker remembers this announcement, which is not of the present base topic. Whether it is of one that
    /// this gateway had.
    pub(super) fn found_of_former(&mut self, topic: &str, payload: &str) -> bool {
        for former in &mut self.formers {
            if let Some(found) = Announcement::parse(&former.topics(), topic, payload) {
                former.announced.retain(|other| other.topic() != topic);
                former.announced.push(found);
                return true;
            }
        }
        false
    }

    /// The time of [`LISTEN_FOR`] may be over.
    pub(super) fn wake_formers(&mut self, now: Time) {
        if self.formers_due.is_some_and(|due| due <= now) {
            self.formers_due = None;
            for former in std::mem::take(&mut self.formers) {
                self.take_back_former(former);
            }
        }
    }

    fn take_back_former(&mut self, former: Former) {
        let topics = former.topics();
        for found in former.announced {
            let topic = found.topic().to_string();
            if self.own_devices.contains(&topic) {
                // Two base topics may make one identity: then what is told now takes its place.
                continue;
            }
            // Home Assistant lets go only of what it has been told since its start.
            self.push_once(Message { retain: false, ..found.message() });
            self.queue_last(Queued::Removal(topic.clone()));
            self.departed.add(found);
        }
        self.left_behind.extend(former.tree.topics);
        self.left_behind.extend([topics.bridge_state(), topics.bridge_info(), topics.bridge_health()]);
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{check_sent, outbox, retained, take_all};
    use super::*;

    const CONFIG: &str = "homeassistant/device/old_boiler/config";
    const ANNOUNCED: &str = "{\"origin\":{\"name\":\"busker\"},\"availability\":[{\"topic\":\"old/bridge/state\"}],\
        \"components\":{}}";

    fn tree(base: &str, topics: &[&str]) -> Tree {
        Tree { base_topic: base.into(), topics: topics.iter().map(|topic| topic.to_string()).collect() }
    }

    /// An outbox that had the base topic `old` before.
    fn moved() -> Outbox {
        let mut outbox = outbox();
        let announced = BTreeMap::from([
            (CONFIG.to_string(), vec![ANNOUNCED.to_string()]),
            // Neither of ours.
            ("homeassistant/device/other/config".to_string(), vec![ANNOUNCED.replace("old/", "other/")]),
        ]);
        outbox.recall(announced, vec![tree("old", &["old/boiler/flow"])], &BTreeSet::new());
        outbox.connected();
        assert_eq!(outbox.former_states(), ["old/bridge/state"]);
        assert_eq!(outbox.ledger(), BTreeMap::from([(CONFIG, vec![ANNOUNCED.into()])]));
        outbox
    }

    fn taken_back() -> Vec<String> {
        [
            format!("{CONFIG} {ANNOUNCED}!"),
            format!("{CONFIG} "),
            "busker/bridge/state online".to_string(),
            "old/boiler/flow ".to_string(),
            "old/bridge/health ".to_string(),
            "old/bridge/info ".to_string(),
            "old/bridge/state ".to_string(),
        ]
        .to_vec()
    }

    #[track_caller]
    fn check_taken_back(outbox: &mut Outbox) {
        let expected = taken_back();
        check_sent(outbox, &expected.iter().map(String::as_str).collect::<Vec<_>>());
    }

    #[test]
    fn what_stands_below_another_base_topic_is_taken_back_when_nobody_is_there() {
        let now = Time::from_millis(5000);
        let mut outbox = moved();
        assert_eq!(outbox.heard_former("old/bridge/state", "offline"), None);
        // The broker remembers it, too.
        outbox.found(CONFIG, ANNOUNCED);
        outbox.listens(now);
        outbox.wake(now + LISTEN_FOR);
        check_taken_back(&mut outbox);
        // A broker that has forgotten all says nothing.
        let mut outbox = moved();
        outbox.wake(now);
        outbox.listens(now);
        let due = outbox.wake_at().expect("it is waited for");
        outbox.disconnected();
        outbox.wake(due);
        outbox.connected();
        outbox.listens(due);
        outbox.wake(due);
        outbox.wake(due + LISTEN_FOR);
        check_taken_back(&mut outbox);
    }

    #[test]
    fn what_stands_below_another_base_topic_is_left_alone_when_somebody_is_there() {
        let mut outbox = moved();
        outbox.listens(Time::from_millis(0));
        assert_eq!(outbox.heard_former("old/bridge/state", "online"), Some("old".to_string()));
        outbox.wake(Time::from_millis(60_000));
        check_sent(&mut outbox, &["busker/bridge/state online"]);
        assert!(outbox.settle(Time::from_millis(60_000)), "it is forgotten, not to be taken back later");
        assert_eq!(outbox.trees(BTreeSet::new()).len(), 1, "only the present one");
    }

    #[test]
    fn what_is_told_no_more_below_the_same_base_topic_is_taken_back_at_once() {
        let mut outbox = outbox();
        let (flow, old) = ("busker/boiler/flow", "busker/boiler/old");
        outbox.recall(
            BTreeMap::new(),
            vec![tree("busker", &[flow, old, "busker/boiler/late"])],
            &BTreeSet::from([flow.to_string()]),
        );
        // Somebody may have told it meanwhile, another device perhaps.
        retained(&mut outbox, "busker/boiler/late", "7");
        assert_eq!(outbox.trees(BTreeSet::new()), [tree("busker", &["busker/boiler/late", old])]);
        check_sent(&mut outbox, &["busker/boiler/late 7", "busker/boiler/old "]);
        assert_eq!(take_all(&mut outbox), []);
    }
}
