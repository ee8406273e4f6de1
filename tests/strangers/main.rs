//! Against strangers: programs that nobody here wrote, so that the gateway and the simulator cannot
//! share a mistake.
//!
//! pymodbus comes from the Python package index and mbpoll (with libmodbus) from Debian, each once,
//! into `.peers/`. Where one cannot be had, its test says so and passes, unless `CI=true` is set.

mod gateway;
mod peers;
mod simulator;
#[path = "../support/mod.rs"]
mod support;
