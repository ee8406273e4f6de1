//! How the words of a point are understood.

use super::PointIndex;
use crate::engine::time::Date;
use crate::engine::value::Decimal;

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

impl Encoding {
    /// Every interpretation.
    pub fn forms(&self) -> impl Iterator<Item = &Form> {
        let (plain, cases) = match self {
            Encoding::Plain(form) => (Some(form), [].as_slice()),
            Encoding::Cases { cases, .. } => (None, cases.as_slice()),
        };
        plain.into_iter().chain(cases.iter().filter_map(|case| case.form.as_ref()))
    }
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

    /// The register values that are told by a name; a flag's are `OFF` and `ON`.
    pub fn named_values(&self) -> Vec<(i128, &str)> {
        match self.kind {
            Kind::Bool => vec![(0, "OFF"), (1, "ON")],
            _ => self.names.list().iter().map(|(value, name)| (*value, name.as_str())).collect(),
        }
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

    /// One value's words, the most significant first, to this order; and from it back again.
    pub fn turn(self, mut words: Vec<u16>) -> Vec<u16> {
        if self.low_word_first() {
            words.reverse();
        }
        if self.swaps_bytes() {
            words.iter_mut().for_each(|word| *word = word.swap_bytes());
        }
        words
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
