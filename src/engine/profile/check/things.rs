//! Rules of things: they are made of points that say and can be told what their rows ask for.

use crate::engine::device::{Form, Point, PointIndex, Poll, Thing, ThingKind, WriteRule};
use crate::engine::profile::check::{Rules, taken_by_the_gateway};
use crate::engine::profile::file;
use crate::engine::profile::text::PointPath;
use crate::engine::yaml::{At, Map, list_of_choices};

impl<'a, 'f> Rules<'a, 'f> {
    pub fn things(&mut self) {
        self.names_of_things_are_unique();
        self.things_have_what_they_need();
        self.rows_say_what_points_can_say();
        self.orders_can_be_written();
    }

    fn names_of_things_are_unique(&mut self) {
        for (path, _) in self.profile.things.iter() {
            for thing in self.device.things.iter().filter(|thing| is_at(thing, &path.value)) {
                let is_taken = self.device.points.iter().any(|point| point.name == thing.name);
                let why =
                    if is_taken { Some("is a point's name") } else { taken_by_the_gateway(&thing.name) };
                if let Some(why) = why {
                    self.faults.add(&path.place, format!("`{}` {why}; expected another name", thing.name));
                }
            }
        }
    }

    fn things_have_what_they_need(&mut self) {
        for (path, thing) in self.profile.things.iter() {
            let kind = thing.r#as.value;
            let message = match kind {
                _ if thing.r#do.is_empty() => "a thing without a command; expected `do`",
                ThingKind::Button if !thing.state.is_empty() => "a button with a state; remove `state`",
                ThingKind::Climate if thing.temperature.is_none() || thing.target.is_none() => {
                    "a climate needs `temperature` (the present one) and `target` (the wanted one)"
                }
                ThingKind::Cover | ThingKind::Valve | ThingKind::Climate if thing.state.is_empty() => {
                    "a thing whose state nobody knows; expected `state`"
                }
                _ => continue,
            };
            self.faults.add(&path.place, message);
        }
    }

    fn rows_say_what_points_can_say(&mut self) {
        for thing in self.first_of_each() {
            let (file, device) = thing;
            for (state, (_, row)) in device.states.iter().zip(file.state.iter()) {
                self.row_is_possible(&state.row, row, |point, text| {
                    if point.poll == Poll::Never {
                        return Err("is never read; expected a point with a `poll`".into());
                    }
                    can_say(point, text)
                });
            }
        }
    }

    fn orders_can_be_written(&mut self) {
        for thing in self.first_of_each() {
            let (file, device) = thing;
            for (command, (_, rows)) in device.commands.iter().zip(file.r#do.iter()) {
                let mut orders = command.orders.iter();
                for row in rows {
                    let resolved: Vec<(PointIndex, String)> =
                        orders.by_ref().take(row.entries.len()).cloned().collect();
                    self.row_is_possible(&resolved, row, can_be_told);
                }
            }
        }
    }

    /// Each thing of the file, as it was written and as its first repetition has become.
    fn first_of_each(&self) -> Vec<(&'f file::Thing, &'a Thing)> {
        let (profile, device) = (self.profile, self.device);
        let first = |path: &PointPath| device.things.iter().find(|thing| is_at(thing, path));
        profile.things.iter().filter_map(|(path, thing)| Some((thing, first(&path.value)?))).collect()
    }

    fn row_is_possible(
        &mut self,
        resolved: &[(PointIndex, String)],
        row: &Map<PointPath, At<String>>,
        rule: impl Fn(&Point, &str) -> Result<(), String>,
    ) {
        // A path that was not found has been told of; the rows then differ in length.
        if resolved.len() != row.entries.len() {
            return;
        }
        for ((point, text), (path, value)) in resolved.iter().zip(row.iter()) {
            if let Err(reason) = rule(&self.device.points[*point], text) {
                self.faults.add(&value.place, format!("`{}` {reason}", path.value.0));
            }
        }
    }
}

/// Whether `thing` is what became of the entry at `path`.
pub(super) fn is_at(thing: &Thing, path: &PointPath) -> bool {
    let Some((group, own)) = path.0.split_once('.') else { return thing.name == path.0 };
    let inside = thing.name.strip_prefix(group).and_then(|rest| rest.strip_suffix(own));
    let number = inside.and_then(|inside| inside.strip_prefix('_')?.strip_suffix('_'));
    number.is_some_and(|number| number.parse::<u16>().is_ok())
}

/// Whether the point may ever be published as `text`.
fn can_say(point: &Point, text: &str) -> Result<(), String> {
    let named = point.plain().map(Form::named_values).unwrap_or_default();
    let names: Vec<&str> = named.into_iter().map(|(_, name)| name).collect();
    match names.as_slice() {
        [] => Err("has no named values; expected a flag, or a point with `values`".into()),
        known if known.contains(&text) => Ok(()),
        known => Err(format!("never says `{text}`; {}", list_of_choices(text, known))),
    }
}

/// Whether `text` may be written to the point.
fn can_be_told(point: &Point, text: &str) -> Result<(), String> {
    match point.write.as_ref().map(|write| &write.rule) {
        None => Err("is never written; expected a point with `write`".into()),
        Some(WriteRule::Press { .. }) if text == WriteRule::PRESS => Ok(()),
        Some(WriteRule::Press { .. }) => Err("is a button; expected `PRESS`".into()),
        Some(WriteRule::Names(allowed)) if !allowed.iter().any(|name| name == text) => {
            Err(format!("may not be set to `{text}`; expected one of its `write`"))
        }
        Some(WriteRule::Range { .. }) => Ok(()),
        Some(_) => can_say(point, text),
    }
}
