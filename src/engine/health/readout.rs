//! Readings as a scraper is told them: numbers only, and only those that are true now.

use crate::engine::codec::Resolved;
use crate::engine::value::Reading;

/// A reading that can be told as numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct Readout {
    pub point: String,
    pub unit: Option<String>,
    pub value: ReadoutValue,
}

#[derive(Clone, Debug, PartialEq)]
pub enum ReadoutValue {
    /// A number; a flag is 0 or 1.
    Number(f64),
    /// The elements that there are, each with its place.
    Numbers(Vec<(usize, f64)>),
    /// One of several names, and all of them.
    Name { holds: String, names: Vec<String> },
}

impl Readout {
    /// `None` of what is missing, and of texts: each would be a series of its own for ever.
    pub fn of(point: &str, resolved: &Resolved<'_>, reading: &Reading) -> Option<Readout> {
        let value = match reading {
            Reading::Name(name) => {
                let all = resolved.form.names.list().iter().map(|(_, name)| name.clone());
                let mut names: Vec<String> = Vec::new();
                for name in all.chain([name.clone()]) {
                    if !names.contains(&name) {
                        names.push(name);
                    }
                }
                ReadoutValue::Name { holds: name.clone(), names }
            }
            Reading::List(elements) => {
                let numbered = elements.iter().enumerate();
                ReadoutValue::Numbers(
                    numbered.filter_map(|(at, element)| Some((at, number(element)?))).collect(),
                )
            }
            reading => ReadoutValue::Number(number(reading)?),
        };
        let is_flag = matches!(reading, Reading::Flag(_));
        Some(Readout { point: point.into(), unit: resolved.unit.clone().filter(|_| !is_flag), value })
    }
}

fn number(reading: &Reading) -> Option<f64> {
    match reading {
        Reading::Number(number) => Some(number.to_f64()),
        Reading::Float(number) => Some(*number),
        Reading::Flag(on) => Some(if *on { 1.0 } else { 0.0 }),
        Reading::Name(_) | Reading::Text(_) | Reading::List(_) | Reading::Missing(_) => None,
    }
}
