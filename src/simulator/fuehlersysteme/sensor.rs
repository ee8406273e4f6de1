//! The sensor (chapters 3 and 5 of the manual), with every quantity that one device can have.
//!
//! What a sensor lacks reads 0 ("ansonsten der Wert „Null“", page 8). This one has all but Rreg_22, in
//! place of which its pressure is told in Rreg_23 (page 10: the one to 500 Pa, the other to 5000 Pa).
//! No real one has both pressure and flow; here RWreg_48 decides by which the volume flow is calculated.
//!
//! Not simulated: the display and its keys, of which the registers are only kept; what RWreg_18 does to
//! the VOC reading, for which the manual has no number.

mod air;
mod extremes;
mod gas;
mod tables;
mod threshold;

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{Quantity, Stimulus, take_words};
use crate::simulator::fuehlersysteme::board::{AUTOMATIC, Board, Table};
use crate::simulator::fuehlersysteme::damping::Damping;
use crate::simulator::fuehlersysteme::ranges::{number_above, number_below};
use extremes::Extremes;
use gas::Gas;
use tables::{DAMPING_MAX, MEASURED, SETTINGS, measured_at, setting_at};
use threshold::{Rules, Threshold};

/// The device.
pub type Sensor = Board<Quantities>;

/// Its own tables.
pub struct Quantities {
    /// The RWregs of `SETTINGS`, in that order.
    settings: [i16; SETTINGS.len()],
    /// RWreg_26: what is added to the pressure, in Pa.
    zero_offset: i16,
    /// The RWregs under the numbers of `MEASURED`: a value instead of the measured one, or 11111.
    fixed: [u16; MEASURED.len()],
    /// When RWreg_35 goes back to 11111.
    fixed_motion_until: Time,
    around: Around,
    /// CO2, VOC and O2: bits 0 to 2 and 4 to 6 of register 19.
    gases: [Gas; 3],
    pressure: Damping,
    motion_until: Option<Time>,
    relay: Threshold,
    extremes: [Extremes; 2],
    settled_at: Time,
}

/// What is around the device.
#[derive(Clone, Copy, Debug)]
struct Around {
    humidity: f64,
    temperature: f64,
    co: f64,
    volts: f64,
    milliamps: f64,
    air_pressure: f64,
    pressure: f64,
    light: f64,
    flow: f64,
    door_open: bool,
    window_open: bool,
    switch_open: bool,
}

/// An empty office on a grey day.
const OFFICE: Around = Around {
    humidity: 45.0,
    temperature: 21.0,
    co: 0.0,
    volts: 0.0,
    milliamps: 0.0,
    air_pressure: 1013.0,
    pressure: 0.0,
    light: 300.0,
    flow: 0.0,
    door_open: false,
    window_open: false,
    switch_open: false,
};
const OFFICE_CO2: f64 = 600.0;
const OFFICE_VOC: f64 = 200.0;
const OFFICE_OXYGEN: f64 = 209.0;

/// Rreg_00. "Siehe verwendete Systemcode" (page 5), of which the manual lists none for sensors, only
/// 0x30, 0x40 and 0x50 in the high byte for the boards. This one is made up.
const SYSTEM_CODE: u16 = 0x1000;

/// The numbers of the settings that are used here.
mod registers {
    pub const HUMIDITY_OFFSET: u16 = 8;
    pub const TEMPERATURE_OFFSET: u16 = 9;
    pub const CALIBRATION: u16 = 19;
    pub const K_FACTOR: u16 = 24;
    pub const SLOPE: u16 = 25;
    pub const ZERO: u16 = 26;
    pub const DAMPING: u16 = 27;
    pub const AIR_PRESSURE_OFFSET: u16 = 28;
    pub const HEIGHT: u16 = 29;
    pub const RUN_ON: u16 = 32;
    pub const MOTION_BELOW: u16 = 33;
    pub const MOTION_BELOW_OF: u16 = 34;
    pub const MOTION: u16 = 35;
    pub const CROSS_SECTION: u16 = 48;
    pub const RELAY: u16 = 50;
    pub const RELAY_OF: u16 = 51;
    pub const RELAY_OFF: u16 = 52;
    pub const RELAY_ON: u16 = 53;
    pub const RELAY_OFF_DELAY: u16 = 54;
    pub const RELAY_ON_DELAY: u16 = 55;
    pub const EXTREMES_OF: [u16; 2] = [57, 58];
    pub const EXTREMES_HOURS: u16 = 59;
}
use registers::*;

impl Quantities {
    fn setting(&self, register: u16) -> i16 {
        setting_at(register).map_or(0, |at| self.settings[at])
    }

    fn seconds(&self, register: u16) -> Duration {
        Duration::from_secs(self.setting(register).max(0) as u64)
    }

    /// What an Rreg_mw tells; `None` where the number names none.
    fn value(&self, register: u16) -> Option<i16> {
        let at = measured_at(register)?;
        if self.fixed[at] != AUTOMATIC {
            // "so wird dieser den berechneten Wert des Messsystems überschreiben und als festen Wert in
            // das Rreg_01 übernehmen". What is calculated from it follows.
            return Some(self.fixed[at] as i16);
        }
        Some(MEASURED[at].limit(self.calculated(register)))
    }

    /// In the steps of the register.
    fn calculated(&self, register: u16) -> f64 {
        let value = |register: u16| f64::from(self.value(register).unwrap_or(0));
        let setting = |register: u16| f64::from(self.setting(register));
        let (humidity, celsius) = (|| value(1) / 10.0, || value(2) / 10.0);
        let flag = |on: bool| f64::from(u8::from(on));
        let around = &self.around;
        match register {
            1 => around.humidity * 10.0 + setting(HUMIDITY_OFFSET),
            2 => around.temperature * 10.0 + setting(TEMPERATURE_OFFSET),
            3 => air::absolute_humidity(celsius(), humidity()) * 10.0,
            4 => air::mixing_ratio(celsius(), humidity(), value(20)) * 10.0,
            5 => air::dew_point(celsius(), humidity()) * 10.0,
            6 => air::wet_bulb(celsius(), humidity(), value(20)) * 10.0,
            10 => self.gases[0].reading(),
            11 => self.gases[1].reading(),
            12 => around.co,
            13 => around.volts * 10.0,
            14 => around.milliamps * 10.0,
            15 => self.gases[2].reading(),
            20 => around.air_pressure + setting(AIR_PRESSURE_OFFSET),
            21 => air::at_sea_level(value(20), setting(HEIGHT)),
            23 => {
                let mean = self.pressure.mean(self.setting(DAMPING).max(1) as u16);
                (mean + f64::from(self.zero_offset)) * setting(SLOPE) / 1000.0
            }
            // "Die Rreg_30 und _31 werden entsprechend der Lichtstärke gleichzeitig aktualisiert" (page 11).
            30 => around.light,
            31 => around.light / 100.0,
            35 => flag(self.motion_until.is_some()),
            36 => flag(around.door_open),
            37 => flag(around.window_open),
            38 => flag(around.switch_open),
            40 => self.flow(),
            41 => self.flow() / 60.0,
            42 => self.flow() / 3600.0,
            43 => self.flow() * 1000.0,
            44 => self.flow() * 1000.0 / 60.0,
            45 => self.flow() * 1000.0 / 3600.0,
            47 => around.flow * 10.0,
            RELAY => flag(self.relay.is_on()),
            // Rreg_22, which this one lacks.
            _ => 0.0,
        }
    }

    /// m³/h.
    fn flow(&self) -> f64 {
        let value = |register: u16| f64::from(self.value(register).unwrap_or(0));
        match self.setting(CROSS_SECTION) {
            0 => air::flow_by_pressure(value(23), self.setting(K_FACTOR).into()),
            square_centimetres => air::flow_by_speed(value(47) / 10.0, square_centimetres.into()),
        }
    }

    /// Register 19. Rreg_19 names Bit_3 for the oxygen that is being calibrated, beside "Bit_2 ... Bit_0"
    /// and RWreg_19's Bit_2 (pages 5 and 6): Bit_2 is taken.
    fn calibration(&self) -> u16 {
        let bit = |on: bool, at: usize| u16::from(on) << at;
        let gases = self.gases.iter().enumerate();
        gases.map(|(at, gas)| bit(gas.is_calibrating(), at) | bit(gas.automatic, at + 4)).sum()
    }

    fn rules(&self) -> Rules {
        Rules {
            off: self.setting(RELAY_OFF),
            on: self.setting(RELAY_ON),
            off_delay: self.seconds(RELAY_OFF_DELAY),
            on_delay: self.seconds(RELAY_ON_DELAY),
        }
    }

    fn fix(&mut self, register: u16, word: u16) {
        if let Some(at) = measured_at(register) {
            self.fixed[at] = word;
        }
    }

    /// The first moment after the last one at which something changes by itself.
    fn changes_at(&self) -> Option<Time> {
        let fixed_motion = measured_at(MOTION).is_some_and(|at| self.fixed[at] != AUTOMATIC);
        let gases = self.gases.iter().flat_map(Gas::changes_at);
        let others = [
            self.pressure.changes_at(self.around.pressure),
            self.motion_until,
            fixed_motion.then_some(self.fixed_motion_until),
            self.relay.changes_at(self.rules()),
        ];
        gases.chain(others).flatten().filter(|at| *at > self.settled_at).min()
    }

    /// Does what is due at a moment, up to which nothing else was.
    fn settle(&mut self, now: Time) {
        self.settled_at = now;
        self.pressure.advance(now, self.around.pressure);
        self.gases.iter_mut().for_each(|gas| gas.advance(now));
        if self.motion_until.is_some_and(|until| until <= now) {
            self.motion_until = None;
        }
        if self.fixed_motion_until <= now {
            self.fix(MOTION, AUTOMATIC);
        }
        match self.value(self.setting(RELAY_OF) as u16) {
            Some(value) => self.relay.observe(now, value, self.rules()),
            None => self.relay = Threshold::default(),
        }
        let window = Duration::from_secs(self.setting(EXTREMES_HOURS).max(1) as u64 * 3600);
        for (number, register) in EXTREMES_OF.into_iter().enumerate() {
            match self.value(self.setting(register) as u16) {
                Some(value) => self.extremes[number].observe(now, value, window),
                None => self.extremes[number] = Extremes::default(),
            }
        }
    }

    /// A movement, which counts in the dark alone where RWreg_33 says so (page 12).
    fn sense_motion(&mut self, now: Time) {
        let below = self.setting(MOTION_BELOW);
        let light = self.value(self.setting(MOTION_BELOW_OF) as u16).unwrap_or(0);
        if below as u16 == AUTOMATIC || light < below {
            let until = now + self.seconds(RUN_ON);
            self.motion_until = (until > now).then_some(until);
        }
    }
}

impl Table for Quantities {
    const HAS_SCRATCH: bool = true;
    /// RWreg_200 to 239, Rreg_100 to 139, Wreg_500 to 539. Chapter 7 ends with Rreg_128 and 129.
    const SPECIALS: u16 = 40;
    /// "0 ... 0xffff".
    const RESTART_TAKES_ALL: bool = true;

    fn new(now: Time) -> Quantities {
        Quantities {
            settings: std::array::from_fn(|at| SETTINGS[at].factory),
            zero_offset: 0,
            fixed: [AUTOMATIC; MEASURED.len()],
            fixed_motion_until: now,
            around: OFFICE,
            gases: [
                Gas::new(now, gas::CO2, OFFICE_CO2),
                Gas::new(now, gas::VOC, OFFICE_VOC),
                Gas::new(now, gas::OXYGEN, OFFICE_OXYGEN),
            ],
            pressure: Damping::new(now, DAMPING_MAX),
            motion_until: None,
            relay: Threshold::default(),
            extremes: Default::default(),
            settled_at: now,
        }
    }

    fn system_code(&self) -> u16 {
        SYSTEM_CODE
    }

    fn read_input(&self, _now: Time, register: u16) -> Option<u16> {
        let value = match register {
            CALIBRATION => return Some(self.calibration()),
            55 => self.extremes[0].low(),
            56 => self.extremes[0].high(),
            57 => self.extremes[1].low(),
            58 => self.extremes[1].high(),
            _ => self.value(register)?,
        };
        Some(value as u16)
    }

    fn read_holding(&self, register: u16) -> Option<u16> {
        match register {
            CALIBRATION => Some(self.calibration()),
            ZERO => Some(self.zero_offset as u16),
            _ => match measured_at(register) {
                Some(at) => Some(self.fixed[at]),
                None => setting_at(register).map(|at| self.settings[at] as u16),
            },
        }
    }

    fn limit(&self, register: u16, word: u16) -> u16 {
        match register {
            CALIBRATION => word.min(0x7F),
            // "0, 1 [0]" are written; "-100 .. 100" is what then stands there.
            ZERO => (word as i16).clamp(0, 1) as u16,
            // "AUS-Schaltwert RWreg_52 kleiner EIN-Schaltwert RWreg_53": each bounds the other's range.
            RELAY_OFF => number_below(word, self.setting(RELAY_ON)),
            RELAY_ON => number_above(word, self.setting(RELAY_OFF)),
            // "1 .. 24" beside "1, 6, 12, 24 h": what lies between is shortened to one of the four.
            EXTREMES_HOURS => match word as i16 {
                24.. => 24,
                12.. => 12,
                6.. => 6,
                _ => 1,
            },
            _ => match (measured_at(register), setting_at(register)) {
                (Some(at), _) => MEASURED[at].limit_word(word),
                (_, Some(at)) => SETTINGS[at].limit(word) as u16,
                _ => word,
            },
        }
    }

    fn write(&mut self, now: Time, register: u16, word: u16) {
        let is_news = self.read_holding(register) != Some(word);
        if let Some(at) = setting_at(register) {
            self.settings[at] = word as i16;
        }
        self.fix(register, word);
        match register {
            CALIBRATION => {
                for (at, gas) in self.gases.iter_mut().enumerate() {
                    gas.calibrate(now, word >> at & 1 == 1);
                    gas.set_automatic(now, word >> (at + 4) & 1 == 1);
                }
            }
            ZERO if word == 0 => self.zero_offset = 0,
            // "bei 1 => einmaliges setzen des Nullpunktoffsets".
            ZERO => {
                let mean = self.pressure.mean(self.setting(DAMPING).max(1) as u16);
                self.zero_offset = (-mean).round().clamp(-100.0, 100.0) as i16;
            }
            // "wird bei Nachlaufzeit zurückgesetzt".
            MOTION => self.fixed_motion_until = now + self.seconds(RUN_ON),
            RELAY_OF if is_news => self.relay = Threshold::default(),
            // "bei Werteingabe => Löschen der Intervallwerte".
            EXTREMES_HOURS => self.extremes = Default::default(),
            _ => {}
        }
        for (number, _) in EXTREMES_OF.iter().enumerate().filter(|(_, of)| is_news && **of == register) {
            self.extremes[number] = Extremes::default();
        }
        self.settle(now);
    }

    fn advance(&mut self, now: Time) {
        while let Some(at) = self.changes_at().filter(|at| *at < now) {
            self.settle(at);
        }
        self.settle(now);
    }

    fn restart(&mut self, now: Time) {
        let settings =
            std::array::from_fn(
                |at| {
                    if SETTINGS[at].stored { self.settings[at] } else { SETTINGS[at].factory }
                },
            );
        *self = Quantities {
            settings,
            zero_offset: self.zero_offset,
            around: self.around,
            gases: self.gases.each_ref().map(|gas| gas.restarted(now)),
            ..Quantities::new(now)
        };
        self.settle(now);
    }

    fn forget(&mut self) {
        self.settings = std::array::from_fn(|at| SETTINGS[at].factory);
        self.zero_offset = 0;
        for gas in &mut self.gases {
            (gas.automatic, gas.offset) = (true, 0);
        }
    }

    fn stimulate(&mut self, now: Time, stimulus: &Stimulus) -> Result<(), String> {
        let around = &mut self.around;
        match *stimulus {
            Stimulus::Measure { quantity, value } => match quantity {
                Quantity::Humidity => around.humidity = value,
                Quantity::Temperature => around.temperature = value,
                Quantity::Co2 => self.gases[0].measure(value),
                Quantity::Voc => self.gases[1].measure(value * 10.0),
                Quantity::Co => around.co = value,
                Quantity::Volts => around.volts = value,
                Quantity::Milliamps => around.milliamps = value,
                Quantity::Oxygen => self.gases[2].measure(value * 10.0),
                Quantity::AirPressure => around.air_pressure = value,
                Quantity::Pressure => around.pressure = value,
                Quantity::Light => around.light = value,
                Quantity::Flow => around.flow = value,
                Quantity::Door => around.door_open = value != 0.0,
                Quantity::Window => around.window_open = value != 0.0,
                Quantity::Switch => around.switch_open = value != 0.0,
            },
            Stimulus::Motion => self.sense_motion(now),
            _ => return Err("the sensor measures what is around it, and has nothing else to touch".into()),
        }
        self.settle(now);
        Ok(())
    }

    fn outputs(&self) -> Vec<(String, String)> {
        let is_on = self.value(RELAY) == Some(1);
        vec![("relay".into(), if is_on { "ON" } else { "OFF" }.into())]
    }

    fn eeprom(&self) -> Vec<u16> {
        let settings = self.settings.iter().zip(&SETTINGS).filter(|(_, setting)| setting.stored);
        let mut words = vec![self.calibration() & 0x70, self.zero_offset as u16];
        words.extend(self.gases.iter().map(|gas| gas.offset as u16));
        words.extend(settings.map(|(value, _)| *value as u16));
        words
    }

    fn load_eeprom(&mut self, words: &mut &[u16]) {
        let [calibration, zero_offset] = take_words(words);
        self.zero_offset = (zero_offset as i16).clamp(-100, 100);
        for (at, offset) in take_words::<3>(words).into_iter().enumerate() {
            self.gases[at].automatic = calibration >> (at + 4) & 1 == 1;
            self.gases[at].offset = offset as i16;
        }
        let stored = SETTINGS.iter().enumerate().filter(|(_, setting)| setting.stored);
        for (at, setting) in stored {
            let [word] = take_words(words);
            self.settings[at] =
                if word == setting.factory as u16 { setting.factory } else { setting.limit(word) };
        }
    }
}

#[cfg(test)]
mod tests;
