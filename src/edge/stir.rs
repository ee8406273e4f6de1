//! How whoever looks at the gateway is called: by everything that changes how it is.

use tokio::sync::Notify;

/// Somebody stirs, and who waits for it looks. Whoever stirs while nobody waits is noticed all the same;
/// several who do are noticed as one.
#[derive(Default)]
pub struct Stir {
    news: Notify,
}

impl Stir {
    /// Something has changed that may be worth telling. From any thread; never waits.
    pub fn stir(&self) {
        self.news.notify_one();
    }

    /// Until somebody has stirred since this last returned.
    pub async fn stirred(&self) {
        self.news.notified().await;
    }
}

#[cfg(test)]
mod tests {
    use std::future::Future;
    use std::pin::pin;
    use std::task::{Context, Waker};

    use super::*;

    fn is_stirred(stir: &Stir) -> bool {
        pin!(stir.stirred()).poll(&mut Context::from_waker(Waker::noop())).is_ready()
    }

    #[test]
    fn who_stirs_is_noticed_once_whether_somebody_waits_or_not() {
        let stir = Stir::default();
        assert!(!is_stirred(&stir));
        stir.stir();
        stir.stir();
        assert!(is_stirred(&stir));
        assert!(!is_stirred(&stir));
    }
}
