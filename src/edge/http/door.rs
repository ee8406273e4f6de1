//! What every answer has in common: who may have it, and what a browser may do with it.

use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::page;

/// Whom to let in.
pub struct Door {
    token: Option<String>,
}

impl Door {
    /// Without a token everybody is let in.
    pub fn new(token: Option<String>) -> Door {
        Door { token }
    }

    fn lets_in(&self, path: &str, headers: &HeaderMap) -> bool {
        let Some(token) = &self.token else { return true };
        // What restarts a container that is not well has no secrets.
        path == "/health" || shown_token(headers).is_some_and(|shown| is_same(shown, token))
    }
}

/// Around every request.
pub async fn pass(State(door): State<Arc<Door>>, request: Request, next: Next) -> Response {
    let mut response = if door.lets_in(request.uri().path(), request.headers()) {
        next.run(request).await
    } else {
        refuse(request.uri().path()).await
    };
    guard(response.headers_mut());
    response
}

/// The page tells nothing of the gateway by itself: it comes along, to ask for the token.
async fn refuse(path: &str) -> Response {
    let mut response = match path {
        "/" => page::page().await,
        _ => "a token is needed: `Authorization: Bearer …`\n".into_response(),
    };
    if response.status() == StatusCode::OK {
        *response.status_mut() = StatusCode::UNAUTHORIZED;
    }
    let scheme = HeaderValue::from_static("Bearer realm=\"busker\"");
    response.headers_mut().insert(header::WWW_AUTHENTICATE, scheme);
    response
}

fn guard(headers: &mut HeaderMap) {
    for (name, value) in [
        ("cache-control", "no-store"),
        ("x-content-type-options", "nosniff"),
        ("x-frame-options", "DENY"),
        ("referrer-policy", "no-referrer"),
        ("cross-origin-opener-policy", "same-origin"),
        ("cross-origin-resource-policy", "same-origin"),
        ("permissions-policy", "camera=(), geolocation=(), microphone=(), payment=(), usb=()"),
        ("content-security-policy", "default-src 'none'; frame-ancestors 'none'"),
    ] {
        // The page has a policy of its own.
        headers.entry(HeaderName::from_static(name)).or_insert(HeaderValue::from_static(value));
    }
}

fn shown_token(headers: &HeaderMap) -> Option<&str> {
    let (scheme, token) = headers.get(header::AUTHORIZATION)?.to_str().ok()?.split_once(' ')?;
    scheme.eq_ignore_ascii_case("bearer").then(|| token.trim())
}

/// Takes as long for a token that begins well as for any other.
fn is_same(shown: &str, token: &str) -> bool {
    let differing = shown.bytes().zip(token.bytes()).fold(0, |differing, (a, b)| differing | (a ^ b));
    shown.len() == token.len() && differing == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(token: Option<&str>, path: &str, authorization: Option<&str>, expected: bool) {
        let door = Door::new(token.map(str::to_string));
        let mut headers = HeaderMap::new();
        if let Some(value) = authorization {
            headers.insert(header::AUTHORIZATION, value.parse().expect("a header"));
        }
        assert_eq!(door.lets_in(path, &headers), expected, "{path} with {authorization:?}");
    }

    #[test]
    fn with_a_token_only_health_is_for_everybody() {
        check(None, "/api/devices", None, true);
        let token = Some("s3cret");
        check(token, "/health", None, true);
        for path in ["/", "/metrics", "/api/devices", "/api/events", "/health/", "/nothing"] {
            check(token, path, None, false);
            check(token, path, Some("Bearer s3cret"), true);
        }
        check(token, "/", Some("bearer s3cret"), true);
        for wrong in
            ["s3cret", "Bearer", "Bearer ", "Bearer s3cre", "Bearer s3crets", "Basic s3cret", "Bearer S3CRET"]
        {
            check(token, "/", Some(wrong), false);
        }
    }
}
