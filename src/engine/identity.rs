//! Who a device is: whether the one that answers is the one that the profile describes, who a stranger is, and how that
//! one would stand in the configuration.

mod interview;
mod proposal;

pub use interview::{ANY_REGISTER, Interview, Known, known, nameless};
pub use proposal::{entry, name_for};

use crate::engine::device::Identify;
use crate::engine::modbus::{Answer, Call};

/// What to ask it.
pub fn question(identify: &Identify) -> Call {
    match identify {
        Identify::Names { .. } => Call::ReadIdentification { code: 1, object: 0 },
        Identify::Word { at, .. } => Call::Read(*at),
    }
}

/// What the device said of itself if it is the right one, else what is wrong with that.
pub fn check(identify: &Identify, answer: &Answer) -> Result<String, String> {
    match (identify, answer) {
        (Identify::Names { vendor, product }, Answer::Identification(found)) => {
            let object = |number: u8| {
                let object = found.objects.iter().find(|(id, _)| *id == number);
                object.map_or("", |(_, text)| text.as_str())
            };
            let told = format!("{} {} {}", object(0), object(1), object(2)).trim().to_string();
            if object(0) == vendor && object(1) == product {
                Ok(told)
            } else {
                Err(format!("it says that it is `{told}`, not `{vendor} {product}`"))
            }
        }
        (Identify::Word { at, mask, equals }, Answer::Words(words)) => match words.first() {
            Some(word) if word & mask == *equals => Ok(format!("{word:#06x}")),
            Some(word) => Err(format!("{at} holds {word:#06x}, not {equals:#06x}")),
            None => Err(format!("{at} is empty")),
        },
        _ => Err("its identification is of another kind".to_string()),
    }
}
