//! What is known of a device's points, and what of it is worth telling.

use crate::engine::codec::{self, Raw};
use crate::engine::device::{Device, Point, PointIndex};
use crate::engine::plan::Read;
use crate::engine::time::{Duration, Time};
use crate::engine::value::{Missing, Reading};

/// The last reading of each point of one device.
#[derive(Clone, Debug)]
pub struct Values {
    values: Vec<Value>,
    /// The raw fields by which other points are read; see [`codec::resolve`].
    known: Vec<Option<i128>>,
    /// For each point, those that it decides.
    dependents: Vec<Vec<PointIndex>>,
    /// Whether a point decides about anything: other points, things, or a heartbeat.
    decides: Vec<bool>,
    /// What is missing, or why, has changed since it was last asked.
    missing_changed: bool,
}

#[derive(Clone, Debug)]
struct Value {
    reading: Reading,
    read_at: Option<Time>,
    told: Option<(Reading, Time)>,
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
}

impl Values {
    /// Nothing is known yet.
    pub fn new(device: &Device) -> Values {
        let count = device.points.len();
        let mut dependents = vec![Vec::new(); count];
        for (index, point) in device.points.iter().enumerate() {
            for selector in point.selectors() {
                dependents[selector].push(index);
            }
        }
        let mut decides: Vec<bool> = dependents.iter().map(|dependents| !dependents.is_empty()).collect();
        let conditions = device.things.iter().flat_map(|thing| &thing.when);
        let others = conditions.map(|condition| condition.point);
        others
            .chain(device.points.iter().filter_map(|point| point.heartbeat))
            .for_each(|point| decides[point] = true);
        let unknown = Value { reading: Reading::Missing(Missing::NotYetRead), read_at: None, told: None };
        Values {
            values: vec![unknown; count],
            known: vec![None; count],
            dependents,
            decides,
            missing_changed: true,
        }
    }

    /// What the selectors say, for [`codec::resolve`].
    pub fn known(&self) -> &[Option<i128>] {
        &self.known
    }

    pub fn reading(&self, point: PointIndex) -> &Reading {
        &self.values[point].reading
    }

    pub fn read_at(&self, point: PointIndex) -> Option<Time> {
        self.values[point].read_at
    }

    /// Whether other points, things or a heartbeat wait for this one.
    pub fn is_selector(&self, point: PointIndex) -> bool {
        self.decides[point]
    }

    /// Takes in the words of a read that began after every write before it. Selectors come first:
    /// what a selector decides is never understood by what it said before.
    pub fn absorb(&mut self, now: Time, device: &Device, read: &Read, words: &[u16]) -> Absorbed {
        let mut absorbed = Absorbed::default();
        let (selectors, others): (Vec<_>, Vec<_>) =
            read.points.iter().copied().partition(|(point, _)| self.is_selector(*point));
        for (point, address) in selectors.into_iter().chain(others) {
            let Some(field) = codec::words_at(address, read.span.first(), words) else { continue };
            let known = known_field(&device.points[point], &field);
            if self.is_selector(point) && self.known[point] != known {
                self.known[point] = known;
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
        absorbed
    }

    /// A write to `point` is on its way: whatever it decides is not understood until it has been read
    /// back.
    pub fn forget_selector(&mut self, device: &Device, point: PointIndex) {
        if self.is_selector(point) {
            self.known[point] = None;
            self.drop_dependents(device, point, &mut Vec::new());
        }
    }

    fn drop_dependents(&mut self, device: &Device, selector: PointIndex, dropped: &mut Vec<PointIndex>) {
        for dependent in self.dependents[selector].clone() {
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
        self.set(point, Reading::Missing(missing));
    }

    /// The device is gone, and with it everything that was known of it.
    pub fn lose_all(&mut self, missing: Missing) {
        self.known.fill(None);
        for point in 0..self.values.len() {
            self.set(point, Reading::Missing(missing.clone()));
        }
    }

    fn set(&mut self, point: PointIndex, reading: Reading) {
        let before = std::mem::replace(&mut self.values[point].reading, reading);
        let is_missing = |reading: &Reading| matches!(reading, Reading::Missing(_));
        let now = &self.values[point].reading;
        self.missing_changed |= (is_missing(&before) || is_missing(now)) && before != *now;
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
        let worth_telling = match &value.told {
            None => true,
            Some((told, told_at)) => {
                // What was told at this very moment need not be told twice.
                (anyway && *told_at < now)
                    || now - *told_at >= republish
                    || differs(told, &value.reading, details)
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

fn differs(told: &Reading, reading: &Reading, point: &Point) -> bool {
    let number = |reading: &Reading| match reading {
        Reading::Number(number) => Some(number.to_f64()),
        Reading::Float(number) => Some(*number),
        _ => None,
    };
    match (number(told), number(reading), point.deadband) {
        (Some(before), Some(after), Some(deadband)) => (after - before).abs() >= deadband.to_f64(),
        // Compared as told: the reason why something is missing belongs to the device's info.
        _ => told.to_string() != reading.to_string(),
    }
}
