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
}

/// Whether a run is pinned.
#[derive(Clone, Copy, Debug, Serialize, Deserialize, ToSchema)]
pub struct Pin {
    /// A pinned run is kept whatever the policy says.
    pub pinned: bool,
}
