//! A configuration file to [`Settings`], or to every fault in it.
//!
//! [`file`] is the shape, `words` its scalars; here, in `broker`, `links`, `wishes` and `wanted` are the rules beyond
//! the shape.

mod broker;
pub mod file;
mod identities;
mod links;
mod secrets;
mod wanted;
mod wishes;
mod words;

pub use words::BAUD_RATES;

use std::path::PathBuf;
use std::sync::Arc;

use crate::engine::address::Span;
use crate::engine::configuration::file::Configuration;
use crate::engine::configuration::words::{Listen, Name, Part, Unit};
use crate::engine::device::{self, Device};
use crate::engine::profile::file::Intervals;
use crate::engine::profile::{self, Inline, Library};
use crate::engine::settings::{
    Bus, DeviceSettings, Eeprom, HomeAssistant, Http, Level, Password, Recorder, Settings, UNIT_OF_LINE_MAX,
    Wanted, host_and_port,
};
use crate::engine::time::Duration;
use crate::engine::units::Release;
use crate::engine::yaml::{
    At, Content, Diagnostic, Faults, Json, Map, Node, Place, Read, Source, list_of_choices, parse, read,
    schema_of,
};

/// Something that works and may still be a mistake.
pub type Warning = Diagnostic;

/// The settings in `bytes`, a file that messages call `file_name`.
pub fn load(
    file_name: &str,
    bytes: &[u8],
    library: &Library,
) -> Result<(Settings, Vec<Warning>), Vec<Diagnostic>> {
    let mut faults = Faults::default();
    let source = Source::from_bytes(file_name, bytes, &mut faults);
    let node = source.as_ref().and_then(|source| parse(source, &mut faults));
    let file: Option<Configuration> = node.and_then(|node| read(&node, &mut faults));
    let mut resolver = Resolver { library, faults, warnings: Faults::default(), release: Release::USUAL };
    let settings = file.and_then(|file| resolver.settings(&file));
    let Resolver { mut faults, mut warnings, .. } = resolver;
    if let Some(source) = source {
        // A fault is shown with its line, and that goes to logs.
        let shown = Source::new(file_name, &secrets::hidden(source.text()));
        faults.show_by(&shown);
        warnings.show_by(&shown);
    }
    faults.into_result(settings).map(|settings| (settings, warnings.into_sorted()))
}

/// The folders under `profiles`, which must be read before [`load`]. Faults are left to [`load`].
pub fn profile_folders(file_name: &str, bytes: &[u8]) -> Vec<At<String>> {
    let mut faults = Faults::default();
    let source = Source::from_bytes(file_name, bytes, &mut faults);
    let node = source.and_then(|source| parse(&source, &mut faults));
    let folders = node.as_ref().and_then(|node| node.get("profiles"));
    folders.and_then(|folders| read(folders, &mut faults)).unwrap_or_default()
}

/// A fault that only the edge can find, at the value that these keys lead to, `["mqtt", "tls"]`: what a
/// file says that the configuration names. Shown without the configuration's secrets.
pub fn fault_at(file_name: &str, bytes: &[u8], keys: &[&str], message: String) -> Diagnostic {
    let mut unread = Faults::default();
    let source = Source::from_bytes(file_name, bytes, &mut unread);
    let node = source.as_ref().and_then(|source| parse(source, &mut unread));
    let mut found = node.as_ref();
    for key in keys {
        found = found.map(|node| node.get(key).unwrap_or(node));
    }
    let mut faults = Faults::default();
    let place = found.map_or_else(Place::nowhere, |node| match node.content {
        Content::Scalar { .. } => node.place.clone(),
        Content::Map(_) | Content::List(_) => node.named_at().clone(),
    });
    faults.add(&place, message.clone());
    if let Some(source) = source {
        faults.show_by(&Source::new(file_name, &secrets::hidden(source.text())));
    }
    faults.into_sorted().pop().unwrap_or(Diagnostic { place, message })
}

/// The settings in `bytes`, a file with nothing but what stands under a device's `settings:`.
pub fn load_wanted(file_name: &str, bytes: &[u8], device: &Device) -> Result<Vec<Wanted>, Vec<Diagnostic>> {
    let mut faults = Faults::default();
    let source = Source::from_bytes(file_name, bytes, &mut faults);
    let node = source.and_then(|source| parse(&source, &mut faults));
    let settings = node.and_then(|node| read(&node, &mut faults));
    let wanted = settings.map(|settings| wanted::check(&settings, device, &mut faults));
    faults.into_result(wanted)
}

/// The JSON Schema of a configuration file.
pub fn schema() -> Json {
    schema_of::<Configuration>("busker configuration")
}

/// A longer tape than this is a capture, which is another program's job.
const RECORDER_KILOBYTES_MAX: u32 = 4096;

struct Resolver<'a> {
    library: &'a Library,
    faults: Faults,
    warnings: Faults,
    /// The oldest Home Assistant that must know the device classes.
    release: Release,
}

impl Resolver<'_> {
    /// Goes through the whole file. What is faulty becomes a fault and something harmless, so that
    /// the rest is looked at as well.
    fn settings(&mut self, file: &Configuration) -> Option<Settings> {
        if let Some(state_dir) = file.state_dir.get().filter(|path| !path.starts_with('/')) {
            let found = &state_dir.value;
            self.faults.add(
                &state_dir.place,
                format!("`{found}` is no absolute path; expected one like `/var/lib/busker`"),
            );
        }
        self.within(file.republish.get(), Duration::from_secs(1), Duration::from_secs(86_400));
        let home_assistant = section(&file.home_assistant).map(|section| {
            self.expiry(&section, file.republish.get());
            home_assistant(&section)
        });
        self.release = home_assistant.as_ref().map_or(Release::USUAL, |section| section.minimum_version);
        let mqtt = section(&file.mqtt).map(|mqtt| self.mqtt(&mqtt));
        let eeprom = section(&file.eeprom).map(|eeprom| self.eeprom(&eeprom));
        let recorder = section(&file.recorder).map(|recorder| self.recorder(&recorder));
        let http = match &file.http {
            Some(part) => part.get().map(|http| self.http(http)),
            None => Some(self.http(&file::Http::off())),
        };
        let buses = self.buses(file);
        let devices = self.devices(file);
        // Each `?` stands for a fault that has been noted.
        Some(Settings {
            mqtt: mqtt?,
            home_assistant: home_assistant?,
            http: http?,
            state_dir: PathBuf::from(&file.state_dir.get()?.value),
            republish: file.republish.get()?.value,
            on_broker_loss: *file.on_broker_loss.get()?,
            eeprom: eeprom?,
            recorder: recorder?,
            buses,
            devices,
        })
    }

    /// What has not changed is told once in `republish`, and two such messages may be lost.
    fn expiry(&mut self, file: &file::HomeAssistant, republish: Option<&At<Duration>>) {
        let (Some(expiry), Some(republish)) = (&file.expire_after, republish) else { return };
        self.within(Some(expiry), Duration::from_secs(1), Duration::from_secs(7 * 86_400));
        let least = republish.value * 3;
        if expiry.value < least {
            let message = format!(
                "what has not changed is told once in {} (`republish`), and would expire meanwhile; expected at least \
                 {}, or a shorter `republish`",
                told(republish.value),
                told(least)
            );
            self.faults.add(&expiry.place, message);
        }
    }

    fn eeprom(&mut self, file: &file::Eeprom) -> Eeprom {
        self.within(Some(&file.interval), Duration::ZERO, Duration::from_secs(86_400));
        if file.daily.value == 0 {
            self.faults.add(&file.daily.place, "no writes at all; expected at least 1 a day");
        }
        Eeprom { interval: file.interval.value, daily: file.daily.value.into() }
    }

    fn recorder(&mut self, file: &file::Recorder) -> Recorder {
        self.within(Some(&file.interval), Duration::from_secs(60), Duration::from_secs(86_400));
        let kilobytes = file.kilobytes.value;
        if kilobytes > RECORDER_KILOBYTES_MAX {
            let place = &file.kilobytes.place;
            let message = format!(
                "{kilobytes} is too much for a tape in memory; expected at most {RECORDER_KILOBYTES_MAX}, or 0 for none"
            );
            self.faults.add(place, message);
        }
        if file.keep.value == 0 {
            let message =
                "no file at all; expected at least 1, or `kilobytes: 0` where nothing shall be recorded";
            self.faults.add(&file.keep.place, message);
        }
        Recorder {
            bytes: kilobytes as usize * 1024,
            on_error: (file.on_error && kilobytes > 0).then_some(file.interval.value),
            keep: file.keep.value.into(),
        }
    }

    fn http(&mut self, file: &file::Http) -> Http {
        let (token, token_file) = (file.token.as_ref(), file.token_file.as_ref());
        self.one_of_two("token", token.map(|at| &at.place), token_file.map(|at| &at.place));
        let listen = file.listen.as_ref();
        let listen = listen.map(|Listen(listen)| host_and_port(&listen.host, listen.port));
        let token = match (token, token_file) {
            (Some(token), _) => Password::Given(token.0.clone()),
            (None, Some(path)) => Password::File(PathBuf::from(&path.value)),
            (None, None) => Password::None,
        };
        Http { listen, token }
    }

    /// A secret stands in the configuration or in a file of its own.
    fn one_of_two(&mut self, key: &str, here: Option<&Place>, in_a_file: Option<&Place>) {
        if let (Some(here), Some(in_a_file)) = (here, in_a_file) {
            let line = here.line();
            self.faults.add(in_a_file, format!("`{key}` stands in line {line} too; keep one of the two"));
        }
    }

    fn buses(&mut self, file: &Configuration) -> Vec<Bus> {
        let mut buses = Vec::new();
        let mut ports: Vec<&At<String>> = Vec::new();
        let devices = file.devices.get();
        let first_level = section(&file.mqtt).and_then(|mqtt| mqtt.topics.levels.first().cloned());
        for (name, bus) in file.buses.get().into_iter().flat_map(Map::iter) {
            self.within(bus.response_timeout.get(), Duration::from_millis(10), Duration::from_secs(60));
            self.within(read_part(&bus.gap), Duration::from_micros(100), Duration::from_secs(1));
            if let Some(port) = read_part(&bus.serial) {
                self.serial_port(port, &ports);
                ports.push(port);
            }
            let is_here = |device: &file::Device| device.bus.get().is_none_or(|bus| bus.value == name.value);
            if let Some(devices) = devices.filter(|devices| devices.unread.is_empty() && !devices.is_empty())
            {
                if !devices.iter().any(|(_, device)| is_here(device)) {
                    self.warnings.add(&name.place, format!("no device is on the bus `{}`", name.0));
                }
            }
            if name.0 == "bridge" && first_level == Some(Level::Bus) {
                let message = "below `{base}/bridge` the gateway tells of itself, and `topics` would put this bus \
                               there; give the bus another name";
                self.faults.add(&name.place, message);
            }
            if let Some(link) = self.link(name, bus) {
                buses.push(Bus {
                    name: name.0.clone(),
                    link,
                    response_timeout: bus.response_timeout.get().map(|at| at.value).unwrap_or_default(),
                    gap: read_part(&bus.gap).map(|gap| gap.value),
                });
            }
        }
        if devices.is_some_and(|devices| devices.is_empty() && devices.unread.is_empty()) {
            self.warnings.add(&file.place, "no device is configured; devices stand under `devices`");
        }
        buses
    }

    fn devices(&mut self, file: &Configuration) -> Vec<DeviceSettings> {
        let mut devices: Vec<DeviceSettings> = Vec::new();
        let mut taken: Vec<(&Name, Unit, &At<Name>)> = Vec::new();
        let mut distinct: Vec<Arc<Device>> = Vec::new();
        for (name, device) in file.devices.get().into_iter().flat_map(Map::iter) {
            self.device_name(name, file);
            if let (Some(bus), Some(unit)) = (device.bus.get(), device.unit.get()) {
                let same =
                    taken.iter().find(|(other, taken, _)| **other == bus.value && *taken == unit.value);
                if let Some((_, _, other)) = same {
                    self.faults.add(
                        &unit.place,
                        format!(
                            "unit {} on the bus `{}` is the device `{}` of line {} already; \
                             two devices on a bus need two units",
                            unit.value.0,
                            bus.value.0,
                            other.value.0,
                            other.place.line()
                        ),
                    );
                }
                taken.push((&bus.value, unit.value, name));
            }
            let bus = self.bus_of(device, file);
            if let (Some(bus), Some(unit), Some(resolved)) = (bus, device.unit.get(), self.device(device)) {
                let settings = read_part(&device.settings);
                let wanted = settings.map(|settings| wanted::check(settings, &resolved, &mut self.faults));
                let raw_write = device.raw_write.get().map(|spans| self.raw_write(spans, &resolved));
                if device.profile.is_some() && device.points.is_some() {
                    self.keys_with_wishes(name, &resolved);
                }
                self.identities(name, &resolved, &devices, file);
                devices.push(DeviceSettings {
                    name: name.0.clone(),
                    title: device.name.clone().unwrap_or_else(|| device::sentence(&name.0)),
                    bus,
                    unit: unit.value.0,
                    device: shared(resolved, &mut distinct),
                    wanted: wanted.unwrap_or_default(),
                    raw_write: raw_write.unwrap_or_default(),
                });
            }
        }
        devices
    }

    /// What may be written as it is lies in a table that can be written, and touches nothing forbidden.
    fn raw_write(&mut self, spans: &[Part<At<Span>>], device: &Device) -> Vec<Span> {
        let spans = || spans.iter().filter_map(Part::get);
        for span in spans() {
            if !span.table().is_writable() {
                self.faults.add(
                    &span.place,
                    format!("`{}` can only be read; expected spans of `coil` or `holding`", span.value),
                );
            }
            for left_out in device.left_out.iter().filter(|other| other.span.overlaps(span.value)) {
                let (found, inside, reason) = (span.value, left_out.span, &left_out.reason);
                let message = format!("`{found}` touches `{inside}`, which the profile leaves out: {reason}");
                self.warnings.add(&span.place, message);
            }
            if let Some(forbidden) =
                device.wire.forbidden.iter().find(|other| other.span.overlaps(span.value))
            {
                let (found, inside, reason) = (span.value, forbidden.span, &forbidden.reason);
                let message = format!(
                    "`{found}` touches `{inside}`, which the profile forbids ({reason}); leave it out"
                );
                self.faults.add(&span.place, message);
            }
        }
        spans().map(|span| span.value).collect()
    }

    /// The index of a device's bus; the device's unit is checked against it.
    fn bus_of(&mut self, device: &file::Device, file: &Configuration) -> Option<usize> {
        let (wanted, buses) = (device.bus.get()?, file.buses.get()?);
        if !buses.names(&wanted.value) {
            let names: Vec<&str> = buses.iter().map(|(name, _)| name.0.as_str()).collect();
            self.faults.add(
                &wanted.place,
                format!("there is no bus `{}`; {}", wanted.0, list_of_choices(&wanted.0, &names)),
            );
            return None;
        }
        let index = buses.iter().position(|(name, _)| name.value == wanted.value)?;
        let unit = device.unit.get()?;
        if buses.entries[index].1.tcp.is_none() && !(1..=UNIT_OF_LINE_MAX).contains(&unit.value.0) {
            let why =
                if unit.value.0 == 0 { "0 speaks to all units at once" } else { "248 to 255 are reserved" };
            self.faults.add(
                &unit.place,
                format!("{} is no unit on a serial line ({why}); expected 1 to 247", unit.value.0),
            );
        }
        Some(index)
    }

    /// The profile with the owner's wishes, or the device's own points.
    fn device(&mut self, file: &file::Device) -> Option<Device> {
        let mut device = match &file.profile {
            Some(profile) => {
                let own = [
                    ("things", file.things.as_ref().map(|things| &things.node)),
                    ("wire", file.wire.as_ref().map(|wire| &wire.node)),
                    ("home_assistant", file.home_assistant.as_ref().map(|looks| &looks.node)),
                ];
                for (key, node) in own {
                    if let Some(node) = node {
                        let message = format!(
                            "`{key}` belongs to the profile; it stands here only for a device without one"
                        );
                        self.faults.add(node.named_at(), message);
                    }
                }
                self.profile(profile)?
            }
            None => self.inline(file)?,
        };
        if let Some(poll) = read_part(&file.poll) {
            self.intervals(poll, &mut device);
        }
        if let (Some(_), Some(points)) = (&file.profile, &file.points) {
            wishes::apply(&points.0, &mut device, self.release, &mut self.faults, &mut self.warnings);
        }
        Some(device)
    }

    fn profile(&mut self, wanted: &At<String>) -> Option<Device> {
        if !self.library.contains(wanted) {
            self.faults.add(&wanted.place, self.library.unknown(wanted));
            return None;
        }
        self.library.load(wanted).map_err(|faults| self.faults.extend(faults)).ok()
    }

    fn inline(&mut self, file: &file::Device) -> Option<Device> {
        let Some(points) = &file.points else {
            self.faults.add(&file.place, "this device has neither a `profile` nor `points` of its own");
            return None;
        };
        let inline = Inline {
            points: &points.0,
            things: file.things.as_ref().map(|things| &things.node),
            wire: file.wire.as_ref().map(|wire| &wire.node),
            home_assistant: file.home_assistant.as_ref().map(|looks| &looks.node),
        };
        let device = profile::load_inline(&inline, self.library, &mut self.faults)?;
        for point in &device.points {
            let unit = points.0.get(&point.name).and_then(|point| point.get("unit"));
            let place = unit.map_or(points.0.named_at(), |unit| &unit.place);
            for form in point.encoding.forms() {
                if let device::Unit::Fixed(unit) = &form.unit {
                    wishes::hint_at_unit(&point.name, unit, place, &mut self.warnings);
                }
            }
        }
        if let Some(looks) = &file.home_assistant {
            wishes::check_release(&device, self.release, looks.node.named_at(), &mut self.faults);
        }
        Some(device)
    }

    fn intervals(&mut self, file: &Intervals, device: &mut Device) {
        let intervals = &mut device.wire.intervals;
        for (wish, own) in [(&file.fast, &mut intervals.fast), (&file.slow, &mut intervals.slow)] {
            self.within(wish.as_ref(), Duration::from_millis(1), Duration::from_secs(86_400));
            if let Some(wish) = wish {
                *own = wish.value;
            }
        }
        if intervals.fast > intervals.slow {
            let (fast, slow) = (told(intervals.fast), told(intervals.slow));
            self.faults.add(&file.place, format!("`fast` ({fast}) takes longer than `slow` ({slow})"));
        }
    }

    fn within(&mut self, found: Option<&At<Duration>>, least: Duration, most: Duration) {
        if let Some(found) = found.filter(|found| !(least..=most).contains(&found.value)) {
            let (value, least, most) = (told(found.value), told(least), told(most));
            self.faults.add(&found.place, format!("{value} is out of range; expected {least} to {most}"));
        }
    }
}

/// Many devices of one profile are kept once. Of those that wish something of their own there may be as
/// many as devices, and not all are compared.
fn shared(device: Device, distinct: &mut Vec<Arc<Device>>) -> Arc<Device> {
    const COMPARED_MAX: usize = 8;
    let same_profile = distinct.iter().rev().filter(|other| other.profile == device.profile);
    if let Some(other) = same_profile.take(COMPARED_MAX).find(|other| ***other == device) {
        return other.clone();
    }
    let device = Arc::new(device);
    distinct.push(device.clone());
    device
}

fn read_part<T>(part: &Option<Part<T>>) -> Option<&T> {
    part.as_ref().and_then(Part::get)
}

fn home_assistant(file: &file::HomeAssistant) -> HomeAssistant {
    HomeAssistant {
        discovery: file.discovery,
        prefix: file.prefix.0.clone(),
        status_topic: file.status_topic.0.clone(),
        minimum_version: file.minimum_version.value,
        expire_after: file.expire_after.as_ref().map(|at| at.value),
    }
}

/// A section that was left out is one in which every key was left out; `None` for a faulty one.
fn section<T: Read + Clone>(file: &Option<Part<T>>) -> Option<T> {
    match file {
        Some(part) => part.get().cloned(),
        None => {
            let empty = Node { place: Place::nowhere(), key: None, content: Content::Map(Vec::new()) };
            read(&empty, &mut Faults::default())
        }
    }
}

/// A duration as people write it here: `250ms`, `1.5s`, `10m`.
fn told(duration: Duration) -> String {
    let micros = duration.as_micros();
    for (unit, each) in
        [("d", 86_400_000_000), ("h", 3_600_000_000), ("m", 60_000_000), ("s", 1_000_000), ("ms", 1000)]
    {
        if micros >= each && micros % each == 0 {
            return format!("{}{unit}", micros / each);
        }
    }
    if micros >= 1000 { format!("{}ms", micros as f64 / 1000.0) } else { format!("{micros}us") }
}

#[cfg(test)]
mod tests;
