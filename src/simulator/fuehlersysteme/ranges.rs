//! Ranges that several boards' tables have: measured numbers, pairs of which one is smaller than the
//! other, and what an analog terminal carries (chapters 6.1 to 6.3).

/// The system code's low byte has a bit for each terminal: "gesetzt bei Stromausgang", "für Stromeingang".
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Terminal {
    /// 0 to 10 V, told as 0 to 1000.
    Voltage,
    /// 4 to 20 mA, told as 400 to 2000.
    Current,
}

const NUMBER_MAX: i16 = 9999;

impl Terminal {
    /// The terminal with this number, which counts from 0.
    pub fn numbered(current: u8, number: usize) -> Terminal {
        if current >> number & 1 == 1 { Terminal::Current } else { Terminal::Voltage }
    }

    /// The hundredths of a volt or a milliampere nearest to `value` that the terminal carries.
    pub fn limit(self, value: f64) -> u16 {
        let (low, high) = self.span();
        value.round().clamp(low, high) as u16
    }

    /// The hundredths at so many parts of the span, 0 to 1.
    pub fn at(self, part: f64) -> u16 {
        let (low, high) = self.span();
        self.limit(low + (high - low) * part)
    }

    /// How many parts of the span so many hundredths are, 0 to 1.
    pub fn part(self, hundredths: u16) -> f64 {
        let (low, high) = self.span();
        (f64::from(hundredths) - low) / (high - low)
    }

    /// Hundredths as a person reads them: `12.00 mA`.
    pub fn text(self, hundredths: u16) -> String {
        let unit = if self == Terminal::Current { "mA" } else { "V" };
        format!("{:.2} {unit}", f64::from(hundredths) / 100.0)
    }

    fn span(self) -> (f64, f64) {
        match self {
            Terminal::Voltage => (0.0, 1000.0),
            Terminal::Current => (400.0, 2000.0),
        }
    }
}

/// "-9999 ... 9999".
pub fn number(word: u16) -> u16 {
    (word as i16).clamp(-NUMBER_MAX, NUMBER_MAX) as u16
}

/// A number that has to stay smaller than `upper`.
pub fn number_below(word: u16, upper: i16) -> u16 {
    (number(word) as i16).min(upper.saturating_sub(1)) as u16
}

/// A number that has to stay greater than `lower`.
pub fn number_above(word: u16, lower: i16) -> u16 {
    (number(word) as i16).max(lower.saturating_add(1)) as u16
}
