//! What a simulated run shows: surface, light, laser, sensor and motion, with a name for each useful mixture.

use nalgebra::Vector3;

use super::motion::Motion;
use super::wall::{Block, Bump, Bumps, Shape, StepRow, Wall};
use crate::error::{Error, Result};
use crate::geometry::Plane;
use crate::rig::{Camera, Laser, LaserColour, LineDirection, Rig};

/// What the surface looks like.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Material {
    /// Mean share of light that comes back, 0 to 1.
    pub albedo: f64,
    /// Greatest relative deviation from it by the texture's clouds; 0 = none at all, neither spots nor cracks.
    pub contrast: f64,
    /// Spots and cracks besides the clouds.
    pub spots: bool,
    /// Strength of the highlight of a long lamp above, in full scales of the sensor; 0 = a dull surface.
    pub gloss: f64,
    /// Tint: red, green, blue around 1.
    pub tint: [f64; 3],
}

/// Where the texture is seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TextureReach {
    /// Everywhere, also under the laser line, whose light it disturbs as on a real wall.
    Everywhere,
    /// Only away from the laser line, fading out towards it: motion can be measured and the line stays exact.
    AwayFromLine,
}

/// The light other than the laser's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ambient {
    /// Signal of a white surface facing the lamp at the nominal distance, in full scales of the sensor.
    pub level: f64,
    /// Share that comes from a lamp on the robot (falls off, shades the relief); the rest is the same everywhere.
    pub lamp_share: f64,
}

/// The cross section of the laser line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LineProfile {
    /// A Gaussian across the laser's plane, as a real fan: its standard deviation in mm.
    Fan {
        /// Standard deviation of the light across the plane, mm.
        sigma_mm: f64,
    },
    /// A Gaussian along the image row, exactly symmetric about the true column: for exact tests.
    Image {
        /// Standard deviation in the image, px.
        sigma_px: f64,
    },
}

/// The laser's light.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LaserLight {
    /// False: switched off.
    pub on: bool,
    /// Signal at the line's centre on a white surface at the nominal distance, in full scales of the sensor.
    pub power: f64,
    /// Its cross section.
    pub profile: LineProfile,
    /// Relative deviation by speckle; 0 = none.
    pub speckle: f64,
}

/// The sensor's noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SensorNoise {
    /// Standard deviation without light, in full scales.
    pub read: f64,
    /// Electrons of a full scale; the shot noise of a signal s is √(s / electrons). Infinite = none.
    pub electrons: f64,
}

/// All that a simulated run shows. Every field may be set; [`Scene::named`] gives the useful mixtures.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// Its name.
    pub name: String,
    /// The surface; its `seed` is set by the simulation's own, or by `wall_seed`.
    pub wall: Wall,
    /// What makes one wall differ from another, where it shall not be what makes one run differ from another: two runs
    /// along one wall.
    pub wall_seed: Option<u64>,
    /// Show the wall some time later ([`Wall::age`]).
    pub later: bool,
    /// What the surface looks like.
    pub material: Material,
    /// Where its texture is seen.
    pub texture: TextureReach,
    /// Lamps and coloured paint on the wall, some of it in the laser's colour.
    pub distractors: bool,
    /// The light other than the laser's.
    pub ambient: Ambient,
    /// The laser's light.
    pub laser: LaserLight,
    /// The laser's colour, for the rig that [`Scene::rig`] makes.
    pub colour: LaserColour,
    /// How the line lies in the image, for the rig that [`Scene::rig`] makes.
    pub line: LineDirection,
    /// The lens, OpenCV's k1 k2 p1 p2 k3 …, for the rig that [`Scene::rig`] makes.
    pub distortion: [f64; 8],
    /// The rig to use instead; its image size is then the video's.
    pub custom_rig: Option<Rig>,
    /// The sensor's noise; `None` = none.
    pub noise: Option<SensorNoise>,
    /// The robot's motion.
    pub motion: Motion,
    /// Its speed, mm/s.
    pub speed_mm_s: f64,
}

/// The names of all scenes, with one line of explanation each.
pub const SCENES: [(&str, &str); 14] = [
    ("wall", "a concrete wall at 850 mm with dents and bulges up to 18 mm; wheels"),
    ("pipe", "a fiberglass pipe at 450 mm, radius 300 mm, with a highlight; a walking robot's jitter"),
    ("pipe-steady", "the same pipe from a rail"),
    ("step-gauge", "a plate at 450 mm with blocks of 1, 2, 5, 10 and 20 mm; rail"),
    ("lens", "the wall through a lens with k1 = -0.28, k2 = 0.10"),
    ("distractor", "the wall with green, red, blue and white lamps and green paint"),
    ("no-laser", "the wall with the laser switched off: the right answer is nothing"),
    ("stop", "the wall; the robot stands still, goes back some way and drives on"),
    ("low-light", "the wall in near darkness: much noise, a weak laser"),
    ("white", "a white wall: the line's core is white and wide"),
    ("black", "a black wall: a faint line"),
    ("damaged", "a wall with dents, bulges, a hole, a place broken off and a block that stands out"),
    ("sound", "a wall with slow waves and no defect at all"),
    ("pipe-oval", "a pipe without defects whose section is oval by 1 %"),
];

impl Scene {
    /// The scene of that name; [`SCENES`] lists them.
    pub fn named(name: &str) -> Result<Scene> {
        let wall = Scene::concrete;
        let mut scene = match name {
            "wall" | "low-light" | "white" | "black" => wall(),
            "pipe" => Scene::pipe(),
            "pipe-steady" => Scene { motion: Motion::Steady, ..Scene::pipe() },
            "step-gauge" => Scene::step_gauge(),
            "lens" => Scene { distortion: [-0.28, 0.10, 0.0008, -0.0005, 0.0, 0.0, 0.0, 0.0], ..wall() },
            "distractor" => Scene { distractors: true, ..wall() },
            "no-laser" => Scene { laser: LaserLight { on: false, ..wall().laser }, ..wall() },
            "stop" => Scene { motion: Motion::Stop, ..wall() },
            "damaged" => Scene::damaged(),
            "sound" => Scene { wall: Wall { bumps: None, ..wall().wall }, ..wall() },
            "pipe-oval" => {
                let pipe = Scene::pipe();
                Scene { wall: Wall { bumps: None, ovality: 0.01, ..pipe.wall }, ..pipe }
            }
            _ => {
                let names: Vec<&str> = SCENES.iter().map(|s| s.0).collect();
                return Err(Error::input("scene", format!("'{name}'"), format!("one of {}", names.join(", "))));
            }
        };
        scene.name = name.to_string();
        match name {
            "white" => scene.material.albedo = 0.85,
            "black" => scene.material.albedo = 0.035,
            "low-light" => {
                scene.ambient.level = 0.03;
                scene.laser.power = 5.0;
                scene.noise = Some(SensorNoise { read: 0.006, electrons: 500.0 });
            }
            _ => {}
        }
        Ok(scene)
    }

    fn concrete() -> Scene {
        Scene {
            name: "wall".into(),
            wall: Wall {
                shape: Shape::Flat,
                distance_mm: 850.0,
                bumps: Some(Bumps { cell_mm: 720.0, height_mm: 17.0, radius_mm: 85.0, y_half_mm: 165.0 }),
                ovality: 0.0,
                placed: Vec::new(),
                blocks: Vec::new(),
                waves_mm: 1.2,
                steps: Vec::new(),
                seed: 0,
            },
            wall_seed: None,
            later: false,
            material: Material { albedo: 0.36, contrast: 0.5, spots: true, gloss: 0.0, tint: [1.0, 1.01, 0.93] },
            texture: TextureReach::Everywhere,
            distractors: false,
            ambient: Ambient { level: 0.5, lamp_share: 0.5 },
            laser: LaserLight { on: true, power: 13.0, profile: LineProfile::Fan { sigma_mm: 1.4 }, speckle: 0.15 },
            colour: LaserColour::Green,
            line: LineDirection::Vertical,
            distortion: [0.0; 8],
            custom_rig: None,
            noise: Some(SensorNoise { read: 0.002, electrons: 9000.0 }),
            motion: Motion::Wheels,
            speed_mm_s: 200.0,
        }
    }

    fn pipe() -> Scene {
        let wall = Scene::concrete();
        Scene {
            name: "pipe".into(),
            wall: Wall {
                shape: Shape::Pipe { radius_mm: 300.0 },
                distance_mm: 450.0,
                bumps: Some(Bumps { cell_mm: 500.0, height_mm: 5.5, radius_mm: 50.0, y_half_mm: 110.0 }),
                waves_mm: 0.0,
                ..wall.wall
            },
            material: Material { albedo: 0.3, contrast: 0.22, spots: true, gloss: 2.2, tint: [0.96, 1.02, 0.9] },
            laser: LaserLight { profile: LineProfile::Fan { sigma_mm: 0.87 }, ..wall.laser },
            motion: Motion::Gait,
            ..wall
        }
    }

    fn damaged() -> Scene {
        let wall = Scene::concrete();
        let block = |x: f64, y: f64, half_x: f64, half_y: f64, height: f64| Block { x, y, half_x, half_y, height };
        let bump = |x: f64, y: f64, r: f64, height: f64| Bump { x, y, r, height };
        let blocks = vec![
            block(220.0, -120.0, 30.0, 25.0, 25.0),
            block(360.0, 110.0, 50.0, 30.0, 5.0),
            block(480.0, -60.0, 25.0, 25.0, -6.0),
        ];
        let placed = vec![bump(250.0, 40.0, 20.0, 3.0), bump(620.0, 90.0, 45.0, -8.0), bump(640.0, -110.0, 70.0, 12.0)];
        Scene { wall: Wall { bumps: None, blocks, placed, ..wall.wall }, ..wall }
    }

    fn step_gauge() -> Scene {
        let wall = Scene::concrete();
        let heights = [(1.0, -90.0), (2.0, -45.0), (5.0, 0.0), (10.0, 45.0), (20.0, 90.0)];
        let steps = heights.map(|(height, y)| StepRow { height, y, half: 15.0, x_period: 150.0, x_on: 100.0 });
        Scene {
            name: "step-gauge".into(),
            wall: Wall { distance_mm: 450.0, bumps: None, waves_mm: 0.0, steps: steps.to_vec(), ..wall.wall },
            material: Material { contrast: 0.3, ..wall.material },
            laser: LaserLight { profile: LineProfile::Fan { sigma_mm: 0.87 }, ..wall.laser },
            motion: Motion::Steady,
            ..wall
        }
    }

    /// The scene with everything inexact taken away: no texture, noise, speckle, saturation or change of the
    /// light, and a line that is a Gaussian in the image, symmetric about the true column. What remains is the
    /// rounding to 8 bits: some 0.005 px for a centroid. (The line's width, 2.5 px, is where the paper's midpoint
    /// of two interpolated crossings errs least: 0.008 px in the median, 0.04 px at most, at K = 0.9.)
    pub fn exact(mut self) -> Scene {
        self.material = Material { contrast: 0.0, spots: false, gloss: 0.0, tint: [1.0; 3], albedo: 0.5 };
        self.distractors = false;
        self.ambient = Ambient { level: 0.1, lamp_share: 0.0 };
        self.laser.power = 1.5;
        self.laser.speckle = 0.0;
        self.laser.profile = LineProfile::Image { sigma_px: 2.5 };
        self.noise = None;
        self
    }

    /// [`Scene::exact`] with a clean texture away from the laser line, so that motion can be measured too.
    pub fn exact_with_texture(self) -> Scene {
        let mut scene = self.exact();
        scene.material.contrast = 0.7;
        scene.ambient.level = 0.3;
        scene.texture = TextureReach::AwayFromLine;
        scene
    }

    /// The scene on its undamaged shape: no dents, bulges, waves or blocks.
    pub fn without_relief(mut self) -> Scene {
        self.wall.bumps = None;
        self.wall.waves_mm = 0.0;
        self.wall.placed.clear();
        self.wall.steps.clear();
        self.wall.blocks.clear();
        self
    }

    /// True where nothing random is left in the image.
    pub fn is_exact(&self) -> bool {
        matches!(self.laser.profile, LineProfile::Image { .. })
    }

    /// The rig for an image size: a view of 65.4° across, the laser 150 mm beside the camera and turned by 95°.
    pub fn rig(&self, width_px: u32, height_px: u32) -> Rig {
        if let Some(rig) = &self.custom_rig {
            return rig.clone();
        }
        let (width, height) = (f64::from(width_px), f64::from(height_px));
        // With a horizontal line the laser sits above or below: the height must hold its range.
        let across = match self.line {
            LineDirection::Vertical => width,
            LineDirection::Horizontal => width.min(height * 16.0 / 9.0),
        };
        let focal_px = 0.5 * across / (65.4f64.to_radians() / 2.0).tan();
        let (sine, cosine) = ANGLE_DEG.to_radians().sin_cos();
        let normal = match self.line {
            LineDirection::Vertical => Vector3::new(sine, 0.0, -cosine),
            LineDirection::Horizontal => Vector3::new(0.0, sine, -cosine),
        };
        Rig {
            name: self.name.clone(),
            camera: Camera {
                width_px,
                height_px,
                fx_px: focal_px,
                fy_px: focal_px,
                cx_px: (width - 1.0) / 2.0,
                cy_px: (height - 1.0) / 2.0,
                distortion: self.distortion,
            },
            laser: Laser {
                colour: self.colour,
                line: self.line,
                plane: Plane { normal, offset_mm: BASELINE_MM * sine },
            },
        }
    }
}

/// The paper's d for the rigs made here, mm.
const BASELINE_MM: f64 = 150.0;

/// The paper's β for the rigs made here, degrees.
const ANGLE_DEG: f64 = 95.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_listed_scene_exists_and_its_rig_is_valid() {
        for (name, _) in SCENES {
            for line in [LineDirection::Vertical, LineDirection::Horizontal] {
                let mut scene = Scene::named(name).expect(name);
                scene.line = line;
                assert_eq!(scene.name, name);
                let rig = scene.rig(1280, 720);
                let back = Rig::from_toml(name, &rig.to_toml()).expect(name);
                assert_eq!(back.camera, rig.camera);
            }
        }
        let message = Scene::named("tunnel").expect_err("unknown").to_string();
        assert!(message.contains("tunnel") && message.contains("step-gauge"), "{message}");
    }
}
