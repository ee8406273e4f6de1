//! The programs of a measurement: a real mosquitto, and the release build of busker.
//!
//! They are not those of the tests' support: there a failure panics, while here the next row is measured; what
//! the program says goes to a file, so that no thread of ours wakes for it; and the broker holds nothing back.

use std::fs::{self, File};
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use anyhow::{Context, bail};
use serde_json::Value;
use tempfile::TempDir;

use crate::clock::{now, seconds_since};
use crate::machine;

pub struct Mosquitto {
    child: Child,
    pub port: u16,
    folder: TempDir,
}

impl Mosquitto {
    pub fn start() -> anyhow::Result<Mosquitto> {
        let folder = tempfile::tempdir()?;
        for _ in 0..5 {
            let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
            if let Some(child) = launch(&folder, port)? {
                return Ok(Mosquitto { child, port, folder });
            }
        }
        bail!("mosquitto does not start")
    }

    /// Kills it with all that it remembers, and starts it again on the same port.
    pub fn start_anew(&mut self) -> anyhow::Result<()> {
        self.child.kill()?;
        self.child.wait()?;
        self.child = launch(&self.folder, self.port)?.context("mosquitto does not start again")?;
        Ok(())
    }

    pub fn cpu_seconds(&self) -> f64 {
        machine::cpu_seconds(self.child.id())
    }
}

impl Drop for Mosquitto {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// `None` if the port is taken.
fn launch(folder: &TempDir, port: u16) -> anyhow::Result<Option<Child>> {
    let path = folder.path().join("mosquitto.conf");
    // Its own defaults hold back what a subscriber has not taken yet, and then drop it.
    let text = format!(
        "listener {port} 127.0.0.1\nallow_anonymous true\npersistence false\nlog_dest stderr\n\
         set_tcp_nodelay true\nmax_queued_messages 0\nmax_inflight_messages 0\n"
    );
    fs::write(&path, text)?;
    let mut child = Command::new("mosquitto")
        .arg("-c")
        .arg(&path)
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .context("mosquitto cannot be started; `scripts/get-mosquitto` gets it")?;
    let log = child.stderr.take().context("its log is piped")?;
    let mut lines = BufReader::new(log).lines().map_while(Result::ok);
    // Without the port it ends, and so does its log.
    if lines.any(|line| line.ends_with(" running")) {
        std::thread::spawn(move || lines.for_each(drop));
        return Ok(Some(child));
    }
    let _ = child.wait();
    Ok(None)
}

/// How many answers came, and how long devices took to begin them, all together.
#[derive(Clone, Copy)]
pub struct Turnarounds {
    seconds: f64,
    count: f64,
}

impl Turnarounds {
    /// The mean of those that came after `before`; `None` where none did.
    pub fn since(self, before: Turnarounds) -> Option<Duration> {
        let count = self.count - before.count;
        (count >= 1.0).then(|| Duration::from_secs_f64((self.seconds - before.seconds) / count))
    }
}

/// A running gateway.
pub struct Busker {
    child: Child,
    pub started_at: i64,
    folder: TempDir,
}

impl Busker {
    /// `busker run` with this broker and with buses and devices as in `rest`.
    pub fn start(mosquitto: &Mosquitto, rest: &str) -> anyhow::Result<Busker> {
        Busker::start_at(mosquitto.port, rest)
    }

    /// The same with a broker at a port of this machine.
    pub fn start_at(port: u16, rest: &str) -> anyhow::Result<Busker> {
        let folder = tempfile::tempdir()?;
        let text = format!(
            "mqtt: {{url: \"mqtt://127.0.0.1:{}\"}}\nhttp: {{listen: \"127.0.0.1:0\"}}\nstate_dir: {}\n{rest}",
            port,
            folder.path().display(),
        );
        let path = folder.path().join("busker.yaml");
        fs::write(&path, text)?;
        let log = File::create(folder.path().join("log"))?;
        let started_at = now();
        let child = Command::new(program()?)
            .args(["run", "--config"])
            .arg(&path)
            .env_remove("RUST_LOG")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()?;
        Ok(Busker { child, started_at, folder })
    }

    /// The number of its process.
    pub fn process(&self) -> u32 {
        self.child.id()
    }

    /// What it has said.
    pub fn log(&self) -> String {
        fs::read_to_string(self.folder.path().join("log")).unwrap_or_default()
    }

    /// Whether it still runs.
    pub fn runs(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// What `busker check` says of its configuration, where devices begin their answers after
    /// `turnaround`; and keeps the file as `target/bench/<name>.yaml`.
    pub fn check(&self, name: &str, turnaround: Duration) -> anyhow::Result<Value> {
        let program = program()?;
        let target = program.parent().and_then(Path::parent).context("a target folder")?;
        fs::create_dir_all(target.join("bench"))?;
        let kept = target.join("bench").join(format!("{name}.yaml"));
        fs::copy(self.folder.path().join("busker.yaml"), &kept)?;
        // It takes whole microseconds.
        let turnaround = format!("{}ms", turnaround.as_micros() as f64 / 1e3);
        let output = Command::new(&program)
            .args(["check", "--json", "--turnaround", &turnaround, "--config"])
            .arg(&kept)
            .output()?;
        if !output.status.success() {
            bail!("`busker check` finds faults: {}", String::from_utf8_lossy(&output.stderr));
        }
        Ok(serde_json::from_slice(&output.stdout)?)
    }

    pub fn cpu_seconds(&self) -> f64 {
        machine::cpu_seconds(self.child.id())
    }

    /// The answers of all devices since it began, as it tells Prometheus.
    pub fn turnarounds(&mut self) -> anyhow::Result<Turnarounds> {
        let mut page =
            ureq::get(format!("http://{}/metrics", self.http()?)).call().context("HTTP answers")?;
        let text = page.body_mut().read_to_string().context("the page of metrics")?;
        let all = |name: &str| -> f64 {
            let lines = text
                .lines()
                .filter(|line| line.starts_with(&format!("busker_device_turnaround_seconds_{name}{{")));
            lines.filter_map(|line| line.rsplit(' ').next()?.parse::<f64>().ok()).sum()
        };
        Ok(Turnarounds { seconds: all("sum"), count: all("count") })
    }

    /// In bytes.
    pub fn resident(&self) -> f64 {
        machine::resident(self.child.id())
    }

    /// Waits until it has told where it serves HTTP: `127.0.0.1:…`.
    pub fn http(&mut self) -> anyhow::Result<String> {
        let log = self.folder.path().join("log");
        let mut address = String::new();
        self.wait(20.0, "the address of HTTP", || {
            let text = fs::read_to_string(&log).unwrap_or_default();
            let behind = text.split_once("HTTP on http://").map(|(_, behind)| behind.to_owned());
            address =
                behind.and_then(|behind| Some(behind.split_once('/')?.0.to_owned())).unwrap_or_default();
            !address.is_empty()
        })?;
        Ok(address)
    }

    /// Looks until `done`; fails with what the program said when that takes too long.
    pub fn wait(&mut self, seconds: f64, what: &str, mut done: impl FnMut() -> bool) -> anyhow::Result<()> {
        let began_at = now();
        while !done() {
            let ended = self.child.try_wait()?.is_some();
            if ended || seconds_since(began_at) > seconds {
                bail!("waited in vain for {what}; the program said:\n{}", self.log());
            }
            crate::clock::sleep(std::time::Duration::from_millis(2));
        }
        Ok(())
    }
}

impl Drop for Busker {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The release build, which lies beside the folder of this one.
pub fn program() -> anyhow::Result<PathBuf> {
    let own = std::env::current_exe()?;
    let folder = own.parent().and_then(Path::parent).context("the benchmark is in a folder")?;
    let program = folder.join("busker");
    if !program.exists() {
        bail!("`{}` is not there; `make bench` and `make soak` build it", program.display());
    }
    Ok(program)
}
