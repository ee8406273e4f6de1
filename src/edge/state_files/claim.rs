//! The folder belongs to one gateway at a time.

use std::fs::{self, File};
use std::io::Write;
use std::path::Path;

use anyhow::bail;
use rustix::fs::FlockOperation;
use rustix::io::Errno;

/// Two gateways with one folder would each count as if the other wrote nothing: the second one does not start.
/// `None` where there can be no lock, since the folder cannot be written (which is told elsewhere) or its
/// file system knows none.
pub(super) fn lock_folder(state_dir: &Path) -> anyhow::Result<Option<File>> {
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
