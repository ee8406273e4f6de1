//! The folder of recordings: each a file that Wireshark opens, as many as are wanted.

use std::fs::{self, DirEntry};
use std::io::{self, ErrorKind};
use std::path::Path;
use std::sync::Mutex;

use crate::edge::clock::Clock;
use crate::edge::files::replace;
use crate::edge::lock::lock;
use crate::engine::bus::Saved;
use crate::engine::recorder::Recording;
use crate::engine::recorder::files::{self, Kept};

/// Who runs the gateway may read and write it, and its group read it.
const MODE: u32 = 0o640;

/// One at a time: a name is chosen by the names that are there, and all are written under the same one first.
static SAVING: Mutex<()> = Mutex::new(());

/// Makes a file of the recording in `folder`. The bus keeps not more than `keep` of them.
pub fn save(folder: &Path, recording: &Recording, clock: Clock, keep: usize) -> Result<Saved, String> {
    let cannot = |error: io::Error| format!("`{}` cannot be written: {error}", folder.display());
    let _alone = lock(&SAVING);
    fs::create_dir_all(folder).map_err(cannot)?;
    let (bytes, frames) = recording.to_pcapng(clock.since_1970_at(recording.made_at));
    let others = kept(folder).map_err(cannot)?;
    for name in files::superfluous(&recording.bus, bytes.len() as u64, &others, keep) {
        match fs::remove_file(folder.join(name)) {
            // Somebody else has tidied up.
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            result => result.map_err(cannot)?,
        }
    }
    let path = folder.join(files::name(&recording.bus, clock.today(), &others));
    // Always the same name: what a loss of power leaves half written is replaced by the next.
    replace(&path, &folder.join("unfinished"), MODE, &bytes).map_err(cannot)?;
    Ok(Saved { path: path.display().to_string(), frames, why: recording.why.clone() })
}

fn kept(folder: &Path) -> io::Result<Vec<Kept>> {
    let of_entry = |entry: io::Result<DirEntry>| {
        let entry = entry?;
        let name = entry.file_name().to_string_lossy().into_owned();
        // One that has just been removed takes no room.
        Ok(Kept { name, bytes: entry.metadata().map_or(0, |metadata| metadata.len()) })
    };
    fs::read_dir(folder)?.map(of_entry).collect()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;
    use crate::engine::recorder::Tape;
    use crate::engine::settings::Link;
    use crate::engine::time::Time;

    fn recording(bus: &str) -> Recording {
        let mut tape = Tape::new(1000);
        tape.sent(Time(0), &[0, 1, 0, 0, 0, 6, 1, 3, 0, 0, 0, 1]);
        let link = Link::Tcp { host: "192.168.1.20".into(), port: 502 };
        tape.recording(Time(0), bus, &link, "on request")
    }

    #[test]
    fn a_bus_has_so_many_files_and_strangers_cannot_read_them() {
        let folder = tempfile::tempdir().expect("a folder");
        let folder = folder.path().join("recordings");
        let clock = Clock::start();
        save(&folder, &recording("attic"), clock, 3).expect("there is room");
        for round in 0..5 {
            let saved = save(&folder, &recording("plant"), clock, 3).expect("there is room");
            let metadata = fs::metadata(&saved.path).expect("the file is there");
            assert_eq!(metadata.permissions().mode() & 0o007, 0, "round {round}");
            assert_eq!((saved.frames, saved.why.as_str()), (1, "on request"));
        }
        let count = |bus: &str| {
            let names = kept(&folder).expect("the folder is there");
            names.iter().filter(|kept| kept.name.starts_with(bus)).count()
        };
        assert_eq!((count("plant-"), count("attic-")), (3, 1));
        assert_eq!(kept(&folder).expect("the folder is there").len(), 4, "and nothing else is left behind");
    }

    #[test]
    fn several_in_the_same_moment_are_several_whole_files() {
        let folder = tempfile::tempdir().expect("a folder");
        let (folder, clock) = (folder.path(), Clock::start());
        let mut paths: Vec<String> = std::thread::scope(|scope| {
            let save = || save(folder, &recording("plant"), clock, 100).expect("there is room").path;
            let threads: Vec<_> = (0..8).map(|_| scope.spawn(save)).collect();
            threads.into_iter().map(|thread| thread.join().expect("it does not panic")).collect()
        });
        paths.sort();
        paths.dedup();
        assert_eq!(paths.len(), 8, "{paths:?}");
        let length = |path: &String| fs::metadata(path).expect("the file is there").len();
        assert!(paths.iter().all(|path| length(path) == length(&paths[0])));
        assert_eq!(kept(folder).expect("the folder is there").len(), 8, "nothing else is left behind");
    }

    #[test]
    fn without_a_place_to_write_it_says_so() {
        let folder = tempfile::tempdir().expect("a folder");
        let in_the_way = folder.path().join("state");
        fs::write(&in_the_way, "").expect("a file");
        let error = save(&in_the_way.join("recordings"), &recording("plant"), Clock::start(), 3);
        assert!(error.as_ref().is_err_and(|error| error.contains("cannot be written")), "{error:?}");
    }
}
