//! How a device is told its bit rate, parity and unit.

use std::fmt;

use crate::engine::address::Span;

/// By what the settings of a device on its line are changed. They are no points: written as one, they would cut
/// the device off.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LineControl {
    pub settings: SettingsBy,
    /// The switches, in words, that set its unit.
    pub unit_by: String,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SettingsBy {
    Register(SettingsRegister),
    /// Switches at the device, in words.
    Hand(String),
}

impl fmt::Display for SettingsBy {
    /// By what, and which settings there are, for people.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            SettingsBy::Register(register) => write!(f, "`busker line`: {}", register.choices()),
            SettingsBy::Hand(switches) => f.write_str(switches),
        }
    }
}

/// A register that takes bit rate and parity in one write, and with them from its answer on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SettingsRegister {
    pub at: Span,
    /// Bits without which the device takes no word.
    pub add: u16,
    pub baud: Vec<(u32, u16)>,
    pub even: Option<u16>,
    pub odd: Option<u16>,
    pub none: Option<u16>,
}

impl SettingsRegister {
    /// What can be set, for people: `1200, 2400 baud; parity even, odd`.
    fn choices(&self) -> String {
        let baud: Vec<String> = self.baud.iter().map(|(baud, _)| baud.to_string()).collect();
        let parities = [("even", self.even), ("odd", self.odd), ("none", self.none)];
        let parities: Vec<&str> =
            parities.into_iter().filter(|(_, code)| code.is_some()).map(|(name, _)| name).collect();
        format!("{} baud; parity {}", baud.join(", "), parities.join(", "))
    }
}
