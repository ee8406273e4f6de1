//! What is more than a point with a value: things made of several points, events, and what is read
//! only when somebody asks.

use std::fmt::Write as _;

use super::page::{Page, device_name};
use super::points::from_to;
use super::words;
use crate::engine::device::{
    Device, Kind, PRESS, Point, PointIndex, Thing, ThingKind, Write as PointWrite, WriteRule,
};
use crate::engine::topics::Topics;

/// Writes the three sections, those that the device needs.
pub fn things(page: &Page<'_>, text: &mut String) {
    made_of_points(page, text);
    events(page, text);
    on_request(page, text);
}

/// The topic of a point or a thing of the device as the page configures it.
fn topic(device: &Device, name: &str) -> String {
    Topics::new("busker").of_device("", &device_name(device)).state(name)
}

fn made_of_points(page: &Page<'_>, text: &mut String) {
    let groups = Told::all_of(page.device);
    if groups.is_empty() {
        return;
    }
    let _ = writeln!(
        text,
        "## Things\n\nSeveral points that are one thing to a person. The points keep their own MQTT topics. A \
         command to a thing is one order after the other: each is written and read back before the next, and the \
         first that fails ends it. How it ended is told on the thing's topic with `/outcome` behind it. The topics \
         are those of the configuration above.\n"
    );
    for (told, things) in &groups {
        told.write(page, things, text);
    }
}

/// What is said of a thing. Compared to see which can share their text.
#[derive(PartialEq)]
struct Told {
    kind: ThingKind,
    topic: String,
    when: String,
    states: Vec<[String; 2]>,
    /// Each with its orders.
    commands: Vec<(String, Vec<String>)>,
    temperatures: Option<[String; 2]>,
    /// Points that it shows, and points that it only commands.
    shows: Vec<String>,
    commands_only: Vec<String>,
}

impl Told {
    /// Things that differ in their number only share their text, with N for it.
    fn all_of(device: &Device) -> Vec<(Told, Vec<&Thing>)> {
        let mut groups: Vec<(Told, Vec<&Thing>)> = Vec::new();
        for thing in &device.things {
            let ((before, _), number) = words::around_first_number(&thing.name);
            let told = Told::of(device, thing, number.map(|number| (before, number)));
            match groups.iter_mut().find(|(known, _)| *known == told) {
                Some((_, things)) => things.push(thing),
                None => groups.push((told, vec![thing])),
            }
        }
        for (told, things) in &mut groups {
            if let [thing] = things.as_slice() {
                *told = Told::of(device, thing, None);
            }
        }
        groups
    }

    fn of(device: &Device, thing: &Thing, own: Option<(&str, u32)>) -> Told {
        let with_n = |name: &str| own.map_or(name.to_string(), |own| words::with_n(name, own));
        let name = |point: PointIndex| with_n(&device.points[point].name);
        let row = |row: &[(PointIndex, String)]| {
            let each = row.iter().map(|(point, value)| format!("`{}` is `{value}`", name(*point)));
            each.collect::<Vec<_>>().join(", and ")
        };
        let order = |(point, value): &(PointIndex, String)| format!("`{value}` to `{}`", name(*point));
        let when = words::condition(device, &thing.when);
        let when = thing.when.iter().fold(when, |when, condition| {
            let own = &device.points[condition.point].name;
            when.replace(&format!("`{own}`"), &format!("`{}`", with_n(own)))
        });
        let points = |wanted: &dyn Fn(PointIndex) -> bool| -> Vec<String> {
            (0..device.points.len()).filter(|point| wanted(*point)).map(name).collect()
        };
        Told {
            kind: thing.kind,
            topic: topic(device, &with_n(&thing.name)),
            when,
            states: thing.states.iter().map(|state| [format!("`{}`", state.name), row(&state.row)]).collect(),
            commands: thing
                .commands
                .iter()
                .map(|command| (command.name.clone(), command.orders.iter().map(order).collect()))
                .collect(),
            temperatures: thing
                .temperature
                .zip(thing.target)
                .map(|(present, target)| [name(present), name(target)]),
            shows: points(&|point| thing.shows(point)),
            commands_only: points(&|point| thing.commands_point(point) && !thing.shows(point)),
        }
    }

    fn write(&self, page: &Page<'_>, things: &[&Thing], text: &mut String) {
        let shown: Vec<String> = things.iter().map(|thing| thing.presentation.title(&thing.name)).collect();
        let shown: Vec<&str> = shown.iter().map(String::as_str).collect();
        let names: Vec<&str> = things.iter().map(|thing| thing.name.as_str()).collect();
        let (kind, several) = words::platform(self.kind.platform());
        let what = match things {
            [_] => format!("A {kind}, {}.", words::together(&names)),
            _ => format!("{several}, {}; N stands for the number.", words::together(&names)),
        };
        let there = match self.when.as_str() {
            "" => String::new(),
            when => format!(" There while {when}."),
        };
        let off = match things[0].presentation.enabled {
            Some(false) => " Switched off in Home Assistant until you enable it.",
            _ => "",
        };
        let _ = writeln!(text, "### {}\n\n{what}{there}{off}\n", words::together_plain(&shown));
        if !self.states.is_empty() {
            let _ = writeln!(text, "Its state, on `{}`, is the first of these that holds:\n", self.topic);
            words::table(&["State", "While"], &self.states, text);
            let stopped = match self.states.iter().any(|[state, _]| state == "`stopped`") {
                true => " Home Assistant shows `stopped` as unknown.",
                false => "",
            };
            let _ = writeln!(text, "If none holds, it is `None`: nobody knows.{stopped}\n");
        }
        if let Some([present, target]) = &self.temperatures {
            let set = topic(page.device, target);
            let _ = writeln!(
                text,
                "The present temperature is `{present}`, the wanted one `{target}`, which is set on `{set}/set`.\n"
            );
        }
        let commands: Vec<[String; 2]> = self
            .commands
            .iter()
            .enumerate()
            .map(|(number, (command, _))| [format!("`{command}`"), self.orders(page.device, things, number)])
            .collect();
        let what = match (self.kind, self.commands.as_slice()) {
            (ThingKind::Button, [(command, _)]) if command == PRESS => "Pressed",
            _ => "Commanded",
        };
        let _ = writeln!(text, "{what} by a message on `{}/set`:\n", self.topic);
        words::table(&["Message", "Writes"], &commands, text);
        let _ = self.write_what_becomes_of_points(text);
    }

    /// The orders of a command, each with where it is written.
    fn orders(&self, device: &Device, things: &[&Thing], command: usize) -> String {
        let (_, orders) = &self.commands[command];
        let each = orders.iter().enumerate().map(|(order, told)| {
            let written = |thing: &&Thing| {
                let (point, value) = thing.commands[command].orders.get(order)?;
                Some((device.points[*point].write.as_ref()?, raw_of(&device.points[*point], value)))
            };
            let written: Vec<(&PointWrite, Option<i128>)> = things.iter().filter_map(written).collect();
            let places: Vec<usize> = (0..written.len()).collect();
            let place = from_to(&places, |place| Some(written[*place].0.at)).unwrap_or_default();
            let raw = match written.first() {
                Some((write, Some(raw))) if !write.at.span.table().is_bits() => format!("{raw} in "),
                _ => String::new(),
            };
            format!("{told} ({raw}{place})")
        });
        each.collect::<Vec<_>>().join(", then ")
    }

    fn write_what_becomes_of_points(&self, text: &mut String) -> std::fmt::Result {
        let told = |names: &[String]| words::together(&names.iter().map(String::as_str).collect::<Vec<_>>());
        match (self.shows.as_slice(), self.commands_only.as_slice()) {
            ([], []) => Ok(()),
            (shows, []) => writeln!(
                text,
                "While it is there, Home Assistant shows {} as part of it and not by themselves.\n",
                told(shows)
            ),
            ([], commands) => writeln!(
                text,
                "While it is there, Home Assistant shows {} without controls.\n",
                told(commands)
            ),
            (shows, commands) => writeln!(
                text,
                "While it is there, Home Assistant shows {} as part of it and not by themselves, and {} without \
                 controls.\n",
                told(shows),
                told(commands)
            ),
        }
    }
}

/// What the register holds after `value` was written.
fn raw_of(point: &Point, value: &str) -> Option<i128> {
    if let Some(WriteRule::Press { word, .. }) = point.write.as_ref().map(|write| &write.rule) {
        return Some(i128::from(*word));
    }
    let form = point.plain()?;
    match (form.kind, value) {
        (Kind::Bool, "ON") => Some(1),
        (Kind::Bool, "OFF") => Some(0),
        _ => form.names.list().iter().find(|(_, name)| name == value).map(|(raw, _)| *raw),
    }
}

fn events(page: &Page<'_>, text: &mut String) {
    let device = page.device;
    let points: Vec<PointIndex> =
        (0..device.points.len()).filter(|index| device.points[*index].event.is_some()).collect();
    let Some(first) = points.first().map(|index| &device.points[*index]) else { return };
    let event = first.event.as_deref().unwrap_or_default();
    let _ = writeln!(
        text,
        "## Events\n\nThe device flips these bits when something has happened, so that what is shorter than the time \
         between two questions is not missed; two of a kind within that time cancel each other. Each flip is told \
         once and not kept: `{}` gets `{{\"event_type\":\"{event}\"}}`. What happened while the device did not \
         answer is not told.\n",
        topic(device, &first.name)
    );
    let mut rows: Vec<(String, String, Vec<PointIndex>)> = Vec::new();
    for index in points {
        let point = &device.points[index];
        let event = point.event.clone().unwrap_or_default();
        let frame = {
            let (before, behind) = words::around_first_number(&point.name).0;
            format!("{before} {behind}")
        };
        match rows.iter_mut().find(|(known, of, _)| (known, of) == (&frame, &event)) {
            Some((_, _, sharing)) => sharing.push(index),
            None => rows.push((frame, event, vec![index])),
        }
    }
    let rows: Vec<[String; 3]> = rows
        .into_iter()
        .map(|(_, event, sharing)| {
            let places = from_to(&sharing, |index| Some(device.points[*index].at)).unwrap_or_default();
            [page.names(&sharing), format!("`{event}`"), places]
        })
        .collect();
    words::table(&["Point", "Event", "Bit"], &rows, text);
}

fn on_request(page: &Page<'_>, text: &mut String) {
    let device = page.device;
    let points: Vec<PointIndex> =
        (0..device.points.len()).filter(|index| device.points[*index].is_read_on_request()).collect();
    let Some(first) = points.first().map(|index| &device.points[*index]) else { return };
    let _ = writeln!(
        text,
        "## On request\n\nThese are read only when somebody asks: send an empty message to `{}/get`, and the values \
         come on `{}`, several as one JSON array (`[0.1,-0.1,1.0]`). busker reads them in as many questions as they \
         need, while other points and orders go between. If a mode has to hold for them, it is read before the first \
         question and after the last; if it does not hold both times, `None` comes instead of values. Home Assistant \
         does not show arrays.\n",
        topic(device, &first.name),
        topic(device, &first.name)
    );
    let rows: Vec<[String; 5]> = points
        .iter()
        .map(|index| {
            let point = &device.points[*index];
            let span = point.at.span;
            let limits = device.wire.limits;
            let most = if span.table().is_bits() { limits.read_bits } else { limits.read_registers };
            let questions = span.count().div_ceil(u32::from(most.max(1)));
            let form = point.plain();
            let values = form.map_or(1, |form| form.elements);
            let unit = form.map(|form| words::unit(device, form)).unwrap_or_default();
            [
                format!("`{}`", point.name),
                format!("{values} {unit}").trim_end().to_string(),
                questions.to_string(),
                words::condition(device, &point.when),
                span.to_string(),
            ]
        })
        .collect();
    words::table(&["Point", "Values", "Questions", "Only while", "Address"], &rows, text);
}
