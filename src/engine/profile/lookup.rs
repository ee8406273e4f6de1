//! Names of points to their indices.

use crate::engine::device::PointIndex;
use crate::engine::profile::expand::Expanded;
use crate::engine::profile::file::Point;
use crate::engine::profile::resolve::Resolution;
use crate::engine::profile::text::{Name, PointPath};
use crate::engine::yaml::{At, Map, list_of_choices};

impl Resolution<'_, '_> {
    /// The one point that `path` names, as seen from `from` or from the top.
    pub fn lookup(&mut self, path: &At<PointPath>, from: Option<&Expanded<'_>>) -> Option<PointIndex> {
        let found = self.lookup_all(path, from);
        if found.len() > 1 {
            let (path_text, count, first) = (&path.value.0, found.len(), &self.points[found[0]].name);
            let expected = match from {
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
    pub fn lookup_all(&mut self, path: &At<PointPath>, from: Option<&Expanded<'_>>) -> Vec<PointIndex> {
        let group =
            from.and_then(|from| from.group.as_ref().map(|group| (format!("{group}."), from.repetition)));
        let mut found = Vec::new();
        if let Some((prefix, repetition)) = &group {
            let beside = format!("{prefix}{}", path.value.0);
            found = self.with_path(&beside, |point| point.repetition == *repetition);
        }
        if found.is_empty() {
            found = self.with_path(&path.value.0, |_| true);
        }
        if found.is_empty() && !self.may_be_unread(&path.value.0) {
            let mut known: Vec<&str> = Vec::new();
            for point in self.points {
                let local = group.as_ref().and_then(|(prefix, _)| point.path.strip_prefix(prefix.as_str()));
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
