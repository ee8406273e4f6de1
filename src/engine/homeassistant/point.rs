//! What one point is in Home Assistant: derived from what it is on the wire, and overridden by what
//! the profile or the configuration says of its looks.

use super::entity::Entity;
use super::thing;
use crate::engine::codec::{self, Limits, Resolved};
use crate::engine::device::{
    Category, Device, Form, Kind, Names, Platform, Point, PointIndex, Poll, WriteRule,
};
use crate::engine::keys;
use crate::engine::units;
use crate::engine::value::Missing;

/// What `point` is at present. `None` while the points that decide about it are not known, and in a
/// case without a reading.
pub fn entity(device: &Device, point: PointIndex, known: &[Option<i128>]) -> Option<Entity> {
    let resolved = codec::resolve(device, point, known).ok()?;
    let shown = thing::as_shown(device, point, known)?;
    let point = &*shown;
    // An array is no state that Home Assistant could keep.
    if resolved.form.elements > 1 {
        return None;
    }
    let platform = keys::platform(point, resolved.form);
    let presentation = &point.presentation;
    let name = presentation.title(&point.name);
    let key = keys::of_point(point, resolved.form, resolved.unit.as_deref()) + shown.key_ending();
    let mut entity = Entity {
        category: category(point, platform),
        icon: presentation.icon.clone().filter(|icon| icon.starts_with("mdi:")),
        enabled: presentation.enabled.unwrap_or(point.is_read() || point.write.is_some()),
        press: (platform == Platform::Button).then(|| WriteRule::PRESS.into()),
        ..Entity::new(key, platform, name)
    };
    if entity.is_number(&resolved) {
        describe_number(&mut entity, point, &resolved);
    } else if matches!(platform, Platform::Sensor | Platform::Select)
        && matches!(resolved.form.names, Names::All(_))
    {
        for (_, name) in resolved.form.names.list() {
            if !entity.options.contains(name) {
                entity.options.push(name.clone());
            }
        }
        if platform == Platform::Sensor {
            entity.device_class = Some("enum".into());
        } else {
            avoid_none(&mut entity);
        }
    } else {
        entity.device_class = fitting_class(point, platform, resolved.form, None)
            .or_else(|| units::class_of_sense(resolved.form).map(str::to_string));
        entity.event_types = point.event.iter().cloned().collect();
        if platform == Platform::Text {
            entity.length = Some(match resolved.form.kind {
                Kind::Text { registers } => registers.saturating_mul(2),
                Kind::LetterNumber => 4,
                _ => 10,
            });
            entity.value_template = Some(NO_TEXT_IS_EMPTY.into());
        }
    }
    Some(entity)
}

/// A text is the one entity for which Home Assistant has no word that means unknown: it would show `None` itself,
/// as if that stood in the device.
const NO_TEXT_IS_EMPTY: &str = "{{ '' if value == 'None' else value }}";

/// Whether enough is known to say which entities there are: no point waits for another one.
pub fn is_settled(device: &Device, known: &[Option<i128>]) -> bool {
    let points = (0..device.points.len()).map(|point| codec::resolve(device, point, known).map(|_| true));
    let things = device.things.iter().map(|thing| codec::lives(device, &thing.when, known));
    points.chain(things).all(|decided| !matches!(decided, Err(Missing::WaitingFor(_))))
}

/// A select takes `none`, however it is written, for an unknown state: an option of that name gets
/// another one in Home Assistant.
fn avoid_none(entity: &mut Entity) {
    let Some(at) = entity.options.iter().position(|option| option.eq_ignore_ascii_case("none")) else {
        return;
    };
    let mut shown = "nothing".to_string();
    while entity.options.contains(&shown) {
        shown.push('_');
    }
    let name = std::mem::replace(&mut entity.options[at], shown.clone());
    let template = |from: &str, to: &str| format!("{{{{ '{to}' if value == '{from}' else value }}}}");
    entity.value_template = Some(template(&name, &shown));
    entity.command_template = Some(template(&shown, &name));
}

fn describe_number(entity: &mut Entity, point: &Point, resolved: &Resolved) {
    let unit = resolved.unit.as_deref().map(units::normalized);
    entity.device_class = fitting_class(point, entity.platform, resolved.form, unit.as_deref())
        .or_else(|| units::class_of_unit(unit.as_deref()?, resolved.form.difference).map(str::to_string));
    let class = entity.device_class.as_deref();
    let mut conditions = Vec::new();
    if !resolved.form.names.list().is_empty() {
        conditions.push("is_number(value)".to_string());
    }
    if entity.platform == Platform::Sensor {
        entity.state_class = point
            .presentation
            .state_class
            .clone()
            .filter(|wished| units::check(Platform::Sensor, class, unit.as_deref(), Some(wished)).is_ok())
            .or_else(|| derived_state_class(point, resolved, class, unit.as_deref()).map(str::to_string));
        let of_a_float = || resolved.form.kind.is_float().then(|| units::digits_of_a_float(unit.as_deref()));
        entity.precision = resolved.display_precision().or_else(of_a_float);
    } else {
        if resolved.form.kind == Kind::F64 {
            entity.reach = f64::MAX;
        }
        let limits = point.write.as_ref().and_then(|write| codec::limits(resolved, &write.rule));
        if let Some(limits) = limits {
            let limits = with_factory_setting(point, resolved, limits);
            (entity.min, entity.max, entity.step) = (Some(limits.min), Some(limits.max), limits.step);
            // Home Assistant logs an error for a number outside its limits and keeps the old one.
            if conditions.is_empty() {
                conditions.push("is_number(value)".to_string());
            }
            conditions.push(format!("{} <= value | float <= {}", limits.min, limits.max));
        }
    }
    entity.unit = unit;
    if !conditions.is_empty() {
        entity.value_template = Some(format!("{{{{ value if {} else None }}}}", conditions.join(" and ")));
    }
}

/// The limits of a number in Home Assistant, which shows none outside of them. What the device holds as it left
/// the factory is shown, also where the manual lets nobody write it; whoever tries is refused by the gateway.
fn with_factory_setting(point: &Point, resolved: &Resolved, limits: Limits) -> Limits {
    let form = resolved.form;
    let is_number =
        |raw: &i128| !form.names.list().iter().chain(&form.invalid).any(|(other, _)| other == raw);
    let factory = point.default.filter(is_number).and_then(|raw| codec::to_unit(resolved, raw));
    let Some(factory) = factory else { return limits };
    let (min, max) = (limits.min, limits.max);
    Limits {
        min: if factory.compare(min).is_lt() { factory } else { min },
        max: if factory.compare(max).is_gt() { factory } else { max },
        ..limits
    }
}

fn derived_state_class(
    point: &Point,
    resolved: &Resolved,
    class: Option<&str>,
    unit: Option<&str>,
) -> Option<&'static str> {
    let kind = resolved.form.kind;
    // Registers of this width that are read again and again and have no unit count something.
    let counts = matches!(kind, Kind::U48 | Kind::U64) && matches!(point.poll, Poll::Fast | Poll::Slow);
    if counts && class.is_none() && unit.is_none() {
        return Some("total_increasing");
    }
    let signed = kind.integer_range().is_none_or(|(low, _)| low < 0);
    units::state_class(class, unit, signed)
}

/// The device class that was wished for, where it goes with the platform, the form and the present unit.
fn fitting_class(point: &Point, platform: Platform, form: &Form, unit: Option<&str>) -> Option<String> {
    let wished = point.presentation.device_class.clone();
    wished.filter(|class| {
        units::check(platform, Some(class), unit, None).is_ok()
            && units::check_sense(platform, form, Some(class), None).is_ok()
    })
}

pub(super) fn category(point: &Point, platform: Platform) -> Option<Category> {
    let reads_only = matches!(platform, Platform::Sensor | Platform::BinarySensor | Platform::Event);
    let category = point.presentation.category.or(if point.persistent {
        Some(Category::Config)
    } else if reads_only && point.poll == Poll::Once {
        Some(Category::Diagnostic)
    } else {
        None
    });
    // What only shows is no setting: Home Assistant refuses the entity.
    if reads_only { category.map(|_| Category::Diagnostic) } else { category }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::address::{Address, Span, Table};
    use crate::engine::device::{Decimals, Encoding, Unit, Write};
    use crate::engine::homeassistant::beside::companions;
    use crate::engine::test_device::device_of;
    use crate::engine::time::Date;
    use crate::engine::value::Decimal;

    /// A point at `holding 0` (or `coil 0` for a flag), read slowly, as `change` makes it.
    fn point_with(form: Form, rule: Option<WriteRule>, change: impl FnOnce(&mut Point)) -> Point {
        let table = if form.kind == Kind::Bool { Table::Coil } else { Table::Holding };
        let at = Address { span: Span::single(table, 0), bits: None };
        let mut point = Point::new("flow_value", at, Poll::Slow);
        point.encoding = Encoding::Plain(form);
        point.write = rule.map(|rule| Write::new(at, rule));
        change(&mut point);
        point
    }

    /// The entity and its companions, a line for each, without what is as usual.
    #[track_caller]
    fn check_entity(point: Point, expected: &[&str]) {
        let device = device_of(vec![point]);
        let main = entity(&device, 0, &[None]).expect("nothing is unknown");
        let all = std::iter::once(main).chain(companions(&device, 0, &[None]));
        let lines: Vec<String> = all
            .map(|entity| {
                let component = entity.component();
                let skipped = ["name", "mode"];
                let parts = component.iter().filter(|(key, _)| !skipped.contains(&key.as_str()));
                let parts: Vec<String> = parts
                    .map(|(key, value)| match (key.as_str(), value.as_str()) {
                        ("platform", Some(text)) => format!("{text} {}:", entity.key),
                        (_, Some(text)) => format!("{key}={text}"),
                        _ => format!("{key}={value}"),
                    })
                    .collect();
                parts.join(" ")
            })
            .collect();
        assert_eq!(lines, expected);
    }

    fn form(kind: Kind, unit: &str) -> Form {
        Form { unit: Unit::Fixed(unit.into()), ..Form::new(kind) }
    }

    fn named(names: &[(i128, &str)]) -> Vec<(i128, String)> {
        names.iter().map(|(raw, name)| (*raw, name.to_string())).collect()
    }

    fn range(min: i128, max: i128) -> Option<WriteRule> {
        Some(WriteRule::Range { min: Decimal::integer(min), max: Decimal::integer(max), step: None })
    }

    const NOTHING: fn(&mut Point) = |_| {};

    #[test]
    fn what_is_only_read_is_a_sensor_with_the_class_of_its_unit() {
        let tenths = Form { decimals: Some(Decimals::Fixed(1)), ..form(Kind::I16, "°C") };
        check_entity(
            point_with(tenths.clone(), None, NOTHING),
            &["sensor flow_value: device_class=temperature unit_of_measurement=°C state_class=measurement \
               suggested_display_precision=1"],
        );
        check_entity(
            point_with(Form { difference: true, ..tenths }, None, NOTHING),
            &["sensor flow_value: device_class=temperature_delta unit_of_measurement=°C \
               state_class=measurement suggested_display_precision=1"],
        );
        check_entity(
            point_with(form(Kind::U32, "kWh"), None, NOTHING),
            &["sensor flow_value: device_class=energy unit_of_measurement=kWh \
               state_class=total_increasing suggested_display_precision=0"],
        );
        check_entity(
            point_with(form(Kind::I32, "kWh"), None, NOTHING),
            &["sensor flow_value: device_class=energy unit_of_measurement=kWh state_class=total \
               suggested_display_precision=0"],
        );
        check_entity(
            point_with(form(Kind::F32, "%"), None, NOTHING),
            &[
                "sensor flow_value: unit_of_measurement=% state_class=measurement suggested_display_precision=1",
            ],
        );
        check_entity(
            point_with(Form::new(Kind::U48), None, NOTHING),
            &["sensor flow_value: state_class=total_increasing suggested_display_precision=0"],
        );
        check_entity(
            point_with(Form::new(Kind::U16), None, |point| point.poll = Poll::Once),
            &["sensor flow_value: suggested_display_precision=0 entity_category=diagnostic"],
        );
        check_entity(
            point_with(Form::new(Kind::Text { registers: 4 }), None, NOTHING),
            &["sensor flow_value:"],
        );
        check_entity(point_with(Form::new(Kind::Bool), None, NOTHING), &["binary_sensor flow_value:"]);
        let moment = Form { since: Some(Date(0)), ..Form::new(Kind::U32) };
        check_entity(
            point_with(moment.clone(), None, NOTHING),
            &["sensor flow_value: device_class=timestamp"],
        );
        check_entity(
            point_with(moment.clone(), None, |point| {
                point.presentation.device_class = Some("uptime".into());
                point.presentation.state_class = Some("measurement".into());
            }),
            &["sensor flow_value: device_class=uptime"],
        );
        check_entity(
            point_with(moment, None, |point| point.presentation.device_class = Some("duration".into())),
            &["sensor flow_value: device_class=timestamp"],
        );
        let names = Names::All(named(&[(0, "mains"), (1, "battery")]));
        check_entity(
            point_with(Form { names, ..Form::new(Kind::U16) }, None, NOTHING),
            &["sensor flow_value: device_class=enum options=[\"mains\",\"battery\"]"],
        );
    }

    #[test]
    fn what_can_be_written_is_a_control() {
        check_entity(
            point_with(Form::new(Kind::Bool), Some(WriteRule::Any), NOTHING),
            &["switch flow_value:"],
        );
        let names = Names::All(named(&[(0, "off"), (3, "pt100")]));
        check_entity(
            point_with(
                Form { names: names.clone(), ..Form::new(Kind::U16) },
                Some(WriteRule::Any),
                |point| {
                    point.persistent = true;
                },
            ),
            &["select flow_value: entity_category=config options=[\"off\",\"pt100\"]"],
        );
        let with_none = Names::All(named(&[(0, "none"), (2, "temperature")]));
        check_entity(
            point_with(Form { names: with_none, ..Form::new(Kind::U16) }, Some(WriteRule::Any), NOTHING),
            &["select flow_value: options=[\"nothing\",\"temperature\"] \
               value_template={{ 'nothing' if value == 'none' else value }} \
               command_template={{ 'none' if value == 'nothing' else value }}"],
        );
        check_entity(
            point_with(
                Form { names, ..Form::new(Kind::U16) },
                Some(WriteRule::Names(vec!["off".into()])),
                NOTHING,
            ),
            &[
                "sensor flow_value: device_class=enum options=[\"off\",\"pt100\"]",
                "button flow_value_off: payload_press=off",
            ],
        );
        check_entity(
            point_with(
                Form { decimals: Some(Decimals::Fixed(1)), ..form(Kind::I16, "V") },
                range(0, 10),
                NOTHING,
            ),
            &["number flow_value: device_class=voltage unit_of_measurement=V min=0 max=10 step=0.1 \
               value_template={{ value if is_number(value) and 0 <= value | float <= 10 else None }}"],
        );
        check_entity(
            point_with(
                Form { names: Names::Some(named(&[(11111, "automatic")])), ..Form::new(Kind::U16) },
                range(0, 255),
                NOTHING,
            ),
            &[
                "number flow_value: min=0 max=255 step=1 \
                 value_template={{ value if is_number(value) and 0 <= value | float <= 255 else None }}",
                "button flow_value_automatic: payload_press=automatic",
            ],
        );
        check_entity(
            point_with(
                Form::new(Kind::U16),
                Some(WriteRule::Press { word: 0x55AA, self_clearing: true }),
                |point| {
                    point.poll = Poll::Never;
                    point.presentation.device_class = Some("restart".into());
                },
            ),
            &["button flow_value: device_class=restart payload_press=PRESS"],
        );
        check_entity(
            point_with(Form::new(Kind::F32), Some(WriteRule::Any), NOTHING),
            &["number flow_value: min=-3.4028236e+38 max=3.4028236e+38 step=0.001"],
        );
        check_entity(
            point_with(Form::new(Kind::F64), Some(WriteRule::Any), NOTHING),
            &["number flow_value: min=-1.7976931348623157e+308 max=1.7976931348623157e+308 step=0.001"],
        );
        check_entity(
            point_with(Form::new(Kind::Text { registers: 4 }), Some(WriteRule::Any), NOTHING),
            &["text flow_value: max=8 value_template={{ '' if value == 'None' else value }}"],
        );
    }

    #[test]
    fn wishes_are_followed_where_home_assistant_would_not_drop_the_entity_for_them() {
        check_entity(
            point_with(form(Kind::U16, "W"), None, |point| {
                point.presentation.device_class = Some("temperature".into());
                point.presentation.state_class = Some("total".into());
                point.presentation.category = Some(Category::Config);
                point.presentation.icon = Some("mdi:flash".into());
                point.presentation.enabled = Some(false);
            }),
            &["sensor flow_value: device_class=power unit_of_measurement=W state_class=measurement \
               suggested_display_precision=0 entity_category=diagnostic icon=mdi:flash \
               enabled_by_default=false"],
        );
        check_entity(
            point_with(form(Kind::U16, "%"), range(0, 100), |point| {
                point.presentation.platform = Some(Platform::Sensor);
                point.presentation.device_class = Some("humidity".into());
            }),
            &["sensor flow_value: device_class=humidity unit_of_measurement=% state_class=measurement \
               suggested_display_precision=0"],
        );
    }
}
