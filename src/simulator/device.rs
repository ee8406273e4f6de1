//! What every simulated device can do, whatever it is: answer, age, restart, be touched, be looked at.

use std::fmt;

use crate::engine::address::Span;
use crate::engine::time::{Duration, Time};
use crate::simulator::btr;
use crate::simulator::fuehlersysteme::analog_in8::AnalogIn8;
use crate::simulator::fuehlersysteme::analog_out8::AnalogOut8;
use crate::simulator::fuehlersysteme::relay8::Relay8;
use crate::simulator::fuehlersysteme::sensor::Sensor;
use crate::simulator::metz_connect::MetzConnect;
use crate::simulator::metz_connect::mr_ai8::MrAi8;
use crate::simulator::metz_connect::mr_aio42::MrAio42;
use crate::simulator::metz_connect::mr_ao4::{MrAo4, MrAop4};
use crate::simulator::metz_connect::mr_ci4::MrCi4;
use crate::simulator::metz_connect::mr_di::{MrDi4, MrDi10};
use crate::simulator::metz_connect::mr_dio42::MrDio42;
use crate::simulator::metz_connect::mr_do4::{MrDo4, MrDoa4};
use crate::simulator::metz_connect::mr_ld6::MrLd6;
use crate::simulator::metz_connect::mr_multi_io::MrMultiIo;
use crate::simulator::metz_connect::mr_si4::MrSi4;
use crate::simulator::metz_connect::mr_sm3::MrSm3;
use crate::simulator::metz_connect::mr_to4::MrTo4;
use crate::simulator::metz_connect::mr_tp::MrTp;

/// A device on a line. It opens nothing, waits for nothing and is told the time; a caller may let
/// any amount of time pass between two calls, but never lets it run backwards.
pub trait SimulatedDevice: Send {
    /// Answers a request PDU (function code and data, no address, no checksum); `None` is silence.
    fn request(&mut self, now: Time, addressed: Addressed, pdu: &[u8]) -> Option<Vec<u8>>;

    /// Something else was on the line. Devices with counters count it.
    fn overhear(&mut self, _heard: Overheard) {}

    /// Lets time pass: delays end, watchdogs expire, pulses arrive.
    fn advance(&mut self, now: Time);

    /// Starts anew: what is in the EEPROM stays, everything else is as after switching on.
    fn restart(&mut self, now: Time);

    /// Changes the process side; the error says what this device has instead.
    fn stimulate(&mut self, now: Time, stimulus: &Stimulus) -> Result<(), String>;

    /// What a person in front of the device sees: `relay_1` `ON`.
    fn outputs(&self) -> Vec<(String, String)>;

    /// The EEPROM as words, always as many; see [`SimulatedDevice::load_eeprom`].
    fn eeprom(&self) -> Vec<u16>;

    /// Puts a stored EEPROM back and restarts. The error says how many words it should have been.
    fn load_eeprom(&mut self, now: Time, words: &[u16]) -> Result<(), String>;

    /// The bit rate and parity that this device listens with; `None`: always those of its line.
    fn line_settings(&self) -> Option<LineSettings> {
        None
    }

    /// The function and register that say what this device is, and a bit of it by which it differs from
    /// another device. `None`: it says so by names, or not at all.
    fn identity_register(&self) -> Option<(u8, u16, u16)> {
        None
    }

    /// A device that cannot answer within this time does not answer at all.
    fn gives_up_after(&self) -> Option<Duration> {
        None
    }
}

/// Whom a request was meant for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Addressed {
    /// This device alone.
    Unit,
    /// Every device on the line (unit 0): obeyed, never answered.
    Broadcast,
}

/// What a device hears although it is not meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Overheard {
    /// A whole frame for another unit.
    Foreign,
    /// A frame with a wrong checksum, or a fragment.
    Damaged,
}

/// A change of the process side. Numbers count from 1, as on the terminals.
#[derive(Clone, Debug, PartialEq)]
pub enum Stimulus {
    /// A hand switch of a relay.
    Hand { relay: u8, position: Hand },
    /// A switch with three positions, which mean what the device's mode makes of them.
    Toggle { toggle: u8, position: Toggle },
    /// The hand operation of a voltage output: volts, or `None` for automatic.
    HandVolts { output: u8, volts: Option<f64> },
    /// What is connected to an input.
    Input { input: u8, signal: Signal },
    /// Somebody presses the button of a relay, and holds it for so long.
    Press { relay: u8, held: Duration },
    /// What one of three phases carries; the other quantities stay.
    Phase { phase: u8, quantity: PhaseQuantity, amount: f64 },
    /// One of the small switches behind the front.
    Dip { switch: u8, on: bool },
    /// Somebody presses the button at the device's front.
    Button,
    /// What a sensor has around it, in the quantity's unit; of a contact 1 is open and 0 closed.
    Measure { quantity: Quantity, value: f64 },
    /// Somebody moves in front of a detector.
    Motion,
    /// Raw words in registers, or 0 and 1 in bits, of a device that is nothing but its registers.
    Set { span: Span, words: Vec<u16> },
}

/// What a sensor may measure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// % relative humidity.
    Humidity,
    /// °C.
    Temperature,
    /// ppm.
    Co2,
    /// %.
    Voc,
    /// ppm.
    Co,
    Volts,
    Milliamps,
    /// % of the volume.
    Oxygen,
    /// mbar.
    AirPressure,
    /// The difference of two pressures in Pa.
    Pressure,
    /// lx.
    Light,
    /// m/s.
    Flow,
    Door,
    Window,
    Switch,
}

impl Quantity {
    pub const ALL: [Quantity; 15] = [
        Quantity::Humidity,
        Quantity::Temperature,
        Quantity::Co2,
        Quantity::Voc,
        Quantity::Co,
        Quantity::Volts,
        Quantity::Milliamps,
        Quantity::Oxygen,
        Quantity::AirPressure,
        Quantity::Pressure,
        Quantity::Light,
        Quantity::Flow,
        Quantity::Door,
        Quantity::Window,
        Quantity::Switch,
    ];

    /// Its word in scripts.
    pub const fn name(self) -> &'static str {
        match self {
            Quantity::Humidity => "humidity",
            Quantity::Temperature => "temperature",
            Quantity::Co2 => "co2",
            Quantity::Voc => "voc",
            Quantity::Co => "co",
            Quantity::Volts => "volts",
            Quantity::Milliamps => "milliamps",
            Quantity::Oxygen => "oxygen",
            Quantity::AirPressure => "air_pressure",
            Quantity::Pressure => "pressure",
            Quantity::Light => "light",
            Quantity::Flow => "flow",
            Quantity::Door => "door",
            Quantity::Window => "window",
            Quantity::Switch => "switch",
        }
    }

    pub fn from_name(name: &str) -> Option<Quantity> {
        Quantity::ALL.into_iter().find(|quantity| quantity.name() == name)
    }

    /// Whether it is `open` or `closed` and no number.
    pub const fn is_contact(self) -> bool {
        matches!(self, Quantity::Door | Quantity::Window | Quantity::Switch)
    }
}

/// The position of a hand switch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Hand {
    Automatic,
    On,
    Off,
}

/// The position of a switch as it stands before one's eyes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Toggle {
    Up,
    Middle,
    Down,
}

/// What an input sees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Signal {
    /// Nothing connected.
    Open,
    Ohms(f64),
    Volts(f64),
    Milliamps(f64),
    /// The temperature at a sensor of the kind that the input is configured for.
    Celsius(f64),
    /// A contact, closed or open.
    Contact(bool),
    /// So many closings of a contact, one after the other.
    Pulses {
        count: u64,
        every: Duration,
    },
    /// Sets a pulse counter as if it had counted that far.
    Counter(u64),
}

impl Signal {
    /// Whether a contact is closed; `None` for what is no contact.
    pub fn contact(self) -> Option<bool> {
        match self {
            Signal::Contact(closed) => Some(closed),
            Signal::Open => Some(false),
            _ => None,
        }
    }
}

/// What there is to a phase; voltage and current are root mean squares, angles are in degrees.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PhaseQuantity {
    Volts,
    Amps,
    Hertz,
    /// How far the current comes behind its voltage.
    Lag,
    /// How far the voltage comes before that of the first phase.
    Angle,
}

/// A line's bit rate and parity.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LineSettings {
    pub baud: u32,
    pub parity: Parity,
}

impl Default for LineSettings {
    /// 19200 and even: what the specification asks for and these devices leave the factory with.
    fn default() -> LineSettings {
        LineSettings { baud: 19200, parity: Parity::Even }
    }
}

impl fmt::Display for LineSettings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.baud, self.parity)
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Parity {
    Even,
    Odd,
    None,
}

impl Parity {
    pub fn from_name(name: &str) -> Option<Parity> {
        [Parity::Even, Parity::Odd, Parity::None].into_iter().find(|parity| parity.to_string() == name)
    }
}

impl fmt::Display for Parity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Parity::Even => "even",
            Parity::Odd => "odd",
            Parity::None => "none",
        })
    }
}

/// The devices there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Model {
    MrDo4,
    MrSi4,
    MrAi8,
    MrDi4,
    MrDi10,
    MrDoa4,
    MrAo4,
    MrAop4,
    MrCi4,
    MrTo4,
    MrDio42,
    MrTp,
    MrLd6,
    MrAio42,
    MrSm3,
    MrMultiIo,
    BtrMrAi8,
    Relay8,
    AnalogOut8,
    AnalogIn8,
    Sensor,
}

impl Model {
    pub const ALL: [Model; 21] = [
        Model::MrDo4,
        Model::MrSi4,
        Model::MrAi8,
        Model::MrDi4,
        Model::MrDi10,
        Model::MrDoa4,
        Model::MrAo4,
        Model::MrAop4,
        Model::MrCi4,
        Model::MrTo4,
        Model::MrDio42,
        Model::MrTp,
        Model::MrLd6,
        Model::MrAio42,
        Model::MrSm3,
        Model::MrMultiIo,
        Model::BtrMrAi8,
        Model::Relay8,
        Model::AnalogOut8,
        Model::AnalogIn8,
        Model::Sensor,
    ];

    /// The identifier of the device's profile.
    pub const fn id(self) -> &'static str {
        match self {
            Model::MrDo4 => "metz-connect/mr-do4",
            Model::MrSi4 => "metz-connect/mr-si4",
            Model::MrAi8 => "metz-connect/mr-ai8",
            Model::MrDi4 => "metz-connect/mr-di4",
            Model::MrDi10 => "metz-connect/mr-di10",
            Model::MrDoa4 => "metz-connect/mr-doa4",
            Model::MrAo4 => "metz-connect/mr-ao4",
            Model::MrAop4 => "metz-connect/mr-aop4",
            Model::MrCi4 => "metz-connect/mr-ci4",
            Model::MrTo4 => "metz-connect/mr-to4",
            Model::MrDio42 => "metz-connect/mr-dio42",
            Model::MrTp => "metz-connect/mr-tp",
            Model::MrLd6 => "metz-connect/mr-ld6",
            Model::MrAio42 => "metz-connect/mr-aio42",
            Model::MrSm3 => "metz-connect/mr-sm3",
            Model::MrMultiIo => "metz-connect/mr-multi-io",
            Model::BtrMrAi8 => "btr/mr-ai8",
            Model::Relay8 => "fuehlersysteme/relay8",
            Model::AnalogOut8 => "fuehlersysteme/analog-out8",
            Model::AnalogIn8 => "fuehlersysteme/analog-in8",
            Model::Sensor => "fuehlersysteme/sensor",
        }
    }

    pub fn from_id(id: &str) -> Option<Model> {
        Model::ALL.into_iter().find(|model| model.id() == id)
    }

    /// A device fresh from the factory, its switches set to the line's settings, switched on at `now`.
    pub fn build(self, now: Time, line: LineSettings) -> Box<dyn SimulatedDevice> {
        match self {
            Model::MrDo4 => Box::new(MetzConnect::new(now, line, MrDo4::new(now))),
            Model::MrSi4 => Box::new(MetzConnect::new(now, line, MrSi4::new(now))),
            Model::MrAi8 => Box::new(MetzConnect::new(now, line, MrAi8::new(now))),
            Model::MrDi4 => Box::new(MetzConnect::new(now, line, MrDi4::new(now))),
            Model::MrDi10 => Box::new(MetzConnect::new(now, line, MrDi10::new(now))),
            Model::MrDoa4 => Box::new(MetzConnect::new(now, line, MrDoa4::new(now))),
            Model::MrAo4 => Box::new(MetzConnect::new(now, line, MrAo4::new(now))),
            Model::MrAop4 => Box::new(MetzConnect::new(now, line, MrAop4::new(now))),
            Model::MrCi4 => Box::new(MetzConnect::new(now, line, MrCi4::new(now))),
            Model::MrTo4 => Box::new(MetzConnect::new(now, line, MrTo4::new(now))),
            Model::MrDio42 => Box::new(MetzConnect::new(now, line, MrDio42::new(now))),
            Model::MrTp => Box::new(MetzConnect::new(now, line, MrTp::new(now))),
            Model::MrLd6 => Box::new(MetzConnect::new(now, line, MrLd6::new(now))),
            Model::MrAio42 => Box::new(MetzConnect::new(now, line, MrAio42::new(now))),
            Model::MrSm3 => Box::new(MetzConnect::new(now, line, MrSm3::new(now))),
            Model::MrMultiIo => Box::new(MetzConnect::new(now, line, MrMultiIo::new(now))),
            Model::BtrMrAi8 => Box::new(MetzConnect::new(now, line, btr::mr_ai8::MrAi8::new(now))),
            Model::Relay8 => Box::new(Relay8::new(now)),
            Model::AnalogOut8 => Box::new(AnalogOut8::new(now)),
            Model::AnalogIn8 => Box::new(AnalogIn8::new(now)),
            Model::Sensor => Box::new(Sensor::new(now)),
        }
    }
}

impl fmt::Display for Model {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.id())
    }
}

/// One device to simulate: `metz-connect/mr-do4@18`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeviceAt {
    pub model: Model,
    /// 1 to 247.
    pub unit: u8,
}

impl std::str::FromStr for DeviceAt {
    type Err = String;

    fn from_str(text: &str) -> Result<DeviceAt, String> {
        let (id, unit) = text
            .split_once('@')
            .ok_or_else(|| format!("`{text}` names no unit; write it as `{}@18`", Model::MrDo4))?;
        let known = || Model::ALL.map(|model| format!("`{model}`")).join(", ");
        let model =
            Model::from_id(id).ok_or_else(|| format!("`{id}` is not simulated; there are {}", known()))?;
        Ok(DeviceAt { model, unit: parse_unit(unit)? })
    }
}

/// Reads `18`.
pub fn parse_unit(text: &str) -> Result<u8, String> {
    match text.parse() {
        Ok(unit @ 1..=247) => Ok(unit),
        _ => Err(format!("`{text}` is not a unit; a unit is 1 to 247")),
    }
}

impl fmt::Display for DeviceAt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}@{}", self.model, self.unit)
    }
}

/// Which device answers at a unit, as a person calls it: `metz-connect/mr-do4@18`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// The identifier of the device's profile.
    pub device: String,
    /// 1 to 247.
    pub unit: u8,
}

impl From<DeviceAt> for Place {
    fn from(at: DeviceAt) -> Place {
        Place { device: at.model.id().into(), unit: at.unit }
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}@{}", self.device, self.unit)
    }
}

/// Takes the next `N` words of a stored EEPROM whose length has been checked.
pub(super) fn take_words<const N: usize>(words: &mut &[u16]) -> [u16; N] {
    let mut taken = [0; N];
    let (head, tail) = words.split_at(N.min(words.len()));
    taken[..head.len()].copy_from_slice(head);
    *words = tail;
    taken
}

/// Whether a stored EEPROM has as many words as this device's.
pub(super) fn check_eeprom_length(words: &[u16], wanted: usize) -> Result<(), String> {
    if words.len() == wanted {
        Ok(())
    } else {
        Err(format!("the EEPROM has {} words; this device has {wanted}", words.len()))
    }
}

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::*;

    use super::*;

    /// A request that is likely to be understood, or any bytes at all.
    fn pdu() -> impl Strategy<Value = Vec<u8>> {
        let small = || prop_oneof![0u16..130, 0u16..900, any::<u16>()];
        let words = (small(), vec(any::<u16>(), 0..12)).prop_map(|(first, words)| {
            let mut pdu = vec![16];
            pdu.extend(first.to_be_bytes());
            pdu.extend((words.len() as u16).to_be_bytes());
            pdu.push(words.len() as u8 * 2);
            pdu.extend(words.iter().flat_map(|word| word.to_be_bytes()));
            pdu
        });
        let two_words = (1u8..=8, small(), small()).prop_map(|(function, first, second)| {
            [vec![function], first.to_be_bytes().to_vec(), second.to_be_bytes().to_vec()].concat()
        });
        prop_oneof![two_words, words, vec(any::<u8>(), 1..260)]
    }

    fn stimulus() -> impl Strategy<Value = Stimulus> {
        let signal = prop_oneof![
            Just(Signal::Open),
            (-1e9..1e9f64).prop_map(Signal::Ohms),
            (-1e3..1e3f64).prop_map(Signal::Volts),
            (-1e3..1e3f64).prop_map(Signal::Milliamps),
            (-1e3..1e3f64).prop_map(Signal::Celsius),
            any::<bool>().prop_map(Signal::Contact),
            (0..1000u64, 1..100u64)
                .prop_map(|(count, every)| Signal::Pulses { count, every: Duration::from_millis(every) }),
            any::<u64>().prop_map(Signal::Counter),
        ];
        prop_oneof![
            Just(Stimulus::Button),
            Just(Stimulus::Motion),
            (proptest::sample::select(&Quantity::ALL[..]), -1e9..1e9f64)
                .prop_map(|(quantity, value)| Stimulus::Measure { quantity, value }),
            (0..6u8).prop_map(|relay| Stimulus::Hand { relay, position: Hand::On }),
            (0..4u8, proptest::sample::select(&[Toggle::Up, Toggle::Middle, Toggle::Down]))
                .prop_map(|(toggle, position)| Stimulus::Toggle { toggle, position }),
            (0..6u8, 0.0..12.0f64)
                .prop_map(|(output, volts)| Stimulus::HandVolts { output, volts: Some(volts) }),
            (0..6u8, 0..2000u64)
                .prop_map(|(relay, held)| Stimulus::Press { relay, held: Duration::from_millis(held) }),
            (0..5u8, 0..5usize, -200.0..1200.0f64).prop_map(|(phase, quantity, amount)| {
                let quantity = [
                    PhaseQuantity::Volts,
                    PhaseQuantity::Amps,
                    PhaseQuantity::Hertz,
                    PhaseQuantity::Lag,
                    PhaseQuantity::Angle,
                ][quantity];
                Stimulus::Phase { phase, quantity, amount }
            }),
            (0..10u8, any::<bool>()).prop_map(|(switch, on)| Stimulus::Dip { switch, on }),
            (0..14u8, signal).prop_map(|(input, signal)| Stimulus::Input { input, signal }),
        ]
    }

    proptest! {
        #[test]
        fn whatever_is_asked_of_a_device_it_answers_with_that_function_or_its_exception(
            model in proptest::sample::select(&Model::ALL),
            eeprom in vec(any::<u16>(), 200),
            steps in vec((0..5000u64, pdu(), stimulus()), 1..40),
        ) {
            let mut now = Time::from_millis(1);
            let mut device = model.build(now, LineSettings::default());
            // Any memory of the right length is taken, or refused, and never a reason to fall over.
            let length = device.eeprom().len();
            let words: Vec<u16> = eeprom.iter().copied().cycle().take(length).collect();
            let _ = device.load_eeprom(now, &words);
            for (pause, pdu, stimulus) in steps {
                now += Duration::from_millis(pause);
                let _ = device.stimulate(now, &stimulus);
                device.advance(now);
                if let Some(reply) = device.request(now, Addressed::Unit, &pdu) {
                    prop_assert!((2..=253).contains(&reply.len()), "{:02X?}: {:02X?}", pdu, reply);
                    // Function 6 of these boards refuses a value with the exception of function 4.
                    let is_board = model.id().starts_with("fuehlersysteme/");
                    let excepted = is_board && pdu[0] == 6 && reply == [0x84, 3];
                    prop_assert!(reply[0] | 0x80 == pdu[0] | 0x80 || excepted, "{:02X?}: {:02X?}", pdu, reply);
                }
                prop_assert_eq!(device.eeprom().len(), length);
                device.outputs();
            }
        }
    }
}
