//! The device model that everything below speaks: a profile, expanded and checked.
//!
//! Nothing here is serialized. What a profile's author typed is `profile::file`; what is true is here.

mod thing;

pub use thing::{PRESS, State, Thing, ThingCommand, ThingKind};

use crate::engine::address::{Address, Span};
use crate::engine::time::{Date, Duration};
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
    /// In the profile's order, repetitions one after the other.
    pub points: Vec<Point>,
    /// Made of points; empty for most devices.
    pub things: Vec<Thing>,
    pub left_out: Vec<LeftOut>,
}

/// How to be sure that the right device answers at this unit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Identify {
    /// Read Device Identification (function code 43/14), objects 0 and 1; both must be equal.
    Names { vendor: String, product: String },
    /// A register: `word & mask == equals`.
    Word { at: Span, mask: u16, equals: u16 },
}

/// How the device behaves on the wire.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Wire {
    pub limits: Limits,
    /// A read must lie within one of these; empty: anywhere.
    pub readable: Vec<Span>,
    /// Never inside any request, not even as a gap.
    pub forbidden: Vec<Forbidden>,
    pub intervals: Intervals,
    /// At least this long is waited for a reply; the bus may say more.
    pub response_timeout: Option<Duration>,
    /// So long after the link has come up nothing is asked on it.
    pub connect_delay: Duration,
    pub quirks: Quirks,
    /// The point that holds the time after which the device falls back to safe outputs unless a
    /// message reaches it.
    pub watchdog: Option<PointIndex>,
}

/// What one request may ask.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Registers in one read, at most 125.
    pub read_registers: u16,
    /// Coils or discrete inputs in one read, at most 2000.
    pub read_bits: u16,
    /// Registers in one write, at most 123.
    pub write_registers: u16,
    /// Unused addresses that may be read over; `None`: as many as are cheaper than a second
    /// request. 0 forbids it.
    pub gap: Option<u16>,
    /// Silence that the device needs before each request, beyond the line's own.
    pub delay: Duration,
}

impl Default for Limits {
    fn default() -> Limits {
        Limits {
            read_registers: 125,
            read_bits: 2000,
            write_registers: 123,
            gap: None,
            delay: Duration::ZERO,
        }
    }
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Forbidden {
    pub span: Span,
    pub reason: String,
}

/// The periods of the poll classes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Intervals {
    pub fast: Duration,
    pub slow: Duration,
}

impl Default for Intervals {
    fn default() -> Intervals {
        Intervals { fast: Duration::from_secs(1), slow: Duration::from_secs(30) }
    }
}

/// Where a device departs from the Modbus specification.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Quirks {
    /// A value out of range is clamped, used, and answered with exception 3.
    pub clamps_with_exception: bool,
    /// An exception may carry another function code than the request (0x84 to function 6).
    pub exception_function_varies: bool,
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
        let is_number = match &self.encoding {
            Encoding::Plain(form) => form.is_number(),
            Encoding::Cases { cases, .. } => {
                cases.iter().filter_map(|case| case.form.as_ref()).any(Form::is_number)
            }
        };
        is_number && matches!(rule, Some(WriteRule::Any | WriteRule::Range { .. }))
    }

    /// The one interpretation, for a point without cases.
    pub fn plain(&self) -> Option<&Form> {
        match &self.encoding {
            Encoding::Plain(form) => Some(form),
            Encoding::Cases { .. } => None,
        }
    }

    /// The points that must be known before this one can be understood.
    pub fn selectors(&self) -> Vec<PointIndex> {
        let mut selectors = Vec::new();
        let mut of_form = |form: &Form| {
            if let Some(Decimals::By(point)) = form.decimals {
                selectors.push(point);
            }
            if let Unit::By(point) = form.unit {
                selectors.push(point);
            }
        };
        match &self.encoding {
            Encoding::Plain(form) => of_form(form),
            Encoding::Cases { by, cases } => {
                cases.iter().filter_map(|case| case.form.as_ref()).for_each(&mut of_form);
                selectors.push(*by);
            }
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

/// How the words of a point are understood.
#[expect(clippy::large_enum_variant, reason = "nearly every point is plain, and a device has few")]
#[derive(Clone, Debug, PartialEq)]
pub enum Encoding {
    Plain(Form),
    /// Another point decides. The case is the one whose `key` that point's register holds.
    Cases {
        by: PointIndex,
        cases: Vec<Case>,
    },
}

#[derive(Clone, Debug, PartialEq)]
pub struct Case {
    /// What the deciding register holds.
    pub key: i128,
    /// The deciding point's name for it: `pt1000`.
    pub name: String,
    /// `None`: there is no reading in this case.
    pub form: Option<Form>,
}

/// One interpretation of a point's words.
#[derive(Clone, Debug, PartialEq)]
pub struct Form {
    pub kind: Kind,
    /// How many values of this kind stand one behind the other: 1, or the length of an array.
    pub elements: u16,
    pub order: Order,
    /// value = register × scale ÷ 10^decimals + offset
    pub scale: Decimal,
    pub offset: Decimal,
    pub decimals: Option<Decimals>,
    /// The value counts seconds since then and stands for a moment.
    pub since: Option<Date>,
    pub unit: Unit,
    /// A difference between two values (an offset, a hysteresis): 5 K are not 41 °F.
    pub difference: bool,
    /// Names of register values. With [`Kind::Bool`] they are what `ON` and `OFF` are not needed for.
    pub names: Names,
    /// Every register value without a name means what this one means.
    pub others: Option<i128>,
    /// Register values that stand for "no reading", and why.
    pub invalid: Vec<(i128, String)>,
    /// What the manual gives as the measuring range, in the unit; for temperatures in °C.
    pub range: Option<(Decimal, Decimal)>,
}

impl Form {
    /// A plain `u16` register, or a flag for `Kind::Bool`: the form from which others differ.
    pub fn new(kind: Kind) -> Form {
        Form {
            kind,
            elements: 1,
            order: Order::Abcd,
            scale: Decimal::ONE,
            offset: Decimal::ZERO,
            decimals: None,
            since: None,
            unit: Unit::None,
            difference: false,
            names: Names::None,
            others: None,
            invalid: Vec::new(),
            range: None,
        }
    }

    /// Whether it is a quantity, of which some values may have names: nothing else has a unit or digits.
    pub fn is_number(&self) -> bool {
        let is_enumeration = matches!(self.names, Names::All(_));
        self.kind != Kind::Bool && !self.kind.is_text() && !is_enumeration && self.since.is_none()
    }
}

/// What the bits mean before scale and names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// One bit, or a register that holds 0 or 1 and nothing else.
    Bool,
    U16,
    I16,
    U32,
    I32,
    U48,
    U64,
    I64,
    F32,
    F64,
    /// Four decimal digits in a register.
    Bcd16,
    /// Eight decimal digits in two registers.
    Bcd32,
    /// Characters, two in a register; padded with zeros or spaces.
    Text {
        registers: u16,
    },
    /// A letter in the high byte, a number in the low one: `R017`.
    LetterNumber,
    /// Decimal digits DDMMY: 1018 is 01.01.2018.
    DayMonthYear,
}

impl Kind {
    /// How many registers a value of this kind occupies.
    pub const fn registers(self) -> u16 {
        match self {
            Kind::U32 | Kind::I32 | Kind::F32 | Kind::Bcd32 => 2,
            Kind::U48 => 3,
            Kind::U64 | Kind::I64 | Kind::F64 => 4,
            Kind::Text { registers } => registers,
            _ => 1,
        }
    }

    /// Its word in profiles: `u16`, `text 8`.
    pub fn name(self) -> String {
        match self {
            Kind::Bool => "bool".into(),
            Kind::U16 => "u16".into(),
            Kind::I16 => "i16".into(),
            Kind::U32 => "u32".into(),
            Kind::I32 => "i32".into(),
            Kind::U48 => "u48".into(),
            Kind::U64 => "u64".into(),
            Kind::I64 => "i64".into(),
            Kind::F32 => "f32".into(),
            Kind::F64 => "f64".into(),
            Kind::Bcd16 => "bcd16".into(),
            Kind::Bcd32 => "bcd32".into(),
            Kind::Text { registers } => format!("text {registers}"),
            Kind::LetterNumber => "letter_number".into(),
            Kind::DayMonthYear => "ddmmy".into(),
        }
    }

    /// The smallest and largest integer of this kind; `None` for floats and texts.
    pub const fn integer_range(self) -> Option<(i128, i128)> {
        match self {
            Kind::Bool => Some((0, 1)),
            Kind::U16 => Some((0, u16::MAX as i128)),
            Kind::I16 => Some((i16::MIN as i128, i16::MAX as i128)),
            Kind::U32 => Some((0, u32::MAX as i128)),
            Kind::I32 => Some((i32::MIN as i128, i32::MAX as i128)),
            Kind::U48 => Some((0, (1 << 48) - 1)),
            Kind::U64 => Some((0, u64::MAX as i128)),
            Kind::I64 => Some((i64::MIN as i128, i64::MAX as i128)),
            Kind::Bcd16 => Some((0, 9_999)),
            Kind::Bcd32 => Some((0, 99_999_999)),
            _ => None,
        }
    }

    pub const fn is_float(self) -> bool {
        matches!(self, Kind::F32 | Kind::F64)
    }

    pub const fn is_text(self) -> bool {
        matches!(self, Kind::Text { .. } | Kind::LetterNumber | Kind::DayMonthYear)
    }
}

/// Byte and word order. The letters are the bytes from the most significant; their order is that on
/// the wire. For three and four registers the pattern goes on: words ascending or descending, bytes
/// straight or swapped.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Order {
    /// High word first, high byte first: what Modbus recommends.
    #[default]
    Abcd,
    /// Low word first, high byte first.
    Cdab,
    /// High word first, low byte first.
    Badc,
    /// Low word first, low byte first.
    Dcba,
}

impl Order {
    pub const fn low_word_first(self) -> bool {
        matches!(self, Order::Cdab | Order::Dcba)
    }

    pub const fn swaps_bytes(self) -> bool {
        matches!(self, Order::Badc | Order::Dcba)
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decimals {
    Fixed(u8),
    /// As many as that point says.
    By(PointIndex),
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Unit {
    None,
    Fixed(String),
    /// The name of that point's present value is the unit: `°C` or `°F`.
    By(PointIndex),
}

/// Names for register values.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Names {
    None,
    /// An enumeration: any other value is unknown.
    All(Vec<(i128, String)>),
    /// A number, of which some values have a name (11111 is `automatic`), readable and writable.
    Some(Vec<(i128, String)>),
}

impl Names {
    pub fn list(&self) -> &[(i128, String)] {
        match self {
            Names::None => &[],
            Names::All(list) | Names::Some(list) => list,
        }
    }
}

/// How a point is written.
#[derive(Clone, Debug, PartialEq)]
pub struct Write {
    /// Where; differs from [`Point::at`] when the device reads and writes at different places.
    pub at: Address,
    /// The only function that works here; `None`: 5 for a coil, 15 for several, 6 for a register,
    /// 16 for several.
    pub with: Option<WriteFunction>,
    pub rule: WriteRule,
    /// So long the device needs until what was written can be read back.
    pub settle: Duration,
    /// The device acts only when the content changes: this register value stands between two equal ones.
    pub on_change: Option<i128>,
    pub out_of_range: OutOfRange,
}

impl Write {
    pub fn new(at: Address, rule: WriteRule) -> Write {
        Write {
            at,
            with: None,
            rule,
            settle: Duration::ZERO,
            on_change: None,
            out_of_range: OutOfRange::Refuse,
        }
    }
}

/// What becomes of a command with a number beyond the limits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum OutOfRange {
    #[default]
    Refuse,
    /// The limit is written, and the outcome says so.
    Clamp,
}

impl OutOfRange {
    pub const fn name(self) -> &'static str {
        match self {
            OutOfRange::Refuse => "refuse",
            OutOfRange::Clamp => "clamp",
        }
    }
}

/// The four function codes that write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WriteFunction {
    SingleCoil,
    SingleRegister,
    MultipleCoils,
    MultipleRegisters,
}

impl WriteFunction {
    pub const fn code(self) -> u8 {
        match self {
            WriteFunction::SingleCoil => 5,
            WriteFunction::SingleRegister => 6,
            WriteFunction::MultipleCoils => 15,
            WriteFunction::MultipleRegisters => 16,
        }
    }
}

/// What may be written.
#[derive(Clone, Debug, PartialEq)]
pub enum WriteRule {
    /// Any flag, any of the names, any text that fits, any finite float, or whatever the present
    /// case's kind can hold.
    Any,
    /// A number from `min` to `max`, in the unit (with `Decimals::By`: as the register holds it).
    /// Names of [`Names::Some`] may be written beside it. Without a step: any that the register can hold.
    Range { min: Decimal, max: Decimal, step: Option<Decimal> },
    /// These of the names.
    Names(Vec<String>),
    /// A button: this word and nothing else. A self-clearing one may read back as zero.
    Press { word: u16, self_clearing: bool },
}

/// What the facts above cannot tell about how a point should look. All of it is optional.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Presentation {
    pub platform: Option<Platform>,
    pub name: Option<String>,
    pub device_class: Option<String>,
    pub state_class: Option<String>,
    pub category: Option<Category>,
    pub icon: Option<String>,
    pub enabled: Option<bool>,
}

/// Home Assistant's platforms: those that a single point can be, and those of things.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Platform {
    Sensor,
    BinarySensor,
    Switch,
    Number,
    Select,
    Button,
    Text,
    Event,
    Cover,
    Valve,
    Climate,
}

impl Platform {
    pub const ALL: [Platform; 11] = [
        Platform::Sensor,
        Platform::BinarySensor,
        Platform::Switch,
        Platform::Number,
        Platform::Select,
        Platform::Button,
        Platform::Text,
        Platform::Event,
        Platform::Cover,
        Platform::Valve,
        Platform::Climate,
    ];

    pub const fn name(self) -> &'static str {
        match self {
            Platform::Sensor => "sensor",
            Platform::BinarySensor => "binary_sensor",
            Platform::Switch => "switch",
            Platform::Number => "number",
            Platform::Select => "select",
            Platform::Button => "button",
            Platform::Text => "text",
            Platform::Event => "event",
            Platform::Cover => "cover",
            Platform::Valve => "valve",
            Platform::Climate => "climate",
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Category {
    Config,
    Diagnostic,
}

impl Category {
    pub const fn name(self) -> &'static str {
        match self {
            Category::Config => "config",
            Category::Diagnostic => "diagnostic",
        }
    }
}
