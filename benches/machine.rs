//! What else the machine did while something was measured, and what machine it is.

use std::fs;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use serde_json::{Value, json};

use crate::clock::{now, seconds_since, sleep, sleep_until, wake_exactly};

/// Looks at the machine beside a measurement: how late a thread wakes up that sleeps as the program does,
/// and how much of the machine others take.
pub struct Watch {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<Vec<i64>>,
    began_at: i64,
    busy_before: f64,
    stolen_before: f64,
    own_before: f64,
}

/// How noisy it was.
#[derive(Clone, Copy, Debug, Default)]
pub struct Noise {
    /// How late sleeping threads woke, in microseconds.
    pub late_half: f64,
    pub late_tenth: f64,
    /// Cores that were busy with something that has nothing to do with the measurement.
    pub others: f64,
    /// Cores that the hypervisor kept for itself.
    pub stolen: f64,
}

/// Sleeping cores of a virtual machine wake within some 100 µs; what is later has waited for others.
const LATE_TENTH_MAX: f64 = 400.0;
const OTHERS_MAX: f64 = 0.15;
const STOLEN_MAX: f64 = 0.05;

impl Watch {
    /// `own` is the processor time of everything that belongs to the measurement, in seconds.
    pub fn start(own: f64) -> anyhow::Result<Watch> {
        let stop = Arc::new(AtomicBool::new(false));
        let of_thread = stop.clone();
        let thread = std::thread::Builder::new().name("watch".into()).spawn(move || {
            wake_exactly();
            let mut late = Vec::new();
            while !of_thread.load(Ordering::Relaxed) {
                let due = now() + 2_000_000;
                sleep_until(due);
                late.push(now() - due);
                sleep(Duration::from_millis(18));
            }
            late
        })?;
        let (busy_before, stolen_before) = busy_seconds();
        Ok(Watch { stop, thread, began_at: now(), busy_before, stolen_before, own_before: own })
    }

    pub fn end(self, own: f64) -> Noise {
        let time = seconds_since(self.began_at);
        let (busy, stolen) = busy_seconds();
        self.stop.store(true, Ordering::Relaxed);
        let mut late = self.thread.join().unwrap_or_default();
        late.sort_unstable();
        let at =
            |share: f64| late.get((late.len() as f64 * share) as usize).map_or(0.0, |ns| *ns as f64 / 1e3);
        let others = (busy - self.busy_before) - (own - self.own_before);
        Noise {
            late_half: at(0.5),
            late_tenth: at(0.9),
            others: (others / time).max(0.0),
            stolen: (stolen - self.stolen_before) / time,
        }
    }
}

impl Noise {
    /// Figures that miss their target now may do so through no fault of the program.
    pub fn is_too_much(self) -> bool {
        self.late_tenth > LATE_TENTH_MAX || self.others > OTHERS_MAX || self.stolen > STOLEN_MAX
    }

    /// The worse of both in each respect.
    pub fn worse(self, other: Noise) -> Noise {
        Noise {
            late_half: self.late_half.max(other.late_half),
            late_tenth: self.late_tenth.max(other.late_tenth),
            others: self.others.max(other.others),
            stolen: self.stolen.max(other.stolen),
        }
    }

    pub fn json(self) -> Value {
        json!({
            "wake_up_late_us_p50": self.late_half,
            "wake_up_late_us_p90": self.late_tenth,
            "cores_busy_with_others": self.others,
            "cores_stolen": self.stolen,
            "too_noisy": self.is_too_much(),
        })
    }
}

impl std::fmt::Display for Noise {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Noise { late_half, late_tenth, others, stolen } = self;
        write!(f, "wake-ups {late_half:.0}/{late_tenth:.0} µs late (p50/p90), others {others:.2} cores")?;
        if *stolen >= 0.01 { write!(f, ", {stolen:.2} stolen") } else { Ok(()) }
    }
}

/// Seconds of all cores in which something ran, and those that were stolen.
fn busy_seconds() -> (f64, f64) {
    let text = fs::read_to_string("/proc/stat").unwrap_or_default();
    let ticks: Vec<f64> = text
        .lines()
        .next()
        .unwrap_or_default()
        .split_whitespace()
        .skip(1)
        .filter_map(|word| word.parse().ok())
        .collect();
    let at = |index: usize| ticks.get(index).copied().unwrap_or_default() / 100.0;
    // User, nice, system, interrupts; idle and waiting for disks stand between.
    (at(0) + at(1) + at(2) + at(5) + at(6), at(7))
}

/// Processor time of a process and its threads so far, in seconds.
pub fn cpu_seconds(process: u32) -> f64 {
    let Ok(tasks) = fs::read_dir(format!("/proc/{process}/task")) else { return 0.0 };
    let of_task = |task: fs::DirEntry| {
        let text = fs::read_to_string(task.path().join("schedstat")).ok()?;
        text.split_whitespace().next()?.parse::<f64>().ok()
    };
    tasks.flatten().filter_map(of_task).sum::<f64>() / 1e9
}

/// Memory of a process that is in RAM now, in bytes.
pub fn resident(process: u32) -> f64 {
    let text = fs::read_to_string(format!("/proc/{process}/status")).unwrap_or_default();
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap_or_default();
    line.split_whitespace().next().and_then(|kib| kib.parse::<f64>().ok()).unwrap_or_default() * 1024.0
}

/// The machine in a few words.
pub fn description() -> String {
    let cpu = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let value = |name: &str| {
        let line = cpu.lines().find(|line| line.starts_with(name))?;
        Some(line.split_once(':')?.1.trim().to_string())
    };
    let model = value("model name").or_else(|| value("Model")).unwrap_or_else(|| "unknown processor".into());
    let virtual_machine =
        value("flags").is_some_and(|flags| flags.split(' ').any(|flag| flag == "hypervisor"));
    let memory = fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let memory = memory.split_whitespace().nth(1).and_then(|kib| kib.parse::<f64>().ok()).unwrap_or_default();
    let kernel = fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    let cores = std::thread::available_parallelism().map_or(0, usize::from);
    format!(
        "{model}, {cores} cores{}, {:.1} GB of memory, Linux {}, {}",
        if virtual_machine { " of a virtual machine" } else { "" },
        memory / 1e6,
        kernel.trim(),
        std::env::consts::ARCH,
    )
}
