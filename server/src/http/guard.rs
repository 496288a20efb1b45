//! What stands before and after every handler: foreign pages are refused, answers begin in time, headers are safe.
//!
//! There is no authentication yet, so a page of any other origin that is open in the same browser must not be able to
//! use the server: neither by writing to it (the browser sends such requests even where it hides the answer), nor by
//! pointing its own name at this address (DNS rebinding).

use axum::extract::{Request, State};
use axum::http::header::{CONTENT_SECURITY_POLICY, HOST, ORIGIN, REFERRER_POLICY, UPGRADE, X_CONTENT_TYPE_OPTIONS};
use axum::http::{HeaderMap, HeaderValue, Method};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::App;
use super::problem::Refusal;
use crate::error::Error;

/// What an answer that brings no policy of its own may do in a browser: nothing.
const DATA_ONLY: &str = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox; frame-ancestors 'none'";

/// Refuses requests under a foreign host name, and writes from a foreign page.
pub(super) async fn own_origin_only(State(app): State<App>, request: Request, next: Next) -> Response {
    let headers = request.headers();
    let loopback_only = app.config.listen.ip().is_loopback();
    if let Err(error) = check_host(headers, request.uri().authority().map(|a| a.as_str()), loopback_only) {
        return error.into_response();
    }
    let reads = matches!(*request.method(), Method::GET | Method::HEAD | Method::OPTIONS);
    // A page of any origin may open a WebSocket: that is as good as a write.
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
fn check_host(headers: &HeaderMap, authority: Option<&str>, loopback_only: bool) -> Result<(), Error> {
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
fn check_origin(headers: &HeaderMap) -> Result<(), Error> {
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
    headers.insert(REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
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
