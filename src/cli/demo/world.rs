//! What happens around the simulated devices: it gets warmer and colder, and meters count.

use std::f64::consts::TAU;
use std::time::Duration;

use super::Line;

/// The time that has passed in it.
#[derive(Default)]
pub struct World {
    passed: Duration,
}

impl World {
    /// Lets `step` pass on all lines.
    pub fn go_on(&mut self, step: Duration, lines: &[Line]) -> anyhow::Result<()> {
        let before = self.passed.as_secs();
        self.passed += step;
        let now = self.passed.as_secs();
        // Once a second, and at the very beginning.
        if before == now && self.passed != step {
            return Ok(());
        }
        for line in lines {
            for device in &line.devices {
                for change in changes(device.model.id(), now) {
                    line.simulation.command(&format!("unit {} {change}", device.unit))?;
                }
            }
        }
        Ok(())
    }
}

/// What changes at a device in this second.
fn changes(id: &str, second: u64) -> Vec<String> {
    let wave = |period: f64| (second as f64 / period * TAU).sin();
    if id == "metz-connect/mr-ai8" {
        // A PT1000 at the first input, which leaves the factory as a voltage input; voltages at others.
        let celsius = 21.0 + 2.0 * wave(120.0);
        let ohms = 1000.0 * (1.0 + 3.9083e-3 * celsius - 5.775e-7 * celsius * celsius);
        return vec![
            format!("input 1 ohms {ohms:.2}"),
            format!("input 2 volts {:.3}", 5.0 + 2.0 * wave(60.0)),
            format!("input 3 volts {:.3}", 2.5 + 0.5 * wave(15.0)),
        ];
    }
    if id == "metz-connect/mr-si4" {
        let mut pulses = vec!["input 1 pulses 2 every 100ms".to_string()];
        if second % 5 == 0 {
            pulses.push("input 2 pulses 1".into());
        }
        return pulses;
    }
    Vec::new()
}
