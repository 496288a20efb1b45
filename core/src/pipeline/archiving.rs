//! What completes a job's archive: everything from which it can be run again.

use super::Request;
use crate::depth_map::MapReader;
use crate::error::{Error, Result};
use crate::export::archive_mcap::ArchiveWriter;
use crate::export::manifest::Manifest;
use crate::source::{Beside, ODOMETRY_CSV, encoded_frames, odometry_csv};

/// Products that the archive keeps too, where they are made.
const KEPT: [(&str, &str); 2] = [("preview.png", "image/png"), (DEFECTS, "application/json")];
const DEFECTS: &str = "defects.json";
const POSES: &str = "poses.csv";
const B_FRAMES: &str = "the video has B-frames: the archive keeps it as it is, in decoding order, but Foxglove and rerun play \
                        MCAP video only without; record without B-frames (ffmpeg: -bf 0)";

/// A job that has ended, but for its archive.
pub(super) struct ArchivedJob<'a> {
    pub(super) request: &'a Request,
    pub(super) beside: &'a Beside,
    /// Frames that were processed.
    pub(super) frames: u64,
    pub(super) manifest: &'a Manifest,
}

impl ArchivedJob<'_> {
    /// Adds the frames as they were given, the map, and what is attached. Returns what is to be known of the archive, in
    /// words.
    pub(super) fn complete(
        &self,
        mut archive: ArchiveWriter,
        map: Option<&mut dyn MapReader>,
        warnings: &[String],
    ) -> Result<Option<String>> {
        self.add_poses(&mut archive)?;
        let note = self.add_frames(&mut archive)?;
        if let Some(map) = map {
            let geometry = map.geometry();
            archive.depth_map(&geometry, |column, row, width, height| map.window(column, row, width, height))?;
        }
        for warning in warnings.iter().chain(&note) {
            archive.warning(warning)?;
        }
        let json = serde_json::to_vec_pretty(self.manifest).map_err(|e| Error::internal("archive", e))?;
        archive.attach("manifest.json", "application/json", &json)?;
        self.add_products(&mut archive)?;
        archive.finish()?;
        Ok(note)
    }

    /// The poses that came with the frames.
    fn add_poses(&self, archive: &mut ArchiveWriter) -> Result<()> {
        if let Some(path) = &self.request.poses {
            let poses = std::fs::read(path).map_err(|e| Error::io(path, e))?;
            return archive.attach(POSES, "text/csv", &poses);
        }
        if self.beside.poses.is_empty() {
            return Ok(());
        }
        archive.attach(ODOMETRY_CSV, "text/csv", odometry_csv(&self.beside.poses).as_bytes())
    }

    /// The frames as the source holds them.
    fn add_frames(&self, archive: &mut ArchiveWriter) -> Result<Option<String>> {
        let request = self.request;
        let frames = match encoded_frames(&request.source, &request.source_name, request.fps, &request.topics) {
            Ok(frames) => frames,
            Err(Error::Input { found, .. }) => return Ok(Some(format!("the archive holds no camera frames: {found}"))),
            Err(error) => return Err(error),
        };
        let video = frames.video();
        if let Some(video) = &video {
            archive.video(video)?;
        }
        for frame in frames.take(self.frames as usize) {
            archive.frame(&frame?)?;
        }
        Ok(video.filter(|video| video.reordered).map(|_| B_FRAMES.into()))
    }

    fn add_products(&self, archive: &mut ArchiveWriter) -> Result<()> {
        for (name, media_type) in KEPT {
            let path = self.request.out_dir.join(name);
            if !path.exists() {
                continue;
            }
            let bytes = std::fs::read(&path).map_err(|e| Error::io(&path, e))?;
            archive.attach(name, media_type, &bytes)?;
            if name == DEFECTS {
                archive.defects(&bytes)?;
            }
        }
        Ok(())
    }
}
