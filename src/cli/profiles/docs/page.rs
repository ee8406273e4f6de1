//! One device's page: what it is, what to mind, what to copy, and every point in a table.

use std::fmt::Write as _;

use super::{modes, points, things, words};
use crate::engine::device::{
    Category, Device, Encoding, Identify, Platform, Point, PointIndex, Poll, WriteRule,
};
use crate::engine::homeassistant::Entity;
use crate::engine::wanted;

/// The page, in Markdown.
pub fn page(device: &Device) -> String {
    let page = Page::of(device);
    let mut text = String::new();
    page.head(&mut text);
    page.shown_at_once(&mut text);
    page.to_copy(&mut text);
    page.take_care(&mut text);
    modes::modes(&page, &mut text);
    things::things(&page, &mut text);
    page.wire(&mut text);
    points::points(&page, &mut text);
    page.left_out(&mut text);
    text
}

/// The names of what the device is for, without settings and diagnostics, by what they are in Home
/// Assistant.
pub fn main_entities(device: &Device) -> Vec<(Platform, String)> {
    by_platform(&Shown::all_of(&Page::of(device)), |shown| shown.is_enabled && shown.category.is_none())
}

/// A point or a thing as Home Assistant shows it.
struct Shown {
    platform: Platform,
    name: String,
    category: Option<Category>,
    is_enabled: bool,
    /// Whatever the mode.
    is_always_there: bool,
}

impl Shown {
    fn all_of(page: &Page<'_>) -> Vec<Shown> {
        let things = page.device.things.iter().map(|thing| Shown {
            platform: thing.kind.platform(),
            name: thing.presentation.title(&thing.name),
            category: thing.presentation.category,
            is_enabled: thing.presentation.enabled.unwrap_or(true),
            is_always_there: thing.when.is_empty(),
        });
        let points = page.device.points.iter().zip(&page.entities).filter_map(|(point, entity)| {
            let entity = entity.as_ref()?;
            Some(Shown {
                platform: entity.platform,
                name: entity.name.clone(),
                category: entity.category,
                is_enabled: entity.enabled,
                is_always_there: point.when.is_empty(),
            })
        });
        things.chain(points).collect()
    }
}

fn by_platform(all: &[Shown], wanted: impl Fn(&Shown) -> bool) -> Vec<(Platform, String)> {
    let mut told = Vec::new();
    for platform in [
        Platform::Cover,
        Platform::Valve,
        Platform::Climate,
        Platform::Switch,
        Platform::Select,
        Platform::Number,
        Platform::Sensor,
        Platform::BinarySensor,
        Platform::Event,
        Platform::Button,
        Platform::Text,
    ] {
        let mut names: Vec<&str> = Vec::new();
        for shown in all.iter().filter(|shown| shown.platform == platform && wanted(shown)) {
            // What is one thing in two modes is named once.
            if !names.contains(&shown.name.as_str()) {
                names.push(&shown.name);
            }
        }
        if !names.is_empty() {
            told.push((platform, words::together_plain(&names)));
        }
    }
    told
}

/// A device and what Home Assistant makes of each of its points.
pub struct Page<'d> {
    pub device: &'d Device,
    /// One for each point.
    pub entities: Vec<Option<Entity>>,
}

impl<'d> Page<'d> {
    pub fn of(device: &'d Device) -> Page<'d> {
        let entities = (0..device.points.len()).map(|index| words::entity_of(device, index)).collect();
        Page { device, entities }
    }

    fn head(&self, text: &mut String) {
        let device = self.device;
        let _ = writeln!(text, "# {} {}\n", device.manufacturer, device.model);
        let _ = writeln!(text, "<!-- Written by `busker profiles docs` from the profile; do not edit. -->\n");
        let _ = writeln!(text, "Profile: `{}`  ", device.profile);
        let _ = writeln!(text, "Written from: {}\n", device.source.trim());
        let told = match &device.identify {
            Some(Identify::Names { vendor, product }) => format!(
                "busker makes sure that the right device answers: it asks for its name and expects \
                 `{vendor}` and `{product}`. Where another device answers, nothing is written to it."
            ),
            Some(Identify::Word { at, mask, equals }) => {
                let part = match mask {
                    0xFFFF => String::new(),
                    mask => format!(" (only the bits {mask:#06X} count)").replace("0X", "0x"),
                };
                format!(
                    "busker makes sure that the right device answers: it reads {at} and expects {equals}{part}. \
                     Where another device answers, nothing is written to it."
                )
            }
            None => "The device cannot say what it is. busker trusts the address: check it before the first \
                     start."
                .into(),
        };
        let _ = writeln!(text, "{told}\n");
    }

    fn shown_at_once(&self, text: &mut String) {
        let _ = writeln!(text, "## In Home Assistant\n");
        let all = Shown::all_of(self);
        let list = |shown: Vec<(Platform, String)>, text: &mut String| {
            for (platform, names) in shown {
                let _ = writeln!(text, "* **{}**: {names}", words::platform(platform).1);
            }
        };
        list(by_platform(&all, |shown| shown.is_enabled && shown.is_always_there), text);
        let in_some = by_platform(&all, |shown| shown.is_enabled && !shown.is_always_there);
        if !in_some.is_empty() {
            let _ = writeln!(text, "\nIn some [operating modes](#operating-modes):\n");
            list(in_some, text);
        }
        let off = all.iter().filter(|shown| !shown.is_enabled).count();
        match off {
            0 => {}
            1 => {
                let _ = writeln!(
                    text,
                    "\nOne more is there, but switched off. Enable it on the device's page if you need it."
                );
            }
            off => {
                let _ = writeln!(
                    text,
                    "\n{off} more are there, but switched off. Enable those that you need on the device's page."
                );
            }
        }
        text.push('\n');
    }

    fn to_copy(&self, text: &mut String) {
        let _ = writeln!(text, "## To copy\n");
        let _ = writeln!(
            text,
            "Into the [configuration](../../../deploy/busker.yaml). If it has a bus already, take only the \
             lines of the device. For a device on the network write `tcp: \"192.168.1.20:502\"` in place of \
             `serial`, `baud` and `parity`.\n"
        );
        let _ = writeln!(text, "```yaml\n{}```\n", self.configuration());
    }

    fn configuration(&self) -> String {
        let device = self.device;
        let mut text = String::from(
            "buses:
  cabinet:
    serial: /dev/serial/by-id/usb-FTDI_FT232R_USB_UART_A1B2C3D4-if00-port0
    baud: 19200          # as it is set at the device
    parity: even         # as it is set at the device

devices:
",
        );
        let name = device_name(device);
        let _ = writeln!(text, "  {name}:\n    profile: {}\n    bus: cabinet", device.profile);
        let _ = writeln!(text, "    unit: 1              # the address that is set at the device");
        let _ = writeln!(text, "    name: {}", quoted_if_needed(&device.model));
        let is_main = |index: &PointIndex| {
            self.entities[*index].as_ref().is_some_and(|entity| entity.enabled && entity.category.is_none())
        };
        let named = (0..device.points.len()).find(is_main);
        if let Some(named) = named {
            let _ = writeln!(text, "    # points:            # wishes for single points");
            let point = &device.points[named];
            // What the device does not tell is the wish without which the number says little.
            let ranges: Vec<&str> = point.ranges.iter().map(|(name, _)| name.as_str()).collect();
            let (range, remark) = match ranges.last() {
                Some(last) => {
                    (format!(", range: {last}"), format!("  # or another one of {}", ranges.join(", ")))
                }
                None => Default::default(),
            };
            let _ = writeln!(text, "    #   {}: {{name: A name of your own{range}}}{remark}", point.name);
        }
        if let Some((setting, value)) = self.a_setting() {
            let _ = writeln!(text, "    # settings:          # what the device keeps shall hold this");
            let _ = writeln!(text, "    #   {setting}: {value}");
        }
        text
    }

    /// The first setting of which the manual tells how it leaves the factory, and that.
    fn a_setting(&self) -> Option<(&str, String)> {
        let is_shown = |index: PointIndex| {
            let default = words::default(self.device, index);
            let is_told = !default.is_empty() && !default.starts_with("register ");
            is_told.then(|| {
                (self.device.points[index].name.as_str(), quoted_if_needed(default.trim_matches('`')))
            })
        };
        let always = |index: &PointIndex| self.device.points[*index].when.is_empty();
        wanted::settings(self.device).filter(always).find_map(is_shown)
    }

    fn take_care(&self, text: &mut String) {
        let warnings: Vec<String> = [
            self.about_the_watchdog(),
            self.about_heartbeats(),
            self.about_eeprom(),
            self.about_presses(),
            self.about_read_clears(),
            self.about_forbidden(),
            self.about_selectors(),
            self.about_left_out(),
        ]
        .into_iter()
        .flatten()
        .collect();
        if warnings.is_empty() {
            return;
        }
        let _ = writeln!(text, "## Take care\n");
        for warning in warnings {
            let _ = writeln!(text, "* {warning}");
        }
        text.push('\n');
    }

    fn about_the_watchdog(&self) -> Option<String> {
        let index = self.device.wire.watchdog?;
        let default = words::default(self.device, index);
        let unit = self.device.points[index].plain().map(|form| words::unit(self.device, form));
        let factory = match (default.as_str(), unit.unwrap_or_default()) {
            ("", _) => String::new(),
            (default, unit) => format!(" From the factory it is {default} {unit}.").replace(" .", "."),
        };
        Some(format!(
            "**Watchdog.** `{}` is a time. If the device hears nothing for so long, it switches its outputs to \
             their safe state by itself. While busker runs, its questions keep that from happening. But when \
             busker, its computer or the line stops, the outputs change and nobody has ordered it. Choose the \
             safe states first, then a time that is longer than a restart of the computer takes. With \
             `on_broker_loss: stop_feeding` in the configuration, the loss of the MQTT broker trips it \
             too.{factory}",
            self.device.points[index].name
        ))
    }

    fn about_heartbeats(&self) -> Option<String> {
        let points = &self.device.points;
        let beating = self.names_of(|point| point.heartbeat.is_some())?;
        let mut times: Vec<PointIndex> = points.iter().filter_map(|point| point.heartbeat).collect();
        times.dedup();
        let mut factory: Vec<String> = times.iter().map(|time| words::default(self.device, *time)).collect();
        factory.dedup();
        let factory = match factory.as_slice() {
            [same] if !same.is_empty() => format!(" From the factory it is {same} s."),
            _ => String::new(),
        };
        Some(format!(
            "**Heartbeat.** The device wants {beating} to be written again and again, at the latest after {} (0: it \
             does not mind). Else it acts as its manual says, mostly by taking it for a fault. busker repeats in time, three times as often as it has to, what it has just read from the register, \
             and never an older order. When busker, its computer or the line stops for longer, or with \
             `on_broker_loss: stop_feeding` the MQTT broker, the device acts. Choose a time that is longer than a \
             restart takes, unless that is what you want.{factory}",
            self.names(&times)
        ))
    }

    fn about_left_out(&self) -> Option<String> {
        let left_out = &self.device.left_out;
        (!left_out.is_empty()).then(|| {
            "**Left out.** Not all that the manual has is here. What is missing on purpose, and why, stands at the \
             end of the page: [Left out](#left-out)."
                .into()
        })
    }

    fn about_eeprom(&self) -> Option<String> {
        let kept = self.device.points.iter().filter(|point| point.persistent).count();
        if kept == 0 {
            return None;
        }
        let subject = if kept == 1 { "One setting is" } else { &format!("{kept} settings are") };
        Some(format!(
            "**EEPROM.** {subject} kept in a memory that wears out by being written; the tables mark them. \
             busker writes them only when the value differs, and when a setting changes again and again, at \
             most once a minute. Set them by hand or under `settings:`, not from an automation that runs often."
        ))
    }

    fn about_presses(&self) -> Option<String> {
        let presses = self.names_of(|point| {
            matches!(point.write.as_ref().map(|write| &write.rule), Some(WriteRule::Press { .. }))
        })?;
        Some(format!("**Buttons act at once** and ask nothing back: {presses}."))
    }

    fn about_read_clears(&self) -> Option<String> {
        let cleared = self.names_of(|point| point.read_clears)?;
        Some(format!(
            "**Cleared by reading.** {cleared}: reading changes it, so no other program should read it."
        ))
    }

    fn about_forbidden(&self) -> Option<String> {
        let forbidden = &self.device.wire.forbidden;
        if forbidden.is_empty() {
            return None;
        }
        let told: Vec<String> = forbidden
            .iter()
            .map(|forbidden| format!("{} ({})", forbidden.span, forbidden.reason.trim()))
            .collect();
        Some(format!("**Never touched.** busker does not ask for these: {}.", told.join("; ")))
    }

    fn about_selectors(&self) -> Option<String> {
        let cases =
            |point: &&Point| matches!(point.encoding, Encoding::Cases { .. }) && point.write.is_some();
        // Modes stand in a section of their own.
        let of_meaning = |point: &Point| Point { when: Vec::new(), ..point.clone() }.selectors();
        let mut selectors: Vec<PointIndex> =
            self.device.points.iter().filter(cases).flat_map(of_meaning).collect();
        selectors.sort_unstable();
        selectors.dedup();
        let points = &self.device.points;
        selectors.retain(|index| points[*index].write.is_some());
        if selectors.is_empty() {
            return None;
        }
        Some(format!(
            "**Settings that change others.** What other registers mean depends on {}. Set them first, and \
             set what depends on them, such as limits and offsets, anew afterwards.",
            self.names(&selectors)
        ))
    }

    fn wire(&self, text: &mut String) {
        let wire = &self.device.wire;
        let limits = wire.limits;
        let uses_bits = self.device.points.iter().any(|point| {
            point.at.span.table().is_bits() || point.also.is_some_and(|also| also.span.table().is_bits())
        });
        let mut rows: Vec<(&str, String)> = Vec::new();
        let bits = match uses_bits {
            true => format!(", or {} coils or discrete inputs", limits.read_bits),
            false => String::new(),
        };
        rows.push(("One question reads at most", format!("{} registers{bits}", limits.read_registers)));
        if self.device.points.iter().any(|point| point.write.is_some()) {
            rows.push(("One order writes at most", format!("{} registers", limits.write_registers)));
        }
        if !wire.readable.is_empty() {
            let spans: Vec<String> = wire.readable.iter().map(ToString::to_string).collect();
            rows.push(("A question must lie within", spans.join("; ")));
        }
        if limits.gap == Some(0) {
            rows.push(("Unused addresses", "are not read over".into()));
        }
        if !limits.delay.is_zero() {
            rows.push(("Silence before each question", words::duration(limits.delay)));
        }
        if !wire.connect_delay.is_zero() {
            rows.push(("Silence behind a connect", words::duration(wire.connect_delay)));
        }
        let waited = match wire.response_timeout {
            Some(timeout) => format!("at least {}; longer if the bus says so", words::duration(timeout)),
            None => "as long as the bus says (`response_timeout`)".into(),
        };
        rows.push(("An answer is awaited", waited));
        rows.push(("Asked how often", self.rhythm()));
        if wire.quirks.clamps_with_exception {
            let told = "the device takes the nearest that it allows, and still answers with an error; busker \
                        does not send such a value";
            rows.push(("A value out of range", told.into()));
        }
        if wire.quirks.exception_function_varies {
            let told =
                "can carry another function code than the question; busker understands it all the same";
            rows.push(("An error", told.into()));
        }
        if let Some(line) = &self.device.line {
            rows.push(("Its unit is set by", line.unit_by.clone()));
            rows.push(("Bit rate and parity are set by", line.settings.to_string()));
        }
        let _ = writeln!(text, "## On the wire\n\n| | |\n|---|---|");
        for (what, value) in rows {
            let _ = writeln!(text, "| {what} | {} |", words::cell(&value));
        }
        text.push('\n');
    }

    fn rhythm(&self) -> String {
        let intervals = self.device.wire.intervals;
        let mut parts = Vec::new();
        for (poll, told) in [
            (Poll::Fast, format!("every {}", words::duration(intervals.fast))),
            (Poll::Slow, format!("every {}", words::duration(intervals.slow))),
            (Poll::Once, "after each connect".into()),
        ] {
            match self.device.points.iter().filter(|point| point.poll == poll).count() {
                0 => {}
                1 => parts.push(format!("1 point {told}")),
                count => parts.push(format!("{count} points {told}")),
            }
        }
        parts.join(", ")
    }

    fn left_out(&self, text: &mut String) {
        if !self.device.left_out.is_empty() {
            let _ = writeln!(text, "## Left out\n\nThe manual has these too. busker leaves them alone:\n");
            for left_out in &self.device.left_out {
                let _ = writeln!(text, "* {}: {}", left_out.span, left_out.reason.trim());
            }
            text.push('\n');
        }
        let _ = writeln!(
            text,
            "The same for programs: `busker profiles show {} --json`. [All devices](../README.md)",
            self.device.profile
        );
    }

    pub fn names(&self, points: &[PointIndex]) -> String {
        let names: Vec<&str> = points.iter().map(|index| self.device.points[*index].name.as_str()).collect();
        words::together(&names)
    }

    /// The names of the points of a kind; `None` if there is none.
    fn names_of(&self, wanted: impl Fn(&Point) -> bool) -> Option<String> {
        let points = &self.device.points;
        let found: Vec<PointIndex> = (0..points.len()).filter(|index| wanted(&points[*index])).collect();
        (!found.is_empty()).then(|| self.names(&found))
    }
}

/// A name for the configuration, made of the profile's.
pub fn device_name(device: &Device) -> String {
    let model = device.profile.rsplit('/').next().unwrap_or_default().replace('-', "_");
    if model.starts_with(|c: char| c.is_ascii_lowercase()) { model } else { format!("device_{model}") }
}

fn quoted_if_needed(text: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || " -_/.".contains(c);
    let starts = text.starts_with(|c: char| c.is_ascii_alphabetic()) || text.parse::<f64>().is_ok();
    if starts && text.chars().all(plain) { text.into() } else { serde_json::Value::from(text).to_string() }
}
