//! The files in `state_dir`: one small file for each device, read at the start and replaced as a whole, and what
//! the broker has been told.

mod claim;
mod shelf;
mod writer;

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::edge::lock::lock;
use crate::engine::memory::{Memories, Memory, Record};
use crate::engine::outbox::Tree;
use claim::lock_folder;
pub use shelf::Shelf;
use writer::Writer;

/// What Home Assistant may have of this gateway, in `state_dir`.
const ANNOUNCED: &str = "announced.json";

/// On which topics something is told, and perhaps still has to be taken back.
const TOPICS: &str = "topics.json";

/// What was remembered at the start, and where to put what is to be remembered.
pub struct StateFiles {
    /// The newest of each device.
    memories: Mutex<Memories>,
    recordings: Option<PathBuf>,
    /// `None` if nothing is kept.
    kept: Option<Kept>,
    announced: Told<BTreeMap<String, Vec<String>>>,
    trees: Told<Vec<Tree>>,
    /// Held as long as this lives.
    _lock: Option<File>,
}

struct Kept {
    /// Of the devices' files.
    folder: PathBuf,
    writer: Writer,
    /// Devices of which it has been said that nothing is remembered.
    unknown: Mutex<BTreeSet<String>>,
}

/// What the broker has been told, in a file.
struct Told<T> {
    file: &'static str,
    /// By an earlier run, until somebody takes it.
    recalled: Mutex<T>,
    /// The fingerprint of what is stored: the whole lies in the outbox already.
    stored: Mutex<u64>,
}

impl StateFiles {
    /// Keeps nothing, and remembers nothing.
    pub fn nowhere() -> StateFiles {
        let memories = Memories { unkept: Some("nothing is kept".into()), ..Memories::default() };
        let (announced, trees) = (Told::nothing(ANNOUNCED), Told::nothing(TOPICS));
        StateFiles {
            memories: Mutex::new(memories),
            recordings: None,
            kept: None,
            announced,
            trees,
            _lock: None,
        }
    }

    /// Reads what is remembered of these devices in `state_dir`. What is wrong with the files goes to
    /// the log, and the gateway runs without them. An error means that another gateway has them.
    pub fn open<'d>(state_dir: &Path, devices: impl Iterator<Item = &'d str>) -> anyhow::Result<StateFiles> {
        let folder = state_dir.join("devices");
        // They may find room where a damaged memory must not be overwritten.
        let recordings = Some(state_dir.join("recordings"));
        let _lock = lock_folder(state_dir)?;
        let mut memories = Memories::default();
        let unknown = recall_all(&mut memories, &folder, devices);
        let shown = folder.display();
        if !unknown.is_empty() {
            tracing::info!("nothing is remembered yet in `{shown}` of {}", unknown.join(", "));
        }
        memories.unkept = probe(&folder).err().map(|error| format!("`{shown}` cannot be written: {error}"));
        let kept = match &memories.unkept {
            Some(reason) => {
                tracing::warn!(
                    "{reason}; counts of EEPROM writes end with this run, and `settings` are only compared, \
                     except where they are enforced"
                );
                None
            }
            None => Some(Kept {
                writer: Writer::start(folder.clone())?,
                folder,
                unknown: Mutex::new(unknown.into_iter().map(String::from).collect()),
            }),
        };
        let (announced, trees) = (Told::recall(state_dir, ANNOUNCED), Told::recall(state_dir, TOPICS));
        Ok(StateFiles { memories: Mutex::new(memories), recordings, kept, announced, trees, _lock })
    }

    /// Where recordings of what was on the wire are kept, if they are.
    pub fn recordings(&self) -> Option<&Path> {
        self.recordings.as_deref()
    }

    /// What is remembered now.
    pub fn memories(&self) -> Memories {
        lock(&self.memories).clone()
    }

    /// What is remembered now, also of these devices, which have come since the start. A device whose file is found
    /// damaged stays so until the end, whatever becomes of the file: what this run counts lacks what stood in it.
    pub fn learn<'d>(&self, devices: impl Iterator<Item = &'d str>) -> Memories {
        let Some(kept) = &self.kept else { return self.memories() };
        let mut memories = lock(&self.memories);
        for device in recall_all(&mut memories, &kept.folder, devices) {
            // It may be in use without anything to remember: then that is no news.
            if lock(&kept.unknown).insert(device.into()) {
                tracing::info!("nothing is remembered yet of {device}");
            }
        }
        memories.clone()
    }

    /// Goes on from what the others remember, where both are kept. What they count of a device whose file is damaged
    /// lacks what stood in it.
    fn take_over(&self, others: &StateFiles) {
        let theirs = others.memories();
        for (device, memory) in &theirs.devices {
            if theirs.unkept_of(device).is_none() {
                self.store(Record { device: device.clone(), memory: memory.clone() });
            }
        }
    }

    /// Puts a memory where it will be stored. Does not wait for that.
    pub fn store(&self, record: Record) {
        // Also what is not kept is remembered until the end: devices may begin anew before.
        let Record { device, memory } = &record;
        let is_damaged = {
            let mut memories = lock(&self.memories);
            memories.devices.insert(device.clone(), memory.clone());
            memories.damaged.contains_key(device)
        };
        if let Some(kept) = self.kept.as_ref().filter(|_| !is_damaged) {
            kept.writer.store(record);
        }
    }

    /// What Home Assistant may have of earlier runs, by topic; only once.
    pub fn take_announced(&self) -> BTreeMap<String, Vec<String>> {
        self.announced.take()
    }

    /// Keeps what Home Assistant may have, if it is not what is kept. Does not wait for that.
    pub fn store_announced(&self, told: &BTreeMap<&str, Vec<Cow<'_, str>>>) {
        if let Some(kept) = &self.kept {
            self.announced.store(told, &kept.writer);
        }
    }

    /// Where earlier runs have told something, the last one first; only once.
    pub fn take_trees(&self) -> Vec<Tree> {
        self.trees.take()
    }

    /// Keeps where something is told, or has to be taken back, if it is not what is kept. Does not wait for that.
    pub fn store_trees(&self, trees: &[Tree]) {
        if let Some(kept) = &self.kept {
            self.trees.store(trees, &kept.writer);
        }
    }

    /// Waits until everything is stored; the end.
    pub fn finish(&self) {
        if let Some(kept) = &self.kept {
            kept.writer.finish();
        }
    }
}

impl<T: Default + DeserializeOwned + Hash> Told<T> {
    /// Nothing if it is not known: the broker most likely knows it.
    fn recall(state_dir: &Path, file: &'static str) -> Told<T> {
        let path = state_dir.join(file);
        let read = match fs::read_to_string(&path) {
            Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {
                Ok(T::default())
            }
            Err(error) => Err(error.to_string()),
            Ok(text) => serde_json::from_str(&text).map_err(|error| error.to_string()),
        };
        let recalled = read.unwrap_or_else(|reason| {
            tracing::warn!("`{}` cannot be used ({reason}) and will be written anew", path.display());
            T::default()
        });
        Told::with(file, recalled)
    }

    fn nothing(file: &'static str) -> Told<T> {
        Told::with(file, T::default())
    }

    fn with(file: &'static str, recalled: T) -> Told<T> {
        Told { file, stored: Mutex::new(fingerprint(&recalled)), recalled: Mutex::new(recalled) }
    }

    fn take(&self) -> T {
        std::mem::take(&mut *lock(&self.recalled))
    }

    /// `told` is hashed and written as a `T` is.
    fn store<U: Hash + Serialize + ?Sized>(&self, told: &U, writer: &Writer) {
        let next = fingerprint(told);
        if std::mem::replace(&mut *lock(&self.stored), next) == next {
            return;
        }
        match serde_json::to_string(told) {
            Ok(text) => writer.store_text(self.file, text),
            Err(error) => tracing::error!("`{}` cannot be stored: {error}", self.file),
        }
    }
}

fn fingerprint(told: &(impl Hash + ?Sized)) -> u64 {
    let mut hasher = DefaultHasher::new();
    told.hash(&mut hasher);
    hasher.finish()
}

fn file_of(folder: &Path, device: &str) -> PathBuf {
    folder.join(format!("{device}.json"))
}

/// Reads what is remembered of the devices of which nothing is known yet; returns those of which nothing is found.
fn recall_all<'d>(
    memories: &mut Memories,
    folder: &Path,
    devices: impl Iterator<Item = &'d str>,
) -> Vec<&'d str> {
    let mut unknown = Vec::new();
    for device in devices {
        let is_known = memories.devices.contains_key(device) || memories.damaged.contains_key(device);
        if is_known {
            continue;
        }
        match recall(&file_of(folder, device)) {
            Ok(Some(memory)) => drop(memories.devices.insert(device.into(), memory)),
            Ok(None) => unknown.push(device),
            Err(reason) => {
                tracing::warn!("{reason}; nothing is kept of {device}");
                memories.damaged.insert(device.into(), reason);
            }
        }
    }
    unknown
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

/// Whether files can be made in `folder`, which is made if it is not there. That a disk is full may pass.
fn probe(folder: &Path) -> io::Result<()> {
    fs::create_dir_all(folder)?;
    let path = folder.join(".probe");
    File::create(&path)?;
    fs::remove_file(&path)
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
        let is_unkept_alone = |memories: Memories| {
            assert_eq!(
                (memories.unkept, memories.damaged.len()),
                (None, 1),
                "the others are kept all the same"
            );
            assert!(memories.damaged["four"].contains("cannot be kept aside"), "{:?}", memories.damaged);
        };
        is_unkept_alone(files.learn(["four"].into_iter()));
        files.store(Record { device: "four".into(), memory: memory(1) });
        // What is counted of it is known, and still it is not kept: neither for a bus that begins nor for one that stays.
        assert_eq!(files.memories().devices["four"], memory(1));
        is_unkept_alone(files.memories());
        is_unkept_alone(files.learn(["four"].into_iter()));
        // Nor does it take the place of what is remembered elsewhere.
        let elsewhere = tempfile::tempdir().expect("another folder");
        let others = StateFiles::open(elsewhere.path(), [].into_iter()).expect("a thread");
        others.store(Record { device: "four".into(), memory: memory(9) });
        others.take_over(&files);
        let expected = [("four", memory(9)), ("one", memory(7)), ("two", memory(2))];
        assert_eq!(others.memories().devices, expected.map(|(device, of)| (device.into(), of)).into());
        // At the next start it is the same: the others are kept.
        drop(files);
        let files = StateFiles::open(folder.path(), ["two", "four"].into_iter()).expect("a thread");
        is_unkept_alone(files.memories());
        files.store(Record { device: "two".into(), memory: memory(3) });
        drop(files);
        let files = StateFiles::open(folder.path(), ["two"].into_iter()).expect("a thread");
        assert_eq!(files.memories().devices["two"], memory(3));
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
        files.store_announced(&BTreeMap::from([("a/config", vec!["{}".into()])]));
        drop(files);
        let files = open();
        assert_eq!(
            files.take_announced(),
            BTreeMap::from([("a/config".to_string(), vec!["{}".to_string()])])
        );
        // What is the same is not written again: it may lie on a memory card.
        fs::remove_file(&path).expect("it is there");
        files.store_announced(&BTreeMap::from([("a/config", vec!["{}".into()])]));
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
        // A device may begin anew before the end.
        files.store(Record { device: "one".into(), memory: memory(1) });
        assert_eq!(files.learn(["one"].into_iter()).devices["one"], memory(1));
    }

    #[test]
    fn what_was_announced_is_known_also_where_nothing_more_can_be_written() {
        let folder = tempfile::tempdir().expect("a folder");
        fs::write(folder.path().join("devices"), "").expect("a file in the way");
        fs::write(folder.path().join(ANNOUNCED), r#"{"a/config":["{}"]}"#).expect("a file");
        let files = StateFiles::open(folder.path(), ["one"].into_iter()).expect("no thread is needed");
        assert!(files.memories().unkept.is_some());
        assert_eq!(files.take_announced().into_keys().collect::<Vec<_>>(), ["a/config"]);
    }
}
