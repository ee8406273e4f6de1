//! What all silent devices of a bus may take of it together.
//!
//! Each of them keeps to a share of its own, which is enough for one or two. Where most of a bus is dead (a cabinet
//! without power), those shares would add up to more than is left for the others.

use crate::engine::time::Duration;

use super::Bus;
use super::device::DeviceState;

/// After a probe in vain the other silent devices wait so many times as long as it took: all of them together have a
/// fifth of the wire at most. Nine or so that died keep their own shares within that.
const OTHERS_WAIT: u32 = 4;
/// On a bus that keeps its periods, or had nothing to ask within this time, nobody suffers from a probe.
const SPARE: Duration = Duration::from_secs(1);

impl Bus {
    /// A silent device has taken so much of the wire.
    pub(super) fn probed(&mut self, device: usize, took: Duration) {
        if !self.pace.is_behind(self.now, SPARE) {
            return;
        }
        let until = self.now + took * OTHERS_WAIT;
        for other in (0..self.devices.len()).filter(|other| *other != device) {
            let is_silent = self.devices.get(other).is_some_and(DeviceState::is_probed);
            if is_silent {
                self.devices[other].rest_until(until);
            }
        }
    }
}
