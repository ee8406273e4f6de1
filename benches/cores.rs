//! Which of the machine's cores is for whom: what stands for devices has one for itself.

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// This thread, and what it starts from now on, keeps away from one core, until this is dropped.
pub struct Apart {
    before: CpuSet,
    core: Core,
}

/// A core that is kept free.
#[derive(Clone, Copy)]
pub struct Core(usize);

impl Apart {
    /// `None`: there is only one core, or who may use which is not ours to say.
    pub fn split() -> Option<Apart> {
        let before = sched_getaffinity(None).ok()?;
        let last = (0..CpuSet::MAX_CPU).rev().find(|core| before.is_set(*core))?;
        let mut others = before;
        others.unset(last);
        if others.count() == 0 {
            return None;
        }
        sched_setaffinity(None, &others).ok()?;
        Some(Apart { before, core: Core(last) })
    }

    pub fn kept_free(&self) -> Core {
        self.core
    }
}

impl Drop for Apart {
    fn drop(&mut self) {
        // Where it was allowed before, it is now.
        let _ = sched_setaffinity(None, &self.before);
    }
}

impl Core {
    /// Moves this thread there. `false`: it stays where it is.
    pub fn take(self) -> bool {
        let mut own = CpuSet::new();
        own.set(self.0);
        sched_setaffinity(None, &own).is_ok()
    }
}
