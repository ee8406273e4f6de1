//! The engine decides. Nothing here waits, asks the time or opens anything: if something must
//! happen later, a function returns the time at which to be called.
//!
//! The modules stand in the order of the data's way, and each uses only modules above it
//! (`tests/architecture` holds this).

// Words that everything speaks.
pub mod address;
pub mod time;
pub mod value;

// Describe: what a device is and what its words mean, what the gateway shall do.
pub mod codec;
pub mod configuration;
pub mod device;
pub mod keys;
pub mod profile;
pub mod settings;
pub mod units;
pub mod wanted;
pub mod yaml;

// Ask: requests, replies, which come when, and what was last on the wire.
pub mod modbus;
pub mod pace;
pub mod plan;
pub mod recorder;
pub mod schedule;

// Understand: who answers, what is known of it, and what changed.
pub mod identity;
pub mod line_change;
pub mod scan;
pub mod state;

// Tell: topics, discovery, health, what waits for the broker and when to look for it, and what has
// changed for who watches.
pub mod connection;
pub mod feed;
pub mod health;
pub mod homeassistant;
pub mod outbox;
pub mod topics;

// Obey: what arrives, commands with what they are known again by, settings, what outlives a restart, and the bus
// that ties all of it together.
pub mod arrivals;
pub mod bus;
pub mod command;
pub mod members;
pub mod memory;
pub mod reload;
pub mod request;
pub mod transaction;
pub mod upkeep;

#[cfg(test)]
pub mod test_device;
