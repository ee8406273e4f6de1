//! A change of a device's line settings by hand: whether it may be, what is written, and in which state the
//! device is afterwards.
//!
//! One device, never all of them: it has answered with the settings that it has, it is known, and its profile
//! says which register it is. What is written is written once; a device that then answers with neither
//! settings is told as that.

use crate::engine::device::{Device, Identify, LineControl, SettingsBy, SettingsRegister};
use crate::engine::identity::{Interview, check, question};
use crate::engine::modbus::{Answer, Call, RequestError};
use crate::engine::settings::{Line, Parity};

/// Why nothing is written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// The device is not the right one, or does not tell.
    Device(String),
    /// It cannot be asked for.
    Wish(String),
}

/// A change that can be made.
#[derive(Clone, Debug)]
pub struct LineChange {
    identify: Option<Identify>,
    pub from: Line,
    pub to: Line,
    call: Call,
}

/// The profile that the device is sure to have, by its own word. `given` is the one that a person names.
pub fn profile_of<'a>(interview: &'a Interview, given: Option<&'a Device>) -> Result<&'a str, Refusal> {
    if !interview.was_heard() {
        let why = interview.objects_error().map_or_else(String::new, |error| {
            let check = error.what_to_check().map_or_else(String::new, |check| format!("; {check}"));
            format!(": {error}{check}")
        });
        return Err(Refusal::Device(format!(
            "it does not answer with these settings{why}; `busker scan --serial PORT --units UNIT` finds those that it has"
        )));
    }
    let fitting = interview.fitting();
    match (given, &fitting[..]) {
        (Some(Device { profile, identify: Some(identify), .. }), _) => match interview.check(identify) {
            Ok(_) => Ok(profile),
            Err(reason) => Err(Refusal::Device(format!("it is no {profile}: {reason}"))),
        },
        // It is the person's word, unless the device says that it is another one.
        (Some(Device { profile, .. }), []) => Ok(profile),
        (None, [(only, _)]) => Ok(only),
        (Some(Device { profile, .. }), [(other, _), ..]) if other != profile => {
            Err(Refusal::Device(format!("it is no {profile}: it says that it is a {other}")))
        }
        (Some(Device { profile, .. }), _) => Ok(profile),
        (None, []) => Err(Refusal::Device(
            "no profile goes by what it says; if you know which it is, name it with `--profile`".into(),
        )),
        (None, several) => {
            let ids: Vec<&str> = several.iter().map(|(id, _)| *id).collect();
            Err(Refusal::Device(format!("it may be {}; name it with `--profile`", ids.join(" or "))))
        }
    }
}

/// What sets the device's unit, which no device here lets a register do.
pub fn why_no_unit(device: &Device) -> String {
    match &device.line {
        Some(LineControl { unit_by, .. }) => {
            format!("the unit of a {} is set by {unit_by}, and not over the line", device.profile)
        }
        None => format!("{} does not say how its unit is set", device.profile),
    }
}

impl LineChange {
    /// The change of `device`, which has answered with the settings `from`; `None`: it has them already.
    pub fn of(device: &Device, from: Line, to: Line) -> Result<Option<LineChange>, Refusal> {
        let id = &device.profile;
        let register = match device.line.as_ref().map(|line| &line.settings) {
            None => return Err(Refusal::Wish(format!("{id} does not say how bit rate and parity are set"))),
            Some(SettingsBy::Hand(switches)) => {
                let reason = format!("bit rate and parity of a {id} are set at the device: {switches}");
                return Err(Refusal::Wish(reason));
            }
            Some(SettingsBy::Register(register)) => register,
        };
        let word = word(register, to).map_err(|reason| Refusal::Wish(format!("{id} {reason}")))?;
        if (from.baud, from.parity) == (to.baud, to.parity) {
            return Ok(None);
        }
        let call = Call::WriteRegister { address: register.at.first(), word };
        Ok(Some(LineChange { identify: device.identify.clone(), from, to, call }))
    }

    /// The one write.
    pub fn call(&self) -> Call {
        self.call.clone()
    }

    /// What follows the write, of which this was the fate.
    pub fn written(self, result: Result<Answer, RequestError>) -> Verification {
        Verification { change: self, result, looks: 0, is_over: false, outcome: None }
    }
}

/// The word for these settings, or what the device can have instead.
fn word(register: &SettingsRegister, to: Line) -> Result<u16, String> {
    let baud = register.baud.iter().find(|(baud, _)| *baud == to.baud);
    let Some((_, baud)) = baud else {
        let known: Vec<String> = register.baud.iter().map(|(baud, _)| baud.to_string()).collect();
        return Err(format!("has no {} baud; expected {}", to.baud, known.join(", ")));
    };
    let (parity, name) = match to.parity {
        Parity::Even => (register.even, "even"),
        Parity::Odd => (register.odd, "odd"),
        Parity::None => (register.none, "none"),
    };
    let parity = parity.ok_or_else(|| format!("cannot have the parity `{name}`"))?;
    Ok(register.add | baud | parity)
}

/// Where the device is looked for behind the write: three times with the new settings, twice with the old
/// ones, and once more with the new ones, since it may have needed its time.
const LOOKS: [bool; 6] = [true, true, true, false, false, true];

/// Looks in which state the device is. Ask [`Verification::question`], tell [`Verification::answered`], until
/// there is no question any more.
#[derive(Clone, Debug)]
pub struct Verification {
    change: LineChange,
    result: Result<Answer, RequestError>,
    looks: usize,
    is_over: bool,
    outcome: Option<Outcome>,
}

/// In which state the device is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// It has answered with the new settings, and is the one it was.
    Changed,
    /// It has answered with the old ones, and why.
    AsBefore(String),
    /// It answers with neither.
    Lost,
    /// Another device answers with the new settings.
    Another(String),
}

impl Verification {
    /// With which settings to ask what.
    pub fn question(&self) -> Option<(Line, Call)> {
        let is_new = LOOKS.get(self.looks).filter(|_| !self.is_over)?;
        let line = if *is_new { self.change.to } else { self.change.from };
        // Whoever tells nobody who it is answers all the same, if only by a refusal.
        let names = Call::ReadIdentification { code: 1, object: 0 };
        Some((line, self.change.identify.as_ref().map_or(names, question)))
    }

    pub fn answered(&mut self, result: &Result<Answer, RequestError>) {
        let is_new = LOOKS.get(self.looks).copied().unwrap_or_default();
        self.looks += 1;
        let identified = match (result, &self.change.identify) {
            (Ok(answer), Some(identify)) => check(identify, answer).map(drop),
            (Ok(_) | Err(RequestError::Exception(_)), None) => Ok(()),
            (Err(RequestError::Exception(code)), Some(_)) => Err(format!("it answers with exception {code}")),
            (Err(_), _) => return,
        };
        self.outcome = Some(match (is_new, identified) {
            (true, Ok(())) => Outcome::Changed,
            (true, Err(reason)) => Outcome::Another(reason),
            (false, _) => Outcome::AsBefore(match &self.result {
                Ok(_) => "it has confirmed the write and not obeyed it".into(),
                Err(error) => format!("the write was not taken: {error}"),
            }),
        });
        self.is_over = true;
    }

    pub fn outcome(self) -> Outcome {
        self.outcome.unwrap_or(Outcome::Lost)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::modbus::Identification;
    use crate::engine::profile::Library;

    const OLD: Line = Line { baud: 19_200, parity: Parity::Even, stop_bits: 1 };
    const NEW: Line = Line { baud: 9600, parity: Parity::None, stop_bits: 1 };

    fn device(id: &str) -> Device {
        Library::shipped().load(id).expect("a shipped profile")
    }

    fn names(product: &str) -> Result<Answer, RequestError> {
        let objects =
            [(0, "METZ CONNECT GmbH"), (1, product)].map(|(number, text)| (number, text.to_string()));
        Ok(Answer::Identification(Identification { conformity: 1, next: None, objects: objects.to_vec() }))
    }

    #[test]
    fn the_word_is_that_of_the_manual() {
        for (id, to, word) in [
            // The manual's example, page 3.
            ("metz-connect/mr-do4", Line { baud: 19_200, parity: Parity::Even, stop_bits: 1 }, 0x5315),
            ("metz-connect/mr-sm3", Line { baud: 115_200, parity: Parity::None, stop_bits: 1 }, 0x5338),
            ("btr/mr-ai8", Line { baud: 1200, parity: Parity::Odd, stop_bits: 1 }, 0x5321),
        ] {
            let other = Line { baud: 4800, ..OLD };
            let change = LineChange::of(&device(id), other, to).expect("possible").expect("another");
            assert_eq!(change.call(), Call::WriteRegister { address: 65, word }, "{id}");
        }
        assert!(LineChange::of(&device("metz-connect/mr-do4"), OLD, OLD).expect("possible").is_none());
    }

    #[test]
    fn what_a_device_cannot_have_is_refused_with_what_it_can() {
        for (id, to, reason) in [
            (
                "metz-connect/mr-do4",
                Line { baud: 14_400, ..OLD },
                "metz-connect/mr-do4 has no 14400 baud; expected 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200",
            ),
            (
                "fuehlersysteme/relay8",
                NEW,
                "bit rate and parity of a fuehlersysteme/relay8 are set at the device: the DIP switches of switch B: 1 \
                 to 3 set parity and stop bits, 4 and 5 the bit rate",
            ),
        ] {
            let refused = LineChange::of(&device(id), OLD, to).expect_err("not possible");
            assert_eq!(refused, Refusal::Wish(reason.into()));
        }
        let unit = why_no_unit(&device("metz-connect/mr-do4"));
        assert_eq!(
            unit,
            "the unit of a metz-connect/mr-do4 is set by its rotary address switches, and not over the line"
        );
    }

    #[test]
    fn every_shipped_profile_says_how_its_line_is_set() {
        let library = Library::shipped();
        for id in library.ids() {
            assert!(device(id).line.is_some(), "{id}");
        }
    }

    /// Who answers what, look by look, and what that is.
    fn check(
        written: Result<Answer, RequestError>,
        answers: impl Fn(Line, usize) -> Result<Answer, RequestError>,
        expected: Outcome,
        looks: usize,
    ) {
        let change =
            LineChange::of(&device("metz-connect/mr-do4"), OLD, NEW).expect("possible").expect("another");
        let mut verification = change.written(written);
        let mut asked = 0;
        while let Some((line, call)) = verification.question() {
            assert!(!call.is_write());
            verification.answered(&answers(line, asked));
            asked += 1;
        }
        assert_eq!(asked, looks);
        assert_eq!(verification.outcome(), expected);
    }

    #[test]
    fn after_the_write_the_device_is_looked_for_with_both_settings() {
        let silent = || Err(RequestError::Timeout);
        let done = || Ok(Answer::Written);
        let at = |here: Line| {
            move |line: Line, _: usize| {
                if line == here { names("MR-DO4") } else { Err(RequestError::Timeout) }
            }
        };
        check(done(), at(NEW), Outcome::Changed, 1);
        // The answer to the write may be lost on a noisy line; the change is there all the same.
        check(silent(), at(NEW), Outcome::Changed, 1);
        check(done(), at(OLD), Outcome::AsBefore("it has confirmed the write and not obeyed it".into()), 4);
        let refused = "the write was not taken: exception 3 (illegal data value)".to_string();
        check(Err(RequestError::Exception(3)), at(OLD), Outcome::AsBefore(refused), 4);
        check(done(), |_, _| Err(RequestError::Timeout), Outcome::Lost, 6);
        check(
            done(),
            |line, look| if line == NEW && look == 5 { names("MR-DO4") } else { silent() },
            Outcome::Changed,
            6,
        );
        let another =
            "it says that it is `METZ CONNECT GmbH MR-DI4`, not `METZ CONNECT GmbH MR-DO4`".to_string();
        check(done(), |_, _| names("MR-DI4"), Outcome::Another(another), 1);
    }
}
