//! The doors: who asks, whether they may, how often, and the log of what they wrote.
//!
//! What a route needs is decided here, by its method and path, for every route there is or will be: what is not named
//! needs `admin`. The OpenAPI document says the same, from the same function.

use std::net::IpAddr;
use std::num::NonZeroU32;
use std::time::Duration;

use axum::extract::{Request, State};
use axum::http::header::{AUTHORIZATION, COOKIE};
use axum::http::{HeaderMap, Method};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use futures::StreamExt;
use governor::clock::{Clock, DefaultClock};
use governor::{DefaultKeyedRateLimiter, Quota, RateLimiter};

use super::App;
use super::connection::Peer;
use super::guard::{RequestId, check_origin};
use super::problem::Refusal;
use crate::auth::{Deed, Scope, Visitor};
use crate::error::{Error, Result};

/// The cookie of a browser's session.
pub(super) const COOKIE_NAME: &str = "stria_session";

/// Requests that one address may make without being let in, as a share of what a token may.
const STRANGERS_SHARE: u32 = 10;
/// Names that a limiter remembers before it forgets the idle ones.
const REMEMBERED: usize = 10_000;

/// How much of a refused request's body is taken, so that its sender reads the answer, bytes.
const HEARD_OUT_BYTES: usize = 16 * 1024 * 1024;
/// And for how long.
const HEARD_OUT_FOR: Duration = Duration::from_secs(10);

/// What a request needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Need {
    /// Nothing: the page's own files, health, logging in.
    Nothing,
    /// To be somebody.
    Somebody,
    /// This scope.
    Scope(Scope),
}

/// What a request needs, by its method and path (or the path's pattern).
pub(super) fn need_of(method: &Method, path: &str) -> Need {
    let Some(rest) = path.strip_prefix("/api") else {
        return if path == "/metrics" { Need::Scope(Scope::Read) } else { Need::Nothing };
    };
    let mut words = rest.split('/').filter(|w| !w.is_empty());
    let (room, more) = (words.next().unwrap_or_default(), words.next().is_some());
    let reads = matches!(*method, Method::GET | Method::HEAD | Method::OPTIONS);
    match (room, reads) {
        ("openapi.json" | "docs", true) => Need::Nothing,
        // What else there is no method for, nobody needs a token to hear.
        ("session", _) if !matches!(*method, Method::GET | Method::HEAD | Method::DELETE) => Need::Nothing,
        ("session", _) => Need::Somebody,
        // The list of streams is for those who look; what lies below is the robots'.
        ("live", true) if !more => Need::Scope(Scope::Read),
        ("uploads" | "live", _) => Need::Scope(Scope::Ingest),
        ("runs", false) if *method == Method::POST && !more => Need::Scope(Scope::Ingest),
        ("tokens" | "audit" | "retention", _) => Need::Scope(Scope::Admin),
        (_, true) => Need::Scope(Scope::Read),
        ("runs" | "jobs" | "batches" | "rigs" | "assets" | "defects", false) => Need::Scope(Scope::Operate),
        (_, false) => Need::Scope(Scope::Admin),
    }
}

/// How often everyone may come.
pub struct Rates {
    guests: DefaultKeyedRateLimiter<String>,
    strangers: DefaultKeyedRateLimiter<IpAddr>,
}

impl Rates {
    /// So many requests a second for each token or session.
    pub fn new(per_s: NonZeroU32, at_once: NonZeroU32) -> Rates {
        let share = |n: NonZeroU32| NonZeroU32::new(n.get() / STRANGERS_SHARE).unwrap_or(NonZeroU32::MIN);
        Rates {
            guests: RateLimiter::keyed(Quota::per_second(per_s).allow_burst(at_once)),
            strangers: RateLimiter::keyed(Quota::per_second(share(per_s)).allow_burst(share(at_once))),
        }
    }

    fn check_guest(&self, key: &str) -> std::result::Result<(), Refusal> {
        if self.guests.len() > REMEMBERED {
            self.guests.retain_recent();
        }
        self.guests
            .check_key(&key.to_string())
            .map_err(|not| too_many(not.wait_time_from(DefaultClock::default().now())))
    }

    fn check_stranger(&self, address: IpAddr) -> std::result::Result<(), Refusal> {
        if self.strangers.len() > REMEMBERED {
            self.strangers.retain_recent();
        }
        self.strangers.check_key(&address).map_err(|not| too_many(not.wait_time_from(DefaultClock::default().now())))
    }
}

fn too_many(wait: Duration) -> Refusal {
    Refusal::TooMany { retry_after_s: wait.as_secs() + 1 }
}

/// Lets a request in, or says why not; writes down what wrote.
pub(super) async fn guard(State(app): State<App>, mut request: Request, next: Next) -> Response {
    let (method, path) = (request.method().clone(), request.uri().path().to_string());
    let need = need_of(&method, &path);
    let address = address_of(&app, &request);
    let visitor = match admit(&app, &method, request.headers(), need, address).await {
        Ok(visitor) => visitor,
        Err(turned) => {
            // Whoever is still sending would take a closed connection for a broken one and never read the answer.
            tokio::spawn(tokio::time::timeout(HEARD_OUT_FOR, hear_out(request.into_body())));
            return match turned {
                Turned::Away(refusal) => refusal.into_response(),
                Turned::Failed(error) => error.into_response(),
            };
        }
    };
    let reads = matches!(method, Method::GET | Method::HEAD | Method::OPTIONS);
    let id = request.extensions().get::<RequestId>().map(|id| id.0.clone()).unwrap_or_default();
    let who = visitor.as_ref().map_or_else(|| "nobody".to_string(), |v| v.name.clone());
    if let Some(visitor) = visitor {
        request.extensions_mut().insert(visitor);
    }
    let response = next.run(request).await;
    if !reads && need != Need::Nothing {
        let status = response.status().as_u16();
        tracing::info!(target: "audit", who, %address, %method, path, status, "a write");
        let deed = Deed { who, address: address.to_string(), method: method.to_string(), path, status, request: id };
        if let Err(error) = app.auth.write_down(&deed).await {
            tracing::error!(%error, ?deed, "a write is not in the audit log");
        }
    }
    response
}

/// Takes what a refused sender still sends, up to a bound.
async fn hear_out(body: axum::body::Body) {
    let mut chunks = body.into_data_stream();
    let mut bytes = 0;
    while let Some(Ok(chunk)) = chunks.next().await {
        bytes += chunk.len();
        if bytes > HEARD_OUT_BYTES {
            return;
        }
    }
}

enum Turned {
    Away(Refusal),
    Failed(Error),
}

impl From<Error> for Turned {
    fn from(error: Error) -> Turned {
        Turned::Failed(error)
    }
}

impl From<Refusal> for Turned {
    fn from(refusal: Refusal) -> Turned {
        Turned::Away(refusal)
    }
}

/// Who asks, where the door is open to them.
async fn admit(
    app: &App,
    method: &Method,
    headers: &HeaderMap,
    need: Need,
    address: IpAddr,
) -> std::result::Result<Option<Visitor>, Turned> {
    if !app.config.doors.locked {
        return Ok(Some(Visitor::anyone()));
    }
    let (bearer, cookie) = (bearer_of(headers), cookie_of(headers));
    if need == Need::Nothing {
        // Only logging in touches the records; the page's files and health checks are free.
        if *method == Method::POST {
            app.rates.check_stranger(address)?;
        }
        return Ok(None);
    }
    let visitor = match (&bearer, &cookie) {
        (Some(token), _) => app.auth.by_token(token).await?,
        (None, Some(session)) => app.auth.by_session(session).await?,
        (None, None) => None,
    };
    let Some(visitor) = visitor else {
        app.rates.check_stranger(address)?;
        return Err(Refusal::Unknown { said: bearer.is_some() || cookie.is_some() }.into());
    };
    app.rates.check_guest(&visitor.key)?;
    if bearer.is_none() {
        check_cookie_use(method, headers)?;
    }
    match need {
        Need::Scope(scope) if !visitor.scopes.allow(scope) => Err(Refusal::Scope { needed: scope }.into()),
        _ => Ok(Some(visitor)),
    }
}

/// True where a browser that asks for the page is logged in, or need not be.
pub(super) async fn is_somebody(app: &App, headers: &HeaderMap) -> Result<bool> {
    if !app.config.doors.locked {
        return Ok(true);
    }
    match cookie_of(headers) {
        Some(secret) => Ok(app.auth.by_session(&secret).await?.is_some()),
        None => Ok(false),
    }
}

/// A browser sends the cookie along with whatever a foreign page makes it ask; a write must prove that it is ours.
fn check_cookie_use(method: &Method, headers: &HeaderMap) -> Result<()> {
    let upgrades = headers.contains_key("upgrade");
    let reads = matches!(*method, Method::GET | Method::HEAD | Method::OPTIONS) && !upgrades;
    if reads {
        return Ok(());
    }
    check_origin(headers)?;
    if headers.contains_key("sec-fetch-site") || headers.contains_key("origin") {
        return Ok(());
    }
    Err(Error::Foreign("a write with a browser's session must say where it comes from; programs use a token".into()))
}

/// `Authorization: Bearer …`.
pub(super) fn bearer_of(headers: &HeaderMap) -> Option<String> {
    let value = headers.get(AUTHORIZATION)?.to_str().ok()?;
    let (kind, token) = value.split_once(' ')?;
    kind.eq_ignore_ascii_case("bearer").then(|| token.trim().to_string())
}

/// The session's secret.
pub(super) fn cookie_of(headers: &HeaderMap) -> Option<String> {
    let all = headers.get_all(COOKIE).iter().filter_map(|v| v.to_str().ok()).flat_map(|v| v.split(';'));
    let mut ours = all.filter_map(|pair| pair.trim().split_once('=')).filter(|(name, _)| *name == COOKIE_NAME);
    ours.next().map(|(_, value)| value.to_string())
}

/// Where a request comes from: the peer, or what a trusted proxy says of it.
fn address_of(app: &App, request: &Request) -> IpAddr {
    let unknown = IpAddr::from([0, 0, 0, 0]);
    let peer = request.extensions().get::<Peer>().map_or(unknown, |peer| peer.0.ip());
    let trusted = &app.config.doors.trusted_proxies;
    if !trusted.contains(&peer) {
        return peer;
    }
    let said = request.headers().get_all("x-forwarded-for").iter().filter_map(|v| v.to_str().ok());
    let hops: Vec<IpAddr> = said.flat_map(|v| v.split(',')).filter_map(|a| a.trim().parse().ok()).collect();
    hops.into_iter().rev().find(|hop| !trusted.contains(hop)).unwrap_or(peer)
}

/// True where the browser speaks TLS, to us or to a trusted proxy.
pub(super) fn is_secure(app: &App, headers: &HeaderMap, peer: Option<&Peer>) -> bool {
    let by_proxy = peer.is_some_and(|p| app.config.doors.trusted_proxies.contains(&p.0.ip()));
    let said = headers.get("x-forwarded-proto").is_some_and(|v| v.as_bytes().eq_ignore_ascii_case(b"https"));
    app.config.doors.tls.is_some() || (by_proxy && said)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn routes_that_nobody_thought_of_need_admin_to_write() {
        let need = |method: Method, path: &str| need_of(&method, path);
        assert_eq!(need(Method::GET, "/api/new"), Need::Scope(Scope::Read));
        assert_eq!(need(Method::POST, "/api/new"), Need::Scope(Scope::Admin));
        assert_eq!(need(Method::POST, "/api/runs"), Need::Scope(Scope::Ingest));
        assert_eq!(need(Method::POST, "/api/runs/"), Need::Scope(Scope::Ingest));
        assert_eq!(need(Method::POST, "/api/runs/x/jobs"), Need::Scope(Scope::Operate));
        assert_eq!(need(Method::DELETE, "/api/runs/x"), Need::Scope(Scope::Operate));
        assert_eq!(need(Method::HEAD, "/api/uploads/x"), Need::Scope(Scope::Ingest));
        assert_eq!(need(Method::GET, "/api/tokens"), Need::Scope(Scope::Admin));
        assert_eq!(need(Method::GET, "/runs/x"), Need::Nothing);
        assert_eq!(need(Method::GET, "/metrics"), Need::Scope(Scope::Read));
        assert_eq!(need(Method::POST, "/api"), Need::Scope(Scope::Admin));
    }

    #[test]
    fn secrets_are_found_in_their_headers() {
        let headers: HeaderMap = [
            (AUTHORIZATION, "bearer stria_x".parse().expect("value")),
            (COOKIE, "a=b; stria_session=s-1; c=d".parse().expect("value")),
        ]
        .into_iter()
        .collect();
        assert_eq!(bearer_of(&headers).as_deref(), Some("stria_x"));
        assert_eq!(cookie_of(&headers).as_deref(), Some("s-1"));
        let headers: HeaderMap = [(AUTHORIZATION, "Basic eA==".parse().expect("value"))].into_iter().collect();
        assert!(bearer_of(&headers).is_none() && cookie_of(&headers).is_none());
    }
}
