//! busker: Modbus devices to MQTT and Home Assistant.
//!
//! The engine decides, the edge does: [`engine`] holds every rule and never waits, never asks the
//! time and never opens anything; [`edge`] moves bytes and messages and never decides.
//! [`simulator`] is a second, independent reading of the manuals: devices to test against.
//! [`cli`] is one verb per file.
//!
//! Begin with `ARCHITECTURE.md`, which leads a value and a command through the files, and with
//! [`engine::bus::Bus::handle`], where everything that happens on a bus comes together.

pub mod cli;
pub mod edge;
pub mod engine;
pub mod simulator;
