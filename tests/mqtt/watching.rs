//! What a browser gets: the page, its headers, the event stream, and nothing without the token.

use std::io::{BufRead, BufReader, Read};

use serde_json::Value as Json;
use ureq::http::Response;
use ureq::{Agent, Body};

use super::{all_online, configuration, json, over_tcp, simulation, wait_until_all_is_online};
use crate::support::{Broker, Gateway, Watcher};

const TOKEN: &str = "s3cret-of-the-test";

fn get(gateway: &Gateway, path: &str, token: Option<&str>) -> Response<Body> {
    let request = agent().get(format!("{}{path}", gateway.http()));
    let request = match token {
        Some(token) => request.header("Authorization", format!("Bearer {token}")),
        None => request,
    };
    request.call().expect("HTTP answers")
}

fn agent() -> Agent {
    Agent::config_builder().http_status_as_error(false).build().into()
}

#[track_caller]
fn header<'r>(answer: &'r Response<Body>, name: &str) -> &'r str {
    let value = answer.headers().get(name).unwrap_or_else(|| panic!("no header `{name}`"));
    value.to_str().expect("it is text")
}

/// The event stream, read as a browser reads it.
struct Events {
    lines: BufReader<ureq::BodyReader<'static>>,
}

impl Events {
    fn open(gateway: &Gateway, token: Option<&str>) -> Events {
        let answer = get(gateway, "/api/events", token);
        assert_eq!(answer.status(), 200);
        assert_eq!(header(&answer, "content-type"), "text/event-stream");
        assert_eq!(header(&answer, "cache-control"), "no-store");
        Events { lines: BufReader::new(answer.into_body().into_reader()) }
    }

    fn next(&mut self) -> (String, Json) {
        let (mut event, mut data) = (String::new(), Json::Null);
        for line in self.lines.by_ref().lines() {
            let line = line.expect("the stream goes on");
            if let Some(name) = line.strip_prefix("event: ") {
                event = name.to_string();
            } else if let Some(text) = line.strip_prefix("data: ") {
                data = json(text);
            } else if line.is_empty() && !event.is_empty() {
                return (event, data);
            }
        }
        panic!("the stream has ended")
    }

    /// The first event of this name that fits. Others come for ever: that it does not come shows only when
    /// the test run is stopped.
    fn wait_for(&mut self, name: &str, fits: impl Fn(&Json) -> bool) -> Json {
        // Once a second a handful; so many have seen a minute go by.
        for _ in 0..600 {
            let (event, data) = self.next();
            if event == name && fits(&data) {
                return data;
            }
        }
        panic!("no event `{name}` that fits")
    }
}

fn point<'d>(data: &'d Json, name: &str) -> Option<&'d Json> {
    data["points"].as_array()?.iter().find(|point| point["name"] == name)
}

#[test]
fn the_page_allows_a_browser_nothing_but_itself() {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let gateway = Gateway::start(&broker, &configuration(&port));
    let mut policies = Vec::new();
    for _ in 0..2 {
        let mut answer = get(&gateway, "/", None);
        assert_eq!(answer.status(), 200);
        assert_eq!(header(&answer, "content-type"), "text/html; charset=utf-8");
        let policy = header(&answer, "content-security-policy").to_string();
        let body = answer.body_mut().read_to_string().expect("the page is text");
        let nonce = policy.split("script-src 'nonce-").nth(1).and_then(|rest| rest.split('\'').next());
        let nonce = nonce.expect("the policy names a nonce");
        assert_eq!(body.matches(&format!(" nonce=\"{nonce}\"")).count(), 2);
        for rule in ["default-src 'none'", "connect-src 'self'", "base-uri 'none'", "form-action 'none'"] {
            assert!(policy.contains(rule), "{policy}");
        }
        policies.push(policy);
    }
    assert_ne!(policies[0], policies[1], "each answer has a nonce of its own");
    for path in ["/", "/health", "/metrics", "/api/devices", "/api/buses", "/nothing"] {
        let answer = get(&gateway, path, None);
        assert_eq!(header(&answer, "cache-control"), "no-store", "{path}");
        assert_eq!(header(&answer, "x-content-type-options"), "nosniff", "{path}");
        assert_eq!(header(&answer, "x-frame-options"), "DENY", "{path}");
        assert_eq!(header(&answer, "referrer-policy"), "no-referrer", "{path}");
        assert!(header(&answer, "content-security-policy").contains("frame-ancestors 'none'"), "{path}");
        let post = agent().post(format!("{}{path}", gateway.http())).send("x").expect("HTTP answers");
        assert!([404, 405].contains(&post.status().as_u16()), "{path}: {}", post.status());
    }
}

#[test]
fn who_watches_is_told_everything_first_and_then_what_changes() {
    let ((_port, simulation), _broker, watcher, gateway) = all_online();
    watcher.wait_for("busker/relays/relay_3", "OFF");

    let mut events = Events::open(&gateway, None);
    let (first, state) = events.next();
    assert_eq!(first, "state");
    assert_eq!(state["buses"][0]["name"], "line");
    let relays = &state["devices"][0];
    assert_eq!((&relays["title"], &relays["online"]), (&"Relays".into(), &true.into()));
    let relay = point(relays, "relay_3").expect("a relay");
    assert_eq!((&relay["value"], &relay["freshness"]), (&"OFF".into(), &"fresh".into()));

    simulation.command("unit 18 relay 3 hand on").expect("a hand on the relay");
    let told = events.wait_for("points", |data| point(data, "relay_3").is_some());
    assert_eq!(told["device"], "relays");
    assert_eq!(point(&told, "relay_3").expect("it is told")["value"], "ON");
    assert!(told["at"].as_f64() > state["at"].as_f64(), "{told}");
    events.wait_for("read", |data| data["device"] == "counters" && data["reads"][0]["points"][0].is_string());
    events.wait_for("bus", |data| data["bus"]["requests"].as_u64() > state["buses"][0]["requests"].as_u64());

    simulation.command("unit 18 fault silent").expect("a fault");
    let told = events
        .wait_for("device", |data| data["device"]["name"] == "relays" && data["device"]["online"] == false);
    assert!(told["device"]["reason"].as_str().is_some_and(|why| why.contains("no answer")), "{told}");
    let told = events.wait_for("points", |data| data["device"] == "relays");
    let relay = point(&told, "relay_3").expect("it is told");
    assert_eq!((&relay["value"], &relay["freshness"]), (&"None".into(), &"missing".into()));
    assert_eq!(relay["reason"], "the device is offline");

    // A second reader is told all of it at once.
    let (first, state) = Events::open(&gateway, None).next();
    assert_eq!((first.as_str(), &state["status"]), ("state", &"degraded".into()));
}

#[test]
fn with_a_token_nothing_but_health_is_told_without_it() {
    let (broker, simulation) = (Broker::start(), simulation());
    let port = over_tcp(&simulation);
    let watcher = Watcher::start(&broker, "watcher");
    let rest = format!("mqtt: {{url: 'mqtt://127.0.0.1:{}'}}\n{}", broker.port, configuration(&port));
    let gateway = Gateway::start_in(&[("BUSKER_HTTP_TOKEN", TOKEN)], &rest);
    wait_until_all_is_online(&watcher);
    for path in ["/", "/metrics", "/api/devices", "/api/buses", "/api/events", "/nothing"] {
        for wrong in [None, Some("wrong"), Some(&TOKEN[1..])] {
            let mut answer = get(&gateway, path, wrong);
            assert_eq!(answer.status(), 401, "{path}");
            assert!(header(&answer, "www-authenticate").starts_with("Bearer"), "{path}");
            let body = answer.body_mut().read_to_string().expect("text");
            assert!(!body.contains("relay_1") && !body.contains(TOKEN), "{path}: {body}");
        }
    }
    assert_eq!(get(&gateway, "/health", None).status(), 200);
    for path in ["/", "/metrics", "/api/devices", "/api/buses"] {
        assert_eq!(get(&gateway, path, Some(TOKEN)).status(), 200, "{path}");
    }
    assert_eq!(Events::open(&gateway, Some(TOKEN)).next().0, "state");
    assert!(watcher.received().iter().all(|got| !got.payload.contains(TOKEN)), "it is not published");
    assert!(gateway.log().iter().all(|line| !line.contains(TOKEN)), "it is not logged");
}

#[test]
fn a_page_from_elsewhere_that_leads_a_browser_here_is_told_nothing() {
    let (_devices, _broker, _watcher, gateway) = all_online();
    let ask = |path: &str, host: &str| {
        let request = agent().get(format!("{}{path}", gateway.http())).header("Host", host);
        let mut answer = request.call().expect("HTTP answers");
        let body = answer.body_mut().read_to_string().expect("text");
        (answer.status().as_u16(), body)
    };
    for path in ["/", "/health", "/metrics", "/api/devices", "/api/buses", "/api/events", "/nothing"] {
        let (status, body) = ask(path, "evil.example");
        assert_eq!(status, 421, "{path}");
        assert!(body.contains("token_file") && !body.contains("relay_1"), "{path}: {body}");
    }
    for host in ["localhost", "localhost:8485", "127.0.0.1:1", "[::1]:8485"] {
        assert_eq!(ask("/api/devices", host).0, 200, "{host}");
    }
}
