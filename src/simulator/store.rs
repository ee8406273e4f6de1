//! Keeps simulated EEPROMs in files, one per device, so that they outlive the program.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use crate::simulator::device::Place;

/// A directory with a file `metz-connect_mr-do4@18.eeprom` per device.
#[derive(Debug)]
pub struct Store {
    directory: PathBuf,
    /// What each file holds, so that it is written only when it changes.
    stored: BTreeMap<u8, Vec<u16>>,
}

impl Store {
    /// Opens the directory, and makes it where it is missing.
    pub fn open(directory: &Path) -> io::Result<Store> {
        std::fs::create_dir_all(directory)?;
        Ok(Store { directory: directory.to_path_buf(), stored: BTreeMap::new() })
    }

    /// The stored EEPROM; `None` where there is none yet.
    pub fn load(&mut self, device: &Place) -> io::Result<Option<Vec<u16>>> {
        let path = self.path(device);
        let text = match std::fs::read_to_string(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(error),
        };
        let words: Result<Vec<u16>, _> =
            text.split_whitespace().map(|word| u16::from_str_radix(word, 16)).collect();
        let words = words.map_err(|_| {
            let told = format!("`{}` holds something else than hexadecimal words", path.display());
            io::Error::new(io::ErrorKind::InvalidData, told)
        })?;
        self.stored.insert(device.unit, words.clone());
        Ok(Some(words))
    }

    /// Stores the EEPROM if it has changed.
    pub fn save(&mut self, device: &Place, words: &[u16]) -> io::Result<()> {
        if self.stored.get(&device.unit).is_some_and(|stored| stored == words) {
            return Ok(());
        }
        let lines = words
            .chunks(8)
            .map(|chunk| chunk.iter().map(|word| format!("{word:04X}")).collect::<Vec<_>>().join(" ") + "\n");
        // Renamed into place, so that an interrupted write leaves the old memory whole.
        let path = self.path(device);
        let new = path.with_extension("new");
        std::fs::write(&new, lines.collect::<String>())?;
        std::fs::rename(&new, &path)?;
        self.stored.insert(device.unit, words.to_vec());
        Ok(())
    }

    fn path(&self, device: &Place) -> PathBuf {
        self.directory.join(format!("{}.eeprom", device.to_string().replace('/', "_")))
    }
}
