//! What one may do.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::error::{Error, Result};

/// A kind of thing that one may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Scope {
    /// Send runs in.
    Ingest,
    /// Look at everything but tokens and the audit log.
    Read,
    /// Change, delete, process again, cancel.
    Operate,
    /// Tokens, audit log, retention; and everything else.
    Admin,
}

impl Scope {
    /// All of them.
    pub const ALL: [Scope; 4] = [Scope::Ingest, Scope::Read, Scope::Operate, Scope::Admin];

    /// As records and requests write it.
    pub fn as_str(self) -> &'static str {
        match self {
            Scope::Ingest => "ingest",
            Scope::Read => "read",
            Scope::Operate => "operate",
            Scope::Admin => "admin",
        }
    }
}

/// What someone may do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Scopes(Vec<Scope>);

impl Scopes {
    /// Everything.
    pub fn all() -> Scopes {
        Scopes(vec![Scope::Admin])
    }

    /// From a list; at least one.
    pub fn new(mut scopes: Vec<Scope>) -> Result<Scopes> {
        scopes.sort_unstable();
        scopes.dedup();
        if scopes.is_empty() {
            let expected = Scope::ALL.map(Scope::as_str).join(", ");
            return Err(Error::field("scopes", "there is no scope", format!("at least one of {expected}")));
        }
        Ok(Scopes(scopes))
    }

    /// Reads words with commas or spaces between them.
    pub fn parse(text: &str) -> Result<Scopes> {
        let words = text.split([',', ' ']).filter(|w| !w.is_empty());
        let read = |word: &str| {
            Scope::ALL.into_iter().find(|s| s.as_str() == word).ok_or_else(|| {
                let expected = Scope::ALL.map(Scope::as_str).join(", ");
                Error::field("scopes", format!("there is no scope {word:?}"), format!("some of {expected}"))
            })
        };
        Scopes::new(words.map(read).collect::<Result<_>>()?)
    }

    /// True where it is among them; `admin` may everything.
    pub fn allow(&self, scope: Scope) -> bool {
        self.0.contains(&scope) || self.0.contains(&Scope::Admin)
    }

    /// The list.
    pub fn list(&self) -> Vec<Scope> {
        self.0.clone()
    }

    /// As records write them.
    pub fn to_text(&self) -> String {
        self.0.iter().map(|s| s.as_str()).collect::<Vec<_>>().join(" ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scopes_are_read_and_only_admin_has_the_others() {
        let scopes = Scopes::parse("read, ingest,read").expect("two");
        assert_eq!(scopes.to_text(), "ingest read");
        assert!(scopes.allow(Scope::Read) && !scopes.allow(Scope::Operate) && !scopes.allow(Scope::Admin));
        assert!(Scope::ALL.into_iter().all(|s| Scopes::all().allow(s)));
        for bad in ["", " ", "write", "read,root"] {
            assert!(Scopes::parse(bad).is_err(), "{bad}");
        }
    }
}
