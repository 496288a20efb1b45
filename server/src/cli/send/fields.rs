//! What travels with a run: which wall, which rig, which recipe, where and when.

use std::path::Path;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use clap::Args;
use serde_json::{Map, Value};

use super::super::Failed;
use crate::store::sha256_of;

/// What the command line says of a run.
#[derive(Args)]
#[command(next_help_heading = "What is said of the run")]
pub(super) struct RunArgs {
    /// The pipe or wall
    #[arg(long, value_name = "NAME", env = "STRIA_ASSET")]
    asset: String,
    /// The rig it was recorded with: a rig file, or the name of a rig that the server has
    #[arg(long, value_name = "FILE|NAME", env = "STRIA_RIG")]
    rig: String,
    /// How to process: a recipe of the server, or a TOML file
    #[arg(long, value_name = "NAME|FILE", env = "STRIA_RECIPE")]
    recipe: Option<String>,
    /// Chainage of the first frame, mm
    #[arg(long, value_name = "MM", default_value_t = 0.0, allow_negative_numbers = true)]
    chainage_mm: f64,
    /// Which way the robot went along the asset
    #[arg(long, value_parser = ["forward", "backward"], default_value = "forward")]
    direction: String,
    /// When a file was recorded (RFC 3339) [default: the time of arrival; with --watch, the file's own time]
    #[arg(long, value_name = "TIME", conflicts_with_all = ["watch", "live"])]
    pub(super) recorded_at: Option<jiff::Timestamp>,
    /// Frames a second, where the source does not say
    #[arg(long, value_name = "F")]
    fps: Option<f64>,
}

impl RunArgs {
    /// With the files read that the arguments name.
    pub(super) fn fields(&self) -> Result<Fields, Failed> {
        for (name, value) in [("--chainage-mm", Some(self.chainage_mm)), ("--fps", self.fps)] {
            if let Some(value) = value.filter(|value| !value.is_finite()) {
                return Err(Failed::Input(format!("{name} is {value}; expected a finite number")));
            }
        }
        Ok(Fields {
            asset: self.asset.clone(),
            rig: file_or_name(&self.rig)?,
            recipe: self.recipe.as_deref().map(file_or_name).transpose()?,
            chainage_mm: self.chainage_mm,
            direction: self.direction.clone(),
            fps: self.fps,
        })
    }
}

/// What is said of every run that one command sends.
pub(super) struct Fields {
    asset: String,
    rig: String,
    recipe: Option<String>,
    chainage_mm: f64,
    direction: String,
    fps: Option<f64>,
}

impl Fields {
    fn pairs(&self) -> Vec<(&'static str, String)> {
        let mut pairs = vec![
            ("asset", self.asset.clone()),
            ("rig", self.rig.clone()),
            ("chainage_mm", self.chainage_mm.to_string()),
            ("direction", self.direction.clone()),
        ];
        pairs.extend(self.recipe.clone().map(|text| ("recipe", text)));
        pairs.extend(self.fps.map(|fps| ("fps", fps.to_string())));
        pairs
    }

    /// True where a refusal of this field is the command's fault, not that of one file.
    pub(super) fn is_ours(field: &str) -> bool {
        let first = field.split('.').next().unwrap_or_default();
        ["asset", "rig", "recipe", "chainage_mm", "direction", "fps"].contains(&first)
    }

    /// The tus header of a file.
    pub(super) fn metadata(&self, filename: &str, recorded_at: Option<jiff::Timestamp>, sha256: &str) -> String {
        let mut pairs = self.pairs();
        pairs.push(("filename", filename.into()));
        pairs.push(("sha256", sha256.into()));
        pairs.extend(recorded_at.map(|time| ("recorded_at", time.to_string())));
        let pairs = pairs.into_iter().filter(|(_, value)| !value.is_empty());
        let encoded = pairs.map(|(name, value)| format!("{name} {}", BASE64_STANDARD.encode(value)));
        encoded.collect::<Vec<_>>().join(",")
    }

    /// The first message of a live stream, but for its type.
    pub(super) fn hello(&self) -> Map<String, Value> {
        let mut hello = Map::new();
        hello.insert("asset".into(), self.asset.clone().into());
        hello.insert("rig".into(), self.rig.clone().into());
        hello.extend(self.recipe.clone().map(|text| ("recipe".to_string(), text.into())));
        hello.extend(self.fps.map(|fps| ("fps".to_string(), fps.into())));
        // What goes without saying is not said.
        if self.chainage_mm != 0.0 {
            hello.insert("chainage_mm".into(), self.chainage_mm.into());
        }
        if self.direction != "forward" {
            hello.insert("direction".into(), self.direction.clone().into());
        }
        hello
    }

    /// Tells whether two commands say the same of a run.
    pub(super) fn digest(&self) -> String {
        sha256_of(&format!("{:?}", self.pairs()))
    }
}

/// The text of a file where there is one of that name, else the name.
fn file_or_name(text: &str) -> Result<String, Failed> {
    let path = Path::new(text);
    if path.is_file() {
        return std::fs::read_to_string(path).map_err(|e| Failed::Input(format!("{text}: {e}; expected a text file")));
    }
    if path.extension().is_some() || text.contains('/') {
        return Err(Failed::Input(format!("{text}: there is no such file")));
    }
    Ok(text.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn metadata_is_base64_and_says_all() {
        let fields = Fields {
            asset: "Röhre 7, Süd".into(),
            rig: "gr3".into(),
            recipe: None,
            chainage_mm: -250.5,
            direction: "backward".into(),
            fps: Some(29.97),
        };
        let header = fields.metadata("a b,c.mp4", None, "00ff");
        let read = |pair: &str| {
            let (name, value) = pair.split_once(' ').expect("a pair");
            let value = BASE64_STANDARD.decode(value).expect("base64");
            (name.to_string(), String::from_utf8(value).expect("UTF-8"))
        };
        let pairs: Vec<_> = header.split(',').map(read).collect();
        let expected = [
            ("asset", "Röhre 7, Süd"),
            ("rig", "gr3"),
            ("chainage_mm", "-250.5"),
            ("direction", "backward"),
            ("fps", "29.97"),
            ("filename", "a b,c.mp4"),
            ("sha256", "00ff"),
        ];
        assert_eq!(pairs, expected.map(|(n, v)| (n.to_string(), v.to_string())));
        assert!(header.is_ascii());
    }

    #[test]
    fn whose_fault_a_refusal_is() {
        assert!(Fields::is_ours("rig") && Fields::is_ours("rig.camera.width_px") && Fields::is_ours("recipe.stripe"));
        assert!(!Fields::is_ours("Upload-Length") && !Fields::is_ours("sha256") && !Fields::is_ours("filename"));
    }
}
