//! Things of the file to things of the device: each is looked up beside the points it is made of.

use crate::engine::device::{PointIndex, State, Thing, ThingCommand, ThingKind};
use crate::engine::profile::file;
use crate::engine::profile::lookup::Scope;
use crate::engine::profile::resolve::Resolution;
use crate::engine::profile::text::PointPath;
use crate::engine::yaml::{At, Map, list_of_choices};

impl<'a> Resolution<'a, '_> {
    /// All things, repetitions one after the other.
    pub fn things(&mut self) -> Vec<Thing> {
        let profile = self.profile;
        let mut things = Vec::new();
        for (path, thing) in profile.things.iter() {
            let repetitions = self.repetitions(&path.value);
            if repetitions.is_empty() {
                let group = path.value.0.split('.').next().unwrap_or_default();
                self.faults.add(
                    &path.place,
                    format!("there is no repeated group `{group}`; expected one of `points`, or a name without a dot"),
                );
            }
            for (name, scope) in repetitions {
                things.push(self.thing(name, thing, scope));
            }
        }
        things
    }

    /// The things that `path` names, by their places among [`Resolution::things`], each with the number
    /// of its repetition.
    pub fn things_with_path(&self, path: &PointPath) -> Vec<(usize, Option<u16>)> {
        let all = self.profile.things.iter().flat_map(|(own, _)| {
            self.repetitions(&own.value).into_iter().map(|(_, scope)| (&own.value, scope.repetition))
        });
        all.enumerate().filter(|(_, (own, _))| *own == path).map(|(at, (_, number))| (at, number)).collect()
    }

    /// The expanded names of a thing, each with the scope in which its points are looked up.
    fn repetitions(&self, path: &PointPath) -> Vec<(String, Scope<'a>)> {
        let Some((group, own)) = path.0.split_once('.') else {
            return vec![(path.0.clone(), Scope::default())];
        };
        let points: &'a [_] = self.points;
        let mut found: Vec<(String, Scope<'a>)> = Vec::new();
        for point in points.iter().filter(|point| point.group.as_deref() == Some(group)) {
            let Some(number) = point.repetition else { continue };
            let name = format!("{group}_{number}_{own}");
            if !found.iter().any(|(known, _)| *known == name) {
                found.push((name, point.into()));
            }
        }
        found
    }

    fn thing(&mut self, name: String, file: &file::Thing, scope: Scope<'_>) -> Thing {
        let kind = file.r#as.value;
        let states = file.state.iter().map(|(state, row)| {
            self.is_one_of(state, kind.states(), "a state", kind);
            State { name: state.value.clone(), row: self.row(row, scope) }
        });
        let states = states.collect();
        let commands = file.r#do.iter().map(|(command, orders)| {
            self.is_one_of(command, kind.commands(), "a command", kind);
            let orders = orders.iter().flat_map(|row| self.row(row, scope)).collect();
            ThingCommand { name: command.value.clone(), orders }
        });
        let commands = commands.collect();
        let mut temperature = |path: &Option<At<PointPath>>| self.temperature(path.as_ref()?, kind, scope);
        let (temperature, target) = (temperature(&file.temperature), temperature(&file.target));
        let when = self.conditions(&file.when, scope);
        Thing { name, kind, when, states, commands, temperature, target, presentation: Default::default() }
    }

    fn temperature(&mut self, path: &At<PointPath>, kind: ThingKind, scope: Scope<'_>) -> Option<PointIndex> {
        if kind != ThingKind::Climate {
            let message = format!("a {} has no temperature; remove it, or say `as: climate`", kind.name());
            self.faults.add(&path.place, message);
        }
        self.lookup(path, scope)
    }

    /// `{position: running, drive: open}`: points and what each says, or is told.
    fn row(&mut self, row: &Map<PointPath, At<String>>, scope: Scope<'_>) -> Vec<(PointIndex, String)> {
        let mut resolved = Vec::new();
        for (path, value) in row.iter() {
            if let Some(point) = self.lookup(path, scope) {
                resolved.push((point, value.value.clone()));
            }
        }
        resolved
    }

    fn is_one_of(&mut self, name: &At<String>, known: &[&str], what: &str, kind: ThingKind) {
        if !known.contains(&name.value.as_str()) {
            let choices = list_of_choices(&name.value, known);
            let message = format!("`{}` is not {what} of a {}; {choices}", name.value, kind.name());
            self.faults.add(&name.place, message);
        }
    }
}
