//! `report.html`: what was found, on one self-contained page that prints.
//!
//! Pictures are JPEG inside the page, drawings are SVG; nothing is fetched, no script runs. Overview, table, a block for
//! each of the deepest defects, the sections along the chainage, and what the method cannot see.

mod drawings;
mod pictures;
mod text;

use std::fmt::Write;
use std::path::Path;

use crate::defects::{Defect, DefectList, Findings};
use crate::depth_map::MapReader;
use crate::error::Result;
use crate::export::manifest::{Quality, Resolution};
use crate::export::new_file;
use crate::export::residual_tif::{self, ResidualFile};

use pictures::Colours;

/// The file's name in a product folder.
pub const NAME: &str = "report.html";

/// Defects that get a block of their own; the table has all of them.
const MAX_BLOCKS: usize = 150;

/// What the report says about the run besides its defects.
pub struct ReportRun<'a> {
    /// The asset; empty where nobody said.
    pub asset: &'a str,
    /// The source's name.
    pub source: &'a str,
    /// When it was recorded.
    pub recorded_at: jiff::Timestamp,
    /// The rig's name.
    pub rig: &'a str,
    /// `metric` or `paper`.
    pub method: &'a str,
    /// How well it was measured.
    pub quality: &'a Quality,
    /// Its resolution.
    pub resolution: Option<&'a Resolution>,
    /// What a person should know.
    pub warnings: &'a [String],
}

/// Writes the report into a product folder that holds the run's `residual.tif`.
///
/// # Errors
/// A folder without it; what reading the map or the disk says.
pub fn write(run: &ReportRun, findings: &Findings, map: &mut dyn MapReader, folder: &Path) -> Result<()> {
    let mut residual = ResidualFile::open(&folder.join(residual_tif::NAME))?;
    let list = &findings.list;
    let colours = Colours::for_list(list);
    let mut page = String::with_capacity(1 << 20);
    text::head(&mut page, run, list);
    page.push_str("<h2>Overview</h2>");
    overview(&mut page, list, &mut residual, &colours)?;
    text::table(&mut page, list);
    let mut deepest: Vec<&Defect> = list.defects.iter().collect();
    deepest.sort_by(|a, b| b.depth_mm.abs().total_cmp(&a.depth_mm.abs()));
    deepest.truncate(MAX_BLOCKS);
    deepest.sort_by_key(|defect| defect.id);
    if !deepest.is_empty() {
        page.push_str("<h2>Defects one by one</h2>");
        if list.defects.len() > MAX_BLOCKS {
            let _ = write!(page, "<p>The {MAX_BLOCKS} deepest of {}; the table lists all.</p>", list.defects.len());
        }
    }
    for defect in deepest {
        let views = pictures::views(defect, map, &mut residual, &colours)?;
        text::block(&mut page, defect, &views);
    }
    if findings.sections.len() > 1 {
        page.push_str("<h2>Sections along the chainage</h2>");
        drawings::sections(&mut page, &findings.sections);
    }
    text::method(&mut page, run, list);
    page.push_str("</body></html>\n");
    new_file::write(&folder.join(NAME), page.as_bytes())
}

/// The residual map in strips like lines of text, with the defects' numbers.
fn overview(page: &mut String, list: &DefectList, residual: &mut ResidualFile, colours: &Colours) -> Result<()> {
    let strips = pictures::strips(residual, colours)?;
    for strip in &strips {
        drawings::strip(page, strip, list);
    }
    drawings::legend(page, colours);
    Ok(())
}
