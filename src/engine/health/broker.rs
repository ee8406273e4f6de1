//! How the connection to the broker is, and what it lacks.

use std::collections::BTreeMap;

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct BrokerReport {
    pub connected: bool,
    /// Why not.
    pub reason: Option<String>,
    /// How often the connection was made since the start.
    pub connects: u64,
    /// Another client with the same identifier takes this gateway's place again and again.
    pub client_id_taken: bool,
    /// Others tell something else of this gateway's state, again and again.
    pub state_denied: bool,
    /// Topics of which the broker is not told what stands there, since it takes no message as long.
    pub kept_back: Vec<String>,
    /// Topics of which the broker does not hand on what is told there, although it confirms it.
    pub not_arriving: Vec<String>,
    /// Where other gateways announce what has the identity of something of ours: by discovery topic, their base
    /// topics.
    pub announced_by_others: BTreeMap<String, String>,
    /// Messages that wait for it: at most one for each retained topic, and those told once.
    pub waiting: usize,
    /// Messages told once that were dropped since too many waited.
    pub dropped: u64,
}

impl BrokerReport {
    /// The connection is made.
    pub fn made(&mut self) {
        (self.connected, self.reason) = (true, None);
        self.connects += 1;
    }

    /// The connection is lost, or could not be made. Whether the reason is news: it is once, not once for each
    /// attempt; and a quarrel for this gateway's place is once, not each time that it is lost.
    pub fn lost(&mut self, reason: String, contested: bool) -> bool {
        let is_known = self.reason.as_ref() == Some(&reason) || (contested && self.client_id_taken);
        (self.connected, self.client_id_taken) = (false, contested);
        self.reason = Some(reason);
        !is_known
    }

    /// Whether the broker does not hand on all that this gateway has to tell.
    pub fn misses_something(&self) -> bool {
        !(self.kept_back.is_empty() && self.not_arriving.is_empty() && self.announced_by_others.is_empty())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is told of a connection that was made (`up`), was lost for a reason, or to somebody else (`taken`).
    #[track_caller]
    fn check_told(life: &[&str], expected: &[&str]) {
        let (mut report, mut told) = (BrokerReport::default(), Vec::new());
        for what in life {
            match *what {
                "up" => report.made(),
                reason if report.lost(reason.into(), reason == "taken") => told.push(*what),
                _ => {}
            }
            assert_eq!(
                (report.connected, report.reason.is_none()),
                (*what == "up", *what == "up"),
                "{life:?}"
            );
        }
        assert_eq!(told, expected, "{life:?}");
        let ups = life.iter().filter(|what| **what == "up").count();
        assert_eq!(report.connects, ups as u64);
    }

    #[test]
    fn a_reason_is_told_once_not_with_each_attempt() {
        check_told(&["refused", "refused", "silent", "refused"], &["refused", "silent", "refused"]);
        check_told(&["refused", "up", "refused", "refused"], &["refused", "refused"]);
    }

    #[test]
    fn a_quarrel_is_told_once_not_with_each_time_that_it_is_lost() {
        check_told(&["up", "taken", "up", "taken", "up", "taken"], &["taken"]);
        check_told(&["up", "taken", "up", "silent", "up", "taken"], &["taken", "silent", "taken"]);
    }
}
