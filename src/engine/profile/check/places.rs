//! Rules of places: what may lie where, beside what, and in which request.

use crate::engine::address::{Address, Span};
use crate::engine::device::{Kind, WriteRule};
use crate::engine::profile::check::{Rules, Subject};
use crate::engine::yaml::Place;

impl Rules<'_, '_> {
    pub fn places(&mut self) {
        self.steps_have_something_to_step();
        self.both_places_of_a_value_are_equally_wide();
        self.no_point_is_in_a_forbidden_span();
        self.what_is_read_is_readable();
        self.no_value_is_wider_than_a_request();
        self.writable_points_do_not_overlap();
        self.no_register_is_read_as_two_points();
    }

    fn steps_have_something_to_step(&mut self) {
        for Subject { file, expanded, .. } in self.entries() {
            let steps = [
                (&file.also_step, file.also.is_some(), "also"),
                (&file.write_at_step, file.write_at.is_some(), "write_at"),
            ];
            for (step, has_address, key) in steps {
                let Some(step) = step else { continue };
                if !has_address {
                    self.faults
                        .add(&step.place, format!("`{key}_step` without `{key}`; remove it, or add `{key}`"));
                } else if expanded.repetition.is_none() {
                    self.faults.add(
                        &step.place,
                        format!("`{key}_step` of a point that is there once; remove it, or add `for`"),
                    );
                }
            }
        }
    }

    fn both_places_of_a_value_are_equally_wide(&mut self) {
        for Subject { file, expanded, point } in self.entries() {
            // A flag is one bit, even where it has a whole register.
            let is_flag = point.plain().is_some_and(|form| form.kind == Kind::Bool);
            let width = |address: Address| if is_flag { 1 } else { width_in_bits(address) };
            for (other, address) in [(&file.also, expanded.also), (&file.write_at, expanded.write_at)] {
                let (Some(other), Some(address)) = (other, address) else { continue };
                let (own, found) = (width(expanded.at), width(address));
                if own != found {
                    self.faults.add(
                        &other.place,
                        format!(
                            "`{address}` has {found} bits, but `{}` has {own}; expected places of one width",
                            expanded.at
                        ),
                    );
                }
            }
            if let (Some(also), true) = (&file.also, expanded.also == Some(expanded.at)) {
                self.faults
                    .add(&also.place, "this is the same place as `at`; expected another one, or no `also`");
            }
        }
    }

    fn no_point_is_in_a_forbidden_span(&mut self) {
        let forbidden = &self.device.wire.forbidden;
        self.once_per_entry(|points, index| {
            places(points[index]).into_iter().find_map(|(place, address, _)| {
                let found = forbidden.iter().find(|forbidden| forbidden.span.overlaps(address.span))?;
                Some((place, format!(
                    "`{}` would lie at {address}, but {} is forbidden ({}); expected another place, or a smaller forbidden span",
                    points[index].point.name, found.span, found.reason
                )))
            })
        });
    }

    fn what_is_read_is_readable(&mut self) {
        let readable = &self.device.wire.readable;
        self.once_per_entry(|points, index| {
            if readable.is_empty() {
                return None;
            }
            let is_reached = |address: Address| readable.iter().any(|span| span.contains(address.span));
            let missed = |(_, address, is_read): &(Place, Address, bool)| *is_read && !is_reached(*address);
            let (place, address, _) = places(points[index]).into_iter().find(missed)?;
            Some((place, format!(
                "`{}` would lie at {address}, which is in none of the `readable` spans; expected another place, or a wider span there",
                points[index].point.name
            )))
        });
    }

    fn no_value_is_wider_than_a_request(&mut self) {
        let limits = self.device.wire.limits;
        for subject in self.entries() {
            // What is read on request only may take several.
            let in_parts = subject.point.is_read_on_request();
            for (place, address, is_read) in places(subject) {
                if in_parts && is_read {
                    continue;
                }
                let count = address.span.count();
                let is_bits = address.span.table().is_bits();
                let (max, what, limit) = match (is_bits, is_read) {
                    (true, true) => (limits.read_bits, "bits", "read_bits"),
                    (true, false) => continue,
                    (false, true) => (limits.read_registers, "registers", "read_registers"),
                    (false, false) => (limits.write_registers, "registers", "write_registers"),
                };
                if count > u32::from(max) {
                    let right = if subject.file.count.is_some() {
                        "`poll: never`, which takes several"
                    } else {
                        "a shorter type"
                    };
                    self.faults.add(
                        &place,
                        format!("a value of {count} {what}, but one request carries {max} (`{limit}`); expected {right}"),
                    );
                }
            }
        }
    }

    fn writable_points_do_not_overlap(&mut self) {
        self.once_per_entry(|points, index| {
            let subject = points[index];
            let write = subject.point.write.as_ref()?;
            let is_press = matches!(write.rule, WriteRule::Press { .. });
            let clash = points[..index].iter().find(|other| {
                other.point.write.as_ref().is_some_and(|other| {
                    // A command register may have a button for each of its words.
                    let both_press = is_press && matches!(other.rule, WriteRule::Press { .. });
                    other.at.overlaps(write.at) && !both_press
                })
            })?;
            let key = subject.file.write_at.as_ref().or(subject.file.at.as_ref())?;
            Some((key.place.clone(), format!(
                "`{}` is written at {}, where `{}` (line {}) is written too; expected one of them, or fields of bits that do not overlap",
                subject.point.name, write.at, clash.point.name, clash.expanded.place.line()
            )))
        });
    }

    fn no_register_is_read_as_two_points(&mut self) {
        let is_read_whole =
            |subject: &Subject<'_, '_>| subject.file.press.is_none() && subject.point.at.bits.is_none();
        self.once_per_entry(|points, index| {
            let subject = points[index];
            let at = subject.point.at;
            let clash = points[..index].iter().filter(|_| is_read_whole(&subject)).find(|other| {
                // Two writable ones are told of already.
                let both_written = other.point.write.is_some() && subject.point.write.is_some();
                is_read_whole(other) && other.point.at.overlaps(at) && !both_written
            })?;
            let key = subject.file.at.as_ref()?;
            Some((key.place.clone(), format!(
                "`{}` at {at} reads what `{}` (line {}) reads too; expected one of them, or fields of bits",
                subject.point.name, clash.point.name, clash.expanded.place.line()
            )))
        });
    }

    /// Notes the first fault that `rule` finds among the repetitions of each entry.
    fn once_per_entry(&mut self, rule: impl Fn(&[Subject<'_, '_>], usize) -> Option<(Place, String)>) {
        let points = self.all();
        let mut told: Vec<Place> = Vec::new();
        for index in 0..points.len() {
            match rule(&points, index) {
                Some((place, message)) if !told.contains(&place) => {
                    self.faults.add(&place, message);
                    told.push(place);
                }
                _ => {}
            }
        }
    }
}

/// Every place of a point with its key, and whether it is read there (or else written).
fn places(subject: Subject<'_, '_>) -> Vec<(Place, Address, bool)> {
    let Subject { expanded, file, point } = subject;
    let is_read = file.press.is_none();
    let mut places = Vec::new();
    if let Some(at) = &file.at {
        places.push((at.place.clone(), expanded.at, is_read));
    }
    if let (Some(also), Some(address)) = (&file.also, expanded.also) {
        places.push((also.place.clone(), address, is_read));
    }
    if let Some(write) = &point.write {
        let key = file.write_at.as_ref().or(file.at.as_ref());
        if let Some(key) = key {
            places.push((key.place.clone(), write.at, false));
        }
    }
    places
}

fn width_in_bits(address: Address) -> u32 {
    let registers = |span: Span| span.count() * 16;
    match address.bits {
        Some(bits) => u32::from(bits.width()),
        None if address.span.table().is_bits() => address.span.count(),
        None => registers(address.span),
    }
}
