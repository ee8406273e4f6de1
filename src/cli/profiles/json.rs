//! A profile as data for other programs: every point, with all that is known of it on the wire.

use serde_json::{Map, Value as Json, json};

use super::access;
use crate::engine::address::Span;
use crate::engine::device::{
    Case, Condition, Decimals, Device, Encoding, Form, Identify, LineControl, Order, Point, PointIndex,
    SettingsBy, Thing, Unit, WriteRule,
};
use crate::engine::homeassistant::entity;
use crate::engine::time::Date;
use crate::engine::value::Decimal;

/// One line of `profiles list`.
pub fn summary(device: &Device) -> Json {
    json!({
        "device": device.profile,
        "manufacturer": device.manufacturer,
        "model": device.model,
        "source": device.source.trim(),
        "points": device.points.len(),
    })
}

/// The whole profile.
pub fn device(device: &Device) -> Json {
    let wire = &device.wire;
    let points: Vec<Json> = (0..device.points.len()).map(|index| point(device, index)).collect();
    let left_out = device.left_out.iter().map(|left_out| with_reason(left_out.span, &left_out.reason));
    let forbidden = wire.forbidden.iter().map(|forbidden| with_reason(forbidden.span, &forbidden.reason));
    json!({
        "device": device.profile,
        "manufacturer": device.manufacturer,
        "model": device.model,
        "source": device.source.trim(),
        "identify": device.identify.as_ref().map(identify),
        "limits": {
            "read_registers": wire.limits.read_registers,
            "read_bits": wire.limits.read_bits,
            "write_registers": wire.limits.write_registers,
            "gap": wire.limits.gap,
            "delay_ms": wire.limits.delay.as_millis() as u64,
        },
        "readable": wire.readable.iter().map(|read| span(*read)).collect::<Vec<_>>(),
        "forbidden": forbidden.collect::<Vec<_>>(),
        "line": device.line.as_ref().map(line),
        "left_out": left_out.collect::<Vec<_>>(),
        "poll": {
            "fast_ms": wire.intervals.fast.as_millis() as u64,
            "slow_ms": wire.intervals.slow.as_millis() as u64,
        },
        "connect_delay_ms": wire.connect_delay.as_millis() as u64,
        "response_timeout_ms": wire.response_timeout.map(|timeout| timeout.as_millis() as u64),
        "quirks": {
            "clamps_with_exception": wire.quirks.clamps_with_exception,
            "exception_function_varies": wire.quirks.exception_function_varies,
        },
        "watchdog": wire.watchdog.map(|point| name(device, point)),
        "points": points,
        "things": device.things.iter().map(|thing| thing_json(device, thing)).collect::<Vec<_>>(),
    })
}

fn identify(identify: &Identify) -> Json {
    match identify {
        Identify::Names { vendor, product } => json!({"vendor": vendor, "product": product}),
        Identify::Word { at, mask, equals } => json!({
            "table": at.table().name(), "address": at.first(), "mask": mask, "equals": equals,
        }),
    }
}

fn line(line: &LineControl) -> Json {
    let settings = match &line.settings {
        SettingsBy::Hand(switches) => json!({"by_hand": switches}),
        SettingsBy::Register(register) => {
            let baud: serde_json::Map<String, Json> =
                register.baud.iter().map(|(baud, code)| (baud.to_string(), (*code).into())).collect();
            json!({
                "table": register.at.table().name(), "address": register.at.first(), "add": register.add, "baud": baud,
                "parity": {"even": register.even, "odd": register.odd, "none": register.none},
            })
        }
    };
    json!({"settings": settings, "unit_by": line.unit_by})
}

fn span(span: Span) -> Json {
    json!({"table": span.table().name(), "first": span.first(), "last": span.last()})
}

fn with_reason(at: Span, reason: &str) -> Json {
    let mut json = span(at);
    json["reason"] = reason.trim().into();
    json
}

fn name(device: &Device, point: PointIndex) -> &str {
    &device.points[point].name
}

fn point(device: &Device, index: PointIndex) -> Json {
    let point = &device.points[index];
    let plain = point.plain();
    let write = point.write.as_ref();
    let range = plain.and_then(|form| raw_limits(form, write.map(|write| &write.rule)));
    let press = write.and_then(|write| match write.rule {
        WriteRule::Press { word, .. } => Some(word),
        _ => None,
    });
    let self_clearing =
        write.is_some_and(|write| matches!(write.rule, WriteRule::Press { self_clearing: true, .. }));
    let writable_names = write.and_then(|write| match &write.rule {
        WriteRule::Names(names) => Some(names),
        _ => None,
    });
    let mut json = json!({
        "name": point.name,
        "table": point.at.span.table().name(),
        "address": point.at.span.first(),
        "count": point.at.span.count(),
        "elements": plain.map_or(1, |form| form.elements),
        "bits": point.at.bits.map(|bits| [bits.low(), bits.high()]),
        "also": point.also.map(|also| json!({
            "table": also.span.table().name(),
            "address": also.span.first(),
            "count": also.span.count(),
            "bits": also.bits.map(|bits| [bits.low(), bits.high()]),
        })),
        "type": plain.map(|form| form.kind.name()),
        "order": plain.map(|form| order(form.order)),
        "scale": plain.map(|form| number(scale(form))),
        "offset": plain.map(|form| number(form.offset)),
        "unit": plain.and_then(unit),
        "unit_by": plain.and_then(|form| unit_by(device, form)),
        "decimals_by": plain.and_then(|form| decimals_by(device, form)),
        "difference": point.encoding.forms().any(|form| form.difference),
        "access": access(point),
        "write_at": write.filter(|write| write.at != point.at).map(|write| json!({
            "table": write.at.span.table().name(),
            "address": write.at.span.first(),
            "count": write.at.span.count(),
            "bits": write.at.bits.map(|bits| [bits.low(), bits.high()]),
        })),
        "write_with": write.and_then(|write| write.with).map(|function| function.code()),
        "writable_names": writable_names,
        "press": press,
        "self_clearing": self_clearing,
        "persistent": point.persistent,
        "read_clears": point.read_clears,
        "poll": point.poll.name(),
        "min": range.map(|(min, _)| number(min)),
        "max": range.map(|(_, max)| number(max)),
        "default": point.default.map(|default| number(Decimal::integer(default))),
        "values": values(&point.encoding),
        "others": plain.and_then(|form| form.others).map(|others| others.to_string()),
        "invalid": invalid(&point.encoding),
        "re_read": point.re_read.iter().map(|other| name(device, *other)).collect::<Vec<_>>(),
        "by": selector(device, point).filter(|by| by.refers.is_none()).map(|by| &by.name),
        "like": selector(device, point).filter(|by| by.refers.is_some()).map(|by| &by.name),
        "refers": point.refers.map(span),
        "cases": match &point.encoding {
            Encoding::Plain(_) => Json::Null,
            Encoding::Cases { cases, .. } => {
                cases.iter().map(|case| (case.name.clone(), case_json(device, case))).collect::<Map<_, _>>().into()
            }
        },
        "when": when(device, &point.when),
        "event": point.event,
        "heartbeat": point.heartbeat.map(|time| name(device, time)),
        "settle_ms": write.map(|write| write.settle.as_millis() as u64),
        "on_change": write.and_then(|write| write.on_change).map(|between| number(Decimal::integer(between))),
        "entity": entity_json(device, index),
    });
    // Beside the macro, which takes no more keys.
    let ranges = point.ranges.iter().map(|(name, form)| (name.clone(), form_json(device, form)));
    json["ranges"] = ranges.collect::<Map<_, _>>().into();
    json["out_of_range"] =
        write.filter(|_| point.takes_numbers()).map(|write| write.out_of_range.name()).into();
    json["since"] = plain.and_then(|form| form.since).map(since).into();
    json
}

/// The point that decides about this one's meaning.
fn selector<'d>(device: &'d Device, point: &Point) -> Option<&'d Point> {
    match &point.encoding {
        Encoding::Plain(_) => None,
        Encoding::Cases { by, .. } => Some(&device.points[*by]),
    }
}

fn when(device: &Device, conditions: &[Condition]) -> Json {
    if conditions.is_empty() {
        return Json::Null;
    }
    let entry = |condition: &Condition| {
        let names: Vec<&str> = condition.values.iter().map(|(_, name)| name.as_str()).collect();
        (name(device, condition.point).to_string(), Json::from(names))
    };
    conditions.iter().map(entry).collect::<Map<_, _>>().into()
}

fn thing_json(device: &Device, thing: &Thing) -> Json {
    let row = |row: &[(PointIndex, String)]| {
        let entry = |(point, text): &(PointIndex, String)| {
            (name(device, *point).to_string(), Json::from(text.as_str()))
        };
        Json::from(row.iter().map(entry).collect::<Map<_, _>>())
    };
    let states = thing.states.iter().map(|state| (state.name.clone(), row(&state.row)));
    let commands = thing.commands.iter().map(|command| {
        let orders: Vec<Json> = command.orders.iter().map(|order| row(std::slice::from_ref(order))).collect();
        (command.name.clone(), Json::from(orders))
    });
    json!({
        "name": thing.name,
        "as": thing.kind.name(),
        "when": when(device, &thing.when),
        "state": states.collect::<Map<_, _>>(),
        "do": commands.collect::<Map<_, _>>(),
        "temperature": thing.temperature.map(|point| name(device, point)),
        "target": thing.target.map(|point| name(device, point)),
        "device_class": thing.presentation.device_class,
        "enabled": thing.presentation.enabled.unwrap_or(true),
    })
}

/// The day that a moment is counted from.
fn since(date: Date) -> String {
    date.to_string().chars().take_while(|character| *character != 'T').collect()
}

fn case_json(device: &Device, case: &Case) -> Json {
    let Some(form) = &case.form else { return Json::Null };
    let mut json = form_json(device, form);
    json["key"] = number(Decimal::integer(case.key));
    json
}

fn form_json(device: &Device, form: &Form) -> Json {
    let range = raw_limits(form, None);
    json!({
        "type": form.kind.name(),
        "scale": number(scale(form)),
        "offset": number(form.offset),
        "unit": unit(form),
        "unit_by": unit_by(device, form),
        "decimals_by": decimals_by(device, form),
        "since": form.since.map(since),
        "min": range.map(|(min, _)| number(min)),
        "max": range.map(|(_, max)| number(max)),
        "values": named(form),
        "invalid": invalid_words(form),
    })
}

/// What Home Assistant shows, whatever the registers that decide hold. Of a point with cases: what
/// all of its cases agree in.
fn entity_json(device: &Device, index: PointIndex) -> Json {
    let usual = usual_registers(device, index);
    let all: Vec<Json> = match &device.points[index].encoding {
        Encoding::Plain(_) => {
            entity(device, index, &usual).into_iter().map(|entity| entity.to_json()).collect()
        }
        Encoding::Cases { by, cases } => cases
            .iter()
            .filter_map(|case| {
                let mut known = usual.clone();
                known[*by] = Some(case.key);
                entity(device, index, &known)
            })
            .map(|entity| entity.to_json())
            .collect(),
    };
    let agreed = all.into_iter().reduce(|mut agreed, other| {
        for (key, value) in agreed.as_object_mut().into_iter().flatten() {
            if other[key.as_str()] != *value {
                *value = Json::Null;
            }
        }
        agreed
    });
    agreed.unwrap_or(Json::Null)
}

/// What the registers that decide about others hold while nobody has changed them: the factory
/// setting, or else the first that the profile names; and whatever lets this point live.
pub fn usual_registers(device: &Device, index: PointIndex) -> Vec<Option<i128>> {
    let usual = |point: &Point| {
        let named = point.plain().and_then(|form| form.names.list().first()).map(|(raw, _)| *raw);
        Some(point.default.or(named).unwrap_or(0))
    };
    let mut registers: Vec<Option<i128>> = device.points.iter().map(usual).collect();
    for condition in &device.points[index].when {
        let holds = registers[condition.point].is_some_and(|raw| condition.holds(raw));
        if let (false, Some((raw, _))) = (holds, condition.values.first()) {
            registers[condition.point] = Some(*raw);
        }
    }
    registers
}

/// The factor from the register to the unit, fixed decimals included.
fn scale(form: &Form) -> Decimal {
    let shift = match form.decimals {
        Some(Decimals::Fixed(decimals)) => decimals,
        Some(Decimals::By(_)) | None => 0,
    };
    Decimal { units: form.scale.units, decimals: form.scale.decimals + shift }.normalized()
}

/// Between which raw values it may be written, or else measures; never more than its type holds.
fn raw_limits(form: &Form, rule: Option<&WriteRule>) -> Option<(Decimal, Decimal)> {
    let (min, max) = match (rule, form.range) {
        (Some(WriteRule::Range { min, max, .. }), _) => (*min, *max),
        (_, Some((min, max))) if form.difference => {
            let widest = max.checked_add(min.negated())?;
            (widest.negated(), widest)
        }
        (_, range) => range?,
    };
    let (a, b) = (to_raw(form, min)?, to_raw(form, max)?);
    let (min, max) = if a.compare(b).is_le() { (a, b) } else { (b, a) };
    let Some((low, high)) = form.kind.integer_range() else { return Some((min, max)) };
    let (low, high) = (Decimal::integer(low), Decimal::integer(high));
    let within = |raw: Decimal| match raw.compare(low).is_lt() {
        true => low,
        false if raw.compare(high).is_gt() => high,
        false => raw,
    };
    Some((within(min), within(max)))
}

fn to_raw(form: &Form, value: Decimal) -> Option<Decimal> {
    let offset = if form.difference { Decimal::ZERO } else { form.offset };
    let above = value.checked_add(offset.negated())?;
    let scale = scale(form);
    if let Some(raw) = above.divided_exactly_by(scale) {
        return Some(Decimal::integer(raw));
    }
    let raw = above.to_f64() / scale.to_f64();
    Decimal::parse(&if form.kind.is_float() { raw.to_string() } else { format!("{raw:.0}") })
}

fn unit(form: &Form) -> Option<&str> {
    match &form.unit {
        Unit::Fixed(unit) => Some(unit),
        Unit::None | Unit::By(_) => None,
    }
}

fn unit_by<'d>(device: &'d Device, form: &Form) -> Option<&'d str> {
    match form.unit {
        Unit::By(point) => Some(name(device, point)),
        Unit::None | Unit::Fixed(_) => None,
    }
}

fn decimals_by<'d>(device: &'d Device, form: &Form) -> Option<&'d str> {
    match form.decimals {
        Some(Decimals::By(point)) => Some(name(device, point)),
        Some(Decimals::Fixed(_)) | None => None,
    }
}

fn order(order: Order) -> &'static str {
    match order {
        Order::Abcd => "abcd",
        Order::Cdab => "cdab",
        Order::Badc => "badc",
        Order::Dcba => "dcba",
    }
}

fn values(encoding: &Encoding) -> Json {
    match encoding {
        Encoding::Plain(form) => named(form),
        Encoding::Cases { .. } => json!({}),
    }
}

fn named(form: &Form) -> Json {
    let named = form.named_values().into_iter().map(|(raw, name)| (raw.to_string(), Json::from(name)));
    named.collect::<Map<_, _>>().into()
}

fn invalid(encoding: &Encoding) -> Json {
    match encoding {
        Encoding::Plain(form) => invalid_words(form),
        Encoding::Cases { .. } => json!({}),
    }
}

fn invalid_words(form: &Form) -> Json {
    let words = form.invalid.iter().map(|(word, reason)| (word.to_string(), Json::from(reason.as_str())));
    words.collect::<Map<_, _>>().into()
}

/// As a JSON number: whole ones without a dot.
fn number(number: Decimal) -> Json {
    let number = number.normalized();
    match (number.decimals, i64::try_from(number.units)) {
        (0, Ok(whole)) => whole.into(),
        _ => number.to_f64().into(),
    }
}
