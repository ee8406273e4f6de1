//! The status page: one file, which needs nothing but `/api/events`.

use std::fs::File;
use std::io::{self, Read};

use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};

const PAGE: &str = include_str!("page.html");

/// Stands in the file where the nonce goes.
const NONCE: &str = "{nonce}";

pub async fn page() -> Response {
    match nonce() {
        Ok(nonce) => {
            let headers = [
                (header::CONTENT_TYPE, "text/html; charset=utf-8".to_string()),
                (header::CONTENT_SECURITY_POLICY, policy(&nonce)),
            ];
            (headers, PAGE.replace(NONCE, &nonce)).into_response()
        }
        Err(error) => {
            (StatusCode::INTERNAL_SERVER_ERROR, format!("no random numbers: {error}\n")).into_response()
        }
    }
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
        assert_eq!(PAGE.matches(NONCE).count(), 2, "one style and one script");
        assert_eq!(PAGE.matches("<style").count() + PAGE.matches("<script").count(), 2);
        // An address would be something to load; the one there is names the language of drawings.
        let namespace = "http://www.w3.org/2000/svg";
        assert!(!PAGE.replace(namespace, "").contains("://"));
        for forbidden in
            ["<link", "<img", "src=", "@import", "url(", "innerHTML", "eval(", "style=\"", "onclick"]
        {
            assert!(!PAGE.contains(forbidden), "`{forbidden}` needs more than the policy allows");
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
