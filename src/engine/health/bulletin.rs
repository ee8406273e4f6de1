//! When how the gateway is is looked at and told: what changes for the worse or the better at once, of a device too,
//! all the rest each minute.

use super::json::info_json;
use super::{BrokerReport, DeviceReport, GatewayReport, TOLD_EVERY};
use crate::engine::settings::Settings;
use crate::engine::time::{Duration, Time};
use crate::engine::topics::{Message, Topics};

/// What stirs is looked at at once, but not more often than this.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// How often each bus is asked although nothing has stirred: it may be stuck.
const ASK_EVERY: Duration = Duration::from_secs(10);

/// What has been told of how the gateway is, and what is to be told next.
#[derive(Debug)]
pub struct Bulletin {
    ask_every: Duration,
    /// When all is told again, changed or not.
    due: Time,
    /// `None` if nothing has been told that still counts.
    told: Option<Standing>,
    /// Where it was told.
    places: Vec<String>,
    /// How each device was when its own health was told.
    devices: Vec<Presence>,
    info: Message,
}

/// Whether a device is online, and why it is not.
type Presence = (bool, Option<String>);

/// What is worth telling at once when it changes.
#[derive(Debug, PartialEq)]
struct Standing {
    broker: [bool; 4],
    buses: Vec<[bool; 3]>,
    has_configuration_error: bool,
}

/// `bridge/info` while all is well.
pub fn info(settings: &Settings) -> Message {
    Message::retained(Topics::of(&settings.mqtt).bridge_info(), info_json(settings).to_string())
}

impl Bulletin {
    /// Nothing has been told but [`info`]. `watchdog_interval` is how often somebody wants to hear that all
    /// buses answer.
    pub fn new(settings: &Settings, watchdog_interval: Option<Duration>) -> Bulletin {
        Bulletin {
            ask_every: watchdog_interval.map_or(ASK_EVERY, |interval| interval.min(ASK_EVERY)),
            due: Time::default(),
            told: None,
            places: Vec::new(),
            devices: Vec::new(),
            info: info(settings),
        }
    }

    /// Whether to ask for a report although nothing has stirred.
    pub fn wants_report(&self, now: Time, broker: &BrokerReport) -> bool {
        let is_calm = |told: &Standing| told.broker == of_broker(broker) && told.all_respond();
        now >= self.due || !self.told.as_ref().is_some_and(is_calm)
    }

    /// What is to be told of this report, which was asked for at `now`.
    pub fn messages(&mut self, now: Time, settings: &Settings, report: &GatewayReport) -> Vec<Message> {
        let topics = Topics::of(&settings.mqtt);
        let mut of_devices = Vec::new();
        for (bus, device) in report.devices() {
            of_devices.push((topics.of_device(&bus.name, &device.name).health(), bus, device));
        }
        let places: Vec<String> =
            of_devices.iter().map(|(topic, ..)| topic.clone()).chain([topics.bridge_health()]).collect();
        // After a reload a device may be new, or tell it elsewhere.
        let is_due = now >= self.due || self.places != places;
        self.places = places;
        let mut messages = Vec::new();
        let standing = Some(Standing::of(report));
        let devices: Vec<Presence> = of_devices.iter().map(|(.., device)| presence(device)).collect();
        if is_due || self.told != standing || self.devices != devices {
            messages.push(Message::retained(topics.bridge_health(), report.to_json().to_string()));
            self.told = standing;
        }
        if is_due {
            self.due = now + TOLD_EVERY;
        }
        // What its health says must not be denied for a minute by its availability, nor by the reason in its info.
        for (index, (topic, bus, device)) in of_devices.into_iter().enumerate() {
            if is_due || self.devices.get(index) != devices.get(index) {
                messages.push(Message::retained(topic, device.health_json(&bus.name).to_string()));
            }
        }
        self.devices = devices;
        let info = Message::retained(topics.bridge_info(), report.info_json(settings).to_string());
        if self.info != info {
            self.info = info.clone();
            messages.push(info);
        }
        messages
    }

    /// A report says nothing, since buses come and go just now.
    pub fn doubt(&mut self) {
        self.told = None;
    }

    /// When to look again if nothing stirs.
    pub fn next_look(&self, now: Time) -> Time {
        match &self.told {
            Some(told) if told.all_respond() => (now + self.ask_every).min(self.due),
            // A bus that is stuck does not say when it goes on.
            Some(_) | None => now + self.pause(),
        }
    }

    /// However much stirs, so long lies between two looks.
    pub fn pause(&self) -> Duration {
        LOOK_EVERY.min(self.ask_every)
    }
}

impl Standing {
    fn of(report: &GatewayReport) -> Standing {
        let buses = report.buses.iter();
        Standing {
            broker: of_broker(&report.broker),
            buses: buses.map(|bus| [bus.report.up, bus.report.paused, bus.responding]).collect(),
            has_configuration_error: report.configuration_error.is_some(),
        }
    }

    fn all_respond(&self) -> bool {
        self.buses.iter().all(|[.., responding]| *responding)
    }
}

fn presence(device: &DeviceReport) -> Presence {
    (device.online, device.reason.clone())
}

fn of_broker(broker: &BrokerReport) -> [bool; 4] {
    [broker.connected, broker.client_id_taken, broker.state_denied, broker.misses_something()]
}

#[cfg(test)]
mod tests {
    use super::super::tests::gateway;
    use super::*;
    use crate::engine::configuration;
    use crate::engine::profile::Library;

    fn settings(base: &str) -> Settings {
        let text = format!(
            "mqtt: {{url: 'mqtt://localhost', base_topic: {base}}}\nbuses: {{cellar: {{tcp: 'host:502'}}}}\n"
        );
        let loaded = configuration::load("busker.yaml", text.as_bytes(), &Library::shipped());
        loaded.unwrap_or_else(|faults| panic!("{faults:?}")).0
    }

    fn at(seconds: u64) -> Time {
        Time::from_millis(seconds * 1000)
    }

    /// A bulletin that has told at the first moment that both devices are there.
    fn told() -> Bulletin {
        let mut bulletin = Bulletin::new(&settings("busker"), None);
        assert!(bulletin.wants_report(at(0), &BrokerReport::default()));
        check(&mut bulletin, 0, &gateway(true, true, true, &[true, true]), &ALL);
        bulletin
    }

    const ALL: [&str; 3] = ["busker/bridge/health", "busker/d0/health", "busker/d1/health"];

    #[track_caller]
    fn check(bulletin: &mut Bulletin, second: u64, report: &GatewayReport, expected: &[&str]) {
        let messages = bulletin.messages(at(second), &settings("busker"), report);
        assert!(messages.iter().all(|message| message.retain));
        assert!(messages.iter().map(|message| &message.topic).eq(expected), "{messages:?}");
    }

    #[test]
    fn what_changes_is_told_at_once_and_all_of_it_each_minute() {
        let good = gateway(true, true, true, &[true, true]);
        let mut bulletin = told();
        check(&mut bulletin, 1, &good, &[]);
        let paused = |report: &GatewayReport| {
            let mut report = report.clone();
            report.buses[0].report.paused = true;
            report
        };
        let one_is_lost = ["busker/bridge/health", "busker/d1/health"];
        check(&mut bulletin, 2, &gateway(true, true, true, &[true, false]), &one_is_lost);
        check(&mut bulletin, 3, &gateway(true, true, true, &[true, false]), &[]);
        let mut another_reason = gateway(true, true, true, &[true, false]);
        another_reason.buses[0].report.devices[1].reason = Some("another device answers".into());
        check(&mut bulletin, 3, &another_reason, &one_is_lost);
        check(&mut bulletin, 4, &another_reason, &[]);
        check(&mut bulletin, 4, &good, &one_is_lost);
        for changed in [
            gateway(true, true, false, &[true, true]),
            gateway(true, false, true, &[true, true]),
            gateway(false, true, true, &[true, true]),
        ] {
            check(&mut bulletin, 2, &changed, &ALL[..1]);
            check(&mut bulletin, 3, &changed, &[]);
        }
        check(&mut bulletin, 4, &good, &ALL[..1]);
        check(&mut bulletin, 5, &paused(&good), &["busker/bridge/health", "busker/bridge/info"]);
        check(&mut bulletin, 6, &good, &["busker/bridge/health", "busker/bridge/info"]);
        assert!(!bulletin.wants_report(at(59), &good.broker));
        assert!(bulletin.wants_report(at(60), &good.broker));
        check(&mut bulletin, 60, &good, &ALL);
        check(&mut bulletin, 119, &good, &[]);
        check(&mut bulletin, 120, &good, &ALL);
    }

    #[test]
    fn a_device_that_is_new_is_told_of_with_all_others_at_once() {
        let mut bulletin = told();
        let three = gateway(true, true, true, &[true, true, true]);
        check(&mut bulletin, 1, &three, &[&ALL[..], &["busker/d2/health"]].concat());
        // Another base topic.
        let messages = bulletin.messages(at(2), &settings("house"), &three);
        assert!(messages.iter().all(|message| message.topic.starts_with("house/")) && messages.len() == 5);
    }

    #[test]
    fn while_buses_come_and_go_nothing_that_was_told_counts() {
        let mut bulletin = told();
        let good = gateway(true, true, true, &[true, true]);
        bulletin.doubt();
        assert!(bulletin.wants_report(at(1), &good.broker));
        assert_eq!(bulletin.next_look(at(1)), at(2));
        check(&mut bulletin, 1, &good, &ALL[..1]);
    }

    #[test]
    fn a_bus_that_was_stuck_is_asked_again_soon_and_told_of_when_it_answers() {
        let mut bulletin = told();
        let (good, stuck) =
            (gateway(true, true, true, &[true, true]), gateway(true, true, false, &[true, true]));
        check(&mut bulletin, 1, &stuck, &ALL[..1]);
        assert_eq!(bulletin.next_look(at(1)), at(2));
        assert!(bulletin.wants_report(at(2), &good.broker));
        check(&mut bulletin, 2, &good, &ALL[..1]);
        assert_eq!(bulletin.next_look(at(2)), at(12));
    }

    #[test]
    fn what_the_broker_does_without_stirring_anybody_is_noticed() {
        let bulletin = told();
        let broker = |client_id_taken: bool| BrokerReport {
            connected: true,
            client_id_taken,
            ..BrokerReport::default()
        };
        assert!(!bulletin.wants_report(at(1), &broker(false)));
        assert!(bulletin.wants_report(at(1), &broker(true)));
        let missing = BrokerReport { not_arriving: vec!["busker/bridge/state".into()], ..broker(false) };
        assert!(bulletin.wants_report(at(1), &missing));
    }

    #[test]
    fn a_look_is_when_all_is_told_again_a_bus_may_be_stuck_or_a_watchdog_wants_to_hear() {
        for (watchdog, now, next) in [(None, 1, 11), (None, 55, 60), (Some(20), 1, 11), (Some(3), 1, 4)] {
            let mut bulletin = Bulletin::new(&settings("busker"), watchdog.map(Duration::from_secs));
            bulletin.messages(at(0), &settings("busker"), &gateway(true, true, true, &[]));
            assert_eq!(bulletin.next_look(at(now)), at(next), "{watchdog:?}");
        }
        let hasty = Bulletin::new(&settings("busker"), Some(Duration::from_millis(300)));
        assert_eq!(hasty.pause(), Duration::from_millis(300));
        assert_eq!(told().pause(), LOOK_EVERY);
    }
}
