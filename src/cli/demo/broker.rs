//! The demo's own mosquitto: started on a free port, ended with the demo however that ends.

use std::env;
use std::fs::File;
use std::io::{BufRead, BufReader, Seek, Write};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

use anyhow::{Context, bail};
use rustix::fs::{MemfdFlags, memfd_create};

/// A free port may be taken by somebody else before mosquitto has it.
const ATTEMPTS: usize = 5;

const STARTS_WITHIN: Duration = Duration::from_secs(10);

/// A running mosquitto.
pub struct Mosquitto {
    address: SocketAddr,
    child: Child,
    guard: Guard,
    /// What it says, line by line; the channel closes when it ends.
    log: Receiver<String>,
    last_line: String,
}

impl Mosquitto {
    /// Starts it on `wanted`, or on a free loopback port, and waits until it listens.
    pub fn start(wanted: Option<SocketAddr>) -> anyhow::Result<Mosquitto> {
        let Some(program) = find("mosquitto") else {
            bail!("mosquitto is not installed; `make demo` fetches it, or install the package `mosquitto`");
        };
        if let Some(address) = wanted {
            return Mosquitto::start_on(&program, address);
        }
        let mut failure = None;
        for _ in 0..ATTEMPTS {
            let address = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?.local_addr()?;
            match Mosquitto::start_on(&program, address) {
                Ok(mosquitto) => return Ok(mosquitto),
                Err(error) => failure = Some(error),
            }
        }
        Err(failure.unwrap_or_else(|| anyhow::anyhow!("mosquitto was not started")))
    }

    fn start_on(program: &Path, address: SocketAddr) -> anyhow::Result<Mosquitto> {
        let configuration = format!(
            "listener {} {}\nallow_anonymous true\npersistence false\nlog_dest stderr\n",
            address.port(),
            address.ip()
        );
        let mut child = Command::new(program)
            .args(["-c", "/dev/stdin"])
            .stdin(file_in_memory(&configuration).context("its configuration")?)
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            // Not in the terminal's group: an interrupt is for the demo, which says goodbye first.
            .process_group(0)
            .spawn()
            .with_context(|| format!("`{}` cannot be started", program.display()))?;
        let guard = Guard::over(&child).inspect_err(|_| {
            let _ = child.kill();
        })?;
        let (sender, log) = channel();
        if let Some(stderr) = child.stderr.take() {
            std::thread::spawn(move || {
                for line in BufReader::new(stderr).lines().map_while(Result::ok) {
                    // Read on when nobody listens: a full pipe would stop mosquitto.
                    let _ = sender.send(line);
                }
            });
        }
        let mut mosquitto = Mosquitto { address, child, guard, log, last_line: String::new() };
        mosquitto.wait_until_it_runs()?;
        Ok(mosquitto)
    }

    fn wait_until_it_runs(&mut self) -> anyhow::Result<()> {
        loop {
            match self.log.recv_timeout(STARTS_WITHIN) {
                Ok(line) if line.ends_with(" running") => return Ok(()),
                Ok(line) => self.last_line = line,
                Err(RecvTimeoutError::Timeout) => bail!("mosquitto does not start: {}", self.last_line),
                Err(RecvTimeoutError::Disconnected) => {
                    bail!("mosquitto does not listen on {}: {}", self.address, self.last_line)
                }
            }
        }
    }

    /// Where a client reaches it.
    pub fn address(&self) -> SocketAddr {
        let ip = match self.address.ip() {
            IpAddr::V4(ip) if ip.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
            IpAddr::V6(ip) if ip.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
            ip => ip,
        };
        SocketAddr::new(ip, self.address.port())
    }

    /// Its last words, if it has ended by itself.
    pub fn has_ended(&mut self) -> Option<String> {
        while let Ok(line) = self.log.try_recv() {
            self.last_line = line;
        }
        match self.child.try_wait() {
            Ok(None) => None,
            _ => Some(self.last_line.clone()),
        }
    }

    /// Ends it and waits until it is gone.
    pub fn stop(self) {}
}

impl Drop for Mosquitto {
    fn drop(&mut self) {
        // With persistence off there is nothing to lose by the hard way.
        let _ = self.child.kill();
        let _ = self.child.wait();
        self.guard.dismiss();
    }
}

/// There is no file to leave behind; and a pipe would not do, since mosquitto 2.0.21, which Debian 13 has,
/// reads its configuration from nothing but files.
fn file_in_memory(content: &str) -> std::io::Result<File> {
    let mut file = File::from(memfd_create("mosquitto.conf", MemfdFlags::CLOEXEC)?);
    file.write_all(content.as_bytes())?;
    file.rewind()?;
    Ok(file)
}

/// Ends mosquitto when this process is gone without having done so: a small shell that waits for a
/// pipe to close, which the kernel does for every way of dying.
struct Guard {
    shell: Child,
    pipe: Option<ChildStdin>,
}

impl Guard {
    fn over(child: &Child) -> anyhow::Result<Guard> {
        let mut shell = Command::new("/bin/sh")
            .args(["-c", "read word || kill \"$1\"", "guard"])
            .arg(child.id().to_string())
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .process_group(0)
            .spawn()
            .context("`/bin/sh` cannot be started")?;
        let pipe = shell.stdin.take();
        Ok(Guard { shell, pipe })
    }

    fn dismiss(&mut self) {
        if let Some(mut pipe) = self.pipe.take() {
            let _ = pipe.write_all(b"dismissed\n");
        }
        let _ = self.shell.wait();
    }
}

/// Where a program lies: on the PATH, or where Debian puts daemons, which is not on everybody's.
pub fn find(program: &str) -> Option<PathBuf> {
    let path = env::var_os("PATH").unwrap_or_default();
    let usual = ["/usr/local/sbin", "/usr/sbin"].map(PathBuf::from);
    env::split_paths(&path).chain(usual).map(|folder| folder.join(program)).find(|file| file.is_file())
}
