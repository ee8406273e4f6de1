//! One blind of MR-TP: its buttons, its commands and the wind, each of which gives pulses (pages 41
//! and 42).

use crate::engine::time::{Duration, Time};
use crate::simulator::metz_connect::mr_tp::relay::{Relay, Stage};

/// What goes on at each level of priority. The levels do not know of each other: the time of a pulse
/// passes whether or not a higher level lets it through.
#[derive(Default)]
pub struct Blind {
    wind: Option<Pulse>,
    command: Option<Pulse>,
    /// Behind the pulse of command 4 comes another that turns the slats.
    rotates: bool,
    press: Option<Press>,
    button: Option<ButtonPulse>,
}

/// The relay in one stage until some time.
#[derive(Clone, Copy)]
struct Pulse {
    stage: Stage,
    ends_at: Time,
}

/// A button that is held.
#[derive(Clone, Copy)]
struct Press {
    stage: Stage,
    since: Time,
    /// It ended a long pulse, and makes no short one.
    stopped: bool,
    /// It has been held for long enough to begin a long pulse.
    long: bool,
}

#[derive(Clone, Copy)]
enum ButtonPulse {
    /// `ends_at` is not there while the end of the press decides.
    Short {
        stage: Stage,
        starts_at: Time,
        ends_at: Option<Time>,
    },
    Long(Pulse),
}

/// What the registers say of pulses.
#[derive(Clone, Copy)]
pub struct Settings {
    pub kind: Kind,
    /// Registers 4 to 7.
    pub held: Duration,
    pub short: Duration,
    pub long: Duration,
    pub rotation: Duration,
}

/// How long a button's short pulse is: bits 8 to 10 of the mode register (page 42).
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// 0: "endet nach Zeitkonstante-Kurz".
    Time,
    /// 1: "endet nach Minimum von Zeitkonstante-Kurz und Tastendruck".
    ShorterOfTimeAndPress,
    /// 2: "endet nach Maximum von Zeitkonstante-Kurz und Tastendruck".
    LongerOfTimeAndPress,
    /// 3: "endet mit Tastendruck".
    Press,
    /// 4: "beginnt am Ende des Tastendrucks, endet nach Zeitkonstante-Kurz".
    TimeAfterPress,
    /// 7: "Impuls dauert so lange wie der Tastendruck", and "kein langer Impuls".
    PressAlone,
}

/// The levels: "Wert wird mit Relaiszustand rückgemeldet" (page 41).
pub mod level {
    pub const BUTTONS: u16 = 0;
    pub const COMMAND: u16 = 1;
    pub const CONTACTS: u16 = 2;
    pub const TOGGLE: u16 = 3;
}

impl Kind {
    /// 5 and 6 are in no table.
    pub fn from_bits(bits: u16) -> Option<Kind> {
        match bits {
            0 => Some(Kind::Time),
            1 => Some(Kind::ShorterOfTimeAndPress),
            2 => Some(Kind::LongerOfTimeAndPress),
            3 => Some(Kind::Press),
            4 => Some(Kind::TimeAfterPress),
            7 => Some(Kind::PressAlone),
            _ => None,
        }
    }
}

impl Blind {
    /// What the highest level that rules wants of the relay. Each level but the buttons rules also
    /// when its pulse is over: that is the "Sperre".
    pub fn demand(&self, command: u16, wind: bool) -> (u16, Option<Stage>) {
        if wind || self.wind.is_some() {
            (level::CONTACTS, self.wind.map(|pulse| pulse.stage))
        } else if command != 0 {
            (level::COMMAND, self.command.map(|pulse| pulse.stage))
        } else {
            let stage = self.button.map(|pulse| match pulse {
                ButtonPulse::Short { stage, .. } | ButtonPulse::Long(Pulse { stage, .. }) => stage,
            });
            (level::BUTTONS, stage)
        }
    }

    /// "Das Aktivieren des Wind-Kontakts wirkt dabei wie das Jalousie-Kommando 2." The pulse is made
    /// whole even if the wind drops; then the levels below rule again.
    pub fn wind_rises(&mut self, now: Time, relay: &Relay, settings: &Settings) {
        self.wind = Some(pulse(now, relay, Stage::One, settings.long));
    }

    /// "Der Ablauf eines Kommandos beginnt, wenn der Register-Inhalt geändert wird."
    pub fn begin_command(&mut self, now: Time, command: u16, relay: &Relay, settings: &Settings) {
        let stage = match command {
            2 => Some(Stage::One),
            3 | 4 => Some(Stage::Two),
            _ => None,
        };
        self.command = stage.map(|stage| pulse(now, relay, stage, settings.long));
        self.rotates = command == 4;
    }

    /// A button is pressed. During a long pulse that is how it "endet bei kurzem Tastendruck
    /// vorzeitig": here it ends at once, and the press makes no short pulse of its own; held on, it
    /// is a long press like any other. Of two buttons the one pressed last counts.
    pub fn press(&mut self, now: Time, stage: Stage, relay: &Relay, settings: &Settings) {
        let stopped = matches!(self.button, Some(ButtonPulse::Long(_)));
        self.press = Some(Press { stage, since: now, stopped, long: false });
        if stopped {
            self.button = None;
            return;
        }
        let starts_at = relay.ready_at(now, stage);
        let ends_at = match settings.kind {
            Kind::Time | Kind::ShorterOfTimeAndPress => Some(starts_at + settings.short),
            Kind::LongerOfTimeAndPress | Kind::Press | Kind::PressAlone => None,
            Kind::TimeAfterPress => return,
        };
        self.button = Some(ButtonPulse::Short { stage, starts_at, ends_at });
    }

    pub fn release(&mut self, now: Time, stage: Stage, relay: &Relay, settings: &Settings) {
        let Some(press) = self.press.filter(|press| press.stage == stage) else { return };
        self.press = None;
        if settings.kind == Kind::TimeAfterPress {
            if !press.stopped && !press.long {
                let starts_at = relay.ready_at(now, stage);
                let ends_at = Some(starts_at + settings.short);
                self.button = Some(ButtonPulse::Short { stage, starts_at, ends_at });
            }
        } else if let Some(ButtonPulse::Short { starts_at, ends_at, .. }) = &mut self.button {
            match settings.kind {
                Kind::Time | Kind::TimeAfterPress => {}
                Kind::LongerOfTimeAndPress => *ends_at = Some(*starts_at + settings.short),
                Kind::ShorterOfTimeAndPress | Kind::Press | Kind::PressAlone => *ends_at = Some(now),
            }
        }
    }

    /// A higher level locks the buttons. A press that was made meanwhile stays without effect.
    pub fn forget_buttons(&mut self) {
        self.press = None;
        self.button = None;
    }

    /// Begins and ends what is due.
    pub fn pass(&mut self, now: Time, relay: &Relay, settings: &Settings) {
        let is_over = |pulse: Pulse| pulse.ends_at <= now;
        if self.wind.is_some_and(is_over) {
            self.wind = None;
        }
        while self.command.is_some_and(is_over) {
            let rotates = std::mem::take(&mut self.rotates);
            // The slats of a closed blind are turned by opening it a little.
            self.command = rotates.then(|| pulse(now, relay, Stage::One, settings.rotation));
        }
        let long_at = self.long_at(settings);
        if let Some(press) = self.press.as_mut().filter(|_| long_at.is_some_and(|at| at <= now)) {
            press.long = true;
            self.button = Some(ButtonPulse::Long(pulse(now, relay, press.stage, settings.long)));
        }
        if self.button.and_then(ButtonPulse::ends_at).is_some_and(|ends_at| ends_at <= now) {
            self.button = None;
        }
    }

    /// When [`Blind::pass`] has something to do next.
    pub fn wakes_at(&self, settings: &Settings) -> Option<Time> {
        let pulses = [self.wind, self.command].into_iter().flatten().map(|pulse| pulse.ends_at);
        pulses.chain(self.long_at(settings)).chain(self.button.and_then(ButtonPulse::ends_at)).min()
    }

    /// When the button that is held will have been held long enough.
    fn long_at(&self, settings: &Settings) -> Option<Time> {
        let press = self.press.filter(|press| !press.long && settings.kind != Kind::PressAlone);
        press.map(|press| press.since + settings.held)
    }
}

impl ButtonPulse {
    fn ends_at(self) -> Option<Time> {
        match self {
            ButtonPulse::Short { ends_at, .. } => ends_at,
            ButtonPulse::Long(pulse) => Some(pulse.ends_at),
        }
    }
}

/// A pulse as long as it says, not counting the pause that the relay makes before it: with a pause as
/// long as the factory's short pulse none would be left of that.
fn pulse(now: Time, relay: &Relay, stage: Stage, length: Duration) -> Pulse {
    Pulse { stage, ends_at: relay.ready_at(now, stage) + length }
}
