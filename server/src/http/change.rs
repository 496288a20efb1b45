//! What changed between two jobs of one asset: worked out off the request's thread, one at a time, and kept for those who
//! ask again.

use std::collections::{HashMap, VecDeque};
use std::path::Path as FilePath;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use axum::body::Body;
use axum::extract::State;
use axum::http::StatusCode;
use axum::http::header::{CONTENT_DISPOSITION, CONTENT_TYPE, RETRY_AFTER};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use stria_core::defects::{DefectList, change};
use stria_core::export::change_list::{MAP_NAME, state_name};
use stria_core::export::defect_list;
use stria_core::export::residual_tif::{self, ResidualFile, ResidualWriter};
use stria_core::recipe::{DefectOptions, Recipe};
use tempfile::TempDir;
use tokio::io::AsyncReadExt;
use tokio::sync::{Semaphore, watch};
use tokio_util::io::{ReaderStream, StreamReader};
use utoipa::IntoParams;

use super::App;
use super::extract::{Path, Query};
use super::stored::StoredFileReader;
use crate::error::{Error, Result};
use crate::wire::{self, ChangeReport, Direction, Problem};

/// Comparisons worked out at the same time: each takes a core.
const AT_ONCE: usize = 1;
/// Comparisons that may wait for that.
const MOST_WAITING: usize = 16;
/// Results that are kept, each with its map on the disk.
const MOST_KEPT: usize = 24;
/// A request waits so long for a result, then asks its sender to come back.
const WAIT: Duration = Duration::from_secs(10);
/// When to come back, s.
const COME_BACK_S: u64 = 2;
/// A list of defects larger than this is not compared, bytes.
const MAX_LIST_BYTES: u64 = 64 * 1024 * 1024;

type Outcome = Option<std::result::Result<Arc<Worked>, Refusal>>;
/// The earlier job and the later one, each with where its run lies.
type Pair = (String, String);

/// A comparison: what is told of it, and the difference map in a folder of its own, which goes when this does.
struct Worked {
    report: ChangeReport,
    difference: Option<TempDir>,
}

/// Why two jobs cannot be compared, to be said to everyone who asks.
#[derive(Clone)]
enum Refusal {
    Input { detail: String, field: Option<String>, expected: Option<String> },
    Failed(String),
}

impl From<Error> for Refusal {
    fn from(error: Error) -> Refusal {
        match error {
            Error::Input { detail, field, expected } => Refusal::Input { detail, field, expected },
            other => Refusal::Failed(other.to_string()),
        }
    }
}

impl From<Refusal> for Error {
    fn from(refusal: Refusal) -> Error {
        match refusal {
            Refusal::Input { detail, field, expected } => Error::Input { detail, field, expected },
            Refusal::Failed(words) => Error::Internal(words),
        }
    }
}

/// The comparisons that were asked for lately.
#[derive(Clone)]
pub struct Changes {
    known: Arc<Mutex<Known>>,
    turns: Arc<Semaphore>,
}

#[derive(Default)]
struct Known {
    results: HashMap<Pair, watch::Receiver<Outcome>>,
    /// The oldest first.
    order: VecDeque<Pair>,
}

impl Default for Changes {
    fn default() -> Changes {
        Changes { known: Arc::default(), turns: Arc::new(Semaphore::new(AT_ONCE)) }
    }
}

impl Changes {
    fn known(&self) -> MutexGuard<'_, Known> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The comparison of a pair, begun where nobody has asked for it yet.
    fn of(&self, app: &App, task: Task) -> Result<watch::Receiver<Outcome>> {
        let mut known = self.known();
        let pair = (task.before.key(), task.after.key());
        if let Some(receiver) = known.results.get(&pair) {
            return Ok(receiver.clone());
        }
        let waiting = known.results.values().filter(|r| r.borrow().is_none()).count();
        if waiting >= MOST_WAITING {
            return Err(Error::Busy(format!("{waiting} comparisons are waiting; come back in a moment")));
        }
        let (sender, receiver) = watch::channel(None);
        known.results.insert(pair.clone(), receiver.clone());
        known.order.push_back(pair.clone());
        if known.order.len() > MOST_KEPT
            && let Some(oldest) = known.order.pop_front()
        {
            known.results.remove(&oldest);
        }
        let (changes, app) = (self.clone(), app.clone());
        tokio::spawn(async move {
            let result = changes.work_out(&app, task).await;
            if let Err(Error::Internal(words)) = &result {
                tracing::error!(words, "two jobs could not be compared");
            }
            // Who asks again after a failure starts again.
            if !matches!(&result, Ok(_) | Err(Error::Input { .. })) {
                let mut known = changes.known();
                known.results.remove(&pair);
                known.order.retain(|each| *each != pair);
            }
            sender.send_replace(Some(result.map(Arc::new).map_err(Refusal::from)));
        });
        Ok(receiver)
    }

    /// Makes the folder for the maps anew: what a server that was killed left there belongs to nobody.
    pub(crate) fn prepare(folder: &std::path::Path) -> Result<()> {
        match std::fs::remove_dir_all(folder) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::io(folder, e)),
            _ => std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e)),
        }
    }

    async fn work_out(&self, app: &App, task: Task) -> Result<Worked> {
        let _turn = self.turns.acquire().await.map_err(|e| Error::Internal(e.to_string()))?;
        let read = (list(app, &task.before).await?, list(app, &task.after).await?);
        let residual = |job: String| {
            let app = app.clone();
            async move {
                let file = app.runs.product(&job, residual_tif::NAME).await?;
                Ok::<_, Error>(StoredFileReader::new(app.store.clone(), file.key, file.facts.bytes))
            }
        };
        let files = (residual(task.before.job.clone()).await?, residual(task.after.job.clone()).await?);
        let (stop, folder) = (app.stop.clone(), app.config.places.changes());
        let worked = tokio::task::spawn_blocking(move || {
            let path = FilePath::new(residual_tif::NAME);
            let (mut before, mut after) = (ResidualFile::read(files.0, path)?, ResidualFile::read(files.1, path)?);
            let folder = tempfile::tempdir_in(&folder).map_err(|e| stria_core::Error::io(&folder, e))?;
            let mut difference = ResidualWriter::new(folder.path(), MAP_NAME);
            let found = change::compare(
                &mut change::Run { residual: &mut before, list: &read.0 },
                &mut change::Run { residual: &mut after, list: &read.1 },
                &task.options,
                &mut |strip| match stop.is_cancelled() {
                    true => Err(stria_core::Error::Cancelled),
                    false => difference.push(strip),
                },
            )?;
            let difference = difference.finish()?.then_some(folder);
            Ok::<_, stria_core::Error>(Worked { report: report_of(task.before.job, task.after.job, found), difference })
        });
        let worked = worked.await.map_err(|e| Error::Internal(format!("the comparison stopped: {e}")))?;
        worked.map_err(|e| Error::from_core("change", e))
    }
}

/// What shall be compared.
struct Task {
    before: Side,
    after: Side,
    options: DefectOptions,
}

/// One of the two jobs, and where its run lies now.
struct Side {
    job: String,
    asset: String,
    start_mm: f64,
    falls: bool,
}

impl Side {
    /// A run that is moved is compared anew.
    fn key(&self) -> String {
        format!("{} {} {}", self.job, self.start_mm, self.falls)
    }

    async fn of(app: &App, job: &str) -> Result<Side> {
        // A job without these products has nothing to compare.
        for name in [defect_list::JSON_NAME, residual_tif::NAME] {
            app.runs.product(job, name).await?;
        }
        let run = app.runs.get(&app.runs.job(job).await?.run).await?;
        let falls = run.direction == Direction::Backward;
        Ok(Side { job: job.into(), asset: run.asset, start_mm: run.chainage_mm, falls })
    }
}

async fn list(app: &App, side: &Side) -> Result<DefectList> {
    let file = app.runs.product(&side.job, defect_list::JSON_NAME).await?;
    if file.facts.bytes > MAX_LIST_BYTES {
        let found = format!("the list of job {} has {} bytes", side.job, file.facts.bytes);
        return Err(Error::field("change", found, format!("at most {MAX_LIST_BYTES}")));
    }
    let stream = app.store.read(&file.key, 0..file.facts.bytes).await?;
    let mut text = Vec::new();
    let read = StreamReader::new(stream).read_to_end(&mut text).await;
    read.map_err(|e| Error::Internal(format!("{}: {e}", defect_list::JSON_NAME)))?;
    let mut list = defect_list::parse(defect_list::JSON_NAME, &text).map_err(|e| Error::from_core("change", e))?;
    // The run may have been moved or turned since.
    (list.start_chainage_mm, list.chainage_falls) = (side.start_mm, side.falls);
    Ok(list)
}

#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct ChangeQuery {
    /// The earlier job, of the same asset.
    #[param(required = true)]
    before: Option<String>,
}

/// What changed from an earlier job to this one, of the same asset, either way along it. A comparison that takes longer than
/// some seconds is answered with 202 and goes on; whoever asks again gets it.
#[utoipa::path(get, path = "/api/jobs/{job}/change", tag = "defects",
    params(("job" = String, Path, description = "The later job"), ChangeQuery),
    responses((status = 200, body = ChangeReport),
        (status = 202, description = "It is being worked out; `Retry-After` says when to come back"),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_change(
    State(app): State<App>,
    Path(job): Path<String>,
    Query(query): Query<ChangeQuery>,
) -> Result<Response> {
    Ok(match worked_out(&app, &job, query).await? {
        Some(worked) => axum::Json(worked.report.clone()).into_response(),
        None => come_back(),
    })
}

/// The map of that change as a GeoTIFF like `residual.tif`: later less earlier, mm, in the earlier run's world, its slow part
/// taken off; NaN where not both measured.
#[utoipa::path(get, path = "/api/jobs/{job}/change/difference.tif", tag = "defects",
    params(("job" = String, Path, description = "The later job"), ChangeQuery),
    responses((status = 200, content_type = "image/tiff", body = Vec<u8>),
        (status = 202, description = "It is being worked out; `Retry-After` says when to come back"),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_difference(
    State(app): State<App>,
    Path(job): Path<String>,
    Query(query): Query<ChangeQuery>,
) -> Result<Response> {
    let Some(worked) = worked_out(&app, &job, query).await? else { return Ok(come_back()) };
    let Some(folder) = &worked.difference else {
        let what = "the two runs have no place in common that both measured".to_string();
        return Err(Error::Input { detail: what, field: Some("before".into()), expected: None });
    };
    let path = folder.path().join(MAP_NAME);
    // Open, it stays even when the comparison is forgotten.
    let file = tokio::fs::File::open(&path).await.map_err(|e| Error::Internal(format!("{}: {e}", path.display())))?;
    let save_as = format!("attachment; filename=\"{MAP_NAME}\"");
    let headers = [(CONTENT_TYPE, "image/tiff".to_string()), (CONTENT_DISPOSITION, save_as)];
    Ok((headers, Body::from_stream(ReaderStream::new(file))).into_response())
}

fn come_back() -> Response {
    (StatusCode::ACCEPTED, [(RETRY_AFTER, COME_BACK_S.to_string())]).into_response()
}

/// The comparison of an earlier job with this one; `None` where it takes longer than a request waits.
async fn worked_out(app: &App, job: &str, query: ChangeQuery) -> Result<Option<Arc<Worked>>> {
    let after = Side::of(app, job).await?;
    let Some(before) = query.before else {
        return Err(Error::field("before", "the query names no earlier job", "before=JOB, a job of the same asset"));
    };
    let before = Side::of(app, &before).await?;
    if before.asset != after.asset {
        let found = format!("the earlier job is of {:?}, the later one of {:?}", before.asset, after.asset);
        return Err(Error::field("before", found, "two jobs of the same asset"));
    }
    let recipe = Recipe::from_toml("recipe", &app.runs.recipe_toml(job).await?);
    let options = recipe.map_err(|e| Error::Internal(format!("the recipe of job {job}: {e}")))?.defects;
    let mut receiver = app.changes.of(app, Task { before, after, options })?;
    let outcome = match tokio::time::timeout(WAIT, receiver.wait_for(Option::is_some)).await {
        Ok(Ok(outcome)) => outcome.clone(),
        Ok(Err(_)) => return Err(Error::Internal("the comparison ended without a word".into())),
        Err(_) => return Ok(None),
    };
    match outcome {
        Some(Ok(worked)) => Ok(Some(worked)),
        Some(Err(refusal)) => Err(refusal.into()),
        None => Err(Error::Internal("the comparison ended without a result".into())),
    }
}

fn report_of(before: String, after: String, list: change::ChangeList) -> ChangeReport {
    let laid = list.registration;
    ChangeReport {
        before,
        after,
        registration: wire::Registration {
            offset_x_mm: laid.offset_x_mm,
            offset_y_mm: laid.offset_y_mm,
            sd_x_mm: laid.sd_x_mm,
            sd_y_mm: laid.sd_y_mm,
            windows: laid.windows,
            windows_agreeing: laid.windows_agreeing,
        },
        level_of_detection_mm: list.level_of_detection_mm,
        claimed_from_mm: list.claimed_from_mm,
        compared_area_mm2: list.compared_area_mm2,
        changes: list.changes.into_iter().map(change_of).collect(),
        unchanged: list
            .unchanged
            .into_iter()
            .map(|same| wire::SameDefect {
                before_number: same.before_id,
                after_number: same.after_id,
                delta_depth_mm: same.delta_depth_mm,
            })
            .collect(),
        unsure_before: list.unsure_before,
        unsure_after: list.unsure_after,
    }
}

fn change_of(found: change::Change) -> wire::Change {
    wire::Change {
        id: found.id,
        state: state_name(found.state).into(),
        chainage_mm: found.chainage_mm,
        x_mm: found.x_mm,
        y_mm: found.y_mm,
        clock_h: found.clock_h,
        height_mm: found.height_mm,
        delta_depth_mm: found.delta_depth_mm,
        area_mm2: found.area_mm2,
        volume_mm3: found.volume_mm3,
        confidence: found.confidence,
        before_number: found.before_id,
        before_depth_mm: found.before_depth_mm,
        after_number: found.after_id,
        after_depth_mm: found.after_depth_mm,
    }
}
