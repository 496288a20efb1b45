//! `sections.csv`: measures of the cross-section along the chainage, one line a stretch; what does not apply is empty.

use std::path::Path;

use crate::defects::SectionRow;
use crate::error::Result;
use crate::export::defect_list::push;
use crate::export::new_file;

/// The file's name in a product folder.
pub const NAME: &str = "sections.csv";

/// The first line.
pub const HEADER: &str = "chainage_mm,x_mm,measured_share,radius_mm,mean_radius_mm,diameter_mm,ovality_percent,ovality_sd_percent,arc_deg,\
                          radius_loss_mm,flatness_mm,flatness_rms_mm,roughness_mm,deviation_min_mm,deviation_max_mm";

/// Writes the rows into a product folder.
pub fn write(rows: &[SectionRow], folder: &Path) -> Result<()> {
    let mut table = String::from(HEADER);
    for row in rows {
        let mut line = format!("\n{:.2}", row.chainage_mm + 0.0);
        let numbers = [
            (Some(row.x_mm), 2),
            (Some(row.measured_share), 4),
            (row.radius_mm, 3),
            (row.mean_radius_mm, 3),
            (row.diameter_mm, 3),
            (row.ovality_percent, 4),
            (row.ovality_sd_percent, 4),
            (row.arc_deg, 2),
            (row.radius_loss_mm, 3),
            (row.flatness_mm, 3),
            (row.flatness_rms_mm, 3),
            (Some(row.roughness_mm), 4),
            (Some(row.deviation_min_mm).filter(|v| v.is_finite()), 3),
            (Some(row.deviation_max_mm).filter(|v| v.is_finite()), 3),
        ];
        for (value, decimals) in numbers {
            push(&mut line, value, decimals);
        }
        table.push_str(&line);
    }
    table.push('\n');
    new_file::write(&folder.join(NAME), table.as_bytes())
}
