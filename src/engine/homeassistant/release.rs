//! What an older Home Assistant must be told otherwise: a device class that it does not know costs it
//! the whole entity.

use serde_json::{Map, Value};

use crate::engine::units::{self, Release};

/// Since then `default_entity_id` is understood. Until 2026.3 both names were; what is not is no fault.
const DEFAULT_ENTITY_ID: Release = Release { year: 2025, month: 10 };

/// Makes a component one that this release understands, and all later ones.
pub(super) fn fit(component: &mut Map<String, Value>, release: Release) {
    let text = |component: &Map<String, Value>, key: &str| {
        component.get(key).and_then(Value::as_str).map(str::to_string)
    };
    let unit = text(component, "unit_of_measurement");
    if let Some(class) = text(component, "device_class") {
        if units::known_since(&class, unit.as_deref()) > release {
            component.remove("device_class");
        }
    }
    if let Some(unit) = unit {
        component.insert("unit_of_measurement".into(), units::spelt_for(&unit, release).into());
    }
    if release < DEFAULT_ENTITY_ID {
        if let Some((_, id)) =
            text(component, "default_entity_id").as_deref().and_then(|id| id.split_once('.'))
        {
            component.insert("object_id".into(), id.into());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[track_caller]
    fn check(release: (u16, u8), mut component: Value, expected: Value) {
        let map = component.as_object_mut().expect("a component is a map");
        fit(map, Release { year: release.0, month: release.1 });
        assert_eq!(component, expected);
    }

    #[test]
    fn an_older_home_assistant_is_told_what_it_understands() {
        let offset = json!({
            "device_class": "temperature_delta", "unit_of_measurement": "°C", "default_entity_id": "number.offset",
        });
        check((2025, 11), offset.clone(), offset.clone());
        check(
            (2025, 10),
            offset.clone(),
            json!({"unit_of_measurement": "°C", "default_entity_id": "number.offset"}),
        );
        check(
            (2025, 4),
            offset,
            json!({"unit_of_measurement": "°C", "default_entity_id": "number.offset", "object_id": "offset"}),
        );
        let dust = json!({"device_class": "pm25", "unit_of_measurement": "\u{3bc}g/m³"});
        check((2025, 10), dust.clone(), dust.clone());
        check((2025, 4), dust, json!({"device_class": "pm25", "unit_of_measurement": "\u{b5}g/m³"}));
    }
}
