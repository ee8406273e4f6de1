//! Devices as their manuals describe them, to test against and to show.
//!
//! This is the independent second reading of the manuals: it is written from them alone, uses no
//! profile and shares nothing with the gateway's encoder and line guard. Only [`plain`] is otherwise: a
//! device that is nothing but its profile.
//!
//! From the inside out: [`pdu`] takes requests apart; [`device`] is what every device can do;
//! [`metz_connect`], [`btr`] and [`fuehlersysteme`] are the devices; [`wire`] is their framing; [`line`] puts
//! several on one line, with [`fault`]s on request; [`script`] is the words in which a person or a
//! file changes the process side; [`server`] serves all of it on pseudo-terminals and sockets. Only
//! `port`, `store` and `server` do anything; everything before them is told the time.

pub mod btr;
pub mod device;
pub mod fault;
pub mod fuehlersysteme;
pub mod line;
pub mod metz_connect;
pub mod pdu;
pub mod plain;
pub mod port;
pub mod script;
pub mod server;
pub mod store;
pub mod wire;

pub use device::{DeviceAt, LineSettings, Model, Parity, Signal, Stimulus};
pub use fault::Fault;
pub use plain::Plain;
pub use port::{PtyPort, TcpPort};
pub use server::{Event, Options, Simulation, Told};
pub use wire::Framing;

#[cfg(test)]
pub(crate) mod testing;
