//! Photos from files, folders and videos.

use std::path::PathBuf;

use crate::error::{Error, Result};
use crate::source::{self, Image};

/// Most photos of one calibration: a hundred poses say all that can be said, and each is held in memory.
const MAX_PHOTOS: usize = 200;
/// Most bytes of pixels held at once.
const MAX_BYTES: usize = 3 << 30;

/// A photo with a name for messages.
pub struct Photo {
    /// File name; with a number for a video's frames.
    pub name: String,
    /// The pixels.
    pub image: Image,
}

/// Reads all photos, and what went wrong without ending the reading.
///
/// # Errors
/// Files that are no images, none at all, more than 200, sizes that differ.
pub fn read(paths: &[PathBuf], mut progress: impl FnMut(usize) -> Result<()>) -> Result<(Vec<Photo>, Vec<String>)> {
    let (mut photos, mut warnings) = (Vec::<Photo>::new(), Vec::new());
    let mut bytes = 0;
    for path in paths {
        let label = path.display().to_string();
        let mut source = source::open(path, &label, None)?;
        let files = source.info().files.clone();
        let before = photos.len();
        while let Some(frame) = source.next_frame()? {
            let file = files.get(frame.index as usize).or(files.first()).unwrap_or(path);
            let file = file.file_name().map_or_else(|| label.clone(), |n| n.to_string_lossy().into_owned());
            let name = if files.len() == 1 && frame.index > 0 { format!("{file}#{}", frame.index) } else { file };
            bytes += frame.image.bgr().len();
            if photos.len() == MAX_PHOTOS || bytes > MAX_BYTES {
                let found = format!("more than {} photos", photos.len());
                return Err(Error::input(label, found, "12 to 30 photos of the board in different poses"));
            }
            check_size(&photos, &name, &frame.image)?;
            photos.push(Photo { name, image: frame.image });
            progress(photos.len())?;
        }
        if photos.len() == before {
            return Err(Error::input(label, "no picture in it", "photos of the board"));
        }
        warnings.extend(source.warnings());
    }
    Ok((photos, warnings))
}

fn check_size(photos: &[Photo], name: &str, image: &Image) -> Result<()> {
    let size = |image: &Image| (image.width_px(), image.height_px());
    match photos.first() {
        Some(first) if size(&first.image) != size(image) => Err(Error::field(
            name,
            "image size",
            format!("{}x{} px", image.width_px(), image.height_px()),
            format!(
                "{}x{} px like {}: one camera, one setting",
                first.image.width_px(),
                first.image.height_px(),
                first.name
            ),
        )),
        _ => Ok(()),
    }
}
