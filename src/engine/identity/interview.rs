//! Who a device is, question by question: what it says of itself, and which profiles that fits.
//!
//! Only what changes nothing is asked: its names (function 43/14), its server id (17), and registers that
//! profiles go by.

use std::collections::VecDeque;
use std::sync::Arc;

use serde_json::{Map, Value as Json, json};

use crate::engine::address::{Span, Table};
use crate::engine::device::{Device, Identify};
use crate::engine::modbus::names::{hexadecimal, object_name};
use crate::engine::modbus::{self, Answer, Call, RequestError};
use crate::engine::profile::Library;

use super::{check, question};

/// Each profile with what its device says of itself.
pub type Known = Arc<Vec<(String, Identify)>>;

/// What the profiles of `library` go by; one with a fault is not among them.
pub fn known(library: &Library) -> Known {
    let identify = |id: &str| Some((id.to_string(), library.load(id).ok()?.identify?));
    Arc::new(library.ids().into_iter().filter_map(identify).collect())
}

/// The profiles of `library` that go by nothing: their devices tell nobody who they are.
pub fn nameless(library: &Library) -> Vec<String> {
    let is_nameless = |id: &&str| library.load(id).is_ok_and(|device| device.identify.is_none());
    library.ids().into_iter().filter(is_nameless).map(String::from).collect()
}

/// The registers by which profiles know their devices, asked of one that does not tell its name.
const REGISTERS_MAX: usize = 4;
/// Read of a device that has answered nothing else: whoever it is says something to that, if only that it
/// has no such register.
pub const ANY_REGISTER: Span = Span::single(Table::Holding, 0);

/// One device that is asked who it is. Ask [`Interview::question`], tell [`Interview::answered`], until
/// there is no question any more.
#[derive(Clone, Debug)]
pub struct Interview {
    known: Known,
    whom: Whom,
    step: Step,
    registers: VecDeque<Span>,
    objects: Vec<(u8, String)>,
    /// Why the objects end.
    objects_error: Option<RequestError>,
    server_id: Option<Result<Vec<u8>, RequestError>>,
    words: Vec<(Span, Result<Answer, RequestError>)>,
    heard_by: Option<Call>,
}

#[derive(Clone, Debug)]
enum Whom {
    /// The device of a profile that goes by this.
    DeviceOf(Option<Identify>),
    Stranger,
    /// A stranger on a line that others need: the fewest questions.
    StrangerInBrief,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    /// 1 basic, 2 regular, 3 extended, from this object on.
    Objects {
        code: u8,
        object: u8,
    },
    ServerId,
    Registers,
}

impl Interview {
    /// Of the device that should be the one of a profile, which goes by `identify`.
    pub fn of_device(identify: Option<Identify>, known: Known) -> Interview {
        Interview::new(Whom::DeviceOf(identify), known)
    }

    /// Of a device of which nothing is known.
    pub fn of_stranger(known: Known) -> Interview {
        Interview::new(Whom::Stranger, known)
    }

    /// The same with its basic names only, or else the registers that profiles go by.
    pub fn in_brief(known: Known) -> Interview {
        Interview::new(Whom::StrangerInBrief, known)
    }

    fn new(whom: Whom, known: Known) -> Interview {
        Interview {
            known,
            whom,
            step: Step::Objects { code: 1, object: 0 },
            registers: VecDeque::new(),
            objects: Vec::new(),
            objects_error: None,
            server_id: None,
            words: Vec::new(),
            heard_by: None,
        }
    }

    /// What to ask next; `None`: all has been asked.
    pub fn question(&self) -> Option<Call> {
        match self.step {
            Step::Objects { code, object } => Some(Call::ReadIdentification { code, object }),
            Step::ServerId => Some(Call::ReportServerId),
            Step::Registers => self.registers.front().copied().map(Call::Read),
        }
    }

    /// The fate of [`Interview::question`].
    pub fn answered(&mut self, result: &Result<Answer, RequestError>) {
        // A refusal is an answer, silence is not.
        let is_heard = matches!(result, Ok(_) | Err(RequestError::Exception(_)));
        if is_heard && self.heard_by.is_none() {
            self.heard_by = self.question();
        }
        match self.step {
            Step::Objects { code, object } => {
                let next = match result {
                    Ok(Answer::Identification(found)) => self.take_objects(code, object, found),
                    Ok(_) => None,
                    Err(error) => {
                        self.objects_error = Some(error.clone());
                        None
                    }
                };
                match (next, &self.whom) {
                    (Some((code, object)), Whom::DeviceOf(_) | Whom::Stranger) => {
                        self.step = Step::Objects { code, object };
                    }
                    (None, Whom::DeviceOf(_) | Whom::Stranger) => self.step = Step::ServerId,
                    (_, Whom::StrangerInBrief) => self.begin_registers(is_heard),
                }
            }
            Step::ServerId => {
                self.server_id = match result {
                    Ok(Answer::ServerId(bytes)) => Some(Ok(bytes.clone())),
                    Ok(_) => None,
                    Err(error) => Some(Err(error.clone())),
                };
                self.begin_registers(true);
            }
            Step::Registers => {
                if let Some(at) = self.registers.pop_front() {
                    self.words.push((at, result.clone()));
                }
                let is_enough = match self.whom {
                    Whom::DeviceOf(_) => false,
                    Whom::Stranger => self.only_fitting().is_some(),
                    Whom::StrangerInBrief => !is_heard || self.only_fitting().is_some(),
                };
                if is_enough {
                    self.registers.clear();
                }
                self.ask_any_register();
            }
        }
    }

    fn begin_registers(&mut self, may_ask: bool) {
        self.step = Step::Registers;
        self.registers = match &self.whom {
            Whom::DeviceOf(Some(Identify::Word { at, .. })) => [*at].into(),
            Whom::Stranger | Whom::StrangerInBrief if may_ask && self.objects.is_empty() => {
                let mut registers = VecDeque::new();
                for (_, identify) in self.known.iter() {
                    if let Identify::Word { at, .. } = identify {
                        if !registers.contains(at) && registers.len() < REGISTERS_MAX {
                            registers.push_back(*at);
                        }
                    }
                }
                registers
            }
            _ => VecDeque::new(),
        };
        self.ask_any_register();
    }

    fn ask_any_register(&mut self) {
        let has_asked = self.words.iter().any(|(at, _)| *at == ANY_REGISTER);
        if matches!(self.whom, Whom::Stranger) && self.registers.is_empty() && !self.was_heard() && !has_asked
        {
            self.registers.push_back(ANY_REGISTER);
        }
    }

    /// Keeps what came; returns where to go on, only ever upwards, so that it ends.
    fn take_objects(&mut self, code: u8, object: u8, found: &modbus::Identification) -> Option<(u8, u8)> {
        let wanted = found.objects.iter().filter(|(number, _)| *number >= object);
        self.objects.extend(wanted.cloned());
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

    // What came out.

    /// Whether the device has answered anything, if only by a refusal.
    pub fn was_heard(&self) -> bool {
        self.heard_by.is_some()
    }

    /// The first question that it has answered.
    pub fn heard_by(&self) -> Option<&Call> {
        self.heard_by.as_ref()
    }

    /// The objects of function 43/14 by their numbers.
    pub fn objects(&self) -> &[(u8, String)] {
        &self.objects
    }

    /// Why there are no more of them.
    pub fn objects_error(&self) -> Option<&RequestError> {
        self.objects_error.as_ref()
    }

    /// The answer to function 17; `None`: not asked, or not answered by one.
    pub fn server_id(&self) -> Option<&Result<Vec<u8>, RequestError>> {
        self.server_id.as_ref()
    }

    /// Why nothing was heard, and where to look.
    pub fn why_unheard(&self) -> String {
        let error = self.silence();
        format!("{error}{}", error.advice())
    }

    /// The fate of the first question, where nothing was heard.
    pub fn silence(&self) -> &RequestError {
        self.objects_error.as_ref().unwrap_or(&RequestError::Timeout)
    }

    /// The objects by their names, as programs are told them.
    pub fn objects_json(&self) -> Map<String, Json> {
        self.objects.iter().map(|(number, text)| (object_name(*number), text.clone().into())).collect()
    }

    /// The server id, as programs are told it.
    pub fn server_id_json(&self) -> Json {
        match &self.server_id {
            Some(Ok(bytes)) => hexadecimal(bytes).into(),
            Some(Err(error)) => json!({"error": error.to_string()}),
            None => Json::Null,
        }
    }

    /// What `whom` has said, and whether it is the one that `device` describes, as programs are told it.
    pub fn json(&self, whom: (&str, Json), device: Option<&Device>) -> Json {
        let profile = device.map(|device| {
            let id = &device.profile;
            match device.identify.as_ref().map(|identify| self.check(identify)) {
                None => json!({"id": id, "matches": null, "reason": "it goes by nothing"}),
                Some(Ok(found)) => json!({"id": id, "matches": true, "found": found}),
                Some(Err(reason)) => json!({"id": id, "matches": false, "reason": reason}),
            }
        });
        json!({
            whom.0: whom.1,
            "objects": self.objects_json(),
            "objects_error": self.objects_error.as_ref().map(RequestError::to_string),
            "server_id": self.server_id_json(),
            "profile": profile,
        })
    }

    /// What the device calls itself: its names, one behind the other.
    pub fn names(&self) -> Option<String> {
        let texts: Vec<&str> = self.objects.iter().map(|(_, text)| text.as_str()).collect();
        let is_named = self.objects_error.is_none() || !texts.is_empty();
        (is_named && matches!(self.step, Step::ServerId | Step::Registers)).then(|| texts.join(" "))
    }

    /// What it has said if it is the device that goes by `identify`, else what is wrong with that.
    pub fn check(&self, identify: &Identify) -> Result<String, String> {
        match question(identify) {
            Call::Read(at) => match self.words.iter().find(|(asked, _)| *asked == at) {
                Some((_, Ok(answer))) => check(identify, answer),
                Some((_, Err(error))) => Err(error.to_string()),
                None => Err(format!("`{at}` was not read")),
            },
            _ => match &self.objects_error {
                Some(error) if self.objects.is_empty() => Err(error.to_string()),
                _ => {
                    let objects = self.objects.clone();
                    let names = modbus::Identification { conformity: 1, next: None, objects };
                    check(identify, &Answer::Identification(names))
                }
            },
        }
    }

    /// The profiles that what the device said fits, each with that.
    pub fn fitting(&self) -> Vec<(&str, String)> {
        let told = |entry: &'_ (String, Identify)| self.check(&entry.1).ok();
        self.known.iter().filter_map(|entry| Some((entry.0.as_str(), told(entry)?))).collect()
    }

    /// The one that fits, where no other does.
    pub fn only_fitting(&self) -> Option<(&str, String)> {
        let mut fitting = self.fitting();
        fitting.pop().filter(|_| fitting.is_empty())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::modbus::Identification;

    const WORD: Span = Span::single(Table::Input, 0);

    fn known() -> Known {
        let names = |product: &str| Identify::Names { vendor: "ACME".into(), product: product.into() };
        let word = Identify::Word { at: WORD, mask: 0xFF00, equals: 0x4000 };
        Arc::new(vec![("acme/l1".into(), names("L1")), ("acme/board".into(), word)])
    }

    fn names(conformity: u8, next: Option<u8>, objects: &[(u8, &str)]) -> Result<Answer, RequestError> {
        let objects = objects.iter().map(|(number, text)| (*number, text.to_string())).collect();
        Ok(Answer::Identification(Identification { conformity, next, objects }))
    }

    /// Holds the interview with a device that answers so; gives the questions.
    fn hold(interview: &mut Interview, answer: impl Fn(&Call) -> Result<Answer, RequestError>) -> String {
        let mut asked = Vec::new();
        while let Some(call) = interview.question() {
            asked.push(call.to_string());
            interview.answered(&answer(&call));
            assert!(asked.len() < 20, "it does not end: {asked:?}");
        }
        asked.join(", ")
    }

    #[test]
    fn names_are_asked_for_while_more_follow_and_then_the_levels_that_the_device_claims() {
        let device = |call: &Call| match call {
            Call::ReadIdentification { code: 1, object: 0 } => names(3, Some(2), &[(0, "ACME"), (1, "L1")]),
            Call::ReadIdentification { code: 1, object: 2 } => names(3, None, &[(2, "V2")]),
            Call::ReadIdentification { code: 2, object: 3 } => names(3, None, &[(0, "ACME"), (5, "Heater")]),
            // It begins again; asked on, it would do so for ever.
            Call::ReadIdentification { code: 3, .. } => names(3, Some(0), &[(0x80, "own")]),
            _ => Ok(Answer::ServerId(vec![0x0A])),
        };
        let mut interview = Interview::of_stranger(known());
        let asked = "identification 1 0, identification 1 2, identification 2 3, identification 3 128, \
                     report server id";
        assert_eq!(hold(&mut interview, device), asked);
        assert_eq!(interview.names().as_deref(), Some("ACME L1 V2 Heater own"));
        assert_eq!(interview.fitting(), [("acme/l1", "ACME L1 V2".to_string())]);
        assert_eq!(interview.server_id(), Some(&Ok(vec![0x0A])));
    }

    #[test]
    fn a_device_without_names_is_known_by_the_registers_that_profiles_go_by() {
        let board = |call: &Call| match call {
            Call::Read(_) => Ok(Answer::Words(vec![0x4007])),
            _ => Err(RequestError::Exception(1)),
        };
        let silent_to_what_it_does_not_know = |call: &Call| match call {
            Call::Read(_) => Ok(Answer::Words(vec![0x4007])),
            _ => Err(RequestError::Timeout),
        };
        let all = "identification 1 0, report server id, read input 0";
        let mut interview = Interview::of_stranger(known());
        assert_eq!(hold(&mut interview, board), all);
        assert_eq!(interview.fitting(), [("acme/board", "0x4007".to_string())]);
        assert_eq!(interview.names(), None);
        let mut interview = Interview::of_stranger(known());
        assert_eq!(hold(&mut interview, silent_to_what_it_does_not_know), all);
        assert_eq!(interview.fitting().len(), 1);
        let mut interview = Interview::in_brief(known());
        assert_eq!(hold(&mut interview, board), "identification 1 0, read input 0");
        assert_eq!(interview.fitting().len(), 1);
    }

    #[test]
    fn silence_ends_what_is_asked_in_brief_and_elsewhere_any_register_has_the_last_word() {
        let silence = |_: &Call| Err(RequestError::Timeout);
        let mut interview = Interview::in_brief(known());
        assert_eq!(hold(&mut interview, silence), "identification 1 0");
        assert!(!interview.was_heard());
        let mut interview = Interview::of_stranger(known());
        let asked = "identification 1 0, report server id, read input 0, read holding 0";
        assert_eq!(hold(&mut interview, silence), asked);
        assert!(!interview.was_heard());
    }

    #[test]
    fn of_a_device_with_a_profile_only_what_that_goes_by_is_read() {
        let refusing = |_: &Call| Err(RequestError::Exception(1));
        let mut interview = Interview::of_device(None, known());
        assert_eq!(hold(&mut interview, refusing), "identification 1 0, report server id");
        let at = Span::single(Table::Holding, 9);
        let own = Identify::Word { at, mask: 0xFFFF, equals: 0x4711 };
        let mut interview = Interview::of_device(Some(own.clone()), known());
        assert_eq!(hold(&mut interview, refusing), "identification 1 0, report server id, read holding 9");
        assert_eq!(interview.check(&own), Err("exception 1 (illegal function)".to_string()));
    }
}
