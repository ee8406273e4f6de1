//! What the owner of a device wishes for single points of its profile.

use crate::engine::configuration::file::PointWish;
use crate::engine::device::{
    self, Condition, Device, Encoding, Platform, Point, PointIndex, Poll, Thing, Unit,
};
use crate::engine::profile::file;
use crate::engine::units::{self, Release};
use crate::engine::yaml::{At, Faults, Map, Node, Place, list_of_choices, nearest, read};

/// Applies the wishes in `node`, a map from names of points.
pub fn apply(node: &Node, device: &mut Device, release: Release, faults: &mut Faults, warnings: &mut Faults) {
    let Some(wishes): Option<Map<String, PointWish>> = read(node, faults) else { return };
    for (name, wish) in wishes.iter() {
        match device.point_named(name) {
            Some(point) => {
                apply_one(point, wish, device, faults, warnings);
                if let Some(class) = &wish.presentation.device_class {
                    check_release_of(&device.points[point], release, &class.place, faults);
                }
            }
            None => match device.things.iter_mut().find(|thing| thing.name == name.value) {
                Some(thing) => apply_to_thing(thing, wish, faults),
                None => faults.add(&name.place, unknown_point(name, device)),
            },
        }
    }
    for name in &wishes.unread {
        let is_there = device.points.iter().map(|point| &point.name);
        let is_there =
            is_there.chain(device.things.iter().map(|thing| &thing.name)).any(|known| *known == name.value);
        if !is_there {
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
    add_conditions(index, wish, device, faults);
    let point = &mut device.points[index];
    if let Some(range) = &wish.range {
        choose_range(point, range, faults);
    }
    if let Some(poll) = &wish.poll {
        point.poll = poll.value;
    }
    if let Some(unit) = &wish.unit {
        give_unit(point, unit, faults);
        hint_at_unit(&point.name, unit, &unit.place, warnings);
    }
    if let Some(deadband) = &wish.deadband {
        if !point.encoding.forms().any(|form| form.is_number() || form.since.is_some()) {
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
    let takes_numbers = point.takes_numbers();
    if let Some(out_of_range) = &wish.out_of_range {
        match &mut point.write {
            Some(write) if takes_numbers => write.out_of_range = out_of_range.value,
            _ => faults.add(
                &out_of_range.place,
                format!("no number is written to `{}`; remove `out_of_range`", point.name),
            ),
        }
    }
    let look = &wish.presentation;
    if let Some(icon) = &look.icon {
        let good = icon.split_once(':').is_some_and(|(set, name)| !set.is_empty() && !name.is_empty());
        if !good || icon.contains(char::is_whitespace) {
            faults.add(&icon.place, format!("`{}` is no icon; expected one like `mdi:fan`", icon.value));
        }
    }
    apply_look(&mut point.presentation, look);
    check_presentation(point, wish, faults, warnings);
}

/// A thing is made of points: only how it looks is a matter of wishes.
fn apply_to_thing(thing: &mut Thing, wish: &PointWish, faults: &mut Faults) {
    let look = &wish.presentation;
    let facts = [
        wish.unit.as_ref().map(|key| ("unit", &key.place)),
        wish.range.as_ref().map(|key| ("range", &key.place)),
        wish.deadband.as_ref().map(|key| ("deadband", &key.place)),
        wish.poll.as_ref().map(|key| ("poll", &key.place)),
        wish.out_of_range.as_ref().map(|key| ("out_of_range", &key.place)),
        look.r#as.as_ref().map(|key| ("as", &key.place)),
        look.state_class.as_ref().map(|key| ("state_class", &key.place)),
        wish.when.iter().next().map(|(key, _)| ("when", &key.place)),
    ];
    for (key, place) in facts.into_iter().flatten() {
        faults.add(place, format!("`{}` is made of points and has no `{key}`; remove it", thing.name));
    }
    if let Some(class) = &look.device_class {
        if let Err(message) = units::check(thing.kind.platform(), Some(&class.value), None, None) {
            faults.add(&class.place, message);
        }
    }
    apply_look(&mut thing.presentation, look);
}

fn apply_look(presentation: &mut device::Presentation, look: &file::Presentation) {
    replace(&mut presentation.name, look.name.clone());
    replace(&mut presentation.platform, look.r#as.as_ref().map(|platform| platform.value));
    replace(&mut presentation.device_class, look.device_class.as_ref().map(|class| class.value.clone()));
    replace(&mut presentation.state_class, look.state_class.as_ref().map(|class| class.value.clone()));
    replace(&mut presentation.category, look.category);
    replace(&mut presentation.icon, look.icon.as_ref().map(|icon| icon.value.clone()));
    replace(&mut presentation.enabled, look.enabled);
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

/// The owner says which of the profile's ranges the device is set to.
fn choose_range(point: &mut Point, range: &At<String>, faults: &mut Faults) {
    match point.ranges.iter().find(|(name, _)| *name == range.value) {
        Some((_, form)) => point.encoding = Encoding::Plain(form.clone()),
        None if point.ranges.is_empty() => {
            faults
                .add(&range.place, format!("the profile knows what `{}` means; remove `range`", point.name));
        }
        None => {
            let known: Vec<&str> = point.ranges.iter().map(|(name, _)| name.as_str()).collect();
            let choices = list_of_choices(&range.value, &known);
            faults.add(&range.place, format!("`{}` is no range of `{}`; {choices}", range.value, point.name));
        }
    }
}

/// The owner says while which switches stand how a reading is to be believed.
fn add_conditions(index: PointIndex, wish: &PointWish, device: &mut Device, faults: &mut Faults) {
    for (name, wanted) in wish.when.iter() {
        let Some(selector) = device.point_named(&name.value.0) else {
            let known: Vec<&str> = device.points.iter().map(|point| point.name.as_str()).collect();
            let choices = list_of_choices(&name.value.0, &known);
            faults.add(&name.place, format!("no point is called `{}`; {choices}", name.value.0));
            continue;
        };
        let names = device.points[selector].deciding_values();
        if names.is_empty() || !device.points[selector].is_read() {
            faults.add(
                &name.place,
                format!("`{}` has no named values that are polled; it cannot decide", name.value.0),
            );
            continue;
        }
        let known: Vec<&str> = names.iter().map(|(_, name)| name.as_str()).collect();
        for value in wanted.iter().filter(|value| !known.contains(&value.value.as_str())) {
            let choices = list_of_choices(&value.value, &known);
            faults
                .add(&value.place, format!("`{}` is no value of `{}`; {choices}", value.value, name.value.0));
        }
        let is_wanted = |name: &str| wanted.iter().any(|value| value.value == name);
        let values = names.iter().filter(|(_, name)| is_wanted(name)).cloned().collect();
        device.points[index].when.push(Condition { point: selector, values });
    }
}

/// A unit is given to a number of which the profile knows none; changing one would make the numbers
/// wrong, since nothing converts them.
fn give_unit(point: &mut Point, unit: &At<String>, faults: &mut Faults) {
    let name = &point.name;
    let refusal = match &mut point.encoding {
        Encoding::Cases { .. } => format!("the unit of `{name}` follows its case; remove `unit`"),
        Encoding::Plain(form) if !form.is_number() => {
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
fn check_presentation(point: &Point, wish: &PointWish, faults: &mut Faults, warnings: &mut Faults) {
    let look = &wish.presentation;
    let classes = [&look.device_class, &look.state_class, &wish.unit].into_iter().flatten();
    let place = classes.map(|class| &class.place).next();
    for form in point.encoding.forms() {
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
        // The class that the unit stands for, where none is wished.
        let is_numeric = matches!(platform, Platform::Sensor | Platform::Number);
        let of_unit = || units::class_of_unit(unit?, form.difference).filter(|_| is_numeric);
        let class = class.or_else(of_unit);
        let fits = units::check(platform, class, unit, state);
        let fits = fits.and_then(|()| units::check_sense(platform, form, class, state));
        if let (Some(place), Err(message)) = (place, fits) {
            faults.add(place, message);
            return;
        }
        let needed =
            || units::needed_by(class?).filter(|_| matches!(form.unit, Unit::None) && form.is_number());
        if let (Some(wished), Some(needed)) = (&look.device_class, needed()) {
            let message = format!(
                "device class `{}` without a unit: Home Assistant makes nothing of such a number; expected `unit` \
                 beside it, one of {needed}",
                wished.value
            );
            warnings.add(&wished.place, message);
            return;
        }
    }
}

/// Home Assistant takes any unit; one that it would know by another spelling is most likely meant so.
pub fn hint_at_unit(name: &str, unit: &str, place: &Place, warnings: &mut Faults) {
    let meant: Vec<String> = units::meant_by(unit).iter().map(|meant| format!("`{meant}`")).collect();
    if !meant.is_empty() {
        let message = format!(
            "Home Assistant does not know the unit `{unit}` of `{name}`; did you mean {}?",
            meant.join(" or ")
        );
        warnings.add(place, message);
    }
}

/// No class that a device's own points ask for may be newer than the oldest Home Assistant that must know it.
pub fn check_release(device: &Device, release: Release, place: &Place, faults: &mut Faults) {
    for point in &device.points {
        check_release_of(point, release, place, faults);
    }
}

fn check_release_of(point: &Point, release: Release, place: &Place, faults: &mut Faults) {
    let Some(class) = point.presentation.device_class.as_deref() else { return };
    let since = point.encoding.forms().map(|form| match &form.unit {
        Unit::Fixed(unit) => (units::known_since(class, Some(unit)), Some(unit)),
        Unit::None | Unit::By(_) => (units::known_since(class, None), None),
    });
    if let Some((since, unit)) = since.filter(|(since, _)| *since > release).max() {
        let of = unit.map(|unit| format!(" in `{unit}`")).unwrap_or_default();
        faults.add(
            place,
            format!(
                "Home Assistant knows `{class}`{of} since {since}, but `{name}` is to be understood by {release}; \
                 say `minimum_version: \"{since}\"` under `home_assistant`, or leave the class out",
                name = point.name,
            ),
        );
    }
}
