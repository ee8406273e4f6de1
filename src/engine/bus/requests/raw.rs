//! Words as they are: read from a span of a device, and written to one, read back.

use serde_json::json;

use crate::engine::address::{Span, Table};
use crate::engine::bus::Context;
use crate::engine::bus::device::DeviceState;
use crate::engine::command::{ACCEPTED, BUSY_MAX, PAUSE_BUSY, words_of};
use crate::engine::device::{PointIndex, WriteFunction};
use crate::engine::modbus::{ACKNOWLEDGE, Answer, BUSY, Call, ILLEGAL_VALUE, RequestError, exception_name};
use crate::engine::request::Status;
use crate::engine::time::{Duration, Time};

use super::Progress;

/// One read of a span.
pub(super) struct RawRead {
    pub(super) span: Span,
}

impl RawRead {
    pub(super) fn begin(&self) -> Progress {
        Progress::Ask(Call::Read(self.span))
    }

    pub(super) fn answered(
        &mut self,
        now: Time,
        device: &mut DeviceState,
        result: Result<Answer, RequestError>,
        context: &mut Context,
    ) -> Progress {
        match result {
            Ok(answer) => {
                let words = words_of(&answer);
                device.read_for_request(now, self.span, &words, context);
                let points = device.readings_in(self.span, &words);
                Progress::done(json!({"at": self.span.to_string(), "words": words, "points": points}))
            }
            Err(error) => Progress::failed(error.to_string()),
        }
    }
}

/// A write of words that no point of the profile describes: read before where it matters (EEPROM),
/// written, read back.
pub(super) struct RawWrite {
    span: Span,
    words: Vec<u16>,
    /// The points that the span touches.
    points: Vec<PointIndex>,
    call: Call,
    settle: Duration,
    state: State,
    /// How often the device was too busy for it.
    busy: u32,
}

enum State {
    ReadingBefore,
    Writing,
    /// What was wrong with the write's own answer.
    ReadingBack(Option<RequestError>),
}

/// The device is still doing what it has been told.
const ACCEPTED_ONLY: RequestError = RequestError::Exception(ACKNOWLEDGE);

impl RawWrite {
    pub(super) fn new(span: Span, words: Vec<u16>, device: &DeviceState) -> Result<RawWrite, String> {
        let points = device.points_touching(span);
        let writes = || points.iter().filter_map(|point| device.details(*point).write.as_ref());
        let only = writes().find_map(|write| write.with);
        let call = call(span, &words, only)?;
        let settle = writes().map(|write| write.settle).max().unwrap_or_default();
        Ok(RawWrite { span, words, points, call, settle, state: State::Writing, busy: 0 })
    }

    pub(super) fn points(&self) -> &[PointIndex] {
        &self.points
    }

    pub(super) fn begin(&mut self, device: &DeviceState) -> Progress {
        if self.points.iter().any(|point| device.details(*point).persistent) {
            self.state = State::ReadingBefore;
            return Progress::Ask(Call::Read(self.span));
        }
        Progress::Ask(self.call.clone())
    }

    pub(super) fn answered(
        &mut self,
        now: Time,
        device: &mut DeviceState,
        result: Result<Answer, RequestError>,
        context: &mut Context,
    ) -> Progress {
        if let Some(call) = self.busy_with(&result) {
            self.busy += 1;
            return Progress::Settle(PAUSE_BUSY, call);
        }
        match &self.state {
            State::ReadingBefore => match result {
                Ok(answer) => {
                    let found = words_of(&answer);
                    device.read_for_request(now, self.span, &found, context);
                    if found == self.words {
                        return self.ended("unchanged", Some(&found), None);
                    }
                    if let Some(reason) = device.why_spared(now, &self.points) {
                        return self.ended("refused", Some(&found), Some(reason));
                    }
                    self.state = State::Writing;
                    Progress::Ask(self.call.clone())
                }
                Err(RequestError::Exception(code)) => self.refused(code),
                Err(error) => self.ended("no_reply", None, Some(format!("nothing was written: {error}"))),
            },
            State::Writing => {
                let doubt = match result {
                    Ok(_) => None,
                    Err(error @ RequestError::Exception(ILLEGAL_VALUE)) if device.clamps_with_exception() => {
                        Some(error)
                    }
                    Err(ACCEPTED_ONLY) => Some(ACCEPTED_ONLY),
                    Err(RequestError::Exception(code)) => return self.refused(code),
                    Err(RequestError::Impossible(reason)) => {
                        return self.ended("refused", None, Some(reason.into()));
                    }
                    // Never repeated: what the device holds now decides.
                    Err(error) => Some(error),
                };
                let is_doing_it = doubt == Some(ACCEPTED_ONLY);
                let settle = if is_doing_it { self.settle.max(PAUSE_BUSY) } else { self.settle };
                self.state = State::ReadingBack(doubt);
                let call = Call::Read(self.span);
                if settle.is_zero() { Progress::Ask(call) } else { Progress::Settle(settle, call) }
            }
            State::ReadingBack(doubt) => match result {
                Ok(answer) => {
                    let found = words_of(&answer);
                    device.read_for_request(now, self.span, &found, context);
                    if found == self.words {
                        return self.ended("done", Some(&found), None);
                    }
                    if *doubt == Some(ACCEPTED_ONLY) && self.busy < BUSY_MAX {
                        self.busy += 1;
                        return Progress::Settle(PAUSE_BUSY, Call::Read(self.span));
                    }
                    let reason = match doubt {
                        Some(ACCEPTED_ONLY) => format!("{ACCEPTED}, but holds something else still"),
                        Some(RequestError::Exception(_)) => "the device limits the value".into(),
                        Some(error) => error.to_string(),
                        None => "the device holds another value".into(),
                    };
                    self.ended("not_taken", Some(&found), Some(reason))
                }
                Err(error) => {
                    let reason = match doubt {
                        Some(ACCEPTED_ONLY) => format!("{ACCEPTED}, but it was not read back: {error}"),
                        Some(of_write) => of_write.to_string(),
                        None => format!("written, but not read back: {error}"),
                    };
                    self.ended("no_reply", None, Some(reason))
                }
            },
        }
    }

    /// What is asked again because the device had no time for it: as of commands, nothing that it has said it does.
    fn busy_with(&self, result: &Result<Answer, RequestError>) -> Option<Call> {
        let is_writing = matches!(self.state, State::Writing);
        let is_busy = match result {
            Err(RequestError::Exception(BUSY)) => true,
            Err(ACCEPTED_ONLY) => !is_writing,
            _ => false,
        };
        let call = if is_writing { self.call.clone() } else { Call::Read(self.span) };
        (is_busy && self.busy < BUSY_MAX).then_some(call)
    }

    /// Why it has not ended well, when nothing more can be asked.
    pub(super) fn broken(&self, reason: &str) -> String {
        match self.state {
            State::ReadingBefore => format!("nothing was written: {reason}"),
            State::Writing => reason.to_string(),
            State::ReadingBack(_) => format!("written, but not read back: {reason}"),
        }
    }

    fn refused(&self, code: u8) -> Progress {
        self.ended("refused", None, Some(format!("exception {code} ({})", exception_name(code))))
    }

    fn ended(&self, outcome: &str, found: Option<&[u16]>, reason: Option<String>) -> Progress {
        let data = json!({
            "at": self.span.to_string(),
            "outcome": outcome,
            "wanted": self.words,
            "found": found,
            "reason": reason,
        });
        let status = if reason.is_none() { Status::Ok } else { Status::Error };
        Progress::Done { status, data, error: reason }
    }
}

/// The request that puts `words` at `span`; `only` is the one function that some point there takes.
fn call(span: Span, words: &[u16], only: Option<WriteFunction>) -> Result<Call, String> {
    let address = span.first();
    let values = || words.iter().map(|word| *word == 1).collect();
    match (span.table(), words, only) {
        (Table::Coil, [word], None | Some(WriteFunction::SingleCoil)) => {
            Ok(Call::WriteCoil { address, on: *word == 1 })
        }
        (Table::Coil, _, None | Some(WriteFunction::MultipleCoils)) => {
            Ok(Call::WriteCoils { address, values: values() })
        }
        (Table::Holding, [word], None | Some(WriteFunction::SingleRegister)) => {
            Ok(Call::WriteRegister { address, word: *word })
        }
        (Table::Holding, _, None | Some(WriteFunction::MultipleRegisters)) => {
            Ok(Call::WriteRegisters { address, words: words.to_vec() })
        }
        (table, _, Some(only)) => {
            Err(format!("the device takes only function {} here; expected a single {table}", only.code()))
        }
        (table, _, None) => Err(format!("`{table}` can only be read")),
    }
}
