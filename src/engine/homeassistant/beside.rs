//! The buttons that stand beside a point's entity, for what that itself cannot be set to.

use super::entity::Entity;
use super::point::{category, entity};
use super::thing;
use crate::engine::codec;
use crate::engine::device::{Device, Platform, Point, PointIndex};
use crate::engine::keys;

/// The buttons that stand beside an entity: one for each name that can be written to the point and
/// that the entity itself cannot show. `automatic` is no number, so a number cannot be set to it.
pub fn companions(device: &Device, index: PointIndex, known: &[Option<i128>]) -> Vec<Entity> {
    let (Some(main), Ok(resolved)) = (entity(device, index, known), codec::resolve(device, index, known))
    else {
        return Vec::new();
    };
    // What a thing commands has no controls of its own.
    let Some(shown) = thing::as_shown(device, index, known) else { return Vec::new() };
    let point = &*shown;
    let names = keys::names_beside(point, resolved.form, main.platform);
    names.into_iter().map(|name| button_beside(device, point, &main, name)).collect()
}

fn button_beside(device: &Device, point: &Point, main: &Entity, name: &str) -> Entity {
    let key = keys::of_button(device, &main.key, name);
    Entity {
        category: category(point, Platform::Button),
        enabled: main.enabled,
        press: Some(name.to_string()),
        ..Entity::new(key, Platform::Button, format!("{}: {}", main.name, name.replace('_', " ")))
    }
}
