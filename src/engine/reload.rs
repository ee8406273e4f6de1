//! From one configuration to another without a gap: what is left alone, what begins and what ends.
//!
//! [`compare`] decides it; the edge goes through it in this order: it prepares what can fail, lets end what ends, lets
//! devices leave their buses, takes back at the broker what is gone, and only then starts buses and hands over
//! devices, which may have been on other buses before.

use std::collections::BTreeSet;

use crate::engine::bus::Event;
use crate::engine::homeassistant;
use crate::engine::memory::Memories;
use crate::engine::outbox::Outbox;
use crate::engine::settings::{Bus, DeviceSettings, Rules, Settings};
use crate::engine::topics::Topics;

/// What has to be done so that the gateway is as the new settings want it.
#[derive(Clone, Debug, PartialEq)]
pub struct Change {
    /// The connection to the broker is made anew.
    pub broker: bool,
    pub http: bool,
    pub telling: Telling,
    /// Where things are remembered.
    pub memory: bool,
    /// What buses that stay go on with, if it has changed.
    pub rules: Option<Rules>,
    /// In the order of the new settings.
    pub buses: Vec<(String, Fate)>,
    /// Buses that are there no more.
    pub ended: Vec<String>,
}

/// What makes a difference beside the settings, also while they are the same.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Circumstances {
    /// The broker's password, which stands in a file.
    pub password_differs: bool,
    /// The token of HTTP, which does as well.
    pub token_differs: bool,
    /// HTTP is not there. Where it could not come back, it is tried again, whatever has changed.
    pub http_is_missing: bool,
}

/// How what is known is told from now on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Telling {
    AsBefore,
    /// On other topics below the same base topic, in another way, or to Home Assistant elsewhere or otherwise.
    Otherwise,
    /// Below another base topic: to everybody this is another gateway.
    Elsewhere,
}

/// What becomes of a bus.
#[derive(Clone, Debug, PartialEq)]
pub enum Fate {
    /// It goes on. These devices leave it, and then these come to it; a changed one does both.
    Stays {
        leave: Vec<String>,
        come: Vec<DeviceSettings>,
    },
    /// Its link has changed.
    Restarts,
    Begins,
}

impl Change {
    /// Things are remembered in another place from now on. Where one of the two keeps nothing, what devices go on with
    /// from memory is not so any more: each leaves its bus and comes to it again. So does one of which alone nothing
    /// is kept in one of the two.
    pub fn remember_elsewhere(
        &mut self,
        (old, before): (&Settings, &Memories),
        (new, now): (&Settings, &Memories),
    ) {
        let is_unkept = |device: &str| before.unkept_of(device).is_some() || now.unkept_of(device).is_some();
        for (bus, fate) in &mut self.buses {
            if let Fate::Stays { leave, come } = fate {
                let left = devices_on(old, bus).into_iter().map(|device| device.name);
                *leave = left.filter(|name| leave.contains(name) || is_unkept(name)).collect();
                let mut there = devices_on(new, bus);
                there.retain(|device| come.contains(device) || is_unkept(&device.name));
                *come = there;
            }
        }
    }

    /// Whether the bus of this name goes on.
    pub fn stays(&self, bus: &str) -> bool {
        self.buses.iter().any(|(name, fate)| name == bus && matches!(fate, Fate::Stays { .. }))
    }

    /// The devices that leave the bus of this name, which goes on.
    pub fn leaving(&self, bus: &str) -> &[String] {
        let fate = self.buses.iter().find(|(name, _)| name == bus).map(|(_, fate)| fate);
        if let Some(Fate::Stays { leave, .. }) = fate { leave } else { &[] }
    }

    /// What the bus number `index` of the new settings has to be told when all that leaves has left. `is_connected`: the
    /// broker is there, as a bus that begins takes for granted.
    pub fn events(&self, index: usize, memories: &Memories, is_connected: bool) -> Vec<Event> {
        let mut events = Vec::new();
        match &self.buses[index].1 {
            Fate::Stays { come, .. } => {
                events.extend(self.rules.map(Event::Rules));
                if !come.is_empty() {
                    let on_bus = |device: &DeviceSettings| DeviceSettings { bus: index, ..device.clone() };
                    events.push(Event::Adopt(come.iter().map(on_bus).collect(), memories.clone()));
                }
            }
            Fate::Restarts | Fate::Begins => events.extend((!is_connected).then_some(Event::BrokerDown)),
        }
        events
    }

    /// Whether what was told and stored so far counts no more, and all of it is due again.
    pub fn begins_telling_anew(&self) -> bool {
        self.telling != Telling::AsBefore || self.memory
    }

    /// What people are told when it has been done.
    pub fn lines(&self) -> Vec<String> {
        let rules =
            self.rules.map(|_| "what holds for every bus has changed, and the buses go on".to_string());
        let of_buses = self.buses.iter().flat_map(|(bus, fate)| fate.lines(bus));
        let ended = self.ended.iter().map(|bus| format!("bus {bus}: gone"));
        rules.into_iter().chain(of_buses).chain(ended).collect()
    }

    pub fn is_nothing(&self) -> bool {
        let stays = |(_, fate): &(String, Fate)| matches!(fate, Fate::Stays { leave, come } if leave.is_empty() && come.is_empty());
        !self.broker
            && !self.http
            && !self.memory
            && self.telling == Telling::AsBefore
            && self.rules.is_none()
            && self.ended.is_empty()
            && self.buses.iter().all(stays)
    }
}

impl Fate {
    fn lines(&self, bus: &str) -> Vec<String> {
        let (leave, come) = match self {
            Fate::Stays { leave, come } => (leave, come),
            Fate::Restarts => return vec![format!("bus {bus}: changed, and started anew")],
            Fate::Begins => return vec![format!("bus {bus}: new")],
        };
        let gone = leave.iter().filter(|name| !come.iter().any(|device| device.name == **name));
        let gone = gone.map(|name| format!("bus {bus}: {name} is gone"));
        let here = come.iter().map(|DeviceSettings { name, .. }| {
            format!("bus {bus}: {name} is {}", if leave.contains(name) { "changed" } else { "new" })
        });
        gone.chain(here).collect()
    }
}

/// Where HTTP is to be listened to before the old address is left, so that nothing has changed if that cannot be. The
/// same port, `port` of the old address, can be taken only when it has been left.
pub fn listens_before_leaving<'n>(old: &Settings, new: &'n Settings, port: Option<u16>) -> Option<&'n str> {
    let listen = new.http.listen.as_deref().filter(|_| old.http.listen != new.http.listen)?;
    let is_the_same = port.is_some_and(|port| listen.ends_with(&format!(":{port}")));
    (!is_the_same).then_some(listen)
}

/// Where HTTP was listened to, to go back there: on the `port` that it had, which may have been for the system to choose.
pub fn listened_before(old: &Settings, port: Option<u16>) -> Option<String> {
    let (host, _) = old.http.listen.as_deref()?.rsplit_once(':')?;
    Some(format!("{host}:{}", port?))
}

/// Takes back at the broker what the new settings do not have.
pub fn take_back(outbox: &mut Outbox, old: &Settings, new: &Settings, telling: Telling) {
    let before = match telling {
        // Has been taken back, as far as it could be.
        Telling::Elsewhere => BTreeSet::new(),
        Telling::AsBefore | Telling::Otherwise => topics_of_devices(old),
    };
    outbox.reconfigure(homeassistant::identities(new), &before, &topics_of_devices(new));
    let topics = Topics::of(&new.mqtt);
    changed_devices(old, new).iter().for_each(|device| outbox.announced_anew(&topics.identity(device)));
}

/// Compares two configurations.
pub fn compare(old: &Settings, new: &Settings, beside: Circumstances) -> Change {
    let telling = |settings: &Settings| {
        let mqtt = &settings.mqtt;
        (mqtt.topics.clone(), mqtt.values, mqtt.json, settings.home_assistant.clone())
    };
    let telling = match telling(old) != telling(new) {
        _ if old.mqtt.base_topic != new.mqtt.base_topic => Telling::Elsewhere,
        true => Telling::Otherwise,
        false => Telling::AsBefore,
    };
    let fate = |bus: &Bus| match old.buses.iter().find(|other| other.name == bus.name) {
        None => Fate::Begins,
        Some(before) if before != bus => Fate::Restarts,
        Some(_) => {
            let (before, after) = (devices_on(old, &bus.name), devices_on(new, &bus.name));
            let leave = before.iter().filter(|device| !after.contains(device));
            let come = after.iter().filter(|device| !before.contains(device));
            Fate::Stays {
                leave: leave.map(|device| device.name.clone()).collect(),
                come: come.cloned().collect(),
            }
        }
    };
    let has_to_come_back = beside.http_is_missing && new.http.listen.is_some();
    let is_gone = |bus: &&Bus| !new.buses.iter().any(|other| other.name == bus.name);
    Change {
        broker: !old.mqtt.is_reached_as(&new.mqtt) || beside.password_differs,
        http: old.http != new.http || beside.token_differs || has_to_come_back,
        telling,
        memory: old.state_dir != new.state_dir,
        rules: (old.rules() != new.rules()).then(|| new.rules()),
        buses: new.buses.iter().map(|bus| (bus.name.clone(), fate(bus))).collect(),
        ended: old.buses.iter().filter(is_gone).map(|bus| bus.name.clone()).collect(),
    }
}

/// The devices on a bus, whatever number that has.
fn devices_on(settings: &Settings, bus: &str) -> Vec<DeviceSettings> {
    let of_bus = settings.devices.iter().filter(|device| settings.buses[device.bus].name == bus);
    of_bus.map(|device| DeviceSettings { bus: 0, ..device.clone() }).collect()
}

/// The names of all devices that are not as they were: also those of buses that restart or end.
fn changed_devices(old: &Settings, new: &Settings) -> BTreeSet<String> {
    let with_bus = |settings: &Settings, name: &str| {
        let device = settings.devices.iter().find(|device| device.name == name)?;
        Some((settings.buses[device.bus].clone(), DeviceSettings { bus: 0, ..device.clone() }))
    };
    let names = old.devices.iter().chain(&new.devices).map(|device| device.name.clone());
    names.filter(|name| with_bus(old, name) != with_bus(new, name)).collect()
}

/// Every retained topic that the devices of these settings tell something on.
pub fn topics_of_devices(settings: &Settings) -> BTreeSet<String> {
    let topics = Topics::of(&settings.mqtt);
    let of_device = |device: &DeviceSettings| {
        let points = device.device.points.iter().map(|point| &point.name);
        let things = device.device.things.iter().map(|thing| &thing.name);
        let own = topics.of_device(&settings.buses[device.bus].name, &device.name);
        let mut all: Vec<String> = points.chain(things).map(|name| own.state(name)).collect();
        all.extend([own.availability(), own.info(), own.health()]);
        if settings.mqtt.json {
            all.push(own.json().to_string());
        }
        all
    };
    settings.devices.iter().flat_map(of_device).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::configuration;
    use crate::engine::profile::Library;

    const BEFORE: &str = "
mqtt: {url: 'mqtt://localhost'}
buses: {a: {tcp: 'host:502'}, b: {tcp: 'host:503'}}
devices:
  one: {bus: a, unit: 1, points: {x: {at: input 0, poll: fast}}}
  two: {bus: a, unit: 2, points: {x: {at: input 0, poll: fast}}}
  three: {bus: b, unit: 3, points: {x: {at: input 0, poll: fast}}}
";

    fn settings(text: &str) -> Settings {
        let loaded = configuration::load("busker.yaml", text.as_bytes(), &Library::shipped());
        loaded.unwrap_or_else(|faults| panic!("{faults:?}")).0
    }

    /// The change that follows from putting `to` where `from` stands, in a few words.
    #[track_caller]
    fn check(changes: &[(&str, &str)], expected: &str) {
        let mut text = BEFORE.to_string();
        for (from, to) in changes {
            assert!(text.contains(from), "{from}");
            text = text.replace(from, to);
        }
        let change = compare(&settings(BEFORE), &settings(&text), Circumstances::default());
        let mut words: Vec<String> = Vec::new();
        words.extend(change.broker.then(|| "broker".into()));
        words.extend(change.http.then(|| "http".into()));
        words.extend(change.memory.then(|| "memory".into()));
        words.extend(change.rules.map(|_| "rules".into()));
        words.extend(match change.telling {
            Telling::AsBefore => None,
            Telling::Otherwise => Some("told otherwise".to_string()),
            Telling::Elsewhere => Some("told elsewhere".to_string()),
        });
        for (name, fate) in &change.buses {
            match fate {
                Fate::Restarts => words.push(format!("{name} restarts")),
                Fate::Begins => words.push(format!("{name} begins")),
                Fate::Stays { leave, come } => {
                    words.extend(leave.iter().map(|device| format!("{device} leaves {name}")));
                    words.extend(come.iter().map(|device| format!("{} comes to {name}", device.name)));
                }
            }
        }
        words.extend(change.ended.iter().map(|name| format!("{name} ends")));
        assert_eq!(change.is_nothing(), words.is_empty());
        let told = words.join(", ");
        assert_eq!(told, expected, "{changes:?}");
    }

    #[test]
    fn only_what_changed_is_touched() {
        check(&[("\nmqtt:", "\n# nothing but a comment\nmqtt:")], "");
        check(&[("localhost", "other")], "broker");
        check(&[("\nmqtt:", "\nhttp: {listen: null}\nmqtt:")], "http");
        check(&[("two: {bus: a, unit: 2", "two: {bus: a, unit: 3")], "two leaves a, two comes to a");
        check(
            &[("two: {bus: a", "two: {bus: b"), ("three: {bus: b", "three: {bus: a")],
            "two leaves a, three comes to a, three leaves b, two comes to b",
        );
        check(&[("three:", "four:")], "three leaves b, four comes to b");
        check(&[("host:503", "host:504")], "b restarts");
        check(&[("{a: ", "{c: {tcp: 'host:505'}, a: ")], "c begins");
        check(&[("b: {tcp", "c: {tcp"), ("bus: b", "bus: c")], "c begins, b ends");
        check(
            &[(
                "{a: {tcp: 'host:502'}, b: {tcp: 'host:503'}}",
                "{b: {tcp: 'host:503'}, a: {tcp: 'host:502'}}",
            )],
            "",
        );
        for rule in [
            "eeprom: {daily: 7}",
            "republish: 5m",
            "recorder: {kilobytes: 0}",
            "on_broker_loss: stop_feeding",
        ] {
            check(&[("\nmqtt:", &format!("\n{rule}\nmqtt:"))], "rules");
        }
        let mqtt = |more: &str, expected: &str| {
            check(&[("'mqtt://localhost'", &format!("'mqtt://localhost', {more}"))], expected);
        };
        for more in ["topics: '{base}/{bus}/{device}/{point}'", "retain: false", "json: true", "qos: 0"] {
            mqtt(more, "told otherwise");
        }
        mqtt("base_topic: house", "broker, told elsewhere");
        mqtt("base_topic: house, json: true", "broker, told elsewhere");
        mqtt("keep_alive: 30s", "broker");
        mqtt("username: me, json: true", "broker, told otherwise");
        for section in ["discovery: false", "prefix: ha", "minimum_version: '2025.4'", "expire_after: 3h"] {
            check(&[("\nmqtt:", &format!("\nhome_assistant: {{{section}}}\nmqtt:"))], "told otherwise");
        }
        check(&[("\nmqtt:", "\nstate_dir: /tmp\nmqtt:")], "memory");
    }

    #[test]
    fn what_makes_a_difference_beside_the_settings_is_a_change_although_they_are_the_same() {
        let nothing = Circumstances::default();
        let without = format!("http: {{listen: null}}{BEFORE}");
        for (text, beside, broker, http) in [
            (BEFORE, nothing, false, false),
            (BEFORE, Circumstances { password_differs: true, ..nothing }, true, false),
            (BEFORE, Circumstances { token_differs: true, ..nothing }, false, true),
            (BEFORE, Circumstances { http_is_missing: true, ..nothing }, false, true),
            (&without, Circumstances { http_is_missing: true, ..nothing }, false, false),
        ] {
            let same = settings(text);
            let change = compare(&same, &same, beside);
            assert_eq!((change.broker, change.http), (broker, http), "{beside:?}");
            assert_eq!(change.is_nothing(), !broker && !http);
        }
    }

    /// A change in which bus `a` stays, `b` begins anew and `c` is new.
    fn change() -> (Settings, Settings, Change) {
        let after = BEFORE
            .replace("two: {bus: a, unit: 2", "two: {bus: a, unit: 4")
            .replace("'host:503'}", "'host:504'}, c: {tcp: 'host:505'}");
        let (old, new) = (settings(BEFORE), settings(&format!("eeprom: {{daily: 7}}{after}")));
        let change = compare(&old, &new, Circumstances::default());
        (old, new, change)
    }

    /// What the bus number `index` is told, in a few words.
    fn told(change: &Change, index: usize, is_connected: bool) -> Vec<String> {
        let word = |event| match event {
            Event::Rules(_) => "rules".to_string(),
            Event::Adopt(devices, _) => {
                assert!(devices.iter().all(|device| device.bus == index));
                let names: Vec<&str> = devices.iter().map(|device| device.name.as_str()).collect();
                names.join(" and ")
            }
            other => format!("{other:?}"),
        };
        change.events(index, &Memories::default(), is_connected).into_iter().map(word).collect()
    }

    #[test]
    fn a_bus_that_stays_is_told_what_is_new_and_one_that_begins_whether_the_broker_is_there() {
        let (_, _, change) = change();
        assert_eq!((change.leaving("a"), change.leaving("b")), (&["two".to_string()][..], &[][..]));
        assert_eq!(told(&change, 0, false), ["rules", "two"]);
        for begins in [1, 2] {
            assert_eq!(told(&change, begins, false), ["BrokerDown"]);
            assert!(told(&change, begins, true).is_empty());
        }
    }

    #[test]
    fn devices_begin_anew_where_nothing_was_or_will_be_kept_of_them() {
        let kept = Memories::default();
        let unkept = Memories { unkept: Some("the card is full".into()), ..Memories::default() };
        let damaged = |device: &str| Memories {
            damaged: [(device.to_string(), "its file is damaged".to_string())].into(),
            ..Memories::default()
        };
        for (before, now, adopted) in [
            (&kept, &kept, "two"),
            (&kept, &unkept, "one and two"),
            (&unkept, &kept, "one and two"),
            (&damaged("one"), &kept, "one and two"),
            (&kept, &damaged("one"), "one and two"),
            (&damaged("two"), &kept, "two"),
            (&damaged("three"), &damaged("three"), "two"),
        ] {
            let (old, new, mut change) = change();
            change.remember_elsewhere((&old, before), (&new, now));
            assert_eq!(told(&change, 0, true), ["rules", adopted]);
            assert_eq!(change.leaving("a").join(" and "), adopted);
        }
    }

    #[test]
    fn people_are_told_what_became_of_each_bus_and_device() {
        let after = "
eeprom: {daily: 7}
buses: {a: {tcp: 'host:502'}, c: {tcp: 'host:504'}}
devices:
  one: {bus: a, unit: 9, points: {x: {at: input 0, poll: fast}}}
  four: {bus: a, unit: 4, points: {x: {at: input 0, poll: fast}}}
";
        let change = compare(&settings(BEFORE), &settings(after), Circumstances::default());
        let expected = [
            "what holds for every bus has changed, and the buses go on",
            "bus a: two is gone",
            "bus a: one is changed",
            "bus a: four is new",
            "bus c: new",
            "bus b: gone",
        ];
        assert_eq!(change.lines(), expected);
        assert_eq!(["a", "b", "c"].map(|bus| change.stays(bus)), [true, false, false]);
    }

    #[test]
    fn another_port_is_listened_to_before_the_old_one_is_left() {
        let with = |listen: &str| settings(&format!("http: {{listen: {listen}}}{BEFORE}"));
        for (old, port, new, expected) in [
            ("'h:80'", Some(80), "'h:81'", Some("h:81")),
            ("null", None, "'h:80'", Some("h:80")),
            ("'h:80'", Some(80), "'h:80'", None),
            ("'h:80'", Some(80), "'other:80'", None),
            ("'h:80'", Some(80), "'h:8080'", Some("h:8080")),
            ("'h:80'", Some(80), "null", None),
            // The port of the old one was for the system to choose.
            ("'h:0'", Some(4711), "'h:4711'", None),
        ] {
            let new = with(new);
            assert_eq!(listens_before_leaving(&with(old), &new, port), expected, "{old}, {:?}", new.http);
        }
        assert_eq!(listened_before(&with("'h:0'"), Some(4711)).as_deref(), Some("h:4711"));
        assert_eq!(listened_before(&with("null"), None), None);
    }
}
