//! What devices do that they should not: the faults from which chance chooses.

/// Of any device, for up to half a minute.
pub const FAULTS: &[&str] = &[
    "silent",
    "silent,every=2",
    "slow=150ms",
    "late=450ms,every=2",
    "late=500ms,every=2",
    "late=700ms,every=2",
    "late=700ms,every=3",
    "late=1s,every=2",
    "late=1s,every=4",
    "late=6s,every=5",
    "dribble=5ms",
    "garbled",
    "garbled,every=2",
    "noisy",
    "leading-zero",
    "short",
    "short,every=3",
    "other-unit",
    "exception=4",
    "exception=2,every=5",
    "exception=5,every=2",
    "exception=6,every=2",
    "reboot=10s",
];
