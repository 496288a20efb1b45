//! Logging in and out with a browser: by a one-time address, or by a token.

use axum::extract::{Extension, State};
use axum::http::header::{CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, LOCATION, REFERRER_POLICY, SET_COOKIE};
use axum::http::{HeaderMap, HeaderValue, StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;

use super::App;
use super::connection::Peer;
use super::docs::escaped;
use super::doors::{COOKIE_NAME, cookie_of, is_secure};
use super::extract::{Json, Query};
use super::problem::Refusal;
use crate::auth::{SESSION_TIME, Visitor};
use crate::error::Result;
use crate::wire::time::to_text;
use crate::wire::{LogIn, Problem, Session};

/// What the log-in page may do: send its form back here.
const PAGE_POLICY: &str =
    "default-src 'none'; style-src 'unsafe-inline'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'";

/// Who asks, and what they may do.
#[utoipa::path(get, path = "/api/session", tag = "doors", responses((status = 200, body = Session)))]
pub(super) async fn get_session(State(app): State<App>, Extension(visitor): Extension<Visitor>) -> Response {
    axum::Json(session_of(&app, &visitor)).into_response()
}

/// Logs a browser in by a token or by the code of a login address; the answer sets the session's cookie.
#[utoipa::path(post, path = "/api/session", tag = "doors", request_body = LogIn,
    responses((status = 200, body = Session), (status = 400, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn create_session(
    State(app): State<App>,
    peer: Option<Extension<Peer>>,
    headers: HeaderMap,
    Json(asked): Json<LogIn>,
) -> Result<Response> {
    match app.auth.log_in(asked.secret.trim()).await? {
        Some((secret, visitor)) => {
            let cookie = cookie(&app, &headers, peer.as_deref(), &secret);
            Ok((cookie, axum::Json(session_of(&app, &visitor))).into_response())
        }
        None => Ok(Refusal::Unknown { said: true }.into_response()),
    }
}

/// Logs this browser out.
#[utoipa::path(delete, path = "/api/session", tag = "doors", responses((status = 204, description = "Logged out")))]
pub(super) async fn delete_session(State(app): State<App>, headers: HeaderMap) -> Result<Response> {
    if let Some(secret) = cookie_of(&headers) {
        app.auth.log_out(&secret).await?;
    }
    let gone = format!("{COOKIE_NAME}=; Path=/; HttpOnly; SameSite=Lax; Max-Age=0");
    Ok((StatusCode::NO_CONTENT, [(SET_COOKIE, gone)]).into_response())
}

/// To the log-in page, and from there to where the browser wanted to go.
pub(super) fn ask_to_log_in(wanted: &Uri) -> Response {
    let next = wanted.path_and_query().map_or("/", |p| p.as_str());
    let coded: String = next
        .bytes()
        .map(|b| match b {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'/' | b'-' | b'_' | b'.' => char::from(b).to_string(),
            _ => format!("%{b:02X}"),
        })
        .collect();
    (StatusCode::SEE_OTHER, [(LOCATION, format!("/login?next={coded}")), (CACHE_CONTROL, "no-store".into())])
        .into_response()
}

/// What the page's form sends.
#[derive(Deserialize)]
pub(super) struct LoginForm {
    secret: String,
    #[serde(default)]
    next: String,
}

#[derive(Deserialize)]
pub(super) struct LoginQuery {
    code: Option<String>,
    next: Option<String>,
}

/// `GET /login`: with a code it logs in and goes on; without one it asks for a token.
pub(super) async fn get_login(
    State(app): State<App>,
    peer: Option<Extension<Peer>>,
    headers: HeaderMap,
    Query(query): Query<LoginQuery>,
) -> Result<Response> {
    let next = query.next.as_deref();
    let Some(code) = query.code else { return Ok(page(StatusCode::OK, "", next)) };
    match app.auth.log_in(code.trim()).await? {
        Some((secret, _)) => Ok(go_on(cookie(&app, &headers, peer.as_deref(), &secret), next)),
        None => {
            let words = "This login address was used already, or its time is over. <code>stria token login</code> on \
                         the server prints a new one.";
            Ok(page(StatusCode::UNAUTHORIZED, words, next))
        }
    }
}

/// `POST /login`: the form of the page.
pub(super) async fn post_login(
    State(app): State<App>,
    peer: Option<Extension<Peer>>,
    headers: HeaderMap,
    axum::extract::Form(form): axum::extract::Form<LoginForm>,
) -> Result<Response> {
    match app.auth.log_in(form.secret.trim()).await? {
        Some((secret, _)) => Ok(go_on(cookie(&app, &headers, peer.as_deref(), &secret), Some(&form.next))),
        None => {
            let words = "This token opens nothing: it is wrong, revoked or over.";
            Ok(page(StatusCode::UNAUTHORIZED, words, Some(&form.next)))
        }
    }
}

fn session_of(app: &App, visitor: &Visitor) -> Session {
    Session {
        name: visitor.name.clone(),
        scopes: visitor.scopes.list(),
        expires_at: visitor.expires_ms.map(to_text),
        locked: app.config.doors.locked,
    }
}

/// No script reads it. A browser sends it along when someone follows a link to here, and with nothing else that a foreign
/// page makes it ask; writes prove where they come from all the same.
fn cookie(app: &App, headers: &HeaderMap, peer: Option<&Peer>, secret: &str) -> [(axum::http::HeaderName, String); 2] {
    let seconds = SESSION_TIME.as_secs();
    let secure = if is_secure(app, headers, peer) { "; Secure" } else { "" };
    let cookie = format!("{COOKIE_NAME}={secret}; Path=/; HttpOnly; SameSite=Lax; Max-Age={seconds}{secure}");
    [(SET_COOKIE, cookie), (CACHE_CONTROL, "no-store".into())]
}

/// To an address of this server, and no other.
fn go_on(cookie: [(axum::http::HeaderName, String); 2], next: Option<&str>) -> Response {
    let own = |n: &&str| n.starts_with('/') && !n[1..].starts_with(['/', '\\']) && !n.contains(char::is_control);
    let next = next.filter(own).and_then(|n| HeaderValue::from_str(n).ok()).unwrap_or(HeaderValue::from_static("/"));
    let mut response = (StatusCode::SEE_OTHER, cookie).into_response();
    response.headers_mut().insert(LOCATION, next);
    response
}

fn page(status: StatusCode, words: &str, next: Option<&str>) -> Response {
    let next = escaped(next.unwrap_or_default());
    let body = format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>Stria: log in</title>\
         <meta name=\"viewport\" content=\"width=device-width\">\
         <style>body{{font:16px/1.5 system-ui,sans-serif;max-width:32rem;margin:15vh auto;padding:0 1rem}}\
         input{{font:inherit;width:100%;padding:.4rem;margin:.3rem 0;box-sizing:border-box}}\
         button{{font:inherit;padding:.4rem 1rem}}</style>\
         <h1>Stria</h1><p role=\"alert\">{words}</p>\
         <form method=\"post\" action=\"/login\"><label>Token<input type=\"password\" name=\"secret\" autofocus \
         autocomplete=\"current-password\" required></label>\
         <input type=\"hidden\" name=\"next\" value=\"{next}\"><button>Log in</button></form>\
         <p>A token comes from whoever runs this server: <code>stria token create NAME --scopes read</code>.</p>"
    );
    let headers = [
        // Without a referrer a browser would send the form from an origin called null, which is refused.
        (REFERRER_POLICY, "same-origin"),
        (CONTENT_TYPE, "text/html; charset=utf-8"),
        (CACHE_CONTROL, "no-store"),
        (CONTENT_SECURITY_POLICY, PAGE_POLICY),
    ];
    (status, headers, body).into_response()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nobody_is_sent_to_another_server() {
        let to = |next: Option<&str>| {
            let response = go_on([(SET_COOKIE, "x".into()), (CACHE_CONTROL, "no-store".into())], next);
            response.headers()[LOCATION].to_str().expect("text").to_string()
        };
        assert_eq!(to(Some("/runs/1?x=2")), "/runs/1?x=2");
        for bad in ["https://evil.example", "//evil.example", "/\\evil.example", "", "runs", "/a\nb"] {
            assert_eq!(to(Some(bad)), "/", "{bad}");
        }
    }
}
