//! What is recorded of some frames: the image, and what the method found in it.

use jpeg_encoder::{ColorType, Encoder};
use rerun::log::Chunk;
use rerun::{Arrows2D, EncodedImage, Pinhole, Points2D, Points3D, Radius};

use super::budget::Share;
use super::data::{fixed, row};
use super::{FrameSteps, charts, entity, metres};
use crate::error::{Error, Result};
use crate::geometry::RawPixel;
use crate::recipe::RecordingOptions;
use crate::rig::{LaserColour, Rig};
use crate::source::{Image, shrunk};
use crate::stripe::Stripe;

const FRAME_QUALITY: u8 = 80;
const AREA_QUALITY: u8 = 70;
/// A corner's flow is a few pixels from frame to frame: drawn this much longer, it can be seen.
pub(super) const FLOW_MAGNIFIED: f32 = 5.0;
/// The line in space is drawn with at most this many points.
const PROFILE_POINTS: usize = 400;
const SPOT_COLOUR: [u8; 3] = [255, 40, 40];
const CORNER_COLOUR: [u8; 3] = [64, 156, 255];

/// Pixels of a frame, a side, that make one of the image that people are shown: at least 1.
pub fn shrink(options: &RecordingOptions, rig: &Rig) -> usize {
    let (full_width, full_height) = (rig.camera.width_px, rig.camera.height_px);
    full_width.div_ceil(options.image_width_px.max(1)).min(full_height).max(1) as usize
}

/// Decides which frames are shown, and shows them.
pub(super) struct Images {
    width_px: u32,
    height_px: u32,
    /// Pixels of the frame, a side, that make one of the shown image: a whole number, which is quick to do.
    shrink: usize,
    interval_s: f64,
    duration_expected_s: Option<f64>,
    last_s: Option<f64>,
    shown: u32,
    shown_bytes: usize,
}

impl Images {
    pub(super) fn new(options: &RecordingOptions, rig: &Rig, duration_expected_s: Option<f64>) -> Images {
        let shrink = shrink(options, rig);
        Images {
            width_px: rig.camera.width_px / shrink as u32,
            height_px: rig.camera.height_px / shrink as u32,
            shrink,
            interval_s: 1.0 / options.images_per_s,
            duration_expected_s,
            last_s: None,
            shown: 0,
            shown_bytes: 0,
        }
    }

    /// The camera as the viewer draws it, and how the overlays look.
    pub(super) fn opening(&self, rig: &Rig) -> Result<Vec<Chunk>> {
        let (camera, shrink) = (&rig.camera, self.shrink as f64);
        let (fx, fy) = ((camera.fx_px / shrink) as f32, (camera.fy_px / shrink) as f32);
        let [cx, cy] = self.to_shown(RawPixel { u_px: camera.cx_px, v_px: camera.cy_px });
        // As long as the laser is away from the camera: large enough to see, small beside the wall.
        let distance_m = (rig.laser.plane.offset_mm.abs() / 1000.0).clamp(0.03, 0.4);
        let pinhole = Pinhole::new([[fx, 0.0, 0.0], [0.0, fy, 0.0], [cx, cy, 1.0]])
            .with_resolution([self.width_px as f32, self.height_px as f32])
            .with_image_plane_distance(distance_m as f32);
        let laser = match rig.laser.colour {
            LaserColour::Green => [60, 255, 60],
            LaserColour::Red => [255, 60, 60],
            LaserColour::Blue => [80, 120, 255],
        };
        let spots = Points2D::update_fields().with_radii([Radius::new_ui_points(1.5)]).with_colors([SPOT_COLOUR]);
        let mut chunks = vec![
            fixed(entity::IMAGE, &pinhole)?,
            fixed(entity::SPOTS, &spots)?,
            fixed(
                entity::CORNERS,
                &Arrows2D::update_fields().with_radii([Radius::new_ui_points(1.0)]).with_colors([CORNER_COLOUR]),
            )?,
            fixed(
                entity::PROFILE,
                &Points3D::update_fields().with_radii([Radius::new_ui_points(3.0)]).with_colors([laser]),
            )?,
        ];
        chunks.extend(charts::opening()?);
        Ok(chunks)
    }

    /// Whether the frame at this time is one to show.
    pub(super) fn due(&self, time_s: f64, share: &Share) -> bool {
        let Some(last_s) = self.last_s else { return true };
        let interval_s = self.interval_s * f64::from(share.halvings()).exp2();
        // Half a millisecond of grace, so that 5 images a second of a 60 Hz video are every 12th frame.
        time_s - last_s >= interval_s - 0.0005
    }

    /// The frame with all its steps; nothing where the budget is used up.
    pub(super) fn show(&mut self, steps: &FrameSteps<'_>, image: &Image, share: &mut Share) -> Result<Vec<Chunk>> {
        let at = steps.moment();
        self.last_s = Some(at.time_s);
        let is_shown_size = (image.width_px(), image.height_px()) == (self.width_px, self.height_px);
        let small = image.shrunk_bgr(if is_shown_size { 1 } else { self.shrink });
        let mut jpegs = vec![(entity::IMAGE, self.jpeg(&small, FRAME_QUALITY)?)];
        if let Some(mask) = steps.effective_area {
            jpegs.push((entity::AREA, self.jpeg(&self.effective_area(small, image, mask)?, AREA_QUALITY)?));
        }
        let spots = self.spots(steps.stripe);
        let profile_points = steps.points.len().min(PROFILE_POINTS);
        let overlay_bytes = 8 * spots.len() + 16 * steps.shift.corners.len() + 12 * profile_points + charts::BYTES;
        let bytes = jpegs.iter().map(|(_, jpeg)| jpeg.len()).sum::<usize>() + overlay_bytes;
        if !share.spend(bytes) {
            return Ok(vec![]);
        }
        self.shown += 1;
        self.shown_bytes += bytes;
        if let Some(duration_s) = self.duration_expected_s {
            let mean_bytes = self.shown_bytes as f64 / f64::from(self.shown);
            share.plan(duration_s / self.interval_s * mean_bytes);
        }

        let mut chunks = Vec::new();
        for (entity, jpeg) in jpegs {
            chunks.push(row(entity, at, &EncodedImage::new(jpeg).with_media_type("image/jpeg"))?);
        }
        chunks.push(row(entity::SPOTS, at, &Points2D::update_fields().with_positions(spots))?);
        chunks.push(row(entity::CORNERS, at, &self.corners(steps))?);
        chunks.push(row(entity::PROFILE, at, &profile(steps))?);
        chunks.extend(charts::show(steps, image)?);
        Ok(chunks)
    }

    /// A pixel of the frame in the shown image, where the corner (not the centre) of the first pixel is (0, 0).
    fn to_shown(&self, pixel: RawPixel) -> [f32; 2] {
        [pixel.u_px, pixel.v_px].map(|v| ((v + 0.5) / self.shrink as f64) as f32)
    }

    /// The spots, no denser than the shown image's own pixels.
    fn spots(&self, stripe: &Stripe) -> Vec<[f32; 2]> {
        stripe.spots().filter(|(i, _)| i % self.shrink == 0).map(|(_, pixel)| self.to_shown(pixel)).collect()
    }

    fn corners(&self, steps: &FrameSteps<'_>) -> Arrows2D {
        let corners = &steps.shift.corners;
        let shown = |p: [f32; 2]| self.to_shown(RawPixel { u_px: f64::from(p[0]), v_px: f64::from(p[1]) });
        Arrows2D::update_fields().with_origins(corners.iter().map(|c| shown(c.from_px))).with_vectors(
            corners.iter().map(|c| {
                let (from, to) = (shown(c.from_px), shown(c.to_px));
                [FLOW_MAGNIFIED * (to[0] - from[0]), FLOW_MAGNIFIED * (to[1] - from[1])]
            }),
        )
    }

    /// Image AND mask, at the shown size.
    fn effective_area(&self, mut small: Vec<u8>, image: &Image, mask: &[u8]) -> Result<Vec<u8>> {
        let (width, height) = (image.width_px() as usize, image.height_px() as usize);
        if mask.len() != width * height {
            return Err(Error::internal(
                "recording",
                format!("a mask of {} for {width} x {height} pixels", mask.len()),
            ));
        }
        let mask = shrunk::<1>(mask, width, self.shrink);
        for (pixel, mask) in small.chunks_exact_mut(3).zip(&mask) {
            pixel.iter_mut().for_each(|c| *c = (u16::from(*c) * u16::from(*mask) / 255) as u8);
        }
        Ok(small)
    }

    fn jpeg(&self, bgr: &[u8], quality: u8) -> Result<Vec<u8>> {
        jpeg(bgr, self.width_px, self.height_px, ColorType::Bgr, quality)
    }
}

/// A JPEG file.
pub(super) fn jpeg(pixels: &[u8], width_px: u32, height_px: u32, colours: ColorType, quality: u8) -> Result<Vec<u8>> {
    let too_large = |_| Error::internal("recording", format!("an image of {width_px} x {height_px} px"));
    let (width, height) = (u16::try_from(width_px).map_err(too_large)?, u16::try_from(height_px).map_err(too_large)?);
    let mut bytes = Vec::new();
    let encoder = Encoder::new(&mut bytes, quality);
    encoder.encode(pixels, width, height, colours).map_err(|e| Error::internal("recording", e))?;
    Ok(bytes)
}

/// The line as measured in this frame, in space.
fn profile(steps: &FrameSteps<'_>) -> Points3D {
    let step = steps.points.len().div_ceil(PROFILE_POINTS).max(1);
    Points3D::update_fields().with_positions(steps.points.iter().step_by(step).map(|p| metres(&p.point_in_world)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shrinking_takes_means_and_cuts_the_rest_off() {
        let gray = [1, 3, 10, 10, 99, 5, 7, 20, 20, 99, 50, 50, 50, 50, 50];
        assert_eq!(shrunk::<1>(&gray, 5, 2), [4, 15]);
        assert_eq!(shrunk::<1>(&gray, 5, 1), gray);
        let bgr: Vec<u8> = (0..6 * 6).flat_map(|i| [i as u8, 100, if i % 6 < 3 { 0 } else { 255 }]).collect();
        assert_eq!(shrunk::<3>(&bgr, 6, 3), [7, 100, 0, 10, 100, 255, 25, 100, 0, 28, 100, 255]);
    }

    #[test]
    fn a_pixel_s_middle_stays_its_middle() {
        let rig = Rig::from_paper(1920, 1080, 1.0, 134.0, 1.57, LaserColour::Green);
        let images = Images::new(&RecordingOptions { image_width_px: 700, ..Default::default() }, &rig, None);
        assert_eq!((images.width_px, images.height_px, images.shrink), (640, 360, 3));
        // The middle one of the first three pixels is the middle of the shown image's first pixel.
        assert_eq!(images.to_shown(RawPixel { u_px: 1.0, v_px: 4.0 }), [0.5, 1.5]);
    }
}
