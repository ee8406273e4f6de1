//! Which points and things there are in which operating mode.

use std::fmt::Write as _;

use super::page::Page;
use super::words;
use crate::engine::device::{Condition, Device, PointIndex};

/// Writes the section, if the device has modes.
pub fn modes(page: &Page<'_>, text: &mut String) {
    let living = Living::all_of(page.device);
    if living.is_empty() {
        return;
    }
    let _ = writeln!(
        text,
        "## Operating modes\n\nSome points and things are there only while other points have certain values. \
         While one is not there, Home Assistant does not show it, its MQTT topic says `None`, it cannot be \
         written, and busker does not ask for it. What is not named here is always there.\n"
    );
    for deciders in Deciders::all_of(page.device, &living) {
        deciders.write(page, &living, text);
    }
    beside(page, &living, text);
}

/// A point or a thing that is not always there.
struct Living<'d> {
    name: &'d str,
    /// A cover, a button; `None`: a point.
    kind: Option<&'static str>,
    /// One for each point that decides.
    when: Vec<Condition>,
}

impl<'d> Living<'d> {
    fn all_of(device: &'d Device) -> Vec<Living<'d>> {
        let things = device.things.iter().map(|thing| Living {
            name: &thing.name,
            kind: Some(thing.kind.name()),
            when: words::merged(&thing.when),
        });
        let points = device.points.iter().map(|point| Living {
            name: &point.name,
            kind: None,
            when: words::merged(&point.when),
        });
        things.chain(points).filter(|living| !living.when.is_empty()).collect()
    }

    /// Whether it may be there while `decider` holds `raw`.
    fn is_possible(&self, decider: PointIndex, raw: i128) -> bool {
        self.when.iter().any(|condition| condition.point == decider && condition.holds(raw))
    }

    fn depends_on_several(&self) -> bool {
        self.when.len() > 1
    }
}

/// Points that decide, and that differ in their number only.
struct Deciders {
    points: Vec<PointIndex>,
    /// What stands before their number; `None` for one that has none.
    before_number: Option<String>,
    numbers: Vec<u32>,
    values: Vec<(i128, String)>,
}

impl Deciders {
    fn all_of(device: &Device, living: &[Living<'_>]) -> Vec<Deciders> {
        let mut all: Vec<Deciders> = Vec::new();
        for (index, point) in device.points.iter().enumerate() {
            if !living.iter().any(|living| living.when.iter().any(|condition| condition.point == index)) {
                continue;
            }
            let values = point.deciding_values();
            let ((before, behind), number) = words::around_first_number(&point.name);
            let is_sibling = |known: &&mut Deciders| {
                let frame = words::around_first_number(&device.points[known.points[0]].name).0;
                number.is_some() && frame == (before, behind) && known.values == values
            };
            match all.iter_mut().find(is_sibling) {
                Some(known) => {
                    known.points.push(index);
                    known.numbers.extend(number);
                }
                None => all.push(Deciders {
                    points: vec![index],
                    before_number: number.map(|_| before.to_string()),
                    numbers: number.into_iter().collect(),
                    values,
                }),
            }
        }
        all
    }

    fn write(&self, page: &Page<'_>, living: &[Living<'_>], text: &mut String) {
        let (device, first) = (page.device, &page.device.points[self.points[0]]);
        let shown: Vec<&str> = self
            .points
            .iter()
            .filter_map(|point| page.entities[*point].as_ref())
            .map(|entity| entity.name.as_str())
            .collect();
        let colon = if shown.is_empty() { "" } else { ": " };
        let (names, shown) = (page.names(&self.points), words::together_plain(&shown));
        let _ = writeln!(text, "### {names}{colon}{shown}\n");
        if self.points.len() > 1 {
            let _ = writeln!(text, "Each decides about what has its number, here N.\n");
        }
        let rows: Vec<[String; 5]> = self
            .values
            .iter()
            .map(|(raw, name)| {
                let factory = if first.default == Some(*raw) { " (factory setting)" } else { "" };
                [
                    format!("`{name}`{factory}"),
                    raw.to_string(),
                    self.told(device, living, *raw, |living| living.kind.is_some()),
                    self.told(device, living, *raw, |living| living.kind.is_none()),
                    self.told_if_more_holds(living, *raw),
                ]
            })
            .collect();
        const TITLES: [&str; 5] =
            ["Value", "Its number", "Things there", "Points there", "There if [more](#and-also) holds"];
        words::table(&TITLES, &rows, text);
    }

    /// What of it needs other settings too.
    fn told_if_more_holds(&self, living: &[Living<'_>], raw: i128) -> String {
        let is_possible =
            |living: &&Living<'_>| self.points.iter().any(|point| living.is_possible(*point, raw));
        let there = living.iter().filter(|living| living.depends_on_several()).filter(is_possible);
        names_of(there.map(|living| (living.name.to_string(), living.kind)))
    }

    /// What `wanted` there is while the register holds `raw`.
    fn told(
        &self,
        device: &Device,
        living: &[Living<'_>],
        raw: i128,
        wanted: impl Fn(&Living<'_>) -> bool,
    ) -> String {
        let there = |point: PointIndex| -> Vec<&Living<'_>> {
            let is_there = |living: &&Living<'_>| {
                wanted(living) && !living.depends_on_several() && living.is_possible(point, raw)
            };
            living.iter().filter(is_there).collect()
        };
        let (Some(before), true) = (&self.before_number, self.points.len() > 1) else {
            return names_of(
                there(self.points[0]).into_iter().map(|living| (living.name.into(), living.kind)),
            );
        };
        let of_each: Vec<Vec<(String, &Living<'_>)>> = self
            .points
            .iter()
            .zip(&self.numbers)
            .map(|(point, number)| {
                let there = there(*point).into_iter();
                there.map(|living| (words::with_n(living.name, (before, *number)), living)).collect()
            })
            .collect();
        let is_common = |name: &str| of_each.iter().all(|there| there.iter().any(|(other, _)| other == name));
        let common = of_each[0].iter().filter(|(name, _)| is_common(name));
        let mut parts = vec![names_of(common.map(|(name, living)| (name.clone(), living.kind)))];
        for (point, there) in self.points.iter().zip(&of_each) {
            let own = there.iter().filter(|(name, _)| !is_common(name));
            let own = names_of(own.map(|(_, living)| (living.name.to_string(), living.kind)));
            if !own.is_empty() {
                parts.push(format!("of `{}`: {own}", device.points[*point].name));
            }
        }
        parts.retain(|part| !part.is_empty());
        parts.join("; ")
    }
}

/// Names in a row; things with what they are.
fn names_of(names: impl Iterator<Item = (String, Option<&'static str>)>) -> String {
    let mut kinds: Vec<(Option<&'static str>, Vec<String>)> = Vec::new();
    for (name, kind) in names {
        match kinds.iter_mut().find(|(known, _)| *known == kind) {
            Some((_, names)) => names.push(name),
            None => kinds.push((kind, vec![name])),
        }
    }
    let told = |(kind, names): (Option<&'static str>, Vec<String>)| {
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        match kind {
            Some(kind) => format!("{kind} {}", words::together(&names)),
            None => words::together(&names),
        }
    };
    kinds.into_iter().map(told).collect::<Vec<_>>().join("; ")
}

/// What needs more than one setting.
fn beside(page: &Page<'_>, living: &[Living<'_>], text: &mut String) {
    let mut sharing: Vec<(&[Condition], Vec<&Living<'_>>)> = Vec::new();
    for living in living.iter().filter(|living| living.depends_on_several()) {
        match sharing.iter_mut().find(|(when, _)| *when == living.when) {
            Some((_, sharing)) => sharing.push(living),
            None => sharing.push((&living.when, vec![living])),
        }
    }
    if sharing.is_empty() {
        return;
    }
    let _ = writeln!(text, "### And also\n\nThese need more than one setting:\n");
    for (when, sharing) in sharing {
        let names = names_of(sharing.iter().map(|living| (living.name.to_string(), living.kind)));
        let _ = writeln!(text, "* {names}: while {}", words::condition(page.device, when));
    }
    text.push('\n');
}
