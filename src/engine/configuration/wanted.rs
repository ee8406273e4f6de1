//! What stands under a device's `settings`: names of its points and what they shall hold.

use crate::engine::configuration::file::Setting;
use crate::engine::configuration::wishes::unknown_point;
use crate::engine::device::Device;
use crate::engine::settings::Wanted;
use crate::engine::wanted;
use crate::engine::yaml::{Faults, Map};

/// The settings in the file's order. What is faulty becomes a fault and is left out.
pub fn check(file: &Map<String, Setting>, device: &Device, faults: &mut Faults) -> Vec<Wanted> {
    let mut found = Vec::new();
    let mut places = Vec::new();
    for (name, setting) in file.iter() {
        let Some(point) = device.point_named(name) else {
            faults.add(&name.place, unknown_point(name, device));
            continue;
        };
        if let Some(refusal) = wanted::refusal(&device.points[point]) {
            faults.add(&name.place, refusal);
            continue;
        }
        let Setting { value, enforce } = setting;
        found.push(Wanted { point, value: value.0.clone(), enforce: *enforce });
        places.push(&value.place);
    }
    for name in &file.unread {
        if !device.points.iter().any(|point| point.name == name.value) {
            faults.add(&name.place, unknown_point(name, device));
        }
    }
    for (index, place) in places.into_iter().enumerate() {
        if let Err(reason) = wanted::check(device, &found, index) {
            faults.add(place, reason);
        }
    }
    found
}
