//! A sensor for a gas and its calibration (chapter 5, pages 11 and 12; RWreg_19).
//!
//! Not told by the manual, and chosen here: a calibration by hand takes ten seconds. At the end of each
//! seven days the reading that came nearest to fresh air is taken for it, unless fresh air was reached.

use crate::engine::time::{Duration, Time};

/// CO2, VOC or O2, in the steps of its register.
#[derive(Clone, Debug)]
pub struct Gas {
    kind: Kind,
    /// Bits 4 to 6 of RWreg_19. Stored.
    pub automatic: bool,
    /// The "interne Kalibrierdaten"; stored as well, for what else would they be for.
    pub offset: i16,
    measured: f64,
    calibrated_at: Option<Time>,
    switched_on: Time,
    /// Since when the seven days run, and the readings between which all of them were.
    since: Time,
    seen: Option<(f64, f64)>,
}

/// What a kind of gas has of its own.
#[derive(Clone, Copy, Debug)]
pub struct Kind {
    /// The reading in fresh air.
    pub fresh: f64,
    /// "Im AUTO-Modus wird ebenfalls bei kleiner … eine Kalibrierung durchgeführt".
    pub too_low: Option<f64>,
}

pub const CO2: Kind = Kind { fresh: 400.0, too_low: Some(300.0) };
pub const VOC: Kind = Kind { fresh: 100.0, too_low: Some(50.0) };
pub const OXYGEN: Kind = Kind { fresh: 209.0, too_low: None };

const BY_HAND: Duration = Duration::from_secs(10);
const PERIOD: Duration = Duration::from_secs(7 * 24 * 3600);
/// "frühestens 10min nach dem Einschalten".
const WARM_UP: Duration = Duration::from_secs(600);

impl Gas {
    pub fn new(now: Time, kind: Kind, measured: f64) -> Gas {
        Gas {
            kind,
            // The factory's setting depends on the type of the device; the manual recommends it.
            automatic: true,
            offset: 0,
            measured,
            calibrated_at: None,
            switched_on: now,
            since: now,
            seen: None,
        }
    }

    pub fn reading(&self) -> f64 {
        self.measured + f64::from(self.offset)
    }

    pub fn is_calibrating(&self) -> bool {
        self.calibrated_at.is_some()
    }

    /// What is around it from now on.
    pub fn measure(&mut self, measured: f64) {
        self.measured = measured;
    }

    /// Begins a calibration by hand, or ends one without an effect.
    pub fn calibrate(&mut self, now: Time, on: bool) {
        self.calibrated_at = if on { self.calibrated_at.or(Some(now + BY_HAND)) } else { None };
    }

    pub fn set_automatic(&mut self, now: Time, on: bool) {
        if on && !self.automatic {
            (self.since, self.seen) = (now, None);
        }
        self.automatic = on;
    }

    /// When something of it ends by itself.
    pub fn changes_at(&self) -> [Option<Time>; 3] {
        let automatic = |at: Time| self.automatic.then_some(at);
        [self.calibrated_at, automatic(self.since + PERIOD), automatic(self.switched_on + WARM_UP)]
    }

    /// Takes note of a moment; between two of them nothing has changed but what `changes_at` told.
    pub fn advance(&mut self, now: Time) {
        if self.calibrated_at.is_some_and(|at| at <= now) {
            self.calibrated_at = None;
            self.shift(self.kind.fresh - self.reading());
        }
        if !self.automatic {
            return;
        }
        let is_low = self.kind.too_low.is_some_and(|low| self.reading() < low);
        if is_low && now.since(self.switched_on) >= WARM_UP {
            self.shift(self.kind.fresh - self.reading());
        }
        let (low, high) = self.seen.unwrap_or((self.reading(), self.reading()));
        let (low, high) = (low.min(self.reading()), high.max(self.reading()));
        self.seen = Some((low, high));
        if now.since(self.since) >= PERIOD {
            self.since = now;
            self.shift(self.kind.fresh - self.kind.fresh.clamp(low, high));
            self.seen = None;
        }
    }

    /// After switching on.
    pub fn restarted(&self, now: Time) -> Gas {
        let Gas { automatic, offset, .. } = *self;
        Gas { automatic, offset, ..Gas::new(now, self.kind, self.measured) }
    }

    fn shift(&mut self, by: f64) {
        self.offset = (f64::from(self.offset) + by.round()) as i16;
        // What was seen before belongs to the calibration before.
        self.seen = None;
    }
}
