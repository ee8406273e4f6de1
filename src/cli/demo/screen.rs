//! What the demo shows: a table that refreshes in place, or plain lines where there is no terminal.

use std::collections::BTreeMap;
use std::io::{self, IsTerminal, Write};
use std::net::SocketAddr;
use std::path::Path;

use crate::cli::output::Table;
use crate::engine::device::{Point, Poll};
use crate::engine::health::{DeviceReport, GatewayReport};
use crate::engine::settings::Settings;

use super::broker::{self, Mosquitto};

/// Values beside each other in the table, where there is room.
const COLUMNS_MAX: usize = 8;

/// Standard output, and what stands on it.
pub struct Screen {
    in_place: bool,
    broker: SocketAddr,
    /// Device to the points that are worth a look, in the profile's order.
    shown: BTreeMap<String, Vec<String>>,
    header: String,
    /// Terminal: what is on the screen. Plain lines: what each value was.
    drawn: String,
    told: BTreeMap<String, String>,
}

impl Screen {
    pub fn new(settings: &Settings, mosquitto: &Mosquitto) -> Screen {
        let shown = settings.devices.iter().map(|device| {
            let points = device.device.points.iter().filter(|point| is_worth_a_look(point));
            (device.name.clone(), points.map(|point| point.name.clone()).collect())
        });
        Screen {
            in_place: io::stdout().is_terminal(),
            broker: mosquitto.address(),
            shown: shown.collect(),
            header: String::new(),
            drawn: String::new(),
            told: BTreeMap::new(),
        }
    }

    /// Says where everything is and what to try.
    pub fn begin(&mut self, http: Option<SocketAddr>) -> io::Result<()> {
        let (host, port) = (self.broker.ip(), self.broker.port());
        let publish = format!("{} -h {host} -p {port}", shown_program("mosquitto_pub"));
        let subscribe = format!("{} -h {host} -p {port}", shown_program("mosquitto_sub"));
        let count = self.shown.len();
        let mut header = format!(
            "busker demo: {count} simulated devices, a broker and the gateway; Ctrl-C ends all of it\n\n\
             broker  mqtt://{}\n",
            self.broker
        );
        if let Some(http) = http {
            header.push_str(&format!("page    http://{http}/\nhealth  http://{http}/health\n"));
        }
        // Each command has a line of its own, to be copied as a whole.
        header.push_str(&format!(
            "\nwatch everything:\n{subscribe} -v -t 'busker/#'\n\
             switch a relay:\n{publish} -t busker/metz_connect_mr_do4/relay_1/set -m ON\n\
             change an input's sensor type:\n\
             {publish} -t busker/metz_connect_mr_ai8/channel_1_code/set -m pt1000\n"
        ));
        self.header = header;
        if self.in_place {
            // Clears the screen and hides the cursor.
            write("\x1b[2J\x1b[?25l")
        } else {
            write(&format!("{}\n", self.header))
        }
    }

    /// Brings the screen up to date.
    pub fn show(&mut self, report: &GatewayReport) -> io::Result<()> {
        if self.in_place { self.draw(report) } else { self.tell(report) }
    }

    /// Gives the terminal back as it was.
    pub fn leave(&self) {
        if self.in_place {
            let _ = write("\x1b[?25h\n");
        }
    }

    fn draw(&mut self, report: &GatewayReport) -> io::Result<()> {
        let (rows, columns) = size();
        let body: String = report.devices().map(|(_, device)| self.block(device, columns)).collect();
        let mut frame = String::from("\x1b[H");
        // The terminal breaks the long lines of the header by itself: a command is never cut.
        let mut used = 0;
        for line in self.header.lines() {
            frame.push_str(&format!("{line}\x1b[K\r\n"));
            used += line.chars().count().div_ceil(columns).max(1);
        }
        // What does not fit would scroll, and the next frame would stand below it.
        let room = rows.saturating_sub(used).max(1);
        let mut lines: Vec<String> = body.lines().map(str::to_string).collect();
        if lines.len() > room {
            lines.retain(|line| !line.is_empty());
        }
        if lines.len() > room {
            let more = lines.len() - (room - 1);
            lines.truncate(room - 1);
            lines.push(format!("… {more} more lines in a higher window"));
        }
        for (index, line) in lines.iter().enumerate() {
            // The last column stays free: a full line is broken by some terminals and not by others.
            let cut: String = line.chars().take(columns - 1).collect();
            let line_break = if index == 0 { "" } else { "\r\n" };
            frame.push_str(&format!("{line_break}{cut}\x1b[K"));
        }
        frame.push_str("\x1b[J");
        if frame == self.drawn {
            return Ok(());
        }
        write(&frame)?;
        self.drawn = frame;
        Ok(())
    }

    fn block(&self, device: &DeviceReport, width: usize) -> String {
        let state = match (device.online, &device.identity, &device.reason) {
            (true, Some(identity), _) => format!("online, {identity}"),
            (true, None, _) => "online".into(),
            (false, _, Some(reason)) => format!("offline: {reason}"),
            (false, _, None) => "offline".into(),
        };
        let values: Vec<String> =
            self.values(device).map(|(name, value)| format!("{name} {value}")).collect();
        format!("\n{}: {state}\n{}", device.name, side_by_side(&values, width))
    }

    /// A line for each value that has changed.
    fn tell(&mut self, report: &GatewayReport) -> io::Result<()> {
        let mut lines = String::new();
        for (_, device) in report.devices() {
            let state = if device.online { "online" } else { "offline" };
            let mut now = vec![(device.name.clone(), state.to_string())];
            now.extend(self.values(device).map(|(name, value)| (format!("{}/{name}", device.name), value)));
            for (what, value) in now {
                // Before the first reading there is nothing to tell.
                let is_first = !self.told.contains_key(&what);
                if self.told.get(&what) != Some(&value) && !(is_first && value.starts_with("- ")) {
                    lines.push_str(&format!("{what} {value}\n"));
                    self.told.insert(what, value);
                }
            }
        }
        if lines.is_empty() { Ok(()) } else { write(&lines) }
    }

    /// The points that are shown, with their values and units.
    fn values<'r>(&'r self, device: &'r DeviceReport) -> impl Iterator<Item = (&'r str, String)> {
        let shown = self.shown.get(&device.name).map_or([].as_slice(), Vec::as_slice);
        device.points.iter().filter(|point| shown.contains(&point.name)).map(|point| {
            let value = match (&point.unit, &point.missing) {
                (_, Some((_, reason))) => format!("- ({reason})"),
                (Some(unit), None) => format!("{} {unit}", point.value),
                (None, None) => point.value.clone(),
            };
            (point.name.as_str(), value)
        })
    }
}

/// As many values in a line as fit, in columns.
fn side_by_side(values: &[String], width: usize) -> String {
    let arranged = |columns: usize| {
        let mut table = Table::new();
        for row in values.chunks(columns) {
            table.row(std::iter::once(" ").chain(row.iter().map(String::as_str)));
        }
        table.render()
    };
    let fits = |text: &String| text.lines().all(|line| line.chars().count() < width);
    (2..=COLUMNS_MAX).rev().map(arranged).find(fits).unwrap_or_else(|| arranged(1))
}

/// Whether a person in front of the device would look at it: no setting, no diagnosis.
fn is_worth_a_look(point: &Point) -> bool {
    let look = &point.presentation;
    let is_setting = point.persistent || look.category.is_some() || look.enabled == Some(false);
    !is_setting && matches!(point.poll, Poll::Fast | Poll::Slow)
}

/// How a person types it: by its name, or by its path if a shell would not find it.
fn shown_program(program: &str) -> String {
    match broker::find(program) {
        Some(path)
            if !["/usr/bin", "/usr/local/bin", "/bin"].map(Path::new).map(Some).contains(&path.parent()) =>
        {
            path.display().to_string()
        }
        _ => program.to_string(),
    }
}

/// Rows and columns of the terminal.
fn size() -> (usize, usize) {
    match rustix::termios::tcgetwinsize(io::stdout()) {
        Ok(size) if size.ws_row > 1 && size.ws_col > 1 => (size.ws_row.into(), size.ws_col.into()),
        _ => (24, 80),
    }
}

fn write(text: &str) -> io::Result<()> {
    let mut stdout = io::stdout().lock();
    stdout.write_all(text.as_bytes())?;
    stdout.flush()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_stand_side_by_side_as_far_as_there_is_room() {
        let values = ["relay_1 ON", "relay_2 OFF", "relay_3 ON"].map(str::to_string);
        assert_eq!(side_by_side(&values, 80), "   relay_1 ON  relay_2 OFF  relay_3 ON\n");
        assert_eq!(side_by_side(&values, 30), "   relay_1 ON  relay_2 OFF\n   relay_3 ON\n");
        assert_eq!(side_by_side(&values, 5), "   relay_1 ON\n   relay_2 OFF\n   relay_3 ON\n");
    }
}
