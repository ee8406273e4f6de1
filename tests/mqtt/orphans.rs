//! What is taken out of the configuration while the gateway is off, and the broker forgets meanwhile: Home
//! Assistant does not forget.

use super::{json, over_tcp, simulation};
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
    watcher.publish("homeassistant/status", "online");
    // Home Assistant lets go only of what it has been told since its start, so that comes first.
    let told = |topic: &str| -> Vec<String> {
        watcher
            .received()
            .into_iter()
            .filter(|got| got.topic == topic && !got.retained)
            .map(|got| got.payload)
            .collect()
    };
    let is_removed = |got: &Received| got.topic == RELAYS && got.payload.is_empty();
    watcher.wait_until("the removal of the relays", is_removed);
    let all = told(RELAYS);
    let before = all.iter().rposition(|payload| !payload.is_empty()).expect("it was announced before");
    assert!(all[before].contains("relay_1") && before + 1 < all.len(), "{all:?}");
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
