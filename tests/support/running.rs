//! A verb of the program that runs until somebody ends it.

use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::thread::JoinHandle;

use rustix::process::{Pid, Signal, kill_process};

use super::{Collected, collect, end, lock, program, wait_for, wait_on};

/// It is killed if the test ends before it.
pub struct Running {
    child: Child,
    said: Arc<Collected<String>>,
    /// Reads its standard output.
    reader: Option<JoinHandle<String>>,
    /// Reads its standard error.
    listener: Option<JoinHandle<()>>,
}

/// What is left of it.
#[derive(Debug)]
pub struct Ended {
    pub status: ExitStatus,
    pub stdout: String,
    pub stderr: String,
}

impl Running {
    pub fn start(arguments: &[&str]) -> Running {
        let mut program = Command::new(program());
        program.args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = program.spawn().expect("the program is built");
        let mut output = child.stdout.take().expect("it is piped");
        let lines = BufReader::new(child.stderr.take().expect("it is piped")).lines();
        let said = Arc::<Collected<String>>::default();
        let told = said.clone();
        let reader = std::thread::spawn(move || {
            let mut text = String::new();
            output.read_to_string(&mut text).expect("text");
            text
        });
        let listener =
            std::thread::spawn(move || lines.map_while(Result::ok).for_each(|line| collect(&told, line)));
        Running { child, said, reader: Some(reader), listener: Some(listener) }
    }

    /// Waits until it has said this on standard error.
    #[track_caller]
    pub fn wait_for(&self, sign: &str) {
        let find = |lines: &[String]| lines.iter().any(|line| line.contains(sign)).then_some(());
        wait_on(&self.said, find).unwrap_or_else(|| panic!("`{sign}` in {:?}", lock(&self.said.0)));
    }

    /// As Ctrl-C does; gives its end.
    #[track_caller]
    pub fn interrupt(mut self) -> Ended {
        kill_process(Pid::from_child(&self.child), Signal::INT).expect("signalled");
        let child = &mut self.child;
        let status = wait_for("the end of the program", || child.try_wait().expect("a child can be asked"));
        // With the program its ends of the pipes are gone, so that both come to theirs.
        let output = self.reader.take().expect("once").join().expect("text");
        self.listener.take().expect("once").join().expect("text");
        Ended { status, stdout: output, stderr: lock(&self.said.0).join("\n") }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        end(&mut self.child);
    }
}
