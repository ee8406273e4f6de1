//! What waits for the broker: the last value of each retained topic, and a bounded queue of the
//! messages that are told once; announcements first. The client library forgets what it has not sent when
//! the connection breaks; this does not.

mod arriving;
mod claim;
mod departed;
mod farewells;
mod former;
mod hearing;
mod held;
mod manner;
mod pace;
mod queue;
mod reconfigure;
mod rivals;
mod taken_back;
mod too_long;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use crate::engine::homeassistant::Announcement;
use crate::engine::settings::Manner;
use crate::engine::time::{Duration, Time};
use crate::engine::topics::{self, Kind, Message, OFFLINE, ONLINE, Topics};

use arriving::Arriving;
use claim::Claim;
use departed::Departed;
use former::Former;
pub use former::Tree;
pub use hearing::Heard;
use held::Held;
use pace::Pace;
use queue::{Lane, Queue, Queued};
use rivals::Rivals;
use taken_back::TakenBack;
use too_long::TooLong;
pub use too_long::may_be_too_long;

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
    departed: Departed,
    has_new_announcement: bool,
    /// On which topics what was announced before was told; the broker shall forget those that are ours no more.
    left_behind: BTreeSet<String>,
    /// On these the devices tell something, if not yet: nothing is taken back there.
    wanted: BTreeSet<String>,
    taken_back: TakenBack,
    /// What this gateway told below other base topics, until it is known whether somebody else is there.
    formers: Vec<Former>,
    /// Somebody was there: that one is no more this gateway's to take back.
    is_left_to_others: bool,
    formers_due: Option<Time>,
    arriving: Arriving,
    claim: Claim,
    rivals: Rivals,
    held: Held,
    retained: BTreeMap<Arc<str>, Retained>,
    queue: Queue,
    pace: Pace,
    too_long: TooLong,
    dropped: u64,
    is_connected: bool,
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
    /// Something was handed over of it on this connection.
    is_told: bool,
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
            departed: Departed::default(),
            has_new_announcement: false,
            left_behind: BTreeSet::new(),
            wanted: BTreeSet::new(),
            taken_back: TakenBack::default(),
            formers: Vec::new(),
            is_left_to_others: false,
            formers_due: None,
            arriving: Arriving::default(),
            claim: Claim::default(),
            rivals: Rivals::default(),
            held: Held::default(),
            retained: BTreeMap::new(),
            queue: Queue::default(),
            pace: Pace::default(),
            too_long: TooLong::default(),
            dropped: 0,
            is_connected: false,
            next_number: 0,
            states_due_at: None,
            tells_once_more: false,
        }
    }

    /// Takes a message. The newest value of a retained topic replaces one that still waits.
    pub fn push(&mut self, message: Message) {
        if self.is_withheld(&message) {
            return;
        }
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
        self.held.is_told(now, message.retain && message.topic.starts_with(&self.discovery_prefix));
        self.pace.told(self.is_answer(&message));
        self.taken_back.handed_over(&message.topic, now);
        self.await_return(&message, now);
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
                Queued::Once(message) if self.too_long.is(message.payload.len()) => self.dropped += 1,
                Queued::Once(message) => return Some(*message),
                Queued::Removal(topic) => return Some(Message::retained(topic, "")),
                Queued::Newest(topic) => {
                    if let Some(entry) = self.retained.get_mut(&topic) {
                        if std::mem::take(&mut entry.kept) {
                            self.queue.push_front(Lane::Others, Queued::Newest(topic.clone()));
                            return Some(Message::retained(&*topic, ""));
                        }
                        (entry.queued, entry.is_told) = (false, true);
                        if self.too_long.is(entry.payload.len()) {
                            continue;
                        }
                        let payload = self.held.told_instead(&topic).unwrap_or(&entry.payload);
                        return Some(Message::retained(&*topic, payload));
                    }
                }
            }
        }
    }

    /// A message from [`Outbox::next_message`] could not be handed over: it is next again.
    pub fn put_back(&mut self, message: Message) {
        self.pace.take_back(self.is_answer(&message));
        self.await_no_return(&message.topic);
        let lane = self.lane(&message.topic);
        if !message.retain {
            self.queue.push_front(lane, Queued::Once(Box::new(message)));
        } else if let Some(entry) = self.retained.get_mut(&*message.topic) {
            entry.kept |= message.payload.is_empty();
            // A newer value that came meanwhile stands in the queue already.
            if !std::mem::replace(&mut entry.queued, true) {
                self.queue.push_front(lane, Queued::Newest(message.topic.into()));
            }
        } else if message.payload.is_empty() {
            self.queue.push_front(lane, Queued::Removal(message.topic));
        } else {
            self.queue.push_front(lane, Queued::Once(Box::new(message)));
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
        self.is_connected = true;
        self.arriving.begin_anew();
        self.held.broker_is_there();
        self.doubt_what_was_taken_back();
        self.push_retained(Message::retained(self.topics.bridge_state(), ONLINE));
        let mut once: Vec<Message> = Vec::new();
        let mut removals: Vec<String> = Vec::new();
        for queued in self.queue.take_all() {
            match queued {
                Queued::Once(message) => once.push(*message),
                Queued::Removal(topic) => removals.push(topic),
                Queued::Newest(_) => {}
            }
        }
        let (last, topics): (Vec<Arc<str>>, Vec<Arc<str>>) =
            self.in_order(|_| true).into_iter().partition(|topic| self.too_long.is_doubted(topic));
        for topic in topics {
            // A farewell goes before the announcement that it prepares.
            let (before, rest) = once.into_iter().partition(|message| *message.topic == *topic);
            once = rest;
            Vec::into_iter(before).for_each(|message| self.queue_last(Queued::Once(Box::new(message))));
            self.queue_last(Queued::Newest(topic));
        }
        once.into_iter().for_each(|message| self.queue_last(Queued::Once(Box::new(message))));
        removals.retain(|topic| !self.retained.contains_key(&**topic) && !self.left_behind.contains(topic));
        removals.into_iter().for_each(|topic| self.queue_last(Queued::Removal(topic)));
        last.into_iter().for_each(|topic| self.queue_last(Queued::Newest(topic)));
        for entry in self.retained.values_mut() {
            (entry.queued, entry.is_told) = (true, false);
        }
        self.tell_held_first();
        self.states_due_at = None;
    }

    /// Whether the broker is there for what this one holds.
    pub fn is_connected(&self) -> bool {
        self.is_connected
    }

    /// The connection is lost, or not made yet.
    pub fn disconnected(&mut self) {
        self.is_connected = false;
        self.arriving.begin_anew();
        self.too_long.wait();
        self.doubt_what_was_taken_back();
        self.departed.doubt();
        self.formers_due = None;
    }

    /// Home Assistant has started: it is told of all devices now, and of all values when it has had
    /// the time to listen ([`Outbox::wake_at`]).
    pub fn home_assistant_started(&mut self, now: Time) {
        self.held.home_assistant_is_there();
        self.take_leave_again(now);
        self.queue_again(|rank| rank == Rank::Discovery);
        self.states_due_at = Some(now + STATES_AFTER_DISCOVERY);
    }

    /// When [`Outbox::wake`] or [`Outbox::next_message`] has something to do; see [`Outbox::awaits_until`] too.
    pub fn wake_at(&self) -> Option<Time> {
        let held_until = self.pace.held_until().filter(|_| !self.is_empty());
        let due = self
            .states_due_at
            .into_iter()
            .chain(self.formers_due)
            .chain(self.claim.due())
            .chain(self.rivals.due())
            .chain(self.too_long.due())
            .chain(self.held.due());
        due.chain(held_until).min()
    }

    /// The time of [`Outbox::wake_at`] has come.
    pub fn wake(&mut self, now: Time) {
        self.wake_claim(now);
        self.wake_rivals(now);
        self.wake_arriving(now);
        self.wake_suspicion(now);
        self.wake_formers(now);
        self.wake_held(now);
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
        let is_announcement = message.topic.starts_with(&self.discovery_prefix);
        if let Some(entry) = self.retained.get_mut(&*message.topic) {
            let before = std::mem::replace(&mut entry.payload, message.payload);
            self.has_new_announcement |= is_announcement && entry.payload != before;
            if !std::mem::replace(&mut entry.queued, true) {
                self.queue_last(Queued::Newest(message.topic.as_str().into()));
            }
            if is_announcement {
                self.replaced(&message.topic, &before);
            }
        } else {
            let topic: Arc<str> = message.topic.as_str().into();
            let kept = !self.values.retain && self.topics.kind(&topic) == Kind::Value;
            let entry = Retained {
                payload: message.payload,
                queued: true,
                is_told: false,
                number: self.next_number,
                kept,
            };
            self.next_number += 1;
            self.retained.insert(topic.clone(), entry);
            self.queue_last(Queued::Newest(topic));
            if is_announcement {
                self.has_new_announcement = true;
                self.take_leave_of_earlier_runs(&message.topic);
            }
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

    /// The value that stands on this topic is sent once more.
    fn tell_again(&mut self, topic: &str) {
        if let Some(entry) = self.retained.get_mut(topic) {
            if !std::mem::replace(&mut entry.queued, true) {
                self.queue_last(Queued::Newest(topic.into()));
            }
        }
    }

    fn queue_last(&mut self, queued: Queued) {
        self.queue.push_back(self.lane(queued.topic()), queued);
    }

    fn lane(&self, topic: &str) -> Lane {
        match self.rank(topic) {
            Rank::Bridge | Rank::Discovery if !self.too_long.is_doubted(topic) => Lane::Announcements,
            _ => Lane::Others,
        }
    }

    /// Puts every retained topic of these ranks into the queue that is not there yet.
    fn queue_again(&mut self, wanted: impl Fn(Rank) -> bool) {
        for topic in self.in_order(wanted) {
            self.tell_again(&topic);
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

    /// Where what has this identity is announced.
    fn discovery(&self, identity: &str) -> String {
        topics::discovery(self.discovery_prefix.trim_end_matches("/device/"), identity)
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
mod tests;
