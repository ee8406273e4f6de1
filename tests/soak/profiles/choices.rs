//! What is left to chance: values that are written, settings that are wished for, addresses that are missing.

use busker::engine::address::Span;
use busker::engine::configuration;
use busker::engine::device::{Device, Form, Identify, Kind, Names, WriteRule};
use busker::engine::profile::Library;
use busker::engine::settings::Settings;
use fastrand::Rng;

use super::Unit;
use crate::load;

/// A point; each second time one that means what another point decides, if there is such a one.
pub fn choose_touched(random: &mut Rng, device: &Device) -> usize {
    let all = 0..device.points.len();
    let decided: Vec<usize> =
        all.clone().filter(|point| !device.points[*point].selectors().is_empty()).collect();
    match random.bool() {
        true if !decided.is_empty() => decided[random.usize(..decided.len())],
        _ => random.usize(all),
    }
}

/// A number below `count`. The first of them are places in `writable`, and each fourth time it is one of a point that
/// decides about others, if there is such a one: a mode would else be one setting among a hundred.
pub fn choose_writable(random: &mut Rng, device: &Device, writable: &[usize], count: usize) -> usize {
    let decides = |at: &usize| device.points.iter().any(|point| point.selectors().contains(&writable[*at]));
    let deciding: Vec<usize> = (0..writable.len()).filter(decides).collect();
    match random.u8(..4) {
        0 if !deciding.is_empty() => deciding[random.usize(..deciding.len())],
        _ => random.usize(..count),
    }
}

/// Something that may be written to the point.
pub fn value_for(random: &mut Rng, device: &Device, point: usize) -> String {
    let details = &device.points[point];
    let rule = &details.write.as_ref().expect("it is written").rule;
    let pick = |random: &mut Rng, names: &[String]| names[random.usize(..names.len())].clone();
    match rule {
        WriteRule::Press { .. } => "PRESS".into(),
        WriteRule::Names(names) => pick(random, names),
        WriteRule::Range { min, max, step } => {
            let number = |decimal: &dyn std::fmt::Display| decimal.to_string().parse::<f64>().expect("one");
            let (min, max) = (number(min), number(max));
            let step = step.as_ref().map_or((max - min) / 10.0, |step| number(step));
            let steps = ((max - min) / step) as u64;
            let value = min + step * random.u64(..=steps.min(1000)) as f64;
            format!("{:.3}", value).trim_end_matches('0').trim_end_matches('.').to_string()
        }
        WriteRule::Any => {
            let forms: Vec<&Form> = details.encoding.forms().collect();
            let form = forms[random.usize(..forms.len())];
            match (&form.names, form.kind) {
                (_, Kind::Bool) => if random.bool() { "ON" } else { "OFF" }.into(),
                (Names::All(names), _) if !names.is_empty() => names[random.usize(..names.len())].1.clone(),
                _ if form.kind.is_text() => "abc".into(),
                _ => random.u16(..30).to_string(),
            }
        }
    }
}

/// Perhaps some points of the devices shall hold something.
pub fn with_wishes(random: &mut Rng, text: &mut String) -> Settings {
    let settings = load(text);
    if random.bool() {
        return settings;
    }
    let mut wishing = text.clone();
    for device in &settings.devices {
        let kept = |point: &usize| {
            let point = &device.device.points[*point];
            point.persistent && !point.is_button()
        };
        let kept: Vec<usize> = (0..device.device.points.len()).filter(kept).collect();
        let mut wishes: Vec<String> = Vec::new();
        for _ in 0..random.usize(..5).min(kept.len()) {
            let point = kept[random.usize(..kept.len())];
            let value = value_for(random, &device.device, point);
            let enforce = random.bool();
            wishes.push(format!(
                "{}: {{value: \"{value}\", enforce: {enforce}}}",
                device.device.points[point].name
            ));
            // Not everything goes: a point twice, or a value that is none in the mode that is wished for.
            let unit = format!("unit: {},", device.unit);
            let attempt = wishing.replace(&unit, &format!("{unit} settings: {{{}}},", wishes.join(", ")));
            if try_load(&attempt).is_none() {
                wishes.pop();
            }
        }
        if !wishes.is_empty() {
            let unit = format!("unit: {},", device.unit);
            wishing = wishing.replace(&unit, &format!("{unit} settings: {{{}}},", wishes.join(", ")));
        }
    }
    *text = wishing;
    load(text)
}

fn try_load(text: &str) -> Option<Settings> {
    configuration::load("soak.yaml", text.as_bytes(), &Library::shipped()).ok().map(|(settings, _)| settings)
}

/// Other addresses than before are missing: between points, or some of them.
pub fn make_holes(random: &mut Rng, unit: &Unit) {
    let points = &unit.device.points;
    let identity = match &unit.device.identify {
        Some(Identify::Word { at, .. }) => Some(*at),
        _ => None,
    };
    let spans: Vec<Span> = points
        .iter()
        .flat_map(|point| {
            [
                Some(point.at.span),
                point.also.map(|at| at.span),
                point.write.as_ref().map(|write| write.at.span),
            ]
            .into_iter()
            .flatten()
        })
        .chain(identity)
        .collect();
    let mut holes = Vec::new();
    for _ in 0..random.usize(0..6) {
        let near = spans[random.usize(..spans.len())];
        let hole = Span::single(near.table(), near.last().saturating_add(random.u16(1..5)));
        if spans.iter().all(|span| !span.overlaps(hole)) {
            holes.push(hole);
        }
    }
    for _ in 0..random.usize(0..3) {
        let point = &points[random.usize(..points.len())];
        let decides = points
            .iter()
            .any(|other| other.selectors().iter().any(|by| points[*by].at.span.overlaps(point.at.span)));
        let shared = identity.is_some_and(|at| at.overlaps(point.at.span));
        if !shared && !decides && point.also.is_none() {
            holes.push(point.at.span);
        }
    }
    *unit.holes.lock().expect("nobody panicked") = holes;
}
