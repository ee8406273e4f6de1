//! Devices as Home Assistant is told of them: a function of the device and of what its selectors
//! say, never of values.
//!
//! `entity` is one of them. `point` derives what one point is there, `beside` the buttons beside it, `thing` what
//! several points are together; `device` puts them into the device's one discovery message, `gateway` does the same
//! for the gateway itself and its buses, and `announcement` is that message; `release` says it so that an older Home
//! Assistant understands it.

mod announcement;
mod beside;
mod device;
mod diagnostics;
mod entity;
mod gateway;
mod point;
mod release;
mod thing;

pub use announcement::{Announcement, Gateway, Outline, announcer, farewell};
pub use beside::companions;
pub use device::announcement;
pub use entity::Entity;
#[cfg(test)]
use gateway::{announce_bridge, announce_bus};
pub use gateway::{identities, introduction, introduction_of_bus};
pub use point::{entity, is_settled};

#[cfg(test)]
mod tests;
