//! The page, built into the binary, and the rerun viewer: no other host is ever asked for anything.

use std::collections::HashMap;
use std::io::Write;
use std::sync::{Arc, LazyLock, OnceLock};

use axum::Router;
use axum::extract::{Path, State};
use axum::http::header::{
    ACCEPT_ENCODING, CACHE_CONTROL, CONTENT_ENCODING, CONTENT_SECURITY_POLICY, CONTENT_TYPE, ETAG, VARY,
};
use axum::http::{HeaderMap, HeaderValue, StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use bytes::Bytes;
use re_web_viewer_server::WebViewerData;
use rust_embed::RustEmbed;
use sha2::{Digest, Sha256};

use super::files::{IMMUTABLE, REVALIDATE, none_matches};
use super::{App, doors, session};
use crate::error::{Error, Result};
use crate::store::hex;

/// What `web/` was built to.
#[derive(RustEmbed)]
#[folder = "../web/dist"]
struct Page;

/// The viewer's version is part of its addresses, which therefore never change their content.
const VIEWER_VERSION: &str = "0.36.3";

/// What the page may do: ask this server, run its own scripts and the viewer's wasm, and nothing else.
const PAGE_POLICY: &str = "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; connect-src 'self'; \
    img-src 'self' blob: data:; style-src 'self'; worker-src 'self' blob:; frame-ancestors 'none'; \
    base-uri 'none'; form-action 'self'";

/// The page answers every address that is not the API's, because it has addresses of its own for runs and jobs.
pub(super) fn routes() -> Router<App> {
    Router::new().route("/viewer/{*path}", get(get_viewer)).fallback(get_page)
}

async fn get_page(State(app): State<App>, uri: Uri, headers: HeaderMap) -> Result<Response> {
    let path = uri.path().trim_start_matches('/');
    // The squeezed forms have no address of their own.
    let exact = Page::get(path).filter(|_| !path.ends_with(".br")).map(|file| (path, file));
    // A missing file is missing; a missing address without an extension is the page's own business.
    let is_address = !path.rsplit('/').next().unwrap_or_default().contains('.');
    let index = || is_address.then(|| Page::get("index.html").map(|file| ("index.html", file))).flatten();
    let Some((name, file)) = exact.or_else(index) else {
        return Err(Error::NotFound { what: "address", id: uri.path().into() });
    };
    if name == "index.html" && !doors::is_somebody(&app, &headers).await? {
        return Ok(session::ask_to_log_in(&uri));
    }
    // The page's build puts a hash of the content into the names below assets/.
    let cache = if name.starts_with("assets/") { IMMUTABLE } else { REVALIDATE };
    let name = name.to_string();
    let asset = shared(&name, || Asset::new(&name, Bytes::from(file.data.into_owned()), brotli_of(&name)));
    asset.send(&headers, cache).await
}

async fn get_viewer(Path(path): Path<String>, headers: HeaderMap) -> Result<Response> {
    let missing = || Error::NotFound { what: "address", id: format!("/viewer/{path}") };
    let (version, name) = path.split_once('/').unwrap_or(("", &path));
    let cache = match version {
        VIEWER_VERSION => IMMUTABLE,
        "" => REVALIDATE,
        _ => return Err(missing()),
    };
    let data = VIEWER.as_ref().map_err(|e| Error::Internal(format!("the viewer is not in this binary: {e}")))?;
    let bytes = match name {
        "re_viewer.js" => data.viewer_js(),
        "re_viewer_bg.wasm" => data.viewer_wasm(),
        _ => return Err(missing()),
    };
    let path = format!("viewer/{VIEWER_VERSION}/{name}");
    shared(&path, || Asset::new(name, Bytes::from_static(bytes), brotli_of(&path))).send(&headers, cache).await
}

/// A file's brotli form, which the page's build makes: small, and slow to make.
fn brotli_of(name: &str) -> Option<Bytes> {
    Page::get(&format!("{name}.br")).map(|file| Bytes::from(file.data.into_owned()))
}

static VIEWER: LazyLock<std::result::Result<WebViewerData, String>> =
    LazyLock::new(|| WebViewerData::load(None).map_err(|e| e.to_string()));

/// Assets by name, made once.
fn shared(name: &str, make: impl FnOnce() -> Asset) -> Arc<Asset> {
    static ASSETS: LazyLock<std::sync::Mutex<HashMap<String, Arc<Asset>>>> = LazyLock::new(Default::default);
    let mut assets = ASSETS.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    assets.entry(name.into()).or_insert_with(|| Arc::new(make())).clone()
}

/// A file in the binary. Its hash and its compressed form are made when they are first asked for, off the async
/// threads: the viewer's wasm is 40 MB.
struct Asset {
    content_type: &'static str,
    bytes: Bytes,
    brotli: Option<Bytes>,
    made: OnceLock<Made>,
}

struct Made {
    etag: String,
    /// Where it is smaller.
    gzip: Option<Bytes>,
}

impl Asset {
    fn new(name: &str, bytes: Bytes, brotli: Option<Bytes>) -> Asset {
        let content_type = match name.rsplit_once('.').map_or("", |(_, extension)| extension) {
            "html" => "text/html; charset=utf-8",
            "js" | "mjs" => "text/javascript; charset=utf-8",
            "css" => "text/css; charset=utf-8",
            "wasm" => "application/wasm",
            "svg" => "image/svg+xml",
            "png" => "image/png",
            "ico" => "image/x-icon",
            "woff2" => "font/woff2",
            "json" | "webmanifest" => "application/json",
            "txt" => "text/plain; charset=utf-8",
            _ => "application/octet-stream",
        };
        Asset { content_type, bytes, brotli, made: OnceLock::new() }
    }

    fn made(&self) -> &Made {
        self.made.get_or_init(|| {
            let gzip = compressed(&self.bytes).ok().filter(|g| g.len() < self.bytes.len());
            Made { etag: format!("\"{}\"", hex(&Sha256::digest(&self.bytes))), gzip: gzip.map(Bytes::from) }
        })
    }

    async fn send(self: Arc<Asset>, asked: &HeaderMap, cache: &'static str) -> Result<Response> {
        let asset = self.clone();
        tokio::task::spawn_blocking(move || asset.made().gzip.is_some())
            .await
            .map_err(|e| Error::Internal(format!("compressing stopped: {e}")))?;
        let made = self.made();
        // Each form is a representation of its own, with its own ETag (RFC 9110, section 8.8.3).
        let brotli = self.brotli.as_ref().filter(|_| takes("br", asked)).map(|bytes| ("br", bytes));
        let gzip = || made.gzip.as_ref().filter(|_| takes("gzip", asked)).map(|bytes| ("gzip", bytes));
        let squeezed = brotli.or_else(gzip);
        let etag = match squeezed {
            Some((form, _)) => format!("{}-{form}\"", made.etag.trim_end_matches('"')),
            None => made.etag.clone(),
        };
        let mut headers = HeaderMap::new();
        headers.insert(CACHE_CONTROL, HeaderValue::from_static(cache));
        headers.insert(VARY, HeaderValue::from_static("accept-encoding"));
        headers.insert(CONTENT_SECURITY_POLICY, HeaderValue::from_static(PAGE_POLICY));
        if let Ok(value) = HeaderValue::from_str(&etag) {
            headers.insert(ETAG, value);
        }
        if none_matches(asked, &etag) {
            return Ok((StatusCode::NOT_MODIFIED, headers).into_response());
        }
        headers.insert(CONTENT_TYPE, HeaderValue::from_static(self.content_type));
        let body = match squeezed {
            Some((form, bytes)) => {
                headers.insert(CONTENT_ENCODING, HeaderValue::from_static(form));
                bytes.clone()
            }
            None => self.bytes.clone(),
        };
        Ok((headers, body).into_response())
    }
}

/// Gzip at the usual effort.
pub(super) fn compressed(bytes: &[u8]) -> std::io::Result<Vec<u8>> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
    encoder.write_all(bytes)?;
    encoder.finish()
}

/// `Accept-Encoding` takes a form, and not with a weight of zero.
pub(super) fn takes(form: &str, asked: &HeaderMap) -> bool {
    let items = asked.get_all(ACCEPT_ENCODING).iter().filter_map(|v| v.to_str().ok()).flat_map(|v| v.split(','));
    items.map(|item| item.split_once(';').map_or((item.trim(), ""), |(name, weight)| (name.trim(), weight.trim()))).any(
        |(name, weight)| {
            let refused = weight.strip_prefix("q=").and_then(|q| q.parse::<f32>().ok()) == Some(0.0);
            name.eq_ignore_ascii_case(form) && !refused
        },
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn squeezed_forms_are_sent_to_those_who_take_them() {
        for (text, gzip, brotli) in [
            ("gzip", true, false),
            ("br, GZIP;q=0.5", true, true),
            ("gzip;q=0, br", false, true),
            ("identity", false, false),
        ] {
            let headers = [(ACCEPT_ENCODING, text.parse().expect("value"))].into_iter().collect();
            assert_eq!((takes("gzip", &headers), takes("br", &headers)), (gzip, brotli), "{text}");
        }
    }

    #[test]
    fn the_viewer_has_the_version_of_its_address() {
        let lock = include_str!("../../../Cargo.lock");
        let entry = format!("name = \"re_web_viewer_server\"\nversion = \"{VIEWER_VERSION}\"");
        assert!(lock.contains(&entry), "VIEWER_VERSION differs from Cargo.lock");
        assert!(VIEWER.as_ref().is_ok_and(|v| v.viewer_wasm().starts_with(b"\0asm")));
    }
}
