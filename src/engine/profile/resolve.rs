//! Expanded points to the device: names become indices, words of the file become forms.
//!
//! A fault here leaves something harmless in the device's place, so that the checks can go on and
//! all faults are told at once; a device with faults is never handed out.

use crate::engine::address::{Span, Table};
use crate::engine::device::{
    self, Case, Condition, Decimals, Device, Encoding, Kind, Names, Order, Point, PointIndex, Poll,
    Presentation, Quirks, Unit, Write, WriteRule,
};
use crate::engine::profile::expand::Expanded;
use crate::engine::profile::file::{self, Cases, Form, Profile, SharedCase, Values};
use crate::engine::profile::lookup::Scope;
use crate::engine::profile::shared::Shared;
use crate::engine::profile::text::{Digits, PointPath, Quirk, Writable};
use crate::engine::value::Decimal;
use crate::engine::yaml::{At, Faults, Map, Place, list_of_choices};

/// The device that `profile`, expanded to `points`, describes.
pub fn device(profile: &Profile, points: &[Expanded<'_>], shared: &Shared, faults: &mut Faults) -> Device {
    let mut resolution = Resolution { profile, points, shared, faults };
    let mut resolved: Vec<Point> = (0..points.len()).map(|index| resolution.point(index)).collect();
    let mut things = resolution.things();
    resolution.presentations(&mut resolved, &mut things);
    let wire = resolution.wire();
    let identify = resolution.identify();
    let line = resolution.line();
    Device {
        profile: profile.device.value.clone(),
        manufacturer: profile.manufacturer.clone(),
        model: profile.model.clone(),
        source: profile.source.clone(),
        identify,
        wire,
        line,
        points: resolved,
        things,
        left_out: profile
            .left_out
            .iter()
            .map(|(span, reason)| device::LeftOut { span: span.value, reason: reason.clone() })
            .collect(),
    }
}

pub struct Resolution<'a, 'f> {
    pub profile: &'f Profile,
    pub points: &'a [Expanded<'f>],
    shared: &'a Shared,
    pub faults: &'a mut Faults,
}

impl Resolution<'_, '_> {
    fn point(&mut self, index: PointIndex) -> Point {
        let expanded = &self.points[index];
        let file = expanded.file;
        let encoding = match (&file.by, &file.is) {
            (Some(by), Some(cases)) if !expanded.is_flag => self.cases(expanded, by, cases),
            _ if file.like.is_some() => self.cases_of_likeness(expanded),
            _ => Encoding::Plain(self.form(expanded, &file.form)),
        };
        let re_read = file.re_read.iter().flat_map(|path| self.lookup_all(path, expanded)).collect();
        let ranges = file.ranges.iter().map(|(name, form)| (name.value.0.clone(), self.form(expanded, form)));
        let ranges = ranges.collect();
        let when = self.conditions(&file.when, expanded.into());
        let heartbeat = file.heartbeat.as_ref().and_then(|path| self.lookup(path, expanded));
        let write = if expanded.is_flag { None } else { self.write_of(expanded) };
        Point {
            name: expanded.name.clone(),
            at: expanded.at,
            also: expanded.also,
            encoding,
            ranges,
            poll: file.poll.as_ref().map_or(Poll::Never, |poll| poll.value),
            when,
            write,
            heartbeat,
            refers: file.refers.as_ref().map(|span| span.value),
            event: file.event.as_ref().map(|event| event.value.0.clone()),
            persistent: file.persistent.as_ref().is_some_and(|persistent| persistent.value),
            read_clears: file.read_clears.as_ref().is_some_and(|read_clears| read_clears.value),
            default: file.default.as_ref().map(|default| default.value),
            re_read,
            deadband: None,
            presentation: Presentation::default(),
        }
    }

    /// Names of the points' values to what the points hold then.
    pub fn conditions(&mut self, when: &Map<PointPath, Vec<At<String>>>, from: Scope<'_>) -> Vec<Condition> {
        let mut conditions = Vec::new();
        for (path, wanted) in when.iter() {
            let Some(point) = self.lookup(path, from) else { continue };
            let names = self.deciding_names(point);
            if names.is_empty() {
                if self.points[point].file.form.values.is_none() {
                    self.faults.add(
                        &path.place,
                        format!(
                            "`{}` has no named values that could decide; expected `values` there",
                            path.value.0
                        ),
                    );
                }
                continue;
            }
            let known: Vec<&str> = names.iter().map(|(_, name)| name.as_str()).collect();
            for name in wanted.iter().filter(|name| !known.contains(&name.value.as_str())) {
                let choices = list_of_choices(&name.value, &known);
                let message = format!("`{}` is no value of `{}`; {choices}", name.value, path.value.0);
                self.faults.add(&name.place, message);
            }
            let is_wanted = |name: &String| wanted.iter().any(|wanted| wanted.value == *name);
            let values: Vec<(i128, String)> = names.into_iter().filter(|(_, name)| is_wanted(name)).collect();
            // Of two repetitions one may be named twice, by its path and by its name: both must hold.
            match conditions.iter_mut().find(|known: &&mut Condition| known.point == point) {
                Some(known) => known.values.retain(|value| values.contains(value)),
                None => conditions.push(Condition { point, values }),
            }
        }
        conditions
    }

    /// The values of a point by which it can decide about others; a flag's are `OFF` and `ON`.
    fn deciding_names(&self, point: PointIndex) -> Vec<(i128, String)> {
        let selector = &self.points[point];
        let names = self.names(selector, &selector.file.form);
        if names.is_empty() && kind_of(selector, &selector.file.form, &names) == Kind::Bool {
            return vec![(0, "OFF".into()), (1, "ON".into())];
        }
        names
    }

    fn form(&mut self, expanded: &Expanded<'_>, form: &Form) -> device::Form {
        self.names_left_out_are_there(form);
        let names = self.names(expanded, form);
        let kind = kind_of(expanded, form, &names);
        let mut resolved = device::Form::new(kind);
        resolved.elements = expanded.file.count.as_ref().map_or(1, |count| count.value);
        resolved.order = form.order.unwrap_or_else(|| self.order());
        resolved.scale = form.scale.as_ref().map_or(Decimal::ONE, |scale| scale.value);
        resolved.offset = form.offset.as_ref().map_or(Decimal::ZERO, |offset| offset.value);
        resolved.decimals = match &form.decimals {
            None => None,
            Some(At { value: Digits::Fixed(decimals), .. }) => Some(Decimals::Fixed(*decimals)),
            Some(At { value: Digits::By(path), place }) => {
                let path = At { value: path.clone(), place: place.clone() };
                self.lookup(&path, expanded).map(Decimals::By)
            }
        };
        resolved.since = form.since.as_ref().map(|since| since.value);
        // The point's own unit stands where a shared case leaves it to a point that this device has not.
        resolved.unit = match (&form.unit, &form.unit_by, &expanded.file.form.unit) {
            (Some(unit), _, _) | (None, Some(_), Some(unit)) => Unit::Fixed(unit.value.clone()),
            (None, Some(path), None) => self.lookup(path, expanded).map_or(Unit::None, Unit::By),
            (None, None, _) => Unit::None,
        };
        resolved.others = form.others.as_ref().and_then(|others| self.value_called(others, &names));
        resolved.difference = expanded.file.difference;
        resolved.names = match names {
            _ if kind == Kind::Bool => Names::None,
            names if names.is_empty() => Names::None,
            names if is_number(expanded, form) => Names::Some(names),
            names => Names::All(names),
        };
        let invalid = expanded.file.form.invalid.iter().chain(form.invalid.iter());
        for (word, reason) in invalid {
            let word = as_decoded(kind, word.value);
            if !resolved.invalid.iter().any(|(known, _)| *known == word) {
                resolved.invalid.push((word, reason.clone()));
            }
        }
        resolved.range = form.range.as_ref().map(|range| (range.min, range.max));
        resolved
    }

    /// The named register values of `form`.
    fn names(&self, expanded: &Expanded<'_>, form: &Form) -> Vec<(i128, String)> {
        let mut names = self.names_of_values(expanded, form);
        if let Some(span) = &expanded.file.refers {
            let there = referred(self.points, span.value);
            names.extend(there.map(|(number, point)| (number, point.name.clone())));
        }
        names
    }

    fn names_of_values(&self, expanded: &Expanded<'_>, form: &Form) -> Vec<(i128, String)> {
        match form.values.as_ref().map(|values| &values.value) {
            _ if expanded.is_flag => Vec::new(),
            None => Vec::new(),
            Some(Values::Listed(values)) => {
                values.iter().map(|(value, name)| (value.value, name.clone())).collect()
            }
            Some(Values::Shared(file)) => self
                .shared
                .get(file)
                .map(|cases| {
                    cases
                        .iter()
                        .map(|(value, case)| (value.value, case.name.value.clone()))
                        .filter(|(_, name)| !form.without.iter().any(|without| without.value == *name))
                        .collect()
                })
                .unwrap_or_default(),
        }
    }

    fn names_left_out_are_there(&mut self, form: &Form) {
        let Some(At { value: Values::Shared(file), .. }) = &form.values else { return };
        let Some(cases) = self.shared.get(file) else { return };
        let known: Vec<&str> = cases.iter().map(|(_, case)| case.name.value.as_str()).collect();
        for without in form.without.iter().filter(|without| !known.contains(&without.value.as_str())) {
            let message = format!(
                "`{}` is no name of `{file}`; {}",
                without.value,
                list_of_choices(&without.value, &known)
            );
            self.faults.add(&without.place, message);
        }
    }

    fn cases(&mut self, expanded: &Expanded<'_>, by: &At<PointPath>, cases: &At<Cases>) -> Encoding {
        // A float can be anything, so that no check finds fault with what is only unknown.
        let unknown = Encoding::Plain(device::Form::new(Kind::F32));
        let Some(by_index) = self.lookup(by, expanded) else { return unknown };
        let selector = &self.points[by_index];
        let names = self.deciding_names(by_index);
        if names.is_empty() {
            if selector.file.form.values.is_none() {
                self.faults.add(
                    &by.place,
                    format!(
                        "`{}` has no named values that could decide; expected `values` there",
                        by.value.0
                    ),
                );
            }
            return unknown;
        }
        let mut resolved = Vec::new();
        let mut missing = Vec::new();
        match &cases.value {
            Cases::Listed(listed) => {
                let known: Vec<&str> = names.iter().map(|(_, name)| name.as_str()).collect();
                for (name, _) in listed.iter().filter(|(name, _)| !known.contains(&name.value.as_str())) {
                    self.faults.add(
                        &name.place,
                        format!(
                            "`{}` is no value of `{}`; {}",
                            name.value,
                            by.value.0,
                            list_of_choices(&name.value, &known)
                        ),
                    );
                }
                for (key, name) in &names {
                    match listed.get(name) {
                        Some(form) => {
                            let form = form.as_ref().map(|form| self.form(expanded, form));
                            resolved.push(Case { key: *key, name: name.clone(), form });
                        }
                        None if listed.names(name) => {}
                        None => missing.push(format!("`{name}`")),
                    }
                }
            }
            Cases::Shared(file) => {
                let shared = self.shared;
                let Some(listed) = shared.get(file) else { return unknown };
                if !self.has_unit_of_shared_cases(expanded, file, listed, &cases.place) {
                    return unknown;
                }
                for (key, name) in &names {
                    match listed.get(key).filter(|case| case.name.value == *name) {
                        Some(case) => {
                            let form = Some(self.form(expanded, &case.form));
                            resolved.push(Case { key: *key, name: name.clone(), form });
                        }
                        None => missing.push(format!("`{name}`")),
                    }
                }
            }
        }
        if !missing.is_empty() {
            let have = if missing.len() == 1 { "has" } else { "have" };
            let (missing, by) = (listed(&missing), &by.value.0);
            self.faults.add(
                &cases.place,
                format!("{missing} of `{by}` {have} no case here; expected one for each value, `null` where there is no reading"),
            );
        }
        Encoding::Cases { by: by_index, cases: resolved }
    }

    /// The cases of `like`: a register whose number the selector holds is understood as the point there.
    fn cases_of_likeness(&mut self, expanded: &Expanded<'_>) -> Encoding {
        let unknown = Encoding::Plain(device::Form::new(Kind::F32));
        let Some(like) = &expanded.file.like else { return unknown };
        let Some(by) = self.lookup(like, expanded) else { return unknown };
        let Some(span) = self.points[by].file.refers.as_ref().map(|span| span.value) else {
            self.faults.add(
                &like.place,
                format!("`{}` names no register; expected a point that `refers` to a span", like.value.0),
            );
            return unknown;
        };
        let mut cases = Vec::new();
        for (key, name) in self.deciding_names(by) {
            let there = referred(self.points, span).find(|(number, _)| *number == key);
            // A point with cases needs its own selector; as somebody else's extreme it has no reading.
            let there = there.map(|(_, point)| point).filter(|point| point.file.is.is_none());
            let form = there.map(|point| self.form(point, &point.file.form));
            cases.push(Case { key, name, form });
        }
        Encoding::Cases { by, cases }
    }

    fn write_of(&mut self, expanded: &Expanded<'_>) -> Option<Write> {
        let file = expanded.file;
        let rule = match (&file.press, &file.write) {
            (Some(word), _) => WriteRule::Press {
                word: word.value,
                self_clearing: file.self_clearing.as_ref().is_some_and(|clearing| clearing.value),
            },
            (None, Some(write)) => match &write.value {
                Writable::Any => WriteRule::Any,
                Writable::Range { range, step } => {
                    WriteRule::Range { min: range.min, max: range.max, step: *step }
                }
                Writable::Names(names) => {
                    WriteRule::Names(names.iter().map(|name| name.value.clone()).collect())
                }
            },
            (None, None) => return None,
        };
        let names = self.names(expanded, &file.form);
        let on_change = file.on_change.as_ref().and_then(|between| self.value_called(between, &names));
        Some(Write {
            at: expanded.write_at.unwrap_or(expanded.at),
            with: file.write_with.as_ref().map(|function| function.value),
            rule,
            settle: file.settle.as_ref().map(|settle| settle.value).unwrap_or_default(),
            on_change,
            out_of_range: file.out_of_range.as_ref().map(|clamps| clamps.value).unwrap_or_default(),
        })
    }

    /// The register value of one of a point's own names.
    fn value_called(&mut self, wanted: &At<String>, names: &[(i128, String)]) -> Option<i128> {
        let found = names.iter().find(|(_, name)| *name == wanted.value).map(|(raw, _)| *raw);
        if found.is_none() {
            let known: Vec<&str> = names.iter().map(|(_, name)| name.as_str()).collect();
            let choices = list_of_choices(&wanted.value, &known);
            let message = format!("`{}` is none of the point's `values`; {choices}", wanted.value);
            self.faults.add(&wanted.place, message);
        }
        found
    }

    /// Whether what the shared cases say of units can be resolved: with the point that they name, or with
    /// a unit in its place.
    fn has_unit_of_shared_cases(
        &mut self,
        expanded: &Expanded<'_>,
        file: &str,
        cases: &Map<i128, SharedCase>,
        place: &Place,
    ) -> bool {
        let mut named = cases.iter().filter_map(|(_, case)| case.form.unit_by.as_ref());
        match &expanded.file.form.unit {
            Some(unit) => {
                if named.next().is_none() {
                    self.faults.add(
                        &unit.place,
                        format!("`unit` beside `{file}`, where no case has a `unit_by` that it could replace; remove it"),
                    );
                }
                true
            }
            None => {
                let missing = named.find(|path| self.is_missing(&path.value, expanded));
                if let Some(missing) = missing {
                    let missing = &missing.value.0;
                    self.faults.add(
                        place,
                        format!("`{file}` takes units from `{missing}`, but no point is called so; expected that point, or `unit` beside this"),
                    );
                }
                missing.is_none()
            }
        }
    }

    fn order(&self) -> Order {
        self.profile.wire.as_ref().and_then(|wire| wire.order).unwrap_or_default()
    }

    fn wire(&mut self) -> device::Wire {
        let mut resolved = device::Wire::default();
        let Some(wire) = &self.profile.wire else { return resolved };
        if let Some(limits) = &wire.limits {
            let of =
                |limit: &Option<At<u16>>, default: u16| limit.as_ref().map_or(default, |limit| limit.value);
            let defaults = resolved.limits;
            resolved.limits = device::Limits {
                read_registers: of(&limits.read_registers, defaults.read_registers),
                read_bits: of(&limits.read_bits, defaults.read_bits),
                write_registers: of(&limits.write_registers, defaults.write_registers),
                gap: limits.gap,
                delay: limits.delay.unwrap_or(defaults.delay),
            };
        }
        resolved.readable = wire.readable.iter().map(|span| span.value).collect();
        resolved.forbidden = wire
            .forbidden
            .iter()
            .map(|(span, reason)| device::Forbidden { span: span.value, reason: reason.clone() })
            .collect();
        if let Some(poll) = &wire.poll {
            let defaults = resolved.intervals;
            resolved.intervals.fast = poll.fast.as_ref().map_or(defaults.fast, |fast| fast.value);
            resolved.intervals.slow = poll.slow.as_ref().map_or(defaults.slow, |slow| slow.value);
        }
        resolved.response_timeout = wire.response_timeout;
        resolved.connect_delay = wire.connect_delay.unwrap_or_default();
        resolved.quirks = Quirks {
            clamps_with_exception: wire.quirks.contains(&Quirk::ClampsWithException),
            exception_function_varies: wire.quirks.contains(&Quirk::ExceptionFunctionVaries),
        };
        resolved.watchdog = wire.watchdog.as_ref().and_then(|path| self.lookup(path, Scope::default()));
        resolved
    }

    fn identify(&mut self) -> Option<device::Identify> {
        let identify = self.profile.identify.as_ref()?;
        match (&identify.vendor, &identify.product, &identify.at, identify.equals) {
            (Some(vendor), Some(product), None, None) if identify.mask.is_none() => {
                Some(device::Identify::Names { vendor: vendor.clone(), product: product.clone() })
            }
            (None, None, Some(at), Some(equals)) => {
                let mask = identify.mask.unwrap_or(0xFFFF);
                if at.table().is_bits() || at.count() != 1 {
                    self.faults.add(&at.place, "this is no single register; expected one like `input 0`");
                }
                if equals & !mask != 0 {
                    self.faults.add(&identify.place, format!(
                        "`equals: 0x{equals:04X}` has bits that `mask: 0x{mask:04X}` takes away; expected only bits of the mask"
                    ));
                }
                Some(device::Identify::Word { at: at.value, mask, equals })
            }
            _ => {
                self.faults.add(
                    &identify.place,
                    "not one way to identify the device; expected `vendor` and `product`, or `at` and `equals` (and perhaps `mask`)",
                );
                None
            }
        }
    }

    fn line(&mut self) -> Option<device::LineControl> {
        let line = self.profile.line.as_ref()?;
        let baud: Vec<(u32, u16)> = line.baud.iter().map(|(baud, code)| (baud.value, *code)).collect();
        let settings = match (&line.at, &line.parity, &line.by_hand) {
            (Some(at), Some(parity), None) if !baud.is_empty() => {
                if at.table() != Table::Holding || at.count() != 1 {
                    self.faults.add(
                        &at.place,
                        "this is no single register that can be written; expected one like `holding 65`",
                    );
                }
                device::SettingsBy::Register(device::SettingsRegister {
                    at: at.value,
                    add: line.add.unwrap_or_default(),
                    baud,
                    even: parity.even,
                    odd: parity.odd,
                    none: parity.none,
                })
            }
            (None, None, Some(switches)) if baud.is_empty() && line.add.is_none() => {
                device::SettingsBy::Hand(switches.clone())
            }
            _ => {
                self.faults.add(
                    &line.place,
                    "not one way to set the line; expected `at`, `baud` and `parity` (and perhaps `add`), or `by_hand`",
                );
                return None;
            }
        };
        Some(device::LineControl { settings, unit_by: line.unit.clone() })
    }

    fn presentations(&mut self, points: &mut [Point], things: &mut [device::Thing]) {
        for (path, wish) in self.profile.home_assistant.iter() {
            let of_things = self.things_with_path(&path.value);
            if !of_things.is_empty() {
                for (index, repetition) in of_things {
                    things[index].presentation = presentation(wish, repetition);
                }
                continue;
            }
            for index in self.lookup_all(path, Scope::default()) {
                points[index].presentation = presentation(wish, self.points[index].repetition);
            }
        }
    }
}

/// The points that have a whole register of `span`, each with its number.
fn referred<'a, 'f>(
    points: &'a [Expanded<'f>],
    span: Span,
) -> impl Iterator<Item = (i128, &'a Expanded<'f>)> {
    let is_meant = move |point: &&Expanded<'_>| {
        let at = point.at;
        let is_whole = !point.is_flag && at.bits.is_none() && at.span.count() == 1;
        // What means what others mean is no meaning for others.
        is_whole && point.file.like.is_none() && span.contains(at.span)
    };
    points.iter().filter(is_meant).map(|point| (i128::from(point.at.span.first()), point))
}

fn presentation(wish: &file::Presentation, repetition: Option<u16>) -> Presentation {
    let text = |text: &Option<At<String>>| text.as_ref().map(|text| text.value.clone());
    Presentation {
        platform: wish.r#as.as_ref().map(|platform| platform.value),
        name: wish.name.as_ref().map(|name| match repetition {
            Some(number) => format!("{name} {number}"),
            None => name.clone(),
        }),
        device_class: text(&wish.device_class),
        state_class: text(&wish.state_class),
        category: wish.category,
        icon: text(&wish.icon),
        enabled: wish.enabled,
    }
}

/// Whether `values` beside it are names of some numbers, and not an enumeration.
fn is_number(expanded: &Expanded<'_>, form: &Form) -> bool {
    let writes_a_range =
        expanded.file.write.as_ref().is_some_and(|write| matches!(write.value, Writable::Range { .. }));
    writes_a_range
        || form.r#type.is_some()
        || form.scale.is_some()
        || form.offset.is_some()
        || form.decimals.is_some()
        || form.unit.is_some()
        || form.unit_by.is_some()
}

/// The type, said or understood: single bits are flags, and so is what is only `OFF` or `ON`.
fn kind_of(expanded: &Expanded<'_>, form: &Form, names: &[(i128, String)]) -> Kind {
    if let Some(kind) = &form.r#type {
        return kind.value;
    }
    let is_off_and_on = names.len() == 2
        && names.iter().any(|(value, name)| (*value, name.as_str()) == (0, "OFF"))
        && names.iter().any(|(value, name)| (*value, name.as_str()) == (1, "ON"));
    let one_bit = match expanded.at.bits {
        Some(bits) => bits.width() == 1,
        None => expanded.at.span.table().is_bits() && expanded.at.span.count() == 1,
    };
    let is_flag = if names.is_empty() { one_bit } else { is_off_and_on && !is_number(expanded, form) };
    if is_flag { Kind::Bool } else { Kind::U16 }
}

/// 0x8000 of a signed register is -32768.
pub fn as_decoded(kind: Kind, word: i128) -> i128 {
    match kind.integer_range() {
        Some((min, max)) if min < 0 && word > max && word <= max - min => word + 2 * min,
        _ => word,
    }
}

/// `a`, `a and b`, `a, b and c`; of many only the first.
fn listed(words: &[String]) -> String {
    const SHOWN_MAX: usize = 5;
    match words {
        [] => String::new(),
        [one] => one.clone(),
        [first @ .., last] if words.len() <= SHOWN_MAX => format!("{} and {last}", first.join(", ")),
        _ => format!("{} and {} more", words[..SHOWN_MAX].join(", "), words.len() - SHOWN_MAX),
    }
}
