//! What an entity is in Home Assistant, without topics, and the words in which it is announced.

use serde_json::{Map, Number, Value, json};

use crate::engine::codec::Resolved;
use crate::engine::device::{Category, Platform};
use crate::engine::value::Decimal;

/// One entity, without topics.
#[derive(Clone, Debug, PartialEq)]
pub struct Entity {
    /// Unique in the device and the same for ever: the point's name, with the active case's unit
    /// where the point has cases (`channel_1_value_c`).
    pub key: String,
    pub platform: Platform,
    /// What people read beside the device's name, in sentence case.
    pub name: String,
    pub device_class: Option<String>,
    pub unit: Option<String>,
    pub state_class: Option<String>,
    pub category: Option<Category>,
    pub icon: Option<String>,
    pub enabled: bool,
    /// Digits behind the dot of a sensor's number.
    pub precision: Option<u8>,
    /// The names that a select or an enumeration can have.
    pub options: Vec<String>,
    /// What an event can be.
    pub event_types: Vec<String>,
    /// Of a number.
    pub min: Option<Decimal>,
    pub max: Option<Decimal>,
    pub step: Option<Decimal>,
    /// Of a number without limits of its own: how far from zero it may be.
    pub reach: f64,
    /// The most characters of a text.
    pub length: Option<u16>,
    /// The text that a button sends.
    pub press: Option<String>,
    /// Turns what is no number in the entity's sense into `None`, where that can come.
    pub value_template: Option<String>,
    /// Turns what Home Assistant calls otherwise into what the gateway calls it.
    pub command_template: Option<String>,
}

impl Entity {
    /// An entity that says nothing of itself: what others differ from.
    pub(super) fn new(key: String, platform: Platform, name: String) -> Entity {
        Entity {
            key,
            platform,
            name,
            device_class: None,
            unit: None,
            state_class: None,
            category: None,
            icon: None,
            enabled: true,
            precision: None,
            options: Vec::new(),
            event_types: Vec::new(),
            min: None,
            max: None,
            step: None,
            reach: FARTHEST_F32,
            length: None,
            press: None,
            value_template: None,
            command_template: None,
        }
    }

    /// The `entity` of `busker profiles show`.
    pub fn to_json(&self) -> Value {
        json!({
            "platform": self.platform.name(),
            "device_class": self.device_class,
            "unit": self.unit,
            "state_class": self.state_class,
            "category": self.category.map(Category::name),
            "enabled": self.enabled,
        })
    }

    /// Whether the state is a number: then Home Assistant logs an error for anything else.
    pub(super) fn is_number(&self, resolved: &Resolved) -> bool {
        matches!(self.platform, Platform::Sensor | Platform::Number) && resolved.form.is_number()
    }

    /// The parts of a discovery component that come from the entity itself.
    pub(super) fn component(&self) -> Map<String, Value> {
        let mut component = Map::new();
        let mut put = |key: &str, value: Option<Value>| {
            if let Some(value) = value {
                component.insert(key.into(), value);
            }
        };
        put("platform", Some(self.platform.name().into()));
        put("name", Some(self.name.clone().into()));
        put("device_class", self.device_class.clone().map(Value::from));
        put("unit_of_measurement", self.unit.clone().map(Value::from));
        put("state_class", self.state_class.clone().map(Value::from));
        put("suggested_display_precision", self.precision.map(Value::from));
        put("entity_category", self.category.map(|category| category.name().into()));
        put("icon", self.icon.clone().map(Value::from));
        put("enabled_by_default", (!self.enabled).then(|| false.into()));
        put("options", (!self.options.is_empty()).then(|| self.options.clone().into()));
        put("event_types", (!self.event_types.is_empty()).then(|| self.event_types.clone().into()));
        if self.platform == Platform::Number {
            // Home Assistant's own limits are 0 and 100, and its finest step is 0.001.
            put("min", Some(self.min.map_or_else(|| json!(-self.reach), number)));
            put("max", Some(self.max.map_or_else(|| json!(self.reach), number)));
            let finest = Decimal { units: 1, decimals: 3 };
            let step = self.step.filter(|step| step.compare(finest).is_gt()).unwrap_or(finest);
            put("step", Some(number(step)));
            put("mode", Some("box".into()));
        }
        put("max", self.length.map(|length| length.min(255).into()));
        put("payload_press", self.press.clone().map(Value::from));
        put("value_template", self.value_template.clone().map(Value::from));
        put("command_template", self.command_template.clone().map(Value::from));
        component
    }
}

/// Beyond the largest number of a four-byte float. The digits in which that is published round it up, and Home
/// Assistant logs an error for a number beyond its limits.
const FARTHEST_F32: f64 = 3.4028236e38;

/// A whole number without a dot, since `0.0` as a limit would look odd beside `20`.
fn number(decimal: Decimal) -> Value {
    let decimal = decimal.normalized();
    match i64::try_from(decimal.units) {
        Ok(units) if decimal.decimals == 0 => units.into(),
        _ => Number::from_f64(decimal.to_f64()).map_or(Value::Null, Value::Number),
    }
}
