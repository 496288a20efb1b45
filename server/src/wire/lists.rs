//! Lists and small things on the wire.

use serde::Serialize;
use utoipa::ToSchema;

use super::{Job, LogLine, Product, Run};

/// A page of runs, the newest first.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct RunPage {
    /// The runs.
    pub items: Vec<Run>,
    /// Pass it as `cursor` for the next page; absent on the last.
    pub next_cursor: Option<String>,
}

/// A page of jobs, the newest first.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct JobPage {
    /// The jobs.
    pub items: Vec<Job>,
    /// Pass it as `cursor` for the next page; absent on the last.
    pub next_cursor: Option<String>,
}

/// A page of products; files at the top of the folder come first, then tiles.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct ProductPage {
    /// The products.
    pub items: Vec<Product>,
    /// Pass it as `cursor` for the next page; absent on the last.
    pub next_cursor: Option<String>,
}

/// A page of a job's log, the oldest first.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct LogPage {
    /// The lines.
    pub items: Vec<LogLine>,
    /// Pass it as `cursor` for the next page; absent on the last.
    pub next_cursor: Option<String>,
}

/// A stored rig.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct Rig {
    /// Its name.
    pub name: String,
    /// When it was stored.
    pub created_at: String,
    /// SHA-256 of its TOML form.
    pub sha256: String,
    /// Camera and laser, as in a rig file.
    pub rig: serde_json::Value,
    /// The rig file.
    pub toml: String,
}

/// A page of rigs by name.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct RigPage {
    /// The rigs.
    pub items: Vec<Rig>,
    /// Pass it as `cursor` for the next page; absent on the last.
    pub next_cursor: Option<String>,
}

/// A pipe or wall with runs.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct Asset {
    /// Its name.
    pub name: String,
    /// Number of its runs.
    pub runs: u64,
    /// When the latest of them came in.
    pub latest_at: Option<String>,
}

/// A page of assets by name.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct AssetPage {
    /// The assets.
    pub items: Vec<Asset>,
    /// Pass it as `cursor` for the next page; absent on the last.
    pub next_cursor: Option<String>,
}

/// A built-in recipe.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct Recipe {
    /// Its name.
    pub name: String,
    /// True for the one that is taken when nothing is said.
    pub default: bool,
    /// All its values.
    pub toml: String,
}

/// What values an option takes.
#[derive(Clone, Debug, Serialize, ToSchema)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum OptionRange {
    /// A number between two limits, both included.
    Number {
        /// Smallest value.
        min: f64,
        /// Largest value.
        max: f64,
        /// True where only whole numbers make sense.
        whole: bool,
    },
    /// True or false.
    Flag,
    /// One of a few words.
    Choice {
        /// The words.
        of: Vec<String>,
    },
    /// Words.
    Text {
        /// Most characters.
        max_chars: usize,
    },
}

/// A tunable of the processing.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct RecipeOption {
    /// Dotted key, as in a recipe's TOML and in `--set`.
    pub key: String,
    /// Unit of the value; empty where it has none.
    pub unit: String,
    /// Value when nothing is said.
    pub default: serde_json::Value,
    /// What values it takes.
    pub range: OptionRange,
    /// What it does and why one would change it.
    pub doc: String,
}

/// A worker process and what it is at.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct Worker {
    /// Its name.
    pub name: String,
    /// When it started.
    pub started_at: String,
    /// When it was last heard of.
    pub seen_at: String,
    /// How many jobs it takes at once.
    pub slots: u32,
    /// The jobs it is at.
    pub jobs: Vec<String>,
}

/// The server's own state.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct Health {
    /// `ok`.
    pub status: String,
    /// Stria's version.
    pub version: String,
    /// What this machine lacks to keep the processing of strangers' videos in its place; absent where it lacks nothing.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
}
