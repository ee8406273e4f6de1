//! Names of points to their indices.

use crate::engine::device::PointIndex;
use crate::engine::profile::expand::Expanded;
use crate::engine::profile::file::Point;
use crate::engine::profile::resolve::Resolution;
use crate::engine::profile::text::{Name, PointPath};
use crate::engine::yaml::{At, Map, list_of_choices};

/// From where a name is looked up: a repetition of a group, or the top.
#[derive(Clone, Copy, Default)]
pub struct Scope<'a> {
    pub group: Option<&'a str>,
    pub repetition: Option<u16>,
}

impl<'a> From<&'a Expanded<'_>> for Scope<'a> {
    fn from(expanded: &'a Expanded<'_>) -> Scope<'a> {
        Scope { group: expanded.group.as_deref(), repetition: expanded.repetition }
    }
}

impl Resolution<'_, '_> {
    /// The one point that `path` names, as seen from `from` or from the top.
    pub fn lookup<'s>(&mut self, path: &At<PointPath>, from: impl Into<Scope<'s>>) -> Option<PointIndex> {
        let from = from.into();
        let found = self.lookup_all(path, from);
        if found.len() > 1 {
            let (path_text, count, first) = (&path.value.0, found.len(), &self.points[found[0]].name);
            let expected = match from.group {
                Some(_) => "one that is there once, or one of the same repetition",
                None => "one that is there once",
            };
            self.faults.add(
                &path.place,
                format!("`{path_text}` are {count} points (`{first}` and others); expected {expected}"),
            );
            return None;
        }
        found.first().copied()
    }

    /// All points that `path` names: those of the same repetition as `from`, or else those at the top.
    pub fn lookup_all<'s>(&mut self, path: &At<PointPath>, from: impl Into<Scope<'s>>) -> Vec<PointIndex> {
        let from = from.into();
        let found = self.find(&path.value, from);
        if found.is_empty() && !self.may_be_unread(&path.value.0) {
            let prefix = prefix_of_group(from);
            let mut known: Vec<&str> = Vec::new();
            for point in self.points {
                let local = prefix.as_ref().and_then(|prefix| point.path.strip_prefix(prefix.as_str()));
                let name = local.unwrap_or(&point.path);
                if !known.contains(&name) {
                    known.push(name);
                }
            }
            let choices = list_of_choices(&path.value.0, &known);
            self.faults.add(&path.place, format!("no point is called `{}`; {choices}", path.value.0));
        }
        found
    }

    /// As `lookup_all`, but it is no fault if there is none.
    fn find(&self, path: &PointPath, from: Scope<'_>) -> Vec<PointIndex> {
        if let Some(prefix) = prefix_of_group(from) {
            let beside =
                self.with_path(&format!("{prefix}{}", path.0), |point| point.repetition == from.repetition);
            if !beside.is_empty() {
                return beside;
            }
        }
        let found = self.with_path(&path.0, |_| true);
        if !found.is_empty() {
            return found;
        }
        // One of several repetitions, by its whole name.
        (0..self.points.len()).filter(|index| self.points[*index].name == path.0).collect()
    }

    /// Whether the device surely has no point that `path` names.
    pub fn is_missing(&self, path: &PointPath, from: &Expanded<'_>) -> bool {
        self.find(path, from.into()).is_empty() && !self.may_be_unread(&path.0)
    }

    fn with_path(&self, path: &str, and: impl Fn(&Expanded<'_>) -> bool) -> Vec<PointIndex> {
        let fits = |index: &PointIndex| self.points[*index].path == path && and(&self.points[*index]);
        (0..self.points.len()).filter(fits).collect()
    }

    /// Whether `path` may name a point whose own faults kept it from being read: that it is not found
    /// is then no fault of who names it.
    fn may_be_unread(&self, path: &str) -> bool {
        let is_meant = |name: &At<Name>| path.split('.').any(|part| part == name.value.0);
        let has_unread = |points: &Map<Name, Point>| points.unread.iter().any(is_meant);
        let mut groups = self.profile.points.iter().filter_map(|(_, point)| point.points.as_ref());
        has_unread(&self.profile.points) || groups.any(|group| has_unread(group))
    }
}

/// `channel.` of a point in the group `channel`.
fn prefix_of_group(from: Scope<'_>) -> Option<String> {
    Some(format!("{}.", from.group?))
}
