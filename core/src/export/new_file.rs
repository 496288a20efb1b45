//! A file that appears under its name only when it is complete.

use std::fs::{File, Permissions};
use std::io::{self, BufWriter, Read, Seek, SeekFrom, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

use crate::error::{Error, Result};

/// How a temporary name starts: hidden, so that no list of products shows it.
pub(crate) const TEMPORARY_PREFIX: &str = ".unfinished-";

/// A file being written under a temporary name in its folder. Dropped without [`NewFile::commit`], it vanishes.
pub struct NewFile {
    path: PathBuf,
    file: BufWriter<NamedTempFile>,
}

impl NewFile {
    /// Starts the file that shall be called `path`; its folder must exist.
    pub fn create(path: &Path) -> Result<NewFile> {
        let file = tempfile::Builder::new()
            .prefix(TEMPORARY_PREFIX)
            // As any other new file: what the user's mask allows.
            .permissions(Permissions::from_mode(0o666))
            .tempfile_in(folder_of(path))
            .map_err(|e| Error::io(path, e))?;
        Ok(NewFile { path: path.to_path_buf(), file: BufWriter::with_capacity(1 << 20, file) })
    }

    /// Its final name.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Appends bytes, or overwrites at the place of a seek.
    pub fn put(&mut self, bytes: &[u8]) -> Result<()> {
        self.file.write_all(bytes).map_err(|e| Error::io(&self.path, e))
    }

    /// Goes to a place, counted from the start, bytes.
    pub fn go_to(&mut self, position_bytes: u64) -> Result<()> {
        self.file.seek(SeekFrom::Start(position_bytes)).map_err(|e| Error::io(&self.path, e)).map(|_| ())
    }

    /// Puts the file on the disk and gives it its name; what had that name before is replaced.
    pub fn commit(self) -> Result<()> {
        let path = self.path.clone();
        self.rename(true)?;
        sync_folder(folder_of(&path))
    }

    /// As [`NewFile::commit`], but a loss of power may still take the file away: for the many small files
    /// that are cheap to make again.
    pub fn commit_without_sync(self) -> Result<()> {
        self.rename(false)
    }

    fn rename(self, sync: bool) -> Result<()> {
        let NewFile { path, file } = self;
        let file = file.into_inner().map_err(|e| Error::io(&path, e.into_error()))?;
        if sync {
            file.as_file().sync_all().map_err(|e| Error::io(&path, e))?;
        }
        file.persist(&path).map_err(|e| Error::io(&path, e.error)).map(|_| ())
    }
}

impl Write for NewFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// What was written can be read back, for formats that mend their pages.
impl Read for NewFile {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        self.file.flush()?;
        self.file.get_mut().read(bytes)
    }
}

impl Seek for NewFile {
    fn seek(&mut self, position: SeekFrom) -> io::Result<u64> {
        self.file.seek(position)
    }
}

/// Writes a whole small file.
pub fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    let mut file = NewFile::create(path)?;
    file.put(bytes)?;
    file.commit()
}

/// The folder of a file; a bare name lies in the current one.
pub(crate) fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    }
}

/// A rename survives a loss of power only once the folder itself is on the disk.
fn sync_folder(folder: &Path) -> Result<()> {
    File::open(folder).and_then(|f| f.sync_all()).map_err(|e| Error::io(folder, e))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_has_the_name_before_commit_and_nothing_stays_without_it() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("a.txt");
        let mut file = NewFile::create(&path).expect("create");
        file.put(b"half").expect("put");
        assert!(!path.exists());
        drop(file);
        assert_eq!(std::fs::read_dir(folder.path()).expect("list").count(), 0);

        let mut file = NewFile::create(&path).expect("create");
        file.put(b"....whole").expect("put");
        file.go_to(0).expect("seek");
        file.put(b"the ").expect("put");
        file.commit().expect("commit");
        assert_eq!(std::fs::read(&path).expect("read"), b"the whole");
        assert_eq!(std::fs::read_dir(folder.path()).expect("list").count(), 1);
        let mode = std::fs::metadata(&path).expect("metadata").permissions().mode();
        assert_eq!(mode & 0o400, 0o400);
    }

    #[test]
    fn a_missing_folder_is_an_error_with_the_path() {
        let error = write(Path::new("/nowhere-at-all/a.txt"), b"x").expect_err("no such folder");
        assert!(error.to_string().starts_with("/nowhere-at-all/a.txt: "), "{error}");
    }
}
