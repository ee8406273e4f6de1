//! Devices of FuehlerSysteme eNET: the manual for their Modbus systems.

mod relay;
pub mod relay8;
