//! Where a value lives on a device: `input 32`, `holding 16.0..7`, `coil 0..3`.

use std::fmt;

/// The four Modbus tables. Registers count from 0, as on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Table {
    /// Coils: bits that can be read and written (function codes 1, 5, 15).
    Coil,
    /// Discrete inputs: bits that can only be read (2).
    Discrete,
    /// Input registers: words that can only be read (4).
    Input,
    /// Holding registers: words that can be read and written (3, 6, 16).
    Holding,
}

impl Table {
    /// All tables, in the order of their names in a plan.
    pub const ALL: [Table; 4] = [Table::Coil, Table::Discrete, Table::Input, Table::Holding];

    /// The table's word in profiles, plans and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Table::Coil => "coil",
            Table::Discrete => "discrete",
            Table::Input => "input",
            Table::Holding => "holding",
        }
    }

    /// The table called `name`, if there is one.
    pub fn from_name(name: &str) -> Option<Table> {
        Table::ALL.into_iter().find(|table| table.name() == name)
    }

    /// Whether an address of this table is one bit (and not a register of sixteen).
    pub const fn is_bits(self) -> bool {
        matches!(self, Table::Coil | Table::Discrete)
    }

    /// Whether this table can be written at all.
    pub const fn is_writable(self) -> bool {
        matches!(self, Table::Coil | Table::Holding)
    }

    /// The function code that reads this table.
    pub const fn read_function(self) -> u8 {
        match self {
            Table::Coil => 1,
            Table::Discrete => 2,
            Table::Holding => 3,
            Table::Input => 4,
        }
    }
}

impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

/// A run of registers (or bits) in one table. Never empty, never past 65535.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Span {
    table: Table,
    first: u16,
    last: u16,
}

impl Span {
    /// The span from `first` to `last`, both included; `None` if `last` is below `first`.
    pub const fn new(table: Table, first: u16, last: u16) -> Option<Span> {
        if last < first { None } else { Some(Span { table, first, last }) }
    }

    /// The span of `count` addresses from `first`; `None` if it is empty or passes 65535.
    pub const fn with_count(table: Table, first: u16, count: u16) -> Option<Span> {
        if count == 0 {
            return None;
        }
        match first.checked_add(count - 1) {
            Some(last) => Some(Span { table, first, last }),
            None => None,
        }
    }

    /// The one address `at`.
    pub const fn single(table: Table, at: u16) -> Span {
        Span { table, first: at, last: at }
    }

    pub const fn table(self) -> Table {
        self.table
    }

    pub const fn first(self) -> u16 {
        self.first
    }

    pub const fn last(self) -> u16 {
        self.last
    }

    /// How many addresses; 65536 is possible, hence the wider type.
    pub const fn count(self) -> u32 {
        self.last as u32 - self.first as u32 + 1
    }

    /// Whether every address of `other` lies in this span.
    pub fn contains(self, other: Span) -> bool {
        self.table == other.table && self.first <= other.first && other.last <= self.last
    }

    /// Whether the two spans share an address.
    pub fn overlaps(self, other: Span) -> bool {
        self.table == other.table && self.first <= other.last && other.first <= self.last
    }

    /// The smallest span that holds both; `None` for two tables.
    pub fn hull(self, other: Span) -> Option<Span> {
        if self.table != other.table {
            return None;
        }
        Some(Span { table: self.table, first: self.first.min(other.first), last: self.last.max(other.last) })
    }
}

impl fmt::Display for Span {
    /// `holding 16` or `holding 16..23`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.first == self.last {
            write!(f, "{} {}", self.table, self.first)
        } else {
            write!(f, "{} {}..{}", self.table, self.first, self.last)
        }
    }
}

/// A run of bits inside one register; bit 0 is the lowest.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Bits {
    low: u8,
    high: u8,
}

impl Bits {
    /// Bits `low` to `high`, both included; `None` unless `low <= high <= 15`.
    pub const fn new(low: u8, high: u8) -> Option<Bits> {
        if low <= high && high <= 15 { Some(Bits { low, high }) } else { None }
    }

    pub const fn low(self) -> u8 {
        self.low
    }

    pub const fn high(self) -> u8 {
        self.high
    }

    /// How many bits, 1 to 16.
    pub const fn width(self) -> u8 {
        self.high - self.low + 1
    }

    /// The bits' places in the register: bits 4..7 are `0x00F0`.
    pub const fn mask(self) -> u16 {
        ((1u32 << self.width()) - 1) as u16 * (1 << self.low)
    }

    /// The field's value, shifted down.
    pub const fn extract(self, word: u16) -> u16 {
        (word & self.mask()) >> self.low
    }

    /// `word` with this field set to `value` and every other bit kept.
    pub const fn insert(self, word: u16, value: u16) -> u16 {
        (word & !self.mask()) | ((value << self.low) & self.mask())
    }
}

/// Where one value lives: a span, and perhaps a field of bits inside its only register.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Address {
    /// The registers or bits that this value occupies.
    pub span: Span,
    /// A field inside the register; only with a span of one register.
    pub bits: Option<Bits>,
}

impl Address {
    /// Whether both addresses have a bit in common.
    pub fn overlaps(self, other: Address) -> bool {
        self.span.overlaps(other.span)
            && match (self.bits, other.bits) {
                (Some(a), Some(b)) => a.mask() & b.mask() != 0,
                _ => true,
            }
    }
}

impl fmt::Display for Address {
    /// `holding 16.0..7`, `holding 68.0`, `input 0..1`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.span)?;
        match self.bits {
            None => Ok(()),
            Some(bits) if bits.low == bits.high => write!(f, ".{}", bits.low),
            Some(bits) => write!(f, ".{}..{}", bits.low, bits.high),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_field_of_bits_is_taken_and_put_back_without_touching_its_neighbours() {
        let high_byte = Bits::new(8, 15).expect("a valid field");
        assert_eq!(high_byte.mask(), 0xFF00);
        assert_eq!(high_byte.extract(0x0703), 7);
        assert_eq!(high_byte.insert(0x0703, 9), 0x0903);
        assert_eq!(Bits::new(0, 15).expect("a valid field").mask(), 0xFFFF);
        assert_eq!(Bits::new(4, 16), None);
    }

    #[test]
    fn a_span_is_never_empty_and_never_passes_the_last_register() {
        assert_eq!(Span::with_count(Table::Input, 0, 0), None);
        assert_eq!(Span::with_count(Table::Input, 65535, 2), None);
        assert_eq!(Span::new(Table::Input, 0, 65535).map(Span::count), Some(65536));
    }
}
