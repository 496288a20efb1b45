//! Everything that can go wrong in the service. `http/problem.rs` gives each its HTTP status.

use std::path::{Path, PathBuf};

/// The service's result.
pub type Result<T> = std::result::Result<T, Error>;

/// A fault of the service or of what was asked of it.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Nothing of that name exists.
    #[error("there is no {what} '{id}'")]
    NotFound {
        /// The kind of thing: `run`, `job`, `product` …
        what: &'static str,
        /// The name that was asked for.
        id: String,
    },
    /// The request cannot be used as it is.
    #[error("{detail}")]
    Input {
        /// What was found, in words.
        detail: String,
        /// The field at fault, dotted inside files (`rig.camera.width_px`).
        field: Option<String>,
        /// What would have been right.
        expected: Option<String>,
    },
    /// The thing's present state does not allow it.
    #[error("{0}")]
    Conflict(String),
    /// It is no longer what the request was made from.
    #[error("{0}")]
    Changed(String),
    /// Somebody else is writing to it.
    #[error("{0}")]
    Locked(String),
    /// It was there, and is no more.
    #[error("{0}")]
    Gone(String),
    /// What arrived is not what was announced.
    #[error("{0}")]
    Checksum(String),
    /// An idempotency key came back with other content.
    #[error("the idempotency key '{0}' was already used with other content")]
    KeyReused(String),
    /// More bytes than the server takes.
    #[error("the request is larger than this server's limit of {limit_bytes} bytes")]
    TooLarge {
        /// The limit.
        limit_bytes: u64,
    },
    /// The sender was silent for too long, or left in the middle of a request.
    #[error("the sender went silent before the request was complete")]
    SenderSilent,
    /// All places of a bounded resource are taken.
    #[error("{0}")]
    Busy(String),
    /// The disk has no room for it.
    #[error("{0}")]
    NoRoom(String),
    /// The request comes from a page of another origin or under a foreign host name.
    #[error("{0}")]
    Foreign(String),
    /// The lease on a job was lost: another attempt owns it now.
    #[error("the lease on the job was lost")]
    LeaseLost,
    /// The records failed.
    #[error("records: {0}")]
    Records(#[from] sea_orm::DbErr),
    /// The store failed.
    #[error("store: {0}")]
    Store(#[from] object_store::Error),
    /// A file failed.
    #[error("{}: {source}", path.display())]
    Io {
        /// Where.
        path: PathBuf,
        /// The operating system's word.
        source: std::io::Error,
    },
    /// A defect of ours.
    #[error("{0}")]
    Internal(String),
}

impl Error {
    /// An input error at one field.
    pub fn field(field: &str, detail: impl Into<String>, expected: impl Into<String>) -> Error {
        Error::Input { detail: detail.into(), field: Some(field.into()), expected: Some(expected.into()) }
    }

    /// An I/O error at a path.
    pub fn io(path: impl AsRef<Path>, source: std::io::Error) -> Error {
        Error::Io { path: path.as_ref().to_path_buf(), source }
    }

    /// True where the disk (or a quota) is full.
    pub fn is_storage_full(&self) -> bool {
        match self {
            Error::NoRoom(_) => true,
            Error::Io { source, .. } => is_full(source),
            Error::Store(e) => chain_is_full(e),
            // SQLite's own words for SQLITE_FULL; the driver passes no kind through.
            // PostgreSQL's is 53100, which says "No space left on device".
            Error::Records(e) => {
                let words = e.to_string();
                words.contains("disk is full") || words.contains("No space left")
            }
            _ => false,
        }
    }

    /// True where the same may succeed in a moment, because a service that this one needs was away.
    pub fn is_passing(&self) -> bool {
        match self {
            Error::Records(e) => crate::db::is_passing(e),
            // Whatever S3 itself refuses has a kind of its own; what remains is the way to it, or its own trouble.
            Error::Store(e) => matches!(e, object_store::Error::Generic { store: "S3", .. }),
            _ => false,
        }
    }

    /// An error of the core about a part of a request; `part` goes before the core's field name.
    pub fn from_core(part: &str, error: stria_core::Error) -> Error {
        match error {
            stria_core::Error::Input { ref field, ref expected, .. } => Error::Input {
                field: Some(match field {
                    Some(field) => format!("{part}.{field}"),
                    None => part.into(),
                }),
                expected: Some(expected.clone()),
                detail: error.to_string(),
            },
            stria_core::Error::Io { path, source } => Error::Io { path, source },
            other => Error::Internal(other.to_string()),
        }
    }
}

fn is_full(error: &std::io::Error) -> bool {
    use std::io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
    matches!(error.kind(), StorageFull | QuotaExceeded | FileTooLarge)
}

fn chain_is_full(error: &object_store::Error) -> bool {
    let mut next: Option<&(dyn std::error::Error + 'static)> = Some(error);
    while let Some(here) = next {
        if here.downcast_ref::<std::io::Error>().is_some_and(is_full) {
            return true;
        }
        next = here.source();
    }
    false
}
