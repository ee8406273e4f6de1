//! Files with cases that several profiles share: `device-profiles/shared/measuring.yaml`.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::engine::profile::file::{Cases, Point, Profile, SharedCase, Values};
use crate::engine::profile::library::Library;
use crate::engine::yaml::{Faults, Map, Place, Source, list_of_choices, parse, read};

/// The shared files that one profile uses, by their names.
#[derive(Default)]
pub struct Shared(BTreeMap<String, Map<i128, SharedCase>>);

impl Shared {
    /// Reads every shared file that `profile` names.
    pub fn of(profile: &Profile, library: &Library, faults: &mut Faults) -> Shared {
        let mut shared = Shared::default();
        for (file, place) in profile.points.iter().flat_map(|(_, point)| references(point)) {
            if shared.0.contains_key(file) {
                continue;
            }
            if !library.contains(file) {
                let known: Vec<&str> = library.shared_ids();
                let message = if known.is_empty() {
                    format!("there is no file `{file}`")
                } else {
                    format!("there is no file `{file}`; {}", list_of_choices(file, &known))
                };
                faults.add(place, message);
                continue;
            }
            let Some(source) = library.source(file, faults) else { continue };
            let cases = cases_in(&source, faults);
            shared.0.insert(file.into(), cases);
        }
        shared
    }

    pub fn get(&self, file: &str) -> Option<&Map<i128, SharedCase>> {
        self.0.get(file)
    }
}

/// The cases of one file, each with a name of its own.
pub fn cases_in(source: &Arc<Source>, faults: &mut Faults) -> Map<i128, SharedCase> {
    let cases: Option<Map<i128, SharedCase>> = parse(source, faults).and_then(|node| read(&node, faults));
    let cases = cases.unwrap_or_default();
    for (at, (key, case)) in cases.iter().enumerate() {
        let name = &case.name.value;
        if let Some((first, _)) = cases.iter().take(at).find(|(_, other)| other.name.value == *name) {
            faults.add(
                &case.name.place,
                format!(
                    "`{name}` is the name of {} and of {}; expected another name",
                    first.value, key.value
                ),
            );
        }
    }
    cases
}

fn references(point: &Point) -> Vec<(&str, &Place)> {
    let mut found = Vec::new();
    if let Some(values) = &point.form.values {
        if let Values::Shared(file) = &values.value {
            found.push((file.as_str(), &values.place));
        }
    }
    if let Some(cases) = &point.is {
        if let Cases::Shared(file) = &cases.value {
            found.push((file.as_str(), &cases.place));
        }
    }
    for (_, child) in point.points.iter().flat_map(|children| children.iter()) {
        found.extend(references(child));
    }
    found
}
