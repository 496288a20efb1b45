//! NumPy `.npy` files (format version 1.0): a two-dimensional array, written row by row.

use std::path::Path;

use crate::error::{Error, Result};
use crate::export::new_file::{self, NewFile};

/// Fixed size of magic, version, length and header: the row count is patched in at the end.
const HEADER_BYTES: usize = 128;

/// Writes a float32 array `[rows, columns]` of which the number of rows is known only at the end.
pub struct NpyWriter {
    file: NewFile,
    columns: usize,
    rows: usize,
}

impl NpyWriter {
    /// Starts the file.
    pub fn create(path: &Path, columns: usize) -> Result<NpyWriter> {
        let mut file = NewFile::create(path)?;
        file.put(&header("<f4", 0, columns))?;
        Ok(NpyWriter { file, columns, rows: 0 })
    }

    /// Appends one row of `columns` values.
    pub fn push_row(&mut self, row: &[f32]) -> Result<()> {
        assert_eq!(row.len(), self.columns, "a row of another length");
        let bytes: Vec<u8> = row.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.file.put(&bytes)?;
        self.rows += 1;
        Ok(())
    }

    /// Writes the number of rows into the header and gives the file its name.
    pub fn finish(mut self) -> Result<()> {
        self.file.go_to(0)?;
        self.file.put(&header("<f4", self.rows, self.columns))?;
        self.file.commit()
    }
}

/// Writes a boolean array `[rows, columns]` in one go.
pub fn write_bool(path: &Path, columns: usize, values: &[bool]) -> Result<()> {
    assert_eq!(values.len() % columns.max(1), 0, "whole rows");
    let mut bytes = header("|b1", values.len() / columns.max(1), columns);
    bytes.extend(values.iter().map(|v| u8::from(*v)));
    new_file::write(path, &bytes)
}

fn header(descr: &str, rows: usize, columns: usize) -> Vec<u8> {
    let mut text = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({rows}, {columns}), }}");
    while text.len() < HEADER_BYTES - 11 {
        text.push(' ');
    }
    text.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend(((HEADER_BYTES - 10) as u16).to_le_bytes());
    bytes.extend(text.as_bytes());
    bytes
}

/// Reads a float32 array back: (rows, columns, values).
pub fn read_f32(path: &Path) -> Result<(usize, usize, Vec<f32>)> {
    let subject = path.display().to_string();
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, e))?;
    let bad = |found: &str| Error::input(subject.clone(), found, "a two-dimensional little-endian float32 .npy file");
    if bytes.len() < 10 || &bytes[..6] != b"\x93NUMPY" {
        return Err(bad("no .npy magic"));
    }
    let start = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let text = bytes.get(10..start).and_then(|b| std::str::from_utf8(b).ok()).ok_or_else(|| bad("a broken header"))?;
    if !text.contains("'<f4'") || text.contains("'fortran_order': True") {
        return Err(bad("another element type or order"));
    }
    let shape = text.split('(').nth(1).and_then(|s| s.split(')').next()).ok_or_else(|| bad("no shape"))?;
    let sides: Vec<usize> = shape.split(',').filter_map(|s| s.trim().parse().ok()).collect();
    let [rows, columns] = sides[..] else { return Err(bad("another number of dimensions")) };
    let values: Vec<f32> =
        bytes[start..].chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    if values.len() != rows * columns {
        return Err(bad("fewer values than its shape says"));
    }
    Ok((rows, columns, values))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_come_back() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("a.npy");
        let mut writer = NpyWriter::create(&path, 3).expect("create");
        writer.push_row(&[1.0, f32::NAN, -2.5]).expect("row");
        writer.push_row(&[4.0, 5.0, 6.0]).expect("row");
        writer.finish().expect("finish");
        let (rows, columns, values) = read_f32(&path).expect("read");
        assert_eq!((rows, columns), (2, 3));
        assert!(values[1].is_nan() && values[2] == -2.5 && values[5] == 6.0);
    }
}
