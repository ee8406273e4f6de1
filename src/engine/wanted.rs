//! What a device's settings shall hold: which points are settings, and what a wanted text means.
//!
//! A setting is what a device keeps: a point in EEPROM, or one that is marked as configuration. Its
//! wanted value is the text of a command, and for a point in a unit of time also a duration. What
//! another point decides can be judged in full only when that point is known; before that, a text
//! is wrong that nothing which the other point may hold would make right.

use crate::engine::codec::{self, Raw, Resolved};
use crate::engine::device::{Category, Device, Encoding, Kind, Names, Point, PointIndex, WriteRule};
use crate::engine::settings::Wanted;
use crate::engine::time::Duration;
use crate::engine::value::{Decimal, Missing};
use crate::engine::yaml::{Scalar, list_of_choices};

/// Why this point cannot be a setting; `None` if it can.
pub fn refusal(point: &Point) -> Option<String> {
    let name = &point.name;
    let Some(write) = &point.write else {
        return Some(format!("`{name}` is read-only; remove it"));
    };
    if matches!(write.rule, WriteRule::Press { .. }) {
        return Some(format!("`{name}` is a button and holds no value; remove it"));
    }
    if !point.is_read() {
        return Some(format!(
            "`{name}` is never read, and a setting is compared before it is written; remove it"
        ));
    }
    if !point.persistent && point.presentation.category != Some(Category::Config) {
        return Some(format!(
            "`{name}` is no setting, since the profile says neither `persistent` nor `category: config` of it; \
             remove it, and write it over MQTT or with `busker write`"
        ));
    }
    None
}

/// The points of a device that are settings, in the profile's order.
pub fn settings(device: &Device) -> impl Iterator<Item = PointIndex> {
    let points = device.points.iter().enumerate();
    points.filter(|(_, point)| refusal(point).is_none()).map(|(index, _)| index)
}

/// The words that make `text` true, as [`codec::encode`], or the rule that it breaks.
pub fn encode(point: &Point, resolved: &Resolved<'_>, text: &str) -> Result<Vec<u16>, String> {
    let write = point.write.as_ref().ok_or_else(|| format!("`{}` is read-only", point.name))?;
    let command = as_command(resolved, text)?;
    codec::encode(point, &write.rule, resolved, &command).map_err(|reason| match &resolved.unit {
        Some(unit) if command != text => format!("`{text}` is {command} {unit}; {reason}"),
        _ => reason,
    })
}

/// The wanted text as a command says it: a duration as a number in the point's unit.
pub fn as_command(resolved: &Resolved<'_>, text: &str) -> Result<String, String> {
    let named = resolved.form.names.list().iter().any(|(_, name)| name == text);
    let unit = resolved.unit.as_deref().and_then(|unit| Some((unit, micros_in(unit)?)));
    match unit {
        Some((unit, each)) if !named && text.starts_with(|c: char| c.is_ascii_digit()) => {
            if Decimal::parse(text).is_some() {
                return Ok(text.into());
            }
            let duration = <Duration as Scalar>::parse(text)?;
            in_unit(duration, each).ok_or_else(|| format!("`{text}` is no even number of {unit}"))
        }
        _ => Ok(text.into()),
    }
}

/// The microseconds in a unit of time, as Home Assistant spells it.
fn micros_in(unit: &str) -> Option<i128> {
    match unit {
        "μs" => Some(1),
        "ms" => Some(1_000),
        "s" => Some(1_000_000),
        "min" => Some(60_000_000),
        "h" => Some(3_600_000_000),
        "d" => Some(86_400_000_000),
        _ => None,
    }
}

fn in_unit(duration: Duration, micros_each: i128) -> Option<String> {
    let micros = i128::try_from(duration.as_micros()).ok()?;
    let number = (0..=6u8).find_map(|decimals| {
        let scaled = micros.checked_mul(10i128.pow(u32::from(decimals)))?;
        (scaled % micros_each == 0).then(|| Decimal { units: scaled / micros_each, decimals })
    })?;
    Some(number.to_string())
}

/// Judges the wish number `index` as far as it can be before the device is known: by what the other
/// wishes say of the points that decide its meaning, and for the rest by all that these may hold.
pub fn check(device: &Device, wanted: &[Wanted], index: usize) -> Result<(), String> {
    let Wanted { point, value, .. } = &wanted[index];
    let details = &device.points[*point];
    if let Some(reason) = unknown_name(details, value) {
        return Err(reason);
    }
    let known = known_by(device, wanted);
    let undecided: Vec<PointIndex> =
        details.selectors().into_iter().filter(|selector| known[*selector].is_none()).collect();
    // Each refusal, and what the undecided points held for it; those for want of a value come last.
    let mut refusals: Vec<(String, String)> = Vec::new();
    let mut without: Vec<(String, String)> = Vec::new();
    for meaning in meanings(device, *point, &undecided, &known) {
        let as_held = || {
            let held: Vec<String> =
                undecided.iter().map(|selector| format!("`{}`", held(device, *selector, &meaning))).collect();
            held.join(" and ")
        };
        match codec::resolve(device, *point, &meaning) {
            Ok(resolved) => match encode(details, &resolved, value) {
                Ok(_) => return Ok(()),
                Err(reason) => refusals.push((reason, as_held())),
            },
            Err(missing) => {
                without.push((without_value(device, *point, &meaning, &missing), as_held()));
            }
        }
    }
    refusals.append(&mut without);
    let Some((reason, held)) = refusals.first() else { return Ok(()) };
    if refusals.iter().all(|(other, _)| other == reason) {
        return Err(reason.clone());
    }
    let deciding: Vec<String> =
        undecided.iter().map(|selector| format!("`{}`", device.points[*selector].name)).collect();
    Err(format!(
        "`{value}` fits nothing that {} may make of `{}`; with {held}: {reason}",
        deciding.join(" and "),
        details.name
    ))
}

/// What is wrong with a name that the point does not have; there may be dozens.
fn unknown_name(point: &Point, value: &str) -> Option<String> {
    let form = point.plain().filter(|form| matches!(form.names, Names::All(_)) && form.kind != Kind::Bool)?;
    let write = point.write.as_ref()?;
    let names: Vec<&str> = match &write.rule {
        WriteRule::Names(names) => names.iter().map(String::as_str).collect(),
        _ => form.names.list().iter().map(|(_, name)| name.as_str()).collect(),
    };
    (!names.contains(&value))
        .then(|| format!("`{value}` is no value of `{}`; {}", point.name, list_of_choices(value, &names)))
}

/// What the wishes themselves say of the points that decide others.
fn known_by(device: &Device, wanted: &[Wanted]) -> Vec<Option<i128>> {
    let mut known = vec![None; device.points.len()];
    // Once more for each point that is itself decided by one.
    for _ in 0..3 {
        for Wanted { point, value, .. } in wanted {
            let details = &device.points[*point];
            let words = codec::resolve(device, *point, &known)
                .ok()
                .and_then(|resolved| encode(details, &resolved, value).ok());
            if let (Some(form), Some(words)) = (details.plain(), words) {
                if let Raw::Integer(raw) = codec::raw(form, &words) {
                    known[*point] = Some(raw);
                }
            }
        }
    }
    known
}

/// `known` with everything that the undecided points may hold.
fn meanings(
    device: &Device,
    point: PointIndex,
    undecided: &[PointIndex],
    known: &[Option<i128>],
) -> Vec<Vec<Option<i128>>> {
    let mut meanings = vec![known.to_vec()];
    for selector in undecided {
        let candidates = candidates(device, point, *selector);
        meanings = meanings
            .iter()
            .flat_map(|meaning| {
                candidates.iter().map(|candidate| {
                    let mut meaning = meaning.clone();
                    meaning[*selector] = Some(*candidate);
                    meaning
                })
            })
            .collect();
    }
    meanings
}

/// What `selector` may hold, as far as it makes a difference to `point`.
fn candidates(device: &Device, point: PointIndex, selector: PointIndex) -> Vec<i128> {
    if let Encoding::Cases { by, cases } = &device.points[point].encoding {
        if *by == selector {
            return cases.iter().map(|case| case.key).collect();
        }
    }
    let details = &device.points[selector];
    match details.plain().map(|form| &form.names) {
        Some(Names::All(names) | Names::Some(names)) if !names.is_empty() => {
            names.iter().map(|(raw, _)| *raw).collect()
        }
        // Digits behind the dot.
        _ => {
            let highest = match details.write.as_ref().map(|write| &write.rule) {
                Some(WriteRule::Range { max, .. }) => max.with_decimals(0).map(|max| max.units),
                _ => None,
            };
            let most = i128::from(Decimal::DECIMALS_MAX);
            (0..=highest.unwrap_or(most).clamp(0, most)).collect()
        }
    }
}

/// Why a point has no value: in the mode that is wanted of it, or for what a deciding point holds.
fn without_value(device: &Device, point: PointIndex, known: &[Option<i128>], missing: &Missing) -> String {
    let details = &device.points[point];
    match (&details.encoding, missing) {
        (Encoding::Cases { by, .. }, Missing::NotInThisMode) => {
            let held = held(device, *by, known);
            format!("`{}` has no value while `{}` is `{held}`", details.name, device.points[*by].name)
        }
        _ => format!("`{}` has no value: {missing}", details.name),
    }
}

/// The name of what a deciding point holds, or its number.
fn held(device: &Device, point: PointIndex, known: &[Option<i128>]) -> String {
    let Some(raw) = known[point] else { return "unknown".into() };
    let names = device.points[point].plain().map_or(&[][..], |form| form.names.list());
    names.iter().find(|(value, _)| *value == raw).map_or_else(|| raw.to_string(), |(_, name)| name.clone())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::profile::Library;

    fn check_values(profile: &str, settings: &[(&str, &str)]) -> Result<(), String> {
        let device = Library::shipped().load(profile).expect("a shipped profile");
        let wanted: Vec<Wanted> = settings
            .iter()
            .map(|(name, value)| {
                let point = device.point_named(name).expect(name);
                Wanted { point, value: value.to_string(), enforce: false }
            })
            .collect();
        (0..wanted.len()).try_for_each(|index| check(&device, &wanted, index))
    }

    #[test]
    fn durations_are_numbers_in_the_unit_of_their_point() {
        for (text, expected) in [
            ("30s", Ok(())),
            ("30", Ok(())),
            ("1.5m", Ok(())),
            ("0.25s", Ok(())),
            ("10m55s", Err("`m55s` is not a unit of time; expected us, ms, s, m, h or d, as in `30s`")),
            ("700s", Err("`700s` is 700 s; `700` is outside 0 to 655.35")),
            ("soon", Err("`soon` is not a number")),
        ] {
            let found = check_values("metz-connect/mr-do4", &[("watchdog", text)]);
            assert_eq!(found.as_ref().map_err(String::as_str).map(|_| ()), expected, "{text}");
        }
        assert_eq!(in_unit(Duration::from_millis(1500), 1_000_000).as_deref(), Some("1.5"));
        assert_eq!(in_unit(Duration::from_secs(90), 60_000_000).as_deref(), Some("1.5"));
        assert_eq!(in_unit(Duration::from_secs(1), 60_000_000), None);
    }

    #[test]
    fn what_another_point_decides_is_checked_as_far_as_possible() {
        const AI8: &str = "metz-connect/mr-ai8";
        // Nothing says what is connected: there is a sensor for which it is right.
        assert_eq!(check_values(AI8, &[("channel_1_on_above", "60")]), Ok(()));
        let refused = check_values(AI8, &[("channel_1_on_above", "much")]).expect_err("no number at all");
        assert_eq!(refused, "`much` is not a number");
        // The deciding point stands beside it, in whatever order.
        const SI4: &str = "metz-connect/mr-si4";
        assert_eq!(check_values(SI4, &[("meter_1_start", "12.3"), ("meter_1_decimals", "1")]), Ok(()));
        let refused = check_values(SI4, &[("meter_1_start", "4294967295"), ("meter_1_decimals", "1")]);
        assert_eq!(refused, Err("`4294967295` is outside 0.0 to 429496729.5".into()));
        assert_eq!(check_values(SI4, &[("meter_1_start", "4294967295")]), Ok(()));
        let refused = check_values(SI4, &[("meter_1_start", "4294967296")]).expect_err("too large");
        assert_eq!(
            refused,
            "`4294967296` fits nothing that `meter_1_decimals` may make of `meter_1_start`; \
             with `0`: `4294967296` is outside 0 to 4294967295"
        );
    }

    #[test]
    fn settings_are_what_the_device_keeps_and_what_is_marked_as_configuration() {
        let device = Library::shipped().load("metz-connect/mr-do4").expect("a shipped profile");
        let names: Vec<&str> = settings(&device).map(|point| device.points[point].name.as_str()).collect();
        assert_eq!(
            names,
            ["relay_1_default", "relay_2_default", "relay_3_default", "relay_4_default", "watchdog"]
        );
        let device = Library::shipped().load("metz-connect/mr-ai8").expect("a shipped profile");
        assert!(settings(&device).any(|point| device.points[point].name == "channel_1_offset"));
    }
}
