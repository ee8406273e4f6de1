//! The analog board with eight outputs (chapter 6.2 of the manual).
//!
//! Not simulated: that the terminals of outputs 1, 2, 5 and 6 take two seconds; registers do not.

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{Stimulus, take_words};
use crate::simulator::fuehlersysteme::board::{AUTOMATIC, Board, Table};
use crate::simulator::fuehlersysteme::ranges::{Terminal, number, number_above, number_below};

/// The board.
pub type AnalogOut8 = Board<Outputs>;

/// Its own tables.
pub struct Outputs {
    settings: Settings,
    /// RWreg_01 to 08: hundredths of a volt or a milliampere, or 11111.
    fixed: [u16; OUTPUTS],
    /// RWreg_11 to 18.
    measured: [i16; OUTPUTS],
    regulators: [Regulator; OUTPUTS],
    /// When the regulators last looked.
    sampled_at: Time,
}

/// What is marked with a star, and so "auch gespeichert".
#[derive(Clone, Copy, Debug)]
struct Settings {
    /// RWreg_10.
    regulated: u8,
    /// RWreg_21 to 28 and 31 to 38.
    zero: [i16; OUTPUTS],
    end: [i16; OUTPUTS],
    /// RWreg_40.
    negated: u8,
    /// RWreg_41 to 48.
    wanted: [i16; OUTPUTS],
    /// RWreg_51 to 58 and 61 to 68.
    proportional: [u16; OUTPUTS],
    integral: [u16; OUTPUTS],
}

/// The state of a PI regulator.
#[derive(Clone, Copy, Debug, Default)]
struct Regulator {
    /// The differences of all samples, one a second.
    sum: f64,
    /// What came of the last sample, in thousandths of the output's span.
    value: f64,
}

const OUTPUTS: usize = 8;
/// Which outputs the factory made for current, a bit each: as in the manual's own examples.
const CURRENT_OUTPUTS: u8 = 0x02;
const FIXED_MAX: u16 = 2000;
const PARAMETER_MAX: u16 = 9999;
/// The whole span of an output, in the units that a regulator counts in.
const WHOLE: f64 = 1000.0;

const FACTORY: Settings = Settings {
    regulated: 0,
    zero: [0; OUTPUTS],
    end: [1000; OUTPUTS],
    negated: 0,
    wanted: [0; OUTPUTS],
    proportional: [10; OUTPUTS],
    integral: [600; OUTPUTS],
};

impl Outputs {
    /// Rreg_01 to 08: a fixed value, what the regulator says, or the measured value within its span.
    fn value(&self, output: usize) -> u16 {
        let terminal = Terminal::numbered(CURRENT_OUTPUTS, output);
        if self.fixed[output] != AUTOMATIC {
            // RWreg_01 allows 2000 for all; a terminal carries no more than its own span.
            return terminal.limit(self.fixed[output].into());
        }
        if self.is_regulated(output) {
            return terminal.at(self.regulators[output].value / WHOLE);
        }
        let (zero, end) = (f64::from(self.settings.zero[output]), f64::from(self.settings.end[output]));
        terminal.at((f64::from(self.measured[output]) - zero) / (end - zero))
    }

    fn is_regulated(&self, output: usize) -> bool {
        self.settings.regulated >> output & 1 == 1
    }

    /// "y(t) = P * (e(t) + 1/I * ∫ e dt)", without the integral where I is 0. The manual names no units
    /// of y and I: here they are thousandths of the output's span, and seconds.
    fn sample(&mut self, output: usize, times: f64) {
        let settings = &self.settings;
        let difference = f64::from(settings.wanted[output]) - f64::from(self.measured[output]);
        let difference = if settings.negated >> output & 1 == 1 { -difference } else { difference };
        // RWreg_51 has a digit behind the point.
        let proportional = f64::from(settings.proportional[output]) / 10.0;
        let integral = f64::from(settings.integral[output]);
        let regulator = &mut self.regulators[output];
        let mut sum_part = 0.0;
        if integral > 0.0 {
            // It sums no further than the output can follow.
            let sum_max = WHOLE * integral / proportional;
            regulator.sum = (regulator.sum + difference * times).clamp(0.0, sum_max);
            sum_part = regulator.sum / integral;
        } else {
            regulator.sum = 0.0;
        }
        regulator.value = (proportional * (difference + sum_part)).clamp(0.0, WHOLE);
    }
}

impl Table for Outputs {
    const HAS_SCRATCH: bool = true;

    fn new(now: Time) -> Outputs {
        Outputs {
            settings: FACTORY,
            fixed: [AUTOMATIC; OUTPUTS],
            measured: [0; OUTPUTS],
            regulators: [Regulator::default(); OUTPUTS],
            sampled_at: now,
        }
    }

    fn system_code(&self) -> u16 {
        0x3000 | u16::from(CURRENT_OUTPUTS)
    }

    fn read_input(&self, _now: Time, register: u16) -> Option<u16> {
        matches!(register, 1..=8).then(|| self.value(usize::from(register - 1)))
    }

    fn read_holding(&self, register: u16) -> Option<u16> {
        let at = |first: u16| usize::from(register - first);
        let settings = &self.settings;
        Some(match register {
            1..=8 => self.fixed[at(1)],
            10 => settings.regulated.into(),
            11..=18 => self.measured[at(11)] as u16,
            21..=28 => settings.zero[at(21)] as u16,
            31..=38 => settings.end[at(31)] as u16,
            40 => settings.negated.into(),
            41..=48 => settings.wanted[at(41)] as u16,
            51..=58 => settings.proportional[at(51)],
            61..=68 => settings.integral[at(61)],
            _ => return None,
        })
    }

    fn limit(&self, register: u16, word: u16) -> u16 {
        let at = |first: u16| usize::from(register - first);
        match register {
            1..=8 if word == AUTOMATIC => word,
            1..=8 => word.min(FIXED_MAX),
            10 | 40 => word.min(255),
            // "Nullpunktwerte… kleiner Endpunktwerte…": each bounds the other's range.
            21..=28 => number_below(word, self.settings.end[at(21)]),
            31..=38 => number_above(word, self.settings.zero[at(31)]),
            51..=58 => word.clamp(1, PARAMETER_MAX),
            61..=68 => word.min(PARAMETER_MAX),
            _ => number(word),
        }
    }

    fn write(&mut self, _now: Time, register: u16, word: u16) {
        let at = |first: u16| usize::from(register - first);
        let settings = &mut self.settings;
        match register {
            1..=8 => self.fixed[at(1)] = word,
            10 => settings.regulated = word as u8,
            11..=18 => self.measured[at(11)] = word as i16,
            21..=28 => settings.zero[at(21)] = word as i16,
            31..=38 => settings.end[at(31)] = word as i16,
            40 => settings.negated = word as u8,
            41..=48 => settings.wanted[at(41)] = word as i16,
            51..=58 => settings.proportional[at(51)] = word,
            _ => settings.integral[at(61)] = word,
        }
        // A regulator that is switched on again begins anew.
        for output in 0..OUTPUTS {
            if !self.is_regulated(output) {
                self.regulators[output] = Regulator::default();
            }
        }
    }

    /// "Die Abtastzeit beträgt 1sec": between two writes nothing changes, so many samples are one of their sum.
    fn advance(&mut self, now: Time) {
        let samples = now.since(self.sampled_at).as_secs();
        if samples == 0 {
            return;
        }
        self.sampled_at += Duration::from_secs(samples);
        for output in 0..OUTPUTS {
            if self.is_regulated(output) {
                self.sample(output, samples as f64);
            }
        }
    }

    fn restart(&mut self, now: Time) {
        *self = Outputs { settings: self.settings, ..Outputs::new(now) };
    }

    fn forget(&mut self) {
        self.settings = FACTORY;
    }

    fn stimulate(&mut self, _now: Time, _stimulus: &Stimulus) -> Result<(), String> {
        Err("the analog board has outputs and nothing to touch".into())
    }

    fn outputs(&self) -> Vec<(String, String)> {
        let text = |output: usize| Terminal::numbered(CURRENT_OUTPUTS, output).text(self.value(output));
        (0..OUTPUTS).map(|output| (format!("output_{}", output + 1), text(output))).collect()
    }

    fn eeprom(&self) -> Vec<u16> {
        let settings = &self.settings;
        let mut words = vec![settings.regulated.into(), settings.negated.into()];
        let signed = [settings.zero, settings.end, settings.wanted].concat();
        words.extend(signed.iter().map(|number| *number as u16));
        words.extend([settings.proportional, settings.integral].concat());
        words
    }

    fn load_eeprom(&mut self, words: &mut &[u16]) {
        let [regulated, negated] = take_words(words);
        let mut signed = || take_words(words).map(|word| word as i16);
        let (zero, end, wanted) = (signed(), signed(), signed());
        self.settings = Settings {
            regulated: regulated as u8,
            zero,
            end,
            negated: negated as u8,
            wanted,
            // By a parameter of 0 nothing could be divided.
            proportional: take_words(words).map(|word: u16| word.max(1)),
            integral: take_words(words),
        };
    }
}

#[cfg(test)]
mod tests;
