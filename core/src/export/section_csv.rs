//! A cross-section of the wall as CSV: `distance_mm,chainage_mm,x_mm,y_mm,z_mm`, one line a point; z is empty where nothing
//! was measured.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use crate::error::{Error, Result};
use crate::export::depth_tif::section::{self, Cut, Section};
use crate::export::new_file;

/// Points of a section in a file, at most.
pub const MAX_POINTS: usize = 1_000_000;

/// A section as text; `chainage_mm` gives the chainage of a world x.
pub fn text(section: &Section, chainage_mm: impl Fn(f64) -> f64) -> String {
    let mut text = String::from("distance_mm,chainage_mm,x_mm,y_mm,z_mm\n");
    for point in &section.points {
        let z = if point.z_mm.is_finite() { point.z_mm.to_string() } else { String::new() };
        let (distance, chainage) = (point.distance_mm, chainage_mm(point.x_mm));
        text.push_str(&format!("{distance:.3},{chainage:.3},{:.3},{:.3},{z}\n", point.x_mm, point.y_mm));
    }
    text
}

/// Cuts the map at `map` open and writes the section to `path`; says how many of its points have a depth, and how many
/// there are.
///
/// # Errors
/// What is no map of Stria's; a section beside the map or of more than [`MAX_POINTS`]; a full disk.
pub fn write(path: &Path, map: &Path, cut: Cut, chainage_mm: impl Fn(f64) -> f64) -> Result<(usize, usize)> {
    let file = BufReader::new(File::open(map).map_err(|e| Error::io(map, e))?);
    let section = section::cut(file, cut, None, MAX_POINTS)?;
    let g = section.map;
    let end = |start: f64, count: usize| start + count.saturating_sub(1) as f64 * g.mm_per_px;
    let on_map = |x: f64, start: f64, count: usize| x > start - g.mm_per_px && x < end(start, count) + g.mm_per_px;
    let inside =
        |p: &section::SectionPoint| on_map(p.x_mm, g.x0_mm, g.width_px) && on_map(p.y_mm, g.y0_mm, g.height_px);
    if !section.points.iter().any(inside) {
        let (chainage, x_end, y_end) = (chainage_mm(g.x0_mm), end(g.x0_mm, g.width_px), end(g.y0_mm, g.height_px));
        return Err(Error::input(
            "the section",
            format!("beside the map ({cut:?})"),
            format!("chainage from {chainage:.1} to {:.1}, y from {:.1} to {y_end:.1} mm", chainage_mm(x_end), g.y0_mm),
        ));
    }
    new_file::write(path, text(&section, chainage_mm).as_bytes())?;
    let measured = section.points.iter().filter(|point| point.z_mm.is_finite()).count();
    Ok((measured, section.points.len()))
}
