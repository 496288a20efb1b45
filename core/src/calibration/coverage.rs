//! The picture of the coverage: where in the image the boards' corners and the laser's lines were, and how well
//! the camera explains them.

use std::path::Path;

use super::Attempt;
use super::camera::CameraFit;
use crate::error::Result;
use crate::export::canvas::{Align, Canvas, Rgb, Style};
use crate::geometry::RawPixel;

/// Width of the image's frame in the picture, px.
const FRAME_WIDTH_PX: f64 = 1280.0;
const MARGIN_PX: f64 = 48.0;
const HEAD_PX: f64 = 132.0;
const FOOT_PX: f64 = 108.0;
const INK: Rgb = [31, 36, 48];
const PALE: Rgb = [98, 106, 120];
const RIM: Rgb = [120, 127, 140];
const PAPER: Rgb = [247, 248, 250];
const BOARD: Rgb = [205, 209, 215];
const LASER: Rgb = [22, 163, 74];
const BAD: Rgb = [190, 24, 60];
/// Residuals from good to bad: blue, yellow, red; all of them differ in lightness too.
const SCALE: [Rgb; 4] = [[37, 99, 190], [86, 160, 211], [232, 170, 30], [200, 30, 45]];
/// Share of the corners whose residuals the colours must hold; the rest has the last colour.
const SCALE_SHARE: f64 = 0.95;
/// Length of the longest common arrow, px.
const ARROW_PX: f64 = 26.0;

/// The share of the image within the hull of all corners.
pub(super) fn share(fit: &CameraFit) -> f64 {
    let points: Vec<(f64, f64)> =
        fit.views.iter().flat_map(|v| v.corners.iter().map(|c| (c.pixel.u_px, c.pixel.v_px))).collect();
    area(&hull(points)) / (f64::from(fit.camera.width_px) * f64::from(fit.camera.height_px))
}

/// The convex hull (Andrew's monotone chain).
fn hull(mut points: Vec<(f64, f64)>) -> Vec<(f64, f64)> {
    points.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let half = |points: &mut dyn Iterator<Item = (f64, f64)>| {
        let mut chain: Vec<(f64, f64)> = Vec::new();
        for p in points {
            while let [.., a, b] = chain[..]
                && (b.0 - a.0) * (p.1 - a.1) - (b.1 - a.1) * (p.0 - a.0) <= 0.0
            {
                chain.pop();
            }
            chain.push(p);
        }
        chain
    };
    let mut hull = half(&mut points.iter().copied());
    hull.extend(half(&mut points.iter().rev().copied()));
    hull
}

fn area(outline: &[(f64, f64)]) -> f64 {
    let next = |i: usize| outline[(i + 1) % outline.len()];
    (0..outline.len()).map(|i| outline[i].0 * next(i).1 - next(i).0 * outline[i].1).sum::<f64>().abs() / 2.0
}

/// Where the image lies in the picture.
struct Frame {
    scale: f64,
    left: f64,
    top: f64,
}

impl Frame {
    fn place(&self, pixel: RawPixel) -> (f64, f64) {
        (self.left + (pixel.u_px + 0.5) * self.scale, self.top + (pixel.v_px + 0.5) * self.scale)
    }
}

pub(super) fn write(attempt: &Attempt, path: &Path) -> Result<()> {
    let size = (f64::from(attempt.size_px.0.max(1)), f64::from(attempt.size_px.1.max(1)));
    let frame = Frame { scale: FRAME_WIDTH_PX / size.0, left: MARGIN_PX, top: HEAD_PX };
    let (width, height) = (FRAME_WIDTH_PX + 2.0 * MARGIN_PX, size.1 * frame.scale + HEAD_PX + FOOT_PX);
    let mut canvas = Canvas::new(width as usize, height as usize, [255; 3])?;
    let (w, h) = (FRAME_WIDTH_PX as i64, (size.1 * frame.scale) as i64);
    canvas.fill(frame.left as i64, frame.top as i64, w, h, PAPER);
    canvas.outline(frame.left as i64 - 1, frame.top as i64 - 1, w + 2, h + 2, RIM);
    let full_px = full_scale_px(attempt);
    outlines(&mut canvas, attempt, &frame);
    lines(&mut canvas, attempt, &frame);
    corners(&mut canvas, attempt, &frame, full_px);
    head(&mut canvas, attempt);
    foot(&mut canvas, full_px, frame.scale, frame.top + h as f64);
    canvas.save_png(path)
}

/// The residual at the end of the colours, px: a round figure.
fn full_scale_px(attempt: &Attempt) -> f64 {
    let mut off: Vec<f64> =
        attempt.photos.iter().flat_map(|p| p.corners.iter().map(|(_, (u, v))| u.hypot(*v))).collect();
    off.sort_by(f64::total_cmp);
    let high = off.get((off.len() as f64 * SCALE_SHARE) as usize).copied().unwrap_or(0.1);
    [0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0].into_iter().find(|round| *round >= high).unwrap_or(10.0)
}

/// Each board as far as its corners reach.
fn outlines(canvas: &mut Canvas, attempt: &Attempt, frame: &Frame) {
    for photo in &attempt.photos {
        let outline = hull(photo.corners.iter().map(|(pixel, _)| frame.place(*pixel)).collect());
        for (i, from) in outline.iter().enumerate() {
            canvas.line(*from, outline[(i + 1) % outline.len()], 1.0, BOARD);
        }
    }
}

fn lines(canvas: &mut Canvas, attempt: &Attempt, frame: &Frame) {
    for photo in &attempt.photos {
        for spot in &photo.spots {
            canvas.disc(frame.place(*spot), 1.1, LASER);
        }
    }
}

fn corners(canvas: &mut Canvas, attempt: &Attempt, frame: &Frame, full_px: f64) {
    for (pixel, (u, v)) in attempt.photos.iter().flat_map(|p| &p.corners) {
        let (x, y) = frame.place(*pixel);
        let length = u.hypot(*v);
        let colour = colour(length / full_px);
        let stretch = ARROW_PX / full_px * (full_px / length.max(1e-9)).min(1.5);
        canvas.line((x, y), (x + u * stretch, y + v * stretch), 1.4, colour);
        canvas.disc((x, y), 2.4, colour);
    }
}

fn colour(share: f64) -> Rgb {
    let place = share.clamp(0.0, 1.0) * (SCALE.len() - 1) as f64;
    let index = (place as usize).min(SCALE.len() - 2);
    let part = place - index as f64;
    std::array::from_fn(|c| {
        let (from, to) = (f64::from(SCALE[index][c]), f64::from(SCALE[index + 1][c]));
        (from + (to - from) * part).round() as u8
    })
}

fn style(size_px: f32, colour: Rgb, align: Align) -> Style {
    Style { size_px, colour, align }
}

fn head(canvas: &mut Canvas, attempt: &Attempt) {
    let left = MARGIN_PX as f32;
    let boards = attempt.photos.iter().filter(|p| !p.corners.is_empty()).count();
    let lines = attempt.photos.iter().filter(|p| !p.spots.is_empty()).count();
    let counts = format!(
        "{} photos   ·   board in {boards}   ·   laser line in {lines}   ·   {} x {} px",
        attempt.photos.len(),
        attempt.size_px.0,
        attempt.size_px.1
    );
    match &attempt.result {
        Ok(fit) => {
            let camera = &fit.rig.camera;
            canvas.text(left, 46.0, &format!("Calibration of {}", fit.rig.name), style(34.0, INK, Align::Left));
            let figures = format!(
                "focal length {:.1} ± {:.1} px   ·   corners {:.3} px   ·   laser plane ± {:.3}°, ± {:.2} mm, points {:.3} mm   ·   {:.0} % covered",
                camera.fx_px,
                fit.deviations.focal_px,
                fit.rms_px,
                fit.plane_angle_rad.to_degrees(),
                fit.plane_offset_mm,
                fit.plane_rms_mm,
                100.0 * fit.coverage
            );
            canvas.text(left, 82.0, &figures, style(22.0, INK, Align::Left));
        }
        Err(_) => canvas.text(left, 46.0, "Not calibrated: the photos do not suffice", style(34.0, BAD, Align::Left)),
    }
    canvas.text(left, 114.0, &counts, style(20.0, PALE, Align::Left));
}

/// The legend.
fn foot(canvas: &mut Canvas, full_px: f64, scale: f64, bottom: f64) {
    let (left, top) = (MARGIN_PX as i64, bottom as i64 + 24);
    let base = (top + 18) as f32;
    canvas.text(left as f32, base, "corners: seen, and how far off their place", style(20.0, PALE, Align::Left));
    let bar_left = left + 420;
    for x in 0..260 {
        canvas.fill(bar_left + x, top, 1, 20, colour(x as f64 / 259.0));
    }
    let under = (top + 48) as f32;
    canvas.text(bar_left as f32, under, "0", style(18.0, INK, Align::Centre));
    canvas.text((bar_left + 130) as f32, under, &format!("{} px", full_px / 2.0), style(18.0, INK, Align::Centre));
    canvas.text((bar_left + 260) as f32, under, &format!("{full_px} px"), style(18.0, INK, Align::Centre));
    let arrows = format!("arrows {:.0} times their length", ARROW_PX / full_px / scale);
    canvas.text(left as f32, under, &arrows, style(18.0, PALE, Align::Left));
    let line_left = (bar_left + 340) as f64;
    canvas.line((line_left, top as f64 + 10.0), (line_left + 60.0, top as f64 + 10.0), 2.5, LASER);
    canvas.text(line_left as f32 + 74.0, base, "the laser's line on the boards", style(20.0, PALE, Align::Left));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hull_has_its_area() {
        let square = vec![(0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0), (2.0, 1.0), (0.0, 1.0)];
        assert!((area(&hull(square)) - 12.0).abs() < 1e-12);
        assert_eq!(area(&hull(vec![(1.0, 1.0), (2.0, 2.0)])), 0.0);
    }
}
