//! Things as Home Assistant is told of them, and what becomes of the points they are made of: one
//! entity for one thing, never the same bit twice.

use std::borrow::Cow;
use std::ops::Deref;

use serde_json::{Map, Value, json};

use super::device::name_beside;
use crate::engine::codec;
use crate::engine::device::{Device, PRESS, Point, PointIndex, Thing, ThingKind};
use crate::engine::keys::STATE_ENDING;
use crate::engine::settings::DeviceSettings;
use crate::engine::topics::DeviceTopics;
use crate::engine::value::Decimal;

/// A point as it is shown beside the things that live now.
pub(super) struct Shown<'d> {
    point: Cow<'d, Point>,
    key_ending: &'static str,
}

impl Shown<'_> {
    /// What makes the entity's key another one than that of the point with its controls: the same key
    /// with another platform would leave both entities in Home Assistant.
    pub(super) fn key_ending(&self) -> &'static str {
        self.key_ending
    }
}

impl Deref for Shown<'_> {
    type Target = Point;
    fn deref(&self) -> &Point {
        &self.point
    }
}

/// The point as an entity of its own: `None` while a thing shows it, and without its controls while a
/// thing commands it.
pub(super) fn as_shown<'d>(
    device: &'d Device,
    index: PointIndex,
    known: &[Option<i128>],
) -> Option<Shown<'d>> {
    let point = &device.points[index];
    let mut shown = Shown { point: Cow::Borrowed(point), key_ending: "" };
    for thing in &device.things {
        let touches = thing.shows(index) || thing.commands_point(index);
        if !touches || !is_there(device, thing, known) {
            continue;
        }
        if thing.shows(index) {
            return None;
        }
        shown.point.to_mut().write = None;
        if !thing.lives_with(point) {
            shown.key_ending = STATE_ENDING;
        }
    }
    Some(shown)
}

/// The discovery component of a thing; `None` while it does not live.
pub(super) fn thing_component(
    identity: &str,
    own: &DeviceTopics,
    device: &DeviceSettings,
    thing: &Thing,
    known: &[Option<i128>],
) -> Option<Map<String, Value>> {
    if !is_there(&device.device, thing, known) {
        return None;
    }
    let presentation = &thing.presentation;
    let platform = thing.kind.name();
    let name = presentation.title(&thing.name);
    let mut component = Map::new();
    let mut put = |key: &str, value: Value| component.insert(key.into(), value);
    put("platform", platform.into());
    put("name", name_beside(&name, &device.title));
    put("unique_id", format!("{identity}_{}", thing.name).into());
    put("default_entity_id", format!("{platform}.{}_{}", device.name, thing.name).into());
    if let Some(class) = &presentation.device_class {
        put("device_class", class.clone().into());
    }
    if let Some(icon) = &presentation.icon {
        put("icon", icon.clone().into());
    }
    if let Some(category) = presentation.category {
        put("entity_category", category.name().into());
    }
    if presentation.enabled == Some(false) {
        put("enabled_by_default", false.into());
    }
    let (state, set) = (own.state(&thing.name), own.set(&thing.name));
    match thing.kind {
        ThingKind::Button => {
            put("command_topic", set.into());
            put("payload_press", PRESS.into());
        }
        ThingKind::Cover | ThingKind::Valve => {
            put("state_topic", state.into());
            put("command_topic", set.into());
            for command in thing.kind.commands() {
                // A command that there is not is null: Home Assistant would offer it else.
                let payload = thing.command(command).map(|command| command.name.as_str());
                put(&format!("payload_{command}"), payload.into());
            }
            // Home Assistant takes what stops behind a closing for closed. Nobody knows that.
            put("value_template", "{{ 'None' if value == 'stopped' else value }}".into());
        }
        ThingKind::Climate => {
            let modes: Vec<&str> = thing.commands.iter().map(|command| command.name.as_str()).collect();
            put("modes", modes.into());
            put("mode_state_topic", state.into());
            put("mode_command_topic", set.into());
            let parts = climate_parts(own, device, thing, known)?;
            parts.into_iter().for_each(|(key, value)| {
                put(key, value);
            });
        }
    }
    Some(component)
}

/// No thermostat is turned by less.
const TENTH: Decimal = Decimal { units: 1, decimals: 1 };

/// Whether Home Assistant is told of the thing now: it lives, and what a climate shows is a temperature.
fn is_there(device: &Device, thing: &Thing, known: &[Option<i128>]) -> bool {
    let is_possible = thing.kind != ThingKind::Climate || temperature_unit(device, thing, known).is_some();
    is_possible && codec::lives(device, &thing.when, known) == Ok(true)
}

fn temperature_unit(device: &Device, thing: &Thing, known: &[Option<i128>]) -> Option<&'static str> {
    let unit = codec::resolve(device, thing.temperature?, known).ok()?.unit;
    match unit.as_deref() {
        Some("°C") => Some("C"),
        Some("°F") => Some("F"),
        _ => None,
    }
}

/// What a climate takes from its two temperatures.
fn climate_parts(
    own: &DeviceTopics,
    device: &DeviceSettings,
    thing: &Thing,
    known: &[Option<i128>],
) -> Option<Vec<(&'static str, Value)>> {
    let (present, target) = (thing.temperature?, thing.target?);
    let points = &device.device.points;
    let unit = temperature_unit(&device.device, thing, known)?;
    let target_form = codec::resolve(&device.device, target, known).ok()?;
    let rule = points[target].write.as_ref().map(|write| &write.rule);
    let limits = rule.and_then(|rule| codec::limits(&target_form, rule));
    let step = limits.and_then(|limits| limits.step).filter(|step| step.compare(TENTH).is_gt());
    let number = |decimal: Decimal| json!(decimal.to_f64());
    let topic = |point: PointIndex| Value::from(own.state(&points[point].name));
    Some(vec![
        ("temperature_unit", unit.into()),
        ("current_temperature_topic", topic(present)),
        ("temperature_state_topic", topic(target)),
        ("temperature_command_topic", own.set(&points[target].name).into()),
        // Home Assistant's own limits are those of a living room.
        ("min_temp", limits.map_or(json!(-50), |limits| number(limits.min))),
        ("max_temp", limits.map_or(json!(150), |limits| number(limits.max))),
        ("temp_step", number(step.unwrap_or(TENTH))),
    ])
}
