//! One wall: its frames averaged, and the straight line on it.

use super::{FlatWall, WallFit};
use crate::calibration::light::{Plane as Picture, evidence};
use crate::calibration::{spot, straight};
use crate::error::{Error, Result};
use crate::rig::{Camera, LaserColour, LineDirection};
use crate::source;

/// Frames of a video that are averaged: more do not help against what remains.
const MAX_FRAMES: u32 = 100;
/// Fewest rows with the line, as a share of the image's.
const MIN_ROWS_SHARE: f64 = 0.25;
/// No row's spot is surer than this, px: the wall's grain moves them all.
const SURE_PX: f64 = 0.1;

/// The mean of the laser's light over the frames of a source.
pub(super) fn mean_evidence(
    wall: &FlatWall,
    colour: LaserColour,
    size_px: &mut Option<(u32, u32)>,
) -> Result<(Picture, String)> {
    let name =
        wall.source.file_name().map_or_else(|| wall.source.display().to_string(), |n| n.to_string_lossy().into());
    let mut frames = source::open(&wall.source, &name, None)?;
    let (mut sum, mut count): (Option<Picture>, u32) = (None, 0);
    while count < MAX_FRAMES
        && let Some(frame) = frames.next_frame()?
    {
        let size = (frame.image.width_px(), frame.image.height_px());
        let expected = *size_px.get_or_insert(size);
        if size != expected {
            let found = format!("{}x{} px", size.0, size.1);
            let expected = format!("{}x{} px like the other walls: one camera, one setting", expected.0, expected.1);
            return Err(Error::field(name, "image size", found, expected));
        }
        let next = evidence(&frame.image, colour, None);
        match &mut sum {
            None => sum = Some(next),
            Some(sum) => sum.data.iter_mut().zip(next.data).for_each(|(s, v)| *s += v),
        }
        count += 1;
    }
    let Some(mut mean) = sum else {
        return Err(Error::input(name, "no picture in it", "a flat wall with the laser on"));
    };
    mean.data.iter_mut().for_each(|v| *v /= count as f32);
    Ok((mean, name))
}

/// Where the line stands and how it leans.
pub(super) fn find_line(
    picture: &Picture,
    camera: &Camera,
    direction: LineDirection,
    name: String,
    distance_mm: f64,
) -> Result<WallFit> {
    let (positions, across) = match direction {
        LineDirection::Vertical => (picture.height_px, picture.width_px),
        LineDirection::Horizontal => (picture.width_px, picture.height_px),
    };
    let (mut rays, mut weights) = (Vec::new(), Vec::new());
    for along in 0..positions as i64 {
        let value = |at: i64| match direction {
            LineDirection::Vertical => picture.at(at, along),
            LineDirection::Horizontal => picture.at(along, at),
        };
        let row: Option<Vec<f32>> = (0..across as i64).map(value).collect();
        if let Some(spot) = row.and_then(|row| spot::find(&row)) {
            rays.push(camera.undistort(spot.moved(along as f64, 0.0).pixel(direction)));
            weights.push(spot.deviation_px.max(SURE_PX).powi(-2));
        }
    }
    let found = straight::fit(&rays, &weights, direction, camera.fx_px);
    let Some((line, inliers)) = found.filter(|(_, i)| i.len() as f64 >= MIN_ROWS_SHARE * positions as f64) else {
        return Err(Error::input(
            name,
            format!("a straight laser line in fewer than {:.0} % of the rows", 100.0 * MIN_ROWS_SHARE),
            "a photo of a flat wall with the laser on and its line clearly visible (--laser says its colour, --line its direction)",
        ));
    };
    let (offset, slope) = line.offset_slope();
    Ok(WallFit {
        name,
        distance_mm,
        rows: inliers.len(),
        column_px: offset * camera.fx_px,
        slope,
        residual_px: 0.0,
        residual_mm: 0.0,
    })
}
