//! What the three phases at the terminals of MR-SM3 carry, and what can be measured of it.

use std::f64::consts::{SQRT_2, TAU};

use crate::simulator::device::PhaseQuantity;

/// One phase: voltage and current are pure sines.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Phase {
    /// Root mean squares.
    volts: f64,
    amps: f64,
    hertz: f64,
    /// Degrees by which the current comes behind its voltage.
    lag: f64,
    /// Degrees by which the voltage comes before that of phase 1.
    angle: f64,
}

/// What is measured of one phase.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Measured {
    pub volts: f64,
    pub amps: f64,
    pub volts_peak: f64,
    pub amps_peak: f64,
    pub hertz: f64,
    /// W, VA and var.
    pub active: f64,
    pub apparent: f64,
    pub reactive: f64,
    pub power_factor: f64,
    /// Degrees; see [`Phase::measure`].
    pub angle: f64,
}

/// What is measured of the three voltages together.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Together {
    /// Degrees of 2 against 1, 3 against 2 and 1 against 3.
    pub angles: [f64; PHASES],
    /// "Betrag der Spannung des Mitsystems, des Gegensystems, des Nullsystems".
    pub components: [f64; PHASES],
}

/// How many phases there are.
pub const PHASES: usize = 3;
/// "Bei einer Effektivspannung < 25 V werden … die Messwerte mit 0 gemeldet" (page 84).
pub const VOLTS_MEASURABLE: f64 = 25.0;
/// What a simulated phase can carry; the manual names no greatest values.
const VOLTS_MAX: f64 = 1000.0;
const AMPS_MAX: f64 = 400.0;
const HERTZ_MAX: f64 = 400.0;

impl Phase {
    /// The phase with this number, which counts from 0, of a net that turns right and is switched off.
    pub fn of_net(number: usize) -> Phase {
        Phase { volts: 0.0, amps: 0.0, hertz: 50.0, lag: 0.0, angle: -120.0 * number as f64 }
    }

    /// The error says what can be set.
    pub fn set(&mut self, quantity: PhaseQuantity, amount: f64) -> Result<(), String> {
        let (place, least, most, unit) = match quantity {
            PhaseQuantity::Volts => (&mut self.volts, 0.0, VOLTS_MAX, "volts"),
            PhaseQuantity::Amps => (&mut self.amps, 0.0, AMPS_MAX, "amps"),
            PhaseQuantity::Hertz => (&mut self.hertz, 1.0, HERTZ_MAX, "hertz"),
            PhaseQuantity::Lag => (&mut self.lag, -360.0, 360.0, "degrees"),
            PhaseQuantity::Angle => (&mut self.angle, -360.0, 360.0, "degrees"),
        };
        if !(least..=most).contains(&amount) {
            return Err(format!("a phase carries {least} to {most} {unit}"));
        }
        *place = amount;
        Ok(())
    }

    pub fn volts(&self) -> f64 {
        self.volts
    }

    /// The voltage at one moment, in microseconds.
    pub fn volts_at(&self, micros: f64) -> f64 {
        let turns = micros / 1e6 * self.hertz + self.angle / 360.0;
        SQRT_2 * self.volts * libm::sin(TAU * turns.fract())
    }

    /// The phase angle has the sign of the reactive power, which is positive for inductive loads. The
    /// manual gives it none. Without a current there is neither an angle nor a power factor: both are 0.
    pub fn measure(&self) -> Measured {
        if self.volts < VOLTS_MEASURABLE {
            return Measured::default();
        }
        let apparent = self.volts * self.amps;
        let (sine, cosine) = libm::sincos(self.lag.to_radians());
        let is_loaded = self.amps > 0.0;
        Measured {
            volts: self.volts,
            amps: self.amps,
            volts_peak: SQRT_2 * self.volts,
            amps_peak: SQRT_2 * self.amps,
            hertz: self.hertz,
            active: tidy(apparent * cosine),
            apparent,
            reactive: tidy(apparent * sine),
            power_factor: if is_loaded { tidy(cosine) } else { 0.0 },
            angle: if is_loaded { within_half_turn(self.lag) } else { 0.0 },
        }
    }
}

/// Measures the three voltages together. One that is too low to be measured counts as 0 V here as it
/// does everywhere, and has no angle to another: that is told as 0.
pub fn measure_together(phases: &[Phase; PHASES]) -> Together {
    let is_measurable = |phase: &Phase| phase.volts >= VOLTS_MEASURABLE;
    let angle = |number: usize| {
        let (to, from) = (&phases[(number + 1) % PHASES], &phases[number]);
        if is_measurable(to) && is_measurable(from) { within_half_turn(to.angle - from.angle) } else { 0.0 }
    };
    // The sum of the phasors, of which the second and the third are turned first, by `turn` and by
    // twice as much.
    let component = |turn: f64| {
        let (mut real, mut imaginary) = (0.0, 0.0);
        for (number, phase) in phases.iter().enumerate().filter(|(_, phase)| is_measurable(phase)) {
            let (sine, cosine) = libm::sincos((phase.angle + turn * number as f64).to_radians());
            real += phase.volts * cosine;
            imaginary += phase.volts * sine;
        }
        tidy(libm::hypot(real, imaginary) / PHASES as f64)
    };
    Together {
        angles: std::array::from_fn(angle),
        components: [component(120.0), component(-120.0), component(0.0)],
    }
}

/// An angle as one above -180 and up to 180 degrees.
fn within_half_turn(degrees: f64) -> f64 {
    let turned = degrees.rem_euclid(360.0);
    if turned > 180.0 { turned - 360.0 } else { turned }
}

/// Without what sines leave behind where nothing should be; and no zero is negative.
fn tidy(amount: f64) -> f64 {
    (amount * 1e6).round() / 1e6 + 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn phase(volts: f64, angle: f64) -> Phase {
        Phase { volts, angle, ..Phase::of_net(0) }
    }

    #[test]
    fn symmetrical_components_are_those_of_the_phasors() {
        let near = |told: f64, wanted: f64| (told - wanted).abs() < 1e-4;
        for (phases, components) in [
            // All alike and turning right; turning left; all the same phase.
            ([phase(230.0, 0.0), phase(230.0, -120.0), phase(230.0, 120.0)], [230.0, 0.0, 0.0]),
            ([phase(230.0, 0.0), phase(230.0, 120.0), phase(230.0, -120.0)], [0.0, 230.0, 0.0]),
            ([phase(230.0, 10.0), phase(230.0, 10.0), phase(230.0, 10.0)], [0.0, 0.0, 230.0]),
            // One is missing: two thirds, one third, one third.
            ([phase(240.0, 0.0), phase(240.0, -120.0), phase(24.9, 120.0)], [160.0, 80.0, 80.0]),
            ([phase(240.0, 0.0), phase(0.0, 0.0), phase(0.0, 0.0)], [80.0, 80.0, 80.0]),
            // One 30 V too low: a third of what is missing, in each of the others.
            ([phase(230.0, 0.0), phase(200.0, -120.0), phase(230.0, 120.0)], [220.0, 10.0, 10.0]),
        ] {
            let told = measure_together(&phases).components;
            let agree = told.iter().zip(components).all(|(told, wanted)| near(*told, wanted));
            assert!(agree, "{phases:?}: {told:?}");
        }
    }

    #[test]
    fn angles_lie_within_half_a_turn() {
        for (degrees, within) in
            [(240.0, -120.0), (-240.0, 120.0), (180.0, 180.0), (-180.0, 180.0), (360.0, 0.0)]
        {
            assert_eq!(within_half_turn(degrees), within, "{degrees}");
        }
    }
}
