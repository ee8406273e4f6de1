//! What the outbox tells in which order, and what it tells again.

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
    let expected: Vec<&str> = EVERYTHING.into_iter().chain(["busker/boiler/flow/outcome done!"]).collect();
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
