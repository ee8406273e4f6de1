//! A bench for one device: requests and replies as hexadecimal text, on simulated time.

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{Addressed, LineSettings, Model, SimulatedDevice};
use crate::simulator::script::{Action, parse_line};

pub(crate) struct Bench {
    pub device: Box<dyn SimulatedDevice>,
    pub now: Time,
}

impl Bench {
    pub fn new(model: Model) -> Bench {
        let now = Time::from_millis(1000);
        Bench { device: model.build(now, LineSettings::default()), now }
    }

    pub fn wait(&mut self, millis: u64) {
        self.now += Duration::from_millis(millis);
    }

    /// Sends a PDU; `silence` is no reply. Spaces in `request` are for the reader.
    pub fn ask(&mut self, request: &str) -> String {
        self.send(Addressed::Unit, request)
    }

    pub fn send(&mut self, addressed: Addressed, request: &str) -> String {
        let digits: String = request.chars().filter(|letter| !letter.is_whitespace()).collect();
        let pdu: Vec<u8> = (0..digits.len())
            .step_by(2)
            .map(|at| u8::from_str_radix(&digits[at..at + 2], 16).expect("hexadecimal"))
            .collect();
        match self.device.request(self.now, addressed, &pdu) {
            Some(reply) => reply.iter().map(|byte| format!("{byte:02X}")).collect(),
            None => "silence".into(),
        }
    }

    /// Sends requests and compares the replies: the one place where tests of devices do it.
    #[track_caller]
    pub fn check(&mut self, rows: &[(&str, &str)]) {
        for (request, reply) in rows {
            let reply = reply.replace(' ', "");
            assert_eq!(self.ask(request), reply, "request {request} at {}", self.now);
        }
    }

    /// Does what a line of a script says, without `unit N`.
    #[track_caller]
    pub fn act(&mut self, command: &str) -> Result<(), String> {
        let step = parse_line(&format!("unit 1 {command}")).expect("a command").expect("not empty");
        match step.action {
            Action::Stimulate { stimulus, .. } => self.device.stimulate(self.now, &stimulus),
            Action::Restart { .. } => {
                self.device.restart(self.now);
                Ok(())
            }
            other => panic!("{other:?} is nothing for a device alone"),
        }
    }

    #[track_caller]
    pub fn output(&mut self, name: &str) -> String {
        self.device.advance(self.now);
        let outputs = self.device.outputs();
        outputs.into_iter().find(|(there, _)| there == name).expect("an output of this name").1
    }
}
