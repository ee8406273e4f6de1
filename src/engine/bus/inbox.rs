//! What waits for a bus's attention: bounded, and of several values for a point the newest stays.

use std::collections::VecDeque;

use super::waiting::REPLACED;
use super::{Command, Event};
use crate::engine::command::{Outcome, OutcomeKind, Wish};

/// Events that wait until the bus takes them.
#[derive(Debug, Default)]
pub struct Inbox {
    events: VecDeque<Event>,
    closed: bool,
}

/// There is no room, or nobody takes anything any more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Full;

/// How a command has ended by being handed to its bus, or the one for the same point whose place it took.
pub fn ended_at_once(command: &Command, taken: &Result<Option<Command>, Full>) -> Option<Outcome> {
    let (ended, kind, reason) = match taken {
        Ok(None) => return None,
        Ok(Some(older)) => (older, OutcomeKind::Expired, REPLACED),
        Err(Full) => (command, OutcomeKind::Refused, "too many commands of this bus wait already"),
    };
    Some(Wish::parse(&ended.payload).ended(kind, reason))
}

impl Inbox {
    /// The bus takes all of them between two looks at the line, so this fills only when something floods it.
    pub const LIMIT: usize = 256;

    /// Adds an event. When there is no room, a command takes the place of the last one for the same point, which
    /// is returned. What strangers publish leaves room for the gateway's own news, that the broker is gone
    /// perhaps: no flood may keep a watchdog fed that should run out.
    pub fn push(&mut self, event: Event) -> Result<Option<Command>, Full> {
        if self.closed {
            return Err(Full);
        }
        let is_of_strangers = matches!(event, Event::Command(_) | Event::Get { .. } | Event::Request(_));
        let limit = if is_of_strangers { Inbox::LIMIT } else { 2 * Inbox::LIMIT };
        if self.events.len() < limit {
            self.events.push_back(event);
            return Ok(None);
        }
        let Event::Command(command) = &event else { return Err(Full) };
        let is_older = |other: &Event| match other {
            Event::Command(other) => {
                let same = (&other.device, &other.point) == (&command.device, &command.point);
                // An empty message is no value that would take the place of one.
                same && other.retained == command.retained
                    && other.payload.is_empty() == command.payload.is_empty()
            }
            _ => false,
        };
        let at = self.events.iter().rposition(is_older).ok_or(Full)?;
        match std::mem::replace(&mut self.events[at], event) {
            Event::Command(older) => Ok(Some(older)),
            _ => Err(Full),
        }
    }

    /// The first of them.
    pub fn take(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    pub fn is_empty(&self) -> bool {
        self.events.is_empty()
    }

    /// Nobody takes anything any more.
    pub fn close(&mut self) {
        self.closed = true;
        self.events.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(point: &str, value: usize) -> Event {
        let payload = value.to_string();
        Event::Command(Command { device: "valves".into(), point: point.into(), payload, retained: false })
    }

    #[test]
    fn a_flood_of_values_ends_in_the_newest_and_nothing_is_lost_without_a_word() {
        let mut inbox = Inbox::default();
        let mut replaced = Vec::new();
        assert_eq!(inbox.push(set("output_2", 7)), Ok(None));
        for value in 0..1000 {
            replaced.extend(inbox.push(set("output_1", value)).expect("of these the newest stays"));
        }
        assert_eq!(inbox.push(set("output_3", 7)), Err(Full));
        let mut waiting = Vec::new();
        while let Some(Event::Command(command)) = inbox.take() {
            waiting.push(command);
        }
        assert_eq!(waiting.len(), Inbox::LIMIT);
        assert_eq!((waiting[0].point.as_str(), waiting[0].payload.as_str()), ("output_2", "7"));
        assert_eq!(waiting.len() + replaced.len(), 1001);
        assert_eq!(waiting[Inbox::LIMIT - 1].payload, "999", "it is taken last");
        assert!(replaced.iter().all(|command| command.payload != "999"));
    }

    #[test]
    fn a_command_without_room_is_refused_and_one_whose_place_is_taken_has_expired() {
        let [older, newer] = [7, 8].map(|value| match set("output_1", value) {
            Event::Command(command) => command,
            other => panic!("{other:?}"),
        });
        let told = |taken| {
            let outcome = ended_at_once(&newer, &taken)?;
            Some((outcome.kind, outcome.wanted, outcome.reason.unwrap_or_default()))
        };
        assert_eq!(told(Ok(None)), None);
        assert_eq!(told(Ok(Some(older))), Some((OutcomeKind::Expired, "7".into(), REPLACED.into())));
        let full = "too many commands of this bus wait already".to_string();
        assert_eq!(told(Err(Full)), Some((OutcomeKind::Refused, "8".into(), full)));
    }

    #[test]
    fn behind_a_flood_there_is_room_for_news_of_the_gateway_itself_though_not_without_end() {
        let mut inbox = Inbox::default();
        let get = |point: usize| Event::Get { device: "valves".into(), point: format!("output_{point}") };
        let taken = (0..1000).filter(|point| inbox.push(get(*point)).is_ok()).count();
        assert_eq!(taken, Inbox::LIMIT);
        let saved = || Event::Recorded(None, Err("the card is full".into()));
        for event in [Event::BrokerDown, saved()] {
            assert_eq!(inbox.push(event), Ok(None));
        }
        let taken = (0..1000).filter(|_| inbox.push(saved()).is_ok()).count();
        assert_eq!(taken, Inbox::LIMIT - 2);
    }

    #[test]
    fn who_has_gone_takes_nothing() {
        let mut inbox = Inbox::default();
        assert_eq!(inbox.push(Event::BrokerUp), Ok(None));
        inbox.close();
        assert_eq!((inbox.push(Event::BrokerUp), inbox.take()), (Err(Full), None));
    }
}
