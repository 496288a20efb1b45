//! One error type for the whole core. Messages carry values and units and say what was expected.

use std::path::{Path, PathBuf};

/// The core's result.
pub type Result<T> = std::result::Result<T, Error>;

/// Everything that can go wrong between a source and its products.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The caller's input cannot be used. Trying again with the same input fails again.
    #[error("{subject}: {}{found}; expected {expected}", field.as_ref().map(|f| format!("{f} is ")).unwrap_or_default())]
    Input {
        /// The file, option or part of a request that is at fault, as the caller named it.
        subject: String,
        /// The field inside it, dotted (`camera.width_px`).
        field: Option<String>,
        /// What was found there, with its unit.
        found: String,
        /// What would have been right.
        expected: String,
    },
    /// A file or folder could not be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// Where.
        path: PathBuf,
        /// The operating system's word.
        source: std::io::Error,
    },
    /// The caller asked for the work to stop.
    #[error("cancelled")]
    Cancelled,
    /// A library refused what should have worked: a defect of ours.
    #[error("{stage}: {message}")]
    Internal {
        /// The stage that failed.
        stage: &'static str,
        /// The library's own message.
        message: String,
    },
}

impl Error {
    /// An input error without a field.
    pub fn input(subject: impl Into<String>, found: impl Into<String>, expected: impl Into<String>) -> Self {
        Error::Input { subject: subject.into(), field: None, found: found.into(), expected: expected.into() }
    }

    /// An input error at one field.
    pub fn field(
        subject: impl Into<String>,
        field: impl Into<String>,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> Self {
        Error::Input {
            subject: subject.into(),
            field: Some(field.into()),
            found: found.into(),
            expected: expected.into(),
        }
    }

    /// An I/O error at a path.
    pub fn io(path: impl AsRef<Path>, source: std::io::Error) -> Self {
        Error::Io { path: path.as_ref().to_path_buf(), source }
    }

    /// A library's refusal inside a stage.
    pub fn internal(stage: &'static str, message: impl std::fmt::Display) -> Self {
        Error::Internal { stage, message: message.to_string() }
    }

    /// The kind in one word, for programs: `bad_input`, `io`, `cancelled`, `internal`.
    pub fn kind(&self) -> &'static str {
        match self {
            Error::Input { .. } => "bad_input",
            Error::Io { .. } => "io",
            Error::Cancelled => "cancelled",
            Error::Internal { .. } => "internal",
        }
    }
}

impl From<opencv::Error> for Error {
    fn from(error: opencv::Error) -> Self {
        Error::internal("opencv", error)
    }
}
