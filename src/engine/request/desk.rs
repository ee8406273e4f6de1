//! Where everything arrives that somebody wants over MQTT: it is for one bus, or is answered here with what would be
//! right.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;
use std::sync::{Arc, Weak};

use serde_json::Value as Json;

use super::object::{Object, transaction_of, words};
use super::{Request, Scan, Status, Verb, Wish, answer};
use crate::engine::arrivals::{Command, Errand};
use crate::engine::command::{self, Outcome, OutcomeKind};
use crate::engine::identity::{self, Known};
use crate::engine::profile::Library;
use crate::engine::settings::{Settings, UNIT_OF_LINE_MAX, units};
use crate::engine::time::{Date, Duration};
use crate::engine::topics::{Message, Topics};
use crate::engine::yaml::{Scalar, list_of_choices};

/// A bus that was forgotten in its pause comes back after this.
const PAUSE_LONGEST: Duration = Duration::from_secs(3600);

/// What is to be done with what somebody wants. The numbers are those of buses.
#[derive(Clone, Debug, PartialEq)]
pub enum Decision {
    /// The bus gets the request; [`Desk::no_room`] answers if it does not take it.
    Ask(usize, Request),
    /// The bus gets the command; [`Desk::outcome`] is told if it does not take it.
    Obey(usize, Command),
    /// The bus is to read this point. Where it does not take that, the next poll reads it.
    Read {
        bus: usize,
        device: String,
        point: String,
    },
    Answer(Message),
    /// It is ignored, and people should know.
    Warn(String),
    /// It is ignored, which is of interest only to who looks closely.
    Mention(String),
    Ignore,
}

/// Knows which device is on which bus, and what can be asked for.
pub struct Desk {
    topics: Topics,
    /// Device to bus.
    bus_of: BTreeMap<String, usize>,
    /// Names in their order, and the highest unit of each.
    buses: Vec<(String, u8)>,
    library: Library,
    /// The identifications in the library, once somebody has wanted them.
    known: Option<Known>,
    /// Of the last scan.
    ticket: Weak<()>,
    /// Verbs of which a retained request has been seen.
    warned: BTreeSet<String>,
}

impl Desk {
    pub fn new(settings: &Settings, library: Library) -> Desk {
        let bus_of = settings.devices.iter().map(|device| (device.name.clone(), device.bus));
        let buses = settings.buses.iter().map(|bus| (bus.name.clone(), bus.link.units_most()));
        Desk {
            topics: Topics::of(&settings.mqtt),
            bus_of: bus_of.collect(),
            buses: buses.collect(),
            library,
            known: None,
            ticket: Weak::new(),
            warned: BTreeSet::new(),
        }
    }

    /// Decides what is to be done with what somebody wants. `today` is only told.
    pub fn decide(&mut self, today: Date, errand: Errand) -> Decision {
        match errand {
            Errand::Set(command) => self.command(command),
            Errand::Get { device, point } => match self.bus_of(&device) {
                Some(bus) => Decision::Read { bus, device, point },
                None => {
                    let text = format!("a message for `{device}`, which is no device of this gateway");
                    Decision::Mention(text)
                }
            },
            // One that the broker has kept is ignored whatever its age.
            Errand::Request { verb, payload, retained: false, stale: Some(reason) } => {
                self.refuse(&verb, &payload, &reason)
            }
            Errand::Request { verb, payload, retained, stale: _ } => {
                self.take(today, &verb, &payload, retained)
            }
        }
    }

    /// A message on the topic of the request `verb`. `today` is only told.
    fn take(&mut self, today: Date, verb: &str, payload: &str, retained: bool) -> Decision {
        if retained {
            if payload.is_empty() || !self.warned.insert(verb.into()) {
                return Decision::Ignore;
            }
            let topic = self.topics.request(verb);
            return Decision::Warn(format!("a retained message on `{topic}` is ignored; delete it"));
        }
        let known = Verb::ALL.into_iter().find(|known| known.name() == verb);
        let transaction = transaction_of(payload);
        let request = match known {
            Some(verb) => self.read(today, verb, payload).map(|(bus, wish)| (bus, verb, wish)),
            None => {
                let names: Vec<&str> = Verb::ALL.into_iter().map(Verb::name).collect();
                Err(format!("`{verb}` is no request; {}", list_of_choices(verb, &names)))
            }
        };
        match request {
            Ok((bus, verb, wish)) => Decision::Ask(bus, Request { verb, transaction, wish }),
            Err(error) => {
                let error = Some(error.as_str());
                Decision::Answer(answer(&self.topics, verb, &transaction, Status::Error, Json::Null, error))
            }
        }
    }

    /// The answer to a request that is not read because it is too old, and why.
    fn refuse(&self, verb: &str, payload: &str, reason: &str) -> Decision {
        let transaction = transaction_of(payload);
        let error = format!("not obeyed: {reason}");
        Decision::Answer(answer(&self.topics, verb, &transaction, Status::Error, Json::Null, Some(&error)))
    }

    /// The number of the bus that this device is on.
    fn bus_of(&self, device: &str) -> Option<usize> {
        self.bus_of.get(device).copied()
    }

    /// A command for no device, or too long to be a value, is refused. What is retained is nobody's wish of now.
    fn command(&self, command: Command) -> Decision {
        let Command { device, point, payload, retained } = &command;
        let outcome = match (self.bus_of(device), Outcome::of_too_long(payload)) {
            (Some(bus), None) => return Decision::Obey(bus, command),
            _ if *retained => return Decision::Ignore,
            (Some(_), Some(too_long)) => too_long,
            (None, _) => command::Wish::parse(payload).ended(OutcomeKind::Refused, self.no_device(device)),
        };
        Decision::Answer(self.outcome(device, point, &outcome))
    }

    /// How a command has ended, for whoever gave it.
    pub fn outcome(&self, device: &str, point: &str, outcome: &Outcome) -> Message {
        let bus = self.bus_of(device).and_then(|bus| self.buses.get(bus));
        let own = self.topics.of_device(bus.map_or("", |(name, _)| name), device);
        Message::once(own.outcome(point), outcome.to_json())
    }

    /// The answer to a request for a bus that has no room for it.
    pub fn no_room(&self, request: &Request) -> Message {
        request.refusal(&self.topics, "too much waits for the bus")
    }

    fn no_device(&self, name: &str) -> String {
        let names: Vec<&str> = self.bus_of.keys().map(String::as_str).collect();
        format!("there is no device `{name}`; {}", list_of_choices(name, &names))
    }

    fn read(&mut self, today: Date, verb: Verb, payload: &str) -> Result<(usize, Wish), String> {
        let object = Object::parse(verb, payload)?;
        match verb {
            Verb::Read => {
                let (device, bus) = self.device(&object)?;
                let clears = object.flag("clears")?;
                Ok((bus, Wish::Read { device, span: object.span()?, clears }))
            }
            Verb::Write => {
                let (device, bus) = self.device(&object)?;
                let span = object.span()?;
                let words = words(span, object.required("value")?)?;
                Ok((bus, Wish::Write { device, span, words }))
            }
            Verb::Identify => self.device(&object).map(|(device, bus)| (bus, Wish::Identify { device })),
            Verb::Diagnostics => {
                self.device(&object).map(|(device, bus)| (bus, Wish::Diagnostics { device }))
            }
            Verb::Refresh => {
                let (device, bus) = self.device(&object)?;
                let point = object.text("point")?.map(str::to_string);
                Ok((bus, Wish::Refresh { device, point }))
            }
            Verb::Scan => {
                let bus = self.bus(object.text("bus")?.ok_or_else(|| object.missing("bus"))?)?;
                let (first, last) = self.units(bus, object.text("units")?)?;
                if self.ticket.strong_count() > 0 {
                    return Err("a scan is under way; there is one at a time".into());
                }
                let ticket = Arc::new(());
                self.ticket = Arc::downgrade(&ticket);
                Ok((bus, Wish::Scan(Scan { first, last, known: self.known(), ticket })))
            }
            Verb::Pause => {
                let bus = self.bus_or_device(&object)?;
                let text = object.text("for")?.ok_or_else(|| object.missing("for"))?;
                let time = <Duration as Scalar>::parse(text)?;
                if time > PAUSE_LONGEST {
                    return Err(format!("`{text}` is too long for a pause; expected at most `1h`"));
                }
                Ok((bus, Wish::Pause { time, until: today + time }))
            }
            Verb::Record => Ok((self.bus_or_device(&object)?, Wish::Record)),
        }
    }

    fn device(&self, object: &Object) -> Result<(String, usize), String> {
        let name = object.text("device")?.ok_or_else(|| object.missing("device"))?;
        match self.bus_of.get(name) {
            Some(bus) => Ok((name.to_string(), *bus)),
            None => Err(self.no_device(name)),
        }
    }

    fn bus(&self, name: &str) -> Result<usize, String> {
        self.buses.iter().position(|(bus, _)| bus == name).ok_or_else(|| {
            let names: Vec<&str> = self.buses.iter().map(|(name, _)| name.as_str()).collect();
            format!("there is no bus `{name}`; {}", list_of_choices(name, &names))
        })
    }

    /// The bus that is named, or that of the device that is.
    fn bus_or_device(&self, object: &Object) -> Result<usize, String> {
        match (object.text("bus")?, object.text("device")?) {
            (Some(bus), None) => self.bus(bus),
            (None, Some(_)) => Ok(self.device(object)?.1),
            (None, None) => Err(object.missing("bus")),
            (Some(_), Some(_)) => {
                Err("`bus` and `device` stand beside each other; leave one of them out".into())
            }
        }
    }

    /// `1..20` or `7`; without it all units of a line.
    fn units(&self, bus: usize, text: Option<&str>) -> Result<(u8, u8), String> {
        let Some(text) = text else { return Ok((1, UNIT_OF_LINE_MAX)) };
        units(text, self.buses[bus].1).map(RangeInclusive::into_inner)
    }

    fn known(&mut self) -> Known {
        let library = &self.library;
        self.known.get_or_insert_with(|| identity::known(library)).clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::configuration;

    fn desk() -> Desk {
        let text = "
buses: {basement: {serial: /dev/ttyS0}, plant: {tcp: '192.168.1.20:502'}}
devices:
  relays: {profile: metz-connect/mr-do4, bus: basement, unit: 18}
  boiler: {bus: plant, unit: 1, points: {flow: {at: input 0, poll: fast}}}
";
        let library = Library::shipped();
        let loaded = configuration::load("busker.yaml", text.as_bytes(), &library);
        Desk::new(&loaded.expect("a good configuration").0, library)
    }

    #[track_caller]
    fn check_asks(verb: &str, payload: &str, bus: usize, wish: &str) {
        match desk().take(Date(0), verb, payload, false) {
            Decision::Ask(found, request) => {
                assert_eq!((found, format!("{:?}", request.wish).as_str()), (bus, wish));
            }
            other => panic!("{other:?}"),
        }
    }

    #[track_caller]
    fn check_error(verb: &str, payload: &str, expected: &str) {
        let Decision::Answer(message) = desk().take(Date(0), verb, payload, false) else {
            panic!("`{payload}` is taken")
        };
        assert_eq!(message.topic, format!("busker/bridge/response/{verb}"));
        assert!(!message.retain);
        let answer: Json = serde_json::from_str(&message.payload).expect("JSON");
        assert_eq!(answer["status"], "error");
        assert_eq!(answer["error"], expected, "{payload}");
    }

    #[test]
    fn a_request_is_for_the_bus_of_its_device() {
        check_asks("identify", r#"{"device":"relays"}"#, 0, r#"Identify { device: "relays" }"#);
        check_asks("identify", r#"{"device":"boiler"}"#, 1, r#"Identify { device: "boiler" }"#);
        check_asks(
            "pause",
            r#"{"device":"boiler","for":"10m"}"#,
            1,
            "Pause { time: 600s, until: Date(600) }",
        );
        check_asks("record", r#"{"bus":"plant"}"#, 1, "Record");
        check_asks("record", r#"{"device":"relays"}"#, 0, "Record");
        check_asks("pause", r#"{"bus":"basement","for":"0s"}"#, 0, "Pause { time: 0ns, until: Date(0) }");
        let found = desk().take(Date(0), "scan", r#"{"bus":"plant","units":"3..255"}"#, false);
        let Decision::Ask(1, Request { wish: Wish::Scan(scan), .. }) = found else { panic!("{found:?}") };
        assert_eq!((scan.first, scan.last), (3, 255));
        assert!(scan.known.iter().any(|(id, _)| id == "metz-connect/mr-do4"));
    }

    #[test]
    fn a_command_for_no_device_is_refused_and_so_is_a_book() {
        let decide = |device: &str, payload: &str, retained| {
            let (device, point, payload) = (device.into(), "output_1".into(), payload.into());
            let command = Command { device, point, payload, retained };
            (desk().decide(Date(0), Errand::Set(command.clone())), command)
        };
        for retained in [false, true] {
            let (decision, command) = decide("relays", "ON", retained);
            assert_eq!(decision, Decision::Obey(0, command), "the bus says what it thinks of a retained one");
        }
        for (device, wanted, expected) in [
            ("relay", "ON", "there is no device `relay`; did you mean `relays`?"),
            ("relays", &"7".repeat(5000), "5000 bytes are no value; expected at most 1024"),
        ] {
            let (Decision::Answer(message), _) = decide(device, wanted, false) else {
                panic!("`{device}` is a device")
            };
            assert_eq!(message.topic, format!("busker/{device}/output_1/outcome"));
            assert!(message.payload.contains("refused") && message.payload.contains(expected), "{message:?}");
            assert_eq!(decide(device, wanted, true).0, Decision::Ignore);
        }
    }

    #[test]
    fn a_wrong_request_is_answered_with_what_would_be_right() {
        let like = r#"expected an object like `{"device":"heating_relays","transaction":"1"}`"#;
        check_error(
            "identify",
            "{device}",
            &format!("this is no JSON: it is wrong at line 1, column 2; {like}"),
        );
        check_error("identify", r#"{"device":"#, &format!("this is no JSON: it ends too early; {like}"));
        check_error("identify", "", &format!("the message is empty; {like}"));
        check_error(
            "identify",
            r#"{"device":"relays","device":"boiler"}"#,
            "`device` stands there more than once; remove all of them but one",
        );
        check_error("identify", "7", &format!("this is no JSON object; {like}"));
        check_error("identify", "{}", &format!("`device` is missing; {like}"));
        check_error("identify", &" ".repeat(20_000), &format!("20000 bytes are no request; {like}"));
        check_error(
            "identify",
            r#"{"device":7}"#,
            r#"`device` is `7`; expected a text, as in `{"device":"heating_relays","transaction":"1"}`"#,
        );
        check_error(
            "identify",
            r#"{"devise":"relays"}"#,
            "`identify` knows no `devise`; did you mean `device`?",
        );
        check_error(
            "identify",
            r#"{"device":"relay"}"#,
            "there is no device `relay`; did you mean `relays`?",
        );
        check_error("scan", r#"{"bus":"roof"}"#, "there is no bus `roof`; expected `basement` or `plant`");
        check_error(
            "scan",
            r#"{"bus":"basement","units":"1..255"}"#,
            "`1..255` names no units of this bus; expected them as in `1..247` or `7`",
        );
        check_error("reed", "{}", "`reed` is no request; did you mean `read`?");
        check_error(
            "pause",
            r#"{"bus":"basement","for":"61m"}"#,
            "`61m` is too long for a pause; expected at most `1h`",
        );
        check_error(
            "write",
            r#"{"device":"relays","at":"holding 0..1","value":7}"#,
            "`holding 0..1` takes 2 values, one for each address; found 1",
        );
        check_error(
            "write",
            r#"{"device":"relays","at":"holding 0","value":[7,8]}"#,
            "`holding 0` takes one value; found 2",
        );
        check_error(
            "write",
            r#"{"device":"relays","at":"holding 0","value":7,"value":8}"#,
            "`value` stands there more than once; remove all of them but one",
        );
        check_error(
            "write",
            r#"{"device":"relays","at":"holding 0","value":65536}"#,
            "`65536` is no register's value; expected a whole number from -32768 to 65535",
        );
        check_error(
            "read",
            r#"{"device":"relays","at":"holding","clears":true}"#,
            "`holding` has no address behind it; expected one, as in `holding 300..399`",
        );
    }

    #[test]
    fn the_transaction_comes_back_even_with_an_error() {
        let long = "18446744073709551616.000000000000000000001";
        for transaction in [r#""x""#, "7", "null", r#"{"a":[1]}"#, long, r#"{"b": 1, "a": 1E+400}"#] {
            let payload = format!(r#"{{"transaction":{transaction}}}"#);
            let Decision::Answer(message) = desk().take(Date(0), "read", &payload, false) else {
                panic!("nothing was asked for")
            };
            assert!(message.payload.starts_with(&payload[..payload.len() - 1]), "{}", message.payload);
        }
    }

    #[test]
    fn there_is_one_scan_at_a_time() {
        let mut desk = desk();
        let mut ask = |bus: &str| desk.take(Date(0), "scan", &format!(r#"{{"bus":"{bus}"}}"#), false);
        let first = ask("basement");
        assert!(matches!(first, Decision::Ask(0, _)), "{first:?}");
        let second = ask("plant");
        assert!(
            matches!(&second, Decision::Answer(message) if message.payload.contains("one at a time")),
            "{second:?}"
        );
        drop(first);
        let third = ask("plant");
        assert!(matches!(third, Decision::Ask(1, _)), "{third:?}");
    }

    #[test]
    fn a_request_that_was_held_up_is_answered_and_not_obeyed() {
        let request = |retained| Errand::Request {
            verb: "write".into(),
            payload: r#"{"transaction":"7"}"#.into(),
            retained,
            stale: Some("it may be 30 s old".into()),
        };
        let decision = desk().decide(Date(0), request(false));
        let Decision::Answer(message) = decision else { panic!("{decision:?}") };
        let expected =
            r#"{"transaction":"7","status":"error","data":null,"error":"not obeyed: it may be 30 s old"}"#;
        assert_eq!(
            (message.topic.as_str(), message.payload.as_str()),
            ("busker/bridge/response/write", expected)
        );
        let decision = desk().decide(Date(0), request(true));
        assert!(matches!(decision, Decision::Warn(_)), "{decision:?}");
    }

    #[test]
    fn a_point_is_read_by_the_bus_of_its_device() {
        let get = |device: &str| Errand::Get { device: device.into(), point: "flow".into() };
        let expected = Decision::Read { bus: 1, device: "boiler".into(), point: "flow".into() };
        assert_eq!(desk().decide(Date(0), get("boiler")), expected);
        let text = "a message for `kettle`, which is no device of this gateway";
        assert_eq!(desk().decide(Date(0), get("kettle")), Decision::Mention(text.into()));
    }

    #[test]
    fn a_retained_request_is_ignored_and_that_is_said_once() {
        let mut desk = desk();
        let payload = r#"{"device":"relays"}"#;
        let warning = "a retained message on `busker/bridge/request/identify` is ignored; delete it";
        assert_eq!(desk.take(Date(0), "identify", payload, true), Decision::Warn(warning.into()));
        assert_eq!(desk.take(Date(0), "identify", payload, true), Decision::Ignore);
    }
}
