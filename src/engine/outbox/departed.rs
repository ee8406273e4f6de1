//! What Home Assistant may have although it is announced no more. Nobody says whether it heard a farewell: it may have
//! been away, and keeps its entities meanwhile; the broker keeps no farewell for it, and may forget announcements, too.
//! So everything that was ever announced is remembered, over restarts as well, until it has been taken away while
//! Home Assistant was there for certain, which is when it has just said so.

use std::borrow::Cow;
use std::collections::BTreeMap;

use super::taken_back::ARRIVES_WITHIN;
use super::{Outbox, Rank};
use crate::engine::homeassistant::Announcement;
use crate::engine::time::Time;

/// By the topic on which it was announced.
#[derive(Clone, Debug, Default)]
pub(super) struct Departed {
    topics: BTreeMap<String, Leaving>,
    /// When Home Assistant was told last, and was there.
    told_at: Time,
}

#[derive(Clone, Debug, Default)]
struct Leaving {
    /// More than one where a component has been several platforms, which one message cannot say.
    parts: Vec<Announcement>,
    /// It was taken away while Home Assistant was there.
    is_told: bool,
}

impl Departed {
    /// This is announced no more.
    pub(super) fn add(&mut self, gone: Announcement) {
        let leaving = self.topics.entry(gone.topic().to_string()).or_default();
        leaving.is_told = false;
        let mut rest = Some(gone);
        for part in &mut leaving.parts {
            rest = rest.and_then(|rest| part.join(rest));
        }
        leaving.parts.extend(rest);
    }

    /// What is announced now has not departed.
    pub(super) fn is_announced(&mut self, present: &Announcement) {
        let Some(leaving) = self.topics.get_mut(present.topic()) else { return };
        leaving.parts = leaving.parts.iter().filter_map(|part| part.without(present)).collect();
        if leaving.parts.is_empty() {
            self.topics.remove(present.topic());
        }
    }

    /// What stands there now is another gateway's.
    pub(super) fn forget(&mut self, topic: &str) {
        self.topics.remove(topic);
    }

    pub(super) fn of(&self, topic: &str) -> Vec<Announcement> {
        self.topics.get(topic).map(|leaving| leaving.parts.clone()).unwrap_or_default()
    }

    pub(super) fn has(&self, topic: &str) -> bool {
        self.topics.contains_key(topic)
    }

    pub(super) fn topics(&self) -> Vec<String> {
        self.topics.keys().cloned().collect()
    }

    /// It is taken away now, and Home Assistant is there.
    pub(super) fn is_told(&mut self, topic: &str, now: Time) {
        self.told_at = now;
        if let Some(leaving) = self.topics.get_mut(topic) {
            leaving.is_told = true;
        }
    }

    /// What was told on the connection that is lost may not have arrived.
    pub(super) fn doubt(&mut self) {
        self.topics.values_mut().for_each(|leaving| leaving.is_told = false);
    }

    /// Nothing waits to be told: what was told a while ago has arrived.
    pub(super) fn settle(&mut self, now: Time) {
        if now >= self.told_at + ARRIVES_WITHIN {
            self.topics.retain(|_, leaving| !leaving.is_told);
        }
    }
}

impl Outbox {
    /// All that Home Assistant may have of this gateway, by topic: what is announced first, told already or not, then
    /// what departed. To be stored before long whenever [`Outbox::is_worth_remembering`], since who ends
    /// unexpectedly finds it nowhere else.
    pub fn ledger(&self) -> BTreeMap<&str, Vec<Cow<'_, str>>> {
        let mut ledger: BTreeMap<&str, Vec<Cow<'_, str>>> = BTreeMap::new();
        for (topic, entry) in &self.retained {
            if self.rank(topic) == Rank::Discovery {
                ledger.insert(topic, vec![entry.payload.as_str().into()]);
            }
        }
        let departed = self.departed.topics.values().flat_map(|leaving| &leaving.parts);
        let former = self.formers.iter().flat_map(|former| former.announced());
        for other in self.remembered.values().chain(departed).chain(former) {
            ledger.entry(other.topic()).or_default().push(other.message().payload.into());
        }
        ledger
    }

    /// Whether the [`Outbox::ledger`] has most likely grown since this was asked last.
    pub fn is_worth_remembering(&mut self) -> bool {
        std::mem::take(&mut self.has_new_announcement)
    }

    /// What stood on this discovery topic is replaced by what stands there now.
    pub(super) fn replaced(&mut self, topic: &str, before: &str) {
        let Some(entry) = self.retained.get(topic).filter(|entry| entry.payload != before) else { return };
        let parse = |payload: &str| Announcement::parse(&self.topics, topic, payload);
        if let (Some(before), Some(now)) = (parse(before), parse(&entry.payload)) {
            self.departed.is_announced(&now);
            before.without(&now).into_iter().for_each(|gone| self.departed.add(gone));
            self.hold(&before, &now);
        }
    }

    /// What stands on a discovery topic.
    pub(super) fn announced_on(&self, topic: &str) -> Option<Announcement> {
        let entry = self.retained.get(topic)?;
        Announcement::parse(&self.topics, topic, &entry.payload)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::super::tests::{LATER, check_sent, outbox, retained, take_all};
    use super::*;
    use crate::engine::homeassistant::farewell;
    use crate::engine::topics::Topics;

    const CONFIG: &str = "homeassistant/device/busker_boiler/config";
    const GONE: &str = "homeassistant/device/busker_gone/config";

    /// What is announced of a device with these components, `key platform`.
    fn announcement(components: &[&str]) -> String {
        let components = components.iter().map(|component| {
            let (key, platform) = component.split_once(' ').expect("a key and a platform");
            format!("\"{key}\":{{\"name\":\"{key}\",\"platform\":\"{platform}\"}}")
        });
        format!(
            "{{\"availability\":[{{\"topic\":\"busker/bridge/state\"}}],\"origin\":{{\"name\":\"busker\"}},\
             \"components\":{{{}}}}}",
            components.collect::<Vec<_>>().join(",")
        )
    }

    fn parsed(components: &[&str]) -> Announcement {
        let payload = announcement(components);
        Announcement::parse(&Topics::new("busker"), CONFIG, &payload).expect("one of ours")
    }

    /// As a bus does when what a device has changes.
    fn changes(outbox: &mut Outbox, before: &[&str], now: &[&str]) {
        let (before, now) = (parsed(before), parsed(now));
        farewell(&before, &now).into_iter().for_each(|farewell| outbox.push(farewell));
        outbox.push(now.message());
        take_all(outbox);
    }

    /// What is sent to take each of these parts away from beside `now`.
    fn burial(parts: &[&[&str]], now: &[&str]) -> Vec<String> {
        let mut sent = Vec::new();
        for part in parts {
            let tombstones = farewell(&parsed(part), &parsed(now)).expect("something is gone");
            sent.push(format!("{CONFIG} {}!", announcement(part)));
            sent.push(format!("{CONFIG} {}!", tombstones.payload));
        }
        sent.push(format!("{CONFIG} {}", announcement(now)));
        sent
    }

    #[track_caller]
    fn check_burial(outbox: &mut Outbox, parts: &[&[&str]], now: &[&str]) {
        check_sent(outbox, &burial(parts, now).iter().map(String::as_str).collect::<Vec<_>>());
    }

    #[track_caller]
    fn check_ledger(outbox: &Outbox, expected: &[&[&str]]) {
        let expected: Vec<String> = expected.iter().map(|components| announcement(components)).collect();
        let ledger = outbox.ledger();
        let found: Vec<&str> = ledger.get(CONFIG).into_iter().flatten().map(|payload| &**payload).collect();
        assert_eq!(found, expected);
    }

    /// The outbox of the next run, after whatever end of this one.
    fn next_run(outbox: &Outbox) -> Outbox {
        let ledger = outbox.ledger().into_iter();
        let text = |payload: Cow<'_, str>| payload.into_owned();
        let ledger =
            ledger.map(|(topic, payloads)| (topic.to_string(), payloads.into_iter().map(text).collect()));
        let mut next = super::super::tests::outbox();
        next.recall(ledger.collect(), Vec::new(), &BTreeSet::new());
        next
    }

    #[test]
    fn what_went_while_home_assistant_was_away_is_taken_away_when_it_says_that_it_is_there() {
        let mut outbox = outbox();
        retained(&mut outbox, CONFIG, &announcement(&["flow sensor", "level sensor"]));
        assert!(outbox.is_worth_remembering());
        changes(&mut outbox, &["flow sensor", "level sensor"], &["level sensor"]);
        assert!(outbox.is_worth_remembering());
        changes(&mut outbox, &["level sensor"], &["level number", "way sensor"]);
        changes(&mut outbox, &["level number", "way sensor"], &["level select", "way sensor"]);
        // One that comes back has not gone.
        changes(&mut outbox, &["level select", "way sensor"], &["level select"]);
        changes(&mut outbox, &["level select"], &["level select", "way sensor"]);
        outbox.home_assistant_started(LATER);
        let now = ["level select", "way sensor"];
        check_burial(&mut outbox, &[&["flow sensor", "level sensor"], &["level number"]], &now);
    }

    #[test]
    fn everything_is_remembered_until_it_was_taken_away_while_home_assistant_was_there() {
        let (before, now) = (["flow sensor", "level sensor"], ["level sensor"]);
        let mut outbox = outbox();
        outbox.connected();
        retained(&mut outbox, CONFIG, &announcement(&before));
        // Also what has not been told yet: who ends in the next moment has perhaps told it.
        check_ledger(&outbox, &[&before]);
        take_all(&mut outbox);
        changes(&mut outbox, &before, &now);
        check_ledger(&outbox, &[&now, &["flow sensor"]]);
        outbox.home_assistant_started(LATER);
        outbox.settle(LATER + ARRIVES_WITHIN);
        check_ledger(&outbox, &[&now, &["flow sensor"]]);
        take_all(&mut outbox);
        // The broker goes before it can have handed it on.
        let mut lost = outbox.clone();
        lost.disconnected();
        lost.settle(LATER + ARRIVES_WITHIN);
        check_ledger(&lost, &[&now, &["flow sensor"]]);
        outbox.settle(LATER + ARRIVES_WITHIN);
        check_ledger(&outbox, &[&now]);
    }

    #[test]
    fn the_next_run_takes_away_what_an_earlier_one_has_told_whatever_the_broker_has_forgotten() {
        let mut first = outbox();
        retained(&mut first, CONFIG, &announcement(&["flow sensor", "level sensor"]));
        changes(&mut first, &["flow sensor", "level sensor"], &["level sensor"]);
        // A device that is silent in this run is remembered for the next one.
        let silent = next_run(&first);
        check_ledger(&silent, &[&["level sensor"], &["flow sensor"]]);
        let mut second = next_run(&silent);
        retained(&mut second, CONFIG, &announcement(&["level number"]));
        let parts: &[&[&str]] = &[&["flow sensor", "level sensor"]];
        check_burial(&mut second, parts, &["level number"]);
        // Home Assistant was perhaps away, and busker is started once more.
        let mut third = next_run(&second);
        retained(&mut third, CONFIG, &announcement(&["level number"]));
        check_burial(&mut third, parts, &["level number"]);
        third.home_assistant_started(LATER);
        check_burial(&mut third, parts, &["level number"]);
    }

    #[test]
    fn a_device_that_an_earlier_run_has_taken_away_is_taken_away_whole_once_more() {
        let payloads = [announcement(&["flow sensor"]), announcement(&["flow number"])];
        let mut outbox = outbox();
        outbox.recall([(GONE.to_string(), payloads.to_vec())].into(), Vec::new(), &BTreeSet::new());
        let announced = payloads.each_ref().map(|payload| format!("{GONE} {payload}!"));
        let removal = format!("{GONE} ");
        // The removal takes away one platform for each key.
        let tombstones = ["sensor", "number"].map(|platform| {
            let parts =
                announcement(&[]).replace("{}", &format!("{{\"flow\":{{\"platform\":\"{platform}\"}}}}"));
            format!("{GONE} {parts}!")
        });
        check_sent(&mut outbox, &[&announced[0], &announced[1], &tombstones[1], &removal]);
        outbox.home_assistant_started(LATER);
        check_sent(&mut outbox, &[&announced[1], &announced[0], &tombstones[0], &removal]);
        outbox.settle(LATER + ARRIVES_WITHIN);
        assert_eq!(outbox.ledger().len(), 0);
    }

    #[test]
    fn a_device_that_goes_before_this_run_has_announced_it_is_taken_away() {
        let mut first = outbox();
        retained(&mut first, CONFIG, &announcement(&["flow sensor"]));
        let mut second = next_run(&first);
        second.reconfigure(["busker_bridge".to_string()], &BTreeSet::new(), &BTreeSet::new());
        check_sent(
            &mut second,
            &[&format!("{CONFIG} {}!", announcement(&["flow sensor"])), &format!("{CONFIG} ")],
        );
        check_ledger(&second, &[&["flow sensor"]]);
    }
}
