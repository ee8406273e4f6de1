//! What waits for the broker: the last value of each retained topic, and a bounded queue of the
//! messages that are told once; announcements first. The client library forgets what it has not sent when
//! the connection breaks; this does not.

mod farewells;
mod manner;
mod pace;
mod queue;
mod reconfigure;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use crate::engine::homeassistant::Announcement;
use crate::engine::settings::Manner;
use crate::engine::time::{Duration, Time};
use crate::engine::topics::{self, Kind, Message, OFFLINE, ONLINE, Topics};

use pace::Pace;
use queue::{Lane, Queue, Queued};

/// Home Assistant subscribes to the states of a new entity only some time after it was announced,
/// and takes no notice of what comes before (0.4 s were too short, 0.8 s long enough).
const STATES_AFTER_DISCOVERY: Duration = Duration::from_millis(1500);
/// And again so long after that where the broker keeps no values: a busy Home Assistant needs longer to listen.
const STATES_ONCE_MORE: Duration = Duration::from_secs(13);

/// The messages of one gateway on their way to its broker.
#[derive(Clone, Debug)]
pub struct Outbox {
    topics: Topics,
    /// How values are told.
    values: Manner,
    /// Topics that begin so are discovery.
    discovery_prefix: String,
    /// The discovery topics of all that this gateway has, announced already or not.
    own_devices: BTreeSet<String>,
    /// What an earlier run announced of devices that this one has not announced yet.
    remembered: BTreeMap<String, Announcement>,
    /// What was taken away since Home Assistant last said that it listens. If it was not there to
    /// hear, it is told again when it starts.
    departed: BTreeMap<String, Announcement>,
    /// On which topics what was announced before was told; the broker shall forget those that are ours no more.
    left_behind: BTreeSet<String>,
    retained: BTreeMap<Arc<str>, Retained>,
    queue: Queue,
    pace: Pace,
    dropped: u64,
    /// Counts the retained topics, to send them again in the order in which they first came.
    next_number: u64,
    states_due_at: Option<Time>,
    /// After these states come once more ([`STATES_ONCE_MORE`]).
    tells_once_more: bool,
}

#[derive(Clone, Debug)]
struct Retained {
    payload: String,
    queued: bool,
    number: u64,
    /// The broker may keep a value of an earlier run, which nobody would replace.
    kept: bool,
}

impl Outbox {
    /// `discovery_prefix` is Home Assistant's, `homeassistant`; `identities` are those of everything
    /// that this gateway has: itself, its buses and its devices.
    pub fn new(
        topics: Topics,
        discovery_prefix: &str,
        identities: impl IntoIterator<Item = String>,
    ) -> Outbox {
        let own = identities.into_iter().map(|identity| topics::discovery(discovery_prefix, &identity));
        Outbox {
            topics,
            values: Manner::default(),
            discovery_prefix: format!("{discovery_prefix}/device/"),
            own_devices: own.collect(),
            remembered: BTreeMap::new(),
            departed: BTreeMap::new(),
            left_behind: BTreeSet::new(),
            retained: BTreeMap::new(),
            queue: Queue::default(),
            pace: Pace::default(),
            dropped: 0,
            next_number: 0,
            states_due_at: None,
            tells_once_more: false,
        }
    }

    /// Takes a message. The newest value of a retained topic replaces one that still waits.
    pub fn push(&mut self, message: Message) {
        if message.retain {
            self.push_retained(message);
        } else {
            self.push_once(message);
        }
    }

    /// The next message to send, if one waits and not too many have been told in a short time
    /// ([`Outbox::wake_at`]).
    pub fn next_message(&mut self, now: Time) -> Option<Message> {
        if !self.pace.allows(now) {
            return None;
        }
        let message = self.take_first()?;
        if !self.values.retain && message.topic.starts_with(&self.discovery_prefix) {
            // Home Assistant listens for values after it has read this, and the broker keeps none for it.
            self.states_due_at = Some(now + STATES_AFTER_DISCOVERY);
            self.tells_once_more = true;
        }
        self.pace.told(self.is_answer(&message));
        Some(message)
    }

    /// Whether nothing waits.
    pub fn is_empty(&self) -> bool {
        self.queue.is_empty() && self.left_behind.is_empty()
    }

    fn take_first(&mut self) -> Option<Message> {
        loop {
            let Some(queued) = self.queue.pop_front() else { return self.next_left_behind() };
            match queued {
                Queued::Once(message) => return Some(*message),
                Queued::Removal(topic) => return Some(Message::retained(topic, "")),
                Queued::Newest(topic) => {
                    if let Some(entry) = self.retained.get_mut(&topic) {
                        if std::mem::take(&mut entry.kept) {
                            self.queue.push_front(Lane::Others, Queued::Newest(topic.clone()));
                            return Some(Message::retained(&*topic, ""));
                        }
                        entry.queued = false;
                        return Some(Message::retained(&*topic, entry.payload.clone()));
                    }
                }
            }
        }
    }

    /// A message from [`Outbox::next_message`] could not be handed over: it is next again.
    pub fn put_back(&mut self, message: Message) {
        self.pace.take_back(self.is_answer(&message));
        let lane = self.lane(&message.topic);
        if !message.retain {
            self.queue.push_front(lane, Queued::Once(Box::new(message)));
        } else if let Some(entry) = self.retained.get_mut(&*message.topic) {
            entry.kept |= message.payload.is_empty();
            // A newer value that came meanwhile stands in the queue already.
            if !std::mem::replace(&mut entry.queued, true) {
                self.queue.push_front(lane, Queued::Newest(message.topic.into()));
            }
        } else {
            self.queue.push_front(lane, Queued::Removal(message.topic));
        }
    }

    /// Messages told once, in their order, that were handed over and did not arrive: they are next
    /// again, as far as there is room.
    pub fn give_back(&mut self, messages: Vec<Message>) {
        // A value that is not retained waits already.
        let is_value = |message: &Message| {
            self.topics.kind(&message.topic) == Kind::Value && self.retained.contains_key(&*message.topic)
        };
        let messages: Vec<Message> = messages.into_iter().filter(|message| !is_value(message)).collect();
        for message in messages.into_iter().rev() {
            if self.queue.is_full() {
                self.dropped += 1;
            } else {
                self.put_back(message);
            }
        }
    }

    /// The broker is there again, and may have forgotten everything: all retained topics are sent
    /// anew, the gateway's own `online` after them, and then what was waiting to be told once.
    pub fn connected(&mut self) {
        self.push_retained(Message::retained(self.topics.bridge_state(), ONLINE));
        let mut once: Vec<Message> = Vec::new();
        let mut removals: Vec<String> = Vec::new();
        for queued in self.queue.take_all() {
            match queued {
                Queued::Once(message) => once.push(*message),
                Queued::Removal(topic) if !self.retained.contains_key(&*topic) => removals.push(topic),
                Queued::Newest(_) | Queued::Removal(_) => {}
            }
        }
        for topic in self.in_order(|_| true) {
            // A farewell goes before the announcement that it prepares.
            let (before, rest) = once.into_iter().partition(|message| *message.topic == *topic);
            once = rest;
            Vec::into_iter(before).for_each(|message| self.queue_last(Queued::Once(Box::new(message))));
            self.queue_last(Queued::Newest(topic));
        }
        once.into_iter().for_each(|message| self.queue_last(Queued::Once(Box::new(message))));
        removals.into_iter().for_each(|topic| self.queue_last(Queued::Removal(topic)));
        self.retained.values_mut().for_each(|entry| entry.queued = true);
        self.states_due_at = None;
    }

    /// Home Assistant has started: it is told of all devices now, and of all values when it has had
    /// the time to listen ([`Outbox::wake_at`]).
    pub fn home_assistant_started(&mut self, now: Time) {
        self.take_leave_again();
        self.queue_again(|rank| rank == Rank::Discovery);
        self.states_due_at = Some(now + STATES_AFTER_DISCOVERY);
    }

    /// When [`Outbox::wake`] or [`Outbox::next_message`] has something to do.
    pub fn wake_at(&self) -> Option<Time> {
        let held_until = self.pace.held_until().filter(|_| !self.is_empty());
        self.states_due_at.into_iter().chain(held_until).min()
    }

    /// The time of [`Outbox::wake_at`] has come.
    pub fn wake(&mut self, now: Time) {
        if self.states_due_at.is_some_and(|due| due <= now) {
            let once_more = std::mem::take(&mut self.tells_once_more);
            self.states_due_at = once_more.then(|| now + STATES_ONCE_MORE);
            self.queue_again(|rank| rank != Rank::Discovery);
        }
    }

    /// The program ends: `offline` goes out behind everything that waits.
    pub fn goodbye(&mut self) {
        let topic = self.topics.bridge_state();
        self.queue.take_newest(self.lane(&topic), &topic);
        if let Some(entry) = self.retained.get_mut(&*topic) {
            entry.queued = false;
        }
        self.push_retained(Message::retained(topic, OFFLINE));
    }

    /// Messages that wait.
    pub fn waiting(&self) -> usize {
        self.queue.len()
    }

    /// Messages told once that were pushed out since the start.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    fn push_retained(&mut self, mut message: Message) {
        // It is kept, and text that was written bit by bit has room for as much again.
        message.payload.shrink_to_fit();
        if let Some(entry) = self.retained.get_mut(&*message.topic) {
            entry.payload = message.payload;
            if !std::mem::replace(&mut entry.queued, true) {
                self.queue_last(Queued::Newest(message.topic.as_str().into()));
            }
        } else {
            let topic: Arc<str> = message.topic.as_str().into();
            let kept = !self.values.retain && self.topics.kind(&topic) == Kind::Value;
            let entry = Retained { payload: message.payload, queued: true, number: self.next_number, kept };
            self.next_number += 1;
            self.retained.insert(topic.clone(), entry);
            self.queue_last(Queued::Newest(topic));
        }
        if let Some(found) = self.remembered.remove(&message.topic) {
            self.take_leave(found);
        }
    }

    fn push_once(&mut self, message: Message) {
        if self.queue.is_full() {
            self.queue.drop_oldest_once();
            self.dropped += 1;
        }
        let lane = self.lane(&message.topic);
        // What is told once to a retained topic prepares the value that follows.
        let value = self.queue.take_newest(lane, &message.topic);
        self.queue.push_back(lane, Queued::Once(Box::new(message)));
        if let Some(value) = value {
            self.queue.push_back(lane, value);
        }
    }

    /// Whether it ends what somebody asked for; an event counts as one, too.
    fn is_answer(&self, message: &Message) -> bool {
        !message.retain && matches!(self.lane(&message.topic), Lane::Others)
    }

    fn queue_last(&mut self, queued: Queued) {
        self.queue.push_back(self.lane(queued.topic()), queued);
    }

    fn lane(&self, topic: &str) -> Lane {
        match self.rank(topic) {
            Rank::Bridge | Rank::Discovery => Lane::Announcements,
            _ => Lane::Others,
        }
    }

    /// Puts every retained topic of these ranks into the queue that is not there yet.
    fn queue_again(&mut self, wanted: impl Fn(Rank) -> bool) {
        for topic in self.in_order(wanted) {
            let Some(entry) = self.retained.get_mut(&topic) else { continue };
            if !std::mem::replace(&mut entry.queued, true) {
                self.queue_last(Queued::Newest(topic));
            }
        }
    }

    /// The retained topics of these ranks, by rank, then as they first came.
    fn in_order(&self, wanted: impl Fn(Rank) -> bool) -> Vec<Arc<str>> {
        let mut topics: Vec<(Rank, u64, &Arc<str>)> = self
            .retained
            .iter()
            .map(|(topic, entry)| (self.rank(topic), entry.number, topic))
            .filter(|(rank, ..)| wanted(*rank))
            .collect();
        topics.sort_unstable();
        topics.into_iter().map(|(.., topic)| topic.clone()).collect()
    }

    fn rank(&self, topic: &str) -> Rank {
        if topic.starts_with(&self.discovery_prefix) {
            return Rank::Discovery;
        }
        match self.topics.kind(topic) {
            Kind::BridgeState => Rank::BridgeState,
            Kind::Bridge => Rank::Bridge,
            Kind::Availability => Rank::Availability,
            Kind::Info => Rank::Info,
            Kind::Value | Kind::Other => Rank::State,
        }
    }
}

/// What is told first after a reconnect.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Rank {
    Bridge,
    Discovery,
    Availability,
    Info,
    State,
    /// Last: the gateway is online when its values are there.
    BridgeState,
}

#[cfg(test)]
mod tests {
    use super::pace::{AT_ONCE, PERIOD};
    use super::queue::ONCE_MAX;
    use super::*;

    pub(super) fn outbox() -> Outbox {
        let identities = ["busker_bridge", "busker_boiler"].map(String::from);
        Outbox::new(Topics::new("busker"), "homeassistant", identities)
    }

    pub(super) fn retained(outbox: &mut Outbox, topic: &str, payload: &str) {
        outbox.push(Message::retained(topic, payload));
    }

    fn once(outbox: &mut Outbox, topic: &str, payload: &str) {
        outbox.push(Message::once(topic, payload));
    }

    /// Long after whatever was told before.
    pub(super) const LATER: Time = Time::from_millis(1_000_000_000);

    pub(super) fn take_all(outbox: &mut Outbox) -> Vec<Message> {
        let mut now = LATER;
        let mut all = Vec::new();
        while !outbox.is_empty() {
            all.extend(std::iter::from_fn(|| outbox.next_message(now)));
            now += PERIOD;
        }
        all
    }

    /// Takes all and compares: `topic payload`, with a `!` behind what is not retained.
    #[track_caller]
    pub(super) fn check_sent(outbox: &mut Outbox, expected: &[&str]) {
        let mut sent = Vec::new();
        for message in take_all(outbox) {
            let mark = if message.retain { "" } else { "!" };
            sent.push(format!("{} {}{mark}", message.topic, message.payload));
        }
        assert_eq!(sent, expected);
    }

    fn filled() -> Outbox {
        let mut outbox = outbox();
        retained(&mut outbox, "busker/boiler/flow", "21.5");
        retained(&mut outbox, "busker/boiler/availability", "online");
        retained(&mut outbox, "busker/boiler/info", "{}");
        retained(&mut outbox, "homeassistant/device/busker_bridge/config", "{1}");
        retained(&mut outbox, "homeassistant/device/busker_boiler/config", "{2}");
        retained(&mut outbox, "busker/bridge/info", "{3}");
        take_all(&mut outbox);
        outbox
    }

    const EVERYTHING: [&str; 7] = [
        "busker/bridge/info {3}",
        "homeassistant/device/busker_bridge/config {1}",
        "homeassistant/device/busker_boiler/config {2}",
        "busker/boiler/availability online",
        "busker/boiler/info {}",
        "busker/boiler/flow 21.5",
        "busker/bridge/state online",
    ];

    #[test]
    fn the_newest_value_wins_and_keeps_its_place() {
        let mut outbox = outbox();
        retained(&mut outbox, "busker/a/x", "1");
        retained(&mut outbox, "busker/a/y", "1");
        retained(&mut outbox, "busker/a/x", "2");
        check_sent(&mut outbox, &["busker/a/x 2", "busker/a/y 1"]);
        retained(&mut outbox, "busker/a/y", "1");
        check_sent(&mut outbox, &["busker/a/y 1"]);
    }

    #[test]
    fn a_reconnect_sends_everything_again_and_online_after_it() {
        let mut outbox = filled();
        check_sent(&mut outbox, &[]);
        for _ in 0..2 {
            outbox.connected();
            check_sent(&mut outbox, &EVERYTHING);
        }
        once(&mut outbox, "busker/boiler/flow/outcome", "done");
        outbox.connected();
        let expected: Vec<&str> =
            EVERYTHING.into_iter().chain(["busker/boiler/flow/outcome done!"]).collect();
        check_sent(&mut outbox, &expected);
    }

    #[test]
    fn a_start_of_home_assistant_is_answered_with_discovery_and_later_with_values() {
        let mut outbox = filled();
        outbox.connected();
        take_all(&mut outbox);
        let now = Time::from_millis(10_000);
        outbox.home_assistant_started(now);
        check_sent(&mut outbox, &EVERYTHING[1..3]);
        outbox.wake(now + Duration::from_millis(900));
        check_sent(&mut outbox, &[]);
        let due = outbox.wake_at().expect("values follow");
        assert!(due - now >= Duration::from_secs(1));
        outbox.wake(due);
        let expected: Vec<&str> = EVERYTHING[..1].iter().chain(&EVERYTHING[3..]).copied().collect();
        check_sent(&mut outbox, &expected);
        assert_eq!(outbox.wake_at(), None);
    }

    #[test]
    fn no_more_is_told_at_once_than_a_broker_queues_and_online_comes_last() {
        let mut outbox = filled();
        for number in 0..2 * AT_ONCE {
            retained(&mut outbox, &format!("busker/boiler/value_{number:03}"), "1");
        }
        outbox.connected();
        let mut told = Vec::new();
        let first = LATER + PERIOD;
        let mut times = vec![first];
        loop {
            let now = times[times.len() - 1];
            let sent: Vec<Message> = std::iter::from_fn(|| outbox.next_message(now)).collect();
            assert!(sent.len() <= AT_ONCE, "{} at once", sent.len());
            told.extend(sent.into_iter().map(|message| message.topic));
            let Some(due) = outbox.wake_at() else { break };
            times.push(due);
        }
        assert_eq!(times, [first, first + PERIOD, first + PERIOD + PERIOD]);
        assert_eq!(told.last().map(String::as_str), Some("busker/bridge/state"));
        assert_eq!(told.len(), outbox.retained.len());
        assert!(outbox.is_empty());
    }

    #[test]
    fn the_outcomes_of_a_flood_go_as_fast_as_it_comes_and_still_fit_in_a_readers_queue() {
        let mut outbox = outbox();
        (0..ONCE_MAX).for_each(|number| once(&mut outbox, "busker/a/x/outcome", &number.to_string()));
        let mut now = LATER;
        while !outbox.is_empty() {
            let burst = std::iter::from_fn(|| outbox.next_message(now)).count();
            assert!((1..1000).contains(&burst), "{burst} at once");
            now += PERIOD;
        }
        assert!(now - LATER < Duration::from_secs(2), "{:?}", now - LATER);
    }

    #[test]
    fn a_thousand_devices_with_fifty_points_each_are_announced_within_ten_seconds() {
        let mut outbox = outbox();
        for device in 0..1000 {
            for point in 0..50 {
                retained(&mut outbox, &format!("busker/device_{device}/p{point}"), "1");
            }
            retained(&mut outbox, &format!("homeassistant/device/busker_device_{device}/config"), "{}");
            retained(&mut outbox, &format!("busker/device_{device}/availability"), "online");
        }
        outbox.connected();
        let mut now = LATER;
        let mut announced = 0;
        while announced < 1000 {
            let messages = std::iter::from_fn(|| outbox.next_message(now));
            announced += messages.filter(|message| message.topic.ends_with("/config")).count();
            assert!(now - LATER < Duration::from_secs(10), "only {announced} devices are announced");
            now = outbox.wake_at().expect("values wait");
        }
    }

    #[test]
    fn an_announcement_overtakes_values_that_wait_and_nothing_else_does() {
        let mut outbox = outbox();
        retained(&mut outbox, "busker/boiler/flow", "21.5");
        once(&mut outbox, "busker/boiler/flow/outcome", "done");
        retained(&mut outbox, "busker/boiler/availability", "online");
        retained(&mut outbox, "homeassistant/device/busker_boiler/config", "{2}");
        let expected = [
            "homeassistant/device/busker_boiler/config {2}",
            "busker/boiler/flow 21.5",
            "busker/boiler/flow/outcome done!",
            "busker/boiler/availability online",
        ];
        check_sent(&mut outbox, &expected);
    }

    #[test]
    fn what_could_not_be_handed_over_is_next_again_unless_it_is_old() {
        let mut outbox = outbox();
        retained(&mut outbox, "busker/a/x", "1");
        once(&mut outbox, "busker/a/x/outcome", "done");
        let first = outbox.next_message(LATER).expect("two wait");
        outbox.put_back(first.clone());
        check_sent(&mut outbox, &["busker/a/x 1", "busker/a/x/outcome done!"]);
        retained(&mut outbox, "busker/a/x", "2");
        outbox.put_back(first);
        check_sent(&mut outbox, &["busker/a/x 2"]);
    }

    #[test]
    fn of_too_many_messages_told_once_the_oldest_are_dropped_and_counted() {
        let mut outbox = outbox();
        retained(&mut outbox, "busker/a/x", "1");
        for number in 0..ONCE_MAX + 3 {
            once(&mut outbox, "busker/a/x/outcome", &number.to_string());
        }
        assert_eq!(outbox.dropped(), 3);
        assert_eq!(outbox.next_message(LATER), Some(Message::retained("busker/a/x", "1")));
        assert_eq!(outbox.next_message(LATER), Some(Message::once("busker/a/x/outcome", "3")));
        assert_eq!(take_all(&mut outbox).len(), ONCE_MAX - 1);
    }

    #[test]
    fn the_last_message_is_offline() {
        let mut outbox = outbox();
        outbox.connected();
        retained(&mut outbox, "busker/a/availability", "offline");
        outbox.goodbye();
        check_sent(&mut outbox, &["busker/a/availability offline", "busker/bridge/state offline"]);
    }

    #[test]
    fn a_farewell_goes_before_the_announcement_that_it_prepares() {
        let config = "homeassistant/device/busker_boiler/config";
        let mut outbox = filled();
        retained(&mut outbox, config, "{old}");
        once(&mut outbox, config, "{farewell}");
        retained(&mut outbox, config, "{new}");
        let expected = [format!("{config} {{farewell}}!"), format!("{config} {{new}}")];
        check_sent(&mut outbox.clone(), &[&expected[0], &expected[1]]);
        outbox.connected();
        let sent: Vec<Message> = take_all(&mut outbox);
        let at = sent.iter().position(|message| !message.retain).expect("the farewell is sent");
        assert_eq!((sent[at].topic.as_str(), sent[at + 1].topic.as_str()), (config, config));
    }
}
