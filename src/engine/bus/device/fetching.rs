//! What a device has to do with points that are read only on request.

use crate::engine::address::Span;
use crate::engine::codec;
use crate::engine::device::PointIndex;
use crate::engine::modbus::RequestError;
use crate::engine::plan::Read;
use crate::engine::time::Time;
use crate::engine::value::Missing;

use super::{Context, DeviceState};

impl DeviceState {
    /// The registers that decide about the point, and its own in parts that fit one request.
    pub(in crate::engine::bus) fn parts_of(&self, point: PointIndex) -> (Vec<Span>, Vec<Span>) {
        let details = self.details(point);
        let guards = details.selectors().into_iter().map(|selector| self.details(selector).at.span).collect();
        let (span, limits) = (details.at.span, self.settings.device.wire.limits);
        let most = if span.table().is_bits() { limits.read_bits } else { limits.read_registers }.max(1);
        let mut parts = Vec::new();
        let mut first = u32::from(span.first());
        while first <= u32::from(span.last()) {
            let last = (first + u32::from(most) - 1).min(u32::from(span.last()));
            parts.extend(Span::new(span.table(), first as u16, last as u16));
            first = last + 1;
        }
        (guards, parts)
    }

    /// Whether the point has a meaning now.
    pub(in crate::engine::bus) fn lives(&self, point: PointIndex) -> bool {
        codec::resolve(self.device(), point, self.known()).is_ok()
    }

    /// All parts have come; no words mean that there is nothing to read now.
    pub(in crate::engine::bus) fn fetched(
        &mut self,
        now: Time,
        point: PointIndex,
        words: &[u16],
        context: &mut Context,
    ) {
        let details = self.details(point);
        let (span, at, poll) = (details.at.span, details.at, details.poll);
        self.told.want(point);
        if words.is_empty() {
            let missing = codec::resolve(self.device(), point, self.known()).err();
            self.values.lose(point, missing.unwrap_or(Missing::NotYetRead));
            self.tell(now, point, context);
        } else {
            let read = Read { poll, span, points: vec![(point, at)], alone: true };
            self.absorb(now, &read, words, context);
        }
        self.after_news(now, context);
    }

    pub(in crate::engine::bus) fn fetch_failed(
        &mut self,
        now: Time,
        point: PointIndex,
        error: &RequestError,
        context: &mut Context,
    ) {
        match error {
            RequestError::Exception(code) => {
                self.values.lose(point, Missing::Exception(*code));
                self.told.want(point);
                self.tell(now, point, context);
                self.after_news(now, context);
            }
            error => self.failed(now, error, context),
        }
    }
}
