//! Messages that are too long for the broker. MQTT 3.1.1 has no words for that: a broker with a limit closes the
//! connection, and since everything is sent anew after a reconnect, the announcement of one large device would keep
//! the whole gateway away for ever. So what was on its way when the broker closed the connection is remembered; the
//! longest of it is sent last after the next reconnect, when everything else is there. If the connection ends with
//! it once more, it is not sent again. If the next connection holds although everything was sent, it was another
//! reason that ended the one before.

use super::Outbox;
use crate::engine::time::{Duration, Time};

/// No broker has a limit below that.
const LONG: usize = 1024;

/// So often in a row the connection ends with the same message; less often if a limit is known already.
const TIMES: u32 = 3;
const TIMES_MORE: u32 = 2;

/// A broker that closes the connection for a message does it at once.
const CLOSES_WITHIN: Duration = Duration::from_secs(10);

#[derive(Clone, Debug, Default)]
pub(super) struct TooLong {
    suspect: Option<Suspect>,
    /// A payload of so many bytes is too long.
    limit: Option<usize>,
    /// If the connection still holds then, the suspect was none.
    acquitted_at: Option<Time>,
}

/// The longest message that was on its way when the connection ended.
#[derive(Clone, Debug)]
struct Suspect {
    topic: String,
    times: u32,
}

impl TooLong {
    /// Whether a payload of so many bytes would end the connection.
    pub(super) fn is(&self, bytes: usize) -> bool {
        self.limit.is_some_and(|limit| bytes >= limit)
    }

    /// Whether what stands on this topic is sent behind everything else.
    pub(super) fn is_doubted(&self, topic: &str) -> bool {
        let suspect = self.suspect.as_ref().filter(|suspect| suspect.topic == topic);
        suspect.is_some_and(|suspect| suspect.times + 1 >= self.times())
    }

    pub(super) fn due(&self) -> Option<Time> {
        self.acquitted_at
    }

    /// There is no connection that would hold.
    pub(super) fn wait(&mut self) {
        self.acquitted_at = None;
    }

    fn times(&self) -> u32 {
        if self.limit.is_some() { TIMES_MORE } else { TIMES }
    }
}

/// Whether a message of so many bytes that was on its way may be why the broker has closed the connection.
pub fn may_be_too_long(bytes: usize) -> bool {
    bytes >= LONG
}

impl Outbox {
    /// The broker has closed the connection, and had not confirmed a message of so many bytes on this topic, the
    /// longest of all. Whether it is found to be too long with that.
    pub(super) fn closed_on(&mut self, topic: &str, bytes: usize) -> bool {
        if !may_be_too_long(bytes) {
            self.lost();
            return false;
        }
        let too_long = &mut self.too_long;
        too_long.wait();
        let before = too_long.suspect.take().filter(|suspect| suspect.topic == topic);
        let times = before.map_or(0, |suspect| suspect.times) + 1;
        if times < too_long.times() {
            too_long.suspect = Some(Suspect { topic: topic.to_string(), times });
            return false;
        }
        too_long.limit = Some(bytes);
        true
    }

    /// The connection was lost for another reason, or could not be made: the broker may be another one by now, or
    /// may have been told another limit.
    pub(super) fn lost(&mut self) {
        self.too_long = TooLong::default();
    }

    /// The broker listens, and is being sent what there is.
    pub(super) fn watch_suspect(&mut self, now: Time) {
        if self.too_long.suspect.is_some() {
            self.too_long.acquitted_at = Some(now + CLOSES_WITHIN);
        }
    }

    /// The time of [`TooLong::due`] may have come.
    pub(super) fn wake_suspicion(&mut self, now: Time) {
        if self.too_long.acquitted_at.is_none_or(|at| now < at) {
            return;
        }
        if !self.is_empty() {
            self.watch_suspect(now);
            return;
        }
        // The connection before was lost for another reason, as with a broker that has started anew.
        let kept_back = self.kept_back();
        self.lost();
        kept_back.iter().for_each(|topic| self.tell_again(topic));
    }

    /// The topics of which the broker is not told what stands there, since it is too long.
    pub fn kept_back(&self) -> Vec<String> {
        if self.too_long.limit.is_none() {
            return Vec::new();
        }
        let retained = self.retained.iter().filter(|(_, entry)| self.too_long.is(entry.payload.len()));
        retained.map(|(topic, _)| topic.to_string()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{LATER, outbox, retained, take_all};
    use super::*;

    const ANNOUNCED: &str = "homeassistant/device/busker_boiler/config";
    const INFO: &str = "busker/boiler/info";

    fn filled() -> Outbox {
        let mut outbox = outbox();
        retained(&mut outbox, ANNOUNCED, &"a".repeat(9000));
        retained(&mut outbox, INFO, &"i".repeat(2000));
        retained(&mut outbox, "busker/boiler/flow", "21.5");
        outbox
    }

    /// The topics that are sent after a reconnect.
    fn sent(outbox: &mut Outbox) -> Vec<String> {
        outbox.connected();
        take_all(outbox).into_iter().map(|message| message.topic).collect()
    }

    #[test]
    fn what_the_broker_ends_the_connection_for_is_sent_last_and_then_no_more() {
        let mut outbox = filled();
        let usual = [ANNOUNCED, INFO, "busker/boiler/flow", "busker/bridge/state"];
        assert_eq!(sent(&mut outbox), usual);
        assert!(!outbox.closed_on(ANNOUNCED, 9000));
        assert_eq!(sent(&mut outbox), usual);
        assert!(!outbox.closed_on(ANNOUNCED, 9000));
        assert_eq!(sent(&mut outbox), [INFO, "busker/boiler/flow", "busker/bridge/state", ANNOUNCED]);
        assert_eq!(outbox.kept_back(), [""; 0]);
        assert!(outbox.closed_on(ANNOUNCED, 9000));
        assert_eq!(outbox.kept_back(), [ANNOUNCED]);
        assert_eq!(sent(&mut outbox), usual[1..]);
        // The next one is believed sooner.
        assert!(!outbox.closed_on(INFO, 2000));
        assert!(outbox.closed_on(INFO, 2000));
        assert_eq!(sent(&mut outbox), usual[2..]);
        assert_eq!(outbox.kept_back(), [INFO, ANNOUNCED]);
        // What has become shorter is told.
        retained(&mut outbox, INFO, "short");
        assert_eq!(take_all(&mut outbox).len(), 1);
        assert_eq!(outbox.kept_back(), [ANNOUNCED]);
    }

    #[test]
    fn what_happened_to_be_on_its_way_is_not_suspected_for_long() {
        for other in [
            |outbox: &mut Outbox| outbox.lost(),
            |outbox: &mut Outbox| assert!(!outbox.closed_on("busker/boiler/flow", 4)),
            |outbox: &mut Outbox| assert!(!outbox.closed_on(INFO, 2000)),
        ] {
            let mut outbox = filled();
            for _ in 0..10 {
                assert!(!outbox.closed_on(ANNOUNCED, 9000));
                assert!(!outbox.closed_on(ANNOUNCED, 9000));
                other(&mut outbox);
            }
            assert!(sent(&mut outbox).iter().any(|topic| topic == ANNOUNCED));
        }
    }

    #[test]
    fn a_broker_that_was_away_is_asked_again() {
        for other in [Outbox::lost, |outbox: &mut Outbox| assert!(!outbox.closed_on("busker/boiler/flow", 4))]
        {
            let mut outbox = filled();
            while !outbox.closed_on(ANNOUNCED, 9000) {}
            assert!(!sent(&mut outbox).iter().any(|topic| topic == ANNOUNCED));
            other(&mut outbox);
            assert!(sent(&mut outbox).iter().any(|topic| topic == ANNOUNCED));
        }
    }

    #[test]
    fn a_broker_that_came_back_at_once_with_another_limit_is_sent_what_was_kept_back() {
        let mut outbox = filled();
        while !outbox.closed_on(ANNOUNCED, 9000) {}
        sent(&mut outbox);
        // Killed as something shorter was on its way.
        assert!(!outbox.closed_on(INFO, 2000));
        outbox.disconnected();
        sent(&mut outbox);
        outbox.listens(LATER);
        let due = outbox.wake_at().expect("the suspect is acquitted");
        assert_eq!(due, LATER + CLOSES_WITHIN);
        // It is not all sent yet.
        retained(&mut outbox, "busker/boiler/flow", "22");
        outbox.wake(due);
        assert_eq!(outbox.kept_back(), [ANNOUNCED]);
        assert_eq!(take_all(&mut outbox).len(), 1);
        outbox.wake(due + CLOSES_WITHIN);
        assert_eq!(outbox.kept_back(), [""; 0]);
        assert!(take_all(&mut outbox).iter().any(|message| message.topic == ANNOUNCED));
        assert_eq!(outbox.wake_at(), None);
    }

    #[test]
    fn while_the_limit_is_the_same_nothing_is_tried_again_by_itself() {
        let mut outbox = filled();
        while !outbox.closed_on(ANNOUNCED, 9000) {}
        sent(&mut outbox);
        outbox.listens(LATER);
        assert_eq!(outbox.wake_at(), None);
        // Nor is a suspect acquitted that ends the connection again.
        assert!(!outbox.closed_on(INFO, 2000));
        sent(&mut outbox);
        outbox.listens(LATER);
        assert!(outbox.closed_on(INFO, 2000));
        assert_eq!(outbox.wake_at(), None);
        assert_eq!(outbox.kept_back(), [INFO, ANNOUNCED]);
    }

    #[test]
    fn an_answer_that_is_too_long_is_dropped_and_counted() {
        let mut outbox = filled();
        while !outbox.closed_on(ANNOUNCED, 9000) {}
        take_all(&mut outbox);
        outbox.push(crate::engine::topics::Message::once("busker/bridge/response/read", "x".repeat(9000)));
        assert_eq!((take_all(&mut outbox).len(), outbox.dropped()), (0, 1));
    }
}
