//! How points and things should look in Home Assistant.

/// What the facts of a point cannot tell about how a point should look. All of it is optional.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Presentation {
    pub platform: Option<Platform>,
    pub name: Option<String>,
    pub device_class: Option<String>,
    pub state_class: Option<String>,
    pub category: Option<Category>,
    pub icon: Option<String>,
    pub enabled: Option<bool>,
}

impl Presentation {
    /// What people call a point or a thing of this name.
    pub fn title(&self, name: &str) -> String {
        self.name.clone().unwrap_or_else(|| sentence(name))
    }
}

/// Home Assistant's platforms: those that a single point can be, and those of things.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Platform {
    Sensor,
    BinarySensor,
    Switch,
    Number,
    Select,
    Button,
    Text,
    Event,
    Cover,
    Valve,
    Climate,
}

impl Platform {
    pub const ALL: [Platform; 11] = [
        Platform::Sensor,
        Platform::BinarySensor,
        Platform::Switch,
        Platform::Number,
        Platform::Select,
        Platform::Button,
        Platform::Text,
        Platform::Event,
        Platform::Cover,
        Platform::Valve,
        Platform::Climate,
    ];

    pub const fn name(self) -> &'static str {
        match self {
            Platform::Sensor => "sensor",
            Platform::BinarySensor => "binary_sensor",
            Platform::Switch => "switch",
            Platform::Number => "number",
            Platform::Select => "select",
            Platform::Button => "button",
            Platform::Text => "text",
            Platform::Event => "event",
            Platform::Cover => "cover",
            Platform::Valve => "valve",
            Platform::Climate => "climate",
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Category {
    Config,
    Diagnostic,
}

impl Category {
    pub const fn name(self) -> &'static str {
        match self {
            Category::Config => "config",
            Category::Diagnostic => "diagnostic",
        }
    }
}

/// `channel_3_value` as people write it: `Channel 3 value`.
pub fn sentence(name: &str) -> String {
    let words = name.replace('_', " ");
    let mut letters = words.chars();
    letters.next().map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect())
}
