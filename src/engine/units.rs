//! Home Assistant's device classes: which units and state classes go with each. An unknown class or
//! a unit that does not fit costs the whole entity there, so it is refused here.
//!
//! The tables are those of Home Assistant 2026.11 (`components/sensor/const.py`,
//! `components/number/const.py`, `components/binary_sensor/__init__.py`).

mod releases;

pub use releases::{Release, known_since, spelt_for};

use crate::engine::device::{Form, Kind, Names, Platform, Point, WriteRule};
use crate::engine::yaml::nearest;

/// What a point can be in Home Assistant, read in this form; the first is what it is unless the
/// profile says `as`. Never empty.
pub fn platforms(point: &Point, form: &Form) -> &'static [Platform] {
    let rule = point.write.as_ref().map(|write| &write.rule);
    let enumeration = matches!(form.names, Names::All(_));
    match rule {
        _ if point.event.is_some() => &[Platform::Event],
        Some(WriteRule::Press { .. }) => &[Platform::Button],
        None if form.kind == Kind::Bool => &[Platform::BinarySensor],
        None => &[Platform::Sensor],
        // Where a single name can be written, a button beside the reading writes it.
        Some(WriteRule::Names(names)) if names.len() == 1 || !enumeration => match form.kind {
            Kind::Bool => &[Platform::BinarySensor],
            _ => &[Platform::Sensor],
        },
        Some(_) if form.kind == Kind::Bool => &[Platform::Switch, Platform::BinarySensor],
        Some(_) if enumeration => &[Platform::Select, Platform::Sensor],
        Some(_) if form.kind.is_text() => &[Platform::Text, Platform::Sensor],
        Some(_) => &[Platform::Number, Platform::Sensor],
    }
}

/// Checks what a profile or a configuration wishes for an entity of `platform`. `unit` is `None`
/// where there is none, or where it is not known yet.
///
/// The error says what is wrong and what would be right, without a place.
pub fn check(
    platform: Platform,
    class: Option<&str>,
    unit: Option<&str>,
    state_class: Option<&str>,
) -> Result<(), String> {
    check_state_class(platform, class, unit, state_class)?;
    let Some(class) = class else { return Ok(()) };
    match classes(platform) {
        Classes::Numeric(known) => {
            let found = known.iter().find(|candidate| candidate.name == class && fits(platform, candidate));
            let Some(found) = found else {
                let names = known.iter().filter(|candidate| fits(platform, candidate));
                return Err(unknown_class(platform, class, names.map(|candidate| candidate.name)));
            };
            unit.map_or(Ok(()), |unit| check_unit(found, unit))
        }
        Classes::Plain(known) if known.contains(&class) => Ok(()),
        Classes::Plain(known) => Err(unknown_class(platform, class, known.iter().copied())),
    }
}

/// Whether a sensor's device class and state class go with what its values are: a number, a moment, a name or a
/// text. Home Assistant would log an error for each value.
pub fn check_sense(
    platform: Platform,
    form: &Form,
    class: Option<&str>,
    state_class: Option<&str>,
) -> Result<(), String> {
    if platform != Platform::Sensor {
        return Ok(());
    }
    let is_enumeration = matches!(form.names, Names::All(_));
    let what = match form {
        _ if form.is_number() => "a number",
        _ if form.since.is_some() => "a moment",
        _ if is_enumeration => "one of several names",
        _ => "a text",
    };
    if let Some(state_class) = state_class.filter(|_| !form.is_number()) {
        return Err(format!("state class `{state_class}` is for numbers, but this is {what}; leave it out"));
    }
    let Some(class) = class else { return Ok(()) };
    let remedy = match class {
        "timestamp" | "uptime" if form.since.is_some() => return Ok(()),
        "timestamp" | "uptime" => {
            "expected `since: 1970-01-01` at the point, if its register counts seconds from there"
        }
        "enum" if is_enumeration => return Ok(()),
        "enum" => "expected `values` at the point, or no `device_class`",
        class if form.is_number() && class != "date" => return Ok(()),
        _ => "leave `device_class` out",
    };
    Err(format!("device class `{class}` does not go with {what}; {remedy}"))
}

/// The device class of what is no number: a moment is a `timestamp`.
pub fn class_of_sense(form: &Form) -> Option<&'static str> {
    form.since.map(|_| "timestamp")
}

/// The device class that a unit leaves no doubt about: `°C` is a temperature, but `%` may be a
/// humidity, a battery or a valve. `difference` as in [`crate::engine::device::Form::difference`].
pub fn class_of_unit(unit: &str, difference: bool) -> Option<&'static str> {
    let unit = normalized(unit);
    if matches!(unit.as_str(), "°C" | "°F" | "K") {
        return Some(if difference { "temperature_delta" } else { "temperature" });
    }
    UNAMBIGUOUS.iter().copied().find(|name| {
        CLASSES.iter().any(|class| class.name == *name && class.units.list().any(|listed| listed == unit))
    })
}

/// The state class of a number that is not said otherwise: the only one its device class knows, or
/// `measurement` for a unit without a class. A quantity that is counted is `total_increasing` if it
/// cannot go below zero.
pub fn state_class(class: Option<&str>, unit: Option<&str>, signed: bool) -> Option<&'static str> {
    let Some(class) = class else { return unit.map(|_| "measurement") };
    let states = CLASSES.iter().find(|candidate| candidate.name == class)?.states;
    match states.first() {
        Some(&"total") if states.len() > 1 && !signed => Some("total_increasing"),
        first => first.copied(),
    }
}

/// How many digits behind the dot people want to see of a float, which does not say how exact it is. Left
/// to itself Home Assistant goes by the device class, and makes 3 V of 2.5.
pub fn digits_of_a_float(unit: Option<&str>) -> u8 {
    match unit {
        Some("°C" | "°F" | "K" | "%" | "Ω" | "W" | "VA" | "var") => 1,
        _ => 2,
    }
}

/// The units that Home Assistant knows and `unit` may stand for: it takes any text for one, but `kwh` and `degC`
/// are no energy and no temperature to it. Empty for what it knows, and for what is like nothing it knows.
pub fn meant_by(unit: &str) -> Vec<&'static str> {
    let all = || CLASSES.iter().flat_map(|class| class.units.list());
    if all().any(|known| known == normalized(unit)) {
        return Vec::new();
    }
    let mut meant: Vec<&str> = all().filter(|known| loosely(known) == loosely(unit)).collect();
    meant.sort_unstable();
    meant.dedup();
    meant
}

/// A unit as it is typed by who does not find the keys for it.
fn loosely(unit: &str) -> String {
    let letters = unit.trim().to_lowercase();
    let letters = letters.strip_prefix("deg").unwrap_or(&letters);
    let plain = letters.chars().filter(|c| !matches!(c, '°' | '^' | ' ' | '.'));
    plain
        .map(|c| match c {
            '²' => '2',
            '³' => '3',
            '₂' => '2',
            '\u{b5}' | '\u{3bc}' => 'u',
            '⋅' => '*',
            c => c,
        })
        .collect()
}

/// The units of which a number of this device class needs one for Home Assistant to make anything of it; `None`
/// if it needs none.
pub fn needed_by(class: &str) -> Option<String> {
    let found = CLASSES.iter().find(|candidate| candidate.name == class)?;
    matches!(found.units, Units::OneOf(_)).then(|| quoted(found.units.list()))
}

/// The unit as Home Assistant spells it: its micro is the Greek letter.
pub fn normalized(unit: &str) -> String {
    unit.replace('\u{b5}', "\u{3bc}")
}

const STATE_CLASSES: &[&str] = &["measurement", "measurement_angle", "total", "total_increasing"];

fn check_state_class(
    platform: Platform,
    class: Option<&str>,
    unit: Option<&str>,
    state_class: Option<&str>,
) -> Result<(), String> {
    let Some(state_class) = state_class else { return Ok(()) };
    if platform != Platform::Sensor {
        return Err(format!(
            "`state_class` says how a sensor's history is kept; a {} has none",
            platform.name()
        ));
    }
    if !STATE_CLASSES.contains(&state_class) {
        let expected = quoted(STATE_CLASSES.iter().copied());
        return Err(format!("`{state_class}` is no state class; expected one of {expected}"));
    }
    if state_class == "measurement_angle" && unit.is_some_and(|unit| unit != "°") {
        return Err("state class `measurement_angle` needs the unit `°`".into());
    }
    let known = class.and_then(|class| CLASSES.iter().find(|candidate| candidate.name == class));
    match known {
        Some(class) if class.states.is_empty() => {
            Err(format!("device class `{}` has no state class; leave `state_class` out", class.name))
        }
        Some(class) if !class.states.contains(&state_class) => Err(format!(
            "device class `{}` does not go with state class `{state_class}`; expected {}",
            class.name,
            quoted(class.states.iter().copied())
        )),
        _ => Ok(()),
    }
}

fn check_unit(class: &Class, unit: &str) -> Result<(), String> {
    let unit = normalized(unit);
    let name = class.name;
    match class.units {
        Units::Any => Ok(()),
        Units::NoUnit | Units::NotANumber => {
            Err(format!("device class `{name}` has no unit, but the point is in `{unit}`"))
        }
        Units::OneOf(_) | Units::NoneOr(_) if class.units.list().any(|listed| listed == unit) => Ok(()),
        Units::OneOf(_) | Units::NoneOr(_) => Err(format!(
            "device class `{name}` does not go with the unit `{unit}`; expected {}",
            quoted(class.units.list())
        )),
    }
}

/// Names all there is.
fn unknown_class<'a>(platform: Platform, class: &str, known: impl Iterator<Item = &'a str>) -> String {
    let platform = platform.name();
    let known: Vec<&str> = known.collect();
    if known.is_empty() {
        return format!("a {platform} has no device class; leave `device_class` out");
    }
    if let Some(meant) = nearest(class, &known) {
        return format!("`{class}` is no device class of a {platform}; did you mean `{meant}`?");
    }
    let expected = quoted(known.into_iter());
    format!("`{class}` is no device class of a {platform}; expected one of {expected}")
}

fn quoted<'a>(names: impl Iterator<Item = &'a str>) -> String {
    names.map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ")
}

enum Classes {
    Numeric(&'static [Class]),
    Plain(&'static [&'static str]),
}

fn classes(platform: Platform) -> Classes {
    match platform {
        Platform::Sensor | Platform::Number => Classes::Numeric(CLASSES),
        Platform::BinarySensor => Classes::Plain(BINARY_SENSOR_CLASSES),
        Platform::Switch => Classes::Plain(&["outlet", "switch"]),
        Platform::Button => Classes::Plain(&["identify", "restart", "update"]),
        Platform::Event => Classes::Plain(&["button", "doorbell", "motion"]),
        Platform::Cover => Classes::Plain(COVER_CLASSES),
        Platform::Valve => Classes::Plain(&["gas", "water"]),
        Platform::Select | Platform::Text | Platform::Climate => Classes::Plain(&[]),
    }
}

fn fits(platform: Platform, class: &Class) -> bool {
    platform == Platform::Sensor || !matches!(class.units, Units::NotANumber)
}

/// A device class of sensors, and of numbers unless it is no number.
struct Class {
    name: &'static str,
    units: Units,
    /// The state classes that go with it; the first is the usual one.
    states: &'static [&'static str],
}

#[derive(Clone, Copy)]
enum Units {
    Any,
    NoUnit,
    NotANumber,
    /// Separated by a comma and a space, since one of them holds a space.
    OneOf(&'static str),
    /// One of these, or none.
    NoneOr(&'static str),
}

impl Units {
    fn list(self) -> impl Iterator<Item = &'static str> {
        let text = match self {
            Units::OneOf(text) | Units::NoneOr(text) => text,
            Units::Any | Units::NoUnit | Units::NotANumber => "",
        };
        text.split(", ").filter(|unit| !unit.is_empty())
    }
}

const MEASUREMENT: &[&str] = &["measurement"];
const TOTALS: &[&str] = &["total", "total_increasing"];
const MEASUREMENT_AND_TOTALS: &[&str] = &["measurement", "total", "total_increasing"];
const EVERY: &[&str] = STATE_CLASSES;

/// Classes of which at least one unit belongs to nobody else, or to nobody as likely. The first that
/// has the unit wins: what measures speed or pressure in general stands for wind and weather too.
const UNAMBIGUOUS: &[&str] = &[
    "apparent_power",
    "area",
    "conductivity",
    "current",
    "data_rate",
    "duration",
    "energy",
    "frequency",
    "illuminance",
    "irradiance",
    "power",
    "pressure",
    "reactive_energy",
    "reactive_power",
    "voltage",
    "volume_flow_rate",
    "weight",
];

const COVER_CLASSES: &[&str] =
    &["awning", "blind", "curtain", "damper", "door", "garage", "gate", "shade", "shutter", "window"];

const BINARY_SENSOR_CLASSES: &[&str] = &[
    "battery",
    "battery_charging",
    "carbon_monoxide",
    "cold",
    "connectivity",
    "door",
    "garage_door",
    "gas",
    "glass_break",
    "heat",
    "light",
    "lock",
    "moisture",
    "motion",
    "moving",
    "occupancy",
    "opening",
    "plug",
    "power",
    "presence",
    "problem",
    "running",
    "safety",
    "smoke",
    "sound",
    "tamper",
    "update",
    "vibration",
    "window",
];

#[rustfmt::skip]
const CLASSES: &[Class] = &[
    Class { name: "absolute_humidity", units: Units::OneOf("g/m³, mg/m³"), states: MEASUREMENT },
    Class { name: "apparent_power", units: Units::OneOf("VA, kVA, mVA"), states: MEASUREMENT },
    Class { name: "aqi", units: Units::NoUnit, states: MEASUREMENT },
    Class { name: "area", units: Units::OneOf("ac, cm², ft², ha, in², km², mi², mm², m², yd²"), states: EVERY },
    Class { name: "atmospheric_pressure", units: Units::OneOf("Pa, atm, bar, cbar, hPa, inHg, inH₂O, kPa, mPa, mbar, mmHg, psi"), states: MEASUREMENT },
    Class { name: "battery", units: Units::OneOf("%"), states: MEASUREMENT },
    Class { name: "blood_glucose_concentration", units: Units::OneOf("mg/dL, mmol/L"), states: MEASUREMENT },
    Class { name: "carbon_dioxide", units: Units::OneOf("ppm"), states: MEASUREMENT },
    Class { name: "carbon_monoxide", units: Units::OneOf("mg/m³, ppb, ppm, μg/m³"), states: MEASUREMENT },
    Class { name: "conductivity", units: Units::OneOf("S/cm, mS/cm, μS/cm"), states: MEASUREMENT },
    Class { name: "current", units: Units::OneOf("A, mA, μA"), states: MEASUREMENT },
    Class { name: "data_rate", units: Units::OneOf("B/s, GB/s, Gbit/s, GiB/s, KiB/s, MB/s, Mbit/s, MiB/s, bit/s, kB/s, kbit/s"), states: MEASUREMENT },
    Class { name: "data_size", units: Units::OneOf("B, EB, EiB, GB, Gbit, GiB, KiB, MB, Mbit, MiB, PB, PiB, TB, TiB, YB, YiB, ZB, ZiB, bit, kB, kbit"), states: EVERY },
    Class { name: "date", units: Units::NotANumber, states: &[] },
    Class { name: "distance", units: Units::OneOf("cm, ft, in, km, m, mi, mm, nmi, yd"), states: EVERY },
    Class { name: "duration", units: Units::OneOf("d, h, min, ms, s, μs"), states: EVERY },
    Class { name: "energy", units: Units::OneOf("GJ, GWh, Gcal, J, MJ, MWh, Mcal, TWh, Wh, cal, kJ, kWh, kcal, mWh, thm"), states: TOTALS },
    Class { name: "energy_distance", units: Units::OneOf("Wh/km, kWh/100km, km/kWh, mi/kWh"), states: MEASUREMENT },
    Class { name: "energy_storage", units: Units::OneOf("GJ, GWh, Gcal, J, MJ, MWh, Mcal, TWh, Wh, cal, kJ, kWh, kcal, mWh, thm"), states: MEASUREMENT },
    Class { name: "enum", units: Units::NotANumber, states: &[] },
    Class { name: "frequency", units: Units::OneOf("GHz, Hz, MHz, kHz, mHz"), states: MEASUREMENT },
    Class { name: "gas", units: Units::OneOf("CCF, L, MCF, ft³, m³"), states: TOTALS },
    Class { name: "humidity", units: Units::OneOf("%"), states: MEASUREMENT },
    Class { name: "illuminance", units: Units::OneOf("lx"), states: MEASUREMENT },
    Class { name: "irradiance", units: Units::OneOf("BTU/(h⋅ft²), W/m²"), states: MEASUREMENT },
    Class { name: "moisture", units: Units::OneOf("%"), states: MEASUREMENT },
    Class { name: "monetary", units: Units::Any, states: &["total"] },
    Class { name: "nitrogen_dioxide", units: Units::OneOf("ppb, ppm, μg/m³"), states: MEASUREMENT },
    Class { name: "nitrogen_monoxide", units: Units::OneOf("ppb, μg/m³"), states: MEASUREMENT },
    Class { name: "nitrous_oxide", units: Units::OneOf("μg/m³"), states: MEASUREMENT },
    Class { name: "ozone", units: Units::OneOf("ppb, ppm, μg/m³"), states: MEASUREMENT },
    Class { name: "ph", units: Units::NoUnit, states: MEASUREMENT },
    Class { name: "pm1", units: Units::OneOf("μg/m³"), states: MEASUREMENT },
    Class { name: "pm10", units: Units::OneOf("μg/m³"), states: MEASUREMENT },
    Class { name: "pm25", units: Units::OneOf("μg/m³"), states: MEASUREMENT },
    Class { name: "pm4", units: Units::OneOf("μg/m³"), states: MEASUREMENT },
    Class { name: "power", units: Units::OneOf("GW, MW, TW, W, kW, mW"), states: MEASUREMENT },
    Class { name: "power_factor", units: Units::NoneOr("%"), states: MEASUREMENT },
    Class { name: "precipitation", units: Units::OneOf("cm, in, mm"), states: EVERY },
    Class { name: "precipitation_intensity", units: Units::OneOf("in/d, in/h, mm/d, mm/h"), states: MEASUREMENT },
    Class { name: "pressure", units: Units::OneOf("Pa, atm, bar, cbar, hPa, inHg, inH₂O, kPa, mPa, mbar, mmHg, psi"), states: MEASUREMENT },
    Class { name: "radon", units: Units::OneOf("Bq/m³, pCi/L"), states: MEASUREMENT },
    Class { name: "reactive_energy", units: Units::OneOf("kvarh, varh"), states: TOTALS },
    Class { name: "reactive_power", units: Units::OneOf("kvar, mvar, var"), states: MEASUREMENT },
    Class { name: "signal_strength", units: Units::OneOf("dB, dBm"), states: MEASUREMENT },
    Class { name: "sound_pressure", units: Units::OneOf("dBA, dB"), states: MEASUREMENT },
    Class { name: "speed", units: Units::OneOf("Beaufort, ft/s, in/d, in/h, in/s, km/h, kn, m/min, m/s, mm/d, mm/h, mm/s, mph"), states: MEASUREMENT },
    Class { name: "sulphur_dioxide", units: Units::OneOf("ppb, μg/m³"), states: MEASUREMENT },
    Class { name: "temperature", units: Units::OneOf("K, °C, °F"), states: MEASUREMENT },
    Class { name: "temperature_delta", units: Units::OneOf("K, °C, °F"), states: MEASUREMENT },
    Class { name: "timestamp", units: Units::NotANumber, states: &[] },
    Class { name: "uptime", units: Units::NotANumber, states: &[] },
    Class { name: "volatile_organic_compounds", units: Units::OneOf("mg/m³, μg/m³"), states: MEASUREMENT },
    Class { name: "volatile_organic_compounds_parts", units: Units::OneOf("ppb, ppm"), states: MEASUREMENT },
    Class { name: "voltage", units: Units::OneOf("MV, V, kV, mV, μV"), states: MEASUREMENT },
    Class { name: "volume", units: Units::OneOf("CCF, L, MCF, fl. oz., ft³, gal, mL, m³"), states: TOTALS },
    Class { name: "volume_flow_rate", units: Units::OneOf("L/h, L/min, L/s, ft³/min, gal/d, gal/h, gal/min, mL/s, m³/h, m³/min, m³/s"), states: MEASUREMENT },
    Class { name: "volume_storage", units: Units::OneOf("CCF, L, MCF, fl. oz., ft³, gal, mL, m³"), states: MEASUREMENT },
    Class { name: "water", units: Units::OneOf("CCF, L, MCF, ft³, gal, m³"), states: TOTALS },
    Class { name: "weight", units: Units::OneOf("g, kg, lb, mg, oz, st, μg"), states: MEASUREMENT_AND_TOTALS },
    Class { name: "wind_direction", units: Units::OneOf("°"), states: &["measurement_angle"] },
    Class { name: "wind_speed", units: Units::OneOf("Beaufort, ft/s, in/s, km/h, kn, m/min, m/s, mm/s, mph"), states: MEASUREMENT },
];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::time::Date;

    #[track_caller]
    fn check_wish(
        platform: Platform,
        wish: (Option<&str>, Option<&str>, Option<&str>),
        expected: Result<(), &str>,
    ) {
        let (class, unit, state_class) = wish;
        match (check(platform, class, unit, state_class), expected) {
            (Ok(()), Ok(())) => {}
            (Err(found), Err(expected)) if found.contains(expected) => {}
            (found, expected) => panic!("{platform:?} {wish:?}: found {found:?}, expected {expected:?}"),
        }
    }

    #[test]
    fn what_home_assistant_would_refuse_is_refused() {
        use Platform::*;
        let good = [
            (Sensor, (Some("temperature"), Some("°C"), Some("measurement"))),
            (Sensor, (Some("energy"), Some("kWh"), Some("total_increasing"))),
            (Sensor, (None, Some("Ω"), Some("measurement"))),
            (Sensor, (None, None, None)),
            (Sensor, (Some("power_factor"), None, None)),
            (Sensor, (Some("current"), Some("\u{b5}A"), None)),
            (Sensor, (Some("volume"), Some("fl. oz."), None)),
            (Number, (Some("temperature_delta"), Some("K"), None)),
            (BinarySensor, (Some("problem"), None, None)),
            (Switch, (Some("outlet"), None, None)),
            (Button, (Some("restart"), None, None)),
        ];
        for (platform, wish) in good {
            check_wish(platform, wish, Ok(()));
        }
        let bad = [
            (Sensor, (Some("energy"), Some("kwh"), None), "does not go with the unit `kwh`; expected `GJ`"),
            (
                Sensor,
                (Some("energy"), Some("kWh"), Some("measurement")),
                "expected `total`, `total_increasing`",
            ),
            (Sensor, (Some("heat"), None, None), "`heat` is no device class of a sensor"),
            (Sensor, (Some("aqi"), Some("ppm"), None), "`aqi` has no unit"),
            (Sensor, (Some("enum"), None, Some("total")), "leave `state_class` out"),
            (Sensor, (None, None, Some("mean")), "`mean` is no state class"),
            (Number, (Some("enum"), None, None), "`enum` is no device class of a number"),
            (Number, (None, Some("V"), Some("measurement")), "a number has none"),
            (BinarySensor, (Some("temperature"), None, None), "no device class of a binary_sensor"),
            (Select, (Some("enum"), None, None), "a select has no device class"),
        ];
        for (platform, wish, expected) in bad {
            check_wish(platform, wish, Err(expected));
        }
    }

    #[test]
    fn a_class_goes_with_what_the_values_are() {
        let number = Form::new(Kind::U32);
        let moment = Form { since: Some(Date(0)), ..number.clone() };
        let names = Form { names: Names::All(vec![(0, "off".into())]), ..number.clone() };
        let text = Form::new(Kind::Text { registers: 4 });
        let date = Form::new(Kind::DayMonthYear);
        for (form, class, state_class, expected) in [
            (&number, Some("energy"), Some("total"), ""),
            (&number, Some("timestamp"), None, "expected `since: 1970-01-01` at the point"),
            (&number, Some("enum"), None, "does not go with a number; expected `values`"),
            (&number, Some("date"), None, "does not go with a number; leave `device_class` out"),
            (&moment, Some("timestamp"), None, ""),
            (&moment, Some("uptime"), None, ""),
            (&moment, Some("duration"), None, "does not go with a moment; leave `device_class` out"),
            (&moment, None, Some("measurement"), "is for numbers, but this is a moment"),
            (&names, Some("enum"), None, ""),
            (&names, Some("power"), None, "does not go with one of several names"),
            (&text, Some("timestamp"), None, "expected `since: 1970-01-01`"),
            (&text, Some("temperature"), None, "does not go with a text"),
            // The year is one digit: which decade it is of, the register does not say.
            (&date, Some("date"), None, "does not go with a text"),
        ] {
            let found = check_sense(Platform::Sensor, form, class, state_class);
            let is_expected = match &found {
                Ok(()) => expected.is_empty(),
                Err(message) => !expected.is_empty() && message.contains(expected),
            };
            assert!(is_expected, "{class:?} {state_class:?}: {found:?} instead of {expected:?}");
        }
        assert_eq!(check_sense(Platform::Number, &number, Some("power"), None), Ok(()));
    }

    #[test]
    fn a_class_follows_from_the_unit_only_where_there_is_no_doubt() {
        for (unit, difference, expected) in [
            ("°C", false, Some("temperature")),
            ("°F", true, Some("temperature_delta")),
            ("mA", false, Some("current")),
            ("V", false, Some("voltage")),
            ("kWh", false, Some("energy")),
            ("bar", false, Some("pressure")),
            ("h", false, Some("duration")),
            ("%", false, None),
            ("m³", false, None),
            ("ppm", false, None),
            ("Ω", false, None),
        ] {
            assert_eq!(class_of_unit(unit, difference), expected, "{unit}");
        }
    }

    #[test]
    fn a_unit_that_is_spelt_otherwise_is_understood() {
        for (unit, meant) in [
            ("kwh", &["kWh"][..]),
            ("KWH", &["kWh"]),
            ("C", &["°C"]),
            ("degC", &["°C"]),
            ("deg F", &["°F"]),
            ("m3", &["m³"]),
            ("m^3/h", &["m³/h"]),
            ("l/min", &["L/min"]),
            ("VAr", &["var"]),
            ("ug/m3", &["μg/m³"]),
            ("mw", &["MW", "mW"]),
            ("kWh", &[]),
            ("mW", &[]),
            ("\u{b5}V", &[]),
            ("imp", &[]),
            ("Ω", &[]),
        ] {
            assert_eq!(meant_by(unit), meant, "{unit}");
        }
    }

    #[test]
    fn what_is_derived_from_a_unit_is_never_refused() {
        for class in CLASSES {
            for unit in class.units.list() {
                for signed in [false, true] {
                    let derived = class_of_unit(unit, false);
                    let state = state_class(derived, Some(unit), signed);
                    check_wish(Platform::Sensor, (derived, Some(unit), state), Ok(()));
                }
            }
        }
    }
}
