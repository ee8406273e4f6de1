//! A change of a device's line settings by hand: whether it may be, what is written, and in which state the
//! device is afterwards.
//!
//! One device, never all of them: it has answered with the settings that it has, it is known, and its profile
//! says which register it is. What is written is written once; a device that then answers with neither
//! settings is told as that.

use crate::engine::device::{Device, Identify, LineControl, SettingsBy, SettingsRegister};
use crate::engine::identity::{Interview, check, question};
use crate::engine::modbus::{ACKNOWLEDGE, Answer, BUSY, Call, RequestError};
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
    /// A question that the device has answered, and by which it is known where that can be.
    who: Call,
    pub from: Line,
    pub to: Line,
    call: Call,
}

/// The profile that the device is sure to have, by its own word. `given` is the one that a person names.
pub fn profile_of<'a>(interview: &'a Interview, given: Option<&'a Device>) -> Result<&'a str, Refusal> {
    if !interview.was_heard() {
        return Err(unheard(interview));
    }
    let fitting = interview.fitting();
    match (given, &fitting[..]) {
        (Some(Device { profile, identify: Some(identify), .. }), _) => match interview.check(identify) {
            Ok(_) => Ok(profile),
            Err(reason) => Err(Refusal::Device(format!("it is no {profile}: {reason}"))),
        },
        (Some(Device { profile, .. }), [(other, _), ..]) if other != profile => {
            Err(Refusal::Device(format!("it is no {profile}: it says that it is a {other}")))
        }
        // It is the person's word, and the device does not say otherwise.
        (Some(Device { profile, .. }), _) => Ok(profile),
        (None, [(only, _)]) => Ok(only),
        (None, []) => Err(Refusal::Device(
            "no profile goes by what it says; if you know which it is, name it with `--profile`".into(),
        )),
        (None, several) => {
            let ids: Vec<&str> = several.iter().map(|(id, _)| *id).collect();
            Err(Refusal::Device(format!("it may be {}; name it with `--profile`", ids.join(" or "))))
        }
    }
}

fn unheard(interview: &Interview) -> Refusal {
    Refusal::Device(format!(
        "it does not answer with these settings: {}; `busker scan --serial PORT --units UNIT` finds those that it has",
        interview.why_unheard()
    ))
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
    pub fn of(
        device: &Device,
        interview: &Interview,
        from: Line,
        to: Line,
    ) -> Result<Option<LineChange>, Refusal> {
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
        let identify = device.identify.clone();
        // A device that tells nobody who it is gives the answer that it has given, if only a refusal; there are those
        // that are silent to all that they do not know.
        let who = match &identify {
            Some(identify) => question(identify),
            None => interview.heard_by().cloned().ok_or_else(|| unheard(interview))?,
        };
        Ok(Some(LineChange { identify, who, from, to, call }))
    }

    /// What to ask with the old settings just before the write.
    pub fn question(&self) -> Call {
        self.who.clone()
    }

    /// Whether, by its answer, the device may still be written to: it may be another one by now.
    pub fn allow(&self, result: &Result<Answer, RequestError>) -> Result<(), Refusal> {
        match self.is_it(result) {
            Ok(Ok(())) => Ok(()),
            Ok(Err(reason)) => Err(Refusal::Device(format!("another one answers there now: {reason}"))),
            Err(error) => Err(Refusal::Device(format!("it answers no more: {error}"))),
        }
    }

    /// Whether it is the device that has answered; `Err` outside: nobody has.
    fn is_it<'a>(
        &self,
        result: &'a Result<Answer, RequestError>,
    ) -> Result<Result<(), String>, &'a RequestError> {
        match (result, &self.identify) {
            (Ok(answer), Some(identify)) => Ok(check(identify, answer).map(drop)),
            (Ok(_) | Err(RequestError::Exception(_)), None) => Ok(Ok(())),
            // Whoever is busy does not say who it is.
            (Err(busy @ RequestError::Exception(ACKNOWLEDGE | BUSY)), _) => Err(busy),
            (Err(error @ RequestError::Exception(_)), _) => Ok(Err(format!("it answers with {error}"))),
            (Err(error), _) => Err(error),
        }
    }

    /// The one write.
    pub fn call(&self) -> Call {
        self.call.clone()
    }

    /// What follows the write, of which this was the fate.
    pub fn written(self, result: Result<Answer, RequestError>) -> Verification {
        Verification { change: self, result, looks: 0, outcome: None }
    }
}

/// The word for these settings, or what the device can have instead.
fn word(register: &SettingsRegister, to: Line) -> Result<u16, String> {
    let baud = register.baud.iter().find(|(baud, _)| *baud == to.baud);
    let Some((_, baud)) = baud else {
        let known: Vec<String> = register.baud.iter().map(|(baud, _)| baud.to_string()).collect();
        return Err(format!("has no {} baud; expected {}", to.baud, known.join(", ")));
    };
    let parity = match to.parity {
        Parity::Even => register.even,
        Parity::Odd => register.odd,
        Parity::None => register.none,
    };
    let parity = parity.ok_or_else(|| format!("cannot have the parity `{}`", to.parity))?;
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
        let is_new = LOOKS.get(self.looks).filter(|_| self.outcome.is_none())?;
        let line = if *is_new { self.change.to } else { self.change.from };
        Some((line, self.change.who.clone()))
    }

    pub fn answered(&mut self, result: &Result<Answer, RequestError>) {
        let is_new = LOOKS.get(self.looks).copied().unwrap_or_default();
        self.looks += 1;
        self.outcome = match (is_new, self.change.is_it(result)) {
            (true, Ok(Ok(()))) => Some(Outcome::Changed),
            (true, Ok(Err(reason))) => Some(Outcome::Another(reason)),
            (false, Ok(Ok(()))) => Some(Outcome::AsBefore(match &self.result {
                Ok(_) => "it has confirmed the write and not obeyed it".into(),
                Err(error) => format!("the write was not taken: {error}"),
            })),
            // Another one that has its unit and the old settings says nothing about where it is itself.
            (false, Ok(Err(_))) | (_, Err(_)) => None,
        };
    }

    pub fn outcome(self) -> Outcome {
        self.outcome.unwrap_or(Outcome::Lost)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::identity::{ANY_REGISTER, Known};
    use crate::engine::modbus::Identification;
    use crate::engine::profile::Library;

    const OLD: Line = Line { baud: 19_200, parity: Parity::Even, stop_bits: 1 };
    const NEW: Line = Line { baud: 9600, parity: Parity::None, stop_bits: 1 };

    fn device(id: &str) -> Device {
        Library::shipped().load(id).expect("a shipped profile")
    }

    /// What came of asking a device that answers so, by whom these profiles are known.
    fn heard(known: Known, answer: impl Fn(&Call) -> Result<Answer, RequestError>) -> Interview {
        let mut interview = Interview::of_stranger(known);
        while let Some(call) = interview.question() {
            interview.answered(&answer(&call));
        }
        interview
    }

    fn refuse(_: &Call) -> Result<Answer, RequestError> {
        Err(RequestError::Exception(1))
    }

    fn change(id: &str, from: Line, to: Line) -> Result<Option<LineChange>, Refusal> {
        LineChange::of(&device(id), &heard(Known::default(), refuse), from, to)
    }

    fn names(product: &str) -> Result<Answer, RequestError> {
        let objects =
            [(0, "METZ CONNECT GmbH"), (1, product)].map(|(number, text)| (number, text.to_string()));
        Ok(Answer::Identification(Identification { conformity: 1, next: None, objects: objects.to_vec() }))
    }

    #[test]
    fn the_profile_is_the_one_that_fits_or_that_a_person_names() {
        let goes_by = |id: &str| (id.to_string(), device("metz-connect/mr-do4").identify.expect("names"));
        let one = || Known::new(vec![goes_by("metz-connect/mr-do4")]);
        let two = || Known::new(vec![goes_by("metz-connect/mr-do4"), goes_by("acme/copy")]);
        let do4 = |_: &Call| names("MR-DO4");
        let di4 = |_: &Call| names("MR-DI4");
        let silent = |_: &Call| Err(RequestError::Timeout);
        let named = |id: &str| Some(device(id));
        // A file of one's own may have the id of a shipped profile, and go by nothing.
        let own = Some(Device { identify: None, ..device("metz-connect/mr-do4") });
        let check = |interview: Interview, given: Option<Device>, expected: Result<&str, &str>| {
            let expected = expected.map_err(|reason| Refusal::Device(reason.into()));
            assert_eq!(profile_of(&interview, given.as_ref()), expected);
        };
        check(
            heard(one(), silent),
            named("metz-connect/mr-do4"),
            Err(
                "it does not answer with these settings: no answer in time; check its power, its wiring and its unit; \
                 `busker scan --serial PORT --units UNIT` finds those that it has",
            ),
        );
        check(heard(one(), do4), None, Ok("metz-connect/mr-do4"));
        check(heard(one(), do4), named("metz-connect/mr-do4"), Ok("metz-connect/mr-do4"));
        check(
            heard(one(), di4),
            named("metz-connect/mr-do4"),
            Err(
                "it is no metz-connect/mr-do4: it says that it is `METZ CONNECT GmbH MR-DI4`, not `METZ CONNECT GmbH \
                 MR-DO4`",
            ),
        );
        check(heard(one(), refuse), named("btr/mr-ai8"), Ok("btr/mr-ai8"));
        check(
            heard(one(), do4),
            named("btr/mr-ai8"),
            Err("it is no btr/mr-ai8: it says that it is a metz-connect/mr-do4"),
        );
        check(heard(two(), do4), own, Ok("metz-connect/mr-do4"));
        check(
            heard(one(), di4),
            None,
            Err("no profile goes by what it says; if you know which it is, name it with `--profile`"),
        );
        check(
            heard(two(), do4),
            None,
            Err("it may be metz-connect/mr-do4 or acme/copy; name it with `--profile`"),
        );
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
            let change = change(id, other, to).expect("possible").expect("another");
            assert_eq!(change.call(), Call::WriteRegister { address: 65, word }, "{id}");
        }
        assert!(change("metz-connect/mr-do4", OLD, OLD).expect("possible").is_none());
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
            let refused = change(id, OLD, to).expect_err("not possible");
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
        let change = change("metz-connect/mr-do4", OLD, NEW).expect("possible").expect("another");
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

    #[test]
    fn whoever_is_busy_or_another_at_the_old_settings_says_nothing_of_where_the_device_is() {
        let done = || Ok(Answer::Written);
        let busy = |line: Line, look: usize| match (line == NEW, look) {
            (true, 0) => Err(RequestError::Exception(6)),
            (true, 1) => Err(RequestError::Exception(5)),
            _ => names("MR-DO4"),
        };
        check(done(), busy, Outcome::Changed, 3);
        check(done(), |_, _| Err(RequestError::Exception(6)), Outcome::Lost, 6);
        let another = "it answers with exception 1 (illegal function)".to_string();
        check(done(), |_, _| Err(RequestError::Exception(1)), Outcome::Another(another), 1);
        let other_at_the_old = |line: Line, look: usize| match (line == OLD, look) {
            (true, _) => names("MR-DI4"),
            (false, 5) => names("MR-DO4"),
            (false, _) => Err(RequestError::Timeout),
        };
        check(done(), other_at_the_old, Outcome::Changed, 6);
    }

    #[test]
    fn a_device_that_tells_nobody_who_it_is_is_asked_what_it_has_answered_before() {
        let any_register = Call::Read(ANY_REGISTER);
        let silent_to_what_it_does_not_know = |call: &Call| match call {
            Call::Read(_) => Err(RequestError::Exception(2)),
            _ => Err(RequestError::Timeout),
        };
        let interview = heard(Known::default(), silent_to_what_it_does_not_know);
        let change =
            LineChange::of(&device("btr/mr-ai8"), &interview, OLD, NEW).expect("possible").expect("another");
        assert_eq!(change.question(), any_register);
        assert_eq!(change.allow(&silent_to_what_it_does_not_know(&any_register)), Ok(()));
        let mut verification = change.written(Ok(Answer::Written));
        assert_eq!(verification.question(), Some((NEW, any_register.clone())));
        verification.answered(&silent_to_what_it_does_not_know(&any_register));
        assert_eq!(verification.outcome(), Outcome::Changed);
    }

    #[test]
    fn just_before_the_write_it_must_still_be_the_device() {
        let change = change("metz-connect/mr-do4", OLD, NEW).expect("possible").expect("another");
        assert_eq!(change.question(), Call::ReadIdentification { code: 1, object: 0 });
        for (answer, refused) in [
            (names("MR-DO4"), None),
            (
                names("MR-DI4"),
                Some(
                    "another one answers there now: it says that it is `METZ CONNECT GmbH MR-DI4`, not \
                     `METZ CONNECT GmbH MR-DO4`",
                ),
            ),
            (Err(RequestError::Timeout), Some("it answers no more: no answer in time")),
            (Err(RequestError::Exception(6)), Some("it answers no more: exception 6 (device busy)")),
        ] {
            let refused = refused.map_or(Ok(()), |reason: &str| Err(Refusal::Device(reason.into())));
            assert_eq!(change.allow(&answer), refused);
        }
    }
}
