//! What can go wrong on the way to a server, and what it means for whoever sends.

use std::time::Duration;

use reqwest::header::{LOCATION, RETRY_AFTER};
use reqwest::{Response, StatusCode};
use serde_json::Value;

use super::super::Failed;

/// Why something did not get through.
#[derive(Debug)]
pub(super) enum Trouble {
    /// It passes by itself: the network, a busy server.
    Passing {
        why: String,
        /// How long the server asks to stay away.
        wait: Option<Duration>,
        /// The server failed at this very request; it may do so each time.
        fault: bool,
    },
    /// The token is missing, wrong, or not allowed to do this.
    Denied(String),
    /// The server does not take it, now or later.
    Refused {
        /// The field at fault, where the server named one.
        field: Option<String>,
        words: String,
    },
    /// The upload is not there any more.
    Gone(String),
    /// The file changed, or went away, while it was sent.
    Changed(String),
    /// It was tried for as long as it was to be tried.
    GaveUp(String),
    /// This machine's own disk or files.
    Local(String),
    /// Somebody asked to stop.
    Stopped,
}

impl Trouble {
    /// The network, in words.
    pub(super) fn passing(why: impl Into<String>) -> Trouble {
        Trouble::Passing { why: why.into(), wait: None, fault: false }
    }
}

impl From<Trouble> for Failed {
    fn from(trouble: Trouble) -> Failed {
        match trouble {
            Trouble::Passing { why, .. } | Trouble::GaveUp(why) => Failed::Other(why),
            Trouble::Denied(why) => Failed::Input(why),
            Trouble::Refused { words, .. } => Failed::Input(words),
            Trouble::Gone(why) | Trouble::Changed(why) | Trouble::Local(why) => Failed::Other(why),
            Trouble::Stopped => Failed::Cancelled,
        }
    }
}

impl From<reqwest::Error> for Trouble {
    fn from(error: reqwest::Error) -> Trouble {
        Trouble::passing(cause(&error))
    }
}

/// The innermost cause says most: "connection refused" instead of "error sending request".
fn cause(error: &reqwest::Error) -> String {
    let mut inner: &dyn std::error::Error = error;
    while let Some(next) = inner.source() {
        inner = next;
    }
    inner.to_string()
}

/// What an answer without success means.
pub(super) async fn trouble_of(response: Response) -> Trouble {
    let status = response.status();
    let header = |name| response.headers().get(name).and_then(|v| v.to_str().ok()).map(String::from);
    let wait = header(RETRY_AFTER).and_then(|text| text.trim().parse().ok()).map(Duration::from_secs);
    if status.is_redirection() {
        let target = header(LOCATION).unwrap_or_else(|| "another place".into());
        let words = format!("the server points to {target} ({status}); give --server its address");
        return Trouble::Refused { field: None, words };
    }
    let problem: Value = response.json().await.unwrap_or_default();
    of_status(status, &problem, wait)
}

/// What a status and its problem document mean.
pub(super) fn of_status(status: StatusCode, problem: &Value, wait: Option<Duration>) -> Trouble {
    let words = words_of(status, problem);
    let retryable = problem.get("retryable").and_then(Value::as_bool).unwrap_or(false);
    match status.as_u16() {
        401 | 403 => Trouble::Denied(format!(
            "the server does not let this sender in ({words}); its token comes from STRIA_TOKEN or --token-file"
        )),
        404 | 410 => Trouble::Gone(words),
        408 | 409 | 423 | 425 | 429 | 460 | 501..=599 => Trouble::Passing { why: words, wait, fault: false },
        500 => Trouble::Passing { why: words, wait, fault: true },
        _ if retryable => Trouble::Passing { why: words, wait, fault: false },
        _ => {
            let field = problem.get("field").and_then(Value::as_str).map(String::from);
            Trouble::Refused { field, words: format!("the server refuses the run ({words})") }
        }
    }
}

fn words_of(status: StatusCode, problem: &Value) -> String {
    let text = |name: &str| problem.get(name).and_then(Value::as_str).unwrap_or_default();
    let (detail, expected) = (text("detail"), text("expected"));
    let mut words = status.to_string();
    if !detail.is_empty() {
        words += &format!(": {detail}");
    }
    // The core's messages say what they expected themselves.
    if !expected.is_empty() && !detail.contains(&format!("expected {expected}")) {
        words += &format!("; expected {expected}");
    }
    words
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn statuses_mean_what_they_should() {
        let of = |status: u16, retryable: bool| {
            let problem = serde_json::json!({"detail": "no", "field": "rig", "retryable": retryable});
            of_status(StatusCode::from_u16(status).expect("a status"), &problem, None)
        };
        for status in [408, 409, 423, 429, 460, 500, 502, 503, 507] {
            assert!(matches!(of(status, false), Trouble::Passing { .. }), "{status}");
        }
        assert!(matches!(of(500, true), Trouble::Passing { fault: true, .. }));
        assert!(matches!(of(503, true), Trouble::Passing { fault: false, .. }));
        assert!(matches!(of(422, true), Trouble::Passing { .. }));
        for status in [401, 403] {
            assert!(matches!(of(status, false), Trouble::Denied(_)), "{status}");
        }
        for status in [400, 412, 413, 415, 422] {
            assert!(matches!(of(status, false), Trouble::Refused { field: Some(f), .. } if f == "rig"), "{status}");
        }
        assert!(matches!(of(404, false), Trouble::Gone(_)) && matches!(of(410, false), Trouble::Gone(_)));
    }
}
