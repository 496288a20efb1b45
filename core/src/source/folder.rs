//! A folder of images, sorted by name (2 before 10), as the frames of a run.

use std::cmp::Ordering;
use std::path::{Path, PathBuf};

use super::video::{Video, display_name};
use super::{Frame, Source, SourceInfo};
use crate::error::{Error, Result};

/// Names that count as images.
pub(super) const EXTENSIONS: [&str; 9] = ["jpg", "jpeg", "png", "webp", "tif", "tiff", "bmp", "pgm", "ppm"];

/// An open folder.
pub(super) struct Folder {
    info: SourceInfo,
    name: String,
    fps: f64,
    next: usize,
    skipped: Vec<String>,
}

/// The folder's images in order; an error where there are none.
pub(super) fn image_files(path: &Path, name: &str) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(path).map_err(|e| Error::io(path, e))? {
        let file = entry.map_err(|e| Error::io(path, e))?.path();
        let extension = file.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
        if EXTENSIONS.contains(&extension.as_str()) && file.is_file() {
            files.push(file);
        }
    }
    if files.is_empty() {
        return Err(Error::input(name, "a folder without images", format!("images ({})", EXTENSIONS.join(", "))));
    }
    files.sort_by(|a, b| natural_order(&a.to_string_lossy(), &b.to_string_lossy()));
    Ok(files)
}

impl Folder {
    pub(super) fn open(path: &Path, name: &str, fps: f64) -> Result<Folder> {
        let files = image_files(path, name)?;
        let first = Video::open(&files[0], &display_name(&files[0]))?;
        let info = SourceInfo {
            width_px: first.width_px,
            height_px: first.height_px,
            frames_announced: Some(files.len() as u64),
            frames_per_s: Some(fps),
            files,
            still_open: false,
        };
        Ok(Folder { info, name: name.to_string(), fps, next: 0, skipped: Vec::new() })
    }

    fn read(&self, file: &Path) -> Result<super::Image> {
        let label = display_name(file);
        let picture = Video::open(file, &label)?.next_picture()?;
        let image = picture.ok_or_else(|| Error::input(&label, "no picture in it", "a whole image"))?.image;
        if (image.width_px(), image.height_px()) != (self.info.width_px, self.info.height_px) {
            return Err(Error::field(
                label,
                "image size",
                format!("{}x{} px", image.width_px(), image.height_px()),
                format!("{}x{} px like the first image of {}", self.info.width_px, self.info.height_px, self.name),
            ));
        }
        Ok(image)
    }
}

impl Source for Folder {
    fn info(&self) -> &SourceInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Frame>> {
        while let Some(file) = self.info.files.get(self.next) {
            let index = self.next as u32;
            let image = self.read(file);
            self.next += 1;
            match image {
                Ok(image) => return Ok(Some(Frame { index, time_s: f64::from(index) / self.fps, image })),
                Err(error @ Error::Input { .. }) => self.skipped.push(error.to_string()),
                Err(error) => return Err(error),
            }
        }
        Ok(None)
    }

    fn warnings(&self) -> Vec<String> {
        match self.skipped.as_slice() {
            [] => Vec::new(),
            [first, ..] => {
                vec![format!("{}: {} images were left out; the first: {first}", self.name, self.skipped.len())]
            }
        }
    }
}

/// Orders names so that numbers inside them count as numbers.
pub(super) fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut a, mut b) = (a.as_bytes(), b.as_bytes());
    loop {
        match (a.first(), b.first()) {
            (None, None) => return Ordering::Equal,
            (None, _) => return Ordering::Less,
            (_, None) => return Ordering::Greater,
            (Some(x), Some(y)) if x.is_ascii_digit() && y.is_ascii_digit() => {
                let (digits_a, digits_b) = (leading_digits(a), leading_digits(b));
                let (value_a, value_b) = (strip_zeros(digits_a), strip_zeros(digits_b));
                let order = value_a.len().cmp(&value_b.len()).then(value_a.cmp(value_b));
                if order != Ordering::Equal {
                    return order;
                }
                (a, b) = (&a[digits_a.len()..], &b[digits_b.len()..]);
            }
            (Some(x), Some(y)) if x != y => return x.cmp(y),
            _ => (a, b) = (&a[1..], &b[1..]),
        }
    }
}

fn leading_digits(text: &[u8]) -> &[u8] {
    &text[..text.iter().take_while(|b| b.is_ascii_digit()).count()]
}

fn strip_zeros(digits: &[u8]) -> &[u8] {
    &digits[digits.iter().take_while(|b| **b == b'0').count()..]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_in_names_count_as_numbers() {
        let mut names = ["img10.jpg", "img2.jpg", "img0003.jpg", "a.jpg", "img2b.jpg"];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(names, ["a.jpg", "img2.jpg", "img2b.jpg", "img0003.jpg", "img10.jpg"]);
    }

    #[test]
    fn an_empty_folder_is_named() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let message = image_files(folder.path(), "run7").expect_err("empty").to_string();
        assert!(message.contains("run7") && message.contains("png"), "{message}");
    }
}
