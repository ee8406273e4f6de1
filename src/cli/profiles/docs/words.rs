//! What a page says of one point, cell by cell, and how it says many things in few words.

use super::super::json::usual_registers;
use crate::engine::codec::{self, Resolved};
use crate::engine::device::{
    Case, Condition, Decimals, Device, Encoding, Form, Kind, Names, Platform, Point, PointIndex, Unit, Write,
    WriteRule,
};
use crate::engine::homeassistant::{Entity, entity};
use crate::engine::time::Duration;
use crate::engine::value::{Decimal, Reading};

/// Lists of more names than this get a table of their own.
pub const NAMES_IN_CELL: usize = 4;

/// While what a point lives, in a cell: of long lists only where they stand.
pub fn living(device: &Device, when: &[Condition]) -> String {
    let long = |condition: &&Condition| condition.values.len() > NAMES_IN_CELL;
    let when = merged(when);
    let (long, short): (Vec<_>, Vec<_>) = when.iter().partition(long);
    let mut parts: Vec<String> =
        short.into_iter().map(|short| condition(device, std::slice::from_ref(short))).collect();
    parts.extend(
        long.into_iter()
            .map(|long| format!("`{}` [allows it](#operating-modes)", device.points[long.point].name)),
    );
    parts.join(", and ")
}

/// What Home Assistant makes of a point while the device is set as it leaves the factory; of a point
/// that has none of its own then, what it makes of it in the first of the other settings that decide.
pub fn entity_of(device: &Device, index: PointIndex) -> Option<Entity> {
    settings(device, index).iter().find_map(|known| entity(device, index, known))
}

/// What the deciding registers can hold as far as that concerns this point, the usual first.
fn settings(device: &Device, index: PointIndex) -> Vec<Vec<Option<i128>>> {
    const MANY: usize = 1000;
    let point = &device.points[index];
    let touching = device.things.iter().filter(|thing| thing.shows(index) || thing.commands_point(index));
    let mut deciding: Vec<(PointIndex, Vec<i128>)> = Vec::new();
    for condition in point.when.iter().chain(touching.flat_map(|thing| &thing.when)) {
        if !deciding.iter().any(|(known, _)| *known == condition.point) {
            let values = device.points[condition.point].deciding_values();
            deciding.push((condition.point, values.into_iter().map(|(raw, _)| raw).collect()));
        }
    }
    if let Encoding::Cases { by, cases } = &point.encoding {
        deciding.retain(|(known, _)| known != by);
        deciding.push((*by, cases.iter().map(|case| case.key).collect()));
    }
    let mut settings = vec![usual_registers(device, index)];
    for (decider, values) in deciding {
        for at in 0..settings.len() {
            for value in &values {
                if settings.len() < MANY {
                    let mut other = settings[at].clone();
                    other[decider] = Some(*value);
                    settings.push(other);
                }
            }
        }
    }
    settings
}

/// While what a point or a thing lives: `mode` is `direct` or `motor`, and `enabled` is `ON`.
pub fn condition(device: &Device, when: &[Condition]) -> String {
    let each = |condition: &Condition| {
        let names: Vec<String> = condition.values.iter().map(|(_, name)| format!("`{name}`")).collect();
        format!("`{}` is {}", device.points[condition.point].name, or(&names))
    };
    merged(when).iter().map(each).collect::<Vec<_>>().join(", and ")
}

fn or(words: &[String]) -> String {
    match words {
        [] => "nothing that it can be".into(),
        [one] => one.clone(),
        [before @ .., last] => format!("{} or {last}", before.join(", ")),
    }
}

/// One condition for each point: one that is named twice has to have a value of both lists.
pub fn merged(when: &[Condition]) -> Vec<Condition> {
    let mut merged: Vec<Condition> = Vec::new();
    for condition in when {
        match merged.iter_mut().find(|known| known.point == condition.point) {
            Some(known) => known.values.retain(|(raw, _)| condition.holds(*raw)),
            None => merged.push(condition.clone()),
        }
    }
    merged
}

/// A switch, a number: Home Assistant's own word for it, and how several are called.
pub fn platform(platform: Platform) -> (&'static str, &'static str) {
    match platform {
        Platform::Sensor => ("sensor", "Sensors"),
        Platform::BinarySensor => ("binary sensor", "Binary sensors"),
        Platform::Switch => ("switch", "Switches"),
        Platform::Number => ("number", "Numbers"),
        Platform::Select => ("select", "Selections"),
        Platform::Button => ("button", "Buttons"),
        Platform::Text => ("text", "Texts"),
        Platform::Event => ("event", "Events"),
        Platform::Cover => ("cover", "Covers"),
        Platform::Valve => ("valve", "Valves"),
        Platform::Climate => ("climate", "Climates"),
    }
}

/// The unit, or the point that tells it.
pub fn unit(device: &Device, form: &Form) -> String {
    match &form.unit {
        Unit::None => String::new(),
        Unit::Fixed(unit) => unit.clone(),
        Unit::By(point) => {
            let point = &device.points[*point];
            let names = point.plain().map_or(&[][..], |form| form.names.list());
            let units: Vec<&str> = names.iter().map(|(_, name)| name.as_str()).collect();
            format!("{}, as `{}` says", units.join(" or "), point.name)
        }
    }
}

/// What it can be: names, a range, a kind of text. `table` is the link to where long lists stand.
pub fn range(device: &Device, index: PointIndex, form: &Form, table: Option<&str>) -> String {
    let point = &device.points[index];
    let rule = point.write.as_ref().map(|write| &write.rule);
    if matches!(rule, Some(WriteRule::Press { .. })) {
        return String::new();
    }
    let listed = match (table, form.names.list().len()) {
        (Some(table), _) => table.to_string(),
        (None, _) => codes(form.names.list().iter().map(|(_, name)| name.as_str())),
    };
    let mut parts = Vec::new();
    if form.elements > 1 {
        parts.push(format!("{} values, [on request](#on-request)", form.elements));
    }
    match (form.kind, &form.names) {
        (Kind::Bool, _) if point.event.is_some() => {
            parts.extend(point.event.iter().map(|event| format!("[event](#events) `{event}`")));
        }
        (Kind::Bool, _) => parts.push("`ON`, `OFF`".to_string()),
        (_, Names::All(_)) => parts.push(listed),
        (kind, _) if kind.is_text() => parts.push(text(kind)),
        _ if form.since.is_some() => parts.push(MOMENT.into()),
        (_, names) => {
            parts.extend(numbers(device, index, form, rule));
            if parts.is_empty() && form.kind.is_float() && rule.is_some() {
                parts.push("any number".into());
            }
            if let Names::Some(_) = names {
                let or = if parts.is_empty() { "a number, or" } else { "or" };
                parts.push(format!("{or} {listed}"));
            }
        }
    }
    if !form.invalid.is_empty() {
        let reasons: Vec<String> = form.invalid.iter().map(|(_, reason)| reason.replace('_', " ")).collect();
        parts.push(format!("no value when: {}", reasons.join(", ")));
    }
    parts.join("; ")
}

const MOMENT: &str = "a date and time, as `2026-11-27T05:24:00+00:00`";

fn text(kind: Kind) -> String {
    match kind {
        Kind::LetterNumber => "a letter and a number, as `R017`".into(),
        Kind::DayMonthYear => "a date, as `01.01.2018`".into(),
        kind => format!("text of up to {} characters", 2 * kind.registers()),
    }
}

fn numbers(device: &Device, index: PointIndex, form: &Form, rule: Option<&WriteRule>) -> Option<String> {
    if let Some(Decimals::By(point)) = form.decimals {
        let dot = format!("`{}` says how many digits stand behind the dot", device.points[point].name);
        return Some(match rule {
            Some(WriteRule::Range { min, max, .. }) => format!("{min} to {max} without the dot; {dot}"),
            _ => dot,
        });
    }
    let resolved = codec::resolve(device, index, &usual_registers(device, index)).ok()?;
    match rule.and_then(|rule| codec::limits(&resolved, rule)) {
        Some(limits) => Some(span_of_numbers(limits.min, limits.max, limits.step)),
        None => measured(form),
    }
}

/// The measuring range of a form and its finest step, as the manual gives it.
pub fn measured(form: &Form) -> Option<String> {
    let digits = match form.decimals {
        Some(Decimals::Fixed(decimals)) => decimals,
        Some(Decimals::By(_)) | None => 0,
    };
    let step = Decimal { units: form.scale.units.abs(), decimals: form.scale.decimals + digits };
    let step = (!form.kind.is_float()).then_some(step);
    let (mut min, mut max) = match (form.range, step) {
        (Some(range), _) => range,
        (None, Some(step)) if step.compare(Decimal::ONE).is_ne() => return Some(steps(step)),
        _ => return None,
    };
    if form.difference {
        max = max.checked_add(min.negated())?;
        min = max.negated();
    }
    Some(span_of_numbers(min, max, step))
}

fn span_of_numbers(min: Decimal, max: Decimal, step: Option<Decimal>) -> String {
    let span = format!("{} to {}", min.normalized(), max.normalized());
    match step.filter(|step| step.compare(Decimal::ONE).is_ne()) {
        Some(step) => format!("{span} {}", steps(step)),
        None => span,
    }
}

fn steps(step: Decimal) -> String {
    format!("in steps of {}", step.normalized())
}

/// The factory setting as it is shown.
pub fn default(device: &Device, index: PointIndex) -> String {
    let Some(raw) = device.points[index].default else { return String::new() };
    let shown = codec::resolve(device, index, &usual_registers(device, index)).ok();
    match shown.map(|resolved| codec::read(&resolved, &words(&resolved, raw))) {
        Some(Reading::Missing(_)) | None => format!("register {raw}"),
        Some(reading @ (Reading::Name(_) | Reading::Text(_) | Reading::Flag(_))) => format!("`{reading}`"),
        Some(Reading::Number(number)) => number.normalized().to_string(),
        Some(reading) => reading.to_string(),
    }
}

/// A register field as the words that carry it on the wire.
fn words(resolved: &Resolved<'_>, raw: i128) -> Vec<u16> {
    let order = resolved.form.order;
    let count = u32::from(resolved.form.kind.registers());
    let mut words: Vec<u16> = (0..count).rev().map(|place| (raw >> (16 * place)) as u16).collect();
    if order.low_word_first() {
        words.reverse();
    }
    if order.swaps_bytes() {
        words.iter_mut().for_each(|word| *word = word.swap_bytes());
    }
    words
}

/// Where it stands, in the manual's words.
pub fn place(point: &Point) -> String {
    match point.also {
        Some(also) => format!("{}, also {also}", point.at),
        None => point.at.to_string(),
    }
}

/// Whether it can be written, and how; where, if that is another place, stands in its row.
pub fn writing(device: &Device, point: &Point) -> String {
    let Some(Write { with, rule, settle, on_change, .. }) = &point.write else { return "no".into() };
    let mut words = vec![match rule {
        WriteRule::Any | WriteRule::Range { .. } => "yes".to_string(),
        WriteRule::Names(names) => format!("only {}", codes(names.iter().map(String::as_str))),
        WriteRule::Press { .. } => "press".into(),
    }];
    words.extend(with.map(|function| format!("with function {} only", function.code())));
    let names = point.plain().map_or(&[][..], |form| form.names.list());
    let between = on_change.and_then(|raw| names.iter().find(|(value, _)| *value == raw));
    words.extend(between.map(|(_, name)| format!("the same again with `{name}` between")));
    if !settle.is_zero() {
        words.push(format!("read back after {}", duration(*settle)));
    }
    words.extend(
        point.heartbeat.map(|time| format!("repeated by busker within `{}`", device.points[time].name)),
    );
    words.join(", ")
}

/// One case of a point that another decides about: its unit and its range.
pub fn case(device: &Device, case: &Case) -> (String, String) {
    let Some(form) = &case.form else { return (String::new(), "no value".into()) };
    let mut range = match (form.kind, &form.names) {
        (Kind::Bool, _) => "`ON`, `OFF`".into(),
        (kind, _) if kind.is_text() => text(kind),
        _ if form.since.is_some() => MOMENT.into(),
        (_, Names::All(names)) => codes(names.iter().map(|(_, name)| name.as_str())),
        (_, names) => {
            let names = codes(names.list().iter().map(|(_, name)| name.as_str()));
            let or = if names.is_empty() { names } else { format!(", or {names}") };
            format!("{}{or}", measured(form).unwrap_or_default())
        }
    };
    if let Some(Decimals::By(point)) = form.decimals {
        range = format!("`{}` says how many digits stand behind the dot", device.points[point].name);
    }
    (unit(device, form), range)
}

/// `ok`, `reset`: names as code, with commas.
pub fn codes<'n>(names: impl IntoIterator<Item = &'n str>) -> String {
    names.into_iter().map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ")
}

/// Names that differ in one number only are told as a range: `relay_1` to `relay_4`.
pub fn together(names: &[&str]) -> String {
    folded(names).iter().map(|run| run.told(|name| format!("`{name}`"))).collect::<Vec<_>>().join(", ")
}

/// The same for what people read: Relay 1 to 4.
pub fn together_plain(names: &[&str]) -> String {
    let told = |run: &Run| match (run.names.as_slice(), run.last_number()) {
        ([first, .., last], Some(number)) if last.ends_with(&number.to_string()) => {
            let to = if run.names.len() == 2 { "and" } else { "to" };
            format!("{first} {to} {number}")
        }
        _ => run.told(str::to_string),
    };
    folded(names).iter().map(told).collect::<Vec<_>>().join(", ")
}

/// Names in a row, of which each has one number that is one more than in the name before.
struct Run<'n> {
    names: Vec<&'n str>,
    /// Which of the numbers; not known of a single name.
    counts: Option<usize>,
}

impl<'n> Run<'n> {
    fn told(&self, show: impl Fn(&str) -> String) -> String {
        match self.names.as_slice() {
            [one] => show(one),
            [first, second] => format!("{} and {}", show(first), show(second)),
            [first, .., last] => format!("{} to {}", show(first), show(last)),
            [] => String::new(),
        }
    }

    fn last_number(&self) -> Option<u32> {
        pieces(self.names.last()?).get(self.counts?)?.1
    }

    /// Which number `name` counts on, if it is the next of the run.
    fn goes_on_with(&self, name: &str) -> Option<usize> {
        let (last, next) = (pieces(self.names.last()?), pieces(name));
        if last.len() != next.len() {
            return None;
        }
        let differs = |at: &usize| last[*at] != next[*at];
        let mut different = (0..last.len()).filter(differs);
        let (at, None) = (different.next()?, different.next()) else { return None };
        let (before, after) = (last[at], next[at]);
        let is_next = before.0 == after.0 && before.1.and_then(|number| number.checked_add(1)) == after.1;
        (is_next && after.1.is_some() && self.counts.is_none_or(|counts| counts == at)).then_some(at)
    }
}

fn folded<'n>(names: &[&'n str]) -> Vec<Run<'n>> {
    let mut runs: Vec<Run<'n>> = Vec::new();
    for &name in names {
        let next = runs.iter().enumerate().find_map(|(at, run)| Some((at, run.goes_on_with(name)?)));
        match next {
            Some((at, counts)) => {
                runs[at].names.push(name);
                runs[at].counts = Some(counts);
            }
            None => runs.push(Run { names: vec![name], counts: None }),
        }
    }
    runs
}

/// Texts, each with the number behind it; the last may have none.
fn pieces(name: &str) -> Vec<(&str, Option<u32>)> {
    let mut pieces = Vec::new();
    let mut rest = name;
    while let ((before, behind), Some(number)) = around_first_number(rest) {
        pieces.push((before, Some(number)));
        rest = behind;
    }
    pieces.push((rest, None));
    pieces
}

/// `name` with N for the number of what it belongs to, which is called `frame.0` and then that number.
/// What does not have that in its name has N for its first number, if it is the same.
pub fn with_n(name: &str, (before, number): (&str, u32)) -> String {
    let own = format!("{before}{number}");
    let is_whole = |at: &usize| {
        let behind = &name[at + own.len()..];
        let begins = *at == 0 || name[..*at].ends_with('_');
        begins && !behind.starts_with(|c: char| c.is_ascii_digit())
    };
    if let Some((at, _)) = name.match_indices(&own).find(|(at, _)| is_whole(at)) {
        return format!("{}{before}N{}", &name[..at], &name[at + own.len()..]);
    }
    match around_first_number(name) {
        ((before, behind), Some(first)) if first == number => format!("{before}N{behind}"),
        _ => name.to_string(),
    }
}

/// What stands before and behind the first number of a name, and that number.
pub fn around_first_number(name: &str) -> ((&str, &str), Option<u32>) {
    let is_digit = |c: char| c.is_ascii_digit();
    let Some(start) = name.find(is_digit) else { return ((name, ""), None) };
    let rest = &name[start..];
    let end = start + rest.find(|c| !is_digit(c)).unwrap_or(rest.len());
    ((&name[..start], &name[end..]), name[start..end].parse().ok())
}

/// A table. A column in which nothing stands only makes the others narrow, and is left away.
pub fn table<const N: usize>(titles: &[&str; N], rows: &[[String; N]], text: &mut String) {
    let filled: Vec<usize> = (0..N).filter(|at| rows.iter().any(|row| !row[*at].is_empty())).collect();
    let line = |cells: Vec<String>| format!("| {} |\n", cells.join(" | "));
    text.push_str(&line(filled.iter().map(|column| titles[*column].to_string()).collect()));
    text.push_str(&format!("|{}\n", "---|".repeat(filled.len())));
    for row in rows {
        text.push_str(&line(filled.iter().map(|column| cell(&row[*column])).collect()));
    }
    text.push('\n');
}

/// A bar would end the cell.
pub fn cell(text: &str) -> String {
    text.replace('|', "\\|")
}

/// 500 ms, 30 s, 1.5 s.
pub fn duration(duration: Duration) -> String {
    let millis = duration.as_millis();
    if millis < 1000 {
        format!("{millis} ms")
    } else {
        let seconds = Decimal { units: millis as i128, decimals: 3 };
        format!("{} s", seconds.normalized())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_in_a_row_are_told_as_a_range() {
        for (names, expected) in [
            (vec!["watchdog"], "`watchdog`"),
            (vec!["relay_1", "relay_2"], "`relay_1` and `relay_2`"),
            (vec!["relay_1", "watchdog", "relay_2", "relay_3"], "`relay_1` to `relay_3`, `watchdog`"),
            (
                vec!["a_1_on", "a_1_off", "a_2_on", "a_2_off"],
                "`a_1_on` and `a_2_on`, `a_1_off` and `a_2_off`",
            ),
            (vec!["relay_1", "relay_3"], "`relay_1`, `relay_3`"),
            (
                vec!["input_1_for_relay_1", "input_1_for_relay_2", "input_2_for_relay_2"],
                "`input_1_for_relay_1` and `input_1_for_relay_2`, `input_2_for_relay_2`",
            ),
        ] {
            assert_eq!(together(&names), expected);
        }
        assert_eq!(together_plain(&["Relay 1", "Relay 2", "Relay 3", "Reset"]), "Relay 1 to 3, Reset");
        assert_eq!(
            together_plain(&["Meter 1 digits", "Meter 2 digits"]),
            "Meter 1 digits and Meter 2 digits"
        );
        assert_eq!(together_plain(&["Relay 1", "Relay 2"]), "Relay 1 and 2");
        assert_eq!(together_plain(&["Input 1 of relay 1", "Input 1 of relay 2"]), "Input 1 of relay 1 and 2");
    }

    #[test]
    fn what_belongs_to_a_number_has_n_in_its_place() {
        for (name, expected) in [
            ("relay_1_hand", "relay_N_hand"),
            ("input_1_leak_for_relay_1", "input_1_leak_for_relay_N"),
            ("relay_12_hand", "relay_12_hand"),
            ("valve_1", "valve_N"),
            ("valve_2", "valve_2"),
            ("watchdog", "watchdog"),
        ] {
            assert_eq!(with_n(name, ("relay_", 1)), expected);
        }
    }

    #[test]
    fn durations_are_told_in_the_unit_that_people_would_use() {
        for (millis, expected) in [(50, "50 ms"), (1000, "1 s"), (1500, "1.5 s"), (60_000, "60 s")] {
            assert_eq!(duration(Duration::from_millis(millis)), expected);
        }
    }
}
