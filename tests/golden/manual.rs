//! Each profile beside a second reading of its manual, by somebody who had not seen the profile:
//! `tests/golden/<profile>/manual.tsv` (see `rows.rs`) says the same of every register, or one of the
//! two is wrong. Which one only the manual can tell.

use std::collections::BTreeSet;
use std::fs;

use busker::engine::address::{Address, Span};
use busker::engine::device::{
    Decimals, Device, Encoding, Form, Kind, Names, Point, PointIndex, Unit, WriteRule,
};
use busker::engine::value::Decimal;

use crate::rows::{Access, Row, Said, rows};
use crate::{place, shipped};

#[test]
fn the_profiles_say_what_a_second_reader_found_in_the_manual() {
    let mut all = Vec::new();
    for (id, device) in shipped() {
        let Ok(file) = fs::read_to_string(place(id, "manual.tsv")) else { continue };
        let name = format!("tests/golden/{id}/manual.tsv");
        match rows(&file) {
            Ok(rows) => {
                all.extend(differences(device, &rows).into_iter().map(|text| format!("{name}{text}")))
            }
            Err(fault) => all.push(format!("{name}: {fault}")),
        }
    }
    assert!(all.is_empty(), "{} differences\n{}\n", all.len(), all.join("\n"));
}

#[test]
fn every_profile_has_a_second_reading() {
    for (id, _) in shipped() {
        assert!(place(id, "manual.tsv").exists(), "tests/golden/{id}/manual.tsv is missing");
    }
}

/// `:LINE: PLACE …` for each attribute of each row that the device sees otherwise, and a line for each
/// point and each span left out that no row has.
fn differences(device: &Device, rows: &[Row]) -> Vec<String> {
    let mut found = BTreeSet::new();
    for row in rows {
        let heading = format!(":{}: {}", row.line, row.place);
        if row.access == Access::Out {
            if !is_left_out(device, row.place.span) {
                found.insert((row.line, format!("{heading} is not left out")));
            }
            continue;
        }
        let here = device.points.iter().filter(|point| lies_at(point, row.place));
        match here.map(|point| about(device, point, row)).min_by_key(Vec::len) {
            Some(list) => found.extend(list.into_iter().map(|text| (row.line, format!("{heading} {text}")))),
            None => {
                found.insert((row.line, format!("{heading} {}", instead(device, row.place))));
            }
        }
    }
    for point in &device.points {
        for address in places_of(point) {
            let here = rows.iter().filter(|row| row.access != Access::Out && row.place == address);
            match here.map(|row| (row, about(device, point, row))).min_by_key(|(_, list)| list.len()) {
                Some((row, list)) => found.extend(
                    list.into_iter().map(|text| (row.line, format!(":{}: {} {text}", row.line, row.place))),
                ),
                None => {
                    found.insert((usize::MAX, format!(": {address} ({}) has no row", point.name)));
                }
            }
        }
    }
    for span in device.left_out.iter().map(|left_out| left_out.span) {
        for at in span.first()..=span.last() {
            let at = Span::single(span.table(), at);
            if !rows.iter().any(|row| row.place.span.contains(at)) {
                found.insert((usize::MAX, format!(": {at} is left out and has no row")));
            }
        }
    }
    found.into_iter().map(|(_, text)| text).collect()
}

fn is_left_out(device: &Device, span: Span) -> bool {
    let is_left_out = |at| device.left_out.iter().any(|left_out| left_out.span.contains(at));
    (span.first()..=span.last()).all(|at| is_left_out(Span::single(span.table(), at)))
}

fn places_of(point: &Point) -> BTreeSet<Address> {
    let write = point.write.as_ref().map(|write| write.at);
    [Some(point.at), point.also, write].into_iter().flatten().collect()
}

fn lies_at(point: &Point, place: Address) -> bool {
    places_of(point).contains(&place)
}

/// What is found where a point should be.
fn instead(device: &Device, place: Address) -> String {
    let overlaps = |address: &Address| address.overlaps(place);
    let near: Vec<String> = device
        .points
        .iter()
        .filter_map(|point| Some((point, places_of(point).into_iter().find(overlaps)?)))
        .map(|(point, address)| format!("{} at {address}", point.name))
        .collect();
    match near.is_empty() {
        true if is_left_out(device, place.span) => "is left out".into(),
        true => "has no point".into(),
        false => format!("has no point, but there is {}", near.join(", ")),
    }
}

/// In what the point differs from the row, which are at the same place.
fn about(device: &Device, point: &Point, row: &Row) -> Vec<String> {
    let mut found = Vec::new();
    let mut compare = |what: &str, manual: String, profile: String| {
        if manual != profile {
            found.push(format!(
                "({}): {what} is {manual} in the manual, {profile} in the profile",
                point.name
            ));
        }
    };
    compare("type", kind_said(device, point, row), kind(device, point));
    compare("access", said_as(row.access), access(device, row));
    // Of what is only read, and of buttons, a profile does not say where it is kept.
    if point.write.is_some() && !point.is_button() {
        compare("eeprom", yes(row.is_persistent), yes(point.persistent));
    }
    compare("default", or_dash(row.default), or_dash(point.default));
    if let (Encoding::Plain(form), false) = (&point.encoding, point.is_button()) {
        let has_scale =
            form.kind != Kind::Bool && !form.kind.is_text() && !matches!(form.names, Names::All(_));
        if has_scale || row.scale != Said::Nothing {
            compare("scale", scale_said(device, form, row), scale(device, form));
        }
        compare("unit", unit_said(device, form, row), unit(device, form));
        compare("values", list(&row.values), list(&values(point, form, row)));
        if !form.kind.is_text() {
            let (manual, profile) = (bounds_said(point, form, row), bounds(point, form));
            compare("min", or_dash(manual.0), or_dash(profile.0));
            compare("max", or_dash(manual.1), or_dash(profile.1));
        }
    }
    if let (Encoding::Cases { cases, .. }, false) = (&point.encoding, row.values.is_empty()) {
        let names = cases.iter().filter_map(|case| case.form.as_ref()).flat_map(|form| form.names.list());
        let keys: BTreeSet<i128> = names.map(|(key, _)| *key).collect();
        compare("values", list(&row.values), list(&keys.into_iter().collect::<Vec<_>>()));
    }
    if let Some(WriteRule::Press { word, .. }) = point.write.as_ref().map(|write| &write.rule) {
        compare("word", or_dash(row.min.map(Decimal::normalized)), word.to_string());
    }
    found
}

fn yes(is_so: bool) -> String {
    if is_so { "yes".into() } else { "no".into() }
}

fn or_dash(number: Option<impl ToString>) -> String {
    number.map_or("-".into(), |number| number.to_string())
}

fn list(numbers: &[i128]) -> String {
    let numbers: Vec<String> = numbers.iter().map(i128::to_string).collect();
    if numbers.is_empty() { "-".into() } else { numbers.join(" ") }
}

/// The row's word for what it names; a place that decides is the deciding point's own, so that either
/// of its two places will do.
fn said(device: &Device, said: &Said, by: Option<PointIndex>) -> String {
    match said {
        Said::Nothing => "-".into(),
        Said::Text(text) => text.clone(),
        Said::By(place) => match by.map(|by| &device.points[by]) {
            Some(point) if lies_at(point, *place) => by_point(point),
            _ => format!("by:{place}"),
        },
    }
}

fn by_point(point: &Point) -> String {
    format!("by:{}", point.at)
}

fn kind_said(device: &Device, point: &Point, row: &Row) -> String {
    let by = if let Encoding::Cases { by, .. } = &point.encoding { Some(*by) } else { None };
    said(device, &row.kind, by)
}

fn kind(device: &Device, point: &Point) -> String {
    match &point.encoding {
        _ if point.is_button() => "press".into(),
        Encoding::Cases { by, .. } => by_point(&device.points[*by]),
        Encoding::Plain(form) if form.elements > 1 => format!("{}×{}", form.kind.name(), form.elements),
        Encoding::Plain(form) if form.kind == Kind::U16 => match bits(point) {
            Some(1) => "bool".into(),
            Some(_) => "bits".into(),
            None => form.kind.name(),
        },
        Encoding::Plain(form) => form.kind.name(),
    }
}

/// How many bits the point has, if it is no register.
fn bits(point: &Point) -> Option<u32> {
    match point.at.bits {
        Some(bits) => Some(bits.width().into()),
        None => point.at.span.table().is_bits().then(|| point.at.span.count()),
    }
}

fn said_as(access: Access) -> String {
    let word = match access {
        Access::Read => "r",
        Access::Write => "w",
        Access::ReadWrite => "rw",
        Access::Out => "out",
    };
    word.into()
}

/// What the points do at the row's place. A value that stands in two places is read and written at the
/// one that costs less, and one point may read what another writes.
fn access(device: &Device, row: &Row) -> String {
    let here = || device.points.iter().filter(|point| lies_at(point, row.place));
    let is_written_at =
        |place| device.points.iter().filter_map(|point| point.write.as_ref()).any(|write| write.at == place);
    let reads = here().any(|point| match row.access {
        Access::ReadWrite => !point.is_button(),
        access => is_read_at(point, row.place) && (access != Access::Write || point.is_read()),
    });
    let writes = match row.access {
        Access::Read => is_written_at(row.place),
        _ => here().flat_map(places_of).any(is_written_at),
    };
    match (reads, writes) {
        (true, true) => "rw".into(),
        (true, false) => "r".into(),
        (false, true) => "w".into(),
        (false, false) => "-".into(),
    }
}

fn is_read_at(point: &Point, place: Address) -> bool {
    !point.is_button() && (point.at == place || point.also == Some(place))
}

fn scale_said(device: &Device, form: &Form, row: &Row) -> String {
    match &row.scale {
        Said::Nothing => "1".into(),
        Said::Text(text) => Decimal::parse(text).map_or(text.clone(), |scale| scale.normalized().to_string()),
        by => said(device, by, if let Some(Decimals::By(by)) = form.decimals { Some(by) } else { None }),
    }
}

/// What one more in the register is in the unit, and what is added: `0.01`, `0.1 + -40`.
pub fn scale(device: &Device, form: &Form) -> String {
    let shift = match form.decimals {
        Some(Decimals::By(by)) => return by_point(&device.points[by]),
        Some(Decimals::Fixed(shift)) => shift,
        None => 0,
    };
    let step = Decimal { units: form.scale.units, decimals: form.scale.decimals + shift }.normalized();
    match form.offset {
        Decimal { units: 0, .. } => step.to_string(),
        offset => format!("{step} + {offset}"),
    }
}

fn unit_said(device: &Device, form: &Form, row: &Row) -> String {
    said(device, &row.unit, if let Unit::By(by) = form.unit { Some(by) } else { None })
}

pub fn unit(device: &Device, form: &Form) -> String {
    match &form.unit {
        Unit::None => "-".into(),
        Unit::Fixed(unit) => unit.clone(),
        Unit::By(by) => by_point(&device.points[*by]),
    }
}

/// The numbers that the profile names. A flag's need no names, and those of the registers that a point
/// refers to are not the manual's. Where it is only written, some of the numbers will do.
fn values(point: &Point, form: &Form, row: &Row) -> Vec<i128> {
    if row.values.is_empty() && (form.kind == Kind::Bool || point.refers.is_some()) {
        return Vec::new();
    }
    let mut keys: Vec<i128> = match form.kind {
        Kind::Bool => vec![0, 1],
        _ => form.names.list().iter().map(|(key, _)| *key).collect(),
    };
    keys.sort_unstable();
    // Values that the manual tells apart and the profile does not, since they mean the same.
    if form.others.is_some() && keys.iter().all(|key| row.values.contains(key)) {
        return row.values.clone();
    }
    let are_some = !is_read_at(point, row.place) && keys.iter().all(|key| row.values.contains(key));
    if are_some { row.values.clone() } else { keys }
}

type Bounds = (Option<Decimal>, Option<Decimal>);

/// Where the row says nothing, all that is named or all that fits.
fn bounds_said(point: &Point, form: &Form, row: &Row) -> Bounds {
    let (first, last) = match &form.names {
        Names::All(_) => ends_of_names(form, |_| true),
        _ => whole_range(point, form),
    };
    (row.min.map(Decimal::normalized).or(first), row.max.map(Decimal::normalized).or(last))
}

/// The smallest and largest number, as the register holds it, that may be written; of what cannot be
/// written, that can be read.
fn bounds(point: &Point, form: &Form) -> Bounds {
    match point.write.as_ref().map(|write| &write.rule) {
        Some(WriteRule::Range { min, max, .. }) => in_register(form, *min, *max),
        Some(WriteRule::Names(written)) => {
            ends_of_names(form, |name| written.iter().any(|written| written == name))
        }
        _ => match (form.range, &form.names) {
            (Some((min, max)), _) => in_register(form, min, max),
            (None, Names::All(_)) => ends_of_names(form, |_| true),
            (None, _) => whole_range(point, form),
        },
    }
}

fn ends_of_names(form: &Form, is_meant: impl Fn(&str) -> bool) -> Bounds {
    let names = form.names.list().iter().filter(|(_, name)| is_meant(name));
    let keys: BTreeSet<i128> = names.map(|(key, _)| *key).collect();
    (keys.first().copied().map(Decimal::integer), keys.last().copied().map(Decimal::integer))
}

fn whole_range(point: &Point, form: &Form) -> Bounds {
    let Some((min, max)) = form.kind.integer_range() else { return (None, None) };
    let max = bits(point).map_or(max, |bits| max.min((1 << bits) - 1));
    (Some(Decimal::integer(min)), Some(Decimal::integer(max)))
}

/// A range in the unit as the register's numbers: the outermost that lie within.
fn in_register(form: &Form, min: Decimal, max: Decimal) -> Bounds {
    let shift = match form.decimals {
        // There the range is the register's own.
        Some(Decimals::By(_)) => return (Some(min.normalized()), Some(max.normalized())),
        Some(Decimals::Fixed(shift)) => shift,
        None => 0,
    };
    let step = Decimal { units: form.scale.units, decimals: form.scale.decimals + shift };
    if step.compare(Decimal::ONE).is_eq() && form.offset == Decimal::ZERO {
        return (Some(min.normalized()), Some(max.normalized()));
    }
    let steps = |end: Decimal, up: bool| {
        let end = end.checked_add(form.offset.negated()).expect("a number of a manual");
        let decimals = end.decimals.max(step.decimals);
        let units = |number: Decimal| number.with_decimals(decimals).expect("a number of a manual").units;
        let (end, step) = (units(end), units(step));
        let down = end.div_euclid(step);
        Decimal::integer(if up && down * step != end { down + 1 } else { down })
    };
    (Some(steps(min, true)), Some(steps(max, false)))
}

/// A device of which a table is right, and then wrong in one cell after the other.
const PROFILE: &str = "
device: acme/ra8
manufacturer: Acme
model: RA8
source: nothing
points:
  relay: {at: holding 0.0, also: coil 0, poll: fast, write: any}
  mode: {at: holding 1, poll: slow, values: {0: volt, 1: amp}, write: any, persistent: true, default: 1}
  digits: {at: holding 2.0..7, poll: slow, write: 0..3}
  total: {at: input 0, type: u32, decimals: digits, unit: kWh, poll: slow}
  limit: {at: holding 3, type: i16, scale: 0.5, decimals: 1, unit: V, poll: slow, write: -5..0.52}
  value: {at: input 2, poll: fast, by: mode, is: {volt: {unit: V, type: u16, values: {9: max}}, amp: {unit: A}}}
  reset: {at: holding 4, press: 0x55AA}
left_out: {holding 65: line settings}
";

const TABLE: &str = "
coil 0|bool|-|-|rw|-|-|-|no|0=off 1=on
holding 0.0|bool|-|-|rw|-|-|-|-|-
holding 1|u16|-|-|rw|-|-|1|yes|0=volt 1=amp
holding 2.0..7|bits|-|-|rw|0|3|-|no|-
input 0..1|u32|by:holding 2.0..7|kWh|r|-|-|-|no|-
holding 3|i16|0.05|V|rw|-100|10|-|no|-
input 2|by:holding 1|-|-|r|-|-|-|no|9=max
holding 4|press|-|-|w|21930|21930|-|no|-
holding 65|-|-|-|out|-|-|-|-|-
";

#[test]
fn each_difference_between_table_and_profile_is_told() {
    let mut library = busker::engine::profile::Library::default();
    library.add("acme/ra8.yaml", "ra8.yaml", PROFILE.as_bytes().to_vec());
    let device = library.load("acme/ra8").unwrap_or_else(|faults| panic!("{}", faults[0]));
    let check = |row: &str, instead: &str, expected: &[&str]| {
        assert!(TABLE.contains(row), "{row} is in the table");
        let rows_of = TABLE.replace(row, instead).replace('|', "\t");
        let lines = rows_of.lines().filter(|line| !line.is_empty()).map(|line| format!("\n{line}\t1"));
        let file = format!("{}{}", crate::rows::HEADER, lines.collect::<String>());
        let rows = rows(&file).unwrap_or_else(|fault| panic!("{instead}: {fault}"));
        let found: Vec<String> = differences(&device, &rows)
            .iter()
            .map(|text| text.split_once(": ").map_or("", |(_, text)| text).to_string())
            .collect();
        assert_eq!(found, expected, "{instead}");
    };
    check("coil 0", "coil 0", &[]);
    let cell = |row: &str, instead: &str, expected: &str| check(row, instead, &[expected]);
    cell("coil 0|bool", "coil 0|u16", "coil 0 (relay): type is u16 in the manual, bool in the profile");
    cell("kWh|r", "kWh|rw", "input 0..1 (total): access is rw in the manual, r in the profile");
    cell("3|-|no|-", "3|-|yes|-", "holding 2.0..7 (digits): eeprom is yes in the manual, no in the profile");
    cell("1|yes", "-|yes", "holding 1 (mode): default is - in the manual, 1 in the profile");
    cell("0.05", "0.5", "holding 3 (limit): scale is 0.5 in the manual, 0.05 in the profile");
    cell(
        "by:holding 2.0..7",
        "by:holding 3",
        "input 0..1 (total): scale is by:holding 3 in the manual, by:holding 2.0..7 in the profile",
    );
    cell("kWh", "-", "input 0..1 (total): unit is - in the manual, kWh in the profile");
    cell("-100|10", "-100|11", "holding 3 (limit): max is 11 in the manual, 10 in the profile");
    cell("-100|10", "-|10", "holding 3 (limit): min is -32768 in the manual, -100 in the profile");
    cell("0=volt 1=amp", "1=amp", "holding 1 (mode): values is 1 in the manual, 0 1 in the profile");
    cell("9=max", "8=max", "input 2 (value): values is 8 in the manual, 9 in the profile");
    cell("by:holding 1", "u16", "input 2 (value): type is u16 in the manual, by:holding 1 in the profile");
    cell(
        "21930|21930",
        "21931|21931",
        "holding 4 (reset): word is 21931 in the manual, 21930 in the profile",
    );
    cell("holding 65|-|-|-|out", "holding 65|u16|-|-|r", "holding 65 is left out");
    cell("holding 65|-|-|-|out", "holding 65..66|-|-|-|out", "holding 65..66 is not left out");
    check("coil 0", "coil 1", &["coil 1 has no point", "coil 0 (relay) has no row"]);
    check(
        "holding 2.0..7|bits",
        "holding 2|u16",
        &[
            "holding 2 has no point, but there is digits at holding 2.0..7",
            "holding 2.0..7 (digits) has no row",
        ],
    );
    check(
        "holding 65",
        "holding 66",
        &["holding 66 is not left out", "holding 65 is left out and has no row"],
    );
}
