//! The files in `state_dir`: one small file for each device, read at the start and replaced as a whole.
//!
//! Storing is a thread of its own: a memory card may take seconds to say that it has what it was
//! given, and a bus waits for nobody.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use anyhow::{Context, bail};
use rustix::fs::FlockOperation;
use rustix::io::Errno;
use serde::de::DeserializeOwned;

use crate::edge::lock::lock;
use crate::engine::memory::{Memories, Memory, Record};
use crate::engine::outbox::Tree;
use crate::engine::time::Duration;

/// What could not be stored is tried again after this.
const TRY_AGAIN_AFTER: Duration = Duration::from_secs(60);

/// What Home Assistant has been told of this gateway, in `state_dir`.
const ANNOUNCED: &str = "announced.json";

/// On which topics something is told, and perhaps still has to be taken back.
const TOPICS: &str = "topics.json";

/// What was remembered at the start, and where to put what is to be remembered.
pub struct StateFiles {
    /// The newest of each device.
    memories: Mutex<Memories>,
    /// Devices whose files must not be overwritten.
    damaged: Mutex<BTreeSet<String>>,
    /// Devices of which it has been said that nothing is remembered.
    unknown: Mutex<BTreeSet<String>>,
    folder: PathBuf,
    recordings: Option<PathBuf>,
    desk: Arc<Desk>,
    thread: Mutex<Option<JoinHandle<()>>>,
    keeps: bool,
    /// What an earlier run has told Home Assistant, by topic, until somebody takes it.
    recalled: Mutex<BTreeMap<String, String>>,
    /// Below which base topics it has told something, until somebody takes it.
    trees: Mutex<Vec<Tree>>,
    /// The fingerprints of what is stored of both: the whole lies in the outbox already.
    announced: Mutex<u64>,
    topics: Mutex<u64>,
    /// Held as long as this lives.
    _lock: Option<File>,
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

impl StateFiles {
    /// Keeps nothing, and remembers nothing.
    pub fn nowhere() -> StateFiles {
        let memories = Memories { unkept: Some("nothing is kept".into()), ..Memories::default() };
        StateFiles::unkept(memories, None, None)
    }

    fn unkept(memories: Memories, recordings: Option<PathBuf>, lock: Option<File>) -> StateFiles {
        StateFiles {
            damaged: Mutex::default(),
            unknown: Mutex::default(),
            memories: Mutex::new(memories),
            folder: PathBuf::new(),
            recordings,
            desk: Arc::default(),
            thread: Mutex::default(),
            keeps: false,
            recalled: Mutex::default(),
            trees: Mutex::default(),
            announced: Mutex::default(),
            topics: Mutex::default(),
            _lock: lock,
        }
    }

    /// Reads what is remembered of these devices in `state_dir`. What is wrong with the files goes to
    /// the log, and the gateway runs without them. An error means that another gateway has them.
    pub fn open<'d>(state_dir: &Path, devices: impl Iterator<Item = &'d str>) -> anyhow::Result<StateFiles> {
        let folder = state_dir.join("devices");
        let lock = lock_folder(state_dir)?;
        let mut memories = Memories::default();
        let mut unknown = Vec::new();
        for device in devices {
            match recall(&file_of(&folder, device)) {
                Ok(Some(memory)) => drop(memories.devices.insert(device.into(), memory)),
                Ok(None) => unknown.push(device),
                Err(reason) => memories.unkept = Some(reason),
            }
        }
        let shown = folder.display();
        if !unknown.is_empty() {
            tracing::info!("nothing is remembered yet in `{shown}` of {}", unknown.join(", "));
        }
        if memories.unkept.is_none() {
            memories.unkept =
                probe(&folder).err().map(|error| format!("`{shown}` cannot be written: {error}"));
        }
        if let Some(reason) = &memories.unkept {
            tracing::warn!(
                "{reason}; counts of EEPROM writes end with this run, and `settings` are only compared, \
                 except where they are enforced"
            );
            // They may find room where a damaged memory must not be overwritten.
            return Ok(StateFiles::unkept(memories, Some(state_dir.join("recordings")), lock));
        }
        let recalled: BTreeMap<String, String> = recall_told(&state_dir.join(ANNOUNCED));
        let announced = fingerprint(recalled.iter().map(|(topic, payload)| (&**topic, &**payload)));
        let trees: Vec<Tree> = recall_told(&state_dir.join(TOPICS));
        let topics = fingerprint(topics_in(&trees));
        let desk = Arc::<Desk>::default();
        let (of_thread, of_files) = (desk.clone(), folder.clone());
        let thread = std::thread::Builder::new()
            .name("state-files".into())
            .spawn(move || of_thread.work(&folder))
            .context("no thread can be started")?;
        Ok(StateFiles {
            memories: Mutex::new(memories),
            damaged: Mutex::default(),
            unknown: Mutex::new(unknown.into_iter().map(String::from).collect()),
            folder: of_files,
            recordings: Some(state_dir.join("recordings")),
            desk,
            thread: Mutex::new(Some(thread)),
            keeps: true,
            recalled: Mutex::new(recalled),
            trees: Mutex::new(trees),
            announced: Mutex::new(announced),
            topics: Mutex::new(topics),
            _lock: lock,
        })
    }

    /// Where recordings of what was on the wire are kept, if they are.
    pub fn recordings(&self) -> Option<&Path> {
        self.recordings.as_deref()
    }

    /// What is remembered now.
    pub fn memories(&self) -> Memories {
        lock(&self.memories).clone()
    }

    /// What is remembered now, also of these devices, which have come since the start.
    pub fn learn<'d>(&self, devices: impl Iterator<Item = &'d str>) -> Memories {
        let mut memories = lock(&self.memories);
        let mut unkept = None;
        for device in devices.filter(|_| self.keeps) {
            if memories.devices.contains_key(device) {
                continue;
            }
            match recall(&file_of(&self.folder, device)) {
                Ok(Some(memory)) => drop(memories.devices.insert(device.into(), memory)),
                // It may be in use without anything to remember: then that is no news.
                Ok(None) if lock(&self.unknown).insert(device.into()) => {
                    tracing::info!("nothing is remembered yet of {device}");
                }
                Ok(None) => {}
                Err(reason) => {
                    tracing::warn!("{reason}");
                    lock(&self.damaged).insert(device.into());
                    unkept = Some(reason);
                }
            }
        }
        let unkept = unkept.or_else(|| memories.unkept.clone());
        Memories { unkept, ..memories.clone() }
    }

    /// Puts a memory where it will be stored. Does not wait for that.
    pub fn store(&self, record: Record) {
        if self.keeps && !lock(&self.damaged).contains(&record.device) {
            lock(&self.memories).devices.insert(record.device.clone(), record.memory.clone());
            self.desk.lock().memories.insert(record.device, record.memory);
            self.desk.changed.notify_all();
        }
    }

    /// What an earlier run has told Home Assistant, by topic; only once.
    pub fn take_announced(&self) -> BTreeMap<String, String> {
        std::mem::take(&mut lock(&self.recalled))
    }

    /// Keeps what Home Assistant has been told, if it is not what is kept. Does not wait for that.
    pub fn store_announced(&self, told: &BTreeMap<&str, &str>) {
        let next = fingerprint(told.iter().map(|(topic, payload)| (*topic, *payload)));
        if self.keeps && std::mem::replace(&mut *lock(&self.announced), next) != next {
            self.store_text(ANNOUNCED, serde_json::to_string(told));
        }
    }

    /// Where earlier runs have told something, the last one first; only once.
    pub fn take_trees(&self) -> Vec<Tree> {
        std::mem::take(&mut lock(&self.trees))
    }

    /// Keeps where something is told, or has to be taken back, if it is not what is kept. Does not wait for that.
    pub fn store_trees(&self, trees: &[Tree]) {
        let next = fingerprint(topics_in(trees));
        if self.keeps && std::mem::replace(&mut *lock(&self.topics), next) != next {
            self.store_text(TOPICS, serde_json::to_string(trees));
        }
    }

    fn store_text(&self, name: &'static str, text: serde_json::Result<String>) {
        match text {
            Ok(text) => drop(self.desk.lock().others.insert(name, text)),
            Err(error) => tracing::error!("`{name}` cannot be stored: {error}"),
        }
        self.desk.changed.notify_all();
    }

    /// Waits until everything is stored; the end.
    pub fn finish(&self) {
        self.desk.lock().finish = true;
        self.desk.changed.notify_all();
        let thread = lock(&self.thread).take();
        if thread.is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the thread that stores the state ended in a panic");
        }
    }
}

impl Drop for StateFiles {
    fn drop(&mut self) {
        self.finish();
    }
}

impl Desk {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        lock(&self.waiting)
    }

    fn work(&self, folder: &Path) {
        let mut failed = false;
        loop {
            let (memories, others, finish) = self.take(failed);
            for (name, text) in others {
                let path = folder.with_file_name(name);
                if let Err(error) = replace(&path, &text) {
                    // The broker most likely remembers it too.
                    tracing::warn!("`{}` cannot be stored: {error}", path.display());
                }
            }
            for (device, memory) in memories {
                match replace(&file_of(folder, &device), &memory.to_text()) {
                    Ok(()) if failed => {
                        failed = false;
                        tracing::info!("`{}` can be written again", folder.display());
                    }
                    Ok(()) => {}
                    Err(error) if finish => {
                        tracing::error!("the state of {device} is lost, since it cannot be stored: {error}");
                    }
                    Err(error) => {
                        if !failed {
                            let path = file_of(folder, &device);
                            tracing::warn!("`{}` cannot be stored: {error}", path.display());
                        }
                        failed = true;
                        // What has come meanwhile is newer.
                        self.lock().memories.entry(device).or_insert(memory);
                    }
                }
            }
            if finish {
                return;
            }
        }
    }

    /// Waits for something to store, or for the end. After a failure, what waits may wait.
    fn take(&self, failed: bool) -> (BTreeMap<String, Memory>, BTreeMap<&'static str, String>, bool) {
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
        (std::mem::take(&mut waiting.memories), std::mem::take(&mut waiting.others), waiting.finish)
    }
}

fn file_of(folder: &Path, device: &str) -> PathBuf {
    folder.join(format!("{device}.json"))
}

/// What the file says; `None` if there is none, or none that can be understood: that one is kept
/// aside. `Err` if it cannot even be kept aside, and must not be overwritten.
fn recall(path: &Path) -> Result<Option<Memory>, String> {
    let read = match fs::read_to_string(path) {
        Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {
            return Ok(None);
        }
        Err(error) => Err(error.to_string()),
        Ok(text) => Memory::parse(&text),
    };
    let reason = match read {
        Ok(memory) => return Ok(Some(memory)),
        Err(reason) => reason,
    };
    let shown = path.display();
    match keep_aside(path) {
        Ok(aside) => {
            tracing::warn!(
                "`{shown}` cannot be used ({reason}) and is kept as `{}`; everything in it counts as never done, \
                 as at the first start",
                aside.display()
            );
            Ok(None)
        }
        Err(error) => Err(format!("`{shown}` cannot be used ({reason}) and cannot be kept aside ({error})")),
    }
}

/// What an earlier run has told; nothing if that is not known: the broker most likely does.
fn recall_told<T: Default + DeserializeOwned>(path: &Path) -> T {
    let read = match fs::read_to_string(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => return T::default(),
        Err(error) => Err(error.to_string()),
        Ok(text) => serde_json::from_str(&text).map_err(|error| error.to_string()),
    };
    read.unwrap_or_else(|reason| {
        tracing::warn!("`{}` cannot be used ({reason}) and will be written anew", path.display());
        T::default()
    })
}

fn topics_in(trees: &[Tree]) -> impl Iterator<Item = (&str, &str)> {
    trees.iter().flat_map(|tree| tree.topics.iter().map(|topic| (&*tree.base_topic, &**topic)))
}

fn fingerprint<'a>(announced: impl Iterator<Item = (&'a str, &'a str)>) -> u64 {
    let mut hasher = DefaultHasher::new();
    announced.for_each(|one| one.hash(&mut hasher));
    hasher.finish()
}

/// Renames a damaged file to one with `.broken` behind its name, which replaces no other.
fn keep_aside(path: &Path) -> io::Result<PathBuf> {
    let numbered = (2..=99).map(|number| format!(".broken.{number}"));
    for ending in std::iter::once(".broken".to_string()).chain(numbered) {
        let mut name = path.as_os_str().to_owned();
        name.push(ending);
        let aside = PathBuf::from(name);
        if !aside.exists() {
            fs::rename(path, &aside)?;
            return Ok(aside);
        }
    }
    Err(io::Error::other("there are 99 damaged ones already"))
}

/// Two gateways with one folder would each count as if the other wrote nothing: the second one does not start.
/// `None` where there can be no lock, since the folder cannot be written (which is told elsewhere) or its
/// file system knows none.
fn lock_folder(state_dir: &Path) -> anyhow::Result<Option<File>> {
    let path = state_dir.join("lock");
    let open = || File::options().read(true).write(true).create(true).truncate(false).open(&path);
    let Ok(mut file) = fs::create_dir_all(state_dir).and_then(|()| open()) else { return Ok(None) };
    let shown = state_dir.display();
    match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => {
            // Only for who is refused; without it the lock holds all the same.
            let told = file.set_len(0).and_then(|()| writeln!(file, "{}", std::process::id()));
            if let Err(error) = told {
                tracing::debug!("`{}` cannot be written: {error}", path.display());
            }
            Ok(Some(file))
        }
        Err(Errno::WOULDBLOCK) => {
            let holder = fs::read_to_string(&path).unwrap_or_default();
            let holder = holder.trim().parse::<u32>().map_or(String::new(), |id| format!(" (process {id})"));
            bail!(
                "another busker{holder} keeps its state in `{shown}`; end it, or give each a `state_dir` and a \
                 `base_topic` of its own"
            )
        }
        Err(error) => {
            tracing::warn!("`{shown}` cannot be locked ({error}); see to it that no other busker uses it");
            Ok(None)
        }
    }
}

/// Whether files can be made in `folder`, which is made if it is not there.
fn probe(folder: &Path) -> io::Result<()> {
    fs::create_dir_all(folder)?;
    let path = folder.join(".probe");
    File::create(&path)?;
    fs::remove_file(&path)
}

/// Puts `text` in place of the file: whoever looks, and whenever the power fails, it is there whole, old
/// or new.
fn replace(path: &Path, text: &str) -> io::Result<()> {
    let folder = path.parent().unwrap_or(Path::new("."));
    // Somebody may have tidied up.
    fs::create_dir_all(folder)?;
    let temporary = path.with_extension("json.new");
    let mut file = File::create(&temporary)?;
    file.write_all(text.as_bytes())?;
    file.sync_all()?;
    fs::rename(&temporary, path)?;
    File::open(folder)?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn memory(writes: u64) -> Memory {
        Memory { persistent_writes: writes, ..Memory::default() }
    }

    fn names(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).expect("a folder");
        let mut names: Vec<String> =
            entries.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into()).collect();
        names.sort();
        names
    }

    #[test]
    fn what_is_stored_is_there_after_a_restart_and_only_the_newest() {
        let folder = tempfile::tempdir().expect("a folder");
        let files = StateFiles::open(folder.path(), ["one", "two"].into_iter()).expect("a thread");
        assert_eq!(files.memories(), Memories::default());
        for writes in 1..=100 {
            files.store(Record { device: "one".into(), memory: memory(writes) });
        }
        drop(files);
        let files = StateFiles::open(folder.path(), ["one", "two"].into_iter()).expect("a thread");
        assert_eq!(files.memories().devices, BTreeMap::from([("one".to_string(), memory(100))]));
        assert_eq!(files.memories().unkept, None);
        drop(files);
        assert_eq!(names(&folder.path().join("devices")), ["one.json"]);
    }

    #[test]
    fn a_folder_is_used_by_one_gateway_at_a_time() {
        let folder = tempfile::tempdir().expect("a folder");
        let open = || StateFiles::open(folder.path(), ["one"].into_iter());
        let first = open().expect("it is free");
        let refused = open().err().expect("it is taken").to_string();
        let holder = format!("another busker (process {}) keeps its state in `", std::process::id());
        assert!(refused.starts_with(&holder), "{refused}");
        drop(first);
        drop(open().expect("it is free again"));
        // What a process that was killed has left there holds nothing.
        fs::write(folder.path().join("lock"), "123456").expect("a file");
        drop(open().expect("it is free"));
    }

    #[test]
    fn a_device_that_comes_later_goes_on_from_what_is_remembered_of_it_now() {
        let folder = tempfile::tempdir().expect("a folder");
        let files = StateFiles::open(folder.path(), ["one"].into_iter()).expect("a thread");
        files.store(Record { device: "one".into(), memory: memory(7) });
        drop(files);
        let files = StateFiles::open(folder.path(), ["two"].into_iter()).expect("a thread");
        files.store(Record { device: "two".into(), memory: memory(2) });
        let learnt = files.learn(["one", "two", "three"].into_iter());
        let expected = [("one".to_string(), memory(7)), ("two".to_string(), memory(2))];
        assert_eq!((learnt.devices, learnt.unkept), (BTreeMap::from(expected), None));
        // A folder in the place of the file, which cannot be kept aside since its place is taken.
        let devices = folder.path().join("devices");
        fs::create_dir_all(devices.join("four.json")).expect("a folder");
        for number in ["", ".2", ".3"].into_iter().map(String::from).chain((4..=99).map(|n| format!(".{n}")))
        {
            fs::write(devices.join(format!("four.json.broken{number}")), "").expect("a file");
        }
        assert!(files.learn(["four"].into_iter()).unkept.is_some());
        assert_eq!(files.memories().unkept, None, "the others are kept all the same");
        files.store(Record { device: "four".into(), memory: memory(1) });
        drop(files);
        assert!(devices.join("four.json").is_dir(), "it is not overwritten");
    }

    #[test]
    fn what_was_announced_is_there_after_a_restart() {
        let folder = tempfile::tempdir().expect("a folder");
        let open = || StateFiles::open(folder.path(), ["one"].into_iter()).expect("a thread");
        let path = folder.path().join(ANNOUNCED);
        let files = open();
        assert_eq!(files.take_announced(), BTreeMap::new());
        files.store_announced(&BTreeMap::from([("a/config", "{}")]));
        drop(files);
        let files = open();
        assert_eq!(files.take_announced(), BTreeMap::from([("a/config".to_string(), "{}".to_string())]));
        // What is the same is not written again: it may lie on a memory card.
        fs::remove_file(&path).expect("it is there");
        files.store_announced(&BTreeMap::from([("a/config", "{}")]));
        drop(files);
        assert!(!path.exists());
        fs::write(&path, "{\"a/config\": 7").expect("a file");
        assert_eq!(open().take_announced(), BTreeMap::new(), "a damaged one is as none");
    }

    #[test]
    fn where_something_was_told_is_there_after_a_restart() {
        let folder = tempfile::tempdir().expect("a folder");
        let open = || StateFiles::open(folder.path(), ["one"].into_iter()).expect("a thread");
        let tree = |base: &str| Tree { base_topic: base.into(), topics: [format!("{base}/one/flow")].into() };
        let files = open();
        assert_eq!(files.take_trees(), []);
        files.store_trees(&[tree("new"), tree("old")]);
        drop(files);
        let files = open();
        assert_eq!(files.take_trees(), [tree("new"), tree("old")]);
        files.store_trees(&[tree("new")]);
        drop(files);
        assert_eq!(open().take_trees(), [tree("new")]);
    }

    #[test]
    fn a_damaged_file_is_kept_aside_and_replaces_no_other() {
        let folder = tempfile::tempdir().expect("a folder");
        let devices = folder.path().join("devices");
        for (round, content) in ["{\"version\": 1, \"pl", "second"].into_iter().enumerate() {
            fs::create_dir_all(&devices).expect("a folder");
            fs::write(devices.join("one.json"), content).expect("a file");
            let files = StateFiles::open(folder.path(), ["one"].into_iter()).expect("a thread");
            assert_eq!(files.memories(), Memories::default(), "round {round}");
            drop(files);
        }
        assert_eq!(names(&devices), ["one.json.broken", "one.json.broken.2"]);
        let first = fs::read_to_string(devices.join("one.json.broken")).expect("the first one");
        assert_eq!(first, "{\"version\": 1, \"pl");
    }

    #[test]
    fn without_a_place_to_write_it_runs_and_says_so() {
        let folder = tempfile::tempdir().expect("a folder");
        // A file where the folder should be: nobody can write there, root neither.
        let in_the_way = folder.path().join("state");
        fs::write(&in_the_way, "").expect("a file");
        let files = StateFiles::open(&in_the_way, ["one"].into_iter()).expect("no thread is needed");
        let reason = files.memories().unkept.clone().expect("a reason");
        assert!(reason.contains("cannot be written"), "{reason}");
        files.store(Record { device: "one".into(), memory: memory(1) });
    }
}
