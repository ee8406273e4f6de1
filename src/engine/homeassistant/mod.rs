//! Devices as Home Assistant is told of them: a function of the device and of what its selectors
//! say, never of values.
//!
//! `entity` derives what one point is there, `thing` what several are together, `announcement` puts the
//! entities of a device into its one discovery message, `gateway` does the same for the gateway itself and
//! its buses; `release` says it so that an older Home Assistant understands it.

mod announcement;
mod entity;
mod gateway;
mod release;
mod thing;

pub use announcement::{Announcement, Gateway, Outline, announcement, farewell};
pub use entity::{Entity, companions, entity, is_settled, sentence};
pub use gateway::{announce_bridge, announce_bus};
pub use thing::name_of_thing;
