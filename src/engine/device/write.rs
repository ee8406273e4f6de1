//! How a point is written, and what may be written to it.

use crate::engine::address::Address;
use crate::engine::time::Duration;
use crate::engine::value::Decimal;

/// How a point is written.
#[derive(Clone, Debug, PartialEq)]
pub struct Write {
    /// Where; differs from [`Point::at`](super::Point::at) when the device reads and writes at different places.
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
    /// Names of [`Names::Some`](super::Names::Some) may be written beside it. Without a step: any that the register can hold.
    Range { min: Decimal, max: Decimal, step: Option<Decimal> },
    /// These of the names.
    Names(Vec<String>),
    /// A button: this word and nothing else. A self-clearing one may read back as zero.
    Press { word: u16, self_clearing: bool },
}

impl WriteRule {
    /// What is written to a button.
    pub const PRESS: &str = "PRESS";
}
