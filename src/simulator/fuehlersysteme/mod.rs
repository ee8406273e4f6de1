//! Devices of FuehlerSysteme eNET: the manual for their Modbus systems.

pub mod analog_in8;
pub mod analog_out8;
mod board;
mod damping;
mod ranges;
mod relay;
pub mod relay8;
pub mod sensor;
