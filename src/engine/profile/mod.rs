//! Profile files to devices: the file's shape, repetitions, names, and the rules beyond the shape.
//!
//! The way: [`Library`] (bytes by identifier) → `engine::yaml` → [`file`] (what the author typed) →
//! `expand` (repetitions) → `resolve` (names to indices) → `check` (rules) →
//! [`Device`] (what is true).

mod check;
mod expand;
pub mod file;
mod library;
mod lookup;
mod resolve;
mod shared;
mod text;
mod things;

pub use library::Library;
pub use text::{NAME_BYTES_MAX, short_name};

use std::sync::Arc;

use serde_json::Value as Json;

use crate::engine::device::Device;
use crate::engine::profile::file::Profile;
use crate::engine::profile::shared::Shared;
use crate::engine::yaml::{At, Diagnostic, Faults, Map, Node, Source, parse, read, schema_of};

impl Library {
    /// The device `id`, or every fault of its file. An unknown `id` is the caller's to find out
    /// ([`Library::contains`]), who knows the place where it was asked for.
    pub fn load(&self, id: &str) -> Result<Device, Vec<Diagnostic>> {
        let mut faults = Faults::default();
        let source = self.source(id, &mut faults);
        let device = source.and_then(|source| self.device_in(&source, Some(id), &mut faults));
        faults.into_result(device)
    }

    /// The device in a file that need not be in the library; its shared files must be.
    pub fn check(&self, shown: &str, bytes: &[u8]) -> Result<Device, Vec<Diagnostic>> {
        let mut faults = Faults::default();
        let source = Source::from_bytes(shown, bytes, &mut faults);
        let device = source.and_then(|source| self.device_in(&source, None, &mut faults));
        faults.into_result(device)
    }

    /// The number of cases in a shared file that need not be in the library.
    pub fn check_shared(&self, shown: &str, bytes: &[u8]) -> Result<usize, Vec<Diagnostic>> {
        let mut faults = Faults::default();
        let source = Source::from_bytes(shown, bytes, &mut faults);
        let cases = source.map(|source| shared::cases_in(&source, &mut faults).iter().count());
        faults.into_result(cases)
    }

    fn device_in(&self, source: &Arc<Source>, id: Option<&str>, faults: &mut Faults) -> Option<Device> {
        let node = parse(source, faults)?;
        let Some(profile) = read::<Profile>(&node, faults) else {
            // Something of the head is wrong. The points are checked all the same, so that all
            // faults are told at once.
            let inline = Inline {
                points: node.get("points")?,
                things: node.get("things"),
                wire: node.get("wire"),
                home_assistant: node.get("home_assistant"),
            };
            load_inline(&inline, self, faults);
            return None;
        };
        if let Some(id) = id.filter(|id| profile.device.value != *id) {
            let found = &profile.device.value;
            let message =
                format!("`{found}` is not where the file is; expected `{id}`, its path without `.yaml`");
            faults.add(&profile.device.place, message);
        }
        Some(device_of(&profile, self, faults))
    }
}

/// The sections of a device whose points stand in the gateway's configuration: the values of these
/// keys, if they are there.
pub struct Inline<'n> {
    pub points: &'n Node,
    pub things: Option<&'n Node>,
    pub wire: Option<&'n Node>,
    pub home_assistant: Option<&'n Node>,
}

/// A device whose points stand in the gateway's configuration, in the profile's form.
///
/// `None` if nothing can be made of it; as everywhere, a device that comes with faults is not to be used.
pub fn load_inline(inline: &Inline<'_>, library: &Library, faults: &mut Faults) -> Option<Device> {
    let points = inline.points;
    let wire = inline.wire.and_then(|node| read(node, faults));
    let things = inline.things.and_then(|node| read(node, faults)).unwrap_or_default();
    let home_assistant = inline.home_assistant.and_then(|node| read(node, faults)).unwrap_or_default();
    let profile = Profile {
        place: points.named_at().clone(),
        device: At::nowhere("inline".into()),
        manufacturer: String::new(),
        model: String::new(),
        source: String::new(),
        identify: None,
        wire,
        line: None,
        points: read(points, faults)?,
        things,
        left_out: Map::default(),
        home_assistant,
    };
    Some(device_of(&profile, library, faults))
}

/// The JSON Schema of a profile file.
pub fn schema() -> Json {
    schema_of::<Profile>("busker device profile")
}

fn device_of(profile: &Profile, library: &Library, faults: &mut Faults) -> Device {
    let shared = Shared::of(profile, library, faults);
    let points = expand::expand(&profile.points, &shared, faults);
    let device = resolve::device(profile, &points, &shared, faults);
    check::check(profile, &points, &device, faults);
    device
}

#[cfg(test)]
mod tests;
