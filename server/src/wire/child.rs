//! What `stria process --json` prints, one JSON object a line, and the worker reads.

use serde::{Deserialize, Serialize};
use stria_core::export::manifest::Manifest;
use stria_core::pipeline::Event;

/// A line: the pipeline's events, then one result or one error.
#[derive(Debug, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Line {
    /// The last line of a process.
    End(End),
    /// Progress, a warning, a recording segment.
    Event(Event),
}

/// How it ended.
#[derive(Debug, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum End {
    /// The products are there.
    Result {
        /// What was made.
        manifest: Box<Manifest>,
    },
    /// They are not.
    Error(Failure),
}

/// Why a processing failed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Failure {
    /// `bad_input`, `io`, `cancelled`, `internal`; the worker adds `killed`, `out_of_memory`, `time_limit`, `away` and
    /// `lost`.
    pub kind: String,
    /// In words.
    pub message: String,
    /// The field at fault.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
    /// What would have been right.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expected: Option<String>,
    /// True where another try may succeed.
    pub retryable: bool,
}

impl Failure {
    /// A failure in words only.
    pub fn new(kind: &str, message: impl Into<String>, retryable: bool) -> Failure {
        Failure { kind: kind.into(), message: message.into(), field: None, expected: None, retryable }
    }
}

impl From<&stria_core::Error> for Failure {
    fn from(error: &stria_core::Error) -> Failure {
        let (field, expected) = match error {
            stria_core::Error::Input { field, expected, .. } => (field.clone(), Some(expected.clone())),
            _ => (None, None),
        };
        let retryable = matches!(error, stria_core::Error::Io { .. } | stria_core::Error::Internal { .. });
        Failure { kind: error.kind().into(), message: error.to_string(), field, expected, retryable }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_told_apart() {
        let line = r#"{"type":"progress","stage":"measuring","fraction":0.5,"frames":60,"frames_total":120,"frames_per_s":31.5,"time_left_s":2.0}"#;
        assert!(matches!(serde_json::from_str(line), Ok(Line::Event(Event::Progress { frames: 60, .. }))));
        let line = r#"{"type":"error","kind":"bad_input","message":"no","retryable":false}"#;
        assert!(matches!(serde_json::from_str(line), Ok(Line::End(End::Error(f))) if f.kind == "bad_input"));
        assert!(serde_json::from_str::<Line>(r#"{"type":"surprise"}"#).is_err());
    }
}
