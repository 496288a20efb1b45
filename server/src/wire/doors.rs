//! Tokens, sessions and the audit log on the wire.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::auth::Scope;

/// A token, without its secret.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct Token {
    /// Its name among tokens.
    pub id: String,
    /// Who uses it.
    pub name: String,
    /// What it may do.
    pub scopes: Vec<Scope>,
    /// False once it was revoked or its time is over.
    pub valid: bool,
    /// When it was made.
    pub created_at: String,
    /// When its time is over; absent where it has no end.
    pub expires_at: Option<String>,
    /// When it was last used, to the minute.
    pub used_at: Option<String>,
    /// When it was revoked.
    pub revoked_at: Option<String>,
}

/// A token that was just made.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct TokenWithSecret {
    /// The token.
    #[serde(flatten)]
    pub token: Token,
    /// What goes into `Authorization: Bearer …`. It is shown this once.
    pub secret: String,
}

/// A page of tokens, the newest first.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct TokenPage {
    /// The tokens.
    pub items: Vec<Token>,
    /// Pass it as `cursor` for the next page; absent on the last.
    pub next_cursor: Option<String>,
}

/// What `POST /api/tokens` takes.
#[derive(Clone, Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct TokenWish {
    /// Who will use it.
    pub name: String,
    /// What it may do.
    pub scopes: Vec<Scope>,
    /// When its time is over (RFC 3339); never when absent.
    pub expires_at: Option<String>,
}

/// What `POST /api/tokens/{token}/rotate` takes.
#[derive(Clone, Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Rotation {
    /// How long the old secret still opens, s; a day when absent.
    pub overlap_s: Option<u32>,
}

/// What `POST /api/session` takes.
#[derive(Clone, Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct LogIn {
    /// A token, or the code of a login address.
    pub secret: String,
}

/// Who asks.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct Session {
    /// The token's or login's name.
    pub name: String,
    /// What they may do.
    pub scopes: Vec<Scope>,
    /// When they have to log in again.
    pub expires_at: Option<String>,
    /// False where this server lets anyone do everything.
    pub locked: bool,
}

/// A request that wrote.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct AuditLine {
    /// Its place in the log.
    pub id: String,
    /// When.
    pub at: String,
    /// Whose token or session.
    pub who: String,
    /// From which address.
    pub address: String,
    /// The request's method.
    pub method: String,
    /// The request's path.
    pub path: String,
    /// The answer's status.
    pub status: u16,
    /// The request's id, as in `x-request-id` and the server's log.
    pub request: String,
}

/// A page of the audit log, the newest line first.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct AuditPage {
    /// The lines.
    pub items: Vec<AuditLine>,
    /// Pass it as `cursor` for the next page; absent on the last.
    pub next_cursor: Option<String>,
}
