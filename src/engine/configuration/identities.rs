//! That no two things of one configuration are the same to Home Assistant, which refuses the second.

use std::collections::BTreeSet;

use super::Resolver;
use super::file::Configuration;
use super::words::Name;
use crate::engine::device::Device;
use crate::engine::keys;
use crate::engine::settings::DeviceSettings;
use crate::engine::yaml::{At, Map};

impl Resolver<'_> {
    pub(super) fn device_name(&mut self, name: &At<Name>, file: &Configuration) {
        if name.0 == "bridge" {
            self.faults.add(&name.place, "`bridge` is the gateway's own name; give the device another one");
        }
        let of_a_bus = name.0.strip_prefix("bus_").map(|bus| Name(bus.into()));
        if let Some(bus) = of_a_bus.filter(|bus| file.buses.get().is_some_and(|buses| buses.names(bus))) {
            self.faults.add(
                &name.place,
                format!(
                    "`{}` is how Home Assistant knows the bus `{}`; give the device another name",
                    name.0, bus.0
                ),
            );
        }
    }

    /// What a profile says is checked with it; what is wished for the device comes on top.
    pub(super) fn keys_with_wishes(&mut self, name: &At<Name>, device: &Device) {
        for (key, owners) in keys::shared(device) {
            self.faults.add(&name.place, keys::message(&key, &owners));
        }
    }

    /// What Home Assistant knows an entity by is made of the device's name and the entity's key: `a` with `b_c` is
    /// `a_b` with `c` to it, and of two with one identity it refuses the second.
    pub(super) fn identities(
        &mut self,
        name: &At<Name>,
        device: &Device,
        others: &[DeviceSettings],
        file: &Configuration,
    ) {
        let of_device = |name: &str, device| Known { called: format!("`{name}`"), name: name.into(), device };
        let own = of_device(&name.0, Some(device));
        let is_near = |other: &&DeviceSettings| are_near(&name.0, &other.name);
        for other in others.iter().filter(is_near) {
            let other = of_device(&other.name, Some(&other.device));
            self.tell_apart(name, &own, &other, "give one of the devices another name");
        }
        for (bus, _) in file.buses.get().into_iter().flat_map(Map::iter) {
            let (called, identity) = (format!("the bus `{}`", bus.0), format!("bus_{}", bus.0));
            let bus = Known { called, name: identity, device: None };
            self.tell_apart(name, &own, &bus, "give the device another name");
        }
    }

    fn tell_apart(&mut self, name: &At<Name>, own: &Known, other: &Known, remedy: &str) {
        let Some((key, others_key)) = own.shares_with(other) else { return };
        let (called, others_name, whole) = (&own.called, &other.called, format!("{}_{key}", own.name));
        let message = format!(
            "{called} with its entity `{key}` and {others_name} with its entity `{others_key}` are both `{whole}` to \
             Home Assistant; {remedy}"
        );
        self.faults.add(&name.place, message);
    }
}

/// Whether one name begins with the other.
fn are_near(a: &str, b: &str) -> bool {
    rest_behind(a, b).or(rest_behind(b, a)).is_some()
}

/// A device or a bus, as Home Assistant knows it.
struct Known<'d> {
    called: String,
    /// The beginning of its identities, behind the base topic.
    name: String,
    /// `None` for a bus.
    device: Option<&'d Device>,
}

impl Known<'_> {
    fn keys(&self) -> BTreeSet<String> {
        match self.device {
            Some(device) => keys::of_device(device).into_keys().collect(),
            None => keys::OF_A_WIRE.into_iter().chain([keys::LINK]).map(str::to_string).collect(),
        }
    }

    /// The first key of it with which it is the same as the other with that one's.
    fn shares_with(&self, other: &Known) -> Option<(String, String)> {
        match (rest_behind(&self.name, &other.name), rest_behind(&other.name, &self.name)) {
            (Some(rest), _) => shared_key(rest, self, other),
            (_, Some(rest)) => shared_key(rest, other, self).map(|(a, b)| (b, a)),
            _ => None,
        }
    }
}

/// What stands in `long` behind `short` and a `_`.
fn rest_behind<'n>(long: &'n str, short: &str) -> Option<&'n str> {
    long.strip_prefix(short)?.strip_prefix('_')
}

/// The first key of `long` that with `rest` in front is one of `short`, and that one.
fn shared_key(rest: &str, long: &Known, short: &Known) -> Option<(String, String)> {
    let taken = short.keys();
    let found = long.keys().into_iter().map(|key| (format!("{rest}_{key}"), key));
    found.filter(|(whole, _)| taken.contains(whole)).map(|(whole, key)| (key, whole)).next()
}
