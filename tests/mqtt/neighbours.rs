//! Several gateways on one broker: of two names, and of one.

use serde_json::Value as Json;

use super::{all_online, configuration, json, over_tcp, relay, remembered, simulation};
use crate::support::{self, Broker, Gateway, Received, Watcher};

fn health(gateway: &Gateway) -> Json {
    json(&gateway.get("/health").1)
}

/// As soon as its devices have answered.
#[track_caller]
fn is_well(gateway: &Gateway) {
    let is_ok = || (health(gateway)["status"] == "ok").then_some(());
    assert!(support::find(is_ok).is_some(), "{}", health(gateway));
}

#[test]
fn two_gateways_with_two_base_topics_leave_each_other_alone() {
    let broker = Broker::start();
    let simulations = [simulation(), simulation()];
    let ports = simulations.each_ref().map(over_tcp);
    let watcher = Watcher::start(&broker, "watcher");
    // One name begins like the other.
    let bases = ["busker", "busker_2"];
    let start = |index: usize| {
        Gateway::start_with(&format!(
            "mqtt: {{url: 'mqtt://127.0.0.1:{}', base_topic: {}}}\n{}",
            broker.port,
            bases[index],
            configuration(&ports[index])
        ))
    };
    let gateways = [start(0), start(1)];
    for base in bases {
        for topic in ["bridge/state", "relays/availability", "counters/availability"] {
            watcher.wait_for(&format!("{base}/{topic}"), "online");
        }
    }
    watcher.publish("busker_2/relays/relay_2/set", "ON");
    watcher.wait_until("an outcome", |got| got.topic == "busker_2/relays/relay_2/outcome");
    assert_eq!(simulations.each_ref().map(|simulation| relay(simulation, 2)), ["OFF", "ON"]);

    // Each comes back and finds the other's announcements.
    let [first, second] = gateways;
    assert!(first.terminate().success());
    let first = start(0);
    first.wait_for_health(200);
    watcher.wait_for("busker/bridge/state", "online");
    for gateway in [&first, &second] {
        let health = health(gateway);
        assert_eq!(health["broker"]["connects"], 1, "{health}");
        assert_eq!(health["broker"]["client_id_taken"], false, "{health}");
    }
    let all = remembered(&broker, "newcomer");
    for base in bases {
        for device in ["bridge", "bus_line", "relays", "counters"] {
            let topic = format!("homeassistant/device/{base}_{device}/config");
            let config = json(super::payload(&all, &topic));
            let is_own = config["device"]["identifiers"][0] == format!("{base}_{device}");
            assert!(is_own, "{topic}: {config}");
        }
    }
}

#[test]
fn a_client_identifier_that_is_taken_is_told_once_and_the_pauses_grow() {
    let ((port, _simulation), broker, watcher, first) = all_online();
    let second = Gateway::start(&broker, &configuration(&port));
    let is_contested = |gateway: &Gateway| health(gateway)["broker"]["client_id_taken"] == true;
    support::find(|| (is_contested(&first) || is_contested(&second)).then_some(())).expect("it is noticed");
    let (contested, other) = if is_contested(&first) { (first, second) } else { (second, first) };
    let said = "another client has the identifier `busker_gateway`";
    contested.wait_for_log(said);
    assert_ne!(health(&contested)["status"], "ok");
    // It is told to whoever watches the broker, too, when it is this one's turn.
    watcher.wait_until("health", |got: &Received| {
        got.topic == "busker/bridge/health" && json(&got.payload)["broker"]["client_id_taken"] == true
    });
    assert!(health(&contested)["broker"]["connects"].as_u64() < Some(10));

    // When the other one goes, all is well again.
    other.kill();
    contested.wait_for_health(200);
    watcher.forget();
    watcher.publish("busker/relays/relay_2/set", "ON");
    let outcome = watcher.wait_until("an outcome", |got| got.topic == "busker/relays/relay_2/outcome");
    assert_eq!(json(&outcome.payload)["outcome"], "done");
    let times = contested.log().iter().filter(|line| line.contains(said)).count();
    assert_eq!(times, 1, "{:?}", contested.log());
}

#[test]
fn a_state_that_somebody_else_has_told_is_put_right_at_once_but_not_without_end() {
    let (_devices, broker, watcher, gateway) = all_online();
    let state = "busker/bridge/state";
    let last = |name: &str| super::payload(&remembered(&broker, name), state).to_string();
    // The will of another gateway; a mistake; somebody who deletes it.
    for payload in ["offline", "on", ""] {
        watcher.forget();
        watcher.publish_retained(state, payload);
        watcher.wait_for(state, payload);
        watcher.wait_for(state, "online");
    }
    assert_eq!(last("newcomer"), "online");
    assert_eq!(health(&gateway)["broker"]["state_denied"], false);

    watcher.forget();
    for _ in 0..50 {
        watcher.publish_retained(state, "offline");
        watcher.publish("test/end", "");
        watcher.wait_until("it has come", |got| got.topic == "test/end");
    }
    gateway.wait_for_log("somebody else tells `offline` on `busker/bridge/state` again and again");
    watcher.wait_until("health", |got: &Received| {
        got.topic == "busker/bridge/health" && json(&got.payload)["broker"]["state_denied"] == true
    });
    assert_eq!(health(&gateway)["status"], "degraded");
    assert!(watcher.payloads(state).iter().filter(|payload| *payload == "online").count() <= 5);
}

#[test]
fn a_second_gateway_with_the_same_state_dir_does_not_start() {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let gateway = Gateway::start(&broker, &configuration(&port));
    let file = gateway.file().display().to_string();
    let (code, told) = support::busker(&["run", "--config", &file, "--http", "127.0.0.1:0"], &[]);
    assert_eq!(code, Some(1), "{told}");
    let expected = format!("another busker (process {}) keeps its state in `", gateway.id());
    assert!(told.contains(&expected) && told.contains("a `state_dir`"), "{told}");

    // Nor does a reload take what another one has.
    let other = Gateway::start_with(&format!(
        "mqtt: {{url: 'mqtt://127.0.0.1:{}', base_topic: other}}\n{}",
        broker.port,
        configuration(&port)
    ));
    let state = gateway.file().with_file_name("state");
    let text = std::fs::read_to_string(other.file()).expect("its configuration");
    let text: Vec<String> = text
        .lines()
        .map(|line| match line.starts_with("state_dir:") {
            true => format!("state_dir: {}", state.display()),
            false => line.to_string(),
        })
        .collect();
    other.write_whole(&text.join("\n"));
    other.reload("the new configuration is refused, and the old one goes on: another busker");
    let told = support::find(|| other.get("/health").1.contains("another busker").then_some(()));
    assert!(told.is_some(), "{:?}", other.get("/health"));

    // Killed, it leaves nothing behind that would keep the next one out.
    gateway.kill();
    other.reload("what has changed is at work");
}

/// Two gateways whose base topics and devices join to one identity, and what else they have is their own.
#[test]
fn what_one_gateway_has_announced_no_other_takes_and_both_places_are_told() {
    const PLACE: &str = "homeassistant/device/busker_cellar_relays/config";
    let mut broker = Broker::start_persistent();
    let simulations = [simulation(), simulation()];
    let ports = simulations.each_ref().map(over_tcp);
    let watcher = Watcher::start(&broker, "watcher");
    let wanted = |base: &str, device: &str, index: usize| {
        let rest = configuration(&ports[index]).replace("relays: {", &format!("{device}: {{"));
        format!("mqtt: {{url: '{}', base_topic: {base}}}\n{rest}", broker.url())
    };
    let (of_first, of_second) = (wanted("busker_cellar", "relays", 0), wanted("busker", "cellar_relays", 1));
    let changed = wanted("busker", "hall_relays", 1);
    let check_whose = |broker: &Broker, expected: &str| {
        support::wait_for(&format!("the announcement of `{expected}`"), || {
            // For a moment nothing may stand there.
            let all = remembered(broker, "newcomer");
            let config = json(&all.iter().find(|got| got.topic == PLACE)?.payload);
            (config["components"]["relay_1"]["command_topic"] == expected).then_some(())
        });
    };
    let (firsts, seconds) = ("busker_cellar/relays/relay_1/set", "busker/cellar_relays/relay_1/set");

    let first = Gateway::start_with(&of_first);
    watcher.wait_for("busker_cellar/bridge/state", "online");
    watcher.wait_until("it is announced", |got| got.topic == PLACE);
    let second = Gateway::start_with(&of_second);
    second.wait_for_log("the gateway with `base_topic: busker_cellar` has announced a device");
    watcher.wait_for("busker/bridge/state", "online");
    watcher.wait_for("busker/cellar_relays/availability", "online");
    watcher.wait_until("its other device", |got| got.topic == "homeassistant/device/busker_counters/config");
    check_whose(&broker, firsts);
    let has_rival = |gateway: &Gateway, rival: &str| {
        let expected = serde_json::json!({PLACE: rival});
        support::wait_for("the other one to be told", || {
            (health(gateway)["broker"]["announced_by_others"] == expected).then_some(())
        });
        assert_eq!(health(gateway)["status"], "degraded");
    };
    has_rival(&second, "busker_cellar");
    is_well(&first);
    // Its own topics are not touched by that.
    watcher.publish(seconds, "ON");
    watcher.wait_for("busker/cellar_relays/relay_1", "ON");
    // Home Assistant starts, and so does the second gateway once more.
    watcher.publish("homeassistant/status", "online");
    let second = second.start_again(|| (), &of_second);
    watcher.wait_for("busker/bridge/state", "offline");
    has_rival(&second, "busker_cellar");
    check_whose(&broker, firsts);

    // With another name the device is announced, and the first one's stays.
    second.write(&changed);
    second.reload("what has changed is at work");
    watcher.wait_until("its new name", |got| got.topic == "homeassistant/device/busker_hall_relays/config");
    is_well(&second);
    check_whose(&broker, firsts);

    // Where the first one goes for good, the second may have the place.
    second.write(&of_second);
    second.reload("what has changed is at work");
    has_rival(&second, "busker_cellar");
    let elsewhere = of_first.replace("relays: {", "shed_relays: {");
    first.write(&elsewhere);
    first.reload("what has changed is at work");
    support::wait_for("the place to be taken", || {
        (health(&second)["broker"]["announced_by_others"] == serde_json::json!({})).then_some(())
    });
    watcher.wait_until("it is announced", |got| got.topic == PLACE && got.payload.contains(seconds));
    check_whose(&broker, seconds);

    // Both come to a broker that has forgotten everything: one of them has it, whichever.
    first.write(&of_first);
    first.reload("what has changed is at work");
    has_rival(&first, "busker");
    check_whose(&broker, seconds);
    broker.restart();
    for gateway in [&first, &second] {
        gateway.wait_for_health(200);
    }
    has_rival(&first, "busker");
    is_well(&second);
}
