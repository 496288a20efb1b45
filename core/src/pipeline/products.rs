//! The products of a job: what is written while the frames go by, and what is written at the end.

use std::path::Path;
use std::time::{Duration, Instant};

use super::archiving::ArchivedJob;
use super::laz::LazThread;
use super::progress::Progress;
use super::quality::QualityCounter;
use super::{Cargo, Colours, Event, Newest, ProductGroup, Request, Timings};
use crate::defects::{self, Chainage, Findings, Sampling};
use crate::depth_map::sheet::Sheet;
use crate::depth_map::strips::{add_strip, strip_grid};
use crate::depth_map::{FinishedMap, Grid, MapReader, SharedMap, SurfaceMap};
use crate::error::{Error, Result};
use crate::export::archive_mcap::ArchiveWriter;
use crate::export::cloud_ply::CloudPlyWriter;
use crate::export::live_frame::{self, LiveFrameWriter};
use crate::export::manifest::{
    FileEntry, Gap, GrayScale, Manifest, Quality, SCHEMA_VERSION, Stretch, list_products, sha256_of_bytes,
};
use crate::export::npy::NpyWriter;
use crate::export::preview::{self, Picture, PreviewText};
use crate::export::report::{self, ReportRun};
use crate::export::residual_tif::{self, ResidualWriter};
use crate::export::tiles::{TileGrid, TileWriter};
use crate::export::trajectory_csv::{TrajectoryRow, TrajectoryWriter};
use crate::export::{defect_list, depth_png, depth_tif, sections_csv, texture};
use crate::motion::track::TrackUse;
use crate::recipe::{Codes, DefectOptions, Method};
use crate::recording::{FrameSteps, RecordedRun, Recordings, Segment};
use crate::rig::{LineDirection, Rig};
use crate::source::{self, Beside, SourceInfo};
use crate::surface::{Placed, SurfacePoint};

/// Where live recording segments lie in the product folder; they are no products.
const SEGMENTS: &str = "recording";

/// All writers of a job.
pub(super) struct Products<'a> {
    request: &'a Request,
    beside: &'a Beside,
    map: Option<SurfaceMap>,
    /// What lays profiles on the map; with method `metric`.
    sheet: Option<Sheet>,
    tiles: Option<TileWriter>,
    trajectory: Option<TrajectoryWriter>,
    cloud: Option<CloudPlyWriter>,
    laz: Option<LazThread>,
    stripes: Option<NpyWriter>,
    recorder: Option<Recordings>,
    archive: Option<ArchiveWriter>,
    live: Option<LiveFrameWriter>,
    /// The robot still walks.
    watched: bool,
    frames: u64,
}

impl<'a> Products<'a> {
    /// Starts the files that grow with the frames.
    pub(super) fn create(request: &'a Request, info: &SourceInfo, beside: &'a Beside) -> Result<Products<'a>> {
        let (folder, rig, recipe) = (&request.out_dir, &request.rig, &request.recipe);
        let wanted = |group| request.products.contains(&group);
        let line_positions = match rig.laser.line {
            LineDirection::Vertical => rig.camera.height_px,
            LineDirection::Horizontal => rig.camera.width_px,
        };
        let run = RecordedRun {
            name: &request.source_name,
            recorded_at: request.recorded_at,
            frames_expected: info.frames_announced,
            duration_expected_s: info.frames_announced.zip(info.frames_per_s).map(|(n, fps)| n as f64 / fps),
            watched: info.still_open,
        };
        let segments = request.live_segments.then(|| folder.join(SEGMENTS));
        let recorder =
            || Recordings::create(&recipe.recording, rig, &run, &folder.join("recording.rrd"), segments.as_deref());
        let archive = || {
            ArchiveWriter::create(&folder.join("archive.mcap"), rig, recipe, &request.source_name, request.recorded_at)
        };
        Ok(Products {
            request,
            beside,
            map: None,
            sheet: None,
            tiles: None,
            trajectory: make(wanted(ProductGroup::Trajectory), || {
                TrajectoryWriter::create(&folder.join("trajectory.csv"))
            })?,
            cloud: make(wanted(ProductGroup::Cloud), || CloudPlyWriter::create(&folder.join("cloud.ply")))?,
            laz: make(wanted(ProductGroup::Cloud), || LazThread::start(&folder.join("cloud.laz")))?,
            stripes: make(recipe.stripe.keep, || {
                NpyWriter::create(&folder.join("stripes.npy"), line_positions as usize)
            })?,
            recorder: make(wanted(ProductGroup::Recording), recorder)?,
            archive: make(wanted(ProductGroup::Archive), archive)?,
            live: make(request.live_segments, || LiveFrameWriter::create(folder))?,
            watched: info.still_open,
            frames: 0,
        })
    }

    /// Whether the picture of a frame at this time is shown: in the recording, or to those who watch.
    pub(super) fn wants_picture(&self, time_s: f64) -> bool {
        self.recorder.as_ref().is_some_and(|recorder| recorder.wants_image(time_s))
            || self.live.as_ref().is_some_and(|live| live.due(time_s))
    }

    /// Whether the frames themselves are shown anywhere.
    pub(super) fn wants_pictures(&self) -> bool {
        self.recorder.is_some() || self.live.is_some()
    }

    /// Whether the newest profile is shown before its place is final: the robot still walks, and people watch.
    pub(super) fn shows_newest(&self) -> bool {
        self.watched && self.recorder.is_some()
    }

    /// Shows the newest profile; says what can be shown now.
    pub(super) fn show_newest(&mut self, newest: &Newest) -> Result<Vec<Event>> {
        let Some(recorder) = &mut self.recorder else { return Ok(Vec::new()) };
        let segments = recorder.log_newest(newest.frame, newest.time_s, &newest.points_in_world)?;
        Ok(self.announcements(segments))
    }

    /// Whether any product shows the wall's colours.
    pub(super) fn wants_colours(&self) -> bool {
        // The depth maps alone, the trajectory and the stripes have none.
        let coloured = |group: &ProductGroup| {
            !matches!(group, ProductGroup::Depth | ProductGroup::Trajectory | ProductGroup::Defects)
        };
        self.request.products.iter().any(coloured)
    }

    /// Whether any product shows the wall's colours between the profiles too.
    pub(super) fn wants_wall_colours(&self) -> bool {
        let shows = |group: &ProductGroup| {
            use ProductGroup::{Cloud, Defects, Depth, Trajectory};
            !matches!(group, Depth | Trajectory | Cloud | Defects)
        };
        self.request.products.iter().any(shows)
    }

    /// Adds a placed frame, in the order of the frames, to everything that grows; says what can be shown now.
    pub(super) fn add(&mut self, placed: &Placed<Cargo>) -> Result<Vec<Event>> {
        let (measured, cargo) = (&placed.measured, &placed.measured.cargo);
        self.frames += 1;
        let points = surface_points(placed);
        self.add_to_map(placed, &points)?;
        if let Some(stripes) = &mut self.stripes {
            stripes.push_row(&cargo.stripe.across_px)?;
        }
        if let Some(trajectory) = &mut self.trajectory {
            trajectory.push(&trajectory_row(placed))?;
        }
        if let Some(cloud) = &mut self.cloud {
            points.iter().try_for_each(|point| cloud.push(point))?;
        }
        if let Some(archive) = &mut self.archive {
            if let Some(pose) = &placed.world_from_camera {
                archive.pose(measured.time_s, pose)?;
            }
            archive.profile(measured.time_s, &measured.profile, &points)?;
            archive.surface(measured.time_s, &points)?;
            archive.measurement(measured.frame, measured.time_s, &cargo.stripe, &measured.shift, &points)?;
        }
        let mut events = Vec::new();
        if let Some(recorder) = &mut self.recorder {
            let picture = cargo.picture.as_ref().filter(|_| recorder.wants_image(measured.time_s));
            let segments = recorder.log_frame(&FrameSteps {
                frame_index: measured.frame,
                time_s: measured.time_s,
                image: picture.map(|p| &*p.image),
                effective_area: picture.and_then(|p| p.effective_area.as_deref()),
                row_threshold: picture.and_then(|p| p.row_threshold.as_deref()),
                stripe: &cargo.stripe,
                shift: &measured.shift,
                world_from_camera: placed.world_from_camera,
                points: &points,
            })?;
            events = self.announcements(segments);
        }
        let names: Vec<String> = [self.write_changed_tiles()?, self.write_live_frame(placed)?].concat();
        if self.request.live_segments && !names.is_empty() {
            events.push(Event::Files { names });
        }
        if let Some(laz) = &mut self.laz {
            laz.push(points)?;
        }
        Ok(events)
    }

    fn write_live_frame(&mut self, placed: &Placed<Cargo>) -> Result<Vec<String>> {
        let (measured, cargo) = (&placed.measured, &placed.measured.cargo);
        let (Some(live), Some(picture)) = (&mut self.live, &cargo.picture) else { return Ok(Vec::new()) };
        if !live.due(measured.time_s) {
            return Ok(Vec::new());
        }
        let x_mm = placed.world_from_camera.map(|pose| pose.translation.x);
        live.put((measured.frame, measured.time_s), &picture.image, &cargo.stripe, x_mm)
    }

    fn add_to_map(&mut self, placed: &Placed<Cargo>, points: &[SurfacePoint]) -> Result<()> {
        self.begin_map(placed)?;
        let Some(map) = &mut self.map else { return Ok(()) };
        let colours = &placed.measured.cargo.colours;
        match &mut self.sheet {
            Some(sheet) => {
                let positions: Vec<u32> =
                    placed.measured.profile.points.iter().map(|point| point.line_position).collect();
                let colours = match colours {
                    Colours::Wall(wall) => Some(wall),
                    _ => None,
                };
                sheet.add(map, points, &positions, placed.part, colours)
            }
            None => {
                let strip = match colours {
                    Colours::Strip(strip) => Some(strip),
                    _ => None,
                };
                add_strip(map, self.request.rig.laser.line, placed, strip)
            }
        }
    }

    /// The map begins with the first placed frame that has points: their distance gives the pixel's size.
    fn begin_map(&mut self, placed: &Placed<Cargo>) -> Result<()> {
        let (rig, options) = (&self.request.rig, &self.request.recipe.map);
        let (None, Some(z_mm), Some(pose)) =
            (&self.map, placed.measured.profile.median_z_mm(), &placed.world_from_camera)
        else {
            return Ok(());
        };
        let grid = match &placed.strip {
            Some(place) => {
                // Grid column 0 is where this frame's line lies.
                let mut grid = strip_grid(rig, z_mm, line_x_mm(rig, z_mm) + pose.translation.x);
                grid.x_mm -= place.travel_px.round() * grid.mm_per_px;
                grid
            }
            None => {
                let mm_per_px = match options.mm_per_px {
                    size if size > 0.0 => size,
                    _ => round_up_125(z_mm / rig.camera.fx_px.min(rig.camera.fy_px)),
                };
                self.sheet = Some(Sheet::new(Grid { x_mm: 0.0, y_mm: 0.0, mm_per_px }, options.bridge_mm));
                Grid { x_mm: 0.0, y_mm: 0.0, mm_per_px }
            }
        };
        let folder = &self.request.out_dir;
        self.map = Some(SurfaceMap::create(grid, options.tiles_in_memory as usize, folder)?);
        if self.request.products.contains(&ProductGroup::Tiles) {
            let grid = TileGrid { x0_mm: grid.x_mm, y0_mm: grid.y_mm, mm_per_px: grid.mm_per_px };
            self.tiles = Some(TileWriter::create(folder, grid)?);
        }
        Ok(())
    }

    /// Hands tiles out while the run goes on, now and then, where people can look. Answers what changed.
    fn write_changed_tiles(&mut self) -> Result<Vec<String>> {
        let (Some(map), Some(tiles)) = (&mut self.map, &mut self.tiles) else { return Ok(Vec::new()) };
        if !self.request.live_segments || !self.frames.is_multiple_of(u64::from(self.request.recipe.map.tile_frames)) {
            return Ok(Vec::new());
        }
        for index in map.take_changed() {
            tiles.put(index.0, index.1, &map.tile_window(index)?)?;
        }
        tiles.publish()
    }

    fn announcements(&self, segments: Vec<Segment>) -> Vec<Event> {
        let event = |segment: Segment| {
            let path = segment.path.strip_prefix(&self.request.out_dir).unwrap_or(&segment.path);
            let path = path.to_string_lossy().into_owned();
            Event::Segment { number: segment.number, path, bytes: segment.bytes }
        };
        segments.into_iter().map(event).collect()
    }

    /// Writes what is written at the end, and the manifest last.
    pub(super) fn finish(
        mut self,
        info: &SourceInfo,
        quality: QualityCounter,
        mut timings: Timings,
        progress: &mut Progress<'_, '_>,
    ) -> Result<Manifest> {
        let request = self.request;
        let mut map = self.map.take();
        let mut finished = map.as_mut().and_then(SurfaceMap::finished);
        let geometry = finished.as_ref().map(|map| map.geometry());
        let coverage = finished.as_ref().map_or(0.0, FinishedMap::coverage);
        let (quality, gaps, resolution) = quality.finish(&request.rig, coverage);
        let given = request.track_use(self.beside);
        warn_of_quality(&quality, &gaps, request, given, progress)?;
        let sampling = resolution.map_or_else(Sampling::default, |r| Sampling {
            profile_step_mm: r.r_lateral_mm.unwrap_or(0.0),
            line_step_mm: r.r_vertical_mm,
        });
        let Maps { gray, picture, found } =
            timings.time("maps", || self.write_maps(finished.as_mut(), sampling, progress))?;
        if let Some((_, time)) = &found {
            timings.add("defects", *time);
        }
        if let Some(trajectory) = self.trajectory.take() {
            progress.step("trajectory")?;
            trajectory.finish()?;
        }
        if let Some(cloud) = self.cloud.take() {
            progress.step("cloud")?;
            cloud.finish()?;
        }
        if let Some(laz) = self.laz.take() {
            laz.finish()?;
        }
        if let Some(stripes) = self.stripes.take() {
            stripes.finish()?;
        }
        let rig_toml = request.rig.to_toml();
        let recipe_toml = request.recipe.to_toml();
        let mut manifest = Manifest {
            schema_version: SCHEMA_VERSION,
            software: format!("stria {}", env!("CARGO_PKG_VERSION")),
            source: hash_source(info, request)?,
            rig: request.rig.to_json(),
            rig_sha256: sha256_of_bytes(rig_toml.as_bytes()),
            recipe: serde_json::to_value(&request.recipe).map_err(|e| Error::internal("manifest", e))?,
            recipe_sha256: sha256_of_bytes(recipe_toml.as_bytes()),
            depth_map: geometry,
            depth_png: gray,
            resolution,
            quality,
            gaps,
            recordings: Vec::new(),
            warnings: Vec::new(),
            timings_s: std::collections::BTreeMap::new(),
            products: Vec::new(),
        };
        if let (Some((findings, _)), Some(map), true) = (&found, &mut finished, self.wants(ProductGroup::Report)) {
            progress.step("report")?;
            timings.time("report", || self.write_report(findings, map, &manifest, progress.warnings()))?;
        }
        let archived = timings.time("archive", || self.finish_archive(&manifest, finished.as_mut(), progress))?;
        manifest.recordings = timings.time("recording", || self.finish_recording(picture, progress))?;
        if let Some(warning) = archived {
            progress.warn(warning)?;
        }
        live_frame::remove(&request.out_dir)?;
        progress.step("manifest")?;
        manifest.warnings = progress.warnings().to_vec();
        manifest.products = list_products(&request.out_dir)?;
        manifest.products.retain(|product| !product.name.starts_with(&format!("{SEGMENTS}/")));
        manifest.timings_s = timings.stages;
        manifest.write(&request.out_dir)?;
        Ok(manifest)
    }

    fn wants(&self, group: ProductGroup) -> bool {
        self.request.products.contains(&group)
    }

    fn write_report(
        &self,
        findings: &Findings,
        map: &mut FinishedMap<'_>,
        manifest: &Manifest,
        warnings: &[String],
    ) -> Result<()> {
        let request = self.request;
        let run = ReportRun {
            asset: &request.asset,
            source: &request.source_name,
            recorded_at: request.recorded_at,
            rig: &request.rig.name,
            method: match request.recipe.method {
                Method::Metric => "metric",
                Method::Paper => "paper",
            },
            quality: &manifest.quality,
            resolution: manifest.resolution.as_ref(),
            warnings,
        };
        report::write(&run, findings, map, &request.out_dir)
    }

    /// Writes the maps, two things at a time: each squeezes or searches the whole map, on its own core. More at a time
    /// would only need more memory.
    fn write_maps(
        &mut self,
        map: Option<&mut FinishedMap<'_>>,
        sampling: Sampling,
        progress: &mut Progress<'_, '_>,
    ) -> Result<Maps> {
        let Some(map) = map else { return Ok(Maps::default()) };
        let (folder, wanted) = (&self.request.out_dir, &self.request.products);
        let wants = |group| wanted.contains(&group);
        let text = self.preview_text();
        let tiles = self.tiles.take();
        let (options, chainage) = (&self.request.recipe.defects, self.request.chainage);
        let shared = SharedMap::new(map);
        std::thread::scope(|scope| {
            let beside = scope.spawn(|| -> Result<Maps> {
                let mut picture = None;
                if wants(ProductGroup::Preview) || wants(ProductGroup::Recording) {
                    let painted = preview::picture(&mut shared.reader(), &text)?;
                    if wants(ProductGroup::Preview) {
                        painted.save(&folder.join("preview.png"))?;
                        painted.save_thumbnail(&folder.join("thumbnail.jpg"))?;
                    }
                    picture = Some(painted);
                }
                let found = match wants(ProductGroup::Defects) || wants(ProductGroup::Report) {
                    true => find_defects(&mut shared.reader(), options, chainage, sampling, folder)?,
                    false => None,
                };
                Ok(Maps { gray: None, picture, found })
            });
            let mut gray = None;
            if wants(ProductGroup::Depth) {
                progress.step("depth")?;
                depth_tif::write(&mut shared.reader(), &folder.join("depth.tif"))?;
                gray = depth_png::write(&mut shared.reader(), folder)?;
            }
            if wants(ProductGroup::Texture) {
                progress.step("texture")?;
                texture::write(&mut shared.reader(), folder)?;
            }
            if let Some(tiles) = tiles {
                progress.step("tiles")?;
                tiles.finish(&mut shared.reader())?;
            }
            if wants(ProductGroup::Defects) || wants(ProductGroup::Report) {
                progress.step("defects")?;
            }
            let maps = beside.join().map_err(|_| Error::internal("maps", "a thread panicked"))??;
            Ok(Maps { gray, ..maps })
        })
    }

    fn preview_text(&self) -> PreviewText {
        PreviewText {
            title: self.request.source_name.clone(),
            start_chainage_mm: self.request.chainage.start_mm,
            chainage_falls: self.request.chainage.falls,
        }
    }

    fn finish_archive(
        &mut self,
        manifest: &Manifest,
        map: Option<&mut FinishedMap<'_>>,
        progress: &mut Progress<'_, '_>,
    ) -> Result<Option<String>> {
        let Some(archive) = self.archive.take() else { return Ok(None) };
        progress.step("archive")?;
        let job = ArchivedJob { request: self.request, beside: self.beside, frames: self.frames, manifest };
        job.complete(archive, map, progress.warnings())
    }

    fn finish_recording(&mut self, picture: Option<Picture>, progress: &mut Progress<'_, '_>) -> Result<Vec<Stretch>> {
        let Some(mut recorder) = self.recorder.take() else { return Ok(Vec::new()) };
        progress.step("recording")?;
        if let Some(picture) = picture {
            recorder.log_map(picture.width_px() as u32, picture.height_px() as u32, picture.rgb())?;
        }
        for warning in progress.warnings().to_vec() {
            recorder.log_warning(&warning)?;
        }
        let (segments, stretches) = recorder.finish()?;
        self.announcements(segments).into_iter().try_for_each(|event| progress.send(event))?;
        Ok(stretches)
    }
}

/// What writing the maps leaves.
#[derive(Default)]
struct Maps {
    /// The gray values of `depth.png`.
    gray: Option<GrayScale>,
    /// The picture for people.
    picture: Option<Picture>,
    /// The defects, and how long it took to find them.
    found: Option<(Findings, Duration)>,
}

/// Depth map ▶ defects ▶ their files; `None` where too little was measured.
fn find_defects(
    map: &mut dyn MapReader,
    options: &DefectOptions,
    chainage: Chainage,
    sampling: Sampling,
    folder: &Path,
) -> Result<Option<(Findings, Duration)>> {
    let start = Instant::now();
    let mut residual = ResidualWriter::new(folder, residual_tif::NAME);
    let found = defects::find(map, options, chainage, sampling, &mut |strip| residual.push(strip))?;
    let Some(mut findings) = found else { return Ok(None) };
    let codes = Codes::parse(&options.codes)
        .map_err(|(found, expected)| Error::field("recipe", "defects.codes", found, expected))?;
    for defect in &mut findings.list.defects {
        defect.code = codes.of(defect.kind, &defect.severity).map(String::from);
    }
    residual.finish()?;
    defect_list::write(&findings.list, folder)?;
    sections_csv::write(&findings.sections, folder)?;
    Ok(Some((findings, start.elapsed())))
}

fn make<T>(wanted: bool, create: impl FnOnce() -> Result<T>) -> Result<Option<T>> {
    if wanted { create().map(Some) } else { Ok(None) }
}

/// World x, seen from the camera, of the laser line at distance `z_mm` on the optical axis' level.
fn line_x_mm(rig: &Rig, z_mm: f64) -> f64 {
    let plane = &rig.laser.plane;
    let across = match rig.laser.line {
        LineDirection::Vertical => plane.normal.x,
        LineDirection::Horizontal => plane.normal.y,
    };
    (plane.offset_mm - plane.normal.z * z_mm) / across
}

/// The next of 1, 2 and 5 times a power of ten.
fn round_up_125(value: f64) -> f64 {
    let power = 10f64.powf(value.log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|step| step * power).find(|size| *size >= value).unwrap_or(10.0 * power)
}

fn surface_points(placed: &Placed<Cargo>) -> Vec<SurfacePoint> {
    let (measured, Some(pose)) = (&placed.measured, &placed.world_from_camera) else { return Vec::new() };
    let points = measured.profile.points.iter().map(|point| SurfacePoint {
        point_in_world: pose * point.point_in_camera,
        rgb: measured.cargo.colours.at(point.line_position),
        confidence: point.confidence,
        frame: measured.frame,
    });
    points.collect()
}

fn trajectory_row(placed: &Placed<Cargo>) -> TrajectoryRow {
    let (measured, shift) = (&placed.measured, &placed.measured.shift);
    TrajectoryRow {
        frame: measured.frame,
        time_s: measured.time_s,
        dx_px: shift.dx_px,
        dy_px: shift.dy_px,
        scale: shift.scale,
        world_from_camera: placed.world_from_camera,
        rotation_determined: placed.degrees_of_freedom == 6,
        rows_found: measured.profile.points.len() as u32,
        tracked: shift.corners.len() as u32,
        residual_px: shift.residual_px,
    }
}

fn hash_source(info: &SourceInfo, request: &Request) -> Result<Vec<FileEntry>> {
    let files = source::files(&request.source, &request.source_name, info)?;
    let single = files.len() == 1;
    let name = |path: &Path| match path.file_name() {
        Some(file) if !single => file.to_string_lossy().into_owned(),
        _ => request.source_name.clone(),
    };
    let poses = request.poses.iter().map(|file| {
        let name = file.file_name().map_or_else(|| "poses".into(), |name| name.to_string_lossy().into_owned());
        FileEntry::of(file, name)
    });
    files.iter().map(|file| FileEntry::of(file, name(file))).chain(poses).collect()
}

/// Says in words what the figures mean for a person.
fn warn_of_quality(
    quality: &Quality,
    gaps: &[Gap],
    request: &Request,
    given: Option<TrackUse>,
    progress: &mut Progress<'_, '_>,
) -> Result<()> {
    if quality.points == 0 && quality.spots > 0 {
        return progress.warn(
            "no point was measured: the laser line was found, but no ray to it meets the rig's laser plane in front of the \
             camera; check that the rig is this run's, and the sign of its baseline"
                .into(),
        );
    }
    if quality.points == 0 {
        let colour = format!("{:?}", request.rig.laser.colour).to_lowercase();
        return progress.warn(format!(
            "no point was measured: no {colour} laser line was found in any of the {} frames; check that the laser was on, \
             and the rig's laser colour",
            quality.frames
        ));
    }
    let without = quality.frames - quality.frames_with_stripe;
    if without > 0 {
        progress.warn(format!("no laser line was found in {without} of {} frames", quality.frames))?;
    }
    if quality.frames == 1 {
        return progress.warn("the run has a single frame: there is no motion, and the map is one column wide".into());
    }
    let lost = quality.frames - 1 - quality.frames_tracked;
    // Of given poses that leave frames out, their reader has said so.
    if lost > 0 && given != Some(TrackUse::Instead) {
        let places = gaps.iter().filter(|g| g.reason == "not_tracked").count();
        progress.warn(format!(
            "the motion was lost in {lost} of {} frames, in {places} places: lengths along the travel are too short there",
            quality.frames
        ))?;
    }
    Ok(())
}
