//! Temperature sensors: which resistance or voltage each has at which temperature.
//!
//! The manual names the sensors and their ranges (chapter MR-AI8, page 52) and gives no curves. Here
//! they are by formula: platinum by IEC 60751; NI1000-TK5000 and TK6180 (DIN 43760) and KTY81 by
//! their makers' polynomials; BALCO by a parabola through a published table (918.53 Ω at 32 °F,
//! 978.06 at 60, 1000 at 70); LM235 by 10 mV/K; NTCs by R25 and a usual B, which for all but CAREL's
//! are not taken from the makers' sheets, so that their curves are near, not exact.

/// One of the sensors that bits 6 to 1 of a configuration register choose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sensor {
    curve: Curve,
    /// The range of the manual, in °C; what lies outside is told as its end.
    range: (f64, f64),
}

/// How a sensor behaves.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Curve {
    /// Resistance at 0 °C.
    Platinum(f64),
    NickelTk5000,
    NickelTk6180,
    /// Resistance at 70 °F.
    Balco(f64),
    /// Resistance at 25 °C, and the two constants of the bend above 100 °C.
    Kty81(f64, f64, f64),
    /// Resistance at 25 °C, and B.
    Ntc(f64, f64),
    /// 10 mV/K, measured with the pull-up.
    Lm235,
}

/// Which quantity a sensor gives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    Ohms,
    Volts,
}

impl Sensor {
    /// The sensor with this number, 0 to 13; all others are reserved.
    pub fn numbered(number: u16) -> Option<Sensor> {
        let usual = (-50.0, 150.0);
        let (curve, range) = match number {
            0 => (Curve::Platinum(100.0), usual),
            1 => (Curve::Platinum(500.0), usual),
            2 => (Curve::Platinum(1000.0), usual),
            3 => (Curve::NickelTk5000, usual),
            4 => (Curve::NickelTk6180, usual),
            5 => (Curve::Balco(500.0), usual),
            6 => (Curve::Kty81(1000.0, 3.42e-8, 3.7), usual),
            7 => (Curve::Kty81(2000.0, 1.096e-6, 3.0), usual),
            8 => (Curve::Ntc(1800.0, 3500.0), usual),
            9 => (Curve::Ntc(5000.0, 3500.0), usual),
            10 => (Curve::Ntc(10_000.0, 3976.0), usual),
            11 => (Curve::Ntc(20_000.0, 4200.0), usual),
            12 => (Curve::Lm235, (-40.0, 120.0)),
            13 => (Curve::Ntc(10_000.0, 3435.0), (-50.0, 110.0)),
            _ => return None,
        };
        Some(Sensor { curve, range })
    }

    pub fn quantity(self) -> Quantity {
        if self.curve == Curve::Lm235 { Quantity::Volts } else { Quantity::Ohms }
    }

    /// The temperature for a resistance in Ω or a voltage in V, kept within the range.
    pub fn celsius(self, measured: f64) -> f64 {
        let (mut low, mut high) = self.range;
        let rising = self.electric(high) > self.electric(low);
        // Every curve is strictly monotone in its range, so that halving it finds the temperature;
        // fifty halvings of 200 K are fine enough for anything.
        for _ in 0..50 {
            let middle = (low + high) / 2.0;
            if (self.electric(middle) < measured) == rising {
                low = middle;
            } else {
                high = middle;
            }
        }
        // A millionth of a degree is nothing that a device tells; 0.0 °C is.
        ((low + high) / 2.0 * 1e6).round() / 1e6 + 0.0
    }

    /// Keeps a temperature that was set directly within the range.
    pub fn limit(self, celsius: f64) -> f64 {
        celsius.clamp(self.range.0, self.range.1)
    }

    /// Ω or V at a temperature.
    fn electric(self, t: f64) -> f64 {
        match self.curve {
            Curve::Platinum(at_0) => {
                let below = if t < 0.0 { -4.183e-12 * (t - 100.0) * t.powi(3) } else { 0.0 };
                at_0 * (1.0 + 3.9083e-3 * t - 5.775e-7 * t * t + below)
            }
            Curve::NickelTk5000 => {
                1000.0 * (1.0 + 4.427e-3 * t + 5.172e-6 * t.powi(2) + 5.585e-9 * t.powi(3))
            }
            Curve::NickelTk6180 => {
                let high = 2.805e-11 * t.powi(4) - 2e-17 * t.powi(6);
                1000.0 * (1.0 + 5.485e-3 * t + 6.65e-6 * t.powi(2) + high)
            }
            Curve::Balco(at_70_fahrenheit) => {
                let above = 1.8 * t;
                at_70_fahrenheit * (0.918_53 + 2.076_02e-3 * above + 1.7877e-6 * above * above)
            }
            Curve::Kty81(at_25, bend, power) => {
                let d = t - 25.0;
                let above = (t - 100.0).max(0.0);
                at_25 * (1.0 + 7.874e-3 * d + 1.874e-5 * d * d - bend * libm::pow(above, power))
            }
            Curve::Ntc(at_25, b) => at_25 * libm::exp(b / (t + 273.15) - b / 298.15),
            Curve::Lm235 => (t + 273.15) / 100.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points of data sheets and standards, in Ω or V; `tolerance` in °C.
    #[test]
    fn sensors_agree_with_their_published_tables() {
        for (number, measured, celsius, tolerance) in [
            (0, 100.0, 0.0, 0.001),
            (0, 138.51, 100.0, 0.02),
            (0, 80.31, -50.0, 0.02),
            (1, 692.55, 100.0, 0.02),
            (2, 1077.9, 20.0, 0.02),
            (3, 1500.0, 100.0, 0.05),
            (4, 1617.8, 100.0, 0.05),
            (4, 742.6, -50.0, 0.1),
            (5, 500.0, 21.11, 0.05),
            (6, 1696.0, 100.0, 0.05),
            (6, 815.0, 0.0, 0.1),
            (6, 2211.0, 150.0, 0.1),
            (7, 4280.0, 150.0, 0.1),
            (8, 1800.0, 25.0, 0.001),
            (11, 20_000.0, 25.0, 0.001),
            (12, 2.9315, 20.0, 0.001),
            // One B for the whole range is a degree off at its sides.
            (13, 27_280.0, 0.0, 1.2),
            (13, 4161.0, 50.0, 1.2),
        ] {
            let sensor = Sensor::numbered(number).expect("a sensor");
            let told = sensor.celsius(measured);
            assert!((told - celsius).abs() <= tolerance, "sensor {number}: {measured} gives {told}");
        }
    }

    #[test]
    fn what_lies_outside_a_range_is_told_as_its_end() {
        for number in 0..14 {
            let sensor = Sensor::numbered(number).expect("a sensor");
            let (low, high) = sensor.range;
            let mut ends = [sensor.celsius(0.0), sensor.celsius(1e9)];
            ends.sort_by(f64::total_cmp);
            assert!((ends[0] - low).abs() < 1e-6 && (ends[1] - high).abs() < 1e-6, "{number}: {ends:?}");
            for celsius in [low, 0.0, 25.0, 99.0, high] {
                let back = sensor.celsius(sensor.electric(celsius));
                assert!((back - celsius).abs() < 1e-6, "sensor {number} at {celsius}: {back}");
            }
        }
        assert_eq!(Sensor::numbered(14), None);
    }
}
