//! The devices of the soak and their points, as the configuration, the topics and the registers know them.

use std::fmt::Write;

use crate::device::{BLOCK, BLOCKS, STORED, Store};

/// The units of each line; the addresses between them belong to nobody, so that a device with a wrong
/// address is not taken for another one, as it would on any line.
pub const UNITS: [&[u8]; 2] = [&[1, 3, 5, 7, 9, 11], &[1, 3, 5, 7]];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Point {
    Reading(u16),
    Stored(Store),
}

/// A point of a device on a line.
#[derive(Clone, Copy, Debug)]
pub struct PointOf {
    pub line: usize,
    pub unit: u8,
    pub point: Point,
}

impl PointOf {
    /// The function that reads it, and its address.
    pub fn place(&self) -> (u8, u16) {
        match self.point {
            Point::Reading(address) => (4, address),
            Point::Stored(Store::Coil(number)) => (1, number),
            Point::Stored(Store::Holding(number)) => (3, number),
        }
    }
}

pub fn units() -> impl Iterator<Item = (usize, u8)> {
    UNITS.iter().enumerate().flat_map(|(line, units)| units.iter().map(move |unit| (line, *unit)))
}

/// The points of each device.
pub fn all() -> impl Iterator<Item = Point> {
    let readings = BLOCKS.iter().flat_map(|block| *block..block + BLOCK).map(Point::Reading);
    readings.chain(stores().map(Point::Stored))
}

pub fn stores() -> impl Iterator<Item = Store> {
    (0..STORED).flat_map(|number| [Store::Coil(number), Store::Holding(number)])
}

pub fn device(line: usize, unit: u8) -> String {
    format!("device_{line}_{unit}")
}

pub fn topic(line: usize, unit: u8, point: Point) -> String {
    format!("busker/{}/{}", device(line, unit), name(point))
}

fn name(point: Point) -> String {
    match point {
        Point::Reading(address) => format!("reading_{address}"),
        Point::Stored(Store::Coil(number)) => format!("relay_{number}"),
        Point::Stored(Store::Holding(number)) => format!("level_{number}"),
    }
}

/// The point of a state topic.
pub fn of_topic(topic: &str) -> Option<PointOf> {
    let (device, point) = topic.strip_prefix("busker/device_")?.split_once('/')?;
    let (line, unit) = device.split_once('_')?;
    let (kind, number) = point.split_once('_')?;
    let number = number.parse().ok()?;
    let point = match kind {
        "reading" => Point::Reading(number),
        "relay" => Point::Stored(Store::Coil(number)),
        "level" => Point::Stored(Store::Holding(number)),
        _ => return None,
    };
    Some(PointOf { line: line.parse().ok()?, unit: unit.parse().ok()?, point })
}

pub fn payload(store: Store, value: u16) -> String {
    match (store, value) {
        (Store::Coil(_), 0) => "OFF".into(),
        (Store::Coil(_), _) => "ON".into(),
        (Store::Holding(_), value) => value.to_string(),
    }
}

pub fn value(payload: &str) -> Option<u16> {
    match payload {
        "ON" => Some(1),
        "OFF" => Some(0),
        number => number.parse().ok(),
    }
}

/// The configuration, without the broker: each of `links` with its devices.
pub fn configuration(links: &[String]) -> String {
    let mut text = String::from("home_assistant: {discovery: false}\nbuses:\n");
    for (line, link) in links.iter().enumerate() {
        let _ = writeln!(text, "  line_{line}: {{{link}, response_timeout: 400ms}}");
    }
    text += "devices:\n";
    for (line, unit) in units() {
        let device = device(line, unit);
        let _ = writeln!(
            text,
            "  {device}:\n    bus: line_{line}\n    unit: {unit}\n    poll: {{fast: 500ms}}\n    points:"
        );
        for point in all() {
            let place = match point {
                Point::Reading(address) => format!("at: input {address}"),
                Point::Stored(Store::Coil(number)) => format!("at: coil {number}, write: any"),
                Point::Stored(Store::Holding(number)) => format!("at: holding {number}, write: 0..65535"),
            };
            let _ = writeln!(text, "      {}: {{{place}, poll: fast}}", name(point));
        }
    }
    text
}
