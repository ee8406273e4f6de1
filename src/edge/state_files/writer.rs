//! The thread that stores what waits to be stored: a memory card may take seconds to say that it has what it was
//! given, and a bus waits for nobody.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use anyhow::Context;

use super::file_of;
use crate::edge::files;
use crate::edge::lock::lock;
use crate::engine::memory::{Memory, Record};
use crate::engine::time::Duration;

/// What could not be stored is tried again after this.
const TRY_AGAIN_AFTER: Duration = Duration::from_secs(60);

/// The running thread, which ends with this.
pub(super) struct Writer {
    desk: Arc<Desk>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

impl Writer {
    /// `folder` is that of the devices' files.
    pub(super) fn start(folder: PathBuf) -> anyhow::Result<Writer> {
        let desk = Arc::<Desk>::default();
        let of_thread = desk.clone();
        let thread = std::thread::Builder::new()
            .name("state-files".into())
            .spawn(move || of_thread.work(&folder))
            .context("no thread can be started")?;
        Ok(Writer { desk, thread: Mutex::new(Some(thread)) })
    }

    /// Does not wait until it is stored, as all here.
    pub(super) fn store(&self, record: Record) {
        self.desk.lay(|waiting| drop(waiting.memories.insert(record.device, record.memory)));
    }

    /// A file beside the devices' folder.
    pub(super) fn store_text(&self, name: &'static str, text: String) {
        self.desk.lay(|waiting| drop(waiting.others.insert(name, text)));
    }

    /// Waits until everything is stored; the end.
    pub(super) fn finish(&self) {
        self.desk.lay(|waiting| waiting.finish = true);
        let thread = lock(&self.thread).take();
        if thread.is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the thread that stores the state ended in a panic");
        }
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.finish();
    }
}

/// What lies on it waits to be stored: the newest of each device.
#[derive(Default)]
struct Desk {
    waiting: Mutex<Waiting>,
    changed: Condvar,
}

#[derive(Default)]
struct Waiting {
    memories: BTreeMap<String, Memory>,
    /// By the file's name.
    others: BTreeMap<&'static str, String>,
    finish: bool,
}

/// What could not be stored, and lies on the desk again.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Failed {
    memories: bool,
    others: bool,
}

impl Failed {
    fn any(self) -> bool {
        self.memories || self.others
    }
}

impl Waiting {
    /// Whether all of it may wait after such a failure. What is counted of EEPROM waits for no file but another
    /// device's: a power failure must not undo it.
    fn may_wait(&self, failed: Failed) -> bool {
        (failed.memories || failed.others && self.memories.is_empty()) && !self.finish
    }
}

impl Desk {
    fn lay(&self, what: impl FnOnce(&mut Waiting)) {
        what(&mut self.lock());
        self.changed.notify_all();
    }

    fn lock(&self) -> MutexGuard<'_, Waiting> {
        lock(&self.waiting)
    }

    fn work(&self, folder: &Path) {
        let mut failed = Failed::default();
        loop {
            let batch = self.take(failed);
            let finish = batch.finish;
            failed = self.store(folder, batch, failed);
            if finish {
                return;
            }
        }
    }

    /// `before`: what failed the last time. Of that people know already.
    fn store(&self, folder: &Path, batch: Waiting, before: Failed) -> Failed {
        let Waiting { memories, others, finish } = batch;
        let could = |path: &Path, what: &str, text: &str, is_known: bool| {
            let Err(error) = replace(path, text) else { return true };
            match finish {
                true => tracing::error!("{what} is lost, since it cannot be stored: {error}"),
                false if !is_known => {
                    tracing::warn!("`{}` cannot be stored, and is tried again: {error}", path.display());
                }
                false => {}
            }
            false
        };
        let mut failed = Failed::default();
        // What has come meanwhile is newer.
        for (name, text) in others {
            let (path, what) = (folder.with_file_name(name), format!("what belongs in `{name}`"));
            if !could(&path, &what, &text, before.others || failed.others) {
                self.lock().others.entry(name).or_insert(text);
                failed.others = true;
            }
        }
        for (device, memory) in memories {
            let (path, what) = (file_of(folder, &device), format!("the state of {device}"));
            if !could(&path, &what, &memory.to_text(), before.memories || failed.memories) {
                self.lock().memories.entry(device).or_insert(memory);
                failed.memories = true;
            }
        }
        if before.any() && !failed.any() {
            tracing::info!("`{}` can be written again", folder.display());
        }
        failed
    }

    /// Waits for something to store, or for the end.
    fn take(&self, failed: Failed) -> Waiting {
        let may_wait = |waiting: &mut Waiting| waiting.may_wait(failed);
        let waited = self.changed.wait_timeout_while(self.lock(), TRY_AGAIN_AFTER, may_wait);
        let waiting = waited.unwrap_or_else(PoisonError::into_inner).0;
        let nothing_to_do = |waiting: &mut Waiting| {
            waiting.memories.is_empty() && waiting.others.is_empty() && !waiting.finish
        };
        let mut waiting =
            self.changed.wait_while(waiting, nothing_to_do).unwrap_or_else(PoisonError::into_inner);
        std::mem::take(&mut *waiting)
    }
}

/// Somebody may have tidied up.
fn replace(path: &Path, text: &str) -> io::Result<()> {
    fs::create_dir_all(path.parent().unwrap_or(Path::new(".")))?;
    files::replace(path, &path.with_extension("json.new"), 0o666, text.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn memory(writes: u64) -> Memory {
        Memory { persistent_writes: writes, ..Memory::default() }
    }

    #[test]
    fn what_could_not_be_stored_is_stored_when_there_is_room_again_and_a_memory_waits_for_no_other_file() {
        let state_dir = tempfile::tempdir().expect("a folder");
        let folder = state_dir.path().join("devices");
        let [announced, one, two] = ["announced.json", "devices/one.json", "devices/two.json"]
            .map(|name| state_dir.path().join(name));
        let lay_memory = |desk: &Desk, device: &str, writes| {
            desk.lay(|waiting| drop(waiting.memories.insert(device.into(), memory(writes))));
        };
        let in_the_way = |path: &Path| path.with_extension("json.new");
        for path in [&announced, &one] {
            fs::create_dir_all(in_the_way(path)).expect("something is in the way");
        }
        let desk = Desk::default();
        lay_memory(&desk, "one", 1);
        desk.lay(|waiting| drop(waiting.others.insert("announced.json", "{}".into())));
        let failed = desk.store(&folder, desk.take(Failed::default()), Failed::default());
        assert_eq!(failed, Failed { memories: true, others: true });
        lay_memory(&desk, "two", 1);
        assert!(desk.lock().may_wait(failed), "a full card is not tried again at once");
        fs::remove_dir(in_the_way(&one)).expect("it is empty");
        let batch = std::mem::take(&mut *desk.lock());
        let failed = desk.store(&folder, batch, failed);
        assert_eq!(failed, Failed { memories: false, others: true });
        assert!(one.exists() && two.exists() && !announced.exists());

        assert!(desk.lock().may_wait(failed), "only what is still blocked is there");
        lay_memory(&desk, "two", 2);
        assert!(!desk.lock().may_wait(failed), "the count waits for no other file");
        let failed = desk.store(&folder, desk.take(failed), failed);
        assert_eq!(failed, Failed { memories: false, others: true });
        assert_eq!(fs::read_to_string(&two).expect("it is stored"), memory(2).to_text());

        fs::remove_dir(in_the_way(&announced)).expect("it is empty");
        desk.lay(|waiting| waiting.finish = true);
        desk.work(&folder);
        assert!(announced.exists());
    }
}
