//! MR-SM3: a meter for three phases, which also watches their voltages and records their curves
//! (Softwarebeschreibung Modbus RTU V2.1, pages 79 to 86).

mod grid;
mod recording;

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{Stimulus, take_words};
use crate::simulator::metz_connect::Module;
use crate::simulator::metz_connect::mr_sm3::grid::{
    Measured, PHASES, Together, VOLTS_MEASURABLE, measure_together,
};
use crate::simulator::metz_connect::mr_sm3::recording::{Recorder, Source};
use crate::simulator::pdu::{Exception, Request, check_span, words_reply, write_reply};

/// The meter.
pub struct MrSm3 {
    eeprom: Eeprom,
    sources: [Source; PHASES],
    now: Time,
    next_measurement: Time,
    measured: [Measured; PHASES],
    together: Together,
    /// Registers 42 to 53: active energy of each phase, then reactive.
    energies: [Energy; 2 * PHASES],
    /// Registers 0, 31 and 32.
    calibration: [u16; 3],
    /// Register 125.
    enabled: u16,
    /// Register 126.
    faults: u16,
    recorder: Recorder,
}

/// What is marked "Nichtflüchtig gespeichert im EEPROM", besides register 65.
#[derive(Clone, Copy, Debug)]
struct Eeprom {
    /// Registers 54 to 59: of the three voltages, then of the currents.
    factors: [u16; 2 * PHASES],
    /// Registers 120 to 123.
    tolerances: [u16; 4],
    /// Register 124.
    enabled_at_start: u16,
}

/// A counter of energy.
#[derive(Clone, Copy, Debug, Default)]
struct Energy {
    /// As the registers tell it, in Wh or varh.
    counted: u32,
    /// What is not yet a whole one, in microseconds at a thousandth of a watt; negative when generated.
    pending: i128,
}

/// "Die Register erhalten einmal pro 1 Sekunde neue Messwerte."
const MEASURED_EVERY: Duration = Duration::from_secs(1);
/// The counters begin again after 999.999.999, and stand there when they fall below 0: the manual gives
/// the range and does not say what happens at its ends; a mechanical counter does this.
const ENERGIES: u32 = 1_000_000_000;
/// Thousandths of a watt times microseconds in a watt-hour.
const WATT_HOUR: i128 = 3_600_000_000_000;
const FACTORS: std::ops::RangeInclusive<u16> = 1..=254;
/// Of tolerances.
const NOMINAL_VOLTS: f64 = 230.0;

const READABLE: [(u16, u16); 4] = [(0, 127), (256, 383), (512, 639), (768, 895)];
/// Register 65 is not here: the common part writes it.
const WRITABLE_SINGLY: [(u16, u16); 4] = [(0, 0), (31, 32), (42, 59), (120, 127)];
const WRITABLE: [(u16, u16); 2] = [(42, 59), (120, 127)];

/// The manual gives neither factors nor tolerances a value from the factory. A factor of 1 is the
/// least of its range; nothing is watched until somebody says how closely.
const FACTORY: Eeprom = Eeprom { factors: [1; 2 * PHASES], tolerances: [0; 4], enabled_at_start: 0 };

impl MrSm3 {
    pub fn new(now: Time) -> MrSm3 {
        MrSm3::start(now, FACTORY, std::array::from_fn(Source::new))
    }

    fn start(now: Time, eeprom: Eeprom, sources: [Source; PHASES]) -> MrSm3 {
        MrSm3 {
            eeprom,
            sources,
            now,
            next_measurement: now + MEASURED_EVERY,
            measured: Default::default(),
            together: Together::default(),
            energies: Default::default(),
            calibration: [0; 3],
            enabled: eeprom.enabled_at_start,
            faults: 0,
            recorder: Recorder::new(now),
        }
    }

    /// Any register of [`READABLE`]. Functions 3 and 4 read the same ones; 63 and 64 have no meaning,
    /// and the common part tells 65.
    fn read(&self, register: u16) -> u16 {
        let at = |first: u16| usize::from(register - first);
        let of = |first: u16| &self.measured[at(first)];
        let tenths = |amount: f64| amount * 10.0;
        let hundredths = |amount: f64| amount * 100.0;
        match register {
            0 => self.calibration[0],
            1..=3 => unsigned(tenths(of(1).volts)),
            4..=6 => unsigned(hundredths(of(4).amps)),
            7..=9 => unsigned(tenths(of(7).volts_peak)),
            10..=12 => unsigned(hundredths(of(10).amps_peak)),
            13..=15 => unsigned(hundredths(of(13).hertz)),
            16..=18 => signed(of(16).active),
            19..=21 => unsigned(of(19).apparent),
            22..=24 => signed(tenths(of(22).active)),
            25..=27 => unsigned(tenths(of(25).apparent)),
            28..=30 => signed(tenths(of(28).reactive)),
            31 | 32 => self.calibration[at(30)],
            39..=41 => signed(of(39).reactive),
            42..=53 => half(self.energies[at(42) / 2].counted, register),
            54..=59 => self.eeprom.factors[at(54)],
            60..=62 => signed(of(60).angle),
            66..=113 => half(self.float((at(66)) / 2).to_bits(), register),
            114..=116 => signed(tenths(self.together.angles[at(114)])),
            117..=119 => unsigned(tenths(self.together.components[at(117)])),
            120..=123 => self.eeprom.tolerances[at(120)],
            124 => self.eeprom.enabled_at_start,
            125 => self.enabled,
            126 => self.faults,
            127 => self.recorder.status(),
            256..=383 => self.sample(0, at(256)),
            512..=639 => self.sample(1, at(512)),
            768..=895 => self.sample(2, at(768)),
            // 33 to 38, "Abgleich-Status-Flags": the factory has set them as no page tells.
            _ => 0,
        }
    }

    /// The float with this number from register 66 on. Of them the transformers' factors are part
    /// (page 81), but of the power factor, which has the same on both sides.
    fn float(&self, number: usize) -> f32 {
        let (quantity, phase) = (number / PHASES, number % PHASES);
        let measured = &self.measured[phase];
        let (volts, amps) = self.factors(phase);
        let amount = match quantity {
            0 => measured.active * volts * amps,
            1 => measured.apparent * volts * amps,
            2 => measured.reactive * volts * amps,
            3 => measured.volts * volts,
            4 => measured.amps * amps,
            5 => measured.volts_peak * volts,
            6 => measured.amps_peak * amps,
            _ => measured.power_factor,
        };
        amount as f32
    }

    /// The factors of voltage and current.
    fn factors(&self, phase: usize) -> (f64, f64) {
        (self.eeprom.factors[phase].into(), self.eeprom.factors[PHASES + phase].into())
    }

    fn sample(&self, phase: usize, number: usize) -> u16 {
        self.recorder.sample(&self.sources, self.now, phase, number) as u16
    }

    /// Writes registers of [`WRITABLE_SINGLY`], all of them or none.
    fn write(&mut self, first: u16, words: &[u16]) -> Result<(), Exception> {
        let written = || (first..).zip(words);
        let mut energies = self.energies;
        for (register, word) in written() {
            match register {
                // A long value may be written by halves (page 85), each of which must leave a whole
                // within the range.
                42..=53 => {
                    let energy = &mut energies[usize::from(register - 42) / 2];
                    let shift = if register % 2 == 0 { 16 } else { 0 };
                    let counted = energy.counted & !(0xFFFF << shift) | u32::from(*word) << shift;
                    *energy = Energy { counted, pending: 0 };
                }
                // The page names the range and not what happens outside it.
                54..=59 if !FACTORS.contains(word) => return Err(Exception::Value),
                _ => {}
            }
        }
        if energies.iter().any(|energy| energy.counted >= ENERGIES) {
            return Err(Exception::Value);
        }
        self.energies = energies;
        for (register, word) in written() {
            let at = |first: u16| usize::from(register - first);
            match register {
                0 => self.calibration[0] = *word,
                31 | 32 => self.calibration[at(30)] = *word,
                54..=59 => self.eeprom.factors[at(54)] = *word,
                120..=123 => self.eeprom.tolerances[at(120)] = *word,
                124 => self.eeprom.enabled_at_start = *word,
                125 => self.enabled = *word,
                // "Bits können über den Modbus auch gesetzt werden": the enable bits are those of what
                // watches, and do not stand in the way.
                126 => self.set_faults(*word, self.now),
                127 => self.recorder.set_status(*word),
                _ => {}
            }
        }
        Ok(())
    }

    /// "Die Aufzeichnung von Spannungs-Messwerten stoppt, wenn Fehler-Bits gesetzt sind."
    fn set_faults(&mut self, faults: u16, at: Time) {
        self.faults = faults;
        if faults == 0 {
            self.recorder.resume();
        } else {
            self.recorder.stop(&self.sources, at);
        }
    }

    /// Counts energy up to `until`, of what flows since `self.now`.
    fn count(&mut self, until: Time) {
        let micros = until.since(self.now).as_micros() as i128;
        for phase in 0..PHASES {
            let Measured { active, reactive, .. } = self.sources[phase].now().measure();
            let (volts, amps) = self.factors(phase);
            for (kind, power) in [active, reactive].into_iter().enumerate() {
                let power = (power * volts * amps * 1000.0).round() as i128;
                self.energies[kind * PHASES + phase].pending += power * micros;
            }
        }
    }

    /// New values for the registers.
    fn measure(&mut self) {
        let phases = std::array::from_fn(|phase| *self.sources[phase].now());
        self.measured = phases.map(|phase| phase.measure());
        self.together = measure_together(&phases);
        for energy in &mut self.energies {
            let whole = energy.pending / WATT_HOUR;
            energy.pending -= whole * WATT_HOUR;
            energy.counted = (i128::from(energy.counted) + whole).rem_euclid(ENERGIES.into()) as u32;
        }
    }

    /// Register 126 for what is measured now. The factors have no part in it (page 81).
    fn found_faults(&self) -> u16 {
        let [under, over, negative, zero] = self.eeprom.tolerances.map(f64::from);
        let lowest = NOMINAL_VOLTS * (100.0 - under) / 100.0;
        let highest = NOMINAL_VOLTS * (100.0 + over) / 100.0;
        let volts = |phase: usize| self.sources[phase].now().volts();
        let [positive_system, negative_system, zero_system] = self.together.components.map(in_tenths);
        // Without a voltage nothing turns; angles are 0 then.
        let turns_left = self.together.angles.iter().all(|angle| *angle > 0.0);
        let mut faults = 0;
        for phase in 0..PHASES {
            faults |= u16::from(volts(phase) < VOLTS_MEASURABLE) << phase;
            faults |= u16::from(volts(phase) < lowest) << (3 + phase);
            faults |= u16::from(volts(phase) > highest) << (6 + phase);
        }
        // Without a voltage there is no ratio, and so no asymmetry.
        faults |= u16::from(zero_system * 100.0 > zero * positive_system) << 13;
        faults |= u16::from(negative_system * 100.0 > negative * positive_system) << 14;
        faults | u16::from(turns_left) << 15
    }
}

/// What registers 117 to 119 resolve, so that a voltage which is none there is none.
fn in_tenths(volts: f64) -> f64 {
    (volts * 10.0).round() / 10.0
}

/// What does not fit into a register is told as the nearest number that does: the casts saturate. The
/// page gives tenths of a watt a register which ends at 3276.7 W, and the whole watts beside it.
fn unsigned(amount: f64) -> u16 {
    amount.round() as u16
}

fn signed(amount: f64) -> u16 {
    amount.round() as i16 as u16
}

/// The half of a value of two registers that stands in `register`: all of them begin at even ones.
fn half(value: u32, register: u16) -> u16 {
    if register % 2 == 0 { (value >> 16) as u16 } else { value as u16 }
}

/// Whether a span lies within one of `spans`.
fn check_spans(first: u16, count: usize, most: usize, spans: &[(u16, u16)]) -> Result<(), Exception> {
    let last = spans.iter().copied().rfind(|(start, _)| *start <= first);
    check_span(first, count, most, last.unwrap_or((u16::MAX, u16::MAX)))
}

impl Module for MrSm3 {
    const PRODUCT: &'static str = "MR-SM3";
    const VERSION: &'static str = "V1.2";
    const FUNCTIONS: &'static [u8] = &[3, 4, 6, 16];
    const READS_LINE: bool = true;

    fn serve(&mut self, _now: Time, request: &Request) -> Result<Vec<u8>, Exception> {
        match *request {
            Request::Read { function, first, count } => {
                check_spans(first, count.into(), 125, &READABLE)?;
                let words: Vec<u16> = (first..first + count).map(|register| self.read(register)).collect();
                Ok(words_reply(function, &words))
            }
            Request::WriteRegister { address, word } => {
                check_spans(address, 1, 1, &WRITABLE_SINGLY)?;
                self.write(address, &[word])?;
                Ok(write_reply(6, address, word))
            }
            Request::WriteRegisters { first, ref words } => {
                check_spans(first, words.len(), 123, &WRITABLE)?;
                self.write(first, words)?;
                Ok(write_reply(16, first, words.len() as u16))
            }
            _ => Err(Exception::Function),
        }
    }

    fn advance(&mut self, now: Time) {
        if self.next_measurement <= now {
            let first = self.next_measurement;
            let more = now.since(first).as_micros() / MEASURED_EVERY.as_micros();
            let last = first + MEASURED_EVERY * more as u32;
            self.count(last);
            self.now = last;
            self.measure();
            // Nothing has changed since the first of these measurements: that one found the faults.
            let found = self.found_faults() & self.enabled;
            if found & !self.faults != 0 {
                self.set_faults(self.faults | found, first);
            }
            self.next_measurement = last + MEASURED_EVERY;
        }
        self.count(now);
        self.now = now;
    }

    /// Energies, faults and all else that is not stored begin anew; register 124 is "beim Einschalten
    /// des Geräts in Register 125 kopiert".
    fn restart(&mut self, now: Time) {
        *self = MrSm3::start(now, self.eeprom, self.sources);
    }

    fn stimulate(&mut self, now: Time, stimulus: &Stimulus) -> Result<(), String> {
        match *stimulus {
            Stimulus::Phase { phase: phase @ 1..=3, quantity, amount } => {
                self.sources[usize::from(phase) - 1].set(now, quantity, amount)
            }
            Stimulus::Phase { phase, .. } => Err(format!("phase {phase} is not there; MR-SM3 has 1 to 3")),
            _ => Err("MR-SM3 has three phases and nothing else to touch".into()),
        }
    }

    /// What is measured; the device itself shows and switches nothing.
    fn outputs(&self) -> Vec<(String, String)> {
        let named = |name: &str, unit: &str, quantity: fn(&Measured) -> f64| {
            let text = |(number, measured)| {
                (format!("{name}_{}", number + 1), format!("{:.2} {unit}", quantity(measured)))
            };
            self.measured.iter().enumerate().map(text).collect::<Vec<_>>()
        };
        [
            named("voltage", "V", |measured| measured.volts),
            named("current", "A", |measured| measured.amps),
            named("active_power", "W", |measured| measured.active),
        ]
        .concat()
    }

    fn eeprom(&self) -> Vec<u16> {
        let Eeprom { factors, tolerances, enabled_at_start } = self.eeprom;
        let mut words = factors.to_vec();
        words.extend(tolerances);
        words.push(enabled_at_start);
        words
    }

    fn load_eeprom(&mut self, mut words: &[u16]) {
        let words = &mut words;
        let factors = take_words(words).map(|factor: u16| factor.clamp(*FACTORS.start(), *FACTORS.end()));
        let (tolerances, [enabled_at_start]) = (take_words(words), take_words(words));
        self.eeprom = Eeprom { factors, tolerances, enabled_at_start };
    }
}

#[cfg(test)]
mod tests;
