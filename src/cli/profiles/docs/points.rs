//! The points of a device in tables: what they mean, repeated ones in one row; lists that are too long
//! for a cell; and every point with its address.

use std::fmt::Write as _;

use super::page::Page;
use super::words;
use crate::engine::address::{Address, Bits, Table};
use crate::engine::device::{Category, Encoding, Form, PointIndex, Unit};

/// Writes all of it.
pub fn points(page: &Page<'_>, text: &mut String) {
    let tables = LongTable::all_of(page);
    let _ = writeln!(
        text,
        "## Points\n\nPoints that differ only in their number share a row, and N stands for that number. *Off*: \
         there in Home Assistant, but switched off.\n"
    );
    for (title, category) in [
        ("Values and controls", None),
        ("Settings", Some(Category::Config)),
        ("Diagnostics", Some(Category::Diagnostic)),
    ] {
        let of_category = |index: &PointIndex| {
            page.entities[*index].as_ref().and_then(|entity| entity.category) == category
        };
        let points: Vec<PointIndex> = (0..page.device.points.len()).filter(of_category).collect();
        if !points.is_empty() {
            let _ = writeln!(text, "### {title}\n");
            meanings(page, &tables, &points, text);
        }
    }
    for (number, table) in tables.iter().enumerate() {
        let _ = writeln!(text, "### Table {}\n", number + 1);
        table.write(page, text);
    }
    addresses(page, text);
}

/// What one row says. Compared cell by cell to see what can share a row.
#[derive(PartialEq)]
struct Row {
    /// Before and behind the number.
    frame: (String, String),
    platform: String,
    unit: String,
    range: String,
    default: String,
    writing: String,
    is_written_elsewhere: bool,
    kept: &'static str,
    living: String,
}

const TITLES: [&str; 10] = [
    "Point",
    "In Home Assistant",
    "Shown as",
    "Only while",
    "Unit",
    "Can be",
    "Factory setting",
    "Can be written",
    "Kept in",
    "Address",
];

fn meanings(page: &Page<'_>, tables: &[LongTable], points: &[PointIndex], text: &mut String) {
    let mut rows: Vec<(Row, Vec<PointIndex>)> = Vec::new();
    for &index in points {
        let row = Row::of(page, tables, index);
        match rows.iter_mut().find(|(known, _)| *known == row) {
            Some((_, sharing)) => sharing.push(index),
            None => rows.push((row, vec![index])),
        }
    }
    let rows: Vec<[String; 10]> = rows.into_iter().map(|(row, sharing)| row.cells(page, &sharing)).collect();
    words::table(&TITLES, &rows, text);
}

impl Row {
    fn of(page: &Page<'_>, tables: &[LongTable], index: PointIndex) -> Row {
        let device = page.device;
        let point = &device.points[index];
        let (frame, number) = words::around_first_number(&point.name);
        // Beside its siblings a point speaks of its own number as N.
        let own = number.map(|number| format!("`{}{number}_", frame.0)).unwrap_or("`".into());
        let with_n = number.map(|_| format!("`{}N_", frame.0)).unwrap_or("`".into());
        let of_any = |text: String| text.replace(&own, &with_n);
        let (unit, range) = match &point.encoding {
            Encoding::Plain(form) => {
                let link = LongTable::link(tables, |table| table.names_of.contains(&index));
                (words::unit(device, form), words::range(device, index, form, link.as_deref()))
            }
            Encoding::Cases { by, .. } => {
                let link =
                    LongTable::link(tables, |table| table.cases_of.contains(&index)).unwrap_or_default();
                let by = &device.points[*by];
                let how = if by.refers.is_some() { "as the point that" } else { "as" };
                let says = if by.refers.is_some() { "names" } else { "says" };
                (String::new(), format!("{how} `{}` {says}: {link}", by.name))
            }
        };
        let shown_by = device.things.iter().find(|thing| thing.shows(index));
        let platform = match (&page.entities[index], shown_by) {
            (Some(entity), _) => {
                let off = if entity.enabled { "" } else { ", *off*" };
                format!("{}{off}", words::platform(entity.platform).0)
            }
            (None, Some(thing)) => of_any(format!("part of `{}`", thing.name)),
            (None, None) => String::new(),
        };
        Row {
            frame: (frame.0.to_string(), frame.1.to_string()),
            platform,
            unit: of_any(unit),
            range: of_any(range),
            default: words::default(device, index),
            writing: of_any(words::writing(device, point)),
            is_written_elsewhere: point.write.as_ref().is_some_and(|write| write.at != point.at),
            kept: if point.persistent { "EEPROM" } else { "" },
            living: of_any(words::living(device, &point.when)),
        }
    }

    fn cells(mut self, page: &Page<'_>, sharing: &[PointIndex]) -> [String; 10] {
        let shown: Vec<&str> = sharing
            .iter()
            .filter_map(|index| page.entities[*index].as_ref())
            .map(|entity| entity.name.as_str())
            .collect();
        let at = |index: &PointIndex| Some(page.device.points[*index].at);
        let also = |index: &PointIndex| page.device.points[*index].also;
        let mut places = from_to(sharing, at).unwrap_or_default();
        if let Some(also) = from_to(sharing, also) {
            places += &format!(", also {also}");
        }
        let written_at = |index: &PointIndex| Some(page.device.points[*index].write.as_ref()?.at);
        if self.is_written_elsewhere {
            let written_at = from_to(sharing, written_at);
            self.writing.push_str(&written_at.map(|at| format!(", at {at}")).unwrap_or_default());
        }
        [
            page.names(sharing),
            words::together_plain(&shown),
            self.platform,
            self.living,
            self.unit,
            self.range,
            self.default,
            self.writing,
            self.kept.into(),
            places,
        ]
    }
}

/// The first and the last place of points that share a row: `holding 51 to 58`.
pub fn from_to(sharing: &[usize], place: impl Fn(&usize) -> Option<Address>) -> Option<String> {
    let (first, last) = (place(sharing.first()?)?, place(sharing.last()?)?);
    if first == last {
        return Some(first.to_string());
    }
    let told = last.to_string();
    let same_table = format!("{} ", first.span.table());
    let to = if sharing.len() == 2 { "and" } else { "to" };
    Some(format!("{first} {to} {}", told.strip_prefix(&same_table).unwrap_or(&told)))
}

/// What is too long for a cell.
struct LongTable {
    /// The points whose cases these are.
    cases_of: Vec<PointIndex>,
    /// The points whose names these are; in a table of cases those that decide.
    names_of: Vec<PointIndex>,
    rows: String,
}

impl LongTable {
    fn all_of(page: &Page<'_>) -> Vec<LongTable> {
        let mut tables: Vec<LongTable> = Vec::new();
        let mut table_with = |rows: String| {
            let known = tables.iter().position(|table| table.rows == rows);
            known.unwrap_or_else(|| {
                tables.push(LongTable { cases_of: Vec::new(), names_of: Vec::new(), rows });
                tables.len() - 1
            })
        };
        let mut cases_of: Vec<(usize, PointIndex)> = Vec::new();
        let mut names_of: Vec<(usize, PointIndex)> = Vec::new();
        for (index, point) in page.device.points.iter().enumerate() {
            if let Encoding::Cases { by, cases } = &point.encoding {
                let row = |case| {
                    let (unit, range) = words::case(page.device, case);
                    format!("| `{}` | {} | {unit} | {} |\n", case.name, case.key, words::cell(&range))
                };
                let at = table_with(cases.iter().map(row).collect());
                cases_of.push((at, index));
                if !names_of.contains(&(at, *by)) {
                    names_of.push((at, *by));
                }
            }
        }
        for (index, point) in page.device.points.iter().enumerate() {
            let names = point.plain().map_or(&[][..], |form| form.names.list());
            let stands_with_cases = names_of.iter().any(|(_, known)| *known == index);
            if names.len() > words::NAMES_IN_CELL && !stands_with_cases {
                let at =
                    table_with(names.iter().map(|(raw, name)| format!("| `{name}` | {raw} |\n")).collect());
                names_of.push((at, index));
            }
        }
        for (at, point) in cases_of {
            tables[at].cases_of.push(point);
        }
        for (at, point) in names_of {
            tables[at].names_of.push(point);
        }
        tables
    }

    /// The link to the first table that `is_meant`.
    fn link(tables: &[LongTable], is_meant: impl Fn(&LongTable) -> bool) -> Option<String> {
        let number = tables.iter().position(is_meant)? + 1;
        Some(format!("[table {number}](#table-{number})"))
    }

    fn write(&self, page: &Page<'_>, text: &mut String) {
        if self.cases_of.is_empty() {
            let _ = writeln!(
                text,
                "What {} can be, and the number in the register.\n\n| Name | In the register |\n|---|---:|",
                page.names(&self.names_of)
            );
        } else {
            let _ = writeln!(
                text,
                "What {} can be, while {} is set as in the first column.{}\n\n\
                 | Setting | Its number | Unit | Can be |\n|---|---:|---|---|",
                page.names(&self.cases_of),
                page.names(&self.names_of),
                self.about_degrees(page)
            );
        }
        let _ = writeln!(text, "{}", self.rows);
    }

    /// Ranges of temperatures are told in °C, also where the device can be set to another unit.
    fn about_degrees(&self, page: &Page<'_>) -> &'static str {
        let changes = |form: &Form| matches!(form.unit, Unit::By(_)) && form.range.is_some();
        let mut of_cases = self.cases_of.iter().map(|index| &page.device.points[*index].encoding);
        if of_cases.any(|encoding| encoding.forms().any(changes)) {
            " Ranges of temperatures are given in °C."
        } else {
            ""
        }
    }
}

/// The list to look things up in, in the profile's order.
fn addresses(page: &Page<'_>, text: &mut String) {
    let _ = writeln!(
        text,
        "## Every point and its address\n\nThe name is the one for MQTT and for the configuration. Addresses \
         count from 0, as on the wire. {}\n\n\
         | Point | In Home Assistant | Address |\n|---|---|---|",
        address_words(page)
    );
    for (point, entity) in page.device.points.iter().zip(&page.entities) {
        let shown = entity.as_ref().map_or("", |entity| &entity.name);
        let _ = writeln!(
            text,
            "| `{}` | {} | {} |",
            point.name,
            words::cell(shown),
            words::cell(&words::place(point))
        );
    }
    text.push('\n');
}

/// The words of an address that this device's points use.
fn address_words(page: &Page<'_>) -> String {
    let places = || page.device.points.iter().flat_map(|point| [Some(point.at), point.also]).flatten();
    let mut parts: Vec<String> = Vec::new();
    for (table, long) in [
        (Table::Coil, "Coils"),
        (Table::Discrete, "Discrete inputs"),
        (Table::Input, "Input registers"),
        (Table::Holding, "Holding registers"),
    ] {
        if places().any(|place| place.span.table() == table) {
            parts.push(format!("{long} are read with function {}.", table.read_function()));
        }
    }
    let single_bit = |bits: &Bits| bits.width() == 1;
    if let Some((place, bit)) = places().find_map(|place| Some((place, place.bits.filter(single_bit)?.low())))
    {
        parts.push(format!("`{place}` is bit {bit} of that register, where 0 is the lowest."));
    }
    parts.join(" ")
}
