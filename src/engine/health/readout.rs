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
        // As what is scraped tells times itself.
        Reading::Moment(moment) => Some(moment.seconds().to_f64()),
        Reading::Flag(on) => Some(if *on { 1.0 } else { 0.0 }),
        Reading::Name(_) | Reading::Text(_) | Reading::List(_) | Reading::Missing(_) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::address::{Address, Span, Table};
    use crate::engine::codec;
    use crate::engine::device::{Encoding, Form, Kind, Point, Poll};
    use crate::engine::test_device::device_of;
    use crate::engine::time::Date;
    use crate::engine::value::Missing;

    #[test]
    fn a_moment_is_seconds_since_1970_and_nothing_is_told_of_what_is_missing() {
        let at = Address { span: Span::with_count(Table::Holding, 0, 2).expect("a span"), bits: None };
        let mut clock = Point::new("clock", at, Poll::Slow);
        clock.encoding = Encoding::Plain(Form { since: Date::of_day(2000, 1, 1), ..Form::new(Kind::U32) });
        let device = device_of(vec![clock]);
        let resolved = codec::resolve(&device, 0, &[None]).expect("nothing decides");
        let told = |words: &[u16]| Readout::of("clock", &resolved, &codec::read(&resolved, words));
        let seconds = told(&[0x3296, 0x6E5A]).map(|told| (told.value, told.unit));
        assert_eq!(seconds, Some((ReadoutValue::Number(1_795_404_250.0), None)));
        assert_eq!(codec::read(&resolved, &[0, 0]), Reading::Missing(Missing::NotAMoment));
        assert_eq!(told(&[0, 0]), None);
    }
}
