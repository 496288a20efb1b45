//! Reading a job and what belongs to it: products, recording segments, log.

use sea_orm::{ColumnTrait, EntityTrait, QueryFilter, QueryOrder, QuerySelect};

use super::listing::job_of;
use super::{Page, Runs, to_u64};
use crate::db::tables::{job, log_line, product, segment};
use crate::error::{Error, Result};
use crate::store::{Facts, Key, ProductName};
use crate::wire::time::to_text;
use crate::wire::{self, RecordingSegment};

/// A product or a recording segment, to be sent.
pub struct StoredFile {
    /// Where it lies.
    pub key: Key,
    /// Its size and hash.
    pub facts: Facts,
}

impl Runs {
    /// A job.
    pub async fn job(&self, id: &str) -> Result<wire::Job> {
        job_of(self.job_row(id).await?)
    }

    async fn job_row(&self, id: &str) -> Result<job::Model> {
        let found = job::Entity::find_by_id(id).one(self.db.read()).await?;
        found.ok_or_else(|| Error::NotFound { what: "job", id: id.into() })
    }

    /// A job's recipe, whole.
    pub async fn recipe_toml(&self, id: &str) -> Result<String> {
        Ok(self.job_row(id).await?.recipe_toml)
    }

    /// The products of a job, in the manifest's order; none until it is done.
    pub async fn products(&self, job: &str, page: &Page) -> Result<wire::ProductPage> {
        self.job_row(job).await?;
        let mut query = product::Entity::find()
            .filter(product::Column::JobId.eq(job))
            .order_by_asc(product::Column::Position)
            .limit(page.limit + 1);
        if let Some(after) = numeric_cursor(page)? {
            query = query.filter(product::Column::Position.gt(after));
        }
        let mut rows = query.all(self.db.read()).await?;
        let next_cursor = page.next(&mut rows, |r| r.position.to_string());
        let of = |p: product::Model| wire::Product {
            bytes: to_u64(p.bytes),
            sha256: p.sha256,
            content_type: content_type(&p.name).into(),
            url: format!("/api/jobs/{job}/products/{}", p.name),
            name: p.name,
        };
        Ok(wire::ProductPage { items: rows.into_iter().map(of).collect(), next_cursor })
    }

    /// One product.
    pub async fn product(&self, job: &str, name: &str) -> Result<StoredFile> {
        let missing = || Error::NotFound { what: "product", id: name.into() };
        let row = self.job_row(job).await?;
        let checked = ProductName::new(name).ok_or_else(missing)?;
        let found = product::Entity::find_by_id((job.to_string(), name.to_string())).one(self.db.read()).await?;
        match (found, row.result_fence) {
            (Some(p), Some(fence)) => Ok(StoredFile {
                key: Key::product(job, fence, &checked),
                facts: Facts { bytes: to_u64(p.bytes), sha256: p.sha256 },
            }),
            _ => Err(missing()),
        }
    }

    /// A file that people look at while the job runs: where it lies, and its facts once it is a product. While the job
    /// runs there may be none at the place.
    pub async fn growing_file(&self, job: &str, name: &str) -> Result<(Key, Option<Facts>)> {
        let row = self.job_row(job).await?;
        if row.result_fence.is_some() {
            let product = self.product(job, name).await?;
            return Ok((product.key, Some(product.facts)));
        }
        let missing = || Error::NotFound { what: "file", id: name.into() };
        let name = ProductName::new(name).ok_or_else(missing)?;
        Ok((Key::product(job, row.fence, &name), None))
    }

    /// The recording so far.
    pub async fn recording(&self, job: &str) -> Result<wire::Recording> {
        const WHOLE: &str = "recording.rrd";
        let state = self.job(job).await?.state;
        let whole = product::Entity::find_by_id((job.to_string(), WHOLE.to_string())).one(self.db.read()).await?;
        Ok(wire::Recording {
            segments: self.segments(job, 0, None).await?,
            complete: state.is_final(),
            recording: whole.map(|_| format!("/api/jobs/{job}/products/{WHOLE}")),
        })
    }

    /// The recording's segments from a number on.
    pub async fn segments(&self, job: &str, from: u32, limit: Option<u64>) -> Result<Vec<RecordingSegment>> {
        let rows = segment::Entity::find()
            .filter(segment::Column::JobId.eq(job))
            .filter(segment::Column::Number.gte(from))
            .order_by_asc(segment::Column::Number)
            .limit(limit)
            .all(self.db.read())
            .await?;
        let of = |s: segment::Model| RecordingSegment {
            number: u32::try_from(s.number).unwrap_or(u32::MAX),
            generation: to_u64(s.fence),
            bytes: to_u64(s.bytes),
            url: format!("/api/jobs/{job}/recording/{}", s.number),
        };
        Ok(rows.into_iter().map(of).collect())
    }

    /// One segment of the recording.
    pub async fn segment(&self, job: &str, number: u32) -> Result<StoredFile> {
        let found = segment::Entity::find_by_id((job.to_string(), i64::from(number))).one(self.db.read()).await?;
        let row = found.ok_or_else(|| Error::NotFound { what: "recording segment", id: format!("{job}/{number}") })?;
        Ok(StoredFile {
            key: Key::segment(job, row.fence, number),
            facts: Facts { bytes: to_u64(row.bytes), sha256: row.sha256 },
        })
    }

    /// A job's log, the oldest line first.
    pub async fn log(&self, job: &str, page: &Page) -> Result<wire::LogPage> {
        self.job_row(job).await?;
        let from = numeric_cursor(page)?.map_or(0, |after| after + 1);
        let mut items = self.log_lines(job, from, page.limit + 1).await?;
        let next_cursor = page.next(&mut items, |l| l.number.to_string());
        Ok(wire::LogPage { items, next_cursor })
    }

    /// Lines of a job's log from a number on.
    pub async fn log_lines(&self, job: &str, from: i64, limit: u64) -> Result<Vec<wire::LogLine>> {
        let rows = log_line::Entity::find()
            .filter(log_line::Column::JobId.eq(job))
            .filter(log_line::Column::Number.gte(from))
            .order_by_asc(log_line::Column::Number)
            .limit(limit)
            .all(self.db.read())
            .await?;
        let of = |l: log_line::Model| wire::LogLine {
            number: to_u64(l.number),
            at: to_text(l.at_ms),
            attempt: u32::try_from(l.attempt).unwrap_or(0),
            text: l.line,
        };
        Ok(rows.into_iter().map(of).collect())
    }
}

fn numeric_cursor(page: &Page) -> Result<Option<i64>> {
    let Some(text) = &page.cursor else { return Ok(None) };
    let bad = |_| Error::field("cursor", format!("cursor is {text:?}"), "the `next_cursor` of the page before");
    Ok(Some(text.parse::<u32>().map_err(bad)?.into()))
}

/// What [`content_type`] may answer, without parameters.
pub const CONTENT_TYPES: [&str; 14] = [
    "application/json",
    "application/octet-stream",
    "image/jpeg",
    "image/png",
    "image/tiff",
    "image/webp",
    "text/csv",
    "text/html",
    "text/plain",
    "video/mp4",
    "video/quicktime",
    "video/webm",
    "video/x-matroska",
    "video/x-msvideo",
];

/// The kind of a file by its name.
pub fn content_type(name: &str) -> &'static str {
    match name.rsplit_once('.').map_or("", |(_, extension)| extension) {
        "json" => "application/json",
        "csv" => "text/csv; charset=utf-8",
        "html" => "text/html; charset=utf-8",
        "txt" => "text/plain; charset=utf-8",
        "png" => "image/png",
        "jpg" | "jpeg" => "image/jpeg",
        "webp" => "image/webp",
        "tif" | "tiff" => "image/tiff",
        "mp4" => "video/mp4",
        "mkv" => "video/x-matroska",
        "webm" => "video/webm",
        "avi" => "video/x-msvideo",
        "mov" => "video/quicktime",
        _ => "application/octet-stream",
    }
}
