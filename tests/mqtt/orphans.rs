//! What is taken out of the configuration while the gateway is off, and the broker forgets meanwhile: Home
//! Assistant does not forget.

use super::{json, over_tcp, remembered, simulation};
use crate::support::{self, Broker, Gateway, Received, Watcher};

const RELAYS: &str = "homeassistant/device/busker_relays/config";
const BOARD: &str = "homeassistant/device/busker_board/config";

#[test]
fn nothing_is_left_in_home_assistant_of_what_only_the_gateway_remembers() {
    let (mut broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let url = format!("mqtt: {{url: 'mqtt://127.0.0.1:{}'}}", broker.port);
    let text = |points: &str, more: &str| {
        format!(
            "{url}\nbuses: {{line: {{tcp: '{}'}}}}\ndevices:\n  board: {{bus: line, unit: 20, points: {{{points}}}}}\n{more}",
            port.address()
        )
    };
    let both = "one: {at: input 0, poll: fast}, two: {at: input 1, poll: fast}";
    let relays = "  relays: {profile: metz-connect/mr-do4, bus: line, unit: 18}\n";
    let watcher = Watcher::start(&broker, "watcher");
    let gateway = Gateway::start_with(&text(both, relays));
    watcher.wait_for("busker/relays/availability", "online");
    watcher.wait_for("busker/board/availability", "online");
    let remembered = gateway.file().with_file_name("state").join("announced.json");
    let holds = |topics: &[&str]| {
        let stored = std::fs::read_to_string(&remembered).ok()?;
        topics.iter().all(|topic| stored.contains(topic)).then_some(())
    };
    support::find(|| holds(&[RELAYS, BOARD])).expect("what is announced is remembered");
    drop(watcher);

    let mut watcher = None;
    let forgets = || {
        broker.kill();
        broker.restart();
        // It listens before the gateway speaks.
        watcher = Some(Watcher::start(&broker, "watcher"));
    };
    let gateway = gateway.start_again(forgets, &text("one: {at: input 0, poll: fast}", ""));
    let watcher = watcher.expect("it was started meanwhile");
    // It listens before it says this.
    watcher.wait_for("busker/bridge/state", "online");
    watcher.publish("homeassistant/status", "online");
    // Home Assistant lets go only of what it has been told since its start, so that comes first.
    let told = |topic: &str| -> Vec<String> {
        let all = watcher.received().into_iter();
        let since_its_start = all.skip_while(|got| got.topic != "homeassistant/status");
        since_its_start.filter(|got| got.topic == topic && !got.retained).map(|got| got.payload).collect()
    };
    let is_removed = || {
        let all = told(RELAYS);
        let before = all.iter().rposition(|payload| !payload.is_empty())?;
        (all[before].contains("relay_1") && before + 1 < all.len()).then_some(())
    };
    assert!(support::find(is_removed).is_some(), "{:?}", told(RELAYS));
    let tombstone = serde_json::json!({"platform": "sensor"});
    let is_buried =
        |got: &Received| got.topic == BOARD && json(&got.payload)["components"]["two"] == tombstone;
    watcher.wait_until("the burial of the point", is_buried);
    let gone = support::find(|| {
        let stored = std::fs::read_to_string(&remembered).ok()?;
        (!stored.contains(RELAYS) && stored.contains(BOARD) && !stored.contains("board_two")).then_some(())
    });
    assert!(gone.is_some(), "what is taken away is forgotten");
    assert!(gateway.terminate().success());
}

#[test]
fn what_a_point_a_device_or_another_layout_has_left_at_the_broker_is_forgotten_at_the_next_start() {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let text = |topics: &str, points: &str, more: &str| {
        format!(
            "mqtt: {{url: '{}', topics: '{topics}'}}\nbuses: {{line: {{tcp: '{}'}}}}\ndevices:\n  \
             board: {{bus: line, unit: 20, points: {{{points}}}}}\n{more}",
            broker.url(),
            port.address()
        )
    };
    let (one, two) = ("one: {at: input 0, poll: fast}", "two: {at: input 1, poll: fast}");
    let relays = "  relays: {profile: metz-connect/mr-do4, bus: line, unit: 18}\n";
    let usual = "{base}/{device}/{point}";
    let kept = |name: &str| -> Vec<String> {
        let watcher = Watcher::start(&broker, name);
        // What is retained comes before what is told after the subscription.
        watcher.publish("the/end", "");
        watcher.wait_until("the end", |got| got.topic == "the/end");
        let is_value = |got: &Received| got.retained && got.topic.starts_with("busker/");
        let mut topics: Vec<String> =
            watcher.received().into_iter().filter(is_value).map(|got| got.topic).collect();
        topics.retain(|topic| !topic.starts_with("busker/bridge/") && !topic.ends_with("/health"));
        topics.sort();
        topics
    };
    let gateway = Gateway::start_with(&text(usual, &format!("{one}, {two}"), relays));
    let all_is_told = || {
        let kept = kept("first");
        let is_kept = |topic: &&str| kept.iter().any(|kept| kept == *topic);
        ["busker/relays/relay_1", "busker/board/two"].iter().all(is_kept).then_some(())
    };
    support::find(all_is_told).expect("the relays and the board");
    let gateway = gateway.start_again(|| {}, &text(usual, one, ""));
    let of_board = |before: &str| ["availability", "info", "one"].map(|last| format!("{before}/{last}"));
    support::find(|| (kept("second") == of_board("busker/board")).then_some(())).unwrap_or_else(|| {
        panic!("of the point and the device something is left: {:?}", kept("second"));
    });
    let gateway = gateway.start_again(|| {}, &text("{base}/{bus}/{device}/{point}", one, ""));
    support::find(|| (kept("third") == of_board("busker/line/board")).then_some(())).unwrap_or_else(|| {
        panic!("of the old layout something is left: {:?}", kept("third"));
    });
    assert!(gateway.terminate().success());
}

/// Every retained topic below `base`, by a newcomer.
fn below(broker: &Broker, name: &str, base: &str) -> Vec<String> {
    let all = remembered(broker, name).into_iter().map(|got| got.topic);
    all.filter(|topic| topic.starts_with(base)).collect()
}

#[test]
fn what_a_gateway_told_below_another_base_topic_is_taken_back_at_the_next_start() {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let text = |base: &str, more: &str| {
        format!(
            "mqtt: {{url: '{}', base_topic: {base}}}\n{more}buses: {{line: {{tcp: '{}'}}}}\ndevices:\n  \
             board: {{bus: line, unit: 20, points: {{one: {{at: input 0, poll: fast}}}}}}\n",
            broker.url(),
            port.address()
        )
    };
    let watcher = Watcher::start(&broker, "watcher");
    let gateway = Gateway::start_with(&text("busker", ""));
    watcher.wait_for("busker/bridge/state", "online");
    watcher.wait_for("busker/board/availability", "online");
    let stored = gateway.state().join("announced.json");
    let holds = |text: &str| std::fs::read_to_string(&stored).ok()?.contains(text).then_some(());
    support::find(|| holds(BOARD)).expect("what is announced is remembered");
    // What others tell below the old base topic and of devices that are called like ours stays.
    let others = ["busker/board/note", "homeassistant/device/busker_board_2/config"];
    others.iter().for_each(|topic| watcher.publish_retained(topic, "{}"));
    others.iter().for_each(|topic| drop(watcher.wait_for(topic, "{}")));

    watcher.forget();
    let gateway = gateway.start_again(|| {}, &text("house", ""));
    watcher.wait_for("house/bridge/state", "online");
    watcher.wait_for(BOARD, "");
    let left = || below(&broker, "left", "busker/");
    support::find(|| (left() == ["busker/board/note"]).then_some(()))
        .unwrap_or_else(|| panic!("below the old base topic is left: {:?}", left()));
    let devices = below(&broker, "devices", "homeassistant/device/");
    assert_eq!(devices.iter().filter(|topic| topic.contains("/busker_")).count(), 1, "{devices:?}");
    assert!(devices.iter().any(|topic| topic.ends_with("/house_board/config")), "{devices:?}");

    // Without discovery what was announced is taken back, too; and then what was told of a device.
    let no_discovery = "home_assistant: {discovery: false}\n";
    let gateway = gateway.start_again(|| {}, &text("house", no_discovery));
    watcher.wait_for("homeassistant/device/house_board/config", "");
    support::find(|| (below(&broker, "values", "house/board/").len() >= 3).then_some(())).expect("values");
    let renamed = text("house", no_discovery).replace("board:", "desk:");
    let gateway = gateway.start_again(|| {}, &renamed);
    watcher.wait_for("house/desk/availability", "online");
    support::find(|| below(&broker, "gone", "house/board/").is_empty().then_some(()))
        .unwrap_or_else(|| panic!("left: {:?}", below(&broker, "left", "house/board/")));
    assert!(below(&broker, "end", "homeassistant/device/house_").is_empty());
    assert!(gateway.terminate().success());
}

#[test]
fn what_stands_below_a_base_topic_that_somebody_else_has_now_is_left_alone() {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let text = |base: &str| {
        format!("mqtt: {{url: '{}', base_topic: {base}}}\n{}", broker.url(), super::configuration(&port))
    };
    let watcher = Watcher::start(&broker, "watcher");
    let first = Gateway::start_with(&text("busker"));
    super::wait_until_all_is_online(&watcher);
    let mut second = None;
    let meanwhile = || {
        watcher.wait_for("busker/bridge/state", "offline");
        watcher.forget();
        second = Some(Gateway::start_with(&text("busker")));
        super::wait_until_all_is_online(&watcher);
    };
    let first = first.start_again(meanwhile, &text("house"));
    first.wait_for_log("what this gateway told below `busker` before is not taken back");
    watcher.wait_for("house/relays/availability", "online");
    assert!(below(&broker, "newcomer", "busker/").len() > 60);
    assert!(below(&broker, "devices", RELAYS) == [RELAYS]);
    assert!(second.expect("it was started").terminate().success());
}
