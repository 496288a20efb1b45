//! The publication's maps: each frame gives a strip as wide as the image moved.
//!
//! Depths come from the laser line, colours from two columns of the same frame beside the line, where no
//! laser light falls: one ahead of it and one behind it on the travel. The one behind only fills what the
//! one ahead could not reach (the run's first columns), so the line is not seen in the texture.

use super::{Grid, SurfaceMap};
use crate::error::Result;
use crate::rig::{LineDirection, Rig};
use crate::source::Image;
use crate::surface::Placed;

/// The colours that a frame gives to its strip, cut out while the image is at hand.
#[derive(Clone, Debug, PartialEq)]
pub struct TextureStrip {
    /// First column relative to the line, px of travel; the same ahead and behind.
    first: i64,
    columns: usize,
    rows: usize,
    /// How far ahead of the line and behind it the colours were taken, px.
    offsets_px: [i64; 2],
    ahead: Vec<Option<[u8; 3]>>,
    behind: Vec<Option<[u8; 3]>>,
}

impl TextureStrip {
    /// Cuts the strip of a frame whose line lies at `line_px` (column, or row of a horizontal line) and
    /// whose content moves by `step_px` of travel until the next frame; colours are taken `offsets_px` ahead
    /// of the line and behind it: far enough that a bent line's light does not reach there.
    pub fn cut(image: &Image, line: LineDirection, line_px: f64, step_px: f64, offsets_px: [f64; 2]) -> TextureStrip {
        let reach = step_px.abs().ceil() as i64 + 1;
        let (first, last) = if step_px < 0.0 { (-reach, 1) } else { (-1, reach) };
        let columns = (last - first + 1) as usize;
        let rows = match line {
            LineDirection::Vertical => image.height_px(),
            LineDirection::Horizontal => image.width_px(),
        } as usize;
        let offsets_px = offsets_px.map(|offset| offset.round() as i64);
        let cut = |offset_px: i64| {
            let start = line_px.round() as i64 + offset_px + first;
            (0..rows).flat_map(|row| (0..columns).map(move |k| pixel(image, line, start + k as i64, row))).collect()
        };
        TextureStrip { first, columns, rows, offsets_px, ahead: cut(offsets_px[0]), behind: cut(-offsets_px[1]) }
    }
}

impl TextureStrip {
    /// The wall's colour beside the line at a line position; mid gray where the image does not reach.
    pub fn beside(&self, line_position: u32) -> [u8; 3] {
        let at = line_position as usize * self.columns + (-self.first) as usize;
        let colour = |side: &[Option<[u8; 3]>]| side.get(at).copied().flatten();
        colour(&self.ahead).or_else(|| colour(&self.behind)).unwrap_or([128; 3])
    }
}

/// The colour at an image position given along the travel and along the line.
fn pixel(image: &Image, line: LineDirection, travel: i64, row: usize) -> Option<[u8; 3]> {
    let (column, row) = match line {
        LineDirection::Vertical => (travel, row as i64),
        LineDirection::Horizontal => (row as i64, travel),
    };
    let inside = column >= 0 && row >= 0 && column < i64::from(image.width_px()) && row < i64::from(image.height_px());
    inside.then(|| {
        let at = 3 * (row as usize * image.width_px() as usize + column as usize);
        [image.bgr()[at + 2], image.bgr()[at + 1], image.bgr()[at]]
    })
}

/// The grid of the publication's map: a pixel of the image is a pixel of the map, and its size in mm is
/// that at distance `z_mm`; `across_line_mm` is the world x of the first frame's line.
pub fn strip_grid(rig: &Rig, z_mm: f64, line_x_mm: f64) -> Grid {
    let camera = &rig.camera;
    match rig.laser.line {
        LineDirection::Vertical => {
            Grid { x_mm: line_x_mm, y_mm: -camera.cy_px * z_mm / camera.fy_px, mm_per_px: z_mm / camera.fx_px }
        }
        // World y is the image's −x there: grid row −a is image column a.
        LineDirection::Horizontal => {
            Grid { x_mm: line_x_mm, y_mm: camera.cx_px * z_mm / camera.fx_px, mm_per_px: z_mm / camera.fy_px }
        }
    }
}

/// Puts a placed frame, with its colours where it has them, on the map.
pub fn add_strip<T>(
    map: &mut SurfaceMap,
    line: LineDirection,
    placed: &Placed<T>,
    texture: Option<&TextureStrip>,
) -> Result<()> {
    let Some(place) = placed.strip else { return Ok(()) };
    let start = place.travel_px.round() as i64;
    let end = place.travel_end_px.round() as i64;
    let across = place.across_px.round() as i64;
    let (low, high) = (start.min(end), start.max(end));
    // The first frame always shows, also when nothing moves after it.
    let high = if placed.measured.frame == 0 { high.max(low + 1) } else { high };
    let grid_row = |line_position: i64| match line {
        LineDirection::Vertical => line_position + across,
        LineDirection::Horizontal => across - line_position,
    };
    for point in &placed.measured.profile.points {
        let depth_mm = (point.point_in_camera.z * place.depth_factor) as f32;
        for column in low..high {
            map.put_depth(column, grid_row(i64::from(point.line_position)), depth_mm)?;
        }
    }
    let Some(strip) = texture else { return Ok(()) };
    for column in low..high {
        let k = column - start - strip.first;
        if k < 0 || k >= strip.columns as i64 {
            continue;
        }
        for row in 0..strip.rows {
            let at = row * strip.columns + k as usize;
            let [ahead_px, behind_px] = strip.offsets_px;
            for (colours, offset_px, replace) in [(&strip.ahead, ahead_px, true), (&strip.behind, -behind_px, false)] {
                if let Some(rgb) = colours[at] {
                    map.put_texture(column + offset_px, grid_row(row as i64), rgb, replace)?;
                }
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::RawPixel;
    use crate::motion::Shift;
    use crate::rig::LaserColour;
    use crate::surface::Measured;
    use crate::surface::paper::StripPlace;
    use crate::triangulation::{Profile, ProfilePoint};
    use nalgebra::Point3;

    /// An image whose colour tells the column (red) and the row (green).
    fn image() -> Image {
        let bgr = (0..64_u32).flat_map(|row| (0..128_u32).flat_map(move |column| [0, row as u8, column as u8]));
        Image::from_bgr(128, 64, bgr.collect())
    }

    fn placed(travel_px: f64, step_px: f64, frame: u32) -> Placed<Option<TextureStrip>> {
        let points = (0..64).map(|row| ProfilePoint {
            line_position: row,
            pixel: RawPixel { u_px: 64.0, v_px: f64::from(row) },
            point_in_camera: Point3::new(0.0, 0.0, 400.0 + f64::from(row)),
            confidence: 1.0,
        });
        let cargo = Some(TextureStrip::cut(&image(), LineDirection::Vertical, 64.0, step_px, [20.0, 20.0]));
        Placed {
            measured: Measured {
                frame,
                time_s: 0.0,
                profile: Profile { points: points.collect() },
                shift: Shift::default(),
                cargo,
            },
            world_from_camera: Some(nalgebra::Isometry3::identity()),
            degrees_of_freedom: 3,
            part: 0,
            strip: Some(StripPlace {
                travel_px,
                travel_end_px: travel_px + step_px,
                across_px: 0.0,
                depth_factor: 1.0,
            }),
        }
    }

    #[test]
    fn strips_fill_the_map_and_the_texture_lies_where_the_wall_is() {
        let rig = Rig::from_paper(128, 64, 1.0, 100.0, 1.6, LaserColour::Green);
        let mut map = SurfaceMap::create(strip_grid(&rig, 400.0, 50.0), 8, &std::env::temp_dir()).expect("map");
        for frame in 0..20 {
            let placed = placed(f64::from(frame) * 3.0, 3.0, frame);
            add_strip(&mut map, LineDirection::Vertical, &placed, placed.measured.cargo.as_ref()).expect("strip");
        }
        let geometry = map.geometry().expect("measured");
        assert_eq!((geometry.width_px, geometry.height_px), (60, 64));
        assert_eq!(geometry.x0_mm, 50.0);
        let window = map.window(0, 0, 60, 64).expect("window");
        assert!(window.depth_mm.iter().enumerate().all(|(i, z)| *z == 400.0 + (i / 60) as f32));
        // Column 30 was seen 20 px ahead of the line when the line was at column 10 or so.
        let [red, green, _] = window.texture[7 * 60 + 30].expect("textured");
        assert_eq!(green, 7);
        assert!((i16::from(red) - 84).abs() <= 3, "{red}");
        // Column 5 lies before the line ahead ever reached it: filled from behind.
        let [red, ..] = window.texture[5].expect("textured");
        assert!((i16::from(red) - 44).abs() <= 3, "{red}");
    }

    #[test]
    fn a_frame_that_stands_still_gives_one_column() {
        let rig = Rig::from_paper(128, 64, 1.0, 100.0, 1.6, LaserColour::Green);
        let mut map = SurfaceMap::create(strip_grid(&rig, 400.0, 50.0), 8, &std::env::temp_dir()).expect("map");
        for frame in 0..5 {
            let placed = placed(0.0, 0.0, frame);
            add_strip(&mut map, LineDirection::Vertical, &placed, placed.measured.cargo.as_ref()).expect("strip");
        }
        assert_eq!(map.geometry().expect("measured").width_px, 1);
    }
}
