//! Rules of meaning: types, names, units and what decides them.

use crate::engine::device::{Decimals, Encoding, Kind, Names, PointIndex, Poll, Unit};
use crate::engine::profile::check::{Rules, Subject, raw_range};
use crate::engine::profile::file::{Cases, Form, Values};
use crate::engine::profile::resolve::as_decoded;
use crate::engine::profile::text::{Digits, PointPath};
use crate::engine::yaml::{At, Place};

impl Rules<'_, '_> {
    pub fn meaning(&mut self) {
        self.cases_come_with_what_decides();
        self.flags_of_a_register_say_nothing_else();
        self.types_fit_their_place();
        self.texts_have_no_scale_or_unit();
        self.flags_have_no_scale_or_unit();
        self.moments_are_counted_in_whole_numbers();
        self.scales_and_units_are_said_once();
        self.only_shared_names_are_left_out();
        self.names_of_values_are_unique();
        self.others_belong_to_an_enumeration();
        self.named_and_invalid_values_are_possible();
        self.what_decides_is_read();
        self.the_watchdog_is_read();
    }

    fn cases_come_with_what_decides(&mut self) {
        for Subject { file, .. } in self.entries() {
            if let Some(like) = &file.like {
                let others = [file.by.as_ref().map(|by| ("by", &by.place))].into_iter().flatten();
                for (key, place) in others.chain(said(&file.form)) {
                    self.faults.add(
                        place,
                        format!(
                            "`{key}` beside `like: {}`, which says it; remove one of the two",
                            like.value.0
                        ),
                    );
                }
            }
            match (&file.by, &file.is) {
                (Some(by), None) => self.faults.add(
                    &by.place,
                    "`by` without `is`; expected the cases beside it, as in `is: {current: {unit: mA}, off: null}`",
                ),
                (None, Some(cases)) => self
                    .faults
                    .add(&cases.place, "`is` without `by`; expected the point that decides, as in `by: mode`"),
                (Some(_), Some(cases)) => {
                    let mut keys = said(&file.form);
                    if let Cases::Shared(_) = cases.value {
                        // It replaces the `unit_by` of the shared cases.
                        keys.retain(|(key, _)| *key != "unit");
                    }
                    for (key, place) in keys {
                        self.faults.add(
                            place,
                            format!("`{key}` beside `is`, whose cases say it; expected it in the cases only"),
                        );
                    }
                }
                (None, None) => {}
            }
        }
    }

    fn flags_of_a_register_say_nothing_else(&mut self) {
        for Subject { file, .. } in self.entries() {
            if file.bits.is_none() {
                continue;
            }
            let mut others = said(&file.form);
            others.extend(file.write.as_ref().map(|write| ("write", &write.place)));
            others.extend(file.press.as_ref().map(|press| ("press", &press.place)));
            others.extend(file.by.as_ref().map(|by| ("by", &by.place)));
            others.extend(file.also.as_ref().map(|also| ("also", &also.place)));
            for (key, place) in others {
                self.faults.add(
                    place,
                    format!("`{key}` beside `bits`, which are flags to read; expected a point of its own for each such bit, as in `at: input 100.3`"),
                );
            }
        }
    }

    fn types_fit_their_place(&mut self) {
        for Subject { file, expanded, .. } in self.entries() {
            let is_bits = expanded.at.span.table().is_bits();
            if !is_bits && expanded.at.bits.is_none() {
                continue;
            }
            for kind in forms_of(file).into_iter().filter_map(|form| form.r#type.as_ref()) {
                let what = if is_bits { "bits of a table of bits" } else { "bits of a register" };
                self.faults.add(
                    &kind.place,
                    format!("the type `{}` of {what}; remove it, since one bit is a flag and several are a number", kind.value.name()),
                );
            }
        }
    }

    fn texts_have_no_scale_or_unit(&mut self) {
        for Subject { file, .. } in self.entries() {
            for form in forms_of(file) {
                let Some(kind) = form.r#type.as_ref().filter(|kind| kind.value.is_text()) else { continue };
                for (key, place) in said(form).into_iter().filter(|(key, _)| *key != "type") {
                    self.faults
                        .add(place, format!("`{key}` of the text type `{}`; remove it", kind.value.name()));
                }
            }
        }
    }

    fn flags_have_no_scale_or_unit(&mut self) {
        for Subject { file, point, .. } in self.entries() {
            if file.bits.is_some() || !point.plain().is_some_and(|form| form.kind == Kind::Bool) {
                continue;
            }
            for (key, place) in said(&file.form) {
                if !["values", "type"].contains(&key) {
                    self.faults.add(place, format!("`{key}` of a flag, which is OFF or ON; remove it"));
                }
            }
        }
    }

    fn moments_are_counted_in_whole_numbers(&mut self) {
        for Subject { file, point, .. } in self.entries() {
            let is_flag = file.bits.is_some() || point.plain().is_some_and(|form| form.kind == Kind::Bool);
            for form in forms_of(file) {
                let Some(since) = form.since.as_ref().filter(|_| !is_flag) else { continue };
                match &form.r#type {
                    None => self.faults.add(
                        &since.place,
                        "`since` without a `type`; expected the one that counts the seconds, as in `type: u32`",
                    ),
                    Some(kind) if kind.value.is_float() => self.faults.add(
                        &kind.place,
                        format!("`since` of the type `{}`; expected a whole number, as in `type: u32`", kind.value.name()),
                    ),
                    Some(_) => {}
                }
                let mut others = said(form);
                others.retain(|(key, _)| !["type", "scale", "since"].contains(key));
                if file.difference {
                    others.push(("difference", &since.place));
                }
                others.extend(file.press.as_ref().map(|press| ("press", &press.place)));
                for (key, place) in others {
                    self.faults.add(
                        place,
                        format!("`{key}` beside `since`, by which the register stands for a moment; remove one of the two"),
                    );
                }
            }
        }
    }

    fn scales_and_units_are_said_once(&mut self) {
        for Subject { file, .. } in self.entries() {
            for form in forms_of(file) {
                if let Some(scale) = form.scale.as_ref().filter(|scale| scale.units == 0) {
                    self.faults
                        .add(&scale.place, "a scale of 0 makes every value 0; expected another factor");
                }
                if let (Some(_), Some(unit_by)) = (&form.unit, &form.unit_by) {
                    self.faults.add(&unit_by.place, "`unit_by` beside `unit`; expected one of them");
                }
            }
        }
    }

    fn only_shared_names_are_left_out(&mut self) {
        for Subject { file, .. } in self.entries() {
            for form in forms_of(file) {
                let Some(without) = form.without.first() else { continue };
                if !matches!(form.values, Some(At { value: Values::Shared(_), .. })) {
                    let expected = if file.is.is_some() {
                        "it at the point that decides, beside the `values` there"
                    } else {
                        "such a file beside it, as in `values: shared/measuring`"
                    };
                    self.faults.add(
                        &without.place,
                        format!("`without` leaves out names of a shared file; expected {expected}"),
                    );
                }
            }
        }
    }

    fn names_of_values_are_unique(&mut self) {
        for Subject { file, .. } in self.entries() {
            for values in forms_of(file).into_iter().filter_map(|form| form.values.as_ref()) {
                let Values::Listed(values) = &values.value else { continue };
                for (index, (value, name)) in values.iter().enumerate() {
                    if let Some((first, _)) = values.iter().take(index).find(|(_, other)| *other == name) {
                        self.faults.add(
                            &value.place,
                            format!(
                                "`{name}` is the name of {} and of {}; expected another name",
                                first.value, value.value
                            ),
                        );
                    }
                }
            }
        }
    }

    fn others_belong_to_an_enumeration(&mut self) {
        for Subject { file, point, .. } in self.entries() {
            let Some(others) = file.form.others.as_ref() else { continue };
            let is_enumeration = point.plain().is_some_and(|form| matches!(form.names, Names::All(_)));
            if !is_enumeration && file.form.values.is_some() {
                self.faults.add(
                    &others.place,
                    "`others` of a number or a flag, which every value already means something to; remove it",
                );
            }
        }
    }

    fn named_and_invalid_values_are_possible(&mut self) {
        for Subject { file, expanded, point } in self.entries() {
            if expanded.is_flag {
                continue;
            }
            let resolved: Vec<_> = point.encoding.forms().collect();
            // With cases the words of the point itself must fit one of them; `forms` are in the same order.
            let Some(first) = resolved.first() else { continue };
            let ranges: Vec<_> = resolved.iter().filter_map(|form| raw_range(point, form)).collect();
            let Some((min, max)) = ranges.into_iter().reduce(|a, b| (a.0.min(b.0), a.1.max(b.1))) else {
                continue;
            };
            let fits = |word: i128| {
                (min..=max).contains(&as_decoded(first.kind, word)) || (min..=max).contains(&word)
            };
            let mut words: Vec<(i128, &Place, &str)> = Vec::new();
            for form in forms_of(file) {
                words.extend(
                    form.invalid.iter().map(|(word, _)| (word.value, &word.place, "an `invalid` word")),
                );
                if let Some(At { value: Values::Listed(values), .. }) = &form.values {
                    words.extend(values.iter().map(|(word, _)| (word.value, &word.place, "a named value")));
                }
            }
            words.extend(file.default.as_ref().map(|default| (default.value, &default.place, "the default")));
            for (word, place, what) in words {
                if !fits(word) {
                    self.faults.add(
                        place,
                        format!("{what} of {word} cannot be there; the place holds {min} to {max}"),
                    );
                }
            }
        }
    }

    fn what_decides_is_read(&mut self) {
        for Subject { file, point, .. } in self.entries() {
            if let (Encoding::Cases { by, .. }, Some(path)) = (&point.encoding, &file.by) {
                self.check_selector(*by, path, Wanted::Names);
            }
            let in_file = forms_of(file);
            for form in point.encoding.forms() {
                if let Some(Decimals::By(selector)) = form.decimals {
                    if let Some(path) = in_file.iter().find_map(|form| digits_path(form)) {
                        self.check_selector(selector, &path, Wanted::Number);
                    }
                }
                if let Unit::By(selector) = form.unit {
                    if let Some(path) = in_file
                        .iter()
                        .find_map(|form| form.unit_by.as_ref())
                        .or(file.is.as_ref().and(file.by.as_ref()))
                    {
                        self.check_selector(selector, path, Wanted::Units);
                    }
                }
            }
        }
    }

    /// What decides is polled, plain, and is not changed by being read.
    fn check_selector(&mut self, selector: PointIndex, path: &At<PointPath>, wanted: Wanted) {
        let point = &self.device.points[selector];
        let name = &self.points[selector].name;
        let message = if point.poll == Poll::Never {
            format!("`{name}` decides here but is never read; expected `poll: slow` there")
        } else if point.read_clears {
            format!("`{name}` decides here but is cleared by reading; expected a point that keeps its value")
        } else {
            match (point.plain(), wanted) {
                (None, _) => format!(
                    "`{name}` decides here and has cases itself; expected a point that needs no other"
                ),
                (Some(form), _) if form.kind.is_float() || form.kind.is_text() || form.since.is_some() => {
                    format!("`{name}` decides here and is no whole number; expected a register of one")
                }
                (Some(form), Wanted::Number) if matches!(form.names, Names::All(_)) => {
                    format!("`{name}` has names and no number of decimals; expected a point with a number")
                }
                (Some(form), Wanted::Units) if form.names.list().is_empty() => {
                    format!(
                        "`{name}` has no named values; expected the units there, as in `values: {{0: °C, 1: °F}}`"
                    )
                }
                _ => return,
            }
        };
        self.faults.add(&path.place, message);
    }

    fn the_watchdog_is_read(&mut self) {
        let path = self.profile.wire.as_ref().and_then(|wire| wire.watchdog.as_ref());
        if let (Some(path), Some(watchdog)) = (path, self.device.wire.watchdog) {
            if self.device.points[watchdog].poll == Poll::Never {
                let name = &path.value.0;
                self.faults.add(
                    &path.place,
                    format!("the time of the watchdog `{name}` is never read; expected `poll: slow` there"),
                );
            }
        }
    }
}

#[derive(Clone, Copy)]
enum Wanted {
    Names,
    Number,
    Units,
}

fn digits_path(form: &Form) -> Option<At<PointPath>> {
    match &form.decimals {
        Some(At { value: Digits::By(path), place }) => Some(At { value: path.clone(), place: place.clone() }),
        _ => None,
    }
}

/// The forms that stand in the entry itself: its own, or its cases.
fn forms_of(file: &crate::engine::profile::file::Point) -> Vec<&Form> {
    let mut forms = vec![&file.form];
    if let Some(At { value: Cases::Listed(cases), .. }) = &file.is {
        forms.extend(cases.iter().filter_map(|(_, form)| form.as_ref()));
    }
    forms.extend(file.ranges.iter().map(|(_, form)| form));
    forms
}

/// The keys that say how a value is understood, apart from `invalid` and `order`.
fn said(form: &Form) -> Vec<(&'static str, &Place)> {
    let mut said = Vec::new();
    said.extend(form.r#type.as_ref().map(|key| ("type", &key.place)));
    said.extend(form.scale.as_ref().map(|key| ("scale", &key.place)));
    said.extend(form.offset.as_ref().map(|key| ("offset", &key.place)));
    said.extend(form.decimals.as_ref().map(|key| ("decimals", &key.place)));
    said.extend(form.since.as_ref().map(|key| ("since", &key.place)));
    said.extend(form.unit.as_ref().map(|key| ("unit", &key.place)));
    said.extend(form.unit_by.as_ref().map(|key| ("unit_by", &key.place)));
    said.extend(form.values.as_ref().map(|key| ("values", &key.place)));
    said.extend(form.others.as_ref().map(|key| ("others", &key.place)));
    said.extend(form.range.as_ref().map(|key| ("range", &key.place)));
    said
}
