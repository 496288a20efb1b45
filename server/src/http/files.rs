//! Files as HTTP sends them: ranges, strong ETags, conditions, and headers under which no browser runs them.

use std::ops::Range;

use axum::body::Body;
use axum::http::header::{
    ACCEPT_RANGES, CACHE_CONTROL, CONTENT_DISPOSITION, CONTENT_LENGTH, CONTENT_RANGE, CONTENT_TYPE, ETAG,
    IF_NONE_MATCH, IF_RANGE, RANGE,
};
use axum::http::{HeaderMap, Method, StatusCode};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use futures::stream::{BoxStream, StreamExt, TryStreamExt};

use super::problem::Refusal;
use crate::error::Result;
use crate::metrics::metrics;
use crate::store::{Facts, Key, Store};

/// Kept for a year: what has this address never changes.
pub(super) const IMMUTABLE: &str = "public, max-age=31536000, immutable";
/// Asked again every time; the ETag saves the bytes.
pub(super) const REVALIDATE: &str = "no-cache";

/// A file and how to send it.
pub(super) struct FileAnswer {
    /// Where it lies: its parts in order, each with its size in bytes.
    pub parts: Vec<(Key, u64)>,
    /// Its size and hash; the hash is the ETag.
    pub facts: Facts,
    /// Its kind.
    pub content_type: &'static str,
    /// How long it may be kept.
    pub cache: &'static str,
    /// The name under which a browser saves it; `None`: it may show it.
    pub save_as: Option<String>,
}

/// Answers a request for a file.
pub(super) async fn send(store: &Store, method: &Method, asked: &HeaderMap, file: FileAnswer) -> Result<Response> {
    let etag = format!("\"{}\"", file.facts.sha256);
    let mut headers = vec![(ETAG, etag.clone()), (CACHE_CONTROL, file.cache.into()), (ACCEPT_RANGES, "bytes".into())];
    if none_matches(asked, &etag) {
        return Ok((StatusCode::NOT_MODIFIED, headers_of(headers)).into_response());
    }
    let size = file.facts.bytes;
    let (status, range) = match asked_range(asked, &etag, size) {
        Asked::Whole => (StatusCode::OK, 0..size),
        Asked::Part(range) => {
            headers.push((CONTENT_RANGE, format!("bytes {}-{}/{size}", range.start, range.end - 1)));
            (StatusCode::PARTIAL_CONTENT, range)
        }
        Asked::Nothing(asked) => return Ok(Refusal::Range { asked, bytes: size }.into_response()),
    };
    headers.push((CONTENT_TYPE, file.content_type.into()));
    headers.push((CONTENT_LENGTH, (range.end - range.start).to_string()));
    if let Some(name) = &file.save_as {
        headers.push((CONTENT_DISPOSITION, attachment(name)));
    }
    let body = match *method {
        Method::HEAD => Body::empty(),
        _ => {
            metrics().bytes_out.inc_by(range.end - range.start);
            Body::from_stream(read(store, file.parts, range).await?)
        }
    };
    Ok((status, headers_of(headers), body).into_response())
}

/// The bytes of a range of all parts together. The first part is opened before the answer begins.
async fn read(
    store: &Store,
    parts: Vec<(Key, u64)>,
    range: Range<u64>,
) -> Result<BoxStream<'static, std::io::Result<Bytes>>> {
    let mut wanted = wanted_parts(parts, &range).into_iter();
    let Some((key, part)) = wanted.next() else { return Ok(futures::stream::empty().boxed()) };
    let first = store.read(&key, part).await?;
    let store = store.clone();
    let rest = futures::stream::iter(wanted).then(move |(key, part)| {
        let store = store.clone();
        async move { store.read(&key, part).await.map_err(std::io::Error::other) }
    });
    Ok(first.chain(rest.try_flatten()).boxed())
}

/// The parts that a range touches, each with the range inside it.
fn wanted_parts(parts: Vec<(Key, u64)>, range: &Range<u64>) -> Vec<(Key, Range<u64>)> {
    let mut begin = 0;
    let inside = parts.into_iter().filter_map(|(key, bytes)| {
        let (from, to) = (range.start.clamp(begin, begin + bytes), range.end.clamp(begin, begin + bytes));
        let part = (from < to).then_some((key, from - begin..to - begin));
        begin += bytes;
        part
    });
    inside.collect()
}

fn headers_of(pairs: Vec<(axum::http::HeaderName, String)>) -> HeaderMap {
    pairs.into_iter().filter_map(|(name, value)| Some((name, value.parse().ok()?))).collect()
}

/// `If-None-Match` names this version.
pub(super) fn none_matches(asked: &HeaderMap, etag: &str) -> bool {
    let tags = asked.get_all(IF_NONE_MATCH).iter().filter_map(|v| v.to_str().ok()).flat_map(|v| v.split(','));
    tags.map(str::trim).any(|tag| tag == "*" || tag.strip_prefix("W/").unwrap_or(tag) == etag)
}

#[derive(Debug, PartialEq)]
enum Asked {
    Whole,
    Part(Range<u64>),
    Nothing(String),
}

/// The bytes that are asked for. Several ranges at once are answered with the whole, as RFC 9110 allows.
fn asked_range(asked: &HeaderMap, etag: &str, size: u64) -> Asked {
    let Some(text) = asked.get(RANGE).and_then(|v| v.to_str().ok()) else { return Asked::Whole };
    if let Some(condition) = asked.get(IF_RANGE)
        && condition.as_bytes() != etag.as_bytes()
    {
        return Asked::Whole;
    }
    let Some((first, last)) = text.trim().strip_prefix("bytes=").and_then(|r| r.trim().split_once('-')) else {
        return Asked::Whole;
    };
    let digits = |t: &str| !t.is_empty() && t.bytes().all(|b| b.is_ascii_digit());
    // A number past u64 lies past every file.
    let number = |t: &str| t.parse::<u64>().unwrap_or(u64::MAX);
    let range = match (first.trim(), last.trim()) {
        ("", n) if digits(n) => size.saturating_sub(number(n))..size,
        (a, "") if digits(a) => number(a)..size,
        (a, b) if digits(a) && digits(b) && number(a) <= number(b) => number(a)..number(b).saturating_add(1).min(size),
        _ => return Asked::Whole,
    };
    if range.start < range.end { Asked::Part(range) } else { Asked::Nothing(text.into()) }
}

/// `Content-Disposition` for a name that someone else chose: the last part of its path, in a form that no quote,
/// backslash or foreign letter can break out of (RFC 6266).
fn attachment(name: &str) -> String {
    let name = name.rsplit(['/', '\\']).next().unwrap_or_default();
    // A name of dots alone would be a folder's.
    let name = if name.trim_matches('.').is_empty() { "source" } else { name };
    let plain: String = name
        .chars()
        .map(|c| if c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_' | ' ') { c } else { '_' })
        .collect();
    let coded: String = name
        .bytes()
        .map(|b| match b {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'.' | b'-' | b'_' => char::from(b).to_string(),
            _ => format!("%{b:02X}"),
        })
        .collect();
    format!("attachment; filename=\"{plain}\"; filename*=UTF-8''{coded}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn range(text: &str) -> Asked {
        let headers = [(RANGE, text.parse().expect("value"))].into_iter().collect();
        asked_range(&headers, "\"e\"", 100)
    }

    #[test]
    fn ranges_are_read_as_rfc_9110_says() {
        assert_eq!(range("bytes=0-0"), Asked::Part(0..1));
        assert_eq!(range("bytes=10-"), Asked::Part(10..100));
        assert_eq!(range("bytes=-10"), Asked::Part(90..100));
        assert_eq!(range("bytes=-1000"), Asked::Part(0..100));
        assert_eq!(range("bytes=90-1000"), Asked::Part(90..100));
        assert_eq!(range("bytes=0-99999999999999999999999"), Asked::Part(0..100));
        for whole in ["bytes=5-4", "bytes=a-b", "bytes=", "bytes=-", "lines=1-2", "bytes=0-1,3-4", "bytes=+1-2"] {
            assert_eq!(range(whole), Asked::Whole, "{whole}");
        }
        for nothing in ["bytes=100-", "bytes=100-200", "bytes=-0", "bytes=99999999999999999999999-"] {
            assert!(matches!(range(nothing), Asked::Nothing(_)), "{nothing}");
        }
    }

    #[test]
    fn if_range_protects_against_a_changed_file() {
        for (condition, expected) in [("\"e\"", Asked::Part(0..1)), ("\"f\"", Asked::Whole), ("W/\"e\"", Asked::Whole)]
        {
            let pairs = [(RANGE, "bytes=0-0"), (IF_RANGE, condition)];
            let headers = pairs.into_iter().map(|(n, v)| (n, v.parse().expect("value"))).collect();
            assert_eq!(asked_range(&headers, "\"e\"", 100), expected, "{condition}");
        }
    }

    #[test]
    fn names_cannot_break_out_of_their_header() {
        assert_eq!(attachment("a.mp4"), "attachment; filename=\"a.mp4\"; filename*=UTF-8''a.mp4");
        let tricky = attachment("../../x\"; filename=\"y\r\nSet-Cookie: ü.mp4");
        assert!(tricky.is_ascii() && !tricky.contains(['\r', '\n']), "{tricky}");
        assert_eq!(tricky.matches('"').count(), 2, "{tricky}");
        assert!(!tricky.contains(".."), "{tricky}");
    }
}
