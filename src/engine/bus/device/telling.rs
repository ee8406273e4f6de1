//! What a device tells: its values, whether it is there, what it is to Home Assistant, and why
//! something is missing.

use serde_json::json;

use crate::engine::codec;
use crate::engine::device::PointIndex;
use crate::engine::health::{DeviceReport, PointReport};
use crate::engine::homeassistant;
use crate::engine::time::Time;
use crate::engine::topics::{Message, OFFLINE, ONLINE};
use crate::engine::value::Reading;

use super::{Context, DeviceState, Presence};

impl DeviceState {
    pub(super) fn tell_all(&mut self, now: Time, context: &mut Context) {
        for point in 0..self.settings.device.points.len() {
            self.tell(now, point, context);
        }
    }

    pub(super) fn tell(&mut self, now: Time, point: PointIndex, context: &mut Context) {
        let details = &self.settings.device.points[point];
        if !details.is_read() {
            return;
        }
        let anyway = self.tell_anyway.contains(&point);
        self.tell_anyway.retain(|other| *other != point);
        if let Some(text) = self.values.tell(now, point, details, context.republish, anyway) {
            let topic = context.gateway.topics.state(&self.settings.name, &details.name);
            context.publish(Message::retained(topic, text));
        }
    }

    pub(super) fn publish_availability(&mut self, available: bool, context: &mut Context) {
        if self.told_available == Some(available) {
            return;
        }
        self.told_available = Some(available);
        let topic = context.gateway.topics.availability(&self.settings.name);
        context.publish(Message::retained(topic, if available { ONLINE } else { OFFLINE }));
    }

    /// The last word before the end.
    pub(in crate::engine::bus) fn say_offline(&mut self, context: &mut Context) {
        self.publish_availability(false, context);
    }

    pub(super) fn announce(&mut self, context: &mut Context) {
        self.announcement_due = false;
        if !context.discovery {
            return;
        }
        let next = homeassistant::announcement(
            &context.gateway,
            &self.settings,
            &context.bus_name,
            self.values.known(),
        );
        if next.is_empty() && self.announced.is_none() {
            return;
        }
        if let Some(previous) = self.announced.take() {
            if let Some(farewell) = homeassistant::farewell(&previous, &next) {
                context.publish(farewell);
            }
        }
        context.publish(next.message());
        self.announced = Some(next);
    }

    pub(super) fn tell_info(&mut self, context: &mut Context) {
        let missing: serde_json::Map<String, serde_json::Value> = self
            .settings
            .device
            .points
            .iter()
            .enumerate()
            .filter(|(_, point)| point.is_read())
            .filter_map(|(index, point)| match self.values.reading(index) {
                Reading::Missing(missing) if self.presence == Presence::Present => {
                    Some((point.name.clone(), missing.to_string().into()))
                }
                _ => None,
            })
            .collect();
        let info = json!({
            "profile": self.settings.device.profile,
            "manufacturer": self.settings.device.manufacturer,
            "model": self.settings.device.model,
            "identity": self.identity,
            "bus": context.bus_name,
            "unit": self.settings.unit,
            "online": self.presence == Presence::Present,
            "reason": self.reason(),
            "missing": missing,
        })
        .to_string();
        self.told_present = self.presence == Presence::Present;
        if info != self.told_info {
            let topic = context.gateway.topics.info(&self.settings.name);
            context.publish(Message::retained(topic, info.clone()));
            self.told_info = info;
        }
    }

    pub(in crate::engine::bus) fn report(&self) -> DeviceReport {
        let points = self.settings.device.points.iter().enumerate().filter(|(_, point)| point.is_read());
        DeviceReport {
            name: self.settings.name.clone(),
            title: self.settings.title.clone(),
            profile: self.settings.device.profile.clone(),
            unit: self.settings.unit,
            online: self.told_available == Some(true),
            reason: self.reason(),
            identity: self.identity.clone(),
            counters: self.counters,
            last_answer_at: self.last_answer_at,
            points: points
                .map(|(index, point)| PointReport {
                    name: point.name.clone(),
                    value: self.values.reading(index).to_string(),
                    unit: self.unit_of(index),
                    reason: match self.values.reading(index) {
                        Reading::Missing(missing) => Some(missing.to_string()),
                        _ => None,
                    },
                    read_at: self.values.read_at(index),
                })
                .collect(),
        }
    }

    /// The unit of a point as it is told now.
    fn unit_of(&self, point: PointIndex) -> Option<String> {
        codec::resolve(self.device(), point, self.known()).ok().and_then(|resolved| resolved.unit)
    }
}
