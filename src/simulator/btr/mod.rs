//! Devices of BTR NETCOM, the forerunners of METZ CONNECT's, with the same general commands.

pub mod mr_ai8;
