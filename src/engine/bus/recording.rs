//! The bus's flight recorder: what is worth a note on its tape, and when the tape becomes a file.

use serde_json::json;

use crate::engine::modbus::{Reply, RequestError};
use crate::engine::recorder::watch::{ASKED_MAX, Watch};
use crate::engine::recorder::{End, Recording, Tape};
use crate::engine::request::{Request, Status};
use crate::engine::settings;
use crate::engine::time::Time;

use super::{Action, Bus, Severity};

/// A file that has been made.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Saved {
    pub path: String,
    pub frames: usize,
    /// Why it was made, if not because somebody asked.
    pub why: String,
}

/// The tape, and what watches for trouble.
pub(super) struct Recorder {
    tape: Tape,
    watch: Watch,
    /// That no file can be made has been said.
    failed: bool,
}

impl Recorder {
    pub(super) fn new(settings: settings::Recorder) -> Recorder {
        Recorder { tape: Tape::new(settings.bytes), watch: Watch::new(settings.on_error), failed: false }
    }

    pub(super) fn due_at(&self) -> Option<Time> {
        self.watch.due_at()
    }
}

impl Bus {
    /// Where the edge puts what it sends and hears.
    pub fn tape(&mut self) -> &mut Tape {
        &mut self.recorder.tape
    }

    /// What was last on the wire; `None`: nothing is recorded.
    pub fn recording(&self, now: Time, why: &str) -> Option<Recording> {
        let tape = &self.recorder.tape;
        tape.is_on().then(|| tape.recording(now, &self.name, &self.link, why))
    }

    /// The request in flight to this device has ended. To be told before the device is.
    pub(super) fn record_reply(&mut self, device: Option<usize>, reply: &Reply) {
        let Some(end) = End::of(&reply.result) else { return };
        self.recorder.tape.ended(self.now, end);
        self.recorder.watch.request_ended();
        let device = device.and_then(|index| self.devices.get(index));
        let is_missed = device.is_some_and(|device| device.is_present());
        let trouble = match &reply.result {
            // Who is known to be away is not missed.
            Err(RequestError::Timeout | RequestError::Unreachable(_)) if is_missed => "no answer",
            Err(RequestError::Checksum) => "a damaged answer",
            Err(RequestError::WrongFrame) => "an answer that does not fit",
            Err(RequestError::Collision) => "a collision",
            _ if reply.discarded.checksum_errors > 0 => "a damaged frame",
            _ if reply.discarded.late_replies > 0 => "a late reply",
            _ if reply.discarded.foreign_frames > 0 => "a frame that nobody asked for",
            _ => return,
        };
        let told = || match device {
            Some(device) => format!("{trouble}, while {} was asked", device.name()),
            None => trouble.to_string(),
        };
        self.recorder.watch.trouble(self.now, told);
    }

    /// Something happened to the link.
    pub(super) fn record_note(&mut self, text: &str) {
        self.recorder.tape.said(self.now, text);
    }

    pub(super) fn record_trouble(&mut self, why: &str) {
        self.recorder.watch.trouble(self.now, || why.to_string());
    }

    /// Saves the tape, if something went wrong and has had time to show what follows.
    pub(super) fn save_trouble(&mut self) {
        if let Some(why) = self.recorder.watch.take(self.now, self.stopping) {
            self.save(&why, None);
        }
    }

    /// Somebody wants a file.
    pub(super) fn record(&mut self, request: Request) {
        if !self.recorder.tape.is_on() {
            return self.refuse(
                &request,
                "nothing is recorded; the configuration says `kilobytes: 0` under `recorder`",
            );
        }
        if let Err(wait) = self.recorder.watch.ask(self.now) {
            let reason = format!(
                "{ASKED_MAX} files were made on request within an hour, and more would wear out a memory card; ask \
                 again in {} min, or load the frames from the status page, which makes no file here",
                wait.as_secs().div_ceil(60)
            );
            return self.refuse(&request, &reason);
        }
        self.save("on request", Some(request));
    }

    fn save(&mut self, why: &str, request: Option<Request>) {
        if let Some(recording) = self.recording(self.now, why) {
            let (recording, keep) = (Box::new(recording), self.rules.recorder.keep);
            self.context.actions.push_back(Action::Record { recording, request, keep });
        }
    }

    /// The file was made, or not.
    pub(super) fn recorded(&mut self, request: Option<Request>, result: Result<Saved, String>) {
        match (request, result) {
            (Some(request), Ok(saved)) => {
                let data = json!({"bus": self.name, "file": saved.path, "frames": saved.frames});
                self.tell(&request, Status::Ok, data, None);
            }
            (Some(request), Err(reason)) => self.refuse(&request, &reason),
            (None, Ok(saved)) => {
                self.recorder.failed = false;
                let Saved { path, frames, why } = saved;
                let text = format!("bus {}: {why}; the last {frames} frames are in `{path}`", self.name);
                self.context.say(Severity::Info, text);
            }
            (None, Err(reason)) => {
                if !std::mem::replace(&mut self.recorder.failed, true) {
                    let text = format!("bus {}: the last frames cannot be saved: {reason}", self.name);
                    self.context.say(Severity::Warning, text);
                }
            }
        }
    }
}
