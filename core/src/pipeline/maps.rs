//! Everything that is made of the finished map, two things at a time: each squeezes or searches the whole map, on its own
//! core. More at a time would only need more memory.

use std::collections::VecDeque;
use std::sync::mpsc::{Sender, channel};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::progress::Progress;
use super::{ProductGroup, Request};
use crate::defects::{self, Findings, Sampling};
use crate::depth_map::{MapReader, SharedMap};
use crate::error::{Error, Result};
use crate::export::manifest::GrayScale;
use crate::export::preview::{self, Picture, PreviewText};
use crate::export::residual_tif::{self, ResidualWriter};
use crate::export::tiles::TileWriter;
use crate::export::{defect_list, depth_png, depth_tif, sections_csv, texture};
use crate::recipe::Codes;

/// What writing the maps leaves.
#[derive(Default)]
pub(super) struct Maps {
    /// The gray values of `depth.png`.
    pub(super) gray: Option<GrayScale>,
    /// The picture for people.
    pub(super) picture: Option<Picture>,
    /// The defects, and how long it took to find them; `None` where too little was measured.
    pub(super) found: Option<(Findings, Duration)>,
}

/// A thing to make.
enum Task {
    Tiles(Box<TileWriter>),
    Defects,
    DepthTif,
    Preview,
    Texture,
    DepthPng,
}

impl Task {
    fn stage(&self) -> &'static str {
        match self {
            Task::Tiles(_) => "tiles",
            Task::Defects => "defects",
            Task::DepthTif | Task::DepthPng => "depth",
            Task::Preview => "preview",
            Task::Texture => "texture",
        }
    }
}

/// Makes what a request wants of a map.
///
/// # Errors
/// What reading the map or the disk says; a stop.
pub(super) fn write(
    request: &Request,
    map: &SharedMap<'_, '_>,
    tiles: Option<TileWriter>,
    sampling: Sampling,
    progress: &mut Progress<'_, '_>,
) -> Result<Maps> {
    let maker = Maker { request, map, sampling, waiting: Mutex::new(tasks(request, tiles)), made: Mutex::default() };
    std::thread::scope(|scope| {
        let (say, begun) = channel();
        let beside = scope.spawn(|| maker.work(say));
        while let Some(task) = maker.next() {
            let made = progress.step(task.stage()).and_then(|()| maker.make(task));
            made.inspect_err(|_| maker.give_up())?;
            begun.try_iter().try_for_each(|stage| progress.step(stage)).inspect_err(|_| maker.give_up())?;
        }
        begun.iter().try_for_each(|stage| progress.step(stage)).inspect_err(|_| maker.give_up())?;
        beside.join().map_err(|_| Error::internal("maps", "a thread panicked"))?
    })?;
    Ok(maker.made.into_inner().unwrap_or_else(PoisonError::into_inner))
}

/// What is to be made, that which takes longest first.
fn tasks(request: &Request, tiles: Option<TileWriter>) -> VecDeque<Task> {
    use ProductGroup::{Defects, Depth, Preview, Recording, Report, Texture};
    let wants = |groups: &[ProductGroup]| groups.iter().any(|group| request.products.contains(group));
    let mut tasks: VecDeque<Task> = tiles.map(|tiles| Task::Tiles(Box::new(tiles))).into_iter().collect();
    for (groups, task) in [
        (&[Defects, Report][..], Task::Defects),
        (&[Depth], Task::DepthTif),
        (&[Preview, Recording], Task::Preview),
        (&[Texture], Task::Texture),
        (&[Depth], Task::DepthPng),
    ] {
        if wants(groups) {
            tasks.push_back(task);
        }
    }
    tasks
}

struct Maker<'a, 'm, 'f> {
    request: &'a Request,
    map: &'a SharedMap<'m, 'f>,
    sampling: Sampling,
    waiting: Mutex<VecDeque<Task>>,
    made: Mutex<Maps>,
}

impl Maker<'_, '_, '_> {
    fn next(&self) -> Option<Task> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner).pop_front()
    }

    /// Nothing more is begun.
    fn give_up(&self) {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner).clear();
    }

    fn made(&self) -> MutexGuard<'_, Maps> {
        self.made.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Makes one thing after the other, and says which.
    fn work(&self, say: Sender<&'static str>) -> Result<()> {
        while let Some(task) = self.next() {
            // Nobody listens only after a stop, which ends this too.
            let _ = say.send(task.stage());
            self.make(task).inspect_err(|_| self.give_up())?;
        }
        Ok(())
    }

    fn make(&self, task: Task) -> Result<()> {
        let (map, folder) = (&mut self.map.reader(), &self.request.out_dir);
        match task {
            Task::Tiles(tiles) => tiles.finish(map),
            Task::DepthTif => depth_tif::write(map, &folder.join("depth.tif")),
            Task::Texture => texture::write(map, folder),
            Task::DepthPng => {
                let gray = depth_png::write(map, folder)?;
                self.made().gray = gray;
                Ok(())
            }
            Task::Preview => self.paint(map),
            Task::Defects => self.find_defects(map),
        }
    }

    fn paint(&self, map: &mut dyn MapReader) -> Result<()> {
        let Request { source_name, chainage, out_dir, products, .. } = self.request;
        let text = PreviewText {
            title: source_name.clone(),
            start_chainage_mm: chainage.start_mm,
            chainage_falls: chainage.falls,
        };
        let picture = preview::picture(map, &text)?;
        if products.contains(&ProductGroup::Preview) {
            picture.save(&out_dir.join("preview.png"))?;
            picture.save_thumbnail(&out_dir.join("thumbnail.jpg"))?;
        }
        self.made().picture = Some(picture);
        Ok(())
    }

    /// Depth map ▶ defects ▶ their files.
    fn find_defects(&self, map: &mut dyn MapReader) -> Result<()> {
        let (options, folder) = (&self.request.recipe.defects, &self.request.out_dir);
        let start = Instant::now();
        let mut residual = ResidualWriter::new(folder, residual_tif::NAME);
        let found =
            defects::find(map, options, self.request.chainage, self.sampling, &mut |strip| residual.push(strip))?;
        let Some(mut findings) = found else { return Ok(()) };
        let codes = Codes::parse(&options.codes)
            .map_err(|(found, expected)| Error::field("recipe", "defects.codes", found, expected))?;
        for defect in &mut findings.list.defects {
            defect.code = codes.of(defect.kind, &defect.severity).map(String::from);
        }
        residual.finish()?;
        defect_list::write(&findings.list, folder)?;
        sections_csv::write(&findings.sections, folder)?;
        self.made().found = Some((findings, start.elapsed()));
        Ok(())
    }
}
