//! The true surface: a wall or a pipe, with dents, bulges, waves and steps, as a height function z(x, y) in the world.

use nalgebra::{Point3, Vector3};
use serde::Serialize;

use super::noise::Stream;

/// The undamaged shape.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// A plane at a constant distance.
    Flat,
    /// A pipe along x, seen from outside.
    Pipe {
        /// Its radius, mm.
        radius_mm: f64,
    },
}

/// The random dents and bulges of a surface, repeated endlessly along x, each time different.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bumps {
    /// Length of the stretch that holds one set of eight, mm.
    pub cell_mm: f64,
    /// Height of the largest, mm.
    pub height_mm: f64,
    /// Radius of the largest, mm.
    pub radius_mm: f64,
    /// They lie within ± this of y = 0, mm.
    pub y_half_mm: f64,
}

/// One dent (height above 0: away from the camera) or bulge (below 0): a raised cosine.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Bump {
    /// Centre, mm.
    pub x: f64,
    /// Centre, mm.
    pub y: f64,
    /// Radius, mm.
    pub r: f64,
    /// Height, mm.
    pub height: f64,
}

/// A row of blocks standing out of the surface towards the camera, periodic along x.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct StepRow {
    /// Height, mm.
    pub height: f64,
    /// Middle of the row, mm.
    pub y: f64,
    /// Half of the blocks' width along y, mm.
    pub half: f64,
    /// Distance from one block to the next, mm.
    pub x_period: f64,
    /// Length of a block, mm.
    pub x_on: f64,
}

/// A block with steep sides: a pit or a hole (height above 0: away from the camera), or something that stands out.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Block {
    /// Centre, mm.
    pub x: f64,
    /// Centre, mm.
    pub y: f64,
    /// Half of its length along x, mm.
    pub half_x: f64,
    /// Half of its width along y, mm.
    pub half_y: f64,
    /// Height, mm.
    pub height: f64,
}

/// The surface of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Wall {
    /// The undamaged shape.
    pub shape: Shape,
    /// Distance of the undamaged surface from the camera at its first frame, mm.
    pub distance_mm: f64,
    /// A pipe's (largest − smallest diameter) / mean, its largest along z; 0 = round.
    pub ovality: f64,
    /// Dents and bulges, if any.
    pub bumps: Option<Bumps>,
    /// Dents and bulges at given places besides; one at the very place and with the radius of another deepens it.
    pub placed: Vec<Bump>,
    /// Blocks and pits at given places.
    pub blocks: Vec<Block>,
    /// Greatest height of the long waves of a surface that is not quite even, mm; 0 = even.
    pub waves_mm: f64,
    /// Blocks.
    pub steps: Vec<StepRow>,
    /// What makes one wall differ from another.
    pub seed: u64,
}

/// Half of the width of a block's flank, mm: the surface stays a function of (x, y).
const FLANK_HALF_MM: f64 = 0.15;

/// Share of a pipe's radius up to which it is seen; beyond, it is too steep to be a function of (x, y).
const PIPE_SEEN: f64 = 0.98;

impl Wall {
    /// True where the surface exists; a pipe ends at its sides.
    pub fn exists(&self, y_mm: f64) -> bool {
        match self.shape {
            Shape::Flat => true,
            Shape::Pipe { radius_mm } => y_mm.abs() <= PIPE_SEEN * self.half_axes_mm(radius_mm).0,
        }
    }

    /// True where the surface has steep sides: it is no smooth function of (x, y).
    pub(super) fn has_edges(&self) -> bool {
        !self.steps.is_empty() || !self.blocks.is_empty()
    }

    /// Half axes of a pipe's section along y and z, mm.
    fn half_axes_mm(&self, radius_mm: f64) -> (f64, f64) {
        (radius_mm * (1.0 - 0.5 * self.ovality), radius_mm * (1.0 + 0.5 * self.ovality))
    }

    /// The undamaged shape's z, mm; continued steeply beyond a pipe's sides.
    fn base_z_mm(&self, y_mm: f64) -> f64 {
        match self.shape {
            Shape::Flat => self.distance_mm,
            Shape::Pipe { radius_mm } => {
                let (half_y, half_z) = self.half_axes_mm(radius_mm);
                let inside = y_mm.abs().min(PIPE_SEEN * half_y);
                let drop = (half_y * half_y - inside * inside).sqrt();
                self.distance_mm + half_z / half_y * (half_y - drop + (y_mm.abs() - inside) * inside / drop)
            }
        }
    }

    /// The nearest and the farthest z that the surface can have, mm.
    pub(super) fn z_range_mm(&self) -> (f64, f64) {
        let placed = self.placed.iter().map(|b| b.height.abs()).sum::<f64>();
        let bump = self.bumps.map_or(0.0, |b| 1.6 * b.height_mm) + placed;
        let block = self.blocks.iter().map(|b| b.height.abs()).fold(0.0, f64::max);
        let step = self.steps.iter().map(|s| s.height).fold(0.0, f64::max);
        let far = match self.shape {
            Shape::Flat => self.distance_mm,
            Shape::Pipe { radius_mm } => self.base_z_mm(PIPE_SEEN * radius_mm),
        };
        (self.distance_mm - bump - self.waves_mm - step - block - 0.5, far + bump + self.waves_mm + block + 0.5)
    }

    /// The part of the surface between two x, ready for many questions.
    pub(super) fn window(&self, x_min_mm: f64, x_max_mm: f64) -> WallWindow<'_> {
        let bumps = self.bumps_between(x_min_mm, x_max_mm);
        let count = ((x_max_mm - x_min_mm) / BUCKET_MM).ceil().max(1.0) as usize;
        let mut buckets = vec![Vec::new(); count];
        for bump in &bumps {
            for (i, bucket) in buckets.iter_mut().enumerate() {
                let start = x_min_mm + i as f64 * BUCKET_MM;
                if bump.x + bump.r > start - 1.0 && bump.x - bump.r < start + BUCKET_MM + 1.0 {
                    bucket.push(*bump);
                }
            }
        }
        WallWindow { wall: self, waves: self.waves(), x_min_mm, buckets }
    }

    /// The bumps that reach into a stretch of x.
    pub fn bumps_between(&self, x_min_mm: f64, x_max_mm: f64) -> Vec<Bump> {
        let mut all: Vec<Bump> = match self.bumps {
            Some(bumps) => {
                let reach = 1.2 * bumps.radius_mm;
                let first = ((x_min_mm - reach) / bumps.cell_mm).floor() as i64;
                let last = ((x_max_mm + reach) / bumps.cell_mm).floor() as i64;
                (first..=last).flat_map(|cell| self.bumps_of_cell(&bumps, cell)).collect()
            }
            None => Vec::new(),
        };
        for placed in &self.placed {
            match all.iter_mut().find(|b| (b.x, b.y, b.r) == (placed.x, placed.y, placed.r)) {
                Some(known) => known.height += placed.height,
                None => all.push(*placed),
            }
        }
        all.retain(|b| b.x + b.r >= x_min_mm && b.x - b.r <= x_max_mm);
        all
    }

    /// What became of the wall some time later: the first large dent past `x_mm` is 2 mm deeper, and beyond it there is a new
    /// one, 4 mm deep and 30 mm in radius, clear of the others.
    pub fn age(&mut self, x_mm: f64) {
        let bumps = self.bumps_between(x_mm, x_mm + 1500.0);
        let deeper = bumps
            .iter()
            .filter(|b| b.height > 2.0 && b.r > 30.0 && b.x - b.r > x_mm)
            .min_by(|a, b| a.x.total_cmp(&b.x))
            .copied();
        self.placed.extend(deeper.map(|dent| Bump { height: 2.0, ..dent }));
        let new = |i: u32| Bump {
            x: x_mm + 60.0 + 15.0 * f64::from(i / 8),
            y: 35.0 * f64::from(i % 8) - 122.5,
            r: 30.0,
            height: 4.0,
        };
        let clear = |new: &Bump| bumps.iter().all(|b| (b.x - new.x).hypot(b.y - new.y) > b.r + new.r + 15.0);
        self.placed.extend((0..400).map(new).find(clear));
    }

    fn bumps_of_cell(&self, bumps: &Bumps, cell: i64) -> [Bump; 8] {
        let mut stream = Stream::at(self.seed ^ 0xb0, cell, 0);
        // From large to small, a dent and a bulge in turn; the order along x mixes the sizes.
        const SIZES: [f64; 8] = [1.0, 0.28, 0.85, 0.2, 0.6, 0.4, 0.5, 0.16];
        std::array::from_fn(|k| {
            let size = SIZES[k];
            let r = bumps.radius_mm * size * stream.between(0.85, 1.15);
            let sign = if (k / 2 + k) % 2 == 0 { 1.0 } else { -1.0 };
            Bump {
                x: (cell as f64 + (k as f64 + stream.between(0.2, 0.8)) / 8.0) * bumps.cell_mm,
                y: bumps.y_half_mm * stream.between(-1.0, 1.0),
                r,
                height: sign * bumps.height_mm * size * stream.between(0.8, 1.0),
            }
        })
    }

    /// Five plane waves: (wave vector along x and y in radians per mm, phase, height in mm).
    fn waves(&self) -> Vec<[f64; 4]> {
        if self.waves_mm == 0.0 {
            return Vec::new();
        }
        let mut stream = Stream::at(self.seed ^ 0x3a7e, 0, 0);
        (0..5)
            .map(|i| {
                let length_mm = 420.0 / 1.6f64.powi(i) * stream.between(0.9, 1.1);
                let (sine, cosine) = stream.between(0.0, std::f64::consts::PI).sin_cos();
                let k = std::f64::consts::TAU / length_mm;
                [
                    k * cosine,
                    k * sine,
                    stream.between(0.0, std::f64::consts::TAU),
                    self.waves_mm * 0.4 / 1.45f64.powi(i),
                ]
            })
            .collect()
    }
}

const BUCKET_MM: f64 = 25.0;

/// A stretch of the surface with its bumps at hand.
pub(super) struct WallWindow<'a> {
    wall: &'a Wall,
    waves: Vec<[f64; 4]>,
    x_min_mm: f64,
    buckets: Vec<Vec<Bump>>,
}

impl WallWindow<'_> {
    /// The surface's z, mm. Continued beyond a pipe's sides, where [`Wall::exists`] says no.
    pub(super) fn z_mm(&self, x_mm: f64, y_mm: f64) -> f64 {
        let mut z = self.wall.base_z_mm(y_mm);
        for [kx, ky, phase, height] in &self.waves {
            z += height * (kx * x_mm + ky * y_mm + phase).sin();
        }
        let bucket = ((x_mm - self.x_min_mm) / BUCKET_MM).max(0.0) as usize;
        for bump in &self.buckets[bucket.min(self.buckets.len() - 1)] {
            let (dx, dy) = (x_mm - bump.x, y_mm - bump.y);
            let square = dx * dx + dy * dy;
            if square < bump.r * bump.r {
                let cosine = (0.5 * std::f64::consts::PI * square.sqrt() / bump.r).cos();
                z += bump.height * cosine * cosine;
            }
        }
        for step in &self.wall.steps {
            z -= step.height * step_inside(step, x_mm, y_mm);
        }
        for block in &self.wall.blocks {
            let (beside_x, beside_y) = (block.half_x - (x_mm - block.x).abs(), block.half_y - (y_mm - block.y).abs());
            z += block.height * flank(beside_x) * flank(beside_y);
        }
        z
    }

    /// The slope of the surface, (dz/dx, dz/dy), taken over ± `reach_mm`.
    pub(super) fn slope(&self, x_mm: f64, y_mm: f64, reach_mm: f64) -> (f64, f64) {
        let z = |dx: f64, dy: f64| self.z_mm(x_mm + dx * reach_mm, y_mm + dy * reach_mm);
        ((z(1.0, 0.0) - z(-1.0, 0.0)) / (2.0 * reach_mm), (z(0.0, 1.0) - z(0.0, -1.0)) / (2.0 * reach_mm))
    }

    /// How far along a ray from `from` (both in the world) the surface is first met, in lengths of
    /// `direction`; `None` where the ray misses it. `near` is a length at which the ray is still before it.
    pub(super) fn first_hit(&self, from: &Point3<f64>, direction: &Vector3<f64>, near: f64) -> Option<f64> {
        // How far the surface lies behind the ray's point: positive before the surface.
        let ahead_mm = |l: f64| {
            let p = from + direction * l;
            self.z_mm(p.x, p.y) - p.z
        };
        let (mut before, mut ahead_before) = (near, ahead_mm(near));
        for _ in 0..200 {
            // A little deeper than the surface lies here: it is soon passed, and so enclosed.
            let next = before + (1.2 * ahead_before + 0.01) / direction.z;
            let ahead_next = ahead_mm(next);
            if ahead_next <= 0.0 {
                let l = enclosed_root(ahead_mm, (before, ahead_before), (next, ahead_next));
                return self.wall.exists(from.y + direction.y * l).then_some(l);
            }
            if ahead_next > 1e4 {
                return None;
            }
            (before, ahead_before) = (next, ahead_next);
        }
        self.wall.exists(from.y + direction.y * before).then_some(before)
    }
}

/// 1 on a block, 0 beside it, a short ramp between.
fn step_inside(step: &StepRow, x_mm: f64, y_mm: f64) -> f64 {
    let x = x_mm.rem_euclid(step.x_period);
    // Distance inside the block along x, also for a point just before the next block's start.
    let inside_x = (0.5 * step.x_on) - (x - 0.5 * step.x_on).abs().min((x - step.x_period - 0.5 * step.x_on).abs());
    let inside_y = step.half - (y_mm - step.y).abs();
    flank(inside_x) * flank(inside_y)
}

/// From 0 to 1 across a block's side.
fn flank(inside_mm: f64) -> f64 {
    (0.5 + inside_mm / (2.0 * FLANK_HALF_MM)).clamp(0.0, 1.0)
}

/// The zero of `f` between two points where it has opposite signs (Illinois' variant of the false position).
pub(super) fn enclosed_root(f: impl Fn(f64) -> f64, low: (f64, f64), high: (f64, f64)) -> f64 {
    let ((mut a, mut fa), (mut b, mut fb)) = (low, high);
    let mut last_side = 0;
    for turn in 0..80 {
        if fa == 0.0 || (b - a).abs() < 1e-11 * (1.0 + a.abs()) {
            return a;
        }
        // False position; every eighth turn a halving, for functions that jump.
        let m = if turn % 8 == 7 { 0.5 * (a + b) } else { (a * fb - b * fa) / (fb - fa) };
        let fm = f(m);
        if fm.abs() < 1e-12 {
            return m;
        }
        if (fm > 0.0) == (fa > 0.0) {
            (a, fa) = (m, fm);
            if last_side == -1 {
                fb *= 0.5;
            }
            last_side = -1;
        } else {
            (b, fb) = (m, fm);
            if last_side == 1 {
                fa *= 0.5;
            }
            last_side = 1;
        }
    }
    0.5 * (a + b)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bumpy() -> Wall {
        let bumps = Bumps { cell_mm: 700.0, height_mm: 17.0, radius_mm: 90.0, y_half_mm: 160.0 };
        Wall {
            shape: Shape::Flat,
            distance_mm: 850.0,
            ovality: 0.0,
            bumps: Some(bumps),
            placed: vec![],
            blocks: vec![],
            waves_mm: 1.0,
            steps: vec![],
            seed: 5,
        }
    }

    #[test]
    fn a_ray_ends_on_the_surface() {
        let pipe = Wall { shape: Shape::Pipe { radius_mm: 300.0 }, distance_mm: 450.0, ..bumpy() };
        for wall in [bumpy(), pipe] {
            let window = wall.window(-800.0, 800.0);
            for i in 0..200 {
                let direction = Vector3::new(-0.6 + 0.006 * f64::from(i), -0.3 + 0.003 * f64::from(i), 1.0);
                let l = window.first_hit(&Point3::origin(), &direction, wall.z_range_mm().0 - 40.0).expect("met");
                let hit = direction * l;
                assert!((window.z_mm(hit.x, hit.y) - hit.z).abs() < 1e-8, "{wall:?} {hit}");
            }
        }
    }

    #[test]
    fn a_block_hides_what_lies_behind_it() {
        let step = StepRow { height: 20.0, y: 0.0, half: 15.0, x_period: 150.0, x_on: 100.0 };
        let wall = Wall { steps: vec![step], bumps: None, waves_mm: 0.0, distance_mm: 450.0, ..bumpy() };
        let window = wall.window(-300.0, 300.0);
        let z_at = |x: f64| {
            let direction = Vector3::new(x / 450.0, 0.0, 1.0);
            let l = window.first_hit(&Point3::origin(), &direction, 400.0).expect("met");
            (direction * l).z
        };
        // Looking past the block's near flank at x = 150: the flank at x = 150 is met before its top.
        assert!((z_at(-25.0) - 450.0).abs() < 1e-6, "the plate between two blocks");
        assert!((z_at(20.0) - 430.0).abs() < 1e-6, "a block's top");
        let flank = z_at(153.0);
        assert!(flank > 430.1 && flank < 449.9, "a flank at {flank} mm");
    }

    #[test]
    fn an_oval_pipe_is_wider_along_the_view() {
        let pipe =
            Wall { shape: Shape::Pipe { radius_mm: 300.0 }, ovality: 0.01, bumps: None, waves_mm: 0.0, ..bumpy() };
        let (z, y) = (pipe.base_z_mm(200.0) - pipe.distance_mm - 301.5, 200.0 / 298.5);
        assert!(((z / 301.5).powi(2) + y * y - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_wall_ages_by_a_deeper_dent_and_a_new_one() {
        let mut later = bumpy();
        later.age(300.0);
        let (before, after) = (bumpy().bumps_between(0.0, 3000.0), later.bumps_between(0.0, 3000.0));
        assert_eq!(after.len(), before.len() + 1);
        let grown: Vec<f64> =
            before.iter().zip(&after).map(|(a, b)| b.height - a.height).filter(|h| *h != 0.0).collect();
        assert_eq!(grown.len(), 1);
        assert!((grown[0] - 2.0).abs() < 1e-12);
    }

    #[test]
    fn bumps_do_not_depend_on_the_window() {
        let wall = bumpy();
        let (wide, narrow) = (wall.window(-2000.0, 2000.0), wall.window(290.0, 310.0));
        for i in 0..100 {
            let y = -150.0 + 3.0 * f64::from(i);
            assert_eq!(wide.z_mm(300.0, y), narrow.z_mm(300.0, y));
        }
    }
}
