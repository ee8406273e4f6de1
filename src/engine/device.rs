//! The device model that everything below speaks: a profile, expanded and checked.
//!
//! Nothing here is serialized. What a profile's author typed is `profile::file`; what is true is here.

mod form;
mod line;
mod presentation;
mod thing;
mod wire;
mod write;

pub use form::{Case, Decimals, Encoding, Form, Kind, Names, Order, Unit};
pub use line::{LineControl, SettingsBy, SettingsRegister};
pub use presentation::{Category, Platform, Presentation, sentence};
pub use thing::{PRESS, State, Thing, ThingCommand, ThingKind};
pub use wire::{Forbidden, Intervals, Limits, Quirks, Wire};
pub use write::{OutOfRange, Write, WriteFunction, WriteRule};

use crate::engine::address::{Address, Span};
use crate::engine::value::Decimal;

/// Index into [`Device::points`].
pub type PointIndex = usize;

/// One type of device, or one device with its owner's wishes applied.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Device {
    /// The profile's identifier, `metz-connect/mr-do4`; `inline` for points from the configuration.
    pub profile: String,
    pub manufacturer: String,
    pub model: String,
    /// The document and revision that the profile was written from.
    pub source: String,
    pub identify: Option<Identify>,
    pub wire: Wire,
    /// `None`: the profile does not say.
    pub line: Option<LineControl>,
    /// In the profile's order, repetitions one after the other.
    pub points: Vec<Point>,
    /// Made of points; empty for most devices.
    pub things: Vec<Thing>,
    pub left_out: Vec<LeftOut>,
}

impl Device {
    pub fn point_named(&self, name: &str) -> Option<PointIndex> {
        self.points.iter().position(|point| point.name == name)
    }
}

/// How to be sure that the right device answers at this unit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Identify {
    /// Read Device Identification (function code 43/14), objects 0 and 1; both must be equal.
    Names { vendor: String, product: String },
    /// A register: `word & mask == equals`.
    Word { at: Span, mask: u16, equals: u16 },
}

/// A span of the manual that is no point, and why.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LeftOut {
    pub span: Span,
    pub reason: String,
}

/// One thing that can be read or written.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// Expanded and unique in the device: `relay_1`, `channel_3_value`.
    pub name: String,
    /// Where it is read; for a point that is only written, where it is written.
    pub at: Address,
    /// The same value in another place; read from whichever costs less.
    pub also: Option<Address>,
    pub encoding: Encoding,
    /// What it may mean as the device is set up, where the device itself does not say: the owner names
    /// one of these.
    pub ranges: Vec<(String, Form)>,
    pub poll: Poll,
    /// It lives only while all of these hold; empty: always.
    pub when: Vec<Condition>,
    pub write: Option<Write>,
    /// The point with the longest time between two writes of this one, in its unit; 0 there: any. What
    /// the register holds is written to it again in time.
    pub heartbeat: Option<PointIndex>,
    /// It holds the number of a register of this span; what is by it is understood as the point there.
    pub refers: Option<Span>,
    /// Each flip of this bit is an event of this type; the bit itself is not told.
    pub event: Option<String>,
    /// In EEPROM: written only if it differs, seldom, and counted.
    pub persistent: bool,
    /// Reading it changes the device; it travels alone.
    pub read_clears: bool,
    /// The factory setting as the register holds it, before scale.
    pub default: Option<i128>,
    /// Points that a write to this one may change; read again after it.
    pub re_read: Vec<PointIndex>,
    /// A reading that differs less than this from the last one told is not told.
    pub deadband: Option<Decimal>,
    pub presentation: Presentation,
}

impl Point {
    /// A point that is read here as a `u16` (in a table of bits as a flag) and not written: the point
    /// from which others differ.
    pub fn new(name: &str, at: Address, poll: Poll) -> Point {
        let kind = if at.span.table().is_bits() { Kind::Bool } else { Kind::U16 };
        Point {
            name: name.into(),
            at,
            also: None,
            encoding: Encoding::Plain(Form::new(kind)),
            ranges: Vec::new(),
            poll,
            when: Vec::new(),
            write: None,
            heartbeat: None,
            refers: None,
            event: None,
            persistent: false,
            read_clears: false,
            default: None,
            re_read: Vec::new(),
            deadband: None,
            presentation: Presentation::default(),
        }
    }

    /// Whether the gateway reads this point at all by itself.
    pub fn is_read(&self) -> bool {
        self.poll != Poll::Never
    }

    /// Whether it is read only when somebody asks for it.
    pub fn is_read_on_request(&self) -> bool {
        self.poll == Poll::Never && !self.is_button()
    }

    /// Whether there is nothing to read.
    pub fn is_button(&self) -> bool {
        self.write.as_ref().is_some_and(|write| matches!(write.rule, WriteRule::Press { .. }))
    }

    /// Whether numbers are written to it, in one case at least.
    pub fn takes_numbers(&self) -> bool {
        let rule = self.write.as_ref().map(|write| &write.rule);
        let is_number = self.encoding.forms().any(Form::is_number);
        is_number && matches!(rule, Some(WriteRule::Any | WriteRule::Range { .. }))
    }

    /// The one interpretation, for a point without cases.
    pub fn plain(&self) -> Option<&Form> {
        match &self.encoding {
            Encoding::Plain(form) => Some(form),
            Encoding::Cases { .. } => None,
        }
    }

    /// The values by which it can decide about others.
    pub fn deciding_values(&self) -> Vec<(i128, String)> {
        let named = self.plain().map(Form::named_values).unwrap_or_default();
        named.into_iter().map(|(value, name)| (value, name.to_string())).collect()
    }

    /// The points that must be known before this one can be understood.
    pub fn selectors(&self) -> Vec<PointIndex> {
        let mut selectors = Vec::new();
        for form in self.encoding.forms() {
            if let Some(Decimals::By(point)) = form.decimals {
                selectors.push(point);
            }
            if let Unit::By(point) = form.unit {
                selectors.push(point);
            }
        }
        if let Encoding::Cases { by, .. } = self.encoding {
            selectors.push(by);
        }
        selectors.extend(self.when.iter().map(|condition| condition.point));
        selectors.sort_unstable();
        selectors.dedup();
        selectors
    }
}

/// That a point, whose names decide, holds one of these values.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Condition {
    pub point: PointIndex,
    /// Register values with their names.
    pub values: Vec<(i128, String)>,
}

impl Condition {
    pub fn holds(&self, raw: i128) -> bool {
        self.values.iter().any(|(value, _)| *value == raw)
    }
}

/// When a point is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Poll {
    Fast,
    Slow,
    /// After every connect, and after a write to it.
    Once,
    /// Only when asked for, or never (buttons).
    Never,
}

impl Poll {
    pub const fn name(self) -> &'static str {
        match self {
            Poll::Fast => "fast",
            Poll::Slow => "slow",
            Poll::Once => "once",
            Poll::Never => "never",
        }
    }
}
