//! What the broker is still to be asked for on one connection, and what it is no longer to send.

use std::collections::VecDeque;

/// The topics (filters, with `+`) that are still to be subscribed to or let go of.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Subscriptions {
    wanted: Vec<String>,
    unwanted: Vec<String>,
    /// What the broker has been asked for, each time, and has not answered yet. Answers come in this order.
    asked_for: VecDeque<Vec<String>>,
}

impl Subscriptions {
    /// Of a new connection, on which nothing has been asked for yet.
    pub fn new(wanted: Vec<String>) -> Subscriptions {
        Subscriptions { wanted, ..Subscriptions::default() }
    }

    /// Instead of `before`, `now` is listened to on the same connection. What is in both is not asked for again.
    pub fn change(&mut self, before: Vec<String>, now: Vec<String>) {
        self.wanted.retain(|filter| now.contains(filter));
        self.unwanted.retain(|filter| !now.contains(filter));
        let (stays, goes): (Vec<String>, Vec<String>) =
            before.into_iter().partition(|filter| now.contains(filter));
        self.wanted.extend(now.into_iter().filter(|filter| !stays.contains(filter)));
        self.unwanted.extend(goes);
    }

    /// What is still to be asked for.
    pub fn wanted(&self) -> &[String] {
        &self.wanted
    }

    /// The broker has been asked for all that is [`Subscriptions::wanted`].
    pub fn asked(&mut self) {
        self.asked_for.push_back(std::mem::take(&mut self.wanted));
    }

    /// The broker has answered, and said of each whether it grants it; what of that it refuses.
    pub fn refused(&mut self, granted: impl IntoIterator<Item = bool>) -> Vec<String> {
        let answers = granted.into_iter().zip(self.asked_for.pop_front().unwrap_or_default());
        answers.filter(|(granted, _)| !granted).map(|(_, filter)| filter).collect()
    }

    /// What is to be let go of next.
    pub fn unwanted(&self) -> Option<&str> {
        self.unwanted.last().map(String::as_str)
    }

    /// The broker has been asked to send no more of [`Subscriptions::unwanted`].
    pub fn let_go(&mut self) {
        self.unwanted.pop();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(filters: &str) -> Vec<String> {
        filters.split_whitespace().map(str::to_string).collect()
    }

    /// On a connection that listens to the first of `steps`, it is listened to the others one after the other. What
    /// is asked for and let go of then, if nothing could be sent meanwhile or (`sends`) each time.
    #[track_caller]
    fn check(steps: &[&str], sends: bool, wanted: &str, unwanted: &str) {
        let mut subscriptions = Subscriptions::new(list(steps[0]));
        for pair in steps.windows(2) {
            if sends {
                subscriptions.asked();
                while subscriptions.unwanted().is_some() {
                    subscriptions.let_go();
                }
            }
            subscriptions.change(list(pair[0]), list(pair[1]));
        }
        assert_eq!(subscriptions.wanted(), list(wanted), "{steps:?}");
        let mut goes = Vec::new();
        while let Some(filter) = subscriptions.unwanted() {
            goes.insert(0, filter.to_string());
            subscriptions.let_go();
        }
        assert_eq!(goes, list(unwanted), "{steps:?}");
    }

    #[test]
    fn only_what_is_new_is_asked_for_and_only_what_is_gone_is_let_go_of() {
        check(&["a b"], true, "a b", "");
        check(&["a b", "b c"], true, "c", "a");
        check(&["a b", "a b"], true, "", "");
        check(&["a b", "b c", "a b"], true, "a", "c");
        // Nothing could be sent yet.
        check(&["a b", "b c"], false, "b c", "a");
        check(&["a b", "b c", "a b"], false, "b a", "c");
    }

    #[test]
    fn the_brokers_answer_is_about_what_it_was_asked_for() {
        let mut subscriptions = Subscriptions::new(list("a b c"));
        subscriptions.asked();
        assert!(subscriptions.wanted().is_empty());
        // More is asked for before the answer is there.
        subscriptions.change(list("a b c"), list("a b c d e"));
        subscriptions.asked();
        assert_eq!(subscriptions.refused([true, false, false]), ["b", "c"]);
        assert_eq!(subscriptions.refused([false, true]), ["d"]);
        assert!(subscriptions.refused([false]).is_empty());
    }
}
