//! The words of a plain device, and the places in which one value stands twice.

use std::collections::{BTreeMap, VecDeque};

use crate::engine::address::{Address, Span, Table};
use crate::engine::codec;
use crate::engine::device::{Device, Point};

/// A word for each register, 0 or 1 for each coil and discrete input.
#[derive(Clone, Debug, Default)]
pub struct Cells {
    words: BTreeMap<(Table, u16), u16>,
}

/// Where a point's value stands: where it is read, where else, and where it is written.
pub fn places(point: &Point) -> impl Iterator<Item = Address> + '_ {
    [Some(point.at), point.also, point.write.as_ref().map(|write| write.at)].into_iter().flatten()
}

impl Cells {
    /// From now on there is something here.
    pub fn add(&mut self, span: Span) {
        for address in span.first()..=span.last() {
            self.words.entry((span.table(), address)).or_insert(0);
        }
    }

    pub fn has(&self, single: Span) -> bool {
        self.words.contains_key(&(single.table(), single.first()))
    }

    /// One word for each address; 0 where nothing is known.
    pub fn words(&self, span: Span) -> Vec<u16> {
        let word = |address: u16| self.words.get(&(span.table(), address)).copied().unwrap_or(0);
        (span.first()..=span.last()).map(word).collect()
    }

    /// The words as they are, without a look at what else stands for the same.
    pub fn set(&mut self, span: Span, words: &[u16]) {
        for (address, word) in (span.first()..=span.last()).zip(words) {
            self.words.insert((span.table(), address), *word);
        }
    }

    /// A value's field: its registers, or one word of its bits.
    pub fn field(&self, at: Address) -> Vec<u16> {
        codec::words_at(at, at.span.first(), &self.words(at.span)).unwrap_or_default()
    }

    /// Puts a value's field to a place, and wherever else the same value stands.
    pub fn put(&mut self, device: &Device, at: Address, field: &[u16]) {
        self.put_field(at, field);
        self.spread(device, at.span);
    }

    /// Carries what has changed to the other places of the same values.
    pub fn spread(&mut self, device: &Device, changed: Span) {
        let mut changed = VecDeque::from([changed]);
        // Each point once and again: a bound for profiles in which values chase each other.
        for _ in 0..=2 * device.points.len() {
            let Some(span) = changed.pop_front() else { return };
            for point in &device.points {
                let Some(source) = places(point).find(|place| place.span.overlaps(span)) else { continue };
                let field = self.field(source);
                for place in places(point).filter(|place| *place != source) {
                    // What has just changed is the newest, and is not changed back.
                    if self.field(place) != field && !place.span.overlaps(span) {
                        self.put_field(place, &field);
                        changed.push_back(place.span);
                    }
                }
            }
        }
    }

    fn put_field(&mut self, at: Address, field: &[u16]) {
        let first = field.first().copied().unwrap_or(0);
        let words: Vec<u16> = match at.bits {
            _ if at.span.table().is_bits() => (0..at.span.count()).map(|bit| first >> bit & 1).collect(),
            Some(bits) => self.words(at.span).iter().map(|word| bits.insert(*word, first)).collect(),
            None => field.to_vec(),
        };
        self.set(at.span, &words);
    }
}
