//! `defects.json` and `defects.csv`: the list of defects; [`crate::defects`] says what the figures mean.

use std::fmt::Write;
use std::path::Path;

use crate::defects::{Defect, DefectList, SCHEMA_VERSION};
use crate::error::{Error, Result};
use crate::export::new_file;

/// The list's name in a product folder.
pub const JSON_NAME: &str = "defects.json";
/// The table's name in a product folder.
pub const CSV_NAME: &str = "defects.csv";

/// The first line of the table.
pub const HEADER: &str = "id,kind,severity,code,chainage_mm,clock_h,height_mm,x_mm,y_mm,z_mm,depth_mm,depth_normal_mm,\
                          length_mm,width_mm,area_mm2,surface_area_mm2,volume_mm3,steepest_slope_deg,confidence,noise_mm,\
                          measured_share,at_edge,deepest_x_mm,deepest_y_mm,depth_sd_mm";

/// Writes both files into a product folder.
pub fn write(list: &DefectList, folder: &Path) -> Result<()> {
    let mut json = serde_json::to_vec_pretty(&rounded(list)?).map_err(|e| Error::internal("defects.json", e))?;
    json.push(b'\n');
    new_file::write(&folder.join(JSON_NAME), &json)?;
    let mut table = String::from(HEADER);
    table.push('\n');
    list.defects.iter().for_each(|defect| table.push_str(&line(defect)));
    new_file::write(&folder.join(CSV_NAME), table.as_bytes())
}

/// Reads `defects.json` of a product folder.
///
/// # Errors
/// Where it is missing, is no such list, or has another schema version.
pub fn load(folder: &Path) -> Result<DefectList> {
    let path = folder.join(JSON_NAME);
    let text = std::fs::read(&path).map_err(|e| Error::io(&path, e))?;
    parse(&path.display().to_string(), &text)
}

/// Reads the text of a `defects.json`; `subject` names it in errors.
///
/// # Errors
/// As [`load`].
pub fn parse(subject: &str, text: &[u8]) -> Result<DefectList> {
    let wrong = |e: serde_json::Error| Error::input(subject, e.to_string(), "a defects.json of stria");
    let json: serde_json::Value = serde_json::from_slice(text).map_err(wrong)?;
    let version = &json["schema_version"];
    if *version != SCHEMA_VERSION {
        return Err(Error::field(subject, "schema_version", version.to_string(), SCHEMA_VERSION.to_string()));
    }
    serde_json::from_value(json).map_err(wrong)
}

/// Numbers to a ten-thousandth: a list for people, too.
fn rounded(list: &DefectList) -> Result<serde_json::Value> {
    let mut json = serde_json::to_value(list).map_err(|e| Error::internal("defects.json", e))?;
    round_numbers(&mut json);
    Ok(json)
}

/// Rounds every fraction to a ten-thousandth.
pub(crate) fn round_numbers(value: &mut serde_json::Value) {
    match value {
        serde_json::Value::Number(number) => {
            if let Some(exact) = number.as_f64().filter(|_| number.is_f64()) {
                *value = ((exact * 1e4).round() / 1e4).into();
            }
        }
        serde_json::Value::Array(items) => items.iter_mut().for_each(round_numbers),
        serde_json::Value::Object(fields) => fields.values_mut().for_each(round_numbers),
        _ => {}
    }
}

fn line(d: &Defect) -> String {
    let mut line = format!("{},{},{},{}", d.id, d.kind.name(), d.severity, quoted(d.code.as_deref().unwrap_or("")));
    let numbers = [
        (Some(d.chainage_mm), 2),
        (d.clock_h, 3),
        (d.height_mm, 2),
        (Some(d.x_mm), 2),
        (Some(d.y_mm), 2),
        (Some(d.z_mm), 3),
        (Some(d.depth_mm), 3),
        (Some(d.depth_normal_mm), 3),
        (Some(d.length_mm), 2),
        (Some(d.width_mm), 2),
        (Some(d.area_mm2), 1),
        (Some(d.surface_area_mm2), 1),
        (Some(d.volume_mm3), 1),
        (Some(d.steepest_slope_deg), 2),
        (Some(d.confidence), 3),
        (Some(d.noise_mm), 4),
        (Some(d.measured_share), 3),
    ];
    for (value, decimals) in numbers {
        push(&mut line, value, decimals);
    }
    let _ = write!(line, ",{}", d.at_edge);
    push(&mut line, Some(d.deepest_x_mm), 2);
    push(&mut line, Some(d.deepest_y_mm), 2);
    push(&mut line, Some(d.depth_sd_mm), 3);
    line.push('\n');
    line
}

/// Appends a comma and the value; nothing after it where there is none.
pub(crate) fn push(line: &mut String, value: Option<f64>, decimals: usize) {
    // Writing to a string cannot fail.
    let _ = match value {
        Some(value) => write!(line, ",{:.decimals$}", value + 0.0),
        None => write!(line, ","),
    };
}

/// A text as a field of a CSV file.
fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.to_string() }
}
