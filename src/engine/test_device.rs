//! Small devices for tests of the engine.

use crate::engine::device::{Device, Point};

/// A device of these points, without any limits of its own.
pub fn device_of(points: Vec<Point>) -> Device {
    Device {
        profile: "test".into(),
        manufacturer: "Test".into(),
        model: "T1".into(),
        points,
        ..Device::default()
    }
}
