//! The built program, run as a service would run it.

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

use super::{Broker, Collected, PATIENCE, collect, end, find, lock, temporary_folder, wait_on};

/// Its configuration, in its folder.
const FILE: &str = "busker.yaml";

/// The program as it was built for this test.
pub fn program() -> PathBuf {
    Path::new(env!("CARGO_BIN_EXE_busker")).to_owned()
}

/// Ends a verb of the program: its exit code, and what it says on standard error.
pub fn busker(arguments: &[&str], environment: &[(&str, &str)]) -> (Option<i32>, String) {
    let output = Command::new(program())
        .args(arguments)
        .envs(environment.iter().copied())
        .output()
        .expect("busker starts");
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

/// `busker run`, with a folder for its configuration and its state. It is killed if the test ends before it.
pub struct Gateway {
    child: Child,
    log: Arc<Collected<String>>,
    http: String,
    folder: Option<TempDir>,
}

impl Gateway {
    /// `rest` is the configuration without the broker, HTTP and the state directory.
    pub fn start(broker: &Broker, rest: &str) -> Gateway {
        Gateway::start_with(&format!("mqtt: {{url: '{}'}}\n{rest}", broker.url()))
    }

    /// `rest` is the configuration without HTTP and the state directory.
    pub fn start_with(rest: &str) -> Gateway {
        Gateway::start_in(&[], rest)
    }

    /// The same with more variables in its environment.
    pub fn start_in(environment: &[(&str, &str)], rest: &str) -> Gateway {
        Gateway::start_at(temporary_folder(), environment, rest)
    }

    /// Ends it, does something meanwhile, and starts it again where it was, with this configuration.
    pub fn start_again(mut self, meanwhile: impl FnOnce(), rest: &str) -> Gateway {
        let folder = self.folder.take().expect("only its end takes the folder");
        assert!(self.terminate().success());
        meanwhile();
        Gateway::start_at(folder, &[], rest)
    }

    /// The same with an end that it does not notice.
    pub fn kill_and_start_again(mut self, meanwhile: impl FnOnce(), rest: &str) -> Gateway {
        let folder = self.folder.take().expect("only its end takes the folder");
        self.kill();
        meanwhile();
        Gateway::start_at(folder, &[], rest)
    }

    fn start_at(folder: TempDir, environment: &[(&str, &str)], rest: &str) -> Gateway {
        write_configuration(&folder, rest);
        let mut gateway = Gateway::begin(folder, environment);
        gateway.http = gateway.listens_at();
        gateway
    }

    /// Waits for nothing: its configuration is in the folder, or may come there as its test pleases.
    pub fn begin(folder: TempDir, environment: &[(&str, &str)]) -> Gateway {
        let mut child = Command::new(program())
            .args(["run", "--config"])
            .arg(file_in(folder.path()))
            .env_remove("JOURNAL_STREAM")
            .envs(environment.iter().copied())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("busker starts");
        let log = Arc::<Collected<String>>::default();
        let lines = BufReader::new(child.stderr.take().expect("it is piped")).lines();
        let said = log.clone();
        std::thread::spawn(move || lines.map_while(Result::ok).for_each(|line| collect(&said, line)));
        Gateway { child, log, http: String::new(), folder: Some(folder) }
    }

    /// Waits until it has told where it listens.
    fn listens_at(&self) -> String {
        let line = self.wait_for_log("HTTP on http://");
        let address = line.split("http://").nth(1).and_then(|rest| rest.split('/').next());
        format!("http://{}", address.expect("the line names the address"))
    }

    /// The first line of the log that contains `part`; waits for it.
    #[track_caller]
    pub fn wait_for_log(&self, part: &str) -> String {
        self.wait_for_log_from(0, part)
    }

    /// The same without the first lines.
    #[track_caller]
    fn wait_for_log_from(&self, first: usize, part: &str) -> String {
        let find = |lines: &[String]| lines.iter().skip(first).find(|line| line.contains(part)).cloned();
        wait_on(&self.log, find).unwrap_or_else(|| panic!("`{part}` is not in the log"))
    }

    /// The lines that it has said so far on standard error.
    pub fn log(&self) -> Vec<String> {
        lock(&self.log.0).clone()
    }

    /// Whether a line of the log so far contains `part`.
    pub fn has_said(&self, part: &str) -> bool {
        lock(&self.log.0).iter().any(|line| line.contains(part))
    }

    /// `http://127.0.0.1:…`
    pub fn http(&self) -> &str {
        &self.http
    }

    /// Status and body of a page.
    pub fn get(&self, path: &str) -> (u16, String) {
        let agent: ureq::Agent = ureq::Agent::config_builder()
            .http_status_as_error(false)
            .timeout_global(Some(PATIENCE))
            .build()
            .into();
        let mut answer = agent.get(format!("{}{path}", self.http)).call().expect("HTTP answers");
        let body = answer.body_mut().read_to_string().expect("the body is text");
        (answer.status().as_u16(), body)
    }

    /// A page that is JSON; `None` if it is not.
    pub fn json(&self, path: &str) -> Option<Value> {
        serde_json::from_str(&self.get(path).1).ok()
    }

    /// `GET path`, whatever bytes it is made of, with what the answer says of itself under `header`.
    pub fn download(&self, path: &str, header: &str) -> Option<(Vec<u8>, String)> {
        let mut answer = ureq::get(format!("{}{path}", self.http)).call().ok()?;
        let told = answer.headers().get(header)?.to_str().ok()?.to_owned();
        Some((answer.body_mut().read_to_vec().ok()?, told))
    }

    /// Waits until `/health` answers with this status.
    #[track_caller]
    pub fn wait_for_health(&self, status: u16) {
        let seen = find(|| (self.get("/health").0 == status).then_some(()));
        assert!(seen.is_some(), "/health is {:?}, not {status}", self.get("/health"));
    }

    /// The memory that it occupies, in bytes.
    pub fn resident(&self) -> u64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.id())).expect("it runs");
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).expect("Linux tells it");
        let kilobytes = line.trim().trim_end_matches(" kB").parse::<u64>().expect("a number");
        kilobytes * 1024
    }

    /// The files that it holds open.
    pub fn open_files(&self) -> Vec<PathBuf> {
        let folder = fs::read_dir(format!("/proc/{}/fd", self.id())).expect("it runs");
        folder.filter_map(|entry| fs::read_link(entry.ok()?.path()).ok()).collect()
    }

    /// The number of its process.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Its configuration file.
    pub fn file(&self) -> PathBuf {
        file_in(self.folder())
    }

    /// Its state directory.
    pub fn state(&self) -> PathBuf {
        state_in(self.folder())
    }

    fn folder(&self) -> &Path {
        self.folder.as_ref().expect("only its end takes the folder").path()
    }

    /// Puts another configuration in the place of its own, as for [`Gateway::start_with`].
    pub fn write(&self, rest: &str) {
        self.write_whole(&configuration(self.folder(), rest));
    }

    /// The same without anything added.
    pub fn write_whole(&self, text: &str) {
        fs::write(self.file(), text).expect("its configuration is written");
    }

    /// Asks it to read its configuration again, and waits until it says this.
    #[track_caller]
    pub fn reload(&self, expected: &str) {
        let before = lock(&self.log.0).len();
        self.hang_up();
        self.wait_for_log_from(before, expected);
    }

    /// Asks it to read its configuration again.
    pub fn hang_up(&self) {
        self.signal(Signal::HUP);
    }

    /// It runs no longer and has not ended.
    pub fn stall(&self) {
        super::stall(&self.child);
    }

    /// The end of [`Gateway::stall`].
    pub fn go_on(&self) {
        self.signal(Signal::CONT);
    }

    fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).expect("the signal is sent");
    }

    /// Asks it to end, and waits until it has.
    pub fn terminate(mut self) -> ExitStatus {
        self.signal(Signal::TERM);
        super::wait_for("its end", || self.child.try_wait().expect("it is ours"))
    }

    /// Ends it without asking.
    pub fn kill(mut self) {
        self.child.kill().expect("it is killed");
        self.child.wait().expect("it has ended");
    }
}

impl Drop for Gateway {
    fn drop(&mut self) {
        end(&mut self.child);
        if std::thread::panicking() {
            eprintln!("what the program said:\n{}", self.log().join("\n"));
        }
    }
}

fn state_in(folder: &Path) -> PathBuf {
    folder.join("state")
}

fn file_in(folder: &Path) -> PathBuf {
    folder.join(FILE)
}

fn configuration(folder: &Path, rest: &str) -> String {
    format!("http: {{listen: '127.0.0.1:0'}}\nstate_dir: {}\n{rest}", state_in(folder).display())
}

fn write_configuration(folder: &TempDir, rest: &str) {
    super::temporary_file(folder, FILE, &configuration(folder.path(), rest));
}
