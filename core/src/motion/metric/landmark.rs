//! Landmarks: patches of the wall with their place in the world, and where new ones are chosen.

use nalgebra::{Isometry3, Matrix3, Point3, Vector3};

use super::bundle::{PlaceDepth, PlaceSight};
use super::image::{Gray, SHRINK, shrunk};
use super::patch::{Found, Kept, Patch, REACH, SIDE, Stretch, UPRIGHT};
use crate::rig::Camera;

/// A patch is made anew when the view turns or stretches it by more than this.
const STRETCH_STEP: f32 = 0.012;
/// Least standard deviation of a place found by a landmark's recent look: errors of one frame add to the next one's.
const RECENT_SIGMA_PX: f32 = 0.25;
/// Side of the blocks whose texture is summed, px of the shrunk image.
const BLOCK: usize = SIDE / 2 / SHRINK;
/// Distance of a landmark from the image's edge, px of the shrunk image.
const EDGE: usize = (REACH + 4).div_ceil(SHRINK) + 1;

/// A sight or a depth in the key frame of that number.
pub(super) type InKeyframe<T> = (u32, T);

/// Where and how a landmark is looked for.
#[derive(Clone, Copy)]
pub(super) struct Search {
    /// Where the pose sees it, raw px.
    pub at: (f64, f64),
    /// Where to begin, raw px.
    pub near: (f64, f64),
    /// How far from there it may be, px.
    pub largest_px: f32,
    /// How like its patch it must be, 0 to 1.
    pub least_likeness: f32,
}

/// A patch of the wall.
pub(super) struct Landmark {
    pub world: Point3<f64>,
    /// Covariance of the place, mm².
    pub covariance: Matrix3<f64>,
    /// From the place to where the surface lies half a patch to the right, and below, mm: as seen when it was chosen.
    surface: [Vector3<f64>; 2],
    kept: Kept,
    patch: Patch,
    stretch: Stretch,
    /// The patch in the shrunk image, and how far its whole pixel lies from the place, small px.
    small: Option<(Patch, (f32, f32))>,
    /// How it looked when it was last seen, and how far the place lies from that piece's whole pixel, px.
    recent: Option<(Kept, (f32, f32))>,
    /// Sights in key frames; the `view` of each is filled in for an adjustment.
    pub sights: Vec<InKeyframe<PlaceSight>>,
    pub depths: Vec<InKeyframe<PlaceDepth>>,
    /// The laser has passed over it.
    pub measured: bool,
    /// Signed distance from the laser line in the last frame, px.
    pub from_line_px: Option<f64>,
    /// Frames in a row in which it should have been found and was not.
    pub misses: u32,
    /// The last frame that saw it.
    pub last_frame: u32,
    /// Given up: kept only while frames that saw it wait for their pose.
    pub dead: bool,
}

impl Landmark {
    /// From an image at a whole pixel; `inverse_at` gives 1/Z for a ray. `None` without texture or too near the edge.
    pub(super) fn choose(
        image: Gray<'_>,
        small: Gray<'_>,
        place: (usize, usize),
        camera: &Camera,
        world_from_camera: &Isometry3<f64>,
        inverse_at: impl Fn([f64; 2]) -> f64,
    ) -> Option<Landmark> {
        let (x, y) = place;
        let kept = Kept::cut(image, x, y)?;
        let patch = kept.patch(UPRIGHT)?;
        let (small_x, small_y) = (shrunk(x as f32), shrunk(y as f32));
        let offset = (small_x.round() - small_x, small_y.round() - small_y);
        let small = Patch::cut(small, small_x.round() as usize, small_y.round() as usize).map(|patch| (patch, offset));
        let point = |x: f64, y: f64| {
            let ray = camera.undistort(crate::geometry::RawPixel { u_px: x, v_px: y });
            world_from_camera * Point3::from(ray.direction() / inverse_at([ray.x, ray.y]))
        };
        let half = (SIDE / 2) as f64;
        let (x, y) = (x as f64, y as f64);
        let world = point(x, y);
        Some(Landmark {
            world,
            covariance: Matrix3::identity(),
            surface: [point(x + half, y) - world, point(x, y + half) - world],
            kept,
            patch,
            stretch: UPRIGHT,
            small,
            recent: None,
            sights: Vec::new(),
            depths: Vec::new(),
            measured: false,
            from_line_px: None,
            misses: 0,
            last_frame: 0,
            dead: false,
        })
    }

    /// Where a camera sees it, raw px. `None` behind the camera.
    pub(super) fn seen_at(&self, camera: &Camera, camera_from_world: &Isometry3<f64>) -> Option<(f64, f64)> {
        project(camera, &(camera_from_world * self.world))
    }

    /// Looks for the patch, turned and stretched as the pose says. `None` where nothing is as like it as asked for.
    pub(super) fn find(
        &mut self,
        image: Gray<'_>,
        camera: &Camera,
        camera_from_world: &Isometry3<f64>,
        search: &Search,
    ) -> Option<Found> {
        let Search { at, near, largest_px, least_likeness } = *search;
        let stretch = self.stretch_seen(camera, camera_from_world, at)?;
        let change = (0..2).flat_map(|i| (0..2).map(move |j| (i, j)));
        if change.map(|(i, j)| (stretch[i][j] - self.stretch[i][j]).abs()).fold(0.0, f32::max) > STRETCH_STEP {
            self.patch = self.kept.patch(stretch)?;
            self.stretch = stretch;
        }
        let near = (near.0 as f32, near.1 as f32);
        let found = self.patch.find(image, near, largest_px).filter(|f| f.likeness >= least_likeness);
        found.or_else(|| {
            // It does not look any more as it did at first: then as it did a moment ago, which is less certain.
            let (kept, offset) = self.recent.as_ref()?;
            let found = kept.patch(UPRIGHT)?.find(image, (near.0 - offset.0, near.1 - offset.1), largest_px)?;
            (found.likeness >= least_likeness).then_some(Found {
                x: found.x + offset.0,
                y: found.y + offset.1,
                sigma: found.sigma.max(RECENT_SIGMA_PX),
                ..found
            })
        })
    }

    /// Keeps how it looks now, at a place where it was found.
    pub(super) fn remember(&mut self, image: Gray<'_>, place: (f32, f32)) {
        let whole = (place.0.round(), place.1.round());
        let kept = Kept::cut(image, whole.0 as usize, whole.1 as usize);
        self.recent = kept.map(|kept| (kept, (place.0 - whole.0, place.1 - whole.1)));
    }

    fn stretch_seen(&self, camera: &Camera, pose: &Isometry3<f64>, at: (f64, f64)) -> Option<Stretch> {
        let column = |offset: &Vector3<f64>| {
            let (x, y) = project(camera, &(pose * (self.world + offset)))?;
            let half = (SIDE / 2) as f64;
            Some((((x - at.0) / half) as f32, ((y - at.1) / half) as f32))
        };
        let ((a, c), (b, d)) = (column(&self.surface[0])?, column(&self.surface[1])?);
        Some([[a, b], [c, d]])
    }

    /// How far from a place of the full image it seems to be by the shrunk one, full px, within `reach` px of that; and how
    /// like it is there.
    pub(super) fn search_small(&self, small: Gray<'_>, at: (f64, f64), reach: f32) -> Option<([f64; 2], f32)> {
        let (patch, offset) = self.small.as_ref()?;
        let start = (shrunk(at.0 as f32) + offset.0, shrunk(at.1 as f32) + offset.1);
        let found = patch.search(small, start, reach)?;
        let shrink = SHRINK as f32;
        let off = [f64::from((found.x - start.0) * shrink), f64::from((found.y - start.1) * shrink)];
        Some((off, found.likeness))
    }

    /// Looks for it in the shrunk image around a place of the full one; the answer is in full px.
    pub(super) fn find_small(&self, small: Gray<'_>, at: (f64, f64), largest: f32) -> Option<Found> {
        let (patch, offset) = self.small.as_ref()?;
        let start = (shrunk(at.0 as f32) + offset.0, shrunk(at.1 as f32) + offset.1);
        let found = patch.find(small, start, largest)?;
        let shrink = SHRINK as f32;
        Some(Found {
            x: at.0 as f32 + (found.x - start.0) * shrink,
            y: at.1 as f32 + (found.y - start.1) * shrink,
            sigma: found.sigma * shrink,
            ..found
        })
    }
}

/// Where a camera sees a point of its own frame, raw px.
pub(super) fn project(camera: &Camera, point: &Point3<f64>) -> Option<(f64, f64)> {
    if point.z < 1.0 {
        return None;
    }
    let pixel = camera.project(point);
    Some((pixel.u_px, pixel.v_px))
}

/// The place of a rectangle (columns, rows; px of the full image) with the most texture in both directions, where
/// `allowed`; `None` where none reaches `least` levels² a px². The shrunk image tells: fine grain is mostly the sensor's.
pub(super) fn best_place(
    small: Gray<'_>,
    columns: std::ops::Range<usize>,
    rows: std::ops::Range<usize>,
    least: f32,
    allowed: impl Fn(usize, usize) -> bool,
) -> Option<(usize, usize)> {
    let columns = (columns.start / SHRINK).max(EDGE)..(columns.end / SHRINK).min(small.width.saturating_sub(EDGE));
    let rows = (rows.start / SHRINK).max(EDGE)..(rows.end / SHRINK).min(small.height.saturating_sub(EDGE));
    let (across, down) = (columns.len() / BLOCK, rows.len() / BLOCK);
    if across < 2 || down < 2 {
        return None;
    }
    let mut blocks = vec![[0.0f32; 3]; across * down];
    for row in 0..down * BLOCK {
        let y = rows.start + row;
        let (above, here, below) = (small.row(y - 1), small.row(y), small.row(y + 1));
        for column in 0..across * BLOCK {
            let x = columns.start + column;
            let dx = f32::from(here[x + 1]) - f32::from(here[x - 1]);
            let dy = f32::from(below[x]) - f32::from(above[x]);
            let block = &mut blocks[(row / BLOCK) * across + column / BLOCK];
            block[0] += dx * dx;
            block[1] += dx * dy;
            block[2] += dy * dy;
        }
    }
    let mut best: Option<(f32, (usize, usize))> = None;
    for row in 1..down {
        for column in 1..across {
            let part = |i: usize, k: usize| blocks[(row - 1 + i / 2) * across + column - 1 + i % 2][k];
            // Four blocks; a difference over two pixels is twice the slope.
            let sum = |k: usize| (0..4).map(|i| part(i, k)).sum::<f32>() / (16.0 * (BLOCK * BLOCK) as f32);
            let (xx, xy, yy) = (sum(0), sum(1), sum(2));
            let weaker = (xx + yy) / 2.0 - (((xx - yy) / 2.0).powi(2) + xy * xy).sqrt();
            let place = ((columns.start + column * BLOCK) * SHRINK, (rows.start + row * BLOCK) * SHRINK);
            if weaker >= least && best.is_none_or(|(most, _)| weaker > most) && allowed(place.0, place.1) {
                best = Some((weaker, place));
            }
        }
    }
    best.map(|(_, place)| place)
}
