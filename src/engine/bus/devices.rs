//! The devices of a bus, and which of them is to be asked next, without a look at each read of each device.
//!
//! On a bus with many devices most of them are as they were since the last request. What each of them may
//! want is therefore kept in few words; whoever can have changed a device makes them be found out anew.

use std::cmp::Reverse;
use std::ops::{Deref, DerefMut, Index, IndexMut};

use crate::engine::pace::{Moment, Pace};
use crate::engine::schedule::{Outlook, Urgency};
use crate::engine::time::Time;

use super::device::{DeviceState, Polled};

#[derive(Default)]
pub(super) struct Devices {
    list: Vec<DeviceState>,
    /// For each device; `None`: it has been touched.
    outlooks: Vec<Option<Outlook>>,
}

/// What is to be asked next, and whom.
pub(super) struct Next {
    pub(super) device: usize,
    pub(super) polled: Polled,
    pub(super) urgency: Urgency,
}

/// Who goes first; the greatest does.
#[derive(Clone, Copy, PartialEq, PartialOrd)]
struct Rank {
    urgency: Urgency,
    served_at: Reverse<Time>,
    device: Reverse<usize>,
}

impl Rank {
    /// The greatest that a device can have.
    fn at_most(device: usize, outlook: &Outlook, at: Moment) -> Option<Rank> {
        let (urgency, served_at) = (outlook.at_most(at)?, Reverse(outlook.served_at));
        Some(Rank { urgency, served_at, device: Reverse(device) })
    }
}

impl Devices {
    /// What is most urgent of all devices that may be asked. Of two equally urgent ones, that which has waited
    /// longest.
    pub(super) fn most_urgent(
        &mut self,
        now: Time,
        pace: &mut Pace,
        may_ask: impl Fn(&DeviceState) -> bool,
    ) -> Option<Next> {
        let (at, mut wanted) = (pace.at(now), 0.0);
        // Who seems to be next is looked at first, and usually that is all: nobody else seems to be before it.
        let (mut seems_next, mut seems_second): (Option<Rank>, Option<Rank>) = (None, None);
        for (index, (device, outlook)) in self.list.iter().zip(&mut self.outlooks).enumerate() {
            let outlook = outlook.get_or_insert_with(|| device.outlook(now));
            wanted += outlook.wanted;
            let Some(rank) = Rank::at_most(index, outlook, at) else { continue };
            if seems_second.is_some_and(|second| rank < second) || !may_ask(device) {
                continue;
            }
            match seems_next.replace(rank) {
                Some(next) if rank < next => (seems_next, seems_second) = (Some(next), Some(rank)),
                before => seems_second = before,
            }
        }
        let first = seems_next.map(|rank| rank.device.0);
        let mut best = first.and_then(|device| self.next_of(device, at));
        if goes_before(seems_second, &best) {
            for index in (0..self.list.len()).filter(|index| Some(*index) != first) {
                let rank =
                    self.outlooks[index].as_ref().and_then(|outlook| Rank::at_most(index, outlook, at));
                if goes_before(rank, &best) && may_ask(&self.list[index]) {
                    let next = self.next_of(index, at);
                    if goes_before(next.as_ref().map(|(rank, _)| *rank), &best) {
                        best = next;
                    }
                }
            }
        }
        let best = best.map(|(_, next)| next);
        debug_assert_eq!(
            best.as_ref().map(|best| (best.device, best.urgency)),
            self.most_urgent_by_looking(at, may_ask),
            "what is known of the devices is not what they want"
        );
        let is_ahead = |next: &Next| matches!(next.urgency, Urgency::Overdue(periods) if periods < 1.0);
        pace.want(wanted, best.as_ref().is_some_and(is_ahead));
        best
    }

    fn next_of(&self, device: usize, at: Moment) -> Option<(Rank, Next)> {
        let (polled, urgency) = self.list[device].most_urgent(at)?;
        let served_at = Reverse(self.list[device].served_at());
        Some((Rank { urgency, served_at, device: Reverse(device) }, Next { device, polled, urgency }))
    }

    /// The same by a look at everything, which any test of a bus holds the short way against.
    fn most_urgent_by_looking(
        &self,
        at: Moment,
        may_ask: impl Fn(&DeviceState) -> bool,
    ) -> Option<(usize, Urgency)> {
        let askable = self.iter().enumerate().filter(|(_, device)| may_ask(device));
        let urgent = askable.filter_map(|(index, device)| Some((index, device.most_urgent(at)?.1)));
        urgent.reduce(|best, other| {
            let waited_longer = || self[other.0].served_at() < self[best.0].served_at();
            let is_better = other.1 > best.1 || (other.1 == best.1 && waited_longer());
            if is_better { other } else { best }
        })
    }

    pub(super) fn push(&mut self, device: DeviceState) {
        self.list.push(device);
        self.outlooks.push(None);
    }

    pub(super) fn remove(&mut self, index: usize) -> DeviceState {
        self.outlooks.remove(index);
        self.list.remove(index)
    }
}

fn goes_before(rank: Option<Rank>, best: &Option<(Rank, Next)>) -> bool {
    rank > best.as_ref().map(|(rank, _)| *rank)
}

impl From<Vec<DeviceState>> for Devices {
    fn from(list: Vec<DeviceState>) -> Devices {
        Devices { outlooks: list.iter().map(|_| None).collect(), list }
    }
}

impl Index<usize> for Devices {
    type Output = DeviceState;
    fn index(&self, index: usize) -> &DeviceState {
        &self.list[index]
    }
}

impl IndexMut<usize> for Devices {
    fn index_mut(&mut self, index: usize) -> &mut DeviceState {
        self.outlooks[index] = None;
        &mut self.list[index]
    }
}

impl Deref for Devices {
    type Target = [DeviceState];
    fn deref(&self) -> &[DeviceState] {
        &self.list
    }
}

impl DerefMut for Devices {
    fn deref_mut(&mut self) -> &mut [DeviceState] {
        self.outlooks.fill_with(|| None);
        &mut self.list
    }
}

impl<'a> IntoIterator for &'a Devices {
    type Item = &'a DeviceState;
    type IntoIter = std::slice::Iter<'a, DeviceState>;
    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

impl<'a> IntoIterator for &'a mut Devices {
    type Item = &'a mut DeviceState;
    type IntoIter = std::slice::IterMut<'a, DeviceState>;
    fn into_iter(self) -> Self::IntoIter {
        self.iter_mut()
    }
}
