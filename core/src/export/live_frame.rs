//! `live/frame.jpg` and `live/frame.json`: the newest frame of a run that is being measured, small, and the stripe found
//! in it, for those who watch. They are no products: at the end they are gone.

use std::path::{Path, PathBuf};

use jpeg_encoder::{ColorType, Encoder};
use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::export::new_file::NewFile;
use crate::rig::{Camera, LineDirection};
use crate::source::Image;
use crate::stripe::Stripe;

/// The folder inside the product folder.
pub const FOLDER: &str = "live";
/// Least time between two frames, s of the run.
const INTERVAL_S: f64 = 0.5;
/// Widest picture, px.
const MOST_WIDTH_PX: u32 = 640;
/// JPEG quality, 1 to 100.
const QUALITY: u8 = 70;
/// The stripe is told at no more positions than these.
const MOST_POSITIONS: usize = 360;

/// `live/frame.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LiveFrame {
    /// The frame's place in the run, from 0.
    pub frame: u32,
    /// Its time since the first frame, s.
    pub time_s: f64,
    /// Width of the whole frame, px.
    pub width_px: u32,
    /// Height of the whole frame, px.
    pub height_px: u32,
    /// Image column and row of the stripe's spots in the whole frame, px.
    pub spots_px: Vec<[f32; 2]>,
    /// Line positions where the line was found.
    pub rows_found: usize,
    /// Line positions in all.
    pub rows: usize,
    /// Where the camera is along the run, mm; `None` where its motion is lost.
    pub x_mm: Option<f64>,
}

/// Writes the newest frame, now and then.
pub struct LiveFrameWriter {
    folder: PathBuf,
    /// Of the whole frames.
    width_px: u32,
    height_px: u32,
    last_s: Option<f64>,
}

impl LiveFrameWriter {
    /// Makes `live/` in the product folder, for frames of this camera.
    pub fn create(product_folder: &Path, camera: &Camera) -> Result<LiveFrameWriter> {
        let folder = product_folder.join(FOLDER);
        std::fs::create_dir_all(&folder).map_err(|e| Error::io(&folder, e))?;
        Ok(LiveFrameWriter { folder, width_px: camera.width_px, height_px: camera.height_px, last_s: None })
    }

    /// Whether it is time for another frame.
    pub fn due(&self, time_s: f64) -> bool {
        self.last_s.is_none_or(|last_s| time_s - last_s >= INTERVAL_S)
    }

    /// Writes a frame, of which `image` is as much as is at hand: whole, or smaller already. Answers what was written:
    /// names inside the product folder.
    ///
    /// # Errors
    /// What the disk says.
    pub fn put(
        &mut self,
        (frame, time_s): (u32, f64),
        image: &Image,
        stripe: &Stripe,
        x_mm: Option<f64>,
    ) -> Result<Vec<String>> {
        self.last_s = Some(time_s);
        let shrink = image.width_px().div_ceil(MOST_WIDTH_PX).min(image.height_px()).max(1);
        let small = image.shrunk_bgr(shrink as usize);
        let mut jpeg = Vec::new();
        Encoder::new(&mut jpeg, QUALITY)
            .encode(&small, (image.width_px() / shrink) as u16, (image.height_px() / shrink) as u16, ColorType::Bgr)
            .map_err(|e| Error::internal("live frame", e))?;
        let step = stripe.across_px.len().div_ceil(MOST_POSITIONS).max(1);
        let about = LiveFrame {
            frame,
            time_s,
            width_px: self.width_px,
            height_px: self.height_px,
            spots_px: stripe
                .spots()
                .filter(|(position, _)| position % step == 0)
                .map(|(_, pixel)| [pixel.u_px as f32, pixel.v_px as f32])
                .collect(),
            rows_found: stripe.found(),
            rows: match stripe.line {
                LineDirection::Vertical => self.height_px as usize,
                LineDirection::Horizontal => self.width_px as usize,
            },
            x_mm,
        };
        let json = serde_json::to_vec(&about).map_err(|e| Error::internal("live frame", e))?;
        self.write("frame.jpg", &jpeg)?;
        self.write("frame.json", &json)?;
        Ok(["frame.jpg", "frame.json"].map(|name| format!("{FOLDER}/{name}")).to_vec())
    }

    fn write(&self, name: &str, bytes: &[u8]) -> Result<()> {
        let mut file = NewFile::create(&self.folder.join(name))?;
        file.put(bytes)?;
        file.commit_without_sync()
    }
}

/// Takes the folder away.
///
/// # Errors
/// What the disk says, but for a folder that is not there.
pub fn remove(product_folder: &Path) -> Result<()> {
    let folder = product_folder.join(FOLDER);
    match std::fs::remove_dir_all(&folder) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::io(folder, e)),
        _ => Ok(()),
    }
}
