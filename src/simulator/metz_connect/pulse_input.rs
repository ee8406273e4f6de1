//! A pulse input with its counter of 48 bits and the meter reading calculated from it, as MR-SI4 has
//! four (pages 16 to 20) and MR-Multi I/O one (pages 96 to 101).

use crate::engine::time::{Duration, Time};
use crate::simulator::device::Signal;

/// One input with its counter and its settings. All of it outlives a restart: the tables mark the
/// holding registers as EEPROM, and of the pulse counter the manual wants that it behaves exactly
/// like the meter behind it, which forgets nothing either.
#[derive(Clone, Copy, Debug)]
pub struct PulseInput {
    /// IZ, 48 bits.
    pub pulses: u64,
    /// IT: the counter at the press of the button, 48 bits.
    pub at_button: u64,
    /// AZ.
    pub initial: u32,
    /// IE.
    pub pulses_per_unit: u16,
    /// WI and WU.
    pub current_factor: u16,
    pub voltage_factor: u16,
    /// WP: false is formula 0, true is formula 1.
    pub factors_only_pulses: bool,
    /// ZS, high and low byte.
    digits: u8,
    decimals: u8,
    /// TA.
    pub button_enabled: bool,
    /// How long the contact has been closed.
    pub closed_for: Duration,
    /// Up to when `closed_for` has been counted.
    passed: Time,
    contact: Contact,
}

/// What is connected to an input.
#[derive(Clone, Copy, Debug)]
struct Contact {
    closed: bool,
    /// When the closing of a pulse ends.
    opens_at: Option<Time>,
    last_counted: Option<Time>,
    /// Closings still to come, from this one on.
    next_pulse: Time,
    remaining: u64,
    every: Duration,
}

/// The bits of IZ and IT.
pub const COUNTER_MASK: u64 = 0xFFFF_FFFF_FFFF;
const OPEN: Contact = Contact {
    closed: false,
    opens_at: None,
    last_counted: None,
    next_pulse: Time(0),
    remaining: 0,
    every: PULSE_DISTANCE,
};
/// "Alle 60 Millisekunden kann ein Impuls vom Stromzähler kommen": what comes faster is not counted.
const PULSE_DISTANCE: Duration = Duration::from_millis(60);
/// How long a simulated pulse keeps the contact closed, as the S0 interface asks for.
const PULSE_LENGTH: Duration = Duration::from_millis(30);
const DIGITS_MAX: u8 = 9;
const DECIMALS_MAX: u8 = 3;

impl PulseInput {
    /// An open input with the settings of the factory.
    pub fn new(now: Time) -> PulseInput {
        PulseInput {
            pulses: 0,
            at_button: 0,
            initial: 0,
            pulses_per_unit: 1,
            current_factor: 1,
            voltage_factor: 1,
            factors_only_pulses: false,
            digits: 7,
            decimals: 1,
            button_enabled: true,
            closed_for: Duration::ZERO,
            passed: now,
            contact: OPEN,
        }
    }

    /// BZ, by the manual's "Details zur Berechnung" (pages 20 and 101): everything in a wide integer, the
    /// division by IE behind all multiplications, the digits cut off last.
    pub fn meter_reading(&self) -> u32 {
        let factors = u128::from(self.current_factor) * u128::from(self.voltage_factor);
        // IZ and IT have 48 bits, and so has their difference before it is made wider.
        let counted = u128::from(self.pulses.wrapping_sub(self.at_button) & COUNTER_MASK);
        let power = |exponent: u8| 10u128.pow(exponent.into());
        let scaled = counted * factors * power(self.decimals);
        // The manual allows every IE and does not say what 0 gives: here the pulses then count nothing.
        let counted = scaled.checked_div(u128::from(self.pulses_per_unit)).unwrap_or(0);
        let initial = u128::from(self.initial) * if self.factors_only_pulses { 1 } else { factors };
        ((counted + initial) % power(self.digits)) as u32
    }

    /// ZS.
    pub fn format(&self) -> u16 {
        u16::from_be_bytes([self.digits, self.decimals])
    }

    /// "größere Werte werden auf 9 begrenzt", "auf 3 begrenzt" (pages 17 and 98).
    pub fn set_format(&mut self, word: u16) {
        let [digits, decimals] = word.to_be_bytes();
        self.digits = digits.min(DIGITS_MAX);
        self.decimals = decimals.min(DECIMALS_MAX);
    }

    pub fn is_closed(&self) -> bool {
        self.contact.closed
    }

    pub fn press_button(&mut self) {
        if self.button_enabled {
            self.at_button = self.pulses;
        }
    }

    pub fn advance(&mut self, now: Time) {
        while self.contact.remaining > 0 && self.contact.next_pulse <= now {
            let at = self.contact.next_pulse;
            self.pass(at);
            self.close(at);
            let contact = &mut self.contact;
            contact.remaining -= 1;
            contact.next_pulse = at + contact.every;
            contact.opens_at = Some(at + PULSE_LENGTH.min(contact.every / 2));
        }
        self.pass(now);
    }

    /// A meter goes on pulsing while the device starts; what came without power is not counted.
    pub fn restart(&mut self, now: Time) {
        while self.contact.remaining > 0 && self.contact.next_pulse <= now {
            self.contact.remaining -= 1;
            self.contact.next_pulse += self.contact.every;
        }
        self.contact.last_counted = None;
        self.passed = now;
    }

    /// Connects a contact or pulses, or sets the counter; `device` is for the error.
    pub fn connect(&mut self, now: Time, signal: Signal, device: &str) -> Result<(), String> {
        match signal {
            Signal::Open | Signal::Contact(false) => {
                self.contact = Contact { last_counted: self.contact.last_counted, ..OPEN };
            }
            Signal::Contact(true) => {
                if !self.contact.closed {
                    self.close(now);
                }
                self.contact.remaining = 0;
                self.contact.opens_at = None;
            }
            Signal::Pulses { count, every } if !every.is_zero() => {
                self.contact.remaining = count;
                self.contact.every = every;
                self.contact.next_pulse = now;
                self.advance(now);
            }
            Signal::Counter(count) if count <= COUNTER_MASK => self.pulses = count,
            Signal::Pulses { .. } => return Err("pulses need a distance, such as `every 80ms`".into()),
            Signal::Counter(_) => return Err(format!("a counter ends at {COUNTER_MASK}")),
            _ => return Err(format!("an input of {device} takes a contact, pulses or a counter")),
        }
        Ok(())
    }

    /// Lets time pass in which no closing begins.
    fn pass(&mut self, until: Time) {
        let opens_at = self.contact.opens_at.filter(|opens_at| *opens_at <= until);
        if self.contact.closed {
            self.closed_for += opens_at.unwrap_or(until).since(self.passed);
        }
        if opens_at.is_some() {
            self.contact.closed = false;
            self.contact.opens_at = None;
        }
        self.passed = until;
    }

    /// The contact closes: that is what is counted.
    fn close(&mut self, now: Time) {
        self.contact.closed = true;
        if self.contact.last_counted.is_none_or(|last| now.since(last) >= PULSE_DISTANCE) {
            self.pulses = self.pulses.wrapping_add(1) & COUNTER_MASK;
            self.contact.last_counted = Some(now);
        }
    }
}
