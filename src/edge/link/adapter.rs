//! What the system knows of the adapter behind a serial port, from `/dev` and `/sys`, without opening it.

use std::fs;
use std::path::{Path, PathBuf};

/// The names that stay with an adapter wherever it is plugged in, as udev makes them.
pub const BY_ID: &str = "/dev/serial/by-id";
/// Where the kernel tells about its terminals.
const TERMINALS: &str = "/sys/class/tty";

/// The path in `folder`, usually [`BY_ID`], that leads to the same port as `path` now.
pub fn stable_path(path: &Path, folder: &Path) -> Option<PathBuf> {
    let port = fs::canonicalize(path).ok()?;
    let links = fs::read_dir(folder).ok()?.filter_map(Result::ok).map(|entry| entry.path());
    // The same one each time, if an adapter has several names.
    links.filter(|link| fs::canonicalize(link).is_ok_and(|target| target == port)).min()
}

/// The driver of the port, `ftdi_sio`; `None`: it has none, or the system does not tell.
pub fn driver(path: &Path) -> Option<String> {
    driver_in(Path::new(TERMINALS), &terminal(path)?)
}

/// How many milliseconds an FTDI adapter waits for more bytes before it hands some over; `None` where there
/// is no such timer.
pub fn latency_timer(path: &Path) -> Option<u32> {
    latency_timer_in(Path::new(TERMINALS), &terminal(path)?)
}

/// `FTDI FT232R USB UART A1B2C3D4`; `None` where there is no USB adapter.
pub fn product(path: &Path) -> Option<String> {
    product_in(Path::new(TERMINALS), &terminal(path)?)
}

/// `ttyUSB0`, wherever the links lead.
fn terminal(path: &Path) -> Option<String> {
    let path = fs::canonicalize(path).ok()?;
    Some(path.strip_prefix("/dev").ok()?.to_str()?.to_owned())
}

/// The kernel puts a device of its own between a port of the board and its driver.
const BETWEEN: [&str; 2] = ["port", "ctrl"];

fn driver_in(terminals: &Path, terminal: &str) -> Option<String> {
    let device = fs::canonicalize(terminals.join(terminal).join("device")).ok()?;
    let drivers = device.ancestors().take(4).filter_map(|folder| fs::read_link(folder.join("driver")).ok());
    let names = drivers.filter_map(|driver| Some(driver.file_name()?.to_str()?.to_owned()));
    names.into_iter().find(|name| !BETWEEN.contains(&name.as_str()))
}

fn latency_timer_in(terminals: &Path, terminal: &str) -> Option<u32> {
    let text = fs::read_to_string(terminals.join(terminal).join("device/latency_timer")).ok()?;
    text.trim().parse().ok()
}

fn product_in(terminals: &Path, terminal: &str) -> Option<String> {
    let device = fs::canonicalize(terminals.join(terminal).join("device")).ok()?;
    let usb = device.ancestors().take(4).find(|folder| folder.join("idVendor").exists())?;
    let words = ["manufacturer", "product", "serial"];
    let words: Vec<String> = words
        .iter()
        .filter_map(|word| Some(fs::read_to_string(usb.join(word)).ok()?.trim().to_owned()))
        .collect();
    (!words.is_empty()).then(|| words.join(" "))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    /// A tree like that of an FTDI adapter in `/sys`.
    fn ftdi(root: &Path) -> PathBuf {
        let usb = root.join("devices/usb1/1-2");
        let port = usb.join("1-2:1.0/ttyUSB0");
        fs::create_dir_all(&port).expect("a temporary folder");
        fs::create_dir_all(root.join("drivers/ftdi_sio")).expect("a temporary folder");
        fs::create_dir_all(root.join("class/ttyUSB0")).expect("a temporary folder");
        for (file, text) in [
            (usb.join("idVendor"), "0403\n"),
            (usb.join("manufacturer"), "FTDI\n"),
            (usb.join("product"), "FT232R USB UART\n"),
            (usb.join("serial"), "A1B2C3D4\n"),
            (port.join("latency_timer"), "16\n"),
        ] {
            fs::write(file, text).expect("a temporary file");
        }
        symlink(root.join("drivers/ftdi_sio"), port.join("driver")).expect("a temporary link");
        symlink(&port, root.join("class/ttyUSB0/device")).expect("a temporary link");
        root.join("class")
    }

    #[test]
    fn an_adapter_is_told_by_its_driver_its_product_and_its_timer() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let class = ftdi(root.path());
        assert_eq!(driver_in(&class, "ttyUSB0").as_deref(), Some("ftdi_sio"));
        assert_eq!(latency_timer_in(&class, "ttyUSB0"), Some(16));
        assert_eq!(product_in(&class, "ttyUSB0").as_deref(), Some("FTDI FT232R USB UART A1B2C3D4"));
        assert_eq!(driver_in(&class, "pts/3"), None);
        assert_eq!(latency_timer_in(&class, "pts/3"), None);
        assert_eq!(product_in(&class, "pts/3"), None);
    }

    #[test]
    fn a_port_of_the_board_has_the_driver_behind_the_kernels_own() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let uart = root.path().join("soc/fe201000.serial");
        let port = uart.join("fe201000.serial:0/fe201000.serial:0.0");
        fs::create_dir_all(&port).expect("a temporary folder");
        fs::create_dir_all(root.path().join("class/ttyAMA0")).expect("a temporary folder");
        for (folder, driver) in
            [(port.as_path(), "port"), (&uart.join("fe201000.serial:0"), "ctrl"), (&uart, "uart-pl011")]
        {
            symlink(root.path().join("drivers").join(driver), folder.join("driver"))
                .expect("a temporary link");
        }
        symlink(&port, root.path().join("class/ttyAMA0/device")).expect("a temporary link");
        assert_eq!(driver_in(&root.path().join("class"), "ttyAMA0").as_deref(), Some("uart-pl011"));
        assert_eq!(product_in(&root.path().join("class"), "ttyAMA0"), None);
    }

    #[test]
    fn the_stable_path_is_the_one_that_leads_to_the_port_now() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let by_id = root.path().join("by-id");
        fs::create_dir_all(&by_id).expect("a temporary folder");
        for port in ["ttyUSB0", "ttyUSB1"] {
            fs::write(root.path().join(port), "").expect("a temporary file");
        }
        symlink("../ttyUSB1", by_id.join("usb-FTDI_A1-if00-port0")).expect("a temporary link");
        symlink("../ttyUSB7", by_id.join("usb-gone-if00-port0")).expect("a temporary link");
        let stable = |port: &str| stable_path(&root.path().join(port), &by_id);
        assert_eq!(stable("ttyUSB1"), Some(by_id.join("usb-FTDI_A1-if00-port0")));
        assert_eq!(stable("ttyUSB0"), None);
        assert_eq!(stable("ttyUSB7"), None);
        assert_eq!(stable_path(&root.path().join("ttyUSB1"), Path::new("/nonexistent")), None);
    }
}
