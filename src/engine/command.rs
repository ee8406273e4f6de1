//! One command, from the wanted value to exactly one outcome.
//!
//! Read first where it matters (EEPROM is written only if it differs; a field of bits needs its neighbours; some devices
//! act only on another value), write, let it settle, read back, compare. A write without an answer is never repeated:
//! what the device holds is read, and decides. The state topic is none of this module's business: it shows only what
//! reads found.

mod wish;

use serde::Serialize;

pub use wish::Wish;

use crate::engine::address::{Address, Span};
use crate::engine::codec;
use crate::engine::device::{Device, Names, Point, PointIndex, Write, WriteFunction, WriteRule};
use crate::engine::modbus::{ACKNOWLEDGE, Answer, BUSY, Call, ILLEGAL_VALUE, RequestError, exception_name};
use crate::engine::time::Duration;
use crate::engine::transaction::Transaction;

/// A command that has begun. Whoever runs it asks the device what it wants asked, and tells it each answer
/// ([`CommandFlow::answered`]), until a [`Step`] says that it is finished.
#[derive(Clone, Debug, PartialEq)]
pub struct CommandFlow {
    point: PointIndex,
    wanted: String,
    /// What was made of the wish, where it is not written as it is.
    note: Option<String>,
    state: State,
    /// The last question, and how often the device was too busy for it.
    asked: Option<Call>,
    busy: u32,
}

pub const ACCEPTED: &str = "the device has accepted it, and takes its time (exception 5, acknowledge)";
/// A device that is busy is asked again after this, and so often.
pub const PAUSE_BUSY: Duration = Duration::from_millis(200);
pub const BUSY_MAX: u32 = 50;
/// A button that is pressed late surprises.
const BUSY_MAX_OF_PRESS: u32 = 15;

#[derive(Clone, Debug, PartialEq)]
enum State {
    /// Reads what is there, to compare or to keep the neighbouring bits.
    ReadingBefore { field: Vec<u16> },
    /// The value that stands between two equal ones is on its way.
    WritingBetween { field: Vec<u16>, then: Call },
    /// The write is on its way. `field` is what the point's own bits shall be.
    Writing { field: Vec<u16> },
    /// The device takes its time; then it is read back.
    Settling { field: Vec<u16>, doubt: Option<Doubt> },
    /// Reads what the device holds now. `doubt` says what was wrong with the write's own answer.
    ReadingBack { field: Vec<u16>, doubt: Option<Doubt> },
}

/// What a command acts on: a point, how it is written, and what is known of its device ([`codec::resolve`]).
#[derive(Clone, Copy)]
struct Subject<'d> {
    device: &'d Device,
    point: &'d Point,
    write: &'d Write,
    known: &'d [Option<i128>],
}

/// Why the answer to a write does not settle the matter.
#[derive(Clone, Debug, PartialEq)]
enum Doubt {
    NoAnswer(RequestError),
    /// The device is still doing it.
    Accepted,
    /// The device says that it clamps, and that it does so with an exception.
    Clamped,
}

/// What to do next with a command.
#[derive(Clone, Debug, PartialEq)]
pub enum Step {
    Ask(Call),
    /// The same, after so long.
    AskLater(Duration, Call),
    /// Wait so long, while others may be asked, and go on with [`CommandFlow::settled`].
    Settle(Duration),
    Finished(Outcome),
}

/// How a command ended; the payload of the `outcome` topic.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outcome {
    pub kind: OutcomeKind,
    pub wanted: String,
    /// What the device holds, as far as it is known.
    pub found: Option<String>,
    pub reason: Option<String>,
    /// As it came with the wish.
    pub transaction: Option<Transaction>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OutcomeKind {
    /// Written, and read back as wanted.
    Done,
    /// EEPROM held it already; nothing was written.
    Unchanged,
    /// A rule of the profile or the device itself said no; nothing was changed.
    Refused,
    /// Written, but the device holds something else.
    NotTaken,
    /// The device did not answer, and what it holds is not known.
    NoReply,
    /// It waited too long, or a newer value took its place.
    Expired,
}

impl OutcomeKind {
    pub const fn name(self) -> &'static str {
        match self {
            OutcomeKind::Done => "done",
            OutcomeKind::Unchanged => "unchanged",
            OutcomeKind::Refused => "refused",
            OutcomeKind::NotTaken => "not_taken",
            OutcomeKind::NoReply => "no_reply",
            OutcomeKind::Expired => "expired",
        }
    }
}

impl Outcome {
    pub fn new(kind: OutcomeKind, wanted: &str, reason: impl Into<String>) -> Outcome {
        Outcome {
            kind,
            wanted: shortened(wanted),
            found: None,
            reason: Some(reason.into()),
            transaction: None,
        }
    }

    /// Why `wanted` is not even looked at, if it is too long to be a value.
    pub fn of_too_long(wanted: &str) -> Option<Outcome> {
        let bytes = wanted.len();
        let reason = || format!("{bytes} bytes are no value; expected at most {}", wish::BYTES_MAX);
        (bytes > wish::BYTES_MAX).then(|| Outcome::new(OutcomeKind::Refused, wanted, reason()))
    }

    /// `{"outcome":"done","wanted":"ON","found":"ON","reason":null}`, and the `transaction` if one came.
    pub fn to_json(&self) -> String {
        #[derive(Serialize)]
        struct Told<'a> {
            outcome: &'a str,
            wanted: &'a str,
            found: Option<&'a str>,
            reason: Option<&'a str>,
            #[serde(skip_serializing_if = "Option::is_none")]
            transaction: Option<&'a Transaction>,
        }
        let told = Told {
            outcome: self.kind.name(),
            wanted: &self.wanted,
            found: self.found.as_deref(),
            reason: self.reason.as_deref(),
            transaction: self.transaction.as_ref(),
        };
        serde_json::to_string(&told).expect("texts are its only keys")
    }
}

impl CommandFlow {
    /// Checks the wish; returns the command and its first question, or how it has ended already. `known` as in
    /// [`codec::resolve`]: the caller has made sure that what decides the point's meaning is known.
    pub fn begin(
        device: &Device,
        point: PointIndex,
        wanted: &str,
        known: &[Option<i128>],
    ) -> Result<(CommandFlow, Call), Outcome> {
        let details = &device.points[point];
        let refused = |reason: String| Outcome::new(OutcomeKind::Refused, wanted, reason);
        let write = details.write.as_ref();
        let write = write.ok_or_else(|| refused(format!("`{}` is read-only", details.name)))?;
        let resolved =
            codec::resolve(device, point, known).map_err(|missing| refused(missing.to_string()))?;
        let codec::Obeyed { words: field, note } =
            codec::obey(details, write, &resolved, wanted).map_err(refused)?;
        let compares = details.persistent && !is_press(write);
        let reads_before = compares || write.at.bits.is_some() || write.on_change.is_some();
        let (call, state) = match reads_before {
            true => (Call::Read(write.at.span), State::ReadingBefore { field }),
            false => (write_call(write, &field), State::Writing { field }),
        };
        let (wanted, asked) = (wanted.to_string(), Some(call.clone()));
        Ok((CommandFlow { point, wanted, note, state, asked, busy: 0 }, call))
    }

    pub fn point(&self) -> PointIndex {
        self.point
    }

    pub fn wanted(&self) -> &str {
        &self.wanted
    }

    /// The time to settle has passed: the question that reads back.
    pub fn settled(&mut self, device: &Device) -> Call {
        if let State::Settling { field, doubt } = &self.state {
            self.state = State::ReadingBack { field: field.clone(), doubt: doubt.clone() };
        }
        let call = Call::Read(device.points[self.point].at.span);
        self.asked = Some(call.clone());
        call
    }

    /// Whether the question under way reads the point's place: the answer is news for every point in it.
    pub fn reads(&self) -> bool {
        matches!(self.state, State::ReadingBefore { .. } | State::ReadingBack { .. })
    }

    /// Whether the device has taken nothing of it yet.
    pub fn is_unwritten(&self) -> bool {
        matches!(
            self.state,
            State::ReadingBefore { .. } | State::WritingBetween { .. } | State::Writing { .. }
        )
    }

    /// Whether all that is left is to see that the device has taken what it has confirmed.
    pub fn only_confirms(&self) -> bool {
        matches!(self.state, State::ReadingBack { doubt: None, .. })
    }

    /// Takes the answer to the last question.
    pub fn answered(
        &mut self,
        device: &Device,
        known: &[Option<i128>],
        result: &Result<Answer, RequestError>,
    ) -> Step {
        let point = &device.points[self.point];
        let Some(write) = &point.write else {
            return self.finish(OutcomeKind::Refused, None, Some("read-only".into()));
        };
        if let Some(step) = self.ask_busy_again(write, result) {
            return step;
        }
        let step = self.next_step(Subject { device, point, write, known }, result);
        if let Step::Ask(call) = &step {
            self.asked = Some(call.clone());
        }
        step
    }

    /// A device that is busy has done nothing, and is asked again. (One that has acknowledged is doing it: to repeat that
    /// would do it twice. What came of it is read back, as often as it takes.)
    fn ask_busy_again(&mut self, write: &Write, result: &Result<Answer, RequestError>) -> Option<Step> {
        let is_reading = matches!(self.asked, Some(Call::Read(_)));
        let is_busy = match result {
            Err(RequestError::Exception(ACKNOWLEDGE)) => is_reading,
            Err(RequestError::Exception(BUSY)) => true,
            _ => false,
        };
        let most = if is_press(write) { BUSY_MAX_OF_PRESS } else { BUSY_MAX };
        if !is_busy || self.busy >= most {
            return None;
        }
        self.busy += 1;
        Some(Step::AskLater(PAUSE_BUSY, self.asked.clone()?))
    }

    fn next_step(&mut self, subject: Subject<'_>, result: &Result<Answer, RequestError>) -> Step {
        match self.state.clone() {
            State::ReadingBefore { field } => self.read_before(subject, field, result),
            State::WritingBetween { field, then } => match result {
                Ok(_) | Err(RequestError::Exception(ACKNOWLEDGE)) => {
                    self.state = State::Writing { field };
                    Step::Ask(then)
                }
                Err(RequestError::Exception(code)) => self.refused_by_device(*code),
                Err(error) => self.finish(OutcomeKind::NoReply, None, Some(error.to_string())),
            },
            State::Writing { field } => self.written(subject, field, result),
            // Nothing is asked meanwhile.
            State::Settling { .. } => Step::Settle(subject.write.settle),
            State::ReadingBack { field, doubt } => self.read_back(subject, &field, doubt, result),
        }
    }

    /// What is there has been read: it is as wanted already, or is written, with its neighbours as they are.
    fn read_before(
        &mut self,
        Subject { device, point, write, known }: Subject<'_>,
        field: Vec<u16>,
        result: &Result<Answer, RequestError>,
    ) -> Step {
        let words = match result {
            Ok(answer) => words_of(answer),
            Err(RequestError::Exception(code)) => return self.refused_by_device(*code),
            Err(error) => {
                let reason = format!("nothing was written: {error}");
                return self.finish(OutcomeKind::NoReply, None, Some(reason));
            }
        };
        let Some(held) = codec::words_at(write.at, write.at.span.first(), &words) else {
            return self.finish(OutcomeKind::NoReply, None, Some("the read before was too short".into()));
        };
        // A button does something by being pressed, whatever its place holds.
        if point.persistent && !is_press(write) && held == field {
            let found = tell(device, self.point, known, &held);
            return self.finish(OutcomeKind::Unchanged, found, None);
        }
        let whole = |field: &[u16]| match write.at.bits {
            Some(bits) => write_call(write, &[bits.insert(words[0], field[0])]),
            None => write_call(write, field),
        };
        if write.at.bits.is_some() {
            if let Some(meaning) = meaning_of_whole_register(device, write.at.span, words[0]) {
                // One bit changed in 11111 would be a number out of range, which a device may clamp to
                // "all relays on" (FuehlerSysteme, chapters 6.1.2 and 9).
                let reason = format!("the register holds {meaning}, of which single bits cannot be changed");
                return self.finish(OutcomeKind::Refused, None, Some(reason));
            }
        }
        let call = whole(&field);
        match write.on_change.filter(|_| held == field) {
            Some(between) => {
                let mut other = vec![0; field.len()];
                other[field.len() - 1] = between as u16;
                self.state = State::WritingBetween { field, then: call };
                Step::Ask(whole(&other))
            }
            None => {
                self.state = State::Writing { field };
                Step::Ask(call)
            }
        }
    }

    /// The write has ended: it is settled, or what the device holds now has to decide.
    fn written(
        &mut self,
        Subject { device, point, write, .. }: Subject<'_>,
        field: Vec<u16>,
        result: &Result<Answer, RequestError>,
    ) -> Step {
        let press = is_press(write);
        let doubt = match result {
            Ok(_) if press && !is_self_clearing(write) => return self.finish(OutcomeKind::Done, None, None),
            Err(RequestError::Exception(ACKNOWLEDGE)) if press && !is_self_clearing(write) => {
                return self.finish(OutcomeKind::Done, None, Some(ACCEPTED.into()));
            }
            Ok(_) => None,
            Err(RequestError::Exception(ACKNOWLEDGE)) => Some(Doubt::Accepted),
            Err(RequestError::Exception(ILLEGAL_VALUE)) if device.wire.quirks.clamps_with_exception => {
                Some(Doubt::Clamped)
            }
            Err(RequestError::Exception(code)) => return self.refused_by_device(*code),
            Err(error) if press => return self.finish(OutcomeKind::NoReply, None, Some(error.to_string())),
            Err(error) => Some(Doubt::NoAnswer(error.clone())),
        };
        let settle = if doubt == Some(Doubt::Accepted) { write.settle.max(PAUSE_BUSY) } else { write.settle };
        if settle > Duration::ZERO {
            self.state = State::Settling { field, doubt };
            return Step::Settle(settle);
        }
        self.state = State::ReadingBack { field, doubt };
        Step::Ask(Call::Read(point.at.span))
    }

    /// What the device holds now has been read, or cannot be: that is the outcome, unless it is still busy with it.
    fn read_back(
        &mut self,
        Subject { device, point, write, known }: Subject<'_>,
        field: &[u16],
        doubt: Option<Doubt>,
        result: &Result<Answer, RequestError>,
    ) -> Step {
        let words = match result {
            Ok(answer) => words_of(answer),
            Err(error) => {
                let reason = match doubt {
                    Some(Doubt::NoAnswer(of_write)) => of_write.to_string(),
                    Some(Doubt::Accepted) => format!("{ACCEPTED}, but it was not read back: {error}"),
                    _ => format!("written, but not read back: {error}"),
                };
                return self.finish(OutcomeKind::NoReply, None, Some(reason));
            }
        };
        let Some(held) = codec::words_at(point.at, point.at.span.first(), &words) else {
            return self.finish(OutcomeKind::NoReply, None, Some("the read-back was too short".into()));
        };
        let found = tell(device, self.point, known, &held);
        let cleared = is_self_clearing(write) && held.iter().all(|word| *word == 0);
        if held == field || cleared {
            return self.finish(OutcomeKind::Done, found, None);
        }
        if doubt == Some(Doubt::Accepted) && self.busy < BUSY_MAX {
            self.busy += 1;
            return Step::AskLater(PAUSE_BUSY, Call::Read(point.at.span));
        }
        let reason = match doubt {
            Some(Doubt::NoAnswer(error)) => error.to_string(),
            Some(Doubt::Accepted) => format!("{ACCEPTED}, but holds another value still"),
            Some(Doubt::Clamped) => "the device limits the value".to_string(),
            None => "the device holds another value".to_string(),
        };
        self.finish(OutcomeKind::NotTaken, found, Some(reason))
    }

    fn refused_by_device(&self, code: u8) -> Step {
        self.finish(OutcomeKind::Refused, None, Some(format!("exception {code} ({})", exception_name(code))))
    }

    fn finish(&self, kind: OutcomeKind, found: Option<String>, reason: Option<String>) -> Step {
        let reason = match (reason, &self.note) {
            (Some(reason), Some(note)) => Some(format!("{reason}; {note}")),
            (reason, note) => reason.or_else(|| note.clone()),
        };
        Step::Finished(Outcome { kind, wanted: self.wanted.clone(), found, reason, transaction: None })
    }
}

/// As it is, or the beginning of what is too long.
fn shortened(wanted: &str) -> String {
    if wanted.len() <= wish::BYTES_MAX {
        return wanted.to_string();
    }
    let beginning: String = wanted.chars().take(100).collect();
    format!("{beginning}…")
}

/// A read's words, one for each address: a bit is 0 or 1.
pub fn words_of(answer: &Answer) -> Vec<u16> {
    match answer {
        Answer::Words(words) => words.clone(),
        Answer::Bits(bits) => bits.iter().map(|bit| u16::from(*bit)).collect(),
        _ => Vec::new(),
    }
}

fn is_press(write: &Write) -> bool {
    matches!(write.rule, WriteRule::Press { .. })
}

fn is_self_clearing(write: &Write) -> bool {
    matches!(write.rule, WriteRule::Press { self_clearing: true, .. })
}

fn tell(device: &Device, point: PointIndex, known: &[Option<i128>], held: &[u16]) -> Option<String> {
    let resolved = codec::resolve(device, point, known).ok()?;
    Some(codec::read(&resolved, held).to_string())
}

/// The request that puts `words` at the point's place.
pub fn write_call(write: &Write, words: &[u16]) -> Call {
    let Address { span, .. } = write.at;
    let address = span.first();
    if span.table().is_bits() {
        let values: Vec<bool> = (0..span.count()).map(|bit| words[0] >> bit & 1 == 1).collect();
        return match (write.with, &values[..]) {
            (Some(WriteFunction::MultipleCoils), _) => Call::WriteCoils { address, values },
            (_, [on]) => Call::WriteCoil { address, on: *on },
            _ => Call::WriteCoils { address, values },
        };
    }
    match (write.with, words) {
        (Some(WriteFunction::MultipleRegisters), _) => {
            Call::WriteRegisters { address, words: words.to_vec() }
        }
        (_, [word]) => Call::WriteRegister { address, word: *word },
        _ => Call::WriteRegisters { address, words: words.to_vec() },
    }
}

/// The name of what a register holds, where a point of the whole register names that very value.
fn meaning_of_whole_register(device: &Device, register: Span, held: u16) -> Option<String> {
    device
        .points
        .iter()
        .filter(|point| point.at.span == register && point.at.bits.is_none())
        .filter_map(Point::plain)
        .find_map(|form| {
            let named = if let Names::Some(names) = &form.names { &names[..] } else { &[] };
            let mut meanings = named.iter().chain(&form.invalid);
            meanings
                .find(|(value, _)| *value == i128::from(held))
                .map(|(value, name)| format!("{value} ({name})"))
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_too_long_to_be_a_value_is_refused_and_not_repeated_as_a_whole() {
        assert_eq!(Outcome::of_too_long(&"7".repeat(wish::BYTES_MAX)), None);
        let outcome = Outcome::of_too_long(&"ß".repeat(5_000_000)).expect("it is refused");
        assert_eq!(outcome.kind, OutcomeKind::Refused);
        assert_eq!(outcome.wanted, format!("{}…", "ß".repeat(100)));
        assert_eq!(outcome.reason.as_deref(), Some("10000000 bytes are no value; expected at most 1024"));
        let outcome = Outcome::new(OutcomeKind::Expired, &"7".repeat(5_000_000), "too old");
        assert!(outcome.to_json().len() < 500);
    }
}
