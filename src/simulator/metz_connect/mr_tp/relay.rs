//! A relay of MR-TP: off, or in one of two stages with a pause between them (page 40).

use crate::engine::time::{Duration, Time};

/// One relay.
pub struct Relay {
    wanted: Option<Stage>,
    stage: Option<Stage>,
    /// The stage that it was in last.
    last: Option<Stage>,
    off_since: Time,
}

/// Contact 11-14 or 31-34, and contact 11-24 or 31-44.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Opens a blind.
    One,
    /// Closes a blind.
    Two,
}

/// "Beim Umschalten der Relaisausgänge zwischen Stufe 1 und Stufe 2 eine Pause von 0,5 Sekunden
/// Aus-Zustand." A relay that has been off meanwhile is taken to have had as much of it.
const PAUSE: Duration = Duration::from_millis(500);

impl Relay {
    pub fn new(now: Time) -> Relay {
        Relay { wanted: None, stage: None, last: None, off_since: now }
    }

    /// The contact that is closed.
    pub fn stage(&self) -> Option<Stage> {
        self.stage
    }

    /// Switches as far as the pause allows.
    pub fn drive(&mut self, now: Time, wanted: Option<Stage>) {
        self.wanted = wanted;
        if self.stage.is_some() && self.stage != wanted {
            self.last = self.stage.take();
            self.off_since = now;
        }
        if let Some(stage) = wanted {
            if self.ready_at(now, stage) <= now {
                self.stage = wanted;
            }
        }
    }

    /// When it would be in this stage if it were driven there from now on.
    pub fn ready_at(&self, now: Time, stage: Stage) -> Time {
        match (self.stage, self.last) {
            (Some(other), _) if other != stage => now + PAUSE,
            (None, Some(last)) if last != stage => now.max(self.off_since + PAUSE),
            _ => now,
        }
    }

    /// When the pause ends that it waits for.
    pub fn wakes_at(&self) -> Option<Time> {
        (self.stage != self.wanted).then(|| self.off_since + PAUSE)
    }
}

impl Stage {
    /// Two bits of the registers: "0: Aus, 2: Stufe-1 (Öffnen), 3: Stufe-2 (Schließen)"; 1 is off as
    /// well where the bus writes it (pages 36 and 37).
    pub fn from_bits(bits: u16) -> Option<Stage> {
        match bits & 3 {
            2 => Some(Stage::One),
            3 => Some(Stage::Two),
            _ => None,
        }
    }

    pub fn bits(stage: Option<Stage>) -> u16 {
        match stage {
            None => 0,
            Some(Stage::One) => 2,
            Some(Stage::Two) => 3,
        }
    }
}
