//! Photos of a checkerboard with known truth: what `stria calibrate` wants, and what tests measure it by.
//!
//! Rendered by casting rays: several per pixel through the exact lens, onto the board or the wall behind it, with
//! the laser's fan on both; then the lens' blur, the sensor's noise and curve.

mod paint;

use std::fs;
use std::path::Path;
use std::sync::Arc;

use nalgebra::{Isometry3, Point3, Rotation3, UnitQuaternion};

use super::bands::for_bands;
use super::noise::Stream;
use super::render::Pixel;
use super::scene::SensorNoise;
use super::sensor::Sensor;
use super::write::{check_new, write_png};
use crate::error::{Error, Result};
use crate::geometry::{RawPixel, UndistortedRay};
use crate::rig::{LineDirection, Rig};
use crate::source::Image;
use paint::{CornerRays, Outline, Shade, blur};

/// Rays a pixel and side: with random places inside the cells, an edge is met to 0.01 px over a corner's window.
const RAYS: usize = 4;
/// The paper beyond the outer squares, squares wide.
const RIM_SQUARES: f64 = 0.5;
/// Distances of the boards from the camera, mm.
const DISTANCE_MM: (f64, f64) = (380.0, 850.0);
/// Largest tilt of a board, degrees.
const TILT_DEG: f64 = 35.0;
/// Tries for a pose that shows the whole board; an image of usual shape needs some ten.
const TRIES: u32 = 10_000;
/// Every so many-th board is anywhere in the image, the others under the laser's line.
const ANYWHERE: u32 = 3;

/// A board, a rig and the light for photos.
#[derive(Clone, Debug)]
pub struct BoardScene {
    rig: Rig,
    rays: Arc<CornerRays>,
    /// Inner corners a row.
    pub columns: u32,
    /// Inner corners a column.
    pub rows: u32,
    /// Side of a square, mm.
    pub square_mm: f64,
    /// Share of light that white and black squares give back.
    pub albedo: (f64, f64),
    /// Light of the room, full scales of the sensor on a white surface.
    pub ambient: f64,
    /// Light at the line's centre on a white surface at 600 mm, full scales.
    pub laser_power: f64,
    /// Width of the fan: standard deviation across its plane, mm.
    pub line_sigma_mm: f64,
    /// Blur of the lens: standard deviation, px.
    pub blur_px: f64,
    /// The sensor's noise.
    pub noise: Option<SensorNoise>,
    /// Makes one set of photos differ from another.
    pub seed: u64,
}

impl BoardScene {
    /// A board of 9x6 inner corners and 25 mm squares before a rig.
    ///
    /// # Errors
    /// Image sizes outside 16 to 8192 px a side or above 8192x4320 px in all.
    pub fn new(rig: Rig, seed: u64) -> Result<BoardScene> {
        super::check_size(rig.camera.width_px, rig.camera.height_px)?;
        Ok(BoardScene {
            rays: Arc::new(CornerRays::new(&rig)),
            rig,
            columns: 9,
            rows: 6,
            square_mm: 25.0,
            albedo: (0.85, 0.05),
            ambient: 0.55,
            laser_power: 0.7,
            line_sigma_mm: 0.8,
            blur_px: 0.6,
            noise: Some(SensorNoise { read: 0.002, electrons: 9000.0 }),
            seed,
        })
    }

    /// The rig that takes the photos.
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// Poses, `camera_from_board`, that show the whole board; tilted and spread over image and distance. Two of
    /// three are under the laser's line.
    ///
    /// # Errors
    /// As [`BoardScene::pose`].
    pub fn poses(&self, count: u32) -> Result<Vec<Isometry3<f64>>> {
        (0..count).map(|number| self.pose(number, TILT_DEG)).collect()
    }

    /// A pose by its number with a greatest tilt, degrees.
    ///
    /// # Errors
    /// An image so long and narrow, or a board so large, that it is never seen whole.
    pub fn pose(&self, number: u32, tilt_deg: f64) -> Result<Isometry3<f64>> {
        let mut random = Stream::at(self.seed, i64::from(number), 0xb0a4d);
        let camera = &self.rig.camera;
        for _ in 0..TRIES {
            let distance_mm = random.between(DISTANCE_MM.0, DISTANCE_MM.1);
            let mut pixel = RawPixel {
                u_px: random.between(0.0, f64::from(camera.width_px) - 1.0),
                v_px: random.between(0.0, f64::from(camera.height_px) - 1.0),
            };
            if !number.is_multiple_of(ANYWHERE) {
                let reach_px = 0.6 * camera.fx_px * self.square_mm / distance_mm * f64::from(self.rows) * 0.5;
                self.put_on_line(&mut pixel, distance_mm, random.between(-reach_px, reach_px));
            }
            let turn = |deg: f64| deg.to_radians();
            let rotation = Rotation3::from_euler_angles(
                turn(random.between(-tilt_deg, tilt_deg)),
                turn(random.between(-tilt_deg, tilt_deg)),
                turn(random.between(-25.0, 25.0)),
            );
            let centre = camera.undistort(pixel).direction() * distance_mm;
            let middle = self.middle_mm();
            let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
            let pose = Isometry3::from_parts((centre - rotation * middle.coords).into(), rotation);
            if self.shows_whole_board(&pose) {
                return Ok(pose);
            }
        }
        Err(Error::input(
            "size",
            format!("{}x{} px: the board never fits in", camera.width_px, camera.height_px),
            "an image of usual shape, such as 1280x720 px",
        ))
    }

    /// Moves a pixel to the laser's line as it lies at a distance.
    fn put_on_line(&self, pixel: &mut RawPixel, distance_mm: f64, off_px: f64) {
        let (camera, plane) = (&self.rig.camera, &self.rig.laser.plane);
        let ray = camera.undistort(*pixel);
        let n = plane.normal;
        let ray = match self.rig.laser.line {
            LineDirection::Vertical => {
                UndistortedRay { x: (plane.offset_mm / distance_mm - n.z - n.y * ray.y) / n.x, y: ray.y }
            }
            LineDirection::Horizontal => {
                UndistortedRay { x: ray.x, y: (plane.offset_mm / distance_mm - n.z - n.x * ray.x) / n.y }
            }
        };
        *pixel = camera.distort(ray);
        match self.rig.laser.line {
            LineDirection::Vertical => pixel.u_px += off_px,
            LineDirection::Horizontal => pixel.v_px += off_px,
        }
    }

    fn middle_mm(&self) -> Point3<f64> {
        let half = |corners: u32| 0.5 * f64::from(corners - 1) * self.square_mm;
        Point3::new(half(self.columns), half(self.rows), 0.0)
    }

    /// True where the board with its rim is inside the image.
    fn shows_whole_board(&self, pose: &Isometry3<f64>) -> bool {
        let out = 1.0 + RIM_SQUARES;
        let ends = |corners: u32| [-out * self.square_mm, (f64::from(corners - 1) + out) * self.square_mm];
        let camera = &self.rig.camera;
        ends(self.columns).iter().all(|x| {
            ends(self.rows).iter().all(|y| {
                let point = pose * Point3::new(*x, *y, 0.0);
                let pixel = camera.project(&point);
                point.z > 100.0
                    && (0.0..f64::from(camera.width_px)).contains(&pixel.u_px)
                    && (0.0..f64::from(camera.height_px)).contains(&pixel.v_px)
            })
        })
    }

    /// The photo of a board at a pose; `number` makes its noise.
    pub fn render(&self, camera_from_board: &Isometry3<f64>, laser_on: bool, number: u32) -> Image {
        let camera = &self.rig.camera;
        let (width, height) = (camera.width_px as usize, camera.height_px as usize);
        let outline = Outline::around(self, camera_from_board);
        let shade = Shade::new(self, camera_from_board, laser_on);
        let mut pixels = vec![Pixel { rgb: [0.0; 3], from_plane_mm: f32::NAN }; width * height];
        for_bands(&mut pixels, width, 8, |first_row, rows| {
            for (i, pixel) in rows.iter_mut().enumerate() {
                let (column, row) = (i % width, first_row + i / width);
                let mut random = Stream::at(self.seed ^ 0x5a, i64::from(number), (row * width + column) as i64);
                if !outline.holds(column, row) {
                    // The wall is smooth: one ray says it all.
                    pixel.rgb = shade.light(self.rays.at(column, row, 0.5, 0.5)).map(|l| l as f32);
                    continue;
                }
                let mut sum = [0.0; 3];
                for cell in 0..RAYS * RAYS {
                    let inside = |k: usize, r: f64| (k as f64 + r) / RAYS as f64;
                    let (x, y) = (inside(cell % RAYS, random.unit()), inside(cell / RAYS, random.unit()));
                    let light = shade.light(self.rays.at(column, row, x, y));
                    (0..3).for_each(|c| sum[c] += light[c]);
                }
                pixel.rgb = sum.map(|s| (s / (RAYS * RAYS) as f64) as f32);
            }
        });
        blur(&mut pixels, width, self.blur_px);
        let seed = super::noise::hash(self.seed, i64::from(number), 0x5e);
        let bgr = Sensor::new(self.noise).expose(&pixels, width, seed);
        Image::from_bgr(camera.width_px, camera.height_px, bgr)
    }
}

/// Writes `count` photos, `board_00.png` and so on, and the true `rig.toml` into a new or empty folder. With
/// `laser_on` every photo has the line; `progress` hears how many are done.
///
/// # Errors
/// A folder with files in it; what the disk or `progress` says.
pub fn write_board_photos(
    scene: &BoardScene,
    out_dir: &Path,
    count: u32,
    mut progress: impl FnMut(u32) -> Result<()>,
) -> Result<()> {
    let parent = check_new(out_dir)?;
    let work = tempfile::Builder::new().prefix(".simulate-").tempdir_in(&parent).map_err(|e| Error::io(&parent, e))?;
    let rig_path = work.path().join("rig.toml");
    fs::write(&rig_path, scene.rig.to_toml()).map_err(|e| Error::io(&rig_path, e))?;
    for (number, pose) in (0..).zip(scene.poses(count)?) {
        let image = scene.render(&pose, true, number);
        write_png(&work.path().join(format!("board_{number:02}.png")), &image)?;
        progress(number + 1)?;
    }
    super::write::put_in_place(work, out_dir)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::Scene;

    #[test]
    fn the_line_lies_where_the_plane_meets_the_board() {
        let rig = Scene::named("lens").expect("a scene").rig(640, 360);
        let mut scene = BoardScene::new(rig, 3).expect("a scene");
        (scene.noise, scene.albedo) = (None, (0.8, 0.8));
        let pose = scene.pose(1, 20.0).expect("a pose");
        let (on, off) = (scene.render(&pose, true, 1), scene.render(&pose, false, 1));
        // The board's middle row: the brightest green is where the laser's plane is.
        let middle = scene.rig.camera.project(&(pose * scene.middle_mm()));
        let row = middle.v_px.round() as usize;
        let gain =
            |c: usize| i32::from(on.bgr()[3 * (row * 640 + c) + 1]) - i32::from(off.bgr()[3 * (row * 640 + c) + 1]);
        let brightest = (0..640).max_by_key(|c| gain(*c)).expect("a row");
        let ray = scene.rig.camera.undistort(RawPixel { u_px: brightest as f64, v_px: row as f64 });
        let shade = Shade::new(&scene, &pose, true);
        let point = shade.surface(ray.direction()).0;
        let off_mm = scene.rig.laser.plane.normal.dot(&point) - scene.rig.laser.plane.offset_mm;
        assert!(off_mm.abs() < 2.0, "{off_mm} mm");
    }

    #[test]
    fn folders_with_files_are_refused() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        fs::write(folder.path().join("a"), "b").expect("write");
        let scene = BoardScene::new(Scene::named("wall").expect("a scene").rig(320, 240), 1).expect("a board");
        assert!(write_board_photos(&scene, folder.path(), 1, |_| Ok(())).is_err());
    }

    #[test]
    fn an_image_that_no_board_fits_in_is_refused() {
        let scene = BoardScene::new(Scene::named("wall").expect("a scene").rig(2000, 32), 1).expect("a board");
        let message = scene.pose(0, 10.0).expect_err("no room").to_string();
        assert!(message.contains("2000x32"), "{message}");
    }
}
