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

impl Desk {
    fn lay(&self, what: impl FnOnce(&mut Waiting)) {
        what(&mut self.lock());
        self.changed.notify_all();
    }

    fn lock(&self) -> MutexGuard<'_, Waiting> {
        lock(&self.waiting)
    }

    fn work(&self, folder: &Path) {
        let mut failed = false;
        loop {
            let batch = self.take(failed);
            let finish = batch.finish;
            failed = self.store(folder, batch, failed);
            if finish {
                return;
            }
        }
    }

    /// Whether some of it could not be stored, and lies on the desk again; `failed`: as the last time.
    fn store(&self, folder: &Path, batch: Waiting, failed: bool) -> bool {
        let Waiting { memories, others, finish } = batch;
        let mut fails = false;
        let mut could = |path: &Path, what: &str, text: &str| {
            let Err(error) = replace(path, text) else { return true };
            match finish {
                true => tracing::error!("{what} is lost, since it cannot be stored: {error}"),
                false if !failed && !fails => {
                    tracing::warn!("`{}` cannot be stored, and is tried again: {error}", path.display());
                }
                false => {}
            }
            fails = true;
            false
        };
        // What has come meanwhile is newer.
        for (name, text) in others {
            if !could(&folder.with_file_name(name), &format!("what belongs in `{name}`"), &text) {
                self.lock().others.entry(name).or_insert(text);
            }
        }
        for (device, memory) in memories {
            let what = format!("the state of {device}");
            if !could(&file_of(folder, &device), &what, &memory.to_text()) {
                self.lock().memories.entry(device).or_insert(memory);
            }
        }
        if failed && !fails {
            tracing::info!("`{}` can be written again", folder.display());
        }
        fails
    }

    /// Waits for something to store, or for the end. After a failure, what waits may wait.
    fn take(&self, failed: bool) -> Waiting {
        let mut waiting = self.lock();
        if failed && !waiting.finish {
            let until_finish = |waiting: &mut Waiting| !waiting.finish;
            let waited = self.changed.wait_timeout_while(waiting, TRY_AGAIN_AFTER, until_finish);
            waiting = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        let nothing_to_do = |waiting: &mut Waiting| {
            waiting.memories.is_empty() && waiting.others.is_empty() && !waiting.finish
        };
        let mut waiting =
            self.changed.wait_while(waiting, nothing_to_do).unwrap_or_else(PoisonError::into_inner);
        let finish = waiting.finish;
        Waiting { finish, ..std::mem::take(&mut *waiting) }
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

    #[test]
    fn what_could_not_be_stored_is_stored_when_there_is_room_again() {
        let state_dir = tempfile::tempdir().expect("a folder");
        let folder = state_dir.path().join("devices");
        let paths = [state_dir.path().join("announced.json"), folder.join("one.json")];
        for path in &paths {
            fs::create_dir_all(path.with_extension("json.new")).expect("something is in the way");
        }
        let desk = Desk::default();
        desk.lay(|waiting| {
            waiting.others.insert("announced.json", "{}".into());
            waiting.memories.insert("one".into(), Memory::default());
        });
        assert!(desk.store(&folder, desk.take(false), false));
        for path in &paths {
            assert!(!path.exists());
            fs::remove_dir(path.with_extension("json.new")).expect("it is empty");
        }
        desk.lay(|waiting| waiting.finish = true);
        desk.work(&folder);
        assert!(paths.iter().all(|path| path.exists()), "{paths:?}");
    }
}
