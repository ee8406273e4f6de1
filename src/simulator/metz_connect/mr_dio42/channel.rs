//! One channel: two inputs, a relay with a hand switch, and the mode that connects them.

use crate::engine::time::{Duration, Time};
use crate::simulator::device::Hand;
use crate::simulator::metz_connect::mr_dio42::damper::{Damper, Times};
use crate::simulator::metz_connect::mr_dio42::fire_damper::{FireDamper, View};
use crate::simulator::metz_connect::mr_dio42::mode::{Mode, Position};
use crate::simulator::metz_connect::mr_dio42::movement::{Limits, TENTH};

/// A channel as its mode has it.
pub struct Channel {
    pub settings: Settings,
    pub hand: Hand,
    /// The inputs as the device has last looked at them.
    pub seen: [bool; 2],
    /// RelaySet: "Beabsichtigter Schaltzustand".
    pub wanted: bool,
    /// "Tatsächlicher Schaltzustand".
    pub relay: bool,
    /// "Ursache des Schaltzustands": the hand switch.
    pub by_hand: bool,
    pub fire_damper: FireDamper,
    pub damper: Damper,
}

/// What the channel keeps in the EEPROM.
#[derive(Clone, Copy, Debug)]
pub struct Settings {
    pub mode: Mode,
    /// DriveTime, TurnOffTime and RcvHeartBeat, in tenths of a second.
    pub drive_time: u16,
    pub turn_off_time: u16,
    pub heartbeat: u16,
    /// RelayLogic. The table does not mark it as EEPROM; but what holds "nach dem Einschalten" in
    /// Input_Logic_Control (page 34) would hold for nothing if it were forgotten.
    pub logic: u16,
}

/// Pages 23 and 25. RelayLogic has no factory setting; no input is taken to be assigned.
pub const FACTORY: Settings =
    Settings { mode: Mode::DirectControl, drive_time: 2400, turn_off_time: 350, heartbeat: 0, logic: 0 };

/// RelayLogic: inputs whose closing toggles the relay, and inputs that it follows.
const TOGGLE: u16 = 0x000F;
const FOLLOW_SHIFT: u16 = 8;

impl Channel {
    pub fn new(now: Time) -> Channel {
        Channel {
            settings: FACTORY,
            hand: Hand::Automatic,
            seen: [false; 2],
            wanted: false,
            relay: false,
            by_hand: false,
            fire_damper: FireDamper::default(),
            damper: Damper::new(now, FACTORY.mode),
        }
    }

    /// Begins with the mode that is set. Nothing is said of a change of modes; it is taken to begin
    /// like a start, except that the relay rests until the new mode switches it.
    pub fn start(&mut self, now: Time, contacts: [bool; 2], default: bool) {
        let mode = self.settings.mode;
        self.seen = contacts;
        self.wanted = if mode.begins_with_default() { default } else { self.relay };
        self.fire_damper = FireDamper::default();
        self.damper = Damper::new(now, mode);
    }

    /// The bus wants the relay on or off.
    pub fn command(&mut self, on: bool) {
        if self.settings.mode.obeys_bus() {
            self.wanted = on;
        }
    }

    /// The bus resets the faults of Fire_Damper.
    pub fn reset_faults(&mut self) {
        self.fire_damper.reset_asked |= self.settings.mode == Mode::FireDamper;
    }

    /// Reads and updates what is read and updated every 100 ms. `silence` is how long no message came.
    pub fn tick(&mut self, now: Time, contacts: [bool; 2], silence: Duration) {
        let Settings { mode, drive_time, turn_off_time, heartbeat, .. } = self.settings;
        if !mode.is_for_dampers() {
            return;
        }
        self.seen = contacts;
        let limits = Limits { open: drive_time, close: turn_off_time };
        if mode == Mode::FireDamper {
            self.switch();
            // "Maximaldauer zwischen Modbus-Kommandos" (page 27) names no register. Of those there are,
            // RcvHeartBeat is the channel's own, as the fault is, and gives the same Update_Error in the
            // other modes; BusTimeout is said to be Direct_Control's (page 24).
            let is_forgotten = heartbeat > 0 && silence >= TENTH * heartbeat.into();
            let view = View { contacts, relay: self.relay, by_hand: self.by_hand, is_forgotten };
            self.fire_damper.tick(now, view, limits);
        } else {
            self.wanted = self.damper.tick(now, mode, contacts, Times { limits, heartbeat }, self.relay);
            self.switch();
        }
    }

    /// Switches the relay as it is wanted, or as the hand switch says: "Dabei haben die Kippschalter
    /// Priorität", but "Kein Handbetrieb bei Betriebsarten Motorized und LimitSwitch" (page 22).
    pub fn switch(&mut self) {
        let hand = if self.settings.mode.has_alarm_code() { Hand::Automatic } else { self.hand };
        self.by_hand = hand != Hand::Automatic;
        self.relay = match hand {
            Hand::Automatic => self.wanted,
            Hand::On => true,
            Hand::Off => false,
        };
    }

    /// Input_Logic_Control (pages 34 and 35): all four inputs as they are, and which of them have just
    /// closed. Each closing toggles, also where two inputs close at once.
    pub fn decide(&mut self, inputs: u16, closing: u16) {
        if self.settings.mode != Mode::InputLogicControl {
            return;
        }
        let logic = self.settings.logic;
        let follow = logic >> FOLLOW_SHIFT;
        if follow != 0 {
            self.wanted = inputs & follow != 0;
        } else if (closing & logic & TOGGLE).count_ones() % 2 == 1 {
            self.wanted = !self.wanted;
        }
    }

    /// ActuDrive, ActuPos, ActuPos_a and AlarmCode. Where the mode has no such register the manual tells
    /// no value; it is 0 here, which is none of the register's own.
    pub fn report(&self) -> [u16; 4] {
        let mode = self.settings.mode;
        if !mode.has_alarm_code() {
            return [0; 4];
        }
        let alarm = self.damper.alarm as u16;
        if let Mode::LimitSwitchOpen | Mode::LimitSwitchClose = mode {
            let [first, second] = self.seen.map(|closed| Position::of_single_switch(closed) as u16);
            return [0, first, second, alarm];
        }
        let drive = if mode.motor().is_some() { self.damper.drive as u16 } else { 0 };
        [drive, Position::of_limit_switches(self.seen) as u16, 0, alarm]
    }
}

/// What RelayLogic takes of a word; `None` where it mixes the two functions: "Daher wird ein
/// Vermischen der Funktionen vom Gerät automatisch verhindert" (page 34) does not say how, and the
/// word is refused here like any other that is not allowed.
pub fn logic_from_word(word: u16) -> Option<u16> {
    let (toggle, follow) = (word & TOGGLE, word & TOGGLE << FOLLOW_SHIFT);
    if toggle != 0 && follow != 0 { None } else { Some(toggle | follow) }
}

/// What is left of RelayLogic without some inputs, bit 0 is input 1: "nicht mehr berücksichtigt und
/// vom Gerät automatisch deaktiviert" (page 35).
pub fn logic_without(logic: u16, inputs: u16) -> u16 {
    logic & !(inputs | inputs << FOLLOW_SHIFT)
}
