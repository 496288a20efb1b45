//! `stria export`: a job's products as files for other people's tools, from a product folder or from a server.

mod remote;

use std::io::Write;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use reqwest::Url;
use stria_core::export::archive_mcap::{ArchiveCut, cut};
use stria_core::export::cloud_laz::CloudLazWriter;
use stria_core::export::cloud_ply::{CloudPlyReader, CloudPlyWriter};
use stria_core::export::depth_tif::section::Cut;
use stria_core::export::manifest::FILE_NAME;
use stria_core::export::mesh_glb;
use stria_core::export::new_file::NewFile;
use stria_core::export::{cloud_e57, cloud_pcd, section_csv};
use stria_core::surface::SurfacePoint;

use self::remote::RemoteJob;
use super::progress::size;
use super::{Failed, Outcome, Success};
use crate::wire::Direction;

/// What can be made of a job's products.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Format {
    /// The archive, whole or in part: frames, poses, profiles, surface, map; opens in Foxglove and rerun
    Mcap,
    /// The cloud, mm: as the job wrote it, or a part of it
    Ply,
    /// The cloud as LAZ 1.4, metres, with confidence and frame as extra dimensions
    Laz,
    /// The cloud as binary PCD, metres, for the Point Cloud Library and ROS
    Pcd,
    /// The cloud as E57, metres, for CAD and surveying programs
    E57,
    /// The wall as a textured mesh, binary glTF, for browsers and office programs
    Glb,
    /// A cross-section: distance, chainage, x, y and depth, mm
    Csv,
    /// The depth map as the job wrote it: a cloud-optimised GeoTIFF, mm
    Tiff,
    /// The rerun recording as the job wrote it
    Rrd,
}

/// Export a job's products as a file that other programs open
#[derive(Args)]
#[command(
    after_help = "Examples: stria export products --format laz --out wall.laz\n          stria export products --format e57 --from-mm 5000 --to-mm 10000 --every 4\n          stria export products --format csv --at-mm 1200\n          stria export 0198c… --server http://127.0.0.1:8420 --format mcap --without-frames"
)]
pub(super) struct Export {
    /// A product folder, or the id of a job on a server
    #[arg(value_name = "JOB|DIR")]
    from: String,
    /// What to make
    #[arg(long, value_enum)]
    format: Format,
    /// The file to write; one that is there is replaced [default: named after the folder or job]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// The server that has the job
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:8420", env = "STRIA_SERVER")]
    server: Url,
    /// Chainage of the run's first frame, mm; of a job on a server it is known
    #[arg(long, value_name = "MM", default_value_t = 0.0, allow_negative_numbers = true)]
    chainage_mm: f64,
    /// Which way the robot went along the asset; of a job on a server it is known
    #[arg(long, value_parser = ["forward", "backward"], default_value = "forward")]
    direction: String,
    /// mcap: leave the camera's frames out
    #[arg(long)]
    without_frames: bool,
    /// mcap: only every n-th frame with what was measured in it, and every n-th point of the surface; clouds: only every n-th
    /// point
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    every: Option<u32>,
    /// mcap, clouds, glb: only the wall from this chainage on, mm
    #[arg(long, value_name = "MM", allow_negative_numbers = true)]
    from_mm: Option<f64>,
    /// mcap, clouds, glb: only the wall up to this chainage, mm
    #[arg(long, value_name = "MM", allow_negative_numbers = true)]
    to_mm: Option<f64>,
    /// csv: across the wall at this chainage, mm
    #[arg(long, value_name = "MM", allow_negative_numbers = true)]
    at_mm: Option<f64>,
    /// csv: along a line between two places, chainage and y of each, mm
    #[arg(long, value_name = "C1,Y1,C2,Y2", allow_hyphen_values = true, conflicts_with = "at_mm")]
    line: Option<String>,
    /// glb: vertices, at most about; more show finer detail and make larger files
    #[arg(long, value_name = "N", default_value_t = mesh_glb::DEFAULT_VERTICES, value_parser = vertices)]
    max_vertices: usize,
}

fn vertices(text: &str) -> Result<usize, String> {
    let range = 1000..=mesh_glb::MAX_VERTICES;
    text.parse()
        .ok()
        .filter(|n| range.contains(n))
        .ok_or_else(|| format!("expected 1000 to {}", mesh_glb::MAX_VERTICES))
}

/// How chainage and the run's own x belong together.
#[derive(Clone, Copy)]
struct Chainage {
    start_mm: f64,
    direction: Direction,
}

impl Chainage {
    fn x_mm(self, chainage_mm: f64) -> f64 {
        match self.direction {
            Direction::Forward => chainage_mm - self.start_mm,
            Direction::Backward => self.start_mm - chainage_mm,
        }
    }

    fn of_x_mm(self, x_mm: f64) -> f64 {
        match self.direction {
            Direction::Forward => self.start_mm + x_mm,
            Direction::Backward => self.start_mm - x_mm,
        }
    }
}

impl Export {
    pub(super) fn run(self) -> Outcome {
        self.check_options()?;
        let folder = Path::new(&self.from);
        if folder.is_dir() {
            let direction = Direction::parse(&self.direction).unwrap_or_default();
            let chainage = Chainage { start_mm: self.chainage_mm, direction };
            return self.export(folder, chainage);
        }
        if folder.exists() || self.from.contains('/') {
            let found = if folder.exists() { "a file" } else { "no such folder" };
            return Err(Failed::Input(format!("{}: {found}; expected a product folder or a job's id", self.from)));
        }
        let job = RemoteJob::find(&self.server, &self.from)?;
        let chainage = Chainage { start_mm: job.chainage_mm, direction: job.direction };
        let out = self.out();
        if self.format == Format::Mcap && !self.whole() {
            // The server makes the part while it sends it.
            job.download(&self.archive_path(), &out)?;
            return done(&out, "a part of the archive");
        }
        let scratch =
            tempfile::tempdir_in(parent(&out)).map_err(|e| Failed::Input(format!("{}: {e}", out.display())))?;
        job.fetch(self.needed(), scratch.path())?;
        if self.format == Format::Laz && self.whole() && !scratch.path().join("cloud.laz").exists() {
            job.fetch(&["cloud.ply"], scratch.path())?;
        }
        self.export(scratch.path(), chainage)
    }

    /// An option of another format would be without effect: the person meant something else.
    fn check_options(&self) -> Result<(), Failed> {
        use Format::{Csv, E57, Glb, Laz, Mcap, Pcd, Ply};
        let (parts, stretches) = ([Mcap, Ply, Laz, Pcd, E57], [Mcap, Ply, Laz, Pcd, E57, Glb]);
        let options = [
            ("--without-frames", self.without_frames, &[Mcap][..]),
            ("--every", self.every.is_some(), &parts),
            ("--from-mm", self.from_mm.is_some(), &stretches),
            ("--to-mm", self.to_mm.is_some(), &stretches),
            ("--at-mm", self.at_mm.is_some(), &[Csv]),
            ("--line", self.line.is_some(), &[Csv]),
        ];
        if let Some((name, _, formats)) =
            options.iter().find(|(_, given, formats)| *given && !formats.contains(&self.format))
        {
            let (of, mine) = (formats.iter().map(|f| format_name(*f)).collect::<Vec<_>>(), format_name(self.format));
            return Err(Failed::Input(format!("{name} is for --format {}, not {mine}", of.join(", "))));
        }
        if self.format == Format::Csv && self.at_mm.is_none() && self.line.is_none() {
            return Err(Failed::Input("--format csv: no line given; expected --at-mm or --line".into()));
        }
        if let (Some(from_mm), Some(to_mm)) = (self.from_mm, self.to_mm)
            && from_mm > to_mm
        {
            return Err(Failed::Input(format!("--to-mm is {to_mm}; expected at least --from-mm, {from_mm}")));
        }
        Ok(())
    }

    /// Everything that the job wrote is wanted.
    fn whole(&self) -> bool {
        !self.without_frames && self.every.is_none() && self.from_mm.is_none() && self.to_mm.is_none()
    }

    fn archive_path(&self) -> String {
        let mut query = vec![format!("frames={}", !self.without_frames)];
        query.extend(self.every.map(|n| format!("every={n}")));
        query.extend(self.from_mm.map(|mm| format!("from_mm={mm}")));
        query.extend(self.to_mm.map(|mm| format!("to_mm={mm}")));
        format!("archive.mcap?{}", query.join("&"))
    }

    /// The products that are needed: a name, or everything under a folder.
    fn needed(&self) -> &'static [&'static str] {
        match self.format {
            Format::Mcap => &["archive.mcap"],
            Format::Laz if self.whole() => &["cloud.laz"],
            Format::Ply | Format::Laz | Format::Pcd | Format::E57 => &["cloud.ply"],
            Format::Glb => &["depth.tif", "tiles/tiles.json", "tiles/texture/"],
            Format::Csv | Format::Tiff => &["depth.tif"],
            Format::Rrd => &["recording.rrd"],
        }
    }

    fn out(&self) -> PathBuf {
        self.out.clone().unwrap_or_else(|| {
            let name = Path::new(&self.from).canonicalize().ok();
            let name = name.as_deref().unwrap_or(Path::new(&self.from)).file_name().unwrap_or_default();
            let extension = match self.format {
                Format::Tiff => "tif",
                other => format_name(other),
            };
            PathBuf::from(format!("{}.{extension}", name.to_string_lossy()))
        })
    }

    fn export(&self, folder: &Path, chainage: Chainage) -> Outcome {
        let product = |name: &str| -> Result<PathBuf, Failed> {
            let path = folder.join(name);
            if path.exists() {
                return Ok(path);
            }
            let what = if folder.join(FILE_NAME).exists() { "the job did not make it" } else { "no product folder" };
            Err(Failed::Input(format!("{}: {what}; expected {name}", folder.display())))
        };
        let out = self.out();
        match self.format {
            Format::Ply if self.whole() => copy(&product("cloud.ply")?, &out),
            Format::Tiff => copy(&product("depth.tif")?, &out),
            Format::Rrd => copy(&product("recording.rrd")?, &out),
            Format::Mcap if self.whole() => copy(&product("archive.mcap")?, &out),
            Format::Mcap => self.archive(&product("archive.mcap")?, &out, chainage),
            // Jobs of before made none.
            Format::Laz if self.whole() && folder.join("cloud.laz").exists() => copy(&folder.join("cloud.laz"), &out),
            Format::Ply | Format::Laz | Format::Pcd | Format::E57 => self.cloud(&product("cloud.ply")?, &out, chainage),
            Format::Csv => self.section(&product("depth.tif")?, &out, chainage),
            Format::Glb => {
                product("depth.tif")?;
                let stretch_mm = self.stretch_mm(chainage).unwrap_or(mesh_glb::ALL_MM);
                let mesh = mesh_glb::write(&out, folder, self.max_vertices, &stretch_mm)?;
                let picture = if mesh.textured { "with the wall's picture" } else { "without a picture: no tiles" };
                let (v, t, mm) = (mesh.vertices, mesh.triangles, mesh.mm_per_vertex);
                done(&out, &format!("{v} vertices every {mm:.3} mm, {t} triangles, {picture}"))
            }
        }
    }

    /// The stretch that is wanted, in the run's own x; `None` for all of it.
    fn stretch_mm(&self, chainage: Chainage) -> Option<RangeInclusive<f64>> {
        let ends = [self.from_mm.unwrap_or(f64::NEG_INFINITY), self.to_mm.unwrap_or(f64::INFINITY)];
        let [a, b] = ends.map(|mm| chainage.x_mm(mm));
        (self.from_mm.is_some() || self.to_mm.is_some()).then(|| a.min(b)..=a.max(b))
    }

    fn archive(&self, archive: &Path, out: &Path, chainage: Chainage) -> Outcome {
        let how = ArchiveCut {
            frames: !self.without_frames,
            every: self.every.unwrap_or(1),
            x_mm: self.stretch_mm(chainage),
        };
        let mut file = NewFile::create(out)?;
        cut(archive, &how, &mut file, &out.display().to_string())?;
        file.commit()?;
        done(out, "a part of the archive")
    }

    fn cloud(&self, cloud: &Path, out: &Path, chainage: Chainage) -> Outcome {
        let all = CloudPlyReader::open(cloud)?.points();
        // Some formats say it in their head.
        let count = if self.whole() { all } else { self.points(cloud, chainage)?.count() as u64 };
        if count == 0 && all > 0 {
            return Err(Failed::Input(format!("{}: no point there; expected a stretch of the cloud", cloud.display())));
        }
        let mut points = self.points(cloud, chainage)?;
        match self.format {
            Format::Pcd => cloud_pcd::write(out, count, points)?,
            Format::E57 => cloud_e57::write(out, &self.from, count, points)?,
            Format::Ply => {
                let mut writer = CloudPlyWriter::create(out)?;
                points.try_for_each(|point| writer.push(&point?))?;
                writer.finish()?;
            }
            _ => {
                let mut writer = CloudLazWriter::create(out)?;
                points.try_for_each(|point| writer.push(&point?))?;
                writer.finish()?;
            }
        }
        done(out, &if count == all { format!("{count} points") } else { format!("{count} of {all} points") })
    }

    /// The points that are wanted, and what cannot be read.
    fn points(
        &self,
        cloud: &Path,
        chainage: Chainage,
    ) -> Result<impl Iterator<Item = stria_core::Result<SurfacePoint>> + use<>, Failed> {
        let (stretch_mm, every) = (self.stretch_mm(chainage), self.every.unwrap_or(1) as usize);
        let there = move |point: &stria_core::Result<SurfacePoint>| match (point, &stretch_mm) {
            (Ok(point), Some(stretch_mm)) => stretch_mm.contains(&point.point_in_world.x),
            _ => true,
        };
        Ok(CloudPlyReader::open(cloud)?.filter(there).step_by(every))
    }

    fn section(&self, map: &Path, out: &Path, chainage: Chainage) -> Outcome {
        let cut = match (&self.line, self.at_mm) {
            (Some(text), _) => {
                let numbers: Vec<f64> = text.split(',').map_while(|n| n.trim().parse().ok()).collect();
                let [c1, y1, c2, y2] = numbers[..] else {
                    return Err(Failed::Input(format!("--line {text}: expected four numbers, such as 0,-100,500,100")));
                };
                Cut::Line { from_mm: [chainage.x_mm(c1), y1], to_mm: [chainage.x_mm(c2), y2] }
            }
            (None, at_mm) => Cut::Across { x_mm: chainage.x_mm(at_mm.unwrap_or_default()) },
        };
        let (measured, rows) = section_csv::write(out, map, cut, |x_mm| chainage.of_x_mm(x_mm))?;
        done(out, &format!("{rows} rows, {measured} with a depth"))
    }
}

fn format_name(format: Format) -> &'static str {
    match format {
        Format::Mcap => "mcap",
        Format::Ply => "ply",
        Format::Laz => "laz",
        Format::Pcd => "pcd",
        Format::E57 => "e57",
        Format::Glb => "glb",
        Format::Csv => "csv",
        Format::Tiff => "tiff",
        Format::Rrd => "rrd",
    }
}

fn parent(out: &Path) -> &Path {
    out.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."))
}

fn copy(from: &Path, out: &Path) -> Outcome {
    let mut source = std::fs::File::open(from).map_err(|e| stria_core::Error::io(from, e))?;
    let mut file = NewFile::create(out)?;
    std::io::copy(&mut source, &mut file).map_err(|e| stria_core::Error::io(out, e))?;
    file.flush().map_err(|e| stria_core::Error::io(out, e))?;
    file.commit()?;
    done(out, "as the job wrote it")
}

fn done(out: &Path, what: &str) -> Outcome {
    let bytes = std::fs::metadata(out).map_err(|e| stria_core::Error::io(out, e))?.len();
    println!("{}: {}, {what}", out.display(), size(bytes));
    Ok(Success::Done)
}
