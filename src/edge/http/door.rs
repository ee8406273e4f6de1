//! What every answer has in common: who may have it, and what a browser may do with it.

use std::net::{IpAddr, Ipv6Addr};
use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, Uri, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::page;

/// Whom to let in.
pub struct Door {
    token: Option<String>,
    /// Where only this machine is to read: the name under which it is asked, beside its addresses. A page
    /// from anywhere can make a browser on this machine ask, under a name of the page's own that leads
    /// here (DNS rebinding); nobody else has a reason to use another name.
    own_name: Option<String>,
}

impl Door {
    /// Without a token everybody is let in who can come; with `own_name` under this name or an address.
    pub fn new(token: Option<String>, own_name: Option<String>) -> Door {
        Door { own_name: own_name.filter(|_| token.is_none()), token }
    }

    /// Whether the question is meant for us, by the name that it was sent to.
    fn is_meant(&self, uri: &Uri, headers: &HeaderMap) -> bool {
        let Some(own_name) = &self.own_name else { return true };
        let named = match uri.authority() {
            Some(authority) => Some(authority.as_str()),
            None => match headers.get(header::HOST) {
                Some(host) => host.to_str().ok(),
                // Before HTTP/1.1, and no browser.
                None => return true,
            },
        };
        named.is_some_and(|named| is_address_or(named, own_name))
    }

    fn lets_in(&self, path: &str, headers: &HeaderMap) -> bool {
        let Some(token) = &self.token else { return true };
        // What restarts a container that is not well has no secrets.
        path == "/health" || shown_token(headers).is_some_and(|shown| is_same(shown, token))
    }
}

/// Around every request.
pub async fn pass(State(door): State<Arc<Door>>, request: Request, next: Next) -> Response {
    let mut response = if !door.is_meant(request.uri(), request.headers()) {
        (StatusCode::MISDIRECTED_REQUEST, NOT_MEANT).into_response()
    } else if door.lets_in(request.uri().path(), request.headers()) {
        next.run(request).await
    } else {
        refuse(request.uri().path()).await
    };
    guard(response.headers_mut());
    response
}

const NOT_MEANT: &str = "\
this gateway listens on this machine only, and answers to its addresses and to `localhost`, not to another \
name; where a proxy or other machines read, configure a token (`http: {token_file: …}`)
";

/// Whether `host`, which may have a port, is `localhost`, `own_name` or an address.
fn is_address_or(host: &str, own_name: &str) -> bool {
    if let Some((inside, _)) = host.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        return inside.parse::<Ipv6Addr>().is_ok();
    }
    let name = host.split(':').next().unwrap_or_default();
    let name = name.strip_suffix('.').unwrap_or(name);
    let is_named = |own: &str| name.eq_ignore_ascii_case(own);
    is_named("localhost") || is_named(own_name) || name.parse::<IpAddr>().is_ok()
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
        let door = Door::new(token.map(str::to_string), None);
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

    #[track_caller]
    fn check_meant(door: &Door, uri: &str, host: Option<&str>, expected: bool) {
        let mut headers = HeaderMap::new();
        if let Some(host) = host {
            headers.insert(header::HOST, host.parse().expect("a header"));
        }
        let uri: Uri = uri.parse().expect("a URI");
        assert_eq!(door.is_meant(&uri, &headers), expected, "{uri} at {host:?}");
    }

    #[test]
    fn on_this_machine_only_its_own_names_are_answered() {
        let local = Door::new(None, Some("gateway.lan".into()));
        for own in [
            "localhost",
            "localhost:8485",
            "LOCALHOST.:8485",
            "127.0.0.1:8485",
            "127.8.8.8",
            "[::1]",
            "[::1]:8485",
            "gateway.lan:8485",
            "Gateway.LAN",
        ] {
            check_meant(&local, "/api/devices", Some(own), true);
            check_meant(&local, &format!("http://{own}/api/devices"), Some("evil.example"), true);
        }
        for foreign in [
            "evil.example",
            "evil.example:8485",
            "localhost.evil.example",
            "127.0.0.1.evil.example",
            "xgateway.lan",
            "[evil.example]",
            "[127.0.0.1",
            "",
        ] {
            check_meant(&local, "/health", Some(foreign), false);
        }
        check_meant(&local, "http://evil.example/api/devices", Some("localhost"), false);
        check_meant(&local, "/health", None, true);
        // A stranger's page does not know the token, and where others read they have names of their own.
        check_meant(
            &Door::new(Some("s3cret".into()), Some("localhost".into())),
            "/",
            Some("gateway.lan"),
            true,
        );
        check_meant(&Door::new(None, None), "/", Some("gateway.lan"), true);
    }
}
