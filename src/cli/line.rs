//! `busker line`: changes the line settings of one device, and says in which state it is afterwards.

use std::io::{self, BufRead, IsTerminal};

use anyhow::anyhow;

use super::by_hand::Addressee;
use super::reach::Reach;
use super::{Failure, output, profiles};
use crate::edge::clock::Clock;
use crate::edge::link::Lost;
use crate::engine::device::Device;
use crate::engine::identity::{self, Interview};
use crate::engine::line_change::{LineChange, Outcome, Refusal, profile_of, why_no_unit};
use crate::engine::modbus::{Answer, Call, RequestError};
use crate::engine::profile::Library;
use crate::engine::settings::{self, Line, Parity, Rs485};
use crate::engine::time::Duration;
use crate::engine::yaml::Scalar;

/// Change the bit rate and parity of one device
///
/// Asks the device who it is with the settings that it has (--baud and --parity), looks into its profile for
/// how they are set, looks whether the port takes the new ones, asks for a yes, asks the device once more,
/// and writes once. Then the device has to answer with the new settings; where it does not, it is looked for
/// with the old ones, and told is in which state it is. Never goes to more than one device. Nobody else may
/// speak on the line meanwhile: stop the service first.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:
  busker line --serial /dev/ttyUSB0 --baud 9600 --parity none --unit 18 --set 19200,even --yes")]
pub struct Args {
    /// The serial port
    #[arg(long, value_name = "PORT")]
    serial: String,
    /// The device's unit
    #[arg(long, value_name = "UNIT", value_parser = clap::value_parser!(u8).range(1..=247))]
    unit: u8,
    /// The bit rate that it has
    #[arg(long, value_name = "RATE", default_value_t = 19200, value_parser = clap::value_parser!(u32).range(300..=1_000_000))]
    baud: u32,
    /// The parity that it has: even, odd or none
    #[arg(long, default_value = "even", value_parser = <Parity as Scalar>::parse)]
    parity: Parity,
    /// The bit rate and parity that it shall have: `19200,even`
    #[arg(long, value_name = "RATE,PARITY", value_parser = wanted, required_unless_present = "set_unit")]
    set: Option<Line>,
    /// The unit that it shall have; most devices have switches for that, and then this says which
    #[arg(long, value_name = "UNIT", value_parser = clap::value_parser!(u8).range(1..=247), conflicts_with = "set")]
    set_unit: Option<u8>,
    /// Its profile, for a device that tells nobody who it is
    #[arg(long, value_name = "ID")]
    profile: Option<String>,
    /// Write without asking
    #[arg(long)]
    yes: bool,
    /// How long a reply may take
    #[arg(long, value_name = "TIME", default_value = "500ms", value_parser = <Duration as Scalar>::parse)]
    timeout: Duration,
}

/// Reads `19200,even`.
fn wanted(text: &str) -> Result<Line, String> {
    let shape = || format!("`{text}` is no bit rate and parity; expected them as in `19200,even`");
    let (baud, parity) = text.split_once(',').ok_or_else(shape)?;
    let baud = baud.trim().parse().map_err(|_| shape())?;
    let parity = <Parity as Scalar>::parse(parity.trim()).map_err(|_| shape())?;
    Ok(Line { baud, parity, stop_bits: 1 })
}

pub fn run(args: Args) -> Result<(), Failure> {
    let may_ask = io::stdin().is_terminal();
    if args.set.is_some() && !args.yes && !may_ask {
        return Err(Failure::wrong(
            "nobody can be asked here whether this shall be written; `--yes` says so beforehand, and nothing was asked of \
             the device",
        ));
    }
    let given = args.profile.as_deref().map(profiles::load).transpose()?;
    let from = Line { baud: args.baud, parity: args.parity, stop_bits: 1 };
    let mut edge = Edge::new(&args, from);
    // Its rules hold from the first question on.
    edge.knows(given.as_ref());
    let interview = edge.interview(from)?;
    let profile = profile_of(&interview, given.as_ref()).map_err(|refusal| args.refused(refusal))?;
    let device = match given {
        Some(given) => given,
        None => profiles::load(profile)?,
    };
    edge.knows(Some(&device));
    let who = interview.names().unwrap_or_else(|| "a device that does not tell its names".into());
    eprintln!("unit {} at {from}: {who} ({})", args.unit, device.profile);
    let Some(to) = args.set else {
        return Err(args.refused(Refusal::Wish(why_no_unit(&device))));
    };
    match LineChange::of(&device, &interview, from, to).map_err(|refusal| args.refused(refusal))? {
        None => output::print(&format!("unit {} has {from} already; nothing was written\n", args.unit)),
        Some(change) => edge.change(&device, change, may_ask),
    }
}

impl Args {
    fn refused(&self, refusal: Refusal) -> Failure {
        match refusal {
            Refusal::Device(reason) => {
                let unit = self.unit;
                anyhow!("unit {unit} at {} {}: {reason}; nothing was written", self.baud, self.parity).into()
            }
            Refusal::Wish(reason) => Failure::wrong(format!("{reason}; nothing was written")),
        }
    }
}

/// What talks to the device.
struct Edge<'a> {
    args: &'a Args,
    reach: Reach,
    whom: Addressee,
}

impl Edge<'_> {
    fn new(args: &Args, line: Line) -> Edge<'_> {
        let link = settings::Link::Serial { path: args.serial.clone(), line, rs485: Rs485::Auto };
        let whom = Addressee { unit: args.unit, timeout: args.timeout, device: None };
        Edge { args, reach: Reach::new(link, Clock::start()), whom }
    }

    /// From here on it is asked by the rules of this profile.
    fn knows(&mut self, device: Option<&Device>) {
        self.whom.device = device.cloned();
        self.reach.connect_delay = device.map(|device| device.wire.connect_delay).unwrap_or_default();
    }

    fn interview(&mut self, line: Line) -> Result<Interview, Failure> {
        let library = Library::shipped();
        let mut interview = Interview::of_stranger(identity::known(&library));
        while let Some(call) = interview.question() {
            interview.answered(&self.ask(line, &call)?);
        }
        Ok(interview)
    }

    fn change(&mut self, device: &Device, change: LineChange, may_ask: bool) -> Result<(), Failure> {
        let (unit, from, to) = (self.args.unit, change.from, change.to);
        eprintln!("it shall have {to} instead of {from}");
        let nothing = |failure: Failure| failure.context("nothing was written");
        // A port that does not take the new settings could not look for the device behind the write.
        self.open(to).map_err(nothing)?;
        let may_write = self.args.yes || (may_ask && says_yes()?);
        if !may_write {
            return Err(anyhow!("nothing was written").into());
        }
        // It may have been exchanged while somebody thought about it; and of a link that was opened anew nobody knows
        // yet whether it returns what is sent, which a confirmation would look like.
        let who = self.ask(from, &change.question()).map_err(nothing)?;
        change.allow(&who).map_err(|refusal| self.args.refused(refusal))?;
        let sent = move |failure: Failure| {
            failure.context(format!(
                "unit {unit} was sent the settings {to}, and has these or still {from}; `busker scan` finds out which"
            ))
        };
        let written = self.ask(from, &change.call()).map_err(sent)?;
        let told = match &written {
            Ok(_) => "written".to_string(),
            Err(error) => format!("sent, and not confirmed: {error}"),
        };
        eprintln!("{told}; looking for it");
        let mut verification = change.written(written);
        while let Some((line, call)) = verification.question() {
            verification.answered(&self.ask(line, &call).map_err(sent)?);
        }
        match verification.outcome() {
            Outcome::Changed => {
                output::print(&format!("unit {unit} has {to} now\n"))?;
                eprintln!(
                    "the other devices of its line keep theirs; when all have {to}, the bus in the configuration wants \
                     `baud: {}` and `parity: {}`",
                    to.baud,
                    to.parity
                );
                Ok(())
            }
            Outcome::AsBefore(why) => {
                Err(anyhow!("unit {unit} has {from} as before: {why}; it works on with these").into())
            }
            Outcome::Another(reason) => Err(anyhow!(
                "with {to} another device answers at unit {unit}: {reason}; two devices may have this unit now. Connect \
                 one alone, and give it another"
            )
            .into()),
            Outcome::Lost => Err(anyhow!("{}", lost(self.args, device, from, to)).into()),
        }
    }

    fn open(&mut self, line: Line) -> Result<(), Failure> {
        self.reach.at(Some(line)).map(drop).map_err(|Lost(why)| anyhow!(why).into())
    }

    fn ask(&mut self, line: Line, call: &Call) -> Result<Result<Answer, RequestError>, Failure> {
        let link = self.reach.at(Some(line)).map_err(|Lost(why)| anyhow!(why))?;
        self.whom.ask(link, call)
    }
}

/// What is known of a device that answers with neither settings, and what to do.
fn lost(args: &Args, device: &Device, from: Line, to: Line) -> String {
    let unit = args.unit;
    format!(
        "unit {unit} answers neither with {to} nor with {from}. It may have taken the new settings while the line was \
         disturbed: switch it off and on, then `busker scan --serial {} --units {unit}` looks for it with all settings. \
         If that does not find it, its manual ({}) says how the settings are set at the device itself",
        args.serial,
        device.source.trim()
    )
}

/// Asks the person in front of the terminal.
fn says_yes() -> Result<bool, Failure> {
    eprintln!("write it? `yes` does it, anything else does not");
    let mut answer = String::new();
    io::stdin().lock().read_line(&mut answer)?;
    Ok(answer.trim() == "yes")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_are_a_bit_rate_and_a_parity() {
        let line = |baud, parity| Ok(Line { baud, parity, stop_bits: 1 });
        assert_eq!(wanted("19200,even"), line(19_200, Parity::Even));
        assert_eq!(wanted("9600, none"), line(9600, Parity::None));
        for wrong in ["19200", "19200,mark", "fast,even", ""] {
            assert!(wanted(wrong).is_err(), "{wrong}");
        }
    }
}
