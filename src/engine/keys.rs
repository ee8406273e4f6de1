//! By which keys Home Assistant knows the entities of a device, and which of them two would share.
//!
//! A key is unique in its device and the same for ever. Most are the point's or the thing's own name; where one
//! point is several entities, by its cases or by the buttons beside it, something is added, and that may be what
//! another one is called.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use crate::engine::device::{
    Device, Encoding, Form, Kind, Names, Platform, Point, Thing, ThingKind, Unit, WriteRule,
};
use crate::engine::units;

/// The key of the entity that counts the writes to the device's EEPROM, and the info's too.
pub const EEPROM_WRITES: &str = "eeprom_writes";

/// What keys begin with that tell how the device is on its wire.
pub const WIRE: &str = "wire_";

/// What a bus tells of its wire, and behind [`WIRE`] a device.
pub const OF_A_WIRE: [&str; 15] = [
    "load",
    "fast_period",
    "slow_period",
    "requests",
    "timeouts",
    "checksum_errors",
    "exceptions",
    "late_replies",
    "wrong_frames",
    "noise_bytes",
    "turnaround_p50",
    "turnaround_p95",
    "turnaround_p99",
    "gap_wait_p95",
    "command_wait_p95",
];

/// Whether the link of a bus is up.
pub const LINK: &str = "link";

/// The one entity of the gateway itself.
pub const CONNECTION: &str = "connection";

/// What is added where the same point has its controls at other times: the same key with another platform would
/// leave both entities in Home Assistant.
pub const STATE_ENDING: &str = "_state";

/// The key of the point's entity while it is understood in this form.
pub fn of_point(point: &Point, form: &Form, unit: Option<&str>) -> String {
    if !matches!(point.encoding, Encoding::Cases { .. }) {
        return point.name.clone();
    }
    // One key never stands for two platforms: Home Assistant would keep both entities.
    let ending = match unit {
        Some(unit) => slug(unit),
        None if form.kind == Kind::Bool => "flag".into(),
        None if form.kind.is_text() => "text".into(),
        None if matches!(form.names, Names::All(_)) => "state".into(),
        None if form.since.is_some() => "time".into(),
        None => return point.name.clone(),
    };
    format!("{}_{ending}", point.name)
}

/// The key of the button that writes `name`, beside the entity with the key `main`.
pub fn of_button(device: &Device, main: &str, name: &str) -> String {
    let mut key = format!("{main}_{}", slug(name));
    while device.points.iter().any(|other| other.name == key) {
        key.push_str("_button");
    }
    key
}

/// What the point is in Home Assistant in this form.
pub fn platform(point: &Point, form: &Form) -> Platform {
    let possible = units::platforms(point, form);
    point.presentation.platform.filter(|wished| possible.contains(wished)).unwrap_or(possible[0])
}

/// The names that can be written to the point and that its own entity cannot show.
pub fn names_beside<'a>(point: &'a Point, form: &'a Form, platform: Platform) -> Vec<&'a str> {
    match (point.write.as_ref().map(|write| &write.rule), platform) {
        (Some(WriteRule::Names(names)), Platform::Sensor | Platform::BinarySensor) => {
            names.iter().map(String::as_str).collect()
        }
        (Some(WriteRule::Any | WriteRule::Range { .. }), Platform::Number) => {
            form.names.list().iter().map(|(_, name)| name.as_str()).collect()
        }
        _ => Vec::new(),
    }
}

/// A unit or a name as the end of an identifier: `°C` is `c`, `kΩ` is `kohm`, `m³/h` is `m3_h`.
fn slug(text: &str) -> String {
    let mut slug = String::new();
    for c in units::normalized(text).chars() {
        match c {
            '°' => {}
            'Ω' | '\u{2126}' => slug.push_str("ohm"),
            '%' => slug.push_str("percent"),
            '\u{3bc}' => slug.push('u'),
            '²' => slug.push('2'),
            '³' => slug.push('3'),
            c if c.is_ascii_alphanumeric() => slug.push(c.to_ascii_lowercase()),
            _ if slug.is_empty() || slug.ends_with('_') => {}
            _ => slug.push('_'),
        }
    }
    slug.trim_end_matches('_').to_string()
}

/// Whose entity it is.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Owner {
    /// A point, in every case that has the same key.
    Point(String),
    /// A point while a thing commands it.
    Commanded(String),
    Thing(usize, String),
    Button {
        point: String,
        name: String,
    },
    /// What every device tells of itself.
    Gateway,
}

impl fmt::Display for Owner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Owner::Point(name) => write!(f, "the point `{name}`"),
            Owner::Commanded(name) => write!(f, "the point `{name}` while a thing commands it"),
            Owner::Thing(_, name) => write!(f, "the thing `{name}`"),
            Owner::Button { point, name } => write!(f, "the button that sets `{point}` to `{name}`"),
            Owner::Gateway => f.write_str("what every device tells of itself"),
        }
    }
}

/// Every key that an entity of the device can have, whatever its selectors say, with those whose it is: more than
/// one only where two cannot be told apart.
pub fn of_device(device: &Device) -> BTreeMap<String, BTreeSet<Owner>> {
    let mut keys: BTreeMap<String, BTreeSet<Owner>> = BTreeMap::new();
    let mut add = |key: String, owner: Owner| {
        keys.entry(key).or_default().insert(owner);
    };
    for (index, point) in device.points.iter().enumerate() {
        // Whether it is there whenever the point is. A climate steps back where it cannot show its temperatures.
        let is_always = |thing: &&Thing| thing.lives_with(point) && thing.kind != ThingKind::Climate;
        let (always, at_times): (Vec<&Thing>, Vec<&Thing>) = device.things.iter().partition(is_always);
        let is_shown = always.iter().any(|thing| thing.shows(index));
        let is_commanded = always.iter().any(|thing| thing.commands_point(index));
        let is_commanded_at_times =
            at_times.iter().any(|thing| thing.commands_point(index) && !thing.shows(index));
        if is_shown {
            continue;
        }
        for form in point.encoding.forms().filter(|form| form.elements == 1) {
            for unit in units_of(form, device) {
                let main = of_point(point, form, unit.as_deref());
                if is_commanded_at_times {
                    add(format!("{main}{STATE_ENDING}"), Owner::Commanded(point.name.clone()));
                }
                if !is_commanded {
                    for name in names_beside(point, form, platform(point, form)) {
                        let owner = Owner::Button { point: point.name.clone(), name: name.into() };
                        add(of_button(device, &main, name), owner);
                    }
                }
                add(main, Owner::Point(point.name.clone()));
            }
        }
    }
    for (index, thing) in device.things.iter().enumerate() {
        add(thing.name.clone(), Owner::Thing(index, thing.name.clone()));
    }
    if device.points.iter().any(|point| point.persistent) {
        add(EEPROM_WRITES.into(), Owner::Gateway);
    }
    for key in OF_A_WIRE {
        add(format!("{WIRE}{key}"), Owner::Gateway);
    }
    keys
}

/// The keys that are made for one entity and are another one's too, with both. What two are called is no matter of
/// this: names have rules of their own.
pub fn shared(device: &Device) -> Vec<(String, Vec<Owner>)> {
    let is_its_name = |key: &str, owner: &Owner| match owner {
        Owner::Point(name) => name == key,
        Owner::Thing(..) | Owner::Gateway => true,
        Owner::Commanded(_) | Owner::Button { .. } => false,
    };
    let is_thing = |owner: &&Owner| matches!(owner, Owner::Thing(..));
    let all =
        of_device(device).into_iter().map(|(key, owners)| (key, owners.into_iter().collect::<Vec<_>>()));
    all.filter(|(_, owners)| owners.len() > 1)
        .filter(|(key, owners)| {
            owners.iter().filter(is_thing).count() > 1 || !owners.iter().all(|owner| is_its_name(key, owner))
        })
        .collect()
}

/// What is wrong with two of one key.
pub fn message(key: &str, owners: &[Owner]) -> String {
    let names: Vec<String> = owners.iter().map(Owner::to_string).collect();
    format!(
        "{} are both `{key}` to Home Assistant; expected another name for one of them",
        names.join(" and ")
    )
}

/// What the unit may be in this form.
fn units_of(form: &Form, device: &Device) -> Vec<Option<String>> {
    match &form.unit {
        Unit::None => vec![None],
        Unit::Fixed(unit) => vec![Some(unit.clone())],
        Unit::By(point) => {
            let names = device.points[*point].plain().map_or(&[][..], |form| form.names.list());
            names.iter().map(|(_, unit)| Some(unit.clone())).collect()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_end_identifiers_in_plain_letters() {
        for (unit, ending) in [
            ("°C", "c"),
            ("°F", "f"),
            ("V", "v"),
            ("mA", "ma"),
            ("Ω", "ohm"),
            ("kΩ", "kohm"),
            ("%", "percent"),
            ("m³/h", "m3_h"),
            ("\u{b5}S/cm", "us_cm"),
            ("4..20 mA", "4_20_ma"),
        ] {
            assert_eq!(slug(unit), ending, "{unit}");
        }
    }
}
