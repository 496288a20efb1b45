//! Ray, surface and light: what one place of the wall sends into the camera.

use nalgebra::{Point3, Vector3};

use super::decals::{Decal, decals_between};
use super::ground::{Ground, GroundView, Sample};
use super::scene::{LineProfile, Scene, TextureReach};
use crate::geometry::WorldFromCamera;
use crate::rig::{LaserColour, Rig};

/// A frame's geometry and light, in single precision around the view.
pub(super) struct FrameView<'a> {
    scene: &'a Scene,
    pub ground: GroundView,
    decals: Vec<Decal>,
    /// World from camera: rotation, and position counted from the ground view's x0.
    rotation: [[f32; 3]; 3],
    position: [f32; 3],
    lamp: [f32; 3],
    tube: [f32; 3],
    laser: [f32; 3],
    plane: [f32; 4],
    focal_px: f32,
    z_near_mm: f32,
    y_limit_mm: f32,
    laser_rgb: [f32; 3],
    has_steps: bool,
}

/// A place of the wall as the camera sees it.
#[derive(Clone, Copy)]
pub(super) struct Hit {
    /// The camera's z of the place, mm.
    pub depth_mm: f32,
    /// The place, x counted from the ground view's x0.
    point: [f32; 3],
    sample: Sample,
    /// Signed distance from the laser's plane, mm.
    pub from_plane_mm: f32,
}

/// How a camera without infrared leaks sees the laser's colour: linear red, green, blue. The leaks are what
/// turns the core of a strong line white.
pub(super) fn laser_rgb(colour: LaserColour) -> [f32; 3] {
    match colour {
        LaserColour::Green => [0.03, 1.0, 0.19],
        LaserColour::Red => [1.0, 0.08, 0.05],
        LaserColour::Blue => [0.05, 0.14, 1.0],
    }
}

impl<'a> FrameView<'a> {
    pub(super) fn new(
        scene: &'a Scene,
        rig: &Rig,
        ground: &Ground,
        pose: &WorldFromCamera,
        x_range_mm: (f64, f64),
    ) -> Self {
        let view = ground.view(x_range_mm.0, x_range_mm.1);
        let d = scene.wall.distance_mm;
        let place = |p: Vector3<f64>| -> [f32; 3] {
            let world = pose * Point3::from(p);
            [(world.x - view.x0_mm) as f32, world.y as f32, world.z as f32]
        };
        // "Above" is the world's −y, also where the camera is turned.
        let up = pose.rotation.inverse() * Vector3::new(0.0, -1.0, 0.0);
        let m = pose.rotation.to_rotation_matrix();
        let plane = &rig.laser.plane;
        let n = plane.normal;
        FrameView {
            scene,
            decals: match scene.distractors {
                true => decals_between(x_range_mm.0, x_range_mm.1, d, ground.wall.seed),
                false => Vec::new(),
            },
            rotation: std::array::from_fn(|r| std::array::from_fn(|c| m[(r, c)] as f32)),
            position: place(Vector3::zeros()),
            lamp: place(up * 0.15 * d),
            tube: place(up * 0.9 * d),
            // The laser sits where its plane comes nearest to the camera.
            laser: place(n * plane.offset_mm),
            plane: [n.x as f32, n.y as f32, n.z as f32, plane.offset_mm as f32],
            focal_px: rig.camera.fx_px as f32,
            z_near_mm: ground.wall.z_range_mm().0 as f32,
            y_limit_mm: match scene.wall.shape {
                super::Shape::Flat => f32::INFINITY,
                super::Shape::Pipe { radius_mm } => 0.98 * radius_mm as f32,
            },
            laser_rgb: laser_rgb(rig.laser.colour),
            has_steps: scene.wall.has_edges(),
            ground: view,
        }
    }

    /// Where a ray of the camera (x, y, 1) meets the wall; `guess_mm` is a depth nearby. `None`: it misses.
    #[inline]
    pub(super) fn hit(&self, x: f32, y: f32, guess_mm: f32) -> Option<Hit> {
        let r = &self.rotation;
        let d: [f32; 3] = std::array::from_fn(|i| r[i][0] * x + r[i][1] * y + r[i][2]);
        let at = |depth: f32| -> ([f32; 3], Sample) {
            let p: [f32; 3] = std::array::from_fn(|i| self.position[i] + d[i] * depth);
            (p, self.ground.sample(p[0], p[1]))
        };
        let nearby = if self.has_steps { None } else { newton(&d, guess_mm, at) };
        let depth_mm = nearby.unwrap_or_else(|| self.march(&d, at));
        let (point, sample) = at(depth_mm);
        let met = (sample[0] - point[2]).abs() < MET_MM && point[1].abs() <= self.y_limit_mm;
        met.then(|| {
            let n = &self.plane;
            let from_plane_mm = depth_mm * (n[0] * x + n[1] * y + n[2]) - n[3];
            Hit { depth_mm, point, sample, from_plane_mm }
        })
    }

    /// The first meeting from the front, where blocks hide what lies behind them.
    fn march(&self, d: &[f32; 3], at: impl Fn(f32) -> ([f32; 3], Sample)) -> f32 {
        let mut before = (self.z_near_mm - self.position[2]) / d[2];
        for _ in 0..40 {
            let (p, s) = at(before);
            let next = before + (s[0] - p[2]) / d[2] + 0.02;
            let (p, s) = at(next);
            if p[2] >= s[0] {
                let (mut low, mut high) = (before, next);
                for _ in 0..12 {
                    let middle = 0.5 * (low + high);
                    let (p, s) = at(middle);
                    if p[2] >= s[0] { high = middle } else { low = middle }
                }
                return high;
            }
            before = next;
        }
        before
    }

    /// The light of a place without the laser's and with only the laser's: linear red, green, blue in full scales.
    pub(super) fn shade(&self, hit: &Hit) -> ([f32; 3], [f32; 3]) {
        let normal = normalised([hit.sample[1], hit.sample[2], -1.0]);
        let (mut albedo, mut glow) = (self.albedo(hit), [0.0; 3]);
        for decal in &self.decals {
            decal.apply(f64::from(hit.point[0]) + self.ground.x0_mm, f64::from(hit.point[1]), &mut albedo, &mut glow);
        }
        let ambient = self.ambient(hit, &normal);
        let gloss = self.gloss(hit, &normal);
        let laser = self.laser_signal(hit, &normal);
        (
            std::array::from_fn(|c| ambient * albedo[c] + glow[c] + gloss),
            std::array::from_fn(|c| laser * albedo[c] * self.laser_rgb[c]),
        )
    }

    fn albedo(&self, hit: &Hit) -> [f32; 3] {
        let material = &self.scene.material;
        let mut albedo = hit.sample[3];
        if self.scene.texture == TextureReach::AwayFromLine {
            let mean = material.albedo as f32;
            let away_px = hit.from_plane_mm.abs() * self.focal_px / hit.depth_mm;
            let t = ((away_px - 28.0) / 28.0).clamp(0.0, 1.0);
            albedo = mean + (albedo - mean) * t * t * (3.0 - 2.0 * t);
        }
        std::array::from_fn(|c| albedo * material.tint[c] as f32)
    }

    fn ambient(&self, hit: &Hit, normal: &[f32; 3]) -> f32 {
        let light = &self.scene.ambient;
        let (level, share) = (light.level as f32, light.lamp_share as f32);
        if share == 0.0 {
            return level;
        }
        let way: [f32; 3] = std::array::from_fn(|i| self.lamp[i] - hit.point[i]);
        let square = dot(&way, &way);
        let cosine = (dot(normal, &way) / square.sqrt()).max(0.0);
        let nominal = self.scene.wall.distance_mm as f32;
        level * (1.0 - share + share * cosine * (nominal * nominal / square).min(2.0))
    }

    /// The highlight of a lamp that is long along x: it depends on the directions across x only.
    fn gloss(&self, hit: &Hit, normal: &[f32; 3]) -> f32 {
        let strength = self.scene.material.gloss as f32;
        if strength == 0.0 {
            return 0.0;
        }
        let across = |target: &[f32; 3]| {
            let (y, z) = (target[1] - hit.point[1], target[2] - hit.point[2]);
            let length = (y * y + z * z).sqrt();
            (y / length, z / length)
        };
        let (eye, tube) = (across(&self.position), across(&self.tube));
        let (hy, hz) = (eye.0 + tube.0, eye.1 + tube.1);
        let cosine = ((normal[1] * hy + normal[2] * hz) / (hy * hy + hz * hz).sqrt()).max(0.0);
        // To the power of 256.
        strength * (0..8).fold(cosine, |power, _| power * power)
    }

    fn laser_signal(&self, hit: &Hit, normal: &[f32; 3]) -> f32 {
        let light = &self.scene.laser;
        let LineProfile::Fan { sigma_mm } = light.profile else { return 0.0 };
        // The pixel's own width widens the Gaussian: exact in its second moment, and never one-sided.
        let pixel_mm = hit.depth_mm / self.focal_px;
        let variance = (sigma_mm * sigma_mm) as f32 + pixel_mm * pixel_mm / 12.0;
        let square = hit.from_plane_mm * hit.from_plane_mm;
        if !light.on || square > 40.0 * variance || !self.is_lit(hit) {
            return 0.0;
        }
        let way: [f32; 3] = std::array::from_fn(|i| self.laser[i] - hit.point[i]);
        let length = dot(&way, &way).sqrt();
        let cosine = (dot(normal, &way) / length).max(0.0);
        let nominal = self.scene.wall.distance_mm as f32;
        light.power as f32 * cosine * (nominal / length) * (-0.5 * square / variance).exp()
    }

    /// True where nothing stands between the laser and the place.
    pub(super) fn is_lit(&self, hit: &Hit) -> bool {
        if !self.has_steps {
            return true;
        }
        let way: [f32; 3] = std::array::from_fn(|i| self.laser[i] - hit.point[i]);
        let reach = (hit.point[2] - self.z_near_mm) / -way[2];
        // The first tenth of a millimetre is the place's own flank.
        const PROBES: u8 = 40;
        (1..=PROBES).all(|i| {
            let t = reach * f32::from(i) / f32::from(PROBES);
            let p: [f32; 3] = std::array::from_fn(|k| hit.point[k] + way[k] * t);
            self.ground.sample(p[0], p[1])[0] > p[2] - 0.1
        })
    }
}

/// A ray has met the surface when it is so near, mm; a block's flank is baked about this steep.
const MET_MM: f32 = 1.0;

/// Newton's method with the baked slope, from a neighbour's depth: one or two steps. `None`: it leads nowhere.
fn newton(d: &[f32; 3], guess_mm: f32, at: impl Fn(f32) -> ([f32; 3], Sample)) -> Option<f32> {
    let mut depth = guess_mm;
    for _ in 0..8 {
        let (p, s) = at(depth);
        let miss = s[0] - p[2];
        let step = miss / (d[2] - s[1] * d[0] - s[2] * d[1]).max(0.3);
        depth += step;
        if step.abs() < 0.01 {
            return Some(depth);
        }
    }
    None
}

fn dot(a: &[f32; 3], b: &[f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn normalised(v: [f32; 3]) -> [f32; 3] {
    let scale = 1.0 / dot(&v, &v).sqrt();
    v.map(|c| c * scale)
}
