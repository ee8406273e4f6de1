//! What the owner of a device wishes for single points of its profile.

use crate::engine::configuration::file::PointWish;
use crate::engine::device::{Device, Encoding, Form, Kind, Names, Point, PointIndex, Poll, Unit};
use crate::engine::units;
use crate::engine::yaml::{At, Faults, Map, Node, nearest, read};

/// Applies the wishes in `node`, a map from names of points.
pub fn apply(node: &Node, device: &mut Device, faults: &mut Faults, warnings: &mut Faults) {
    let Some(wishes): Option<Map<String, PointWish>> = read(node, faults) else { return };
    for (name, wish) in wishes.iter() {
        match device.points.iter().position(|point| point.name == name.value) {
            Some(point) => apply_one(point, wish, device, faults, warnings),
            None => faults.add(&name.place, unknown_point(name, device)),
        }
    }
    for name in &wishes.unread {
        if !device.points.iter().any(|point| point.name == name.value) {
            faults.add(&name.place, unknown_point(name, device));
        }
    }
}

pub(super) fn unknown_point(name: &str, device: &Device) -> String {
    let known: Vec<&str> = device.points.iter().map(|point| point.name.as_str()).collect();
    let inline = device.profile == "inline";
    let owner = if inline { "this device".into() } else { format!("`{}`", device.profile) };
    match nearest(name, &known) {
        Some(meant) => format!("{owner} has no point `{name}`; did you mean `{meant}`?"),
        None if inline => format!("{owner} has no point `{name}`; its points stand under `points`"),
        None => {
            let profile = &device.profile;
            format!("{owner} has no point `{name}`; `busker profiles show {profile}` lists its points")
        }
    }
}

fn apply_one(
    index: PointIndex,
    wish: &PointWish,
    device: &mut Device,
    faults: &mut Faults,
    warnings: &mut Faults,
) {
    if let Some(poll) = &wish.poll {
        check_poll(index, poll, device, faults, warnings);
    }
    let point = &mut device.points[index];
    if let Some(poll) = &wish.poll {
        point.poll = poll.value;
    }
    if let Some(unit) = &wish.unit {
        give_unit(point, unit, faults);
    }
    if let Some(deadband) = &wish.deadband {
        if !forms(point).any(is_number) {
            faults.add(
                &deadband.place,
                format!("`{}` is no number; only a number has a `deadband`", point.name),
            );
        }
        if deadband.units < 0 {
            faults.add(
                &deadband.place,
                format!("{} is below zero; a deadband is a difference", deadband.value),
            );
        }
        point.deadband = Some(deadband.value);
    }
    let look = &wish.presentation;
    if let Some(icon) = &look.icon {
        let good = icon.split_once(':').is_some_and(|(set, name)| !set.is_empty() && !name.is_empty());
        if !good || icon.contains(char::is_whitespace) {
            faults.add(&icon.place, format!("`{}` is no icon; expected one like `mdi:fan`", icon.value));
        }
    }
    let presentation = &mut point.presentation;
    replace(&mut presentation.name, look.name.clone());
    replace(&mut presentation.platform, look.r#as.as_ref().map(|platform| platform.value));
    replace(&mut presentation.device_class, look.device_class.as_ref().map(|class| class.value.clone()));
    replace(&mut presentation.state_class, look.state_class.as_ref().map(|class| class.value.clone()));
    replace(&mut presentation.category, look.category);
    replace(&mut presentation.icon, look.icon.as_ref().map(|icon| icon.value.clone()));
    replace(&mut presentation.enabled, look.enabled);
    check_presentation(point, wish, faults);
}

fn replace<T>(own: &mut Option<T>, wish: Option<T>) {
    if wish.is_some() {
        *own = wish;
    }
}

fn check_poll(
    index: PointIndex,
    poll: &At<Poll>,
    device: &Device,
    faults: &mut Faults,
    warnings: &mut Faults,
) {
    let name = &device.points[index].name;
    if !device.points[index].is_read() && poll.value != Poll::Never {
        faults.add(&poll.place, format!("`{name}` is not read by its profile; remove `poll`"));
    }
    let Some(follower) = device.points.iter().find(|point| point.selectors().contains(&index)) else {
        return;
    };
    match poll.value {
        Poll::Never => faults.add(
            &poll.place,
            format!("`{name}` decides how `{}` is read and must be read itself; expected `slow`", follower.name),
        ),
        Poll::Once => warnings.add(
            &poll.place,
            format!("`{name}` decides how `{}` is read; a change made on the device is not seen until the next connect", follower.name),
        ),
        Poll::Fast | Poll::Slow => {}
    }
}

/// A unit is given to a number of which the profile knows none; changing one would make the numbers
/// wrong, since nothing converts them.
fn give_unit(point: &mut Point, unit: &At<String>, faults: &mut Faults) {
    let name = &point.name;
    let refusal = match &mut point.encoding {
        Encoding::Cases { .. } => format!("the unit of `{name}` follows its case; remove `unit`"),
        Encoding::Plain(form) if !is_number(form) => {
            format!("`{name}` is no number and has no unit; remove `unit`")
        }
        Encoding::Plain(form) => match &form.unit {
            Unit::None => {
                form.unit = Unit::Fixed(unit.value.clone());
                return;
            }
            Unit::Fixed(own) if *own == unit.value => return,
            Unit::Fixed(own) => format!(
                "`{name}` is in `{own}`, and nothing would convert it to `{}`; remove `unit`",
                unit.value
            ),
            Unit::By(_) => format!("the device decides the unit of `{name}`; remove `unit`"),
        },
    };
    faults.add(&unit.place, refusal);
}

/// What Home Assistant would refuse, it refuses silently for the person who wished it; so here.
fn check_presentation(point: &Point, wish: &PointWish, faults: &mut Faults) {
    let look = &wish.presentation;
    let classes = [&look.device_class, &look.state_class, &wish.unit].into_iter().flatten();
    let place = classes.map(|class| &class.place).next();
    for form in forms(point) {
        let platforms = units::platforms(point, form);
        if let Some(platform) = &look.r#as {
            if !platforms.contains(&platform.value) {
                let possible: Vec<String> =
                    platforms.iter().map(|known| format!("`{}`", known.name())).collect();
                faults.add(
                    &platform.place,
                    format!(
                        "`{}` cannot be a {}; expected {}",
                        point.name,
                        platform.name(),
                        possible.join(" or ")
                    ),
                );
                return;
            }
        }
        let platform = point.presentation.platform.unwrap_or(platforms[0]);
        let unit = match &form.unit {
            Unit::Fixed(unit) => Some(unit.as_str()),
            Unit::None | Unit::By(_) => None,
        };
        let (class, state) =
            (point.presentation.device_class.as_deref(), point.presentation.state_class.as_deref());
        if let (Some(place), Err(message)) = (place, units::check(platform, class, unit, state)) {
            faults.add(place, message);
            return;
        }
    }
}

fn forms(point: &Point) -> impl Iterator<Item = &Form> {
    let (plain, cases) = match &point.encoding {
        Encoding::Plain(form) => (Some(form), [].as_slice()),
        Encoding::Cases { cases, .. } => (None, cases.as_slice()),
    };
    plain.into_iter().chain(cases.iter().filter_map(|case| case.form.as_ref()))
}

fn is_number(form: &Form) -> bool {
    form.kind != Kind::Bool && !form.kind.is_text() && !matches!(form.names, Names::All(_))
}
