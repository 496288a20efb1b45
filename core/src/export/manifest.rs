//! `manifest.json`: what was made, from what, with what, how well.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::depth_map::MapGeometry;
use crate::error::{Error, Result};
use crate::export::new_file;
use crate::motion::metric::Drift;

/// The manifest's own name in the product folder.
pub const FILE_NAME: &str = "manifest.json";

/// Version of the manifest's shape; grows when a field changes its meaning.
pub const SCHEMA_VERSION: u32 = 1;

/// A file with its size and hash.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FileEntry {
    /// Path inside the product folder (or the source's own name).
    pub name: String,
    /// Size, bytes.
    pub bytes: u64,
    /// SHA-256 in lower-case hex.
    pub sha256: String,
}

impl FileEntry {
    /// Measures and hashes the file at `path`, to be listed as `name`.
    pub fn of(path: &Path, name: impl Into<String>) -> Result<FileEntry> {
        let bytes = fs::metadata(path).map_err(|e| Error::io(path, e))?.len();
        Ok(FileEntry { name: name.into(), bytes, sha256: sha256_of_file(path)? })
    }
}

/// How the 16-bit gray values of `depth.png` map to mm: z = min_mm + (value − 1)·(max_mm − min_mm)/65534; 0 = none.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct GrayScale {
    /// Depth of value 1, mm.
    pub min_mm: f64,
    /// Depth of value 65535, mm.
    pub max_mm: f64,
}

/// The paper's resolution formulas (15) to (18) for this run's own geometry.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Resolution {
    /// Median distance of the wall, mm.
    pub distance_mm: f64,
    /// C1 of equation (3), mm·px.
    pub c1_mm_px: f64,
    /// C2 of equation (4), px.
    pub c2_px: f64,
    /// Height of the view, mm: (15) from the diagonal angle, by its corrected form.
    pub d_vertical_mm: f64,
    /// Along the line, mm per px (16).
    pub r_vertical_mm: f64,
    /// Along the travel, mm per frame (17).
    pub r_lateral_mm: Option<f64>,
    /// In depth, mm for one px (18).
    pub r_depth_mm: f64,
}

/// How well the run was measured.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// Frames read.
    pub frames: u64,
    /// Frames in which a line was found.
    pub frames_with_stripe: u64,
    /// Frames whose motion was found (of all but the first).
    pub frames_tracked: u64,
    /// Frames whose whole pose was measured: three positions and three angles.
    #[serde(default)]
    pub frames_6_dof: u64,
    /// Frames of which only the position was measured: the angles are the starting ones.
    #[serde(default)]
    pub frames_3_dof: u64,
    /// Breaks of the way: places where the motion was lost so long that the surface begins anew after them.
    #[serde(default)]
    pub breaks: u32,
    /// Share of line positions with a spot, over all frames, 0 to 1.
    pub rows_found: f64,
    /// Spots of the line found in the images.
    #[serde(default)]
    pub spots: u64,
    /// Points measured: spots whose ray meets the laser plane in front of the camera.
    pub points: u64,
    /// Share of map pixels with a depth, 0 to 1.
    pub coverage: f64,
    /// Median over frames of the motion's residual, px.
    pub residual_px: Option<f64>,
    /// How far the last frame's place may be off against the first one's; `None` where the way was broken, too short, or not the
    /// image's.
    #[serde(default)]
    pub drift: Option<Drift>,
    /// Distance travelled, mm.
    pub travel_mm: f64,
    /// Duration of the run, s.
    pub duration_s: f64,
}

/// A stretch of frames without motion, without a stripe, or not all on the map.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Gap {
    /// First frame.
    pub first_frame: u32,
    /// Last frame.
    pub last_frame: u32,
    /// `no_stripe`, `not_tracked`, or `beyond_map`: the map's limits left something of them out.
    pub reason: String,
}

/// A dense recording of a part of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stretch {
    /// The file's name beside the recording of the whole.
    pub name: String,
    /// The smallest world x of the camera in it, mm.
    pub from_x_mm: f64,
    /// The largest world x of the camera in it, mm.
    pub to_x_mm: f64,
    /// First frame.
    pub first_frame: u32,
    /// Last frame.
    pub last_frame: u32,
}

/// `manifest.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// [`SCHEMA_VERSION`].
    pub schema_version: u32,
    /// `stria` and its version.
    pub software: String,
    /// The source's files as read, and the poses given with it.
    pub source: Vec<FileEntry>,
    /// The rig as used.
    pub rig: serde_json::Value,
    /// SHA-256 of the rig's TOML form.
    pub rig_sha256: String,
    /// The recipe as used.
    pub recipe: serde_json::Value,
    /// SHA-256 of the recipe's TOML form.
    pub recipe_sha256: String,
    /// Where the maps lie; absent where nothing was measured.
    pub depth_map: Option<MapGeometry>,
    /// The gray values of `depth.png`.
    pub depth_png: Option<GrayScale>,
    /// Resolution for the run's own geometry.
    pub resolution: Option<Resolution>,
    /// Quality figures.
    pub quality: Quality,
    /// Stretches without data.
    pub gaps: Vec<Gap>,
    /// Dense recordings of stretches of a long run, beside the one of the whole.
    #[serde(default)]
    pub recordings: Vec<Stretch>,
    /// What a person should know.
    pub warnings: Vec<String>,
    /// Seconds of work per stage.
    pub timings_s: BTreeMap<String, f64>,
    /// Every product.
    pub products: Vec<FileEntry>,
}

impl Manifest {
    /// Writes `manifest.json` into the product folder: the last file of a job, since it says that the rest is there.
    pub fn write(&self, folder: &Path) -> Result<()> {
        let path = folder.join(FILE_NAME);
        let mut text = serde_json::to_vec_pretty(self).map_err(|e| Error::internal("manifest", e))?;
        text.push(b'\n');
        new_file::write(&path, &text)
    }

    /// Reads the manifest of a product folder.
    ///
    /// # Errors
    /// Where it is missing, is no manifest, or has another schema version.
    pub fn load(folder: &Path) -> Result<Manifest> {
        let path = folder.join(FILE_NAME);
        let text = fs::read(&path).map_err(|e| Error::io(&path, e))?;
        let subject = path.display().to_string();
        let json: serde_json::Value = serde_json::from_slice(&text)
            .map_err(|e| Error::input(subject.clone(), format!("no JSON ({e})"), "a manifest of stria"))?;
        let version = &json["schema_version"];
        if *version != SCHEMA_VERSION {
            return Err(Error::field(subject, "schema_version", version.to_string(), SCHEMA_VERSION.to_string()));
        }
        serde_json::from_value(json).map_err(|e| Error::input(subject, e.to_string(), "a manifest of stria"))
    }
}

/// SHA-256 of bytes, in lower-case hex.
pub fn sha256_of_bytes(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

/// SHA-256 of a file of any size, in lower-case hex.
pub fn sha256_of_file(path: &Path) -> Result<String> {
    let mut file = File::open(path).map_err(|e| Error::io(path, e))?;
    let mut digest = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    loop {
        match file.read(&mut buffer).map_err(|e| Error::io(path, e))? {
            0 => return Ok(hex(&digest.finalize())),
            length => digest.update(&buffer[..length]),
        }
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

/// Measures and hashes every product in a folder and the folders inside it, in the order of their names
/// (`tiles/depth/0/0_0.png`); not the manifest itself, nor hidden files.
pub fn list_products(folder: &Path) -> Result<Vec<FileEntry>> {
    let mut files = Vec::new();
    list_into(folder, "", &mut files)?;
    files.sort();
    // The large ones are few: each of two threads takes the next file until none is left.
    let next = AtomicUsize::new(0);
    let hash = || -> Result<Vec<FileEntry>> {
        let taken = std::iter::from_fn(|| files.get(next.fetch_add(1, Ordering::Relaxed)));
        taken.map(|(name, path)| FileEntry::of(path, name.clone())).collect()
    };
    let mut entries = std::thread::scope(|scope| {
        let beside = scope.spawn(hash);
        let mut entries = hash()?;
        entries.extend(beside.join().map_err(|_| Error::internal("manifest", "a thread panicked"))??);
        Ok::<_, Error>(entries)
    })?;
    entries.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(entries)
}

/// Name and path of each product.
fn list_into(folder: &Path, prefix: &str, files: &mut Vec<(String, PathBuf)>) -> Result<()> {
    for item in fs::read_dir(folder).map_err(|e| Error::io(folder, e))? {
        let item = item.map_err(|e| Error::io(folder, e))?;
        let name = format!("{prefix}{}", item.file_name().to_string_lossy());
        if item.file_name().to_string_lossy().starts_with('.') || name == FILE_NAME {
            continue;
        }
        let path = item.path();
        if item.file_type().map_err(|e| Error::io(&path, e))?.is_dir() {
            list_into(&path, &format!("{name}/"), files)?;
        } else {
            files.push((name, path));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn manifest(products: Vec<FileEntry>) -> Manifest {
        Manifest {
            schema_version: SCHEMA_VERSION,
            software: "stria 0".into(),
            source: Vec::new(),
            rig: serde_json::json!({"name": "r"}),
            rig_sha256: sha256_of_bytes(b"r"),
            recipe: serde_json::Value::Null,
            recipe_sha256: String::new(),
            depth_map: Some(MapGeometry { x0_mm: 0.1, y0_mm: -2.0, mm_per_px: 0.5, width_px: 3, height_px: 4 }),
            depth_png: None,
            resolution: None,
            quality: Quality::default(),
            gaps: Vec::new(),
            recordings: Vec::new(),
            warnings: vec!["a \"quoted\" name".into()],
            timings_s: BTreeMap::from([("stripe".into(), 1.5)]),
            products,
        }
    }

    #[test]
    fn products_are_listed_hashed_and_read_back() {
        let folder = tempfile::tempdir().expect("temporary folder");
        fs::create_dir_all(folder.path().join("tiles/depth")).expect("folders");
        for (name, text) in [("b.txt", "abc"), ("tiles/depth/a", ""), ("manifest.json", "old"), (".unfinished-x", "")] {
            fs::write(folder.path().join(name), text).expect("write");
        }
        let products = list_products(folder.path()).expect("list");
        assert_eq!(
            products.iter().map(|p| (p.name.as_str(), p.bytes)).collect::<Vec<_>>(),
            [("b.txt", 3), ("tiles/depth/a", 0)]
        );
        // The first test vector of FIPS 180-2.
        assert_eq!(products[0].sha256, "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
        let manifest = manifest(products);
        manifest.write(folder.path()).expect("write");
        assert_eq!(Manifest::load(folder.path()).expect("load"), manifest);
    }

    #[test]
    fn another_version_is_refused_by_name() {
        let folder = tempfile::tempdir().expect("temporary folder");
        fs::write(folder.path().join(FILE_NAME), r#"{"schema_version": 99}"#).expect("write");
        let message = Manifest::load(folder.path()).expect_err("another version").to_string();
        assert!(message.contains("schema_version is 99; expected 1"), "{message}");
    }
}
