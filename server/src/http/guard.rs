//! What stands before and after every handler: foreign pages are refused, answers begin in time, headers are safe.
//!
//! A page of any other origin that is open in the same browser must not be able to use the server: neither by writing
//! to it (the browser sends such requests even where it hides the answer), nor by pointing its own name at this address
//! (DNS rebinding).

use axum::extract::{Request, State};
use axum::http::header::{CONTENT_SECURITY_POLICY, HOST, ORIGIN, REFERRER_POLICY, UPGRADE, X_CONTENT_TYPE_OPTIONS};
use axum::http::{HeaderMap, HeaderValue, Method};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use tracing::Instrument;

use super::App;
use super::problem::Refusal;
use crate::error::Error;
use crate::metrics::{Answer, metrics};
use crate::queue::Queue;

/// What an answer that brings no policy of its own may do in a browser: nothing.
const DATA_ONLY: &str = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox; frame-ancestors 'none'";

/// Refuses requests under a foreign host name, and writes from a foreign page.
pub(super) async fn own_origin_only(State(app): State<App>, request: Request, next: Next) -> Response {
    let headers = request.headers();
    // A proxy on this machine asks under the name that the world knows.
    let loopback_only = app.config.listen.ip().is_loopback() && app.config.doors.trusted_proxies.is_empty();
    if let Err(error) = check_host(headers, request.uri().authority().map(|a| a.as_str()), loopback_only) {
        return error.into_response();
    }
    // A WebSocket is opened by a GET, and no browser hides it from a foreign page.
    let reads = matches!(*request.method(), Method::GET | Method::HEAD | Method::OPTIONS);
    let upgrades = headers.contains_key(UPGRADE);
    if (!reads || upgrades)
        && let Err(error) = check_origin(headers)
    {
        return error.into_response();
    }
    next.run(request).await
}

fn text(headers: &HeaderMap, name: impl axum::http::header::AsHeaderName) -> Option<&str> {
    headers.get(name).and_then(|v| v.to_str().ok())
}

/// A server that listens on the loopback only is asked under a name of the loopback only.
pub(super) fn check_host(headers: &HeaderMap, authority: Option<&str>, loopback_only: bool) -> Result<(), Error> {
    let Some(host) = text(headers, HOST).or(authority) else {
        return Err(Error::Foreign("the request names no host".into()));
    };
    if !loopback_only || is_loopback_name(host) {
        return Ok(());
    }
    Err(Error::Foreign(format!("this server listens on the loopback only and is not called {host:?}")))
}

fn is_loopback_name(host: &str) -> bool {
    let without_port = match host.strip_prefix('[') {
        Some(rest) => rest.split(']').next().unwrap_or_default(),
        None => host.split(':').next().unwrap_or_default(),
    };
    without_port.eq_ignore_ascii_case("localhost")
        || without_port.parse::<std::net::IpAddr>().is_ok_and(|ip| ip.is_loopback())
}

/// Browsers say where a write comes from; programs say nothing and may go on.
pub(super) fn check_origin(headers: &HeaderMap) -> Result<(), Error> {
    if let Some(site) = text(headers, "sec-fetch-site")
        && !matches!(site, "same-origin" | "none")
    {
        return Err(Error::Foreign(format!("a write from a page of another site ({site}) is refused")));
    }
    let Some(origin) = headers.get(ORIGIN) else { return Ok(()) };
    let origin = origin.to_str().unwrap_or_default();
    let own = origin.split_once("://").map(|(_, authority)| authority) == text(headers, HOST);
    if own { Ok(()) } else { Err(Error::Foreign(format!("a write from a page of {origin:?} is refused"))) }
}

/// The name of a request in logs and answers.
#[derive(Clone)]
pub(super) struct RequestId(pub(super) String);

/// Gives every request a name, or keeps the one it came with, and puts all that is logged on the way under it.
pub(super) async fn named(mut request: Request, next: Next) -> Response {
    let plain = |id: &&str| (1..=64).contains(&id.len()) && id.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-');
    let id = text(request.headers(), "x-request-id").filter(plain).map_or_else(Queue::new_id, Into::into);
    request.extensions_mut().insert(RequestId(id.clone()));
    let span = tracing::info_span!("request", id, method = %request.method(), path = request.uri().path());
    // Methods that nobody knows are one, or their number would grow without bound.
    let known = ["GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"];
    let method = known.into_iter().find(|m| *m == request.method().as_str()).unwrap_or("other").to_string();
    let begun = std::time::Instant::now();
    let mut response = next.run(request).instrument(span.clone()).await;
    let (status, ms) = (response.status().as_u16(), begun.elapsed().as_millis() as u64);
    metrics().answers.get_or_create(&Answer { method, status }).inc();
    span.in_scope(|| tracing::debug!(status, ms, "answered"));
    if let Ok(value) = HeaderValue::from_str(&id) {
        response.headers_mut().insert("x-request-id", value);
    }
    response
}

/// Anything but an upload begins to answer within its time.
pub(super) async fn answer_in_time(State(app): State<App>, request: Request, next: Next) -> Response {
    let path = request.uri().path();
    let sends = matches!(*request.method(), Method::POST | Method::PATCH);
    let upload = sends && (path == "/api/runs" || path.starts_with("/api/uploads") || path.starts_with("/api/live/"));
    if upload {
        return next.run(request).await;
    }
    match tokio::time::timeout(app.config.requests.answer_timeout, next.run(request)).await {
        Ok(response) => response,
        Err(_) => Refusal::TooSlow.into_response(),
    }
}

/// Headers of every answer. What is sent back is data that someone sent in: it never runs as part of this origin.
pub(super) async fn safe_headers(mut response: Response) -> Response {
    let headers = response.headers_mut();
    headers.entry(CONTENT_SECURITY_POLICY).or_insert(HeaderValue::from_static(DATA_ONLY));
    headers.insert(X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.entry(REFERRER_POLICY).or_insert(HeaderValue::from_static("no-referrer"));
    headers.insert("cross-origin-resource-policy", HeaderValue::from_static("same-origin"));
    response
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(pairs: &[(&'static str, &str)]) -> HeaderMap {
        pairs.iter().map(|(n, v)| (n.parse().expect("name"), v.parse().expect("value"))).collect()
    }

    #[test]
    fn only_the_loopbacks_names_are_its_own() {
        for host in ["localhost", "localhost:8420", "LOCALHOST:1", "127.0.0.1:8420", "127.8.0.1", "[::1]:8420"] {
            assert!(check_host(&headers(&[("host", host)]), None, true).is_ok(), "{host}");
        }
        for host in
            ["evil.example", "localhost.evil.example", "127.0.0.1.evil.example:80", "192.168.1.2", "[::2]:1", ""]
        {
            assert!(check_host(&headers(&[("host", host)]), None, true).is_err(), "{host}");
        }
        assert!(check_host(&headers(&[("host", "robots.example")]), None, false).is_ok());
        assert!(check_host(&headers(&[]), None, false).is_err());
    }

    #[test]
    fn writes_come_from_the_own_page_or_from_a_program() {
        let host = ("host", "localhost:8420");
        for more in [vec![], vec![("origin", "http://localhost:8420")], vec![("sec-fetch-site", "same-origin")]] {
            assert!(check_origin(&headers(&[vec![host], more].concat())).is_ok());
        }
        for more in [
            ("origin", "https://evil.example"),
            ("origin", "null"),
            ("origin", "http://localhost:9"),
            ("sec-fetch-site", "cross-site"),
            ("sec-fetch-site", "same-site"),
        ] {
            assert!(check_origin(&headers(&[host, more])).is_err(), "{more:?}");
        }
    }
}
