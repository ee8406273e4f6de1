//! What a device says of itself and of its line: identification and diagnostics.

use serde_json::{Map, Value as Json, json};

use crate::engine::bus::device::DeviceState;
use crate::engine::device::Identify;
use crate::engine::identity;
use crate::engine::modbus::names::{COUNTERS, QUERY, hexadecimal, object_name};
use crate::engine::modbus::{self, Answer, Call, RequestError};
use crate::engine::request::Status;

use super::Progress;

/// All objects of function 43/14, the server id of function 17, and what the profile goes by.
pub(super) struct Identification {
    step: Step,
    /// Objects so far; the profile's check wants them too.
    objects: Vec<(u8, String)>,
    server_id: Json,
    /// Why the objects end.
    error: Option<RequestError>,
    heard: bool,
}

enum Step {
    /// 1 basic, 2 regular, 3 extended, from this object on.
    Objects {
        code: u8,
        object: u8,
    },
    ServerId,
    Register,
}

impl Default for Identification {
    fn default() -> Identification {
        Identification {
            step: Step::Objects { code: 1, object: 0 },
            objects: Vec::new(),
            server_id: Json::Null,
            error: None,
            heard: false,
        }
    }
}

impl Identification {
    pub(super) fn begin(&self) -> Progress {
        Progress::Ask(Call::ReadIdentification { code: 1, object: 0 })
    }

    pub(super) fn answered(
        &mut self,
        device: &DeviceState,
        result: Result<Answer, RequestError>,
    ) -> Progress {
        // A refusal is an answer, silence is not.
        self.heard |= matches!(result, Ok(_) | Err(RequestError::Exception(_)));
        match self.step {
            Step::Objects { code, object } => {
                let next = match result {
                    Ok(Answer::Identification(found)) => self.take_objects(code, object, found),
                    Ok(_) => None,
                    Err(error) => {
                        self.error = Some(error);
                        None
                    }
                };
                match next {
                    Some((code, object)) => {
                        self.step = Step::Objects { code, object };
                        Progress::Ask(Call::ReadIdentification { code, object })
                    }
                    None => {
                        self.step = Step::ServerId;
                        Progress::Ask(Call::ReportServerId)
                    }
                }
            }
            Step::ServerId => {
                self.server_id = match result {
                    Ok(Answer::ServerId(bytes)) => hexadecimal(&bytes).into(),
                    Ok(_) => Json::Null,
                    Err(error) => json!({"error": error.to_string()}),
                };
                match &device.device().identify {
                    Some(identify @ Identify::Word { .. }) => {
                        self.step = Step::Register;
                        Progress::Ask(identity::question(identify))
                    }
                    Some(identify @ Identify::Names { .. }) => {
                        let objects = self.objects.clone();
                        let basic = modbus::Identification { conformity: 1, next: None, objects };
                        let checked = match &self.error {
                            Some(error) if self.objects.is_empty() => Err(error.to_string()),
                            _ => identity::check(identify, &Answer::Identification(basic)),
                        };
                        self.ended(device, Some(checked))
                    }
                    None => self.ended(device, None),
                }
            }
            Step::Register => {
                let checked = match (result, &device.device().identify) {
                    (Ok(answer), Some(identify)) => identity::check(identify, &answer),
                    (Err(error), _) => Err(error.to_string()),
                    (Ok(_), None) => Err("the profile goes by nothing".into()),
                };
                self.ended(device, Some(checked))
            }
        }
    }

    /// Keeps what came; returns where to go on, only ever upwards, so that it ends.
    fn take_objects(&mut self, code: u8, object: u8, found: modbus::Identification) -> Option<(u8, u8)> {
        self.objects.extend(found.objects.into_iter().filter(|(number, _)| *number >= object));
        if let Some(next) = found.next.filter(|next| *next > object) {
            return Some((code, next));
        }
        // The highest level that the device claims; bit 7 says that single objects may be asked for.
        match (code, found.conformity & 0x7F) {
            (1, 2 | 3) => Some((2, 3)),
            (2, 3) => Some((3, 0x80)),
            _ => None,
        }
    }

    fn ended(&self, device: &DeviceState, checked: Option<Result<String, String>>) -> Progress {
        let objects: Map<String, Json> =
            self.objects.iter().map(|(number, text)| (object_name(*number), text.clone().into())).collect();
        let profile = match checked {
            None => json!({"id": device.device().profile, "matches": null, "reason": "it goes by nothing"}),
            Some(Ok(found)) => json!({"id": device.device().profile, "matches": true, "found": found}),
            Some(Err(reason)) => json!({"id": device.device().profile, "matches": false, "reason": reason}),
        };
        let error = self.error.as_ref().map(RequestError::to_string);
        let data = json!({
            "device": device.name(),
            "objects": objects,
            "objects_error": error,
            "server_id": self.server_id,
            "profile": profile,
        });
        if self.heard {
            return Progress::done(data);
        }
        let error = error.unwrap_or_else(|| RequestError::Timeout.to_string());
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
