//! The edge does: everything that waits, opens and asks the time. It decides nothing.

pub mod clock;
pub mod http;
pub mod metrics;
pub mod mqtt;
pub mod reports;
