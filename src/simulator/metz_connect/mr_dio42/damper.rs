//! The modes Motorized, Motor and LimitSwitch: alarms, their acknowledgement, and what they make of
//! the relay (pages 27 to 34).

use crate::engine::time::{Duration, Time};
use crate::simulator::metz_connect::mr_dio42::mode::{Mode, Motor, Position};
use crate::simulator::metz_connect::mr_dio42::movement::{Limits, Movement, TENTH};

/// A damper, or two without motors that share a channel.
#[derive(Clone, Copy, Debug)]
pub struct Damper {
    /// ActuDrive.
    pub drive: Position,
    /// AlarmCode.
    pub alarm: Alarm,
    /// "Alarm-Reset": the self-holding by the fire position is interrupted.
    resetting: bool,
    movement: Movement,
    /// From when RcvHeartBeat counts.
    fed: Time,
}

/// AlarmCode: the first stays until it is acknowledged (page 28).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Alarm {
    Ok = 1,
    Runtime = 3,
    Manipulation = 4,
    Update = 5,
    /// The (first) damper is in its fire position.
    Fire = 6,
    /// The second damper is in its fire position.
    SecondFire = 7,
}

/// DriveTime, TurnOffTime and RcvHeartBeat.
#[derive(Clone, Copy, Debug)]
pub struct Times {
    pub limits: Limits,
    /// In tenths of a second; 0 is off.
    pub heartbeat: u16,
}

impl Damper {
    /// "Initialisierung nach dem Einschalten / Rücksetzen" (pages 32 to 34).
    pub fn new(now: Time, mode: Mode) -> Damper {
        Damper {
            drive: mode.motor().map_or(Position::Close, Motor::normal),
            alarm: Alarm::Ok,
            resetting: true,
            movement: Movement::default(),
            fed: now,
        }
    }

    /// ActuDrive has been written: that is what RcvHeartBeat waits for, whatever the value.
    pub fn write_drive(&mut self, now: Time, motor: Motor, drive: Position) {
        // "Bei Steuerung über ActuDrive gelten die letzte und erste Zeile" of the table: the way back
        // from the safe position begins with the alarm reset that page 31 otherwise has for alarms.
        let comes_back = drive == motor.normal() && self.drive != drive;
        self.resetting |= comes_back && !motor.drive_alarms && self.alarm == Alarm::Ok;
        self.drive = drive;
        self.fed = now;
    }

    /// AlarmCode has been written with OK. The alarm reset begins only where the normal position is
    /// already in ActuDrive: "wird erst die normale Position in ActuDrive geschrieben und danach
    /// AlarmCode auf OK rückgesetzt" (page 30).
    pub fn acknowledge(&mut self, now: Time, motor: Option<Motor>) {
        let wants_normal = motor.is_some_and(|motor| self.drive == motor.normal());
        self.resetting |= self.alarm != Alarm::Ok && wants_normal;
        if self.alarm == Alarm::Update {
            self.feed(now);
        }
        self.alarm = Alarm::Ok;
    }

    /// RcvHeartBeat counts anew: "Die Überwachung startet auch, wenn der Fehler rückgesetzt wird oder
    /// RcvHeartBeat ungleich 0 gesetzt wird" (page 32).
    pub fn feed(&mut self, now: Time) {
        self.fed = now;
    }

    /// Looks at the contacts, reports what is wrong, and tells the relay's state, which was `relay`.
    pub fn tick(&mut self, now: Time, mode: Mode, contacts: [bool; 2], times: Times, relay: bool) -> bool {
        let Some(motor) = mode.motor() else {
            if self.alarm == Alarm::Ok {
                self.alarm = alarm_without_motor(mode, contacts);
            }
            // "Das Relais ist dauernd ausgeschaltet" (page 34).
            return false;
        };
        let position = Position::of_limit_switches(contacts);
        self.movement.arrive(position);
        if self.alarm == Alarm::Ok {
            self.alarm = self.detect(now, motor, contacts, times);
        }
        // "Er endet, wenn die normale Position erreicht ist oder bei einem Fehler" (page 32).
        if self.alarm != Alarm::Ok || position == motor.normal() {
            self.resetting = false;
        }
        let relay = self.relay(motor, is_in_fire_position(motor, contacts), relay);
        self.movement.follow(now, relay);
        relay
    }

    /// What is wrong, in the order of the picture on page 29; the fire position only where there is "noch
    /// kein anderer Alarm-Code" (page 30).
    fn detect(&self, now: Time, motor: Motor, contacts: [bool; 2], times: Times) -> Alarm {
        let heartbeat: Duration = TENTH * times.heartbeat.into();
        if contacts == [true, true] {
            Alarm::Manipulation
        } else if self.movement.is_overdue(now, times.limits) {
            Alarm::Runtime
        } else if times.heartbeat > 0 && now.since(self.fed) >= heartbeat {
            Alarm::Update
        } else if is_in_fire_position(motor, contacts) && self.is_fire_an_alarm(motor) {
            Alarm::Fire
        } else {
            Alarm::Ok
        }
    }

    /// Not on the way to the normal position; and in the modes _2 not where ActuDrive wants it.
    fn is_fire_an_alarm(&self, motor: Motor) -> bool {
        let wants_normal = self.drive == motor.normal();
        !(self.resetting && wants_normal) && (motor.drive_alarms || wants_normal)
    }

    /// The tables of pages 32 to 34, from the top to the bottom. They have no row for an alarm whose
    /// fire position is over: there the relay stays as it was.
    fn relay(&self, motor: Motor, is_fire: bool, before: bool) -> bool {
        let opens = |position: Position| position == Position::Open;
        if self.resetting && self.drive == motor.normal() && self.alarm == Alarm::Ok {
            return opens(motor.normal());
        }
        if is_fire && (motor.drive_alarms || self.drive == motor.normal()) {
            return opens(motor.safe);
        }
        match self.alarm {
            Alarm::Runtime | Alarm::Update => opens(motor.safe),
            Alarm::Manipulation => false,
            Alarm::Ok => opens(self.drive),
            Alarm::Fire | Alarm::SecondFire => before,
        }
    }
}

/// "Klappe nicht AUF" or "Klappe nicht ZU", by the one contact that says so (page 30). Pages 33 and 34
/// paraphrase it as "ActuPos = close, running", which with both contacts closed would be the fire
/// position as well; but then no Manipulation could switch the relay of a Motorized_SafetyOpen off,
/// which its table and page 31 ask for.
fn is_in_fire_position(motor: Motor, [open, closed]: [bool; 2]) -> bool {
    if motor.safe == Position::Close { !open } else { !closed }
}

/// The fire position and the manipulation of dampers without motors (pages 28, 30 and 31).
fn alarm_without_motor(mode: Mode, contacts: [bool; 2]) -> Alarm {
    match (mode, contacts) {
        (Mode::LimitSwitchOpenClose, [true, true]) => Alarm::Manipulation,
        (_, [false, _]) => Alarm::Fire,
        (Mode::LimitSwitchOpen | Mode::LimitSwitchClose, [true, false]) => Alarm::SecondFire,
        _ => Alarm::Ok,
    }
}

#[cfg(test)]
mod tests;
