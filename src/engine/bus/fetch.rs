//! Points that are read only because somebody asks: in as many requests as they need, and only while
//! what decides about them stays as it was from before the first until after the last.

use std::collections::VecDeque;

use crate::engine::address::Span;
use crate::engine::command::words_of;
use crate::engine::device::PointIndex;
use crate::engine::modbus::{Answer, Call, RequestError};

use super::{Bus, Purpose};

/// One point that is being fetched.
pub(super) struct Fetch {
    pub(super) device: usize,
    point: PointIndex,
    steps: VecDeque<Step>,
    words: Vec<u16>,
}

#[derive(Clone, Copy)]
enum Step {
    /// A register that decides whether the point lives.
    Guard(Span),
    Part(Span),
}

impl Bus {
    /// Somebody asks for this point.
    pub(super) fn fetch(&mut self, device: usize, point: PointIndex) {
        if self.fetches.iter().any(|fetch| fetch.device == device && fetch.point == point) {
            return;
        }
        let state = &self.devices[device];
        let (guards, parts) = state.parts_of(point);
        let guards = || guards.iter().copied().map(Step::Guard);
        let steps = guards().chain(parts.into_iter().map(Step::Part)).chain(guards()).collect();
        self.fetches.push_back(Fetch { device, point, steps, words: Vec::new() });
    }

    /// Asks for the next part of what is fetched. Whether anything was done.
    pub(super) fn next_fetch(&mut self) -> bool {
        let devices = &self.devices;
        let is_possible = |fetch: &Fetch| devices[fetch.device].is_present();
        let Some(at) = self.fetches.iter().position(is_possible) else { return false };
        // The one under way is always the first.
        if let Some(fetch) = self.fetches.remove(at) {
            self.fetches.push_front(fetch);
        }
        let fetch = &self.fetches[0];
        let (Some(Step::Guard(span) | Step::Part(span)), device) =
            (fetch.steps.front().copied(), fetch.device)
        else {
            return false;
        };
        self.send(device, Call::Read(span), Purpose::Fetch);
        true
    }

    pub(super) fn fetched(&mut self, result: Result<Answer, RequestError>) {
        let Some(mut fetch) = self.fetches.pop_front() else { return };
        let state = &mut self.devices[fetch.device];
        let answer = match result {
            Ok(answer) => answer,
            Err(error) => {
                state.fetch_failed(self.now, fetch.point, &error, &mut self.context);
                return;
            }
        };
        let words = words_of(&answer);
        match fetch.steps.pop_front() {
            Some(Step::Guard(span)) => state.read_beside(self.now, span, &words, &mut self.context),
            Some(Step::Part(_)) => fetch.words.extend(words),
            None => return,
        }
        let lives = state.lives(fetch.point);
        if lives && !fetch.steps.is_empty() {
            self.fetches.push_front(fetch);
            return;
        }
        // What came while the device changed under it is no reading.
        let words = if lives { fetch.words } else { Vec::new() };
        state.fetched(self.now, fetch.point, &words, &mut self.context);
    }
}
