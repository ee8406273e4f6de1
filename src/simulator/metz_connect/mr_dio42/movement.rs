//! How long a damper takes to follow its relay (pages 23, 26 and 31).

use crate::engine::time::{Duration, Time};
use crate::simulator::metz_connect::mr_dio42::mode::Position;

/// DriveTime and TurnOffTime, in tenths of a second; 0 is not measured.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    pub open: u16,
    pub close: u16,
}

/// Measures from the switching of the relay to the damper's arrival. A relay that is on opens the
/// damper, one that is off lets it close, whichever of the two is safe (page 31).
#[derive(Clone, Copy, Debug, Default)]
pub struct Movement {
    /// `None` until the relay is switched for the first time: that counts as switching, so that a
    /// damper which is stuck is found after a start as well.
    relay: Option<bool>,
    /// `None` where nothing is being measured.
    began: Option<Time>,
}

/// The unit of all times but register 66's: "Auflösung 0,1 Sekunden".
pub const TENTH: Duration = Duration::from_millis(100);

impl Movement {
    /// Begins to measure where the relay has switched.
    pub fn follow(&mut self, now: Time, relay: bool) {
        if self.relay != Some(relay) {
            *self = Movement { relay: Some(relay), began: Some(now) };
        }
    }

    /// Ends measuring where the damper has arrived. Page 31 says so of the modes with a motor; page 26
    /// gives no end for Fire_Damper, where the same registers are taken to measure the same.
    pub fn arrive(&mut self, position: Position) {
        if position == self.target() {
            self.began = None;
        }
    }

    /// Whether the damper has moved too long.
    pub fn is_overdue(&self, now: Time, limits: Limits) -> bool {
        let limit = self.limit(limits);
        limit > 0 && self.began.is_some_and(|began| now.since(began) >= TENTH * limit.into())
    }

    /// Whether the damper is not where it should be, and is not allowed to be on its way (page 26).
    pub fn is_astray(&self, now: Time, position: Position, limits: Limits) -> bool {
        let may_move = self.began.is_some() && !self.is_overdue(now, limits);
        self.limit(limits) > 0 && position != self.target() && !may_move
    }

    fn target(&self) -> Position {
        if self.relay == Some(true) { Position::Open } else { Position::Close }
    }

    fn limit(&self, limits: Limits) -> u16 {
        if self.relay == Some(true) { limits.open } else { limits.close }
    }
}
