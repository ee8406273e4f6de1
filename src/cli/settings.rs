//! `busker settings`: what a device's settings hold, as text that can be declared, and how they become so.

use std::fs;
use std::io::{IsTerminal, Write};
use std::path::PathBuf;

use anyhow::{Context, anyhow};
use clap::Subcommand;

use super::by_hand::{Asked, ByHand};
use super::output::{self, Table};
use super::{Failure, configuration};
use crate::engine::codec;
use crate::engine::command::{CommandFlow, OutcomeKind, words_of};
use crate::engine::configuration::load_wanted;
use crate::engine::device::{Device, PointIndex};
use crate::engine::memory::Memory;
use crate::engine::modbus::{Call, RequestError};
use crate::engine::plan::{self, Cost, Read};
use crate::engine::settings::Wanted;
use crate::engine::state::Values;
use crate::engine::time::Time;
use crate::engine::upkeep::{Standing, Upkeep};
use crate::engine::value::{Missing, Reading};
use crate::engine::wanted;

/// Show a device's settings as text, or write them from it
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  busker settings dump --config busker.yaml --device heating_relays")]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Print what the settings of a device hold, as it can stand under its `settings:`
    ///
    /// Settings are the points that the device keeps, and those that its profile marks as configuration.
    #[command(after_help = "Examples:
  busker settings dump --config busker.yaml --device heating_relays > relays.yaml
  busker settings dump --serial /dev/ttyUSB0 --unit 18 --profile metz-connect/mr-do4")]
    Dump {
        #[command(flatten)]
        device: ByHand,
    },
    /// Write settings from a file to a device, and read each of them back
    ///
    /// The file holds what stands under a device's `settings:`, as `busker settings dump` prints it. What
    /// would change is shown first. Ends with 1 if a setting was not taken.
    #[command(after_help = "Examples:
  busker settings apply relays.yaml --config busker.yaml --device heating_relays
  busker settings apply relays.yaml --tcp 192.168.1.20:502 --unit 18 --profile metz-connect/mr-do4 --yes")]
    Apply {
        /// The settings
        #[arg(value_name = "FILE")]
        file: PathBuf,
        #[command(flatten)]
        device: ByHand,
        /// Write without asking
        #[arg(long)]
        yes: bool,
    },
}

pub fn run(args: Args) -> Result<(), Failure> {
    match args.what {
        What::Dump { device } => dump(&device),
        What::Apply { file, device, yes } => apply(&file, &device, yes),
    }
}

fn dump(by_hand: &ByHand) -> Result<(), Failure> {
    let (mut asked, device) = open(by_hand)?;
    let identity = asked.identify(&device)?.unwrap_or_else(|| "it has no identification".into());
    let mut values = Values::new(&device);
    let points: Vec<PointIndex> = wanted::settings(&device).collect();
    learn(&mut asked, &device, &points, &mut values)?;
    output::print(&as_yaml(&device, &identity, &points, &values))
}

/// The device with its profile, without which nobody knows its settings.
fn open(by_hand: &ByHand) -> Result<(Asked, Device), Failure> {
    let asked = by_hand.open()?;
    match asked.device().cloned() {
        Some(device) => Ok((asked, device)),
        None => Err(Failure::wrong(
            "only a profile knows a device's settings; give --profile beside the unit, or --config and --device",
        )),
    }
}

/// Each setting a line. What could not be written back is a comment.
fn as_yaml(device: &Device, identity: &str, points: &[PointIndex], values: &Values) -> String {
    let mut text = format!("# Settings of {}: {identity}\n", device.profile);
    if points.is_empty() {
        text.push_str("# It has none.\n{}\n");
    }
    for point in points {
        let (name, reading) = (&device.points[*point].name, values.reading(*point));
        if let Reading::Missing(missing) = reading {
            text.push_str(&format!("# {name}: {missing}\n"));
            continue;
        }
        let value = reading.to_string();
        let resolved = codec::resolve(device, *point, values.known());
        let unit = resolved.as_ref().ok().and_then(|resolved| resolved.unit.clone());
        let may_stand = resolved
            .map_err(|missing| missing.to_string())
            .and_then(|resolved| wanted::encode(&device.points[*point], &resolved, &value).map(drop));
        match may_stand {
            Ok(()) => {
                let unit = unit.map(|unit| format!("  # {unit}")).unwrap_or_default();
                text.push_str(&format!("{name}: {}{unit}\n", quoted(&value)));
            }
            Err(reason) => text.push_str(&format!("# {name}: {}  ({reason})\n", quoted(&value))),
        }
    }
    text
}

/// A scalar as YAML takes it: in quotes where it would be something else without.
fn quoted(text: &str) -> String {
    let plain = |c: char| c.is_alphanumeric() || matches!(c, '.' | '_' | '-' | '+' | '/' | '°' | '²' | '³');
    let is_plain = text.chars().all(plain)
        && text.starts_with(|c: char| c.is_alphanumeric() || c == '°' || c == '-')
        && text != "-"
        && text != "null";
    if is_plain { text.into() } else { format!("'{}'", text.replace('\'', "''")) }
}

fn apply(file: &PathBuf, by_hand: &ByHand, yes: bool) -> Result<(), Failure> {
    let shown = file.display().to_string();
    let bytes = fs::read(file)
        .with_context(|| format!("cannot read the settings `{shown}`"))
        .map_err(Failure::WrongInput)?;
    let (mut asked, device) = open(by_hand)?;
    let mut wanted = load_wanted(&shown, &bytes, &device)
        .map_err(|faults| configuration::faults(faults).so("nothing was written"))?;
    // A person looks on; nothing is written behind his back.
    wanted.iter_mut().for_each(|wanted| wanted.enforce = false);
    asked.identify(&device)?;

    let mut values = Values::new(&device);
    let points: Vec<PointIndex> = wanted.iter().map(|wanted| wanted.point).collect();
    learn(&mut asked, &device, &points, &mut values)?;
    let mut upkeep = Upkeep::new(&device, &wanted, &Memory::default());
    upkeep.compare(Time::default(), &device, &values);
    let differences = differences(&device, &upkeep);
    if differences.is_empty() {
        return output::print(&format!("nothing to change: the device holds all that `{shown}` wants\n"));
    }
    output::print(&table_of(&differences))?;
    if !yes {
        confirm(differences.len())?;
    }
    write(&mut asked, &device, &wanted, &mut upkeep, &mut values)
}

/// A setting that does not hold what is wanted of it.
struct Difference {
    name: String,
    found: String,
    wanted: String,
    /// Why it cannot be written, or not yet.
    remark: String,
}

fn differences(device: &Device, upkeep: &Upkeep) -> Vec<Difference> {
    let difference = |(point, wanted, standing): (PointIndex, &str, &Standing)| {
        let (found, remark) = match standing {
            Standing::Right => return None,
            Standing::Differs { found, .. } => (Some(found), String::new()),
            Standing::Unknown { found } => (found.as_ref(), "(after what decides it)".into()),
            Standing::Faulty { found, reason } => (found.as_ref(), format!("(cannot be written: {reason})")),
        };
        Some(Difference {
            name: device.points[point].name.clone(),
            found: found.cloned().unwrap_or_else(|| "unknown".into()),
            wanted: wanted.to_string(),
            remark,
        })
    };
    upkeep.standings().filter_map(difference).collect()
}

fn table_of(differences: &[Difference]) -> String {
    let mut table = Table::new();
    for Difference { name, found, wanted, remark } in differences {
        table.row([name, found, "→", wanted, remark]).right(1);
    }
    table.render()
}

/// Asks the person at the terminal. Without one, nobody has agreed.
fn confirm(count: usize) -> Result<(), Failure> {
    let what = if count == 1 { "this setting" } else { "these settings" };
    if !std::io::stdin().is_terminal() {
        return Err(anyhow!("nothing was written; --yes writes {what}").into());
    }
    eprint!("Write {what}? Type yes: ");
    std::io::stderr().flush()?;
    let mut answer = String::new();
    std::io::stdin().read_line(&mut answer)?;
    match answer.trim() {
        "yes" => Ok(()),
        _ => Err(anyhow!("nothing was written").into()),
    }
}

/// Writes one after the other, those that decide others first, and tells of each.
fn write(
    asked: &mut Asked,
    device: &Device,
    wanted: &[Wanted],
    upkeep: &mut Upkeep,
    values: &mut Values,
) -> Result<(), Failure> {
    let before = differences(device, upkeep);
    let before_of = |name: &str| before.iter().find(|difference| difference.name == name);
    let points: Vec<PointIndex> = wanted.iter().map(|wanted| wanted.point).collect();
    while let Some((point, command)) = upkeep.next(|_| true) {
        let known = values.known().to_vec();
        let outcome = match CommandFlow::begin(device, point, &command, &known) {
            Ok((flow, first)) => asked.carry_out(device, flow, first, &known)?,
            Err(outcome) => outcome,
        };
        let is_last_word = upkeep.ended(Time::default(), point, &outcome);
        // What the write may have changed is read again before anything else is compared with it.
        values.lose(point, Missing::NotYetRead);
        values.forget_selector(device, point);
        for partner in &device.points[point].re_read {
            values.lose(*partner, Missing::NotYetRead);
        }
        learn(asked, device, &points, values)?;
        upkeep.compare(Time::default(), device, values);
        if is_last_word {
            let name = &device.points[point].name;
            let found = outcome.found.clone().unwrap_or_else(|| "unknown".into());
            let was = before_of(name).map_or("unknown", |difference| difference.found.as_str());
            let mut line = format!("{name}  {was} → {found}  {}", outcome.kind.name());
            if !matches!(outcome.kind, OutcomeKind::Done | OutcomeKind::Unchanged) {
                line.push_str(&format!(": {}", outcome.reason.unwrap_or_default()));
            }
            output::print(&format!("{line}\n"))?;
        }
    }
    let left = differences(device, upkeep);
    for Difference { name, found, wanted, remark } in &left {
        eprintln!("{name} holds {found} and not {wanted} {remark}");
    }
    match left.len() {
        0 => Ok(()),
        1 => Err(anyhow!("one setting does not hold what is wanted").into()),
        count => Err(anyhow!("{count} settings do not hold what is wanted").into()),
    }
}

/// So much a request and a byte cost on a usual line, for reads that nobody times.
const COST: Cost = Cost { request: 20_000_000, byte: 573_000 };

/// Reads what is not yet known of `points`, and before it what decides them.
fn learn(
    asked: &mut Asked,
    device: &Device,
    points: &[PointIndex],
    values: &mut Values,
) -> Result<(), Failure> {
    let mut needed = points.to_vec();
    let mut next = 0;
    while let Some(point) = needed.get(next) {
        let selectors = device.points[*point].selectors();
        let new: Vec<PointIndex> =
            selectors.into_iter().filter(|selector| !needed.contains(selector)).collect();
        needed.extend(new);
        next += 1;
    }
    let mut reads = plan::plan(device, COST, &[]);
    reads.retain(|read| read.points.iter().any(|(point, _)| needed.contains(point)));
    // What is decided by a point that is decided itself is understood in the third round.
    for _ in 0..3 {
        for deciding in [true, false] {
            for read in &reads {
                let of_kind = read.points.iter().any(|(point, _)| values.is_selector(*point)) == deciding;
                let is_open = |point: &PointIndex| {
                    needed.contains(point)
                        && matches!(
                            values.reading(*point),
                            Reading::Missing(Missing::NotYetRead | Missing::WaitingFor(_))
                        )
                };
                if of_kind && read.points.iter().any(|(point, _)| is_open(point)) {
                    take_in(asked, device, read, &needed, values)?;
                }
            }
        }
    }
    Ok(())
}

/// One read, or its points one by one where the device does not give them together.
fn take_in(
    asked: &mut Asked,
    device: &Device,
    read: &Read,
    needed: &[PointIndex],
    values: &mut Values,
) -> Result<(), Failure> {
    match asked.ask(&Call::Read(read.span))? {
        Ok(answer) => {
            values.absorb(Time::default(), device, read, &words_of(&answer));
        }
        Err(RequestError::Exception(code)) => match &read.points[..] {
            [(point, _)] => values.lose(*point, Missing::Exception(code)),
            points => {
                for (point, _) in points.iter().filter(|(point, _)| needed.contains(point)) {
                    let at = device.points[*point].at;
                    let alone = Read { span: at.span, points: vec![(*point, at)], ..read.clone() };
                    take_in(asked, device, &alone, needed, values)?;
                }
            }
        },
        Err(error) => {
            let unit = asked.unit();
            return Err(anyhow!("{error}")
                .context(format!("unit {unit}: `{}` cannot be read", read.span))
                .into());
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_dumped_is_read_as_it_was() {
        for (text, expected) in [
            ("ON", "ON"),
            ("-12.50", "-12.50"),
            ("°C", "°C"),
            ("R017", "R017"),
            ("it's", "'it''s'"),
            ("a: b", "'a: b'"),
            ("", "''"),
            ("null", "'null'"),
            ("-", "'-'"),
            ("#1", "'#1'"),
        ] {
            assert_eq!(quoted(text), expected);
        }
    }
}
