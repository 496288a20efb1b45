use super::*;
use crate::synthetic::{BoardScene, Scene};

fn rig(size_px: (u32, u32), lens: bool, line: LineDirection) -> Rig {
    let mut scene = Scene::named(if lens { "lens" } else { "wall" }).expect("a scene");
    scene.line = line;
    if lens {
        scene.distortion = [-0.28, 0.10, 0.0008, -0.0005, 0.0, 0.0, 0.0, 0.0];
    }
    scene.rig(size_px.0, size_px.1)
}

fn photos(scene: &BoardScene, laser_on: impl Fn(u32) -> bool) -> Vec<Photo> {
    let photo = |(number, pose): (u32, _)| Photo {
        name: format!("{number}.png"),
        image: scene.render(&pose, laser_on(number), number),
    };
    (0..).zip(scene.poses(15).expect("poses")).map(photo).collect()
}

fn options(colour: LaserColour) -> Options {
    Options { board: Board::new("9x6", 25.0).expect("a board"), colour, line: None, name: "test".into() }
}

/// Angle between the planes (degrees), offset (mm), focal length (share).
fn errors(found: &Calibration, truth: &Rig) -> (f64, f64, f64) {
    let (a, b) = (&found.rig.laser.plane, &truth.laser.plane);
    let sign = a.normal.dot(&b.normal).signum();
    let angle_deg = (a.normal * sign).angle(&b.normal).to_degrees();
    let focal = (found.rig.camera.fx_px / truth.camera.fx_px - 1.0).abs();
    (angle_deg, (a.offset_mm * sign - b.offset_mm).abs(), focal)
}

#[test]
fn fifteen_photos_give_the_rig() {
    for (seed, size_px, lens, line) in [
        (1, (1280, 720), false, LineDirection::Vertical),
        (2, (1280, 720), true, LineDirection::Vertical),
        (3, (1280, 720), true, LineDirection::Horizontal),
    ] {
        let truth = rig(size_px, lens, line);
        let scene = BoardScene::new(truth.clone(), seed).expect("a board");
        let begun = std::time::Instant::now();
        let photos = photos(&scene, |_| true);
        let rendered_s = begun.elapsed().as_secs_f64();
        let attempt = calibrate(&photos, &options(LaserColour::Green), &mut |_, _| Ok(())).expect("an attempt");
        for p in &attempt.photos {
            println!(
                "{} {} corners rms {:?} spots {} plane {:?} {}",
                p.name,
                p.corners.len(),
                p.rms_px,
                p.spots.len(),
                p.plane_rms_mm,
                p.note
            );
        }
        let found = attempt.result.as_ref().expect("a rig");
        let (angle_deg, offset_mm, focal) = errors(found, &truth);
        println!(
            "seed {seed} {size_px:?} lens {lens} {line:?}: plane {angle_deg:.4}°, offset {offset_mm:.4} mm, focal {:.4} % \
             (± {:.4} %, ± {:.4}°, ± {:.4} mm), {} corners {:.3} px, plane {:.3} mm, cx {:.3} ± {:.3}, cover {:.2}; render {rendered_s:.1} s, all {:.1} s",
            100.0 * focal,
            100.0 * found.deviations.focal_px / truth.camera.fx_px,
            found.plane_angle_rad.to_degrees(),
            found.plane_offset_mm,
            found.lens,
            found.rms_px,
            found.plane_rms_mm,
            found.rig.camera.cx_px - truth.camera.cx_px,
            found.deviations.centre_px.0,
            found.coverage,
            begun.elapsed().as_secs_f64()
        );
        assert_eq!(found.rig.laser.line, line);
        assert!(angle_deg < 0.025 && offset_mm < 0.05 && focal < 5e-4);
    }
}
