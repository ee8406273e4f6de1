//! What the log says of what the outbox has noticed: another gateway in this one's place, and what the broker does not
//! hand on.

use crate::engine::outbox::{NotArriving, Outbox, RivalNews};
use crate::engine::topics::Topics;

/// Logs what the outbox has noticed since the last time.
pub(super) fn tell(outbox: &mut Outbox, topics: &Topics) {
    for news in outbox.take_news_of_rivals() {
        tracing::warn!("{}", of_rival(&news, topics.base()));
    }
    if let Some(news) = outbox.take_news_of_arriving() {
        tracing::warn!("{}", of_silence(&news));
    }
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
             both (`topic readwrite …` in an `acl_file` of mosquitto)"
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
