//! Where the records are, as `--database` says it.

use std::fmt;
use std::path::PathBuf;

use crate::error::{Error, Result};

/// Where the records are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DatabasePlace {
    /// A SQLite file.
    Sqlite(PathBuf),
    /// A PostgreSQL database, by its URL.
    Postgres(String),
}

impl DatabasePlace {
    /// Reads `postgres://user@host/database` or `sqlite:PATH`.
    pub fn parse(text: &str) -> Result<DatabasePlace> {
        if text.starts_with("postgres://") || text.starts_with("postgresql://") {
            return Ok(DatabasePlace::Postgres(text.into()));
        }
        let path = text.strip_prefix("sqlite:").map(|rest| rest.strip_prefix("//").unwrap_or(rest));
        match path {
            Some(path) if !path.is_empty() => Ok(DatabasePlace::Sqlite(path.into())),
            _ => Err(Error::field(
                "--database",
                format!("--database is {:?}", without_password(text)),
                "postgres://USER:PASSWORD@HOST:PORT/NAME, or sqlite:PATH",
            )),
        }
    }
}

impl fmt::Display for DatabasePlace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            DatabasePlace::Sqlite(path) => write!(f, "sqlite:{}", path.display()),
            DatabasePlace::Postgres(url) => f.write_str(&without_password(url)),
        }
    }
}

/// A URL as logs may show it.
fn without_password(url: &str) -> String {
    let Some((scheme, rest)) = url.split_once("://") else { return url.into() };
    // Parameters may hold a password as well.
    let rest = rest.split('?').next().unwrap_or_default();
    let host = match rest.rsplit_once('@') {
        Some((user, host)) => format!("{}@{host}", user.split(':').next().unwrap_or_default()),
        None => rest.into(),
    };
    format!("{scheme}://{host}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_read_and_shown_without_their_password() {
        let place = DatabasePlace::parse("postgres://stria:secret@db.example:5432/stria?password=other");
        assert_eq!(place.expect("read").to_string(), "postgres://stria@db.example:5432/stria");
        for path in ["sqlite:a/b.db", "sqlite://a/b.db"] {
            assert_eq!(DatabasePlace::parse(path).expect("read"), DatabasePlace::Sqlite("a/b.db".into()));
        }
        for bad in ["", "sqlite:", "mysql://x", "a.db"] {
            let error = DatabasePlace::parse(bad).expect_err(bad);
            assert!(matches!(error, Error::Input { field: Some(f), .. } if f == "--database"));
        }
    }
}
