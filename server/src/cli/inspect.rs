//! `stria inspect`: what a rig, a source or a product folder is, in a few lines.

use std::path::{Path, PathBuf};

use clap::Args;
use serde_json::{Value, json};
use stria_core::export::manifest::Manifest;
use stria_core::mcap_file;
use stria_core::rig::{LineDirection, Rig};
use stria_core::source::use_of_topic;

use super::progress::size;
use super::{Failed, Outcome, Success};

/// Show what a file is: a rig, a product folder (or its manifest.json), a video, a folder of images or an MCAP file
#[derive(Args)]
pub(super) struct Inspect {
    /// The file or folder
    file: PathBuf,
    /// Print one JSON object for programs
    #[arg(long)]
    json: bool,
}

/// Names and values, in the order in which a person wants them.
type Facts = Vec<(&'static str, String)>;

impl Inspect {
    pub(super) fn run(self) -> Outcome {
        let (what, facts, value) = look(&self.file)?;
        if self.json {
            println!("{}", json!({ "file": self.file.display().to_string(), "kind": what, "facts": value }));
            return Ok(Success::Done);
        }
        println!("{}: {what}", self.file.display());
        let width = facts.iter().map(|(name, _)| name.len()).max().unwrap_or(0);
        for (name, value) in facts {
            println!("  {name:width$}  {value}");
        }
        Ok(Success::Done)
    }
}

fn look(path: &Path) -> Result<(&'static str, Facts, Value), Failed> {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    if !path.exists() {
        return Err(Failed::Input(format!("{}: there is no such file or folder", path.display())));
    }
    if path.is_dir() && path.join("manifest.json").exists() {
        return products(&path.join("manifest.json"));
    }
    if let Some(files) = stria_core::source::mcap_files(path)? {
        return mcap(path, &files);
    }
    match extension.as_str() {
        "toml" => rig(path),
        "json" => products(path).or_else(|not_products| rig(path).map_err(|_| not_products)),
        _ => source(path),
    }
}

fn rig(path: &Path) -> Result<(&'static str, Facts, Value), Failed> {
    let rig = Rig::load(path)?;
    let (camera, laser) = (&rig.camera, &rig.laser);
    let n = laser.plane.normal;
    let line = match laser.line {
        LineDirection::Vertical => "vertical: one spot per row",
        LineDirection::Horizontal => "horizontal: one spot per column",
    };
    let colour = format!("{:?}", laser.colour).to_lowercase();
    let facts = vec![
        ("name", rig.name.clone()),
        ("image", format!("{} x {} px", camera.width_px, camera.height_px)),
        (
            "focal length",
            format!("{:.1} x {:.1} px ({:.1}° wide)", camera.fx_px, camera.fy_px, camera.fov_rad().to_degrees()),
        ),
        ("centre", format!("{:.1}, {:.1} px", camera.cx_px, camera.cy_px)),
        ("distortion", format!("{:?}", camera.distortion)),
        ("laser", format!("{colour}, {line}")),
        ("laser plane", format!("normal [{:.4}, {:.4}, {:.4}], offset {:.2} mm", n.x, n.y, n.z, laser.plane.offset_mm)),
    ];
    Ok(("a rig", facts, rig.to_json()))
}

fn products(path: &Path) -> Result<(&'static str, Facts, Value), Failed> {
    let text = std::fs::read_to_string(path).map_err(|e| stria_core::Error::io(path, e))?;
    let manifest: Manifest = serde_json::from_str(&text)
        .map_err(|e| Failed::Input(format!("{}: {e}; expected a manifest.json of Stria", path.display())))?;
    let q = &manifest.quality;
    let bytes: u64 = manifest.products.iter().map(|p| p.bytes).sum();
    let mut facts = vec![
        ("made by", manifest.software.clone()),
        ("source", manifest.source.iter().map(|s| s.name.as_str()).take(3).collect::<Vec<_>>().join(", ")),
        ("frames", format!("{} ({} with a stripe, {} tracked)", q.frames, q.frames_with_stripe, q.frames_tracked)),
        ("travel", format!("{:.1} mm in {:.1} s", q.travel_mm, q.duration_s)),
        ("points", q.points.to_string()),
    ];
    facts.extend(q.drift.map(|d| {
        let axes = format!("±{:.1} mm along, ±{:.1} mm across, ±{:.1} mm deep at the end", d.x_mm, d.y_mm, d.z_mm);
        ("drift", axes)
    }));
    if let Some(map) = &manifest.depth_map {
        facts.push((
            "map",
            format!(
                "{} x {} px of {:.3} mm, {:.1} % measured",
                map.width_px,
                map.height_px,
                map.mm_per_px,
                100.0 * q.coverage
            ),
        ));
    }
    facts.push(("products", format!("{} files, {}", manifest.products.len(), size(bytes))));
    facts.extend(manifest.warnings.iter().map(|w| ("warning", w.clone())));
    let value = serde_json::from_str(&text).unwrap_or(Value::Null);
    Ok(("a product folder", facts, value))
}

/// Topics that are listed for people, at most.
const MAX_TOPICS: usize = 200;

/// An MCAP file, or a bag's folder of them: its topics, and what each is good for here.
fn mcap(path: &Path, files: &[PathBuf]) -> Result<(&'static str, Facts, Value), Failed> {
    let contents = mcap_file::contents(files, &path.display().to_string())?;
    let bytes: u64 = files.iter().filter_map(|f| std::fs::metadata(f).ok()).map(|f| f.len()).sum();
    let start = jiff::Timestamp::from_nanosecond(i128::from(contents.start_ns));
    let start = start.map_or_else(|_| "not known".into(), |time| time.to_string());
    let length_s = (contents.end_ns - contents.start_ns) as f64 / 1e9;
    let mut facts = vec![
        ("size", format!("{} in {} {}", size(bytes), files.len(), if files.len() == 1 { "file" } else { "files" })),
        ("begins", start.clone()),
        ("length", format!("{length_s:.2} s")),
    ];
    let width = contents.topics.iter().map(|facts| facts.topic.name.len()).max().unwrap_or(0);
    for topic in contents.topics.iter().take(MAX_TOPICS) {
        let good_for = use_of_topic(&topic.topic).map_or_else(String::new, |word| format!("  [{word}]"));
        let (name, schema) = (&topic.topic.name, &topic.topic.schema);
        facts.push(("topic", format!("{name:width$}  {:>7} x {schema}{good_for}", topic.messages)));
    }
    if contents.topics.len() > MAX_TOPICS {
        facts.push(("topics", format!("{} more", contents.topics.len() - MAX_TOPICS)));
    }
    if !contents.attachments.is_empty() {
        facts.push(("attachments", contents.attachments.join(", ")));
    }
    facts.extend(contents.damage.iter().map(|damage| ("warning", damage.clone())));
    let topics: Vec<Value> = contents
        .topics
        .iter()
        .map(|facts| {
            json!({
                "name": facts.topic.name,
                "schema": facts.topic.schema,
                "encoding": facts.topic.encoding,
                "messages": facts.messages,
                "use": use_of_topic(&facts.topic),
            })
        })
        .collect();
    let value = json!({
        "topics": topics,
        "attachments": contents.attachments,
        "begins": start,
        "length_s": length_s,
        "files": files.len(),
        "bytes": bytes,
        "damage": contents.damage,
    });
    Ok(("an MCAP file", facts, value))
}

/// A video or a folder of images.
fn source(path: &Path) -> Result<(&'static str, Facts, Value), Failed> {
    let name = path.display().to_string();
    let source = stria_core::source::open(path, &name, None)?;
    let info = source.info();
    let or_unknown = |text: Option<String>| text.unwrap_or_else(|| "not announced".into());
    let bytes: u64 = info.files.iter().filter_map(|f| std::fs::metadata(f).ok()).map(|f| f.len()).sum();
    let length_s = info.frames_announced.zip(info.frames_per_s).map(|(frames, rate)| frames as f64 / rate);
    let facts = vec![
        ("image", format!("{} x {} px", info.width_px, info.height_px)),
        ("frames", or_unknown(info.frames_announced.map(|n| n.to_string()))),
        ("frames/s", or_unknown(info.frames_per_s.map(|rate| format!("{rate:.3}")))),
        ("length", or_unknown(length_s.map(|s| format!("{s:.2} s")))),
        (
            "size",
            format!("{} in {} {}", size(bytes), info.files.len(), if info.files.len() == 1 { "file" } else { "files" }),
        ),
    ];
    let value = json!({
        "width_px": info.width_px,
        "height_px": info.height_px,
        "frames_announced": info.frames_announced,
        "frames_per_s": info.frames_per_s,
        "files": info.files.len(),
        "bytes": bytes,
    });
    Ok((if path.is_dir() { "a folder of images" } else { "a video" }, facts, value))
}
