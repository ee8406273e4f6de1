//! `busker diagnose`: what a device says of itself and of its line.

use serde_json::{Map, Value, json};

use super::by_hand::{Asked, ByHand};
use super::{Failure, output};
use crate::engine::identity::{Interview, Known};
use crate::engine::modbus::names::{COUNTERS, QUERY, hexadecimal, object_name};
use crate::engine::modbus::{Answer, Call, RequestError};

/// Ask a device who it is and how it hears the line
///
/// Asks for its identification (function 43/14) and server id (17), returns a query (8/0), and reads
/// its counters (8/11 to 8/18). What a device refuses is shown as that: few know all of it.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:
  busker diagnose --serial /dev/ttyUSB0 --baud 19200 --parity even --unit 18")]
pub struct Args {
    #[command(flatten)]
    device: ByHand,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// A line of the result: what was asked, and the device's word or why there is none.
type Finding = (String, Result<Value, RequestError>);

pub fn run(args: Args) -> Result<(), Failure> {
    let mut device = args.device.open()?;
    let mut findings = identification(&mut device)?;
    let query = Call::Diagnostics { function: 0, data: vec![QUERY] };
    findings.push(("query_returned".into(), device.ask(&query)?.map(|_| Value::Bool(true))));
    for (function, name) in COUNTERS {
        let answer = device.ask(&Call::Diagnostics { function, data: vec![0] })?;
        findings.push((name.into(), answer.map(|answer| told(&answer))));
    }
    print(&findings, args.json)?;
    // A refusal is an answer, silence is not.
    let heard = |(_, result): &Finding| matches!(result, Ok(_) | Err(RequestError::Exception(_)));
    match findings.iter().any(heard) {
        true => Ok(()),
        false => Err(anyhow::anyhow!("unit {} answers nothing that fits", device.unit()).into()),
    }
}

/// What the device says of itself, as `busker identify` asks for it.
fn identification(device: &mut Asked) -> Result<Vec<Finding>, Failure> {
    let interview = device.interview(Interview::of_device(None, Known::default()))?;
    let objects = interview.objects().iter();
    let mut findings: Vec<Finding> =
        objects.map(|(number, text)| (object_name(*number), Ok(Value::String(text.clone())))).collect();
    if let Some(error) = interview.objects_error() {
        findings.push(("identification".into(), Err(error.clone())));
    }
    if let Some(server_id) = interview.server_id() {
        let told = server_id.clone().map(|bytes| hexadecimal(&bytes).into());
        findings.push(("server_id".into(), told));
    }
    Ok(findings)
}

fn told(answer: &Answer) -> Value {
    match answer {
        Answer::Diagnostics(words) => words.first().copied().into(),
        _ => Value::Null,
    }
}

fn print(findings: &[Finding], as_json: bool) -> Result<(), Failure> {
    if as_json {
        let entry = |(name, result): &Finding| {
            let value = match result {
                Ok(value) => value.clone(),
                Err(error) => json!({"error": error.to_string()}),
            };
            (name.clone(), value)
        };
        return output::print_json(&findings.iter().map(entry).collect::<Map<_, _>>());
    }
    let mut table = output::Table::new();
    for (name, result) in findings {
        let text = match result {
            Ok(Value::String(text)) => text.clone(),
            Ok(Value::Bool(_)) => "yes".into(),
            Ok(value) => value.to_string(),
            Err(error) => format!("({error})"),
        };
        table.row([name.replace('_', " "), text]);
    }
    output::print(&table.render())
}
