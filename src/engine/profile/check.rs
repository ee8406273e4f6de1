//! Rules beyond the shape: what a device of these points must keep to be safe and clear.

use crate::engine::device::Device;
use crate::engine::profile::expand::Expanded;
use crate::engine::profile::file::Profile;
use crate::engine::yaml::Faults;

/// Notes every rule that `device`, made of `points` of `profile`, breaks.
pub fn check(_profile: &Profile, points: &[Expanded<'_>], _device: &Device, faults: &mut Faults) {
    names_are_unique(points, faults);
    what_is_read_has_a_poll_class(points, faults);
}

fn names_are_unique(points: &[Expanded<'_>], faults: &mut Faults) {
    for (index, point) in points.iter().enumerate() {
        if let Some(first) = points[..index].iter().find(|other| other.name == point.name) {
            let message = format!(
                "two points are called `{}` (the other in line {}); expected another name",
                point.name,
                first.place.line()
            );
            faults.add(point.place, message);
        }
    }
}

fn what_is_read_has_a_poll_class(points: &[Expanded<'_>], faults: &mut Faults) {
    for point in points.iter().filter(|point| point.is_first) {
        if point.file.poll.is_none() && point.file.press.is_none() {
            faults
                .add(&point.file.place, "`poll` is missing here; expected `fast`, `slow`, `once` or `never`");
        }
    }
}
