//! What a device says of itself and of its line: identification and diagnostics.

use serde_json::{Map, Value as Json, json};

use crate::engine::bus::device::DeviceState;
use crate::engine::identity::{Interview, Known};
use crate::engine::modbus::names::{COUNTERS, QUERY};
use crate::engine::modbus::{Answer, Call, RequestError};
use crate::engine::request::Status;

use super::Progress;

/// All objects of function 43/14, the server id of function 17, and what the profile goes by.
pub(super) struct Identification(Interview);

impl Identification {
    pub(super) fn new(device: &DeviceState) -> Identification {
        Identification(Interview::of_device(device.device().identify.clone(), Known::default()))
    }

    pub(super) fn begin(&self, device: &DeviceState) -> Progress {
        self.0.question().map_or_else(|| self.ended(device), Progress::Ask)
    }

    pub(super) fn answered(
        &mut self,
        device: &DeviceState,
        result: &Result<Answer, RequestError>,
    ) -> Progress {
        self.0.answered(result);
        self.begin(device)
    }

    fn ended(&self, device: &DeviceState) -> Progress {
        let Identification(interview) = self;
        let data = interview.json(("device", device.name().into()), Some(device.device()));
        if interview.was_heard() {
            return Progress::done(data);
        }
        let error = interview.silence().to_string();
        Progress::Done { status: Status::Error, data, error: Some(error) }
    }
}

/// Function 8: the echo of a query, then the device's counters; and what busker itself has counted.
#[derive(Default)]
pub(super) struct Diagnosis {
    echo: Json,
    found: Map<String, Json>,
    /// The echo is 0, the counters follow.
    step: usize,
}

impl Diagnosis {
    pub(super) fn begin(&self) -> Progress {
        Progress::Ask(Call::Diagnostics { function: 0, data: vec![QUERY] })
    }

    pub(super) fn answered(
        &mut self,
        device: &DeviceState,
        result: Result<Answer, RequestError>,
    ) -> Progress {
        let silence = match &result {
            Ok(_) | Err(RequestError::Exception(_)) => None,
            Err(error) => Some(error.to_string()),
        };
        let told = match (&result, self.step) {
            (Ok(Answer::Diagnostics(words)), 0) => (words[..] == [QUERY]).into(),
            (Ok(Answer::Diagnostics(words)), _) => words.first().copied().into(),
            (Ok(_), _) => Json::Null,
            (Err(error), _) => json!({"error": error.to_string()}),
        };
        match self.step {
            0 => self.echo = told,
            step => drop(self.found.insert(COUNTERS[step - 1].1.into(), told)),
        }
        // Who does not answer one of them would not answer eight more.
        match COUNTERS.get(self.step).filter(|_| silence.is_none()) {
            Some((function, _)) => {
                self.step += 1;
                Progress::Ask(Call::Diagnostics { function: *function, data: vec![0] })
            }
            None => {
                let own: Map<String, Json> = device
                    .counters()
                    .list()
                    .into_iter()
                    .map(|(name, count)| (name.into(), count.into()))
                    .collect();
                let data = json!({
                    "device": device.name(),
                    "echo": self.echo,
                    "counters": self.found,
                    "busker": own,
                });
                let status = if silence.is_none() { Status::Ok } else { Status::Error };
                Progress::Done { status, data, error: silence }
            }
        }
    }
}
