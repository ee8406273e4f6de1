//! The mode Fire_Damper: the bus switches the relay, and the device only watches (pages 26 and 27).

use crate::engine::time::Time;
use crate::simulator::metz_connect::mr_dio42::mode::Position;
use crate::simulator::metz_connect::mr_dio42::movement::{Limits, Movement};

/// What is known of the damper.
#[derive(Clone, Copy, Debug, Default)]
pub struct FireDamper {
    /// "Nur einer der unten aufgeführten Einzelfehler wird gemeldet, danach ist die Fehlererkennung
    /// gesperrt."
    pub fault: Option<Fault>,
    /// FaultReset: stays 1 until the faults are reset, which is at the next of the 100 ms.
    pub reset_asked: bool,
    movement: Movement,
}

/// The single faults, in the order of their bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// FaultRun.
    Runtime,
    /// FaultMan.
    Manipulation,
    /// FaultCom.
    Update,
}

/// What is looked at every 100 ms.
#[derive(Clone, Copy, Debug)]
pub struct View {
    pub contacts: [bool; 2],
    pub relay: bool,
    pub by_hand: bool,
    /// No message has come for too long.
    pub is_forgotten: bool,
}

impl FireDamper {
    pub fn tick(&mut self, now: Time, view: View, limits: Limits) {
        let position = Position::of_limit_switches(view.contacts);
        self.movement.follow(now, view.relay);
        self.movement.arrive(position);
        if self.reset_asked {
            // A fault that lasts is found again 100 ms later, so that its absence can be seen.
            self.reset_asked = false;
            self.fault = None;
        } else if self.fault.is_none() {
            self.fault = self.detect(now, view, position, limits);
        }
    }

    /// Manipulation before the position, which with both contacts closed is never as expected.
    fn detect(&self, now: Time, view: View, position: Position, limits: Limits) -> Option<Fault> {
        if view.contacts == [true, true] {
            Some(Fault::Manipulation)
        } else if !view.by_hand && self.movement.is_astray(now, position, limits) {
            Some(Fault::Runtime)
        } else if view.is_forgotten {
            Some(Fault::Update)
        } else {
            None
        }
    }
}
