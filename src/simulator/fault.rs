//! Misbehaviour on request: `unit=19,silent` or `garbled,every=3`.

use std::str::FromStr;

use crate::engine::time::Duration;
use crate::simulator::script::parse_duration;

/// One fault of one unit, or of all of them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// `None`: every unit on the line.
    pub unit: Option<u8>,
    pub kind: FaultKind,
    /// Only each so-manieth request; 1 is every one.
    pub every: u32,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum FaultKind {
    /// Neither obeys nor replies.
    Silent,
    /// Each reply begins so much later, yet in time for a patient client.
    Slow(Duration),
    /// Each reply begins so late that its request has been given up.
    Late(Duration),
    /// Each byte of a reply comes so long after the one before.
    Dribble(Duration),
    /// A bit of the reply is turned over: the checksum does not fit. On Modbus TCP, which has no
    /// checksum, the reply carries another request's transaction.
    Garbled,
    /// Thirty bytes of noise before the reply.
    Noisy,
    /// A zero byte before the reply, as a floating line gives.
    LeadingZero,
    /// The last two bytes of the reply are missing.
    Short,
    /// The reply comes with the next unit's address.
    OtherUnit,
    /// The request comes back before the reply, as adapters without echo suppression do it.
    Echo,
    /// Each request is refused with this exception, and not obeyed.
    Exception(u8),
    /// The device restarts again and again, and is silent for two seconds each time.
    Reboot(Duration),
    /// The device says that it is another: in function 43/14, or in its system code.
    WrongIdentity,
}

/// The kinds as they are written, with their usual amount.
pub const KINDS: &str = "silent, slow=150ms, late=2s, dribble=5ms, garbled, noisy, leading-zero, short, \
                         other-unit, echo, exception=4, reboot=10s, wrong-identity";

impl FromStr for Fault {
    type Err = String;

    /// Parts divided by commas, in any order: `unit=N`, `every=N`, and one kind, perhaps with `=` and
    /// its amount.
    fn from_str(text: &str) -> Result<Fault, String> {
        let (mut unit, mut every, mut kind) = (None, 1, None);
        for part in text.split(',').map(str::trim) {
            let (name, amount) = part.split_once('=').map_or((part, None), |(name, rest)| (name, Some(rest)));
            match (name, amount) {
                ("unit", Some(number)) => match number.parse() {
                    Ok(number @ 1..=247) => unit = Some(number),
                    _ => return Err(format!("`{number}` is not a unit; a unit is 1 to 247")),
                },
                ("every", Some(number)) => match number.parse() {
                    Ok(number @ 1..) => every = number,
                    _ => return Err(format!("`{number}` is not a count of requests; write `every=3`")),
                },
                _ if kind.is_some() => {
                    return Err(format!("`{text}` has two kinds of fault; give two faults"));
                }
                _ => kind = Some(parse_kind(name, amount)?),
            }
        }
        let kind = kind.ok_or_else(|| format!("`{text}` says no fault; there are {KINDS}"))?;
        Ok(Fault { unit, kind, every })
    }
}

fn parse_kind(name: &str, amount: Option<&str>) -> Result<FaultKind, String> {
    let duration = |usual: u64| match amount {
        Some(text) => parse_duration(text),
        None => Ok(Duration::from_millis(usual)),
    };
    let timed = match name {
        "slow" => return Ok(FaultKind::Slow(duration(150)?)),
        "late" => return Ok(FaultKind::Late(duration(2000)?)),
        "dribble" => return Ok(FaultKind::Dribble(duration(5)?)),
        "reboot" => return Ok(FaultKind::Reboot(duration(10_000)?)),
        "exception" => {
            let code = amount.unwrap_or("4");
            return match code.parse() {
                Ok(code @ 1..=127) => Ok(FaultKind::Exception(code)),
                _ => Err(format!("`{code}` is not an exception code; write `exception=4`")),
            };
        }
        "silent" => FaultKind::Silent,
        "garbled" => FaultKind::Garbled,
        "noisy" => FaultKind::Noisy,
        "leading-zero" => FaultKind::LeadingZero,
        "short" => FaultKind::Short,
        "other-unit" => FaultKind::OtherUnit,
        "echo" => FaultKind::Echo,
        "wrong-identity" => FaultKind::WrongIdentity,
        _ => return Err(format!("`{name}` is not a fault; there are {KINDS}")),
    };
    match amount {
        None => Ok(timed),
        Some(amount) => Err(format!("`{name}` takes no amount, but `{amount}` was given")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fault_is_read_from_its_parts_in_any_order() {
        let millis = Duration::from_millis;
        for (text, unit, kind, every) in [
            ("silent", None, FaultKind::Silent, 1),
            ("unit=19,silent", Some(19), FaultKind::Silent, 1),
            ("late=700ms, every=3, unit=7", Some(7), FaultKind::Late(millis(700)), 3),
            ("slow", None, FaultKind::Slow(millis(150)), 1),
            ("exception=6", None, FaultKind::Exception(6), 1),
            ("reboot", None, FaultKind::Reboot(millis(10_000)), 1),
        ] {
            assert_eq!(text.parse(), Ok(Fault { unit, kind, every }), "{text}");
        }
    }

    #[test]
    fn what_is_no_fault_is_refused_with_what_there_is() {
        for (text, message) in [
            ("unit=19", "`unit=19` says no fault; there are silent"),
            ("deaf", "`deaf` is not a fault; there are silent"),
            ("unit=300,silent", "`300` is not a unit; a unit is 1 to 247"),
            ("silent,garbled", "`silent,garbled` has two kinds of fault; give two faults"),
            ("silent=2s", "`silent` takes no amount, but `2s` was given"),
            ("every=0,silent", "`0` is not a count of requests"),
            ("late=soon", "`soon` is not a duration"),
        ] {
            let told = text.parse::<Fault>().unwrap_err();
            assert!(told.starts_with(message), "{text}: {told}");
        }
    }
}
