//! What a message from the broker is to this gateway, and which of them it wants to have.
//!
//! A message is sorted once, when it arrives: what somebody wants of a bus goes straight there ([`Errand`]), and what
//! the outbox has to know follows in its own time ([`Heard`]).

mod subscriptions;

use crate::engine::command::{OutcomeKind, Wish};
use crate::engine::outbox::Heard;
use crate::engine::settings::Settings;
use crate::engine::time::Duration;
use crate::engine::topics::{self, Incoming, Message, ONLINE, Topics};

pub use subscriptions::Subscriptions;

/// A message that the broker has handed on.
#[derive(Clone, Copy, Debug)]
pub struct Mail<'m> {
    pub topic: &'m str,
    pub payload: &'m str,
    /// It was told before anybody listened, and kept.
    pub retained: bool,
    /// The broker has sent it before, on an earlier connection.
    pub repeated: bool,
    /// How old it may be, if it was held up on its way.
    pub stale_for: Option<Duration>,
}

/// What a message is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Arrival {
    Errand(Errand),
    Heard(Heard),
    /// It is of no interest, or not meant for now.
    Nothing,
}

/// What somebody wants of a bus or of a device on it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Errand {
    Set(Command),
    /// To read a point now.
    Get {
        device: String,
        point: String,
    },
    /// A request with a verb and JSON.
    Request {
        verb: String,
        payload: String,
        retained: bool,
        /// Why it would be too old to be obeyed.
        stale: Option<String>,
    },
}

/// A message on a `set` topic, as it came.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Command {
    pub device: String,
    pub point: String,
    pub payload: String,
    /// A replayed one; it is never obeyed.
    pub retained: bool,
}

/// Where messages from the broker are sorted.
#[derive(Clone, Debug)]
pub struct Arrivals {
    topics: Topics,
    former_states: Vec<String>,
    status_topic: String,
    filters: Vec<String>,
    /// What was listened to before on the same connection: it may be on its way still.
    before: Option<Box<Arrivals>>,
}

impl Arrivals {
    /// `former_states`: where it is told whether somebody is below a base topic that this gateway had.
    pub fn new(settings: &Settings, former_states: Vec<String>) -> Arrivals {
        let (topics, home_assistant) = (Topics::of(&settings.mqtt), &settings.home_assistant);
        let mut filters = topics.subscriptions();
        filters.extend(former_states.iter().cloned());
        // Also without discovery: what was announced with it is forgotten when Home Assistant has heard that it is gone.
        filters.push(home_assistant.status_topic.clone());
        // What an earlier run announced, to take away what is gone; all of it without discovery.
        filters.push(topics::discovery(&home_assistant.prefix, "+"));
        let status_topic = home_assistant.status_topic.clone();
        Arrivals { topics, former_states, status_topic, filters, before: None }
    }

    /// On a new connection nothing is on its way.
    pub fn begin_anew(&mut self) {
        self.before = None;
    }

    /// `now` is listened to from now on, on the same connection.
    pub fn listen_to(&mut self, now: Arrivals) {
        let before = std::mem::replace(self, now);
        self.before = Some(Box::new(Arrivals { before: None, ..before }));
    }

    /// What to subscribe to, so that everything arrives that [`Arrivals::sort`] knows.
    pub fn filters(&self) -> &[String] {
        &self.filters
    }

    /// What this message is.
    pub fn sort(&self, mail: &Mail<'_>) -> Arrival {
        match (self.sort_present(mail), &self.before) {
            (Arrival::Nothing, Some(before)) => before.sort_present(mail),
            (arrival, _) => arrival,
        }
    }

    fn sort_present(&self, mail: &Mail<'_>) -> Arrival {
        let is_news = !mail.retained;
        if mail.topic == self.topics.bridge_state() {
            // What the broker has kept is followed by this gateway's own word.
            return Arrival::Heard(Heard::OwnState).only_if(is_news);
        }
        if self.former_states.iter().any(|state| state == mail.topic) {
            return Arrival::Heard(Heard::FormerState);
        }
        if mail.topic == self.status_topic {
            // Who was there before this connection was told everything when it was made.
            return Arrival::Heard(Heard::HomeAssistantStarted).only_if(is_news && mail.payload == ONLINE);
        }
        if mail.topic.ends_with("/config") {
            return Arrival::Heard(Heard::Announcement { is_news });
        }
        let (payload, retained) = (mail.payload, mail.retained);
        match self.topics.parse(mail.topic) {
            Some(Incoming::Set { device, point }) => match mail.too_old().filter(|_| is_news) {
                Some(reason) => Arrival::Heard(expired(mail, reason)),
                None => Arrival::Errand(Errand::Set(Command {
                    device: device.into(),
                    point: point.into(),
                    payload: payload.into(),
                    retained,
                })),
            },
            Some(Incoming::Get { device, point }) => {
                Arrival::Errand(Errand::Get { device: device.into(), point: point.into() }).only_if(is_news)
            }
            Some(Incoming::Request { verb }) => Arrival::Errand(Errand::Request {
                verb: verb.into(),
                payload: payload.into(),
                retained,
                stale: mail.too_old(),
            }),
            None => Arrival::Nothing,
        }
    }
}

impl Arrival {
    fn only_if(self, condition: bool) -> Arrival {
        if condition { self } else { Arrival::Nothing }
    }
}

/// A command that is too old to be obeyed, with its outcome for whoever gave it.
fn expired(mail: &Mail<'_>, reason: String) -> Heard {
    let outcome = Wish::parse(mail.payload).ended(OutcomeKind::Expired, &reason);
    Heard::Expired { reason, outcome: Message::once(topics::outcome_of(mail.topic), outcome.to_json()) }
}

impl Mail<'_> {
    fn too_old(&self) -> Option<String> {
        match (self.repeated, self.stale_for) {
            // A broker repeats only what it has kept from an earlier connection.
            (true, _) => Some("the broker has kept it from an earlier connection".into()),
            (false, Some(age)) => {
                Some(format!("the broker or the way to it was stalled; it may be {} s old", age.as_secs()))
            }
            (false, None) => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::configuration;
    use crate::engine::profile::Library;

    fn arrivals(more: &str) -> Arrivals {
        let text =
            format!("mqtt: {{url: 'mqtt://localhost'}}\nbuses: {{cellar: {{tcp: 'host:502'}}}}\n{more}");
        let loaded = configuration::load("busker.yaml", text.as_bytes(), &Library::shipped());
        let settings = loaded.unwrap_or_else(|faults| panic!("{faults:?}")).0;
        Arrivals::new(&settings, vec!["house/bridge/state".into()])
    }

    #[test]
    fn it_is_listened_to_commands_requests_states_and_announcements() {
        let all = [
            "busker/+/+/set",
            "busker/+/+/get",
            "busker/bridge/request/+",
            "busker/bridge/state",
            "house/bridge/state",
            "homeassistant/status",
            "homeassistant/device/+/config",
        ];
        assert_eq!(arrivals("").filters(), all);
        assert_eq!(arrivals("home_assistant: {discovery: false}\n").filters(), all);
    }

    #[test]
    fn what_was_listened_to_before_is_heard_until_the_connection_is_another() {
        let mut arrivals = arrivals("home_assistant: {status_topic: ha/status}\n");
        let started = |arrivals: &Arrivals, topic: &str| {
            let mail = Mail { topic, payload: ONLINE, retained: false, repeated: false, stale_for: None };
            arrivals.sort(&mail) == Arrival::Heard(Heard::HomeAssistantStarted)
        };
        let both =
            |arrivals: &Arrivals| ["ha/status", "homeassistant/status"].map(|topic| started(arrivals, topic));
        assert_eq!(both(&arrivals), [true, false]);
        arrivals.listen_to(self::arrivals(""));
        assert_eq!(both(&arrivals), [true, true]);
        arrivals.begin_anew();
        assert_eq!(both(&arrivals), [false, true]);
    }

    fn set(payload: &str, retained: bool) -> Arrival {
        let (device, point, payload) = ("boiler".into(), "flow".into(), payload.into());
        Arrival::Errand(Errand::Set(Command { device, point, payload, retained }))
    }

    fn get() -> Arrival {
        Arrival::Errand(Errand::Get { device: "boiler".into(), point: "flow".into() })
    }

    fn request(payload: &str, retained: bool, stale: Option<&str>) -> Arrival {
        let (verb, payload, stale) = ("read".into(), payload.into(), stale.map(str::to_string));
        Arrival::Errand(Errand::Request { verb, payload, retained, stale })
    }

    /// `news` is what it is when it is told just now, `retained` when the broker has kept it.
    #[track_caller]
    fn check(topic: &str, payload: &str, news: &Arrival, retained: &Arrival) {
        for (is_retained, expected) in [(false, news), (true, retained)] {
            let mail = Mail { topic, payload, retained: is_retained, repeated: false, stale_for: None };
            assert_eq!(arrivals("").sort(&mail), *expected, "{mail:?}");
        }
    }

    #[test]
    fn what_is_kept_is_no_wish_of_now_and_what_is_told_now_is_no_memory() {
        let nothing = &Arrival::Nothing;
        check("busker/bridge/state", "offline", &Arrival::Heard(Heard::OwnState), nothing);
        let former = &Arrival::Heard(Heard::FormerState);
        check("house/bridge/state", "online", former, former);
        check("homeassistant/status", "online", &Arrival::Heard(Heard::HomeAssistantStarted), nothing);
        check("homeassistant/status", "offline", nothing, nothing);
        let announced = |is_news| Arrival::Heard(Heard::Announcement { is_news });
        check("homeassistant/device/busker_boiler/config", "{}", &announced(true), &announced(false));
        // The bus says so of a retained one.
        check("busker/boiler/flow/set", "21", &set("21", false), &set("21", true));
        check("busker/boiler/flow/get", "", &get(), nothing);
        let of_request = |retained| request("{}", retained, None);
        check("busker/bridge/request/read", "{}", &of_request(false), &of_request(true));
        check("busker/boiler/flow", "21", nothing, nothing);
        check("elsewhere", "", nothing, nothing);
    }

    #[test]
    fn what_was_held_up_on_its_way_is_told_with_its_reason() {
        let stalled = "the broker or the way to it was stalled; it may be 12 s old";
        let kept = "the broker has kept it from an earlier connection";
        let age = Some(Duration::from_millis(12_900));
        for (repeated, stale_for, expected) in [(false, age, stalled), (true, None, kept), (true, age, kept)]
        {
            let mail = |topic| Mail { topic, payload: "21", retained: false, repeated, stale_for };
            let arrivals = arrivals("");
            let arrival = arrivals.sort(&mail("busker/boiler/flow/set"));
            let Arrival::Heard(Heard::Expired { reason, outcome }) = arrival else { panic!("it is obeyed") };
            assert_eq!(reason, expected);
            assert_eq!((outcome.topic.as_str(), outcome.retain), ("busker/boiler/flow/outcome", false));
            assert!(outcome.payload.contains("expired") && outcome.payload.contains(expected));
            let asked = arrivals.sort(&mail("busker/bridge/request/read"));
            assert_eq!(asked, request("21", false, Some(expected)));
            // A retained one is refused for that, whenever it comes.
            let retained = Mail { retained: true, ..mail("busker/boiler/flow/set") };
            assert_eq!(arrivals.sort(&retained), set("21", true));
            // Reading is never wrong.
            assert_eq!(arrivals.sort(&mail("busker/boiler/flow/get")), get());
        }
    }
}
