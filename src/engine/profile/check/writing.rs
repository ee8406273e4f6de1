//! Rules of writing: what may be written, where, and by which function.

use crate::engine::device::{Decimals, Encoding, Form, Kind, Point, WriteFunction, WriteRule};
use crate::engine::profile::check::{Rules, Subject, is_true, raw_range};
use crate::engine::profile::text::Writable;
use crate::engine::value::Decimal;
use crate::engine::yaml::{At, Place, list_of_choices};

impl Rules<'_, '_> {
    pub fn writing(&mut self) {
        self.only_what_is_written_says_how();
        self.a_button_is_nothing_else();
        self.what_is_written_can_be();
        self.the_function_fits_the_place();
        self.what_is_written_fits_the_value();
        self.only_a_number_is_out_of_range();
        self.what_reading_clears_is_not_written();
    }

    fn only_a_number_is_out_of_range(&mut self) {
        for Subject { file, point, .. } in self.entries() {
            if let Some(key) = file.out_of_range.as_ref().filter(|_| !point.takes_numbers()) {
                self.faults.add(
                    &key.place,
                    "`out_of_range` of a point that no number is written to; remove it, or add a range as in `write: 0..100`",
                );
            }
        }
    }

    fn only_what_is_written_says_how(&mut self) {
        for Subject { file, .. } in self.entries() {
            if file.write.is_none() && file.press.is_none() {
                let keys = [
                    ("write_at", file.write_at.as_ref().map(|key| &key.place)),
                    ("write_with", file.write_with.as_ref().map(|key| &key.place)),
                    ("persistent", file.persistent.as_ref().map(|key| &key.place)),
                    ("re_read", file.re_read.first().map(|key| &key.place)),
                ];
                for (key, place) in keys {
                    let Some(place) = place else { continue };
                    self.faults.add(
                        place,
                        format!("`{key}` of a point that is never written; remove it, or add `write`"),
                    );
                }
            }
            if let (None, Some(clearing)) = (&file.press, &file.self_clearing) {
                self.faults.add(
                    &clearing.place,
                    "`self_clearing` of a point that is no button; expected `press` beside it",
                );
            }
        }
    }

    fn a_button_is_nothing_else(&mut self) {
        for Subject { file, point, .. } in self.entries() {
            let Some(press) = &file.press else { continue };
            if let Some(write) = &file.write {
                self.faults.add(
                    &write.place,
                    "`write` of a button, which only has its one word; remove one of the two",
                );
            }
            if let Some(values) = &file.form.values {
                self.faults.add(&values.place, "`values` of a button, which is never read; remove them");
            }
            let form = Form::new(Kind::U16);
            if let Some((_, max)) = raw_range(point, &form).filter(|(_, max)| i128::from(press.value) > *max)
            {
                let at = point.at;
                self.faults.add(
                    &press.place,
                    format!("{} cannot be written to {at}, which holds 0 to {max}", press.value),
                );
            }
        }
    }

    fn what_is_written_can_be(&mut self) {
        for Subject { file, point, .. } in self.entries() {
            let (Some(write), Some(place)) = (&point.write, place_of_rule(file)) else { continue };
            let table = write.at.span.table();
            if !table.is_writable() {
                let what = if table.is_bits() { "discrete inputs" } else { "input registers" };
                let where_to = if table.is_bits() { "a coil" } else { "a holding register" };
                self.faults.add(place, format!(
                    "`{}` would be written, but {what} can only be read; expected `write_at` with {where_to}, or no `write`",
                    write.at
                ));
            }
        }
    }

    fn the_function_fits_the_place(&mut self) {
        for Subject { file, point, .. } in self.entries() {
            let (Some(write), Some(function)) = (&point.write, &file.write_with) else { continue };
            let (table, count) = (write.at.span.table(), write.at.span.count());
            let of_coils = matches!(function.value, WriteFunction::SingleCoil | WriteFunction::MultipleCoils);
            let single = matches!(function.value, WriteFunction::SingleCoil | WriteFunction::SingleRegister);
            let code = function.value.code();
            if of_coils != table.is_bits() {
                let what = if of_coils { "coils" } else { "holding registers" };
                let right = if table.is_bits() { "5 or 15" } else { "6 or 16" };
                self.faults.add(
                    &function.place,
                    format!("function {code} writes {what}, but this is `{}`; expected {right}", write.at),
                );
            } else if single && count > 1 {
                let right = if of_coils { 15 } else { 16 };
                self.faults.add(
                    &function.place,
                    format!(
                        "function {code} writes one address, but this value has {count}; expected {right}"
                    ),
                );
            }
        }
    }

    fn what_is_written_fits_the_value(&mut self) {
        for Subject { file, point, .. } in self.entries() {
            let (Some(write), Some(place)) = (&point.write, place_of_rule(file)) else { continue };
            if !point.is_button() && point.encoding.forms().any(|form| form.since.is_some()) {
                self.faults.add(place, "a moment cannot be written; remove `write`");
                continue;
            }
            let form = match &point.encoding {
                Encoding::Plain(form) => form,
                Encoding::Cases { .. } => {
                    if matches!(write.rule, WriteRule::Range { .. }) {
                        self.faults.add(place, "a range of a point with cases, which have different units; expected `any`, and a `range` in the cases");
                    }
                    continue;
                }
            };
            match &write.rule {
                WriteRule::Press { .. } => {}
                WriteRule::Any => self.any_value_is_a_clear_one(point, form, place),
                WriteRule::Names(_) => {
                    let known: Vec<&str> = form.named_values().into_iter().map(|(_, name)| name).collect();
                    let Some(At { value: Writable::Names(in_file), .. }) = &file.write else { continue };
                    for name in in_file.iter().filter(|name| !known.contains(&name.value.as_str())) {
                        let choices = list_of_choices(&name.value, &known);
                        self.faults.add(
                            &name.place,
                            format!("`{}` is none of the point's `values`; {choices}", name.value),
                        );
                    }
                }
                WriteRule::Range { min, max, step } => {
                    self.range_fits(point, form, (*min, *max, *step), place)
                }
            }
        }
    }

    fn any_value_is_a_clear_one(&mut self, point: &Point, form: &Form, place: &Place) {
        if !form.is_number() || form.kind.is_float() || form.range.is_some() {
            return;
        }
        if let Some((min, max)) = raw_range(point, form) {
            self.faults.add(
                place,
                format!("a number that can be written needs a range; expected what the manual allows, as in `write: 0..100` (the place holds {min} to {max})"),
            );
        }
    }

    fn range_fits(
        &mut self,
        point: &Point,
        form: &Form,
        (min, max, step): (Decimal, Decimal, Option<Decimal>),
        place: &Place,
    ) {
        if form.kind == Kind::Bool || form.kind.is_text() {
            let what = if form.kind == Kind::Bool { "flag" } else { "text" };
            self.faults.add(place, format!("a range of a {what}; expected `any`"));
            return;
        }
        let Some((low, high)) = raw_range(point, form) else { return };
        let shift = match form.decimals {
            Some(Decimals::Fixed(decimals)) => decimals,
            // The range is then the register's own.
            Some(Decimals::By(_)) | None => 0,
        };
        let in_unit = |raw: i128| {
            Decimal { units: raw, decimals: shift }
                .checked_mul(form.scale)
                .and_then(|value| value.checked_add(form.offset))
        };
        let (Some(a), Some(b)) = (in_unit(low), in_unit(high)) else { return };
        let (low, high) = if a.compare(b).is_le() { (a, b) } else { (b, a) };
        if min.compare(low).is_lt() || max.compare(high).is_gt() {
            self.faults.add(
                place,
                format!(
                    "the range {min}..{max} is wider than what the place holds; expected {} to {} or less",
                    low.normalized(),
                    high.normalized()
                ),
            );
        }
        let resolution = Decimal { units: form.scale.units, decimals: form.scale.decimals + shift };
        if let Some(step) = step.filter(|step| step.divided_exactly_by(resolution).is_none()) {
            self.faults.add(
                place,
                format!("a step of {step} cannot be written, since the register counts in {}; expected a multiple of that", resolution.normalized()),
            );
        }
    }

    fn what_reading_clears_is_not_written(&mut self) {
        for Subject { file, .. } in self.entries() {
            let Some(clears) = file.read_clears.as_ref().filter(|_| is_true(&file.read_clears)) else {
                continue;
            };
            if file.write.is_some() || file.press.is_some() {
                self.faults.add(&clears.place, "what reading clears cannot be written, since each write is read back; remove one of the two");
            }
        }
    }
}

/// The key that says that a point is written.
fn place_of_rule(file: &crate::engine::profile::file::Point) -> Option<&Place> {
    file.write.as_ref().map(|write| &write.place).or(file.press.as_ref().map(|press| &press.place))
}
