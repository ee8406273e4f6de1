//! One analog input: from its configuration register and what is connected to the words of its
//! measured value (Softwarebeschreibung Modbus RTU V2.1, pages 51 to 57; the same again for MR-AIO4/2
//! on pages 64 to 68).

use crate::simulator::device::Signal;
use crate::simulator::metz_connect::sensors::{Quantity, Sensor};

/// What a configuration register, 16 to 23, says (bit 8 aside).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Code {
    pub format: Format,
    meaning: Meaning,
}

/// How the value stands in its two registers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Format {
    Float,
    /// In the first register, `per_unit` steps to one volt, ohm, degree or milliampere; the second holds 0.
    Integer {
        per_unit: f64,
    },
}

/// What is measured, and how it is made a value.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Meaning {
    Electric(Circuit),
    Sensor(Sensor),
    Table { circuit: Circuit, exponential: bool },
}

/// "Eingangsschaltung bzw. Messbereich".
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Circuit {
    /// 0 to 10 V.
    Voltage,
    /// 0 to 10 V with 2 kΩ to 5 V.
    Pullup,
    Resistance,
    /// 0 to 20 mA, of MR-Multi I/O's input I (page 93).
    Current,
}

/// "Spannung 0-10 V, Maximum 10,24 V" (page 54).
pub const VOLTS_MAX: f64 = 10.24;
/// "Widerstand, Maximum 4 MΩ" (page 54); an input without anything connected reads it.
const OHMS_MAX: f64 = 4e6;
/// "Strom 0-20mA, Maximum 22 mA" (page 93).
const MILLIAMPS_MAX: f64 = 22.0;
/// Steps of the integer to one volt: "1 V / 3200" (page 51).
const VOLT_STEPS: f64 = 3200.0;
/// Steps of the integer to one milliampere: "1mA / 1600" (page 93).
const MILLIAMP_STEPS: f64 = 1600.0;

impl Default for Code {
    /// 0, "Werkseinstellung": voltage as a float.
    fn default() -> Code {
        Code { format: Format::Float, meaning: Meaning::Electric(Circuit::Voltage) }
    }
}

impl Code {
    /// Reads a register; `None` for what the tables call reserved.
    pub fn parse(word: u16) -> Option<Code> {
        if word >> 9 != 0 {
            return None;
        }
        let number = word & 0x1F;
        if word & 0x80 == 0 {
            let circuit = Circuit::numbered(word >> 5 & 3)?;
            let format = match (circuit, number) {
                (_, 0) => Format::Float,
                (Circuit::Voltage | Circuit::Pullup, 1) => Format::Integer { per_unit: VOLT_STEPS },
                // 0.1 Ω, 1 Ω, 10 Ω, 100 Ω.
                (Circuit::Resistance, 1..=4) => {
                    Format::Integer { per_unit: 100.0 / 10f64.powi(number.into()) }
                }
                _ => return None,
            };
            return Some(Code { format, meaning: Meaning::Electric(circuit) });
        }
        let format = if word & 1 == 1 { Format::Integer { per_unit: 10.0 } } else { Format::Float };
        let meaning = if word >> 4 & 7 == 7 {
            Meaning::Table { circuit: Circuit::numbered(word >> 2 & 3)?, exponential: word >> 1 & 1 == 1 }
        } else {
            Meaning::Sensor(Sensor::numbered(word >> 1 & 0x3F)?)
        };
        Some(Code { format, meaning })
    }

    /// Reads the register of an input that measures current: only 0 and 1, which mean volts elsewhere.
    pub fn parse_current(word: u16) -> Option<Code> {
        let format = match word {
            0 => Format::Float,
            1 => Format::Integer { per_unit: MILLIAMP_STEPS },
            _ => return None,
        };
        Some(Code { format, meaning: Meaning::Electric(Circuit::Current) })
    }
}

/// The codes of devices that compare with no threshold, for which bit 8 stands, and do not have sensor
/// 13, NTC-10k of CAREL: BTR's MR-AI8 and MR-Multi I/O.
pub fn is_code_without_carel(word: u16) -> bool {
    word <= 0xFF && word & 0xFE != 0x9A && Code::parse(word).is_some()
}

impl Circuit {
    fn numbered(number: u16) -> Option<Circuit> {
        match number {
            0 => Some(Circuit::Voltage),
            1 => Some(Circuit::Pullup),
            2 => Some(Circuit::Resistance),
            _ => None,
        }
    }

    /// Volts, ohms or milliamperes at the terminals. A temperature without a sensor is nothing to measure.
    fn measure(self, signal: Signal, volts_max: f64) -> f64 {
        match (self, signal) {
            (Circuit::Voltage | Circuit::Pullup, Signal::Volts(volts)) => volts.clamp(0.0, volts_max),
            (Circuit::Pullup, Signal::Ohms(ohms)) => 5.0 * ohms.max(0.0) / (ohms.max(0.0) + 2000.0),
            (Circuit::Pullup, _) => 5.0,
            (Circuit::Voltage, _) => 0.0,
            (Circuit::Resistance, Signal::Ohms(ohms)) => ohms.clamp(0.0, OHMS_MAX),
            (Circuit::Resistance, Signal::Volts(_)) => 0.0,
            (Circuit::Resistance, _) => OHMS_MAX,
            (Circuit::Current, Signal::Milliamps(milliamps)) => milliamps.clamp(0.0, MILLIAMPS_MAX),
            (Circuit::Current, _) => 0.0,
        }
    }
}

/// The value of an input in its unit: volts, ohms, milliamperes, degrees, or what the table's left column
/// holds. `volts_max` is as far as the device measures.
pub fn measure(code: Code, signal: Signal, table: &[u16], fahrenheit: bool, volts_max: f64) -> f64 {
    match code.meaning {
        Meaning::Electric(circuit) => circuit.measure(signal, volts_max),
        Meaning::Sensor(sensor) => {
            let celsius = match (signal, sensor.quantity()) {
                (Signal::Celsius(celsius), _) => sensor.limit(celsius),
                (signal, Quantity::Ohms) => sensor.celsius(Circuit::Resistance.measure(signal, volts_max)),
                (signal, Quantity::Volts) => sensor.celsius(Circuit::Pullup.measure(signal, volts_max)),
            };
            // "gilt für alle aufgelisteten Sensortypen, aber nicht für die Interpolations-Tabelle".
            if fahrenheit { celsius * 1.8 + 32.0 } else { celsius }
        }
        Meaning::Table { circuit, exponential } => match signal {
            Signal::Celsius(celsius) => celsius,
            signal => interpolate(&table_points(table), circuit.measure(signal, volts_max), exponential),
        },
    }
}

/// The value's two registers, with the offset added, which has the value's own format.
pub fn raw_words(code: Code, value: f64, offset: [u16; 2]) -> [u16; 2] {
    match code.format {
        Format::Float => float_words(value as f32 + float(offset)),
        Format::Integer { per_unit } => {
            // What does not fit is told as the largest number that does: the cast saturates.
            let steps = (value * per_unit).round() as i16;
            [steps.saturating_add(offset[0] as i16) as u16, 0]
        }
    }
}

/// The value with its offset as a number in volts, ohms or degrees Celsius, whatever the registers tell
/// it in: what controllers within the device work with (page 76).
pub fn quantity(code: Code, value: f64, offset: [u16; 2], fahrenheit: bool) -> f64 {
    let told = value
        + match code.format {
            Format::Float => f64::from(float(offset)),
            Format::Integer { per_unit } => f64::from(offset[0] as i16) / per_unit,
        };
    match code.meaning {
        Meaning::Sensor(_) if fahrenheit => (told - 32.0) / 1.8,
        _ => told,
    }
}

/// "Der Registerwert ändert sich, sobald der Analogwert die Einschaltschwelle erreicht hat" (page 57),
/// against "wenn Messwert > Schwellenwert" (pages 51, 52 and 53): above means above.
pub fn is_above(format: Format, value: [u16; 2], on: [u16; 2], off: [u16; 2], before: bool) -> bool {
    let number = |words: [u16; 2]| match format {
        Format::Float => float(words),
        Format::Integer { .. } => f32::from(words[0] as i16),
    };
    let value = number(value);
    if value > number(on) { true } else { before && value >= number(off) }
}

/// The float in two registers, the higher half first (pages 49 and 60).
pub fn float(words: [u16; 2]) -> f32 {
    f32::from_bits(u32::from(words[0]) << 16 | u32::from(words[1]))
}

/// A float as two registers.
pub fn float_words(number: f32) -> [u16; 2] {
    let bits = number.to_bits();
    [(bits >> 16) as u16, bits as u16]
}

/// The table's points, up to the first that is 0, 0: temperature and what is measured (page 56).
fn table_points(table: &[u16]) -> Vec<(f64, f64)> {
    table
        .chunks_exact(4)
        .map(|words| (float([words[0], words[1]]).into(), float([words[2], words[3]]).into()))
        .take_while(|point| *point != (0.0, 0.0))
        .collect()
}

/// The temperature at `measured`. The manual speaks only of what lies between points; outside them
/// the nearest point's temperature is told.
fn interpolate(points: &[(f64, f64)], measured: f64, exponential: bool) -> f64 {
    let scale =
        |quantity: f64| if exponential { libm::log(quantity.max(f64::MIN_POSITIVE)) } else { quantity };
    let between = points.windows(2).find(|pair| {
        let (a, b) = (pair[0].1, pair[1].1);
        a.min(b) <= measured && measured <= a.max(b) && a != b
    });
    if let Some(pair) = between {
        let (a, b) = (scale(pair[0].1), scale(pair[1].1));
        return pair[0].0 + (pair[1].0 - pair[0].0) * (scale(measured) - a) / (b - a);
    }
    let distance = |point: &&(f64, f64)| (point.1 - measured).abs();
    points.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).map_or(0.0, |point| point.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_of_the_tables_on_pages_54_to_56_is_known_and_no_other() {
        let known: Vec<u16> = (0..=0xFFFF).filter(|word| Code::parse(*word).is_some()).collect();
        let mut tabled: Vec<u16> = vec![0, 1, 32, 33, 64, 65, 66, 67, 68];
        tabled.extend(128..=155);
        tabled.extend(240..=251);
        // Each with bit 8, the turned comparison.
        let turned: Vec<u16> = tabled.iter().map(|code| code | 0x100).collect();
        tabled.extend(turned);
        assert_eq!(known, tabled);
    }

    #[test]
    fn integers_count_in_the_units_of_page_54_and_saturate() {
        for (code, signal, word) in [
            (1, Signal::Volts(1.0), 3200),
            (1, Signal::Volts(10.0), 32_000),
            (1, Signal::Volts(11.0), 32_767),
            (33, Signal::Ohms(2000.0), 8000),
            (33, Signal::Open, 16_000),
            (65, Signal::Ohms(107.8), 1078),
            (65, Signal::Ohms(3276.7), 32_767),
            (65, Signal::Ohms(5000.0), 32_767),
            (66, Signal::Ohms(5000.0), 5000),
            (67, Signal::Ohms(327_670.0), 32_767),
            (67, Signal::Ohms(100.0), 10),
            (68, Signal::Ohms(1_000_000.0), 10_000),
            (68, Signal::Open, 32_767),
            (129, Signal::Celsius(21.54), 215),
            (129, Signal::Celsius(-50.0), -500),
            (129, Signal::Celsius(500.0), 1500),
        ] {
            let code = Code::parse(code).expect("a code");
            let words = raw_words(code, measure(code, signal, &[], false, VOLTS_MAX), [0, 0]);
            assert_eq!(words, [word as u16, 0], "{code:?} {signal:?}");
        }
    }

    #[test]
    fn the_table_is_interpolated_linearly_or_by_the_logarithm_and_ends_at_its_ends_page_56() {
        let points = [(0.0, 1000.0), (10.0, 4000.0), (20.0, 16_000.0)];
        for (measured, linear, exponential) in [
            (1000.0, 0.0, 0.0),
            (2000.0, 10.0 / 3.0, 5.0),
            (10_000.0, 15.0, 10.0 + 10.0 * (libm::log(2.5) / libm::log(4.0))),
            (16_000.0, 20.0, 20.0),
            (20_000.0, 20.0, 20.0),
            (10.0, 0.0, 0.0),
        ] {
            let near = |told: f64, wanted: f64| assert!((told - wanted).abs() < 1e-9, "{measured}: {told}");
            near(interpolate(&points, measured, false), linear);
            near(interpolate(&points, measured, true), exponential);
            let falling: Vec<(f64, f64)> = points.iter().rev().copied().collect();
            near(interpolate(&falling, measured, false), linear);
        }
        assert_eq!(interpolate(&[], 5.0, false), 0.0);
    }

    #[test]
    fn the_table_ends_with_the_first_point_that_is_zero_and_zero_page_56() {
        let words = |number: f32| [(number.to_bits() >> 16) as u16, number.to_bits() as u16];
        let table =
            [words(0.0), words(5.0), words(7.5), words(0.0), words(0.0), words(0.0), words(1.0), words(1.0)];
        assert_eq!(table_points(table.as_flattened()), [(0.0, 5.0), (7.5, 0.0)]);
    }
}
