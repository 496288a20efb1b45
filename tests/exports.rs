//! `stria export`, from a product folder and from a server: other people's programs open what it writes, it needs little
//! memory, and nothing under a final name is ever incomplete, whenever and wherever the writing was cut.

mod exports {
    mod cut;
    mod formats;
    mod map_size;
    mod memory;

    use std::path::Path;
    use std::process::Output;

    use nalgebra::Point3;
    use stria_core::export::cloud_ply::CloudPlyWriter;
    use stria_core::surface::SurfacePoint;

    fn text(path: &Path) -> &str {
        path.to_str().expect("a plain path")
    }

    fn said(output: &Output) -> String {
        String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
    }

    /// A product folder with nothing but a cloud of so many points.
    fn write_cloud(folder: &Path, points: u32) {
        let mut writer = CloudPlyWriter::create(&folder.join("cloud.ply")).expect("create");
        for i in 0..points {
            let t = f64::from(i);
            let point = SurfacePoint {
                point_in_world: Point3::new(t * 0.01, f64::from(i % 1080) * 0.4, 850.0 + (t * 0.001).sin() * 9.0),
                rgb: [i as u8, (i / 7) as u8, 120],
                confidence: (i % 64) as f32 / 64.0,
                frame: i / 1080,
            };
            writer.push(&point).expect("push");
        }
        writer.finish().expect("finish");
    }
}
