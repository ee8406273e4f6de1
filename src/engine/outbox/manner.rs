//! In which way a message is told: values as the owner wants it, all else so that it arrives and stays.

use super::Outbox;
use crate::engine::settings::Manner;
use crate::engine::topics::{Kind, Message};

impl Outbox {
    /// The same with values told in this manner. Where they are not retained, what the broker keeps of an
    /// earlier run is taken back before the first one: it would stand there for ever.
    pub fn with_values(self, values: Manner) -> Outbox {
        Outbox { values, ..self }
    }

    /// How a message of [`Outbox::next_message`] is told.
    pub fn manner(&self, message: &Message) -> Manner {
        let is_removal = message.retain && message.payload.is_empty();
        match self.topics.kind(&message.topic) {
            // A broker keeps messages in order only within one quality: a value must not overtake the removal
            // of what the broker kept. It is lost if the connection is, at this moment.
            Kind::Value if is_removal && self.retained.contains_key(&*message.topic) => {
                Manner { retain: true, ..self.values }
            }
            Kind::Value if !is_removal => {
                Manner { retain: message.retain && self.values.retain, ..self.values }
            }
            _ => Manner { confirmed: true, retain: message.retain },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::time::Time;
    use crate::engine::topics::Topics;

    const LATER: Time = Time::from_millis(1_000_000);

    fn outbox(confirmed: bool, retain: bool) -> Outbox {
        let outbox = Outbox::new(Topics::new("busker"), "homeassistant", ["busker_boiler".to_string()]);
        outbox.with_values(Manner { confirmed, retain })
    }

    /// All that is sent: topic, payload, quality of service, `r` where it is retained.
    fn sent(outbox: &mut Outbox) -> Vec<String> {
        let mut all = Vec::new();
        while let Some(message) = outbox.next_message(LATER) {
            let Manner { confirmed, retain } = outbox.manner(&message);
            let (qos, kept) = (i32::from(confirmed), if retain { " r" } else { "" });
            all.push(format!("{} `{}` {qos}{kept}", message.topic, message.payload));
        }
        all
    }

    fn tell(outbox: &mut Outbox) {
        outbox.push(Message::retained("busker/boiler/flow", "21.5"));
        outbox.push(Message::retained("busker/boiler", "{}"));
        outbox.push(Message::once("busker/boiler/door", "{\"event_type\":\"opened\"}"));
        outbox.push(Message::once("busker/boiler/flow/outcome", "{}"));
        for topic in [
            "busker/boiler/availability",
            "busker/boiler/info",
            "busker/bridge/health",
            "homeassistant/device/busker_boiler/config",
        ] {
            outbox.push(Message::retained(topic, "x"));
        }
    }

    /// What is always told so.
    const ALWAYS: [&str; 5] = [
        "busker/boiler/flow/outcome `{}` 1",
        "busker/boiler/availability `x` 1 r",
        "busker/boiler/info `x` 1 r",
        "busker/bridge/health `x` 1 r",
        "homeassistant/device/busker_boiler/config `x` 1 r",
    ];

    #[track_caller]
    fn check(confirmed: bool, retain: bool, values: &[&str]) {
        let mut outbox = outbox(confirmed, retain);
        tell(&mut outbox);
        let is_always = |sent: &String| ALWAYS.contains(&sent.as_str());
        let (always, of_values): (Vec<String>, Vec<String>) =
            sent(&mut outbox).into_iter().partition(is_always);
        assert_eq!(of_values, values);
        assert_eq!(always.len(), ALWAYS.len(), "{always:?}");
    }

    #[test]
    fn values_are_told_as_it_is_wanted_and_all_else_so_that_it_arrives_and_stays() {
        let event = "busker/boiler/door `{\"event_type\":\"opened\"}`";
        check(
            true,
            true,
            &["busker/boiler/flow `21.5` 1 r", "busker/boiler `{}` 1 r", &format!("{event} 1")],
        );
        check(
            false,
            true,
            &["busker/boiler/flow `21.5` 0 r", "busker/boiler `{}` 0 r", &format!("{event} 0")],
        );
        check(
            true,
            false,
            &[
                "busker/boiler/flow `` 1 r",
                "busker/boiler/flow `21.5` 1",
                "busker/boiler `` 1 r",
                "busker/boiler `{}` 1",
                &format!("{event} 1"),
            ],
        );
        check(
            false,
            false,
            &[
                "busker/boiler/flow `` 0 r",
                "busker/boiler/flow `21.5` 0",
                "busker/boiler `` 0 r",
                "busker/boiler `{}` 0",
                &format!("{event} 0"),
            ],
        );
    }

    #[test]
    fn what_is_not_retained_is_told_again_to_a_broker_that_comes_back_and_to_home_assistant() {
        let mut outbox = outbox(true, false);
        outbox.push(Message::retained("busker/boiler/flow", "21.5"));
        assert_eq!(sent(&mut outbox).len(), 2);
        let again = ["busker/boiler/flow `21.5` 1", "busker/bridge/state `online` 1 r"];
        outbox.connected();
        assert_eq!(sent(&mut outbox), again);
        outbox.home_assistant_started(LATER);
        outbox.wake(outbox.wake_at().expect("values follow"));
        assert_eq!(sent(&mut outbox), again);
        // The library gives back what it has not sent: that waits here already.
        outbox.give_back(vec![Message::once("busker/boiler/flow", "21.4")]);
        assert_eq!(sent(&mut outbox), [""; 0]);
    }

    #[test]
    fn what_is_not_retained_is_told_again_when_home_assistant_has_read_an_announcement() {
        let mut outbox = outbox(true, false);
        outbox.push(Message::retained("busker/boiler/flow", "21.5"));
        outbox.push(Message::retained("homeassistant/device/busker_boiler/config", "x"));
        assert_eq!(sent(&mut outbox).len(), 3);
        for _ in 0..2 {
            outbox.wake(outbox.wake_at().expect("values follow"));
            assert_eq!(sent(&mut outbox), ["busker/boiler/flow `21.5` 1"]);
        }
        assert_eq!(outbox.wake_at(), None);
    }

    #[test]
    fn a_removal_that_could_not_be_handed_over_comes_again() {
        let mut outbox = outbox(true, false);
        outbox.push(Message::retained("busker/boiler/flow", "21.5"));
        let removal = outbox.next_message(LATER).expect("it comes first");
        outbox.put_back(removal);
        assert_eq!(sent(&mut outbox), ["busker/boiler/flow `` 1 r", "busker/boiler/flow `21.5` 1"]);
    }
}
