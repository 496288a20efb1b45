//! `change.json`, `change.csv` and `difference.tif`: what changed between two runs; [`crate::defects::change`] says what the
//! figures mean.

use std::path::Path;

use crate::defects::change::{self, ChangeList, ChangeState};
use crate::error::{Error, Result};
use crate::export::defect_list::{self, push};
use crate::export::new_file;
use crate::export::residual_tif::{self, ResidualFile, ResidualWriter};
use crate::recipe::DefectOptions;

/// The list's name.
pub const JSON_NAME: &str = "change.json";
/// The table's name.
pub const CSV_NAME: &str = "change.csv";
/// The map's name: later less earlier, mm, in the earlier run's world.
pub const MAP_NAME: &str = "difference.tif";

/// The first line of the table.
pub const HEADER: &str = "id,state,chainage_mm,clock_h,height_mm,x_mm,y_mm,delta_depth_mm,area_mm2,volume_mm3,confidence,\
                          before_id,before_depth_mm,after_id,after_depth_mm,delta_sd_mm";

/// Compares two product folders and writes the three files into `out`, which must exist.
///
/// # Errors
/// Folders without `defects.json` and `residual.tif`; runs that cannot be compared.
pub fn compare_folders(before: &Path, after: &Path, options: &DefectOptions, out: &Path) -> Result<ChangeList> {
    let (list_before, list_after) = (defect_list::load(before)?, defect_list::load(after)?);
    let mut map_before = ResidualFile::open(&before.join(residual_tif::NAME))?;
    let mut map_after = ResidualFile::open(&after.join(residual_tif::NAME))?;
    let mut difference = ResidualWriter::new(out, MAP_NAME);
    let list = change::compare(
        &mut change::Run { residual: &mut map_before, list: &list_before },
        &mut change::Run { residual: &mut map_after, list: &list_after },
        options,
        &mut |strip| difference.push(strip),
    )?;
    difference.finish()?;
    write(&list, out)?;
    Ok(list)
}

fn write(list: &ChangeList, folder: &Path) -> Result<()> {
    let mut json = serde_json::to_value(list).map_err(|e| Error::internal("change.json", e))?;
    defect_list::round_numbers(&mut json);
    let mut text = serde_json::to_vec_pretty(&json).map_err(|e| Error::internal("change.json", e))?;
    text.push(b'\n');
    new_file::write(&folder.join(JSON_NAME), &text)?;
    let mut table = String::from(HEADER);
    table.push('\n');
    let id = |id: Option<u32>| id.map_or(String::new(), |id| id.to_string());
    for change in &list.changes {
        let mut line = format!("{},{}", change.id, state_name(change.state));
        let numbers = [
            (Some(change.chainage_mm), 2),
            (change.clock_h, 3),
            (change.height_mm, 2),
            (Some(change.x_mm), 2),
            (Some(change.y_mm), 2),
            (Some(change.delta_depth_mm), 3),
            (Some(change.area_mm2), 1),
            (Some(change.volume_mm3), 1),
            (Some(change.confidence), 3),
        ];
        for (value, decimals) in numbers {
            push(&mut line, value, decimals);
        }
        line.push(',');
        line.push_str(&id(change.before_id));
        push(&mut line, change.before_depth_mm, 3);
        line.push(',');
        line.push_str(&id(change.after_id));
        push(&mut line, change.after_depth_mm, 3);
        push(&mut line, Some(change.delta_sd_mm), 3);
        line.push('\n');
        table.push_str(&line);
    }
    new_file::write(&folder.join(CSV_NAME), table.as_bytes())
}

/// As the files write it.
pub fn state_name(state: ChangeState) -> &'static str {
    match state {
        ChangeState::New => "new",
        ChangeState::Grown => "grown",
        ChangeState::Shrunk => "shrunk",
        ChangeState::Vanished => "vanished",
        ChangeState::Changed => "changed",
    }
}
