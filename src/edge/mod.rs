//! The edge does: everything that waits, opens and asks the time. It decides nothing.

// The gateway as a whole: how it starts, changes and ends.
pub mod app;
pub mod plant;
pub mod reload;
pub mod runtime;
pub mod shutdown;
pub mod stir;

// A bus: its thread, its link, and the time.
pub mod bell;
pub mod bus_runner;
pub mod bus_thread;
pub mod clock;
pub mod doze;
pub mod expectation;
pub mod guarded_link;
pub mod link;
pub mod punctual;

// Who is told, and who asks.
pub mod http;
pub mod log;
pub mod metrics;
pub mod mqtt;
pub mod reports;

// What is kept in files.
pub mod files;
pub mod recordings;
pub mod secrets;
pub mod state_files;
pub mod tls;

// What all of them use.
pub mod lock;
