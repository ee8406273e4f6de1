//! What somebody who watches the gateway is told: first everything, then what has changed since.

use serde_json::{Value, json};

use crate::engine::health::{BusHealth, DeviceReport, GatewayReport, device_json, point_json, seconds};
use crate::engine::time::Time;

/// The gateway as it was at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct Look {
    pub at: Time,
    pub report: GatewayReport,
}

/// One event of `GET /api/events`.
#[derive(Clone, Debug, PartialEq)]
pub struct News {
    /// `state`, `gateway`, `bus`, `device`, `points` or `read`.
    pub event: &'static str,
    /// With `at`, the seconds since the gateway's start, from which its ages are counted: what has
    /// waited on its way is as much older when it arrives.
    pub data: Value,
}

/// After so many looks at which there was nothing to tell, it is said that somebody is still there.
const HEARTBEAT_LOOKS: u32 = 10;

/// What is to be told after a look.
#[derive(Clone, Debug, PartialEq)]
pub enum Told {
    News(Vec<News>),
    /// That somebody is still there.
    Heartbeat,
    Nothing,
}

/// What those who watch know.
#[derive(Clone, Debug, Default)]
pub struct Feed {
    last: Option<Look>,
    silent_looks: u32,
}

impl Feed {
    /// What those are told who watch already.
    pub fn look(&mut self, look: Look) -> Told {
        let news = self.last.as_ref().map_or_else(Vec::new, |last| changes(last, &look));
        self.last = Some(look);
        if !news.is_empty() {
            self.silent_looks = 0;
            return Told::News(news);
        }
        self.silent_looks += 1;
        if self.silent_looks % HEARTBEAT_LOOKS == 0 { Told::Heartbeat } else { Told::Nothing }
    }

    /// What a newcomer is told, to know what the others know: [`everything`] as it was last seen.
    pub fn everything(&self, now: Time) -> Option<News> {
        self.last.as_ref().map(|last| everything(last, now))
    }
}

/// The event `state`: all that the others are a difference to. It may be told some time after the look:
/// `now` is when.
pub fn everything(look: &Look, now: Time) -> News {
    let Look { at, report } = look;
    let mut data = report.summary_json();
    data["now"] = seconds(now - Time::default()).into();
    data["version"] = env!("CARGO_PKG_VERSION").into();
    data["buses"] = report.buses_json();
    data["devices"] = report.devices_json(*at);
    news("state", look, data)
}

/// What has changed from one look to the next. What is only read again and is what it was before comes
/// in `read`, with its age and nothing else. If a new configuration has changed what there is, all of it
/// is told.
pub fn changes(before: &Look, after: &Look) -> Vec<News> {
    if names(&before.report) != names(&after.report) {
        return vec![everything(after, after.at)];
    }
    let mut all = Vec::new();
    let gateway = after.report.summary_json();
    if gateway != before.report.summary_json() {
        all.push(news("gateway", after, gateway));
    }
    for (old, new) in before.report.buses.iter().zip(&after.report.buses) {
        let bus = new.named_json();
        if bus != old.named_json() {
            all.push(news("bus", after, json!({"bus": bus})));
        }
        for (old_device, new_device) in old.report.devices.iter().zip(&new.report.devices) {
            let mut of_device = changes_of_device((before, old, old_device), (after, new, new_device));
            all.append(&mut of_device);
        }
    }
    all
}

/// Everything that there is, in its order: each bus, device and point, with what people call it.
fn names(report: &GatewayReport) -> Vec<&str> {
    let mut names = Vec::new();
    for bus in &report.buses {
        names.push(bus.report.name.as_str());
        for device in &bus.report.devices {
            names.push(&device.name);
            names.extend(device.points.iter().flat_map(|point| [point.name.as_str(), &point.title]));
        }
    }
    names
}

/// A device of a bus at the time of a look.
type Seen<'l> = (&'l Look, &'l BusHealth, &'l DeviceReport);

fn changes_of_device((before, old_bus, old): Seen, (after, new_bus, new): Seen) -> Vec<News> {
    let mut all = Vec::new();
    // Being older by itself is no change.
    let ageless = |look: &Look, bus, device: &DeviceReport| {
        let mut told = device_json(bus, device, look.at);
        told["last_answer_seconds_ago"] = device.last_answer_at.map(|at| at.0).into();
        told
    };
    if ageless(before, old_bus, old) != ageless(after, new_bus, new) {
        all.push(news("device", after, json!({"device": device_json(new_bus, new, after.at)})));
    }
    let mut changed: Vec<Value> = Vec::new();
    // Points of one read have one age.
    let mut read: Vec<(Time, Vec<&str>)> = Vec::new();
    for (was, is) in old.points.iter().zip(&new.points) {
        let was_fresh = was.freshness(before.at, old_bus.responding);
        let is_fresh = is.freshness(after.at, new_bus.responding);
        let same_value = was.value == is.value && was.unit == is.unit && was.missing == is.missing;
        if !same_value || was_fresh != is_fresh {
            changed.push(point_json(is, after.at, new_bus.responding));
        } else if was.read_at != is.read_at {
            let Some(read_at) = is.read_at else { continue };
            match read.iter_mut().find(|(at, _)| *at == read_at) {
                Some((_, names)) => names.push(&is.name),
                None => read.push((read_at, vec![&is.name])),
            }
        }
    }
    if !changed.is_empty() {
        all.push(news("points", after, json!({"device": new.name, "points": changed})));
    }
    if !read.is_empty() {
        let told =
            |(at, names): (Time, Vec<&str>)| json!({"seconds_ago": seconds(after.at - at), "points": names});
        let reads: Vec<Value> = read.into_iter().map(told).collect();
        all.push(news("read", after, json!({"device": new.name, "reads": reads})));
    }
    all
}

fn news(event: &'static str, look: &Look, mut data: Value) -> News {
    data["at"] = seconds(look.at - Time::default()).into();
    News { event, data }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::health::{BrokerReport, BusReport, PointReport, Role, ThingReport, good_for};
    use crate::engine::time::Duration;

    /// A gateway with one device, whose two points were read at once, half a second ago.
    fn look(seconds: u64) -> Look {
        let at = Time::from_millis(seconds * 1000);
        let point = |name: &str, value: &str| PointReport {
            name: name.into(),
            title: name.into(),
            role: Role::Value,
            value: value.into(),
            is_list: false,
            unit: Some("°C".into()),
            missing: None,
            read_at: Some(Time::from_millis(seconds * 1000 - 500)),
            good_for: Some(good_for(Duration::from_secs(1))),
        };
        let thing = ThingReport {
            name: "blind".into(),
            title: "Blind".into(),
            kind: "cover",
            state: Some("open".into()),
            missing: None,
            made_of: vec!["flow".into()],
            temperature: None,
            target: None,
        };
        let device = DeviceReport {
            name: "boiler".into(),
            online: true,
            last_answer_at: Some(Time::from_millis(500)),
            points: vec![point("flow", "21.5"), point("return", "18.0")],
            things: vec![thing],
            ..DeviceReport::default()
        };
        let report = BusReport {
            name: "cellar".into(),
            up: true,
            load: 0.1,
            devices: vec![device],
            ..BusReport::default()
        };
        let broker = BrokerReport { connected: true, ..BrokerReport::default() };
        let buses = vec![BusHealth { report, responding: true }];
        Look { at, report: GatewayReport { broker, buses, configuration_error: None } }
    }

    fn device(look: &mut Look) -> &mut DeviceReport {
        &mut look.report.buses[0].report.devices[0]
    }

    /// Each event with what of it is worth comparing.
    #[track_caller]
    fn check(change: impl FnOnce(&mut Look), expected: &[(&str, &str, Value)]) {
        let before = look(10);
        let mut after = look(11);
        change(&mut after);
        let told: Vec<(&str, Value)> =
            changes(&before, &after).into_iter().map(|news| (news.event, news.data)).collect();
        let events: Vec<&str> = told.iter().map(|(event, _)| *event).collect();
        assert_eq!(events, expected.iter().map(|(event, ..)| *event).collect::<Vec<_>>());
        for ((_, data), (_, pointer, value)) in told.iter().zip(expected) {
            assert_eq!(data.pointer(pointer), Some(value), "{data}");
            assert_eq!(data["at"], 11.0);
        }
    }

    #[test]
    fn what_was_only_read_again_comes_with_its_age_and_the_points_of_one_read_together() {
        let reads = json!([{"seconds_ago": 0.5, "points": ["flow", "return"]}]);
        check(|_| {}, &[("read", "/reads", reads)]);
    }

    #[test]
    fn a_change_is_told_by_what_it_concerns() {
        let again = || ("read", "/reads/0/points", json!(["return"]));
        check(
            |look| device(look).points[0].value = "21.6".into(),
            &[("points", "/points/0/value", json!("21.6")), again()],
        );
        check(
            |look| device(look).points[1].missing = Some(("exception", "exception 4".into())),
            &[
                ("points", "/points/0/reason", json!("exception 4")),
                ("read", "/reads/0/points", json!(["flow"])),
            ],
        );
        check(
            |look| device(look).points[0].unit = Some("°F".into()),
            &[("points", "/points/0/unit", json!("°F")), again()],
        );
        let both = || ("read", "/reads/0/points", json!(["flow", "return"]));
        check(
            |look| look.report.broker.connected = false,
            &[("gateway", "/broker/connected", json!(false)), both()],
        );
        check(
            |look| look.report.buses[0].report.counters.timeouts = 1,
            &[("bus", "/bus/timeouts", json!(1)), both()],
        );
        check(
            |look| device(look).online = false,
            &[("gateway", "/status", json!("degraded")), ("device", "/device/online", json!(false)), both()],
        );
    }

    #[test]
    fn what_is_not_read_again_grows_old_and_what_is_made_of_it_too() {
        let (before, mut after) = (look(10), look(10));
        assert_eq!(changes(&before, &after), [], "the same look twice");
        after.at = Time::from_millis(20_000);
        let told = changes(&before, &after);
        let events: Vec<&str> = told.iter().map(|news| news.event).collect();
        assert_eq!(events, ["device", "points"]);
        assert_eq!(told[0].data["device"]["things"][0]["freshness"], "old");
        assert_eq!(told[1].data["points"][0]["freshness"], "old");
        assert_eq!(told[1].data["points"][0]["read_seconds_ago"], 10.5);
    }

    #[test]
    fn of_a_stuck_bus_nothing_is_fresh() {
        let before = look(10);
        let mut after = look(10);
        after.at = Time::from_millis(10_500);
        after.report.buses[0].responding = false;
        let told = changes(&before, &after);
        let events: Vec<&str> = told.iter().map(|news| news.event).collect();
        assert_eq!(events, ["gateway", "bus", "device", "points"]);
        assert_eq!(told[3].data["points"][1]["freshness"], "old");
    }

    #[test]
    fn where_something_else_is_there_than_before_all_is_told() {
        for change in [
            |look: &mut Look| device(look).points[1].name = "rate".into(),
            |look: &mut Look| drop(device(look).points.pop()),
            |look: &mut Look| device(look).name = "pump".into(),
            |look: &mut Look| look.report.buses.clear(),
        ] {
            check(change, &[("state", "/version", json!(env!("CARGO_PKG_VERSION")))]);
        }
    }

    #[test]
    fn who_watches_is_told_what_is_new_and_now_and_then_that_there_is_nothing() {
        let mut feed = Feed::default();
        assert_eq!(feed.everything(Time::from_millis(10_000)), None, "nobody has looked");
        assert_eq!(feed.look(look(10)), Told::Nothing);
        let first = feed.everything(Time::from_millis(10_250)).expect("it was seen");
        assert_eq!(first, everything(&look(10), Time::from_millis(10_250)));
        assert!(matches!(feed.look(look(11)), Told::News(news) if news == changes(&look(10), &look(11))));
        for round in 1..=25 {
            let expected = if round % 10 == 0 { Told::Heartbeat } else { Told::Nothing };
            assert_eq!(feed.look(look(11)), expected, "{round}");
        }
    }

    #[test]
    fn everything_is_everything() {
        let told = everything(&look(10), Time::from_millis(10_250));
        assert_eq!(told.event, "state");
        assert_eq!((&told.data["at"], &told.data["now"]), (&json!(10.0), &json!(10.25)));
        assert_eq!(told.data["status"], "ok");
        assert_eq!(told.data["buses"][0]["name"], "cellar");
        assert_eq!(told.data["devices"][0]["points"][1]["value"], "18.0");
        assert_eq!(told.data["devices"][0]["things"][0]["state"], "open");
    }
}
