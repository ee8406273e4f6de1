//! Small devices for tests of the engine.

use crate::engine::address::Address;
use crate::engine::device::{Device, Encoding, Form, Kind, Limits, Point, Poll, Presentation, Quirks, Wire};

/// A read-only `u16` (or, in a table of bits, flag) at this place.
pub fn point(name: &str, at: Address, poll: Poll) -> Point {
    let kind = if at.span.table().is_bits() { Kind::Bool } else { Kind::U16 };
    Point {
        name: name.into(),
        at,
        also: None,
        encoding: Encoding::Plain(Form::new(kind)),
        poll,
        write: None,
        persistent: false,
        read_clears: false,
        default: None,
        re_read: Vec::new(),
        deadband: None,
        presentation: Presentation::default(),
    }
}

/// A device of these points, without any limits of its own.
pub fn device_of(points: Vec<Point>) -> Device {
    Device {
        profile: "test".into(),
        manufacturer: "Test".into(),
        model: "T1".into(),
        source: "a test".into(),
        identify: None,
        wire: Wire {
            limits: Limits::default(),
            readable: Vec::new(),
            forbidden: Vec::new(),
            intervals: Default::default(),
            response_timeout: None,
            quirks: Quirks::default(),
            watchdog: None,
        },
        points,
        left_out: Vec::new(),
    }
}
