//! Rules of presentation: an unknown class, or a unit that does not fit it, costs the whole entity in
//! Home Assistant.

use crate::engine::device::{Platform, Unit};
use crate::engine::profile::check::Rules;
use crate::engine::units;
use crate::engine::yaml::list_of_choices;

impl Rules<'_, '_> {
    pub fn presentation(&mut self) {
        self.looks_fit_what_the_point_is();
        self.looks_fit_what_the_thing_is();
        self.icons_are_of_the_known_set();
    }

    fn looks_fit_what_the_point_is(&mut self) {
        for (path, wish) in self.profile.home_assistant.iter() {
            let Some(index) = self.points.iter().position(|point| point.path == path.value.0) else {
                continue;
            };
            let point = &self.device.points[index];
            let forms: Vec<_> = point.encoding.forms().collect();
            let Some(first) = forms.first() else { continue };
            let possible = units::platforms(point, first);
            if let Some(platform) = wish.r#as.as_ref().filter(|platform| !possible.contains(&platform.value))
            {
                let name = platform.value.name();
                let possible: Vec<&str> = possible.iter().map(|platform| platform.name()).collect();
                let message =
                    format!("`{}` cannot be a {name}; {}", path.value.0, list_of_choices("", &possible));
                self.faults.add(&platform.place, message);
                continue;
            }
            let platform = wish.r#as.as_ref().map_or(possible[0], |platform| platform.value);
            let class = wish.device_class.as_ref().map(|class| class.value.as_str());
            let state_class = wish.state_class.as_ref().map(|class| class.value.as_str());
            // Of a point with cases one is enough: in the others the wish does not count.
            let first_fault = |class: Option<&str>, state_class: Option<&str>| -> Option<String> {
                let mut faults = Vec::new();
                for form in &forms {
                    let unit = match &form.unit {
                        Unit::Fixed(unit) if matches!(platform, Platform::Sensor | Platform::Number) => {
                            Some(unit.as_str())
                        }
                        _ => None,
                    };
                    let class = class.or_else(|| units::class_of_unit(unit?, form.difference));
                    let fits = units::check(platform, class, unit, state_class);
                    let fits = fits.and_then(|()| units::check_sense(platform, form, class, state_class));
                    faults.push(fits.err()?);
                }
                faults.into_iter().next()
            };
            if let (Some(key), Some(message)) = (&wish.device_class, first_fault(class, None)) {
                self.faults.add(&key.place, message);
            } else if let (Some(key), Some(message)) = (&wish.state_class, first_fault(class, state_class)) {
                self.faults.add(&key.place, message);
            }
        }
    }

    fn looks_fit_what_the_thing_is(&mut self) {
        for (path, wish) in self.profile.home_assistant.iter() {
            let things = self.profile.things.iter();
            let Some((_, thing)) = things.into_iter().find(|(own, _)| own.value == path.value) else {
                continue;
            };
            let platform = thing.r#as.value.platform();
            if let Some(key) = &wish.r#as {
                let message = format!("`{}` says under `things` what it is; remove `as`", path.value.0);
                self.faults.add(&key.place, message);
            }
            let classes = [(&wish.device_class, true), (&wish.state_class, false)];
            for (key, is_class) in classes {
                let Some(key) = key else { continue };
                let value = Some(key.value.as_str());
                let (class, state_class) = if is_class { (value, None) } else { (None, value) };
                if let Err(message) = units::check(platform, class, None, state_class) {
                    self.faults.add(&key.place, message);
                }
            }
        }
    }

    fn icons_are_of_the_known_set(&mut self) {
        for (_, wish) in self.profile.home_assistant.iter() {
            if let Some(icon) = wish.icon.as_ref().filter(|icon| !icon.value.starts_with("mdi:")) {
                let message = format!("`{}` is no icon; expected one like `mdi:fan`", icon.value);
                self.faults.add(&icon.place, message);
            }
        }
    }
}
