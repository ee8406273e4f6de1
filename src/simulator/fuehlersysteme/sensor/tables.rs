//! The sensor's two tables: which quantities and settings there are, and between which values.

use crate::simulator::fuehlersysteme::board::AUTOMATIC;

/// As many measurements as RWreg_27 may ask for.
pub const DAMPING_MAX: u16 = 50;

/// A quantity's number, which is that of its Rreg and of the RWreg that overrides it, and its range.
pub struct Measured {
    pub register: u16,
    pub low: i16,
    pub high: i16,
}

const fn measured(register: u16, low: i16, high: i16) -> Measured {
    Measured { register, low, high }
}

/// Pages 5 and 6: the registers of measured values ("Rreg_mw"), whose numbers other registers may name.
/// The manual marks them by a grey background; here they are those that are not about the device.
pub const MEASURED: [Measured; 30] = [
    measured(1, 0, 999),
    measured(2, -999, 2999),
    measured(3, 0, 999),
    measured(4, 0, 999),
    measured(5, -999, 999),
    measured(6, -999, 999),
    measured(10, 0, 9999),
    measured(11, 0, 999),
    measured(12, 0, 9999),
    // "0 ... 9999" beside "0 ... 99.9 V (mit Kommastelle)", and likewise of mA: tenths to 999.9 are taken.
    measured(13, 0, 9999),
    measured(14, 0, 9999),
    measured(15, 0, 999),
    measured(20, 750, 1150),
    measured(21, 750, 1500),
    measured(22, -9999, 9999),
    measured(23, -9999, 9999),
    measured(30, 0, 999),
    measured(31, 0, 999),
    measured(35, 0, 1),
    measured(36, 0, 1),
    measured(37, 0, 1),
    measured(38, 0, 1),
    measured(40, 0, 9999),
    measured(41, 0, 9999),
    measured(42, 0, 9999),
    measured(43, 0, 9999),
    measured(44, 0, 9999),
    measured(45, 0, 9999),
    measured(47, 0, 200),
    measured(50, 0, 1),
];

/// A setting's RWreg, its range, what it leaves the factory with, and whether it is kept in the EEPROM.
pub struct Setting {
    pub register: u16,
    pub low: i16,
    pub high: i16,
    pub factory: i16,
    pub stored: bool,
}

const fn stored(register: u16, low: i16, high: i16, factory: i16) -> Setting {
    Setting { register, low, high, factory, stored: true }
}

const fn unstored(register: u16, low: i16, high: i16, factory: i16) -> Setting {
    Setting { stored: false, ..stored(register, low, high, factory) }
}

/// Pages 6 to 8. Where the factory's setting is "[v]", depending on the type, one that makes sense.
pub const SETTINGS: [Setting; 37] = [
    stored(8, -100, 100, 0),
    stored(9, -100, 100, 0),
    stored(18, 0, 2, 1),
    stored(24, 0, 1999, 75),
    // Without a star in the table, unlike its neighbours.
    unstored(25, 800, 1200, 1000),
    stored(27, 1, DAMPING_MAX as i16, 10),
    stored(28, -50, 50, 0),
    stored(29, 0, 3000, 0),
    stored(32, 0, 1500, 60),
    // 11111 beside the range: not active.
    stored(33, 0, 999, AUTOMATIC as i16),
    stored(34, 30, 31, 30),
    stored(48, 0, 9999, 0),
    stored(51, 0, 255, 0),
    stored(52, -9999, 9999, 0),
    stored(53, -9999, 9999, 1),
    stored(54, 0, 1800, 0),
    stored(55, 0, 1800, 0),
    stored(57, 0, 255, 0),
    stored(58, 0, 255, 0),
    stored(59, 1, 24, 6),
    stored(60, 0, 3, 2),
    stored(61, 0, 63, 24),
    stored(62, 0, 1, 1),
    unstored(63, 0, 1, 0),
    stored(64, 1, 3, 3),
    // "1.. 60 [0]": the factory's 0 is outside the range and cannot be written again.
    stored(65, 1, 60, 0),
    // Its star is missing, but 67 to 75 refer to it and have theirs.
    stored(66, 0, 255, 2),
    stored(67, 0, 255, 1),
    stored(68, 0, 255, 10),
    stored(69, 0, 255, 0),
    stored(70, 0, 255, 0),
    stored(71, 0, 255, 0),
    stored(72, 0, 255, 0),
    stored(73, 0, 255, 0),
    stored(74, 0, 255, 0),
    stored(75, 0, 255, 0),
    stored(80, 0, 9999, 911),
];

impl Measured {
    pub fn limit(&self, value: f64) -> i16 {
        value.round().clamp(self.low.into(), self.high.into()) as i16
    }

    /// The word used in place of one that is written to override the quantity.
    pub fn limit_word(&self, word: u16) -> u16 {
        if word == AUTOMATIC { word } else { (word as i16).clamp(self.low, self.high) as u16 }
    }
}

impl Setting {
    pub fn limit(&self, word: u16) -> i16 {
        match word as i16 {
            off if off as u16 == AUTOMATIC && self.factory == off => off,
            value => value.clamp(self.low, self.high),
        }
    }
}

/// The place of a quantity in [`MEASURED`].
pub fn measured_at(register: u16) -> Option<usize> {
    MEASURED.iter().position(|measured| measured.register == register)
}

/// The place of a setting in [`SETTINGS`].
pub fn setting_at(register: u16) -> Option<usize> {
    SETTINGS.iter().position(|setting| setting.register == register)
}
