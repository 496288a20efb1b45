//! The names of files in the store, all made here.

use std::path::Path;

use object_store::path::Path as ObjectPath;

/// Longest name of a product, characters.
const MAX_NAME_CHARS: usize = 200;

/// Longest file name extension that a source keeps.
const MAX_EXTENSION_CHARS: usize = 8;

/// The name of one file in the store.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Key(pub(super) ObjectPath);

impl Key {
    pub(super) fn new(text: String) -> Key {
        Key(ObjectPath::from(text))
    }

    /// A run's images, in one file.
    pub fn source(run: &str, extension: &str) -> Key {
        Key::new(format!("{}source{}", run_prefix(run), dotted(extension)))
    }

    /// A part of a run's images, from 0. The fence keeps a connection that was taken over from writing into its
    /// successor's segments.
    pub fn source_segment(run: &str, number: u32, fence: i64, extension: &str) -> Key {
        Key::new(format!("{}segments/{number:06}-{fence}{}", run_prefix(run), dotted(extension)))
    }

    /// A part of an upload that is not a run yet, from 0.
    pub fn upload_part(upload: &str, number: u32) -> Key {
        Key::new(format!("{}{number:06}", upload_prefix(upload)))
    }

    /// An upload that is not a run yet, in one file.
    pub fn upload(upload: &str) -> Key {
        Key::new(format!("{}whole", upload_prefix(upload)))
    }

    /// A product of an attempt.
    pub fn product(job: &str, fence: i64, name: &ProductName) -> Key {
        Key::new(format!("{}products/{}", attempt_prefix(job, fence), name.0))
    }

    /// A recording segment of an attempt.
    pub fn segment(job: &str, fence: i64, number: u32) -> Key {
        Key::new(format!("{}recording/{number:06}.rrd", attempt_prefix(job, fence)))
    }

    /// A key as a backup lists it.
    pub fn of_backup(text: &str) -> Key {
        Key::new(text.into())
    }

    /// The last part of the name.
    pub fn filename(&self) -> &str {
        self.0.filename().unwrap_or_default()
    }

    /// The whole name.
    pub fn as_str(&self) -> &str {
        self.0.as_ref()
    }
}

fn dotted(extension: &str) -> String {
    if extension.is_empty() { String::new() } else { format!(".{extension}") }
}

/// Everything of a run that is not its jobs'.
pub fn run_prefix(run: &str) -> String {
    format!("runs/{run}/")
}

/// Everything of an upload that is not a run yet.
pub fn upload_prefix(upload: &str) -> String {
    format!("uploads/{upload}/")
}

/// Everything of a job.
pub fn job_prefix(job: &str) -> String {
    format!("jobs/{job}/")
}

/// Everything of one attempt at a job.
pub fn attempt_prefix(job: &str, fence: i64) -> String {
    format!("jobs/{job}/{fence:06}/")
}

/// The path of a product inside its folder: plain words with `/` between them, so that it can be no path elsewhere.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ProductName(String);

impl ProductName {
    /// Checks a name; `None` where it is none that a pipeline would give.
    pub fn new(name: &str) -> Option<ProductName> {
        let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
        let word = |w: &str| !w.is_empty() && !w.starts_with('.') && w.chars().all(plain);
        (name.len() <= MAX_NAME_CHARS && name.split('/').all(word)).then(|| ProductName(name.into()))
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// The extension of an uploaded file's name, where it is a plain one; a hint for FFmpeg, nothing more.
pub fn plain_extension(filename: &str) -> String {
    let extension = Path::new(filename).extension().and_then(|e| e.to_str()).unwrap_or_default();
    let plain = extension.len() <= MAX_EXTENSION_CHARS && extension.chars().all(|c| c.is_ascii_alphanumeric());
    if plain { extension.to_ascii_lowercase() } else { String::new() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_could_be_paths_are_refused() {
        for name in ["depth.tif", "tiles/depth/3/0_1.png", "cloud-2.ply", "report_v1.html"] {
            assert!(ProductName::new(name).is_some(), "{name}");
        }
        for name in ["", "..", "../x", "a//b", "/etc/passwd", "a/../b", ".hidden", "a\\b", "a b", "é", "a%2fb", "a\0b"]
        {
            assert!(ProductName::new(name).is_none(), "{name:?}");
        }
        assert!(ProductName::new(&"a".repeat(MAX_NAME_CHARS + 1)).is_none());
    }

    #[test]
    fn only_plain_extensions_are_kept() {
        for (name, extension) in
            [("run.MP4", "mp4"), ("../../x.mkv", "mkv"), ("a.m p4", ""), ("a.abcdefghi", ""), ("a", ""), ("a.\"x", "")]
        {
            assert_eq!(plain_extension(name), extension, "{name}");
        }
    }

    #[test]
    fn keys_sort_by_their_numbers() {
        assert_eq!(Key::source_segment("r", 7, 2, "mp4").as_str(), "runs/r/segments/000007-2.mp4");
        assert_eq!(Key::source_segment("r", 7, 2, "mp4").filename(), "000007-2.mp4");
        assert!(Key::upload_part("u", 9) < Key::upload_part("u", 10));
    }
}
