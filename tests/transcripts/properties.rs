//! Whatever happens to a bus, in whatever order: the promises that hold always.

use std::collections::BTreeMap;

use busker::engine::address::Span;
use busker::engine::bus::{Action, Bus, Command, Event};
use busker::engine::memory::Memories;
use busker::engine::modbus::{Answer, Call, Discarded, Identification, Reply, Request, RequestError};
use busker::engine::profile::Library;
use busker::engine::request::{Decision, Desk};
use busker::engine::settings::{DeviceSettings, Settings};
use busker::engine::time::{Date, Duration, Time};
use busker::engine::topics::Message;
use proptest::prelude::*;

use crate::devices;
use crate::play::request;

const DEVICES: &str = "device relays 1 relays\ndevice meter 2 selectable\ndevice board 3 clamping\n\
    device holes 4 holes\ndevice cellar 5 identified\ndiscovery\n\
    setting relays watchdog 0.02\nsetting relays relay_1_default ON enforced\nsetting meter mode voltage enforced\n\
    raw-write relays holding 60..70\nraw-write board holding 0..9\n";
const COMMANDS: [(&str, &str, &str); 9] = [
    ("relays", "relay_1", "ON"),
    ("relays", "relay_1_default", "ON"),
    ("relays", "watchdog", "12.5"),
    ("relays", "reset", "PRESS"),
    ("meter", "mode", "voltage"),
    ("meter", "value", "3"),
    ("board", "order", "automatic"),
    ("board", "level", "nonsense"),
    ("cellar", "level", "1"),
];

const REQUESTS: [(&str, &str); 12] = [
    ("read", r#"{"device":"meter","at":"input 0..3"}"#),
    ("read", r#"{"device":"relays","at":"holding 1..66"}"#),
    ("read", r#"{"device":"nobody","at":"holding 1"}"#),
    ("write", r#"{"device":"relays","at":"holding 66","value":7}"#),
    ("write", r#"{"device":"board","at":"holding 1..2","value":[1,2]}"#),
    ("write", r#"{"device":"holes","at":"holding 1","value":1}"#),
    ("identify", r#"{"device":"cellar"}"#),
    ("diagnostics", r#"{"device":"holes"}"#),
    ("refresh", r#"{"device":"meter"}"#),
    ("scan", r#"{"bus":"basement","units":"4..9"}"#),
    ("pause", r#"{"bus":"basement","for":"2s"}"#),
    ("pause", r#"{"bus":"basement","for":"0s"}"#),
];

#[derive(Clone, Debug)]
enum Happening {
    /// The request in flight ends so; without one, nothing.
    Ends(End),
    Command(usize),
    Request(usize),
    /// The configuration of a device changes: it leaves, and comes again when it has left.
    Changed(usize),
    LinkDown,
    LinkUp,
    /// So many requests, one after the other, get no answer, while commands come.
    Mute(u8),
    Time(u16),
}

#[derive(Clone, Debug)]
enum End {
    Words(u16),
    Refused(u8),
    Silence,
    Checksum,
    Collision,
}

fn happening() -> impl Strategy<Value = Happening> {
    prop_oneof![
        8 => (0u16..4).prop_map(|word| Happening::Ends(End::Words(word))),
        2 => any::<u16>().prop_map(|word| Happening::Ends(End::Words(word))),
        1 => (1u8..7).prop_map(|code| Happening::Ends(End::Refused(code))),
        1 => Just(Happening::Ends(End::Silence)),
        1 => Just(Happening::Ends(End::Checksum)),
        1 => Just(Happening::Ends(End::Collision)),
        3 => (0..COMMANDS.len()).prop_map(Happening::Command),
        3 => (0..REQUESTS.len()).prop_map(Happening::Request),
        1 => (0usize..5).prop_map(Happening::Changed),
        1 => Just(Happening::LinkDown),
        2 => Just(Happening::LinkUp),
        1 => (1u8..12).prop_map(Happening::Mute),
        4 => (0u16..2000).prop_map(Happening::Time),
    ]
}

fn answer(request: &Request, word: u16) -> Answer {
    match request.call {
        Call::Read(span) if span.table().is_bits() => Answer::Bits(vec![word & 1 == 1; count(span)]),
        Call::Read(span) => Answer::Words(vec![word; count(span)]),
        Call::ReadIdentification { .. } => {
            let product = if word == 0 { "L2" } else { "L1" };
            let objects = vec![(0, "ACME".to_string()), (1, product.to_string())];
            Answer::Identification(Identification { conformity: 1, next: None, objects })
        }
        Call::Diagnostics { .. } => Answer::Diagnostics(vec![word]),
        Call::ReportServerId => Answer::ServerId(vec![word as u8]),
        _ => Answer::Written,
    }
}

fn count(span: Span) -> usize {
    span.count() as usize
}

/// A bus and what an observer has seen of it.
struct Observed {
    bus: Bus,
    now: Time,
    in_flight: Option<Request>,
    outcomes: usize,
    /// Commands sent to points that exist.
    commands: usize,
    settings: Settings,
    leaving: Vec<DeviceSettings>,
    desk: Desk,
    requests: usize,
    responses: usize,
    is_link_wanted: bool,
    /// What each device was last told to be.
    availability: BTreeMap<String, String>,
    /// The device that was told to be online, and not yet more.
    has_just_come: Option<String>,
}

impl Observed {
    fn take_actions(&mut self) {
        while let Some(action) = self.bus.next_action() {
            match action {
                Action::Send { request, .. } => {
                    assert!(self.in_flight.is_none(), "two requests in flight");
                    self.in_flight = Some(request);
                }
                // Every other request is not yet on the wire.
                Action::Withdraw if self.commands % 2 == 0 => {
                    self.in_flight = None;
                    self.bus.handle(self.now, Event::Withdrawn);
                }
                Action::Reopen { .. } => {
                    assert!(self.in_flight.is_none(), "a link ends under a request");
                    self.is_link_wanted = true;
                }
                Action::Publish(message) if message.topic.ends_with("/outcome") => self.outcomes += 1,
                Action::Publish(message) if message.topic.contains("/response/") => {
                    self.responses += usize::from(!message.payload.contains(r#""status":"progress""#));
                }
                Action::Publish(message) => self.look_at(&message),
                _ => {}
            }
        }
    }

    /// Who hears `online` finds the values: the info that is told with it knows of nothing that is still to be read.
    fn look_at(&mut self, message: &Message) {
        if let Some(device) = message.topic.strip_suffix("/availability") {
            self.availability.insert(device.into(), message.payload.clone());
            self.has_just_come = (message.payload == "online").then(|| device.into());
        }
        if let Some(device) = message.topic.strip_suffix("/info") {
            let info: serde_json::Value = serde_json::from_str(&message.payload).expect("JSON");
            let is_online = self.availability[device] == "online";
            assert_eq!(info["online"], is_online, "{device} {}", self.availability[device]);
            assert_eq!(info["reason"].is_null(), is_online, "{}", message.payload);
            if self.has_just_come.take().is_some_and(|came| came == device) {
                let missing = info["missing"].as_object().expect("an object");
                for reason in missing.values().filter_map(|reason| reason.as_str()) {
                    let is_waited_for = reason.strip_prefix("waiting for ");
                    let is_known =
                        reason != "not yet read" && is_waited_for.is_none_or(|why| missing.contains_key(why));
                    assert!(is_known, "{}", message.payload);
                }
            }
        }
    }

    /// Answers everything for so long, and opens the link whenever it is wanted.
    fn is_well_for(&mut self, time: Duration) {
        let until = self.now + time;
        while self.now < until {
            while self.in_flight.is_some() || self.is_link_wanted {
                self.end(&End::Words(1));
                if std::mem::take(&mut self.is_link_wanted) {
                    self.handle(Event::LinkUp);
                }
            }
            self.play(&Happening::Time(500));
        }
    }

    fn handle(&mut self, event: Event) {
        self.bus.handle(self.now, event);
        self.take_actions();
        let bus = &self.bus;
        let is_gone = |device: &DeviceSettings| !bus.has_device(&device.name);
        let (gone, leaving) = std::mem::take(&mut self.leaving).into_iter().partition(is_gone);
        self.leaving = leaving;
        self.bus.handle(self.now, Event::Adopt(gone, Memories::default()));
        self.take_actions();
    }

    fn end(&mut self, end: &End) {
        let Some(request) = self.in_flight.take() else { return };
        let result = match end {
            End::Words(word) => Ok(answer(&request, *word)),
            End::Refused(code) => Err(RequestError::Exception(*code)),
            End::Silence => Err(RequestError::Timeout),
            End::Checksum => Err(RequestError::Checksum),
            End::Collision => Err(RequestError::Collision),
        };
        let (sent_at, heard) = (self.now, Some(self.now));
        let discarded = Discarded::default();
        self.handle(Event::Reply(Reply {
            result,
            sent_at,
            first_byte_at: heard,
            last_byte_at: heard,
            discarded,
        }));
    }

    fn play(&mut self, happening: &Happening) {
        match happening {
            Happening::Ends(end) => self.end(end),
            Happening::Command(index) => {
                let (device, point, payload) = COMMANDS[*index];
                self.commands += 1;
                self.handle(Event::Command(Command {
                    device: device.into(),
                    point: point.into(),
                    payload: payload.into(),
                    retained: false,
                }));
            }
            Happening::Request(index) => {
                let (verb, payload) = REQUESTS[*index];
                match self.desk.decide(Date(0), request(verb, payload)) {
                    Decision::Ask(_, request) => {
                        self.requests += 1;
                        self.handle(Event::Request(request));
                    }
                    Decision::Answer(_) => {}
                    other => panic!("{other:?}"),
                }
            }
            Happening::Changed(index) => {
                let device = &self.settings.devices[*index];
                if !self.leaving.contains(device) {
                    self.leaving.push(device.clone());
                }
                self.handle(Event::Retire(device.name.clone()));
            }
            Happening::LinkDown => {
                self.in_flight = None;
                self.handle(Event::LinkDown("pulled".into()));
            }
            Happening::LinkUp => {
                if self.in_flight.is_none() {
                    self.handle(Event::LinkUp);
                }
            }
            Happening::Mute(count) => {
                for number in 0..*count {
                    self.end(&End::Silence);
                    self.play(&Happening::Command(usize::from(number) % COMMANDS.len()));
                    self.play(&Happening::LinkUp);
                    self.play(&Happening::Time(500));
                }
            }
            Happening::Time(millis) => {
                let until = self.now + Duration::from_millis(u64::from(*millis));
                while let Some(wake_at) = self.bus.wake_at().filter(|wake_at| *wake_at <= until) {
                    let before = self.now;
                    self.now = self.now.max(wake_at);
                    self.handle(Event::Wake);
                    let again = self.bus.wake_at();
                    assert!(
                        self.in_flight.is_some()
                            || again.is_none_or(|again| again > self.now || self.now > before),
                        "woken for nothing at {}",
                        self.now
                    );
                    if self.in_flight.is_some() {
                        break;
                    }
                }
                self.now = until.max(self.now);
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn each_command_and_each_request_has_one_answer_and_one_question_is_in_flight(
        link in prop_oneof![Just(""), Just("tcp\n")],
        happenings in prop::collection::vec(happening(), 1..300),
    ) {
        let settings = devices::settings(&format!("{link}{DEVICES}"));
        let mut observed = Observed {
            bus: Bus::new(Time::default(), &settings, 0, &Memories::default()),
            now: Time::default(),
            in_flight: None,
            outcomes: 0,
            commands: 0,
            desk: Desk::new(&settings, Library::default()),
            requests: 0,
            responses: 0,
            leaving: Vec::new(),
            is_link_wanted: false,
            availability: BTreeMap::new(),
            has_just_come: None,
            settings,
        };
        observed.take_actions();
        observed.play(&Happening::LinkUp);
        for happening in &happenings {
            observed.play(happening);
        }
        // Whatever has happened, who answers is online in the end.
        observed.end(&End::Silence);
        observed.is_well_for(Duration::from_secs(40));
        for (device, availability) in &observed.availability {
            prop_assert_eq!(availability, "online", "{}", device);
        }
        observed.handle(Event::Shutdown);
        for _ in 0..10 {
            observed.end(&End::Silence);
        }
        prop_assert!(observed.bus.is_finished());
        prop_assert_eq!(observed.outcomes, observed.commands);
        prop_assert_eq!(observed.responses, observed.requests);
    }
}
