//! Repetitions: one entry of the file to as many points as it stands for, each with its addresses.

use crate::engine::address::{Address, Bits, Span};
use crate::engine::profile::file::{Cases, Form, Point};
use crate::engine::profile::shared::Shared;
use crate::engine::profile::text::{Name, Step};
use crate::engine::yaml::{At, Faults, Map, Place};

/// One point, with the entry of the file that it came from.
pub struct Expanded<'f> {
    /// `channel_3_value`
    pub name: String,
    /// `channel.value`
    pub path: String,
    /// The repeated group that it belongs to, and which repetition: `channel`, 3.
    pub group: Option<String>,
    pub repetition: Option<u16>,
    /// Whether no earlier point came from the same entry: faults that all repetitions share are
    /// told once.
    pub is_first: bool,
    pub file: &'f Point,
    /// The key of the entry, or of the flag in its `bits`.
    pub place: &'f Place,
    pub at: Address,
    pub also: Option<Address>,
    pub write_at: Option<Address>,
    /// Whether it is one of the entry's `bits`.
    pub is_flag: bool,
}

/// All points of `points`, in its order, repetitions one after the other.
pub fn expand<'f>(points: &'f Map<Name, Point>, shared: &Shared, faults: &mut Faults) -> Vec<Expanded<'f>> {
    let mut expansion = Expansion { shared, faults, expanded: Vec::new(), beyond: Vec::new() };
    for (name, point) in points.iter() {
        expansion.entry(name, point);
    }
    expansion.expanded
}

struct Expansion<'a, 'f> {
    shared: &'a Shared,
    faults: &'a mut Faults,
    expanded: Vec<Expanded<'f>>,
    /// Addresses of which some repetition lies outside; told once.
    beyond: Vec<Place>,
}

/// Which repetition of what: its number in names, and how many come before it.
#[derive(Clone, Copy)]
struct Repetition {
    number: u16,
    before: u16,
}

impl<'f> Expansion<'_, 'f> {
    fn entry(&mut self, name: &'f At<Name>, point: &'f Point) {
        self.check_shape_of_entry(point);
        let repetitions: Vec<Option<Repetition>> = match &point.r#for {
            None => vec![None],
            Some(range) => (range.first..=range.last)
                .map(|number| Some(Repetition { number, before: number - range.first }))
                .collect(),
        };
        let name = &name.value.0;
        for repetition in repetitions {
            let own_name = match repetition {
                Some(repetition) => format!("{name}_{}", repetition.number),
                None => name.clone(),
            };
            self.point(&own_name, name, name, repetition, point);
            for (child_name, child) in point.points.iter().flat_map(|children| children.iter()) {
                let path = format!("{name}.{}", child_name.value.0);
                let child_name = format!("{own_name}_{}", child_name.value.0);
                self.point(&child_name, &path, name, repetition, child);
            }
        }
    }

    fn check_shape_of_entry(&mut self, point: &Point) {
        if let Some(children) = &point.points {
            if point.r#for.is_none() {
                self.faults.add(
                    &point.place,
                    "a group of points without `for`; expected its repetitions, as in `for: 1..8`",
                );
            }
            if point.at.is_none() && (point.poll.is_some() || point.write.is_some() || point.press.is_some())
            {
                self.faults.add(
                    &point.place,
                    "this group is no point itself, since it has no `at`; expected only `for` and `points`",
                );
            }
            for (_, child) in children.iter() {
                if let Some(range) = &child.r#for {
                    self.faults.add(&range.place, "a repetition inside a repeated group; expected one point for each repetition, or the group beside this one");
                }
                if child.points.is_some() {
                    self.faults
                        .add(&child.place, "a group inside a group; expected its points beside the others");
                }
            }
        }
        if point.at.is_none() && point.points.is_none() {
            self.faults
                .add(&point.place, "the key `at` is missing here; expected a place like `at: input 32`");
        }
        for (_, child) in point.points.iter().flat_map(|children| children.iter()) {
            if child.at.is_none() && child.points.is_none() {
                self.faults
                    .add(&child.place, "the key `at` is missing here; expected a place like `at: input 32`");
            }
        }
        if let (Some(step), None) = (&point.step, &point.r#for) {
            self.faults.add(&step.place, "`step` of a point that is there once; remove it, or add `for`");
        }
    }

    fn point(
        &mut self,
        name: &str,
        path: &str,
        group: &str,
        repetition: Option<Repetition>,
        point: &'f Point,
    ) {
        let Some(at) = &point.at else { return };
        let before = repetition.map_or(0, |repetition| repetition.before);
        let width = self.width(point, at);
        let Some(own_at) = self.place_of(at, point.step.as_ref(), before, width, name) else { return };
        let also = point
            .also
            .as_ref()
            .and_then(|also| self.place_of(also, point.also_step.as_ref(), before, width, name));
        let write_at = point
            .write_at
            .as_ref()
            .and_then(|write_at| self.place_of(write_at, point.write_at_step.as_ref(), before, width, name));
        let expanded = |name: String, path: String, place: &'f Place, at: Address, is_flag: bool| Expanded {
            name,
            path,
            group: repetition.map(|_| group.to_string()),
            repetition: repetition.map(|repetition| repetition.number),
            is_first: before == 0,
            file: point,
            place,
            at,
            also: if is_flag { None } else { also },
            write_at: if is_flag { None } else { write_at },
            is_flag,
        };
        let Some(flags) = &point.bits else {
            self.expanded.push(expanded(name.into(), path.into(), &point.place, own_at, false));
            return;
        };
        if own_at.span.table().is_bits() || own_at.bits.is_some() || own_at.span.count() != 1 {
            self.faults.add(
                &flags.place,
                "`bits` of something that is no single register; expected them of one like `input 100`",
            );
            return;
        }
        for (flag, flag_name) in flags.iter() {
            let Some(bits) = Bits::new(flag.value, flag.value) else {
                self.faults.add(
                    &flag.place,
                    format!("bit {} is not in a register; expected 0 (the lowest) to 15", flag.value),
                );
                continue;
            };
            let at = Address { span: own_at.span, bits: Some(bits) };
            let flag_name = &flag_name.0;
            self.expanded.push(expanded(
                format!("{name}_{flag_name}"),
                format!("{path}.{flag_name}"),
                &flag.place,
                at,
                true,
            ));
        }
    }

    /// The registers (or bits of a table of bits) that belong to one value.
    fn width(&mut self, point: &Point, at: &At<Address>) -> u16 {
        if at.span.table().is_bits() || at.bits.is_some() {
            if let Some(width) = &point.width {
                self.faults.add(&width.place, "`width` of something that is no whole register; remove it");
            }
            return at.span.count().min(16) as u16;
        }
        let of_form = |form: &Form| form.r#type.as_ref().map_or(1, |kind| kind.value.registers());
        let widest = match point.is.as_ref().map(|cases| &cases.value) {
            None => of_form(&point.form),
            Some(Cases::Listed(cases)) => {
                cases.iter().filter_map(|(_, form)| form.as_ref()).map(of_form).max().unwrap_or(1)
            }
            Some(Cases::Shared(file)) => self
                .shared
                .get(file)
                .map_or(1, |cases| cases.iter().map(|(_, case)| of_form(&case.form)).max().unwrap_or(1)),
        };
        let elements = point.count.as_ref().map_or(1, |count| count.value.max(1));
        let Some(widest) = widest.checked_mul(elements) else {
            self.faults.add(&at.place, format!("{elements} values have no room in 65536 registers"));
            return widest;
        };
        match &point.width {
            None => widest,
            Some(width) if width.value < widest => {
                self.faults.add(
                    &width.place,
                    format!(
                        "a width of {} is too small for its type; expected at least {widest}",
                        width.value
                    ),
                );
                widest
            }
            Some(width) => width.value,
        }
    }

    /// Where `address`, which is that of the first repetition, is after `before` more.
    fn place_of(
        &mut self,
        address: &At<Address>,
        given_step: Option<&At<Step>>,
        before: u16,
        width: u16,
        name: &str,
    ) -> Option<Address> {
        let table = address.span.table();
        let count = if table.is_bits() || address.bits.is_some() {
            address.span.count().min(16) as u16
        } else {
            width
        };
        let mut bits = address.bits;
        let registers = match given_step.map(|step| step.value) {
            None => u32::from(count) * u32::from(before),
            Some(Step::Addresses(step)) => u32::from(step) * u32::from(before),
            Some(Step::Bits(step)) => {
                let Some(first) = address.bits else {
                    let place = given_step.map_or(&address.place, |step| &step.place);
                    self.faults.add(place, "a step in bits of an address without a bit; expected a number of addresses, or `at` with a bit like `holding 1.0`");
                    return None;
                };
                let up = u32::from(step) * u32::from(before);
                let moved = |bit: u8| u8::try_from(u32::from(bit) + up).unwrap_or(u8::MAX);
                bits = Bits::new(moved(first.low()), moved(first.high()));
                if bits.is_none() {
                    self.lies_beyond(address, name, "bit 15 of its register");
                    return None;
                }
                0
            }
        };
        let first = u32::from(address.span.first()) + registers;
        let span = u16::try_from(first).ok().and_then(|first| Span::with_count(table, first, count));
        if span.is_none() {
            self.lies_beyond(address, name, &format!("{table} 65535"));
        }
        span.map(|span| Address { span, bits })
    }

    fn lies_beyond(&mut self, address: &At<Address>, name: &str, end: &str) {
        if !self.beyond.contains(&address.place) {
            self.beyond.push(address.place.clone());
            let message =
                format!("`{name}` would lie beyond {end}; expected a lower place or fewer repetitions");
            self.faults.add(&address.place, message);
        }
    }
}
