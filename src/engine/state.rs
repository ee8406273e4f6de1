//! What is known of a device's points, and what of it is worth telling.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::engine::address::Address;
use crate::engine::codec::{self, Raw};
use crate::engine::device::{Device, Point, PointIndex};
use crate::engine::plan::Read;
use crate::engine::time::{Duration, Time};
use crate::engine::value::{Decimal, Missing, Reading};

/// The last reading of each point of one device.
#[derive(Clone, Debug)]
pub struct Values {
    values: Vec<Value>,
    /// The raw fields by which other points are read; see [`codec::resolve`].
    known: Vec<Option<i128>>,
    /// For each point that decides about others, those.
    dependents: BTreeMap<PointIndex, Vec<PointIndex>>,
    /// Whether a point decides about anything: other points, things, or a heartbeat.
    decides: Vec<bool>,
    /// What is missing, or why, has changed since it was last asked.
    missing_changed: bool,
    /// What each poll brought last. Words that have not changed need not be understood again, and cost
    /// nothing for each point.
    heard: Vec<Heard>,
    /// Counts what makes equal words mean something else: a selector, a loss, a reading from elsewhere.
    meaning: u64,
}

/// The words of a read, and the count of meanings under which they were understood.
#[derive(Clone, Debug)]
struct Heard {
    read: Arc<Read>,
    meaning: u64,
    words: Vec<u16>,
    /// When they last came.
    at: Time,
    /// As long as the same words come, nothing of them is to be told before.
    told_until: Time,
}

#[derive(Clone, Debug)]
struct Value {
    reading: Reading,
    read_at: Option<Time>,
    told: Option<(Reading, Time)>,
    /// Has changed since it was last asked whether that is worth telling.
    is_news: bool,
    /// It decides about others and has been written since it was read.
    is_forgotten: bool,
}

/// What a read has brought.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Absorbed {
    /// Points whose interpretation has changed with a selector; their readings have been dropped.
    pub dropped: Vec<PointIndex>,
    /// Something that decides about others has changed.
    pub decided: bool,
    /// Points that hold a register value which the profile does not name, seen for the first time.
    pub unnamed: Vec<(PointIndex, i128)>,
    /// The same came as before, and it is not yet time to tell any of it again.
    pub is_told: bool,
}

impl Values {
    /// Nothing is known yet.
    pub fn new(device: &Device) -> Values {
        let count = device.points.len();
        let mut dependents: BTreeMap<PointIndex, Vec<PointIndex>> = BTreeMap::new();
        let mut decides = vec![false; count];
        for (index, point) in device.points.iter().enumerate() {
            for selector in point.selectors() {
                dependents.entry(selector).or_default().push(index);
                decides[selector] = true;
            }
        }
        let conditions = device.things.iter().flat_map(|thing| &thing.when);
        let others = conditions.map(|condition| condition.point);
        others
            .chain(device.points.iter().filter_map(|point| point.heartbeat))
            .for_each(|point| decides[point] = true);
        let unknown = Value {
            reading: Reading::Missing(Missing::NotYetRead),
            read_at: None,
            told: None,
            is_news: true,
            is_forgotten: false,
        };
        Values {
            values: vec![unknown; count],
            known: vec![None; count],
            dependents,
            decides,
            missing_changed: true,
            heard: Vec::new(),
            meaning: 0,
        }
    }

    /// What the selectors say, for [`codec::resolve`].
    pub fn known(&self) -> &[Option<i128>] {
        &self.known
    }

    pub fn reading(&self, point: PointIndex) -> &Reading {
        &self.values[point].reading
    }

    /// What was last told of it.
    pub fn told(&self, point: PointIndex) -> Option<&Reading> {
        self.values[point].told.as_ref().map(|(reading, _)| reading)
    }

    /// Whether the device has been asked for it, or it is known why not; and it has not been written since, if it
    /// decides about others.
    pub fn is_settled(&self, point: PointIndex) -> bool {
        let Value { reading, is_forgotten, .. } = &self.values[point];
        !is_forgotten && !matches!(reading, Reading::Missing(Missing::NotYetRead | Missing::Offline))
    }

    pub fn read_at(&self, point: PointIndex) -> Option<Time> {
        let holds = |heard: &&Heard| heard.read.points.iter().any(|(held, _)| *held == point);
        let by_polls = self.heard.iter().filter(holds).map(|heard| heard.at);
        by_polls.chain(self.values[point].read_at).max()
    }

    /// Whether other points, things or a heartbeat wait for this one.
    pub fn is_selector(&self, point: PointIndex) -> bool {
        self.decides[point]
    }

    /// Takes in the words of a poll that began after every write before it. As [`Values::absorb`], but
    /// what has not changed since the poll before is not understood again.
    pub fn absorb_poll(&mut self, now: Time, device: &Device, read: &Arc<Read>, words: &[u16]) -> Absorbed {
        let at = self.heard.iter().position(|heard| Arc::ptr_eq(&heard.read, read));
        if let Some(heard) = at.map(|at| &mut self.heard[at]) {
            // Most polls bring what the one before has brought.
            if heard.meaning == self.meaning && heard.words == words {
                heard.at = now;
                return Absorbed { is_told: now < heard.told_until, ..Absorbed::default() };
            }
        }
        let before = at.map(|at| self.heard.swap_remove(at));
        let known = before.as_ref().filter(|heard| heard.meaning == self.meaning);
        let absorbed = self.take_in(now, device, read, words, known.map(|heard| &heard.words[..]));
        let mut heard = before.map_or(Vec::new(), |heard| heard.words);
        heard.clear();
        heard.extend_from_slice(words);
        let (read, meaning) = (read.clone(), self.meaning);
        self.heard.push(Heard { read, meaning, words: heard, at: now, told_until: now });
        absorbed
    }

    /// All that a poll has just brought has been told as far as it is worth telling.
    pub fn has_been_told(&mut self, read: &Arc<Read>, republish: Duration) {
        let told_at = |(point, _): &(PointIndex, Address)| Some(self.values[*point].told.as_ref()?.1);
        let oldest = read.points.iter().filter_map(told_at).min();
        if let Some(heard) = self.heard.iter_mut().find(|heard| Arc::ptr_eq(&heard.read, read)) {
            heard.told_until = oldest.map_or(heard.at, |oldest| oldest + republish);
        }
    }

    /// What was worth telling is looked at anew with the next poll of each.
    pub fn look_again(&mut self) {
        self.heard.iter_mut().for_each(|heard| heard.told_until = heard.at);
    }

    /// The reads have changed. What one of them brought long ago may come again while others have brought
    /// something else since.
    pub fn forget_words(&mut self) {
        for heard in std::mem::take(&mut self.heard) {
            for (point, _) in &heard.read.points {
                let read_at = &mut self.values[*point].read_at;
                *read_at = (*read_at).max(Some(heard.at));
            }
        }
    }

    /// Takes in the words of a read that began after every write before it. Selectors come first:
    /// what a selector decides is never understood by what it said before.
    pub fn absorb(&mut self, now: Time, device: &Device, read: &Read, words: &[u16]) -> Absorbed {
        let absorbed = self.take_in(now, device, read, words, None);
        // A poll that brings again what it brought before this is news.
        self.meaning += 1;
        absorbed
    }

    /// `before`: words that were understood as these are, and brought the present readings.
    fn take_in(
        &mut self,
        now: Time,
        device: &Device,
        read: &Read,
        words: &[u16],
        before: Option<&[u16]>,
    ) -> Absorbed {
        let mut absorbed = Absorbed::default();
        let meaning = self.meaning;
        for selectors in [true, false] {
            for (point, address) in &read.points {
                let point = *point;
                if self.is_selector(point) != selectors {
                    continue;
                }
                let before = before.filter(|_| self.meaning == meaning);
                if before
                    .is_some_and(|before| codec::are_equal_at(*address, read.span.first(), before, words))
                {
                    self.values[point].read_at = Some(now);
                } else {
                    self.understand(now, device, read, words, (point, *address), &mut absorbed);
                }
            }
        }
        absorbed
    }

    fn understand(
        &mut self,
        now: Time,
        device: &Device,
        read: &Read,
        words: &[u16],
        (point, address): (PointIndex, Address),
        absorbed: &mut Absorbed,
    ) {
        let Some(field) = codec::words_at(address, read.span.first(), words) else { return };
        let known = known_field(&device.points[point], &field);
        if self.is_selector(point) && self.known[point] != known {
            self.known[point] = known;
            self.meaning += 1;
            absorbed.decided = true;
            self.drop_dependents(device, point, &mut absorbed.dropped);
        }
        let reading = match codec::resolve(device, point, &self.known) {
            Ok(resolved) => codec::read(&resolved, &field),
            Err(missing) => Reading::Missing(missing),
        };
        if let Reading::Missing(Missing::UnknownValue(raw)) = reading {
            if self.values[point].reading != reading {
                absorbed.unnamed.push((point, raw));
            }
        }
        self.set(point, reading);
        self.values[point].read_at = Some(now);
        absorbed.dropped.retain(|dropped| *dropped != point);
    }

    /// A write to `point` is on its way: whatever it decides is not understood until it has been read
    /// back.
    pub fn forget_selector(&mut self, device: &Device, point: PointIndex) {
        if self.is_selector(point) {
            self.known[point] = None;
            self.values[point].is_forgotten = true;
            self.meaning += 1;
            self.drop_dependents(device, point, &mut Vec::new());
        }
    }

    fn drop_dependents(&mut self, device: &Device, selector: PointIndex, dropped: &mut Vec<PointIndex>) {
        for dependent in self.dependents.get(&selector).cloned().unwrap_or_default() {
            let missing = match codec::resolve(device, dependent, &self.known) {
                Ok(_) => Missing::NotYetRead,
                Err(missing) => missing,
            };
            self.set(dependent, Reading::Missing(missing));
            if !dropped.contains(&dependent) {
                dropped.push(dependent);
            }
            if self.is_selector(dependent) {
                self.known[dependent] = None;
                self.drop_dependents(device, dependent, dropped);
            }
        }
    }

    /// There is no reading of this point now.
    pub fn lose(&mut self, point: PointIndex, missing: Missing) {
        self.meaning += 1;
        self.set(point, Reading::Missing(missing));
    }

    /// The device is gone, and with it everything that was known of it.
    pub fn lose_all(&mut self, missing: Missing) {
        self.known.fill(None);
        self.meaning += 1;
        for point in 0..self.values.len() {
            self.set(point, Reading::Missing(missing.clone()));
        }
    }

    fn set(&mut self, point: PointIndex, reading: Reading) {
        let before = std::mem::replace(&mut self.values[point].reading, reading);
        let is_missing = |reading: &Reading| matches!(reading, Reading::Missing(_));
        let value = &mut self.values[point];
        let has_changed = before != value.reading;
        value.is_news |= has_changed;
        value.is_forgotten = false;
        self.missing_changed |= (is_missing(&before) || is_missing(&value.reading)) && has_changed;
    }

    /// Who was told is gone: each point is told next as if for the first time. That a bit has flipped is told to who
    /// is there then.
    pub fn forget_what_was_told(&mut self, device: &Device) {
        for (value, point) in self.values.iter_mut().zip(&device.points) {
            if point.event.is_none() {
                value.told = None;
            }
        }
    }

    /// Whether what is missing, or why, has changed since this was last called.
    pub fn take_missing_changed(&mut self) -> bool {
        std::mem::take(&mut self.missing_changed)
    }

    /// Whether this bit, which tells events, has flipped since it was last asked. After a silence the
    /// first reading is none: nobody knows how often it has flipped.
    pub fn take_flip(&mut self, now: Time, point: PointIndex) -> bool {
        let value = &mut self.values[point];
        let before = value.told.replace((value.reading.clone(), now));
        match (before, &value.reading) {
            (Some((Reading::Flag(before), _)), Reading::Flag(after)) => before != *after,
            _ => false,
        }
    }

    /// Whether there is any reason to look closer: it has changed, or was last told long ago.
    pub fn may_be_told(&self, now: Time, point: PointIndex, republish: Duration) -> bool {
        let value = &self.values[point];
        value.is_news || value.told.as_ref().is_none_or(|(_, told_at)| now - *told_at >= republish)
    }

    /// The text to publish for this point now: if it differs from what was told last (by at least the
    /// deadband), if what was told is older than `republish`, or if `anyway`.
    pub fn tell(
        &mut self,
        now: Time,
        point: PointIndex,
        details: &Point,
        republish: Duration,
        anyway: bool,
    ) -> Option<String> {
        let value = &mut self.values[point];
        let is_news = std::mem::take(&mut value.is_news);
        let worth_telling = match &value.told {
            None => true,
            Some((told, told_at)) => {
                // What was told at this very moment need not be told twice.
                (anyway && *told_at < now)
                    || now - *told_at >= republish
                    || (is_news && differs(told, &value.reading, details))
            }
        };
        if !worth_telling {
            return None;
        }
        value.told = Some((value.reading.clone(), now));
        Some(value.reading.to_string())
    }
}

/// The raw integer of a selector; `None` when its words are invalid.
fn known_field(point: &Point, field: &[u16]) -> Option<i128> {
    let form = point.plain()?;
    match codec::raw(form, field) {
        Raw::Integer(raw) => Some(codec::meant(form, raw)),
        _ => None,
    }
}

/// Whether the reading is worth telling to who was told the other one.
fn differs(told: &Reading, reading: &Reading, point: &Point) -> bool {
    match (number(told), number(reading), point.deadband) {
        // Exact: between 0.2 and 0.3 lies 0.1, of which the difference of two doubles falls short.
        (Some(before), Some(after), Some(deadband)) => {
            after.checked_add(before.negated()).is_none_or(|apart| apart.absolute().compare(deadband).is_ge())
        }
        // Compared as told: the reason why something is missing belongs to the device's info.
        _ => told.to_string() != reading.to_string(),
    }
}

fn number(reading: &Reading) -> Option<Decimal> {
    match reading {
        Reading::Number(number) => Some(*number),
        Reading::Float(number) => Decimal::nearest(*number),
        Reading::Moment(moment) => Some(moment.seconds()),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::address::{Span, Table};
    use crate::engine::device::Poll;
    use crate::engine::test_device::device_of;
    use crate::engine::value::Moment;

    const REPUBLISH: Duration = Duration::from_secs(60);

    fn two_registers() -> (Device, Arc<Read>) {
        let at = |first| Address { span: Span::single(Table::Holding, first), bits: None };
        let device =
            device_of(vec![Point::new("one", at(0), Poll::Fast), Point::new("two", at(1), Poll::Fast)]);
        let points = vec![(0, at(0)), (1, at(1))];
        let span = Span::with_count(Table::Holding, 0, 2).expect("a span");
        (device, Arc::new(Read { poll: Poll::Fast, span, points, alone: false }))
    }

    /// What of a poll at this second is told, as the bus goes about it.
    fn told(
        values: &mut Values,
        device: &Device,
        read: &Arc<Read>,
        second: u64,
        words: &[u16],
    ) -> Vec<String> {
        let now = Time::from_millis(second * 1000);
        if values.absorb_poll(now, device, read, words).is_told {
            return Vec::new();
        }
        let points = read.points.iter();
        let told = points
            .filter_map(|(point, _)| values.tell(now, *point, &device.points[*point], REPUBLISH, false))
            .collect();
        values.has_been_told(read, REPUBLISH);
        told
    }

    #[test]
    fn a_poll_that_brings_the_same_is_told_again_in_time_and_not_before() {
        let (device, read) = two_registers();
        let mut values = Values::new(&device);
        for (second, words, expected) in [
            (0, [1, 2], vec!["1", "2"]),
            (10, [1, 2], vec![]),
            (20, [1, 3], vec!["3"]),
            (30, [1, 3], vec![]),
            (59, [1, 3], vec![]),
            (60, [1, 3], vec!["1"]),
            (79, [1, 3], vec![]),
            (80, [1, 3], vec!["3"]),
        ] {
            assert_eq!(told(&mut values, &device, &read, second, &words), expected, "{second}");
        }
        // What was lost meanwhile is told when it comes again, however much it is the same.
        values.lose(1, Missing::Exception(4));
        let now = Time::from_millis(81_000);
        assert_eq!(values.tell(now, 1, &device.points[1], REPUBLISH, false).as_deref(), Some("None"));
        assert_eq!(told(&mut values, &device, &read, 82, &[1, 3]), ["3"]);
    }

    #[test]
    fn what_differs_by_the_deadband_or_more_from_what_was_told_is_told() {
        let number = |text: &str| Reading::Number(Decimal::parse(text).expect("a decimal"));
        let moment = |seconds| Reading::Moment(Moment::new(Decimal::integer(seconds)).expect("a moment"));
        let (device, _) = two_registers();
        let check = |deadband: &str, readings: Vec<Reading>, expected: &[&str]| {
            let mut values = Values::new(&device);
            let mut point = device.points[0].clone();
            point.deadband = Decimal::parse(deadband);
            let told = readings.into_iter().enumerate().filter_map(|(second, reading)| {
                values.set(0, reading);
                values.tell(Time::from_millis(second as u64 * 1000), 0, &point, REPUBLISH, false)
            });
            assert_eq!(told.collect::<Vec<_>>(), expected, "{deadband}");
        };
        // As doubles, 0.3 - 0.2 is less than 0.1.
        check("0.1", vec![number("0.2"), number("0.3"), number("0.2")], &["0.2", "0.3", "0.2"]);
        check("0.1", vec![number("0.20"), number("0.29"), number("0.11"), number("0.10")], &["0.20", "0.10"]);
        check("0.1", vec![Reading::Float(0.2), Reading::Float(0.3), Reading::Float(0.39)], &["0.2", "0.3"]);
        // From what was told, not from the reading before: what creeps arrives.
        check("1", (0..25).map(|tenth| number(&format!("2.{tenth:02}"))).collect(), &["2.00"]);
        check(
            "0.1",
            (0..25).map(|tenth| number(&format!("2.{tenth:02}"))).collect(),
            &["2.00", "2.10", "2.20"],
        );
        check(
            "60",
            vec![moment(1000), moment(1059), moment(1060)],
            &["1970-01-01T00:16:40+00:00", "1970-01-01T00:17:40+00:00"],
        );
        // What is missing, or is there again, is told however near the number is.
        let gone = || Reading::Missing(Missing::Exception(4));
        check("5", vec![number("20.0"), gone(), gone(), number("20.1")], &["20.0", "None", "20.1"]);
        check(
            "5",
            vec![number("20.0"), Reading::Name("automatic".into()), number("20.0")],
            &["20.0", "automatic", "20.0"],
        );
        let large = Reading::Float(1e200);
        check(
            "5",
            vec![Reading::Float(0.0), Reading::Float(f64::from_bits(1)), large.clone()],
            &["0", &large.to_string()],
        );
    }

    #[test]
    fn a_poll_that_brings_the_same_has_read_its_points_also_after_the_reads_have_changed() {
        let (device, read) = two_registers();
        let mut values = Values::new(&device);
        assert_eq!(values.read_at(1), None);
        for second in [0, 10] {
            told(&mut values, &device, &read, second, &[1, 2]);
            assert_eq!(values.read_at(1), Some(Time::from_millis(second * 1000)));
        }
        values.forget_words();
        assert_eq!(values.read_at(1), Some(Time::from_millis(10_000)));
        told(&mut values, &device, &two_registers().1, 20, &[1, 2]);
        assert_eq!(values.read_at(0), Some(Time::from_millis(20_000)));
    }
}
