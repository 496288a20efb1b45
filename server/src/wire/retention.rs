//! What would be deleted, on the wire.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// A run that would go.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct Doomed {
    /// The run.
    pub run: String,
    /// Its asset.
    pub asset: String,
    /// When it came in.
    pub created_at: String,
    /// What goes with it, bytes.
    pub bytes: u64,
    /// `age` or `quota`.
    pub reason: String,
}

/// What a policy would delete now.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct RetentionPreview {
    /// Runs older than this go, days; absent where age does not matter.
    pub keep_days: Option<f64>,
    /// While more than this is stored the oldest runs go, GB; absent where size does not matter.
    pub quota_gb: Option<f64>,
    /// Bytes of all sources and products now.
    pub stored_bytes: u64,
    /// Number of runs that would go.
    pub runs: u64,
    /// Bytes that would go.
    pub freed_bytes: u64,
    /// The first 1,000 of them, the oldest first.
    pub items: Vec<Doomed>,
    /// The rules that hold now, whatever was asked about.
    pub rules: RetentionRules,
}

/// Where the rules that hold come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum RulesOrigin {
    /// Each server's own flags.
    Server,
    /// Somebody stored them; they hold on every server.
    Stored,
}

/// The rules of keeping that hold now.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct RetentionRules {
    /// Runs older than this go, days; absent where age does not matter.
    pub keep_days: Option<f64>,
    /// While more than this is stored the oldest runs go, GB; absent where size does not matter.
    pub quota_gb: Option<f64>,
    /// Where they come from.
    pub origin: RulesOrigin,
    /// Another after every change; a PUT or DELETE that brings it as `If-Match` changes nothing else.
    pub version: String,
    /// When people last stored rules, or let the servers' own hold again (RFC 3339).
    pub changed_at: Option<String>,
    /// Who did: the name of a token or a session.
    pub changed_by: Option<String>,
    /// What `--keep-days` of the answering server says, days.
    pub own_keep_days: Option<f64>,
    /// What `--quota-gb` of the answering server says, GB.
    pub own_quota_gb: Option<f64>,
}

/// Rules of keeping to be stored; what is absent or null does not matter.
#[derive(Clone, Copy, Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct RetentionWish {
    /// Runs that came in more than so many days ago shall go.
    #[schema(exclusive_minimum = 0.0, maximum = 1_000_000.0)]
    pub keep_days: Option<f64>,
    /// While more than so many GB are stored, the oldest runs shall go.
    #[schema(exclusive_minimum = 0.0, maximum = 1_000_000_000.0)]
    pub quota_gb: Option<f64>,
}

/// Whether a run is pinned.
#[derive(Clone, Copy, Debug, Serialize, Deserialize, ToSchema)]
pub struct Pin {
    /// A pinned run is kept whatever the policy says.
    pub pinned: bool,
}
