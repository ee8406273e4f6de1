//! Whether a process grows: its memory by a straight line through the samples, its threads and its
//! descriptors by comparing two calm moments.

use std::fs;

use serde_json::{Value, json};

use crate::machine;

/// What a process occupies at one moment.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sample {
    /// Seconds since the beginning.
    pub at: f64,
    pub resident: f64,
    pub threads: usize,
    pub descriptors: usize,
}

impl Sample {
    pub fn of(process: u32, at: f64) -> Sample {
        let count =
            |folder: &str| fs::read_dir(format!("/proc/{process}/{folder}")).map_or(0, Iterator::count);
        let (resident, threads, descriptors) = (machine::resident(process), count("task"), count("fd"));
        Sample { at, resident, threads, descriptors }
    }
}

/// A process may have grown by so many bytes from the end of the warm-up to the end. What is less is the
/// allocator's own: blocks that fit nothing, and pages that it keeps.
pub const GROWTH_MAX: f64 = 1024.0 * 1024.0;

/// What the samples come to.
#[derive(Clone, Copy, Debug)]
pub struct Growth {
    /// Bytes, along the line through the samples behind the warm-up.
    pub memory: f64,
    pub first: f64,
    pub last: f64,
    pub seconds: f64,
    /// Threads and descriptors, first and last in calm.
    pub threads: (usize, usize),
    pub descriptors: (usize, usize),
}

impl Growth {
    /// `calm_before` and `calm_after` are samples while nothing bad is done.
    pub fn of(samples: &[Sample], calm_before: &[Sample], calm_after: &[Sample]) -> Growth {
        let most = |of: fn(&Sample) -> usize| calm_before.iter().map(of).max().unwrap_or_default();
        let least = |of: fn(&Sample) -> usize| calm_after.iter().map(of).min().unwrap_or_default();
        let (first, last) =
            (samples.first().copied().unwrap_or_default(), samples.last().copied().unwrap_or_default());
        let seconds = last.at - first.at;
        Growth {
            memory: slope(samples) * seconds,
            first: first.resident,
            last: last.resident,
            seconds,
            threads: (most(|sample| sample.threads), least(|sample| sample.threads)),
            descriptors: (most(|sample| sample.descriptors), least(|sample| sample.descriptors)),
        }
    }

    /// What has grown that must not.
    pub fn faults(&self) -> Vec<String> {
        let mut faults = Vec::new();
        if self.memory > GROWTH_MAX {
            faults.push(format!("memory grew by {:.0} kB in {:.0} s", self.memory / 1024.0, self.seconds));
        }
        for (what, (before, after)) in [("threads", self.threads), ("descriptors", self.descriptors)] {
            if after > before {
                faults.push(format!("{after} {what} at the end, {before} at the beginning"));
            }
        }
        faults
    }

    pub fn json(&self) -> Value {
        json!({
            "memory_growth_bytes": self.memory.round(),
            "memory_growth_allowed_bytes": GROWTH_MAX,
            "resident_after_warm_up_bytes": self.first,
            "resident_at_the_end_bytes": self.last,
            "measured_seconds": self.seconds.round(),
            "threads": [self.threads.0, self.threads.1],
            "descriptors": [self.descriptors.0, self.descriptors.1],
        })
    }
}

/// Bytes a second, by least squares.
fn slope(samples: &[Sample]) -> f64 {
    let count = samples.len() as f64;
    let mean = |of: fn(&Sample) -> f64| samples.iter().map(of).sum::<f64>() / count;
    let (at, resident) = (mean(|sample| sample.at), mean(|sample| sample.resident));
    let both: f64 = samples.iter().map(|sample| (sample.at - at) * (sample.resident - resident)).sum();
    let square: f64 = samples.iter().map(|sample| (sample.at - at).powi(2)).sum();
    if square > 0.0 { both / square } else { 0.0 }
}
