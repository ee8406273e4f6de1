//! What the outbox hears from the broker, and what people are told of what it notices by that: lines for the log.

use super::Outbox;
use super::arriving::NotArriving;
use super::rivals::RivalNews;
use crate::engine::health::Severity;
use crate::engine::time::Time;
use crate::engine::topics::{Message, Topics};

/// What a message from the broker is to the outbox.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Heard {
    /// Somebody has told this gateway's state, itself perhaps.
    OwnState,
    /// Somebody may be below a base topic that this gateway had.
    FormerState,
    HomeAssistantStarted,
    /// An announcement of an earlier run, of this one, or of somebody else: told just now, or kept by the broker.
    Announcement {
        is_news: bool,
    },
    /// A command that is too old to be obeyed, why, and what whoever gave it is told.
    Expired {
        reason: String,
        outcome: Message,
    },
}

impl Outbox {
    /// A message with this topic and payload has come, and is `heard`. Returns lines for the log.
    pub fn hear(&mut self, heard: Heard, topic: &str, payload: &str, now: Time) -> Vec<(Severity, String)> {
        let mut lines = Vec::new();
        let mut say = |severity, text| lines.push((severity, text));
        match heard {
            Heard::OwnState => {
                if self.heard_state(payload, now) {
                    say(Severity::Warning, of_quarrel(payload, &self.topics));
                }
            }
            Heard::FormerState => {
                if let Some(base) = self.heard_former(topic, payload) {
                    say(Severity::Warning, of_somebody_below(&base));
                }
            }
            Heard::HomeAssistantStarted => {
                say(Severity::Info, "Home Assistant is there: it is told of everything again".into());
                self.home_assistant_started(now);
            }
            Heard::Announcement { is_news: true } => self.heard_announcement(topic, payload, now),
            Heard::Announcement { is_news: false } => self.found(topic, payload),
            Heard::Expired { reason, outcome } => {
                say(Severity::Warning, format!("`{topic}` is not obeyed: {reason}"));
                self.push(outcome);
            }
        }
        lines.append(&mut self.take_lines());
        lines
    }

    /// The connection was lost, or could not be made. If the broker has closed it, `suspect` is what it may have done
    /// that for: the topic and the bytes of the longest message that it had not confirmed. Returns a line for the log
    /// when it is found to be too long. A broker that takes no message of that length has no other word for it than
    /// to close the connection.
    pub fn connection_ended(&mut self, suspect: Option<(String, usize)>) -> Option<(Severity, String)> {
        let Some((topic, bytes)) = suspect else {
            self.lost();
            return None;
        };
        self.closed_on(&topic, bytes).then(|| (Severity::Warning, of_too_long(&topic, bytes)))
    }

    /// What was noticed and nobody has been told of yet, as lines for the log.
    pub fn take_lines(&mut self) -> Vec<(Severity, String)> {
        let rivals = self.take_news_of_rivals();
        let rivals = rivals.iter().map(|news| of_rival(news, self.topics.base()));
        let mut lines: Vec<String> = rivals.collect();
        lines.extend(self.take_news_of_arriving().map(|news| of_silence(&news)));
        lines.into_iter().map(|line| (Severity::Warning, line)).collect()
    }
}

fn of_quarrel(payload: &str, own: &Topics) -> String {
    format!(
        "somebody else tells `{}` on `{}` again and again, and is put right some times a minute: has another gateway \
         `base_topic: {}`?",
        payload.chars().take(20).collect::<String>(),
        own.bridge_state(),
        own.base()
    )
}

fn of_somebody_below(base: &str) -> String {
    format!("what this gateway told below `{base}` before is not taken back: somebody else is online there")
}

fn of_too_long(topic: &str, bytes: usize) -> String {
    format!(
        "the broker closes the connection whenever it is sent what belongs on `{topic}`, {bytes} bytes: most likely it \
         takes no message that long (`max_packet_size` of mosquitto). It is not sent again; the topics that miss \
         something stand under `kept_back` in `/health`"
    )
}

fn of_rival(news: &RivalNews, own: &str) -> String {
    let RivalNews { topic, base_topic, stays } = news;
    let found = format!(
        "the gateway with `base_topic: {base_topic}` has announced a device to Home Assistant on `{topic}`, where this \
         gateway, with `base_topic: {own}`, announces one of its own: base topic and device name join to the same \
         identity"
    );
    match stays {
        true => format!(
            "{found}. The other one's stays, and this gateway announces nothing there: give the device, or one of the \
             gateways, another name. If the other gateway is no more, empty the topic (`mosquitto_pub -r -n -t \
             {topic}`)"
        ),
        false => format!("{found}; give one of the devices, or one of the gateways, another name"),
    }
}

fn of_silence(news: &NotArriving) -> String {
    let first = news.topics.first().map(String::as_str).unwrap_or_default();
    let more = match news.topics.len() {
        0 | 1 => String::new(),
        many => format!(" and on {} more (`not_arriving` in `/health`)", many - 1),
    };
    let found =
        format!("the broker confirms what this gateway tells on `{first}`{more}, and does not hand it on");
    match news.too_long {
        Some(bytes) => format!(
            "{found}: most likely it passes on no message of {bytes} bytes (`message_size_limit` of mosquitto), since \
             all that is shorter arrives"
        ),
        None => format!(
            "{found}: most likely its rules do not let this user write there, or not read there. This gateway needs \
             both (`topic readwrite …` in an `acl_file` of mosquitto), or no command reaches it"
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::outbox;
    use super::*;

    #[test]
    fn what_people_should_know_of_what_was_heard_is_said() {
        let state = "busker/bridge/state";
        let mut outbox = outbox();
        outbox.connected();
        let mut hear = |heard, topic: &str, payload: &str| {
            let lines = outbox.hear(heard, topic, payload, Time::from_millis(7));
            lines.into_iter().map(|(_, line)| line).collect::<Vec<_>>().join("; ")
        };
        assert_eq!(hear(Heard::OwnState, state, "online"), "");
        assert_eq!(hear(Heard::FormerState, "old/bridge/state", "online"), "", "nothing was told there");
        assert!(hear(Heard::HomeAssistantStarted, "", "").starts_with("Home Assistant is there"));
        let outcome = Message::once("busker/boiler/flow/outcome", "expired");
        let line =
            hear(Heard::Expired { reason: "it is old".into(), outcome }, "busker/boiler/flow/set", "21");
        assert_eq!(line, "`busker/boiler/flow/set` is not obeyed: it is old");
    }

    #[test]
    fn a_connection_that_ends_with_the_same_long_message_again_and_again_is_told_with_its_topic() {
        let mut outbox = outbox();
        let mut ended = |bytes| outbox.connection_ended(Some(("busker/boiler/info".into(), bytes)));
        assert_eq!((0..20).find_map(|_| ended(10)), None, "that is not long");
        let (severity, line) = (0..20).find_map(|_| ended(9000)).expect("it is found");
        assert_eq!(severity, Severity::Warning);
        assert!(line.contains("`busker/boiler/info`, 9000 bytes"), "{line}");
        assert_eq!(outbox.connection_ended(None), None);
    }

    #[test]
    fn a_rival_is_told_with_both_base_topics_and_what_to_do() {
        for (stays, remedy) in
            [(true, "mosquitto_pub -r -n -t homeassistant/device/house_a_b/config"), (false, "another name")]
        {
            let topic = "homeassistant/device/house_a_b/config".to_string();
            let told = of_rival(&RivalNews { topic, base_topic: "house_a".into(), stays }, "house");
            for part in ["`base_topic: house_a`", "`base_topic: house`", "give ", remedy] {
                assert!(told.contains(part), "{told}");
            }
        }
    }

    #[test]
    fn what_does_not_arrive_is_told_with_its_likely_reason() {
        let told = |count: usize, too_long| {
            of_silence(&NotArriving { topics: vec!["house/bridge/state".into(); count], too_long })
        };
        assert!(told(1, None).contains("tells on `house/bridge/state`, and does not"), "{}", told(1, None));
        assert!(told(3, None).contains("`house/bridge/state` and on 2 more"), "{}", told(3, None));
        assert!(told(1, None).contains("topic readwrite"));
        assert!(
            told(1, Some(9000)).contains("9000 bytes") && told(1, Some(9000)).contains("message_size_limit")
        );
    }
}
