//! The status page: one answer, which needs nothing but `/api/events`.

use std::fs::File;
use std::io::{self, Read};

use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};

const FRAME: &str = include_str!("page/frame.html");
const STYLE: &str = include_str!("page/style.css");
/// One script; what is outside functions is done in this order.
const SCRIPT: &str = concat!(
    include_str!("page/state.js"),
    include_str!("page/elements.js"),
    include_str!("page/buses.js"),
    include_str!("page/points.js"),
    include_str!("page/devices.js"),
    include_str!("page/stream.js"),
);

/// Stands in the frame where the nonce goes.
const NONCE: &str = "{nonce}";

pub async fn page() -> Response {
    match nonce() {
        Ok(nonce) => {
            let headers = [
                (header::CONTENT_TYPE, "text/html; charset=utf-8".to_string()),
                (header::CONTENT_SECURITY_POLICY, policy(&nonce)),
            ];
            (headers, whole(&nonce)).into_response()
        }
        Err(error) => {
            (StatusCode::INTERNAL_SERVER_ERROR, format!("no random numbers: {error}\n")).into_response()
        }
    }
}

fn whole(nonce: &str) -> String {
    FRAME.replace(NONCE, nonce).replace("{style}", STYLE).replace("{script}", SCRIPT)
}

/// The page's own style and script and nobody else's, which talk to this gateway and nobody else.
fn policy(nonce: &str) -> String {
    format!(
        "default-src 'none'; style-src 'nonce-{nonce}'; script-src 'nonce-{nonce}'; connect-src 'self'; \
         base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
}

/// 128 bits that nobody can guess, anew for each answer.
fn nonce() -> io::Result<String> {
    let mut bytes = [0; 16];
    File::open("/dev/urandom")?.read_exact(&mut bytes)?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_brings_all_it_needs() {
        let page = whole("0123");
        assert_eq!(page.matches("nonce=\"0123\"").count(), 2, "one style and one script");
        assert_eq!(page.matches("<style").count() + page.matches("<script").count(), 2);
        // An address would be something to load; the one there is names the language of drawings.
        let namespace = "http://www.w3.org/2000/svg";
        assert!(!page.replace(namespace, "").contains("://"));
        for forbidden in
            ["<link", "<img", "src=", "@import", "url(", "innerHTML", "eval(", "style=\"", "onclick"]
        {
            assert!(!page.contains(forbidden), "`{forbidden}` needs more than the policy allows");
        }
        for left in [NONCE, "{style}", "{script}"] {
            assert!(!page.contains(left), "`{left}` is left in it");
        }
    }

    #[test]
    fn each_answer_has_a_nonce_of_its_own() {
        let (first, second) = (nonce().expect("random"), nonce().expect("random"));
        assert_eq!(first.len(), 32);
        assert_ne!(first, second);
        assert!(policy(&first).contains(&format!("script-src 'nonce-{first}'; ")));
    }
}
