//! The rig: one camera and one laser, fixed to each other. Load, check, undistort, project.

use std::path::Path;

use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::geometry::{Plane, RawPixel, UndistortedRay};

/// The largest image side Stria takes, px. Larger sizes are refused before memory is asked for.
pub const MAX_IMAGE_SIDE_PX: u32 = 8192;

/// The colour of the laser's light.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LaserColour {
    /// About 520 to 532 nm, the publication's choice.
    #[default]
    Green,
    /// About 635 to 660 nm.
    Red,
    /// About 405 to 450 nm.
    Blue,
}

/// How the laser line lies in the image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LineDirection {
    /// Along the image's columns: one spot per row.
    #[default]
    Vertical,
    /// Along the image's rows: one spot per column.
    Horizontal,
}

/// The camera's calibration, in OpenCV's model.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// Columns of the image.
    pub width_px: u32,
    /// Rows of the image.
    pub height_px: u32,
    /// Focal length along x, px.
    pub fx_px: f64,
    /// Focal length along y, px.
    pub fy_px: f64,
    /// Principal point, column, px.
    pub cx_px: f64,
    /// Principal point, row, px.
    pub cy_px: f64,
    /// k1 k2 p1 p2 k3 k4 k5 k6, OpenCV's order; absent ones are zero.
    pub distortion: [f64; 8],
}

/// The laser's calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct Laser {
    /// Its colour.
    pub colour: LaserColour,
    /// How its line lies in the image.
    pub line: LineDirection,
    /// The plane of its light in the camera's frame.
    pub plane: Plane,
}

/// One camera and one laser.
#[derive(Clone, Debug, PartialEq)]
pub struct Rig {
    /// A name for people.
    pub name: String,
    /// The camera.
    pub camera: Camera,
    /// The laser.
    pub laser: Laser,
}

/// The rig file as written (CONTRACT.md, "Rig file").
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RigFile {
    name: String,
    camera: CameraFile,
    laser: LaserFile,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraFile {
    width_px: u32,
    height_px: u32,
    #[serde(skip_serializing_if = "Option::is_none")]
    fov_deg: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    fx_px: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    fy_px: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    cx_px: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    cy_px: Option<f64>,
    #[serde(default)]
    distortion: Vec<f64>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct LaserFile {
    #[serde(default)]
    colour: LaserColour,
    #[serde(default)]
    line: LineDirection,
    #[serde(skip_serializing_if = "Option::is_none")]
    plane_normal: Option<[f64; 3]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    plane_offset_mm: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    baseline_mm: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    angle_deg: Option<f64>,
}

impl Rig {
    /// Reads a rig file: TOML, or JSON where the name ends in `.json`.
    pub fn load(path: &Path) -> Result<Rig> {
        let text = std::fs::read_to_string(path).map_err(|e| match e.kind() {
            std::io::ErrorKind::InvalidData => {
                Error::input(path.display().to_string(), "not text", "a rig file in TOML or JSON")
            }
            _ => Error::io(path, e),
        })?;
        let subject = path.display().to_string();
        if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("json")) {
            Rig::from_json(&subject, &text)
        } else {
            Rig::from_toml(&subject, &text)
        }
    }

    /// Reads a rig from TOML text; `subject` names it in errors.
    pub fn from_toml(subject: &str, text: &str) -> Result<Rig> {
        let file: RigFile = toml::from_str(text)
            .map_err(|e| Error::input(subject, e.to_string(), "a rig file as CONTRACT's section 'Rig file' shows"))?;
        Rig::from_file(subject, file)
    }

    /// Reads a rig from JSON text; `subject` names it in errors.
    pub fn from_json(subject: &str, text: &str) -> Result<Rig> {
        let file: RigFile = serde_json::from_str(text)
            .map_err(|e| Error::input(subject, e.to_string(), "a rig with name, camera and laser"))?;
        Rig::from_file(subject, file)
    }

    fn from_file(subject: &str, file: RigFile) -> Result<Rig> {
        let camera = Camera::from_file(subject, file.camera)?;
        let laser = Laser::from_file(subject, file.laser, &camera)?;
        Ok(Rig { name: file.name, camera, laser })
    }

    /// A rig from the paper's quantities: horizontal field of view α, baseline d and angle β.
    pub fn from_paper(
        width_px: u32,
        height_px: u32,
        fov_rad: f64,
        baseline_mm: f64,
        angle_rad: f64,
        colour: LaserColour,
    ) -> Rig {
        let f = f64::from(width_px) / (2.0 * (fov_rad / 2.0).tan());
        Rig {
            name: "paper".into(),
            camera: Camera {
                width_px,
                height_px,
                fx_px: f,
                fy_px: f,
                cx_px: (f64::from(width_px) - 1.0) / 2.0,
                cy_px: (f64::from(height_px) - 1.0) / 2.0,
                distortion: [0.0; 8],
            },
            laser: Laser {
                colour,
                line: LineDirection::Vertical,
                plane: plane_from_paper(LineDirection::Vertical, baseline_mm, angle_rad),
            },
        }
    }

    /// The rig as a TOML file that [`Rig::load`] reads back.
    pub fn to_toml(&self) -> String {
        toml::to_string(&self.to_file()).unwrap_or_else(|e| unreachable!("a rig is plain tables and numbers: {e}"))
    }

    /// The rig as JSON, with the same fields as the TOML file.
    pub fn to_json(&self) -> serde_json::Value {
        serde_json::to_value(self.to_file()).unwrap_or_else(|e| unreachable!("a rig is plain tables and numbers: {e}"))
    }

    fn to_file(&self) -> RigFile {
        let n = self.laser.plane.normal;
        RigFile {
            name: self.name.clone(),
            camera: CameraFile {
                width_px: self.camera.width_px,
                height_px: self.camera.height_px,
                fov_deg: None,
                fx_px: Some(self.camera.fx_px),
                fy_px: Some(self.camera.fy_px),
                cx_px: Some(self.camera.cx_px),
                cy_px: Some(self.camera.cy_px),
                distortion: self.camera.distortion.to_vec(),
            },
            laser: LaserFile {
                colour: self.laser.colour,
                line: self.laser.line,
                plane_normal: Some([n.x, n.y, n.z]),
                plane_offset_mm: Some(self.laser.plane.offset_mm),
                baseline_mm: None,
                angle_deg: None,
            },
        }
    }

    /// Depth that one pixel across the line stands for at distance `z_mm`, mm: z²/C1 (METHOD.md, equation (18)).
    pub fn depth_step_mm(&self, z_mm: f64) -> f64 {
        let normal = self.laser.plane.normal;
        let (across, f_px) = match self.laser.line {
            LineDirection::Vertical => (normal.x, self.camera.fx_px),
            LineDirection::Horizontal => (normal.y, self.camera.fy_px),
        };
        (z_mm * z_mm * across / (f_px * self.laser.plane.offset_mm)).abs()
    }

    /// Refuses images that this rig was not calibrated for; `subject` names the source.
    pub fn check_image_size(&self, subject: &str, width_px: u32, height_px: u32) -> Result<()> {
        let camera = &self.camera;
        if (width_px, height_px) == (camera.width_px, camera.height_px) {
            return Ok(());
        }
        Err(Error::field(
            subject,
            "image size",
            format!("{width_px}x{height_px} px"),
            format!(
                "{}x{} px, the size that rig '{}' was calibrated for",
                camera.width_px, camera.height_px, self.name
            ),
        ))
    }
}

/// The laser plane of the paper, X − Z/tan β = d (METHOD.md, "Triangulation"); with a horizontal
/// line the same along y.
fn plane_from_paper(line: LineDirection, baseline_mm: f64, angle_rad: f64) -> Plane {
    let (s, c) = angle_rad.sin_cos();
    let normal = match line {
        LineDirection::Vertical => Vector3::new(s, 0.0, -c),
        LineDirection::Horizontal => Vector3::new(0.0, s, -c),
    };
    Plane { normal, offset_mm: baseline_mm * s }
}

impl Camera {
    fn from_file(subject: &str, file: CameraFile) -> Result<Camera> {
        let bad = |field: &str, found: String, expected: &str| Err(Error::field(subject, field, found, expected));
        for (field, side) in [("camera.width_px", file.width_px), ("camera.height_px", file.height_px)] {
            if !(16..=MAX_IMAGE_SIDE_PX).contains(&side) {
                return bad(field, format!("{side} px"), "16 to 8192 px");
            }
        }
        let (width, height) = (f64::from(file.width_px), f64::from(file.height_px));
        let (fx_px, fy_px) = match (file.fov_deg, file.fx_px, file.fy_px) {
            (Some(fov), None, None) if fov > 1.0 && fov < 170.0 => {
                let f = width / (2.0 * (fov.to_radians() / 2.0).tan());
                (f, f)
            }
            (Some(fov), None, None) => return bad("camera.fov_deg", format!("{fov}°"), "1° to 170°"),
            (None, Some(fx), fy) => (fx, fy.unwrap_or(fx)),
            (Some(_), _, _) => {
                return bad("camera.fov_deg", "given beside fx_px or fy_px".into(), "one of the two forms");
            }
            (None, None, _) => return bad("camera.fx_px", "missing".into(), "fx_px and fy_px, or fov_deg"),
        };
        for (field, f) in [("camera.fx_px", fx_px), ("camera.fy_px", fy_px)] {
            if !(f.is_finite() && f >= 0.05 * width && f <= 100.0 * width) {
                return bad(field, format!("{f} px"), "0.05 to 100 image widths");
            }
        }
        let cx_px = file.cx_px.unwrap_or((width - 1.0) / 2.0);
        let cy_px = file.cy_px.unwrap_or((height - 1.0) / 2.0);
        for (field, c, side) in [("camera.cx_px", cx_px, width), ("camera.cy_px", cy_px, height)] {
            if !(c >= -side && c <= 2.0 * side) {
                return bad(field, format!("{c} px"), "a principal point within one image size of the image");
            }
        }
        if ![0, 4, 5, 8].contains(&file.distortion.len()) {
            return bad(
                "camera.distortion",
                format!("{} values", file.distortion.len()),
                "4, 5 or 8 values (k1 k2 p1 p2 k3 …)",
            );
        }
        let mut distortion = [0.0; 8];
        distortion[..file.distortion.len()].copy_from_slice(&file.distortion);
        if distortion.iter().any(|d| !d.is_finite() || d.abs() > 100.0) {
            return bad("camera.distortion", format!("{:?}", file.distortion), "finite values, at most 100 each");
        }
        let camera =
            Camera { width_px: file.width_px, height_px: file.height_px, fx_px, fy_px, cx_px, cy_px, distortion };
        camera.check_lens(subject)?;
        Ok(camera)
    }

    /// A lens model that folds back inside the image maps two directions to one pixel: refuse it.
    fn check_lens(&self, subject: &str) -> Result<()> {
        let (w, h) = (f64::from(self.width_px) - 1.0, f64::from(self.height_px) - 1.0);
        for (u, v) in [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h), (w / 2.0, 0.0), (0.0, h / 2.0)] {
            let pixel = RawPixel { u_px: u, v_px: v };
            let back = self.distort(self.undistort(pixel));
            let miss_px = (back.u_px - u).hypot(back.v_px - v);
            if miss_px.is_nan() || miss_px >= 0.01 {
                return Err(Error::field(
                    subject,
                    "camera.distortion",
                    format!("not invertible at pixel ({u:.0}, {v:.0}): off by {miss_px:.2} px"),
                    "a lens model that maps each pixel of the image to one direction",
                ));
            }
        }
        Ok(())
    }

    /// True where the lens moves pixels at all.
    pub fn has_distortion(&self) -> bool {
        self.distortion.iter().any(|d| *d != 0.0)
    }

    /// The direction that a raw pixel looks into: Newton's method on OpenCV's distortion model.
    pub fn undistort(&self, pixel: RawPixel) -> UndistortedRay {
        let target = ((pixel.u_px - self.cx_px) / self.fx_px, (pixel.v_px - self.cy_px) / self.fy_px);
        if !self.has_distortion() {
            return UndistortedRay { x: target.0, y: target.1 };
        }
        let (mut x, mut y) = target;
        const STEP: f64 = 1e-6;
        for _ in 0..20 {
            let (dx, dy) = self.distort_normalised(x, y);
            let (ex, ey) = (target.0 - dx, target.1 - dy);
            if ex.hypot(ey) < 1e-12 {
                break;
            }
            let (ax, ay) = self.distort_normalised(x + STEP, y);
            let (bx, by) = self.distort_normalised(x, y + STEP);
            let (jxx, jyx, jxy, jyy) = ((ax - dx) / STEP, (ay - dy) / STEP, (bx - dx) / STEP, (by - dy) / STEP);
            let det = jxx * jyy - jxy * jyx;
            if det.abs() < 1e-9 {
                break;
            }
            x += (jyy * ex - jxy * ey) / det;
            y += (jxx * ey - jyx * ex) / det;
        }
        UndistortedRay { x, y }
    }

    /// Where the lens puts a direction on the sensor.
    pub fn distort(&self, ray: UndistortedRay) -> RawPixel {
        let (x, y) = self.distort_normalised(ray.x, ray.y);
        RawPixel { u_px: self.fx_px * x + self.cx_px, v_px: self.fy_px * y + self.cy_px }
    }

    /// Where a point of the camera's frame (mm, z > 0) appears in the image.
    pub fn project(&self, point_in_camera: &Point3<f64>) -> RawPixel {
        self.distort(UndistortedRay {
            x: point_in_camera.x / point_in_camera.z,
            y: point_in_camera.y / point_in_camera.z,
        })
    }

    fn distort_normalised(&self, x: f64, y: f64) -> (f64, f64) {
        let [k1, k2, p1, p2, k3, k4, k5, k6] = self.distortion;
        let r2 = x * x + y * y;
        let radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
        (
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    }

    /// The horizontal field of view α of the pinhole, radians (the paper's form).
    pub fn fov_rad(&self) -> f64 {
        2.0 * (f64::from(self.width_px) / (2.0 * self.fx_px)).atan()
    }
}

impl Laser {
    fn from_file(subject: &str, file: LaserFile, camera: &Camera) -> Result<Laser> {
        let bad = |field: &str, found: String, expected: &str| Err(Error::field(subject, field, found, expected));
        let plane = match (file.plane_normal, file.plane_offset_mm, file.baseline_mm, file.angle_deg) {
            (Some(n), Some(offset), None, None) => {
                let normal = Vector3::from(n);
                let length = normal.norm();
                if !(length > 1e-6 && length.is_finite() && offset.is_finite()) {
                    return bad(
                        "laser.plane_normal",
                        format!("{n:?}, offset {offset} mm"),
                        "a finite vector that is not zero",
                    );
                }
                Plane { normal: normal / length, offset_mm: offset / length }
            }
            (None, None, Some(baseline), angle) => {
                let angle_deg = angle.unwrap_or(90.0);
                if !(angle_deg > 5.0 && angle_deg < 175.0) {
                    return bad(
                        "laser.angle_deg",
                        format!("{angle_deg}°"),
                        "5° to 175° (90° is parallel to the optical axis)",
                    );
                }
                if !baseline.is_finite() {
                    return bad("laser.baseline_mm", format!("{baseline} mm"), "a finite distance");
                }
                plane_from_paper(file.line, baseline, angle_deg.to_radians())
            }
            _ => {
                return bad(
                    "laser.plane_normal",
                    "neither of the two forms whole".into(),
                    "plane_normal with plane_offset_mm, or baseline_mm with angle_deg",
                );
            }
        };
        if plane.offset_mm.abs() < 1.0 {
            return bad(
                "laser.plane_offset_mm",
                format!("{:.3} mm: the plane goes through the camera's centre", plane.offset_mm),
                "at least 1 mm of distance between camera and laser plane, else no depth can be measured",
            );
        }
        let laser = Laser { colour: file.colour, line: file.line, plane };
        laser.check_view(subject, camera)?;
        Ok(laser)
    }

    /// The plane must be seen by at least one pixel, in front of the camera.
    fn check_view(&self, subject: &str, camera: &Camera) -> Result<()> {
        let (w, h) = (f64::from(camera.width_px) - 1.0, f64::from(camera.height_px) - 1.0);
        let seen = (0..=16).any(|i| {
            let t = f64::from(i) / 16.0;
            let pixel = match self.line {
                LineDirection::Vertical => RawPixel { u_px: t * w, v_px: h / 2.0 },
                LineDirection::Horizontal => RawPixel { u_px: w / 2.0, v_px: t * h },
            };
            self.plane.meet(camera.undistort(pixel)).is_some()
        });
        if seen {
            return Ok(());
        }
        Err(Error::field(
            subject,
            "laser.plane_normal",
            format!(
                "{:?}, offset {} mm: outside the camera's view",
                self.plane.normal.as_slice(),
                self.plane.offset_mm
            ),
            "a plane that crosses the image in front of the camera",
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PINHOLE: &str = r#"
        name = "test"
        [camera]
        width_px = 1280
        height_px = 720
        fov_deg = 65.4
        [laser]
        baseline_mm = 150.0
        angle_deg = 95.0
    "#;

    #[test]
    fn the_papers_form_is_the_plane_of_method() {
        let rig = Rig::from_toml("rig", PINHOLE).expect("valid");
        // X − Z/tan β = d
        let z: f64 = 850.0;
        let x = 150.0 + z / 95f64.to_radians().tan();
        let distance = rig.laser.plane.normal.dot(&Vector3::new(x, 12.0, z)) - rig.laser.plane.offset_mm;
        assert!(distance.abs() < 1e-9, "{distance}");
    }

    #[test]
    fn undistort_inverts_distort() {
        let mut rig = Rig::from_toml("rig", PINHOLE).expect("valid");
        rig.camera.distortion = [-0.28, 0.1, 0.0008, -0.0005, 0.0, 0.0, 0.0, 0.0];
        for (u, v) in [(0.0, 0.0), (1279.0, 719.0), (640.0, 3.0), (730.0, 360.0)] {
            let back = rig.camera.distort(rig.camera.undistort(RawPixel { u_px: u, v_px: v }));
            assert!((back.u_px - u).abs() < 1e-6 && (back.v_px - v).abs() < 1e-6);
        }
    }

    #[test]
    fn toml_and_json_come_back() {
        let rig = Rig::from_toml("rig", PINHOLE).expect("valid");
        assert_eq!(Rig::from_toml("again", &rig.to_toml()).expect("toml"), rig);
        assert_eq!(Rig::from_json("again", &rig.to_json().to_string()).expect("json"), rig);
    }

    #[test]
    fn nonsense_is_refused_by_field() {
        for (from, to, field) in [
            ("width_px = 1280", "width_px = 20000", "camera.width_px"),
            ("height_px = 720", "height_px = 0", "camera.height_px"),
            ("fov_deg = 65.4", "fov_deg = 300.0", "camera.fov_deg"),
            ("baseline_mm = 150.0", "baseline_mm = 0.0", "laser.plane_offset_mm"),
            ("fov_deg = 65.4", "fov_deg = 65.4\ndistortion = [-5.0, 0.0, 0.0, 0.0]", "camera.distortion"),
            ("fov_deg = 65.4", "fov_deg = 65.4\ndistortion = [1.0]", "camera.distortion"),
        ] {
            let text = PINHOLE.replace(from, to);
            let message = Rig::from_toml("rig.toml", &text).expect_err(to).to_string();
            assert!(message.contains(field) && message.contains("rig.toml"), "{message}");
        }
        assert!(
            Rig::from_toml("rig", &PINHOLE.replace("baseline_mm", "basline_mm")).is_err(),
            "unknown keys are refused"
        );
    }
}
