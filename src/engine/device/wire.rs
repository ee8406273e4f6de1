//! How a device behaves on the wire.

use super::PointIndex;
use crate::engine::address::Span;
use crate::engine::time::Duration;

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
