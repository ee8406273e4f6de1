//! The edge does: everything that waits, opens and asks the time. It decides nothing.

pub mod app;
pub mod bell;
pub mod bus_runner;
pub mod bus_thread;
pub mod clock;
pub mod expectation;
pub mod files;
pub mod guarded_link;
pub mod http;
pub mod link;
pub mod lock;
pub mod log;
pub mod metrics;
pub mod mqtt;
pub mod plant;
pub mod punctual;
pub mod recordings;
pub mod reload;
pub mod reports;
pub mod runtime;
pub mod secrets;
pub mod shutdown;
pub mod state_files;
pub mod stir;
pub mod tls;
