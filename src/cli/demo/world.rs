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
    let wave = |period: f64| libm::sin(second as f64 / period * TAU);
    // A room with a little life in it.
    let celsius = 21.0 + 2.0 * wave(120.0);
    match id {
        // A PT1000 at the first input, which leaves the factory as a voltage input; voltages at others.
        "metz-connect/mr-ai8" | "btr/mr-ai8" => vec![
            format!("input 1 ohms {:.2}", pt1000(celsius)),
            format!("input 2 volts {:.3}", 5.0 + 2.0 * wave(60.0)),
            format!("input 3 volts {:.3}", 2.5 + 0.5 * wave(15.0)),
        ],
        "metz-connect/mr-aio42" => vec![
            format!("input 1 ohms {:.2}", pt1000(celsius)),
            format!("input 2 volts {:.3}", 5.0 + 2.0 * wave(90.0)),
        ],
        "metz-connect/mr-si4" => {
            let mut pulses = vec!["input 1 pulses 2 every 100ms".to_string()];
            if second % 5 == 0 {
                pulses.push("input 2 pulses 1".into());
            }
            pulses
        }
        "metz-connect/mr-multi-io" => vec![
            format!("input 1 contact {}", contact(second, 8)),
            format!("input 1 volts {:.3}", 5.0 + 2.0 * wave(60.0)),
            "input 12 pulses 1".into(),
        ],
        "metz-connect/mr-sm3" => (1..=3)
            .flat_map(|phase: u8| {
                let load = 4.0 + f64::from(phase) + 2.0 * wave(40.0 + 10.0 * f64::from(phase));
                [
                    format!("phase {phase} volts {:.1}", 230.0 + 2.0 * wave(30.0 * f64::from(phase))),
                    format!("phase {phase} amps {load:.2}"),
                    format!("phase {phase} lag {:.1}", 10.0 + 5.0 * wave(75.0)),
                ]
            })
            .collect(),
        "metz-connect/mr-ld6" => {
            // Now and then a puddle at the first sensor.
            let ohms = if second % 60 < 10 { 5_000 } else { 800_000 };
            vec![format!("input 1 ohms {ohms}")]
        }
        "metz-connect/mr-di4" | "metz-connect/mr-di10" | "metz-connect/mr-dio42" | "metz-connect/mr-tp" => {
            vec![
                format!("input 1 contact {}", contact(second, 5)),
                format!("input 2 contact {}", contact(second, 12)),
            ]
        }
        "metz-connect/mr-ci4" => vec![format!("input 1 milliamps {:.2}", 12.0 + 4.0 * wave(50.0))],
        "fuehlersysteme/analog-in8" => vec![format!("input 1 volts {:.2}", 5.0 + 3.0 * wave(45.0))],
        "fuehlersysteme/sensor" => vec![
            format!("measure temperature {celsius:.1}"),
            format!("measure humidity {:.1}", 45.0 + 8.0 * wave(180.0)),
            format!("measure co2 {:.0}", 700.0 + 200.0 * wave(240.0)),
        ],
        _ => Vec::new(),
    }
}

/// Ohms of a PT1000 above 0 °C (IEC 60751).
fn pt1000(celsius: f64) -> f64 {
    1000.0 * (1.0 + 3.9083e-3 * celsius - 5.775e-7 * celsius * celsius)
}

/// A contact that changes every `seconds`.
fn contact(second: u64, seconds: u64) -> &'static str {
    if second / seconds % 2 == 0 { "open" } else { "closed" }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::{DeviceAt, Model, Options, Simulation};

    #[test]
    fn whatever_changes_is_something_that_its_device_has() {
        for model in Model::ALL {
            let simulation = Simulation::new(&[DeviceAt { model, unit: 1 }], Options::default());
            let simulation = simulation.expect("a simulation");
            for second in 0..70 {
                for change in changes(model.id(), second) {
                    let told = simulation.command(&format!("unit 1 {change}"));
                    assert!(told.is_ok(), "{model}: {change}: {told:?}");
                }
            }
        }
    }
}
