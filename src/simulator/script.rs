//! The words in which a person or a file changes the process side.
//!
//! ```text
//! # a comment
//! unit 18 relay 2 hand on
//! at 5s unit 19 input 1 ohms 107.8
//! at 6s unit 20 input 1 pulses 100 every 80ms
//! ```

use crate::engine::address::{Span, Table};
use crate::engine::time::Duration;
use crate::simulator::device::{Hand, PhaseQuantity, Quantity, Signal, Stimulus, Toggle, parse_unit};
use crate::simulator::fault::Fault;

/// What a line of a script does.
#[derive(Clone, Debug, PartialEq)]
pub enum Action {
    Stimulate { unit: u8, stimulus: Stimulus },
    Power { unit: u8, on: bool },
    Restart { unit: u8 },
    Fault(Fault),
    Repair { unit: u8 },
}

/// An action and when to do it, counted from the start of the script.
#[derive(Clone, Debug, PartialEq)]
pub struct Step {
    pub after: Duration,
    pub action: Action,
}

/// The commands, as the help shows them.
pub const COMMANDS: &str =
    "  unit N relay R hand on|off|automatic      a relay's hand switch (MR-DO4, MR-DIO4/2, MR-Multi I/O)
  unit N relay R press TIME                 somebody holds a relay's button for so long (MR-Multi I/O)
  unit N triac T hand on|off|automatic      a triac's hand switch (MR-TO4)
  unit N toggle T up|middle|down            a switch with three positions (MR-TP)
  unit N output O hand X|automatic          volts that a person sets (MR-AOP4)
  unit N input I ohms X | volts X | celsius X | open
                                            what is connected to an input (MR-AI8, MR-AIO4/2,
                                            MR-Multi I/O)
  unit N input I ohms X | volts X | open    a leak sensor, the voltage at its Zener diode (MR-LD6)
  unit N input I volts X | milliamps X | open
                                            what is connected to an input (MR-CI4, analog-in8;
                                            MR-Multi I/O: 7 is I)
  unit N input I contact closed|open        a contact (MR-SI4, MR-DI4, MR-DI10, MR-DIO4/2, MR-TP,
                                            analog-in8; MR-Multi I/O: 12 is S0)
  unit N input I pulses COUNT [every 80ms]  closings of a contact (MR-SI4; MR-Multi I/O: 12)
  unit N input I counter COUNT              sets a pulse counter (MR-SI4; MR-Multi I/O: 12)
  unit N phase P volts X | amps X | hertz X | lag X | angle X
                                            a phase: its current lags its voltage by degrees, which is
                                            at an angle to that of phase 1 (MR-SM3)
  unit N dip D on|off                       a DIP switch (MR-CI4)
  unit N button                             somebody presses the button (MR-SI4, MR-Multi I/O)
  unit N measure QUANTITY X                 what is around a sensor (sensor): humidity, temperature, co2,
                                            voc, co, volts, milliamps, oxygen, air_pressure, pressure,
                                            light, flow; door, window, switch with `open` or `closed`
  unit N motion                             somebody moves (sensor)
  unit N set 'TABLE ADDRESS' WORD …         raw words from there on, as in `set 'input 0' 215` (--profile)
  unit N power off|on                       power loss: only the EEPROM is kept
  unit N restart                            the same, and silent for two seconds
  unit N fault KIND | none                  see --fault
  at TIME COMMAND                           later: `at 5s unit 19 input 1 ohms 107.8`
";

/// Reads a whole script, or tells all its errors, each with its line's number from 1.
pub fn parse_script(text: &str) -> Result<Vec<Step>, Vec<(usize, String)>> {
    let (mut steps, mut errors) = (Vec::new(), Vec::new());
    for (number, line) in text.lines().enumerate() {
        match parse_line(line) {
            Ok(step) => steps.extend(step),
            Err(error) => errors.push((number + 1, error)),
        }
    }
    // Steps of the same time stay in the order of their lines.
    steps.sort_by_key(|step: &Step| step.after);
    if errors.is_empty() { Ok(steps) } else { Err(errors) }
}

/// Reads one line; `None` where it is empty or a comment.
pub fn parse_line(line: &str) -> Result<Option<Step>, String> {
    let line = line.split('#').next().unwrap_or("").trim();
    let mut words: Vec<&str> = line.split_whitespace().collect();
    if words.is_empty() {
        return Ok(None);
    }
    let mut after = Duration::ZERO;
    if words[0] == "at" {
        let time = words.get(1).ok_or("`at` needs a time: `at 5s unit 18 restart`")?;
        after = parse_duration(time)?;
        words.drain(..2);
    }
    let ["unit", unit, command @ ..] = &words[..] else {
        return Err(format!("`{line}` is not a command; one begins with `unit 18` or `at 5s unit 18`"));
    };
    Ok(Some(Step { after, action: parse_action(parse_unit(unit)?, command)? }))
}

fn parse_action(unit: u8, command: &[&str]) -> Result<Action, String> {
    let stimulus = match command {
        ["restart"] => return Ok(Action::Restart { unit }),
        ["power", "off"] => return Ok(Action::Power { unit, on: false }),
        ["power", "on"] => return Ok(Action::Power { unit, on: true }),
        ["fault", "none"] => return Ok(Action::Repair { unit }),
        ["fault", kind] => {
            let fault: Fault = kind.parse()?;
            return Ok(Action::Fault(Fault { unit: Some(unit), ..fault }));
        }
        ["button"] => Stimulus::Button,
        ["motion"] => Stimulus::Motion,
        ["set", table, address, words @ ..] if !words.is_empty() => parse_set(table, address, words)?,
        ["measure", quantity, value] => parse_measure(quantity, value)?,
        ["relay" | "triac", relay, "hand", position] => {
            let position = match *position {
                "automatic" => Hand::Automatic,
                "on" => Hand::On,
                "off" => Hand::Off,
                other => {
                    return Err(format!(
                        "`{other}` is not a position of a hand switch; there are `on`, `off`, `automatic`"
                    ));
                }
            };
            Stimulus::Hand { relay: parse_number("relay", relay)?, position }
        }
        ["toggle", toggle, position] => {
            let position = match *position {
                "up" => Toggle::Up,
                "middle" => Toggle::Middle,
                "down" => Toggle::Down,
                other => {
                    return Err(format!(
                        "`{other}` is not a position of a switch; there are `up`, `middle`, `down`"
                    ));
                }
            };
            Stimulus::Toggle { toggle: parse_number("toggle", toggle)?, position }
        }
        ["dip", switch, state @ ("on" | "off")] => {
            Stimulus::Dip { switch: parse_number("switch", switch)?, on: *state == "on" }
        }
        ["relay", relay, "press", held] => {
            Stimulus::Press { relay: parse_number("relay", relay)?, held: parse_duration(held)? }
        }
        ["phase", phase, quantity, amount] => Stimulus::Phase {
            phase: parse_number("phase", phase)?,
            quantity: parse_quantity(quantity)?,
            amount: parse_finite(amount)?,
        },
        ["output", output, "hand", setting] => {
            let volts = if *setting == "automatic" { None } else { Some(parse_finite(setting)?) };
            Stimulus::HandVolts { output: parse_number("output", output)?, volts }
        }
        ["input", input, signal @ ..] => {
            Stimulus::Input { input: parse_number("input", input)?, signal: parse_signal(signal)? }
        }
        _ => return Err(format!("`{}` is not a command; there are\n{COMMANDS}", command.join(" "))),
    };
    Ok(Action::Stimulate { unit, stimulus })
}

/// `set 'input 0' 215`, with or without the quotes.
fn parse_set(table: &str, address: &str, words: &[&str]) -> Result<Stimulus, String> {
    let (table, address) = (table.trim_start_matches(['\'', '"']), address.trim_end_matches(['\'', '"']));
    let known = || Table::ALL.map(|table| format!("`{table}`")).join(", ");
    let found =
        Table::from_name(table).ok_or_else(|| format!("`{table}` is no table; there are {}", known()))?;
    let words = words.iter().map(|word| parse_word(word)).collect::<Result<Vec<u16>, String>>()?;
    let first = parse_number("register", address)?;
    let span = u16::try_from(words.len()).ok().and_then(|count| Span::with_count(found, first, count));
    let span = span.ok_or_else(|| format!("there are fewer than {} words from {address} on", words.len()))?;
    Ok(Stimulus::Set { span, words })
}

/// A register's word: `215`, `-5`, `0x00FF`.
fn parse_word(text: &str) -> Result<u16, String> {
    let hexadecimal = text.strip_prefix("0x").map(|digits| u16::from_str_radix(digits, 16).ok());
    let decimal = || text.parse::<u16>().ok().or_else(|| text.parse::<i16>().ok().map(|word| word as u16));
    hexadecimal
        .unwrap_or_else(decimal)
        .ok_or_else(|| format!("`{text}` is no word of a register, which holds -32768 to 65535"))
}

fn parse_measure(quantity: &str, value: &str) -> Result<Stimulus, String> {
    let known = || Quantity::ALL.map(|quantity| format!("`{}`", quantity.name())).join(", ");
    let quantity = Quantity::from_name(quantity)
        .ok_or_else(|| format!("`{quantity}` is not measured; there are {}", known()))?;
    let value = match value {
        _ if !quantity.is_contact() => parse_finite(value)?,
        "open" => 1.0,
        "closed" => 0.0,
        _ => return Err(format!("`{value}` is neither `open` nor `closed`")),
    };
    Ok(Stimulus::Measure { quantity, value })
}

fn parse_signal(words: &[&str]) -> Result<Signal, String> {
    match words {
        ["open"] | ["contact", "open"] if words.len() == 1 => Ok(Signal::Open),
        ["contact", "open"] => Ok(Signal::Contact(false)),
        ["contact", "closed"] => Ok(Signal::Contact(true)),
        ["ohms", number] => Ok(Signal::Ohms(parse_finite(number)?)),
        ["volts", number] => Ok(Signal::Volts(parse_finite(number)?)),
        ["milliamps", number] => Ok(Signal::Milliamps(parse_finite(number)?)),
        ["celsius", number] => Ok(Signal::Celsius(parse_finite(number)?)),
        ["counter", number] => Ok(Signal::Counter(parse_number("count", number)?)),
        ["pulses", number] => {
            Ok(Signal::Pulses { count: parse_number("count", number)?, every: Duration::from_millis(80) })
        }
        ["pulses", number, "every", period] => {
            Ok(Signal::Pulses { count: parse_number("count", number)?, every: parse_duration(period)? })
        }
        _ => Err(format!("`{}` is not a signal; there are\n{COMMANDS}", words.join(" "))),
    }
}

fn parse_quantity(text: &str) -> Result<PhaseQuantity, String> {
    match text {
        "volts" => Ok(PhaseQuantity::Volts),
        "amps" => Ok(PhaseQuantity::Amps),
        "hertz" => Ok(PhaseQuantity::Hertz),
        "lag" => Ok(PhaseQuantity::Lag),
        "angle" => Ok(PhaseQuantity::Angle),
        _ => Err(format!(
            "`{text}` is nothing of a phase; there are `volts`, `amps`, `hertz`, `lag` and `angle`"
        )),
    }
}

fn parse_finite(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(number) if number.is_finite() => Ok(number),
        _ => Err(format!("`{text}` is not a number")),
    }
}

fn parse_number<T: std::str::FromStr>(what: &str, text: &str) -> Result<T, String> {
    text.parse().map_err(|_| format!("`{text}` is not a {what}; write a whole number"))
}

/// Reads `80ms`, `5s`, `2m`, `1.5s`.
pub fn parse_duration(text: &str) -> Result<Duration, String> {
    let wrong = || format!("`{text}` is not a duration; write it as `80ms`, `5s` or `2m`");
    let unit_at =
        text.find(|letter: char| letter.is_ascii_alphabetic() || letter == 'µ').ok_or_else(wrong)?;
    let number: f64 = text[..unit_at].parse().map_err(|_| wrong())?;
    let seconds = match &text[unit_at..] {
        "us" | "µs" => 1e-6,
        "ms" => 1e-3,
        "s" => 1.0,
        "m" => 60.0,
        "h" => 3600.0,
        _ => return Err(wrong()),
    };
    // A hundred days; longer is surely a mistake, and this keeps every sum in range.
    let amount = number * seconds;
    if !(0.0..=8_640_000.0).contains(&amount) {
        return Err(wrong());
    }
    Ok(Duration::from_micros((amount * 1e6).round() as u64))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_commands_of_the_help_are_understood() {
        let stimulate = |unit, stimulus| Action::Stimulate { unit, stimulus };
        let input = |signal| stimulate(19, Stimulus::Input { input: 1, signal });
        for (line, after, action) in [
            ("at 5s unit 19 input 1 ohms 107.8", 5000, input(Signal::Ohms(107.8))),
            ("unit 19 input 1 volts 2.5 # a comment", 0, input(Signal::Volts(2.5))),
            ("unit 19 input 1 celsius -12", 0, input(Signal::Celsius(-12.0))),
            ("unit 19 input 1 open", 0, input(Signal::Open)),
            ("unit 19 input 1 contact open", 0, input(Signal::Contact(false))),
            ("unit 19 input 1 counter 281474976710655", 0, input(Signal::Counter(0xFFFF_FFFF_FFFF))),
            (
                "unit 19 input 1 pulses 100 every 60ms",
                0,
                input(Signal::Pulses { count: 100, every: Duration::from_millis(60) }),
            ),
            ("unit 20 button", 0, stimulate(20, Stimulus::Button)),
            ("unit 18 relay 2 hand on", 0, stimulate(18, Stimulus::Hand { relay: 2, position: Hand::On })),
            (
                "unit 22 toggle 2 middle",
                0,
                stimulate(22, Stimulus::Toggle { toggle: 2, position: Toggle::Middle }),
            ),
            ("at 1.5s unit 18 power off", 1500, Action::Power { unit: 18, on: false }),
            (
                "unit 21 output 2 hand 5.5",
                0,
                stimulate(21, Stimulus::HandVolts { output: 2, volts: Some(5.5) }),
            ),
            (
                "unit 21 output 2 hand automatic",
                0,
                stimulate(21, Stimulus::HandVolts { output: 2, volts: None }),
            ),
            (
                "unit 5 measure co2 812.5",
                0,
                stimulate(5, Stimulus::Measure { quantity: Quantity::Co2, value: 812.5 }),
            ),
            (
                "unit 5 measure door open",
                0,
                stimulate(5, Stimulus::Measure { quantity: Quantity::Door, value: 1.0 }),
            ),
            ("unit 5 set 'input 0' 215", 0, stimulate(5, set(Table::Input, 0, &[215]))),
            ("unit 5 set holding 9 -5 0x00FF", 0, stimulate(5, set(Table::Holding, 9, &[65531, 255]))),
            ("unit 5 motion", 0, stimulate(5, Stimulus::Motion)),
            (
                "unit 22 relay 4 press 1.2s",
                0,
                stimulate(22, Stimulus::Press { relay: 4, held: Duration::from_millis(1200) }),
            ),
            (
                "unit 22 phase 2 angle -120",
                0,
                stimulate(22, Stimulus::Phase { phase: 2, quantity: PhaseQuantity::Angle, amount: -120.0 }),
            ),
            ("unit 18 restart", 0, Action::Restart { unit: 18 }),
            (
                "unit 18 fault late=700ms,every=2",
                0,
                Action::Fault("unit=18,late=700ms,every=2".parse().expect("a fault")),
            ),
            ("unit 18 fault none", 0, Action::Repair { unit: 18 }),
        ] {
            let step = Step { after: Duration::from_millis(after), action };
            assert_eq!(parse_line(line), Ok(Some(step)), "{line}");
        }
        assert_eq!(parse_line("  # nothing"), Ok(None));
    }

    #[test]
    fn all_wrong_lines_of_a_script_are_told_at_once_with_their_numbers() {
        let told =
            parse_script("unit 18 restart\nfoo\nat soon unit 18 restart\nunit 0 button\n").unwrap_err();
        let wanted =
            [(2, "`foo` is not a command"), (3, "`soon` is not a duration"), (4, "`0` is not a unit")];
        assert_eq!(told.len(), wanted.len(), "{told:?}");
        for ((line, error), (wanted_line, beginning)) in told.iter().zip(wanted) {
            assert!(*line == wanted_line && error.starts_with(beginning), "{line}: {error}");
        }
    }

    fn set(table: Table, first: u16, words: &[u16]) -> Stimulus {
        let span = Span::with_count(table, first, words.len() as u16).expect("a span");
        Stimulus::Set { span, words: words.to_vec() }
    }

    #[test]
    fn what_is_no_register_or_no_word_is_told() {
        for (line, wanted) in [
            ("unit 5 set 'register 0' 1", "`register` is no table; there are `coil`, `discrete`, `input`"),
            ("unit 5 set 'input x' 1", "`x` is not a register; write a whole number"),
            ("unit 5 set 'input 65535' 1 2", "there are fewer than 2 words from 65535 on"),
            ("unit 5 set 'input 0' 65536", "`65536` is no word of a register, which holds -32768 to 65535"),
            ("unit 5 set 'input 0' 0xG", "`0xG` is no word"),
            ("unit 5 set 'input 0'", "`set 'input 0'` is not a command"),
        ] {
            let told = parse_line(line).unwrap_err();
            assert!(told.starts_with(wanted), "{line}: {told}");
        }
    }

    #[test]
    fn every_quantity_is_in_the_help_and_takes_a_number_or_open_and_closed() {
        for quantity in Quantity::ALL {
            assert!(COMMANDS.contains(quantity.name()), "{quantity:?}");
            let parse = |value: &str| parse_line(&format!("unit 5 measure {} {value}", quantity.name()));
            assert_eq!(parse("closed").is_ok(), quantity.is_contact(), "{quantity:?}");
            assert_eq!(parse("1").is_ok(), !quantity.is_contact(), "{quantity:?}");
        }
        let error = parse_line("unit 5 measure colour 1").unwrap_err();
        assert!(error.starts_with("`colour` is not measured; there are `humidity`, "), "{error}");
    }

    #[test]
    fn a_script_is_sorted_by_time_and_keeps_the_order_of_lines_within_one() {
        let steps =
            parse_script("at 2s unit 1 restart\nunit 2 restart\nat 2s unit 3 restart").expect("a script");
        let units: Vec<&Action> = steps.iter().map(|step| &step.action).collect();
        assert_eq!(
            units,
            [&Action::Restart { unit: 2 }, &Action::Restart { unit: 1 }, &Action::Restart { unit: 3 }]
        );
    }
}
