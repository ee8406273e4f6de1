//! One device by hand: which line, which unit, and a question with its answer.

use std::path::PathBuf;

use anyhow::{Context, anyhow};

use super::characters::Characters;
use super::{Failure, configuration, profiles, reach};
use crate::edge::clock::Clock;
use crate::edge::guarded_link::GuardedLink;
use crate::edge::link::Link;
use crate::engine::address::Span;
use crate::engine::codec::{self, Raw};
use crate::engine::command::{CommandFlow, Outcome, Step, words_of};
use crate::engine::device::{Device, PointIndex};
use crate::engine::identity::{self, Interview};
use crate::engine::modbus::guard::Guard;
use crate::engine::modbus::{Answer, Call, Request, RequestError};
use crate::engine::profile::Library;
use crate::engine::settings;
use crate::engine::time::Duration;
use crate::engine::yaml::Scalar;

/// Where the device is: for a verb's own arguments by `#[command(flatten)]`.
#[derive(Debug, clap::Args)]
pub struct ByHand {
    #[command(flatten)]
    line: WhichLine,
    /// The device's name in the configuration
    #[arg(long, value_name = "NAME", requires = "config")]
    device: Option<String>,
    /// Its profile, as `busker profiles list` tells them, or a file of one that ends in .yaml; with it
    /// points are known by their names
    #[arg(long, value_name = "ID", conflicts_with = "config")]
    profile: Option<String>,
    /// The device's unit on the line; 0 writes to all units of an RTU line
    #[arg(long, value_name = "UNIT", conflicts_with = "config")]
    unit: Option<u8>,
    #[command(flatten)]
    characters: Characters,
    /// How long a reply may take
    #[arg(long, value_name = "TIME", default_value = "500ms", value_parser = <Duration as Scalar>::parse, conflicts_with = "config")]
    timeout: Duration,
}

#[derive(Debug, clap::Args)]
#[group(required = true, multiple = false)]
struct WhichLine {
    /// RTU on this serial port
    #[arg(long, value_name = "PORT", requires = "unit")]
    serial: Option<String>,
    /// Modbus TCP at this address; without a port 502
    #[arg(long, value_name = "ADDRESS:PORT", requires = "unit")]
    tcp: Option<String>,
    /// RTU through a serial server at this address
    #[arg(long, value_name = "ADDRESS:PORT", requires = "unit")]
    rtu_over_tcp: Option<String>,
    /// The configuration that knows the device
    #[arg(long, value_name = "FILE", requires = "device")]
    config: Option<PathBuf>,
}

/// A device that can be asked.
pub struct Asked {
    link: GuardedLink,
    /// Unit 0 is every unit: on RTU, but not on Modbus TCP.
    broadcasts: bool,
    whom: Addressee,
}

/// Whom a question is for, and the rules of its profile, where that is known.
pub struct Addressee {
    pub unit: u8,
    /// How long a reply may take, unless the profile wants it longer.
    pub timeout: Duration,
    pub device: Option<Device>,
}

/// A question's fate: the device's word, or why there is none.
type Answered = Result<Answer, RequestError>;

impl ByHand {
    /// Opens the line.
    pub fn open(&self) -> Result<Asked, Failure> {
        let line = self.characters.line();
        let WhichLine { serial, tcp, rtu_over_tcp, .. } = &self.line;
        let Some(link) = reach::link([serial, tcp, rtu_over_tcp], line)? else {
            return self.open_configured();
        };
        let unit = self.unit.unwrap_or_default();
        let most = link.units_most();
        if unit > most {
            return Err(Failure::wrong(format!("there is no unit {unit} on a line; expected 1 to {most}")));
        }
        let device = self.profile.as_deref().map(profiles::load).transpose()?;
        open(&link, None, Addressee { unit, timeout: self.timeout, device })
    }

    /// The profiles that are known: the shipped ones, and over them those of the configuration.
    pub fn library(&self) -> Result<Library, Failure> {
        match &self.line.config {
            None => Ok(Library::shipped()),
            Some(path) => {
                configuration::load(path)?.map(|loaded| loaded.library).map_err(configuration::faults)
            }
        }
    }

    fn open_configured(&self) -> Result<Asked, Failure> {
        let path = self.line.config.clone().unwrap_or_default();
        let settings = configuration::ConfigurationArgs { config: path }.load()?;
        let name = self.device.as_deref().unwrap_or_default();
        let device = configuration::device_named(&settings, name)?;
        let bus = &settings.buses[device.bus];
        let own = Some(Device::clone(&device.device));
        let whom = Addressee { unit: device.unit, timeout: bus.response_timeout, device: own };
        open(&bus.link, bus.gap, whom)
    }
}

fn open(link: &settings::Link, gap: Option<Duration>, whom: Addressee) -> Result<Asked, Failure> {
    let opened = Link::open(link).map_err(|lost| anyhow!("{lost}"))?;
    let broadcasts = !matches!(link, settings::Link::Tcp { .. });
    if let Some(device) = &whom.device {
        std::thread::sleep(device.wire.connect_delay);
    }
    let link = GuardedLink::new(opened, Guard::new(link, gap), Clock::start());
    Ok(Asked { link, broadcasts, whom })
}

impl Addressee {
    /// One question. `Err` outside: the line is lost, or it cannot be asked.
    pub fn ask(&self, link: &mut GuardedLink, call: &Call) -> Result<Answered, Failure> {
        let (mut timeout, mut any_exception) = (self.timeout, false);
        if let Some(wire) = self.device.as_ref().map(|device| &device.wire) {
            std::thread::sleep(wire.limits.delay);
            timeout = timeout.max(wire.response_timeout.unwrap_or_default());
            any_exception = wire.quirks.exception_function_varies;
        }
        let request = Request { any_exception, ..Request::new(self.unit, call.clone()) };
        let reply = link.ask(&request, timeout).map_err(|lost| anyhow!("{lost}"))?;
        match reply.result {
            Err(RequestError::Impossible(reason)) => Err(Failure::wrong(format!("{call}: {reason}"))),
            result => Ok(result),
        }
    }
}

impl Asked {
    pub fn unit(&self) -> u8 {
        self.whom.unit
    }

    /// Its profile, where one is named.
    pub fn device(&self) -> Option<&Device> {
        self.whom.device.as_ref()
    }

    /// Whether what is asked goes to all units of the line, of which none answers.
    pub fn is_broadcast(&self) -> bool {
        self.unit() == 0 && self.broadcasts
    }

    /// One question. `Err` outside: the line is lost, or it cannot be asked.
    pub fn ask(&mut self, call: &Call) -> Result<Answered, Failure> {
        self.whom.ask(&mut self.link, call)
    }

    /// What the device says of itself, if it is the one of its profile. Without anything to identify it by
    /// there is nothing to say.
    pub fn identify(&mut self, device: &Device) -> Result<Option<String>, Failure> {
        let Some(identify) = &device.identify else { return Ok(None) };
        let unit = self.unit();
        let answer = match self.ask(&identity::question(identify))? {
            Ok(answer) => answer,
            Err(error) => {
                return Err(anyhow!("{error}")
                    .context(format!("unit {unit}: it does not identify itself"))
                    .into());
            }
        };
        identity::check(identify, &answer)
            .map(Some)
            .map_err(|found| anyhow!("unit {unit} is no {}: {found}", device.profile).into())
    }

    /// Asks everything that `interview` wants to know.
    pub fn interview(&mut self, mut interview: Interview) -> Result<Interview, Failure> {
        while let Some(call) = interview.question() {
            interview.answered(&self.ask(&call)?);
        }
        Ok(interview)
    }

    /// Takes every step of a command that begins with the question `first`.
    pub fn carry_out(
        &mut self,
        device: &Device,
        mut flow: CommandFlow,
        first: Call,
        known: &[Option<i128>],
    ) -> Result<Outcome, Failure> {
        let mut step = Step::Ask(first);
        loop {
            step = match step {
                Step::Finished(outcome) => return Ok(outcome),
                Step::Ask(call) => {
                    let result = self.ask(&call)?;
                    flow.answered(device, known, &result)
                }
                Step::AskLater(time, call) => {
                    std::thread::sleep(time);
                    Step::Ask(call)
                }
                Step::Settle(time) => {
                    std::thread::sleep(time);
                    Step::Ask(flow.settled(device))
                }
            };
        }
    }

    /// The words (a bit is 0 or 1) of `span`.
    pub fn read(&mut self, span: Span) -> Result<Vec<u16>, Failure> {
        let answer = self.ask(&Call::Read(span))?;
        let answer = answer.map_err(|error| anyhow!("{error}")).with_context(|| self.asking(span))?;
        Ok(words_of(&answer))
    }

    /// The point that is called `name`, and the device that knows it.
    pub fn point(&self, name: &str) -> Result<(Device, PointIndex), Failure> {
        let Some(device) = self.device() else {
            return Err(Failure::wrong(format!(
                "`{name}` is no address; expected one like `holding 0..3`, or a point's name with --config and --device, or with --profile"
            )));
        };
        match device.point_named(name) {
            Some(index) => Ok((device.clone(), index)),
            None => Err(Failure::wrong(format!(
                "`{name}` is no point of {} and no address like `holding 0..3`; `busker profiles show {0}` lists the points",
                device.profile
            ))),
        }
    }

    /// Reads what decides how `point` is understood, and what decides that.
    pub fn learn(
        &mut self,
        device: &Device,
        point: PointIndex,
        known: &mut [Option<i128>],
    ) -> Result<(), Failure> {
        for selector in device.points[point].selectors() {
            if known[selector].is_some() {
                continue;
            }
            self.learn(device, selector, known)?;
            let at = device.points[selector].at;
            let words = self.read(at.span)?;
            if let (Ok(resolved), Some(words)) =
                (codec::resolve(device, selector, known), codec::words_at(at, at.span.first(), &words))
            {
                if let Raw::Integer(raw) = codec::raw(resolved.form, &words) {
                    known[selector] = Some(raw);
                }
            }
        }
        Ok(())
    }

    fn asking(&self, span: Span) -> String {
        format!("unit {}: `{span}` cannot be read", self.unit())
    }
}

/// `holding 0..3`, if that is what `text` means; a word without a table is left to others.
pub fn span(text: &str) -> Option<Result<Span, Failure>> {
    let word = text.split_whitespace().next().unwrap_or_default();
    let is_address = text.contains(' ') || crate::engine::address::Table::from_name(word).is_some();
    is_address.then(|| <Span as Scalar>::parse(text).map_err(Failure::wrong))
}
