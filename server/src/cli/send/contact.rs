//! The way to a server: its address, the token, the cap on the bandwidth, time-outs.

use std::num::NonZeroU32;
use std::path::Path;
use std::time::Duration;

use governor::{DefaultDirectRateLimiter, Quota, RateLimiter};
use reqwest::header::{AUTHORIZATION, HeaderMap, HeaderValue};
use reqwest::{Client, Method, RequestBuilder, Response, Url};

use super::super::{Failed, bearer};
use super::trouble::{Trouble, trouble_of};

/// Longest time to reach the server.
const CONNECT: Duration = Duration::from_secs(20);
/// Longest time for a small answer.
pub(super) const ANSWER: Duration = Duration::from_secs(60);
/// Connections that are not used are not kept longer: a robot's address changes as it walks.
const IDLE: Duration = Duration::from_secs(20);
/// Bytes of a chunk where no cap says less.
const CHUNK_BYTES: usize = 256 * 1024;
/// With a cap, chunks a second: what is sent at once, and how smoothly.
const CHUNKS_PER_S: u32 = 8;

/// A server and how to speak to it.
pub(super) struct Contact {
    server: Url,
    http: Client,
    token: Option<HeaderValue>,
    limit: Option<Limit>,
    /// A connection on which nothing moves for this long is dead.
    pub(super) stall: Duration,
}

struct Limit {
    gate: DefaultDirectRateLimiter,
    chunk_bytes: NonZeroU32,
}

impl Contact {
    pub(super) fn new(
        server: &Url,
        token_file: Option<&Path>,
        limit_kbit_s: Option<u32>,
        stall: Duration,
    ) -> Result<Contact, Failed> {
        if !matches!(server.scheme(), "http" | "https") || server.host().is_none() {
            return Err(Failed::Input(format!("--server {server}: expected http://HOST:PORT or https://HOST")));
        }
        let token = authorization(token_file)?;
        // Two libraries bring their own cryptography; the WebSocket's must be told which. A second word changes nothing.
        let _ = tokio_rustls::rustls::crypto::aws_lc_rs::default_provider().install_default();
        let mut headers = HeaderMap::new();
        headers.extend(token.clone().map(|token| (AUTHORIZATION, token)));
        let http = Client::builder()
            .default_headers(headers)
            .connect_timeout(CONNECT)
            .pool_idle_timeout(IDLE)
            // The network's own word that nothing arrives any more; it comes sooner than any guess of ours.
            .tcp_user_timeout(stall)
            .tcp_keepalive(stall / 4)
            // The token goes to the server that was named, and nowhere else.
            .redirect(reqwest::redirect::Policy::none())
            .user_agent(concat!("stria/", env!("CARGO_PKG_VERSION")))
            .build()
            .map_err(|e| Failed::Other(format!("the HTTP client did not start: {e}")))?;
        Ok(Contact { server: server.clone(), http, token, limit: limit_kbit_s.and_then(Limit::new), stall })
    }

    /// The server's address, for messages and names.
    pub(super) fn server(&self) -> &Url {
        &self.server
    }

    /// What a person should know before anything is sent.
    pub(super) fn warning(&self) -> Option<String> {
        let host = self.server.host_str().unwrap_or_default();
        let own = host == "localhost"
            || host.trim_matches(['[', ']']).parse::<std::net::IpAddr>().is_ok_and(|ip| ip.is_loopback());
        (self.token.is_some() && self.server.scheme() == "http" && !own)
            .then(|| format!("the token goes to {} without encryption; https:// would hide it", self.server))
    }

    /// The address of a path.
    pub(super) fn url(&self, path: &str) -> Url {
        let mut url = self.server.clone();
        url.set_path(path);
        url.set_query(None);
        url
    }

    /// Where people look at a run.
    pub(super) fn page(&self, run: &str) -> Url {
        self.url(&format!("/runs/{run}"))
    }

    /// An address that the server gave, which must be its own.
    pub(super) fn own_url(&self, given: &str) -> Result<Url, Trouble> {
        match self.server.join(given) {
            Ok(url) if url.host() == self.server.host() => Ok(self.url(url.path())),
            _ => {
                let words =
                    format!("the server sends the upload elsewhere ({given:?}); expected an address of its own");
                Err(Trouble::Refused { field: None, words })
            }
        }
    }

    /// The address of a WebSocket and what its request carries.
    pub(super) fn websocket(&self, path: &str) -> (Url, Option<HeaderValue>) {
        let mut url = self.url(path);
        // Both pairs of schemes are of the same kind, so that this cannot fail.
        let _ = url.set_scheme(if self.server.scheme() == "https" { "wss" } else { "ws" });
        (url, self.token.clone())
    }

    /// A request with the token.
    pub(super) fn request(&self, method: Method, url: Url) -> RequestBuilder {
        self.http.request(method, url)
    }

    /// The answer to a small request, where it is a success.
    pub(super) async fn ask(&self, request: RequestBuilder) -> Result<Response, Trouble> {
        let response = request.timeout(ANSWER).send().await?;
        if response.status().is_success() { Ok(response) } else { Err(trouble_of(response).await) }
    }

    /// Bytes to send at once.
    pub(super) fn chunk_bytes(&self) -> usize {
        self.limit.as_ref().map_or(CHUNK_BYTES, |limit| limit.chunk_bytes.get() as usize)
    }

    /// Waits until so many bytes may go out.
    pub(super) async fn may_send(&self, bytes: usize) {
        let Some(limit) = &self.limit else { return };
        let mut left = u32::try_from(bytes).unwrap_or(u32::MAX);
        while let Some(piece) = NonZeroU32::new(left.min(limit.chunk_bytes.get())) {
            // A piece is never larger than what the gate lets through at once.
            let _ = limit.gate.until_n_ready(piece).await;
            left -= piece.get();
        }
    }
}

impl Limit {
    fn new(kbit_s: u32) -> Option<Limit> {
        let bytes_s = NonZeroU32::new(kbit_s.saturating_mul(125))?;
        let chunk_bytes = NonZeroU32::new((bytes_s.get() / CHUNKS_PER_S).clamp(1, CHUNK_BYTES as u32))?;
        let gate = RateLimiter::direct(Quota::per_second(bytes_s).allow_burst(chunk_bytes));
        Some(Limit { gate, chunk_bytes })
    }
}

/// The header that brings the token.
fn authorization(file: Option<&Path>) -> Result<Option<HeaderValue>, Failed> {
    let Some(token) = bearer::token(file)? else { return Ok(None) };
    let mut value = HeaderValue::from_str(&format!("Bearer {token}"))
        .map_err(|_| Failed::Input("the token has characters that no token has".into()))?;
    value.set_sensitive(true);
    Ok(Some(value))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn contact(server: &str, limit: Option<u32>) -> Contact {
        Contact::new(&server.parse().expect("an address"), None, limit, ANSWER).ok().expect("a contact")
    }

    #[test]
    fn addresses_are_the_servers_own() {
        let contact = contact("https://stria.example:8443", None);
        assert_eq!(contact.page("r1").as_str(), "https://stria.example:8443/runs/r1");
        assert_eq!(contact.websocket("/api/live/a").0.as_str(), "wss://stria.example:8443/api/live/a");
        // A proxy that ends the encryption may let the server think that it speaks http.
        for given in
            ["/api/uploads/u", "https://stria.example:8443/api/uploads/u", "http://stria.example/api/uploads/u"]
        {
            let own = contact.own_url(given).expect("its own");
            assert_eq!(own.as_str(), "https://stria.example:8443/api/uploads/u");
        }
        assert!(matches!(contact.own_url("https://evil.example/u"), Err(Trouble::Refused { .. })));
    }

    #[tokio::test]
    async fn the_cap_holds() {
        let contact = contact("http://127.0.0.1:1", Some(800));
        assert_eq!(contact.chunk_bytes(), 12_500);
        let begun = std::time::Instant::now();
        contact.may_send(62_500).await;
        // 100 kB/s: an eighth of a second's worth is free, the rest takes its time.
        assert!(begun.elapsed() >= Duration::from_millis(490), "{:?}", begun.elapsed());
    }
}
