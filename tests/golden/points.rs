//! The expanded points as a table for people, with the long lists below it.

use busker::engine::device::{
    Condition, Decimals, Device, Encoding, Form, Kind, Names, OutOfRange, Point, PointIndex, Thing, Unit,
    Write, WriteFunction, WriteRule,
};
use busker::engine::time::Duration;
use busker::engine::value::Decimal;

/// Lists of more names than this stand below the table, once for all points that share them.
const NAMES_IN_LINE: usize = 3;

/// A line a point: name, place, meaning, poll class, how it is written, what else. Below: long lists,
/// things, and what is left out.
pub fn table(device: &Device) -> String {
    let mut lists = Vec::new();
    let rows: Vec<[String; 5]> = device.points.iter().map(|point| row(device, point, &mut lists)).collect();
    let widths: Vec<usize> =
        (0..4).map(|column| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0)).collect();
    let mut text = String::new();
    for row in &rows {
        let mut line = String::new();
        for (cell, width) in row.iter().zip(&widths) {
            line.push_str(&format!("{cell:width$}  "));
        }
        line.push_str(&row[4]);
        text.push_str(line.trim_end());
        text.push('\n');
    }
    for (index, list) in lists.iter().enumerate() {
        text.push_str(&format!("\n[{}]\n{list}", index + 1));
    }
    for thing in &device.things {
        text.push_str(&format!("\n{}\n", in_lines(device, thing)));
    }
    if !device.left_out.is_empty() {
        text.push_str("\nleft out\n");
    }
    for left_out in &device.left_out {
        text.push_str(&format!("{}: {}\n", left_out.span, left_out.reason));
    }
    text
}

fn row(device: &Device, point: &Point, lists: &mut Vec<String>) -> [String; 5] {
    let place = match point.also {
        Some(also) => format!("{}, {also}", point.at),
        None => point.at.to_string(),
    };
    let meaning = match &point.encoding {
        Encoding::Plain(form) => meaning(device, form, lists),
        Encoding::Cases { by, cases } => {
            let lines: String = cases
                .iter()
                .map(|case| {
                    let form = case.form.as_ref();
                    let form =
                        form.map_or("no reading".into(), |form| meaning(device, form, &mut Vec::new()));
                    format!("0x{:02X} {}: {form}\n", case.key, case.name)
                })
                .collect();
            format!("by {}: {}", device.points[*by].name, reference(lists, lines))
        }
    };
    let write = point.write.as_ref().map_or("read only".into(), |write| writing(point, write));
    [point.name.clone(), place, meaning, point.poll.name().into(), format!("{write}{}", more(device, point))]
}

fn meaning(device: &Device, form: &Form, lists: &mut Vec<String>) -> String {
    let mut words = vec![form.kind.name()];
    if form.elements > 1 {
        words.push(format!("array of {}", form.elements));
    }
    if form.scale != Decimal::ONE {
        words.push(format!("× {}", form.scale));
    }
    match form.decimals {
        Some(Decimals::Fixed(decimals)) => words.push(format!("÷ 10^{decimals}")),
        Some(Decimals::By(point)) => words.push(format!("÷ 10^{}", device.points[point].name)),
        None => {}
    }
    if form.offset != Decimal::ZERO {
        words.push(format!("+ {}", form.offset));
    }
    if let Some(since) = form.since {
        words.push(format!("seconds since {since}"));
    }
    match &form.unit {
        Unit::Fixed(unit) => words.push(unit.clone()),
        Unit::By(point) => words.push(format!("unit of {}", device.points[*point].name)),
        Unit::None => {}
    }
    if form.difference {
        words.push("difference".into());
    }
    if let Some((min, max)) = form.range {
        words.push(format!("{min}..{max}"));
    }
    let names = form.names.list();
    if form.kind != Kind::Bool && !names.is_empty() {
        let kind = if matches!(form.names, Names::All(_)) { "one of" } else { "or" };
        if names.len() <= NAMES_IN_LINE {
            let listed: Vec<String> = names.iter().map(|(raw, name)| format!("{raw} {name}")).collect();
            words.push(format!("{kind} {}", listed.join(", ")));
        } else {
            let lines = names.iter().map(|(raw, name)| format!("0x{raw:02X} {name}\n")).collect();
            words.push(format!("{kind} {}", reference(lists, lines)));
        }
    }
    for (raw, reason) in &form.invalid {
        words.push(format!("not {raw} ({reason})"));
    }
    words.join(" ")
}

fn reference(lists: &mut Vec<String>, list: String) -> String {
    let index = lists.iter().position(|known| *known == list).unwrap_or_else(|| {
        lists.push(list);
        lists.len() - 1
    });
    format!("[{}]", index + 1)
}

fn writing(point: &Point, write: &Write) -> String {
    let mut words = Vec::new();
    words.push(match &write.rule {
        WriteRule::Any => "write any".into(),
        WriteRule::Range { min, max, step: None } => format!("write {min}..{max}"),
        WriteRule::Range { min, max, step: Some(step) } => format!("write {min}..{max} step {step}"),
        WriteRule::Names(names) => format!("write {}", names.join(", ")),
        WriteRule::Press { word, self_clearing } => {
            format!("press {word}{}", if *self_clearing { ", clears itself" } else { "" })
        }
    });
    if write.at != point.at {
        words.push(format!("at {}", write.at));
    }
    if let Some(function) = write.with {
        words.push(format!("with function {}", WriteFunction::code(function)));
    }
    if write.out_of_range == OutOfRange::Clamp {
        words.push("or the nearest of it".into());
    }
    if let Some(between) = write.on_change {
        words.push(format!("with {between} between two equal ones"));
    }
    if write.settle > Duration::ZERO {
        words.push(format!("and wait {} ms", write.settle.as_micros() / 1000));
    }
    words.join(" ")
}

fn more(device: &Device, point: &Point) -> String {
    let mut words = Vec::new();
    if point.persistent {
        words.push("EEPROM".to_string());
    }
    if point.read_clears {
        words.push("reading clears it".into());
    }
    if let Some(default) = point.default {
        words.push(format!("factory {default}"));
    }
    match point.re_read.as_slice() {
        [] => {}
        [one] => words.push(format!("then reads {}", device.points[*one].name)),
        [first, .., last] => words.push(format!(
            "then reads {} .. {} ({})",
            device.points[*first].name,
            device.points[*last].name,
            point.re_read.len()
        )),
    }
    if let Some(time) = point.heartbeat {
        words.push(format!("repeated within {}", device.points[time].name));
    }
    if let Some(registers) = point.refers {
        words.push(format!("names a point of {registers}"));
    }
    if let Some(event) = &point.event {
        words.push(format!("each flip is the event {event}"));
    }
    if !point.when.is_empty() {
        words.push(conditions(device, &point.when));
    }
    words.iter().map(|word| format!("; {word}")).collect()
}

/// `only while mode is direct or logic, and …`
fn conditions(device: &Device, when: &[Condition]) -> String {
    let each = when.iter().map(|condition| {
        let values: Vec<&str> = condition.values.iter().map(|(_, name)| name.as_str()).collect();
        format!("{} is {}", device.points[condition.point].name, values.join(" or "))
    });
    format!("only while {}", each.collect::<Vec<_>>().join(", and "))
}

/// A thing with its conditions, its points, and a line for each state and command.
fn in_lines(device: &Device, thing: &Thing) -> String {
    let name = |point: PointIndex| device.points[point].name.as_str();
    let row = |row: &[(PointIndex, String)]| {
        let each = row.iter().map(|(point, value)| format!("{} {value}", name(*point)));
        each.collect::<Vec<_>>().join(", ")
    };
    let mut lines = vec![format!("{}: {}", thing.name, thing.kind.name())];
    if !thing.when.is_empty() {
        lines.push(conditions(device, &thing.when));
    }
    lines.extend(thing.temperature.map(|point| format!("temperature {}", name(point))));
    lines.extend(thing.target.map(|point| format!("target {}", name(point))));
    lines.extend(thing.states.iter().map(|state| format!("is {} with {}", state.name, row(&state.row))));
    let commands = thing.commands.iter();
    lines.extend(commands.map(|command| format!("does {} by {}", command.name, row(&command.orders))));
    lines.join("\n  ")
}
