//! The products of a job: what is written while the frames go by, and what is written at the end.

use std::path::Path;

use super::archiving::ArchivedJob;
use super::growing_map::GrowingMap;
use super::laz::LazThread;
use super::maps::{self, Maps};
use super::progress::Progress;
use super::quality::{QualityCounter, warn_of_quality};
use super::{Cargo, Event, Newest, ProductGroup, Request, Timings};
use crate::defects::{Findings, Sampling};
use crate::depth_map::{FinishedMap, MapReader, SharedMap, SurfaceMap};
use crate::error::{Error, Result};
use crate::export::archive_mcap::ArchiveWriter;
use crate::export::cloud_ply::CloudPlyWriter;
use crate::export::live_frame::{self, LiveFrameWriter};
use crate::export::manifest::{FileEntry, Manifest, SCHEMA_VERSION, Stretch, list_products, sha256_of_bytes};
use crate::export::npy::NpyWriter;
use crate::export::preview::Picture;
use crate::export::report::{self, ReportRun};
use crate::export::tiles::TileWriter;
use crate::export::trajectory_csv::{TrajectoryRow, TrajectoryWriter};
use crate::recipe::Method;
use crate::recording::{FrameSteps, RecordedRun, Recordings, Segment};
use crate::rig::LineDirection;
use crate::source::{self, Beside, SourceInfo};
use crate::surface::{Placed, SurfacePoint};

/// Where live recording segments lie in the product folder; they are no products.
const SEGMENTS: &str = "recording";

/// All writers of a job.
pub(super) struct Products<'a> {
    request: &'a Request,
    beside: &'a Beside,
    map: GrowingMap,
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
    /// Mean width of the line at half of its height, px; 0 with method `paper`.
    line_width_px: f64,
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
            map: GrowingMap::default(),
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
            live: make(request.live_segments, || LiveFrameWriter::create(folder, &rig.camera))?,
            watched: info.still_open,
            frames: 0,
            line_width_px: 0.0,
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
        if let Some(grid) = self.map.add(self.request, placed, &points)?
            && self.request.products.contains(&ProductGroup::Tiles)
        {
            self.tiles = Some(TileWriter::create(&self.request.out_dir, grid)?);
        }
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
                image: picture.map(|p| &p.image),
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

    /// Hands tiles out while the run goes on, now and then, where people can look. Answers what changed.
    fn write_changed_tiles(&mut self) -> Result<Vec<String>> {
        let (Some(map), Some(tiles)) = (self.map.begun(), &mut self.tiles) else { return Ok(Vec::new()) };
        if !self.request.live_segments || !self.frames.is_multiple_of(u64::from(self.request.recipe.map.tile_frames)) {
            return Ok(Vec::new());
        }
        for index in map.take_changed() {
            tiles.put(index.0, index.1, &map.tile_window(index)?)?;
        }
        tiles.publish()
    }

    /// How wide the line was, for the blur of what was measured with it.
    pub(super) fn note_line_width(&mut self, width_px: f64) {
        self.line_width_px = width_px;
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
        let (mut map, beyond) = std::mem::take(&mut self.map).finish();
        let mut finished = map.as_mut().map(SurfaceMap::finished).transpose()?.flatten();
        let geometry = finished.as_ref().map(|map| map.geometry());
        let coverage = finished.as_ref().map_or(0.0, FinishedMap::coverage);
        let (quality, mut gaps, resolution) = quality.finish(&request.rig, coverage);
        warn_of_quality(&quality, &gaps, request, request.track_use(self.beside), progress)?;
        beyond.warning(request).into_iter().try_for_each(|warning| progress.warn(warning))?;
        gaps.extend(beyond.gaps);
        let sampling = resolution.map_or_else(Sampling::default, |r| Sampling {
            profile_step_mm: r.r_lateral_mm.unwrap_or(0.0),
            line_step_mm: r.r_vertical_mm,
            line_width_mm: self.line_width_px * r.r_vertical_mm,
        });
        let shared = finished.as_mut().map(SharedMap::new);
        let tiles = self.tiles.take();
        let Maps { gray, picture, found } = match &shared {
            Some(map) => timings.time("maps", || maps::write(request, map, tiles, sampling, progress))?,
            None => Maps::default(),
        };
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
        let findings = found.map(|(findings, _)| findings);
        let last = self.finish_report_archive_recording(findings, shared.as_ref(), &manifest, picture, progress)?;
        timings.merge(last.timings);
        manifest.recordings = last.stretches;
        if let Some(warning) = last.archive_note {
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

    /// Writes the archive, and beside it, on the other core, the report and the recording's end: they need the same map,
    /// and nothing of each other.
    fn finish_report_archive_recording(
        &mut self,
        findings: Option<Findings>,
        map: Option<&SharedMap<'_, '_>>,
        manifest: &Manifest,
        picture: Option<Picture>,
        progress: &mut Progress<'_, '_>,
    ) -> Result<Last> {
        let (request, beside, frames) = (self.request, self.beside, self.frames);
        let (archive, recorder) = (self.archive.take(), self.recorder.take());
        let warnings = progress.warnings().to_vec();
        let reported = findings.zip(map).filter(|_| self.wants(ProductGroup::Report));
        for (stage, wanted) in
            [("report", reported.is_some()), ("archive", archive.is_some()), ("recording", recorder.is_some())]
        {
            if wanted {
                progress.step(stage)?;
            }
        }
        let (last, segments) = std::thread::scope(|scope| {
            let other = scope.spawn(|| {
                let mut timings = Timings::default();
                if let Some((findings, map)) = reported {
                    let mut map = map.reader();
                    timings.time("report", || write_report(request, &findings, &mut map, manifest, &warnings))?;
                }
                let recorded = recorder.map(|r| timings.time("recording", || finish_recording(r, picture, &warnings)));
                Ok::<_, Error>((timings, recorded.transpose()?.unwrap_or_default()))
            });
            let mut timings = Timings::default();
            let archive_note = archive.map(|archive| {
                let job = ArchivedJob { request, beside, frames, manifest };
                let mut map = map.map(SharedMap::reader);
                let map = map.as_mut().map(|map| map as &mut dyn MapReader);
                timings.time("archive", || job.complete(archive, map, &warnings))
            });
            let other = other.join().map_err(|_| Error::internal("report", "a thread panicked"))?;
            let (archive_note, (others, (segments, stretches))) = (archive_note.transpose()?.flatten(), other?);
            timings.merge(others);
            Ok::<_, Error>((Last { timings, archive_note, stretches }, segments))
        })?;
        self.announcements(segments).into_iter().try_for_each(|event| progress.send(event))?;
        Ok(last)
    }
}

/// What the end of report, archive and recording leaves.
struct Last {
    timings: Timings,
    /// What is to be known of the archive, in words.
    archive_note: Option<String>,
    stretches: Vec<Stretch>,
}

fn write_report(
    request: &Request,
    findings: &Findings,
    map: &mut dyn MapReader,
    manifest: &Manifest,
    warnings: &[String],
) -> Result<()> {
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

fn finish_recording(
    mut recorder: Recordings,
    picture: Option<Picture>,
    warnings: &[String],
) -> Result<(Vec<Segment>, Vec<Stretch>)> {
    if let Some(picture) = picture {
        recorder.log_map(picture.width_px() as u32, picture.height_px() as u32, picture.rgb())?;
    }
    warnings.iter().try_for_each(|warning| recorder.log_warning(warning))?;
    recorder.finish()
}

fn make<T>(wanted: bool, create: impl FnOnce() -> Result<T>) -> Result<Option<T>> {
    if wanted { create().map(Some) } else { Ok(None) }
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
