//! A real mosquitto of the test's own.

use std::fs;
use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};

use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

use super::{end, free_port, temporary_folder};

/// A mosquitto on a port of its own, that forgets everything when it ends unless it is told to persist.
pub struct Broker {
    pub port: u16,
    pub address: &'static str,
    folder: TempDir,
    extra: String,
    child: Option<Child>,
}

impl Broker {
    pub fn start() -> Broker {
        Broker::start_with("allow_anonymous true\npersistence false\n")
    }

    /// It remembers what is retained, and sessions, over its own end.
    pub fn start_persistent() -> Broker {
        Broker::start_with("allow_anonymous true\npersistence true\nautosave_interval 1\n")
    }

    /// `extra` are lines of its configuration.
    pub fn start_with(extra: &str) -> Broker {
        // Somebody else may take the port between our look and mosquitto's.
        for _ in 0..10 {
            if let Some(broker) = Broker::try_at("127.0.0.1", free_port(), extra) {
                return broker;
            }
        }
        panic!("mosquitto does not start with\n{extra}");
    }

    /// `None` if there is no such address, or the port is taken.
    pub fn try_at(address: &'static str, port: u16, extra: &str) -> Option<Broker> {
        let folder = temporary_folder();
        let mut broker = Broker { port, address, folder, extra: extra.into(), child: None };
        broker.launch().then_some(broker)
    }

    pub fn url(&self) -> String {
        format!("mqtt://{}:{}", self.address, self.port)
    }

    /// As if its machine lost power.
    pub fn kill(&mut self) {
        if let Some(mut child) = self.child.take() {
            child.kill().expect("mosquitto is killed");
            child.wait().expect("mosquitto has ended");
        }
    }

    /// Asks it to end; it writes down what it shall remember.
    pub fn stop(&mut self) {
        self.signal(Signal::TERM);
        if let Some(mut child) = self.child.take() {
            child.wait().expect("mosquitto has ended");
        }
    }

    /// It runs no longer and has not ended, like a machine that swaps.
    pub fn stall(&self) {
        super::stall(self.child.as_ref().expect("it runs"));
    }

    /// The end of [`Broker::stall`].
    pub fn go_on(&self) {
        self.signal(Signal::CONT);
    }

    fn signal(&self, signal: Signal) {
        if let Some(child) = &self.child {
            kill_process(Pid::from_child(child), signal).expect("the signal is sent");
        }
    }

    /// Again on the same port, with what it remembers.
    pub fn restart(&mut self) {
        self.kill();
        self.start_again();
    }

    /// Another configuration, from its next start on.
    pub fn be_told(&mut self, extra: &str) {
        self.extra = extra.into();
    }

    /// The same after its end.
    pub fn start_again(&mut self) {
        assert!(self.launch(), "mosquitto starts again on port {}", self.port);
    }

    fn launch(&mut self) -> bool {
        let folder = self.folder.path();
        let file = folder.join("mosquitto.conf");
        // Started by root it would become another user, who may not read what tests write. And it would hold
        // back by 40 ms what it sends while something before it is not acknowledged.
        let text = format!(
            "listener {} {}\nset_tcp_nodelay true\nuser root\nlog_dest stderr\npersistence_location {}/\n{}",
            self.port,
            self.address,
            folder.display(),
            self.extra
        );
        fs::write(&file, text).expect("its configuration is written");
        // Debian keeps it where only root's PATH leads.
        let path = format!("{}:/usr/sbin:/usr/local/sbin", std::env::var("PATH").unwrap_or_default());
        let mut child = Command::new("mosquitto")
            .arg("-c")
            .arg(&file)
            .env("PATH", path)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("mosquitto is installed; `scripts/get-mosquitto` gets it");
        let log = child.stderr.take().expect("it is piped");
        let mut log = BufReader::new(log).lines().map_while(Result::ok);
        // A connection would prove nothing: somebody else's broker may have been faster. Without the port
        // it ends, and so does its log.
        if !log.any(|line| line.ends_with(" running")) {
            end(&mut child);
            return false;
        }
        std::thread::spawn(move || log.for_each(drop));
        self.child = Some(child);
        true
    }
}

impl Drop for Broker {
    fn drop(&mut self) {
        if let Some(child) = &mut self.child {
            end(child);
        }
    }
}
