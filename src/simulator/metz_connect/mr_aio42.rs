//! MR-AIO4/2: four inputs for voltage, resistance and temperature, two voltage outputs, and two PID
//! controllers between them (Softwarebeschreibung Modbus RTU V2.1, pages 60 to 78).

mod controller;

use crate::engine::time::{Duration, Time};
use crate::simulator::device::Stimulus;
use crate::simulator::metz_connect::Module;
use crate::simulator::metz_connect::analog_inputs::AnalogInputs;
use crate::simulator::metz_connect::channel::{Code, float, float_words};
use crate::simulator::metz_connect::holding::HoldingRegisters;
use crate::simulator::metz_connect::mr_aio42::controller::{Controller, Limit, Parameters, limited};
use crate::simulator::metz_connect::watchdog::{WATCHDOG, Watchdog};
use crate::simulator::pdu::{Exception, Request, check_span};

/// The inputs and what is made of them.
pub struct MrAio42 {
    /// With registers 0 to 7, 16 to 19 and 24 to 63, here all in the EEPROM, the offsets too (page 63).
    inputs: AnalogInputs<INPUTS>,
    /// Registers 8 to 15, "frei verwendbar". EEPROM.
    free: [u16; 8],
    /// Register 68. EEPROM.
    fahrenheit: bool,
    watchdog: Watchdog,
    sides: [Side; 2],
    /// Registers 200 to 239, the linear maps LCL1 to LCL4. EEPROM.
    maps: [u16; 40],
    /// The input that is measured next, counted from 0, and when.
    turn: usize,
    next_turn: Time,
}

/// "Jeweils einem Ausgang und 2 Eingängen ist ein PID-Regler zugeordnet" (page 77).
struct Side {
    /// Registers 100 to 123, or 150 to 173, of which the second side's first has no meaning. EEPROM.
    settings: [u16; 24],
    controller: Controller,
    /// W, registers 136 or 186.
    set_point: f32,
    /// Amin, register 140, or Bmax, register 190.
    limit: f32,
    /// OutF, registers 138 or 188.
    percent: f32,
    /// OutI, register 20 or 21.
    steps: i16,
    /// InitOutI, register 22 or 23. EEPROM.
    initial_steps: i16,
}

const INPUTS: usize = 4;
const UNIT: u16 = 68;
const SWITCH: u16 = 100;
/// The registers of function 3 and 16 (page 60), which must not be mixed in one request. Of LCL4 that
/// list has only the first half, "200 - 231", and the table on page 76 all of it: up to 239.
const REGISTERS: [(u16, u16); 9] =
    [(0, 63), (65, 65), (66, 66), (68, 68), (100, 123), (130, 143), (150, 173), (180, 193), (200, 239)];
/// Those of function 6, without 65, which is written the same in all devices.
const SINGLE_REGISTERS: [(u16, u16); 3] = [(16, 23), (66, 66), (68, 68)];
/// Those that outlive a restart: all but the values of outputs and controllers.
const EEPROM: [(u16, u16); 7] = [(0, 19), (22, 63), (66, 66), (68, 68), (100, 123), (150, 173), (200, 239)];
/// Where in the settings InitW and InitOutF stand.
const INITIAL_SET_POINT: usize = 20;
const INITIAL_PERCENT: usize = 22;
/// Where the maps' registers begin, counted from 200: LCL3 and LCL4 have two limits more.
const MAPS: [usize; 4] = [0, 8, 16, 28];
/// "Etwa 0,2 Sekunden" for one measurement, and each input "im Abstand von etwa 1 Sekunde" (page 62).
/// That a new range of resistance takes longer is said without ranges, and left out.
const TURN: Duration = Duration::from_millis(250);
/// "Wert 32767 = 10,24 Volt", as MR-AO4's.
const STEPS_PER_VOLT: f64 = 3200.0;
/// "102,4 % = 10,24 Volt".
const STEPS_PER_PERCENT: f32 = 320.0;
const PERCENT_MAX: f32 = 102.4;

impl MrAio42 {
    pub fn new(now: Time) -> MrAio42 {
        let map = [0.0, 100.0, 0.0, 100.0];
        let limited_map = [0.0, 100.0, 0.0, 100.0, 0.0, 100.0];
        let numbers = [&map[..], &map, &limited_map, &limited_map].concat();
        let mut maps = [0; 40];
        for (words, number) in maps.chunks_exact_mut(2).zip(numbers) {
            words.copy_from_slice(&float_words(number));
        }
        let mut device = MrAio42 {
            inputs: AnalogInputs::new(now),
            free: [0; 8],
            fahrenheit: false,
            watchdog: Watchdog::new(now),
            sides: [Side::new(), Side::new()],
            maps,
            turn: 0,
            next_turn: now,
        };
        device.restart(now);
        device
    }

    /// One of [`REGISTERS`].
    fn put(&mut self, now: Time, register: u16, word: u16) {
        let at = usize::from(register);
        match register {
            8..=15 => self.free[at - 8] = word,
            20 | 21 => self.sides[at - 20].steps = word as i16,
            22 | 23 => self.sides[at - 22].initial_steps = word as i16,
            0..=63 => self.inputs.write(now, register, word),
            WATCHDOG => self.watchdog.time = word,
            UNIT => self.fahrenheit = word & 1 == 1,
            100..=123 => self.sides[0].settings[at - 100] = word,
            130..=143 => self.sides[0].put_value(at - 130, word),
            150 => {}
            151..=173 => self.sides[1].settings[at - 150] = word,
            180..=193 => self.sides[1].put_value(at - 180, word),
            _ => self.maps[at - 200] = word,
        }
    }

    /// Expires, maybe.
    fn watch(&mut self, at: Time) {
        if self.watchdog.expires(at) {
            self.sides.iter_mut().for_each(Side::load_initial_values);
            self.connect();
        }
    }

    /// What two bits of the register Switch choose: a set point or an output value (page 77).
    fn selection(&self, shift: usize) -> u16 {
        self.sides[0].settings[0] >> shift & 3
    }

    /// Joins inputs, maps, set points, limits and outputs as Switch says ("Verschaltung der
    /// Funktionsblöcke", pages 76 and 77).
    ///
    /// The picture of it is lost, and no text says what LCL3 and LCL4 are joined to. Amin and Bmax have
    /// no other source, and they are taken to be made of the same input of the controller's two that
    /// would else be the set point: In2 and In4.
    fn connect(&mut self) {
        for number in 0..2 {
            let second_input = self.inputs.quantity(2 * number + 1) as f32;
            let converted = self.map(number, second_input);
            let limit = self.map(2 + number, second_input);
            let (from, to) = (self.selection(2 * number), self.selection(4 + 2 * number));
            let side = &mut self.sides[number];
            match from {
                0 => side.set_point = second_input,
                1 => side.set_point = converted,
                _ => {}
            }
            side.limit = limit;
            // "Der Ausgabewert wird immer in beiden Modbus Registern angezeigt": the one that is chosen
            // holds what was written, the other what goes out.
            match to {
                0 => side.percent = f32::from(side.steps.max(0)) / STEPS_PER_PERCENT,
                1 => side.steps = steps(side.percent),
                _ => {
                    side.percent = limited(side.controller.y, 0.0, PERCENT_MAX);
                    side.steps = steps(side.percent);
                }
            }
        }
    }

    /// LCL1 to LCL4, counted from 0 (pages 74 to 76).
    fn map(&self, number: usize, x: f32) -> f32 {
        let at = |parameter: usize| {
            let first = MAPS[number] + 2 * parameter;
            float([self.maps[first], self.maps[first + 1]])
        };
        let (y1, y2, x1, x2) = (at(0), at(1), at(2), at(3));
        let (low, high) = if number < 2 { (y1.min(y2), y1.max(y2)) } else { (at(4), at(5)) };
        let y = if x1 != x2 {
            y1 + (y2 - y1) * (x - x1) / (x2 - x1)
        } else if x <= x1 {
            // The pages do not speak of two points above each other: here the line is a step.
            y1
        } else {
            y2
        };
        limited(y, low, high)
    }

    /// Both controllers calculate once.
    fn control(&mut self) {
        for (number, side) in self.sides.iter_mut().enumerate() {
            let x = self.inputs.quantity(2 * number) as f32;
            let limit = if number == 0 { Limit::AtLeast(side.limit) } else { Limit::AtMost(side.limit) };
            side.controller.step(&Parameters::read(&side.settings), x, side.set_point, limit);
        }
        self.connect();
    }
}

impl Side {
    fn new() -> Side {
        // Enabled and negated. Of Ymin, Ymax and DeadR page 73 tells no factory setting: here nothing
        // is cut off, and no change too small.
        let parameters = [3.0, 300.0, 1.0, 10.0, 0.0, 100.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let mut settings = [0; 24];
        settings[1] = controller::ENABLE | controller::ACTION;
        settings[2..].copy_from_slice(parameters.map(float_words).as_flattened());
        Side {
            settings,
            controller: Controller::default(),
            set_point: 0.0,
            limit: 0.0,
            percent: 0.0,
            steps: 0,
            initial_steps: 0,
        }
    }

    /// Registers 130 to 143, or 180 to 193.
    fn values(&self) -> [f32; 7] {
        let Controller { yp, yi, ydt, manual_y, .. } = self.controller;
        [yp, yi, ydt, self.set_point, self.percent, self.limit, manual_y]
    }

    /// Writes half of such a value. The list of function 16 has those, too, that are "Nur Lesen" (pages
    /// 74 and 78): what is written to them has no effect.
    fn put_value(&mut self, at: usize, word: u16) {
        let mut values = self.values().map(float_words);
        values.as_flattened_mut()[at] = word;
        [_, _, _, self.set_point, self.percent, _, self.controller.manual_y] = values.map(float);
    }

    /// What is copied "beim Einschalten des Geräts und Ablaufen des Watchdog-Timers" (pages 62 and 77).
    fn load_initial_values(&mut self) {
        let number = |at: usize| float([self.settings[at], self.settings[at + 1]]);
        self.steps = self.initial_steps;
        (self.set_point, self.percent) = (number(INITIAL_SET_POINT), number(INITIAL_PERCENT));
    }
}

fn steps(percent: f32) -> i16 {
    // What is more than an output can give is told as the most that it can.
    (percent * STEPS_PER_PERCENT).round().max(0.0) as i16
}

impl HoldingRegisters for MrAio42 {
    fn check(first: u16, count: usize) -> Result<(), Exception> {
        let allowed = REGISTERS.into_iter().find(|(low, high)| (*low..=*high).contains(&first));
        // No span at all refuses every address, and a wrong quantity before it.
        check_span(first, count, 125, allowed.unwrap_or((u16::MAX, 0)))
    }

    fn read(&self, register: u16) -> u16 {
        let at = usize::from(register);
        let value = |side: usize, at: usize| self.sides[side].values().map(float_words).as_flattened()[at];
        match register {
            8..=15 => self.free[at - 8],
            20 | 21 => self.sides[at - 20].steps as u16,
            22 | 23 => self.sides[at - 22].initial_steps as u16,
            0..=63 => self.inputs.read(register),
            // What it is, the part knows that all devices have in common.
            65 => 0,
            WATCHDOG => self.watchdog.time,
            UNIT => self.fahrenheit.into(),
            100..=123 => self.sides[0].settings[at - 100],
            130..=143 => value(0, at - 130),
            150..=173 => self.sides[1].settings[at - 150],
            180..=193 => value(1, at - 180),
            _ => self.maps[at - 200],
        }
    }

    fn write(&mut self, now: Time, first: u16, words: &[u16]) -> Result<(), Exception> {
        // MR-AI8's codes without their bit 8 ("Bit 15-8: reserviert", pages 64 to 66).
        self.inputs.check_codes(first, words, |word| word <= 0xFF && Code::parse(word).is_some())?;
        // Of each field's four values three are told; the fourth is refused as reserved codes are.
        let means_nothing = |word: u16| (0..8).step_by(2).any(|shift| word >> shift & 3 == 3);
        if first == SWITCH && means_nothing(words[0]) {
            return Err(Exception::Value);
        }
        for (register, word) in (first..).zip(words) {
            self.put(now, register, *word);
        }
        self.connect();
        Ok(())
    }
}

impl Module for MrAio42 {
    const PRODUCT: &'static str = "MR-AIO4/2";
    const VERSION: &'static str = "V1.4";
    const FUNCTIONS: &'static [u8] = &[3, 4, 6, 16];
    const READS_LINE: bool = true;

    fn serve(&mut self, now: Time, request: &Request) -> Result<Vec<u8>, Exception> {
        match *request {
            Request::Read { function: 4, first, count } => self.inputs.read_values(first, count),
            Request::WriteRegister { address, .. }
                if !SINGLE_REGISTERS.iter().any(|(low, high)| (*low..=*high).contains(&address)) =>
            {
                Err(Exception::Address)
            }
            _ => self.serve_holding(now, request),
        }
    }

    fn message_for_this_device(&mut self, now: Time) {
        self.watchdog.feed(now);
    }

    fn advance(&mut self, now: Time) {
        while self.next_turn <= now {
            self.watch(self.next_turn);
            self.inputs.measure_one(self.turn, self.fahrenheit);
            self.turn = (self.turn + 1) % INPUTS;
            self.next_turn += TURN;
            self.connect();
            if self.turn == 0 {
                self.control();
            }
        }
        self.watch(now);
    }

    fn restart(&mut self, now: Time) {
        self.inputs.restart(now);
        self.watchdog.feed(now);
        for side in &mut self.sides {
            // A controller that is enabled starts with the device, and so with InitY.
            side.controller = Controller::default();
            side.load_initial_values();
        }
        (self.turn, self.next_turn) = (0, now + TURN);
        self.connect();
    }

    fn stimulate(&mut self, _now: Time, stimulus: &Stimulus) -> Result<(), String> {
        self.inputs.stimulate(Self::PRODUCT, stimulus)
    }

    /// Volts at the terminals, the measured values, and the red light of the watchdog (page 61).
    fn outputs(&self) -> Vec<(String, String)> {
        let volts = |side: &Side| f64::from(side.steps.max(0)) / STEPS_PER_VOLT;
        let sides = self.sides.iter().enumerate();
        let mut outputs: Vec<(String, String)> = sides
            .map(|(number, side)| (format!("output_{}", number + 1), format!("{:.3} V", volts(side))))
            .collect();
        outputs.extend(self.inputs.outputs());
        let light = if self.watchdog.has_expired() { "ON" } else { "OFF" };
        outputs.push(("red_light".into(), light.into()));
        outputs
    }

    fn eeprom(&self) -> Vec<u16> {
        EEPROM.iter().flat_map(|(low, high)| *low..=*high).map(|register| self.read(register)).collect()
    }

    fn load_eeprom(&mut self, words: &[u16]) {
        for (register, word) in EEPROM.iter().flat_map(|(low, high)| *low..=*high).zip(words) {
            // The time only says when an input is measured anew, and a restart follows that says it again.
            self.put(Time::default(), register, *word);
        }
    }
}

#[cfg(test)]
mod tests;
