//! What Home Assistant has not always known: the device classes and units that came after the oldest
//! release that can be asked for, and the letter that it once wrote otherwise.

use std::fmt;

use super::normalized;

/// A release of Home Assistant, `2025.11`: there is one a month.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Release {
    pub year: u16,
    pub month: u8,
}

impl Release {
    /// The oldest that can be asked for.
    pub const OLDEST: Release = Release { year: 2025, month: 4 };
    /// What is meant unless said: it knows all device classes of the shipped profiles.
    pub const USUAL: Release = Release { year: 2025, month: 11 };
}

impl fmt::Display for Release {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}", self.year, self.month)
    }
}

/// The release that first knew this device class, and this unit of it, at the latest.
pub fn known_since(class: &str, unit: Option<&str>) -> Release {
    let unit = unit.map(normalized);
    let came = LATER.iter().filter(|(_, of, units)| {
        *of == class
            && (units.is_empty()
                || unit.as_deref().is_some_and(|unit| units.split(", ").any(|one| one == unit)))
    });
    came.map(|(release, ..)| *release).max().unwrap_or(Release::OLDEST)
}

/// The unit as this release spells it: from 2025.10 on with the Greek letter for micro, before with the
/// sign of that name.
pub fn spelt_for(unit: &str, release: Release) -> String {
    // Microseconds had it always.
    let was_greek = normalized(unit) == "\u{3bc}s";
    if release < GREEK_MICRO && !was_greek { unit.replace('\u{3bc}', "\u{b5}") } else { normalized(unit) }
}

const fn release(year: u16, month: u8) -> Release {
    Release { year, month }
}

const GREEK_MICRO: Release = release(2025, 10);

/// A class with the units that it got, or without any where it came itself. Found by comparing what
/// 2025.4.4, 2025.7.4, 2025.10.4, 2025.11.3, 2026.2.3 and 2026.11.0 know; what came between two of
/// these counts for the later one.
const LATER: &[(Release, &str, &str)] = &[
    (release(2025, 7), "energy_distance", "Wh/km"),
    (release(2025, 7), "gas", "L"),
    (release(2025, 7), "reactive_energy", ""),
    (release(2025, 7), "reactive_power", "kvar"),
    (release(2025, 7), "volatile_organic_compounds", "mg/m³"),
    (release(2025, 7), "volume_flow_rate", "L/h, L/s, m³/s"),
    (release(2025, 10), "absolute_humidity", ""),
    (release(2025, 10), "apparent_power", "kVA, mVA"),
    (release(2025, 10), "atmospheric_pressure", "inH₂O"),
    (release(2025, 10), "gas", "MCF"),
    (release(2025, 10), "pm4", ""),
    (release(2025, 10), "pressure", "inH₂O"),
    (release(2025, 10), "reactive_power", "mvar"),
    (release(2025, 10), "speed", "m/min"),
    (release(2025, 10), "volume", "MCF"),
    (release(2025, 10), "volume_flow_rate", "m³/min"),
    (release(2025, 10), "volume_storage", "MCF"),
    (release(2025, 10), "water", "MCF"),
    (release(2025, 10), "wind_speed", "m/min"),
    (release(2025, 11), "atmospheric_pressure", "mPa"),
    (release(2025, 11), "carbon_monoxide", "mg/m³, μg/m³"),
    (release(2025, 11), "pressure", "mPa"),
    (release(2025, 11), "temperature_delta", ""),
    (release(2025, 11), "volume_flow_rate", "gal/h"),
    (release(2026, 2), "carbon_monoxide", "ppb"),
    (release(2026, 2), "nitrogen_dioxide", "ppb"),
    (release(2026, 2), "nitrogen_monoxide", "ppb"),
    (release(2026, 2), "ozone", "ppb"),
    (release(2026, 2), "sulphur_dioxide", "ppb"),
    (release(2026, 2), "volume_flow_rate", "gal/d"),
    (release(2026, 11), "atmospheric_pressure", "atm"),
    (release(2026, 11), "current", "μA"),
    (release(2026, 11), "energy", "thm"),
    (release(2026, 11), "energy_storage", "thm"),
    (release(2026, 11), "frequency", "mHz"),
    (release(2026, 11), "nitrogen_dioxide", "ppm"),
    (release(2026, 11), "ozone", "ppm"),
    (release(2026, 11), "pressure", "atm"),
    (release(2026, 11), "radon", ""),
    (release(2026, 11), "uptime", ""),
];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::device::Platform;

    #[track_caller]
    fn check(class: &str, unit: Option<&str>, expected: (u16, u8)) {
        let found = known_since(class, unit);
        assert_eq!((found.year, found.month), expected, "{class} in {unit:?}");
    }

    #[test]
    fn a_class_and_its_units_came_with_a_release() {
        check("temperature", Some("°C"), (2025, 4));
        check("temperature", None, (2025, 4));
        check("temperature_delta", Some("°C"), (2025, 11));
        check("temperature_delta", None, (2025, 11));
        check("volume_flow_rate", Some("m³/h"), (2025, 4));
        check("volume_flow_rate", Some("L/s"), (2025, 7));
        check("volume_flow_rate", Some("m³/min"), (2025, 10));
        check("current", Some("\u{b5}A"), (2026, 11));
    }

    #[test]
    fn what_is_said_to_be_new_is_there_at_all() {
        for (_, class, units) in LATER {
            let units: Vec<Option<&str>> =
                if units.is_empty() { vec![None] } else { units.split(", ").map(Some).collect() };
            for unit in units {
                assert_eq!(crate::engine::units::check(Platform::Sensor, Some(class), unit, None), Ok(()));
            }
        }
    }

    #[test]
    fn micro_is_spelt_as_the_release_does() {
        assert_eq!(spelt_for("\u{3bc}g/m³", Release { year: 2025, month: 4 }), "\u{b5}g/m³");
        assert_eq!(spelt_for("\u{b5}g/m³", Release { year: 2025, month: 10 }), "\u{3bc}g/m³");
        assert_eq!(spelt_for("\u{b5}s", Release { year: 2025, month: 4 }), "\u{3bc}s");
        assert_eq!(spelt_for("°C", Release { year: 2025, month: 4 }), "°C");
    }
}
