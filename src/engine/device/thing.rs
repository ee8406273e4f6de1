//! Several points that are one thing to a person: a blind, a damper, a controller.

use crate::engine::device::{Condition, Platform, Point, PointIndex, Presentation};

/// One thing, with a name and a topic of its own beside its points'.
#[derive(Clone, Debug, PartialEq)]
pub struct Thing {
    /// Expanded and unique in the device, among its points too: `channel_1_damper`.
    pub name: String,
    pub kind: ThingKind,
    /// It lives only while all of these hold; empty: always.
    pub when: Vec<Condition>,
    /// The first whose row holds is the thing's state; if none does, the state is not known.
    pub states: Vec<State>,
    pub commands: Vec<ThingCommand>,
    /// The point with the present temperature; of a climate only.
    pub temperature: Option<PointIndex>,
    /// The point that is the wanted temperature; of a climate only.
    pub target: Option<PointIndex>,
    pub presentation: Presentation,
}

/// `opening: {position: running, drive: open}`
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct State {
    pub name: String,
    /// Points and what each must say, as it is published.
    pub row: Vec<(PointIndex, String)>,
}

/// `open: [{drive: open}]`
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ThingCommand {
    pub name: String,
    /// Points and what is written to each, one after the other, each read back before the next.
    pub orders: Vec<(PointIndex, String)>,
}

impl Thing {
    pub fn command(&self, name: &str) -> Option<&ThingCommand> {
        self.commands.iter().find(|command| command.name == name)
    }

    /// The points that its state is made of, and its target: they are shown by the thing itself.
    pub fn shows(&self, point: PointIndex) -> bool {
        let in_rows = || self.states.iter().flat_map(|state| &state.row).any(|(shown, _)| *shown == point);
        self.target == Some(point) || in_rows()
    }

    /// Whether it is there whenever the point is, as far as their conditions say.
    pub fn lives_with(&self, point: &Point) -> bool {
        self.when.is_empty() || self.when == point.when
    }

    /// Whether some command of it writes this point.
    pub fn commands_point(&self, point: PointIndex) -> bool {
        self.commands.iter().flat_map(|command| &command.orders).any(|(written, _)| *written == point)
    }
}

/// What things there are, by Home Assistant's platforms.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum ThingKind {
    Cover,
    Valve,
    Climate,
    Button,
}

impl ThingKind {
    pub const fn platform(self) -> Platform {
        match self {
            ThingKind::Cover => Platform::Cover,
            ThingKind::Valve => Platform::Valve,
            ThingKind::Climate => Platform::Climate,
            ThingKind::Button => Platform::Button,
        }
    }

    pub const fn name(self) -> &'static str {
        self.platform().name()
    }

    /// The states that it can have; a climate's are its modes.
    pub const fn states(self) -> &'static [&'static str] {
        match self {
            ThingKind::Cover | ThingKind::Valve => &["open", "closed", "opening", "closing", "stopped"],
            ThingKind::Climate => CLIMATE_MODES,
            ThingKind::Button => &[],
        }
    }

    /// The commands that it can obey.
    pub const fn commands(self) -> &'static [&'static str] {
        match self {
            ThingKind::Cover | ThingKind::Valve => &["open", "close", "stop"],
            ThingKind::Climate => CLIMATE_MODES,
            ThingKind::Button => &[PRESS],
        }
    }
}

/// The one command of a button, in profiles.
pub const PRESS: &str = "press";

const CLIMATE_MODES: &[&str] = &["off", "heat", "cool", "auto", "heat_cool", "dry", "fan_only"];
