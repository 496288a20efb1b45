//! Wide maps as numbered parts: PNG and JPEG readers give up long before a tunnel ends.

use std::ops::Range;

/// Widest PNG or JPEG map, px.
pub const MAX_PART_WIDTH_PX: usize = 32_768;

/// One file of a map in PNG or JPEG.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Part {
    /// `depth.png`; with more than one part `depth-0001.png`, `depth-0002.png` and so on.
    pub name: String,
    /// The map's column that is this file's first.
    pub first_column_px: usize,
    /// Columns.
    pub width_px: usize,
}

impl Part {
    /// The map's columns that it holds.
    pub fn columns(&self) -> Range<usize> {
        self.first_column_px..self.first_column_px + self.width_px
    }
}

/// The files that a map of `width_px` columns needs, from left to right.
pub fn parts(stem: &str, extension: &str, width_px: usize) -> Vec<Part> {
    let count = width_px.div_ceil(MAX_PART_WIDTH_PX);
    (0..count)
        .map(|index| {
            let first_column_px = index * MAX_PART_WIDTH_PX;
            let number = if count == 1 { String::new() } else { format!("-{:04}", index + 1) };
            Part {
                name: format!("{stem}{number}.{extension}"),
                first_column_px,
                width_px: MAX_PART_WIDTH_PX.min(width_px - first_column_px),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_cover_every_column_once() {
        assert_eq!(
            parts("depth", "png", 32_768),
            [Part { name: "depth.png".into(), first_column_px: 0, width_px: 32_768 }]
        );
        let three = parts("depth", "png", 65_537);
        assert_eq!(
            three.iter().map(|p| p.name.as_str()).collect::<Vec<_>>(),
            ["depth-0001.png", "depth-0002.png", "depth-0003.png"]
        );
        assert_eq!(three[2], Part { name: "depth-0003.png".into(), first_column_px: 65_536, width_px: 1 });
        assert!(parts("depth", "png", 0).is_empty());
    }
}
