//! Rules beyond the shape: what a device of these points must keep to be safe and clear.
//!
//! Each rule is a function whose name says it. A fault stands at the key that breaks the rule; what
//! all repetitions of an entry share is told once.

mod living;
mod meaning;
mod places;
mod presentation;
mod things;
mod writing;

use crate::engine::device::{Device, Form, Point};
use crate::engine::keys::{self, EEPROM_WRITES, Owner, WIRE};
use crate::engine::profile::expand::Expanded;
use crate::engine::profile::file::{self, Profile};
use crate::engine::yaml::{At, Faults, Place};

/// Notes every rule that `device`, made of `points` of `profile`, breaks.
pub fn check(profile: &Profile, points: &[Expanded<'_>], device: &Device, faults: &mut Faults) {
    let mut rules = Rules { profile, points, device, faults };
    rules.names_are_unique_and_free();
    rules.entities_have_keys_of_their_own();
    rules.what_is_read_has_a_poll_class();
    rules.limits_are_possible();
    rules.places();
    rules.meaning();
    rules.writing();
    rules.living();
    rules.things();
    rules.presentation();
}

struct Rules<'a, 'f> {
    profile: &'f Profile,
    points: &'a [Expanded<'f>],
    device: &'a Device,
    faults: &'a mut Faults,
}

/// One entry of the file with the first point that it became.
#[derive(Clone, Copy)]
struct Subject<'a, 'f> {
    expanded: &'a Expanded<'f>,
    file: &'f file::Point,
    point: &'a Point,
}

impl<'a, 'f> Rules<'a, 'f> {
    /// Each entry once, and each flag of its `bits`.
    fn entries(&self) -> Vec<Subject<'a, 'f>> {
        self.all().into_iter().filter(|subject| subject.expanded.is_first).collect()
    }

    /// Every point with its entry.
    fn all(&self) -> Vec<Subject<'a, 'f>> {
        let with_entry = |(expanded, point): (&'a Expanded<'f>, &'a Point)| Subject {
            expanded,
            file: expanded.file,
            point,
        };
        self.points.iter().zip(&self.device.points).map(with_entry).collect()
    }

    fn names_are_unique_and_free(&mut self) {
        for (index, point) in self.points.iter().enumerate() {
            if let Some(first) = self.points[..index].iter().find(|other| other.name == point.name) {
                let (name, line) = (&point.name, first.place.line());
                self.faults.add(
                    point.place,
                    format!(
                        "two points are called `{name}` (the other in line {line}); expected another name"
                    ),
                );
            }
            if let Some(why) = taken_by_the_gateway(&point.name) {
                let name = &point.name;
                self.faults.add(point.place, format!("`{name}` {why}; expected another name for this point"));
            }
        }
    }

    fn entities_have_keys_of_their_own(&mut self) {
        for (key, owners) in keys::shared(self.device) {
            let place = owners.iter().rev().find_map(|owner| self.place_of(owner));
            self.faults.add(place.unwrap_or(&self.profile.place), keys::message(&key, &owners));
        }
    }

    fn place_of(&self, owner: &Owner) -> Option<&'f Place> {
        match owner {
            Owner::Point(name) | Owner::Commanded(name) | Owner::Button { point: name, .. } => {
                self.points.iter().find(|point| point.name == *name).map(|point| point.place)
            }
            Owner::Thing(index, _) => {
                let thing = &self.device.things[*index];
                let paths = self.profile.things.iter().filter(|(path, _)| things::is_at(thing, &path.value));
                paths.last().map(|(path, _)| &path.place)
            }
            Owner::Gateway => None,
        }
    }

    fn what_is_read_has_a_poll_class(&mut self) {
        for Subject { file, .. } in self.entries() {
            match (&file.poll, &file.press) {
                (None, None) => self.faults.add(
                    &file.place,
                    "the key `poll` is missing here; expected `fast`, `slow`, `once` or `never`",
                ),
                (Some(poll), Some(_)) => self.faults.add(&poll.place, "a button is not read; remove `poll`"),
                _ => {}
            }
        }
    }

    fn limits_are_possible(&mut self) {
        let Some(wire) = &self.profile.wire else { return };
        if let Some(limits) = &wire.limits {
            let ranges = [
                (&limits.read_registers, 125, "registers in one read"),
                (&limits.read_bits, 2000, "bits in one read"),
                (&limits.write_registers, 123, "registers in one write"),
            ];
            for (limit, max, what) in ranges {
                if let Some(limit) = limit.as_ref().filter(|limit| !(1..=max).contains(&limit.value)) {
                    let found = limit.value;
                    self.faults.add(&limit.place, format!("{found} {what}; Modbus allows 1 to {max}"));
                }
            }
        }
        if let Some(poll) = &wire.poll {
            for period in [&poll.fast, &poll.slow].into_iter().flatten() {
                if period.value.is_zero() {
                    self.faults.add(&period.place, "a period of no time; expected one like `500ms`");
                }
            }
        }
    }
}

/// The smallest and largest raw value that fits a point in this form; `None` for floats and texts.
fn raw_range(point: &Point, form: &Form) -> Option<(i128, i128)> {
    let (min, max) = form.kind.integer_range()?;
    let bits = match point.at.bits {
        Some(bits) => u32::from(bits.width()),
        None if point.at.span.table().is_bits() => point.at.span.count(),
        None => return Some((min, max)),
    };
    Some((min.max(0), max.min((1i128 << bits) - 1)))
}

/// Whether the key is there and says `true`.
fn is_true(key: &Option<At<bool>>) -> bool {
    key.as_ref().is_some_and(|key| key.value)
}

/// What a name stands for already, if it does: neither a point nor a thing can be called so.
fn taken_by_the_gateway(name: &str) -> Option<&'static str> {
    match name {
        "availability" | "info" | "health" => Some("is a topic of every device"),
        EEPROM_WRITES => Some("is the entity that counts what is written to the device's EEPROM"),
        _ if name.starts_with(WIRE) => Some("begins as entities do that tell how the device is on its wire"),
        _ => None,
    }
}
